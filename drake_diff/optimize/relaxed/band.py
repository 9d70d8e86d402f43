"""Linear equations whose matrix is symmetric with five diagonals of blocks, by a Cholesky factor of such blocks."""

from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array


@dataclass(frozen=True, eq=False)
class Band:
    """A symmetric matrix of N by N blocks (n, n), 0 but for those on the diagonal, below it, and below that.

    Of `below` and `beneath` the last, and the last two, are of no column and not looked at.
    """

    diagonal: Array  # (N, n, n)
    below: Array  # (N, n, n) in row k + 1 of column k
    beneath: Array  # (N, n, n) in row k + 2

    def solve(self, right: Array) -> Array | None:
        """(N n,) the solution for the right side (N, n); None where the matrix is not positive definite."""
        N, n = right.shape
        inverse, factors, y = np.empty((N, n, n)), np.zeros((N + 2, 2 * n, n)), np.zeros((N + 2, n))
        y[:N] = right
        columns = np.concatenate([self.below, self.beneath], axis=1)
        diagonal = np.array(self.diagonal)
        try:
            for k in range(N):  # what column k adds to the columns and rows after it
                own = np.linalg.inv(np.linalg.cholesky(diagonal[k]))
                inverse[k] = own
                y[k] = own.dot(y[k])
                factors[k] = factor = columns[k].dot(own.T)
                y[k + 1 : k + 3] -= factor.dot(y[k]).reshape(2, n)
                if k + 1 < N:
                    square = factor.dot(factor.T)
                    diagonal[k + 1] -= square[:n, :n]
                    columns[k + 1, :n] -= square[n:, :n]
                if k + 2 < N:
                    diagonal[k + 2] -= square[n:, n:]
        except np.linalg.LinAlgError:
            return None
        y[N:] = 0.0
        for k in range(N - 1, -1, -1):
            y[k] = inverse[k].T.dot(y[k] - factors[k].T.dot(y[k + 1 : k + 3].ravel()))
        found = y[:N].ravel()
        return found if np.all(np.isfinite(found)) else None
