"""Compare a derivative with difference quotients, entry by entry, and say whether it may be used.

What the differences say is in `neighbourhood`, the verdict in `judgement`, and what it means in `Certificate`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff._base.differences import Difference, Function, Many, one_by_one
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.certificates.judgement import VERDICTS, Scales, judge
from drake_diff.certificates.neighbourhood import Neighbourhood, look_around
from drake_diff.exceptions import CertificateError, GradientError, InputError, ShapeError
from drake_diff.model.contact import Pair

JITTER = 1e-9


@dataclass(frozen=True)
class Entry:
    """One entry of a derivative, the differences' value of it, the gap that is allowed, and what would be noticed."""

    row: str
    column: str
    derivative: float
    difference: float
    tolerance: float
    noticeable: float  # the smallest error that would have been noticed
    verdict: str
    reason: str = ""  # of "discontinuous": which kind, with numbers

    def __str__(self) -> str:
        why = f" ({self.reason})" if self.reason else ""
        return (
            f"d {self.row} / d {self.column}: derivative {self.derivative:.9g}, differences {self.difference:.9g}, "
            f"tolerance {self.tolerance:.2g}, would have noticed {self.noticeable:.2g}: {self.verdict}{why}"
        )


@dataclass(frozen=True)
class ModeChange:
    """One pair's contact mode at the point and beside it, and the rows that the derivative misses there."""

    pair: Pair
    before: str
    after: str
    column: str
    displacement: float  # in the column's own unit
    rows: tuple[str, ...]

    def __str__(self) -> str:
        touched = f", which touches d({', '.join(self.rows)})/d{self.column}" if self.rows else ""
        return (
            f"{self.pair[0]} and {self.pair[1]}: {self.before} here, {self.after} where {self.column} "
            f"is {self.displacement:+.3g}{touched}"
        )


