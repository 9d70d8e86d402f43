"""A run as one page that opens from a disk: what was found, the motion, plots, certificates, contract, provenance."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from drake_diff.html_parts import (
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
from drake_diff.report_data import report_data
from drake_diff.solution import Solution

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
