"""The report of a fit: before and after, intervals, residuals, correlation, and what stays open."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.identification.results import Followed, Identification
from drake_diff.pages.html import Line, Plot, page_data, write_page


def joined(motions: Sequence[Followed]) -> tuple[Array, Array, Array, Array]:
    """times (n,), measured, fitted and earlier states (n, nx) of one recording's stretches, NaN where there is none.

    A sample where one stretch ends and the next begins is told once, as the next one has it.
    """
    motions = sorted(motions, key=lambda motion: float(motion.piece.times[0]))
    parts: list[list[Array]] = [[], [], [], []]
    for k, motion in enumerate(motions):
        count = len(motion.piece.times) - (k < len(motions) - 1)
        before = np.full_like(motion.xs, np.nan) if motion.xs_before is None else motion.xs_before
        for arrays, values in zip(parts, (motion.piece.times, motion.piece.ys, motion.xs, before), strict=True):
            arrays.append(values[:count])
    times, ys, xs, before = (np.concatenate(arrays) for arrays in parts)
    return times, ys, xs, before


MOST_PLOTS = 12  # of coordinates
MOST_COLUMNS = 16  # of the table of correlations


def write_page_of(path: Path, e: Identification, record: Mapping[str, Any]) -> None:
    """Write the report of `e`, whose record has these fields."""
    duration = max(float(m.piece.times[-1]) for m in e.motions)
    write_page(
        path,
        "identification.html.j2",
        record=record,
        data=page_data(duration, [*_motion_plots(e), *_residual_plots(e)]),
        most_columns=MOST_COLUMNS,
    )


def _motion_plots(e: Identification) -> Iterator[Plot]:
    """What was measured beside the model's motion."""
    if e.asked is None:
        return
    model = e.asked.model
    units = [c.unit for c in (*model.contract.positions, *model.contract.velocities)]
    for i, recording in enumerate(e.asked.recordings):
        times, ys, xs, before = joined([m for m in e.motions if m.piece.recording == i])
        seen = [j for j in range(model.nx) if np.any(np.isfinite(ys[:, j]))]
        for j in seen[:MOST_PLOTS]:
            lines = [Line("measured", ys[:, j]), Line("with the values found", xs[:, j])]
            if np.any(np.isfinite(before[:, j])):
                lines.append(Line("with the model's own values", before[:, j], dashed=True))
            yield Plot(model.state_names[j], units[j], times, lines, group=recording.name)


def _residual_plots(e: Identification) -> Iterator[Plot]:
    """What is left of each entry that was fitted, in standard deviations of the noise."""
    if e.asked is None:
        return
    names = e.entries
    fitted = [m.piece for m in e.motions if not m.piece.held_out]
    for j, name in enumerate([n for n in names if n in e.noise][:MOST_PLOTS]):
        column = names.index(name)
        x = np.concatenate([p.times for p in fitted])
        y = np.concatenate([r[:, column] for r in e.residuals])
        order = np.argsort(x, kind="stable")
        yield Plot(
            name,
            "standard deviations",
            x[order],
            [Line("what is left", y[order])],
            axis="time [s]",
            place="residuals",
            group="Residuals",
            marks="points",
            limits=(-2.0, 2.0),
            note="of noise, 95 % lie between the dashed lines" if j == 0 else "",
        )
