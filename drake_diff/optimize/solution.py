"""What every solver returns, and measures that do not take its word."""

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
from drake_diff.optimize.measure import following_checks, plan_checks
from drake_diff.optimize.optimality import Optimality, final_state_norms, optimality
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iteration, Multipliers
from drake_diff.optimize.replay import OPEN_LOOP, Replay, ReplayPlan, held, judged_replay, replays
from drake_diff.optimize.transcription.between import Excess, violation_between_nodes
from drake_diff.optimize.transcription.collocation import Collocated, collocated

SAME_COST = 1e-2  # of the larger one: what searches that stop at one optimum on other meshes may differ by
SAME_MOTION = 5e-2  # of each state's range, the root of the mean square over the knots
# Fields that no measure depends on.
TOLD = ("cross_checks", "iterations", "message", "notes", "optima", "options", "search", "solver_message", "status")


class Status(enum.Enum):
    """How a solve ended. Only CONVERGED is a success: the solver converged and all measures taken again hold.

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
        """What it means; a solution's notes say what to try."""
        return _SENTENCES[self]

    @property
    def words(self) -> str:
        """How a message begins: "converged", "not verified", "time limit"."""
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
    """What `solve` was called with, so that it can be called again.

    `arguments` are its keyword arguments as plain data, `guess` is the `initial_guess` that was given.
    """

    arguments: dict[str, Any]
    guess: Any = None


