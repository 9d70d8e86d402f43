"""The fields of certification.json."""

from typing import Literal

from pydantic import Field

from drake_diff.record import canonical
from drake_diff.record_parts import Certified, FiniteTable, ModelInput, Part, Provenance, WallClock

CERTIFICATION_VERSION = "1.0.0"


class StateEvidence(Part):
    """The certificate of one sampled state of a model."""

    kind: Literal["free", "contact"]
    x: list[float]
    u: list[float]
    gradient: Certified | None
    refusal: str | None = None  # why there is no certificate
    largest: float | None = None  # the largest entry of the derivative
    contact_modes: dict[str, str] = Field(default_factory=dict)  # of the pairs that push each other
    mode_changes: list[str] = Field(default_factory=list)  # within 1e-4 of the state

    @property
    def verdict(self) -> str:
        """The certificate's, or "refused"."""
        return self.gradient.verdict if self.gradient else "refused"


class CertificationRecord(Part):
    """Certificates of a model at sampled states."""

    schema_version: str = CERTIFICATION_VERSION
    name: str
    verdict: Literal["pass", "fail", "incomplete"]
    sentence: str
    seed: int
    parameters: list[str]
    model: ModelInput
    contract: FiniteTable
    states: list[StateEvidence]
    provenance: Provenance
    wall_clock: WallClock

    def to_json(self) -> str:
        """The record as canonical JSON: the same record gives the same bytes."""
        return canonical(self.model_dump(mode="json"))
