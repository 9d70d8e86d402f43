"""The quadratic program of one step: linear dynamics, hard input bounds, and priced slacks on all other constraints.

The variables are the moves d of inputs and states at each knot. The move of the first state is 0. The program is

    minimize  sum_k g_k' d_k + d_k' H_k d_k / 2 + price' slack
    where     dx_(k+1) = F_k d_k + gap_k,  du within its bounds,  lower - slack <= J d <= upper + slack,  slack >= 0,

The slacks make it always feasible. If a row's price exceeds its multiplier, the row is satisfied wherever possible (an
exact penalty; Nocedal and Wright, "Numerical Optimization", 2006, section 17.2). PIQP, which CasADi includes, solves
it: Schwan, Jiang, Kuhn and Jones, "PIQP: A Proximal Interior-Point Quadratic Programming Solver", 2023.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from scipy.sparse import csc_matrix

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import Refusal
from drake_diff.derivatives.steps import Flags
from drake_diff.exceptions import GradientError
from drake_diff.optimize.ilqr.riccati import LinearQuadratic
from drake_diff.optimize.knots import PointFunction

ACCURATE = {"eps_abs": 1e-9, "eps_rel": 1e-9, "max_iter": 50}
# The second set is slower and solves programs with widely different numbers, where the first set may fail.
OPTIONS = (ACCURATE, ACCURATE | {"iterative_refinement_always_enabled": True})
FREE = 1e30  # PIQP's value for no limit
FAR = 1e3  # ranges: a limit beyond this distance has no effect
DEAREST = 1e4  # largest price: higher ones reduce PIQP's accuracy, so that the cost is scaled


@dataclass(frozen=True, eq=False)
class RowLimits:
    """Rows lower <= f(z) <= upper at the K knots from `first` on, infinite if there is no limit."""

    labels: tuple[str, ...]  # (m,)
    function: PointFunction
    first: int
    lower: Array  # (K, m)
    upper: Array
    has_lower: Flags  # (m,) whether any knot of the problem has such a limit
    has_upper: Flags
    prices: Array  # (m,) per unit of violation
    ranges: Array  # (m,) the range of f; limits on both sides that are much narrower count as an equality

    @classmethod
    def unpriced(
        cls, labels: tuple[str, ...], function: PointFunction, first: int, lower: Array, upper: Array
    ) -> "RowLimits":
        """Create row limits with prices of 1."""
        has_lower, has_upper = (np.any(np.isfinite(side), axis=0) for side in (lower, upper))
        return cls(labels, function, first, lower, upper, has_lower, has_upper, *np.ones((2, len(labels))))

    @property
    def knots(self) -> slice:
        return slice(self.first, self.first + len(self.lower))

    def select(self, xs: Array, us: Array) -> Array:
        """Return the knots (K, nx + nu) of a motion at which the rows apply."""
        return np.hstack([xs, np.vstack([us, np.zeros((1, us.shape[1]))])])[self.knots]

    def beyond(self, xs: Array, us: Array) -> Array:
        """Return the violations (K, m) of the limits by a motion."""
        values = self.function.values(self.select(xs, us))
        return np.maximum(np.maximum(self.lower - values, values - self.upper), 0.0)

    def linearize(self, xs: Array, us: Array) -> "Limited":
        """Linearize around a motion. Raises GradientError if a value is not finite."""
        values, jacobians = self.function.linearize(self.select(xs, us))
        if not (np.all(np.isfinite(values)) and np.all(np.isfinite(jacobians))):
            raise GradientError(f"{self.labels[0]} or its derivative is not finite along the motion")
        return Limited(self, jacobians, self.lower - values, self.upper - values, self.prices)


@dataclass(frozen=True, eq=False)
class Limited:
    """`RowLimits` around a motion: Jacobians (K, m, nx + nu), and the limits minus the values (K, m)."""

    limits: RowLimits
    jacobians: Array
    lower: Array
    upper: Array
    prices: Array  # (m,)

    @property
    def beyond(self) -> Array:
        """The violations (K, m) of the limits by the values."""
        return np.maximum(np.maximum(self.lower, -self.upper), 0.0)


@dataclass(frozen=True, eq=False)
class Moves:
    """A solution of the program. Multipliers are positive at an upper limit and negative at a lower one."""

    dxs: Array  # (N+1, nx)
    dus: Array  # (N, nu)
    slacks: tuple[Array, ...]  # (K, m) for each of the row limits
    multipliers: tuple[Array, ...]  # (K, m)
    bounds: Array  # (N, nu) multipliers of the inputs' bounds
    dynamics: Array  # (N, nx) multipliers of each step: d cost / d gap


class _Pattern:
    """The sparsity of a matrix, and the order in which CasADi stores its entries (2, nnz)."""

    def __init__(self, entries: Indices, shape: tuple[int, int]):
        self.order = np.lexsort(entries)
        self.sparsity = ca.DM(csc_matrix((np.ones(len(self.order)), entries), shape)).sparsity()

    def matrix(self, values: Array) -> ca.DM:
        """The matrix with `values` (nnz,); ten times faster than CasADi's conversion from SciPy."""
        return ca.DM(self.sparsity, values[self.order])


