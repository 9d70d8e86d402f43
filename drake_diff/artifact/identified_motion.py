"""What was recorded and how the model moves, on one axis of time."""

from collections.abc import Sequence

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.identification.identify import Followed


def joined(motions: Sequence[Followed]) -> tuple[Array, Array, Array, Array]:
    """times (n,), measured, fitted and earlier states (n, nx) of one recording's stretches, NaN where there is none.

    A sample where one stretch ends and the next begins is told once, as the next one has it.
    """
    motions = sorted(motions, key=lambda motion: float(motion.piece.times[0]))
    parts: list[list[Array]] = [[], [], [], []]
    for k, motion in enumerate(motions):
        count = len(motion.piece.times) - (k < len(motions) - 1)
        before = np.full_like(motion.xs, np.nan) if motion.xs_before is None else motion.xs_before
        for part, values in zip(parts, (motion.piece.times, motion.piece.ys, motion.xs, before), strict=True):
            part.append(values[:count])
    times, ys, xs, before = (np.concatenate(part) for part in parts)
    return times, ys, xs, before
