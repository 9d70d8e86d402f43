"""Compare the models of two engines line by line, before any simulation: bodies, forces, contact."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.engines.interface import Engine, EngineContract, Precision
from drake_diff.exceptions import NotOfferedError
from drake_diff.mechanics.description import GeometryContract, JointContract, PairContract

Verdict = Literal["equal", "mapped", "different"]
# Sums over a tree by two libraries differ by rounding, magnified by cancellation. A wrong number differs by far more.
SAME_NUMBER: dict[Precision, float] = {"float64": 1e-9, "float32": 1e-5}
# Below any significant inertia, above MuJoCo's inertia of a point mass (2e-15 kg m^2) and the rounding of zeros.
NOTHING: dict[Precision, float] = {"float64": 1e-12, "float32": 1e-6}

# Quantities without which an engine simulates another model if contact acts.
MUST_HAVE = ("shapes", "poses", "contact pairs")
# Quantities that depend on the engine and not on the model.
LAWS = (
    "integrator", "scalar type", "derivative convention", "limit law", "contact law", "solver tolerance", "reset",
)  # fmt: skip


# Reasons for "different" if a value is unknown. Such a line neither shows another model nor explains a difference.
NOT_TOLD, FUNCTION_DOES_NOT_SAY = "the recording does not say", "a user's function does not say"
UNKNOWN = (NOT_TOLD, FUNCTION_DOES_NOT_SAY)


@dataclass(frozen=True, repr=False)
class ContractLine:
    """The comparison of one quantity of two engines.

    Attributes:
        quantity: The compared quantity, such as "mass" or "contact law".
        verdict: "equal", "mapped" (equal in other coordinates, see `detail`) or "different".
        detail: The common value, or both values with their place and the reason, if there is one.
        reason: Why an engine does not support the other's value, empty if the models differ.

    Example:
        >>> print(dd.engines.ContractLine("time step", "equal", "0.01 [s]"))
        equal     time step: 0.01 [s]
    """

    quantity: str
    verdict: Verdict
    detail: str
    reason: str = ""

    def __repr__(self) -> str:
        return f"{self.verdict:9} {self.quantity}: {self.detail}"


def is_another_model(line: ContractLine, touched: bool) -> bool:
    """Return whether a "different" line means another model, depending on whether contact acts (`touched`)."""
    must_have = touched and line.quantity in MUST_HAVE and line.reason not in UNKNOWN
    return must_have or (not line.reason and line.quantity not in LAWS)


class Match:
    """The comparison of two engines' contracts, `one` and `two`, with the lower of their two precisions."""

    def __init__(self, a: Engine, b: Engine):
        self.engines = a, b
        self.one, self.two = self.contracts = a.contract, b.contract
        self.precision: Precision = "float32" if "float32" in [c.precision for c in self.contracts] else "float64"
        sides = [side for c in self.contracts for j in c.joints for side in (j.lower, j.upper)]
        self.limited = any(math.isfinite(side) for side in sides)
        self.touches = any(c.contacts for c in self.contracts)

    def same(self, a: Any, b: Any) -> bool:
        if not all(isinstance(x, (int, float)) and math.isfinite(x) for x in (a, b)):
            return bool(a == b)
        return bool(abs(a - b) <= max(NOTHING[self.precision], SAME_NUMBER[self.precision] * max(abs(a), abs(b))))

    def all_same(self, a: Sequence[Any], b: Sequence[Any]) -> bool:
        return len(a) == len(b) and all(map(self.same, a, b))

    def both(self, a: object, b: object) -> str:
        return f"{self.one.engine}: {a}; {self.two.engine}: {b}"

    def reason(self, quantity: str) -> str:
        """Return why one of the engines does not support the other's value, or ""."""
        return self.one.reasons.get(quantity) or self.two.reasons.get(quantity) or ""

    def different(self, quantity: str, what: str) -> ContractLine:
        """Return a "different" line, with the reason of the engine that has one."""
        reason = self.reason(quantity)
        detail = reason if reason in UNKNOWN else "; ".join(text for text in (what, reason) if text)
        return ContractLine(quantity, "different", detail, reason)

    def numbers(self, quantity: str, a: tuple[Any, ...], b: tuple[Any, ...], unit: str = "") -> ContractLine:
        if self.all_same(a, b):
            return ContractLine(quantity, "equal", f"{values_told(a)} {unit}".strip())
        return self.different(quantity, f"{self.both(values_told(a), values_told(b))} {unit}".strip())

    def text(self, quantity: str, read: Callable[[EngineContract], str]) -> ContractLine:
        return self.numbers(quantity, (read(self.one),), (read(self.two),))

    def mapped(self, quantity: str, read: Callable[[EngineContract], str]) -> ContractLine:
        """Compare a quantity for which each engine may use its own convention."""
        a, b = map(read, self.contracts)
        return ContractLine(quantity, "equal", a) if a == b else ContractLine(quantity, "mapped", self.both(a, b))

    def order(self) -> ContractLine:
        quantity = "joint order and names"
        a, b = (tuple(j.name for j in contract.joints) for contract in self.contracts)
        line = self.numbers(quantity, a, b)
        if line.verdict == "different" or self.one.native_order == self.two.native_order:
            return line
        inside = (values_told(contract.native_order) for contract in self.contracts)
        return ContractLine(quantity, "mapped", f"by name, from {self.both(*inside)}")

    def joints(self, quantity: str, read: Callable[[JointContract], tuple[Any, ...]]) -> ContractLine:
        """Compare joints by name, so that a different order is reported once and not in every line."""
        others = {j.name: j for j in self.two.joints}
        both = [(j, others[j.name]) for j in self.one.joints if j.name in others]
        lines = {a.name: self.numbers(quantity, read(a), read(b)) for a, b in both}
        if not lines:
            return ContractLine(quantity, "different", "no joint has the same name in both")
        wrong = {name: line for name, line in lines.items() if line.verdict == "different"}
        if not wrong:
            return ContractLine(quantity, "equal", "of " + ", ".join(lines))
        first = next(iter(wrong.values()))
        if first.reason in UNKNOWN:
            return first
        detail = "; ".join(f"{name}: {line.detail}" for name, line in wrong.items())
        return ContractLine(quantity, "different", detail, first.reason)

    def actuation(self) -> ContractLine:
        quantity, inputs = "actuator mapping", self.one.inputs
        if inputs != self.two.inputs or not inputs:
            return self.numbers(quantity, inputs, self.two.inputs)
        a, b = _forces_by_joint(self.one), _forces_by_joint(self.two)
        same = {
            n: a[n].keys() == b[n].keys() and self.all_same([*a[n].values()], [b[n][j] for j in a[n]]) for n in inputs
        }
        wrong = [self.both(f"{name} drives {a[name]}", b[name]) for name in inputs if not same[name]]
        if wrong:
            return self.different(quantity, "; ".join(wrong))
        return ContractLine(quantity, "equal", "; ".join(f"{name} drives {a[name]}" for name in inputs))

    def dynamics(self) -> tuple[ContractLine, ...]:
        """Compare M and bias at random states in Drake's coordinates, or the force parts of a user's closed form."""
        kinds = [j.kind for j in self.one.joints]
        if kinds != [j.kind for j in self.two.joints]:
            why = "not comparable: the joint types differ"
            return ContractLine("M(q)", "different", why), ContractLine("bias(q, v)", "different", why)
        random, (a, b) = np.random.default_rng(0), self.engines
        states = [_random_state(kinds, random) for _ in range(RANDOM_STATES)]
        if of_parts := getattr(a, "part_lines", None) or getattr(b, "part_lines", None):  # a user's accelerations
            lines: tuple[ContractLine, ...] = of_parts(self, states)
            return lines
        return (
            self.term("M(q)", [(q,) for q, _ in states], a.mass_matrix, b.mass_matrix),
            self.term("bias(q, v)", states, a.bias, b.bias),
        )

    def term(
        self, quantity: str, states: Sequence[tuple[Array, ...]], a: Callable[..., Array], b: Callable[..., Array]
    ) -> ContractLine:
        worst, entry, same = 0.0, "", SAME_NUMBER[self.precision]
        for state in states:
            try:
                x, y = a(*state), b(*state)
            except NotOfferedError as error:
                return ContractLine(quantity, "different", f"not comparable: {error}", str(error))
            gap = np.abs(x - y) / max(float(np.abs(x).max()), NOTHING[self.precision] / same)
            where = np.unravel_index(int(np.argmax(gap)), gap.shape)
            if not gap[where] <= worst:
                values = self.both(f"{x[where]:.10g}", f"{y[where]:.10g}")
                worst, entry = float(gap[where]), f", entry {[int(i) for i in where]}, {values}"
        within = f"to {worst:.1e} of its largest entry at {RANDOM_STATES} random states"
        if worst <= same:
            return ContractLine(quantity, "equal", within)
        return ContractLine(quantity, "different", within + entry)

    def state(self) -> ContractLine:
        if not any(j.kind == "quaternion_floating" for c in self.contracts for j in c.joints):
            return ContractLine("state of a free body", "equal", "no free body")
        return self.mapped("state of a free body", lambda contract: contract.state)

    def limit_law(self) -> ContractLine:
        if not self.limited:
            return ContractLine("limit law", "equal", "no joint is limited")
        return self.text("limit law", lambda contract: contract.limit_law)

    def solver_tolerance(self) -> ContractLine:
        if not self.limited and not self.touches:
            return ContractLine("solver tolerance", "equal", "nothing to solve: neither contact nor limits")
        return self.text(
            "solver tolerance", lambda c: "none" if c.solver_tolerance is None else f"{c.solver_tolerance:g}"
        )

    def scalar_type(self) -> ContractLine:
        line = self.text("scalar type", lambda contract: contract.precision)
        return line if line.verdict == "equal" else replace(line, reason=f"its arithmetic is {self.precision}")

    def derivatives(self) -> ContractLine:
        line = self.mapped("derivative convention", lambda contract: contract.derivatives)
        if line.verdict == "mapped" and any(contract.derivatives == "none" for contract in self.contracts):
            return replace(line, verdict="different", reason="it offers no derivatives")
        return line


