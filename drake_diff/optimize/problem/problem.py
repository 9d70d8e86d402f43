"""The definition of a trajectory optimization problem, checked at construction, without any solver."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import KW_ONLY, dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, cast

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, InitializeAutoDiff

from drake_diff._base.arrays import (
    Array,
    Indices,
    array_with_gaps,
    count,
    finite_array,
    frozen,
    number_of_steps,
    positive_float,
    seconds,
)
from drake_diff._base.autodiff import ORDINARY, named, user_function
from drake_diff._base.values import PicklesItsFields, ShowsItsRepr
from drake_diff.exceptions import GradientError, InputError, ModelError, ModelWarning, ShapeError, UnknownNameError
from drake_diff.model.assembly import check_closed
from drake_diff.model.model import Model
from drake_diff.model.parameters import TIME_STEP, ParameterVector, applied, select
from drake_diff.model.tangent import tangent_space
from drake_diff.motion.intervals import Intervals, intervals_of
from drake_diff.motion.rollout import MOTIONS, STEPS
from drake_diff.optimize.problem.constraint import (
    Constraint,
    check_inside,
    plant_limits,
    resolve_bounds,
    several,
    short,
)
from drake_diff.optimize.problem.cost import (
    ConstantCost,
    FinalCost,
    QuadraticCost,
    SumOfCosts,
    TimedCost,
    TrackingCost,
    cost_at,
    differentiate_final_cost,
    quadratic_along,
    running_cost_of,
)
from drake_diff.optimize.problem.coupling import BoundCoupling, Couples, Joins, RateLimit, excess_of
from drake_diff.optimize.problem.design import Design
from drake_diff.optimize.problem.dynamics import DiscreteMap, Dynamics, bounds_of, plant_dynamics, state_of, vectors_of
from drake_diff.optimize.problem.goals import LAST, Goal, GoalConstraint, WithGoals, in_words
from drake_diff.optimize.problem.obstacles import ClearanceConstraint, doubts_of


class _Parallel:
    """A function of the state that is zero (3,) if the quaternion at `entries` is a multiple of `wanted` (4,)."""

    def __init__(self, entries: slice, wanted: Array):
        self.entries, self.across = entries, np.linalg.svd(wanted[None])[2][1:]

    def __call__(self, x: Any) -> Any:
        return self.across @ x[self.entries]


OPTIMIZABLE = ("controls", "initial_state", "parameters")
# A parameter that cannot be negative stays above this part of its first value, unless a bound is given.
SMALLEST_PART = 1e-3
SAME_STATE = 1e-6  # [the coupling's unit], tolerance for states that a user types
STILL = 1e-6  # of a state's largest magnitude, or of a radian: a smaller range counts as no motion
RETURNS = 0.1  # of its range along a plan: a state whose required change is smaller returns to its start
NOTHING = 1e-150  # in any unit: the square of a smaller number may underflow
STAYS = 1e-2  # of its bounds, or of a radian: the scale of a state that need not travel
# Relative to a state's magnitude or size. Bounds further apart than WIDEST are ignored, and others count as at most
# REACH, those of velocities as at most FASTER, so that no bound makes a scale much larger than the state's motion.
WIDEST, FASTER, REACH = 1e3, 300.0, 10.0
GOAL_PART = 0.01  # of a state's required change: the default goal tolerance
TRIED, NO_SLOPE = 3, 1e-9  # random states for the slopes of goals, and the largest slope that is rounding


@dataclass(frozen=True, eq=False, repr=False)
class Problem(PicklesItsFields, ShowsItsRepr):
    """A trajectory optimization problem: minimize the time integral of running_cost(x, u), plus final_cost(x_N).

    On a model's discrete steps the integral is sum_k h * running_cost(x_k, u_k) with h = model.time_step; collocation
    uses the quadrature of its scheme. Bounds apply to every state that is not given and to every input.

    Args:
        system: a Model; or `Dynamics` x' = f(x, u), for method="collocation" only; or an `optimize.DiscreteMap`, a map
            x_(k+1) = f(x_k, u_k) whose time is the step index.
        x0: (nx,) the initial state; or a mapping from coordinate names to values, with the model's defaults for the
            rest. A name is one of `state_names`, or a joint with one position, which then means this position.
        num_steps: number N of intervals, each of model.time_step if no `horizon` is given.
        running_cost: a function (x, u) or (x, u, t) -> scalar, where t [s] is 0 at the first state; a QuadraticCost, an
            `optimize.TrackingCost`, or a list of such costs, which are added; or, with `horizon`, a number [per s]:
            with 1.0 the cost is the time itself.
        final_cost: a function x -> scalar, or a QuadraticCost. This and any other function of a problem may be written
            in JAX in double precision, and is compiled for each solve.
        x_goal: (nx,) final state, a hard equality, NaN for free entries. Or a mapping as for `x0`; the rest is free.
        goal_tolerance: allowed distance of the replay's final state from `x_goal`: a mapping from names as for `x0`, or
            (nx,), NaN where not given, in the states' units. The default is 1 % of the state's required change.
        waypoints: mapping from knots (1 ... N-1) to states (nx,), NaN for free entries, or to mappings as for `x_goal`.
        constraints: a `Constraint`, or several.
        couplings: a constraint that joins several knots, such as `optimize.Periodic`, or several of these; for
            collocation and shooting.
        goals: a goal for the robot's frames, joints or bodies, such as a `FrameGoal`, or several; each adds constraints
            or a cost on the model's motion.
        horizon: [s] time from the first state to the last, in N equal intervals: a number, or (lower, upper) for a free
            final time. Plain dynamics need one.
        bounds: `Bounds`, or a mapping from names of coordinates or inputs to (lower, upper). The limits of the model or
            the dynamics apply to all entries that are not given.
        optimize: the quantities that may change: "controls", "initial_state", "parameters", or several of them.
        initial_state_mask: (nx,) booleans, True for entries that "initial_state" may change; x0 is their initial guess.
        us: (N, nu) the inputs if they are not optimized, or else their initial guess; 0 if not given.
        parameters: names of model parameters (see `list_parameters`) or of parameters of the `Dynamics`, or a mapping
            from names to values. They are constant in time. With "parameters" in `optimize`, the search starts from
            them, and parameters of the `Dynamics` need not be named.
        parameter_bounds: mapping from names to (lower, upper). Without a bound, a parameter that cannot be negative
            stays above 1e-3 of its start, and an inertia stays physically possible.
        trajectory_cost: a function (xs, us) -> scalar that is added to the cost, such as the distance from a
            measured motion.
        parameter_cost: a function (p) -> scalar of the values (np,) of `parameters` that is added to the cost, such as
            the price of a stronger motor.
        motion: how a model moves between knots. "steps": by Drake's own steps. "continuous": by their limit for
            vanishing time steps, contact included (see `rollout`), so that the derivative through an impact is that of
            the impact itself; for iLQR and shooting. Such a plan must also pass a replay with another integration.

    Raises:
        InputError: an argument does not fit; also ShapeError, NonFiniteError and UnknownNameError, all with the
            expected and the given value.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.05)
        >>> effort = dd.QuadraticCost(R=[[1.0]])
        >>> dd.Problem(model, x0=[0, 0], num_steps=40, x_goal=[3.14, 0], running_cost=effort)
        Problem of pendulum: 2 states, 1 input, 40 steps in 2 s
          from x0 = [0., 0.] to x_goal = [3.14, 0.  ]
          running cost: QuadraticCost(R=[[1.]])
          optimize: controls
    """

    system: Model | Dynamics
    _: KW_ONLY
    x0: Any
    num_steps: int
    running_cost: Any = None  # becomes a RunningCost
    final_cost: FinalCost | None = None
    x_goal: Any = None
    goal_tolerance: Any = None  # becomes an array, or stays None
    waypoints: Any = None  # becomes a dict
    constraints: Any = ()  # becomes a tuple of Constraints
    couplings: Any = ()  # becomes a tuple of Couples
    goals: Any = ()  # becomes a tuple of Goals
    horizon: Any = None  # becomes a pair, or stays None
    bounds: Any = None  # Bounds
    optimize: Sequence[str] = ("controls",)
    initial_state_mask: Any = None
    us: Any = None
    parameters: Any = ()  # becomes a ParameterVector
    parameter_bounds: Mapping[str, tuple[Any, Any]] | None = None
    trajectory_cost: Callable[[Any, Any], Any] | None = None
    parameter_cost: Callable[[Any], Any] | None = None
    motion: str = STEPS

    def __post_init__(self) -> None:
        system = self.system
        if not isinstance(system, (Model, Dynamics)):
            raise InputError("system", got=type(system).__name__, expected="a Model or Dynamics")
        x0 = state_of(system, "x0", self.x0, system.default_state)
        state = system.finite_state if isinstance(system, Model) else partial(finite_array, shape=(self.nx,))
        self._set("x0", state("x0", x0))
        self._set("num_steps", number_of_steps(self.num_steps))
        self._set("optimize", _check_optimize(self.optimize))
        if isinstance(system, Model):
            given = self.parameters
            if isinstance(given, ParameterVector) and given.model is not system:
                given = given.to_dict()
            self._set("parameters", select(system, given))
            limits = plant_limits(system)
            check_closed(system, "x0", self.x0)
        else:
            all_of_them = (
                self.optimizes_parameters and isinstance(self.parameters, (tuple, list)) and not self.parameters
            )
            asked = system.parameters if all_of_them else self.parameters
            self._set("parameters", system.with_parameters(asked).parameters)
            limits = vars(system.bounds)
        self._check_parameters()
        bounds = resolve_bounds(bounds_of(system, self.bounds), limits, self.state_names, self.input_names)
        self._set("bounds", bounds)
        self._set("initial_state_mask", self._check_mask())
        shape = (self.num_steps, self.nu)
        # The default has strides of 0, so that dataclasses.replace with another num_steps makes it anew.
        is_default = self.us is None or (isinstance(self.us, np.ndarray) and not any(self.us.strides))
        us = np.broadcast_to(0.0, shape) if is_default else finite_array("us", self.us, shape)
        if not is_default and not self.optimizes_controls:
            check_inside("us", us, bounds.u_lower, bounds.u_upper, self.input_names)
        self._set("us", us)
        check_inside("x0", self.x0, bounds.x_lower, bounds.x_upper, self.state_names)
        self._set("waypoints", self._check_waypoints())
        if self.x_goal is not None:
            self._set("x_goal", self._check_state("x_goal", self.x_goal, self._last_before_goal()))
        if self.goal_tolerance is not None:
            self._set("goal_tolerance", self._check_goal_tolerance())
        self._set("constraints", self._check_constraints())
        self._set("couplings", self._check_couplings())
        self._set("goals", self._check_goals())
        self._check_kept()
        if self.horizon is not None and self.is_map:
            raise InputError(
                "horizon", got="given", expected="no horizon for a DiscreteMap, whose time counts its steps"
            )
        if self.horizon is not None:
            self._set("horizon", _check_horizon(self.horizon))
        elif not self.has_model and not self.is_map:
            raise InputError("horizon", got="none", expected="a number of seconds, or (lower, upper)")
        self._check_costs()
        self._check_quantities()
        self._check_motion()

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def __repr__(self) -> str:
        counts = ((self.nx, "state"), (self.nu, "input"), (self.num_steps, "step"))
        sizes = ", ".join(f"{n} {word}{'s' * (n != 1)}" for n, word in counts)
        free = self.horizon is not None and self.horizon[0] < self.horizon[1]
        time = f"{self.horizon[0]:g} to {self.horizon[1]:g}" if free else f"{self.start_horizon:g}"
        time = "" if self.is_map else f" in {time} s"
        goal = "" if self.x_goal is None else f" to x_goal = {short(self.x_goal)}"
        lines = [f"Problem of {self.name}: {sizes}{time}", f"from x0 = {short(self.x0)}{goal}"]
        if self.goal_tolerance is not None:
            given = np.flatnonzero(~np.isnan(self.goal_tolerance))
            lines.append(
                f"to within {', '.join(f'{self.goal_tolerance[i]:g} of {self.state_names[i]}' for i in given)}"
            )
        for name in ("running_cost", "final_cost", "trajectory_cost", "parameter_cost"):
            cost = getattr(self, name)
            if cost is not None:
                has_repr = isinstance(cost, (QuadraticCost, ConstantCost, TrackingCost, SumOfCosts))
                description = repr(cost) if has_repr else getattr(cost, "__qualname__", type(cost).__name__)
                lines.append(f"{name.replace('_', ' ')}: {description}")
        if self.waypoints:
            lines.append(f"waypoints at knots {', '.join(map(str, self.waypoints))}")
        lines += [f"constraint: {constraint!r}" for constraint in self.constraints]
        lines += [f"coupling: {coupling!r}" for coupling in self.couplings]
        lines += [f"goal: {goal!r}" for goal in self.goals]
        named = f" ({', '.join(self.parameters.names)})" if self.parameters.names else ""
        lines.append(f"optimize: {', '.join(self.optimize)}{named}")
        return "\n  ".join(lines)

    @property
    def has_model(self) -> bool:
        """Whether the system is a model rather than plain dynamics."""
        return isinstance(self.system, Model)

    @property
    def is_map(self) -> bool:
        """Whether the system is a `DiscreteMap`, whose time is the step index."""
        return isinstance(self.system, DiscreteMap)

    @property
    def moved(self) -> Model | None:
        """The model that defines the states, also under fixed contacts, or None for plain functions."""
        return self.system if isinstance(self.system, Model) else self.system.model

    @property
    def model(self) -> Model:
        """The model. Raises ModelError for plain dynamics."""
        if not isinstance(self.system, Model):
            raise ModelError("the problem has plain dynamics and no model")
        return self.system

    @cached_property
    def dynamics(self) -> Dynamics:
        """The dynamics x' = f(x, u) with the problem's parameters: a model's equations of motion, or plain dynamics.

        Raises ModelError if the model has no equations of motion.
        """
        if isinstance(self.system, Model):
            return plant_dynamics(self.system, self.parameters)
        return self.system.with_parameters(self.parameters)

    @property
    def name(self) -> str:
        """The model's name, or "plain dynamics"."""
        return "plain dynamics" if self.moved is None else self.moved.name

    @property
    def nx(self) -> int:
        return self.system.nx

    @property
    def nu(self) -> int:
        return self.system.nu

    @property
    def state_names(self) -> tuple[str, ...]:
        return self.system.state_names

    @property
    def input_names(self) -> tuple[str, ...]:
        return self.system.input_names

    @property
    def start_horizon(self) -> float:
        """The time [s] from the first state to the last at the start of a search, which changes a free `horizon`."""
        if isinstance(self.system, Model):
            whole = self.num_steps * self.system.time_step
            return whole if self.horizon is None else float(np.clip(whole, *self.horizon))
        if self.is_map:
            return float(self.num_steps)
        return float(sum(self.horizon) / 2)

    @property
    def time_step(self) -> float:
        """The model's time step [s], or, for plain dynamics, one interval of `start_horizon`."""
        return self.system.time_step if isinstance(self.system, Model) else self.start_horizon / self.num_steps

    @property
    def phases(self) -> tuple["Problem", ...]:
        """The problem itself, because a problem that is not a `PhasedProblem` is one phase."""
        return (self,)

    @cached_property
    def kept(self) -> tuple[Constraint, ...]:
        """All constraints of a motion except bounds: the given constraints, and those of goals and orientations."""
        return (*self.constraints, *self.kept_goals, *self._orientations)

    @cached_property
    def _orientations(self) -> tuple[Constraint, ...]:
        """Constraints on free bodies' orientations at waypoints and goal. Quaternions may grow in length over steps."""
        none, asked = np.zeros(3), {**self.waypoints, self.num_steps: self.goal}
        return tuple(
            Constraint(_Parallel(q, state[q]), none, none, [knot], f"orientation from {self.state_names[q.start]} on")
            for knot, state in asked.items()
            for q in self._orientations_of(state)
        )

    @cached_property
    def kept_goals(self) -> tuple[GoalConstraint, ...]:
        """The constraints on the model that follow from the goals without a weight."""
        return tuple(constraint for goal in self.goals if goal.weight is None for constraint in self._bound(goal))

    def _bound(self, goal: Goal) -> Iterator[GoalConstraint]:
        for constraint in goal.bind_to(self):
            yield cast(GoalConstraint, constraint.resolved(self.x0, np.zeros(self.nu)))

    @cached_property
    def total_running_cost(self) -> Any:
        """The running cost with the costs of weighted goals along the whole motion, or None."""
        return self._with_goals(self.running_cost, None)

    @cached_property
    def total_final_cost(self) -> Any:
        """The final cost with the costs of weighted goals at the end, or None."""
        return self._with_goals(self.final_cost, LAST)

    def _with_goals(self, cost: Any, knots: Any) -> Any:
        soft = [goal for goal in self.goals if goal.weight is not None and goal.knots == knots]
        terms = tuple((cast(float, goal.weight), constraint) for goal in soft for constraint in self._bound(goal))
        if terms and isinstance(cost, TimedCost):
            return SumOfCosts((cost, WithGoals(None, terms)))
        return WithGoals(cost, terms) if terms else cost

    @cached_property
    def design(self) -> Design:
        """The variables of a search through the model's discrete steps besides states and inputs."""
        return Design(
            self.model,
            self.parameters,
            self.bounds_of_parameters(),
            free=self.optimizes_parameters,
            horizon=self.horizon,
            start=self.start_horizon,
            num_steps=self.num_steps,
        )

    @property
    def optimizes_controls(self) -> bool:
        return "controls" in self.optimize

    @property
    def optimizes_parameters(self) -> bool:
        return "parameters" in self.optimize

    def bounds_of_parameters(self) -> tuple[Array, Array]:
        """Return the bounds (lower (np,), upper (np,)) of the parameter vector, infinite if not given."""
        lower, upper = np.full(len(self.parameters.values), -np.inf), np.full(len(self.parameters.values), np.inf)
        given = self.parameter_bounds or {}
        for p, s in zip(self.parameters.parameters, self.parameters.slices, strict=True):
            if p.kind.positive:
                lower[s] = SMALLEST_PART * self.parameters.values[s]
            if p.name in given:
                lower[s], upper[s] = given[p.name]
        return lower, upper

    @property
    def goal(self) -> Array:
        """The final state (nx,) that a plan must reach, NaN for free entries."""
        return np.full(self.nx, np.nan) if self.x_goal is None else np.asarray(self.x_goal)

    @property
    def start(self) -> Array:
        """The initial state (nx,), NaN for entries that may change."""
        return np.where(self.initial_state_mask, np.nan, self.x0)

    @property
    def initial_state_is_given(self) -> bool:
        return not self.initial_state_mask.any()

    def state_limits(self) -> tuple[Array, Array]:
        """Return the bounds (lower (N+1, nx), upper (N+1, nx)) of each state, equal at given x0, waypoints and goal."""
        sides = [np.tile(side, (self.num_steps + 1, 1)) for side in (self.bounds.x_lower, self.bounds.x_upper)]
        for knot, wanted in {0: self.start, **self.waypoints, self.num_steps: self.goal}.items():
            for side in sides:
                side[knot] = np.where(np.isnan(wanted), side[knot], wanted)
            for entries in self._orientations_of(wanted) if knot else ():  # constrained by `kept`
                for side, bounds in zip(sides, (self.bounds.x_lower, self.bounds.x_upper), strict=True):
                    side[knot, entries] = bounds[entries]
        return sides[0], sides[1]

    def knots_of(self, c: Constraint, *, input_at_end: bool) -> tuple[int, ...]:
        """Return the knots of `c`. Discrete methods have no input at knot N, collocation has one (`input_at_end`)."""
        return c.at_knots(self.num_steps + int(input_at_end and c.takes_input), self.initial_state_is_given)

    def coupled(self, *, input_at_end: bool) -> tuple[BoundCoupling, ...]:
        """Return the couplings of selected knots; see `knots_of`."""
        sizes = self.num_steps, self.nx, self.nu
        return tuple(c.bound(*sizes, input_at_end=input_at_end) for c in self.couplings if isinstance(c, Joins))

    @property
    def rate_limits(self) -> tuple[RateLimit, ...]:
        """The couplings of all pairs or triples of successive knots."""
        return tuple(c for c in self.couplings if isinstance(c, RateLimit))

    @property
    def limits_jerk(self) -> bool:
        """Whether a rate limit applies to the slopes of x'."""
        return any(limit.of_slopes and not limit.of_inputs for limit in self.rate_limits)

    def coupled_steps(self, time_step: float | None = None) -> tuple[BoundCoupling, ...]:
        """Return all couplings of a motion in steps of `time_step` [s], by default the step where a search starts."""
        h = self.start_horizon / self.num_steps if time_step is None else time_step
        rates = [rate.of_steps(self.system, self.num_steps, h) for rate in self.rate_limits]
        return (*self.coupled(input_at_end=False), *rates)

    def constraint_excess(
        self, xs: Array, us: Array, knots: Indices | None = None, coupled: Sequence[BoundCoupling] | None = None
    ) -> dict[str, tuple[float, int]]:
        """Return each constraint's largest excess over its bounds along xs (M+1, nx) under us, and the excess's row.

        us is (M, nu), or (M+1, nu) at the knots. `knots` (N+1,) are the rows of the problem's own knots after mesh
        refinement, and a constraint on all knots applies to all rows. Waypoints and couplings are included as
        constraints. The couplings are those of steps by default.
        """
        excesses: dict[str, tuple[float, int]] = {}
        where = np.arange(len(xs)) if knots is None else knots
        for c in self.kept:
            own_knots = self.knots_of(c, input_at_end=len(us) == len(xs))
            every = range(own_knots[0], len(us) if c.takes_input else len(xs))  # from 1 if the first state is given
            rows: Any = every if c.knots is None else where[list(own_knots)]
            if c.whole and c.knots is not None:
                rows = range(where[own_knots[0]], where[own_knots[-1]] + 1)
            worst = max((c.excess(xs[k], us[min(k, len(us) - 1)]), int(k)) for k in rows)
            excesses[c.label] = max(worst, excesses.get(c.label, worst))
        for knot, wanted in self.waypoints.items():
            distance = np.abs(self.distance(xs[where[knot]], wanted))
            excesses[f"waypoint at knot {knot}"] = (float(np.max(distance, initial=0.0)), int(where[knot]))
        return excesses | excess_of(self.coupled_steps() if coupled is None else coupled, xs, us, where)

    def state_scales(self, xs: Array) -> Array:
        """Return the scale (nx,) of each state's tolerances, in its unit, from its range along xs (M, nx).

        A joint of several directions has the range of the one that moves most. A position that need not travel has at
        least STAYS of its bounds, an angle at most STAYS of a radian, and a length without bounds STAYS of the body's
        radius of gyration. The velocity of such a position has STAYS of its limits, or of the position's bounds over
        the horizon. Bounds such as 1e30 are ignored, see WIDEST. A state at rest has 1e-6 of the largest of its
        magnitude, required values, a radian and the body's radius of gyration, and its velocity has this over the
        horizon. If all these are 0, the scale is 1e-6 of the bound.
        """
        asked = np.vstack([xs, self.x0, *self.waypoints.values(), self.goal])
        scales, sizes = np.ptp(xs, axis=0), np.max(np.nan_to_num(np.abs(asked), posinf=0.0), axis=0)
        sizes = np.minimum(sizes, 1 / NOTHING)
        for q, _, size, _ in self._vectors:
            sizes[q] = np.maximum(np.max(sizes[q]), size)
        way, width, least = self._way(xs), self.bounds.x_upper - self.bounds.x_lower, STILL * sizes
        room = np.where(width / WIDEST <= sizes, np.minimum(width, REACH * sizes), 0.0)
        for q, v, size, turns in self._vectors:
            for places in (q, v):
                scales[places], least[places] = np.max(scales[places]), np.max(least[places])
            room[q] = min(np.max(room[q]) or size, size) if turns else np.max(room[q]) or size
            limits = np.where(width[v] / WIDEST <= sizes[v], np.minimum(width[v], FASTER * sizes[v]), 0.0)
            room[v] = np.max(limits) or room[q[0]] / self.start_horizon
            least[v] = np.maximum(least[v], least[q[0]] / self.start_horizon)
        least = np.maximum(least, np.where(way <= STILL * room, STAYS * room, 0.0))
        return _not_zero(np.maximum(scales, least), self.bounds.x_lower, self.bounds.x_upper)

    def input_scales(self, us: Array) -> Array:
        """Return the largest magnitude (nu,) of each input along us (M, nu), or 1e-6 of its bound if that is 0."""
        return _not_zero(np.max(np.abs(us), axis=0, initial=0.0), self.bounds.u_lower, self.bounds.u_upper)

    def spans(self, xs: Array, us: Array) -> Array:
        """Return `state_scales` and `input_scales`, concatenated (nx + nu,)."""
        return np.concatenate([self.state_scales(xs), self.input_scales(us)])

    def search_spans(self, xs: Array, us: Array, slopes: Array, horizon: float) -> Array:
        """Return how far states and inputs (nx + nu,) may move in a search from xs (M, nx), us (M, nu), in any units.

        The spans come from x0, waypoints, goal and the guess. A state that is constant there has what moves another one
        by its span over the `horizon` [s], by `slopes` (nx, nx + nu) of x', or its change due to others. So has an
        input, or its magnitude in the guess if larger, within bounds. Others have 1, or their bound if that is smaller.
        """
        b, nx = self.bounds, self.nx
        given = np.vstack([xs, np.where(self.initial_state_mask, np.nan, self.x0), *self.waypoints.values(), self.goal])
        spans = np.concatenate([_spread(given), np.zeros(self.nu)])
        spans[:nx][spans[:nx] <= STILL**2 * np.max(np.nan_to_num(np.abs(given)), axis=0)] = 0.0
        driven = horizon * np.nan_to_num(slopes[:, :nx], posinf=0.0)
        moved = np.maximum(driven @ spans[:nx], driven @ (driven @ spans[:nx]))  # by others, and by what these move
        spans[:nx][spans[:nx] <= STILL**2 * moved] = 0.0  # rounding of a guess such as 1e-19
        for _ in spans:
            with np.errstate(divide="ignore", invalid="ignore"):
                drives = spans[:nx, None] / (horizon * slopes)
            drives = np.min(np.where((spans[:nx, None] > 0) & (slopes > 0), drives, np.inf), axis=0)
            driven = np.concatenate([horizon * slopes @ spans, np.zeros(self.nu)])
            spans = np.where(spans > 0, spans, np.where(np.isfinite(drives), drives, driven))
        wide = (b.u_upper - b.u_lower) / 2
        wide = np.where(np.isfinite(wide) & (wide > 0), wide, np.inf)
        known = np.where(spans[nx:] > 0, spans[nx:], np.minimum(wide, 1.0))
        inputs = np.minimum(np.maximum(known, np.max(np.abs(us), axis=0, initial=0.0)), wide)
        spans = np.append(spans[:nx], inputs)
        return np.where(spans > 0, spans, 1.0)

    def feasibility_scales(self, xs: Array, us: Array, values: Array, knots: Indices) -> dict[str, float]:
        """Return the scale of each state, input, parameter (from `values` (np,)), constraint, coupling and the horizon.

        The keys are the names of excesses along xs (M, nx) under us (M, nu). Solver tolerances are relative to these.
        """
        spans, us = self.spans(xs, us), np.vstack([us, np.tile(us[-1:], (len(xs) - len(us), 1))])
        scales = dict(zip((*self.state_names, *self.input_names), spans, strict=True))
        scales |= dict(
            zip(self.parameters.names, np.maximum(np.abs(values), np.abs(self.parameters.values)), strict=True)
        )
        scales["horizon"] = self.start_horizon
        for c in self.kept:
            scales[c.label] = max(float(np.max(c.scales(xs, us, spans))), scales.get(c.label, 0.0))
        for bound in self.coupled(input_at_end=False):
            scales[bound.label] = float(np.max(bound.scales(xs[knots], us[knots], spans), initial=0.0))
        scales |= {limit.label: float(np.max(limit.entries(self.system)[1])) for limit in self.rate_limits}
        return scales

    def goal_tolerances(self, xs: Array) -> Array:
        """Return the allowed distance (nx,) of each final state from the goal: as given, or 1 % of its required change.

        The required change is the range of the values at x0, waypoints and goal. A state that returns to its start,
        within RETURNS of its range along xs (M, nx), has this range instead, such as a velocity from rest to rest.
        """
        scales = self.state_scales(xs)
        way = self._way(xs)
        tolerances = GOAL_PART * np.where(way > RETURNS * scales, way, scales)
        given = tolerances if self.goal_tolerance is None else self.goal_tolerance
        return np.where(self.has_goal_tolerance, given, tolerances)

    def _way(self, xs: Array) -> Array:
        """Return the range (nx,) of each state's values at x0, waypoints and goal, shared by a joint's directions."""
        x0 = np.where(self.initial_state_mask, xs[0], self.x0)
        way = _spread(np.vstack([x0, *self.waypoints.values(), self.goal]))
        for q, v, *_ in self._vectors:
            way[q], way[v] = np.max(way[q]), np.max(way[v])
        return way

    @property
    def has_goal_tolerance(self) -> Array:
        """A mask (nx,) of the states whose `goal_tolerance` is given."""
        return ~np.isnan(np.full(self.nx, np.nan) if self.goal_tolerance is None else self.goal_tolerance)

    @cached_property
    def _quaternions(self) -> tuple[int, ...]:
        return () if self.moved is None else tangent_space(self.moved).quaternions

    @cached_property
    def _vectors(self) -> list[tuple[Indices, Indices, float, bool]]:
        return [] if self.moved is None else vectors_of(self.moved)

    def goal_error(self, x: Array) -> Array:
        """Return the distance (nx,) of `x` from the goal; see `distance`."""
        return self.distance(x, self.goal)

    def distance(self, x: Array, wanted: Array) -> Array:
        """Return the distance (nx,) of `x` from `wanted`, 0 if free, regardless of quaternions' lengths and signs."""
        state, wanted = np.array(x), self._with_the_signs_of(x, wanted)
        for entries in self._orientations_of(wanted):
            state[entries] *= np.linalg.norm(wanted[entries]) / np.linalg.norm(state[entries])
        return np.where(np.isnan(wanted), 0.0, state - wanted)

    def _orientations_of(self, wanted: Array) -> list[slice]:
        """Return the slices of the quaternions whose four entries are all given in the state `wanted` (nx,)."""
        every = [slice(start, start + 4) for start in self._quaternions]
        return [entries for entries in every if not np.isnan(wanted[entries]).any()]

    @cached_property
    def is_orientation(self) -> Indices:
        """A mask (nx,) of the goal's entries that belong to an orientation, which `kept` constrains."""
        mask = np.zeros(self.nx, dtype=bool)
        for entries in self._orientations_of(self.goal):
            mask[entries] = True
        return mask

    def cost_of_parameters(self, values: Array) -> float:
        """Return the `parameter_cost` of the values (np,), or 0 if there is none."""
        return 0.0 if self.parameter_cost is None else float(self.parameter_cost(values))

    def objective(self, xs: Array, inputs: Array, time_step: float | None = None) -> float:
        """Return the objective of xs (N+1, nx) under inputs (N, nu) held over each step, without `parameter_cost`.

        Inputs (N+1, nu) are at the knots, and the running cost is then integrated by the trapezoid rule. Steps have the
        length `time_step` [s], by default that of the model.
        """
        return float(np.sum(self.cost_terms(xs, inputs, time_step)))

    @property
    def has_cost(self) -> bool:
        """Whether the problem has a cost, also of weighted goals."""
        costs = self.total_running_cost, self.total_final_cost, self.trajectory_cost, self.parameter_cost
        return any(cost is not None for cost in costs)

    def least_cost(self, x0: Array, time_step: float) -> float:
        """Return a millionth of the cost of resting at `x0` (nx,) under inputs of 0. Smaller costs count as zero."""
        return STILL * abs(
            self.objective(np.tile(x0, (self.num_steps + 1, 1)), np.zeros((self.num_steps, self.nu)), time_step)
        )

    def cost_terms(self, xs: Array, inputs: Array, time_step: float | None = None) -> Array:
        """Return the terms of `objective` for the knots, the final state and the whole motion."""
        h = self.time_step if time_step is None else time_step
        running, final, rates = self.total_running_cost, self.total_final_cost, np.zeros(0)
        if running is not None:
            before = xs[: len(inputs)]
            quadratic = quadratic_along(running, h * np.arange(float(len(inputs))))
            if quadratic is not None or getattr(running, "takes_rows", False):
                rates = (quadratic or running)(before, inputs)
            else:
                along = enumerate(zip(before, inputs, strict=True))
                rates = np.array([float(cost_at(running, k * h)(x, u)) for k, (x, u) in along])
            if len(inputs) == len(xs):
                rates[0], rates[-1] = rates[0] / 2, rates[-1] / 2
        ends = [] if final is None else [float(final(xs[-1]))]
        whole = [] if self.trajectory_cost is None else [float(self.trajectory_cost(xs, inputs))]
        return np.concatenate([h * rates, ends, whole])

    def _check_parameters(self) -> None:
        vector, given = self.parameters, self.parameter_bounds or {}
        if self.optimizes_parameters and not vector.parameters:
            raise InputError("parameters", got="none", expected='at least one name, as "parameters" is in optimize')
        if TIME_STEP in {p.name for p in vector.parameters}:
            raise InputError(
                "parameters",
                got=TIME_STEP,
                expected="parameters other than the time step, as the horizon is num_steps * model.time_step",
            )
        for name in given:
            if name not in {p.name for p in vector.parameters}:
                raise UnknownNameError("parameter_bounds", got=name, known=[p.name for p in vector.parameters])
            if name.endswith(".inertia"):
                raise InputError(
                    f"parameter_bounds of {name}",
                    got="bounds",
                    expected="no bounds, as an inertia stays physically possible",
                )
        check_inside("parameters", vector.values, *self.bounds_of_parameters(), vector.names)

    def _check_mask(self) -> Array:
        free = "initial_state" in self.optimize
        if self.initial_state_mask is None:
            return np.full(self.nx, free)
        mask = np.asarray(self.initial_state_mask)
        if mask.shape != (self.nx,):
            raise ShapeError("initial_state_mask", got=mask.shape, expected=(self.nx,))
        if mask.dtype != bool or mask.any() != free:
            expected = "booleans, of which some are True" if free else 'no True without "initial_state" in optimize'
            raise InputError("initial_state_mask", got=f"{mask.tolist()}", expected=expected)
        return mask

    def _check_state(self, subject: str, given: Any, before: Array) -> Array:
        """Check the state `given` (nx,), NaN where free, and give its quaternions the signs nearer to `before`."""
        named = state_of(self.system, subject, given, np.full(self.nx, np.nan))
        state = array_with_gaps(subject, named, (self.nx,))
        if np.any(np.isinf(state)):
            raise InputError(subject, got=state, expected="finite numbers, NaN where free")
        check_inside(subject, state, self.bounds.x_lower, self.bounds.x_upper, self.state_names)
        for entries in self._orientations_of(state):
            if not state[entries].any():
                raise InputError(subject, got="a quaternion of zeros", expected="an orientation")
        return self._with_the_signs_of(before, state)

    def _with_the_signs_of(self, x: Array, state: Array) -> Array:
        """Return `state` (nx,) with each quaternion or its negative, the same orientation, nearer to that of `x`."""
        signed = np.array(state)
        for q in self._quaternions:
            if signed[q : q + 4] @ x[q : q + 4] < 0:
                signed[q : q + 4] = 0.0 - signed[q : q + 4]
        return frozen(signed)

    def _check_goal_tolerance(self) -> Array:
        subject = "goal_tolerance"
        named = state_of(self.system, subject, self.goal_tolerance, np.full(self.nx, np.nan))
        tolerance = array_with_gaps(subject, named, (self.nx,))
        for i in np.flatnonzero(~np.isnan(tolerance)):
            if not 0 < tolerance[i] < np.inf:
                raise InputError(f"{subject}, {self.state_names[i]}", got=tolerance[i], expected="a positive number")
            if np.isnan(self.goal[i]):
                raise InputError(
                    f"{subject}, {self.state_names[i]}",
                    got=tolerance[i],
                    expected="no tolerance, as the entry has no goal",
                )
        return tolerance

    def _check_waypoints(self) -> dict[int, Array]:
        given = {} if self.waypoints is None else self.waypoints
        if not isinstance(given, Mapping):
            raise InputError("waypoints", got=f"{given!r:.80}", expected="a mapping from knots to states")
        subject = "knots of waypoints (the last state has x_goal)"
        knots = {count(subject, k, 1, self.num_steps - 1): state for k, state in given.items()}
        states, before = dict[int, Array](), self.x0
        for k, state in sorted(knots.items()):
            states[k] = self._check_state(f"waypoint at knot {k}", state, before)
            before = np.where(np.isnan(states[k]), before, states[k])
        return states

    def _last_before_goal(self) -> Array:
        """Return the last value (nx,) that x0 and the waypoints give for each state."""
        last = self.x0
        for state in self.waypoints.values():
            last = np.where(np.isnan(state), last, state)
        return last

    def _check_constraints(self) -> tuple[Constraint, ...]:
        where = "; pass a coupling as couplings=" if isinstance(self.constraints, Couples) else ""
        like = "a Constraint or several, such as Constraint(lambda x, u: x[0] + u[0], upper=1)"
        given = several("constraints", self.constraints, Constraint, f"{like}{where}")
        return tuple(constraint.resolved(self.x0, np.zeros(self.nu)) for constraint in given)

    def _check_couplings(self) -> tuple[Couples, ...]:
        kinds = "Periodic, Coupling, InputRate, Acceleration, Jerk, or several"
        couplings = several("couplings", self.couplings, Couples, kinds)
        self._set("couplings", couplings)
        taken = {c.label for c in self.constraints}
        for c in couplings:
            if c.label in taken:
                raise InputError("couplings", got=f"two named {c.label}", expected="a different name for each")
            taken.add(c.label)
            if isinstance(c, RateLimit):
                c.entries(self.system)
        for bound in self.coupled(input_at_end=not (self.has_model or self.is_map)):
            self._check_given(bound)
        return couplings

    def _check_given(self, bound: BoundCoupling) -> None:
        """Raise InputError if the states of a coupling are all given and violate it."""
        lower, upper = self.state_limits()
        knots = np.unique(bound.knots)
        if bound.takes_input or np.any(lower[knots] != upper[knots]):
            return
        excess, _ = bound.excess(lower, np.zeros((len(lower), self.nu)), np.arange(len(lower)))
        if not excess <= SAME_STATE:
            raise InputError(
                f"coupling {bound.label}",
                got=f"states that violate it by {excess:.3g}",
                expected="states that satisfy it",
            )

    def _check_goals(self) -> tuple[Goal, ...]:
        given = several("goals", self.goals, Goal, "a goal such as FrameGoal, or several")
        if given and not self.has_model:
            raise InputError("goals", got="given", expected="no goals with plain dynamics, as goals need a model")
        for doubt in doubts_of(given, self.model, self.x0) if given else ():
            warnings.warn(doubt, ModelWarning, stacklevel=4)
        return given

    def _check_kept(self) -> None:
        """Bind the goals, which checks their names, and check the knots and given states of all constraints."""
        if self.has_model:
            sides = np.array([self.bounds.u_lower, self.bounds.u_upper])
            check_inside("bounds", sides, *self.model.inputs.one_sided, self.input_names)
        for constraint in self.kept:
            self.knots_of(constraint, input_at_end=not self.has_model)
        for constraint in self.kept_goals:
            if isinstance(constraint, ClearanceConstraint):
                if self.initial_state_is_given:
                    constraint.check("x0", self.x0)
                if not np.any(np.isnan(self.goal[: self.model.nq])):
                    constraint.check("x_goal", np.nan_to_num(self.goal))
                continue
            miss = constraint.miss(self.x0) if constraint.knots is None and self.initial_state_is_given else 0.0
            if miss > constraint.tolerance:
                allowed = in_words(constraint.tolerance, constraint.unit)
                raise InputError(
                    f"x0 and goal {constraint.label}", got=constraint.told(miss), expected=f"at most {allowed}"
                )
            fixed = self._fixed_values(constraint)
            apart = np.maximum(constraint.lower - fixed, fixed - constraint.upper)
            for i in np.flatnonzero(apart > NO_SLOPE)[:1]:
                got = f"{constraint.wanted[i]:.6g} for entry {i}, which is {fixed[i]:.6g} in every state of {self.name}"
                raise InputError(
                    f"goal {constraint.label}", got=got, expected="targets of entries that a joint can change"
                )

    def _fixed_values(self, constraint: GoalConstraint) -> Array:
        """Return the values (m,) of a goal's rows that do not depend on the coordinates, and NaN for the other rows."""
        random, none = np.random.default_rng(0), np.zeros(self.nu)
        states = self.x0 + random.standard_normal((TRIED, self.nx))
        pairs = [constraint.differentiate(x, none) for x in states]
        values, slopes = np.array([v for v, _ in pairs]), np.array([np.max(np.abs(j), axis=1) for _, j in pairs])
        still = (np.max(slopes, axis=0) <= NO_SLOPE) & (np.ptp(values, axis=0) <= NO_SLOPE)
        return np.where(still, values[0], np.nan)

    def _check_costs(self) -> None:
        if isinstance(self.running_cost, (int, float)) and self.horizon is not None:
            self._set("running_cost", ConstantCost(positive_float("running_cost", self.running_cost)))
        self._set("running_cost", running_cost_of(self.running_cost))
        costs = (self.running_cost, self.final_cost, self.trajectory_cost, self.parameter_cost)
        asked = self.goals or self.constraints or self.couplings
        if all(cost is None for cost in costs) and np.all(np.isnan(self.goal)) and not asked:
            raise InputError("problem", got="no cost and no goal", expected="a cost, an x_goal, goals or constraints")
        for name in ("running_cost", "final_cost", "trajectory_cost", "parameter_cost"):
            self._set(name, user_function(name, getattr(self, name), ndim=2 if name == "trajectory_cost" else 1))
            cost = getattr(self, name)
            if cost is not None and not callable(cost) and not (name == "running_cost" and isinstance(cost, TimedCost)):
                expected = "a QuadraticCost or a function, such as lambda x, u: u[0] ** 2"
                raise InputError(name, got=type(cost).__name__, expected=expected)
            if isinstance(cost, (QuadraticCost, TimedCost)):
                cost.check_sizes(name, self.nx, self.nu)
        with np.errstate(all="ignore"):
            self._call_costs()

    def _call_costs(self) -> None:
        """Call each cost once with floats, so that a cost without a scalar value is rejected before a solve."""
        for _, cost, arguments in self._user_costs():
            cost(*(argument.copy() for argument in arguments))
        if self.trajectory_cost is not None:
            self.trajectory_cost(np.tile(self.x0, (self.num_steps + 1, 1)), np.array(self.us))

    def _user_costs(self) -> Iterator[tuple[str, Any, tuple[Array, ...]]]:
        """Yield the costs of a knot, with their names and their arguments at the first knot."""
        if self.running_cost is not None:
            yield "running_cost", cost_at(self.running_cost, 0.0), (self.x0, self.us[0])
        if self.final_cost is not None:
            yield "final_cost", self.final_cost, (self.x0,)

    def check_derivatives(self) -> None:
        """Raise GradientError if a cost of a knot loses its derivatives, for any method."""
        for name, cost, arguments in self._user_costs():
            ends = np.cumsum([0, *map(len, arguments)])
            z = InitializeAutoDiff(np.concatenate(arguments)).ravel()
            with np.errstate(all="ignore"):
                result = cost(*(z[a:b] for a, b in pairwise(ends)))
            if not isinstance(np.asarray(result).item(), AutoDiffXd):
                raise GradientError(f"{named(name, cost)} lost its derivatives: write it in {ORDINARY}")

    def _check_parameter_cost(self, cost: Callable[[Any], Any]) -> None:
        """Check the cost by one call with AutoDiffXd."""
        if not self.optimizes_parameters:
            raise InputError(
                "parameter_cost", got="given", expected='"parameters" in optimize, as the cost is constant otherwise'
            )
        try:
            differentiate_final_cost(cost, np.array(self.parameters.values))
        except (GradientError, TypeError, ValueError, IndexError, AttributeError) as error:
            expected = "a function of the parameters' values (np,) in ordinary arithmetic, without float()"
            raise InputError("parameter_cost", got=f"{type(error).__name__}: {error}", expected=expected) from error

    def _check_motion(self) -> None:
        if self.motion not in MOTIONS:
            raise UnknownNameError("motion", got=self.motion, known=MOTIONS)
        if self.motion == STEPS:
            return
        if not self.has_model:
            raise InputError(
                "motion", got=repr(self.motion), expected=f'"{STEPS}" for plain dynamics, as other motions need a model'
            )
        if self.horizon is not None:
            expected = "no horizon, as a motion in continuous time lasts num_steps * model.time_step"
            raise InputError("horizon", got="given", expected=expected)
        with self.intervals(self.parameters):
            pass  # raises an error if the model has no such motion

    @contextmanager
    def intervals(self, vector: ParameterVector) -> Iterator[Intervals]:
        """Yield the model's intervals from knot to knot. The parameters are applied while the block runs."""
        with applied(vector) as model:
            yield intervals_of(model, vector, self.motion)

    def _check_quantities(self) -> None:
        """Call each function once with the parameters applied. Functions of the model's original values raise."""
        if self.parameter_cost is not None:
            self._check_parameter_cost(self.parameter_cost)
        if not self.parameters.parameters or not self.has_model:
            return
        xs = np.tile(self.x0, (self.num_steps + 1, 1))
        with applied(self.parameters), np.errstate(all="ignore"):
            self.constraint_excess(xs, self.us)
            self.objective(xs, self.us)


