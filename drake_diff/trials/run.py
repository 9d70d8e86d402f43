"""Does a plan survive: trials under each perturbation and level, how sure the rates are, and how far one can go.

Before anything is tried, gradients predict how far a small perturbation displaces the last state (`LoopSensitivity`);
beside the measured displacement that shows how far first order reaches.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from drake_diff._base.arrays import LARGEST_SEED, Array, count, positive_int
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

WORST = "worst"  # the folder of the trials that are written in full
AGREE = 2.0  # a prediction within this factor of what is measured counts as right
UNIFORM = 1 / np.sqrt(3)  # the standard deviation of a number that is uniform in [-1, 1]
# Step of the central differences of the controller's answer: about the cube root of rounding, which is best for them.
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
    """Try the plan of a solution many times under each perturbation and level.

    A trial succeeds where it reaches the goal (without one, the plan's end) and keeps the bounds. A failure has a
    label that says whose fault it is. A controller, sensor or estimator that raises is such a failure too.

    Args:
        solution: its motion and inputs are the plan.
        perturbations: levels by name, or names, for their usual levels (`PERTURBATIONS` lists them). None means all
            that apply to the model.
        trials: how many at each level.
        controller: "tvlqr" about the plan, "mpc" (over 20 steps), "open_loop", an `MPC` of your own, or a function
            of (plan, model, xs (N+1, nx), us (N, nu)) that makes a controller u = controller(x, t).
        loop: what stands around the controller in every trial, the unperturbed run included.
        seed: of all draws. The same seed gives the same trials.
        progress: called with a line of text after each level.

    Returns:
        Success rates with their 95 % intervals, margins, labels of failures, and displacements of the last state.

    Raises:
        UnknownNameError: no such perturbation or controller.
        InputError: a level or another argument is wrong, or a function for `controller` makes none.

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
        raise InputError("solution", got='one with motion="continuous"', expected='motion="steps": trials are stepped')
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
    """What remains of each trial; `label` is None for a success, `reason` says why it failed, `last` is (nx,)."""

    seed: int
    label: Label | None
    reason: str
    goal_error: float
    last: Array


@dataclass(frozen=True, eq=False)
class Cell:
    """The trials of one perturbation at one level. Displacements are root mean squares of the last state's."""

    perturbation: str
    level: float
    rate: Rate
    labels: Mapping[str, int]  # of the failures
    controller_errors: Mapping[str, int]  # "Type: message" of what the controller raised, and in how many trials
    goal_error: float  # the median; inf where it is not finite
    worst_goal_error: float
    displacement: float | None  # measured; None where a run broke off or it is not finite
    predicted: float | None  # from gradients, to first order; None where they say nothing
    worst: Trial
    endings: tuple[Ending, ...]

    @property
    def ratio(self) -> float | None:
        """Measured displacement over predicted; None without one of them, or where none is predicted."""
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
    """What `robustness` found: a cell for each perturbation and level, and the task with its unperturbed run.

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
        """Whether the unperturbed run succeeds, and each perturbation has a level above 0 that is survived."""
        return self.task.nominal.success and all(value > 0 for value in self.margins.values())

    @property
    def names(self) -> tuple[str, ...]:
        """The perturbations that were tried."""
        return tuple(dict.fromkeys(c.perturbation for c in self.cells))

    @property
    def margins(self) -> dict[str, float]:
        """By perturbation, the largest level up to which 95 % of the trials succeed."""
        return {name: margin([c.level for c in self.of(name)], [c.rate for c in self.of(name)]) for name in self.names}

    @property
    def weakest(self) -> str:
        """The perturbation with the smallest margin, as a part of its largest usual level; of equals, the one that the
        fewest trials survive.
        """

        return weakest_of(self.perturbations).name

    def of(self, name: str) -> list[Cell]:
        """The cells of one perturbation, with increasing levels."""
        return [c for c in self.cells if c.perturbation == name]

    def worst(self, name: str) -> Cell:
        """The cell whose worst trial is shown: the lowest level that fails; without one, the furthest from the goal."""
        cells = self.of(name)
        return next((c for c in cells if c.fails), max(cells, key=lambda c: c.worst_goal_error))

    @cached_property
    def perturbations(self) -> tuple[PerturbationEvidence, ...]:
        """The perturbations as a record has them."""
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
        """The verdict in a paragraph: what fails first, whose fault it is, and what the gradients knew."""
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
    """That with the smallest margin, as a part of its largest usual level; of equals, which fewest trials survive."""

    def rank(p: PerturbationEvidence) -> tuple[float, float]:
        return p.margin / perturbation_for(p.name).levels[-1], sum(c.rate for c in p.cells) / len(p.cells)

    return min(perturbations, key=rank)


def sentence_of(nominal: Nominal, perturbations: Sequence[PerturbationEvidence], reason: str) -> str:
    """What fails first, whose fault it is, and what the gradients knew; `reason` is of the weakest's worst trial."""
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
    """Where the worst trial of a perturbation is written, at the level that its cell has."""
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
    """Of the `index`-th trial: the same in every cell, so that levels are compared under the same draws."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1)[0])


def cell_of(name: str, level: float, trials: Sequence[Trial], predicted: float | None) -> Cell:
    """What `trials` of one perturbation and level amount to."""

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
    """Whether a measured displacement is within a factor of AGREE of the predicted one."""
    return ratio is not None and 1 / AGREE <= ratio <= AGREE


def sized(name: str, level: float) -> str:
    """A level with its unit."""
    return perturbation_for(name).with_unit(level)


class LoopSensitivity:
    """How far perturbations displace the last state of a task's unperturbed run, to first order.

    Along that run, with A_k, B_k, C_k the derivatives of step k by state, input and parameters on the tangent space
    and K_k that of the controller's answer by what it sees, the closed loop moves by

        d_(k+1) = (A_k + B_k K_k) d_k + C_k dp + B_k K_k n_k

    so the last displacement is linear in the first one d_0, a change dp of the parameters and the noise n_k. Its root
    mean square, sqrt(E |d_N|^2), is for independent perturbations as `trials.perturbation` draws them.

    Known only in an ideal loop: None with a delay, a lag, lost samples, another estimator, a fallback in charge, or a
    controller with a memory (one with `start`, as MPC), whose answer is no function of what it sees.
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
        """The root mean square of the last state's displacement; None where gradients say nothing."""
        applies = name in PREDICTED and PERTURBATIONS[name].applies_to(self.task.model)
        effects = self._effects if applies and self.is_known else None
        if effects is None:
            return None
        displacement = float(level * np.linalg.norm(effects[name]))
        return displacement if np.isfinite(displacement) else None

    @cached_property
    def _effects(self) -> dict[str, Array] | None:
        """(nt, .) the last state's derivative by what a perturbation of level 1 draws, times its spread."""
        gains = self._gains()
        if gains is None:
            return None
        task, size, xs = self.task, self.space.size, self.task.nominal.run.motion.xs
        # The inertia by itself: a mass that is changed alone takes it along, one that is set beside it does not.
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
        """N times (nu, nt), the derivative of the controller's answer by what it sees, by central differences.

        None where it raises beside the motion, as a user's code may: then it has no derivative.
        """
        task, gains = self.task, []
        for k, x in enumerate(task.nominal.run.motion.xs[:-1]):
            columns = []
            for e in DIFFERENCE * np.eye(self.space.size):
                try:
                    ahead, behind = (task.policy(self.space.plus(x, d), k * task.model.time_step) for d in (e, -e))
                except Exception:
                    return None
                columns.append((np.asarray(ahead, dtype=float) - np.asarray(behind, dtype=float)) / (2 * DIFFERENCE))
            gains.append(np.array(columns).T.reshape(task.model.nu, self.space.size))
        return gains
