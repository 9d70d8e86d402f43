"""What a comparison is of: a motion's start and inputs, and the states at which Jacobians are compared.

What is found of each engine beside the reference, and what that amounts to.

What a comparison found, in sentences: per engine what it is and why, and which output to trust for what.
"""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array
from drake_diff.comparison.attribution import Attribution
from drake_diff.comparison.recorded import NOT_TOLD
from drake_diff.comparison.recordings import Recording, inputs_of
from drake_diff.engines.contract_match import ContractLine
from drake_diff.engines.interface import Precision
from drake_diff.engines.jacobians import AGREES, JacobianAt
from drake_diff.engines.motion import BROKE_OFF, EngineMotion
from drake_diff.model.model import Model
from drake_diff.model.sampling import sample_states
from drake_diff.motion.rollout import check_inputs

DURATION, MOST_STEPS = 1.0, 500  # [s]; of a motion that is not given


class Probe(NamedTuple):
    """A state at which Jacobians are compared: "start", "free", "contact" or "deepest"."""

    name: str
    x: Array
    u: Array


def task_of(
    model: Model,
    recordings: Sequence[Recording],
    x0: ArrayLike | None,
    us: ArrayLike | None,
    num_steps: int | None,
    seed: int,
) -> tuple[Array, Array]:
    """x0 (nx,) and us (N, nu), checked; without x0 those of the first recording, without any sampled ones."""
    if recordings and x0 is None:
        x0, us = recordings[0].xs[0], inputs_of(recordings[0], model.time_step) if us is None else us
    sample = sample_states(model, 1, seed)[0]
    if us is None:
        count = num_steps or min(MOST_STEPS, max(1, round(DURATION / model.time_step)))
        us = np.tile(sample.u, (count, 1))
    return (sample.x if x0 is None else finite_array("x0", x0, (model.nx,))), check_inputs(model, us, num_steps)


def probes_of(model: Model, motion: EngineMotion, seed: int) -> tuple[Probe, ...]:
    """The motion's start, a state sampled free and one touching, and the motion's deepest overlap."""
    probes = [Probe("start", motion.xs[0], motion.us[0])]
    probes += [Probe(sample.kind, sample.x, sample.u) for sample in sample_states(model, 2, seed + 1)]
    if motion.depth is not None and np.max(motion.depth[:-1], initial=0.0) > 0:
        k = int(np.argmax(motion.depth[:-1]))
        probes.append(Probe("deepest", motion.xs[k], motion.us[k]))
    return tuple(probes)


Verdict = Literal["same", "other law", "other model", "unexplained"]
Gradient = Literal["its own step's", "not its own step's", "undecided", "none"]
# One step against the reference's, relative to the state where that is above 1: rounding in solves with M.
STEP_TOLERANCE: dict[Precision, float] = {"float64": 1e-10, "float32": 1e-4}
# Relative to the largest entry: what differences of a step, which some engines offer as its derivative, leave.
JACOBIAN_TOLERANCE: dict[Precision, float] = {"float64": 1e-8, "float32": 1e-2}
# The lines of a contract that tell of a term.
TELLS: Mapping[str, tuple[str, ...]] = {
    "inertia": ("mass", "center of mass", "inertia", "frames", "armature", "joint types", "joint order and names"),
    "bias": ("gravity", "springs", "mass", "center of mass", "inertia", "frames", "joint order and names"),
    "actuation": ("actuator mapping", "effort limits"),
    "damping": ("damping", "integrator"),
    "time step": ("time step",),
    "integrator": ("integrator",),
    "contact law": ("contact law", "contact pairs", "solver tolerance"),
    "limit law": ("limit law", "position limits"),
}
# What is the engine's own whatever the model.
LAWS = (
    "integrator",
    "scalar type",
    "derivative convention",
    "limit law",
    "contact law",
    "contact pairs",
    "solver tolerance",
    "reset",
)


@dataclass(frozen=True)
class Refused:
    """An engine that is not compared: not installed, or without something that the model has."""

    engine: str
    reason: str
    installed: bool