class SoftProgram:
    """The program for `count` steps. Its structure is constant and is set up once."""

    def __init__(self, nx: int, nu: int, count: int, rows: Sequence[RowLimits]):
        self.nx, self.nu, self.count = nx, nu, count
        n, moves = nx + nu, count * (nx + nu)
        self.slack_at = np.cumsum([moves, *(r.lower.size for r in rows)])
        self.size = int(self.slack_at[-1])
        places, sides = [self._dynamics()], count * nx
        self.sides: list[tuple[int, int, Indices]] = []  # (+1 upper or -1 lower, index of the rows, bounded (m,))
        for i, r in enumerate(rows):
            for sign, has in ((1, r.has_upper), (-1, r.has_lower)):
                bounded = np.flatnonzero(has)
                self.sides.append((sign, i, bounded))
                places.append(self._soft(i, r, bounded, sides))
                sides += len(r.lower) * len(bounded)
        entries = np.concatenate([np.stack(pair) for pair in places], axis=1)
        self._inside = entries[1] >= 0  # the first state is given and has no columns
        self._a = _Pattern(entries[:, self._inside], (sides, self.size))
        self._h = _Pattern(self._set_hessian(n), (self.size, self.size))
        shapes = {"h": self._h.sparsity, "a": self._a.sparsity}
        self._solvers = [ca.conic("step", "piqp", shapes, {"error_on_fail": False, "piqp": o}) for o in OPTIONS]
        self._free = np.full(self.size - moves, FREE)

    def _dynamics(self) -> tuple[Indices, Indices]:
        """Return (rows, columns) of dx_(k+1), then those of -F_k."""
        nx, n = self.nx, self.nx + self.nu
        k, i = _all(self.count, nx)
        steps, entries, j = _all(self.count, nx, n)
        rows = np.concatenate([k * nx + i, steps * nx + entries])
        return rows, np.concatenate([k * n + self.nu + i, self._column(steps, j)])

    def _column(self, k: Indices, j: Indices) -> Indices:
        """Return the index of the variable for entry j of [x, u] at knot k, negative for the given first state."""
        n = self.nx + self.nu
        positions = np.where(j < self.nx, (k - 1) * n + self.nu + j, k * n + j - self.nx)
        return np.where((k == 0) & (j < self.nx), -1, positions)

    def _soft(self, i: int, r: RowLimits, bounded: Indices, first: int) -> tuple[Indices, Indices]:
        """Return (rows, columns) of one side's Jacobian, then those of its slacks."""
        count, m = r.lower.shape
        k, a = _all(count, len(bounded))
        steps, entries, j = _all(count, len(bounded), len(r.function.columns))
        rows = np.concatenate([steps * len(bounded) + entries, k * len(bounded) + a])
        slacks = self.slack_at[i] + k * m + bounded[a]
        return first + rows, np.concatenate([self._column(steps + r.first, r.function.columns[j]), slacks])

    def _set_hessian(self, n: int) -> Indices:
        k, i, j = _all(self.count + 1, n, n)
        last = (k == self.count) & ((i >= self.nx) | (j >= self.nx))
        entries = np.stack([self._column(k, i), self._column(k, j)])
        self._curved = np.all(entries >= 0, axis=0) & ~last
        return entries[:, self._curved]

    def solve(self, model: LinearQuadratic, limited: Sequence[Limited]) -> Moves | Refusal:
        """Solve the program, or return a Refusal if PIQP finds no solution, as for non-finite or very large numbers."""
        n, nx, nu, count = self.nx + self.nu, self.nx, self.nu, self.count
        dearest = max((float(np.max(rows.prices, initial=0.0)) for rows in limited), default=0.0)
        unit = DEAREST / dearest if dearest > DEAREST else 1.0  # unit of the cost
        data = [np.ones(count * nx), -model.F.ravel()]
        lower, upper = [model.gaps.ravel()], [model.gaps.ravel()]
        for sign, i, bounded in self.sides:
            rows = limited[i]
            side, far = (rows.upper if sign > 0 else rows.lower)[:, bounded], FAR * rows.limits.ranges[bounded]
            columns = rows.limits.function.columns
            data += [rows.jacobians[:, bounded][:, :, columns].ravel(), np.full(side.size, -float(sign))]
            side = np.clip(side, -far, far).ravel()  # PIQP warns about rows without a limit
            lower.append(side if sign < 0 else np.full(side.size, -np.inf))
            upper.append(side if sign > 0 else np.full(side.size, np.inf))
        a, h = np.concatenate(data)[self._inside], unit * model.hessians.ravel()[self._curved]
        of_slacks = [np.tile(rows.prices, len(rows.lower)) for rows in limited]
        g = np.concatenate([model.gradients.ravel()[nx : nx + count * n], *of_slacks])
        least, most = np.full((count, n), -np.inf), np.full((count, n), np.inf)
        least[:, :nu], most[:, :nu] = model.lower, model.upper
        sides = {"lba": np.concatenate(lower), "uba": np.concatenate(upper)}
        sides |= {"lbx": np.append(least.ravel(), 0.0 * self._free), "ubx": np.append(most.ravel(), self._free)}
        given = {"h": self._h.matrix(h), "g": unit * g, "a": self._a.matrix(a), **sides}
        for solver in self._solvers:
            solution, stats = solver(**given), solver.stats()
            z = np.asarray(solution["x"]).ravel()
            if stats["success"] and np.all(np.isfinite(z)):
                break
        else:
            return Refusal(f"PIQP: {stats['return_status']}")
        by_row, by_variable = (np.asarray(solution[name]).ravel() / unit for name in ("lam_a", "lam_x"))
        moves, first = z[: count * n].reshape(count, n), count * nx
        multipliers = [np.zeros(rows.lower.shape) for rows in limited]
        for _, i, bounded in self.sides:
            shape = len(limited[i].lower), len(bounded)
            size = shape[0] * shape[1]
            multipliers[i][:, bounded] += by_row[first : first + size].reshape(shape)
            first += size
        slacks = zip(np.split(z, self.slack_at[:-1])[1:], limited, strict=True)
        return Moves(
            dxs=np.concatenate([np.zeros((1, nx)), moves[:, nu:]]),
            dus=moves[:, :nu],
            slacks=tuple(slack.reshape(rows.lower.shape) for slack, rows in slacks),
            multipliers=tuple(multipliers),
            bounds=by_variable[: count * n].reshape(count, n)[:, :nu],
            dynamics=-by_row[: count * nx].reshape(count, nx),
        )


def _all(*counts: int) -> Indices:
    """Return all indices below `counts`, in order, with one row for each count."""
    return np.indices(counts, dtype=np.intp).reshape(len(counts), -1)
