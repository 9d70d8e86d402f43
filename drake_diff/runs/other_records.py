"""The records of fits and of comparisons, including panels, which are comparisons of many trials."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal

from pydantic import Field, model_validator

from drake_diff.runs.fields import Certified, Fields, FiniteTable, ModelInput, Provenance, SealedRecord, WallClock


class Mounted(Fields):
    """Where a sensor sits: x, y, z [m], or with roll, pitch, yaw [rad], in a body's frame."""

    body: str
    pose: list[float]


class Asked(Fields):
    """What `identify` was called with."""

    parameters: list[str] | str
    noise: dict[str, float]
    held_out: float | str
    motion: str
    max_iterations: int
    priors: dict[str, list[list[float]]] = Field(default_factory=dict)  # means, and standard deviations
    bounds: dict[str, list[float | None]] = Field(default_factory=dict)  # lower and upper; null: no bound
    sensors: dict[str, Mounted] = Field(default_factory=dict)  # mounts of the sensors that are not at a body's frame


class RecordingEvidence(Fields):
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
    fitted_s: list[list[float]]  # intervals (from, to) [s], each with its own initial state
    held_out_s: list[list[float]]


class Estimate(Fields):
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


class FitRecord(SealedRecord):
    """Parameters estimated from recordings: "pass" only where the model with them explains what was recorded."""

    KIND: ClassVar[str] = "fit"

    kind: Literal["fit"] = "fit"
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
    remains: list[str] = Field(default_factory=list)  # where the error is, and which change of structure reduces it
    noise: dict[str, float] = Field(default_factory=dict)
    error_before: float | None = None  # in standard deviations of the noise; null if there was no motion to measure
    error_after: float | None = None
    rms: dict[str, tuple[float, float, str]] = Field(default_factory=dict)  # by entry: errors before, after, unit
    score: float | None = None
    count: int = 0
    correlation: list[list[float | None]] = Field(default_factory=list)  # of the estimates; null if it is unknown

    @model_validator(mode="after")
    def _passes_only_what_is_explained(self) -> "FitRecord":
        if self.verdict == "pass" and not (self.explained and self.converged and self.estimates):
            raise ValueError('a verdict "pass" with a fit that does not explain its recordings, or has no estimate')
        if self.verdict == "fail" and self.explained:
            raise ValueError('a verdict "fail" with a fit that explains its recordings')
        if {len(row) for row in self.correlation} - {len(self.estimates)} or len(self.correlation) not in (
            0,
            len(self.estimates),
        ):
            raise ValueError("expected a correlation for each pair of estimates")
        return self

    def facts(self) -> dict[str, str]:
        """Return the number of known parameters, and the amount of data."""
        known = sum(e.lower is not None and e.upper is not None for e in self.estimates)
        used = f"{len(self.recordings)} recordings, {self.count} numbers"
        return {"data": used, "known": f"{known} of {len(self.estimates)} numbers", **super().facts()}


TRIALS = "trials"  # the folder of the trials' records, in the panel's directory
TRIAL_PACKAGES = ("drake", "drake-diff", "numpy")  # packages whose versions must agree for two trials in one table
NOT_JUDGED = "it ran, and does not say whether it is a success"
Sameness = Literal["same", "other law", "other model", "unexplained"]
Numbers = list[float | None]  # null: not finite


class LineEvidence(Fields):
    """A line of the contract match."""

    quantity: str
    verdict: Literal["equal", "mapped", "different"]
    detail: str
    reason: str


class AttributionEvidence(Fields):
    """What makes a step differ: what each term alone changes of it, and the scheme of both engines."""

    gap: float
    responsible: str
    effects: dict[str, float]
    schemes: list[str]
    assumed: list[str]


class JacobianEvidence(Fields):
    """[A B] on the tangent space, row by row, its gap to the reference's, and whether it is its own step's."""

    state: str
    method: str
    gap: float
    jacobian: list[Numbers]
    law: str  # of contact or limits, if one is active
    own: str | None
    certificate: Certified | None


class FunctionEvidence(Fields):
    """A user's own equations: their code is not in the record, and cannot be run again from it."""

    name: str
    sha256: str | None  # of the source; null if Python could not read it
    parameters: dict[str, float]


class CauseEvidence(Fields):
    """The smallest change of the model that explains a recording, with 95 % intervals; or why nothing is named."""

    names: list[str]  # the quantities that are changed together
    values: dict[str, Numbers]
    intervals: dict[str, list[Numbers]]  # by name: lower and upper limits of its numbers
    alternatives: list[list[str]]  # changes that explain the recording equally well
    explained: bool  # whether the model explains the recording, unchanged or with the change
    sentence: str


class RecordedEvidence(Fields):
    """A recording that was compared; its arrays are in the directory, so that it can be compared again."""

    name: str
    version: str
    facts: dict[str, str]  # the known parts of the engine's contract
    path: str
    samples: int


class EngineEvidence(Fields):
    """One engine beside the reference."""

    engine: str
    version: str
    precision: Literal["float64", "float32"]
    verdict: Sameness
    sentence: str
    contract: list[LineEvidence]
    status: str
    steps: int
    largest_step_gap: float  # relative to the state if that is above 1
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


