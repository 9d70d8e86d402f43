"""The fields of record.json: one solve, from what was asked to what was measured again."""

from hashlib import sha256
from typing import ClassVar, Literal

from pydantic import Field, model_validator

from drake_diff.record.parts import (
    Certified,
    Evaluation,
    Event,
    Failure,
    FiniteTable,
    Metric,
    ModelInput,
    Part,
    Quantity,
)
from drake_diff.record.provenance import provenance_of, written_now
from drake_diff.record.sealed import SealedRecord, WallClock, canonical

NO_PROBLEM = "there was no problem yet"

METRIC_WRONG = "metric_wrong"  # the code of a failure: a metric is not what it is by a second measurement


class Claim(Part):
    """What the run says is true, and what it does not say."""

    statement: str
    limitations: list[str]


class Inputs(Part):
    """What the run started from, besides `problem`, which holds the initial state.

    `search` are the arguments of `solve`, so that it can be called again; null where they are not known.
    """

    initial_guess: str
    initial_guess_sha256: str | None  # of the bytes of xs (N+1, nx), then us (N, nu), as doubles
    seed: int | None
    random_generator: str = "numpy.random.default_rng"
    search: FiniteTable | None = None


class Solver(Part):
    """What solved the problem, and how it says it ended."""

    method: str
    solver: str
    scheme: str
    status: str
    message: str
    solver_message: str
    options: FiniteTable
    iterations: int


class ParameterEvidence(Part):
    """One entry of the parameter vector: where it started, what was found, where its derivative came from."""

    name: str
    unit: str
    derivative_source: str
    start: float
    value: float
    optimized: bool
    lower: float | None
    upper: float | None


class GradientColumn(Part):
    """One of the variables that the motion is differentiated by, and where that column of derivatives comes from."""

    name: str
    unit: str
    source: str


class GradientEvidence(Part):
    """What is differentiated, from where, and how far it agrees with differences."""

    differentiated: list[str]
    columns: list[GradientColumn]
    smoothing: str
    regularization: str
    solver_tolerance: Quantity
    horizon: Quantity
    final_state_norm_definition: str  # or why there are none
    final_state_norms: list[float | None] = Field(default_factory=list)  # by knot; null where one is not finite
    lagrangian_norm_definition: str  # or why there are none
    lagrangian_norms: list[float | None] = Field(default_factory=list)  # the same
    stationarity: Quantity
    certificates: list[Certified] = Field(default_factory=list)


class ObservedVariable(Part):
    """One variable of the state as it is observed."""

    name: str
    unit: str
    frame: str
    uncertainty: Quantity


class Observation(Part):
    """What is observed, in which frame, and when."""

    variables: list[ObservedVariable]
    clock: str
    start_s: float
    period_s: float
    count: int


class Command(Part):
    """One commanded input; null is no limit."""

    name: str
    unit: str
    lower: float | None
    upper: float | None


class ActionInterface(Part):
    """How the inputs reach the plant."""

    command_type: str
    commands: list[Command]
    update_rate: Quantity
    latency_budget: Quantity
    safety_fallback: str


class ReplayEvidence(Part):
    """One replay of the plan on the plant; a measure is None where the motion could not be taken."""

    variant: str
    control: str
    time_step_s: float
    contact_approximation: str
    goal_error: float | None  # the largest, in the state's units
    bound_violation: float | None  # the same
    energy_error_J: float | None
    penetration_m: float | None
    holds: bool
    failures: list[str]


class FollowedEvidence(Part):
    """A plant in which the plan was followed by its own feedback; a measure is None where there is no motion.

    `off_plan` is how far from the plan it ends, as a part of the worst state's range, `left_plan_s` from when on it is
    further from the plan than allowed, and `unlike` what is another in this plant than in the plan's.
    """

    plant: str
    where: str
    control: str
    time_step_s: float | None  # null in continuous time
    measured: bool
    goal_error: float | None
    bound_violation: float | None
    penetration_m: float | None
    off_plan: float | None
    left_plan_s: float | None
    holds: bool
    failures: list[str]
    unlike: list[str]
    remark: str

    @model_validator(mode="after")
    def _holds_only_without_failures(self) -> "FollowedEvidence":
        if self.holds != (self.measured and not self.failures and not self.unlike):
            raise ValueError(f"{self.where}: holds is {self.holds}, against what it says of it")
        return self


class ElsewhereEvidence(Part):
    """Where the plan holds beside the plant that it was made on: evidence that no verdict rests on."""

    sentence: str
    engines: list[str]  # that were asked for
    period_s: float  # how long each command of the controller is held
    rows: list[FollowedEvidence]


class PanelCase(Part):
    """One plant in which the plan was judged, and under which control; `decides` where the verdict rests on it."""

    variant: str
    control: str
    time_step_s: float
    contact_approximation: str
    decides: bool


class EvaluationPanel(Part):
    """Under what the plan was judged: plants, perturbations, latencies; runs of one `sha256` were judged alike.

    The hash is that of the panel's canonical JSON with `sha256` empty.
    """

    statement: str
    cases: list[PanelCase]
    perturbations: list[str]
    latencies_s: list[float]
    sha256: str = ""

    def hashed(self) -> "EvaluationPanel":
        """The same with its hash."""
        bare = self.model_copy(update={"sha256": ""})
        return bare.model_copy(update={"sha256": sha256(canonical(bare.model_dump(mode="json")).encode()).hexdigest()})


