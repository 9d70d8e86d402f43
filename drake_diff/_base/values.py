"""Base classes of results: pickling, display in Jupyter, and refusals."""

import math
import pickle
from collections.abc import Sequence
from contextvars import ContextVar
from dataclasses import dataclass, fields, replace
from html import escape
from typing import Any, TypeVar

import cloudpickle
import numpy as np

from drake_diff._base.arrays import frozen
from drake_diff.exceptions import DrakeDiffError, InputError

Made = TypeVar("Made")
INSIDE: ContextVar[bool] = ContextVar("INSIDE", default=False)  # an object is being pickled


class PicklesItsFields:
    """A dataclass that is pickled by its fields; cached properties are computed again.

    Functions of any kind can be fields. Raises InputError with the name of a field that cannot be pickled.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        if INSIDE.get():  # pickle all in one pass, so that shared parts stay shared
            return _empty, (type(self),), values
        token = INSIDE.set(True)
        try:
            return pickle.loads, (cloudpickle.dumps(self),)
        except DrakeDiffError:
            raise
        except Exception as error:  # a user's object may raise anything
            for name, value in values.items():
                _check(f"{type(self).__name__}.{name}", value)
            raise InputError(type(self).__name__, got=f"{error}", expected="values that can be pickled") from error
        finally:
            INSIDE.reset(token)

    def __copy__(self: Made) -> Made:
        copy: Made = object.__new__(type(self))
        vars(copy).update(vars(self))
        return copy


def _empty(kind: type[Made]) -> Made:
    return object.__new__(kind)


def _check(name: str, value: Any) -> None:
    try:
        cloudpickle.dumps(value)
    except Exception as error:
        raise InputError(name, got=f"{value!r:.80}: {error}", expected="a value that can be pickled") from error


def plain_numbers(value: Any) -> Any:
    """Convert to lists and dicts for JSON; infinity and NaN become None."""
    if isinstance(value, dict):
        return {key: plain_numbers(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_numbers(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


BETWEEN_WORDS = "white-space: pre-wrap; word-break: normal; overflow-wrap: anywhere"  # JupyterLab breaks inside words


def preformatted(text: str) -> str:
    """Return `text` as HTML that keeps its lines; lines that are too long for the page wrap."""
    return f'<pre style="{BETWEEN_WORDS}">{escape(text)}</pre>'


def stacked(results: Sequence[Made], batch: tuple[int, ...], **others: Any) -> Made:
    """Return dataclasses of equal sizes in one, whose arrays and numbers have the leading dimensions `batch`.

    Fields in `others` have these values; fields of other types are those of the first result.
    """
    first: Any = results[0]
    stacks = {}
    for name in (f.name for f in fields(first)):
        if name not in others and isinstance(getattr(first, name), (float, np.ndarray)):
            values = np.stack([getattr(result, name) for result in results])
            stacks[name] = frozen(values.reshape(*batch, *values.shape[1:]))
    return replace(first, **stacks, **others)


class ShowsItsRepr:
    """A base class whose `repr` is displayed in Jupyter."""

    def _repr_html_(self) -> str:
        return preformatted(repr(self))


@dataclass(frozen=True)
class Refusal:
    """A refusal in place of a result; the caller can use another method and report the reason.

    A function that may refuse returns `Result | Refusal`, and its caller checks `isinstance(found, Refusal)`.
    """

    reason: str  # a sentence without its full stop: "joint elbow is of type planar"

    def __str__(self) -> str:
        return self.reason
