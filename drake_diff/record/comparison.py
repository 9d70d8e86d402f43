"""The fields of comparison.json: one model in several engines."""

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from drake_diff.record.parts import Certified, FiniteTable, Part
from drake_diff.record.sealed import SealedRecord, WallClock

Sameness = Literal["same", "other law", "other model", "unexplained"]
Numbers = list[float | None]  # null: not finite


class LineEvidence(Part):
    """A line of the contract match."""

    quantity: str
    verdict: Literal["equal", "mapped", "different"]
    detail: str
    reason: str


class AttributionEvidence(Part):
    """What makes a step differ: what each term alone changes of it, and the scheme of both engines."""

    gap: float
    responsible: str
    effects: dict[str, float]
    schemes: list[str]
    assumed: list[str]


class JacobianEvidence(Part):
    """[A B] on the tangent space, row by row, its gap to the reference's, and whether it is its own step's."""

    state: str
    method: str
    gap: float
    jacobian: list[Numbers]
    law: str  # of contact or limits, where one is at work there
    own: str | None
    certificate: Certified | None


class FunctionEvidence(Part):
    """A user's own equations: their code is not in the record, and cannot be run again from it."""

    name: str
    sha256: str | None  # of the source; null where Python could not show it
    parameters: dict[str, float]


class CauseEvidence(Part):
    """The smallest change of the model that explains a recording, with 95 % intervals; or why nothing is named."""

    names: list[str]  # what is changed, together
    values: dict[str, Numbers]
    intervals: dict[str, list[Numbers]]  # by name, lower and upper of each of its numbers
    alternatives: list[list[str]]  # changes that the recording cannot tell from this one
    explained: bool  # by the model as it is, or with the change
    sentence: str


class RecordedEvidence(Part):
    """A recording that was compared; its arrays are in the directory, so that it can be compared again."""

    name: str
    version: str
    facts: dict[str, str]  # what is known of the engine's contract
    path: str
    samples: int


class EngineEvidence(Part):
    """One engine beside the reference."""

    engine: str
    version: str
    precision: Literal["float64", "float32"]
    verdict: Sameness
    sentence: str
    contract: list[LineEvidence]
    status: str
    steps: int
    largest_step_gap: float  # relative to the state where that is above 1
    first_apart_s: float | None
    first: AttributionEvidence
    largest: AttributionEvidence
    final_gap: float
    energy_change_J: float | None
    largest_penetration_m: float | None
    jacobians: list[JacobianEvidence]
    rollout_jacobian: list[Numbers] | None
    rollout_gap: float | None
    gradient: Literal["its own step's", "not its own step's", "undecided", "none"]
    function: FunctionEvidence | None = None
    cause: CauseEvidence | None = None  # of a recording


class StateEvidence(Part):
    """A state at which Jacobians were compared."""

    name: str
    x: list[float]
    u: list[float]


class RefusedEvidence(Part):
    """An engine that was not compared."""

    engine: str
    reason: str
    installed: bool


class ComparisonClock(WallClock):
    """How fast each engine is, by its name."""

    seconds_per_step: dict[str, float | None] = Field(default_factory=dict)
    seconds_per_jacobian: dict[str, float | None] = Field(default_factory=dict)


class ComparisonRecord(SealedRecord):
    """One model in several engines; the first engine is the reference. Incomplete until everything is written."""

    FILE: ClassVar[str] = "comparison.json"

    kind: Literal["comparison"] = "comparison"
    tolerances: dict[str, float]
    contract: FiniteTable
    time_step_s: float
    state_names: list[str]
    input_names: list[str]
    states: list[StateEvidence]
    engines: list[EngineEvidence]
    refused: list[RefusedEvidence]
    recordings: list[RecordedEvidence] = Field(default_factory=list)  # none: none kept, or of before 2.4
    wall_clock: ComparisonClock

    @model_validator(mode="after")
    def _passes_only_what_is_explained(self) -> "ComparisonRecord":
        broken = [e.engine for e in self.engines if e.verdict not in ("same", "other law")]
        if self.verdict == "pass" and (broken or not self.engines):
            raise ValueError(f'a verdict "pass" with {", ".join(broken) or "no engine"}')
        return self

    def facts(self) -> dict[str, str]:
        """The verdict on each engine but the reference."""
        told: dict[str, str] = {e.engine: e.verdict for e in self.engines[1:]}
        for e in self.engines:
            if e.function is not None:
                source = f"source sha256 {e.function.sha256}" if e.function.sha256 else "its source was not to be had"
                told[e.engine] += f"; a user's function {e.function.name}, {source}, which this record does not hold"
        return told | {e.engine: "not compared" for e in self.refused} | super().facts()