@dataclass(frozen=True, eq=False)
class Compared:
    """One engine, or a recording, beside the reference."""

    engine: str
    version: str
    precision: Precision
    lines: tuple[ContractLine, ...]  # of its contract against the reference's
    motion: EngineMotion
    step_gaps: Array  # (n - 1,) of each of its steps to the reference's from the same state
    first: Attribution  # of the first step that is apart, or of the first of all
    largest: Attribution  # of the largest gap
    final_gap: float  # of the last state that both have, on the tangent space
    jacobians: tuple[JacobianAt, ...]
    jacobian_gaps: Array  # one per state, relative to the reference's largest entry
    laws: tuple[str, ...]  # per state, of contact or limits where one is at work there, else ""
    rollout_jacobian: Array | None
    rollout_gap: float | None  # relative to the reference's largest entry; None where one of the two broke off
    seconds_per_step: float | None
    seconds_per_jacobian: float | None

    @property
    def different(self) -> tuple[ContractLine, ...]:
        """The lines of the contract that are different."""
        return tuple(line for line in self.lines if line.verdict == "different")

    @cached_property
    def first_apart(self) -> int | None:
        """The first step whose gap is above the tolerance."""
        return first_above(self.step_gaps, self.precision)

    @property
    def broken(self) -> tuple[ContractLine, ...]:
        """The lines that are different without being the engine's doing: it simulates another model."""
        return tuple(line for line in self.different if not line.reason and line.quantity not in LAWS)

    @property
    def told(self) -> tuple[ContractLine, ...]:
        """The lines that tell of the terms responsible; none where one of the terms is told of by no line."""
        lines = [self.tells(term) for term in sorted({self.first.responsible, self.largest.responsible})]
        return tuple(dict.fromkeys(x for found in lines for x in found)) if all(lines) else ()

    def tells(self, term: str) -> tuple[ContractLine, ...]:
        """The lines that are different, and tell of a term."""
        known = [line for line in self.different if line.reason != NOT_TOLD]
        return tuple(line for line in known if line.quantity in TELLS.get(term, ()))

    @property
    def other_states(self) -> tuple[int, ...]:
        """The states whose Jacobian is another one than the reference's."""
        return tuple(int(i) for i in np.flatnonzero(~(self.jacobian_gaps <= JACOBIAN_TOLERANCE[self.precision])))

    @property
    def verdict(self) -> Verdict:
        """Same: every step and Jacobian is the reference's. Other law: not, and the contract tells of what is at work.

        Other model: the contract is broken. Unexplained: nothing tells why. Of a recording also the one change that
        takes its steps tells, of a law or of the model.
        """
        if self.broken:
            return "other model"
        if self.first_apart is not None and self.first.as_if and self.first.as_if == self.largest.as_if:
            return "other law" if self.first.responsible in LAWS else "other model"
        if self.first_apart is not None:
            return "other law" if self.told else "unexplained"
        if self.motion.status.startswith(BROKE_OFF) or not all(self.tells(self.laws[i]) for i in self.other_states):
            return "unexplained"
        return "other law" if self.other_states else "same"

    @property
    def gradient(self) -> Gradient:
        """Whether its Jacobians are the derivatives of its own steps, at all states that were looked at."""
        verdicts = {j.own for j in self.jacobians if j.own is not None}
        if not verdicts:
            return "none"
        if verdicts == {AGREES}:
            return "its own step's"
        return "not its own step's" if verdicts & {"disagree", "discontinuous"} else "undecided"


@dataclass(frozen=True, eq=False)
class Comparison:
    """Engines on one model; the first of `engines` is Drake, the reference."""

    model: Model
    x0: Array
    us: Array
    states: tuple[Probe, ...]  # where Jacobians were compared
    engines: tuple[Compared, ...]
    refused: tuple[Refused, ...]

    @property
    def reference(self) -> Compared:
        return self.engines[0]

    @property
    def holds(self) -> bool:
        """Whether every engine is the same, or differs by a law that its contract tells of."""
        return all(e.verdict in ("same", "other law") for e in self.engines)


def first_above(gaps: Array, precision: Precision) -> int | None:
    """The first step whose gap is above the tolerance."""
    above = np.flatnonzero(~(gaps <= STEP_TOLERANCE[precision]))
    return int(above[0]) if len(above) else None


def slugs(comparison: Comparison) -> list[str]:
    """Names of the engines that can be parts of a topic; the place keeps them apart."""
    return [f"{i}_" + re.sub(r"[^A-Za-z0-9]+", "_", e.engine).strip("_") for i, e in enumerate(comparison.engines)]


def sentence_of(compared: Compared) -> str:
    """What one engine is beside Drake, and why."""
    told = {"same": _same, "other law": _other_law, "other model": _other_model, "unexplained": _unexplained}[
        compared.verdict
    ]
    return told(compared)


