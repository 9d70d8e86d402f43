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
from drake_diff._base.values import ShowsItsRepr
from drake_diff.certificates.certificate import EPS, LIMITS, VERDICTS, Certificate, Entry, Flags, certify_displacement
from drake_diff.certificates.differences import noise_of
from drake_diff.certificates.directions import SCREEN, Claim, Screen, first_power, least_size, normals, resolution
from drake_diff.exceptions import CertificateError, InputError, ShapeError


@dataclass(frozen=True)
class FunctionOptions:
    """Limits of the search for wrong entries, and of what counts as noise."""

    columns: int = 8  # most columns that are compared entry by entry
    rows: int = 8  # most values of a function whose VJPs are asked for each row
    alone: float = 2e-4  # 1 - cosine of the angle between a gap and the only column that explains it
    noisy: float = 10.0  # scatter over the precision of the type, above which the screen is repeated for this scatter
    noisiest: float = 4e-5  # relative to the values: what scatters more is no noise
    bound: float = 4.0  # largest error of a value over its scatter, a standard deviation
    unsolved: float = 4.0  # rounding of a value over its precision, in differences of single entries
    stretch: float = 30.0  # of the steps for single entries, if the values have single precision or less
    double: float = 1e-12  # precision beyond which steps need no stretch


OPTIONS = FunctionOptions()


@dataclass(frozen=True, eq=False, repr=False)
class FunctionCertificate(ShowsItsRepr):
    """The verdict on a function's derivative, as in `Certificate`, and the `entries` that do not agree, worst first.

    The verdict is

    - "agree": the derivative has the slopes that differences measure, and an error of 1 % would have been noticed;
    - "disagree": the `entries` are wrong;
    - "discontinuous": the function has a corner, a jump or a staircase; `why` and the `entries` say where;
    - "undecided": `why` says what differences cannot tell.

    Example:
        >>> found = dd.certify_function(np.sin, [0.0, 1.0], jacobian=lambda x: np.diag(np.cos(x)) * [1.0, 1.01])
        >>> found.verdict, found.entries[0].row, found.entries[0].column
        ('disagree', 'f[1]', 'x[1]')
    """

    verdict: str
    entries: tuple[Entry, ...]
    why: str
    power: float  # the smallest error that would have been noticed in every entry, relative to its size
    least: float  # relative to the largest entry of its row: the size of an entry is this at least
    noise: float  # relative scatter of the function's values
    evaluations: int  # of the function
    derivative_calls: int
    subject: str

    def require(self) -> FunctionCertificate:
        """Return this certificate if the verdict is "agree", and raise CertificateError otherwise."""
        if self.verdict != "agree":
            raise CertificateError(f"{self.subject}: {self}")
        return self

    def _lines(self) -> list[str]:
        cost = f"{self.evaluations} evaluations, {self.derivative_calls} calls of the derivative"
        lines = [f"{self.verdict} ({cost}, noise {self.noise:.1g}, would have noticed {100 * self.power:.1g} %)"]
        lines += [str(entry) for entry in self.entries[:3]]
        lines += [f"and {len(self.entries) - 3} more entries"] if len(self.entries) > 3 else []
        return lines + [self.why] * bool(self.why)

    def __str__(self) -> str:
        return "; ".join(self._lines())

    def __repr__(self) -> str:
        return f"{type(self).__name__} of {self.subject}: " + "\n  ".join(self._lines())


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
    ((kind, derivative),) = given.items()
    claimed = _KINDS[kind](function, derivative)
    precision = function.precision
    if not (function.rows and function.columns):
        return _certificate(claimed, "agree", precision=precision)
    screen = claimed.screen(precision)
    if screen.doubt:
        size = np.abs(screen.centre) + screen.claim.reach
        noise = noise_of(screen.changes, len(function.columns))[size > 0] / size[size > 0]
        scatter = OPTIONS.bound * float(np.max(noise, initial=0.0))
        if OPTIONS.noisy * precision < scatter <= OPTIONS.noisiest:
            precision, screen = scatter, claimed.screen(scatter)
    if not screen.doubt:
        return _certificate(claimed, "agree", precision=precision, power=_power(screen))
    return _examined(claimed, screen, precision, f"the values scatter by {scatter:.1g} of their size")


def _power(screen: Screen) -> float:
    """Return the smallest error, relative to the size of an entry, that the rows without doubt would have shown."""
    known = ~screen.in_doubt & (screen.allowed > 0)
    return LIMITS.power * float(np.max(screen.noticeable[known] / screen.allowed[known], initial=0.0))


def _examined(claimed: _Claimed, screen: Screen, precision: float, scatter: str) -> FunctionCertificate:
    """Compare the entries that a screen suspects, and return the verdict."""
    rows = screen.in_doubt if screen.in_doubt.any() else ~screen.in_doubt
    n, power, entries = len(claimed.function.columns), _power(screen), tuple[Entry, ...]()
    for columns in _suspects(screen):
        for block in claimed.blocks(columns, rows):
            compared = _compared(claimed.function, block, columns, precision)
            entries = _wrong(compared)
            power = max(power, float(np.max(compared.tolerance / compared.size, initial=0.0)))
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
            halves = np.array_split(group, 2)
            single, groups = (single, groups + halves) if len(group) > 1 else ([*single, int(group[0])], groups)
    if single:
        yield sorted(single)


