"""The linear-quadratic problem around a motion, with gaps and bounds, and the Riccati recursion that solves it.

Minimize sum_k g_k' z_k + z_k' H_k z_k / 2 + (the same terms of dx_N), where z_k = [dx_k; du_k], dx_(k+1) = F_k z_k +
f_k and lower_k <= du_k <= upper_k. The gaps f_k follow Mastalli et al., "Crocoddyl", 2020, and the bounds follow Tassa,
Mansard and Todorov, "Control-limited differential dynamic programming", 2014.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array, Indices, own_array
from drake_diff._base.compiled import compiled, inner

BOX_ITERATIONS = 30
HALVINGS = 20
ROUNDING_OF_CURVATURE = 1e-8  # of the inputs' curvature: makes a Hessian positive definite that is singular by rounding
LEAST_SCALE = 1e-12  # relative to the largest diagonal entry, so that an input without effect is regularized too


@dataclass(frozen=True, eq=False)
class LinearQuadratic:
    """N steps with n states and m inputs. dx_0 lies in [start_lower, start_upper], both 0 for a given initial state."""

    F: Array  # (N, n, n + m)
    gaps: Array  # (N, n)
    gradients: Array  # (N+1, n + m), the last row is the gradient of x_N, followed by zeros
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
        """The gradient (n,) with respect to dx_N."""
        return self.gradients[-1, : self.num_states]

    @property
    def final_hessian(self) -> Array:
        """The Hessian (n, n) with respect to dx_N."""
        return self.hessians[-1, : self.num_states, : self.num_states]

    def unbounded(self) -> "LinearQuadratic":
        """Return the same problem without bounds on the inputs."""
        wide = np.full_like(self.lower, np.inf)
        return replace(self, lower=-wide, upper=wide)

    def multipliers(self) -> Array:
        """Return v_k = d cost / d x_(k+1) (N, n), with the inputs and the gaps held constant."""
        n, v = self.num_states, np.empty_like(self.gaps)
        v[-1] = self.final_gradient
        for k in range(len(v) - 1, 0, -1):
            v[k - 1] = self.gradients[k, :n] + self.F[k, :, :n].T @ v[k]
        return v


@dataclass(frozen=True, eq=False)
class AffinePolicy:
    """A policy du_k = feedforward_k + feedback_k dx_k from dx_0 = start, and its predicted decrease if all gaps are 0.

    The cost-to-go from knot k is value_gradients_k' dx_k + dx_k' value_hessians_k dx_k / 2 plus a constant. `slope` and
    `curvature` are those of the quadratic model along the step, which changes the cost by a slope + a^2 curvature / 2
    at the step size a. `gradient` is the largest |d cost / d u| or |d cost / d x_0| over the entries that are not on a
    bound.
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
        """The predicted decrease of the cost over a full step, as a positive number."""
        return -(self.slope + self.curvature / 2)


def solve_riccati(problem: LinearQuadratic, regularization: float) -> AffinePolicy | None:
    """Return the optimal policy, with `regularization` times the diagonal of the inputs' Hessian added to it.

    Returns None if this Hessian is not positive definite. The step is about 1 + `regularization` times shorter.
    """
    n, (count, m) = problem.num_states, problem.lower.shape
    P, s = np.empty((count + 1, n, n)), np.empty((count + 1, n))  # cost-to-go
    P[-1], s[-1] = problem.final_hessian, problem.final_gradient
    K, free = np.empty((count, m, n + 1)), np.ones((count, m), dtype=bool)  # feedforward and feedback
    gradients, hessians = np.empty((count, m)), np.empty((count, m, m))  # with respect to the inputs
    names = ("F", "gaps", "gradients", "hessians", "lower", "upper")
    arrays: Any = [_contiguous(getattr(problem, name)) for name in names]
    if not _sweep(*[*arrays, float(regularization), P, s, K, free, gradients, hessians]):
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
    if not math.isfinite(slope + curvature):  # a NaN can pass the test for positive definiteness
        return None
    return AffinePolicy(start, d, K[:, :, 1:], s, P, slope, curvature, gradient)


def _contiguous(array: Array) -> Array:
    """Return the array, or a contiguous writable copy. Numba would compile the sweep again for other layouts."""
    flags = array.flags
    return array if flags.c_contiguous and flags.writeable and array.dtype == float else own_array(array.astype(float))


