"""The solution that every solver returns, with measures that do not rely on the solver."""

import copy
import enum
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from pydrake.trajectories import PiecewisePolynomial

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import PicklesItsFields, Refusal, ShowsItsRepr
from drake_diff.certificates.certificate import Certificate
from drake_diff.exceptions import GradientError, ModelError, SimulationError, UnknownNameError
from drake_diff.model.parameters import ParameterVector, applied, select
from drake_diff.motion.intervals import intervals_of
from drake_diff.motion.rollout import STEPS, Rollout
from drake_diff.optimize.checks import Check, Checks
from drake_diff.optimize.measure import GIVEN, following_checks, plan_checks
from drake_diff.optimize.optimality import Optimality, final_state_norms, optimality
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iteration, Multipliers
from drake_diff.optimize.replay import OPEN_LOOP, Replay, ReplayPlan, held, judged_replay, replays
from drake_diff.optimize.transcription.between import Excess, violation_between_nodes
from drake_diff.optimize.transcription.collocation import Collocated, collocated

SAME_COST = 1e-2  # largest relative difference in cost between searches that reach one optimum on different meshes
SAME_MOTION = 5e-2  # largest RMS difference over the knots, as a fraction of each state's range
NO_INPUT = PiecewisePolynomial(np.zeros((0, 1)))  # of a system without inputs
# Fields that no measure depends on.
OF_THE_SEARCH = ("iterations", "optima", "options", "search", "solver_message", "wall_time")
TOLD = ("cross_checks", "message", "notes", "status", *OF_THE_SEARCH)


class Status(enum.Enum):
    """The status of a solve. Only CONVERGED is a success: the solver converged and all independent checks pass.

    Example:
        >>> dd.Status("iteration_limit").sentence
        'the iteration limit came first'
    """

    CONVERGED = "converged"
    CONVERGED_NOT_VERIFIED = "converged_not_verified"
    ITERATION_LIMIT = "iteration_limit"
    TIME_LIMIT = "time_limit"
    INFEASIBLE = "infeasible"
    DIVERGED = "diverged"
    NO_GRADIENT = "no_gradient"
    INTERRUPTED = "interrupted"
    FAILED = "failed"

    @property
    def sentence(self) -> str:
        """A sentence that explains the status. A solution's notes suggest what to try."""
        return _SENTENCES[self]

    @property
    def words(self) -> str:
        """The first words of a message: "converged", "not verified", "time limit"."""
        return "not verified" if self is Status.CONVERGED_NOT_VERIFIED else self.value.replace("_", " ")


_SENTENCES = {
    Status.CONVERGED: "the solver converged and the plan holds",
    Status.CONVERGED_NOT_VERIFIED: "the solver stopped at a solution, but a measure or a certificate does not hold",
    Status.ITERATION_LIMIT: "the iteration limit came first",
    Status.TIME_LIMIT: "the time limit came first",
    Status.INFEASIBLE: "the solver found no motion that keeps every bound and reaches the goal",
    Status.DIVERGED: "the motion left every finite number",
    Status.NO_GRADIENT: "part of the goal or the cost is out of reach of all that may change, or a derivative must not "
    "be used",
    Status.INTERRUPTED: "the run was interrupted; this is the best motion so far",
    Status.FAILED: "the solver failed",
}


PLANS = (Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED)


@dataclass(frozen=True, eq=False)
class Search:
    """The arguments of a call of `solve`, so that the call can be repeated.

    `arguments` are its keyword arguments as plain data. `guess` is the given `initial_guess`.
    """

    arguments: dict[str, Any]
    guess: Any = None


