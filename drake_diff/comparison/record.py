"""The fields of comparison.json."""

from typing import Literal

from pydantic import Field

from drake_diff.record.parts import Certified, FileEvidence, FiniteTable, ModelInput, Part, Provenance
from drake_diff.record.run_record import canonical, own_sha256

COMPARISON_VERSION = "1.0.0"
Verdict = Literal["same", "other law", "other model", "unexplained"]
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


class EngineEvidence(Part):
    """One engine beside the reference."""

    engine: str
    version: str
    precision: Literal["float64", "float32"]
    verdict: Verdict
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


class Times(Part):
    """Seconds; they differ from run to run."""

    written: str
    seconds_per_step: dict[str, float | None] = Field(default_factory=dict)
    seconds_per_jacobian: dict[str, float | None] = Field(default_factory=dict)


class ComparisonRecord(Part):
    """One model in several engines; the first engine is the reference. Incomplete until everything is written."""

    schema_version: str = COMPARISON_VERSION
    name: str
    verdict: Literal["pass", "fail", "incomplete"]
    sentence: str
    tolerances: dict[str, float]
    model: ModelInput
    contract: FiniteTable
    time_step_s: float
    state_names: list[str]
    input_names: list[str]
    states: list[StateEvidence]
    engines: list[EngineEvidence]
    refused: list[RefusedEvidence]
    files: list[FileEvidence]
    provenance: Provenance
    wall_clock: Times
    record_sha256: str = ""

    def to_json(self) -> str:
        """The record as canonical JSON: the same record gives the same bytes."""
        return canonical(self.model_dump(mode="json"))

    def sealed(self) -> "ComparisonRecord":
        """This record with its own hash."""
        return self.model_copy(update={"record_sha256": own_sha256(self.model_dump(mode="json"))})
