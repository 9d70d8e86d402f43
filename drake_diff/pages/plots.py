"""What a page draws, as plain data for `report.js`: lines over time, iterations or levels, and heat maps."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from drake_diff.certificates.certificate import VERDICTS, Certificate


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
        title: What is plotted, as its heading.
        unit: The unit of y.
        x: (n,) where the series have their values.
        series: The lines; a name shows in the legend.
        axis: What x is: "time" [s] follows the slider, any other word is a label.
        place: Where on the page: that of the template's macro `plots`.
        log: Whether y has a logarithmic scale; what is not above 0 is left out.
        levels: Whether x are the few levels of something, each a tick on a logarithmic scale.
        limits: The lower and upper limit of y, None or infinite where there is none; what is beyond is shaded.
        range: The range of y, where it is not to follow the data.
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
    log: bool = False
    levels: bool = False
    limits: Sequence[float | None] = (None, None)
    range: Sequence[float] | None = None
    marks: str = "lines"
    band: bool = False
    note: str = ""


def page_data(duration: float, plots: Iterable[Plot], certificates: Iterable[Certificate] = ()) -> dict[str, Any]:
    """All that a page draws, for JSON: `plots` and a heat map of each of `certificates`, over `duration` [s]."""
    return {
        "duration": duration,
        "plots": [_plot(p) for p in plots],
        "certificates": [_certificate(c) for c in certificates],
        "verdicts": list(VERDICTS),
    }


def _plot(p: Plot) -> dict[str, Any]:
    series = [{**vars(line), "y": numbers(line.y)} for line in p.series]
    return {**vars(p), "x": numbers(p.x), "series": series, "limits": numbers(p.limits)}


def numbers(values: Iterable[Any]) -> list[float | None]:
    """`values` with eight digits, more than a screen shows; None where there is none, or none that is finite."""
    return [float(f"{v:.8g}") if v is not None and math.isfinite(v) else None for v in values]


def _certificate(c: Certificate) -> dict[str, Any]:
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
