"""Whether two engines simulate the same model, line by line, before either takes a step."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.engines.interface import Engine, EngineContract, Precision
from drake_diff.exceptions import NotOfferedError
from drake_diff.mechanics.joints import JointContract

Verdict = Literal["equal", "mapped", "different"]
# Two libraries' sums over a tree differ by rounding, magnified by cancellation; a wrong number differs by far more.
SAME_NUMBER: dict[Precision, float] = {"float64": 1e-9, "float32": 1e-5}
# Below any inertia that matters: what MuJoCo gives a point mass, 2e-15 kg m^2, and rounding of zeros.
NOTHING: dict[Precision, float] = {"float64": 1e-12, "float32": 1e-6}
RANDOM_STATES = 5


@dataclass(frozen=True)
class ContractLine:
    """One thing that two engines must share: "equal", "mapped" (and how), or "different" (and why).

    `reason` is why an engine cannot have it, where it is the engine's doing; it stands in the detail too.
    """

    quantity: str
    verdict: Verdict
    detail: str
    reason: str = ""

    def __str__(self) -> str:
        return f"{self.verdict:9} {self.quantity}: {self.detail}"


def match_contracts(a: Engine, b: Engine) -> tuple[ContractLine, ...]:
    """A line per quantity of the contracts of `a` and `b`, M(q) and bias at random states among them.

    "different" is the model's doing (a mass that is another) or the engine's (a contact law that it has not); the
    detail gives both values, the place, and the engine's reason where it has one.
    """
    one, two = a.contract, b.contract
    return (
        _order(one, two),
        *(_joint_line(one, two, quantity, read) for quantity, read in JOINT_NUMBERS.items()),
        _numbers(one, two, "gravity", one.gravity, two.gravity, "[m/s^2]"),
        _actuation(one, two),
        _effort_limits(one, two),
        *_dynamics(a, b, one, two),
        _numbers(one, two, "time step", (one.time_step,), (two.time_step,), "[s]"),
        _text(one, two, "integrator", one.integrator, two.integrator),
        _state(one, two),
        _limit_law(one, two),
        _contact_law(one, two),
        _contact_pairs(one, two),
        _solver_tolerance(one, two),
        _text(one, two, "reset", one.reset, two.reset),
        _scalar_type(one, two),
        _derivatives(one, two),
    )


JOINT_NUMBERS: dict[str, Callable[[JointContract], tuple[Any, ...]]] = {
    "joint types": lambda j: (j.kind,),
    "frames": lambda j: (*j.axis, *j.anchor),
    "mass": lambda j: (j.mass,),
    "center of mass": lambda j: j.center_of_mass,
    "inertia": lambda j: j.inertia,
    "damping": lambda j: (j.damping,),
    "armature": lambda j: (j.armature,),
    "springs": lambda j: (j.stiffness, j.rest if j.stiffness else 0.0),
    "position limits": lambda j: (j.lower, j.upper),
}


def _coarser(one: EngineContract, two: EngineContract) -> Precision:
    return "float32" if "float32" in (one.precision, two.precision) else "float64"


def _same(a: Any, b: Any, precision: Precision) -> bool:
    if isinstance(a, str) or isinstance(b, str) or not (math.isfinite(a) and math.isfinite(b)):
        return bool(a == b)
    return abs(a - b) <= max(NOTHING[precision], SAME_NUMBER[precision] * max(abs(a), abs(b)))


def _values(values: tuple[Any, ...]) -> str:
    shown = [value if isinstance(value, str) else f"{value:.10g}" for value in values]
    return shown[0] if len(shown) == 1 else "(" + ", ".join(shown) + ")"


def _difference(one: EngineContract, two: EngineContract, quantity: str, what: str) -> ContractLine:
    reason = one.reasons.get(quantity) or two.reasons.get(quantity) or ""
    return ContractLine(quantity, "different", f"{what}; {reason}" if reason else what, reason)


def _text(one: EngineContract, two: EngineContract, quantity: str, a: str, b: str) -> ContractLine:
    if a == b:
        return ContractLine(quantity, "equal", a)
    return _difference(one, two, quantity, f"{one.engine}: {a}; {two.engine}: {b}")


def _numbers(
    one: EngineContract, two: EngineContract, quantity: str, a: tuple[Any, ...], b: tuple[Any, ...], unit: str = ""
) -> ContractLine:
    precision = _coarser(one, two)
    if len(a) == len(b) and all(_same(x, y, precision) for x, y in zip(a, b, strict=True)):
        return ContractLine(quantity, "equal", f"{_values(a)} {unit}".strip())
    return _difference(one, two, quantity, f"{one.engine}: {_values(a)}; {two.engine}: {_values(b)} {unit}".strip())


def _order(one: EngineContract, two: EngineContract) -> ContractLine:
    a, b = (tuple(j.name for j in contract.joints) for contract in (one, two))
    if a != b:
        return _numbers(one, two, "joint order and names", a, b)
    if one.native_order != two.native_order:
        inside = f"{one.engine}: {_values(one.native_order)}; {two.engine}: {_values(two.native_order)}"
        return ContractLine("joint order and names", "mapped", f"by name, from {inside}")
    return ContractLine("joint order and names", "equal", _values(a))


def _joint_line(
    one: EngineContract, two: EngineContract, quantity: str, read: Callable[[JointContract], tuple[Any, ...]]
) -> ContractLine:
    """By name, so that another order is named once and not in every line."""
    others = {j.name: j for j in two.joints}
    wrong, named = [], []
    for joint in one.joints:
        if joint.name in others:
            line = _numbers(one, two, quantity, read(joint), read(others[joint.name]))
            wrong += [line] if line.verdict == "different" else []
            named += [f"{joint.name}: {line.detail}"] if line.verdict == "different" else []
    if wrong:
        return ContractLine(quantity, "different", "; ".join(named), wrong[0].reason)
    common = [j.name for j in one.joints if j.name in others]
    if not common:
        return ContractLine(quantity, "different", "no joint has the same name in both")
    return ContractLine(quantity, "equal", "of " + ", ".join(common))


def _actuation(one: EngineContract, two: EngineContract) -> ContractLine:
    quantity = "actuator mapping"
    if one.inputs != two.inputs:
        return _numbers(one, two, quantity, one.inputs, two.inputs)
    if not one.inputs:
        return ContractLine(quantity, "equal", "no inputs")
    a, b, precision = _by_joint(one), _by_joint(two), _coarser(one, two)
    wrong = [
        f"{one.engine}: {name} drives {a.get(name, {})}; {two.engine}: {b.get(name, {})}"
        for name in one.inputs
        if a[name].keys() != b[name].keys()
        or not all(_same(gain, b[name][j], precision) for j, gain in a[name].items())
    ]
    if wrong:
        return _difference(one, two, quantity, "; ".join(wrong))
    return ContractLine(quantity, "equal", "; ".join(f"{name} drives {a[name]}" for name in one.inputs))


def _by_joint(contract: EngineContract) -> dict[str, dict[str, float]]:
    """Of each input, the generalized force per unit by joint."""
    owners = [name for j in contract.joints for name in [j.name] * (6 if j.kind == "quaternion_floating" else 1)]
    rows = list(zip(owners, contract.actuation, strict=True))
    return {name: {joint: row[i] for joint, row in rows if row[i]} for i, name in enumerate(contract.inputs)}


def _effort_limits(one: EngineContract, two: EngineContract) -> ContractLine:
    if not one.inputs and not two.inputs:
        return ContractLine("effort limits", "equal", "no inputs")
    return _numbers(one, two, "effort limits", one.effort_limits, two.effort_limits)


def _dynamics(a: Engine, b: Engine, one: EngineContract, two: EngineContract) -> tuple[ContractLine, ContractLine]:
    """M and bias at random states, each engine asked in Drake's coordinates."""
    kinds = [j.kind for j in one.joints]
    if kinds != [j.kind for j in two.joints]:
        why = "not comparable: the joints are of other types"
        return ContractLine("M(q)", "different", why), ContractLine("bias(q, v)", "different", why)
    random = np.random.default_rng(0)
    states = [random_state(kinds, random) for _ in range(RANDOM_STATES)]
    return (
        _term(one, two, "M(q)", [(q,) for q, _ in states], a.mass_matrix, b.mass_matrix),
        _term(one, two, "bias(q, v)", states, a.bias, b.bias),
    )


