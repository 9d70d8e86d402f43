"""The linear-quadratic problem around a motion, with gaps and boxes, and the Riccati recursion that solves it.

Minimize sum_k g_k' z_k + z_k' H_k z_k / 2 + (the same of dx_N), z_k = [dx_k; du_k], where
dx_(k+1) = F_k z_k + f_k and lower_k <= du_k <= upper_k. The gaps f_k are those of Mastalli et al., "Crocoddyl", 2020,
the boxes those of Tassa, Mansard and Todorov, "Control-limited differential dynamic programming", 2014.
"""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff._base.compiled import kernel

KERNEL = "drake_diff.optimize.ilqr.riccati_kernel"
WORTH_COMPILING = 12  # states and inputs: of fewer a search takes less time than Numba takes to load
BOX_ITERATIONS = 30
HALVINGS = 0.5 ** np.arange(20)
LEAST_SCALE = 1e-12  # of the largest diagonal entry: an input of no effect has a ridge too


@dataclass(frozen=True, eq=False)
class LinearQuadratic:
    """N steps of n states and m inputs; dx_0 lies in [start_lower, start_upper], which is 0 if it is given."""

    F: Array  # (N, n, n + m)
    gaps: Array  # (N, n)
    gradients: Array  # (N, n + m)
    hessians: Array  # (N, n + m, n + m)
    final_gradient: Array  # (n,)
    final_hessian: Array  # (n, n)
    lower: Array  # (N, m)
    upper: Array  # (N, m)
    start_lower: Array  # (n,)
    start_upper: Array  # (n,)

    @property
    def num_states(self) -> int:
        return len(self.final_gradient)

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
    compiled = kernel(KERNEL) if problem.F.shape[2] >= WORTH_COMPILING else None
    try:
        if compiled is None:
            swept = _sweep(problem, regularization)
        else:
            swept = _sweep_compiled(compiled, problem, regularization)
        start, left = _best_start(problem, swept.P[0], swept.s[0], regularization)
    except np.linalg.LinAlgError:
        return None
    d = swept.K[:, :, 0]
    slope = float(np.sum(swept.gradients * d) + swept.s[0] @ start)
    along = (swept.hessians @ d[:, :, None])[:, :, 0]
    curvature = float(np.sum(along * d) + start @ swept.P[0] @ start)
    gradient = float(np.abs(swept.gradients[swept.free]).max(initial=left))
    if not math.isfinite(slope + curvature):  # NaN passes for positive definite
        return None
    return AffinePolicy(start, d, swept.K[:, :, 1:], swept.s, swept.P, slope, curvature, gradient)


class _Swept(NamedTuple):
    """What a sweep leaves."""

    P: Array  # (N+1, n, n) and
    s: Array  # (N+1, n), what remains to be paid
    K: Array  # (N, m, n+1) feedforward and feedback
    free: NDArray[np.bool_]  # (N, m) which inputs no bound holds
    gradients: Array  # (N, m) and
    hessians: Array  # (N, m, m), by the inputs


def _sweep_compiled(compiled: Any, problem: LinearQuadratic, regularization: float) -> _Swept:
    """The same as `_sweep`, knot by knot without NumPy's calls."""
    n, (count, m) = problem.num_states, problem.lower.shape
    P, s = np.empty((count + 1, n, n)), np.empty((count + 1, n))
    P[-1], s[-1] = problem.final_hessian, problem.final_gradient
    found = _Swept(
        P,
        s,
        np.empty((count, m, n + 1)),
        np.ones((count, m), dtype=bool),
        np.empty((count, m)),
        np.empty((count, m, m)),
    )
    asked = (problem.F, problem.gaps, problem.gradients, problem.hessians, problem.lower, problem.upper)
    how = float(regularization), LEAST_SCALE, BOX_ITERATIONS, HALVINGS
    if not compiled.sweep(*(_plain(part) for part in asked), *how, *found):
        raise np.linalg.LinAlgError
    return found


def _plain(array: Array) -> Array:
    """Itself, or a copy that is contiguous and may be written: of others the sweep would be compiled once more."""
    flags = array.flags
    return (
        array if flags.c_contiguous and flags.writeable and array.dtype == float else np.array(array, float, order="C")
    )


def _sweep(problem: LinearQuadratic, regularization: float) -> _Swept:
    """The recursion; raises LinAlgError where there is no minimum.

    It is that of [1; dx], so that V = [[c, s'], [s, P]] is all that remains to be paid and K = [feedforward, feedback]
    all that is done, in the fewest products: NumPy's calls, and memory that is new at every knot, are what a sweep's
    time goes to.
    """
    n, (count, m) = problem.num_states, problem.lower.shape
    w = n + 1
    F, VF, Q = np.zeros((w, w + m)), np.empty((w, w + m)), np.empty((w + m, w + m))
    F[0, 0] = 1.0
    V, K, free = np.empty((count + 1, w, w)), np.empty((count, m, w)), np.ones((count, m), dtype=bool)
    gradients, hessians = np.empty((count, m)), np.empty((count, m, m))  # of the inputs
    V[-1, 0, 0], V[-1, 0, 1:], V[-1, 1:, 0] = 0.0, problem.final_gradient, problem.final_gradient
    V[-1, 1:, 1:] = problem.final_hessian
    bounded = np.asarray((np.isfinite(problem.lower) | np.isfinite(problem.upper)).any(axis=1))
    Q_uu, Q_ux, gaps = Q[w:, w:], Q[w:, :w], bool(np.any(problem.gaps))
    for k in range(count - 1, -1, -1):
        F[1:, 1:] = problem.F[k]
        if gaps:
            F[1:, 0] = problem.gaps[k]
        F.T.dot(V[k + 1].dot(F, out=VF), out=Q)
        Q[1:, 1:] += problem.hessians[k]
        Q[0, 1:] += problem.gradients[k]
        Q[1:, 0] += problem.gradients[k]
        hessian = _with_ridge(Q_uu, regularization)
        K_k = _gains(hessian, Q_ux)
        if bounded[k]:
            K_k, free[k] = _within(hessian, Q_ux, K_k, problem.lower[k], problem.upper[k])
        W = Q[:w, :w] + K_k.T.dot(Q_uu.dot(K_k) + Q_ux) + Q_ux.T.dot(K_k)
        np.add(W, W.T, out=V[k])
        V[k] *= 0.5
        K[k], gradients[k], hessians[k] = K_k, Q[w:, 0], Q_uu
    return _Swept(V[:, 1:, 1:], V[:, 0, 1:], K, free, gradients, hessians)


