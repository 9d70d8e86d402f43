"""The linear-quadratic problem around a motion, with gaps and boxes, and the Riccati recursion that solves it.

Minimize sum_k g_k' z_k + z_k' H_k z_k / 2 + (the same of dx_N), z_k = [dx_k; du_k], where
dx_(k+1) = F_k z_k + f_k and lower_k <= du_k <= upper_k. The gaps f_k are those of Mastalli et al., "Crocoddyl", 2020,
the boxes those of Tassa, Mansard and Todorov, "Control-limited differential dynamic programming", 2014.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.optimize.ilqr import riccati_kernel

BOX_ITERATIONS = 30
HALVINGS = np.asarray(0.5 ** np.arange(20), dtype=np.float64)
ROUNDING_OF_CURVATURE = 1e-8  # of the inputs' curvature: makes one that is only just not positive definite so
LEAST_SCALE = 1e-12  # of the largest diagonal entry: an input of no effect has a ridge too


@dataclass(frozen=True, eq=False)
class LinearQuadratic:
    """N steps of n states and m inputs; dx_0 lies in [start_lower, start_upper], which is 0 if it is given."""

    F: Array  # (N, n, n + m)
    gaps: Array  # (N, n)
    gradients: Array  # (N+1, n + m), whose last entries are those of x_N and zeros
    hessians: Array  # (N+1, n + m, n + m)
    lower: Array  # (N, m)
    upper: Array  # (N, m)
    start_lower: Array  # (n,)
    start_upper: Array  # (n,)

    @property
    def num_states(self) -> int:
        return self.gaps.shape[1]

    @property
    def final_gradient(self) -> Array:
        """(n,)"""
        return self.gradients[-1, : self.num_states]

    @property
    def final_hessian(self) -> Array:
        """(n, n)"""
        return self.hessians[-1, : self.num_states, : self.num_states]

    def unbounded(self) -> "LinearQuadratic":
        """The same without bounds of the inputs."""
        wide = np.full_like(self.lower, np.inf)
        return replace(self, lower=-wide, upper=wide)

    def multipliers(self) -> Array:
        """(N, n): v_k = d cost / d x_(k+1), all inputs as they are and all gaps kept."""
        n, v = self.num_states, np.empty_like(self.gaps)
        v[-1] = self.final_gradient
        for k in range(len(v) - 1, 0, -1):
            v[k - 1] = self.gradients[k, :n] + self.F[k, :, :n].T @ v[k]
        return v


@dataclass(frozen=True, eq=False)
class AffinePolicy:
    """du_k = feedforward_k + feedback_k dx_k from dx_0 = start; what it promises if all gaps are 0.

    What remains to be paid from knot k on is value_gradients_k' dx_k + dx_k' value_hessians_k dx_k / 2, and a constant.
    `slope` and `curvature` are those of the quadratic model along the step: it changes the cost by
    a slope + a^2 curvature / 2 at the step size a. `gradient` is the largest |d cost / d u| of an input, or
    |d cost / d x_0|, that no bound holds.
    """

    start: Array  # (n,)
    feedforward: Array  # (N, m)
    feedback: Array  # (N, m, n)
    value_gradients: Array  # (N+1, n)
    value_hessians: Array  # (N+1, n, n)
    slope: float
    curvature: float
    gradient: float

    @property
    def expected(self) -> float:
        """The decrease that a full step promises, as a positive number."""
        return -(self.slope + self.curvature / 2)


def solve_riccati(problem: LinearQuadratic, regularization: float) -> AffinePolicy | None:
    """The best policy, `regularization` times its own diagonal added to the inputs' Hessian.

    None if that is not positive definite. So the step is about 1 + `regularization` times shorter, whatever the units.
    """
    n, (count, m) = problem.num_states, problem.lower.shape
    P, s = np.empty((count + 1, n, n)), np.empty((count + 1, n))  # what remains to be paid
    P[-1], s[-1] = problem.final_hessian, problem.final_gradient
    K, free = np.empty((count, m, n + 1)), np.ones((count, m), dtype=bool)  # feedforward and feedback
    gradients, hessians = np.empty((count, m)), np.empty((count, m, m))  # by the inputs
    is_solved = riccati_kernel.sweep(
        _contiguous(problem.F),
        _contiguous(problem.gaps),
        _contiguous(problem.gradients),
        _contiguous(problem.hessians),
        _contiguous(problem.lower),
        _contiguous(problem.upper),
        float(regularization),
        LEAST_SCALE,
        BOX_ITERATIONS,
        HALVINGS,
        P,
        s,
        K,
        free,
        gradients,
        hessians,
    )
    if not is_solved:
        return None
    try:
        start, left = _best_start(problem, P[0], s[0], regularization)
    except np.linalg.LinAlgError:
        return None
    d = K[:, :, 0]
    slope = float(np.sum(gradients * d) + s[0] @ start)
    along = (hessians @ d[:, :, None])[:, :, 0]
    curvature = float(np.sum(along * d) + start @ P[0] @ start)
    gradient = float(np.abs(gradients[free]).max(initial=left))
    if not math.isfinite(slope + curvature):  # NaN passes for positive definite
        return None
    return AffinePolicy(start, d, K[:, :, 1:], s, P, slope, curvature, gradient)


def _contiguous(array: Array) -> Array:
    """Itself, or a copy that is contiguous and may be written: of others the sweep would be compiled once more."""
    flags = array.flags
    return (
        array if flags.c_contiguous and flags.writeable and array.dtype == float else np.array(array, float, order="C")
    )


def _best_start(problem: LinearQuadratic, P: Array, s: Array, regularization: float) -> tuple[Array, float]:
    """(dx_0 (n,), largest |s| of an entry that no bound holds)."""
    start = np.zeros(len(s))
    moves = np.flatnonzero(problem.start_lower < problem.start_upper)
    if not len(moves):
        return start, 0.0
    hessian = P[np.ix_(moves, moves)]
    riccati_kernel.add_ridge(hessian, float(regularization), LEAST_SCALE)
    lower, upper = problem.start_lower[moves], problem.start_upper[moves]
    start[moves], free = minimize_in_box(hessian, s[moves], lower, upper)
    return start, float(np.abs(s[moves[free]]).max(initial=0.0))


def minimize_in_box(hessian: Array, gradient: Array, lower: Array, upper: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(d, free): argmin of gradient' d + d' hessian d / 2 within [lower, upper], by projected Newton steps.

    `free` is where d is not held by a bound. Raises LinAlgError if the Hessian is not positive definite.
    """
    np.linalg.cholesky(hessian)
    d, free = np.empty(len(gradient)), np.ones(len(gradient), dtype=bool)
    H, g, low, high = _contiguous(hessian), _contiguous(gradient), _contiguous(lower), _contiguous(upper)
    if not riccati_kernel.minimize_in_box(H, g, low, high, BOX_ITERATIONS, HALVINGS, d, free):
        raise np.linalg.LinAlgError
    return d, free


