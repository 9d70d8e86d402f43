"""How far perturbations displace the last state to first order: what the gradients say before anything is tried.

Along the unperturbed motion, with A_k, B_k, C_k the derivatives of step k by state, input and parameters on the tangent
space and K_k that of the controller's answer by what it sees (u = -K_k x), the closed loop moves by

    d_(k+1) = (A_k - B_k K_k) d_k + C_k dp + B_k K_k (-n_k)

so a displacement d_0, a change dp and a noise n_k lead to a last displacement that is linear in each. What is told is
its root mean square: sqrt(E |d_N|^2) of independent perturbations as `loop.perturbation` draws them.

Does a plan survive: trials under each perturbation and level, how sure the rates are, and how far one can go.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_diff._base.arrays import Array, positive_int
from drake_diff._base.statistics import Rate, margin, success_rate
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.exceptions import InputError
from drake_diff.loop.parts import Hold
from drake_diff.loop.run import Loop
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, select
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.gradient import derivatives_along
from drake_diff.optimize.solution import Solution
from drake_diff.trials.perturbation import PERTURBATIONS, parameters_of, perturbation_named
from drake_diff.trials.trial import Label, MakeController, Task, Trial, run_trial

UNIFORM = 1 / np.sqrt(3)  # the standard deviation of U of level 1
DIFFERENCE = (
    1e-5  # of the controller's answer by what it sees: about the cube root of rounding, central differences' best
)
FACTORS = ("inertia", "mass", "friction", "stiffness", "damping", "gravity")
TOLD = ("initial_state", "sensor_noise", "sensor_bias", "actuator_strength", *FACTORS)


class Sensitivity:
    """The first-order effect of perturbations on the last state of a task's unperturbed run.

    Only of runs in an ideal loop: with a delay, a lag, lost samples, another estimator or a fallback in charge
    `predicted` is None.
    """

    def __init__(self, task: Task):
        self.task, self.space = task, tangent_space(task.model)
        loop = task.loop
        self.is_known = (
            loop.substeps == 1
            and loop.sensor.delay == loop.actuator.delay == 0
            and loop.sensor.every == loop.actuator.every == 1
            and loop.actuator.lag == 0
            and loop.sensor.dropout == 0
            and type(loop.estimator) is Hold
            and not task.nominal.run.ended
            and not any(event.kind == "fallback" for event in task.nominal.run.events)
        )
        self.parameters = {name: parameters_of(task.model, name) for name in FACTORS}
        self._products: tuple[Array, Array, Array, Array] | None = None

    def predicted(self, name: str, level: float) -> float | None:
        """The root mean square of the last state's displacement; None where no gradient tells."""
        if not self.is_known or name not in TOLD or not PERTURBATIONS[name].is_of(self.task.model):
            return None
        found = float(level * np.linalg.norm(self._effect(name)))
        return found if np.isfinite(found) else None

    def _effect(self, name: str) -> Array:
        """(nt, .) the last state's derivative by what a perturbation of level 1 draws, times its spread."""
        start, _, noise, factor = self._effects()
        if name == "initial_state":
            return start
        if name == "sensor_noise":
            return noise
        if name == "sensor_bias":  # the same at every step
            return np.asarray(UNIFORM * noise.reshape(self.space.size, -1, self.space.size).sum(axis=1))
        return np.asarray(UNIFORM * (factor if name == "actuator_strength" else self._by_factor(name)))

    def _by_factor(self, quantity: str) -> Array:
        """(nt, n) the derivative by a factor of each parameter of a quantity."""
        columns, at = [], 0
        for name in FACTORS:
            for value in self.parameters[name].values():
                width = len(np.atleast_1d(value))
                if name == quantity:
                    columns.append(self._effects()[1][:, at : at + width] @ np.atleast_1d(value))
                at += width
        return np.array(columns).T

    def _effects(self) -> tuple[Array, Array, Array, Array]:
        """(nt, .) of the start, the parameters, every step's noise, and a factor of each input."""
        if self._products is None:
            self._products = self._along()
        return self._products

    def _along(self) -> tuple[Array, Array, Array, Array]:
        task, size = self.task, self.space.size
        run, h = task.nominal.run, task.model.time_step
        xs, us = run.motion.xs, run.applied
        start, noise, factor = np.eye(size), np.zeros((size, 0)), np.zeros((size, task.model.nu))
        by_parameter: Array | None = None
        # The inertia apart: a mass that is changed alone takes it along, one that is set beside it does not.
        inertia, others = list(self.parameters["inertia"]), [n for q in FACTORS[1:] for n in self.parameters[q]]
        groups = [inertia, others] if inertia else [others]
        with applied(select(task.setup.model, task.setup.parameters)) as model:
            along = [_along(model, xs[:-1], us, names) for names in groups]
        for k, u in enumerate(us):
            steps = [found[k] for found in along]
            found = self.space.jacobian(xs[k], xs[k + 1], steps[0].A, steps[0].B, *(step.C for step in steps))
            A, B, C = np.split(found, [size, size + task.model.nu], axis=1)
            K = self._gain(xs[k], k * h)
            loop = A + B @ K
            start, noise = loop @ start, np.hstack([loop @ noise, B @ K])
            factor = loop @ factor + B * u
            by_parameter = C if by_parameter is None else loop @ by_parameter + C
        return start, np.zeros((size, 0)) if by_parameter is None else by_parameter, noise, factor

    def _gain(self, x: Array, t: float) -> Array:
        """(nu, nt) the derivative of the controller's answer by what it sees, by central differences."""
        columns = []
        for e in DIFFERENCE * np.eye(self.space.size):
            ahead, behind = (np.asarray(self.task.policy(self.space.plus(x, d), t), dtype=float) for d in (e, -e))
            columns.append((ahead - behind) / (2 * DIFFERENCE))
        return np.array(columns).T.reshape(self.task.model.nu, self.space.size)


