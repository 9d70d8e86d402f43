"""Certify the derivative of any function of any engine: along random directions, then the entries they suspect."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import wraps
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, Indices, finite_array, fraction
from drake_diff._base.autodiff import called
from drake_diff._base.differences import richardson
from drake_diff.certificates.certificate import (
    EPS,
    LIMITS,
    VERDICTS,
    Certificate,
    Entry,
    Flags,
    Verdict,
    certify_displacement,
)
from drake_diff.certificates.differences import noise_of
from drake_diff.certificates.directions import SCREEN, Claim, Screen, first_power, least_size, normals, resolution
from drake_diff.exceptions import InputError, ShapeError


@dataclass(frozen=True)
class FunctionOptions:
    """Limits of the search for wrong entries, and of what counts as noise."""

    columns: int = 8  # most columns that are compared entry by entry
    rows: int = 8  # most values of a function whose VJPs are asked for each row
    alone: float = 2e-4  # 1 - cosine of the angle between a gap and the only column that explains it
    noisy: float = 10.0  # error of the values over the precision of the type, above which the screen is repeated
    noisiest: float = 4e-5  # error relative to the values, above which the screen is not repeated
    alike: float = 0.1  # scatter at smaller spacings over that at 1e-5, at least, of noise
    single: float = 1.2e-7  # relative scatter that may be rounding to single precision, constant at spacings of 1e-9
    bound: float = 4.0  # largest error of a value over its scatter, a standard deviation
    unsolved: float = 4.0  # allowed error of a value over the precision of the values, if single entries are compared
    stretch: float = 30.0  # of the steps for single entries, if the values have single precision or less
    double: float = 1e-12  # precision beyond which steps need no stretch


OPTIONS = FunctionOptions()


@dataclass(frozen=True, eq=False, repr=False)
class FunctionCertificate(Verdict):
    """The verdict on a function's derivative, with the meaning that it has in `Certificate`.

    Example:
        >>> certificate = dd.certify_function(np.sin, [0.0, 1.0], jacobian=lambda x: np.diag(np.cos(x)) * [1.0, 1.01])
        >>> certificate.verdict, certificate.entries[0].row, certificate.entries[0].column
        ('disagree', 'f[1]', 'x[1]')
    """

    verdict: str
    entries: tuple[Entry, ...]  # that do not agree, the worst first
    why: str  # it is undecided, or where the function is discontinuous beside the entries
    power: float  # the smallest error that would have been noticed in every entry, relative to its size
    least: float  # relative to the largest entry of its row: the size of an entry is this at least
    noise: float  # relative error of the values that is allowed for: rounding, tolerance, or 4 times their scatter
    evaluations: int  # of the function
    derivative_calls: int
    subject: str

    def _lines(self) -> list[str]:
        cost = f"{self.evaluations} evaluations, {self.derivative_calls} calls of the derivative"
        lines = [f"{self.verdict} ({cost}, noise {self.noise:.1g}, would have noticed {100 * self.power:.1g} %)"]
        lines += [str(entry) for entry in self.entries[:3]]
        lines += [f"and {len(self.entries) - 3} more entries"] if len(self.entries) > 3 else []
        return lines + [self.why] * bool(self.why)


def certify_function(
    f: Callable[..., Any],
    x: ArrayLike,
    *,
    jacobian: ArrayLike | Callable[..., Any] | None = None,
    jvp: Callable[..., Any] | None = None,
    vjp: Callable[..., Any] | None = None,
    scales: ArrayLike | None = None,
    solver_tolerance: float = 0.0,
) -> FunctionCertificate:
    """Certify the derivative of any function at a point: of NumPy, PyTorch, JAX, MuJoCo, Warp, CasADi, ...

    A few random directions with several step sizes decide first. If they find something wrong, it is traced to single
    entries. The noise of the function is measured. Functions in single precision are differenced over larger steps.
    A feature narrower than 1e-6 of the scale, such as a ripple, may be missed or taken for noise.

    Args:
        f: The function of an array like `x`. It returns a number or an array of any shape, also of PyTorch or JAX.
        x: The point, a number or an array of any shape. If its type is float32, `f` is called with float32 arrays.
        jacobian: The Jacobian, or a function of `x` that returns it, of the shape (size of f, size of x), or the shape
            of f followed by the shape of x.
        jvp: A function of `x` and a tangent v, like `x`, that returns J v, like f(x).
        vjp: A function of `x` and a cotangent w, like f(x), that returns w J, like `x`. The Jacobian is not formed, but
            compared through dot products.
        scales: The scales of the variables, to which steps and errors are relative, like `x` or one number. The default
            is max(1, |x|).
        solver_tolerance: Relative tolerance of the values, if `f` is solved iteratively. The error that a solver leaves
            is smooth, so that it cannot be measured. Derivatives of the exact solution differ from `f` by it.

    Returns:
        The verdict, the entries that are wrong, the smallest error that would have been noticed, and the cost. An error
        is relative to the entry (units of `f` per unit of `x`), or to `least` times the largest entry of its row if
        that is larger, with each column multiplied by its scale. `least` is 1e-4, but 0.1 in single precision.
        `power` may be large for a `vjp` if rows differ by more than a factor of 100.

    Raises:
        InputError: None or several of `jacobian`, `jvp` and `vjp` are given; a function raises or returns no numbers.
        ShapeError, NonFiniteError: An array has a wrong shape, or x, f(x) or the derivative is not finite.

    Source:
        More and Wild, "Estimating computational noise", 2011.

    Example:
        >>> dd.certify_function(lambda x: x**3, 2.0, jacobian=12.0).verdict
        'agree'
        >>> dd.certify_function(abs, 0.0, jvp=lambda x, v: v).verdict
        'discontinuous'
    """
    given = {name: value for name, value in (("jacobian", jacobian), ("jvp", jvp), ("vjp", vjp)) if value is not None}
    if len(given) != 1:
        raise InputError("jacobian, jvp, vjp", got=", ".join(given) or "none", expected="one of them")
    function = _Function(f, x, scales, fraction("solver_tolerance", solver_tolerance))
    claimed = _Claimed(function, *given.popitem())
    precision = function.precision
    if not (function.rows and function.columns):
        return _certificate(claimed, "agree", precision=precision)
    screen, why = claimed.screen(precision), ""
    if screen.doubt:
        if screen.within_steps().any():
            why = f"{screen.doubt}; the function changes within the smallest step: give smaller `scales`"
            return _certificate(claimed, "undecided", (), why, precision=precision, power=np.inf)
        scatter, why = _noise(screen, precision)
        if OPTIONS.noisy * precision < scatter:
            precision, screen = scatter, claimed.screen(scatter)
    if not screen.doubt:
        return _certificate(claimed, "agree", precision=precision, power=_power(screen, claimed.unbalanced))
    if np.isfinite(function.undefined):
        why = f"f is not finite at a distance of {function.undefined:.1g} from x: give smaller `scales`"
    return _examined(claimed, screen, precision, why)


def _noise(screen: Screen, precision: float) -> tuple[float, str]:
    """Return the largest error of the values relative to their size, if they scatter as noise does, and a sentence."""
    size = np.abs(screen.centre) + screen.claim.reach
    stretch = OPTIONS.stretch if precision > OPTIONS.double else 1.0
    values = noise_of(lambda d: screen.changes(stretch * d), len(screen.claim.weights))
    scatter = values[:, size > 0] / size[size > 0]  # (spacings, rows)
    largest = OPTIONS.bound * float(np.max(scatter[-1], initial=0.0))
    fine, finer = (scatter[k] >= OPTIONS.alike * scatter[-1] for k in (1, 0))
    noise = fine & (finer | (scatter[-1] <= max(OPTIONS.single, OPTIONS.noisy * precision)))
    noise |= OPTIONS.bound * scatter[-1] <= OPTIONS.noisy * precision  # too little to matter
    if largest <= OPTIONS.noisiest and noise.all():
        return largest, f"the values scatter by {largest:.1g} of their size"
    return 0.0, f"the values scatter by {largest:.1g} of their size, but not as noise does"


def _power(screen: Screen, unbalanced: float) -> float:
    """Return the smallest relative error that rows without doubt show, times `unbalanced` (of the smallest value)."""
    known = ~screen.in_doubt & (screen.allowed > 0)
    return LIMITS.power * float(np.max(screen.noticeable[known] / screen.allowed[known], initial=0.0)) * unbalanced


def _examined(claimed: _Claimed, screen: Screen, precision: float, scatter: str) -> FunctionCertificate:
    """Compare the entries that a screen suspects, and return the verdict."""
    rows = screen.in_doubt if screen.in_doubt.any() else ~screen.in_doubt
    n, power, entries = len(claimed.function.columns), _power(screen, claimed.unbalanced), tuple[Entry, ...]()
    for columns in _suspects(screen):
        for block in claimed.blocks(columns, rows):
            compared = _compared(claimed.function, block, columns, precision)
            entries = _wrong(compared)
            relative = np.nan_to_num(compared.tolerance / compared.size, nan=np.inf)
            power = max(power, float(np.max(relative, initial=0.0)))
            if compared.verdict in ("disagree", "discontinuous"):
                return _certificate(claimed, compared.verdict, entries, precision=precision, power=power)
        if not (entries or screen.broken) and len(columns) == n:
            return _certificate(claimed, "agree", precision=precision, power=power)
    if screen.broken:
        return _certificate(claimed, "discontinuous", entries, screen.broken, precision=precision, power=power)
    why = f"{screen.doubt}, but no single entry is known to be wrong; {scatter}"
    return _certificate(claimed, "undecided", entries, why, precision=precision, power=power)


def _suspects(screen: Screen) -> Iterator[list[int]]:
    """Yield columns that may be wrong: those that explain a gap alone, those that remain in doubt alone, or all."""
    rows, z, n = screen.in_doubt, screen.directions, len(screen.claim.weights)
    gap = screen.gap[:, rows]
    sizes = np.linalg.norm(z, axis=0)[:, None] * np.linalg.norm(gap, axis=0)
    cosine = np.abs(z.T @ gap) / np.where(sizes > 0, sizes, np.inf)  # (n, rows)
    alone = np.unique(np.argmax(cosine, axis=0)[np.max(cosine, axis=0, initial=0) >= 1 - OPTIONS.alone])
    if len(alone):
        yield alone[: OPTIONS.columns].tolist()
    if n <= OPTIONS.columns:
        yield list(range(n))
        return
    groups, single = [np.arange(n)], list[int]()
    while groups and len(single) < OPTIONS.columns:
        group = groups.pop()
        if np.any(screen.doubtful(np.isin(np.arange(n), group))[rows] if rows.any() else True):
            if len(group) > 1:
                groups += np.array_split(group, 2)
            else:
                single.append(int(group[0]))
    if single:
        yield sorted(single)


Block = tuple[Callable[[Array], Array], Array, tuple[str, ...]]  # values (K, m) -> (K, r), slopes (r, columns), names


def _compared(function: _Function, block: Block, columns: list[int], precision: float) -> Certificate:
    """Compare the slopes of a block with differences, entry by entry."""
    project, slopes, names = block
    stretch = OPTIONS.stretch if precision > OPTIONS.double else 1.0
    size = np.abs(project(function.value[None])[0]) + np.abs(slopes) @ np.abs(function.point / function.scale)[columns]

    def values(displacements: Array) -> Array:
        everywhere = np.zeros((len(displacements), len(function.point)))
        everywhere[:, columns] = stretch * displacements
        return project(function.values(everywhere))

    return certify_displacement(
        values,
        stretch * slopes,
        rows=names,
        columns=tuple(function.columns[j] for j in columns),
        subject="the derivative",
        method="given",
        scale=stretch * function.scale[columns],
        unsolved=OPTIONS.unsolved * precision * size,
        stopped=function.solver_tolerance,
    )


def _wrong(certificate: Certificate) -> tuple[Entry, ...]:
    """Return the entries that do not agree, the worst verdict and the largest gap first."""
    entries = [entry for entry in certificate.entries if entry.verdict != "agree"]
    gaps = [abs(e.derivative - e.difference) for e in entries]
    order = sorted(range(len(entries)), key=lambda i: (-VERDICTS.index(entries[i].verdict), -gaps[i]))
    return tuple(entries[i] for i in order)


def _certificate(
    claimed: _Claimed,
    verdict: str,
    entries: tuple[Entry, ...] = (),
    why: str = "",
    *,
    precision: float,
    power: float = 0.0,
) -> FunctionCertificate:
    cost = claimed.function.calls, claimed.calls
    subject = f"the derivative of {getattr(claimed.function.f, '__name__', 'f')}"
    return FunctionCertificate(verdict, entries, why, power, resolution(precision), precision, *cost, subject)


def _plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with results that are copied to NumPy: a function may return the same buffer each time."""
    return wraps(function)(lambda *arguments: _copied(_readable(function(*arguments))))


