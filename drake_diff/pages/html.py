"""Write HTML pages that open without a server or a network, from data and `templates/*.html.j2`.

Names from models, files and records are untrusted text. Templates escape all values (autoescape), and data for scripts
is JSON that cannot close its script element. Only our own scripts and style sheets in `assets/` are marked as safe. The
content security policy of a page permits only these scripts, by their hashes, so the browser refuses any injected
script.
"""

import base64
import html
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from drake_diff._base.files import json_of, read_plain, write_whole
from drake_diff.certificates.certificate import VERDICTS, Certificate
from drake_diff.exceptions import ArtifactError

if TYPE_CHECKING:
    from jinja2 import Environment

SCRIPTS = ("uPlot.iife.min.js", "report.js")
# Fields of a record that are not embedded: wall-clock times differ between runs, and the page can contain neither its
# own hash nor that of the record.
APART = ("wall_clock", "files", "record_sha256")

_SCRIPT = re.compile(r"<script(?![^>]*application/json)[^>]*>(.*?)</script>", re.DOTALL)
_VIEW = re.compile(r'(?<= srcdoc=")[^"]*')
COMMAND = re.compile(  # a command to the viewer of a scene
    r'fetch\("data:application/octet-binary;base64,([A-Za-z0-9+/=]*)"\)\s*\.then\(res => res\.arrayBuffer\(\)\)\s*'
    r"\.then\(buffer => viewer\.handle_command_bytearray\(new Uint8Array\(buffer\)\)\);\s*"
)
_DATA = re.compile(r'(?<=<script type="application/json" id="data">).*?(?=</script>)', re.DOTALL)
_POLICY = re.compile(r"(?<='sha256-)[A-Za-z0-9+/=]*(?=')")


@dataclass(frozen=True, eq=False)
class Line:
    """A series `y` (n,) of a plot; `held` values are drawn as steps."""

    name: str
    y: Iterable[Any]
    dashed: bool = False
    held: bool = False


@dataclass(frozen=True, eq=False)
class Plot:
    """One plot of `series` over `x`.

    Attributes:
        title: The heading.
        unit: The unit of y.
        x: (n,) the positions of the values of the series.
        series: The lines. Their names are shown in the legend.
        axis: The quantity of x. "time" [s] follows the slider; any other word is a label.
        place: The position on the page, as in the template's macro `plots`.
        group: The name of a group of plots with one legend. A place with several groups shows one group at a time.
        log: Whether y has a logarithmic scale. Values that are not positive are omitted.
        levels: Whether x are a few discrete levels, each with a tick on a logarithmic scale.
        limits: The lower and upper limit of y, or None or infinity. They are dashed, and the area beyond is shaded.
        percent: Whether to draw y relative to its limit, if it has a limit on either side.
        range: The range of y, if it does not follow the data.
        marks: "lines", "points" or "both".
        band: Whether to shade between the last two series.
        note: A remark below the plot.
    """

    title: str
    unit: str
    x: Iterable[Any]
    series: Sequence[Line]
    axis: str = "time"
    place: str = "plots"
    group: str = ""
    log: bool = False
    levels: bool = False
    limits: Sequence[float | None] = (None, None)
    percent: bool = False
    range: Sequence[float] | None = None
    marks: str = "lines"
    band: bool = False
    note: str = ""


ENTRY = {"derivative": 9, "difference": 9, "tolerance": 2, "noticeable": 2}  # numbers of an entry, and their digits
MOST_POINTS = 1200  # of a plot; the minimum and maximum of each stretch of a longer plot are drawn
MOST_ENTRIES = 500  # of a certificate in a page; for a larger certificate, the entries that are closest to failing


def page_data(duration: float, plots: Iterable[Plot], certificates: Iterable[Certificate] = ()) -> dict[str, Any]:
    """Return the data of `report.js` for JSON: `plots`, and a heat map of each certificate, over `duration` [s]."""
    maps = [_map_of(c) for c in certificates]
    return {"duration": duration, "plots": [_drawn(p) for p in plots], "certificates": maps, "verdicts": list(VERDICTS)}


