"""The record of an identification: what was asked of which data, what was found, how sure, and whether it explains."""

from typing import ClassVar, Literal

from pydantic import Field, model_validator

from drake_diff.record.parts import FiniteTable, Part
from drake_diff.record.sealed import SealedRecord


class Mounted(Part):
    """Where a sensor sits: x, y, z [m], or with roll, pitch, yaw [rad], in a body's frame."""

    body: str
    pose: list[float]


class Asked(Part):
    """What `identify` was called with."""

    parameters: list[str] | str
    noise: dict[str, float]
    held_out: float | str
    motion: str
    max_iterations: int
    priors: dict[str, list[list[float]]] = Field(default_factory=dict)  # means, and standard deviations
    bounds: dict[str, list[float | None]] = Field(default_factory=dict)  # lower and upper; null: none
    sensors: dict[str, Mounted] = Field(default_factory=dict)  # where those sit that are no body's frame


class RecordingEvidence(Part):
    """A recording: the copy in the directory, the hash of the file it was read from, and what of it was used how.

    Without a file, `sha256` is null and `path` has the arrays. Times are those of the recording less its first.
    """

    name: str
    version: str
    facts: dict[str, str] = Field(default_factory=dict)
    file: str | None
    path: str
    sha256: str | None
    samples: int
    fitted_s: list[list[float]]  # from, to [s], each with a first state of its own
    held_out_s: list[list[float]]


class Estimate(Part):
    """One entry of a parameter; a limit of its 95 % interval is null where there is none."""

    name: str
    unit: str
    before: float
    value: float
    lower: float | None
    upper: float | None

    @model_validator(mode="after")
    def _is_in_its_interval(self) -> "Estimate":
        low, high = (self.value if limit is None else limit for limit in (self.lower, self.upper))
        if not low <= self.value <= high:
            raise ValueError(f"{self.name}: {self.value} is not within its interval, {self.lower} to {self.upper}")
        return self


class IdentificationRecord(SealedRecord):
    """Parameters estimated from recordings: "pass" only where the model with them explains what was recorded."""

    FILE: ClassVar[str] = "identification.json"

    kind: Literal["identification"] = "identification"
    contract: FiniteTable
    inputs: Asked
    recordings: list[RecordingEvidence]  # the data boundary
    explained: bool = False
    reason: str = ""
    converged: bool = False
    steps: int = 0
    motion: str = ""
    estimates: list[Estimate] = Field(default_factory=list)
    unidentifiable: list[str] = Field(default_factory=list)
    noise: dict[str, float] = Field(default_factory=dict)
    error_before: float | None = None  # in standard deviations of the noise; null where there was no motion to measure
    error_after: float | None = None
    score: float | None = None
    count: int = 0
    correlation: list[list[float | None]] = Field(default_factory=list)  # of the estimates; null where nothing is known

    @model_validator(mode="after")
    def _passes_only_what_is_explained(self) -> "IdentificationRecord":
        if self.verdict == "pass" and not (self.explained and self.converged and self.estimates):
            raise ValueError('a verdict "pass" with a fit that does not explain its recordings, or has no estimate')
        if self.verdict == "fail" and self.explained:
            raise ValueError('a verdict "fail" with a fit that explains its recordings')
        if {len(row) for row in self.correlation} - {len(self.estimates)} or len(self.correlation) not in (
            0,
            len(self.estimates),
        ):
            raise ValueError("expected a correlation of each estimate with each")
        return self

    def facts(self) -> dict[str, str]:
        """How many parameters, from how much data."""
        known = sum(e.lower is not None and e.upper is not None for e in self.estimates)
        used = f"{len(self.recordings)} recordings, {self.count} numbers"
        return {"data": used, "known": f"{known} of {len(self.estimates)} numbers", **super().facts()}
