"""Gradients of first, zeroth and blended order on a panel of tasks: variance, bias, and whether a descent arrives.

After Suh et al. 2022, "Do differentiable simulators give better policy gradients?". Cost is counted in calls of f and
of its derivative, one each; wall-clock times are not compared.
"""

import csv
import io
import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import positive_int
from drake_diff._base.files import write_whole
from drake_diff._base.jupyter import preformatted
from drake_diff._base.statistics import Rate, success_rate
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.pages.html import Line, Plot, page_data, write_page
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
RECORD, TABLE, PAGE = "gradient_panel.json", "gradient_panel.csv", "gradient_panel.html"


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
) -> "GradientPanel":
    """Compare estimates of the gradient of F(x) = E[f(x + w)] on several tasks.

    For every case, sigma and order, `seeds` estimates at the case's start are compared with the truth, and `seeds`
    descents at the largest sigma show whether the estimates lead anywhere. The same call gives the same numbers.

    Args:
        cases: Your own `GradientCase`, or names of the built-in ones; all of those by default, which takes minutes.
        orders: Of "point" (the derivative without noise), "first", "zeroth" and "blend".
        sigmas: Standard deviations of w, in the units of x; each case's own by default.
        samples: Samples w of an estimate.
        seeds: How many estimates, and how many descents, of each order.
        reference_samples: Samples of the truth, by zeroth order, where a case has no closed form.
        budget: Calls of f and its derivative that a descent may make.
        batch: Samples of one step of a descent.
        progress: Called with the name of each case when its turn comes.

    Returns:
        The panel. Printed, it is a table; `case(name)` has the numbers of one case.

    Raises:
        UnknownNameError: For a case or an order that does not exist.
        InputError: If a count is too small, a sigma is not above 0, or there is no case.
        GradientError, SimulationError: From f and its derivative at a case's start.

    Source:
        Suh, Simchowitz, Zhang, Tedrake 2022, "Do differentiable simulators give better policy gradients?", ICML.

    Example:
        >>> panel = dd.studies.gradient_panel(["wall"], ["first", "zeroth"], sigmas=[0.2], seeds=3)
        >>> panel.case("wall").at("first", 0.2).biased  # f jumps where the ball just clears the wall
        True
        >>> panel.case("wall").least_error(0.2)
        'zeroth'
    """
    orders = check_orders(orders)
    for name, value in (("seeds", seeds), ("budget", budget)):
        positive_int(name, value)
    for name, value in (("samples", samples), ("reference_samples", reference_samples), ("batch", batch)):
        if positive_int(name, value) < 2:
            raise InputError(name, got=value, expected="at least 2: one has no variance")
    if budget < 2 * batch + 2:
        raise InputError("budget", got=budget, expected=f"at least {2 * batch + 2}, one step of a blend")
    asked = None if sigmas is None else checked_sigmas("sigmas", sigmas)
    found = []
    for case in [_case_of(case) for case in (CASES if cases is None else cases)]:
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


@dataclass(frozen=True, eq=False)
class CasePanel:
    """One case: its truth at each sigma, the quality of each order there, and the descents at the largest sigma."""

    case: GradientCase
    sigmas: tuple[float, ...]
    truths: tuple[Truth, ...]
    qualities: tuple[Quality, ...]
    descents: tuple[Descent, ...]

    def __repr__(self) -> str:
        return "\n  ".join([f"CasePanel({self.case.name})", *self.verdict])

    def at(self, order: str, sigma: float) -> Quality:
        """The estimates of one order at one sigma."""
        return next(q for q in self.qualities if q.order == order and q.sigma == sigma)

    def descents_of(self, order: str) -> tuple[Descent, ...]:
        """One for each seed; "point" makes one alone, as no seed changes it."""
        return tuple(d for d in self.descents if d.order == order)

    def rate(self, order: str) -> Rate:
        """How many of the descents arrived."""
        found = self.descents_of(order)
        return success_rate(sum(d.arrived for d in found), len(found))

    def least_error(self, sigma: float) -> str:
        """The order with the smallest mean squared error at equal cost; "point", which does not estimate F, is out."""
        ranked = [q for q in self.qualities if q.sigma == sigma and q.order != "point"]
        return min(ranked or [self.at("point", sigma)], key=lambda q: q.mean_squared_error).order

    @property
    def verdict(self) -> tuple[str, ...]:
        """Sentences: which order has the least error, which are biased, which descents arrived."""
        best = ", ".join(f"{self.least_error(s)} at sigma {s:g}" for s in self.sigmas)
        found, arrived = [f"least mean squared error at equal evaluations: {best}"], []
        for order in dict.fromkeys(q.order for q in self.qualities):
            label = {"point": "the derivative at the point", "blend": "the blend"}.get(order, f"{order} order")
            biased = [q for q in self.qualities if q.order == order and q.biased]
            sizes = []
            for q in biased:
                errors = f"{q.bias_in_errors:.0f} standard errors" if np.isfinite(q.bias_in_errors) else "exactly"
                sizes.append(f"sigma {q.sigma:g} (by {np.linalg.norm(q.bias):.2g}, {errors})")
            found.append(f"{label} is biased at {', '.join(sizes)}" if biased else f"{label} shows no bias")
            rate = self.rate(order)
            arrived.append(f"{order} {rate.successes} of {rate.trials}")
        return (*found, f"the descent arrived with {', '.join(arrived)}")


