"""Steps of a `FlowPlant` under a given set of contacts that push, with their errors: explicit, or for stiff motions.

Friction that holds is a damper of rate up to 15/8 mu f / (v_s m), which keeps explicit steps short long after the
motion itself has become slow. Where the explicit steps come near the end of their stability, those of a Rosenbrock
method take over, until explicit ones would be as long.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.motion import rosenbrock
from drake_diff.motion.flow.plant import FlowPlant

STABLE = 1.0  # of a step's length times the rate at which its stages move apart; the explicit method is stable to 3.3
HITS = 5  # steps in a row over it before the other method takes over
LOOK = 8  # steps of the other method between looks at the largest rate


@dataclass(frozen=True, eq=False)
class _Part:
    """What runs a part's functions on the stepper's own arrays."""

    explicit: Any
    rates: Any
    slopes: Any
    kept: tuple[Any, ...]


class Stepper:
    """Tries steps from the state `x` under `u`: the results are `ahead` (nx,) and the rates there, `after` (nx,)."""

    def __init__(self, plant: FlowPlant, materials: Array):
        nx, nu = plant.model.nx, plant.model.nu
        self.plant, self.materials = plant, np.array(materials, dtype=float)
        self.x, self.u = np.zeros(nx), np.zeros(nu)
        self.ahead, self.after = np.zeros(nx), np.zeros(nx)
        self.is_stiff, self._hits, self._left = False, 0, 0
        self._h, self._told = np.zeros(1), np.zeros(2)
        self._stage, self._rates, self._slopes = np.zeros(nx), np.zeros(nx), np.zeros((nx + nu, nx))
        self._at, self._jacobian, self._changes = np.empty(0), np.zeros((nx, nx)), np.zeros((8, nx))
        self._parts: dict[tuple[int, ...], _Part] = {}
        self.push(())

    def push(self, pushing: tuple[int, ...]) -> None:
        """Take the equations where the pairs `pushing` push."""
        if pushing not in self._parts:
            part = self.plant.part(pushing)
            given = self.u, self.materials
            told = self.ahead, self.after, self._told
            kept, explicit = on_arrays(part.step, (self.x, *given, self._h), told)
            kept_too, rates = on_arrays(part.rates, (self._stage, *given), (self._rates,))
            kept_last, slopes = on_arrays(part.slopes, (self._stage, *given), (self._rates, self._slopes))
            self._parts[pushing] = _Part(explicit, rates, slopes, (kept, kept_too, kept_last))
        self._part = self._parts[pushing]
        self.is_stiff, self._hits = False, 0
        self.moved()

    def moved(self) -> None:
        """The state or the input is another one."""
        self._at = np.empty(0)

    def rates(self) -> Array:
        """(nx,) at the state."""
        self._stage[:] = self.x
        self._part.rates()
        return self._rates

    def attempt(self, length: float) -> float:
        """A step of `length` [s] into `ahead` and `after`; its error relative to max(1, |x|)."""
        error = self._implicit(length) if self.is_stiff else self._explicit(length)
        if not np.isfinite(error) or not np.isfinite(np.sum(self.ahead)):
            return float("inf")
        return error

    def accept(self, length: float) -> None:
        """Go where the last attempt led."""
        if not self.is_stiff:
            self._hits = self._hits + 1 if length * self._told[1] > STABLE else 0
            if self._hits == HITS:
                self.is_stiff, self._hits, self._left = True, 0, LOOK
        else:
            self._left -= 1
            if self._left == 0:
                self._left = LOOK
                self.is_stiff = bool(length * np.max(np.abs(np.linalg.eigvals(self._jacobian))) > STABLE)
        self.x[:] = self.ahead
        self.moved()

    def _explicit(self, length: float) -> float:
        self._h[0] = length
        self._part.explicit()
        return float(self._told[0])

    def _implicit(self, length: float) -> float:
        if not self._at.size:
            self._stage[:] = self.x
            self._part.slopes()
            self._at = self._rates.copy()
            self._jacobian = self._slopes[: len(self.x)].T.copy()
        W = -self._jacobian
        W[np.diag_indices(len(W))] += 1 / (rosenbrock.GAMMA * length)
        try:
            solve = np.linalg.inv(W)
        except np.linalg.LinAlgError:
            return float("inf")
        changes = self._changes
        changes[0] = solve @ self._at
        for i in range(1, 8):
            self._stage[:] = self.x + rosenbrock.STAGES[i] @ changes[:i]
            self._part.rates()
            changes[i] = solve @ (self._rates + rosenbrock.COUPLINGS[i] @ changes[:i] / length)
        self.ahead[:] = self._stage + changes[7]
        self._stage[:] = self.ahead
        self._part.rates()
        self.after[:] = self._rates
        size = np.maximum(1.0, np.maximum(np.abs(self.x), np.abs(self.ahead)))
        return float(np.sqrt(np.mean((changes[7] / size) ** 2)))


def on_arrays(function: Any, arguments: tuple[Array, ...], results: tuple[Array, ...]) -> tuple[Any, Any]:
    """A function of CasADi's on arrays that stay where they are: (what has to be kept, what runs it)."""
    buffer, run = function.buffer()
    for i, a in enumerate(arguments):
        if a.size:
            buffer.set_arg(i, a.data)
    for i, a in enumerate(results):
        if a.size:
            buffer.set_res(i, a.data)
    return buffer, run