def _readable(result: Any) -> Any:
    for method in ("detach", "cpu", "numpy"):
        result = getattr(result, method)() if hasattr(result, method) else result
    return result


def _copied(result: Any) -> Any:
    array = np.array(result)
    return array if array.ndim or array.dtype.kind != "O" else result  # no numbers, which messages show as they are


def _numbers(subject: str, given: Any) -> Any:
    """Return the user's numbers as an array, or raise InputError."""
    try:
        array = np.asarray(_copied(_readable(given)))
    except (TypeError, ValueError) as error:
        raise InputError(subject, got=f"{given!r:.80}", expected="an array of numbers") from error
    if given is None:
        raise InputError(subject, got="None", expected="an array of numbers")
    return array


class _Function:
    """A user's function of scaled displacements (K, n) from the point, with values (K, m). `calls` are counted."""

    def __init__(self, f: Any, x: ArrayLike, scales: ArrayLike | None, solver_tolerance: float):
        if not callable(f):
            raise InputError("f", got=f"{f!r:.80}", expected="a function")
        self.f, self._plain, given = f, _plain(f), _numbers("x", x)
        self.solver_tolerance = solver_tolerance
        self.shape, self.calls, self.undefined = given.shape, 0, np.inf  # smallest distance where f is not finite
        self.type = given.dtype if given.dtype.kind == "f" else np.dtype(float)
        self.point = finite_array("x", given, given.shape).ravel()
        self.scale = np.maximum(1.0, np.abs(self.point))
        if scales is not None:
            scale = _numbers("scales", scales)
            scale = finite_array("scales", scale, self.shape if scale.ndim else ())
            if np.any(scale <= 0):
                raise InputError("scales", got=f"{np.min(scale):g}", expected="numbers above 0")
            self.scale = np.broadcast_to(scale, self.shape).ravel()
        value = np.asarray(self._evaluate(self.point))
        self.value_shape, self.value = value.shape, finite_array("f(x)", value, value.shape).ravel()
        self.value_type = value.dtype if value.dtype.kind == "f" else np.dtype(float)
        self.precision = max(
            EPS, solver_tolerance, *(float(np.finfo(kind).eps) for kind in (self.type, self.value_type))
        )
        self.rows, self.columns = _names("f", self.value_shape), _names("x", self.shape)

    def given(self, vector: Array) -> Any:
        """Return `vector` (n,) as the user's functions get it."""
        shaped = vector.reshape(self.shape).astype(self.type)
        return shaped if self.shape else shaped[()]

    def _evaluate(self, point: Array) -> Any:
        self.calls += 1
        return called("f", self._plain, self.given(point))

    def values(self, displacements: Array) -> Array:
        """Return the values (K, m) at displacements (K, n)."""
        values = [np.asarray(self._evaluate(self.point + self.scale * d), dtype=float) for d in displacements]
        for value in values:
            if value.shape != self.value_shape:
                raise ShapeError("f(x)", got=value.shape, expected=self.value_shape)
        table = np.array(values).reshape(len(values), -1)
        reach = np.abs(self.scale * displacements).max(axis=1, initial=0.0)
        self.undefined = min([self.undefined, *reach[~np.isfinite(table).all(axis=1)]])
        return table