def _within(
    hessian: Array, Q_ux: Array, K: Array, lower: Array, upper: Array
) -> tuple[Array, NDArray[np.bool_] | bool]:
    """(K (m, n+1), which inputs (m,) no bound holds): `K` itself if its feedforward leaves no bound."""
    d = K[:, 0]
    if (d >= lower).all() and (d <= upper).all():
        return K, True
    d, free = minimize_in_box(hessian, Q_ux[:, 0], lower, upper)
    K = np.zeros_like(Q_ux)
    K[free] = _gains(hessian[np.ix_(free, free)], Q_ux[free])
    K[:, 0] = d
    return K, free


def _best_start(problem: LinearQuadratic, P: Array, s: Array, regularization: float) -> tuple[Array, float]:
    """(dx_0 (n,), largest |s| of an entry that no bound holds)."""
    start = np.zeros(len(s))
    moves = np.flatnonzero(problem.start_lower < problem.start_upper)
    if not len(moves):
        return start, 0.0
    hessian = _with_ridge(P[np.ix_(moves, moves)], regularization)
    lower, upper = problem.start_lower[moves], problem.start_upper[moves]
    start[moves], free = minimize_in_box(hessian, s[moves], lower, upper)
    return start, float(np.abs(s[moves[free]]).max(initial=0.0))


def _with_ridge(hessian: Array, regularization: float) -> Array:
    """`hessian` with `regularization` times its diagonal added, of entries that are far below the largest a part of it.

    The ridge of an all-zero diagonal is `regularization` itself.
    """
    if not regularization:
        return hessian
    diagonal = np.abs(np.diagonal(hessian))
    largest = np.max(diagonal)
    scale = np.maximum(diagonal, LEAST_SCALE * largest) if largest > 0 else np.ones(len(diagonal))
    return np.asarray(hessian + regularization * np.diag(scale))


def _gains(hessian: Array, Q_ux: Array) -> Array:
    """(m, n+1): -hessian^-1 Q_ux; raises LinAlgError if the Hessian is not positive definite."""
    if len(hessian) == 1:
        if not hessian[0, 0] > 0:
            raise np.linalg.LinAlgError
        return Q_ux / -hessian[0, 0]
    np.linalg.cholesky(hessian)
    return np.asarray(-np.linalg.solve(hessian, Q_ux), dtype=float)


def minimize_in_box(hessian: Array, gradient: Array, lower: Array, upper: Array) -> tuple[Array, NDArray[np.bool_]]:
    """(d, free): argmin of gradient' d + d' hessian d / 2 within [lower, upper], by projected Newton steps.

    `free` is where d is not held by a bound. Raises LinAlgError if the Hessian is not positive definite.
    """
    np.linalg.cholesky(hessian)
    d = np.clip(np.zeros_like(gradient), lower, upper)
    free = np.ones(len(d), dtype=bool)
    for _ in range(BOX_ITERATIONS):
        slope = gradient + hessian @ d
        free = ~(((d <= lower) & (slope > 0)) | ((d >= upper) & (slope < 0)))
        if not free.any():
            break
        step = np.zeros_like(d)
        step[free] = -np.linalg.solve(hessian[np.ix_(free, free)], slope[free])
        value, before = gradient @ d + d @ hessian @ d / 2, d
        for size in HALVINGS:  # of the projected step, until it lowers the value
            moved = np.clip(before + size * step, lower, upper)
            if gradient @ moved + moved @ hessian @ moved / 2 < value:
                d = moved
                break
        if np.array_equal(before, d):
            break
    return d, free


def follow(problem: LinearQuadratic, policy: AffinePolicy) -> tuple[Array, Array]:
    """(dxs (N+1, n), dus (N, m)) of the full linear step, which closes the gaps."""
    n, (count, m) = problem.num_states, problem.lower.shape
    zs, dx = np.empty((count, n + m)), policy.start
    for z, F, f, d, K in zip(zs, problem.F, problem.gaps, policy.feedforward, policy.feedback, strict=True):
        z[:n] = dx
        z[n:] = d + K.dot(dx)
        dx = F.dot(z) + f
    return np.vstack([zs[:, :n], dx]), zs[:, n:]


def slope_along(problem: LinearQuadratic, dxs: Array, dus: Array) -> tuple[float, float]:
    """(slope, curvature) of the cost along a step (N+1, n), (N, m)."""
    zs, dx = np.hstack([dxs[:-1], dus]), dxs[-1]
    slope = float(np.sum(problem.gradients * zs) + problem.final_gradient @ dx)
    bent = (problem.hessians @ zs[:, :, None])[:, :, 0]
    return slope, float(np.sum(bent * zs) + dx @ problem.final_hessian @ dx)