@dataclass(frozen=True, eq=False, repr=False)
class Solution(PicklesItsFields, ShowsItsRepr):
    """The motion that `solve` found, how it was found, and its measures on Drake's double plant.

    `cost`, `defect`, `goal_error`, `bound_violation`, `constraint_violation`, `replays` and other measures are computed
    from the states and inputs on first access. They are never taken from the solver. A measure that cannot be computed
    is infinite. `success` is true if the solver converged and all checks pass.

    Attributes:
        problem: the solved problem.
        method, solver, scheme: how the problem was solved; `scheme` is "step" for the discrete methods.
        status, message: how the solve ended, as a `Status` and as text of at most 160 characters.
        xs: (N+1, nx) states at the knots, in the states' units.
        us: (N, nu) inputs. A discrete method holds them over each step. In collocation, they are values at the knots of
            an input that is linear in between, or a parabola through `us_mid` (N, nu) at midpoints (hermite_simpson).
        u_final: (nu,) the input at the last knot, for collocation.
        mesh: (N+1,) the knots of a refined mesh as fractions of the horizon, or None for equal intervals.
        free_horizon: [s] the value of the problem's `horizon`, or None if the problem has none.
        parameters: (np,) the values that were found for the problem's parameters.
        iterations: the solver's own table.
        certificates: certificates of the solver's derivatives, at some knots of the guess and of the result.
        options: the options of the solver, including those that it chose itself.
        wall_time: [s] the duration of the solve.
        multipliers: multipliers of the bounds and rows in collocation or iLQR, which warm-start a search from here.
        optima: with `restarts`, the verified solutions that differ in cost or motion, the cheapest first.
        search: the arguments of `solve`, or None if the solution was not made by `solve`.
        cross_checks: replays in other plants, if `drake_diff.runs.cross_check` returned this solution.
        notes: sentences about the search: the solver's message, results of other guesses, suggestions.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> effort = dd.QuadraticCost(R=[[1.0]])
        >>> problem = dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=10, horizon=1.0, running_cost=effort)
        >>> solution = dd.solve(problem)
        >>> solution.status.value, round(solution.cost, 6)
        ('converged', 12.0)
    """

    problem: Problem
    method: str
    solver: str
    status: Status
    message: str
    xs: Array
    us: Array
    scheme: str = "step"
    us_mid: Array | None = None
    u_final: Array | None = None
    mesh: Array | None = None
    free_horizon: float | None = None
    parameters: Array | None = None
    iterations: tuple[Iteration, ...] = ()
    certificates: tuple[Certificate, ...] = ()
    options: dict[str, Any] = field(default_factory=dict)
    solver_message: str = ""
    wall_time: float = 0.0
    search: Search | None = None
    multipliers: Multipliers | None = None
    optima: tuple["Solution", ...] = ()
    cross_checks: tuple[Replay, ...] = ()
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.message}\n{self.problem.name} by {self.method}: cost {self.cost:.6g}"

    def __repr__(self) -> str:
        how = ", ".join(name for name in (self.scheme, self.solver) if name not in ("step", ""))
        verdicts = Counter(certificate.verdict for certificate in self.certificates)
        certified = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.items()) or "none"
        length = "" if self.problem.is_map else f"{self.horizon:g} s in "
        lines = [
            f"Solution of {self.problem.name} by {self.method}{f' ({how})' if how else ''}: {self.status.value}",
            self.message,
            *self.notes,
            f"cost {self.cost:.6g} over {length}{len(self.us)} intervals",
            *(str(c) for c in self.plan_checks.failing),
            f"{len(self.iterations)} iterations in {self.wall_time:.2g} s; certificates: {certified}",
        ]
        known = vars(self).get("replays", vars(self).get("deciding_replays", ()))
        if known:  # replays take time, so that printing does not start them
            lines.append(f"replays: {sum(r.holds for r in known)} of {len(known)} hold")
            lines += [str(r) for r in known if not r.holds]
        lines += [f"cross-checked {row}" for row in self.cross_checks]
        return "\n  ".join(lines)

    def told(self, **fields: Any) -> "Solution":
        """Return the same motion and measures with other `fields` out of TOLD. UnknownNameError for other names."""
        for name in fields:
            if name not in TOLD:
                raise UnknownNameError("field of a Solution", got=name, known=TOLD)
        changed = copy.copy(self)
        vars(changed).update(fields)
        return changed

    def noted(self, *notes: str) -> "Solution":
        """Return the same motion with more `notes`."""
        return self.told(notes=(*self.notes, *notes))

    @property
    def phases(self) -> tuple["Solution", ...]:
        """The solution itself: a problem that is not a `PhasedProblem` has one phase."""
        return (self,)

    @property
    def success(self) -> bool:
        """Whether the solver converged and all independent checks pass."""
        return self.status is Status.CONVERGED

    @property
    def plant(self) -> str:
        """The plant in which the plan must hold: the "steps" of the model or map, or "continuous" time."""
        if self.scheme == "step":
            return "steps" if self.problem.motion == STEPS else "continuous"
        return "steps" if self.problem.is_map else "continuous"

    @property
    def feedback(self) -> str | None:
        """The feedback that the plan needs in its plant: None if it holds open loop there, else "TVLQR".

        This property replays the plan. `success` tells whether the plan holds under that feedback.
        """
        rows = self.following or [c for r in self.deciding_replays[:1] for c in r.checks]
        open_loop = [c.passes for c in rows if c.feedback is None]
        return None if open_loop and all(open_loop) else "TVLQR"

    @property
    def vector(self) -> ParameterVector:
        """The problem's parameters with the values that were found."""
        return self.problem.parameters if self.parameters is None else self.problem.parameters.at(self.parameters)

    @property
    def step_vector(self) -> ParameterVector:
        """The parameters of discrete steps: `vector`, and the length of a step if the problem has a horizon."""
        design = self.problem.design
        return design.vector.at(design.whole(self.vector.values, self.time_step))

    @property
    def horizon(self) -> float:
        """The duration [s] from the first state to the last."""
        return self.problem.start_horizon if self.free_horizon is None else self.free_horizon

    @property
    def time_step(self) -> float:
        """The time [s] between two of the problem's knots; without a horizon, exactly the model's time step."""
        return self.problem.time_step if self.free_horizon is None else self.free_horizon / self.problem.num_steps

    @cached_property
    def cost(self) -> float:
        """The objective of xs and us, as `Problem` defines it, or inf if it is not finite.

        In collocation, the running cost is integrated along the motion of the dynamics from each knot.
        """
        if not self._is_whole:
            return float("inf")
        total = float("nan")
        if self.transcribed is not None:
            total = self.transcribed.cost
        else:
            total = self.problem.objective(self.xs, self.us, self.time_step)
            total += self.problem.cost_of_parameters(self.vector.values)
        return total if np.isfinite(total) else float("inf")

    @cached_property
    def cost_error(self) -> float:
        """The largest distance of `cost` from the minimized cost and from its own true value, or inf if it is unknown.

        For a collocated plan, it is the distance of the scheme's quadrature from the integral along the motion of the
        dynamics, plus the remaining error of that integral, for features that are wider than 1e-4 of each state's range
        along the motion. For a discrete plan, it is a bound on the rounding of the sum.
        """
        if not np.isfinite(self.cost):
            return float("inf")
        if self.transcribed is not None:
            return self.transcribed.cost_error
        return float(np.finfo(float).eps * (len(self.xs) + 2) * self.cost_scale)

    @cached_property
    def cost_scale(self) -> float:
        """The sum of the magnitudes of the cost's parts."""
        if self.transcribed is not None:
            return max(abs(self.cost), self.transcribed.cost_scale)
        parts = [
            *self.problem.cost_terms(self.xs, self.us, self.time_step),
            self.problem.cost_of_parameters(self.vector.values),
        ]
        return float(np.sum(np.abs(parts)))

    @property
    def times(self) -> Array:
        """(N+1,) the times [s] of the states."""
        if self.mesh is not None:
            return np.asarray(self.horizon * self.mesh, dtype=float)
        return np.asarray(self.time_step * np.arange(len(self.xs)), dtype=float)

    @property
    def knots(self) -> Indices:
        """(problem.num_steps + 1,) the rows of `xs` at the problem's own knots: all rows, except on a refined mesh."""
        whole = np.arange(self.problem.num_steps + 1)
        if self.mesh is None:
            return whole
        return np.argmin(np.abs(self.mesh[None] - whole[:, None] / self.problem.num_steps), axis=1)

    @property
    def inputs_at_knots(self) -> Array:
        """The inputs at the knots: (N, nu) for held inputs, (N+1, nu) for collocation."""
        return self.us if self.u_final is None else np.vstack([self.us, self.u_final])

    @cached_property
    def transcribed(self) -> Collocated | None:
        """The motion of a collocation scheme from xs, us, us_mid and u_final, or None if they are not such a motion."""
        if self.scheme == "step" or not self._is_whole:
            return None
        mesh, us = np.linspace(0, 1, len(self.xs)) if self.mesh is None else self.mesh, self.inputs_at_knots
        if self.problem.is_map:  # a map has no input after its last step
            us = np.vstack([us, np.clip(0.0, self.problem.bounds.u_lower, self.problem.bounds.u_upper)])
        return collocated(self.problem, self.scheme, self.xs, us, self.us_mid, self.horizon, mesh, self.vector.values)

    def trajectory(self) -> "Trajectories":
        """Return the state and the input as Drake's piecewise polynomials, for its own controllers and `Simulator`.

        States of collocation are cubics with the slopes of the dynamics at the knots. Its inputs are linear, or
        parabolas through the midpoints. States of a discrete method are linear between knots, and its inputs are held.

        Raises:
            ModelError: The solution is incomplete, or has states or inputs that are not finite.

        Source:
            Kelly, "An Introduction to Trajectory Optimization", SIAM Review 59(4), 2017, sections 3.4 and 4.4.

        Example:
            >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
            >>> effort = dd.QuadraticCost(R=[[1.0]])
            >>> problem = dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=10, horizon=1.0, running_cost=effort)
            >>> state, input = dd.solve(problem).trajectory()
            >>> state.value(0.5).ravel().round(6), input.value(0.25).ravel().round(6)
            (array([0.5, 1.5]), array([3.]))
        """
        if not self._is_whole or not (np.all(np.isfinite(self.xs)) and np.all(np.isfinite(self.us))):
            raise ModelError(f"{self.problem.name}: no trajectory: the solution has entries that are not finite")
        return trajectories(self)

    @property
    def defects(self) -> Array:
        """(N,) the defect of each interval from the dynamics, as a state change in the worst coordinate's unit.

        Discrete: |x_(k+1) - step(x_k, u_k)|, with the step of the problem's `motion`. Collocation: the scheme's own
        equations.
        """
        return np.max(self.defects_of_states, axis=1)

    @cached_property
    def defects_of_states(self) -> Array:
        """(N, nx) the defects of each state, in its unit."""
        if not self._is_whole:
            return np.full((self._num_intervals, self.problem.nx), np.inf)
        if self.transcribed is not None:
            return np.nan_to_num(self.transcribed.defects_of_states, nan=np.inf)
        defects = np.full((len(self.us), self.problem.nx), np.inf)
        with self.problem.intervals(self.step_vector) as intervals:
            for k, u in enumerate(self.us):
                with suppress(SimulationError):
                    defects[k] = np.nan_to_num(np.abs(self.xs[k + 1] - intervals.end(self.xs[k], u)), nan=np.inf)
        return defects

    @property
    def defect(self) -> float:
        """The largest of `defects`."""
        return _largest(self.defects)

    @cached_property
    def integration_errors(self) -> Array:
        """(N,) the distance of knot k+1 from an accurate integration of the dynamics from knot k.

        For a discrete method, the step is the dynamics, and this is its defect.
        """
        return self.defects if self.transcribed is None else self.transcribed.errors

    @property
    def integration_error(self) -> float:
        """The largest of `integration_errors`."""
        return _largest(self.integration_errors)

    @cached_property
    def integrated(self) -> Array | None:
        """(N+1, nx) the integral of x' = f(x, u) from xs[0] under the plan's input, or None for a discrete method.

        It is NaN after the motion diverges. An unstable motion drifts off even if the plan is correct. The drift is
        only reported, and `integration_errors`, which restart at each knot, decide.
        """
        return None if self.transcribed is None else self.transcribed.open_loop

    @cached_property
    def bound_violation(self) -> float:
        """The largest excess over a bound of a free state, an input or a parameter."""
        return max((excess for excess, _ in self.bound_excess.values()), default=0.0)

    @cached_property
    def bound_excess(self) -> dict[str, tuple[float, int]]:
        """The largest excess over a bound and its knot, by the state's, input's or parameter's name, where above 0.

        Given states have no excess. Midpoints of collocation are assigned to the knot before them, and those of a given
        plan, which has no scheme, are left to the checks between the knots.
        """
        b, states, names = self.problem.bounds, self.problem.state_names, self.problem.input_names
        free = self.problem.initial_state_mask
        given = np.zeros(self.xs.shape, dtype=bool)
        given[0] = ~free
        inside = np.clip(0.0, b.x_lower, b.x_upper)
        sides = [(states, np.where(given, inside, self.xs), b.x_lower, b.x_upper)]
        motion = None if self.method == GIVEN else self.transcribed
        if motion is not None and not motion.task.scheme.input_is_linear:  # Drake only bounds knots
            sides += [(states, xs, b.x_lower, b.x_upper) for xs in [motion.xs_mid] if xs is not None]
        sides += [(names, us, b.u_lower, b.u_upper) for us in (self.inputs_at_knots, self.us_mid) if us is not None]
        sides.append((self.vector.names, self.vector.values[None], *self.problem.bounds_of_parameters()))
        if self.problem.horizon is not None:
            shortest, longest = (np.array([end]) for end in self.problem.horizon)
            sides.append((("horizon",), np.array([[self.horizon]]), shortest, longest))
        excesses: dict[str, tuple[float, int]] = {}
        for labels, values, lower, upper in sides:
            excess = np.where(np.isfinite(values), np.maximum(lower - values, values - upper), np.inf)
            for i in np.flatnonzero(excess.max(axis=0, initial=0.0) > 0):
                k = int(np.argmax(excess[:, i]))
                excesses[labels[i]] = max((float(excess[k, i]), k), excesses.get(labels[i], (0.0, 0)))
        return excesses

    @cached_property
    def constraint_excess(self) -> dict[str, tuple[float, int]]:
        """The largest excess and its knot of each of the problem's constraints and waypoints.

        Collocation also enforces constraints of all knots at midpoints, which are assigned to the knot before them.
        """
        if self.transcribed is None or self.problem.is_map:
            coupled = self.problem.coupled_steps(self.time_step)
            return self.problem.constraint_excess(self.xs, self.inputs_at_knots, coupled=coupled)
        nodes, every = self.transcribed.nodes, self.transcribed.task.scheme.nodes
        xs, us = np.split(nodes, [self.problem.nx], axis=1)
        excesses = self.problem.constraint_excess(xs, us, every * self.knots, self.transcribed.task.couplings)
        return {name: (excess, row // every) for name, (excess, row) in excesses.items()} | self.transcribed.rate_excess

    @property
    def constraint_violation(self) -> float:
        """The largest excess of a constraint over a bound or distance from a waypoint, in its own unit."""
        return max((excess for excess, _ in self.constraint_excess.values()), default=0.0)

    @cached_property
    def between_nodes(self) -> Excess | None:
        """The violation of bounds and constraints between nodes in collocation, or None for a discrete method."""
        return None if self.transcribed is None else violation_between_nodes(self.transcribed)

    @cached_property
    def plan_checks(self) -> Checks:
        """Checks of the states and inputs themselves, without replays."""
        return Checks(plan_checks(self))

    @cached_property
    def following(self) -> list[Check]:
        """Checks of whether the dynamics follow a collocated plan from its first state, open loop or under TVLQR."""
        return [] if self.transcribed is None else following_checks(self, self.transcribed)

    @property
    def checks(self) -> Checks:
        """All checks of the plan, of each replay and of other plants, the worst first.

        Replays are computed on first access.

        Example:
            >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
            >>> effort = dd.QuadraticCost(R=[[1.0]])
            >>> problem = dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=10, horizon=1.0, running_cost=effort)
            >>> solution = dd.solve(problem)
            >>> sorted({c.what for c in solution.checks})
            ['bound', 'constraint', 'cost', 'defect', 'derivative', 'following', 'goal', 'integration', 'start']
            >>> [c.verdict for c in solution.checks if c.verdict != "pass"]
            []
        """
        rows = [c for replay in (*self.replays, *self.cross_checks) for c in replay.checks]
        return Checks([*self.plan_checks, *self.following, *rows])

    @cached_property
    def goal_error(self) -> float:
        """The largest distance of the final state from the goal, without free entries."""
        return _largest(np.abs(self.problem.goal_error(self.xs[-1])))

    @cached_property
    def initial_state_error(self) -> float:
        """The largest distance of xs[0] from the problem's x0, without free entries."""
        fixed = ~self.problem.initial_state_mask
        return _largest(np.abs(self.xs[0] - self.problem.x0)[fixed])

    @cached_property
    def final_state_norms(self) -> Array | Refusal:
        """(N+1,) |d x_N / d x_k| at the problem's own knots, by the plant's steps from the plan's states, or a Refusal.

        If they grow towards the start, early inputs dominate. If they vanish there, early inputs have no effect.
        """
        if not self.problem.has_model:
            return Refusal("plain dynamics have no discrete step")
        if not self._is_whole or not np.all(np.isfinite(self.xs)):
            return Refusal("the plan is not finite")
        try:
            xs, us = self.plan.sample(1)
            vector = select(self.plan.model_at(1), self.vector.to_dict())
            with applied(vector) as model:
                intervals = intervals_of(model, vector, self.problem.motion)
                return final_state_norms(intervals.derivatives(xs[0], us, xs[:-1]))
        except (GradientError, ModelError, SimulationError) as error:
            return Refusal(f"a step or its derivative is refused: {error}")

    @cached_property
    def optimality(self) -> Optimality | Refusal:
        """The distance of a discrete plan from a stationary point, with our own multipliers, or a Refusal.

        Collocation has another Lagrangian, that of its scheme, and its multipliers come from the solver.
        """
        if self.scheme != "step":
            return Refusal("the plan has no discrete steps: the Lagrangian of a collocation belongs to its scheme")
        if not self._is_whole or not np.all(np.isfinite(self.xs)):
            return Refusal("the plan is not finite")
        try:
            return optimality(self.problem, np.asarray(self.xs), self.us, self.step_vector.values)
        except (GradientError, SimulationError) as error:
            return Refusal(f"a step or a derivative is refused: {error}")

    @cached_property
    def plan(self) -> ReplayPlan:
        """The plan for replays: states, and inputs held over each step or averaged over parts of an interval."""
        continuous = self.transcribed is not None
        sample = held(self.xs, self.us) if self.transcribed is None else self.transcribed.sample
        return ReplayPlan(self.problem, self.vector, self.time_step, sample, continuous, self.cost)

    @cached_property
    def replay(self) -> Rollout | None:
        """The plant's own open-loop motion from xs[0], or None if the simulation fails.

        The discrete plant is simulated. A problem in continuous time uses another integration than the plan. An input
        that changes between knots is held at its mean over each step. Plain dynamics have no plant: see `integrated`.
        """
        return self.plan.open_loop if self.problem.has_model else None

    @cached_property
    def replays(self) -> tuple[Replay, ...]:
        """The replays in every variant of the plant (step, half step, other contact), open loop and under TVLQR.

        A plan in continuous time has a single variant, which is another integration than the plan's. Plain dynamics
        have no variants, and the tuple is empty.
        """
        return replays(self.plan) if self.problem.has_model else ()

    @cached_property
    def deciding_replays(self) -> tuple[Replay, ...]:
        """The replays that decide success: under TVLQR only in variants in which the plan does not hold open loop."""
        return replays(self.plan, sufficient=OPEN_LOOP) if self.problem.has_model else ()

    @property
    def judged_replay(self) -> Replay | None:
        """The replay that decides success: open loop if that holds, else under TVLQR, or None if both fail."""
        if not self.problem.has_model:
            return None
        open_loop = [r for r in self.deciding_replays if r.control == OPEN_LOOP]
        return judged_replay(self.plan, open_loop) or judged_replay(self.plan, self.replays)

    @property
    def half_step_error(self) -> float:
        """The distance from xs[-1] of the end under the same held inputs at half the time step.

        It shows the effect of the step size. It is inf if that replay fails, and NaN for a motion in continuous time.
        """
        if self.problem.motion != STEPS:
            return float("nan")
        half = f"in steps of {self.time_step / 2:.4g} s"
        motions = [r.motion for r in self.deciding_replays if (r.variant, r.control) == (half, OPEN_LOOP)]
        if self.replay is None or not motions or motions[0] is None:
            return float("inf")
        return _largest(np.abs(motions[0].xs[-1] - self.xs[-1]))

    @property
    def _num_intervals(self) -> int:
        return self.problem.num_steps if self.mesh is None else len(self.mesh) - 1

    @property
    def _is_whole(self) -> bool:
        """Whether xs and the inputs have the problem's shapes, and are finite in collocation."""
        count, nx, nu = self._num_intervals, self.problem.nx, self.problem.nu
        if self.us.shape != (count, nu) or self.xs.shape != (count + 1, nx):
            return False
        parts = [array for array in (self.xs, self.inputs_at_knots, self.us_mid) if array is not None]
        return self.scheme == "step" or all(bool(np.all(np.isfinite(array))) for array in parts)


@dataclass(frozen=True, eq=False)
class Optimum:
    """A verified solution, the first initial guess that led to it, and the number of guesses that did."""

    solution: Solution
    guess: str
    count: int

    def to_dict(self) -> dict[str, Any]:
        """Return the optimum as plain data."""
        s = self.solution
        return {"cost": s.cost, "horizon": s.horizon, "guess": self.guess, "count": self.count}


def distinct(pairs: Sequence[tuple[Solution, str]]) -> list[Optimum]:
    """Return the verified solutions with different motions, and their guesses, the cheapest first."""
    optima: list[Optimum] = []
    for solution, guess in pairs:
        if not solution.success:
            continue
        for i, other in enumerate(optima):
            if _are_same(solution, other.solution):
                cheapest = min((other.solution, solution), key=lambda s: s.cost)
                optima[i] = Optimum(cheapest, other.guess, other.count + 1)
                break
        else:
            optima.append(Optimum(solution, guess, 1))
    return sorted(optima, key=lambda optimum: optimum.solution.cost)


def _are_same(solution: Solution, other: Solution) -> bool:
    """Return whether two solutions of one problem have the same cost and the same motion at its knots."""
    room = solution.problem.least_cost(solution.xs[0], solution.horizon / solution.problem.num_steps)
    if abs(solution.cost - other.cost) > SAME_COST * max(abs(solution.cost), abs(other.cost)) + room:
        return False
    first, second = (np.asarray(s.xs)[s.knots] for s in (solution, other))
    apart = np.abs(first - second) / solution.problem.state_scales(np.vstack([first, second]))
    return bool(np.max(np.sqrt(np.mean(apart**2, axis=0))) <= SAME_MOTION)


class Trajectories(NamedTuple):
    """A motion as two Drake trajectories over the same time [s]."""

    state: PiecewisePolynomial
    input: PiecewisePolynomial


def trajectories(solution: Solution) -> Trajectories:
    """Return the result of `Solution.trajectory`."""
    times, motion = solution.times, solution.transcribed
    xs, us = np.asarray(solution.xs), np.asarray(solution.inputs_at_knots)
    if motion is None or solution.problem.is_map:
        held = PiecewisePolynomial.ZeroOrderHold(times, np.vstack([us, us[-1:]]).T) if us.size else NO_INPUT
        between = PiecewisePolynomial.ZeroOrderHold if solution.problem.is_map else PiecewisePolynomial.FirstOrderHold
        return Trajectories(between(times, xs.T), held)
    state = PiecewisePolynomial.CubicHermite(times, xs.T, motion.rates.T)
    if not us.size:
        return Trajectories(state, NO_INPUT)
    if solution.us_mid is None:
        return Trajectories(state, PiecewisePolynomial.FirstOrderHold(times, us.T))
    parabolas = PiecewisePolynomial()
    for k, (t, end) in enumerate(pairwise(times)):
        through = np.array([us[k], solution.us_mid[k], us[k + 1]]).T
        parabolas.ConcatenateInTime(
            PiecewisePolynomial.LagrangeInterpolatingPolynomial([t, (t + end) / 2, end], through)
        )
    return Trajectories(state, parabolas)


def _largest(values: Array) -> float:
    """Return the largest value, inf if a value is NaN, or 0 without values."""
    values = np.asarray(values, dtype=float)
    return float("inf") if np.any(np.isnan(values)) else float(np.max(values, initial=0.0))
