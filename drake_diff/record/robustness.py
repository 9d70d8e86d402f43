"""The fields of robustness.json, and of the trial.json beside each worst trial."""

from typing import ClassVar, Literal

from pydantic import model_validator

from drake_diff.record.parts import Label, Part
from drake_diff.record.sealed import SealedRecord, WallClock
from drake_diff.record.solve import EvaluationPanel


class RunEvidence(Part):
    """The run directory whose plan was tried, and the hash of its record."""

    path: str
    record_sha256: str


class CellEvidence(Part):
    """The trials at one level; null is no finite number. Displacements are root mean squares of the last state's."""

    level: float
    successes: int
    trials: int
    rate: float
    lower_95: float  # Wilson's interval
    upper_95: float
    distinct: int  # how many of the trials end in a state of their own: 1 where nothing is drawn
    labels: dict[str, int]
    controller_errors: dict[str, int]  # "Type: message" of what the controller raised, and in how many trials
    goal_error_median: float | None
    goal_error_worst: float | None
    displacement: float | None
    predicted: float | None
    ratio: float | None


class PerturbationEvidence(Part):
    """One perturbation at all its levels; `margin` is the largest level up to which 95 % of the trials succeed."""

    name: str
    unit: str
    meaning: str
    margin: float
    cells: list[CellEvidence]
    worst: str  # the directory of its worst trial


class EventEvidence(Part):
    """Something that happened in a loop, at simulated time."""

    t_s: float
    kind: str
    message: str


class TrialEvidence(Part):
    """One trial, with all that it takes to run it again: `loop.panel_trial.evaluate` takes it as it is.

    `run` is null where the plan was not read from a run directory: the trial can be run again with it at hand alone.
    """

    run: str | None
    controller: str
    perturbation: str
    level: float
    seed: int
    success: bool
    label: Label | None
    reason: str
    failures: list[str]
    goal_error: float | None
    displacement: float | None
    ended: str
    plant_time_step_s: float
    controller_period_s: float
    parameters: dict[str, float | list[float]]  # of the plant, where another than the model's
    start: list[float]
    events: list[EventEvidence]


class Nominal(Part):
    """The unperturbed run."""

    success: bool
    failures: list[str]
    goal_error: float | None
    ended: str


class LoopEvidence(Part):
    """What is around the controller in every trial; numbers are for all coordinates, or one each."""

    controller: str
    period_s: float
    steps: int
    judged_by: str
    sensor: dict[str, float | list[float | None] | None]
    estimator: str
    actuator: dict[str, float | list[float | None] | None]
    fallback: str | None
    latency_budget_s: float
    latency_budget_is: Literal["stated", "the controller's period"]


class RobustnessClock(WallClock):
    """How fast the controller answered, in the unperturbed run and the worst trials."""

    latency_median_s: float | None = None
    latency_99_percent_s: float | None = None
    latency_largest_s: float | None = None
    late: int | None = None
    controller_steps: int | None = None


class RobustnessRecord(SealedRecord):
    """A plan under perturbations. Incomplete until everything is written."""

    FILE: ClassVar[str] = "robustness.json"

    kind: Literal["robustness"] = "robustness"
    run: RunEvidence | None
    state_names: list[str]
    input_names: list[str]
    trials: int | None
    seed: int | None
    loop: LoopEvidence | None
    nominal: Nominal | None
    perturbations: list[PerturbationEvidence]
    panel: EvaluationPanel | None = None  # null in records of before 2.3, and before anything was judged
    wall_clock: RobustnessClock

    @model_validator(mode="after")
    def _passes_only_what_is_survived(self) -> "RobustnessRecord":
        broken = [p.name for p in self.perturbations if p.margin <= 0]
        if self.verdict == "pass" and (broken or self.nominal is None or not self.nominal.success):
            raise ValueError(f'a verdict "pass" with {", ".join(broken) or "an unperturbed run that is no success"}')
        return self

    def facts(self) -> dict[str, str]:
        """The margin of each perturbation."""
        return {p.name: f"survived up to {p.margin:g} {p.unit}" for p in self.perturbations} | super().facts()