def verdict_of(comparison: Comparison) -> str:
    """All of it in a sentence or two: who is the same, who is not, whose gradients are their own steps'."""
    others = comparison.engines[1:]
    parts = []
    for verdict, said in (
        ("same", "the same simulation as Drake"),
        ("other law", "the same model under another law"),
        ("other model", "another model: its contract is broken"),
        ("unexplained", "different, and nothing tells why"),
    ):
        names = [e.engine for e in others if e.verdict == verdict]
        parts += [f"{_list(names)}: {said}"] if names else []
    if not parts:
        parts.append("no engine was compared")
    return "; ".join(parts) + ". " + _trust(comparison) + _after_contact(others)


def _trust(comparison: Comparison) -> str:
    own, wrong, open_, blind = (
        [e.engine for e in comparison.engines if e.gradient == kind]
        for kind in ("its own step's", "not its own step's", "undecided", "none")
    )
    parts = [f"Gradients to trust at the states looked at: {_list(own)}"] if own else ["No gradient to trust"]
    parts += [f"not those of {_list(wrong)}, which are not the derivatives of their own steps"] if wrong else []
    parts += [f"those of {_list(open_)} could not be decided"] if open_ else []
    parts += [f"{_list(blind)} {'offer' if len(blind) > 1 else 'offers'} none"] if blind else []
    return "; ".join(parts) + "."


def _after_contact(others: tuple[Compared, ...]) -> str:
    if not any("contact law" in (e.first.responsible, e.largest.responsible) for e in others if e.verdict != "same"):
        return ""
    return " From the first touch on a state is only as good as the contact law: drake-diff contact-table."


def _same(e: Compared) -> str:
    unused = [line.quantity for line in e.different if line.reason != NOT_TOLD]
    but = f"; what its contract has otherwise ({_list(unused)}) did not come into play" if unused else ""
    jacobians = f", Jacobians within {_largest(e.jacobian_gaps)} of their largest entry" if e.jacobians else ""
    return (
        f"the same simulation: each of {len(e.step_gaps)} steps within {_largest(e.step_gaps)} of Drake's"
        f"{jacobians}{but}"
    )


def _other_law(e: Compared) -> str:
    if e.first_apart is None:
        i = max(e.other_states, key=lambda state: e.jacobian_gaps[state])
        reason = "; ".join(dict.fromkeys(line.reason or line.detail for line in e.tells(e.laws[i])[:1]))
        return (
            f"the same motion, each of {len(e.step_gaps)} steps within {_largest(e.step_gaps)} of Drake's; another "
            f"Jacobian at the {e.jacobians[i].state} state, by the {e.laws[i]} ({reason})"
        )
    k = e.first_apart or 0
    before = "from the first step on" if k == 0 else f"the same for {e.motion.times[k]:.4g} s, then apart"
    terms = list(dict.fromkeys((e.first.responsible, e.largest.responsible)))
    lines = {line.quantity: line.reason or line.detail for line in e.told}
    why = "; ".join(lines[term] for term in terms if term in lines) or "; ".join(lines.values())
    why = "; ".join(part for part in (why, e.first.as_if) if part)
    return f"{before} by the {_list(terms)}, at most {_largest(e.step_gaps)} of the state in one step ({why})"


def _other_model(e: Compared) -> str:
    lines = "; ".join([f"{line.quantity}: {line.detail}" for line in e.broken] or [e.first.as_if])
    return (
        f"another model ({lines}); a step differs by up to {_largest(e.step_gaps)}, most by its {e.largest.responsible}"
    )


def _unexplained(e: Compared) -> str:
    if e.first_apart is not None:
        return (
            f"apart from t = {e.motion.times[e.first_apart]:.4g} s on by up to {_largest(e.step_gaps)} in one step, "
            f"above {STEP_TOLERANCE[e.precision]:g}; the largest part is {e.largest.responsible}, and no line of its "
            "contract tells of it"
        )
    if e.motion.status != "ok":
        return e.motion.status
    worst = int(np.argmax(e.jacobian_gaps))
    return (
        f"every step is Drake's, but its Jacobian at the {e.jacobians[worst].state} state is off by "
        f"{e.jacobian_gaps[worst]:.1e} of its largest entry"
    )


def _largest(values: Iterable[float]) -> str:
    return f"{max(values, default=0.0):.1e}"


def _list(names: list[str]) -> str:
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)
