"""The trials of a plan as one page that opens from a disk: the verdict, every rate and margin, the worst trials."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from drake_diff.html_parts import (
    Link,
    Mark,
    Row,
    escaped,
    plots,
    provenance,
    section,
    slider,
    stage,
    table,
    write_page,
)
from drake_diff.loop.robustness import Robustness
from drake_diff.loop.robustness_plots import robustness_data
from drake_diff.loop.robustness_record import CellEvidence, PerturbationEvidence, RobustnessRecord
from drake_diff.loop.robustness_words import agrees, sized, weakest_of
from drake_diff.loop.statistics import ENOUGH

APART = ("wall_clock", "files", "record_sha256")
MEANINGS = (
    ("success", "the run reaches the goal (or the plan's end, where there is none) and keeps bounds and overlap"),
    ("interval", "Wilson's, 95 %; where every trial is the same run, nothing being drawn, it says nothing"),
    ("margin", f"the largest level up to which {ENOUGH:.0%} of the trials succeed"),
    ("displacement", "of the last state from the unperturbed run's, root mean square over the trials"),
    ("predicted", "the same, to first order, from the gradients along the unperturbed run, before anything is tried"),
    ("planning error", "unperturbed it fails too"),
    ("perception error", "with a perfect sensor it succeeds"),
    ("control error", "with a perfect actuator it succeeds, the controller failed, or no single thing helps"),
    ("state error", "with plant and start as planned, and no push, it succeeds"),
    ("evaluation error", "what came out cannot be judged"),
)


def write_robustness_page(path: Path, result: Robustness, record: RobustnessRecord, replay: Path) -> None:
    """Write the page of `result` with its `record` and `replay`, the page of the weakest point's worst trial."""
    fields, view = record.model_dump(mode="json"), replay.read_text()
    embedded = {key: value for key, value in fields.items() if key not in APART}
    body = "\n".join(_sections(result, record, fields, view))
    write_page(path, f"{record.name}: {record.verdict}", body, robustness_data(result), embedded, view)


def _sections(result: Robustness, record: RobustnessRecord, fields: Mapping[str, Any], view: str) -> Iterable[str]:
    yield (
        f'<header><p class="pill {record.verdict}">{record.verdict}</p><h1>{escaped(record.name)}</h1>'
        f'<p class="sentence">{escaped(record.sentence)}</p><p class="facts">{escaped(_facts(result, record))}</p>'
        "</header>"
    )
    yield section("Perturbations", _overview(record))
    trial = result.worst(weakest_of(result)).worst
    ((name, level),) = trial.levels.items()
    told = trial.reason or "it succeeds, and of all trials it ends furthest from the goal"
    yield stage(view, f"The worst trial of {name} {sized(name, level)}, the plan as a ghost: {told}.")
    for p in record.perturbations:
        yield section(f"{p.name} [{p.unit}]", _perturbation(p) + plots(p.name))
    yield section("Latency of the controller", _latency(record))
    yield section("What the words mean", table(("", ""), MEANINGS))
    yield section("Provenance", provenance(fields))
    yield slider(robustness_data(result)["duration"])


def _facts(result: Robustness, record: RobustnessRecord) -> str:
    loop = record.loop
    around = f"{loop.controller}, every {loop.period_s:.4g} s for {loop.steps} steps" if loop else ""
    judged = f"judged by {loop.judged_by}" if loop else ""
    return f"{result.task.model.name} · {around} · {record.trials} trials a level, seed {record.seed} · {judged}"


def _overview(record: RobustnessRecord) -> str:
    head = ("perturbation", "margin", "of levels", "first failing", "labels", "measured / predicted", "worst trial")
    rows: list[Row] = []
    for p in record.perturbations:
        levels = ", ".join(f"{c.level:g}" for c in p.cells)
        failing = next((c for c in p.cells if c.successes < c.trials), None)
        first = "" if failing is None else f"{failing.level:g}: {failing.successes} of {failing.trials}"
        ratios = [c.ratio for c in p.cells if c.ratio is not None]
        span = f"{min(ratios):.3g} to {max(ratios):.3g}" if ratios else "not predicted"
        kind = "fail" if p.margin == 0 else "pass" if p.margin == p.cells[-1].level else "undecided"
        margin = Mark(kind, f"{p.margin:g} {'' if p.unit == '1' else p.unit}".strip())
        worst = Link(f"{p.worst}/replay.html", p.worst.removeprefix("worst/"))
        rows.append((p.name, margin, levels, first, _labels(p.cells), span, worst))
    return table(head, rows)


def _labels(cells: Iterable[CellEvidence]) -> str:
    counts: dict[str, int] = {}
    for cell in cells:
        for label, count in cell.labels.items():
            counts[label] = counts.get(label, 0) + count
    return ", ".join(f"{count} {label.removesuffix('_error')}" for label, count in sorted(counts.items()))


def _perturbation(p: PerturbationEvidence) -> str:
    head = (
        "level", "success", "95 % interval", "labels", "goal error, median", "worst", "displacement", "predicted",
        "ratio",
    )  # fmt: skip
    rows = [
        (
            f"{c.level:g}",
            Mark("pass" if c.rate >= ENOUGH else "fail", f"{c.successes} of {c.trials}"),
            f"{c.lower_95:.3f} to {c.upper_95:.3f}",
            _labels([c]),
            *(_short(v) for v in (c.goal_error_median, c.goal_error_worst, c.displacement, c.predicted)),
            Mark("pass" if agrees(c.ratio) else "undecided", _short(c.ratio)),
        )
        for c in p.cells
    ]
    same = p.cells[0].trials > 1 and all(c.distinct == 1 for c in p.cells)
    drawn = " Nothing is drawn: every trial of a level is the same run." if same else ""
    return f'<p class="note">{escaped(p.meaning + "." + drawn)}</p>' + table(head, rows)


def _short(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _latency(record: RobustnessRecord) -> str:
    loop, clock = record.loop, record.wall_clock
    if loop is None or clock.controller_steps is None:
        return ""
    budget = f"Budget: {1e3 * loop.latency_budget_s:.4g} ms, {loop.latency_budget_is}."
    measured = (
        f"Measured on this machine over {clock.controller_steps} answers, in the unperturbed run and the worst trials: "
        f"median {_ms(clock.latency_median_s)}, 99 % within {_ms(clock.latency_99_percent_s)}, at most "
        f"{_ms(clock.latency_largest_s)}; {clock.late} later than the budget."
    )
    return f'<p>{escaped(budget)}</p><p id="measured-latency">{escaped(measured)}</p>'


def _ms(seconds: float | None) -> str:
    return "–" if seconds is None else f"{1e3 * seconds:.3g} ms"
