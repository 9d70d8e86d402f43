"""Limits of states, inputs and times: what is given, and a model's own where nothing is; states within them.

What is to be optimized; contains no solver.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, array_with_gaps, finite_array, frozen, positive_float, positive_int
from drake_diff.exceptions import InputError, ShapeError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.parameters import TIME_STEP, applied, select
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.cost import ConstantCost, FinalCost, QuadraticCost


@dataclass(frozen=True, eq=False)
class Bounds:
    """Limits of states (nx,) and inputs (nu,), infinite where there is none.

    The model's own limits (positions, velocities, efforts) apply to a whole array that is None and to each
    entry that is NaN.
    """

    x_lower: Any = None
    x_upper: Any = None
    u_lower: Any = None
    u_upper: Any = None


def resolve_bounds(
    given: Bounds | None, own: Mapping[str, Array], state_names: Sequence[str], input_names: Sequence[str]
) -> Bounds:
    """`given` with the limits of `own` (by the fields' names) where it has none; InputError where two cross."""
    found = {}
    for name, limits in own.items():
        value = getattr(given, name, None)
        checked = limits if value is None else array_with_gaps(name, value, limits.shape)
        found[name] = frozen(np.where(np.isnan(checked), limits, checked))
    for kind, names in (("x", state_names), ("u", input_names)):
        lower, upper = found[f"{kind}_lower"], found[f"{kind}_upper"]
        for i in np.flatnonzero((lower > upper) | (lower == np.inf) | (upper == -np.inf))[:1]:
            got = f"[{lower[i]:g}, {upper[i]:g}]"
            raise InputError(f"bounds of {names[i]}", got=got, expected="lower at most upper")
    return Bounds(**found)


def checked_state(subject: str, given: Any, bounds: Bounds | None, names: Sequence[str]) -> Array:
    """`given` (nx,), NaN where free, within resolved `bounds` if there are any; InputError and its kin where not."""
    state = array_with_gaps(subject, given, (len(names),))
    if np.any(np.isinf(state)):
        raise InputError(subject, got=state, expected="finite numbers, NaN where free")
    if bounds is None:
        return state
    for i in np.flatnonzero((state < bounds.x_lower) | (state > bounds.x_upper))[:1]:
        expected = f"within [{bounds.x_lower[i]:g}, {bounds.x_upper[i]:g}]"
        raise InputError(f"{subject}, {names[i]}", got=float(state[i]), expected=expected)
    return state


def checked_waypoints(
    given: Mapping[int, Any] | None, num_steps: int, bounds: Bounds, names: Sequence[str]
) -> dict[int, Array]:
    """The states (nx,) `given` at knots between the ends, in their order; InputError and its kin of anything else."""
    found = {}
    for knot, state in (given or {}).items():
        if isinstance(knot, bool) or not isinstance(knot, (int, np.integer)) or not 0 < knot < num_steps:
            expected = f"whole numbers from 1 to {num_steps - 1} (the last state's is x_goal)"
            raise InputError("knots of waypoints", got=repr(knot), expected=expected)
        found[int(knot)] = checked_state(f"waypoint at knot {knot}", state, bounds, names)
    return dict(sorted(found.items()))


def checked_horizon(given: Any, expected: str) -> tuple[float, float]:
    """`given` as a pair of times [s], the first at most the second; InputError, `expected` in it, of anything else."""
    if not (isinstance(given, (tuple, list)) and len(given) == 2):
        raise InputError("horizon", got=repr(given), expected=expected)
    lower, upper = (positive_float("horizon [s]", value) for value in given)
    if lower > upper:
        raise InputError("horizon", got=repr(given), expected="lower at most upper")
    return lower, upper


def plant_limits(plant: Any) -> dict[str, Array]:
    """A plant's own limits, by the fields' names of `Bounds`."""
    return {
        "x_lower": np.concatenate([plant.GetPositionLowerLimits(), plant.GetVelocityLowerLimits()]),
        "x_upper": np.concatenate([plant.GetPositionUpperLimits(), plant.GetVelocityUpperLimits()]),
        "u_lower": np.asarray(plant.GetEffortLowerLimits()),
        "u_upper": np.asarray(plant.GetEffortUpperLimits()),
    }


OPTIMIZABLE = ("controls", "initial_state", "parameters")
# A parameter that cannot be negative stays above this part of its first value, unless a bound is given.
SMALLEST_PART = 1e-3


@dataclass(frozen=True, eq=False)
class Problem:
    """Minimize sum_k h * running_cost(x_k, u_k) + final_cost(x_N) over `num_steps` steps of h = model.time_step.

    (Collocation: the transcription's quadrature of the same rate.) `x0` (nx,) is the initial state; `x_goal`
    (nx,) a hard final equality whose NaN entries are free, and so are `waypoints`, a mapping from knots to states.
    `bounds` hold at every state that is not given and for every input, `constraints` at their knots. With
    `horizon` = (lower, upper) [s] the final time is free between them, `num_steps` intervals of equal length
    (collocation); a `running_cost` of 1.0 is then the time itself. `optimize` names what may change: "controls" and/or
    "initial_state", the latter where `initial_state_mask` (nx,) is True, x0 being the first guess there. Controls that
    are not optimized are `us` (N, nu), zero where not given; controls that are optimized start from it.

    `parameters` names some of the model's (see `list_parameters`), or maps names to values, which hold in all steps;
    with "parameters" in `optimize` these are where the search starts, between `parameter_bounds` (a mapping from
    names to (lower, upper)); what cannot be negative stays above 1e-3 of its start where no bound is given, and an
    inertia stays one that a body can have. `trajectory_cost(xs, us)` adds a cost of the whole motion, such as its
    distance from a measured one.

    Raises InputError, ShapeError, NonFiniteError or UnknownNameError, each with expected and got.
    """

    model: Model
    _: KW_ONLY
    x0: Any
    num_steps: int
    running_cost: Any = None  # becomes a RunningCost
    final_cost: FinalCost | None = None
    x_goal: Any = None
    waypoints: Any = None  # becomes a dict
    constraints: Any = ()  # becomes a tuple of Constraints
    horizon: Any = None
    bounds: Any = None  # Bounds
    optimize: Sequence[str] = ("controls",)
    initial_state_mask: Any = None
    us: Any = None
    parameters: Any = ()  # becomes a ParameterVector
    parameter_bounds: Mapping[str, tuple[Any, Any]] | None = None
    trajectory_cost: Callable[[Any, Any], Any] | None = None

    def __post_init__(self) -> None:
        model = self.model
        if not isinstance(model, Model):
            raise InputError("model", got=type(model).__name__, expected="a Model")
        self._set("x0", finite_array("x0", self.x0, (model.nx,)))
        self._set("num_steps", positive_int("num_steps", self.num_steps))
        self._set("optimize", _check_optimize(model, self.optimize))
        self._set("parameters", select(model, self.parameters))
        self._check_parameters()
        if not (self.bounds is None or isinstance(self.bounds, Bounds)):
            raise InputError("bounds", got=type(self.bounds).__name__, expected="Bounds")
        bounds = resolve_bounds(self.bounds, plant_limits(model.plant), model.state_names, model.input_names)
        self._set("bounds", bounds)
        self._set("initial_state_mask", self._check_mask())
        self._set("us", self._check_us())
        self._check_inside("x0", self.x0, "x")
        if self.x_goal is not None:
            self._set("x_goal", checked_state("x_goal", self.x_goal, bounds, model.state_names))
        self._set("waypoints", checked_waypoints(self.waypoints, self.num_steps, bounds, model.state_names))
        self._set("constraints", self._check_constraints())
        if self.horizon is not None:
            self._set("horizon", checked_horizon(self.horizon, "(lower, upper) in seconds"))
        self._check_costs()
        self._check_quantities()

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    @property
    def optimizes_controls(self) -> bool:
        return "controls" in self.optimize

    @property
    def optimizes_parameters(self) -> bool:
        return "parameters" in self.optimize

    def bounds_of_parameters(self) -> tuple[Array, Array]:
        """(lower (np,), upper (np,)) of the parameter vector, infinite where there is none."""
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
        """(nx,) the hard final state; NaN where it is free."""
        return np.full(self.model.nx, np.nan) if self.x_goal is None else np.asarray(self.x_goal)

    @property
    def initial_state_is_given(self) -> bool:
        return not self.initial_state_mask.any()

    def state_limits(self) -> tuple[Array, Array]:
        """(lower (N+1, nx), upper (N+1, nx)): the bounds of each state, x0, waypoints and goal where they are given."""
        sides = [np.tile(side, (self.num_steps + 1, 1)) for side in (self.bounds.x_lower, self.bounds.x_upper)]
        start = np.where(self.initial_state_mask, np.nan, self.x0)
        for knot, wanted in {0: start, **self.waypoints, self.num_steps: self.goal}.items():
            for side in sides:
                side[knot] = np.where(np.isnan(wanted), side[knot], wanted)
        return sides[0], sides[1]

    def constraint_excess(self, xs: Array, us: Array) -> dict[str, tuple[float, int]]:
        """The largest excess over its bounds of each constraint and the knot it is at, at xs (N+1, nx) under us.

        us is (N, nu), or (N+1, nu) at the knots; waypoints are constraints here too.
        """
        found: dict[str, tuple[float, int]] = {}
        for c in self.constraints:
            knots = c.at_knots(self.num_steps, self.initial_state_is_given)
            worst = max((c.excess(xs[k], us[min(k, len(us) - 1)]), k) for k in knots)
            found[c.label] = max(worst, found.get(c.label, worst))
        for k, wanted in self.waypoints.items():
            distance = np.abs(xs[k] - wanted)[~np.isnan(wanted)]
            found[f"waypoint at knot {k}"] = (float(np.max(distance, initial=0.0)), k)
        return found

    def goal_error(self, x: Array) -> Array:
        """(nx,) the distance of `x` from the goal, 0 where the goal is free."""
        goal = self.goal
        return np.where(np.isnan(goal), 0.0, x - np.where(np.isnan(goal), 0.0, goal))

    def objective(self, xs: Array, inputs: Array) -> float:
        """The objective of xs (N+1, nx) under inputs (N, nu) held over each step.

        Inputs (N+1, nu) are at the knots, and the running cost is integrated by the trapezoid rule.
        """
        total = 0.0 if self.final_cost is None else float(self.final_cost(xs[-1]))
        if self.running_cost is not None:
            rates = self._rates(xs[: len(inputs)], inputs)
            if len(inputs) == len(xs):
                rates[0], rates[-1] = rates[0] / 2, rates[-1] / 2
            total += self.model.time_step * float(np.sum(rates))
        if self.trajectory_cost is not None:
            total += float(self.trajectory_cost(xs, inputs))
        return total

    def _rates(self, xs: Array, us: Array) -> Array:
        """(N,): the running cost of xs (N, nx), us (N, nu)."""
        if isinstance(self.running_cost, QuadraticCost):
            return self.running_cost.along(xs, us)
        return np.array([float(self.running_cost(x, u)) for x, u in zip(xs, us, strict=True)])

    def _check_parameters(self) -> None:
        vector, given = self.parameters, self.parameter_bounds or {}
        if self.optimizes_parameters and not vector.parameters:
            raise InputError("parameters", got="none", expected='at least one name, as "parameters" is in optimize')
        if TIME_STEP in {p.name for p in vector.parameters}:
            raise InputError("parameters", got=TIME_STEP, expected="others: the horizon is num_steps * model.time_step")
        for name in given:
            if name not in {p.name for p in vector.parameters}:
                raise UnknownNameError("parameter_bounds", got=name, known=[p.name for p in vector.parameters])
            if name.endswith(".inertia"):
                raise InputError(f"parameter_bounds of {name}", got="bounds", expected="none: it stays possible anyway")
        lower, upper = self.bounds_of_parameters()
        for i in np.flatnonzero(~((lower <= vector.values) & (vector.values <= upper))):
            expected = f"within [{lower[i]:g}, {upper[i]:g}]"
            raise InputError(f"parameters, {vector.names[i]}", got=float(vector.values[i]), expected=expected)

    def _check_mask(self) -> Array:
        nx = self.model.nx
        free = "initial_state" in self.optimize
        if self.initial_state_mask is None:
            return np.full(nx, free)
        mask = np.asarray(self.initial_state_mask)
        if mask.shape != (nx,):
            raise ShapeError("initial_state_mask", got=mask.shape, expected=(nx,))
        if mask.dtype != bool:
            raise InputError("initial_state_mask", got=f"dtype {mask.dtype}", expected="booleans")
        if free and not mask.any():
            raise InputError("initial_state_mask", got="no True entry", expected="at least one free entry")
        if not free and mask.any():
            raise InputError("initial_state_mask", got="a mask", expected='"initial_state" in optimize')
        return mask

    def _check_us(self) -> Array:
        shape = (self.num_steps, self.model.nu)
        if self.us is None:
            return frozen(np.zeros(shape))
        us = finite_array("us", self.us, shape)
        if not self.optimizes_controls:
            self._check_inside("us", us, "u")
        return us

    def _check_inside(self, subject: str, values: Any, kind: str) -> None:
        lower, upper = getattr(self.bounds, f"{kind}_lower"), getattr(self.bounds, f"{kind}_upper")
        names = self.model.state_names if kind == "x" else self.model.input_names
        outside = np.argwhere(np.atleast_2d((values < lower) | (values > upper)))
        if len(outside):
            i = int(outside[0][-1])
            got = float(np.atleast_2d(values)[tuple(outside[0])])
            raise InputError(f"{subject}, {names[i]}", got=got, expected=f"within [{lower[i]:g}, {upper[i]:g}]")

    def _check_constraints(self) -> tuple[Constraint, ...]:
        given = (self.constraints,) if isinstance(self.constraints, Constraint) else tuple(self.constraints)
        for constraint in given:
            if not isinstance(constraint, Constraint):
                raise InputError("constraints", got=type(constraint).__name__, expected="Constraints")
            constraint.at_knots(self.num_steps, self.initial_state_is_given)
        return tuple(constraint.resolved(self.x0, np.zeros(self.model.nu)) for constraint in given)

    def _check_costs(self) -> None:
        if isinstance(self.running_cost, (int, float)) and self.horizon is not None:
            self._set("running_cost", ConstantCost(positive_float("running_cost", self.running_cost)))
        costs = (self.running_cost, self.final_cost, self.trajectory_cost)
        if all(cost is None for cost in costs) and np.all(np.isnan(self.goal)):
            raise InputError("problem", got="no cost and no goal", expected="a cost, an x_goal, or both")
        for name in ("running_cost", "final_cost", "trajectory_cost"):
            cost = getattr(self, name)
            if cost is not None and not callable(cost):
                raise InputError(name, got=type(cost).__name__, expected="a function or a QuadraticCost")
            if isinstance(cost, QuadraticCost):
                cost.check_sizes(name, self.model.nx, self.model.nu)

    def _check_quantities(self) -> None:
        """Call each function once with the parameters applied: what depends on the model's own refuses them."""
        if not self.parameters.parameters:
            return
        x, u = self.x0, np.zeros(self.model.nu)
        with applied(self.parameters), np.errstate(all="ignore"):
            for constraint in self.constraints:
                constraint(x, u)
            if self.running_cost is not None:
                self.running_cost(x, u)
            if self.final_cost is not None:
                self.final_cost(x)
            if self.trajectory_cost is not None:
                self.trajectory_cost(np.tile(x, (self.num_steps + 1, 1)), self.us)


def _check_optimize(model: Model, optimize: Sequence[str]) -> tuple[str, ...]:
    if not isinstance(optimize, (str, tuple, list, set, frozenset)):
        raise InputError("optimize", got=repr(optimize), expected="names out of " + ", ".join(OPTIMIZABLE))
    names = (optimize,) if isinstance(optimize, str) else tuple(optimize)
    if not names:
        raise InputError("optimize", got="nothing", expected="at least one of " + ", ".join(OPTIMIZABLE))
    for name in names:
        if name not in OPTIMIZABLE:
            raise UnknownNameError("optimize", got=name, known=OPTIMIZABLE)
    if "controls" in names and model.nu == 0:
        raise InputError("optimize", got='"controls", but the model has no actuators', expected="an actuated model")
    return names