class EvidenceRecord(SealedRecord):
    """Everything a stranger needs to judge one solve; the motion is in plan.npz and trace.mcap.

    It has nothing to do with RFC 4998, which uses the name for archive time stamps.
    """

    FILE: ClassVar[str] = "record.json"

    kind: Literal["solve"] = "solve"
    claim: Claim
    inputs: Inputs
    problem: FiniteTable
    contract: FiniteTable
    panel: EvaluationPanel | None = None  # null in records of before 2.2, and before anything was judged
    units: dict[str, str]  # of the numbers in `problem` and `contract`, by their key
    solver: Solver | None = None
    parameters: list[ParameterEvidence] = Field(default_factory=list)
    metrics: list[Metric] = Field(default_factory=list)
    invariants: list[Metric] = Field(default_factory=list)
    evaluations: list[Evaluation] = Field(default_factory=list)
    gradient: GradientEvidence | None = None
    observation: Observation
    action: ActionInterface
    events: list[Event] = Field(default_factory=list)
    replays: list[ReplayEvidence] = Field(default_factory=list)
    elsewhere: ElsewhereEvidence | None = None  # null where nobody asked
    failures: list[Failure] = Field(default_factory=list)

    @model_validator(mode="after")
    def _passes_only_what_holds(self) -> "EvidenceRecord":
        if self.verdict == "pass":
            broken = [m.name for m in (*self.metrics, *self.invariants) if m.verdict in ("fail", "undecided")]
            broken += [failure.code for failure in self.failures]
            if self.solver is None or self.solver.status != "converged":
                broken.append(f"solver status {self.solver.status if self.solver else 'missing'}")
            if broken:
                raise ValueError(f'a verdict "pass" with {", ".join(broken)}')
        return self

    @model_validator(mode="after")
    def _says_where_its_evaluation_fails(self) -> "EvidenceRecord":
        metrics = {metric.name: metric for metric in self.metrics}
        for e in self.evaluations:
            if e.name not in metrics or e.verdict != e.of(metrics[e.name]):
                raise ValueError(f'evaluation of {e.name}: "{e.verdict}" is not what the two values say')
            labelled = any(f.label == "evaluation_error" and f.code == METRIC_WRONG for f in self.failures)
            if e.verdict == "differ" and not labelled:
                raise ValueError(f"{e.name} differs from its second measurement: expected an evaluation_error")
        return self

    @model_validator(mode="after")
    def _was_judged_on_its_panel(self) -> "EvidenceRecord":
        judged = [(r.variant, r.control, r.time_step_s, r.contact_approximation) for r in self.replays]
        cases = self.panel.cases if self.panel is not None else []
        told = [(c.variant, c.control, c.time_step_s, c.contact_approximation) for c in cases]
        if self.panel is not None and told != judged:
            raise ValueError(f"panel: expected the {len(judged)} replays, got {len(told)} others")
        return self

    def as_row(self) -> dict[str, str]:
        """The textbook's view of the record: section, tool, observation, action, metric, perturbation."""
        return {
            "section": "differentiable physics",
            "tool": f"drake {self.provenance.packages.get('drake', '?')}, {self.solver.method if self.solver else '-'}",
            "observation": ", ".join(f"{x.name} [{x.unit}]" for x in self.observation.variables),
            "action": ", ".join(f"{x.name} [{x.unit}]" for x in self.action.commands),
            "metric": "; ".join(f"{m.name} {m.value} {m.unit}" for m in self.metrics),
            "perturbation": "; ".join(dict.fromkeys(f"replayed {r.variant}" for r in self.replays)) or "none",
        }

    def facts(self) -> dict[str, str]:
        """What solved it, what it cost, and what fails."""
        cost = next((m.value for m in self.metrics if m.name == "cost"), None)
        told = {"cost": "none" if cost is None else f"{cost:.6g}"}
        if self.solver is not None:
            told["solver"] = f"{self.solver.method}, {self.solver.status}"
        if self.failures:
            told["failures"] = "; ".join(f"{f.label}: {f.code}" for f in self.failures)
        return told | super().facts()


def record_without_problem(name: str, sentence: str) -> EvidenceRecord:
    """The record of a run that ended before there was a problem: it says that, when and with which versions."""
    none = Quantity(value=None, unit="s", reason=NO_PROBLEM)
    return EvidenceRecord(
        name=name,
        verdict="incomplete",
        sentence=sentence,
        model=ModelInput(file=None, options=None),
        provenance=provenance_of(),
        wall_clock=WallClock(written_utc=written_now()),
        claim=Claim(statement=f"nothing: {NO_PROBLEM}", limitations=[]),
        inputs=Inputs(initial_guess=NO_PROBLEM, initial_guess_sha256=None, seed=None),
        problem={},
        contract={},
        units={},
        observation=Observation(variables=[], clock=NO_PROBLEM, start_s=0.0, period_s=0.0, count=0),
        action=ActionInterface(
            command_type=NO_PROBLEM, commands=[], update_rate=none, latency_budget=none, safety_fallback=NO_PROBLEM
        ),
        events=[Event(t_s=None, kind="failure", message=sentence)],
    )
