"""Does a plan survive: trials under each perturbation and level, how sure the rates are, and how far one can go."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from drake_diff.arrays import Array, positive_int
from drake_diff.exceptions import InputError
from drake_diff.loop.closed_loop import Loop
from drake_diff.loop.perturbation import PERTURBATIONS, perturbation_named
from drake_diff.loop.sensitivity import Sensitivity
from drake_diff.loop.statistics import Rate, margin, success_rate
from drake_diff.loop.trial import Label, MakeController, Task, Trial, run_trial
from drake_diff.solution import Solution

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
