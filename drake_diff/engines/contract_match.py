"""Whether two engines simulate the same model, line by line, before either takes a step."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.engines.contact_match import contact_lines
from drake_diff.engines.contract_line import NOTHING, SAME_NUMBER, UNKNOWN, ContractLine, Match, values_told
from drake_diff.engines.equations import ClosedForm, part_lines
from drake_diff.engines.interface import Engine, EngineContract
from drake_diff.exceptions import NotOfferedError
from drake_diff.mechanics.description import JointContract

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
    """Compare what two engines simulate, quantity by quantity, before either takes a step.

    M(q) and the bias forces are compared at random states, everything else as the engines report it.

    Args:
        a: one engine, from `load_engine`; its values come first in the details.
        b: another engine on the same model.

    Returns:
        A line per quantity. A line that is "different" has no reason where the model differs (another mass), and the
        reason where the engine cannot have what the other has (another contact law).

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> drake, hand = (dd.engines.load_engine(name, model) for name in ("drake", "numpy"))
        >>> lines = dd.engines.match_contracts(drake, hand)
        >>> print([line.quantity for line in lines if line.verdict == "different"])
        []
    """
    match = _Match(a, b)
    one, two = match.one, match.two
    return (
        match.order(),
        *(match.joints(quantity, read) for quantity, read in JOINT_NUMBERS.items()),
        match.numbers("gravity", one.gravity, two.gravity, "[m/s^2]"),
        match.actuation(),
        match.effort_limits(),
        *match.dynamics(),
        match.numbers("time step", (one.time_step,), (two.time_step,), "[s]"),
        match.text("integrator", one.integrator, two.integrator),
        match.state(),
        match.limit_law(),
        match.text("contact law", one.contact_law, two.contact_law),
        *contact_lines(match),
        match.solver_tolerance(),
        match.text("reset", one.reset, two.reset),
        match.scalar_type(),
        match.derivatives(),
    )


class _Match(Match):
    def __init__(self, a: Engine, b: Engine):
        super().__init__(a, b)
        sides = [side for c in self.contracts for j in c.joints for side in (j.lower, j.upper)]
        self.limited = any(math.isfinite(side) for side in sides)

    def order(self) -> ContractLine:
        quantity = "joint order and names"
        a, b = (tuple(j.name for j in contract.joints) for contract in self.contracts)
        if a != b:
            return self.numbers(quantity, a, b)
        inside = [values_told(contract.native_order) for contract in self.contracts]
        if inside[0] != inside[1]:
            return ContractLine(quantity, "mapped", f"by name, from {self.both(*inside)}")
        return ContractLine(quantity, "equal", values_told(a))

    def joints(self, quantity: str, read: Callable[[JointContract], tuple[Any, ...]]) -> ContractLine:
        """By name, so that another order is reported once and not in every line."""
        others = {j.name: j for j in self.two.joints}
        common = [j for j in self.one.joints if j.name in others]
        if not common:
            return ContractLine(quantity, "different", "no joint has the same name in both")
        lines = {j.name: self.numbers(quantity, read(j), read(others[j.name])) for j in common}
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
        if inputs != self.two.inputs:
            return self.numbers(quantity, inputs, self.two.inputs)
        if not inputs:
            return ContractLine(quantity, "equal", "no inputs")
        a, b = _forces_by_joint(self.one), _forces_by_joint(self.two)
        wrong = [
            f"{self.one.engine}: {name} drives {a[name]}; {self.two.engine}: {b[name]}"
            for name in inputs
            if a[name].keys() != b[name].keys() or not all(self.same(gain, b[name][j]) for j, gain in a[name].items())
        ]
        if wrong:
            return self.different(quantity, "; ".join(wrong))
        return ContractLine(quantity, "equal", "; ".join(f"{name} drives {a[name]}" for name in inputs))

    def effort_limits(self) -> ContractLine:
        if not self.one.inputs and not self.two.inputs:
            return ContractLine("effort limits", "equal", "no inputs")
        return self.numbers("effort limits", self.one.effort_limits, self.two.effort_limits)

    def dynamics(self) -> tuple[ContractLine, ...]:
        """M and bias at random states in Drake's coordinates; of a closed form the parts of its forces."""
        kinds = [j.kind for j in self.one.joints]
        if kinds != [j.kind for j in self.two.joints]:
            why = "not comparable: the joints are of other types"
            return ContractLine("M(q)", "different", why), ContractLine("bias(q, v)", "different", why)
        random, (a, b) = np.random.default_rng(0), self.engines
        states = [_random_state(kinds, random) for _ in range(RANDOM_STATES)]
        if isinstance(a, ClosedForm) or isinstance(b, ClosedForm):
            return part_lines(self, states)
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
                worst, entry = float(gap[where]), f"entry {[int(i) for i in where]}, {values}"
        within = f"to {worst:.1e} of its largest entry at {RANDOM_STATES} random states"
        if worst <= same:
            return ContractLine(quantity, "equal", within)
        return ContractLine(quantity, "different", f"{within}, {entry}")

    def state(self) -> ContractLine:
        quantity, (a, b) = "state of a free body", (contract.state for contract in self.contracts)
        if not any(j.kind == "quaternion_floating" for c in self.contracts for j in c.joints):
            return ContractLine(quantity, "equal", "no free body")
        return ContractLine(quantity, "equal", a) if a == b else ContractLine(quantity, "mapped", self.both(a, b))

    def limit_law(self) -> ContractLine:
        if not self.limited:
            return ContractLine("limit law", "equal", "no joint is limited")
        return self.text("limit law", self.one.limit_law, self.two.limit_law)

    def solver_tolerance(self) -> ContractLine:
        if not self.limited and not any(c.contacts for c in self.contracts):
            return ContractLine("solver tolerance", "equal", "nothing to solve: neither contact nor limits")
        told = ("none" if c.solver_tolerance is None else f"{c.solver_tolerance:g}" for c in self.contracts)
        return self.text("solver tolerance", *told)

    def scalar_type(self) -> ContractLine:
        a, b = (contract.precision for contract in self.contracts)
        if a == b:
            return ContractLine("scalar type", "equal", a)
        return ContractLine("scalar type", "different", self.both(a, b), f"its arithmetic is {self.precision}")

    def derivatives(self) -> ContractLine:
        quantity, told = "derivative convention", [contract.derivatives for contract in self.contracts]
        if told[0] == told[1]:
            return ContractLine(quantity, "equal", told[0])
        if "none" in told:
            return ContractLine(quantity, "different", self.both(*told), "it offers no derivatives")
        return ContractLine(quantity, "mapped", self.both(*told))


def _forces_by_joint(contract: EngineContract) -> dict[str, dict[str, float]]:
    """Of each input, the generalized force per unit by joint."""
    owners = [name for j in contract.joints for name in [j.name] * (6 if j.kind == "quaternion_floating" else 1)]
    rows = list(zip(owners, contract.actuation, strict=True))
    return {name: {joint: row[i] for joint, row in rows if row[i]} for i, name in enumerate(contract.inputs)}


def _random_state(kinds: list[str], random: np.random.Generator) -> tuple[Array, Array]:
    """q and v of joints of these kinds, in Drake's coordinates, quaternions of norm 1."""
    free = [kind == "quaternion_floating" for kind in kinds]
    parts = [random.standard_normal(7 if floats else 1) for floats in free]
    for part in (part for part, floats in zip(parts, free, strict=True) if floats):
        part[:4] /= np.linalg.norm(part[:4])
    return np.concatenate(parts), random.standard_normal(len(kinds) + 5 * sum(free))
