"""Gradients of first, zeroth and blended order on a panel of tasks: variance, bias, and whether they find a way.

After Suh et al. 2022, "Do differentiable simulators give better policy gradients?". What is claimed is counted in
calls of f and of its derivative, each as one; wall-clock time is nobody's promise.

A gradient panel saved: every number as JSON, the table as CSV, and a page with plots.
"""

import csv
import io
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import positive_int
from drake_diff._base.files import write_whole
from drake_diff._base.statistics import Rate, success_rate
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.pages.html import write_page
from drake_diff.pages.plots import Plot, line, page_data, plot
from drake_diff.studies.gradient_cases import CASES
from drake_diff.studies.gradient_estimates import (
    ORDERS,
    Descent,
    GradientCase,
    Quality,
    Truth,
    check_orders,
    checked_sigmas,
    descend,
    quality,
    truth_of,
)

Json = dict[str, Any]


@dataclass(frozen=True, eq=False)
class CasePanel:
    """One case: its truth at each sigma, the quality of each order there, and the descents at the largest sigma."""

    case: GradientCase
    sigmas: tuple[float, ...]
    truths: tuple[Truth, ...]
    qualities: tuple[Quality, ...]
    descents: tuple[Descent, ...]

    def at(self, order: str, sigma: float) -> Quality:
        return next(q for q in self.qualities if q.order == order and q.sigma == sigma)

    def descents_of(self, order: str) -> tuple[Descent, ...]:
        return tuple(d for d in self.descents if d.order == order)

    def rate(self, order: str) -> Rate:
        """How many descents arrived; "point" makes one alone, as no seed changes it."""
        found = self.descents_of(order)
        return success_rate(sum(d.succeeded for d in found), len(found))

    def least_error(self, sigma: float) -> str:
        """The order of the smallest mean squared error at equal evaluations; "point", no estimate of F's, apart."""
        ranked = [q for q in self.qualities if q.sigma == sigma and q.order != "point"]
        return min(ranked or [self.at("point", sigma)], key=lambda q: q.mean_squared_error).order

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentences by rule: least error, bias, success."""
        orders = tuple(dict.fromkeys(q.order for q in self.qualities))
        best = ", ".join(f"{self.least_error(s)} at sigma {s:g}" for s in self.sigmas)
        found = [f"least mean squared error at equal evaluations: {best}"]
        for order in orders:
            biased = [self.at(order, s) for s in self.sigmas if self.at(order, s).biased]
            told = ", ".join(f"sigma {q.sigma:g} (by {_size(q)})" for q in biased)
            found.append(f"{_label(order)} is biased at {told}" if biased else f"{_label(order)} shows no bias")
        rates = {order: self.rate(order) for order in orders}
        arrived = ", ".join(f"{order} {r.successes} of {r.trials}" for order, r in rates.items())
        return (*found, f"the descent arrived with {arrived}")


@dataclass(frozen=True, eq=False)
class GradientPanel:
    """All cases, and the counts that they were made with; `to_dict` has every number, `str` a table."""

    cases: tuple[CasePanel, ...]
    orders: tuple[str, ...]
    samples: int
    seeds: int
    reference_samples: int
    budget: int
    batch: int

    def case(self, name: str) -> CasePanel:
        known = {panel.case.name: panel for panel in self.cases}
        if name not in known:
            raise UnknownNameError("case", got=name, known=known)
        return known[name]

    def to_dict(self) -> Json:
        """Plain data for JSON; None stands for no number."""
        counts = ("samples", "seeds", "reference_samples", "budget", "batch")
        return {
            "orders": list(self.orders),
            **{name: getattr(self, name) for name in counts},
            "cases": [_case_dict(panel) for panel in self.cases],
        }

    def rows(self) -> list[Json]:
        """A row for each case, sigma and order, as the table and its file have them."""
        return [_row(panel, q) for panel in self.cases for q in panel.qualities]

    def __str__(self) -> str:
        lines = [f"{self.seeds} seeds of {self.samples} samples; descents of {self.budget} calls, {self.batch} a step"]
        head = f"{'order':8s}{'sigma':>7s}{'variance':>11s}{'bias':>11s}{'errors':>8s}{'cosine':>8s}{'mse':>11s}"
        for panel in self.cases:
            lines += ["", f"{panel.case.name}: {panel.case.about}", f"  {head}  arrived"]
            for row in (_row(panel, q) for q in panel.qualities):
                lines.append("  " + _line(row))
            lines += [f"  {sentence}" for sentence in panel.verdict]
        return "\n".join(lines)


def gradient_panel(
    cases: Sequence[GradientCase | str] | None = None,
    orders: Sequence[str] = ORDERS,
    sigmas: Sequence[float] | None = None,
    *,
    samples: int = 30,
    seeds: int = 10,
    reference_samples: int = 1000,
    budget: int = 300,
    batch: int = 10,
    progress: Callable[[str], None] | None = None,
) -> GradientPanel:
    """Compare `orders` ("point", "first", "zeroth", "blend") on `cases`, or on all of `CASES`.

    For every case, sigma (its own where `sigmas` is None, in the units of x) and order: `seeds` estimates of
    `samples` samples against the truth, a closed form or `reference_samples` samples of zeroth order. At the largest
    sigma `seeds` descents that may call f and its derivative `budget` times, `batch` samples a step. Everything
    follows from the seeds: the same call gives the same bytes. Raises InputError, UnknownNameError, and at a case's
    start GradientError and SimulationError of f and its derivative.
    """
    orders = check_orders(orders)
    for name, value in (("seeds", seeds), ("budget", budget)):
        positive_int(name, value)
    for name, value in (("samples", samples), ("reference_samples", reference_samples), ("batch", batch)):
        if positive_int(name, value) < 2:
            raise InputError(name, got=value, expected="at least 2: one has no variance")
    if budget < 2 * batch + 1:
        raise InputError("budget", got=budget, expected=f"at least {2 * batch + 1}, one step of a blend")
    asked = None if sigmas is None else checked_sigmas("sigmas", sigmas)
    found = []
    for case in [_named(case) for case in (CASES if cases is None else cases)]:
        if progress:
            progress(case.name)
        levels = asked or case.sigmas
        truths = tuple(truth_of(case, case.start, sigma, reference_samples) for sigma in levels)
        qualities = tuple(
            quality(case, order, sigma, truth, samples, seeds)
            for sigma, truth in zip(levels, truths, strict=True)
            for order in orders
        )
        descents = tuple(
            descend(case, order, levels[-1], seed, budget=budget, batch=batch, samples=max(2, reference_samples // 10))
            for order in orders
            for seed in range(1 if order == "point" else seeds)
        )
        found.append(CasePanel(case, levels, truths, qualities, descents))
    if not found:
        raise InputError("cases", got="none", expected="at least one case")
    return GradientPanel(tuple(found), orders, samples, seeds, reference_samples, budget, batch)


def _named(case: GradientCase | str) -> GradientCase:
    if isinstance(case, GradientCase):
        return case
    if case not in CASES:
        raise UnknownNameError("case", got=case, known=CASES)
    return CASES[case]()


def _label(order: str) -> str:
    return {"point": "the derivative at the point", "blend": "the blend"}.get(order, f"{order} order")


def _size(q: Quality) -> str:
    errors = f"{q.bias_in_errors:.0f} standard errors" if np.isfinite(q.bias_in_errors) else "exactly"
    return f"{np.linalg.norm(q.bias):.2g}, {errors}"


def _row(panel: CasePanel, q: Quality) -> Json:
    last, rate = q.sigma == panel.sigmas[-1], panel.rate(q.order)
    descents = panel.descents_of(q.order)
    estimate = q.estimates[0]
    return {
        "case": panel.case.name,
        "order": q.order,
        "sigma": q.sigma,
        "truth": panel.truths[panel.sigmas.index(q.sigma)].source,
        "variance": q.trace,
        "bias": float(np.linalg.norm(q.bias)),
        "bias_in_errors": q.bias_in_errors if np.isfinite(q.bias_in_errors) else None,
        "biased": q.biased,
        "cosine": q.cosine,
        "mean_squared_error": q.mean_squared_error,
        "functions": estimate.functions,
        "derivatives": estimate.derivatives,
        "arrived": rate.successes if last else None,
        "descents": rate.trials if last else None,
        "arrived_lower": rate.lower if last else None,
        "arrived_upper": rate.upper if last else None,
        "final_loss": float(np.mean([d.losses[-1] for d in descents])) if last else None,
    }


def _line(row: Json) -> str:
    errors = "exact" if row["bias_in_errors"] is None else f"{row['bias_in_errors']:.1f}"
    cosine = "-" if row["cosine"] is None else f"{row['cosine']:.3f}"
    text = f"{row['order']:8s}{row['sigma']:7g}{row['variance']:11.2e}{row['bias']:11.2e}{errors:>8s}{cosine:>8s}"
    text += f"{row['mean_squared_error']:11.2e}"
    if row["arrived"] is None:
        return text
    span = f"{100 * row['arrived_lower']:.0f} to {100 * row['arrived_upper']:.0f} %"
    return f"{text}  {row['arrived']} of {row['descents']} ({span}), loss {row['final_loss']:.3g}"


def _case_dict(panel: CasePanel) -> Json:
    case = panel.case
    return {
        "name": case.name,
        "about": case.about,
        "start": case.start.tolist(),
        "rate": case.rate,
        "goal": case.goal,
        "verdict": list(panel.verdict),
        "truths": [
            {
                "sigma": sigma,
                "source": truth.source,
                "value": truth.value,
                "value_error": truth.value_error,
                "gradient": truth.gradient.tolist(),
                "standard_error": truth.error.tolist(),
            }
            for sigma, truth in zip(panel.sigmas, panel.truths, strict=True)
        ],
        "qualities": [_row(panel, q) | _quality_dict(q) for q in panel.qualities],
        "descents": [_descent_dict(d) for d in panel.descents],
    }


def _quality_dict(q: Quality) -> Json:
    entries = {"variance": q.variance, "bias": q.bias, "bias_error": q.bias_error}
    estimates = [
        {"seed": e.seed, "gradient": e.gradient.tolist(), "variance": e.variance.tolist(), "cosine": e.cosine}
        for e in q.estimates
    ]
    return {"entries": {name: values.tolist() for name, values in entries.items()}, "estimates": estimates}


def _descent_dict(d: Descent) -> Json:
    return {
        "order": d.order,
        "sigma": d.sigma,
        "seed": d.seed,
        "evaluations": list(d.evaluations),
        "losses": list(d.losses),
        "standard_errors": list(d.errors),
        "x": d.x.tolist(),
        "arrived": d.succeeded,
        "failure": d.failure,
    }


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
    write_page(folder / PAGE, "gradient_panel.html.j2", record=record, data=page_data(0.0, _plots(panel)))


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
