"""The record of a plan: a solve in one phase or several, or the certificates or trials of a plan or its model."""

from collections.abc import Iterator
from typing import Any, ClassVar, Literal

from pydantic import ConfigDict, Field, model_validator

from drake_diff.runs.fields import (
    Certified,
    Event,
    Failure,
    Fields,
    FiniteTable,
    GradientEvidence,
    Inputs,
    Label,
    Metric,
    ModelInput,
    ParameterEvidence,
    ReplayEvidence,
    SealedRecord,
    Solver,
)

# Units of the numbers in `problem` and `contract`, by their keys.
PROBLEM_UNITS = {
    "horizon_s, time_step_s, free_horizon_s": "s",
    "x0, x_goal, goal_tolerance, x_lower, x_upper, waypoints": "of `gradient.columns`: the states are the first",
    "u_lower, u_upper": "of `gradient.columns`, entry by entry: the inputs follow the states",
    "goals": "m and rad, per s for velocities",
    "constraints": "of the values of the constraint's function",
    "couplings": "of the states and inputs, per s for rates",
    "Q, R, rate": "cost per s and squared unit of the state or input; of a final cost without the s; rate: cost per s",
    "num_steps": "1",
}
CONTRACT_UNITS = {
    "time_step, relaxation_time": "s",
    "gravity": "m/s^2",
    "lower, upper": "the `unit` beside them",
    "mass": "kg",
    "center_of_mass": "m",
    "inertia, rotor_inertia": "kg m^2",
    "damping, kd": "N s/m or N m s/rad",
    "effort_limit": "N or N m",
    "kp": "N/m or N m/rad",
    "stiffness": "N/m",
    "dissipation": "s/m",
    "hydroelastic_modulus": "Pa",
    "gear_ratio, friction, solver_relative_tolerance, sap_near_rigid_threshold, collision_pairs, constraints": "1",
}


def units_of_keys(units: dict[str, str]) -> str:
    """Return the description of a table of numbers for the JSON Schema."""
    return f"Units: {'; '.join(f'{keys}: {unit}' for keys, unit in units.items())}."


class PhaseEvidence(Fields):
    """One phase: its name, the directory of its own record, how it ended, its cost and duration."""

    name: str
    directory: str
    status: str
    cost: float | None  # null if it is not finite
    duration: float  # [s], or steps of a map


class LinkEvidence(Fields):
    """From the last state of phase `before` to the first of phase `after`, by their places among the phases.

    `reset` is {"identity": {}}, {"matrix": {"rows": ...}} or {"impact": {...}} (points, axes, restitution, places and
    friction of a rigid impact); null is a user's function, whose name is `told`.
    """

    before: int
    after: int
    told: str
    reset: FiniteTable | None
    errors: list[float | None]  # error of each state of the phase after, in its unit; null if it is not finite
    tolerance: float
    certificate: Certified | None


class ChainEvidence(Fields):
    """Where the dynamics lead from the first state of all through all phases, compared with the plan."""

    holds: bool
    control: str
    told: str
    worst: float | None  # distance from the plan or beyond a bound, relative to the state's range


class PhasesSection(Fields):
    """A solve in phases: how they are linked, and what was measured of the links and of the chain of all phases.

    What each phase was asked and what it measures is in the record of its own directory.
    """

    horizon_s: list[float] | None  # (lower, upper) of the sum of all durations
    counts_steps: bool  # for maps, whose time is a number of steps
    search: FiniteTable | None = None  # the arguments of `solve`
    initial_guess: str | None = None  # null: none was given
    cost: float | None = None
    phases: list[PhaseEvidence] = Field(default_factory=list)
    links: list[LinkEvidence] = Field(default_factory=list)
    chain: ChainEvidence | None = None

    def broken(self) -> Iterator[str]:
        """Yield the reasons why the plan is not a success."""
        yield from (f"{p.name} {p.status}" for p in self.phases if p.status != "converged")
        for link in self.links:
            if not all(error is not None and error <= link.tolerance for error in link.errors):
                yield f"the link from phase {link.before} to phase {link.after}"
            if link.certificate is None or link.certificate.verdict != "agree":
                yield f"the derivative of the reset from phase {link.before} to phase {link.after}"
        if self.chain is None or not self.chain.holds or not self.phases:
            yield "the chain of all phases"

    def facts(self) -> dict[str, str]:
        """Return the phases and their total cost."""
        unit = "steps" if self.counts_steps else "s"
        phases = ", ".join(f"{p.name} ({p.duration:.4g} {unit}, {p.status})" for p in self.phases)
        return {"phases": phases or "none yet", "cost": "none" if self.cost is None else f"{self.cost:.6g}"}


