"""What is found of each engine beside the reference, and what that amounts to."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from drake_diff.arrays import Array
from drake_diff.engines.attribution import Attribution
from drake_diff.engines.comparison_task import Probe
from drake_diff.engines.contract_match import ContractLine
from drake_diff.engines.engine import Precision
from drake_diff.engines.jacobians import AGREES, JacobianAt
from drake_diff.engines.motion import BROKE_OFF, EngineMotion
from drake_diff.engines.recorded import NOT_TOLD
from drake_diff.model import Model

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