def _term(
    one: EngineContract,
    two: EngineContract,
    quantity: str,
    states: Sequence[tuple[Array, ...]],
    of_one: Callable[..., Array],
    of_two: Callable[..., Array],
) -> ContractLine:
    worst, entry, precision = 0.0, "", _coarser(one, two)
    for state in states:
        try:
            x, y = of_one(*state), of_two(*state)
        except NotOfferedError as error:
            return ContractLine(quantity, "different", f"not comparable: {error}", str(error))
        gap = np.abs(x - y) / max(float(np.abs(x).max()), NOTHING[precision] / SAME_NUMBER[precision])
        where = np.unravel_index(int(np.argmax(gap)), gap.shape)
        if not gap[where] <= worst:
            entry = f"entry {[int(i) for i in where]}, {one.engine}: {x[where]:.10g}; {two.engine}: {y[where]:.10g}"
            worst = float(gap[where])
    within = f"to {worst:.1e} of its largest entry at {RANDOM_STATES} random states"
    if worst <= SAME_NUMBER[precision]:
        return ContractLine(quantity, "equal", within)
    return ContractLine(quantity, "different", f"{within}, {entry}")


def random_state(kinds: list[str], random: np.random.Generator) -> tuple[Array, Array]:
    """q and v of joints of these kinds, in Drake's coordinates, quaternions of norm 1."""
    q: list[float] = []
    nv = 0
    for kind in kinds:
        if kind == "quaternion_floating":
            quaternion = random.standard_normal(4)
            q += [*(quaternion / np.linalg.norm(quaternion)), *random.standard_normal(3)]
            nv += 6
        else:
            q.append(float(random.standard_normal()))
            nv += 1
    return np.array(q), random.standard_normal(nv)


