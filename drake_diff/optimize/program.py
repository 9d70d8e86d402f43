"""What is common to all solves: limits, progress, interrupts, the motion of an iterate, the best one, how they end."""

import enum
import math
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.clock import now
from drake_diff.model.contact import ContactPoint, contacts_of_the_step
from drake_diff.model.parameters import ParameterVector, applied
from drake_diff.model.step import advance
from drake_diff.motion.rollout import STEPS
from drake_diff.optimize.problem.problem import Problem

FEASIBILITY_TOLERANCE = 1e-5  # defect, goal and bounds, of the scale of the state, input or constraint itself
FAR_FROM_ONE = 1e4  # a scale or one over it: what a solver's own tolerances do not allow for


def are_far_from_one(scales: Array) -> bool:
    """Whether the numbers of a program have to be divided by its scales."""
    return bool(np.max(scales) > FAR_FROM_ONE or np.min(scales) < 1 / FAR_FROM_ONE)


class Scales(NamedTuple):
    """What the numbers of a program are divided by, so that they do not depend on units.

    Of its variables (n,), in iLQR of a knot's (nx + nu,), its rows (m,) and its cost; without them nothing is divided.
    """

    variables: Any = 1.0
    rows: Any = 1.0
    cost: float = 1.0


UNSCALED = Scales()
REPORT_PERIOD = 0.2  # [s] between two progress reports: each costs an evaluation of every constraint


@dataclass(frozen=True, eq=False, repr=False)
class Iterate:
    """One motion of a search, with copies of its own: nothing that the solver does later changes it.

    Attributes:
        problem: what is solved; a stage of a continuation has a problem of its own.
        times: (N+1,) [s].
        xs: (N+1, nx) the states. Where the search has gaps still to close, from x_k under u_k the plant gets elsewhere.
        us: (N, nu) the inputs; those of collocation are at the knots before the last.
        vector: the parameters, as they are at this iterate.
        by_steps: whether the search goes through the plant's own steps; collocation does not.
    """

    problem: Problem
    times: Array
    xs: Array
    us: Array
    vector: ParameterVector
    by_steps: bool

    def __repr__(self) -> str:
        return f"Iterate of {self.problem.name}: {len(self.us)} steps in {self.times[-1]:g} s"

    @cached_property
    def contacts(self) -> tuple[tuple[ContactPoint, ...], ...] | None:
        """The contacts of each of the N steps from x_k under u_k, computed when they are first asked for.

        Collocation has no contact: N times none. None where the motion is in continuous time, in which contact comes
        and goes within an interval. Raises SimulationError where the plant cannot take a step.
        """
        if self.problem.motion != STEPS:
            return None
        return tuple(self.contacts_in(range(len(self.us))))

    def contacts_in(self, steps: Iterable[int]) -> list[tuple[ContactPoint, ...]]:
        """Those of some of the N steps, of a motion by steps."""
        touches = self.problem.has_model and self.problem.model.contract.contact.collision_pairs
        if not (self.by_steps and touches):
            return [() for _ in steps]
        contacts = []
        with applied(self.vector) as model:
            for k in steps:
                advance(model.double, self.xs[k], self.us[k])
                contacts.append(contacts_of_the_step(model))
        return contacts


@dataclass(frozen=True, slots=True)
class Iteration:
    """One row of the solver's own table; NaN where it prints no such number.

    What a callback gets has the motion at which the solver stands too. The arrays are copies that may be kept.
    Everything of it is None where the motion cannot be simulated, in `Solution.iterations`, and of a PhasedProblem,
    which has one for each phase in `motions`.

    Attributes:
        iteration, objective, primal_infeasibility, dual_infeasibility, step: the solver's row.
        motions: an `Iterate` for each phase; one where there are no phases.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> effort = dd.QuadraticCost(R=[[1.0]])
        >>> problem = dd.Problem(model, x0=[0, 0], x_goal=[0.5, 0], num_steps=20, running_cost=effort)
        >>> ends = []
        >>> solution = dd.solve(problem, method="ilqr", callback=lambda row: ends.append(row.xs[-1]))
        >>> bool(np.allclose(ends[-1], [0.5, 0], atol=1e-6))
        True
    """

    iteration: int
    objective: float
    primal_infeasibility: float
    dual_infeasibility: float
    step: float
    motions: tuple[Iterate, ...] = field(default=(), compare=False, repr=False, kw_only=True)

    @property
    def times(self) -> Array | None:
        """(N+1,) [s]"""
        return self.motions[0].times if len(self.motions) == 1 else None

    @property
    def xs(self) -> Array | None:
        """(N+1, nx), in the states' units; see `Iterate`."""
        return self.motions[0].xs if len(self.motions) == 1 else None

    @property
    def us(self) -> Array | None:
        """(N, nu), in the inputs' units; see `Iterate`."""
        return self.motions[0].us if len(self.motions) == 1 else None

    @property
    def contacts(self) -> tuple[tuple[ContactPoint, ...], ...] | None:
        """N tuples: the contacts of each step, computed when they are first asked for; see `Iterate.contacts`."""
        return self.motions[0].contacts if len(self.motions) == 1 else None

    def __str__(self) -> str:
        columns = [f"iteration {self.iteration:5d}", f"cost {self.objective:12.6g}"]
        columns.append(f"violation {self.primal_infeasibility:9.2e}")
        if not math.isnan(self.dual_infeasibility):
            columns.append(f"gradient {self.dual_infeasibility:9.2e}")
        if not math.isnan(self.step):
            columns.append(f"step {self.step:.3g}")
        return "  ".join(columns)