@dataclass(frozen=True, eq=False, repr=False)
class Certificate(ShowsItsRepr):
    """One derivative (m, n), compared with difference quotients; `codes` (m, n) are indices into VERDICTS.

    How far the differences can be trusted is measured at the point: by how much they depend on their step, and by how
    much the function's values scatter. From that comes `noticeable`, the smallest error of each entry that would have
    been noticed. It is weighed by `size`: the entry itself, but no less than a millionth of the largest entry of its
    row and of its column, the columns being moved by 1 SI unit, or by the variable's magnitude where that is more.
    The verdict of an entry is

    - "agree": it is the differences' value, and an error of 1 % of `size` would have been noticed;
    - "undecided": the differences do not tell 1 %. Undecided does not pass;
    - "not_converged": it agrees, but a rollout's gradient changes at a finer time step or in stiffer contact;
    - "disagree": it is another value than the differences';
    - "discontinuous": the function has a corner, a jump or stairs at the point, or the derivative is another one 1e-9
      beside it; the entry's `reason` says which.

    Example:
        >>> certificate = dd.certificates.certify_jacobian(np.sin, [0.0], [[1.01]], rows=["y"], columns=["x"])
        >>> certificate.verdict
        'disagree'
        >>> print(certificate.worst)
        d y / d x: derivative 1.01, differences 1, tolerance ..., would have noticed ...: disagree
    """

    rows: tuple[str, ...]
    columns: tuple[str, ...]
    derivative: Array
    difference: Array
    tolerance: Array
    noticeable: Array
    size: Array
    codes: NDArray[np.int64]
    reasons: dict[tuple[int, int], str]  # of the entries that are discontinuous
    method: str
    subject: str
    # In displacements of which one changes a column by its `scale`; None where the differences are of another motion,
    # or along directions alone: `difference` then is the matrix nearest to the derivative that has their slopes.
    around: Neighbourhood | None
    scale: Array  # (n,)
    stopped: float  # how early the solver stopped where the derivative was taken, as a part of the momentum
    second: Scales | None  # units of rows and columns by which entries are weighed as well
    told: str = ""  # whose differences these are, where it is not plain
    mode_changes: tuple[ModeChange, ...] = ()  # of contact, within 1e-4 of the point

    @property
    def verdict(self) -> str:
        """The worst verdict of all entries."""
        return VERDICTS[int(np.max(self.codes))] if self.codes.size else "agree"

    @property
    def power(self) -> float:
        """The smallest error, as a part of what it is weighed by, that would have been noticed in every entry."""
        return float(np.max(self.noticeable / self.size, initial=0.0))

    @cached_property
    def entries(self) -> tuple[Entry, ...]:
        """Every entry, row by row."""
        return tuple(self.entry(i, j) for i in range(len(self.rows)) for j in range(len(self.columns)))

    @property
    def worst(self) -> Entry:
        """The entry with the worst verdict; among equals, the one that is most wrong, or least known, for its size."""
        gap = np.abs(self.derivative - self.difference)
        excess = np.where(gap > self.tolerance, gap, self.noticeable) / self.size
        rank = self.codes + excess / (1 + excess)
        i, j = np.unravel_index(int(np.argmax(np.where(np.isnan(rank), np.inf, rank))), rank.shape)
        return self.entry(int(i), int(j))

    def entry(self, row: int, column: int) -> Entry:
        """The entry at (`row`, `column`)."""
        numbers = (self.derivative, self.difference, self.tolerance, self.noticeable)
        a, d, t, n = (float(values[row, column]) for values in numbers)
        verdict, reason = VERDICTS[self.codes[row, column]], self.reasons.get((row, column), "")
        return Entry(self.rows[row], self.columns[column], a, d, t, n, verdict, reason)

    def of(self, derivative: ArrayLike) -> Certificate:
        """The certificate of another `derivative` (m, n) at this point, by the same differences."""
        if self.around is None:
            raise InputError("of", got="a certificate without differences of each entry", expected="one by `certify`")
        a = finite_array("derivative", derivative, self.derivative.shape) * self.scale
        named = {
            name: getattr(self, name) for name in ("rows", "columns", "method", "subject", "told", "stopped", "second")
        }
        return certificate_of(self.around, a, None, scale=self.scale, **named)

    def count(self, verdict: str) -> int:
        """How many entries have this verdict."""
        return int((self.codes == VERDICTS.index(verdict)).sum())

    def require(self) -> Certificate:
        """This certificate if every entry agrees; otherwise CertificateError, which names the worst entry."""
        if self.verdict != "agree":
            raise CertificateError(f"{self.subject}: {self}")
        return self

    def _lines(self) -> list[str]:
        counts = ", ".join(f"{self.count(v)} {v}" for v in VERDICTS if self.count(v))
        noticed = f", would have noticed {100 * self.power:.1g} %" if self.verdict == "agree" else ""
        lines = [f"{self.verdict} ({counts} of {self.codes.size} entries, {self.method}{noticed})"]
        lines += [f"worst: {self.worst}"] if self.codes.size else []
        lines += [self.told] if self.told else []
        if self.mode_changes:
            more = f" and {len(self.mode_changes) - 1} more" if len(self.mode_changes) > 1 else ""
            lines.append(f"contact changes nearby: {self.mode_changes[0]}{more}")
        return lines

    def __str__(self) -> str:
        return "; ".join(self._lines())

    def __repr__(self) -> str:
        return f"{type(self).__name__} of {self.subject}: " + "\n  ".join(self._lines())