Block = tuple[Callable[[Array], Array], Array, tuple[str, ...]]  # values (K, m) -> (K, r), slopes (r, columns), names


def _compared(function: _Function, block: Block, columns: list[int], precision: float) -> Certificate:
    """Compare the slopes of a block with differences, entry by entry."""
    project, slopes, names = block
    stretch = OPTIONS.stretch if precision > OPTIONS.double else 1.0
    point = function.point[columns] / (stretch * function.scale[columns])
    size = np.abs(project(function.values(np.zeros((1, len(function.point)))))[0])
    unsolved = OPTIONS.unsolved * precision * (size + np.abs(slopes) @ np.abs(function.point / function.scale)[columns])

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
        scale=stretch * function.scale[columns],
        stopped=function.solver_tolerance,
        unsolved=unsolved if precision > EPS else 0.0,
        point=point,
        method="given",
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
    """Return the function with results that NumPy can read: tensors of PyTorch and arrays of Warp are converted."""

    @wraps(function)
    def converted(*arguments: Any) -> Any:
        return _readable(function(*arguments))

    return converted


def _readable(result: Any) -> Any:
    for method in ("detach", "cpu", "numpy"):
        result = getattr(result, method)() if hasattr(result, method) else result
    return result


class _Function:
    """A user's function of scaled displacements (K, n) from the point, with values (K, m). `calls` are counted."""

    def __init__(self, f: Any, x: ArrayLike, scales: ArrayLike | None, solver_tolerance: float):
        if not callable(f):
            raise InputError("f", got=f"{f!r:.80}", expected="a function")
        self.f, self._plain, given = f, _plain(f), np.asarray(_readable(x))
        self.solver_tolerance = solver_tolerance
        self.shape, self.calls = given.shape, 0
        self.type = given.dtype if given.dtype.kind == "f" else np.dtype(float)
        self.point = finite_array("x", given, given.shape).ravel()
        self.scale = np.maximum(1.0, np.abs(self.point))
        if scales is not None:
            scale = finite_array("scales", scales, self.shape if np.ndim(scales) else ())
            if np.any(scale <= 0):
                raise InputError("scales", got=f"{np.min(scale):g}", expected="numbers above 0")
            self.scale = np.broadcast_to(scale, self.shape).ravel()
        value = np.asarray(self._at(self.point))
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

    def _at(self, point: Array) -> Any:
        self.calls += 1
        return called("f", self._plain, self.given(point))

    def values(self, displacements: Array) -> Array:
        """Return the values (K, m) at displacements (K, n)."""
        values = [np.asarray(self._at(self.point + self.scale * d), dtype=float) for d in displacements]
        for value in values:
            if value.shape != self.value_shape:
                raise ShapeError("f(x)", got=value.shape, expected=self.value_shape)
        return np.array(values).reshape(len(values), -1)


def _names(letter: str, shape: tuple[int, ...]) -> tuple[str, ...]:
    return tuple(letter + str(list(index)) if index else letter for index in np.ndindex(shape))


class _Claimed:
    """A Jacobian `matrix` (m, n) by scaled displacements. `calls` counts calls of the user's derivative."""

    def __init__(self, function: _Function, given: Any):
        self.function, self._given, self.calls = function, given, 0
        shapes = (len(function.rows), len(function.columns)), function.value_shape + function.shape
        matrix = self._ask("jacobian", function.given(function.point)) if callable(given) else _readable(given)
        shape = np.shape(matrix)
        if shape not in shapes:
            raise ShapeError("jacobian", got=shape, expected=shapes[0])
        self.matrix = finite_array("jacobian", matrix, shape).reshape(shapes[0]) * function.scale

    def _ask(self, name: str, *arguments: Any, shape: tuple[int, ...] | None = None) -> Array:
        self.calls += 1
        result = called(name, _plain(self._given), *arguments, shape=shape)
        return finite_array(f"{name}(x)", np.asarray(result), np.shape(result))

    def screen(self, precision: float) -> Screen:
        """Screen the derivative, for values of this relative precision."""
        least = least_size(np.abs(self.matrix).max(axis=1), self.function.value, precision)
        claim = Claim.of_matrix(self.matrix, least=least[:, None], still=1.0)
        return Screen(claim, self.function.values, precision=precision)

    def blocks(self, columns: list[int], rows: Flags) -> Iterator[Block]:
        """Yield the slopes of values along `columns`, to compare them entry by entry. `rows` (m,) are in doubt."""
        yield self._block(self.matrix[:, columns], np.flatnonzero(rows))

    def _block(self, slopes: Array, rows: Indices) -> Block:
        return lambda values: values[:, rows], slopes[rows], tuple(self.function.rows[i] for i in rows)


