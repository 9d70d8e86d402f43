"""The Riccati recursion of `riccati`, knot by knot: compiled.

The formulas are those of `riccati`, which says what they are. Inner loops run along rows, which are what a processor
adds several at a time. Kept apart as Numba compiles what is in here.
"""

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.compiled import compiled

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


@compiled
def _factor(A: Array, m: int, L: Array) -> bool:
    """L D L' = A of its first m rows and columns, D on L's diagonal; False if A is not positive definite."""
    for i in range(m):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k] * L[k, k]
            if j < i:
                L[i, j] = total / L[j, j]
            elif total > 0 and total < np.inf:  # not where it is NaN
                L[i, i] = total
            else:
                return False
    return True


@compiled
def _solve(L: Array, m: int, B: Array, width: int) -> None:
    """B = -(L D L')^-1 B, of the first m rows of B and its first `width` columns."""
    for i in range(m):
        for k in range(i):
            entry = L[i, k]
            for c in range(width):
                B[i, c] -= entry * B[k, c]
    for i in range(m):
        for c in range(width):
            B[i, c] /= -L[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            entry = L[k, i]
            for c in range(width):
                B[i, c] -= entry * B[k, c]


@compiled
def _value(H: Array, g: Array, d: Array) -> float:
    total = 0.0
    for i in range(len(d)):
        row = 0.0
        for j in range(len(d)):
            row += H[i, j] * d[j]
        total += d[i] * (g[i] + row / 2)
    return total


@compiled
def minimize_in_box(
    H: Array, g: Array, lower: Array, upper: Array, iterations: int, sizes: Array, d: Array, free: Flags
) -> bool:
    """The d (m,) of least g' d + d' H d / 2 within bounds, and which are free; False if a part of H fails.

    H (m, m) is positive definite. By projected Newton steps.
    """
    m = len(g)
    block, L, step = np.empty((m, m)), np.empty((m, m)), np.empty((m, 1))
    slope, moved, indices = np.empty(m), np.empty(m), np.empty(m, dtype=np.int64)
    for i in range(m):
        d[i] = min(max(0.0, lower[i]), upper[i])
    for _ in range(iterations):
        count = 0
        for i in range(m):
            slope[i] = g[i]
            for j in range(m):
                slope[i] += H[i, j] * d[j]
            free[i] = not ((d[i] <= lower[i] and slope[i] > 0) or (d[i] >= upper[i] and slope[i] < 0))
            if free[i]:
                indices[count] = i
                count += 1
        if count == 0:
            return True
        for a in range(count):
            step[a, 0] = slope[indices[a]]
            for b in range(count):
                block[a, b] = H[indices[a], indices[b]]
        if not _factor(block, count, L):
            return False
        _solve(L, count, step, 1)
        value, same = _value(H, g, d), True
        for size in sizes:
            for i in range(m):
                moved[i] = d[i]
            for a in range(count):
                i = indices[a]
                moved[i] = min(max(d[i] + size * step[a, 0], lower[i]), upper[i])
            if _value(H, g, moved) < value:
                for i in range(m):
                    same = same and d[i] == moved[i]
                    d[i] = moved[i]
                break
        if same:
            return True
    return True


@compiled
def _hold(
    hessian: Array, Q_ux: Array, K: Array, lower: Array, upper: Array, iterations: int, sizes: Array, free: Flags
) -> bool:
    """Put a gain K (m, n+1) whose feedforward keeps the bounds into K, where it leaves one; False if there is none."""
    m, w = K.shape
    leaves = False
    for i in range(m):
        leaves = leaves or not (K[i, 0] >= lower[i] and K[i, 0] <= upper[i])
    if not leaves:
        return True
    d, block, L = np.empty(m), np.empty((m, m)), np.empty((m, m))
    if not minimize_in_box(hessian, Q_ux[:, 0].copy(), lower, upper, iterations, sizes, d, free):
        return False
    rows, count = np.empty((m, w)), 0
    indices = np.empty(m, dtype=np.int64)
    for i in range(m):
        if free[i]:
            indices[count] = i
            count += 1
    for a in range(count):
        for b in range(count):
            block[a, b] = hessian[indices[a], indices[b]]
        for c in range(w):
            rows[a, c] = Q_ux[indices[a], c]
    if not _factor(block, count, L):
        return False
    _solve(L, count, rows, w)
    for i in range(m):
        for c in range(w):
            K[i, c] = 0.0
    for a in range(count):
        for c in range(w):
            K[indices[a], c] = rows[a, c]
    for i in range(m):
        K[i, 0] = d[i]
    return True


@compiled
def add_ridge(hessian: Array, regularization: float, least_scale: float) -> None:
    """Add `regularization` times its diagonal, of entries far below the largest `least_scale` of that, to a Hessian.

    The ridge of an all-zero diagonal is `regularization` itself.
    """
    m, largest = len(hessian), 0.0
    for a in range(m):
        largest = max(largest, abs(hessian[a, a]))
    if regularization > 0:
        for a in range(m):
            scale = max(abs(hessian[a, a]), least_scale * largest) if largest > 0 else 1.0
            hessian[a, a] += regularization * scale


@compiled
def sweep(
    F: Array,
    gaps: Array,
    gradients: Array,
    hessians: Array,
    lower: Array,
    upper: Array,
    regularization: float,
    least_scale: float,
    iterations: int,
    sizes: Array,
    P: Array,
    s: Array,
    K: Array,
    free: Flags,
    by_input: Array,
    of_inputs: Array,
) -> bool:
    """Fill P (N+1, n, n) and s (N+1, n) from their last on, the gains K (N, m, n+1) and which inputs are `free` (N, m).

    And the gradients (N, m) and Hessians (N, m, m) of the inputs. False if no minimum is found.
    """
    count, n, z = F.shape
    m, whole = z - n, n - n % 4
    PF, Q, q = np.empty((n, z)), np.empty((z, z)), np.empty(z)
    ahead, hessian, L, Q_ux, T = np.empty(n), np.empty((m, m)), np.empty((m, m)), np.empty((m, n + 1)), np.empty((m, n))
    for k in range(count - 1, -1, -1):
        for i in range(n):  # P F, and s + P gap
            total = s[k + 1, i]
            for j in range(n):
                total += P[k + 1, i, j] * gaps[k, j]
            ahead[i] = total
            for c in range(z):
                PF[i, c] = 0.0
            for j in range(0, whole, 4):  # four at a time: what is added to is read and written less often
                p0, p1, p2, p3 = P[k + 1, i, j], P[k + 1, i, j + 1], P[k + 1, i, j + 2], P[k + 1, i, j + 3]
                for c in range(z):
                    PF[i, c] += (p0 * F[k, j, c] + p1 * F[k, j + 1, c]) + (p2 * F[k, j + 2, c] + p3 * F[k, j + 3, c])
            for j in range(whole, n):
                p0 = P[k + 1, i, j]
                for c in range(z):
                    PF[i, c] += p0 * F[k, j, c]
        for i in range(z):
            q[i] = gradients[k, i]
            for c in range(i, z):
                Q[i, c] = hessians[k, i, c]
            for j in range(n):
                q[i] += F[k, j, i] * ahead[j]
            for j in range(0, whole, 4):
                p0, p1, p2, p3 = F[k, j, i], F[k, j + 1, i], F[k, j + 2, i], F[k, j + 3, i]
                for c in range(i, z):
                    Q[i, c] += (p0 * PF[j, c] + p1 * PF[j + 1, c]) + (p2 * PF[j + 2, c] + p3 * PF[j + 3, c])
            for j in range(whole, n):
                p0 = F[k, j, i]
                for c in range(i, z):
                    Q[i, c] += p0 * PF[j, c]
        for a in range(m):
            by_input[k, a], Q_ux[a, 0] = q[n + a], q[n + a]
            for c in range(n):
                Q_ux[a, 1 + c] = Q[c, n + a]
            for b in range(m):
                of_inputs[k, a, b] = hessian[a, b] = Q[n + min(a, b), n + max(a, b)]
        add_ridge(hessian, regularization, least_scale)
        if not _factor(hessian, m, L):
            return False
        gain = K[k]
        for a in range(m):
            for c in range(n + 1):
                gain[a, c] = Q_ux[a, c]
        _solve(L, m, gain, n + 1)
        if not _hold(hessian, Q_ux, gain, lower[k], upper[k], iterations, sizes, free[k]):
            return False
        for i in range(n):
            s[k, i] = q[i]
            for c in range(i, n):
                P[k, i, c] = Q[i, c]
        for a in range(m):  # Q_uu K + Q_ux, and what it adds
            total = q[n + a]
            for c in range(n):
                T[a, c] = Q_ux[a, 1 + c]
            for b in range(m):
                entry = of_inputs[k, a, b]
                total += entry * gain[b, 0]
                for c in range(n):
                    T[a, c] += entry * gain[b, 1 + c]
            for i in range(n):
                left, right = gain[a, 1 + i], Q_ux[a, 1 + i]
                s[k, i] += left * total + right * gain[a, 0]
                for c in range(i, n):
                    P[k, i, c] += left * T[a, c] + right * gain[a, 1 + c]
        for i in range(n):
            for c in range(i):
                P[k, i, c] = P[k, c, i]
    return True