class StateEvidence(Fields):
    """A state at which Jacobians were compared."""

    name: str
    x: list[float]
    u: list[float]


class RefusedEvidence(Fields):
    """An engine that was not compared."""

    engine: str
    reason: str
    installed: bool


class PanelSection(Fields):
    """Many trials from one file. Each has a record of its own in trials/.

    `conditions` are what must be the same for two trials to stand in one table.
    """

    conditions: FiniteTable
    trials: int
    errors: int | None  # null while trials are missing
    ranked_by: str = ""
    ranking: list[FiniteTable] = Field(default_factory=list)  # a row for each cell, in descending order

    def facts(self) -> dict[str, str]:
        """Return the number of trials, and the best cell."""
        best = {"best": str(self.ranking[0]["name"])} if self.ranking else {}
        return {"trials": f"{self.trials}, {self.errors} errors", **best}


class TrialSection(Fields):
    """One trial of a panel: what it was given, and what came out. `id` is the start of the SHA-256 of `inputs`."""

    id: str
    cell: FiniteTable
    inputs: FiniteTable
    result: FiniteTable
    conditions: FiniteTable


class ComparisonRecord(SealedRecord):
    """One model in several engines, the first of which is the reference; or a panel, or one trial of it.

    The record of a trial is the same, byte for byte, whichever engine, worker and call of the panel evaluated it.
    """

    KIND: ClassVar[str] = "comparison"

    kind: Literal["comparison"] = "comparison"
    tolerances: dict[str, float] = Field(default_factory=dict)
    contract: FiniteTable = Field(default_factory=dict)
    time_step_s: float | None = None
    state_names: list[str] = Field(default_factory=list)
    input_names: list[str] = Field(default_factory=list)
    states: list[StateEvidence] = Field(default_factory=list)
    engines: list[EngineEvidence] = Field(default_factory=list)
    refused: list[RefusedEvidence] = Field(default_factory=list)
    recordings: list[RecordedEvidence] = Field(default_factory=list)
    panel: PanelSection | None = None
    trial: TrialSection | None = None

    @property
    def subject(self) -> str:
        """The subject of the record: "comparison", "panel" or "trial"."""
        return "panel" if self.panel else "trial" if self.trial else self.kind

    @model_validator(mode="after")
    def _passes_only_what_holds(self) -> "ComparisonRecord":
        if self.trial is not None:
            if (self.verdict, self.sentence) != judged(self.trial.result):
                raise ValueError(f'a verdict "{self.verdict}, {self.sentence}" that contradicts its result')
        elif self.panel is not None:
            if self.verdict == "pass" and self.panel.errors != 0:
                raise ValueError(f'a verdict "pass" with {self.panel.errors} errors')
        elif self.verdict == "pass":
            broken = [e.engine for e in self.engines if e.verdict not in ("same", "other law")]
            if broken or not self.engines:
                raise ValueError(f'a verdict "pass" with {", ".join(broken) or "no engine"}')
        return self

    def facts(self) -> dict[str, str]:
        """Return the verdict on each engine except the reference, a panel's best cell, or a trial's result."""
        if self.trial is not None:
            return {name: str(value) for name, value in self.trial.result.items()}
        if self.panel is not None:
            return self.panel.facts() | super().facts()
        facts: dict[str, str] = {e.engine: e.verdict for e in self.engines[1:]}
        for e in self.engines:
            if e.function is not None:
                source = f"source sha256 {e.function.sha256}" if e.function.sha256 else "its source was not available"
                facts[e.engine] += f"; a user's function {e.function.name}, {source}, which this record does not hold"
        return facts | {e.engine: "not compared" for e in self.refused} | super().facts()


def judged(result: Mapping[str, Any]) -> tuple[Literal["pass", "fail"], str]:
    """Return the verdict on a trial according to its result, and the reason."""
    if "error" in result:
        return "fail", f"it ended in an error: {result['error']}"
    if isinstance(result.get("success"), bool):
        return ("pass", "it is a success") if result["success"] else ("fail", "it is no success")
    return "pass", NOT_JUDGED


def trial_record(
    trial: str, name: str, cell: FiniteTable, inputs: FiniteTable, result: FiniteTable, conditions: Mapping[str, Any]
) -> ComparisonRecord:
    """Return the sealed record of a trial, with the package versions in `conditions`."""
    verdict, sentence = judged(result)
    packages = {key: str(conditions[key]) for key in TRIAL_PACKAGES if conditions.get(key)}
    return ComparisonRecord(
        name=name,
        verdict=verdict,
        sentence=sentence,
        trial=TrialSection(id=trial, cell=cell, inputs=inputs, result=result, conditions=dict(conditions)),
        model=ModelInput(file=None, options=None),
        provenance=Provenance(
            python=str(conditions["python"]),
            platform=str(conditions["platform"]),
            packages=packages,
            git=None,
            command=[],
        ),
        wall_clock=WallClock(written_utc=""),
    ).sealed()


def is_trial_file(path: Path) -> bool:
    """Return whether `path` can be the record of a trial of a panel: ID.json in trials/."""
    return path.parent.name == TRIALS and re.fullmatch(r"[0-9a-f]{16}\.json", path.name) is not None and path.is_file()