class CertifiedState(Fields):
    """The certificate of one sampled state of a model."""

    kind: Literal["free", "contact"]
    x: list[float]
    u: list[float]
    gradient: Certified | None
    refusal: str | None = None  # why there is no certificate
    largest: float | None = None  # the largest entry of the derivative
    contact_modes: dict[str, str] = Field(default_factory=dict)  # of the pairs in contact
    mode_changes: list[str] = Field(default_factory=list)  # within 1e-4 of the state

    @property
    def verdict(self) -> str:
        """The verdict of the certificate, or "refused"."""
        return self.gradient.verdict if self.gradient else "refused"


class CertificationSection(Fields):
    """Certificates of a model at sampled states, and all that it takes to take them again."""

    seed: int
    method: str
    parameters: list[str]
    states: list[CertifiedState]

    def broken(self) -> Iterator[str]:
        """Yield the states whose certificate does not agree."""
        yield from (f"state {i} {s.verdict}" for i, s in enumerate(self.states) if s.verdict != "agree")
        if not self.states:
            yield "no state"

    def facts(self) -> dict[str, str]:
        """Return the number of states with each verdict."""
        verdicts = [state.verdict for state in self.states]
        counts = ", ".join(f"{verdicts.count(verdict)} {verdict}" for verdict in dict.fromkeys(verdicts))
        return {"states": counts or "none yet", "seed": str(self.seed), "method": self.method}


class RolloutSection(Fields):
    """The certificate of a rollout's gradient, of a record of schema 3 or earlier; no longer written."""

    model_config = ConfigDict(extra="allow")

    columns: list[str]
    verdicts: list[str]
    certificate: Certified

    def broken(self) -> Iterator[str]:
        """Yield the entries that do not agree."""
        pairs = zip((*self.columns, "the certificate"), (*self.verdicts, self.certificate.verdict), strict=True)
        yield from (f"{column} {verdict}" for column, verdict in pairs if verdict != "agree")

    def facts(self) -> dict[str, str]:
        """Return the names of the columns of the derivative."""
        return {"columns": ", ".join(self.columns)}


class RunEvidence(Fields):
    """The run directory whose plan was tried, and the hash of its record."""

    path: str
    record_sha256: str


class CellEvidence(Fields):
    """The trials at one level; null is no finite number. Displacements are root mean squares of the last state's."""

    level: float
    successes: int
    trials: int
    rate: float
    lower_95: float  # Wilson's interval
    upper_95: float
    distinct: int  # number of different final states of the trials: 1 without random numbers
    labels: dict[str, int]
    controller_errors: dict[str, int]  # "Type: message" of the controller's exceptions, and the number of trials
    goal_error_median: float | None
    goal_error_worst: float | None
    displacement: float | None
    predicted: float | None
    ratio: float | None


class PerturbationEvidence(Fields):
    """One perturbation at all its levels; `margin` is the largest level up to which 95 % of the trials succeed."""

    name: str
    unit: str
    meaning: str
    margin: float
    cells: list[CellEvidence]
    worst: str  # the directory of its worst trial


class TrialEvidence(Fields):
    """One trial, with everything needed to repeat it: `loop.panel_trial.evaluate` accepts it unchanged.

    `run` is null if the plan was not read from a run directory; to repeat the trial, the plan must then be given.
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
    parameters: dict[str, float | list[float]]  # of the plant, if they differ from the model's
    start: list[float]
    events: list[Event]


class Nominal(Fields):
    """The unperturbed run."""

    success: bool
    failures: list[str]
    goal_error: float | None
    ended: str


class PushEvidence(Fields):
    """A blow at the centre of mass of a body; `impulse` in the world frame [N s]."""

    body: str
    impulse: list[float]
    at_s: float


class LoopEvidence(Fields):
    """What is around the controller; numbers are for all coordinates, or one each."""

    controller: str
    period_s: float
    steps: int
    judged_by: str
    sensor: dict[str, float | list[float | None] | None]
    estimator: str
    estimator_delay: int | None = None  # of a Predictor, in steps of the controller
    estimator_model: Literal["the plant's", "the controller's"] | None = None  # of a Predictor; null: another
    actuator: dict[str, float | list[float | None] | None]
    fallback: str | None
    fallback_patience: int | None = None
    fallback_damping: float | list[float | None] | None = None
    pushes: list[PushEvidence] = Field(default_factory=list)
    latency_budget_s: float
    latency_budget_is: Literal["stated", "the controller's period"]


class RobustnessSection(Fields):
    """A plan under perturbations."""

    run: RunEvidence | None = None
    state_names: list[str]
    input_names: list[str]
    trials: int | None = None
    seed: int | None = None
    loop: LoopEvidence | None = None
    nominal: Nominal | None = None
    perturbations: list[PerturbationEvidence] = Field(default_factory=list)

    def broken(self) -> Iterator[str]:
        """Yield the perturbations that the plan does not survive."""
        yield from (p.name for p in self.perturbations if p.margin <= 0)
        if self.nominal is None or not self.nominal.success:
            yield "an unperturbed run that is no success"

    def facts(self) -> dict[str, str]:
        """Return the margin of each perturbation."""
        return {p.name: f"survived up to {p.margin:g} {p.unit}" for p in self.perturbations}


class PredictiveControl(Fields):
    """MPC of the record's `problem` on `model`; its plan, and what that was made from, are in plan.npz."""

    model: ModelInput
    horizon: int
    iterations: int
    replan_every: int