def values_told(values: tuple[Any, ...]) -> str:
    if not values:
        return "none"
    shown = [value if isinstance(value, str) else f"{value:.10g}" for value in values]
    return shown[0] if len(shown) == 1 else "(" + ", ".join(shown) + ")"


RANDOM_STATES = 5
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


def match_contracts(a: Engine, b: Engine) -> tuple[ContractLine, ...]:
    """Compare the models of two engines, quantity by quantity, before any simulation.

    M(q) and the bias forces are compared at random states, all other quantities as the engines report them.

    Args:
        a: One engine, from `load_engine`. Its values come first in the details.
        b: Another engine on the same model.

    Returns:
        A line per quantity. A "different" line has no reason if the models differ (for example in a mass). It has a
        reason if an engine does not support the other's value (for example its contact law).

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> drake, hand = (dd.engines.load_engine(name, model) for name in ("drake", "numpy"))
        >>> lines = dd.engines.match_contracts(drake, hand)
        >>> print([line.quantity for line in lines if line.verdict == "different"])
        []
    """
    match = Match(a, b)
    first, two = match.one, match.two
    return (
        match.order(),
        *(match.joints(quantity, read) for quantity, read in JOINT_NUMBERS.items()),
        match.numbers("gravity", first.gravity, two.gravity, "[m/s^2]"),
        match.actuation(),
        match.numbers("effort limits", first.effort_limits, two.effort_limits),
        *match.dynamics(),
        match.numbers("time step", (first.time_step,), (two.time_step,), "[s]"),
        match.text("integrator", lambda contract: contract.integrator),
        match.state(),
        match.limit_law(),
        match.text("contact law", lambda contract: contract.contact_law),
        *contact_lines(match),
        match.solver_tolerance(),
        match.text("reset", lambda contract: contract.reset),
        match.scalar_type(),
        match.derivatives(),
    )


