"""The cells of a panel in order, the best first, with what cannot be told apart from the best, as one page."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from drake_diff.pages.html import page_data, write_page
from drake_diff.panels.panel_file import cell_name
from drake_diff.record.provenance import provenance_of

COST = "cost"  # the number that ranks where nothing is judged, and among equals: less is better


def ranked(summary: Mapping[str, Any]) -> tuple[str, list[dict[str, Any]]]:
    """By what the cells of `summary` are ranked, and a row for each, the best first.

    Cells with a success rate are ranked by the lower end of its 95 % interval, equals by the mean cost; others by the
    mean cost. A trial that ended in an error is no success, and has no cost: of cells without rates those with fewer
    errors come first. `apart` says whether the interval of a cell lies below that of the best; None without rates.
    """
    cells = summary["cells"]
    judged = all("success" in cell for cell in cells)

    def key(cell: Mapping[str, Any]) -> tuple[float, ...]:
        cost = cell["numbers"].get(COST, {}).get("mean", float("inf"))
        rate = cell["success"]["low"] if judged else 0.0
        return (-rate, 0.0 if judged else cell["errors"], cost)

    ordered = sorted(cells, key=key)  # equals stay in the panel's order
    rows: list[dict[str, Any]] = []
    for i, cell in enumerate(ordered):
        place = i + 1 if not rows or key(ordered[i - 1]) != key(cell) else rows[-1]["place"]
        apart = cell["success"]["high"] < ordered[0]["success"]["low"] if judged else None
        rows.append({"place": place, "name": cell_name(cell["cell"]), "apart": apart, **cell})
    if judged:
        return "the lower end of the 95 % interval of the success rate, then the mean cost", rows
    if any(COST in cell["numbers"] for cell in cells):
        return "the fewest errors, then the mean cost; no trial says whether it is a success", rows
    return "the fewest errors; no trial says whether it is a success, or has a cost", rows


def write_ranking(path: Path, summary: Mapping[str, Any]) -> None:
    """Write the page of a panel's `summary`."""
    by, rows = ranked(summary)
    errors = summary["errors"]
    record = {
        "name": path.parent.name,
        "verdict": "fail" if errors else "pass",
        "sentence": f"{rows[0]['name']} is the best of {len(rows)} cells, by {by}",
        "provenance": provenance_of().model_dump(mode="json"),
        **summary,
    }
    write_page(path, "panel.html.j2", record=record, data=page_data(0.0, []), rows=rows)
