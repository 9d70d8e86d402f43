"""`dd.identify` with motion="impacts": what the search in `impacts` finds, judged.

Where bodies strike each other a motion forgets where it began: small errors of its first state grow. So what is left
is measured in units of the noise and of how far apart motions are that begin at other states which the same measured
positions allow.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.identification.impacts import Found, Search
from drake_diff.identification.judge import SCATTER
from drake_diff.identification.measured import Piece
from drake_diff.model.model import Model
from drake_diff.model.tangent import tangent_space

SEED = 0  # of clouds and other first states: the same recordings give the same values
OTHERS = 8  # first states of each recording


@dataclass(frozen=True, eq=False)
class Judged:
    """What a search found, and what it leaves of every recording, in units of what noise explains."""

    search: Search
    found: Found
    after: list[Array]  # of each piece (n, nx), with the values that were found
    before: list[Array]  # with the model's own
    fitted: list[Array]  # (n, 2 nv) what is left of each piece that was fitted; NaN of velocities
    error_before: float  # of what was held out; of all, where nothing was
    error_after: float
    reason: str  # why the recordings are not explained; empty where they are


def judged(model: Model, pieces: Sequence[Piece], names: Sequence[str] | str, noise: Array) -> Judged:
    """The search through impacts over the pieces; those held out are predicted from their first flight.

    Positions alone are judged, by their `noise` (2 nv,). InputError or UnknownNameError for a recording or a name that
    cannot be taken.
    """
    search = Search(model, pieces, names)
    found = search.run(SEED)
    after, left = _followed(search, found.w, noise)
    before, was = _followed(search, np.zeros(len(found.w)), noise)
    fitted, held = ([r for r, p in zip(left, pieces, strict=True) if p.held_out == h] for h in (False, True))
    was_held = [r for r, piece in zip(was, pieces, strict=True) if piece.held_out]
    entries = tangent_space(model).names
    reason = "" if found.converged else "the search did not converge: its last step was longer than the cloud is wide"
    reason = reason or _doubt(entries, fitted, "what is left of {} is {:.3g} times what noise explains")
    reason = reason or _doubt(entries, held, "{} of what was held out is missed by {:.3g} times the noise")
    return Judged(search, found, after, before, fitted, _size(was_held or was), _size(held or left), reason)


def _followed(search: Search, w: Array, noise: Array) -> tuple[list[Array], list[Array]]:
    """The motion (n, nx) of each recording, and what is left (n, 2 nv) in units of what noise explains; NaN of v."""
    starts, random, nv = search.starts(w, noise), np.random.default_rng(SEED), search.model.nv
    xs = search.whole(w, [start.x for start in starts])
    others = [start.others(search.chart, OTHERS, random) for start in starts]
    squares = [np.zeros((len(x), 2 * nv)) for x in xs]
    for k in range(OTHERS):
        for square, other, x in zip(squares, search.whole(w, [each[k] for each in others]), xs, strict=True):
            square += search.chart.minus(other, x) ** 2 / OTHERS
    left = []
    for piece, x, square in zip(search.pieces, xs, squares, strict=True):
        r = search.chart.minus(piece.ys, x) / np.sqrt(noise**2 + square)
        r[:, nv:] = np.nan
        left.append(r)
    return xs, left


def _size(residuals: Sequence[Array]) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate(residuals) ** 2)))


def _doubt(names: Sequence[str], residuals: Sequence[Array], words: str) -> str:
    """Where residuals are larger than noise makes them; empty where they are not."""
    if not residuals:
        return ""
    every = np.concatenate(residuals)
    seen = np.flatnonzero(np.isfinite(every).any(axis=0))
    sizes = np.sqrt(np.nanmean(every[:, seen] ** 2, axis=0))
    worst = int(np.argmax(sizes))
    return words.format(names[seen[worst]], sizes[worst]) if sizes[worst] > SCATTER else ""