def least_regularized(problem: LinearQuadratic) -> AffinePolicy | None:
    """The best policy; None where the inputs' Hessian is not positive definite by more than rounding."""
    return solve_riccati(problem, 0.0) or solve_riccati(problem, ROUNDING_OF_CURVATURE)


def follow(problem: LinearQuadratic, policy: AffinePolicy, *, clipped: bool = False) -> tuple[Array, Array]:
    """(dxs (N+1, n), dus (N, m)) of the full linear step, which closes the gaps; its inputs may be `clipped`."""
    n, (count, m) = problem.num_states, problem.lower.shape
    dxs, dus = np.empty((count + 1, n)), np.empty((count, m))
    dxs[0] = policy.start
    for k, (F, f, d, K) in enumerate(zip(problem.F, problem.gaps, policy.feedforward, policy.feedback, strict=True)):
        dus[k] = d + K.dot(dxs[k])
        if clipped:
            dus[k] = np.clip(dus[k], problem.lower[k], problem.upper[k])
        dxs[k + 1] = F[:, :n].dot(dxs[k]) + F[:, n:].dot(dus[k]) + f
    return dxs, dus


def slope_along(problem: LinearQuadratic, dxs: Array, dus: Array) -> tuple[float, float]:
    """(slope, curvature) of the cost along a step (N+1, n), (N, m)."""
    zs = np.hstack([dxs, np.vstack([dus, np.zeros((1, dus.shape[1]))])])
    bent = (problem.hessians @ zs[:, :, None])[:, :, 0]
    return float(np.sum(problem.gradients * zs)), float(np.sum(bent * zs))
