"""A gradient panel saved: every number as JSON, the table as CSV, and a page with plots."""

import csv
import io
import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from drake_diff.gradient_panel import CasePanel, GradientPanel
from drake_diff.html_parts import Mark, Row, escaped, section, short_number, table, write_page
from drake_diff.report_data import Plot, line, plot
from drake_diff.whole_file import write_whole

RECORD, TABLE, PAGE = "gradient_panel.json", "gradient_panel.csv", "gradient_panel.html"


def save_gradient_panel(panel: GradientPanel, directory: str | Path) -> None:
    """Write gradient_panel.json, .csv (a row for each case, sigma and order) and .html into `directory`."""
    folder = Path(directory)
    folder.mkdir(parents=True, exist_ok=True)
    record = panel.to_dict()
    write_whole(folder / RECORD, (json.dumps(record, indent=1, allow_nan=False) + "\n").encode())
    rows, text = panel.rows(), io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(folder / TABLE, text.getvalue().encode())
    data = {"duration": 0.0, "plots": list(_plots(panel)), "certificates": [], "verdicts": []}
    write_page(folder / PAGE, "gradient panel", "\n".join(_sections(panel)), data, record)


def _plots(panel: GradientPanel) -> Iterable[Plot]:
    for found in panel.cases:
        name = found.case.name
        variances = [line(o, [found.at(o, s).trace for s in found.sigmas]) for o in panel.orders]
        biases = [line(o, [float(np.linalg.norm(found.at(o, s).bias)) for s in found.sigmas]) for o in panel.orders]
        note = f"of the mean of {panel.samples} samples, summed over the entries; 0 is not on a log scale"
        yield plot(f"{name}: variance", "f² / x²", found.sigmas, variances, axis="sigma", log=True, note=note)
        note = f"the mean of {panel.seeds} seeds, less the truth; where it is not significant it is chance"
        yield plot(f"{name}: bias", "f / x", found.sigmas, biases, axis="sigma", log=True, note=note)
        yield _loss_plot(panel, found)


def _loss_plot(panel: GradientPanel, found: CasePanel) -> Plot:
    x = found.descents[0].evaluations
    losses = [line(o, np.mean([d.losses for d in found.descents_of(o)], axis=0)) for o in panel.orders]
    note = f"smoothed by sigma = {found.sigmas[-1]:g}, mean over the seeds; above {found.case.goal:.4g} is not arrived"
    limits = [None, found.case.goal]
    return plot(f"{found.case.name}: loss", "f", x, losses, axis="evaluations", limits=limits, note=note)


def _sections(panel: GradientPanel) -> Iterable[str]:
    yield (
        "<header><h1>Gradient panel</h1>"
        '<p class="sentence">Gradients of a smoothed loss F(x) = E[f(x + w)], estimated from '
        "derivatives (first order), values (zeroth order) or both (blend); point is the derivative without noise.</p>"
        f'<p class="facts">{len(panel.cases)} cases · {panel.seeds} seeds of {panel.samples} samples · descents of '
        f"{panel.budget} calls, {panel.batch} samples a step</p></header>"
    )
    yield section("Verdicts", "".join(_verdict(found) for found in panel.cases))
    yield '<section><h2>Plots</h2><div id="plots" class="plots"></div></section>'
    yield section("All numbers", _table(panel))
    button = '<p class="controls"><button id="download" type="button">Download the record (JSON)</button></p>'
    yield section("Record", button)


def _verdict(found: CasePanel) -> str:
    lines = "".join(f"<li>{escaped(sentence)}</li>" for sentence in found.verdict)
    source = f"the truth is a {t}" if (t := found.truths[0].source) == "closed form" else f"the truth is {t}"
    return f"<h3>{escaped(found.case.name)}</h3><p>{escaped(found.case.about)}; {escaped(source)}</p><ul>{lines}</ul>"


def _table(panel: GradientPanel) -> str:
    head = (
        "case",
        "order",
        "sigma",
        "variance",
        "bias",
        "in its errors",
        "",
        "cosine",
        "mean squared error",
        "arrived",
    )
    rows: list[Row] = []
    for row in panel.rows():
        errors = "exact" if row["bias_in_errors"] is None else f"{row['bias_in_errors']:.1f}"
        numbers = [short_number(row[name]) for name in ("sigma", "variance", "bias")]
        mark = Mark("fail", "biased") if row["biased"] else Mark("pass", "shows no bias")
        cosine, error = short_number(row["cosine"]), short_number(row["mean_squared_error"])
        arrived = "" if row["arrived"] is None else f"{row['arrived']} of {row['descents']}"
        rows.append((row["case"], row["order"], *numbers, errors, mark, cosine, error, arrived))
    return table(head, rows)