def _forces_by_joint(contract: EngineContract) -> dict[str, dict[str, float]]:
    """Return the generalized force per unit of each input, by joint."""
    rows = list(zip(contract.by_velocity, contract.actuation, strict=True))
    return {name: {joint.name: row[i] for joint, row in rows if row[i]} for i, name in enumerate(contract.inputs)}


def _random_state(kinds: list[str], random: np.random.Generator) -> tuple[Array, Array]:
    """Return random q and v for joints of these kinds, in Drake's coordinates, with quaternions of norm 1."""
    positions = [random.standard_normal(7 if kind == "quaternion_floating" else 1) for kind in kinds]
    free = [q for q in positions if len(q) == 7]
    for q in free:
        q[:4] /= np.linalg.norm(q[:4])
    return np.concatenate(positions), random.standard_normal(len(kinds) + 5 * len(free))


NAMED = 4  # maximum number of pairs or geometries that a line names
Shared = Sequence[tuple[PairContract, PairContract]]


def contact_lines(match: Match) -> tuple[ContractLine, ...]:
    """Compare shapes, poses, pairs, friction, stiffness, dissipation, margin, and terms that Drake does not have.

    A different number has no reason, as the models differ. A number that an engine lacks has the engine's reason.
    """
    same = same_geometries(match)
    a = {frozenset(same.get(name, name) for name in pair.names): pair for pair in match.one.contacts}
    b = {frozenset(pair.names): pair for pair in match.two.contacts}
    shared = [(a[names], b[names]) for names in a if names in b]
    return (
        *_geometries(match, same),
        _pairs(match, a, b),
        _numbers(match, "friction", shared, lambda pair: pair.friction, "[1]"),
        _numbers(match, "stiffness", shared, lambda pair: pair.stiffness, "[N/m]"),
        _dissipation(match, shared),
        _numbers(match, "contact margin", shared, lambda pair: pair.margin, "[m]"),
        _more(match, shared),
    )