def _along(model: Model, xs: Array, us: Array, names: list[str]) -> list[StepDerivatives]:
    """The derivatives, by the parameters `names` too, of the steps from each of xs (N, nx) under us (N, nu)."""
    vector = select(model, names)
    with applied(vector) as set_model:
        return derivatives_along(set_model, xs[0], us, vector=vector, xs=xs)


Levels = Mapping[str, Sequence[float]]


class Ending(NamedTuple):
    """What remains of each trial; `label` is None for a success, `last` (nx,) its last state."""

    seed: int
    label: Label | None
    goal_error: float
    last: Array


@dataclass(frozen=True, eq=False)
class Cell:
    """The trials of one perturbation at one level. Displacements are root mean squares of the last state's."""

    perturbation: str
    level: float
    rate: Rate
    labels: Mapping[str, int]  # of the failures
    goal_error: float  # the median; inf where it is not finite
    worst_goal_error: float
    displacement: float | None  # measured; None where a run broke off or it is not finite
    predicted: float | None  # from gradients, to first order; None where they do not tell
    worst: Trial
    endings: tuple[Ending, ...]

    @property
    def ratio(self) -> float | None:
        """Measured displacement over predicted; None without one of them, or where none is predicted."""
        return self.displacement / self.predicted if self.displacement is not None and self.predicted else None


@dataclass(frozen=True, eq=False)
class Robustness:
    """All cells of a plan, and its unperturbed run."""

    task: Task
    cells: tuple[Cell, ...]
    trials: int
    seed: int

    @property
    def margins(self) -> dict[str, float]:
        """By perturbation the largest level up to which 95 % of the trials succeed."""
        return {name: margin([c.level for c in self.of(name)], [c.rate for c in self.of(name)]) for name in self.names}

    @property
    def success(self) -> bool:
        """Whether the unperturbed run succeeds, and each perturbation has a level above 0 that is survived."""
        return self.task.nominal.success and all(value > 0 for value in self.margins.values())

    @property
    def names(self) -> tuple[str, ...]:
        """The perturbations that were tried."""
        return tuple(dict.fromkeys(c.perturbation for c in self.cells))

    def of(self, name: str) -> list[Cell]:
        """The cells of one perturbation, its levels increasing."""
        return [c for c in self.cells if c.perturbation == name]

    def worst(self, name: str) -> Cell:
        """The cell whose worst trial is shown: the lowest level that fails, the furthest from the goal without one."""
        cells = self.of(name)
        failing = [c for c in cells if c.rate.successes < c.rate.trials]
        return failing[0] if failing else max(cells, key=lambda c: c.worst_goal_error)

    def __str__(self) -> str:
        nominal = "succeeds" if self.task.nominal.success else f"fails: {self.task.nominal.failures[0]}"
        margins = ", ".join(f"{name} {value:g}" for name, value in self.margins.items())
        return f"unperturbed it {nominal}; 95 % survive up to: {margins}"


