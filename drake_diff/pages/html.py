"""What a page of HTML may do in a browser: run the scripts that it was written with, and nothing from the network.

The parts of our pages: everything that comes from a model, a file or a record is escaped here.
"""

import base64
import html
import json
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from hashlib import sha256
from importlib.resources import files
from pathlib import Path
from typing import Any
from urllib.parse import quote

from drake_diff._base.files import write_whole

_SCRIPT = re.compile(r"<script(?![^>]*application/json)[^>]*>(.*?)</script>", re.DOTALL)


def content_policy(*pages: str) -> str:
    """The meta element that lets exactly the scripts in `pages` run, by their hashes, and lets nothing be fetched."""
    scripts = dict.fromkeys(script for page in pages for script in _SCRIPT.findall(page) if script)
    hashes = [base64.b64encode(sha256(script.encode()).digest()).decode() for script in scripts]
    policy = "; ".join(
        [
            "default-src 'none'",
            "script-src " + " ".join(f"'sha256-{found}'" for found in hashes),
            "style-src 'unsafe-inline'",
            "img-src data: blob:",
            "connect-src data:",  # the viewer fetches its own data out of the page
            "base-uri 'none'",
            "form-action 'none'",
        ]
    )
    return f'<meta http-equiv="Content-Security-Policy" content="{policy}">'


Row = Sequence[Any]


def write_page(
    path: Path, title: str, body: str, data: Mapping[str, Any], record: Mapping[str, Any], view: str = ""
) -> None:
    """Write one page: `body` with plots of `data` (see `report_data`), `record` to be downloaded, the replay `view`.

    A page without `view` has neither `stage` nor `slider`.
    """
    embedded = script_json("data", data) + script_json("record", record)
    scripts = "".join(f"<script>{asset(name)}</script>\n" for name in ("uPlot.iife.min.js", "report.js"))
    style = asset("uPlot.min.css") + asset("report.css")
    head = (
        f'<meta charset="utf-8">\n{content_policy(view, scripts)}\n<meta name="viewport" content="width=device-width">'
    )
    page = (
        f"{head}\n<title>{escaped(title)}</title>\n<style>{style}</style>\n</head><body>\n{body}\n{embedded}{scripts}"
        "</body></html>\n"
    )
    write_whole(path, ('<!doctype html>\n<html lang="en"><head>\n' + page).encode())


def stage(view: str, caption: str) -> str:
    """The replay with what is to be seen in it, and the plots beside it."""
    return (
        '<div class="stage"><section id="motion"><h2>Motion</h2>'
        f'<iframe id="view" title="the motion in 3D" srcdoc="{html.escape(view)}"></iframe>'
        f'<p class="note">{escaped(caption)}</p>'
        '<img id="still" alt="the motion at the time of the slider"></section>'
        f"<section><h2>Plots</h2>{plots('plots')}</section></div>"
    )


def asset(name: str) -> str:
    return files("drake_diff").joinpath("assets", name).read_text(encoding="utf-8")


def script_json(name: str, value: Any) -> str:
    """JSON that no text in it can end early."""
    text = json.dumps(value, sort_keys=True, allow_nan=False, separators=(",", ":"))
    text = text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
    return f'<script type="application/json" id="{name}">{text}</script>\n'


def slider(end: float) -> str:
    """The time that the view and the plots follow; it stays in sight."""
    return (
        '<div class="controls bar"><button id="play" type="button" aria-label="play or pause">▶</button>'
        f'<input id="time" type="range" aria-label="time" min="0" max="{end!r}" step="any" value="0">'
        '<output id="now" for="time">0 s</output></div>'
    )


class Mark(str):
    """A text in the colour of its verdict."""

    kind: str

    def __new__(cls, kind: str, text: str) -> "Mark":
        mark = super().__new__(cls, text)
        mark.kind = kind
        return mark


class Link(str):
    """A text that leads to a file beside the page."""

    target: str

    def __new__(cls, target: str, text: str) -> "Link":
        link = super().__new__(cls, text)
        link.target = target
        return link


def section(title: str, body: str) -> str:
    return f"<section><h2>{escaped(title)}</h2>{body}</section>"


def plots(place: str) -> str:
    """Where the plots go whose `place` this is."""
    return f'<div id="{escaped(place)}" class="plots"></div>'


def table(head: Sequence[str], rows: Iterable[Row]) -> str:
    top = "".join(f'<th scope="col">{escaped(name)}</th>' for name in head) if any(head) else ""
    lines = ["<tr>" + "".join(_cell(cell) for cell in row) + "</tr>" for row in rows]
    return f'<div class="wide"><table><thead><tr>{top}</tr></thead><tbody>{"".join(lines)}</tbody></table></div>'


def _cell(cell: Any) -> str:
    mark = f' class="{cell.kind}"' if isinstance(cell, Mark) else ""
    text = f'<a href="{escaped(quote(cell.target))}">{escaped(cell)}</a>' if isinstance(cell, Link) else escaped(cell)
    return f"<td{mark}>{text}</td>"


def escaped(value: Any) -> str:
    return html.escape(str(value))


def phrase(key: str) -> str:
    return str(key).replace("_", " ")


def short_number(value: float | None) -> str:
    return "–" if value is None else f"{value:.6g}"


def in_words(value: Any) -> str:
    """Anything of a record in one line."""
    if isinstance(value, dict):
        return ", ".join(f"{phrase(k)} {in_words(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(in_words(v) for v in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return short_number(value) if value is None or isinstance(value, float) else str(value)


def provenance(record: Mapping[str, Any]) -> str:
    found, clock = record["provenance"], record["wall_clock"]
    rows = [(phrase(key), in_words(value)) for key, value in found.items() if key != "command"]
    times = ", ".join(f"{phrase(key)} {in_words(value)}" for key, value in clock.items() if value is not None)
    return (
        f"<p>To reproduce:</p><pre>{escaped(shlex.join(found['command']))}</pre>"
        + table(("", ""), rows)
        + '<p class="controls"><button id="download" type="button">Download the record (JSON)</button></p>'
        + f'<p id="wall-clock" class="note">Wall clock: {escaped(times)}</p>'
    )