def _best_start(problem: LinearQuadratic, P: Array, s: Array, regularization: float) -> tuple[Array, float]:
    """Return dx_0 (n,) and the largest |s| among the entries that are not on a bound."""
    start = np.zeros(len(s))
    moves = np.flatnonzero(problem.start_lower < problem.start_upper)
    if not len(moves):
        return start, 0.0
    hessian = P[np.ix_(moves, moves)]
    _add_ridge(hessian, float(regularization))
    lower, upper = problem.start_lower[moves], problem.start_upper[moves]
    start[moves], free = minimize_in_box(hessian, s[moves], lower, upper)
    return start, float(np.abs(s[moves[free]]).max(initial=0.0))


def minimize_in_box(hessian: Array, gradient: Array, lower: Array, upper: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Minimize gradient' d + d' hessian d / 2 within [lower, upper] by projected Newton steps. Return (d, free).

    `free` masks the entries of d that are not on a bound. Raises LinAlgError if the Hessian is not positive definite.
    """
    np.linalg.cholesky(hessian)
    d, free = np.empty(len(gradient)), np.ones(len(gradient), dtype=bool)
    H, g, low, high = (_contiguous(array) for array in (hessian, gradient, lower, upper))
    if not _minimize_in_box(H, g, low, high, d, free, np.empty(hessian.shape)):
        raise np.linalg.LinAlgError
    return d, free


def least_regularized(problem: LinearQuadratic) -> AffinePolicy | None:
    """Return the optimal policy, or None if the inputs' Hessian is not positive definite beyond rounding."""
    return solve_riccati(problem, 0.0) or solve_riccati(problem, ROUNDING_OF_CURVATURE)


def follow(problem: LinearQuadratic, policy: AffinePolicy, *, clipped: bool = False) -> tuple[Array, Array]:
    """Return dxs (N+1, n) and dus (N, m) of the full linear step, which closes the gaps. `clipped` bounds dus."""
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
    """Return the slope and the curvature of the cost along the step dxs (N+1, n), dus (N, m)."""
    zs = np.hstack([dxs, np.vstack([dus, np.zeros((1, dus.shape[1]))])])
    bent = (problem.hessians @ zs[:, :, None])[:, :, 0]
    return float(np.sum(problem.gradients * zs)), float(np.sum(bent * zs))


# Functions compiled by Numba. For the few states of a robot, plain loops over rows are faster than BLAS.

Flags = NDArray[np.bool_]


@inner
def _factor(A: Array, which: Indices, L: Array) -> bool:
    """Factor A[which][:, which] = L D L' with D on L's diagonal. Return False if it is not positive definite."""
    for i in range(len(which)):
        for j in range(i + 1):
            total = A[which[i], which[j]]
            for k in range(j):
                total -= L[i, k] * L[j, k] * L[k, k]
            if j < i:
                L[i, j] = total / L[j, j]
            elif total > 0 and total < np.inf:  # false for NaN too
                L[i, i] = total
            else:
                return False
    return True


@inner
def _solve(A: Array, B: Array, which: Indices, L: Array) -> bool:
    """Set B = -A^-1 B for the rows and columns `which`. Return False if A is not positive definite there."""
    if not _factor(A, which, L):
        return False
    m, width = len(which), B.shape[1]
    for i in range(m):
        for k in range(i):
            for c in range(width):
                B[which[i], c] -= L[i, k] * B[which[k], c]
    for i in range(m):
        for c in range(width):
            B[which[i], c] /= -L[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            for c in range(width):
                B[which[i], c] -= L[k, i] * B[which[k], c]
    return True


@inner
def _value(H: Array, g: Array, d: Array) -> float:
    total = 0.0
    for i in range(len(d)):
        row = 0.0
        for j in range(len(d)):
            row += H[i, j] * d[j]
        total += d[i] * (g[i] + row / 2)
    return total


@compiled
def _minimize_in_box(H: Array, g: Array, lower: Array, upper: Array, d: Array, free: Flags, L: Array) -> bool:
    """Minimize g' d + d' H d / 2 over d (m,) within bounds and set `free`. Return False if a part of H fails."""
    m = len(g)
    step, moved = np.empty((m, 1)), np.empty(m)
    for i in range(m):
        d[i] = min(max(0.0, lower[i]), upper[i])
    for _ in range(BOX_ITERATIONS):
        for i in range(m):
            slope = g[i]
            for j in range(m):
                slope += H[i, j] * d[j]
            step[i, 0] = slope
            free[i] = not ((d[i] <= lower[i] and slope > 0) or (d[i] >= upper[i] and slope < 0))
        which = np.flatnonzero(free)
        if not _solve(H, step, which, L):
            return False
        before, size, same = _value(H, g, d), 1.0, True
        for _ in range(HALVINGS):
            moved[:] = d
            for a in which:
                moved[a] = min(max(d[a] + size * step[a, 0], lower[a]), upper[a])
            if _value(H, g, moved) < before:
                same = np.array_equal(d, moved)
                d[:] = moved
                break
            size /= 2
        if same:
            break
    return True


@compiled
def _add_ridge(hessian: Array, regularization: float) -> None:
    """Add `regularization` times max(|H_aa|, LEAST_SCALE times the largest |H_bb|) to each diagonal entry H_aa."""
    m, largest = len(hessian), 0.0
    for a in range(m):
        largest = max(largest, abs(hessian[a, a]))
    for a in range(m if regularization > 0 else 0):
        scale = max(abs(hessian[a, a]), LEAST_SCALE * largest) if largest > 0 else 1.0
        hessian[a, a] += regularization * scale


@inner
def _gains(H: Array, rows: Array, lower: Array, upper: Array, K: Array, free: Flags, L: Array) -> bool:
    """Compute the gain K (m, n+1) = -H^-1 rows with a feedforward within bounds. Return False if there is none."""
    m, leaves = len(rows), False
    K[:] = rows
    if not _solve(H, K, np.arange(m), L):
        return False
    for i in range(m):
        leaves = leaves or not (K[i, 0] >= lower[i] and K[i, 0] <= upper[i])
    if not leaves:
        return True
    d = np.empty(m)
    if not _minimize_in_box(H, rows[:, 0].copy(), lower, upper, d, free, L):
        return False
    for i in range(m):
        for c in range(K.shape[1]):
            K[i, c] = rows[i, c] if free[i] else 0.0
    is_solved = _solve(H, K, np.flatnonzero(free), L)
    K[:, 0] = d
    return is_solved


@inner
def _add_product(A: Array, B: Array, out: Array) -> None:
    """Add A' B to `out`."""
    for k in range(len(A)):
        for i in range(A.shape[1]):
            for c in range(B.shape[1]):
                out[i, c] += A[k, i] * B[k, c]


@compiled
def _sweep(
    F: Array,
    gaps: Array,
    gradients: Array,
    hessians: Array,
    lower: Array,
    upper: Array,
    regularization: float,
    P: Array,
    s: Array,
    K: Array,
    free: Flags,
    by_input: Array,
    of_inputs: Array,
) -> bool:
    """Fill P (N+1, n, n) and s (N+1, n) backward from the last knot, the gains K (N, m, n+1) and `free` (N, m).

    Fill the gradients (N, m) and Hessians (N, m, m) with respect to the inputs. Return False if no minimum is found.
    """
    count, n, z = F.shape
    m = z - n
    PF, Q, L, hessian = np.empty((n, z + 1)), np.empty((z, z + 1)), np.empty((m, m)), np.empty((m, m))
    rows, T, added = np.empty((m, n + 1)), np.empty((m, n + 1)), np.empty((n + 1, n + 1))
    for k in range(count - 1, -1, -1):
        PF[:, :z], PF[:, z] = 0.0, s[k + 1]  # P F, and P gap + s in the last column
        _add_product(P[k + 1], F[k], PF)
        _add_product(P[k + 1], gaps[k].copy().reshape(n, 1), PF[:, z:])
        Q[:, :z], Q[:, z] = hessians[k], gradients[k]  # with respect to [x, u], with the gradient in the last column
        _add_product(F[k], PF, Q)
        by_input[k], of_inputs[k], hessian[:] = Q[n:, z], Q[n:, n:z], Q[n:, n:z]
        rows[:, 0], rows[:, 1:] = Q[n:, z], Q[n:, :n]
        _add_ridge(hessian, regularization)
        if not _gains(hessian, rows, lower[k], upper[k], K[k], free[k], L):
            return False
        T[:], added[:] = rows, 0.0
        _add_product(of_inputs[k], K[k], T)
        _add_product(K[k], T, added)
        _add_product(rows, K[k], added)
        for i in range(n):
            s[k, i] = Q[i, z] + added[1 + i, 0]
            for c in range(i, n):
                P[k, i, c] = P[k, c, i] = Q[i, c] + added[1 + i, 1 + c]
    return True