def robustness(
    solution: Solution,
    perturbations: Levels | Sequence[str] | None = None,
    *,
    trials: int = 100,
    controller: str | MakeController = "tvlqr",
    loop: Loop | None = None,
    seed: int = 0,
    progress: Callable[[str], None] | None = None,
) -> Robustness:
    """Try the plan of `solution` `trials` times under each perturbation and level.

    `perturbations` maps names to levels, or names them with their usual levels; all that the model has something for
    where left out. `controller` is "tvlqr" about the plan, "open_loop", or a function that makes one (see `Task`);
    `loop` is what is around it in every trial, unperturbed ones too. The same seed gives the same trials.
    """
    count, task = positive_int("trials", trials), Task(solution.plan, controller, loop)
    levels, sensitivity = levels_of(task, perturbations), Sensitivity(task)
    cells = []
    for name, values in levels.items():
        for level in values:
            found = [run_trial(task, {name: level}, trial_seed(seed, k)) for k in range(count)]
            cells.append(cell_of(name, level, found, sensitivity.predicted(name, level)))
            if progress is not None:
                progress(f"{name} {level:g}: {cells[-1].rate.successes} of {count}")
    return Robustness(task, tuple(cells), count, seed)


def trial_seed(seed: int, index: int) -> int:
    """Of the `index`-th trial: the same in every cell, so that levels are compared under the same draws."""
    return int(np.random.SeedSequence([seed, index]).generate_state(1)[0])


def levels_of(task: Task, perturbations: Levels | Sequence[str] | None) -> dict[str, tuple[float, ...]]:
    """By name the levels to be tried, in increasing order. UnknownNameError; InputError for what cannot be tried."""
    if perturbations is None:
        return {name: kind.levels for name, kind in PERTURBATIONS.items() if kind.is_of(task.model)}
    if not isinstance(perturbations, Mapping):
        perturbations = {name: perturbation_named(name).levels for name in perturbations}
    for name, values in perturbations.items():
        if not perturbation_named(name).is_of(task.model):
            raise InputError("perturbation", got=name, expected=f"one that {task.model.name} has something for")
        if not len(values) or not all(np.isfinite(v) and v > 0 for v in values):
            raise InputError(f"levels of {name}", got=values, expected="numbers above 0")
    return {name: tuple(sorted(values)) for name, values in perturbations.items()}


def cell_of(name: str, level: float, trials: Sequence[Trial], predicted: float | None) -> Cell:
    """What `trials` of one perturbation and level amount to."""
    endings = tuple(Ending(t.seed, t.label, _distance(t), t.outcome.run.motion.xs[-1]) for t in trials)
    errors = [ending.goal_error for ending in endings]
    squares = np.array([float(t.outcome.displacement @ t.outcome.displacement) for t in trials])
    known = bool(np.all(np.isfinite(squares))) and not any(t.outcome.run.ended for t in trials)
    return Cell(
        perturbation=name,
        level=level,
        rate=success_rate(sum(t.outcome.success for t in trials), len(trials)),
        labels=dict(sorted(Counter(t.label for t in trials if t.label is not None).items())),
        goal_error=float(np.median(errors)),
        worst_goal_error=max(errors),
        displacement=float(np.sqrt(np.mean(squares))) if known else None,
        predicted=predicted,
        worst=max(trials, key=lambda t: (not t.outcome.success, _distance(t))),
        endings=endings,
    )


def _distance(trial: Trial) -> float:
    found = trial.outcome.goal_error
    return found if np.isfinite(found) else float("inf")
