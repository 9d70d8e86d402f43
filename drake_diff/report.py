"""A run as one page that opens from a disk: what was found, the motion, plots, certificates, contract, provenance."""

import html
import json
import shlex
from collections.abc import Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from drake_diff.page import content_policy
from drake_diff.report_data import report_data
from drake_diff.solution import Solution
from drake_diff.whole_file import write_whole

Row = Sequence[Any]
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
    view = replay.read_text()
    data = _script_json("data", report_data(solution)) + _script_json("record", embedded)
    body = "\n".join(_sections(solution, record, view))
    scripts = "".join(f"<script>{_asset(name)}</script>\n" for name in ("uPlot.iife.min.js", "report.js"))
    style = _asset("uPlot.min.css") + _asset("report.css")
    head = (
        f'<meta charset="utf-8">\n{content_policy(view, scripts)}\n<meta name="viewport" content="width=device-width">'
    )
    title = f"<title>{_text(record['name'])}: {_text(record['verdict'])}</title>"
    page = f"{head}\n{title}\n<style>{style}</style>\n</head><body>\n{body}\n{data}{scripts}</body></html>\n"
    write_whole(path, ('<!doctype html>\n<html lang="en"><head>\n' + page).encode())


def _asset(name: str) -> str:
    return files("drake_diff").joinpath("assets", name).read_text(encoding="utf-8")


def _script_json(name: str, value: Any) -> str:
    """JSON that no text in it can end early."""
    text = json.dumps(value, sort_keys=True, allow_nan=False, separators=(",", ":"))
    text = text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return f'<script type="application/json" id="{name}">{text}</script>\n'


def _sections(solution: Solution, record: Mapping[str, Any], view: str) -> Iterable[str]:
    yield _header(solution, record)
    failures = _section("What does not hold", _failures(record))
    yield "" if solution.success else failures  # first of all, where there is something
    plots = '<section><h2>Plots</h2><div id="plots" class="plots"></div></section>'
    yield f'<div class="stage">{_view(solution, view)}{plots}</div>'
    yield failures if solution.success else ""
    yield _section("Measured again on the plant", _measures(record))
    yield _section("Replays in variants of the plant", _replays(solution))
    yield _section("Certificates of the gradients", _certificates(solution))
    yield _section("Contract", _contract(record["contract"]))
    yield _section("Provenance", _provenance(record))
    yield _slider(float(solution.times[-1]))


def _header(solution: Solution, record: Mapping[str, Any]) -> str:
    facts = f"{solution.method} with {solution.solver}: {solution.status.value}, {len(solution.iterations)} iterations"
    verdict = _text(record["verdict"])
    return (
        f'<header><p class="pill {verdict}">{verdict}</p><h1>{_text(record["name"])}</h1>'
        f'<p class="sentence">{_text(record["sentence"])}</p>'
        f'<p class="facts">{_text(solution.problem.model.name)} · {_text(facts)} · {solution.horizon:.6g} s in '
        f"{len(solution.us)} steps · cost {_number(solution.cost)}</p></header>"
    )


def _view(solution: Solution, view: str) -> str:
    """The replay, with what is to be seen in it."""
    return (
        '<section id="motion"><h2>Motion</h2>'
        f'<iframe id="view" title="the motion in 3D" srcdoc="{html.escape(view)}"></iframe>'
        f'<p class="note">{_text(_caption(solution))}</p>'
        '<img id="still" alt="the motion at the time of the slider"></section>'
    )


