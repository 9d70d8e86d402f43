"""One line of what two engines must share, and how two numbers, texts or rows of theirs become one."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from drake_diff.engines.interface import Engine, Precision

Verdict = Literal["equal", "mapped", "different"]
# Two libraries' sums over a tree differ by rounding, magnified by cancellation; a wrong number differs by far more.
SAME_NUMBER: dict[Precision, float] = {"float64": 1e-9, "float32": 1e-5}
# Below any inertia that matters: what MuJoCo gives a point mass, 2e-15 kg m^2, and rounding of zeros.
NOTHING: dict[Precision, float] = {"float64": 1e-12, "float32": 1e-6}

# What an engine must have of contact: where it lacks them and they are at work, it simulates another model.
MUST_HAVE = ("shapes", "poses", "contact pairs")
# What is the engine's own whatever the model: the form of its laws.
LAWS = (
    "integrator", "scalar type", "derivative convention", "limit law", "contact law", "solver tolerance", "reset",
)  # fmt: skip


# Of a quantity that is different because nobody says what it is, which neither breaks nor explains anything.
NOT_TOLD, FUNCTION_DOES_NOT_SAY = "the recording does not say", "a user's function does not say"
UNKNOWN = (NOT_TOLD, FUNCTION_DOES_NOT_SAY)


@dataclass(frozen=True, repr=False)
class ContractLine:
    """One thing that two engines must share, and whether they do.

    Attributes:
        quantity: what is compared, such as "mass" or "contact law".
        verdict: "equal", "mapped" (the same in other coordinates; `detail` says how) or "different".
        detail: the common value, or both values, their place, and the reason where there is one.
        reason: why an engine cannot have what the other has; empty where the model itself differs.

    Example:
        >>> print(dd.engines.ContractLine("time step", "equal", "0.01 [s]"))
        equal     time step: 0.01 [s]
    """

    quantity: str
    verdict: Verdict
    detail: str
    reason: str = ""

    def __repr__(self) -> str:
        return f"{self.verdict:9} {self.quantity}: {self.detail}"


def is_another_model(line: ContractLine, touched: bool) -> bool:
    """Whether a line that is different makes another model, where contact is at work (`touched`) or not."""
    return (touched and line.quantity in MUST_HAVE) or (not line.reason and line.quantity not in LAWS)


class Match:
    """Lines of two engines' contracts, `one` and `two`, compared in the coarser arithmetic of both."""

    def __init__(self, a: Engine, b: Engine):
        self.engines = a, b
        self.one, self.two = self.contracts = a.contract, b.contract
        self.precision: Precision = "float32" if "float32" in [c.precision for c in self.contracts] else "float64"

    def same(self, a: Any, b: Any) -> bool:
        if isinstance(a, str) or isinstance(b, str) or not (math.isfinite(a) and math.isfinite(b)):
            return bool(a == b)
        return abs(a - b) <= max(NOTHING[self.precision], SAME_NUMBER[self.precision] * max(abs(a), abs(b)))

    def both(self, a: object, b: object) -> str:
        return f"{self.one.engine}: {a}; {self.two.engine}: {b}"

    def different(self, quantity: str, what: str) -> ContractLine:
        """With the reason of the engine that has one."""
        reason = self.one.reasons.get(quantity) or self.two.reasons.get(quantity) or ""
        told = reason if reason in UNKNOWN else "; ".join(part for part in (what, reason) if part)
        return ContractLine(quantity, "different", told, reason)

    def text(self, quantity: str, a: str, b: str) -> ContractLine:
        return ContractLine(quantity, "equal", a) if a == b else self.different(quantity, self.both(a, b))

    def all_same(self, a: Sequence[Any], b: Sequence[Any]) -> bool:
        return len(a) == len(b) and all(map(self.same, a, b))

    def numbers(self, quantity: str, a: tuple[Any, ...], b: tuple[Any, ...], unit: str = "") -> ContractLine:
        if self.all_same(a, b):
            return ContractLine(quantity, "equal", f"{values_told(a)} {unit}".strip())
        return self.different(quantity, f"{self.both(values_told(a), values_told(b))} {unit}".strip())


def values_told(values: tuple[Any, ...]) -> str:
    shown = [value if isinstance(value, str) else f"{value:.10g}" for value in values]
    return shown[0] if len(shown) == 1 else "(" + ", ".join(shown) + ")"
