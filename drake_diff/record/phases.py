"""The fields of phases.json: a solve in phases, each of which has a directory and a record of its own beside it."""

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from drake_diff.record.parts import Certified, FiniteTable, Part
from drake_diff.record.sealed import SealedRecord
from drake_diff.record.solve import Claim, Solver


class PhaseEvidence(Part):
    """One phase: its name, the directory of its own record, how it ended, what it costs and how long it lasts."""

    name: str
    directory: str
    status: str
    cost: float | None  # null where it is not finite
    duration: float  # [s], or steps of a map


class LinkEvidence(Part):
    """From the last state of phase `before` to the first of phase `after`, by their places among the phases.

    `reset` is {"identity": {}}, {"matrix": {"rows": ...}} or {"impact": {...}} (points, axes, restitution, places and
    friction of a rigid impact); null is a user's function, whose name is `told`.
    """

    before: int
    after: int
    told: str
    reset: FiniteTable | None
    errors: list[float | None]  # of each state of the phase after, in its unit; null where one is not finite
    tolerance: float
    certificate: Certified | None


class ChainEvidence(Part):
    """Where the dynamics lead from the first state of all through all phases, compared with the plan."""

    holds: bool
    control: str
    told: str
    worst: float | None  # distance from the plan or beyond a bound, as a part of the state's range


class PhasesRecord(SealedRecord):
    """A solve in phases: how they are linked, what was measured of the links and of the chain of all phases.

    What each phase was asked and what it measures is in the record of its own directory.
    """

    FILE: ClassVar[str] = "phases.json"

    kind: Literal["phases"] = "phases"
    claim: Claim
    horizon_s: list[float] | None  # (lower, upper) of the sum of all durations
    counts_steps: bool  # of maps, whose time counts steps
    search: FiniteTable | None  # the arguments of `solve`
    initial_guess: str | None  # null: none was given
    solver: Solver | None = None
    cost: float | None = None
    phases: list[PhaseEvidence] = Field(default_factory=list)
    links: list[LinkEvidence] = Field(default_factory=list)
    chain: ChainEvidence | None = None

    @model_validator(mode="after")
    def _passes_only_what_holds(self) -> "PhasesRecord":
        if self.verdict != "pass":
            return self
        broken = [f"{p.name} {p.status}" for p in self.phases if p.status != "converged"]
        for link in self.links:
            if not all(error is not None and error <= link.tolerance for error in link.errors):
                broken.append(f"the link from phase {link.before} to phase {link.after}")
            if link.certificate is None or link.certificate.verdict != "agree":
                broken.append(f"the derivative of the reset from phase {link.before} to phase {link.after}")
        if self.chain is None or not self.chain.holds:
            broken.append("the chain of all phases")
        if self.solver is None or self.solver.status != "converged" or not self.phases:
            broken.append(f"solver status {self.solver.status if self.solver else 'missing'}")
        if broken:
            raise ValueError(f'a verdict "pass" with {", ".join(broken)}')
        return self

    def facts(self) -> dict[str, str]:
        """What the phases are, what all cost, and how well they are linked."""
        unit = "steps" if self.counts_steps else "s"
        told = {
            "phases": ", ".join(f"{p.name} ({p.duration:.4g} {unit}, {p.status})" for p in self.phases) or "none yet"
        }
        told["cost"] = "none" if self.cost is None else f"{self.cost:.6g}"
        if self.solver is not None:
            told["solver"] = f"{self.solver.method}, {self.solver.status}"
        return told | super().facts()
