"""The numbers that a report plots, as plain data for JSON: time series, solver iterations, certificates."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from drake_diff.arrays import Array
from drake_diff.certificate import VERDICTS, Certificate
from drake_diff.contact import thinnest_geometry
from drake_diff.replay import PENETRATION_PART, Replay
from drake_diff.rollout import Rollout
from drake_diff.solution import Solution

SERIES_PER_PLOT = 6  # more lines cannot be told apart
Plot = dict[str, Any]


def report_data(solution: Solution) -> dict[str, Any]:
    """`plots` over time or iterations, `certificates` for heat maps, and the `duration` [s]; None stands for no number.

    A plot has `title`, `unit`, `axis` ("time", "knot" or "iteration"), `x`, `series` (name, y, dashed, held), `log`,
    `limits` [lower, upper], a `note`, `marks` ("lines", "points" or "both"), `levels` (whether x is the few levels of
    something, on a log scale), `range` of y where it is given, and a `place`, that of `html_parts.plots`. Between the
    last two series of a `band` it is shaded.
    """
    motion = solution.replay
    plots = [*_state_plots(solution, motion), *_input_plots(solution, motion)]
    plots += [] if motion is None else [*_energy_plots(motion), _penetration_plot(solution, motion)]
    plots += [*_replay_plots(solution), *_gradient_plots(solution), *_iteration_plots(solution)]
    return {
        "duration": float(solution.times[-1]),
        "plots": plots,
        "certificates": [certificate_data(c) for c in solution.certificates],
        "verdicts": list(VERDICTS),
    }


def plot(title: str, unit: str, x: Iterable[Any], series: Sequence[Plot], *, axis: str = "time", **rest: Any) -> Plot:
    base = {"title": title, "unit": unit, "axis": axis, "x": numbers(x), "series": list(series)}
    plain = {"log": False, "levels": False, "limits": [None, None], "note": "", "marks": "lines", "band": False}
    return base | plain | {"place": "plots", "range": None} | rest


def line(name: str, y: Iterable[Any], *, dashed: bool = False, held: bool = False) -> Plot:
    return {"name": name, "y": numbers(y), "dashed": dashed, "held": held}


def numbers(values: Iterable[Any]) -> list[float | None]:
    return [float(f"{v:.8g}") if math.isfinite(v) else None for v in values]


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


def certificate_data(c: Certificate) -> dict[str, Any]:
    return {
        "subject": c.subject,
        "method": c.method,
        "verdict": c.verdict,
        "rows": list(c.rows),
        "columns": list(c.columns),
        "codes": c.codes.ravel().tolist(),
        "derivative": numbers(c.derivative.ravel()),
        "difference": numbers(c.difference.ravel()),
        "tolerance": numbers(c.tolerance.ravel()),
    }
