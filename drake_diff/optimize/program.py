"""Common parts of all solvers: limits, progress, interrupts, iterates and outcomes."""

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

FEASIBILITY_TOLERANCE = 1e-5  # of defects, goals and bounds, relative to the scale of the state, input or constraint
FAR_FROM_ONE = 1e4  # a solver's own tolerances do not suit scales above this number or below its inverse


def are_far_from_one(scales: Array) -> bool:
    """Return whether the scales of a program are so extreme that its numbers have to be divided by them."""
    return bool(np.max(scales) > FAR_FROM_ONE or np.min(scales) < 1 / FAR_FROM_ONE)


class Scales(NamedTuple):
    """The numbers that a program is divided by, so that it does not depend on units.

    They apply to variables (n,) (in iLQR to those of a knot, (nx + nu,)), to rows (m,) and to the cost. Default: 1.
    """

    variables: Any = 1.0
    rows: Any = 1.0
    cost: float = 1.0


UNSCALED = Scales()
REPORT_PERIOD = 0.2  # [s] between two progress reports: each costs an evaluation of every constraint


@dataclass(frozen=True, eq=False, repr=False)
class Iterate:
    """One motion of a search, as a copy that the solver does not change later.

    Attributes:
        problem: the problem that is solved; a stage of a continuation has its own problem.
        times: (N+1,) [s].
        xs: (N+1, nx) the states. While the search has open gaps, the step from x_k under u_k need not end in x_(k+1).
        us: (N, nu) the inputs; collocation has them at all knots except the last.
        vector: the parameters at this iterate.
        by_steps: whether the search uses the plant's own steps; collocation does not.
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
        """The contacts of each of the N steps from x_k under u_k, computed on first access.

        Collocation has no contact, so that all N tuples are empty. The value is None for a motion in continuous time,
        because its contacts change within an interval. Raises SimulationError if the plant cannot take a step.
        """
        if self.problem.motion != STEPS:
            return None
        return tuple(self.contacts_in(range(len(self.us))))

    def contacts_in(self, steps: Iterable[int]) -> list[tuple[ContactPoint, ...]]:
        """Compute the contacts of some of the N steps of a discrete motion."""
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
    """One row of the solver's own table, with NaN for numbers that the solver does not print.

    A row in a callback also has the solver's current motion, in arrays that the callback may store. The motion's
    attributes are None if it cannot be simulated, in `Solution.iterations`, and for a PhasedProblem, which has one
    motion for each phase in `motions`.

    Attributes:
        iteration, objective, primal_infeasibility, dual_infeasibility, step: the solver's row.
        motions: an `Iterate` for each phase; a single one if the problem has no phases.

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
        """(N+1,) the times [s]."""
        return self.motions[0].times if len(self.motions) == 1 else None

    @property
    def xs(self) -> Array | None:
        """(N+1, nx) the states, in their units; see `Iterate`."""
        return self.motions[0].xs if len(self.motions) == 1 else None

    @property
    def us(self) -> Array | None:
        """(N, nu) the inputs, in their units; see `Iterate`."""
        return self.motions[0].us if len(self.motions) == 1 else None

    @property
    def contacts(self) -> tuple[tuple[ContactPoint, ...], ...] | None:
        """N tuples with the contacts of each step, computed on first access; see `Iterate.contacts`."""
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
    """The receivers of a solve's progress. `line` gets text, `callback` gets an Iteration, and `plan` gets the result
    of a search before its verification.
    """

    def __init__(
        self,
        line: Callable[[str], None] | None = None,
        callback: Callable[[Iteration], None] | None = None,
        plan: Callable[[Any], None] | None = None,
        looks: Callable[[], bool] = lambda: True,
    ):
        self.line, self.callback, self.plan = line, callback, plan
        self.looks = looks  # whether the callback uses the motions of a row
        self.asked: Any = None  # the `Search` that is reported on

    def found(self, plan: Any) -> None:
        """Report a solution that is not verified yet."""
        if self.plan is not None:
            self.plan(replace(plan, search=self.asked))

    def row(self, row: Iteration, motions: Callable[[], tuple[Iterate, ...]], *, printed: bool = True) -> None:
        """Report `row` with its `motions`, which are only made if the callback uses them, and print it."""
        if self.callback is not None:
            self.callback(replace(row, motions=motions()) if self.looks() else row)
        if printed:
            self.say(str(row))

    def say(self, text: str) -> None:
        """Print a line of progress."""
        if self.line is not None:
            self.line(text)


class Outcome(enum.Enum):
    """The outcome of a search, as the solver reports it."""

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
    """The limits of a search: iterations, seconds, and the tolerance of feasibility and optimality."""

    max_iterations: int
    time_limit: float
    tolerance: float

    def after(self, start: float) -> "Limits":
        """Return what is left of the limits in a solve that began at `start` on the monotonic clock."""
        return replace(self, time_limit=max(0.0, self.time_limit - (now() - start)))


@dataclass(frozen=True, eq=False)
class Multipliers:
    """Multipliers of variables (n,), positive on an upper bound and negative on a lower one, and of rows (m,)."""

    variables: Array
    rows: Array

    @property
    def sizes(self) -> tuple[int, int]:
        """The sizes (n, m)."""
        return len(self.variables), len(self.rows)


@dataclass(frozen=True, eq=False)
class NlpResult:
    """The result of a nonlinear program: the final or the best variables (n,), and how they were reached."""

    z: Array
    outcome: Outcome
    message: str
    iterations: tuple[Iteration, ...]
    note: str = ""  # restriction of the claim that this is a minimum
    parameters: Array | None = None  # (np,) the values that iLQR found for discrete steps
    # The part of the Lagrangian's gradient that active rows do not balance, over its largest term; NaN if unknown.
    stationarity: float = math.nan
    multipliers: Multipliers | None = None  # if the solver provides them
    refusal: str = ""  # reason for the last point that could not be evaluated


def heard(result: NlpResult, interrupted: threading.Event) -> NlpResult:
    """Return the result, marked as interrupted if a signal came just after the search had ended."""
    if not interrupted.is_set() or result.outcome is Outcome.INTERRUPTED:
        return result
    return replace(result, outcome=Outcome.INTERRUPTED, message=f"{result.message}; then interrupted")


class Watch:
    """The state of a running solve: the best iterate, and whether a signal or the time limit ends it."""

    def __init__(self, limits: Limits, interrupted: threading.Event):
        self.limits, self.interrupted = limits, interrupted
        self.start = self.last_report = now()
        self.best: Array | None = None
        self.best_merit = math.inf
        self.stopped_by: Outcome | None = None

    @property
    def elapsed(self) -> float:
        """The time since the start [s]."""
        return now() - self.start

    def look_up(self) -> bool:
        """Check for a signal and for the time limit, and return whether a report is due."""
        moment = now()
        if self.interrupted.is_set():
            self.stopped_by = Outcome.INTERRUPTED
        elif moment - self.start > self.limits.time_limit:
            self.stopped_by = Outcome.TIME_LIMIT
        due = moment - self.last_report > REPORT_PERIOD or self.stopped_by is not None
        self.last_report = moment if due else self.last_report
        return due

    def offer(self, z: Array, cost: float, violation: float) -> None:
        """Store a copy of `z` (n,) if its cost + 1e6 * (violation beyond the tolerance) is the least so far."""
        merit = cost + 1e6 * max(0.0, violation - self.limits.tolerance)
        if self.best is None or merit < self.best_merit:
            self.best, self.best_merit = np.array(z), merit

    def best_of(self, guess: Array) -> Array:
        """Return the best iterate, or the guess if there is none."""
        return guess if self.best is None else self.best