@dataclass(frozen=True, eq=False)
class GradientPanel:
    """All cases of a `gradient_panel`, and the counts that they were made with; `str` is a table.

    Example:
        >>> dd.studies.gradient_panel(["double_integrator"], ["first"], sigmas=[0.5], seeds=2)
        GradientPanel(1 case, 2 seeds of 30 samples)
          double_integrator: least mean squared error at equal evaluations: first at sigma 0.5
    """

    cases: tuple[CasePanel, ...]
    orders: tuple[str, ...]
    samples: int
    seeds: int
    reference_samples: int
    budget: int
    batch: int

    def case(self, name: str) -> CasePanel:
        """The case of that name; UnknownNameError where there is none."""
        known = {panel.case.name: panel for panel in self.cases}
        if name not in known:
            raise UnknownNameError("case", got=name, known=known)
        return known[name]

    def to_dict(self) -> Json:
        """Every number, as plain data for JSON; None stands for no number."""
        counts = _fields(self, "orders", "samples", "seeds", "reference_samples", "budget", "batch")
        return {**counts, "cases": [_case_dict(panel) for panel in self.cases]}

    def rows(self) -> list[Json]:
        """A row for each case, sigma and order, as the table and its file have them."""
        return [_row(panel, q) for panel in self.cases for q in panel.qualities]

    def __repr__(self) -> str:
        cases = f"{len(self.cases)} case{'s' * (len(self.cases) > 1)}"
        lines = [f"  {panel.case.name}: {panel.verdict[0]}" for panel in self.cases]
        return "\n".join([f"GradientPanel({cases}, {self.seeds} seeds of {self.samples} samples)", *lines])

    def __str__(self) -> str:
        lines = [f"{self.seeds} seeds of {self.samples} samples; descents of {self.budget} calls, {self.batch} a step"]
        head = f"{'order':8s}{'sigma':>7s}{'variance':>11s}{'bias':>11s}{'errors':>8s}{'cosine':>8s}{'mse':>11s}"
        for panel in self.cases:
            lines += ["", f"{panel.case.name}: {panel.case.about}", f"  {head}  arrived"]
            lines += [f"  {_line(_row(panel, q))}" for q in panel.qualities]
            lines += [f"  {sentence}" for sentence in panel.verdict]
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        return preformatted(str(self))


def save_gradient_panel(panel: GradientPanel, directory: str | Path) -> None:
    """Write a panel as numbers, table and page: gradient_panel.json, .csv and .html.

    Args:
        panel: Made by `gradient_panel`.
        directory: Where to write; made if it is not there. The table has a row for each case, sigma and order.

    Raises:
        OSError: If the directory cannot be written to.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> panel = dd.studies.gradient_panel(["double_integrator"], ["first"], sigmas=[0.5], seeds=2)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     dd.studies.save_gradient_panel(panel, folder)
        ...     sorted(path.name for path in Path(folder).iterdir())
        ['gradient_panel.csv', 'gradient_panel.html', 'gradient_panel.json']
    """
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


def _case_of(case: GradientCase | str) -> GradientCase:
    if isinstance(case, GradientCase):
        return case
    if case not in CASES:
        raise UnknownNameError("case", got=case, known=CASES)
    return CASES[case]()


def _row(panel: CasePanel, q: Quality) -> Json:
    last, rate, estimate = q.sigma == panel.sigmas[-1], panel.rate(q.order), q.estimates[0]
    losses = [d.losses[-1] for d in panel.descents_of(q.order)]
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
        "final_loss": float(np.mean(losses)) if last else None,
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
    qualities = []
    for q in panel.qualities:
        entries = _fields(q, "variance", "bias", "bias_error")
        estimates = [_fields(e, "seed", "gradient", "variance", "cosine") for e in q.estimates]
        qualities.append({**_row(panel, q), "entries": entries, "estimates": estimates})
    return {
        **_fields(panel.case, "name", "about", "start", "rate", "goal"),
        "verdict": list(panel.verdict),
        "truths": [{"sigma": s, **_fields(truth)} for s, truth in zip(panel.sigmas, panel.truths, strict=True)],
        "qualities": qualities,
        "descents": [_fields(d) for d in panel.descents],
    }


def _fields(value: Any, *names: str) -> Json:
    """Those fields of a dataclass, or all, with arrays and tuples as lists."""
    found = {name: getattr(value, name) for name in names or [field.name for field in fields(value)]}
    return {name: np.asarray(v).tolist() if isinstance(v, (np.ndarray, tuple)) else v for name, v in found.items()}


def _plots(panel: GradientPanel) -> Iterable[Plot]:
    for found in panel.cases:
        name = found.case.name
        variances = [Line(o, [found.at(o, s).trace for s in found.sigmas]) for o in panel.orders]
        biases = [Line(o, [float(np.linalg.norm(found.at(o, s).bias)) for s in found.sigmas]) for o in panel.orders]
        note = f"of the mean of {panel.samples} samples, summed over the entries; 0 is not on a log scale"
        yield Plot(f"{name}: variance", "f² / x²", found.sigmas, variances, axis="sigma", log=True, note=note)
        note = f"the mean of {panel.seeds} seeds, less the truth; a bias that is not significant is chance"
        yield Plot(f"{name}: bias", "f / x", found.sigmas, biases, axis="sigma", log=True, note=note)
        calls = found.descents[0].evaluations
        losses = [Line(o, np.mean([d.losses for d in found.descents_of(o)], axis=0)) for o in panel.orders]
        goal = found.case.goal
        note = f"smoothed by sigma = {found.sigmas[-1]:g}, mean over the seeds; above {goal:.4g} is not arrived"
        yield Plot(f"{name}: loss", "f", calls, losses, axis="evaluations", limits=[None, goal], note=note)
