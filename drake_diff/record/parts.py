"""What records are made of: numbers with units and verdicts, files, failures, events. None is NaN or infinite."""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, JsonValue, model_validator

Label = Literal["perception_error", "state_error", "planning_error", "control_error", "evaluation_error"]
Table = dict[str, JsonValue]


def _finite(table: Any) -> Any:
    """`table` as it is; ValueError where a number in it is none that JSON has."""
    if isinstance(table, float) and table - table != 0:
        raise ValueError("expected finite numbers, null where there is none")
    for item in table.values() if isinstance(table, dict) else table if isinstance(table, list) else ():
        _finite(item)
    return table


FiniteTable = Annotated[Table, AfterValidator(_finite)]


class Part(BaseModel):
    """The rules of every part: no field that the schema does not have, no NaN, no infinity."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class Quantity(Part):
    """A number with its unit; `value` is null where there is no finite one, and `reason` says why."""

    value: float | None
    unit: str
    reason: str | None = None

    @model_validator(mode="after")
    def _has_a_reason(self) -> "Quantity":
        if self.value is None and not self.reason:
            raise ValueError("a value of null: expected a reason")
        return self


class Metric(Part):
    """Something measured on the plant after the solve; with a tolerance it decides, without one it informs.

    `verdict` is "pass" only where `value` keeps `tolerance`, and "info" where there is none; a value of null (there is
    no finite one, and `reason` says why) passes nothing. `t_s` is where along the motion it is at its worst.
    """

    name: str
    definition: str
    unit: str
    value: float | None
    reason: str | None = None
    tolerance: float | None = None
    direction: Literal["at_most", "at_least", "info"] = "info"
    verdict: Literal["pass", "fail", "undecided", "info"] = "info"
    t_s: float | None = None

    @model_validator(mode="after")
    def _is_consistent(self) -> "Metric":
        if self.value is None and not self.reason:
            raise ValueError(f"metric {self.name}: a value of null: expected a reason")
        if (self.tolerance is None) != (self.direction == "info") or (self.tolerance is None) != (
            self.verdict == "info"
        ):
            raise ValueError(f'metric {self.name}: expected a tolerance, or "info" as direction and verdict')
        if self.verdict == "pass" and not self.keeps(self.value):
            raise ValueError(f'metric {self.name}: "pass", but {self.value} does not keep {self.tolerance}')
        if self.verdict == "fail" and self.keeps(self.value):
            raise ValueError(f'metric {self.name}: "fail", but {self.value} keeps {self.tolerance}')
        return self

    def keeps(self, value: float | None) -> bool:
        """Whether `value` keeps the tolerance; no value keeps none."""
        if value is None or self.tolerance is None:
            return False
        return value <= self.tolerance if self.direction == "at_most" else value >= self.tolerance


class FileEvidence(Part):
    """A file of the run directory, or one the run was made from; `reason` says why it has no size and hash."""

    path: str
    bytes: int | None
    sha256: str | None
    reason: str | None = None


class Failure(Part):
    """Why a run is no success: a case under one of the five labels, and what found it."""

    label: Label
    code: str
    message: str
    t_s: float | None = None  # along the motion, where the failure is at one time
    detected_by: str
    evidence: str | None = None  # the section of the record that shows it


class Event(Part):
    """Something that happened; `t_s` [s] is simulated time, null for what happens before or after the motion.

    No solver here reports a "recovery" yet; observations and actions, step by step, are in trace.mcap.
    """

    t_s: float | None
    kind: Literal[
        "solver_started",
        "solver_ended",
        "contact_made",
        "contact_broken",
        "saturation_begins",
        "saturation_ends",
        "recovery",
        "failure",
    ]
    message: str


class Certified(Part):
    """One certificate: what was compared, where the derivative came from, and the entry that is worst."""

    subject: str
    method: str
    verdict: str
    entries: int
    counts: dict[str, int]
    worst: str | None
    power: float  # the smallest error that every entry's differences would have noticed, as a part of the entry
    told: str  # whose differences they are


class Provenance(Part):
    """With what the run was made."""

    python: str
    platform: str
    packages: dict[str, str]
    git: dict[str, str | bool] | None
    command: list[str]


class ModelInput(Part):
    """What the model was made from, and how; no `file` and no `options` where it is a user's own diagram.

    `named` are the files that the model file names (meshes, included models), by the name that they have in it. Those
    whose name is neither that of a mesh nor of a robot file are not read.
    """

    file: FileEvidence | None
    named: list[FileEvidence] = Field(default_factory=list)
    options: FiniteTable | None


class DataUse(Part):
    """Data that a run used: what it is, and the hash of its bytes, null where it has none of its own."""

    name: str
    what: str
    sha256: str | None = None


class DataBoundary(Part):
    """Which data a run saw while it searched, and on which it was judged; `statement` says it in words.

    `held_out` are the names of what it was judged on and did not see. What has the name or the bytes of data that was
    seen is not held out: a record that says so is refused.
    """

    statement: str
    seen: list[DataUse]
    judged_on: list[DataUse]
    held_out: list[str] = Field(default_factory=list)

    @model_validator(mode="after")
    def _holds_out_only_what_was_not_seen(self) -> "DataBoundary":
        names, hashes = {use.name for use in self.seen}, {use.sha256 for use in self.seen if use.sha256}
        new = [use.name for use in self.judged_on if use.name not in names and use.sha256 not in hashes]
        wrong = [name for name in self.held_out if name not in new]
        if wrong:
            raise ValueError(f"held out: {', '.join(wrong)}, which the run saw, or was not judged on")
        return self


class Drive(Part):
    """An actuator: its joint, what it is commanded, and what it can do; null is no limit, and no gain."""

    actuator: str
    joint: str
    command: str
    unit: str
    effort_limit: float | None
    gear_ratio: float
    rotor_inertia: float
    kp: float | None
    kd: float | None


class Embodiment(Part):
    """The robot: its base, which joints are driven and how, which only move, what is fixed, sensed and can touch.

    `other_inputs` are those that are no actuator, such as the thrust on a body. Units are those of the contract.
    """

    robot: str
    base: str
    driven: list[Drive]
    other_inputs: list[str]
    passive: list[str]
    fixed: list[str]
    sensed: str
    touching: list[str]


class Evaluation(Part):
    """A metric measured a second time in another way; `how` says which.

    "differ" is a failure of the evaluator, whatever the motion is: the two values are further apart than `tolerance`,
    one alone is a finite number, or their units are not the same. "not measured" has the reason.
    """

    name: str  # the metric's
    how: str
    unit: str
    value: float | None
    tolerance: float
    verdict: Literal["agree", "differ", "not measured"]
    reason: str | None = None

    def of(self, metric: Metric) -> str:
        """What the verdict has to be beside `metric`."""
        if self.reason is not None:
            return "not measured"
        same = set(self.unit.split(" or ")) == set(metric.unit.split(" or "))
        if self.value is None or metric.value is None:
            return "agree" if same and self.value is metric.value else "differ"
        return "agree" if same and abs(self.value - metric.value) <= self.tolerance else "differ"
