"""The gradient of a scalar function of whole arrays, in one pass forward and one back.

A loss of a motion has as many variables as the motion has numbers, so that AutoDiffXd, which carries a derivative by
each with every number, takes time that grows with the square of the motion's length. Here the function is run once on
`Traced` arrays, which note what is done to them: NumPy's arithmetic, elementwise functions, products, sums and views,
each with its derivative. What is not known here, or would lose the derivative, raises Untraceable.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from drake_diff._base.arrays import Array

Pull = Callable[[Array], Array]  # from the gradient by a result to that by one of what it was made of


class UntraceableError(Exception):
    """Something was done to a traced array of which no derivative is known here."""


def traced_gradient(f: Callable[..., Any], arrays: Sequence[Array]) -> tuple[float, list[Array]]:
    """The scalar f(*arrays) and its gradient by each of the arrays.

    Raises UntraceableError where f does what is not known here; what else it raises it may raise for that reason.
    """
    begin = [Traced(np.array(array, dtype=float), ()) for array in arrays]
    result = f(*begin)
    if isinstance(result, np.ndarray) and result.size == 1:
        result = result.item()
    if not isinstance(result, Traced) or result.value.size != 1:
        raise UntraceableError("the result is no traced scalar")
    sums = _Sums()
    sums.add(result, np.ones(result.value.shape))
    for node in reversed(_in_order(result)):
        if node.parents:
            gradient = sums.take(node)
            for parent, pull in node.parents:
                if isinstance(pull, _Part):
                    sums.add_part(parent, pull, gradient)
                else:
                    sums.add(parent, pull(gradient))
    return float(result.value.item()), [sums.take(node) for node in begin]


class _Part:
    """What was taken of an array: its gradient goes where it came from, without one of the whole for each."""

    def __init__(self, key: Any):
        self.key = key
        parts = key if isinstance(key, tuple) else (key,)
        self.is_basic = all(isinstance(part, int | np.integer | slice | None) or part is Ellipsis for part in parts)


class _Sums:
    """The gradients by what was made, so far; those that are ours may be added to in place."""

    def __init__(self) -> None:
        self._found: dict[int, Array] = {}
        self._ours: set[int] = set()

    def add(self, node: "Traced", gradient: Array) -> None:
        at, known = id(node), self._found.get(id(node))
        if known is None:
            self._found[at] = gradient
        elif at in self._ours:
            known += gradient
        else:
            self._found[at] = known + gradient
            self._ours.add(at)

    def add_part(self, node: "Traced", part: _Part, gradient: Array) -> None:
        at = id(node)
        if at not in self._ours:
            self._found[at] = np.array(np.broadcast_to(self._found.get(at, 0.0), node.value.shape), dtype=float)
            self._ours.add(at)
        if part.is_basic:
            self._found[at][part.key] += gradient
        else:
            np.add.at(self._found[at], part.key, gradient)

    def take(self, node: "Traced") -> Array:
        return self._found.pop(id(node), np.zeros(node.value.shape))


def _in_order(result: "Traced") -> "list[Traced]":
    """Everything that `result` was made of, each after what it was made of itself."""
    order: list[Traced] = []
    seen: set[int] = set()
    open_: list[tuple[Traced, bool]] = [(result, False)]
    while open_:
        node, done = open_.pop()
        if done:
            order.append(node)
        elif id(node) not in seen:
            seen.add(id(node))
            open_.append((node, True))
            open_ += [(parent, False) for parent, _ in node.parents]
    return order


class Traced(NDArrayOperatorsMixin):
    """An array, and what it was made of."""

    __array_priority__ = 100.0

    def __init__(self, value: Array, parents: tuple[tuple["Traced", "Pull | _Part"], ...]):
        self.value, self.parents = value, parents

    shape = property(lambda self: self.value.shape)
    ndim = property(lambda self: self.value.ndim)
    size = property(lambda self: self.value.size)
    T = property(lambda self: np.transpose(self))
    __hash__ = None  # type: ignore[assignment]

    def __len__(self) -> int:
        return len(self.value)

    def __getitem__(self, key: Any) -> "Traced":
        return Traced(np.asarray(self.value[key]), ((self, _Part(key)),))

    def __iter__(self) -> Any:
        return (self[k] for k in range(len(self)))

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        if ufunc in _COMPARISONS and method == "__call__" and not options:
            return ufunc(*(_plain(x) for x in inputs))
        if method != "__call__" or options or ufunc not in _UFUNCS:
            raise UntraceableError(f"{ufunc.__name__}.{method} of {', '.join(options) or 'arrays'}")
        return _UFUNCS[ufunc](*inputs)

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> Any:
        if function not in _FUNCTIONS:
            raise UntraceableError(f"{function.__name__}")
        return _FUNCTIONS[function](*args, **options)

    def sum(self, axis: Any = None, keepdims: bool = False) -> "Traced":
        return _sum(self, axis, keepdims)

    def mean(self, axis: Any = None, keepdims: bool = False) -> "Traced":
        return _mean(self, axis, keepdims)

    def dot(self, other: Any) -> "Traced":
        return _dot(self, other)

    def reshape(self, *shape: Any) -> "Traced":
        return _reshape(self, shape[0] if len(shape) == 1 else shape)

    def ravel(self) -> "Traced":
        return _reshape(self, -1)

    flatten = ravel

    def transpose(self) -> "Traced":
        return _transpose(self)

    def copy(self) -> "Traced":
        return self

    def _refused(self, *_: Any, **__: Any) -> Any:
        raise UntraceableError("an assignment, or a plain number")

    __array__ = __float__ = __int__ = __index__ = __bool__ = __complex__ = __setitem__ = _refused
    __iadd__ = __isub__ = __imul__ = __itruediv__ = __ipow__ = __imatmul__ = _refused


def _plain(x: Any) -> Any:
    return x.value if isinstance(x, Traced) else x


def _shrunk(gradient: Array, shape: tuple[int, ...]) -> Array:
    """The gradient by what was broadcast from `shape`."""
    extra = gradient.ndim - len(shape)
    if extra:
        gradient = gradient.sum(axis=tuple(range(extra)))
    wide = tuple(k for k, n in enumerate(shape) if n == 1 and gradient.shape[k] != 1)
    return gradient.sum(axis=wide, keepdims=True) if wide else gradient


def _made(value: Any, *parts: tuple[Any, Pull]) -> Traced:
    """A result and how its gradient goes on to those of the parts that are traced."""
    return Traced(np.asarray(value), tuple((x, pull) for x, pull in parts if isinstance(x, Traced)))


def _two(value: Callable[[Any, Any], Any], by_a: Any, by_b: Any) -> Callable[..., Traced]:
    """An elementwise function of two, whose derivatives are by_a(a, b, result) and by_b(a, b, result)."""

    def call(a: Any, b: Any) -> Traced:
        x, y = (np.asarray(_plain(z), dtype=float) for z in (a, b))
        found = value(x, y)
        return _made(
            found,
            (a, lambda g: _shrunk(np.asarray(g * by_a(x, y, found)), x.shape)),
            (b, lambda g: _shrunk(np.asarray(g * by_b(x, y, found)), y.shape)),
        )

    return call


def _one(value: Callable[[Any], Any], by: Callable[[Any, Any], Any]) -> Callable[..., Traced]:
    """An elementwise function of one, whose derivative is by(a, result)."""

    def call(a: Any) -> Traced:
        found = value(a.value)
        return _made(found, (a, lambda g: np.asarray(g * by(a.value, found))))

    return call


def _power(a: Any, b: Any) -> Traced:
    if isinstance(b, Traced):
        raise UntraceableError("an exponent that is traced")
    return _two(np.power, lambda x, y, r: y * x ** (y - 1), lambda x, y, r: 0.0)(a, b)


def _matmul(a: Any, b: Any) -> Traced:
    x, y = (np.asarray(_plain(z), dtype=float) for z in (a, b))
    if x.ndim == 0 or y.ndim == 0:
        raise UntraceableError("a product of scalars by @")
    rows, columns = x.reshape(1, -1) if x.ndim == 1 else x, y.reshape(-1, 1) if y.ndim == 1 else y
    found = x @ y

    def whole(g: Array) -> Array:
        return g.reshape(*np.broadcast_shapes(rows.shape[:-2], columns.shape[:-2]), rows.shape[-2], columns.shape[-1])

    return _made(
        found,
        (a, lambda g: _shrunk(whole(g) @ np.swapaxes(columns, -1, -2), rows.shape).reshape(x.shape)),
        (b, lambda g: _shrunk(np.swapaxes(rows, -1, -2) @ whole(g), columns.shape).reshape(y.shape)),
    )


def _dot(a: Any, b: Any) -> Traced:
    if np.ndim(_plain(a)) == 0 or np.ndim(_plain(b)) == 0:
        return _UFUNCS[np.multiply](a, b)
    if np.ndim(_plain(b)) > 2:
        raise UntraceableError("dot with more than two dimensions")
    return _matmul(a, b)


def _sum(a: Any, axis: Any = None, keepdims: bool = False) -> Traced:
    shape = a.value.shape

    def pull(g: Array) -> Array:
        if axis is not None and not keepdims:
            g = np.expand_dims(g, axis)
        return np.broadcast_to(g, shape)

    return _made(a.value.sum(axis=axis, keepdims=keepdims), (a, pull))


def _mean(a: Any, axis: Any = None, keepdims: bool = False) -> Traced:
    total = _sum(a, axis, keepdims)
    return _UFUNCS[np.multiply](total, total.value.size / a.value.size)


def _reshape(a: Any, shape: Any) -> Traced:
    return _made(np.reshape(a.value, shape), (a, lambda g: g.reshape(a.value.shape)))


def _transpose(a: Any) -> Traced:
    return _made(a.value.T, (a, lambda g: g.T))


def _concatenate(parts: Sequence[Any], axis: int = 0) -> Traced:
    plain = [np.asarray(_plain(x), dtype=float) for x in parts]
    ends = np.cumsum([x.shape[axis] for x in plain])[:-1]

    def pull(k: int) -> Pull:
        return lambda g: np.split(g, ends, axis=axis)[k]

    return _made(np.concatenate(plain, axis=axis), *((x, pull(k)) for k, x in enumerate(parts)))


def _stack(parts: Sequence[Any], axis: int = 0) -> Traced:
    plain = [np.asarray(_plain(x), dtype=float) for x in parts]

    def pull(k: int) -> Pull:
        return lambda g: np.take(g, k, axis=axis)

    return _made(np.stack(plain, axis=axis), *((x, pull(k)) for k, x in enumerate(parts)))


def _norm(a: Any, ord: Any = None, axis: Any = None, keepdims: bool = False) -> Traced:
    if ord not in (None, 2) or (ord == 2 and axis is None and a.ndim > 1) or isinstance(axis, tuple):
        raise UntraceableError("another norm than that of vectors")
    return np.sqrt(_sum(np.square(a), axis, keepdims))  # type: ignore[return-value]


def _where(condition: Any, a: Any, b: Any) -> Traced:
    if isinstance(condition, Traced):
        raise UntraceableError("a condition that is traced")
    choose = _two(
        lambda x, y: np.where(condition, x, y),
        lambda x, y, r: np.where(condition, 1.0, 0.0),
        lambda x, y, r: np.where(condition, 0.0, 1.0),
    )
    return choose(a, b)


def _diff(a: Any, n: int = 1, axis: int = -1) -> Traced:
    if n != 1 or axis not in (0, -1):
        raise UntraceableError("other differences than one after the other along the first or last axis")
    first = axis == 0
    return a[1:] - a[:-1] if first else a[..., 1:] - a[..., :-1]


_COMPARISONS = {np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal, np.isfinite, np.isnan}
_UFUNCS: dict[Any, Callable[..., Traced]] = {
    np.add: _two(np.add, lambda x, y, r: 1.0, lambda x, y, r: np.ones(np.shape(r))),
    np.subtract: _two(np.subtract, lambda x, y, r: 1.0, lambda x, y, r: -1.0),
    np.multiply: _two(np.multiply, lambda x, y, r: y, lambda x, y, r: x),
    np.divide: _two(np.divide, lambda x, y, r: 1 / y, lambda x, y, r: -r / y),
    np.power: _power,
    np.arctan2: _two(np.arctan2, lambda x, y, r: y / (x * x + y * y), lambda x, y, r: -x / (x * x + y * y)),
    np.maximum: _two(np.maximum, lambda x, y, r: 1.0 * (x >= y), lambda x, y, r: 1.0 * (x < y)),
    np.minimum: _two(np.minimum, lambda x, y, r: 1.0 * (x <= y), lambda x, y, r: 1.0 * (x > y)),
    np.matmul: _matmul,
    np.negative: _one(np.negative, lambda x, r: -1.0),
    np.positive: _one(np.positive, lambda x, r: 1.0),
    np.square: _one(np.square, lambda x, r: 2 * x),
    np.absolute: _one(np.absolute, lambda x, r: np.where(x < 0, -1.0, 1.0)),
    np.sqrt: _one(np.sqrt, lambda x, r: 0.5 / r),
    np.exp: _one(np.exp, lambda x, r: r),
    np.log: _one(np.log, lambda x, r: 1 / x),
    np.sin: _one(np.sin, lambda x, r: np.cos(x)),
    np.cos: _one(np.cos, lambda x, r: -np.sin(x)),
    np.tan: _one(np.tan, lambda x, r: 1 + r * r),
    np.arcsin: _one(np.arcsin, lambda x, r: 1 / np.sqrt(1 - x * x)),
    np.arccos: _one(np.arccos, lambda x, r: -1 / np.sqrt(1 - x * x)),
    np.arctan: _one(np.arctan, lambda x, r: 1 / (1 + x * x)),
    np.sinh: _one(np.sinh, lambda x, r: np.cosh(x)),
    np.cosh: _one(np.cosh, lambda x, r: np.sinh(x)),
    np.tanh: _one(np.tanh, lambda x, r: 1 - r * r),
}
_FUNCTIONS: dict[Any, Callable[..., Traced]] = {
    np.sum: _sum,
    np.mean: _mean,
    np.dot: _dot,
    np.reshape: _reshape,
    np.ravel: lambda a: _reshape(a, -1),
    np.transpose: _transpose,
    np.concatenate: _concatenate,
    np.hstack: lambda parts: _concatenate(parts, 0 if np.ndim(_plain(parts[0])) == 1 else 1),
    np.vstack: lambda parts: _concatenate([x if np.ndim(_plain(x)) > 1 else _row(x) for x in parts]),
    np.stack: _stack,
    np.linalg.norm: _norm,
    np.where: _where,
    np.diff: _diff,
    np.shape: lambda a: a.value.shape,
    np.ndim: lambda a: a.value.ndim,
    np.size: lambda a: a.value.size,
}


def _row(x: Any) -> Any:
    return x.reshape(1, -1) if isinstance(x, Traced) else np.reshape(x, (1, -1))