def _slider(end: float) -> str:
    """The time that the view and the plots follow; it stays in sight."""
    return (
        '<div class="controls bar"><button id="play" type="button" aria-label="play or pause">▶</button>'
        f'<input id="time" type="range" aria-label="time" min="0" max="{end!r}" step="any" value="0">'
        '<output id="now" for="time">0 s</output></div>'
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
    rows = [(_phrase(f["label"]), f["code"], f["message"]) for f in record.get("failures", [])]
    found = _table(("label", "code", "message"), rows) if rows else '<p class="note">Nothing: every bound is kept.</p>'
    events = [(_number(e.get("t_s")), _phrase(e["kind"]), e["message"]) for e in record.get("events", [])]
    return found + (("<h3>Events</h3>" + _table(("time [s]", "kind", "message"), events)) if events else "")


def _measures(record: Mapping[str, Any]) -> str:
    rows = [_measure(m) for section in MEASURES for m in record.get(section, [])]
    return _table(("measure", "definition", "value", "unit", "bound", "verdict"), rows)


def _measure(m: Mapping[str, Any]) -> Row:
    quantity = m.get("quantity", m)
    bound = m.get("bound", m.get("tolerance"))
    verdict = m.get("verdict", {True: "pass", False: "fail", None: "info"}[m.get("passed")])
    value = quantity["reason"] if quantity["value"] is None else _number(quantity["value"])
    shown = "" if bound is None else f"{'≥' if m.get('direction') == 'at_least' else '≤'} {_number(bound)}"
    return (m["name"], m["definition"], value, quantity["unit"], shown, _Mark(verdict, SYMBOLS[verdict]))


def _replays(solution: Solution) -> str:
    head = ("variant", "control", "goal error", "beyond bounds", "energy error [J]", "penetration [m]", "verdict")
    rows = []
    for r in solution.replays:
        numbers = [_number(v) for v in (r.goal_error, r.bound_violation, r.energy_error, r.penetration)]
        verdict = "✓ holds" if r.holds else "✗ " + "; ".join(r.failures)
        rows.append((r.variant, r.control, *numbers, _Mark("pass" if r.holds else "fail", verdict)))
    return _table(head, rows) if rows else '<p class="note">The plan could not be replayed.</p>'


def _certificates(solution: Solution) -> str:
    if not solution.certificates:
        return '<p class="note">No derivative was certified.</p>'
    rows = [
        (i, c.subject, c.method, f"{c.count('agree')} of {c.codes.size}", _Mark(_kind(c.verdict), c.verdict))
        for i, c in enumerate(solution.certificates)
    ]
    note = '<p class="note">An entry is a square: point at it for both numbers.</p>'
    return _table(("", "of", "derivative", "entries agree", "verdict"), rows) + note + '<div id="maps"></div>'


def _kind(verdict: str) -> str:
    return {"agree": "pass", "undecided": "undecided", "not_converged": "undecided"}.get(verdict, "fail")


def _contract(contract: Mapping[str, Any]) -> str:
    """Every section of the contract as it is: tables of what comes in lists, names and values of the rest."""
    plain = {key: value for key, value in contract.items() if not _is_rows(value) and value not in ([], {})}
    parts = [_table(("", ""), [(_phrase(key), _value(value)) for key, value in plain.items()])]
    for key, rows in contract.items():
        if _is_rows(rows):
            names = list(rows[0])
            table = _table([_phrase(n) for n in names], [[_value(row[n]) for n in names] for row in rows])
            parts.append(f"<details open><summary>{_text(_phrase(key))} ({len(rows)})</summary>{table}</details>")
    return "".join(parts)


def _is_rows(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and isinstance(value[0], dict)


def _provenance(record: Mapping[str, Any]) -> str:
    found, clock = record["provenance"], record["wall_clock"]
    rows = [(_phrase(key), _value(value)) for key, value in found.items() if key != "command"]
    times = ", ".join(f"{_phrase(key)} {_value(value)}" for key, value in clock.items() if value is not None)
    return (
        f"<p>To reproduce:</p><pre>{_text(shlex.join(found['command']))}</pre>"
        + _table(("", ""), rows)
        + '<p class="controls"><button id="download" type="button">Download the record (JSON)</button></p>'
        + f'<p id="wall-clock" class="note">Wall clock: {_text(times)}</p>'
    )


class _Mark(str):
    """A text in the colour of its verdict."""

    kind: str

    def __new__(cls, kind: str, text: str) -> "_Mark":
        mark = super().__new__(cls, text)
        mark.kind = kind
        return mark


def _section(title: str, body: str) -> str:
    return f"<section><h2>{_text(title)}</h2>{body}</section>"


def _table(head: Sequence[str], rows: Iterable[Row]) -> str:
    top = "".join(f'<th scope="col">{_text(name)}</th>' for name in head) if any(head) else ""
    lines = ["<tr>" + "".join(_cell(cell) for cell in row) + "</tr>" for row in rows]
    return f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def _cell(cell: Any) -> str:
    mark = f' class="{cell.kind}"' if isinstance(cell, _Mark) else ""
    return f"<td{mark}>{_text(cell)}</td>"


def _text(value: Any) -> str:
    return html.escape(str(value))


def _phrase(key: str) -> str:
    return str(key).replace("_", " ")


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.6g}"


def _value(value: Any) -> str:
    """Anything of a record in one line."""
    if isinstance(value, dict):
        return ", ".join(f"{_phrase(k)} {_value(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(_value(v) for v in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return _number(value) if value is None or isinstance(value, float) else str(value)