def _spread(values: Array) -> Array:
    """Return the range (n,) of each column of values (M, n) without NaN, or 0 for a column of NaN."""
    lowest, highest = (np.nan_to_num(sign * values, nan=np.inf).min(axis=0) for sign in (1, -1))
    return np.where(np.isnan(values).all(axis=0), 0.0, -highest - lowest)


def _not_zero(scales: Array, lower: Array, upper: Array) -> Array:
    """Replace `scales` (n,) below NOTHING by 1e-6 of a finite bound, or else of the largest scale, or else of 1.

    A bound counts as at most WIDEST times the largest scale, if there is one.
    """
    scales = np.where(scales < NOTHING, 0.0, scales)
    largest = np.max(scales, initial=0.0)
    sides = [np.where(np.isfinite(side), np.abs(side), 0.0) for side in (lower, upper)]
    for others in (np.minimum(np.max(sides, axis=0) / WIDEST, largest or np.inf) * WIDEST, largest, 1.0):
        scales = np.where(scales == 0, STILL * others, scales)
    return scales


def _check_optimize(optimize: Sequence[str]) -> tuple[str, ...]:
    names = (optimize,) if isinstance(optimize, str) else optimize
    if not isinstance(names, (tuple, list, set, frozenset)) or not names:
        raise InputError("optimize", got=repr(optimize), expected="at least one of " + ", ".join(OPTIMIZABLE))
    for name in names:
        if name not in OPTIMIZABLE:
            raise UnknownNameError("optimize", got=name, known=OPTIMIZABLE)
    return tuple(names)


def _check_horizon(given: Any) -> tuple[float, float]:
    pair = given if isinstance(given, (tuple, list)) else (given, given)
    if len(pair) != 2:
        raise InputError("horizon", got=repr(given), expected="a number of seconds, or (lower, upper)")
    lower, upper = (seconds("horizon [s]", value) for value in pair)
    if lower > upper:
        raise InputError("horizon", got=repr(given), expected="a lower bound of at most the upper bound")
    return lower, upper