@dataclass(frozen=True, eq=False, repr=False)
class Solution(PicklesItsFields, ShowsItsRepr):
    """The motion that `solve` found, how it was found, and what it measures on Drake's double plant.

    `cost`, `defect`, `goal_error`, `bound_violation`, `constraint_violation`, `replays` and the rest are computed from
    the states and inputs when they are first asked for. They are never taken from the solver, and what cannot be
    computed is infinite. `success` holds where the solver converged and all of them hold.

    Attributes:
        problem: what was asked.
        method, solver, scheme: how it was solved; `scheme` is "step" for the discrete methods.
        status, message: how it ended, as a `Status` and in at most 160 characters.
        xs: (N+1, nx) states at the knots, in the states' units.
        us: (N, nu) inputs, held over each step by a discrete method. Those of collocation are at the knots and
            linear in between, or the parabola through `us_mid` (N, nu) at the midpoints (hermite_simpson).
        u_final: (nu,) the input at the last knot, for collocation.
        mesh: (N+1,) the knots as fractions of the horizon where the mesh was refined, else None: equal intervals.
        free_horizon: [s] what a `horizon` of the problem came to, else None.
        parameters: (np,) the values that were found for the problem's parameters.
        iterations: the solver's own table.
        certificates: of the derivatives that the solver used, at some knots of the guess and of the result.
        options: what was asked of the solver, and what it chose.
        wall_time: [s] what the solve took.
        multipliers: of the bounds and rows of what collocation or iLQR solved, with which a search from here begins.
        optima: with `restarts`, the verified solutions that differ in cost or motion, the cheapest first.
        search: the arguments of `solve`, None of a solution that it did not make.
        cross_checks: replays in other plants, of a solution that `artifact.cross_check` returned.
        notes: sentences about the search: what the solver says, what other guesses came to, what to try.

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
        if "replays" in vars(self) and self.replays:  # they take time: a printed line starts none
            lines.append(f"replays: {sum(r.holds for r in self.replays)} of {len(self.replays)} hold")
            lines += [str(r) for r in self.replays if not r.holds]
        lines += [f"cross-checked {row}" for row in self.cross_checks]
        return "\n  ".join(lines)

    def told(self, **fields: Any) -> "Solution":
        """The same motion with other `fields` out of TOLD: its measures stay. UnknownNameError of others."""
        for name in fields:
            if name not in TOLD:
                raise UnknownNameError("field of a Solution", got=name, known=TOLD)
        changed = copy.copy(self)
        vars(changed).update(fields)
        return changed

    def noted(self, *notes: str) -> "Solution":
        """The same motion with more `notes`."""
        return self.told(notes=(*self.notes, *notes))

    @property
    def phases(self) -> tuple["Solution", ...]:
        """Itself: a problem that is not a `PhasedProblem` is one phase."""
        return (self,)

    @property
    def success(self) -> bool:
        """Whether the solver converged and everything measured again holds."""
        return self.status is Status.CONVERGED

    @property
    def plant(self) -> str:
        """Where the plan is to hold: in the "steps" of the model or map, or in "continuous" time."""
        if self.scheme == "step":
            return "steps" if self.problem.motion == STEPS else "continuous"
        return "steps" if self.problem.is_map else "continuous"

    @property
    def feedback(self) -> str | None:
        """The feedback that the plan needs in its plant: None where it holds open loop there, else "TVLQR".

        Replays of the plan are taken for it. `success` says whether it holds under that feedback.
        """
        rows = self.following or [c for r in self.replays[:1] for c in r.checks]
        open_loop = [c.passes for c in rows if c.feedback is None]
        return None if open_loop and all(open_loop) else "TVLQR"

    @property
    def vector(self) -> ParameterVector:
        """The problem's parameters as they were found."""
        return self.problem.parameters if self.parameters is None else self.problem.parameters.at(self.parameters)

    @property
    def step_vector(self) -> ParameterVector:
        """The parameters of discrete steps: `vector`, and the step's length where a horizon is asked for."""
        design = self.problem.design
        return design.vector.at(design.whole(self.vector.values, self.time_step))

    @property
    def horizon(self) -> float:
        """[s] from the first state to the last."""
        return self.problem.start_horizon if self.free_horizon is None else self.free_horizon

    @property
    def time_step(self) -> float:
        """[s] between two of the problem's knots: the model's own, to the last bit, where no horizon is asked for."""
        return self.problem.time_step if self.free_horizon is None else self.free_horizon / self.problem.num_steps

    @cached_property
    def cost(self) -> float:
        """The objective of xs and us, as `Problem` defines it; inf where it is not finite.

        In collocation the running cost is integrated along the motion that the dynamics make from each knot.
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
        """How far `cost` may be from what was minimized and from its own true value; inf where it is not known.

        Of a collocated plan, the distance of the scheme's quadrature from the integral along the motion of the
        dynamics, and what is left of that integral's errors: of features that are wider than a 1e-4 of each state's
        range along the motion. Of a plan in steps, a bound of the rounding of its sum.
        """
        if not np.isfinite(self.cost):
            return float("inf")
        if self.transcribed is not None:
            return self.transcribed.cost_error
        return float(np.finfo(float).eps * (len(self.xs) + 2) * self.cost_scale)

    @cached_property
    def cost_scale(self) -> float:
        """What the parts of the cost come to without their signs."""
        if self.transcribed is not None:
            return max(abs(self.cost), self.transcribed.cost_scale)
        parts = [
            *self.problem.cost_terms(self.xs, self.us, self.time_step),
            self.problem.cost_of_parameters(self.vector.values),
        ]
        return float(np.sum(np.abs(parts)))

    @property
    def times(self) -> Array:
        """(N+1,) [s] of the states."""
        if self.mesh is not None:
            return np.asarray(self.horizon * self.mesh, dtype=float)
        return np.asarray(self.time_step * np.arange(len(self.xs)), dtype=float)

    @property
    def knots(self) -> Indices:
        """(problem.num_steps + 1,) the rows of `xs` that are the problem's own knots: all, but on a refined mesh."""
        whole = np.arange(self.problem.num_steps + 1)
        if self.mesh is None:
            return whole
        return np.argmin(np.abs(self.mesh[None] - whole[:, None] / self.problem.num_steps), axis=1)

    @property
    def inputs_at_knots(self) -> Array:
        """The inputs at the knots: (N, nu) held ones, (N+1, nu) those of collocation."""
        return self.us if self.u_final is None else np.vstack([self.us, self.u_final])

    @cached_property
    def transcribed(self) -> Collocated | None:
        """The motion of a collocation scheme, from xs, us, us_mid and u_final; None where they are no such motion."""
        if self.scheme == "step" or not self._is_whole:
            return None
        mesh, us = np.linspace(0, 1, len(self.xs)) if self.mesh is None else self.mesh, self.inputs_at_knots
        if self.problem.is_map:  # after the last step there is no input
            us = np.vstack([us, np.clip(0.0, self.problem.bounds.u_lower, self.problem.bounds.u_upper)])
        return collocated(self.problem, self.scheme, self.xs, us, self.us_mid, self.horizon, mesh, self.vector.values)

    def trajectory(self) -> "Trajectories":
        """The state and the input as Drake's piecewise polynomials, for its own controllers and `Simulator`.

        States of collocation are cubics with the dynamics' slopes at the knots, its inputs lines, or parabolas through
        the midpoints. Those of a discrete method are lines between its states, under inputs that are held.

        Raises:
            ModelError: The solution is not whole: it has states or inputs that are no numbers.

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
        """(N,) how far each interval is from the dynamics, as a state change, in the worst coordinate's unit.

        Discrete: |x_(k+1) - step(x_k, u_k)|, the step being that of the problem's `motion`. Collocation: the scheme's
        own equations.
        """
        return np.max(self.defects_of_states, axis=1)

    @cached_property
    def defects_of_states(self) -> Array:
        """(N, nx) the same of each state, in its unit."""
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
        """(N,) distance of knot k+1 from an accurate integration of the dynamics from knot k.

        Of a discrete method the step is the dynamics, and this is its defect.
        """
        return self.defects if self.transcribed is None else self.transcribed.errors

    @property
    def integration_error(self) -> float:
        """The largest of `integration_errors`."""
        return _largest(self.integration_errors)

    @cached_property
    def integrated(self) -> Array | None:
        """(N+1, nx) where x' = f(x, u) leads from xs[0] under the plan's input; None of a discrete method.

        NaN from where the motion leaves all finite numbers. An unstable motion drifts off here whatever is right: it
        is reported, and `integration_errors`, which start anew at each knot, decide.
        """
        return None if self.transcribed is None else self.transcribed.open_loop

    @cached_property
    def bound_violation(self) -> float:
        """The largest excess over a bound of a state that is not given, an input, or a parameter."""
        return max((excess for excess, _ in self.bound_excess.values()), default=0.0)

    @cached_property
    def bound_excess(self) -> dict[str, tuple[float, int]]:
        """The largest excess over a bound and its knot, by the state's, input's or parameter's name, where above 0.

        States that are given have none; collocation's midpoints count to the knot before them.
        """
        b, states, names = self.problem.bounds, self.problem.state_names, self.problem.input_names
        free = self.problem.initial_state_mask
        given = np.zeros(self.xs.shape, dtype=bool)
        given[0] = ~free
        inside = np.clip(0.0, b.x_lower, b.x_upper)
        sides = [(states, np.where(given, inside, self.xs), b.x_lower, b.x_upper)]
        if self.transcribed is not None and not self.transcribed.task.scheme.input_is_linear:  # Drake bounds knots
            sides += [(states, xs, b.x_lower, b.x_upper) for xs in [self.transcribed.xs_mid] if xs is not None]
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

        Collocation keeps constraints of all knots at its midpoints too, which count to the knot before them.
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
        """The largest excess over a bound of a constraint, or distance from a waypoint, in its own unit."""
        return max((excess for excess, _ in self.constraint_excess.values()), default=0.0)

    @cached_property
    def between_nodes(self) -> Excess | None:
        """How far a collocated motion leaves bounds and constraints between its nodes; None of a discrete method."""
        return None if self.transcribed is None else violation_between_nodes(self.transcribed)

    @cached_property
    def plan_checks(self) -> Checks:
        """What is checked of the states and inputs themselves; replays apart."""
        return Checks(plan_checks(self))

    @cached_property
    def following(self) -> list[Check]:
        """Of a collocated plan: whether its dynamics follow it from its first state, open loop and else under TVLQR."""
        return [] if self.transcribed is None else following_checks(self, self.transcribed)

    @property
    def checks(self) -> Checks:
        """Everything that was checked, the worst first: of the plan, of each replay and of other plants.

        Replays are taken when they are first asked for.

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
        """The largest distance of the final state from the goal, free entries apart."""
        return _largest(np.abs(self.problem.goal_error(self.xs[-1])))

    @cached_property
    def initial_state_error(self) -> float:
        """The largest distance of xs[0] from the problem's x0, free entries apart."""
        fixed = ~self.problem.initial_state_mask
        return _largest(np.abs(self.xs[0] - self.problem.x0)[fixed])

    @cached_property
    def final_state_norms(self) -> Array | Refusal:
        """(N+1,) |d x_N / d x_k| at the problem's own knots, by the plant's steps from the plan's states; else why not.

        Where they grow going back, early inputs decide all; where they vanish, nothing that is early matters.
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
        """How far a discrete plan is from a stationary point, by our own multipliers; why not, where that is not known.

        Collocation has another Lagrangian, that of its scheme: its multipliers are the solver's.
        """
        if self.scheme != "step":
            return Refusal("only discrete steps have it, as the Lagrangian of a collocation belongs to its scheme")
        if not self._is_whole or not np.all(np.isfinite(self.xs)):
            return Refusal("the plan is not finite")
        try:
            return optimality(self.problem, np.asarray(self.xs), self.us, self.step_vector.values)
        except (GradientError, SimulationError) as error:
            return Refusal(f"a step or a derivative is refused: {error}")

    @cached_property
    def plan(self) -> ReplayPlan:
        """What is replayed: states, and inputs held over each step, or their means over the parts of an interval."""
        continuous = self.transcribed is not None
        sample = held(self.xs, self.us) if self.transcribed is None else self.transcribed.sample
        return ReplayPlan(self.problem, self.vector, self.time_step, sample, continuous, self.cost)

    @cached_property
    def replay(self) -> Rollout | None:
        """The plant's own open-loop motion from xs[0]; None where it cannot be taken.

        It is the discrete plant's; of a problem whose motion is continuous, another integration than the plan's. An
        input that changes between knots is held at its mean over each step. Plain dynamics have no plant to step: see
        `integrated`.
        """
        return self.plan.open_loop if self.problem.has_model else None

    @cached_property
    def replays(self) -> tuple[Replay, ...]:
        """The plan in every variant of the plant (step, half step, other contact), open loop and under TVLQR.

        Of a plan in continuous time there is one, by another integration than that which made it.

        None of plain dynamics, which have no such variants.
        """
        return replays(self.plan) if self.problem.has_model else ()

    @property
    def judged_replay(self) -> Replay | None:
        """The replay that a success rests on: open loop where that holds, else under TVLQR; None where neither does."""
        return judged_replay(self.plan, self.replays) if self.problem.has_model else None

    @property
    def half_step_error(self) -> float:
        """How far from xs[-1] the same held inputs lead at half the time step: what a step size decided.

        inf where that replay cannot be taken, NaN of a motion in continuous time, which has no steps.
        """
        if self.problem.motion != STEPS:
            return float("nan")
        half = f"in steps of {self.time_step / 2:.4g} s"
        motions = [r.motion for r in self.replays if (r.variant, r.control) == (half, OPEN_LOOP)]
        if self.replay is None or not motions or motions[0] is None:
            return float("inf")
        return _largest(np.abs(motions[0].xs[-1] - self.xs[-1]))

    @property
    def _num_intervals(self) -> int:
        return self.problem.num_steps if self.mesh is None else len(self.mesh) - 1

    @property
    def _is_whole(self) -> bool:
        """Whether xs and the inputs have the problem's shapes, and all of collocation's are numbers."""
        count, nx, nu = self._num_intervals, self.problem.nx, self.problem.nu
        if self.us.shape != (count, nu) or self.xs.shape != (count + 1, nx):
            return False
        parts = [array for array in (self.xs, self.inputs_at_knots, self.us_mid) if array is not None]
        return self.scheme == "step" or all(bool(np.all(np.isfinite(array))) for array in parts)


@dataclass(frozen=True, eq=False)
class Optimum:
    """A verified solution, the first guess that led to it first, and how many did."""

    solution: Solution
    guess: str
    count: int

    def to_dict(self) -> dict[str, Any]:
        """Plain data."""
        s = self.solution
        return {"cost": s.cost, "horizon": s.horizon, "guess": self.guess, "count": self.count}


def distinct(pairs: Sequence[tuple[Solution, str]]) -> list[Optimum]:
    """Those of the verified solutions and their guesses that are no other's motion, the cheapest first."""
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
    """Whether two solutions of one problem have one cost and one motion at its knots."""
    room = solution.problem.least_cost(solution.xs[0], solution.horizon / solution.problem.num_steps)
    if abs(solution.cost - other.cost) > SAME_COST * max(abs(solution.cost), abs(other.cost)) + room:
        return False
    first, second = (np.asarray(s.xs)[s.knots] for s in (solution, other))
    apart = np.abs(first - second) / solution.problem.state_scales(np.vstack([first, second]))
    return bool(np.max(np.sqrt(np.mean(apart**2, axis=0))) <= SAME_MOTION)


class Trajectories(NamedTuple):
    """A motion as two of Drake's trajectories over the same time [s]."""

    state: PiecewisePolynomial
    input: PiecewisePolynomial


def trajectories(solution: Solution) -> Trajectories:
    """See `Solution.trajectory`."""
    times, motion = solution.times, solution.transcribed
    xs, us = np.asarray(solution.xs), np.asarray(solution.inputs_at_knots)
    if motion is None or solution.problem.is_map:
        held = PiecewisePolynomial.ZeroOrderHold(times, np.vstack([us, us[-1:]]).T)
        between = PiecewisePolynomial.ZeroOrderHold if solution.problem.is_map else PiecewisePolynomial.FirstOrderHold
        return Trajectories(between(times, xs.T), held)
    state = PiecewisePolynomial.CubicHermite(times, xs.T, motion.rates.T)
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
    """The largest value; inf where one is not a number, 0 where there is none."""
    values = np.asarray(values, dtype=float)
    return float("inf") if np.any(np.isnan(values)) else float(np.max(values, initial=0.0))
