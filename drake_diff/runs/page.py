"""The pages of a run, which open without a server: the motion in 3D, and a report.

The first screen of the report states the task and the robot, and whether all checks hold. Plots and numbers follow.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.model.contract import CoordinateTerms
from drake_diff.optimize.goal_markers import Colour, colours_of, meaning_of
from drake_diff.optimize.live import differ, scene_of_plan
from drake_diff.optimize.measure import GIVEN
from drake_diff.optimize.messages import joined
from drake_diff.optimize.replay import OPEN_LOOP
from drake_diff.optimize.solution import Status
from drake_diff.optimize.verification import NEAR
from drake_diff.pages.html import Line, Plot, page_data, write_page
from drake_diff.pages.meshcat import write_replay
from drake_diff.pages.scene import Scene
from drake_diff.runs.measurement import Measurement, gradient_norms
from drake_diff.runs.messages import asked_for

CONTROLS = {
    "open loop": "Inputs alone (open loop)",
    "TVLQR": "With feedback (TVLQR)",
    "TVLQR without offsets": "Feedback without offsets",
}


@dataclass(frozen=True)
class PageCheck:
    """A check: its `title`, its `kind`, and its result in words.

    The kind is "pass", "fail", "undecided", "info", or "warn" for a failure that does not affect the verdict.
    """

    title: str
    kind: str
    text: str


def checks_of(m: Measurement, record: Mapping[str, Any]) -> list[PageCheck]:
    """Return the checks of a run in the order in which they were made."""
    status, count = m.solution.status, record["solver"]["iterations"]
    rounds = f"{count} iteration{'s' * (count != 1)} of {record['solver']['solver']}"
    at_solution = status is Status.CONVERGED_NOT_VERIFIED or NEAR in m.solution.notes
    ended = "stopped at a solution" if at_solution else status.value.replace("_", " ")
    stopped = status in (Status.CONVERGED, Status.CONVERGED_NOT_VERIFIED)
    result = [PageCheck("Solver", "pass" if stopped else "fail", f"{ended} after {rounds}")]
    if m.solution.method == GIVEN:
        is_timing = "search" in (record["inputs"].get("search") or {})
        text = "the timing of a given path, by IPOPT" if is_timing else "a given plan, without a search"
        result = [PageCheck("Solver", "info", text)]
    decided = [m for m in (*record["metrics"], *record["invariants"]) if m["verdict"] != "info"]
    broken = [m["name"] for m in decided if m["verdict"] != "pass"]
    failed = any(m["verdict"] == "fail" for m in decided)
    text = f"not kept: {joined(broken)}" if broken else f"all {len(decided)} bounds are kept"
    result.append(PageCheck("Plan", "fail" if failed else "undecided" if broken else "pass", text))
    result += _of_replays(m, record["replays"])
    certificates = record["gradient"]["certificates"]
    agree = sum(c["verdict"] == "agree" for c in certificates)
    kind = "info" if not certificates else "pass" if agree == len(certificates) else "undecided"
    content = f"{agree} of {len(certificates)} certificates agree" if certificates else "not certified"
    if not certificates and record["problem"].get("motion") == "continuous" and status is Status.CONVERGED:
        kind, content = (
            "pass",
            "that of the end is a slope of another integration",
        )  # otherwise the status is not CONVERGED
    result.append(PageCheck("Gradients", kind, content))
    return result


def _of_replays(m: Measurement, replays: Sequence[Mapping[str, Any]]) -> Iterator[PageCheck]:
    judged = m.solution.judged_replay
    failed = judged is None and not m.solution.success  # each replay may hold under one control, and no control in all
    for control in dict.fromkeys(r["control"] for r in replays):
        tried = [r for r in replays if r["control"] == control]
        lost = [r for r in tried if not r["holds"]]
        enough = judged is not None and judged.control == control
        text = {1: "holds in its replay", 2: "holds in both replays"}.get(
            len(tried), f"holds in all {len(tried)} replays"
        )
        if lost:
            text = f"holds in {len(tried) - len(lost)} of {len(tried)} replays; {lost[0]['variant']}: "
            text += lost[0]["failures"][0] if lost[0]["failures"] else "it fails"
        kind = "pass" if enough or not lost else "fail" if failed else "warn"
        if lost and kind == "pass":  # the verdict depends on the replays that hold, so no failure is shown
            text = f"holds {joined([r['variant'] for r in tried if r['holds']])}; see Replays for other steps"
        yield PageCheck(CONTROLS.get(control, control), kind, text)


SERIES_PER_PLOT = 6  # more lines are hard to distinguish
PHYSICS, SEARCH = "Energy and contact", "Search"


def write_pages(replay: Path, report: Path, m: Measurement, record: Mapping[str, Any]) -> None:
    """Write the pages of a measurement, whose `record` is given as plain data.

    Plain dynamics have no 3D scene and therefore no page `replay`. The same solution gives the same bytes, except for
    the paragraph of wall-clock times.
    """
    plots, view, colours = list(plots_of(m)), "", list[Colour]()
    if m.solution.problem.has_model:
        scene = scene_of_plan(m.solution, m.shown[0])
        write_replay(replay, scene, title=f"{record['name']}: {m.solution.status.value.replace('_', ' ')}")
        view, colours = replay.read_text(encoding="utf-8"), [*_colours_of(scene), *meaning_of(m.solution.problem.goals)]
    data = page_data(float(m.times[-1]), plots, m.solution.certificates)
    judged = m.solution.judged_replay
    write_page(
        report,
        "report.html.j2",
        record=record,
        data=data,
        view=view,
        asked=asked_for(m.solution.problem, m.times),
        checks=checks_of(m, record),
        cost=m.solution.cost,
        certificates=alike(record["gradient"]["certificates"]),
        replayed=m.shown[0] is not None,
        control="open loop" if judged is None else judged.control,
        variant=f"in steps of {m.solution.time_step:g} s" if judged is None else judged.variant,
        leaves=next((r["variant"] for r in record["replays"] if r["control"] == OPEN_LOOP and not r["holds"]), ""),
        colours=colours,
    )


def _colours_of(scene: Scene) -> list[Colour]:
    """Return the colours of the objects that a replay shows in addition to the robot."""
    return colours_of(plan=bool(scene.ghosts), contacts=any(scene.contacts), thrusts=any(scene.thrusts))


def alike(certificates: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Merge successive certificates of equal content into a row; `power` is the largest one, the least sensitive."""
    rows: list[dict[str, Any]] = []
    for number, c in enumerate(certificates):
        content = {name: c[name] for name in ("subject", "method", "verdict", "entries")} | {
            "agree": c["counts"]["agree"]
        }
        if not rows or any(rows[-1][name] != value for name, value in content.items()):
            rows.append({**content, "first": number, "count": 0, "power": 0.0})
        row = rows[-1]
        row["count"] += 1
        row["power"] = max(row["power"], c["power"])
        row["numbers"] = f"{row['first']} to {number}" if row["count"] > 1 else str(number)
    return rows


