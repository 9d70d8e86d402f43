"""Least squares over a ragged function, by planes laid through the residuals of clouds of values.

A cloud of values, normal about the best so far, gives each residual a plane (regression). Its slopes are those of the
residual smoothed over the cloud, which is what a search can follow; what the residual scatters by about its plane is a
variance of its own, and weighs it. A step of Gauss and Newton with a soft-L1 loss follows, and the cloud shrinks.
That is statistical linear regression, as in iterated sigma-point filters, within a search that reduces its width.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array

ROUNDS = 5  # of reweighting
PULL = 1e-3  # towards where a cloud stands: what no residual knows stays there
AGAIN = 4  # steps of one width at most: it shrinks where a step is no longer than it
FAR = 2.0  # widths of the cloud that a step may go along each direction


@dataclass(frozen=True, eq=False)
class Plane:
    """Residuals near w: r + J d, and how far to believe each."""

    r: Array  # (M,)
    J: Array  # (M, n)
    variance: Array  # (M,) of the scatter about the plane, and 1 of the residual's own

    def weights(self, d: Array) -> Array:
        """(M,) of the soft-L1 loss at d (n,)."""
        e = self.r + self.J @ d
        return np.asarray(1 / self.variance / np.sqrt(1 + e**2 / self.variance))

    def step(self) -> Array:
        """(n,) to where the loss is least."""
        d: Array = np.zeros(self.J.shape[1])
        for _ in range(ROUNDS):
            weighted = self.J.T * self.weights(d)
            d = np.asarray(-np.linalg.solve(weighted @ self.J + PULL * np.eye(len(d)), weighted @ self.r))
        return d


def plane_at(residual: Callable[[Array], Array], w: Array, width: float, random: np.random.Generator) -> Plane:
    """Laid through the residuals (M,) of 4 n or more values about w (n,), in pairs."""
    n = len(w)
    half = max(2 * n, 4)
    z = random.standard_normal((half, n))
    z = np.concatenate([z, -z])
    R = np.array([residual(w + width * each) for each in z])
    A = np.concatenate([np.ones((2 * half, 1)), z], axis=1)
    C = np.linalg.lstsq(A, R, rcond=None)[0]
    scatter = np.sum((R - A @ C) ** 2, axis=0) / (2 * half - n - 1)
    return Plane(C[0], C[1:].T / width, scatter + 1)


@dataclass(frozen=True, eq=False)
class Shrunk:
    """Where steps led."""

    w: Array  # (n,)
    rounds: int  # planes that were laid
    converged: bool  # whether the last step was within the narrowest cloud


def shrink_to(
    residual: Callable[[Array], Array], w: Array, widths: Sequence[float], random: np.random.Generator
) -> Shrunk:
    """Where steps lead, some for each width of the cloud, from w (n,).

    Residuals are in units of what they are uncertain by at best.
    """
    rounds, within = 0, False
    for width in widths:
        most = FAR * width * float(np.sqrt(len(w)))
        for _ in range(AGAIN):
            d = plane_at(residual, w, width, random).step()
            length = float(np.linalg.norm(d))
            w = w + d * min(1.0, most / max(length, 1e-300))
            rounds, within = rounds + 1, length <= most / 2
            if within:
                break
    return Shrunk(w, rounds, within)
