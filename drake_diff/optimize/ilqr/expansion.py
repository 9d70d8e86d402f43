"""The linear-quadratic problem around a motion: step Jacobians, derivatives of the cost, curvature of the dynamics.

All derivatives are in Drake's own coordinates, quaternions included. The discrete step lets a quaternion's norm grow,
so the norm is a state that depends on the inputs, and a gradient on the rotations' tangent space would omit this.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal
from drake_diff.derivatives.analytic import analytic_of
from drake_diff.derivatives.steps import known_steps
from drake_diff.model.parameters import select
from drake_diff.motion.rollout import STEPS
from drake_diff.optimize.ilqr.constraints import AugmentedLagrangian
from drake_diff.optimize.ilqr.riccati import LinearQuadratic
from drake_diff.optimize.problem.constraint import Bounds
from drake_diff.optimize.problem.cost import differentiate_final_cost, final_cost_hessian
from drake_diff.optimize.problem.problem import Problem

# Relative to max(1, |state|). Jacobians have errors of 1e-12, so that their differences have errors of 1e-6.
DIFFERENCE_STEP = 1e-6


@dataclass(frozen=True, eq=False)
class Motion:
    """States xs (N+1, nx) and inputs us (N, nu), a rollout if the gaps (N, nx), step(x_k, u_k) - x_(k+1), are zero.

    The steps are those of the problem's `design` at the coordinates c (nc,).
    """

    xs: Array
    us: Array
    gaps: Array
    c: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def with_ends(cls, xs: Array, us: Array, ends: Array) -> "Motion":
        """Return the motion whose steps lead to `ends` (N, nx)."""
        return cls(xs, us, ends - xs[1:])

    @property
    def point(self) -> tuple[Array, Array]:
        """The pair (xs, us)."""
        return self.xs, self.us

    @property
    def ends(self) -> Array:
        """The ends of the steps (N, nx)."""
        return self.xs[1:] + self.gaps

    @property
    def is_rollout(self) -> bool:
        return not self.gaps.any()

    @property
    def distance(self) -> float:
        """The sum of the absolute values of all gaps."""
        return float(np.abs(self.gaps).sum())


def expand_costs(
    problem: Problem, motion: Motion, constraints: AugmentedLagrangian, time_step: float | None = None
) -> tuple[Array, Array]:
    """Return the gradients (N+1, nx + nu) and Hessians (N+1, nx + nu, nx + nu) of the augmented cost at each knot."""
    from drake_diff.optimize.knots import costs_of  # loads CasADi

    gradients, hessians = costs_of(problem, *motion.point, time_step).expand(*motion.point)
    if constraints.any:
        of_rows = constraints.differentiate(*motion.point)
        gradients, hessians = gradients + of_rows[0], hessians + of_rows[1]
    return gradients, hessians


def expand(problem: Problem, motion: Motion, jacobians: Array, constraints: AugmentedLagrangian) -> LinearQuadratic:
    """Expand `problem` around `motion`, with its constraints as part of the cost.

    The coordinates c of the design do not change along the motion and are appended to the state: [x, c].
    """
    xs, us, nx, design = motion.xs, motion.us, problem.nx, problem.design
    h = design.time_step(design.values(motion.c))
    gradients, hessians = expand_costs(problem, motion, constraints, h)
    bounds, free = problem.bounds, problem.initial_state_mask
    lower, upper = bounds.u_lower - us, bounds.u_upper - us
    if not problem.optimizes_controls:  # the inputs are fixed, so that any positive curvature will do
        lower, upper = np.zeros_like(us), np.zeros_like(us)
        gradients[:, nx:], hessians[:, nx:], hessians[:, :, nx:] = 0.0, 0.0, 0.0
        hessians[:-1, nx:, nx:] = np.eye(us.shape[1])
    expansion = LinearQuadratic(
        F=jacobians,
        gaps=motion.gaps,
        gradients=gradients,
        hessians=hessians,
        lower=lower,
        upper=upper,
        start_lower=np.where(free, bounds.x_lower - xs[0], 0.0),
        start_upper=np.where(free, bounds.x_upper - xs[0], 0.0),
    )
    return _with_design(problem, motion, expansion, h) if len(motion.c) else expansion


def _with_design(problem: Problem, motion: Motion, model: LinearQuadratic, h: float) -> LinearQuadratic:
    """Append c to the state. F has the columns of c already: (N, nx, nx + nc + nu)."""
    design, c, (count, nx), nu = problem.design, motion.c, motion.gaps.shape, motion.us.shape[1]
    nc, columns = len(c), np.r_[:nx, nx + len(c) : nx + len(c) + nu]  # columns of x and u in [x, c, u]
    F, gaps = np.zeros((count, nx + nc, nx + nc + nu)), np.zeros((count, nx + nc))
    F[:, :nx], gaps[:, :nx] = model.F, motion.gaps
    F[:, nx:, nx : nx + nc] = np.eye(nc)
    gradients, hessians = np.zeros((count + 1, nx + nc + nu)), np.zeros((count + 1, nx + nc + nu, nx + nc + nu))
    gradients[:, columns], hessians[:, columns[:, None], columns] = model.gradients, model.hessians
    design_columns = np.arange(nx, nx + nc)
    if design.moves_step and problem.total_running_cost is not None:  # h(c) L(x, u): h is linear in c
        from drake_diff.optimize.knots import costs_of  # loads CasADi

        by_step = np.zeros(len(design.vector.values))
        by_step[design.own_count] = 1.0
        slope = design.pull_back(c, by_step)
        costs = costs_of(problem, *motion.point, h)
        gradients[:-1, design_columns] = costs.values(*motion.point)[:-1, None] / h * slope
        across = costs.expand(*motion.point)[0][:-1, :, None] / h * slope
        hessians[:-1, columns[:, None], design_columns] += across
        hessians[:-1, design_columns[:, None], columns] += across.swapaxes(1, 2)
    if problem.parameter_cost is not None:
        cost = problem.parameter_cost

        def of_coordinates(coordinates: Any) -> Any:
            return cost(design.own_at(coordinates))

        gradients[-1, design_columns] = differentiate_final_cost(of_coordinates, c)[1]
        hessians[-1, design_columns[:, None], design_columns] = final_cost_hessian(of_coordinates, c)
    lower, upper = design.limits
    return replace(
        model,
        F=F,
        gaps=gaps,
        gradients=gradients,
        hessians=hessians,
        start_lower=np.concatenate([model.start_lower, lower - c]),
        start_upper=np.concatenate([model.start_upper, upper - c]),
    )


def jacobians_along(problem: Problem, motion: Motion) -> Array:
    """Return [A_k, C_k, B_k] (N, nx, nx + nc + nu), or raise GradientError or SimulationError if a step is refused.

    Derivatives with respect to an input on a bound are taken inside the bound. A bound is often the actuator's limit,
    where Drake's derivative is 0, as it is beyond the limit, but a minimization needs the effect of leaving the bound.
    """
    design, us = problem.design, off_bounds(problem.bounds, motion.us)
    vector = design.at(motion.c)
    with problem.intervals(vector) as intervals:
        if not design.count:
            return intervals.jacobians(motion.xs, us, motion.ends)
        derivatives = intervals.derivatives(motion.xs[0], us, motion.xs[:-1])
    return np.array([np.hstack([d.A, design.pull_back(motion.c, d.C), d.B]) for d in derivatives])


def off_bounds(bounds: Bounds, us: Array) -> Array:
    """Return `us` with inputs on a bound moved to the next floating-point number inside it."""
    lower, upper = bounds.u_lower, bounds.u_upper
    return np.where(us == upper, np.nextafter(us, lower), np.where(us == lower, np.nextafter(us, upper), us))


def curvature_along(problem: Problem, motion: Motion, v: Array) -> tuple[Array, NDArray[np.bool_]] | None:
    """Return sum_i v_i d2 step_i / d(x, u)2 (K, nx + nu, nx + nu) for v (N, nx), and a mask (N,) of those K steps.

    Steps at a joint limit are omitted, because the difference between their Jacobians and those of free steps is no
    second derivative. The curvature comes from the second derivatives of inverse dynamics, or from differences of the
    Jacobians along every state, since a smooth step is linear in its inputs. Returns None if bodies touch, a coupler
    acts, no analytic Jacobians exist, or the motion is in continuous time. Raises the errors of `linearize`.
    """
    model, xs, us = problem.model, motion.xs[:-1], off_bounds(problem.bounds, motion.us)
    if problem.design.vector.parameters or problem.motion != STEPS:
        return None  # only a learned curvature includes parameters
    analytic = analytic_of(model)
    if isinstance(analytic, Refusal):
        return None
    steps = known_steps(model, select(model, ()), xs, us, motion.ends)
    if steps.some_touch or model.num_constraints:
        return None
    known = analytic(steps)[1]
    xs, us, v = xs[known], us[known], v[known]
    curvature = analytic.curvature(xs, us, v)
    if curvature is None:  # this evaluates no step that might not be smooth
        curvature = _differences(lambda xs: analytic.differentiate(xs, us)[0], xs, v)
    return curvature, known


def _differences(jacobians: Callable[[Array], Array], xs: Array, v: Array) -> Array:
    """Compute the curvature from differences of `jacobians` (N, nx, nx + nu) at the states xs (N, nx)."""
    here, nx = jacobians(xs), xs.shape[1]
    curvature = np.zeros((len(xs), here.shape[2], here.shape[2]))
    for j in range(nx):
        moved = np.array(xs)
        moved[:, j] += DIFFERENCE_STEP * np.maximum(1.0, np.abs(xs[:, j]))
        slopes = (jacobians(moved) - here) / (moved - xs)[:, j, None, None]
        curvature[:, :, j] = np.einsum("kij,ki->kj", slopes, v)
    curvature[:, :nx, nx:] = curvature[:, nx:, :nx].swapaxes(1, 2)
    return (curvature + curvature.swapaxes(1, 2)) / 2