def _state(one: EngineContract, two: EngineContract) -> ContractLine:
    quantity = "state of a free body"
    if not any(j.kind == "quaternion_floating" for c in (one, two) for j in c.joints):
        return ContractLine(quantity, "equal", "no free body")
    if one.state == two.state:
        return ContractLine(quantity, "equal", one.state)
    return ContractLine(quantity, "mapped", f"{one.engine}: {one.state}; {two.engine}: {two.state}")


def _has_limits(contract: EngineContract) -> bool:
    return any(math.isfinite(side) for j in contract.joints for side in (j.lower, j.upper))


def _limit_law(one: EngineContract, two: EngineContract) -> ContractLine:
    if not (_has_limits(one) or _has_limits(two)):
        return ContractLine("limit law", "equal", "no joint is limited")
    return _text(one, two, "limit law", one.limit_law, two.limit_law)


def _contact_law(one: EngineContract, two: EngineContract) -> ContractLine:
    return _text(one, two, "contact law", one.contact_law, two.contact_law)


def _contact_pairs(one: EngineContract, two: EngineContract) -> ContractLine:
    quantity = "contact pairs"
    a, b = ({pair.names: pair for pair in c.contacts} for c in (one, two))
    if a.keys() != b.keys():
        only = sorted(str(names) for names in a.keys() ^ b.keys())
        return _difference(one, two, quantity, f"{one.engine}: {len(a)}; {two.engine}: {len(b)}; only in one: {only}")
    law = one.contact_law == two.contact_law  # then a value that neither gives is the same default
    precision = _coarser(one, two)
    wrong = [
        f"{names}: friction {x.friction} and {y.friction} [1], stiffness {x.stiffness} and {y.stiffness} [N/m]"
        for names, x, y in ((names, a[names], b[names]) for names in a)
        if not all(_same_value(m, n, law, precision) for m, n in ((x.friction, y.friction), (x.stiffness, y.stiffness)))
    ]
    if wrong:
        return _difference(one, two, quantity, "; ".join(wrong))
    return ContractLine(quantity, "equal", f"{len(a)} pairs, friction and stiffness at rest" if a else "none")


def _same_value(a: float | None, b: float | None, same_default: bool, precision: Precision) -> bool:
    return a is b and same_default if a is None or b is None else _same(a, b, precision)


def _solver_tolerance(one: EngineContract, two: EngineContract) -> ContractLine:
    quantity = "solver tolerance"
    if not any(_has_limits(c) or c.contacts for c in (one, two)):
        return ContractLine(quantity, "equal", "nothing to solve: neither contact nor limits")
    a, b = ("none" if c.solver_tolerance is None else f"{c.solver_tolerance:g}" for c in (one, two))
    return _text(one, two, quantity, a, b)


def _scalar_type(one: EngineContract, two: EngineContract) -> ContractLine:
    if one.precision == two.precision:
        return ContractLine("scalar type", "equal", one.precision)
    what = f"{one.engine}: {one.precision}; {two.engine}: {two.precision}"
    return ContractLine("scalar type", "different", what, f"its arithmetic is {_coarser(one, two)}")


def _derivatives(one: EngineContract, two: EngineContract) -> ContractLine:
    quantity = "derivative convention"
    if one.derivatives == two.derivatives:
        return ContractLine(quantity, "equal", one.derivatives)
    what = f"{one.engine}: {one.derivatives}; {two.engine}: {two.derivatives}"
    if "none" in (one.derivatives, two.derivatives):
        return ContractLine(quantity, "different", what, "it offers no derivatives")
    return ContractLine(quantity, "mapped", what)
