"""Where the contact mode of a step changes beside the point at which it is differentiated."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.model.contact import SEPARATED, Pair, active_modes
from drake_diff.model.model import Model

# How far, in scaled coordinates, the neighbourhood reaches.
NEIGHBOURHOOD = 1e-4
# A row is touched if its change departs from what the derivative predicts by this part of the larger one.
TOUCHED = 1e-2


@dataclass(frozen=True)
class ModeChange:
    """One pair's contact mode at the point and beside it, and the rows that the derivative misses there."""

    pair: Pair
    before: str
    after: str
    column: str
    displacement: float  # in the column's own unit
    rows: tuple[str, ...]

    def __str__(self) -> str:
        touched = f", which touches d({', '.join(self.rows)})/d{self.column}" if self.rows else ""
        return (
            f"{self.pair[0]} and {self.pair[1]}: {self.before} here, {self.after} where {self.column} "
            f"is {self.displacement:+.3g}{touched}"
        )


def find_mode_changes(
    model: Model,
    f: Callable[[Array], Array],
    derivative: Array,
    *,
    rows: tuple[str, ...],
    columns: tuple[str, ...],
    scale: Array,
    minus: Callable[[Array, Array], Array],
) -> tuple[ModeChange, ...]:
    """Displace each of the `columns` by 1e-4 of its scale to both sides and compare the modes of the step `f`.

    `f` takes a scaled displacement (n,) and leaves the double twin at the step; `derivative` (m, n) is by it.
    """
    size = derivative.shape[1]
    centre = f(np.zeros(size))
    here = active_modes(model)
    found = []
    for j, column in enumerate(columns):
        for reach in (NEIGHBOURHOOD, -NEIGHBOURHOOD):
            step = reach * np.eye(size)[j]
            change = minus(f(step), centre)
            there = active_modes(model)
            touched = _touched(rows, change, derivative @ step)
            for pair in sorted(pair for pair in here.keys() | there.keys() if here.get(pair) != there.get(pair)):
                before, after = here.get(pair, SEPARATED), there.get(pair, SEPARATED)
                found.append(ModeChange(pair, before, after, column, float(reach * scale[j]), touched))
    return tuple(found)


def _touched(rows: tuple[str, ...], change: Array, predicted: Array) -> tuple[str, ...]:
    """The rows whose change is not what the derivative predicts."""
    size = np.maximum(np.abs(predicted), np.abs(change))
    missed = np.abs(change - predicted) > TOUCHED * np.maximum(size, 1e-6 * size.max(initial=0.0))
    return tuple(name for name, miss in zip(rows, missed, strict=True) if miss)
