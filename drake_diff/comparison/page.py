"""A comparison as one page that opens from a disk: the verdict, the motions, plots, tables, contracts."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.comparison.result import Comparison
from drake_diff.engines.motion import EngineMotion
from drake_diff.pages.html import Line, Plot, page_data, write_page
from drake_diff.record.comparison import ComparisonRecord

SAME_TIME = 1e-6  # [s] clocks in single precision are within it
MOST_PLOTS = 12  # of coordinates; those whose motions are furthest apart


def write_comparison_page(path: Path, comparison: Comparison, record: ComparisonRecord, replay: Path) -> None:
    """Write the page of `comparison` with its `record` and the page `replay`, which has the engines as ghosts."""
    write_page(
        path, "comparison.html.j2", record=record.model_dump(mode="json"), data=comparison_data(comparison),
        view=replay.read_text(encoding="utf-8"), most_plots=MOST_PLOTS,
    )  # fmt: skip


def comparison_data(comparison: Comparison) -> dict[str, Any]:
    """What the page draws (see `page_data`), with the certificates that do not agree."""
    certificates = [j.certificate for e in comparison.engines for j in e.jacobians]
    doubtful = [c for c in certificates if c is not None and c.verdict != "agree"]
    plots = [*_gap_plots(comparison), *_measure_plots(comparison), *_coordinate_plots(comparison)]
    return page_data(float(comparison.reference.motion.times[-1]), plots, doubtful)


def _gap_plots(comparison: Comparison) -> Iterator[Plot]:
    """Against Drake: where a gap arises, and what becomes of it."""
    ours = comparison.reference.motion
    reference = Line("drake, the reference", np.full(len(ours.times), np.nan))  # keeps the colours of the other plots
    steps, distances = [reference], [reference]
    for e in comparison.engines[1:]:
        steps.append(Line(e.engine, _on(ours.times, e.motion, np.append(e.step_gaps, np.nan))))
        columns = [_on(e.motion.times, ours, x) for x in ours.xs.T]
        distance = np.abs(e.motion.xs - np.array(columns).T).max(axis=1)
        distances.append(Line(e.engine, _on(ours.times, e.motion, distance)))
    note = "of one step to Drake's from the same state, relative to the state; 0 is not on a log scale"
    yield Plot("gap of each step", "1", ours.times, steps, log=True, note=note, group="Gaps")
    note = "the largest difference of a state, in its own unit"
    yield Plot("distance from Drake's motion", "q, v", ours.times, distances, log=True, note=note, group="Gaps")


def _measure_plots(comparison: Comparison) -> Iterator[Plot]:
    """Energy and penetration, as each engine finds them."""
    times, energies, depths = comparison.reference.motion.times, [], []
    for e in comparison.engines:
        if e.motion.energy is not None:
            energies.append(Line(e.engine, _on(times, e.motion, e.motion.energy - e.motion.energy[0])))
        if e.motion.depth is not None:
            depths.append(Line(e.engine, _on(times, e.motion, e.motion.depth)))
    note = "kinetic and potential, less that at the start; inputs, damping and contact change it too"
    yield Plot("energy", "J", times, energies, note=note, group="Energy and contact")
    note = "the deepest overlap that the engine finds"
    yield Plot("penetration", "m", times, depths, note=note, group="Energy and contact")


def _coordinate_plots(comparison: Comparison) -> Iterator[Plot]:
    """Those coordinates whose motions are furthest apart, in the order of the state."""
    model, times = comparison.model, comparison.reference.motion.times
    units = [c.unit for c in (*model.contract.positions, *model.contract.velocities)]
    found = [[_on(times, e.motion, e.motion.xs[:, i]) for e in comparison.engines] for i in range(model.nx)]
    spread = [float(np.nanmax(np.nanmax(xs, axis=0) - np.nanmin(xs, axis=0))) for xs in found]
    for i in sorted(np.argsort(spread)[::-1][:MOST_PLOTS]):
        lines = [Line(e.engine, x) for e, x in zip(comparison.engines, found[i], strict=True)]
        yield Plot(model.state_names[i], units[i], times, lines, group="Coordinates")


def _on(times: Array, motion: EngineMotion, values: Array) -> Array:
    """`values` (n,) of a motion at `times`, NaN where it has none."""
    found = np.full(len(times), np.nan)
    at = np.searchsorted(times, motion.times - SAME_TIME)
    known = (at < len(times)) & (np.abs(times[np.minimum(at, len(times) - 1)] - motion.times) < SAME_TIME)
    found[at[known]] = np.asarray(values)[known]
    return found
