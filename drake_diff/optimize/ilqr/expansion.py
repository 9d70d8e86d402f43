"""The linear-quadratic problem around a motion: Drake's step Jacobians, the cost's derivatives, learned curvature.

All in Drake's own coordinates, quaternions included: the discrete step lets a quaternion's norm grow, so that the norm
is a state that inputs move, and on the rotations' tangent space the gradient would be wrong by what is left out.
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
from drake_diff.optimize.ilqr.constraints import Active, AugmentedLagrangian
from drake_diff.optimize.ilqr.riccati import LinearQuadratic
from drake_diff.optimize.problem.cost import (
    cost_at,
    differentiate_cost,
    differentiate_final_cost,
    final_cost_hessian,
    quadratic_along,
    running_cost_hessian,
)
from drake_diff.optimize.problem.problem import Problem

# Of a state, or of 1: Jacobians are known to 1e-12, so that this leaves 1e-6 of their derivative.
DIFFERENCE_STEP = 1e-6
SMALLEST_MOVE = 1e-7  # below it rounding of the Jacobians, 1e-12, is too large a part of their difference
SAFE_DIVISOR = 1e-6  # of |dz| |r|: SR1 is not defined where dz' r vanishes


@dataclass(frozen=True, eq=False)
class Motion:
    """xs (N+1, nx) and us (N, nu), a rollout where the gaps (N, nx), step(x_k, u_k) - x_(k+1), are zero.

    The steps are of the problem's `design` at the coordinates c (nc,).
    """

    xs: Array
    us: Array
    gaps: Array
    c: Array = field(default_factory=lambda: np.zeros(0))

    @property
    def point(self) -> tuple[Array, Array]:
        """(xs, us)."""
        return self.xs, self.us

    @property
    def ends(self) -> Array:
        """(N, nx): where the steps lead."""
        return self.xs[1:] + self.gaps

    @property
    def is_rollout(self) -> bool:
        return not self.gaps.any()

    @property
    def distance(self) -> float:
        """The sum of all |gaps|."""
        return float(np.abs(self.gaps).sum())


def expand(problem: Problem, motion: Motion, jacobians: Array, constraints: AugmentedLagrangian) -> LinearQuadratic:
    """`problem` around `motion`, the constraints being part of its cost.

    What may change beside states and inputs, c, is constant and part of the state: [x, c].
    """
    model, xs, us, design = problem.model, motion.xs, motion.us, problem.design
    h = design.time_step(design.values(motion.c))
    gradients, hessians = expand_running_cost(problem, xs, us, h)
    final_gradient, final_hessian = np.zeros(model.nx), np.zeros((model.nx, model.nx))
    if problem.total_final_cost is not None:
        final_gradient = differentiate_final_cost(problem.total_final_cost, xs[-1])[1]
        final_hessian = final_cost_hessian(problem.total_final_cost, xs[-1])
    if constraints.any:
        gradient, curvature = constraints.differentiate(xs, us)
        gradients += gradient[:-1]
        hessians += curvature[:-1]
        final_gradient = final_gradient + gradient[-1, : model.nx]
        final_hessian = final_hessian + curvature[-1, : model.nx, : model.nx]
    bounds, free = problem.bounds, problem.initial_state_mask
    lower, upper = bounds.u_lower - us, bounds.u_upper - us
    if not problem.optimizes_controls:  # they stay: any curvature will do
        lower, upper, nx = np.zeros_like(us), np.zeros_like(us), model.nx
        gradients[:, nx:], hessians[:, nx:], hessians[:, :, nx:] = 0.0, 0.0, 0.0
        hessians[:, nx:, nx:] = np.eye(us.shape[1])
    expansion = LinearQuadratic(
        F=jacobians,
        gaps=motion.gaps,
        gradients=gradients,
        hessians=hessians,
        final_gradient=final_gradient,
        final_hessian=final_hessian,
        lower=lower,
        upper=upper,
        start_lower=np.where(free, bounds.x_lower - xs[0], 0.0),
        start_upper=np.where(free, bounds.x_upper - xs[0], 0.0),
    )
    return _with_design(problem, motion, expansion, h) if len(motion.c) else expansion


def with_active(
    problem: Problem, motion: Motion, model: LinearQuadratic, rows: AugmentedLagrangian, old: Active, new: Active
) -> LinearQuadratic:
    """`model` of `motion`, in which the `old` rows push, as if the `new` ones pushed, and they alone."""
    nx, n = motion.xs.shape[1], model.F.shape[2]
    columns = np.r_[:nx, nx + len(motion.c) : n]  # where x and u are in [x, c, u]
    before, after = rows.differentiate(*motion.point, old), rows.differentiate(*motion.point, new)
    gradient, curvature = after[0] - before[0], after[1] - before[1]
    gradients, hessians = np.array(model.gradients), np.array(model.hessians)
    final_gradient, final_hessian = np.array(model.final_gradient), np.array(model.final_hessian)
    gradients[:, columns] += gradient[:-1]
    hessians[:, columns[:, None], columns] += curvature[:-1]
    final_gradient[:nx] += gradient[-1, :nx]
    final_hessian[:nx, :nx] += curvature[-1, :nx, :nx]
    return replace(
        model, gradients=gradients, hessians=hessians, final_gradient=final_gradient, final_hessian=final_hessian
    )


def _with_design(problem: Problem, motion: Motion, model: LinearQuadratic, h: float) -> LinearQuadratic:
    """The same with c as a part of the state; F has its columns already: (N, nx, nx + nc + nu)."""
    design, c, (count, nx), nu = problem.design, motion.c, motion.gaps.shape, motion.us.shape[1]
    nc, columns = len(c), np.r_[:nx, nx + len(c) : nx + len(c) + nu]  # where x and u are in [x, c, u]
    F, gaps = np.zeros((count, nx + nc, nx + nc + nu)), np.zeros((count, nx + nc))
    F[:, :nx], gaps[:, :nx] = model.F, motion.gaps
    F[:, nx:, nx : nx + nc] = np.eye(nc)
    gradients, hessians = np.zeros((count, nx + nc + nu)), np.zeros((count, nx + nc + nu, nx + nc + nu))
    gradients[:, columns], hessians[:, columns[:, None], columns] = model.gradients, model.hessians
    if design.moves_step and problem.total_running_cost is not None:  # h(c) L(x, u): h is linear in c
        by_step = np.zeros(len(design.vector.values))
        by_step[design.own_count] = 1.0
        slope = design.pull_back(c, by_step)
        along, unit = (
            zip(motion.xs, motion.us, strict=False),
            expand_running_cost(problem, motion.xs, motion.us, 1.0)[0],
        )
        rates = np.array([float(cost_at(problem.total_running_cost, k * h)(x, u)) for k, (x, u) in enumerate(along)])
        gradients[:, nx : nx + nc] = rates[:, None] * slope
        across = unit[:, :, None] * slope
        hessians[:, columns[:, None], np.arange(nx, nx + nc)] += across
        hessians[:, np.arange(nx, nx + nc)[:, None], columns] += across.swapaxes(1, 2)
    final_gradient, final_hessian = np.zeros(nx + nc), np.zeros((nx + nc, nx + nc))
    final_gradient[:nx], final_hessian[:nx, :nx] = model.final_gradient, model.final_hessian
    if problem.parameter_cost is not None:
        cost = problem.parameter_cost

        def of_coordinates(coordinates: Any) -> Any:
            return cost(design.own_at(coordinates))

        final_gradient[nx:] = differentiate_final_cost(of_coordinates, c)[1]
        final_hessian[nx:, nx:] = final_cost_hessian(of_coordinates, c)
    lower, upper = design.limits
    return replace(
        model,
        F=F,
        gaps=gaps,
        gradients=gradients,
        hessians=hessians,
        final_gradient=final_gradient,
        final_hessian=final_hessian,
        start_lower=np.concatenate([model.start_lower, lower - c]),
        start_upper=np.concatenate([model.start_upper, upper - c]),
    )


def expand_running_cost(problem: Problem, xs: Array, us: Array, h: float | None = None) -> tuple[Array, Array]:
    """(gradients (N, nx + nu), Hessians (N, nx + nu, nx + nu)) of h times the running cost.

    h [s] is the model's time step where it is None.
    """
    h = problem.model.time_step if h is None else h
    (nx, nu), cost = (xs.shape[1], us.shape[1]), problem.total_running_cost
    gradients, hessians = np.zeros((len(us), nx + nu)), np.zeros((len(us), nx + nu, nx + nu))
    quadratic = quadratic_along(cost, h * np.arange(float(len(us))))
    if quadratic is not None:
        x_ref = 0.0 if quadratic.x_ref is None else quadratic.x_ref
        u_ref = 0.0 if quadratic.u_ref is None else quadratic.u_ref
        hessians[:] = h * running_cost_hessian(quadratic, xs[0], us[0])
        gradients = np.hstack([xs[:-1] - x_ref, us - u_ref]) @ hessians[0]
    elif cost is not None:
        for k, u in enumerate(us):
            rate = cost_at(cost, k * h)
            gradients[k] = h * np.concatenate(differentiate_cost(rate, xs[k], u)[1:])
            hessians[k] = h * running_cost_hessian(rate, xs[k], u)
    return gradients, hessians


def jacobians_along(problem: Problem, motion: Motion) -> Array:
    """(N, nx, nx + nc + nu): [A_k, C_k, B_k]; raises GradientError or SimulationError if one, or a step, is refused.

    Those of an input on a bound are from inside it: a bound is often the actuator's limit, at which Drake's derivative
    is 0, as beyond it, while a minimization needs to know what leaving the bound would do.
    """
    design, us = problem.design, _off_bounds(problem, motion.us)
    vector = design.at(motion.c)
    with problem.intervals(vector) as intervals:
        if not design.count:
            return intervals.jacobians(motion.xs, us, motion.ends)
        derivatives = intervals.derivatives(motion.xs[0], us, motion.xs[:-1])
    return np.array([np.hstack([d.A, design.pull_back(motion.c, d.C), d.B]) for d in derivatives])


def _off_bounds(problem: Problem, us: Array) -> Array:
    """`us` with those on a bound moved inside it by rounding."""
    lower, upper = problem.bounds.u_lower, problem.bounds.u_upper
    return np.where(us == upper, np.nextafter(us, lower), np.where(us == lower, np.nextafter(us, upper), us))


def curvature_along(problem: Problem, motion: Motion, v: Array) -> tuple[Array, NDArray[np.bool_]] | None:
    """(K, nx + nu, nx + nu) sum_i v_i d2 step_i / d(x, u)2 for v (N, nx), and which K of the N steps (N,) have it.

    Those at a joint limit have none: what their Jacobians and those of free steps differ by is no second derivative. By
    the second derivatives of inverse dynamics, or else by differences of the Jacobians along every state: in its inputs
    alone a smooth step is linear. None where anything touches, a coupler acts, no Jacobians are to be had in one call,
    or the motion is in continuous time. Raises what `linearize` raises.
    """
    model, xs, us = problem.model, motion.xs[:-1], _off_bounds(problem, motion.us)
    if problem.design.vector.parameters or problem.motion != STEPS:
        return None  # what is learned has the parameters in it
    analytic = analytic_of(model)
    if isinstance(analytic, Refusal):
        return None
    steps = known_steps(model, select(model, ()), xs, us, motion.ends)
    if steps.some_touch or model.num_constraints:
        return None
    known = analytic(steps)[1]
    xs, us, v = xs[known], us[known], v[known]
    curvature = analytic.curvature(xs, us, v)
    if curvature is None:  # no step is taken that might not be smooth
        curvature = _differences(lambda xs: analytic.differentiate(xs, us)[0], xs, v)
    return curvature, known


def _differences(jacobians: Callable[[Array], Array], xs: Array, v: Array) -> Array:
    """The same of `jacobians` (N, nx, nx + nu) of the states xs (N, nx)."""
    here, nx = jacobians(xs), xs.shape[1]
    curvature = np.zeros((len(xs), here.shape[2], here.shape[2]))
    for j in range(nx):
        moved = np.array(xs)
        moved[:, j] += DIFFERENCE_STEP * np.maximum(1.0, np.abs(xs[:, j]))
        slopes = (jacobians(moved) - here) / (moved - xs)[:, j, None, None]
        curvature[:, :, j] = np.einsum("kij,ki->kj", slopes, v)
    curvature[:, :nx, nx:] = curvature[:, nx:, :nx].swapaxes(1, 2)
    return (curvature + curvature.swapaxes(1, 2)) / 2


class DynamicsCurvature:
    """The dynamics' second derivatives, learned from the Jacobians of successive motions, for no simulation at all.

    iLQR leaves out sum_i v_i d2 f_i / d z2, v being the multipliers of the dynamics, and crawls where that is large
    beside the cost's curvature. M (N, n + m, n + m) stands for it: symmetric, corrected once for each motion by
    symmetric rank one (SR1; Nocedal and Wright, "Numerical Optimization", 2006, section 6.2) so that
    M_k dz = (F_k(new) - F_k(old))' v; it stays 0 where the dynamics are linear. If more is known of M, it is set.
    """

    def __init__(self) -> None:
        self.M = np.zeros(0)
        self._F = np.zeros(0)

    def update(self, problem: LinearQuadratic, dz: Array) -> None:
        """Learn from the problem around the new motion, dz (N, n + m) being how far it has moved."""
        if not self._F.size:
            self.M, self._F = np.zeros_like(problem.hessians), problem.F
            return
        v = problem.multipliers()
        r = np.einsum("kij,ki->kj", problem.F - self._F, v) - np.einsum("kij,kj->ki", self.M, dz)
        divisor = np.einsum("ki,ki->k", r, dz)
        length = np.linalg.norm(dz, axis=1)
        safe = (length > SMALLEST_MOVE) & (np.abs(divisor) > SAFE_DIVISOR * length * np.linalg.norm(r, axis=1))
        r, divisor = r[safe], divisor[safe]
        self.M[safe] += r[:, :, None] * r[:, None, :] / divisor[:, None, None]
        self._F = problem.F