def _drawn(plot: Plot) -> dict[str, Any]:
    """Convert a plot to JSON with at most MOST_POINTS points; `points` is the original number."""
    x, ys = numbers(plot.x), [numbers(line.y) for line in plot.series]
    retained = _points_to_draw(ys, len(x)) if plot.marks == "lines" else range(len(x))
    series = [{**vars(line), "y": [y[i] for i in retained]} for line, y in zip(plot.series, ys, strict=True)]
    content = {"x": [x[i] for i in retained], "points": len(x), "series": series, "limits": numbers(plot.limits)}
    return {**vars(plot), **content}


def _points_to_draw(ys: Sequence[Sequence[float | None]], count: int) -> Sequence[int]:
    """Return the indices of up to MOST_POINTS of `count` points: both ends, and each series' extremes per stretch."""
    stretches = MOST_POINTS // (2 * max(1, len(ys)) + 1)
    if count <= MOST_POINTS:
        return range(count)
    ends = [count * k // stretches for k in range(stretches + 1)]
    retained = {0, count - 1}
    for start, end in pairwise(ends):
        for y in ys:
            known = [(value, i) for i, value in enumerate(y[start:end], start) if value is not None]
            retained |= {min(known)[1], max(known)[1]} if known else {start}  # keep gaps
    return sorted(retained)


def _map_of(c: Certificate) -> dict[str, Any]:
    """Convert a certificate to JSON: all verdicts, and the numbers of the entries with indices `told`, worst first."""
    codes = c.codes.ravel()
    gap = np.abs(c.difference - c.derivative).ravel() / np.maximum(c.tolerance.ravel(), 1e-300)
    gap = np.nan_to_num(gap, nan=np.inf, posinf=np.inf)
    content = np.lexsort((np.arange(len(codes)), -gap, -codes))[:MOST_ENTRIES]
    content = np.arange(len(codes)) if len(codes) <= MOST_ENTRIES else content
    entries = {name: numbers(getattr(c, name).ravel()[content], digits) for name, digits in ENTRY.items()}
    subject = {
        "subject": c.subject,
        "method": c.method,
        "verdict": c.verdict,
        "rows": [*c.rows],
        "columns": [*c.columns],
    }
    return {**subject, "codes": "".join(str(code) for code in codes), "told": content.tolist(), **entries}


def _pooled(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return `data` with each distinct x only once, in `xs`, and with the index of its x in each plot."""
    xs: dict[tuple[Any, ...], int] = {}
    plots = [{**plot, "x": xs.setdefault(tuple(plot["x"]), len(xs))} for plot in data.get("plots", ())]
    return {**data, "plots": plots, "xs": [list(x) for x in xs]}


def numbers(values: Iterable[Any], digits: int = 8) -> list[float | None]:
    """Round `values` to significant digits (a screen shows fewer than eight); non-finite values become None."""
    return [float(f"{v:.{digits}g}") if v is not None and math.isfinite(v) else None for v in values]


def write_page(
    path: Path, template: str, *, record: Mapping[str, Any], data: Mapping[str, Any], view: str = "", **facts: Any
) -> None:
    """Render a page and write it.

    Args:
        path: The file to write.
        template: The name of a file in `templates/` that extends base.html.j2.
        record: The record of the page's subject, as plain data. Readers can download it from the page, without the
            fields `APART`.
        data: The data of `report.js`; see `page_data`.
        view: The page of the replay (see `meshcat.write_replay`), shown in a frame, or "" without a motion.
        facts: Other values of the template.

    Raises:
        jinja2.UndefinedError: The template uses a missing name.
    """
    write_whole(path, _page(template, record, _pooled(data), view, facts).encode())


def _page(template: str, record: Mapping[str, Any], pooled: Mapping[str, Any], view: str, facts: Any) -> str:
    scripts = [asset(name) for name in SCRIPTS]
    values = {
        "record": record,
        "embedded": {key: value for key, value in record.items() if key not in APART},
        "data": pooled,
        "view": view,
        "scripts": scripts,
        "hashes": script_hashes(view, *(f"<script>{script}</script>" for script in scripts)),
    }
    return render(template, **values, **facts)


def page_again(path: Path, template: str, *, record: Mapping[str, Any], view: str = "", **facts: Any) -> bytes:
    """Return what `write_page` writes for `record` and `view`, with the plots of the page at `path`.

    Raises ArtifactError if that page has no plots, or the template does not accept the record.
    """
    from jinja2 import TemplateError

    match = _DATA.search(read_plain(path).decode(errors="replace"))
    try:
        return _page(template, record, json_of(match[0].encode() if match else b""), view, facts).encode()
    except (ArithmeticError, LookupError, TemplateError, TypeError, ValueError) as error:
        raise ArtifactError(f"{path.name}: the data of the page is invalid: {type(error).__name__}: {error}") from error


def content_policy(page: str) -> str:
    """Return a meta element that permits exactly the scripts in `page`, and no network access."""
    return render("content_policy.html.j2", hashes=script_hashes(page))


def script_hashes(*pages: str) -> list[str]:
    """Return the SHA-256 hashes in base64 of all scripts in `pages` for a content policy; JSON is not a script."""
    scripts = dict.fromkeys(script for page in pages for script in _SCRIPT.findall(page) if script)
    return [base64.b64encode(sha256(script.encode()).digest()).decode() for script in scripts]


@dataclass(frozen=True)
class PagePieces:
    """The parts of a page, including the page of a replay in it.

    `text` is everything except the `scripts`, with the scripts' hashes in the content policy replaced by their numbers.
    `scene` are the commands to a viewer in the scripts, in base64.
    """

    text: str
    scripts: tuple[str, ...]
    scene: tuple[str, ...]


def pieces_of(page: str) -> PagePieces:
    """Split a page into its parts; any text is accepted."""
    views = [html.unescape(view) for view in _VIEW.findall(page)]
    inner = [pieces_of(view) for view in views]
    hashes = {name: f"script {i}" for i, name in enumerate(script_hashes(*views, page))}
    outer = _VIEW.sub("view", page)
    scripts = _SCRIPT.findall(outer)
    text = _POLICY.sub(lambda match: hashes.get(match[0], match[0]), _SCRIPT.sub("script", outer))
    return PagePieces(
        "".join([*(view.text for view in inner), text]),
        (*(script for view in inner for script in view.scripts), *(COMMAND.sub("", script) for script in scripts)),
        (*(command for view in inner for command in view.scene), *COMMAND.findall("".join(scripts))),
    )


def asset(name: str) -> str:
    """Return the text of one of our own scripts or style sheets."""
    return files("drake_diff.pages").joinpath("assets", name).read_text(encoding="utf-8")


def render(template: str, **values: Any) -> str:
    """Render a template with `values`, which are escaped; a missing name is an error."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined  # loaded when the first page is written

    loader = PackageLoader("drake_diff.pages")
    environment = Environment(
        loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    # tojson writes <, >, & and ' as \u003c and so on, so that no text can close its script element.
    environment.policies["json.dumps_kwargs"] = {"sort_keys": True, "allow_nan": False, "separators": (",", ":")}
    environment.filters["worst_first"] = worst_first
    environment.filters.update(short=short_number, words=in_words, phrase=phrase, unit=unit_of, shell=shlex.join)
    environment.globals["asset"] = asset
    return environment


def worst_first(measures: list[Any]) -> list[Any]:
    """Sort the measures of a record: failed, undecided, and passed ones, each by decreasing excess, then all others."""

    def used(measure: Any) -> float:
        value, bound = measure["value"], measure["tolerance"]
        if value is None:
            return math.inf
        used_up = bound - value if measure["direction"] == "at_least" else value - bound
        return float(used_up / abs(bound)) if bound else float(used_up)

    decided = [m for m in measures if m["verdict"] != "info"]
    order = ("fail", "undecided", "pass")
    return sorted(decided, key=lambda m: (order.index(m["verdict"]), -used(m))) + [
        m for m in measures if m["verdict"] == "info"
    ]


def phrase(key: str) -> str:
    """Convert the name of a field to words."""
    return str(key).replace("_", " ")


def short_number(value: float | None, digits: int = 6) -> str:
    """Format a number with `digits` significant digits, or None as a dash."""
    return "–" if value is None else f"{value:.{digits}g}"


def unit_of(unit: str) -> str:
    """Format a unit for printing; pure numbers have no unit."""
    return " or ".join(piece for piece in unit.split(" or ") if piece != "1")


def in_words(value: Any, digits: int = 6) -> str:
    """Format any value of a record on one line."""
    if isinstance(value, dict):
        return ", ".join(f"{phrase(k)} {in_words(v, digits)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(in_words(v, digits) for v in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    return short_number(value, digits) if value is None or isinstance(value, float) else str(value)