def plots_of(m: Measurement) -> Iterator[Plot]:
    """Yield the plots of the report, over time and over the solver's iterations."""
    yield from _state_plots(m, "Positions", 0, m.positions)
    yield from _state_plots(m, "Velocities", len(m.positions), m.velocities)
    yield from _input_plots(m)
    motion = m.shown[0]
    if motion is not None:
        times, energy = motion.times, Line("total", motion.energy)
        parts = [Line("kinetic", motion.kinetic_energy), Line("potential", motion.potential_energy), energy]
        yield Plot("energy", "J", times, parts, group=PHYSICS)
        note = "change of energy that inputs, damping, contact and joint limits do not explain: an error of the steps"
        yield Plot("unexplained energy", "J", times, [Line("error", motion.energy_error)], note=note, group=PHYSICS)
        note = "nothing can touch"
        if math.isfinite(m.penetration_limit):
            note = f"limit {m.penetration_limit:.3g} m, a quarter of {m.thinnest}"
        overlap = [Line("largest overlap", motion.penetration)]
        yield Plot("penetration", "m", times, overlap, limits=(None, m.penetration_limit), note=note, group=PHYSICS)
    yield from _replay_plots(m)
    yield from _solver_plots(m)


def _state_plots(m: Measurement, group: str, start: int, columns: Sequence[CoordinateTerms]) -> Iterator[Plot]:
    """Yield a plot for each column: the motion, and the plan if it differs. Plain dynamics have only "States"."""
    shown = m.shown[0]
    motion = m.integrated if shown is None else shown.xs[:: _parts(m)]
    differs = motion is not None and differ(motion, m.xs)
    for i, c in enumerate(columns, start):
        lines = [] if motion is None else [Line("motion", motion[:, i])]
        if motion is None or differs:
            lines.append(Line("plan", m.xs[:, i], dashed=differs))
        yield Plot(c.name, c.unit, m.times, lines, limits=(c.lower, c.upper), group=group if m.velocities else "States")