def certify_jacobian(
    f: Function | Many,
    x: ArrayLike,
    jacobian: ArrayLike | Callable[[Array], Array],
    *,
    batched: bool = False,
    rows: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    solver_tolerance: float = 0.0,
    method: str = "given",
    subject: str = "the derivative",
    scale: ArrayLike | None = None,
) -> Certificate:
    """Certify the Jacobian of any function R^n -> R^m at a point.

    Args:
        f: the function, (n,) -> (m,); if `batched`, (K, n) -> (K, m), and it is called once for all points.
        x: (n,) the point.
        jacobian: (m, n), or a function of x that gives it, which is then also asked 1e-9 beside `x`.
        batched: whether `f` takes many points at once.
        rows: m names of the function's values.
        columns: n names of the variables.
        solver_tolerance: how accurately `f` is solved, relative to max(1, |f|), if it is solved iteratively.
        method: how the Jacobian was computed, for the record.
        subject: what is certified, for messages.
        scale: (n,) sizes of the variables, which differences move by parts of; max(1, |x|) where not given.

    Returns:
        The certificate; its derivatives have the units of `f` per unit of `x`.

    Raises:
        ShapeError: the Jacobian does not have m rows and n columns.
        GradientError: the Jacobian is not finite.

    Source:
        Richardson, "The approximate arithmetical solution by finite differences", 1911.

    Example:
        >>> dd.certificates.certify_jacobian(np.sin, [0.0], [[1.0]]).verdict
        'agree'
        >>> dd.certificates.certify_jacobian(np.abs, [0.0], [[0.0]]).verdict  # a kink: central differences see 0
        'discontinuous'
    """
    x = finite_array("x", x, ("n",))
    scale = np.maximum(1.0, np.abs(x)) if scale is None else finite_array("scale", scale, x.shape)
    at_x, beside = np.asarray(jacobian(x) if callable(jacobian) else jacobian, dtype=float), None
    if callable(jacobian):
        beside = np.asarray(jacobian(x + jitter(scale)), dtype=float) * scale
    many = f if batched else one_by_one(lambda at: np.asarray(f(at), dtype=float))
    unsolved: Array | float = 0.0
    if solver_tolerance:
        unsolved = solver_tolerance * np.maximum(1.0, np.abs(np.asarray(many(x[None]), dtype=float)[0]))
    return certify_displacement(
        lambda d: many(x + scale * d),
        at_x * scale,
        beside=beside,
        scale=scale,
        rows=tuple(rows or (f"f[{i}]" for i in range(at_x.shape[0]))),
        columns=tuple(columns or (f"x[{i}]" for i in range(len(x)))),
        unsolved=unsolved,
        stopped=solver_tolerance,
        point=x / scale,
        method=method,
        subject=subject,
    )


def certify_displacement(
    f: Many,
    derivative: Array,
    *,
    rows: tuple[str, ...],
    columns: tuple[str, ...],
    scale: Array,
    beside: Array | None = None,
    minus: Difference = np.subtract,
    unsolved: Array | float = 0.0,
    stopped: float = 0.0,
    point: Array | None = None,
    told: str = "",
    method: str = "given",
    subject: str = "the derivative",
) -> Certificate:
    """Certify `derivative` (m, n) of `f` at 0, a function of scaled displacements (K, n) with values (K, m).

    `beside` is the derivative at a point 1e-9 away; `scale` (n,) takes the scaling out of what is reported;
    `minus` subtracts two values of `f`, on a tangent space if need be; `unsolved` (m,) is how wrong a value of `f` may
    be because a solver stopped early, and `stopped` is how early, relative: see `judge`; `point` (n,) is what is
    displaced, in the same units, if it is numbers that are rounded; `told` says whose differences these are.
    """
    if derivative.shape != (len(rows), len(columns)):
        raise ShapeError("derivative", got=derivative.shape, expected=(len(rows), len(columns)))
    if not np.all(np.isfinite(derivative)):
        raise GradientError(f"{subject} is not finite: {derivative}")
    around = look_around(f, len(columns), minus, unsolved, point)
    named: dict[str, Any] = {"rows": rows, "columns": columns, "method": method, "subject": subject, "told": told}
    return certificate_of(around, derivative, beside, scale=scale, stopped=stopped, **named)


def certificate_of(
    around: Neighbourhood,
    derivative: Array,
    beside: Array | None,
    *,
    scale: Array,
    stopped: float = 0.0,
    second: Scales | None = None,
    **named: Any,
) -> Certificate:
    """The verdict on a `derivative` (m, n) by the scaled displacements; see `judge`."""
    found = judge(around, derivative, beside, stopped, second)
    numbers = (derivative, found.difference, found.tolerance, found.noticeable, found.size)
    a, d, t, noticeable, size = (frozen(some / scale) for some in numbers)
    return Certificate(
        derivative=a, difference=d, tolerance=t, noticeable=noticeable, size=size, codes=found.codes,
        reasons=found.reasons, around=around, scale=scale, stopped=stopped, second=second, **named,
    )  # fmt: skip


def jitter(scale: Array) -> Array:
    """(n,) entries between a half and all of 1e-9 `scale` (n,), of either sign, always the same ones."""
    random, size = np.random.default_rng(0), len(scale)
    return JITTER * scale * (random.uniform(0.5, 1.0, size) * random.choice([-1.0, 1.0], size))