def same_geometries(match: Match) -> dict[str, str]:
    """Map the geometries of the first engine to those of the second: by name, else by pose, else the nearest.

    Drake's additions to a name (model::name#number) are ignored if the full names differ.
    """
    a, b = (list(c.geometries) for c in match.contracts)
    same: dict[str, str] = {}

    def take(rule: Callable[[GeometryContract, GeometryContract], bool]) -> None:
        for x in [x for x in a if x.name not in same]:
            free = [y for y in b if y.name not in same.values() and rule(x, y)]
            if free:
                same[x.name] = min(free, key=lambda y: float(np.linalg.norm(np.subtract(x.position, y.position)))).name

    take(lambda x, y: x.name == y.name)
    take(lambda x, y: _plain(x.name) == _plain(y.name) and x.carrier == y.carrier)
    touching = {name for c in match.contracts for pair in c.contacts for name in pair.names}
    a, b = ([g for g in side if g.name in touching] for side in (a, b))
    take(lambda x, y: _same_shape(match, x, y) and _same_pose(match, x, y))
    take(lambda x, y: x.kind == y.kind and x.carrier == y.carrier)
    return same


def _plain(name: str) -> str:
    return name.split("#")[0].split("::")[-1]


def _same_shape(match: Match, x: GeometryContract, y: GeometryContract) -> bool:
    return x.kind == y.kind and match.all_same(x.sizes, y.sizes)


def _same_pose(match: Match, x: GeometryContract, y: GeometryContract) -> bool:
    return x.carrier == y.carrier and match.all_same(x.position + x.directions, y.position + y.directions)


def _geometries(match: Match, same: Mapping[str, str]) -> tuple[ContractLine, ContractLine]:
    """Compare shapes and poses of the geometries that are in both engines and may collide in at least one."""
    a, b = ({g.name: g for g in c.geometries} for c in match.contracts)
    touching = [{name for pair in c.contacts for name in pair.names} for c in match.contracts]
    both = [(a[x], b[y]) for x, y in same.items() if x in touching[0] or y in touching[1]]
    shapes = [
        f"{x.name}: {match.both(*(f'{g.kind} {values_told(g.sizes)}' for g in (x, y)))} [m]"
        for x, y in both
        if not _same_shape(match, x, y)
    ]
    poses = [f"{x.name}: {match.both(*map(_pose, (x, y)))}" for x, y in both if not _same_pose(match, x, y)]
    detail = f"of {len(both)} geometries" if both else "nothing can touch"
    return _line(match, "shapes", shapes, detail), _line(match, "poses", poses, detail)


