"""What a transcription solves, checked: dynamics, ends, waypoints, costs, bounds and constraints over a horizon."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, finite_array
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.cost import FinalCost, QuadraticCost, differentiate_cost
from drake_diff.optimize.problem.dynamics import Dynamics, Pointwise, plant_dynamics
from drake_diff.optimize.problem.problem import Bounds, Problem, checked_horizon, checked_state, checked_waypoints
from drake_diff.optimize.transcription.scheme import SCHEMES, Scheme, node_fractions


class RunningRate:
    """A running cost at many knots: a number [per s], a QuadraticCost, or a function (x, u) -> scalar."""

    def __init__(self, cost: Any, dynamics: Dynamics):
        self.cost, self.nx, self.width = cost, dynamics.nx, dynamics.nx + dynamics.nu
        self.quadratic = isinstance(cost, QuadraticCost)
        self.constant = None
        if cost is None or np.isscalar(cost):
            self.constant = float(finite_array("running_cost", 0.0 if cost is None else cost, ()))
        elif self.quadratic:
            cost.check_sizes("running_cost", dynamics.nx, dynamics.nu)
        else:
            self._at = Pointwise("running_cost", cost, self.nx, (), dynamics.probe())

    def __call__(self, x: Any, u: Any) -> Any:
        """The rate at x (nx,), u (nu,): floats or what else goes through the cost."""
        return self.cost(x, u) if self.constant is None else self.constant

    def values(self, knots: Array) -> Array:
        """(K,) at `knots` (K, nx + nu)."""
        if self.constant is not None:
            return np.full(len(knots), self.constant)
        if self.quadratic:
            return np.asarray(self.cost.along(knots[:, : self.nx], knots[:, self.nx :]))
        return self._at.values(knots)[:, 0]

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """(K,) and the gradients (K, nx + nu)."""
        if self.constant is not None:
            return self.values(knots), np.zeros(knots.shape)
        if self.quadratic:
            found = [differentiate_cost(self.cost, k[: self.nx], k[self.nx :]) for k in knots]
            return np.array([v for v, _, _ in found]), np.array([np.concatenate(g) for _, *g in found])
        values, rows = self._at.linearize(knots)
        return values[:, 0], rows[:, 0]


@dataclass(frozen=True, eq=False)
class PathConstraint:
    """A constraint at the nodes at `fractions` of the horizon, or, where None, at all but a given first one."""

    constraint: Constraint
    fractions: Array | None
    first: int

    def nodes(self, mesh: Array, scheme: Scheme) -> Indices:
        """The numbers of its nodes on `mesh` (N+1,), which holds the fractions."""
        if self.fractions is not None:
            return nodes_at(self.fractions, mesh, scheme)
        return np.arange(self.first, scheme.nodes * (len(mesh) - 1) + 1)


def nodes_at(fractions: Array, mesh: Array, scheme: Scheme) -> Indices:
    """The numbers of the nodes at `fractions` of the horizon that knots of `mesh` lie at."""
    return scheme.nodes * np.argmin(np.abs(mesh[None] - np.asarray(fractions)[:, None]), axis=1)


@dataclass(frozen=True, eq=False)
class OptimalControl:
    """What is transcribed, checked: NaN in `x0`, `x_goal` and waypoints is free; `horizon` (lower, upper) [s]."""

    dynamics: Dynamics
    x0: Array  # (nx,)
    x_goal: Array  # (nx,)
    horizon: tuple[float, float]
    rate: RunningRate
    final_cost: FinalCost | None
    bounds: Bounds
    scheme: Scheme
    waypoints: tuple[tuple[float, Array], ...] = ()  # fraction of the horizon, state (nx,)
    paths: tuple[PathConstraint, ...] = ()

    @property
    def time_is_free(self) -> bool:
        return self.horizon[0] < self.horizon[1]

    def final(self, x: Any) -> Any:
        """The final cost at `x` (nx,)."""
        return 0.0 if self.final_cost is None else self.final_cost(x)

    def node_limits(self, mesh: Array) -> tuple[Array, Array]:
        """(lower, upper), each (K, nx + nu): the bounds of the nodes, equal where an end or a waypoint is given."""
        b, nx, count = self.bounds, self.dynamics.nx, len(node_fractions(mesh, self.scheme))
        sides = [np.tile(np.concatenate(s), (count, 1)) for s in ((b.x_lower, b.u_lower), (b.x_upper, b.u_upper))]
        if self.scheme.input_is_linear:  # Drake bounds knots alone
            sides[0][1::2], sides[1][1::2] = -np.inf, np.inf
        between = [(int(nodes_at(np.array([at]), mesh, self.scheme)[0]), wanted) for at, wanted in self.waypoints]
        for node, wanted in ((0, self.x0), *between, (-1, self.x_goal)):
            for side in sides:
                side[node, :nx] = np.where(np.isnan(wanted), side[node, :nx], wanted)
        return sides[0], sides[1]

    def path_excess(self, nodes: Array, mesh: Array) -> dict[str, float]:
        """The largest excess over its bounds of each path constraint at `nodes` (K, nx + nu); inf where no number."""
        nx = self.dynamics.nx
        found: dict[str, float] = {}
        for path in self.paths:
            c = path.constraint
            worst = max(c.excess(k[:nx], k[nx:]) for k in nodes[path.nodes(mesh, self.scheme)])
            found[c.label] = max(worst, found.get(c.label, 0.0))
        return found


def task_of(problem: Problem, scheme: str) -> OptimalControl:
    """What `problem` asks of a collocation scheme; ModelError where its model has no continuous form."""
    return checked_task(
        plant_dynamics(problem.model),
        np.linspace(0, 1, problem.num_steps + 1),
        x0=np.where(problem.initial_state_mask, np.nan, problem.x0),
        x_goal=problem.goal,
        waypoints=problem.waypoints,
        horizon=problem.horizon or problem.num_steps * problem.model.time_step,
        running_cost=problem.running_cost,
        final_cost=problem.final_cost,
        bounds=problem.bounds,
        constraints=problem.constraints,
        scheme=scheme,
    )


def checked_task(
    dynamics: Dynamics,
    mesh: Array,
    *,
    x0: Any,
    x_goal: Any,
    waypoints: Mapping[int, Any] | None,
    horizon: Any,
    running_cost: Any,
    final_cost: Any,
    bounds: Any,
    constraints: Any,
    scheme: str,
) -> OptimalControl:
    """The arguments of `transcribe_and_solve` as a task, knots being those of `mesh` (N+1,); InputError and its kin."""
    if not isinstance(dynamics, Dynamics):
        raise InputError("dynamics", got=type(dynamics).__name__, expected="Dynamics or plant_dynamics(model)")
    if scheme not in SCHEMES:
        raise UnknownNameError("scheme", got=scheme, known=SCHEMES)
    if not (bounds is None or isinstance(bounds, Bounds)):
        raise InputError("bounds", got=type(bounds).__name__, expected="Bounds")
    if isinstance(final_cost, QuadraticCost):
        final_cost.check_sizes("final_cost", dynamics.nx, dynamics.nu)
    elif final_cost is not None:
        Pointwise(
            "final_cost", lambda x, u: final_cost(x), dynamics.nx, (), dynamics.probe()
        )  # raises where it is none
    limits = dynamics.limits(bounds)
    free = np.full(dynamics.nx, np.nan)
    start = checked_state("x0", x0, None, dynamics.state_names)
    goal = free if x_goal is None else checked_state("x_goal", x_goal, limits, dynamics.state_names)
    if running_cost is None and final_cost is None and np.all(np.isnan(goal)):
        raise InputError("problem", got="no cost and no goal", expected="a cost, an x_goal, or both")
    rate = RunningRate(running_cost, dynamics)
    pair = horizon if isinstance(horizon, (tuple, list)) else (horizon, horizon)
    time = checked_horizon(pair, "a number of seconds, or (lower, upper)")
    task = OptimalControl(dynamics, start, goal, time, rate, final_cost, limits, SCHEMES[scheme])
    paths = _check_constraints(task, mesh, constraints)
    given = checked_waypoints(waypoints, len(mesh) - 1, limits, dynamics.state_names)
    return replace(task, waypoints=tuple((float(mesh[knot]), state) for knot, state in given.items()), paths=paths)


def _check_constraints(task: OptimalControl, mesh: Array, given: Any) -> tuple[PathConstraint, ...]:
    constraints = given if isinstance(given, (tuple, list)) else (given,)
    first_is_given, found = bool(np.all(np.isfinite(task.x0))), []
    x, u = np.split(task.dynamics.probe()[0], [task.dynamics.nx])
    for c in constraints:
        if not isinstance(c, Constraint):
            raise InputError("constraints", got=type(c).__name__, expected="Constraints")
        knots = c.at_knots(len(mesh) - 1 + int(c.takes_input), first_is_given)
        fractions = None if c.knots is None else mesh[list(knots)]
        found.append(PathConstraint(c.resolved(x, u), fractions, knots[0]))
    return tuple(found)