def _parts(m: Measurement) -> int:
    """Return the number of steps of the displayed motion per interval of the plan."""
    motion = m.shown[0]
    return 1 if motion is None else (len(motion.xs) - 1) // (len(m.xs) - 1)


def _input_plots(m: Measurement) -> Iterator[Plot]:
    """Yield a plot for each input, relative to its limit if it has one."""
    held, motion = len(m.us) < len(m.times), m.shown[0]
    for i, c in enumerate(m.inputs):
        planned = Line("plan", padded(m.us[:, i], len(m.times)), held=held)
        lines = [planned]
        if motion is not None:
            applied = motion.us[:: _parts(m), i]
            same = held and not differ(applied[:, None], m.us[:, i : i + 1])
            ours = Line("motion", padded(applied, len(m.times)), held=True)
            lines = [ours] if same else [ours, replace(planned, dashed=True)]
        yield Plot(f"input {c.name}", c.unit, m.times, lines, limits=(c.lower, c.upper), percent=True, group="Inputs")


def padded(rows: Array, count: int) -> Array:
    """Pad `rows` (n, ...) with NaN to (count, ...). If a single row is missing, the last row is repeated instead."""
    rows = np.concatenate([rows, rows[-1:]]) if len(rows) == count - 1 else rows[:count]
    return np.concatenate([rows, np.full((count - len(rows), *rows.shape[1:]), np.nan)])


def _replay_plots(m: Measurement) -> Iterator[Plot]:
    lines = []
    for r in m.replays:
        if r.motion is not None:
            parts = (len(r.motion.xs) - 1) // (len(m.xs) - 1)
            lines.append(Line(f"{r.variant}, {r.control}", np.abs(r.motion.xs[::parts] - m.xs).max(axis=1)))
    note = "the largest difference of a state, in its own unit, in each replay; 0 is not on a log scale"
    for first in range(0, len(lines), SERIES_PER_PLOT):
        piece = lines[first : first + SERIES_PER_PLOT]
        yield Plot("distance from the plan", "q, v", m.times, piece, log=True, note=note, group="Replays")


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
    iterations, cost = [row.iteration for row in rows], [row.objective for row in rows]
    positive = all(c > 0 for c in cost if math.isfinite(c))
    yield Plot(
        "cost per iteration", "1", iterations, [Line("cost", cost)], axis="iteration", log=positive, group=SEARCH
    )
    violations = [
        Line("constraint violation", [row.primal_infeasibility for row in rows]),
        Line("optimality", [row.dual_infeasibility for row in rows]),
    ]
    note = "as the solver prints it; 0 is not on a log scale"
    yield Plot(
        "violation per iteration", "1", iterations, violations, axis="iteration", log=True, note=note, group=SEARCH
    )
