"""A comparison as one page that opens from a disk: the verdict, the motions, plots, tables, contracts."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.certificates.certificate import VERDICTS
from drake_diff.comparison.result import JACOBIAN_TOLERANCE, STEP_TOLERANCE, Compared, Comparison
from drake_diff.engines.motion import EngineMotion
from drake_diff.pages.html import (
    Mark,
    Row,
    escaped,
    provenance,
    section,
    short_number,
    slider,
    stage,
    table,
    write_page,
)
from drake_diff.pages.plots import Plot, certificate_data, line, plot
from drake_diff.record.comparison import ComparisonRecord, EngineEvidence

SAME_TIME = 1e-6  # [s] clocks in single precision are within it
MOST_PLOTS = 12  # of coordinates; those whose motions are furthest apart
KINDS = {"same": "pass", "other law": "undecided", "other model": "fail", "unexplained": "fail"}
APART = ("wall_clock", "files", "record_sha256")


def write_comparison_page(path: Path, comparison: Comparison, record: ComparisonRecord, replay: Path) -> None:
    """Write the page of `comparison` with its `record` and the page `replay`, which has the engines as ghosts."""
    fields = record.model_dump(mode="json")
    embedded = {key: value for key, value in fields.items() if key not in APART}
    view, body = replay.read_text(), "\n".join(_sections(comparison, record, fields, replay.read_text()))
    write_page(path, f"{record.name}: {record.verdict}", body, comparison_data(comparison), embedded, view)


def comparison_data(comparison: Comparison) -> dict[str, Any]:
    """What the page plots; see `report_data`."""
    doubtful = [
        j.certificate
        for e in comparison.engines
        for j in e.jacobians
        if j.certificate is not None and j.certificate.verdict != "agree"
    ]
    return {
        "duration": float(comparison.reference.motion.times[-1]),
        "plots": [*_gap_plots(comparison), *_measure_plots(comparison), *_coordinate_plots(comparison)],
        "certificates": [certificate_data(c) for c in doubtful],
        "verdicts": list(VERDICTS),
    }


def _on(times: Array, motion: EngineMotion, values: Array) -> Array:
    """`values` (n,) of a motion at `times`, NaN where it has none."""
    found = np.full(len(times), np.nan)
    at = np.searchsorted(times, motion.times - SAME_TIME)
    known = (at < len(times)) & (np.abs(times[np.minimum(at, len(times) - 1)] - motion.times) < SAME_TIME)
    found[at[known]] = np.asarray(values)[known]
    return found


def _gap_plots(comparison: Comparison) -> Iterable[Plot]:
    """Against Drake: where a gap arises, and what becomes of it."""
    times = comparison.reference.motion.times
    steps, distances = [], []
    for e in comparison.engines[1:]:
        steps.append(line(e.engine, _on(times, e.motion, np.append(e.step_gaps, np.nan))))
        distances.append(line(e.engine, _on(times, e.motion, _distance(comparison, e))))
    note = "of one step to Drake's from the same state, relative to the state; 0 is not on a log scale"
    yield plot(
        "gap of each step",
        "1",
        times,
        [line("drake, the reference", np.full(len(times), np.nan)), *steps],
        log=True,
        note=note,
    )
    note = "the largest difference of a state, in its own unit"
    first = line("drake, the reference", np.full(len(times), np.nan))
    yield plot("distance from Drake's motion", "q, v", times, [first, *distances], log=True, note=note)


def _distance(comparison: Comparison, e: Compared) -> Array:
    ours = comparison.reference.motion
    columns = [_on(e.motion.times, ours, x) for x in ours.xs.T]
    return np.asarray(np.abs(e.motion.xs - np.array(columns).T).max(axis=1))


def _measure_plots(comparison: Comparison) -> Iterable[Plot]:
    times = comparison.reference.motion.times
    energies = [
        line(e.engine, _on(times, e.motion, e.motion.energy - e.motion.energy[0]))
        for e in comparison.engines
        if e.motion.energy is not None
    ]
    note = "kinetic and potential, less that at the start; inputs, damping and contact change it too"
    yield plot("energy", "J", times, energies, note=note)
    depths = [
        line(e.engine, _on(times, e.motion, e.motion.depth)) for e in comparison.engines if e.motion.depth is not None
    ]
    yield plot("penetration", "m", times, depths, note="the deepest overlap that the engine finds")


def _coordinate_plots(comparison: Comparison) -> Iterable[Plot]:
    """Those coordinates whose motions are furthest apart, in the order of the state."""
    model, times = comparison.model, comparison.reference.motion.times
    units = [c.unit for c in (*model.contract.positions, *model.contract.velocities)]
    spread = []
    for i in range(model.nx):
        known = np.array([_on(times, e.motion, e.motion.xs[:, i]) for e in comparison.engines])
        spread.append(float(np.nanmax(np.nanmax(known, axis=0) - np.nanmin(known, axis=0))))
    shown = sorted(np.argsort(spread)[::-1][:MOST_PLOTS])
    for i in shown:
        lines = [line(e.engine, _on(times, e.motion, e.motion.xs[:, i])) for e in comparison.engines]
        yield plot(model.state_names[i], units[i], times, lines)


def _sections(comparison: Comparison, record: ComparisonRecord, fields: Mapping[str, Any], view: str) -> Iterable[str]:
    motion = comparison.reference.motion
    yield (
        f'<header><p class="pill {record.verdict}">{record.verdict}</p><h1>{escaped(record.name)}</h1>'
        f'<p class="sentence">{escaped(record.sentence)}</p>'
        f'<p class="facts">{escaped(comparison.model.name)} · {motion.times[-1]:.6g} s in {len(motion.us)} steps · '
        f"{len(record.engines)} engines, {len(record.refused)} not compared</p></header>"
    )
    left = comparison.model.nx - MOST_PLOTS
    caption = "Drake in its own colours, the other engines as ghosts in the colours of their lines."
    yield stage(view, f"{caption} Plotted: the {MOST_PLOTS} coordinates that differ most." if left > 0 else caption)
    yield section("Engines", _engines(record) + _refused(record))
    yield section("What makes steps differ", _terms(record))
    yield section("Jacobians", _jacobians(record) + '<div id="maps"></div>')
    yield section("Contracts against Drake's", "".join(_contract(e) for e in record.engines[1:]))
    yield section("Provenance", provenance(fields))
    yield slider(float(motion.times[-1]))


def _engines(record: ComparisonRecord) -> str:
    head = (
        "engine", "verdict", "largest gap of a step", "apart from", "gap at the end", "energy change [J]",
        "penetration [m]", "step", "Jacobian", "in words",
    )  # fmt: skip
    rows: list[Row] = []
    for i, e in enumerate(record.engines):
        step, jacobian = (
            _time(times[e.engine])
            for times in (record.wall_clock.seconds_per_step, record.wall_clock.seconds_per_jacobian)
        )
        rows.append(
            (
                f"{e.engine} {e.version}",
                Mark(KINDS[e.verdict], e.verdict if i else "the reference"),
                short_number(e.largest_step_gap),
                "" if e.first_apart_s is None else f"{e.first_apart_s:.4g} s",
                short_number(e.final_gap),
                short_number(e.energy_change_J),
                short_number(e.largest_penetration_m),
                step,
                jacobian,
                e.sentence if i else "",
            )
        )
    note = f"tolerances of a step: {_tolerances(STEP_TOLERANCE)}, relative to the state where that is above 1"
    return table(head, rows) + f'<p class="note">{escaped(note)}</p>'


def _tolerances(tolerances: Mapping[Any, float]) -> str:
    return ", ".join(f"{value:g} in {precision}" for precision, value in tolerances.items())


def _time(seconds: float | None) -> str:
    return "none" if seconds is None else f"{1e6 * seconds:.0f} µs"


def _refused(record: ComparisonRecord) -> str:
    rows = [(r.engine, "not for this model" if r.installed else "not installed", r.reason) for r in record.refused]
    return "<h3>Not compared</h3>" + table(("engine", "", "why"), rows) if rows else ""


def _terms(record: ComparisonRecord) -> str:
    head = ("engine", "step", "gap", "responsible", "effect of each term alone", "scheme", "assumed")
    rows: list[Row] = []
    for e in record.engines[1:]:
        for which, a in (("first apart", e.first), ("largest", e.largest)):
            effects = ", ".join(f"{term} {size:.2g}" for term, size in a.effects.items() if size > 0) or "none"
            rows.append((e.engine, which, f"{a.gap:.2g}", a.responsible, effects, a.schemes[1], ", ".join(a.assumed)))
    note = (
        "each term of the engine alone put into Drake's step; what no term explains is contact, limits or unexplained"
    )
    return table(head, rows) + f'<p class="note">{escaped(note)}</p>'


def _jacobians(record: ComparisonRecord) -> str:
    head = ("engine", "state", "derivative", "gap to Drake's", "is it its own step's?", "rollout gap to Drake's")
    rows: list[Row] = []
    for e in record.engines:
        for j in e.jacobians:
            own = Mark("undecided", "made of differences") if j.own is None else _own(j.own)
            rows.append((e.engine, j.state, j.method, short_number(j.gap), own, short_number(e.rollout_gap)))
    note = f"relative to the largest entry; tolerances: {_tolerances(JACOBIAN_TOLERANCE)}"
    return table(head, rows) + f'<p class="note">{escaped(note)}</p>'


def _own(verdict: str) -> Mark:
    return Mark({"agree": "pass", "undecided": "undecided"}.get(verdict, "fail"), verdict)


def _contract(e: EngineEvidence) -> str:
    kinds = {"equal": "pass", "mapped": "undecided", "different": "fail"}
    rows = [(x.quantity, Mark(kinds[x.verdict], x.verdict), x.detail) for x in e.contract]
    different = sum(x.verdict == "different" for x in e.contract)
    found = table(("quantity", "", "detail"), rows)
    return f"<details><summary>{escaped(e.engine)}: {different} of {len(rows)} different</summary>{found}</details>"