class _ByProducts(_Claimed):
    """A Jacobian that is known by its products J v."""

    def __init__(self, function: _Function, given: Any):
        self.function, self._given, self.calls = function, given, 0
        self._known: dict[bytes, Array] = {}

    def _along(self, directions: Array) -> Array:
        return np.array([self._product(d) for d in directions]).reshape(len(directions), -1)

    def _product(self, direction: Array) -> Array:
        key, function = direction.tobytes(), self.function
        if key not in self._known:
            point, tangent = (function.given(v) for v in (function.point, function.scale * direction))
            self._known[key] = self._ask("jvp", point, tangent, shape=function.value_shape).ravel()
        return self._known[key]

    def screen(self, precision: float) -> Screen:
        n = len(self.function.columns)
        norm = np.sqrt((self._along(normals(n)) ** 2).mean(axis=0))  # about that of each row
        size = least_size(norm, self.function.value, precision)
        claim = Claim(self._along, np.ones(n), LIMITS.power * size, np.sqrt(n) * norm, size[:, None])
        return Screen(claim, self.function.values, precision=precision)

    def blocks(self, columns: list[int], rows: Flags) -> Iterator[Block]:
        units = np.eye(len(self.function.columns))[columns]
        yield self._block(self._along(units).T, np.flatnonzero(rows))


class _ByTransposedProducts(_Claimed):
    """A Jacobian that is known by its products w J, compared as that of a few random combinations of the values."""

    def __init__(self, function: _Function, given: Any):
        self.function, self._given, self.calls = function, given, 0
        m, n = len(function.rows), len(function.columns)
        self._mixed = np.eye(m)
        if m > OPTIONS.rows and n:
            self._mixed = normals(m) / self._sizes()
        self.matrix = self._rows(self._mixed)

    def _sizes(self) -> Array:
        """Return (m,) the slopes of the values along a line, which balance their combinations."""
        width = 10.0 ** (-first_power(self.function.precision) / 2)
        ends = self.function.values(width * normals(len(self.function.columns))[:2])
        sizes = np.abs(ends - self.function.value).max(axis=0) / width
        return np.maximum(sizes, SCREEN.flat * np.max(sizes, initial=0.0)) + float(not np.any(sizes))

    def _rows(self, cotangents: Array) -> Array:
        """Return the products (k, n) of cotangents (k, m) and the Jacobian, by scaled displacements."""
        function, shape = self.function, self.function.value_shape
        point, rows = function.given(function.point), []
        for w in cotangents:
            cotangent = w.astype(function.value_type).reshape(shape)
            product = self._ask("vjp", point, cotangent if shape else cotangent[()], shape=function.shape)
            rows.append(product.ravel() * function.scale)
        return np.array(rows).reshape(len(cotangents), -1)

    def _mix(self, values: Array) -> Array:
        return values @ self._mixed.T

    def screen(self, precision: float) -> Screen:
        if len(self._mixed) == len(self.function.rows):
            return super().screen(precision)
        a, values = self.matrix, np.abs(self._mixed) @ np.abs(self.function.value)
        size = least_size(np.abs(a).max(axis=1), values, precision)  # an entry is a small part of a combination's
        claim = Claim(lambda z: z @ a.T, np.ones(a.shape[1]), LIMITS.power * size, np.abs(a).sum(axis=1), size[:, None])
        return Screen(claim, lambda d: self._mix(self.function.values(d)), precision=precision)

    def blocks(self, columns: list[int], rows: Flags) -> Iterator[Block]:
        """Yield the rows that the gaps of the combinations point to, then the combinations themselves."""
        m = len(self.function.rows)
        if len(self._mixed) == m:
            yield from super().blocks(columns, rows)
            return
        slopes, suspects = np.zeros((m, len(columns))), self._suspected_rows(columns)
        slopes[suspects] = self._rows(np.eye(m)[suspects])[:, columns]
        yield self._block(slopes, suspects)
        yield self._mix, self.matrix[:, columns], tuple(f"combination {k} of f" for k in range(len(self._mixed)))

    def _suspected_rows(self, columns: list[int]) -> Indices:
        """Return the rows whose parts in the combinations are most like the gaps, two for each column."""
        function = self.function
        power = first_power(function.precision)
        widths = 10.0 ** (-np.array([power - 1, power]) / 2)
        units = np.eye(len(function.columns))[columns]
        ends = function.values(np.vstack([side * w * units for w in widths for side in (1.0, -1.0)]))
        ahead, behind = ends.reshape(2, 2, len(columns), -1).swapaxes(0, 1)
        slopes = richardson((ahead - behind) / (2 * widths[:, None, None]))[0]  # (columns, m)
        gap = self.matrix[:, columns] - self._mix(slopes).T  # (k, columns)
        alike = np.abs(self._mixed.T @ gap) / np.linalg.norm(self._mixed, axis=0)[:, None]
        return np.unique(np.argsort(-alike, axis=0)[:2])


_KINDS = {"jacobian": _Claimed, "jvp": _ByProducts, "vjp": _ByTransposedProducts}