class ClosedLoopSection(Fields):
    """A controller on the plant; what was measured, estimated, commanded and applied, and when, is in trace.mcap.

    `given` are the rows that a user's code made, or a clock decided: they are data, and nothing can make them again.
    """

    seed: int
    loop: LoopEvidence
    mpc: PredictiveControl | None = None
    given: list[Literal["observations", "estimates", "commands", "applied"]]
    ended: str
    failed_part: str
    controller_error: str

    def broken(self) -> Iterator[str]:
        """Yield the reasons why the run is not a success, apart from the metrics."""
        if self.ended:
            yield "a run that broke off"

    def facts(self) -> dict[str, str]:
        """Return the controller, and the duration of the run."""
        return {"controller": self.loop.controller, "steps": f"{self.loop.steps} of {self.loop.period_s:g} s"}


Section = PhasesSection | CertificationSection | RolloutSection | RobustnessSection | ClosedLoopSection
SECTIONS = ("phases", "certification", "rollout", "robustness", "closed_loop")


class PlanRecord(SealedRecord):
    """Everything that it takes to judge one solve; the motion is in plan.npz and trace.mcap.

    At most one of `phases`, `certification`, `rollout`, `robustness` and `closed_loop` is there: the record is then of
    that, and the fields of a solve are empty but for what it states itself.
    """

    KIND: ClassVar[str] = "plan"

    kind: Literal["plan"] = "plan"
    inputs: Inputs = Inputs()
    problem: FiniteTable = Field(default_factory=dict, description=units_of_keys(PROBLEM_UNITS))
    contract: FiniteTable = Field(default_factory=dict, description=units_of_keys(CONTRACT_UNITS))
    solver: Solver | None = None
    parameters: list[ParameterEvidence] = Field(default_factory=list)
    metrics: list[Metric] = Field(default_factory=list)
    invariants: list[Metric] = Field(default_factory=list)
    gradient: GradientEvidence | None = None
    events: list[Event] = Field(default_factory=list)
    replays: list[ReplayEvidence] = Field(default_factory=list)
    failures: list[Failure] = Field(default_factory=list)
    phases: PhasesSection | None = None
    certification: CertificationSection | None = None
    rollout: RolloutSection | None = None
    robustness: RobustnessSection | None = None
    closed_loop: ClosedLoopSection | None = None

    @property
    def section(self) -> Section | None:
        """The section that the record is about, or None for a solve in one phase."""
        return next((getattr(self, name) for name in SECTIONS if getattr(self, name) is not None), None)

    @property
    def subject(self) -> str:
        """The subject of the record: "plan", or the name of its section."""
        return next((name for name in SECTIONS if getattr(self, name) is not None), self.kind)

    @model_validator(mode="after")
    def _passes_only_what_holds(self) -> "PlanRecord":
        if self.verdict != "pass":
            return self
        broken = [m.name for m in (*self.metrics, *self.invariants) if m.verdict in ("fail", "undecided")]
        broken += [failure.code for failure in self.failures]
        if self.section is not None:
            broken += self.section.broken()
        if self.subject in ("plan", "phases") and (self.solver is None or self.solver.status != "converged"):
            broken.append(f"solver status {self.solver.status if self.solver else 'missing'}")
        if broken:
            raise ValueError(f'a verdict "pass" with {", ".join(broken)}')
        return self

    def as_row(self) -> dict[str, str]:
        """Return the record as a textbook's table row: section, tool, observation, action, metric, perturbation."""
        units = {c.name: c.unit for c in self.gradient.columns} if self.gradient else {}
        problem: dict[str, Any] = self.problem
        observed, commanded = (
            ", ".join(f"{name} [{units.get(name, '?')}]" for name in problem.get(key, []))
            for key in ("state_names", "input_names")
        )
        return {
            "section": "differentiable physics",
            "tool": f"drake {self.provenance.packages.get('drake', '?')}, {self.solver.method if self.solver else '-'}",
            "observation": observed,
            "action": commanded,
            "metric": "; ".join(f"{m.name} {m.value} {m.unit}" for m in self.metrics),
            "perturbation": "; ".join(dict.fromkeys(f"replayed {r.variant}" for r in self.replays)) or "none",
        }

    def facts(self) -> dict[str, str]:
        """Return the facts of the section, or the cost, and the solver and the failures."""
        cost = next((m.value for m in self.metrics if m.name == "cost"), None)
        facts = {"cost": "none" if cost is None else f"{cost:.6g}"} if self.section is None else self.section.facts()
        if self.solver is not None:
            facts["solver"] = f"{self.solver.method}, {self.solver.status}"
        if self.failures:
            facts["failures"] = "; ".join(f"{f.label}: {f.code}" for f in self.failures)
        return facts | super().facts()
