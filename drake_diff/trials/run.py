"""Test the robustness of a plan: trials under each perturbation and level, success rates and their margins.

Gradients predict how far a small perturbation displaces the last state (`LoopSensitivity`). A comparison with the
measured displacement shows up to which level the first order is accurate.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from drake_diff._base.arrays import LARGEST_SEED, Array, count, positive_int
from drake_diff._base.differences import central_differences
from drake_diff._base.statistics import Rate, margin, success_rate
from drake_diff._base.values import ShowsItsRepr
from drake_diff.derivatives.step import derivatives_along
from drake_diff.exceptions import InputError
from drake_diff.loop.mpc import MPC
from drake_diff.loop.run import Hold, Loop
from drake_diff.model.parameters import applied, select
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.rollout import STEPS
from drake_diff.optimize.solution import Solution
from drake_diff.runs.fields import Label, evidence, finite
from drake_diff.runs.plan_record import CellEvidence, Nominal, PerturbationEvidence
from drake_diff.trials.perturbation import PERTURBATIONS, Levels, levels_named, parameters_of, perturbation_for
from drake_diff.trials.trial import MakeController, Task, Trial, run_trial

WORST = "worst"  # folder of the trials that are written in full
AGREE = 2.0  # a prediction within this factor of the measured value counts as correct
UNIFORM = 1 / np.sqrt(3)  # standard deviation of the uniform distribution in [-1, 1]
# Step of the central differences of the controller: about the cube root of rounding, which is optimal.
DIFFERENCE = 1e-5
FACTORS = ("inertia", "mass", "friction", "stiffness", "damping", "gravity")
PREDICTED = ("initial_state", "sensor_noise", "sensor_bias", "actuator_strength", *FACTORS)


def robustness(
    solution: Solution,
    perturbations: Levels | Sequence[str] | None = None,
    *,
    trials: int = 100,
    controller: str | MPC | MakeController = "tvlqr",
    loop: Loop | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> "Robustness":
    """Run the plan of a solution many times under each perturbation and level.

    A trial succeeds if it reaches the goal (without a goal, the end of the plan) and satisfies the bounds. A failure
    has a label for its cause. An error raised by the controller, sensor or estimator counts as a failure too.

    Args:
        solution: The solution whose motion and inputs are the plan.
        perturbations: Levels by name, or names to use default levels (listed in `PERTURBATIONS`). None means all
            perturbations that apply to the model.
        trials: The number of trials at each level.
        controller: "tvlqr" about the plan, "mpc" (over 20 steps), "open_loop", a custom `MPC`, or a function
            of (plan, model, xs (N+1, nx), us (N, nu)) that makes a controller u = controller(x, t).
        loop: Sensor, estimator, actuator and other parts of the loop in every trial, also in the unperturbed run.
        seed: Seed of all draws. The same seed gives the same trials.
        progress: Called with a line of text after each level.

    Returns:
        Success rates with their 95 % intervals, margins, labels of failures, and displacements of the last state.

    Raises:
        UnknownNameError: There is no such perturbation or controller.
        InputError: A level or another argument is invalid, or a function for `controller` makes no controller.

    Source: Wilson's interval, J. American Statistical Association 22 (1927).

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.02)
        >>> cost = dd.QuadraticCost(R=[[1.0]])
        >>> problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=cost)
        >>> result = dd.robustness(dd.solve(problem, method="shooting"), {"mass": [0.05]}, trials=5)
        >>> result.margins
        {'mass': 0.05}
    """
    trials, seed = positive_int("trials", trials), count("seed", seed, 0, LARGEST_SEED)
    if solution.problem.motion != STEPS:
        raise InputError("solution", got='motion="continuous"', expected='motion="steps", as trials consist of steps')
    task = Task(solution.plan, controller, loop)
    levels, sensitivity = levels_named(task.model, perturbations), LoopSensitivity(task)
    cells = []
    for name, values in levels.items():
        for level in values:
            outcomes = [run_trial(task, {name: level}, trial_seed(seed, k)) for k in range(trials)]
            cells.append(cell_of(name, level, outcomes, sensitivity.predicted(name, level)))
            if progress is not None:
                progress(f"{name} {level:g}: {cells[-1].rate.successes} of {trials}")
    return Robustness(task, tuple(cells), trials, seed)


class Ending(NamedTuple):
    """The result of a trial. `label` is None for a success, `reason` explains a failure, and `last` is (nx,)."""

    seed: int
    label: Label | None
    reason: str
    goal_error: float
    last: Array


@dataclass(frozen=True, eq=False)
class Cell:
    """The trials of one perturbation at one level. Displacements are root mean squares for the last state."""

    perturbation: str
    level: float
    rate: Rate
    labels: Mapping[str, int]  # of the failures
    controller_errors: Mapping[str, int]  # "Type: message" of the controller's errors, and their numbers of trials
    goal_error: float  # the median; inf if it is not finite
    worst_goal_error: float
    displacement: float | None  # measured; None if a run stopped early or the value is not finite
    predicted: float | None  # from gradients, to first order; None without a prediction
    worst: Trial
    endings: tuple[Ending, ...]

    @property
    def ratio(self) -> float | None:
        """The ratio of measured to predicted displacement. None if one is missing or the prediction is 0."""
        return self.displacement / self.predicted if self.displacement is not None and self.predicted else None

    @property
    def fails(self) -> bool:
        """Whether any trial fails."""
        return self.rate.successes < self.rate.trials

    def __repr__(self) -> str:
        level = sized(self.perturbation, self.level)
        labels = ", ".join(f"{count} {label}" for label, count in self.labels.items())
        sentence = f"{self.perturbation} {level}: {self.rate.successes} of {self.rate.trials} succeed"
        return f"{sentence}; {labels}" if labels else sentence


@dataclass(frozen=True, eq=False)
class Robustness(ShowsItsRepr):
    """The result of `robustness`: a cell for each perturbation and level, and the task with its unperturbed run.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.02)
        >>> cost = dd.QuadraticCost(R=[[1.0]])
        >>> problem = dd.Problem(model, x0=[0, 0], x_goal=[1, 0], num_steps=20, running_cost=cost)
        >>> dd.robustness(dd.solve(problem, method="shooting"), {"mass": [0.05]}, trials=5)
        pendulum under tvlqr, 5 trials at each level, seed 0: pass
          unperturbed: succeeds
          mass: 95 % survive up to 0.05 of 0.05
    """

    task: Task
    cells: tuple[Cell, ...]
    trials: int
    seed: int

    @property
    def success(self) -> bool:
        """Whether the unperturbed run succeeds and each perturbation has a margin above 0."""
        return self.task.nominal.success and all(value > 0 for value in self.margins.values())

    @property
    def names(self) -> tuple[str, ...]:
        """The names of the perturbations."""
        return tuple(dict.fromkeys(c.perturbation for c in self.cells))

    @property
    def margins(self) -> dict[str, float]:
        """The largest level up to which 95 % of the trials succeed, by perturbation."""
        return {name: margin([c.level for c in self.of(name)], [c.rate for c in self.of(name)]) for name in self.names}

    @property
    def weakest(self) -> str:
        """The perturbation with the smallest margin relative to its largest default level, then the lowest rate."""

        return weakest_of(self.perturbations).name

    def of(self, name: str) -> list[Cell]:
        """Return the cells of one perturbation, with increasing levels."""
        return [c for c in self.cells if c.perturbation == name]

    def worst(self, name: str) -> Cell:
        """Return the cell of the lowest level with a failure, or the cell with the trial furthest from the goal."""
        cells = self.of(name)
        return next((c for c in cells if c.fails), max(cells, key=lambda c: c.worst_goal_error))

    @cached_property
    def perturbations(self) -> tuple[PerturbationEvidence, ...]:
        """The perturbations in the format of a record."""
        return tuple(
            evidence(
                PerturbationEvidence,
                perturbation_for(name),
                margin=self.margins[name],
                cells=[_evidence_of(c) for c in self.of(name)],
                worst=folder_of(name, self.worst(name).level),
            )
            for name in self.names
        )

    @property
    def sentence(self) -> str:
        """A summary: the first failure, the causes of failures, and the accuracy of predictions by gradients."""
        nominal = evidence(Nominal, self.task.nominal, ended=self.task.nominal.run.ended)
        return sentence_of(nominal, self.perturbations, self.worst(self.weakest).worst.reason)

    def __repr__(self) -> str:
        name = self.task.controller_name
        verdict, nominal = "pass" if self.success else "fail", self.task.nominal
        lines = [
            f"{self.task.model.name} under {name}, {self.trials} trials at each level, seed {self.seed}: {verdict}",
            "  unperturbed: " + ("succeeds" if nominal.success else f"fails: {nominal.failures[0]}"),
        ]
        for name, value in self.margins.items():
            most = sized(name, self.of(name)[-1].level)
            lines.append(f"  {name}: 95 % survive up to {value:g} of {most}" if value else f"  {name}: no margin")
        return "\n".join(lines)

    def __str__(self) -> str:
        return self.sentence


def weakest_of(perturbations: Sequence[PerturbationEvidence]) -> PerturbationEvidence:
    """Return the perturbation of the smallest margin relative to its largest default level, then the lowest rate."""

    def rank(p: PerturbationEvidence) -> tuple[float, float]:
        return p.margin / perturbation_for(p.name).levels[-1], sum(c.rate for c in p.cells) / len(p.cells)

    return min(perturbations, key=rank)


def sentence_of(nominal: Nominal, perturbations: Sequence[PerturbationEvidence], reason: str) -> str:
    """Summarize failures, causes and predictions. `reason` belongs to the weakest perturbation's worst trial."""
    weakest, cells = weakest_of(perturbations), [c for p in perturbations for c in p.cells]
    labels = sum((Counter(c.labels) for c in cells), Counter[str]())
    known = [agrees(c.ratio) for c in cells if c.ratio is not None]
    sentences = ["Unperturbed it succeeds." if nominal.success else f"Unperturbed it fails: {nominal.failures[0]}."]
    if not labels:
        tried = len(perturbations)
        sentences += [f"No trial fails: each of {tried} perturbations is survived up to its largest level."]
    else:
        name, margin = weakest.name, weakest.margin
        cell = next(c for c in weakest.cells if folder_of(name, c.level) == weakest.worst)
        much = f"with a margin of {sized(name, margin)}" if margin else "with no margin"
        rate = f"at {sized(name, cell.level)} {cell.successes} of {cell.trials} succeed"
        causes = ", ".join(f"{count} {label.replace('_', ' ')}" for label, count in labels.most_common())
        sentences += [f"Weakest point: {name}, {much}: {rate}. What fails first: {reason}."]
        sentences += [f"Failed trials: {causes}."]
    if raised := sum((Counter(c.controller_errors) for c in cells), Counter[str]()):
        (error, most), total = raised.most_common(1)[0], sum(raised.values())
        sentences += [f"In {total} of them the controller itself failed, in {most} with {error}."]
    within = f"Gradients predict how far the last state moves within a factor of {AGREE:g} in"
    sentences += [
        f"{within} {sum(known)} of {len(known)} cells."
        if known
        else "Gradients predict no displacement of the last state."
    ]
    return " ".join(sentences)


