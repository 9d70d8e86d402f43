"""The numbers that a report plots, as plain data for JSON: time series, solver iterations, certificates.

A run as one page that opens from a disk: what was found, the motion, plots, certificates, contract, provenance.
"""

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.certificates.certificate import VERDICTS
from drake_diff.model.contact import thinnest_geometry
from drake_diff.motion.rollout import Rollout
from drake_diff.optimize.replay import PENETRATION_PART, Replay
from drake_diff.optimize.solution import Solution
from drake_diff.pages.html import (
    Mark,
    Row,
    escaped,
    in_words,
    phrase,
    provenance,
    section,
    short_number,
    slider,
    stage,
    table,
    write_page,
)
from drake_diff.pages.plots import Plot, certificate_data, line, numbers, plot

SERIES_PER_PLOT = 6  # more lines cannot be told apart


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


MEASURES = ("checks", "metrics", "invariants")  # the sections of a record that hold numbers with a verdict
SYMBOLS = {"pass": "✓ holds", "fail": "✗ does not hold", "undecided": "? undecided", "info": ""}

# Of the record: what is not reproducible, and hashes, which cannot be in what they are the hash of.
APART = ("wall_clock", "files", "record_sha256")


def write_report(path: Path, solution: Solution, record: Mapping[str, Any], replay: Path) -> None:
    """Write the page of `solution` with its `record` (plain data) and the page `replay` inside.

    The bytes are the same for the same solution but for the paragraph of wall-clock facts. The record is embedded
    without those, and without `files`, which could not hold this page's own hash.
    """
    embedded = {key: value for key, value in record.items() if key not in APART}
    view, title = replay.read_text(), f"{record['name']}: {record['verdict']}"
    write_page(path, title, "\n".join(_sections(solution, record, view)), report_data(solution), embedded, view)


def _sections(solution: Solution, record: Mapping[str, Any], view: str) -> Iterable[str]:
    yield _header(solution, record)
    failures = section("What does not hold", _failures(record))
    yield "" if solution.success else failures  # first of all, where there is something
    yield stage(view, _caption(solution))
    yield failures if solution.success else ""
    yield section("Measured again on the plant", _measures(record))
    yield section("Replays in variants of the plant", _replays(solution))
    yield section("Certificates of the gradients", _certificates(solution))
    yield section("Contract", _contract(record["contract"]))
    yield section("Provenance", provenance(record))
    yield slider(float(solution.times[-1]))


def _header(solution: Solution, record: Mapping[str, Any]) -> str:
    facts = f"{solution.method} with {solution.solver}: {solution.status.value}, {len(solution.iterations)} iterations"
    verdict = escaped(record["verdict"])
    return (
        f'<header><p class="pill {verdict}">{verdict}</p><h1>{escaped(record["name"])}</h1>'
        f'<p class="sentence">{escaped(record["sentence"])}</p>'
        f'<p class="facts">{escaped(solution.problem.model.name)} · {escaped(facts)} · {solution.horizon:.6g} s in '
        f"{len(solution.us)} steps · cost {short_number(solution.cost)}</p></header>"
    )


def _caption(solution: Solution) -> str:
    motion = solution.replay
    if motion is None:
        return (
            "The solver's states, not a replay: the discrete plant could not be stepped along these inputs. States "
            "that are not finite are drawn at the initial state."
        )
    told = ["The discrete plant's own open-loop motion under the planned inputs."]
    if solution.transcribed is not None:
        told.append("Blue, translucent: the plan.")
    told.append("Orange: the way of the centre of mass that moves most.")
    if any(motion.contacts):
        told.append("Red: contact forces, as long as they are large; the largest tenth may be cut.")
    return " ".join(told)


def _failures(record: Mapping[str, Any]) -> str:
    rows = [(phrase(f["label"]), f["code"], f["message"]) for f in record.get("failures", [])]
    found = table(("label", "code", "message"), rows) if rows else '<p class="note">Nothing: every bound is kept.</p>'
    events = [(short_number(e.get("t_s")), phrase(e["kind"]), e["message"]) for e in record.get("events", [])]
    return found + (("<h3>Events</h3>" + table(("time [s]", "kind", "message"), events)) if events else "")


def _measures(record: Mapping[str, Any]) -> str:
    rows = [_measure(m) for section in MEASURES for m in record.get(section, [])]
    return table(("measure", "definition", "value", "unit", "bound", "verdict"), rows)


def _measure(m: Mapping[str, Any]) -> Row:
    quantity = m.get("quantity", m)
    bound = m.get("bound", m.get("tolerance"))
    verdict = m.get("verdict", {True: "pass", False: "fail", None: "info"}[m.get("passed")])
    value = quantity["reason"] if quantity["value"] is None else short_number(quantity["value"])
    shown = "" if bound is None else f"{'≥' if m.get('direction') == 'at_least' else '≤'} {short_number(bound)}"
    return (m["name"], m["definition"], value, quantity["unit"], shown, Mark(verdict, SYMBOLS[verdict]))


def _replays(solution: Solution) -> str:
    head = ("variant", "control", "goal error", "beyond bounds", "energy error [J]", "penetration [m]", "verdict")
    rows = []
    for r in solution.replays:
        numbers = [short_number(v) for v in (r.goal_error, r.bound_violation, r.energy_error, r.penetration)]
        verdict = "✓ holds" if r.holds else "✗ " + "; ".join(r.failures)
        rows.append((r.variant, r.control, *numbers, Mark("pass" if r.holds else "fail", verdict)))
    return table(head, rows) if rows else '<p class="note">The plan could not be replayed.</p>'


def _certificates(solution: Solution) -> str:
    if not solution.certificates:
        return '<p class="note">No derivative was certified.</p>'
    rows = [
        (i, c.subject, c.method, f"{c.count('agree')} of {c.codes.size}", Mark(_kind(c.verdict), c.verdict))
        for i, c in enumerate(solution.certificates)
    ]
    note = '<p class="note">An entry is a square: point at it for both numbers.</p>'
    return table(("", "of", "derivative", "entries agree", "verdict"), rows) + note + '<div id="maps"></div>'


def _kind(verdict: str) -> str:
    return {"agree": "pass", "undecided": "undecided", "not_converged": "undecided"}.get(verdict, "fail")


def _contract(contract: Mapping[str, Any]) -> str:
    """Every section of the contract as it is: tables of what comes in lists, names and values of the rest."""
    plain = {key: value for key, value in contract.items() if not _is_rows(value) and value not in ([], {})}
    parts = [table(("", ""), [(phrase(key), in_words(value)) for key, value in plain.items()])]
    for key, rows in contract.items():
        if _is_rows(rows):
            names = list(rows[0])
            columns = table([phrase(n) for n in names], [[in_words(row[n]) for n in names] for row in rows])
            parts.append(f"<details open><summary>{escaped(phrase(key))} ({len(rows)})</summary>{columns}</details>")
    return "".join(parts)


def _is_rows(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)