def _names(letter: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    return tuple(letter + str(list(index)) if index else letter for index in np.ndindex(shape))


class _Claimed:
    """A user's derivative by scaled displacements. `calls` are counted.

    A VJP of many values gives the Jacobian of a few random combinations of the values, with weights `mixed` (k, m).
    """

    def __init__(self, function: _Function, kind: str, given: Any):
        self.function, self.kind, self._given, self.calls = function, kind, given, 0
        m, n = len(function.rows), len(function.columns)
        if kind != "jacobian" and not callable(given):
            raise InputError(kind, got=f"{given!r:.80}", expected="a function")
        self.mixed, self.matrix, self.unbalanced = np.eye(m), np.zeros((m, n)), 1.0
        if kind == "jacobian":
            shapes = (m, n), function.value_shape + function.shape
            matrix = self._ask(function.given(function.point)) if callable(given) else _numbers(kind, given)
            if np.shape(matrix) not in shapes:
                raise ShapeError("jacobian", got=np.shape(matrix), expected=shapes[0])
            self.matrix = finite_array("jacobian", matrix, np.shape(matrix)).reshape(m, n) * function.scale
        elif kind == "vjp":
            self.mixed = normals(m) / self._sizes() if m > OPTIONS.rows and n else self.mixed
            self.matrix = self._rows(self.mixed)

    def _ask(self, *arguments: Any, shape: tuple[int, ...] | None = None) -> Array:
        self.calls += 1
        result = called(self.kind, _plain(self._given), *arguments, shape=shape)
        return finite_array(f"{self.kind}(x)", result, np.shape(result))

    def _along(self, directions: Array) -> Array:
        """Return the slopes (K, k) along `directions` (K, n)."""
        if self.kind != "jvp":
            return directions @ self.matrix.T
        given, shape, point = self.function.given, self.function.value_shape, self.function.point
        tangents = [given(self.function.scale * direction) for direction in directions]
        slopes = [self._ask(given(point), tangent, shape=shape).ravel() for tangent in tangents]
        return np.array(slopes).reshape(len(directions), -1)

    def _rows(self, cotangents: Array) -> Array:
        """Return the products (k, n) of cotangents (k, m) and the Jacobian."""
        function, rows = self.function, []
        for w in cotangents:
            cotangent = w.astype(function.value_type).reshape(function.value_shape)
            asked = function.given(function.point), cotangent if function.value_shape else cotangent[()]
            rows.append(self._ask(*asked, shape=function.shape).ravel() * function.scale)
        return np.array(rows).reshape(len(cotangents), -1)

    def _sizes(self) -> Array:
        """Return (m,) the slopes of the values along the directions, which balance their combinations, or 1 % of the
        largest slope, beside which the combinations are `unbalanced`."""
        width = 10.0 ** (-first_power(self.function.precision) / 2)
        ends = self.function.values(width * normals(len(self.function.columns)))
        sizes = np.abs(ends - self.function.value).max(axis=0) / width
        balanced = np.maximum(sizes, SCREEN.flat * np.max(sizes, initial=0.0)) + float(not np.any(sizes))
        self.unbalanced = float(np.max(balanced[sizes > 0] / sizes[sizes > 0], initial=1.0))
        return balanced

    def _mix(self, values: Array) -> Array:
        return values @ self.mixed.T

    def screen(self, precision: float) -> Screen:
        """Screen the derivative, for values of this relative precision."""
        n, values = len(self.function.columns), np.abs(self.mixed) @ np.abs(self.function.value)
        if self.kind == "jvp" or len(self.mixed) < len(self.function.rows):  # the entries themselves are not known
            norm = np.linalg.norm(self._along(normals(n)), axis=0) / np.sqrt(
                SCREEN.directions
            )  # about that of each row
            size = least_size(norm, values, precision)
            claim = Claim(self._along, np.ones(n), LIMITS.power * size, np.sqrt(n) * norm, size[:, None])
        else:
            least = least_size(np.abs(self.matrix).max(axis=1), values, precision)
            claim = Claim.of_matrix(self.matrix, least=least[:, None], still=1.0)
        return Screen(claim, lambda d: self._mix(self.function.values(d)), precision=precision)

    def blocks(self, columns: list[int], rows: Flags) -> Iterator[Block]:
        """Yield the slopes along `columns` of values in doubt, `rows` (k,).

        With combinations, these are first the values to which their gaps point, and then the combinations.
        """
        names, m = self.function.rows, len(self.function.rows)
        if len(self.mixed) < m:
            suspects = self._suspects(columns)
            slopes = self._rows(np.eye(m)[suspects])[:, columns]
            yield lambda values: values[:, suspects], slopes, tuple(names[i] for i in suspects)
            names = tuple(f"combination {k} of f" for k in range(len(self.mixed)))
        slopes = self._along(np.eye(len(self.function.columns))[columns]).T[rows]
        yield lambda values: self._mix(values)[:, rows], slopes, tuple(names[i] for i in np.flatnonzero(rows))

    def _suspects(self, columns: list[int]) -> Indices:
        """Return the values whose parts in the combinations are most like the gaps, two for each column."""
        power, units = first_power(self.function.precision), np.eye(len(self.function.columns))[columns]
        widths = 10.0 ** (-np.array([power - 1, power]) / 2)
        ends = self.function.values(np.vstack([side * w * units for w in widths for side in (1.0, -1.0)]))
        ahead, behind = ends.reshape(2, 2, len(columns), -1).swapaxes(0, 1)
        slopes = richardson((ahead - behind) / (2 * widths[:, None, None]))[0]  # (columns, m)
        gap = self.matrix[:, columns] - self._mix(slopes).T  # (k, columns)
        mixed = self.mixed / np.max(np.abs(self.mixed))  # the squares of larger numbers may overflow
        alike = np.abs(mixed.T @ gap) / np.linalg.norm(mixed, axis=0)[:, None]
        return np.unique(np.argsort(-alike, axis=0)[:2])