def folder_of(name: str, level: float) -> str:
    """Return the folder of the worst trial of a perturbation at a level."""
    return f"{WORST}/{name}_{level:g}"


def _evidence_of(c: Cell) -> CellEvidence:
    return evidence(
        CellEvidence,
        c,
        successes=c.rate.successes,
        trials=c.rate.trials,
        rate=c.rate.value,
        lower_95=c.rate.lower,
        upper_95=c.rate.upper,
        distinct=len({e.last.tobytes() for e in c.endings}),
        labels=dict(c.labels),
        controller_errors=dict(c.controller_errors),
        goal_error_median=finite(c.goal_error),
        goal_error_worst=finite(c.worst_goal_error),
    )


def trial_seed(seed: int, index: int) -> int:
    """Return the seed of the `index`-th trial, equal in all cells so that levels are compared under the same draws."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1)[0])


def cell_of(name: str, level: float, trials: Sequence[Trial], predicted: float | None) -> Cell:
    """Summarize the `trials` of one perturbation and level."""

    def distance(trial: Trial) -> float:
        error = trial.outcome.goal_error
        return error if np.isfinite(error) else float("inf")

    endings = tuple(Ending(t.seed, t.label, t.reason, distance(t), t.outcome.run.motion.xs[-1]) for t in trials)
    errors = [ending.goal_error for ending in endings]
    squares = np.array([float(t.outcome.displacement @ t.outcome.displacement) for t in trials])
    known = bool(np.all(np.isfinite(squares))) and not any(t.outcome.run.ended for t in trials)
    raised = Counter(t.outcome.run.controller_error for t in trials if t.outcome.run.controller_error)
    return Cell(
        perturbation=name,
        level=level,
        rate=success_rate(sum(t.outcome.success for t in trials), len(trials)),
        labels=dict(sorted(Counter(t.label for t in trials if t.label is not None).items())),
        controller_errors=dict(sorted(raised.items())),
        goal_error=float(np.median(errors)),
        worst_goal_error=max(errors),
        displacement=float(np.sqrt(np.mean(squares))) if known else None,
        predicted=predicted,
        worst=max(trials, key=lambda t: (not t.outcome.success, distance(t))),
        endings=endings,
    )


def agrees(ratio: float | None) -> bool:
    """Return whether a measured displacement is within a factor of AGREE of the predicted displacement."""
    return ratio is not None and 1 / AGREE <= ratio <= AGREE


def sized(name: str, level: float) -> str:
    """Format a level with its unit."""
    return perturbation_for(name).with_unit(level)


class LoopSensitivity:
    """The displacement of the last state of a task's unperturbed run by perturbations, to first order.

    Let A_k, B_k, C_k be the derivatives of step k with respect to state, input and parameters on the tangent space, and
    K_k the derivative of the controller's output with respect to its measurement. The closed loop is displaced by

        d_(k+1) = (A_k + B_k K_k) d_k + C_k dp + B_k K_k n_k

    so the last displacement is linear in the first one d_0, a change dp of the parameters and the noise n_k. Its root
    mean square, sqrt(E |d_N|^2), is for the independent perturbations of `trials.perturbation`.

    The prediction is available only for an ideal loop. It is None with a delay, a lag, lost samples, another estimator,
    an active fallback, or a controller with memory (with `start`, as MPC), whose output also depends on the past.
    """

    def __init__(self, task: Task):
        self.task, self.space = task, tangent_space(task.model)
        loop = task.loop
        self.is_known = (
            loop.substeps == loop.sensor.every == loop.actuator.every == 1
            and loop.sensor.delay == loop.actuator.delay == loop.actuator.lag == loop.sensor.dropout == 0
            and type(loop.estimator) is Hold
            and not task.nominal.run.ended
            and not any(event.kind == "fallback" for event in task.nominal.run.events)
            and not hasattr(task.policy, "start")
        )
        self.parameters = {name: parameters_of(task.model, name) for name in FACTORS}

    def predicted(self, name: str, level: float) -> float | None:
        """Return the root mean square of the last state's displacement, or None without a prediction."""
        applies = name in PREDICTED and PERTURBATIONS[name].applies_to(self.task.model)
        effects = self._effects if applies and self.is_known else None
        if effects is None:
            return None
        displacement = float(level * np.linalg.norm(effects[name]))
        return displacement if np.isfinite(displacement) else None

    @cached_property
    def _effects(self) -> dict[str, Array] | None:
        """The last state's derivatives (nt, .) with respect to the draws of level 1, times their standard deviation."""
        gains = self._gains()
        if gains is None:
            return None
        task, size, xs = self.task, self.space.size, self.task.nominal.run.motion.xs
        # The inertia is a separate group, because a mass parameter scales the inertia unless both are set together.
        inertia, others = list(self.parameters["inertia"]), [n for q in FACTORS[1:] for n in self.parameters[q]]
        groups = [inertia, others] if inertia else [others]
        us, along = task.nominal.run.applied, []
        with applied(select(task.setup.model, task.setup.parameters)) as model:
            for group in groups:
                vector = select(model, group)
                with applied(vector) as same:
                    along.append(derivatives_along(same, xs[0], us, vector=vector, xs=xs[:-1]))
        start, noise, factor = np.eye(size), np.zeros((size, 0)), np.zeros((size, task.model.nu))
        by_parameter = np.zeros((size, sum(derivatives[0].C.shape[1] for derivatives in along)))
        for k, (u, K) in enumerate(zip(us, gains, strict=True)):
            steps = [derivatives[k] for derivatives in along]
            jacobian = self.space.jacobian(xs[k], xs[k + 1], steps[0].A, steps[0].B, *(step.C for step in steps))
            A, B, C = np.split(jacobian, [size, size + task.model.nu], axis=1)
            loop = A + B @ K
            start, noise = loop @ start, np.hstack([loop @ noise, B @ K])
            factor, by_parameter = loop @ factor + B * u, loop @ by_parameter + C
        bias = noise.reshape(size, -1, size).sum(axis=1)  # the same at every step
        effects = {"initial_state": start, "sensor_noise": noise}
        effects |= {"sensor_bias": UNIFORM * bias, "actuator_strength": UNIFORM * factor}
        offset = 0
        for quantity, parameters in self.parameters.items():
            columns = []
            for value in map(np.atleast_1d, parameters.values()):
                columns.append(by_parameter[:, offset : offset + len(value)] @ value)
                offset += len(value)
            effects[quantity] = UNIFORM * np.array(columns).T
        return effects

    def _gains(self) -> list[Array] | None:
        """Return N derivatives (nu, nt) of the controller's output with respect to its measurement, by differences.

        The result is None if the controller raises an error near the motion, so that it has no derivative.
        """
        task, gains = self.task, []
        for k, x in enumerate(task.nominal.run.motion.xs[:-1]):

            def commanded(d: Array, x: Array = x, t: float = k * task.model.time_step) -> Array:
                return np.asarray(task.policy(self.space.plus(x, d), t), dtype=float).reshape(task.model.nu)

            try:
                gains.append(central_differences(commanded, self.space.size, DIFFERENCE))
            except Exception:
                return None
        return gains
