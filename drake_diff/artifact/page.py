"""A run as one page that opens from a disk: what was found, the motion, plots, certificates, contract, provenance."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.model.contact import thinnest_geometry
from drake_diff.motion.rollout import Rollout
from drake_diff.optimize.replay import PENETRATION_PART, Replay
from drake_diff.optimize.solution import Solution
from drake_diff.pages.html import write_page
from drake_diff.pages.plots import Plot, line, numbers, page_data, plot

SERIES_PER_PLOT = 6  # more lines cannot be told apart


def write_report(path: Path, solution: Solution, record: Mapping[str, Any], replay: Path) -> None:
    """Write the page of `solution` with its `record` (plain data) and the page `replay` inside.

    The bytes are the same for the same solution, but for the paragraph of wall-clock times.
    """
    motion = solution.replay
    write_page(
        path,
        "report.html.j2",
        record=record,
        data=report_data(solution),
        view=replay.read_text(encoding="utf-8"),
        cost=solution.cost,
        replayed=motion is not None,
        has_plan=solution.transcribed is not None,
        has_contacts=motion is not None and any(motion.contacts),
    )


def report_data(solution: Solution) -> dict[str, Any]:
    """What the report draws (see `page_data`): plots over time and over iterations, and every certificate."""
    motion = solution.replay
    plots = [*_state_plots(solution, motion), *_input_plots(solution, motion)]
    plots += [] if motion is None else [*_energy_plots(motion), _penetration_plot(solution, motion)]
    plots += [*_replay_plots(solution), *_gradient_plots(solution), *_iteration_plots(solution)]
    return page_data(float(solution.times[-1]), plots, solution.certificates)


def _state_plots(solution: Solution, motion: Rollout | None) -> list[Plot]:
    """Positions and velocities, those of one unit together."""
    model, plots = solution.problem.model, []
    for title, start, coordinates in (
        ("positions", 0, model.contract.positions),
        ("velocities", model.nq, model.contract.velocities),
    ):
        for unit in dict.fromkeys(c.unit for c in coordinates):
            columns = [start + i for i, c in enumerate(coordinates) if c.unit == unit]
            for first in range(0, len(columns), SERIES_PER_PLOT):
                plots.append(_state_plot(solution, motion, title, unit, columns[first : first + SERIES_PER_PLOT]))
    return plots


def _state_plot(solution: Solution, motion: Rollout | None, title: str, unit: str, columns: list[int]) -> Plot:
    names, bounds = solution.problem.model.state_names, solution.problem.bounds
    shown = motion is not None and not np.array_equal(motion.xs, solution.xs)
    lines = [] if motion is None else [line(names[i], motion.xs[:, i]) for i in columns]
    if motion is None or shown:
        lines += [line(f"{names[i]}, plan", solution.xs[:, i], dashed=shown) for i in columns]
    limits: list[float | None] = [None, None]
    if len(columns) == 1:
        limits = numbers([bounds.x_lower[columns[0]], bounds.x_upper[columns[0]]])
    return plot(title, unit, solution.times, lines, limits=limits)


def _input_plots(solution: Solution, motion: Rollout | None) -> list[Plot]:
    """A plot for each input: the limits of two differ as a rule."""
    model, bounds, plots = solution.problem.model, solution.problem.bounds, []
    knots = solution.inputs_at_knots
    held = len(knots) < len(solution.times)
    for i, c in enumerate(model.contract.inputs):
        planned = line("plan" if motion is not None else c.name, _as_long(knots[:, i], solution), held=held)
        lines = [planned]
        if motion is not None:
            applied = motion.us[:, i]
            same = held and np.array_equal(applied, knots[:, i])
            lines = [
                line(c.name, _as_long(applied, solution), held=True),
                *([] if same else [planned | {"dashed": True}]),
            ]
        limits = numbers([bounds.u_lower[i], bounds.u_upper[i]])
        plots.append(plot(f"input {c.name}", c.unit, solution.times, lines, limits=limits))
    return plots


def _as_long(values: Array, solution: Solution) -> Array:
    """`values` with as many entries as there are times, the last one held or missing ones NaN."""
    missing = max(0, len(solution.times) - len(values))
    return np.append(values, np.full(missing, values[-1] if missing == 1 and len(values) else np.nan))


def _energy_plots(motion: Rollout) -> list[Plot]:
    shown = [("kinetic", motion.kinetic_energy), ("potential", motion.potential_energy), ("total", motion.energy)]
    note = "what neither actuators nor damping account for: the time stepping's error, and what contact takes"
    return [
        plot("energy", "J", motion.times, [line(name, values) for name, values in shown]),
        plot("unexplained energy", "J", motion.times, [line("error", motion.energy_error)], note=note),
    ]


def _penetration_plot(solution: Solution, motion: Rollout) -> Plot:
    size, name = thinnest_geometry(solution.problem.model)
    limit = PENETRATION_PART * size
    note = f"limit {limit:.3g} m, a quarter of {name}" if math.isfinite(limit) else "nothing can touch"
    overlap = line("largest overlap", motion.penetration)
    return plot("penetration", "m", motion.times, [overlap], limits=[None, *numbers([limit])], note=note)


def _replay_plots(solution: Solution) -> list[Plot]:
    lines = [line(f"{r.variant}, {r.control}", found) for r in solution.replays if (found := _distance(solution, r))]
    if not lines:
        return []
    note = "the largest difference of a state, in its own unit, in each replay; 0 is not on a log scale"
    plots = [lines[i : i + SERIES_PER_PLOT] for i in range(0, len(lines), SERIES_PER_PLOT)]
    return [plot("distance from the plan", "q, v", solution.times, part, log=True, note=note) for part in plots]


def _distance(solution: Solution, replay: Replay) -> list[float]:
    """At the plan's knots; nothing where the replay could not be taken."""
    if replay.motion is None:
        return []
    parts = (len(replay.motion.xs) - 1) // (len(solution.xs) - 1)
    return [float(d) for d in np.abs(replay.motion.xs[::parts] - solution.xs).max(axis=1)]


def _gradient_plots(solution: Solution) -> list[Plot]:
    norms = solution.gradient_norms
    if norms is None:
        return []
    zero = not np.any(norms > 0)
    note = "0 at every knot: the cost does not depend on the states" if zero else "0 is not on a log scale"
    lines = [line("norm", norms)]
    return [plot("gradient norm |d cost / d x_k|", "cost / x", solution.times, lines, log=not zero, note=note)]


def _iteration_plots(solution: Solution) -> list[Plot]:
    rows = solution.iterations
    if not rows:
        return []
    at, cost = [row.iteration for row in rows], [row.objective for row in rows]
    violations = [
        line("constraint violation", [row.primal_infeasibility for row in rows]),
        line("optimality", [row.dual_infeasibility for row in rows]),
    ]
    positive = all(c > 0 for c in cost if math.isfinite(c))
    note = "as the solver prints it; 0 is not on a log scale"
    return [
        plot("cost per iteration", "1", at, [line("cost", cost)], axis="iteration", log=positive),
        plot("violation per iteration", "1", at, violations, axis="iteration", log=True, note=note),
    ]