def _pose(g: GeometryContract) -> str:
    along = f", directions {values_told(g.directions)}" if g.directions else ""
    return f"on {g.carrier} at {values_told(g.position)} [m]{along}"


def _line(match: Match, quantity: str, wrong: list[str], detail: str) -> ContractLine:
    """Return a line without `reason` for different values. The engine's remark is included in the detail."""
    if not wrong:
        return ContractLine(quantity, "equal", detail)
    remark = match.reason(quantity)
    return ContractLine(quantity, "different", "; ".join([_some(wrong), *([remark] if remark else [])]))


def _some(details: list[str]) -> str:
    return "; ".join(details[:NAMED]) + (f"; and {len(details) - NAMED} more" if len(details) > NAMED else "")


def _pairs(
    match: Match, a: Mapping[frozenset[str], PairContract], b: Mapping[frozenset[str], PairContract]
) -> ContractLine:
    if a.keys() == b.keys():
        return ContractLine("contact pairs", "equal", f"{len(a)} pairs" if a else "none")
    only = []
    for contract, pairs, others in ((match.one, a, b), (match.two, b, a)):
        missing = sorted(" with ".join(pairs[names].names) for names in pairs.keys() - others.keys())
        only += [f"only in {contract.engine}: {_some(missing)}"] if missing else []
    return match.different("contact pairs", "; ".join([match.both(len(a), len(b)), *only]))


def _numbers(
    match: Match, quantity: str, shared: Shared, read: Callable[[PairContract], float | None], unit: str
) -> ContractLine:
    """Compare a value of the pairs. A value missing in both engines is equal only if the contact laws are equal."""
    wrong, absent = [], []
    for x, y in shared:
        p, q = read(x), read(y)
        detail = f"{' with '.join(x.names)}: {match.both(p, q)} {unit}"
        if p is None or q is None:
            absent += [detail] if p is not q or match.one.contact_law != match.two.contact_law else []
        elif not match.same(p, q):
            wrong.append(detail)
    if absent and not wrong:
        return match.different(quantity, _some(absent))
    values = sorted({value for x, _ in shared if (value := read(x)) is not None})[:NAMED]
    return _line(match, quantity, wrong + absent, f"{values_told(tuple(values))} {unit}" if values else "of no pair")


def _dissipation(match: Match, shared: Shared) -> ContractLine:
    """Compare Hunt-Crossley dissipation if both have it, and relaxation times, or an engine's critical one."""
    quantity = "dissipation"
    details: dict[str, list[str]] = {"wrong": [], "absent": [], "mapped": []}
    for x, y in shared:
        (d_x, d_y), (p, q) = (x.dissipation, y.dissipation), (x.relaxation_time, y.relaxation_time)
        name = " with ".join(x.names)
        if d_x is not None and d_y is not None and not match.same(d_x, d_y):
            details["wrong"].append(f"{name}: {match.both(d_x, d_y)} [s/m]")
        if p is not q and not match.same(p, q):
            times = [(pair.relaxation_time, pair.critical_time) for pair in (x, y) if pair.critical_time is not None]
            critical = any(match.same(*both) for both in times)
            kind = "absent" if p is None or q is None else "mapped" if critical else "wrong"
            details[kind].append(f"{name}: {match.both(p, q)} [s]")
    if details["wrong"]:
        return _line(match, quantity, details["wrong"], "")
    if details["absent"]:
        return match.different(quantity, _some(details["absent"]))
    if details["mapped"]:
        detail = f"relaxation times {_some(details['mapped'])}: the damping is critical, which is the engine's own"
        return ContractLine(quantity, "mapped", detail)
    return ContractLine(quantity, "equal", f"of {len(shared)} pairs" if shared else "of no pair")


def _more(match: Match, shared: Shared) -> ContractLine:
    wrong = []
    for x, y in shared:
        p, q = dict(x.more), dict(y.more)
        for name in {**p, **q}:
            both = p.get(name, 0.0), q.get(name, 0.0)
            wrong += [] if match.same(*both) else [f"{' with '.join(x.names)}: {name}, {match.both(*both)}"]
    return _line(match, "other contact terms", wrong, "none")