class Report:
    """Where the progress of a solve goes: a `line` for people, an Iteration for `callback`, and for `plan` what a
    search came to, before it is measured.
    """

    def __init__(
        self,
        line: Callable[[str], None] | None = None,
        callback: Callable[[Iteration], None] | None = None,
        plan: Callable[[Any], None] | None = None,
        looks: Callable[[], bool] = lambda: True,
    ):
        self.line, self.callback, self.plan = line, callback, plan
        self.looks = looks  # whether the callback looks at the motions of a row
        self.asked: Any = None  # the `Search` that is reported on

    def found(self, plan: Any) -> None:
        """Hand on a solution that is not measured yet."""
        if self.plan is not None:
            self.plan(replace(plan, search=self.asked))

    def row(self, row: Iteration, motions: Callable[[], tuple[Iterate, ...]], *, printed: bool = True) -> None:
        """Hand on `row` with its `motions`, which are made only where somebody gets them, and print it."""
        if self.callback is not None:
            self.callback(replace(row, motions=motions()) if self.looks() else row)
        if printed:
            self.say(str(row))

    def say(self, text: str) -> None:
        """Print a line of progress."""
        if self.line is not None:
            self.line(text)


class Outcome(enum.Enum):
    """How the solver says it ended."""

    SOLVED = "solved"
    ITERATION_LIMIT = "iteration limit"
    TIME_LIMIT = "time limit"
    INFEASIBLE = "infeasible"
    UNBOUNDED = "unbounded"
    INTERRUPTED = "interrupted"
    INACCURATE = "inaccurate"
    DIVERGED = "the simulation failed"
    NO_GRADIENT = "a derivative was refused"
    FAILED = "failed"


@dataclass(frozen=True)
class Limits:
    """When to stop: iterations, seconds, and the tolerance on feasibility and optimality."""

    max_iterations: int
    time_limit: float
    tolerance: float


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Those of a program's variables (n,), positive on an upper bound and negative on a lower one, and rows (m,)."""

    variables: Array
    rows: Array

    @property
    def sizes(self) -> tuple[int, int]:
        """(n, m)"""
        return len(self.variables), len(self.rows)


@dataclass(frozen=True, eq=False)
class NlpResult:
    """The final, or the best, values of the decision variables (n,), how they were reached, and a claim's limits."""

    z: Array
    outcome: Outcome
    message: str
    iterations: tuple[Iteration, ...]
    note: str = ""  # what a claim of a minimum is limited to, if it is
    # What multipliers of rows that hold leave of the Lagrangian's gradient, over its largest term; NaN if not known.
    parameters: Array | None = None  # (np,) of iLQR: those of discrete steps that it found
    stationarity: float = math.nan
    multipliers: Multipliers | None = None  # where the solver has them
    refusal: str = ""  # why a point could not be evaluated, the last one


def heard(result: NlpResult, interrupted: threading.Event) -> NlpResult:
    """A result that says that it was interrupted where a signal came when the search had just ended, too."""
    if not interrupted.is_set() or result.outcome is Outcome.INTERRUPTED:
        return result
    return replace(result, outcome=Outcome.INTERRUPTED, message=f"{result.message}; then interrupted")


class Watch:
    """What is kept of a solve while it runs: the best iterate, and whether a signal or the clock ends it."""

    def __init__(self, limits: Limits, interrupted: threading.Event):
        self.limits, self.interrupted = limits, interrupted
        self.start = self.last_report = now()
        self.best: Array | None = None
        self.best_merit = math.inf
        self.stopped_by: Outcome | None = None

    @property
    def elapsed(self) -> float:
        """[s] since the start."""
        return now() - self.start

    def look_up(self) -> bool:
        """Note what ends the solve, if anything does; whether a report is due."""
        moment = now()
        if self.interrupted.is_set():
            self.stopped_by = Outcome.INTERRUPTED
        elif moment - self.start > self.limits.time_limit:
            self.stopped_by = Outcome.TIME_LIMIT
        due = moment - self.last_report > REPORT_PERIOD or self.stopped_by is not None
        self.last_report = moment if due else self.last_report
        return due

    def offer(self, z: Array, cost: float, violation: float) -> None:
        """Keep a copy of `z` (n,) if it is the best so far by cost + 1e6 * (violation beyond the tolerance)."""
        merit = cost + 1e6 * max(0.0, violation - self.limits.tolerance)
        if self.best is None or merit < self.best_merit:
            self.best, self.best_merit = np.array(z), merit

    def best_of(self, guess: Array) -> Array:
        """The best iterate, the guess where there was none."""
        return guess if self.best is None else self.best
