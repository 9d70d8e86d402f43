"""The pages of a run, which open from a disk: the motion in 3D, and a report with the motion, plots and numbers."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.artifact.marks import drawn_goals, labels_of
from drake_diff.artifact.measurement import Column, Measurement, gradient_norms
from drake_diff.pages.html import Line, Plot, page_data, write_page
from drake_diff.pages.meshcat import write_replay
from drake_diff.pages.scene import BLUE, scene_of

SERIES_PER_PLOT = 6  # more lines cannot be told apart
PHYSICS, SEARCH = "Energy and contact", "Search"


def write_pages(replay: Path, report: Path, m: Measurement, record: Mapping[str, Any]) -> None:
    """Write the pages of a measurement, whose `record` is given as plain data.

    Plain dynamics have nothing to draw in 3D, and so no page `replay`. The bytes are the same for the same solution,
    but for the paragraph of wall-clock times.
    """
    plots, view, ghosts = list(plots_of(m)), "", None
    motion, control = m.shown
    if m.solution.problem.has_model:
        times, xs = m.times, m.xs
        if motion is None:  # the plan alone; states of it that are not finite are drawn at x0
            xs = np.where(np.all(np.isfinite(xs), axis=1)[:, None], xs, m.solution.problem.x0)
        else:  # beside a plan that is not the motion itself
            times, xs = motion.times, motion.xs
            planned = m.solution.plan.sample(_parts(m))[0]
            drawn = bool(np.all(np.isfinite(planned))) and not np.array_equal(planned, xs)
            ghosts = {"plan": (planned, BLUE)} if drawn else None
        contacts, us = ((), None) if motion is None else (motion.contacts, motion.us)
        model = m.solution.problem.model
        marks = drawn_goals(model.plant, model.double.context, m.solution.problem.goals)
        scene = scene_of(model, times, xs, us=us, contacts=contacts, ghosts=ghosts, marks=marks)
        write_replay(replay, scene, title=f"{record['name']}: {m.solution.status.value}")
        view = replay.read_text(encoding="utf-8")
    data = page_data(float(m.times[-1]), plots, m.solution.certificates)
    write_page(
        report,
        "report.html.j2",
        record=record,
        data=data,
        view=view,
        cost=m.solution.cost,
        replayed=motion is not None,
        control=control,
        has_plan=ghosts is not None,
        goals=labels_of(m.solution.problem.goals),
        has_contacts=motion is not None and any(motion.contacts),
    )


def plots_of(m: Measurement) -> Iterator[Plot]:
    """What the report plots, over time and over the solver's iterations."""
    yield from _state_plots(m, "Positions", 0, m.positions)
    yield from _state_plots(m, "Velocities", len(m.positions), m.velocities)
    yield from _input_plots(m)
    motion = m.shown[0]
    if motion is not None:
        times, energy = motion.times, Line("total", motion.energy)
        parts = [Line("kinetic", motion.kinetic_energy), Line("potential", motion.potential_energy), energy]
        yield Plot("energy", "J", times, parts, group=PHYSICS)
        note = "what neither actuators nor damping account for: the time stepping's error, and what contact takes"
        yield Plot("unexplained energy", "J", times, [Line("error", motion.energy_error)], note=note, group=PHYSICS)
        note = "nothing can touch"
        if math.isfinite(m.penetration_limit):
            note = f"limit {m.penetration_limit:.3g} m, a quarter of {m.thinnest}"
        overlap = [Line("largest overlap", motion.penetration)]
        yield Plot("penetration", "m", times, overlap, limits=(None, m.penetration_limit), note=note, group=PHYSICS)
    yield from _replay_plots(m)
    yield from _solver_plots(m)


def _state_plots(m: Measurement, group: str, start: int, columns: Sequence[Column]) -> Iterator[Plot]:
    """A plot for each column: the motion, and the plan where it is another. Plain dynamics have "states" alone."""
    shown = m.shown[0]
    motion = m.integrated if shown is None else shown.xs[:: _parts(m)]
    differs = motion is not None and not np.array_equal(motion, m.xs)
    for i, c in enumerate(columns, start):
        lines = [] if motion is None else [Line("motion", motion[:, i])]
        if motion is None or differs:
            lines.append(Line("plan", m.xs[:, i], dashed=differs))
        yield Plot(c.name, c.unit, m.times, lines, limits=(c.lower, c.upper), group=group if m.velocities else "States")


def _parts(m: Measurement) -> int:
    """How many steps of the motion that is shown make one of the plan's intervals."""
    motion = m.shown[0]
    return 1 if motion is None else (len(motion.xs) - 1) // (len(m.xs) - 1)


def _input_plots(m: Measurement) -> Iterator[Plot]:
    """A plot for each input, as a part of its limit where it has one."""
    held, motion = len(m.us) < len(m.times), m.shown[0]
    for i, c in enumerate(m.inputs):
        planned = Line("plan", _as_long(m.us[:, i], m.times), held=held)
        lines = [planned]
        if motion is not None:
            applied = motion.us[:: _parts(m), i]
            same = held and np.array_equal(applied, m.us[:, i])
            ours = Line("motion", _as_long(applied, m.times), held=True)
            lines = [ours] if same else [ours, replace(planned, dashed=True)]
        yield Plot(f"input {c.name}", c.unit, m.times, lines, limits=(c.lower, c.upper), percent=True, group="Inputs")


def _as_long(values: Array, times: Array) -> Array:
    """`values` with as many entries as there are times, the last one held or missing ones NaN."""
    missing = max(0, len(times) - len(values))
    return np.append(values, np.full(missing, values[-1] if missing == 1 and len(values) else np.nan))


def _replay_plots(m: Measurement) -> Iterator[Plot]:
    lines = []
    for r in m.replays:
        if r.motion is not None:
            parts = (len(r.motion.xs) - 1) // (len(m.xs) - 1)
            lines.append(Line(f"{r.variant}, {r.control}", np.abs(r.motion.xs[::parts] - m.xs).max(axis=1)))
    note = "the largest difference of a state, in its own unit, in each replay; 0 is not on a log scale"
    for first in range(0, len(lines), SERIES_PER_PLOT):
        part = lines[first : first + SERIES_PER_PLOT]
        yield Plot("distance from the plan", "q, v", m.times, part, log=True, note=note, group="Replays")


def _solver_plots(m: Measurement) -> Iterator[Plot]:
    named = (("|d x_N / d x_k|", "x / x", "final"), ("|d L / d x_k|, L the Lagrangian", "cost / x", "Lagrangian"))
    for (title, unit, name), norms in zip(named, gradient_norms(m.solution), strict=True):
        if norms is None:
            continue
        zero = not np.any(norms > 0)
        note = "0 at every knot" if zero else "0 is not on a log scale"
        yield Plot(title, unit, m.times, [Line(name, norms)], log=not zero, note=note, group=SEARCH)
    rows = m.solution.iterations
    if not rows:
        return
    at, cost = [row.iteration for row in rows], [row.objective for row in rows]
    positive = all(c > 0 for c in cost if math.isfinite(c))
    yield Plot("cost per iteration", "1", at, [Line("cost", cost)], axis="iteration", log=positive, group=SEARCH)
    violations = [
        Line("constraint violation", [row.primal_infeasibility for row in rows]),
        Line("optimality", [row.dual_infeasibility for row in rows]),
    ]
    note = "as the solver prints it; 0 is not on a log scale"
    yield Plot("violation per iteration", "1", at, violations, axis="iteration", log=True, note=note, group=SEARCH)
