"""Checks of a motion: each has a measured value, a tolerance and a verdict."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from drake_diff._base.values import ShowsItsRepr
from drake_diff.optimize import messages

Verdict = Literal["pass", "fail", "undecided"]
PLAN = "plan"  # the `plant` of checks that use the solver's own states and inputs
COLUMNS = ("verdict", "what", "where", "plant", "feedback", "value", "tolerance", "unit")
ORDER: dict[str, int] = {"fail": 0, "undecided": 1, "pass": 2}


@dataclass(frozen=True)
class Check:
    """A measured value of a motion together with its tolerance.

    Attributes:
        what: The measured quantity: "goal", "bound", "constraint", "defect", "penetration", "energy", "derivative", ...
        where: The state, constraint or geometry with the largest value, and the time of this value.
        plant: "plan" for the solver's own states, or the plant in which the plan is replayed.
        feedback: The feedback under which the plan is replayed, or None for an open-loop replay.
        value, tolerance: Both in `unit`. `value` is infinite if it could not be measured.
        verdict: "pass", "fail" or "undecided". "undecided" does not count as passing.

    Example:
        >>> print(check("goal", "hinge_q", 0.2, 0.05, "rad"))
        hinge_q ends 0.2 rad from its goal, tolerance 0.05 rad
    """

    what: str
    where: str
    plant: str
    feedback: str | None
    value: float
    tolerance: float
    unit: str
    verdict: Verdict

    @property
    def passes(self) -> bool:
        """Whether the verdict is "pass"."""
        return self.verdict == "pass"

    @property
    def ratio(self) -> float:
        """`value` divided by `tolerance`."""
        if self.value <= 0:
            return 0.0
        return self.value / self.tolerance if self.tolerance > 0 else math.inf

    def __str__(self) -> str:
        if self.passes:
            return f"pass: {self.what}, {self.where}: {self.value:.3g} {self.unit}, tolerance {self.tolerance:.3g}"
        return messages.clause(self)


def check(
    what: str, where: str, value: float, tolerance: float, unit: str = "1", verdict: Verdict | None = None
) -> Check:
    """Return a check of the plan itself, which passes if `value` <= `tolerance`. NaN counts as infinite."""
    value = math.inf if math.isnan(value) else float(value)
    return Check(
        what, where, PLAN, None, value, float(tolerance), unit, verdict or ("pass" if value <= tolerance else "fail")
    )


class Checks(list[Check], ShowsItsRepr):
    """A list of checks, sorted from worst to best, that prints as a table."""

    def __init__(self, checks: Iterable[Check] = ()):
        super().__init__(sorted(checks, key=lambda c: (ORDER[c.verdict], -c.ratio)))

    @property
    def failing(self) -> list[Check]:
        """The checks that do not pass."""
        return [c for c in self if not c.passes]

    def __str__(self) -> str:
        rows = [COLUMNS]
        for c in self:
            numbers = f"{c.value:.3g}", f"{c.tolerance:.3g}"
            rows.append((c.verdict, c.what, c.where, c.plant, c.feedback or "open loop", *numbers, c.unit))
        widths = [max(len(row[i]) for row in rows) for i in range(len(COLUMNS))]
        return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)

    __repr__ = __str__
