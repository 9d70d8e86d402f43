"""What a page draws, as plain data for JSON: lines over time, iterations or levels, and certificates as heat maps."""

import math
from collections.abc import Iterable, Sequence
from typing import Any

from drake_diff.certificates.certificate import Certificate

Plot = dict[str, Any]


def plot(title: str, unit: str, x: Iterable[Any], series: Sequence[Plot], *, axis: str = "time", **rest: Any) -> Plot:
    base = {"title": title, "unit": unit, "axis": axis, "x": numbers(x), "series": list(series)}
    plain = {"log": False, "levels": False, "limits": [None, None], "note": "", "marks": "lines", "band": False}
    return base | plain | {"place": "plots", "range": None} | rest


def line(name: str, y: Iterable[Any], *, dashed: bool = False, held: bool = False) -> Plot:
    return {"name": name, "y": numbers(y), "dashed": dashed, "held": held}


def numbers(values: Iterable[Any]) -> list[float | None]:
    return [float(f"{v:.8g}") if math.isfinite(v) else None for v in values]


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
