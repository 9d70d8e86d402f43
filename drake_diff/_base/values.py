"""Results: how they pickle, show in Jupyter, and say that what was asked for is not possible."""

import math
import pickle
from contextvars import ContextVar
from dataclasses import dataclass, fields
from html import escape
from typing import Any, TypeVar

import cloudpickle

from drake_diff.exceptions import DrakeDiffError, InputError

Made = TypeVar("Made")
INSIDE: ContextVar[bool] = ContextVar("INSIDE", default=False)  # something that is being pickled


class PicklesItsFields:
    """A dataclass that pickles by its fields; what is computed when it is first asked for is computed again.

    Functions go along whatever they are. Raises InputError where a field cannot, with its name.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        values = {f.name: getattr(self, f.name) for f in fields(self)}  # type: ignore[arg-type]
        if INSIDE.get():  # once for all, so that what two parts share is one thing afterwards too
            return _empty, (type(self),), values
        token = INSIDE.set(True)
        try:
            return pickle.loads, (cloudpickle.dumps(self),)
        except DrakeDiffError:
            raise
        except Exception as error:  # whatever a user's object raises
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
    """Lists and dicts for JSON, which has no infinity: None."""
    if isinstance(value, dict):
        return {key: plain_numbers(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain_numbers(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


BETWEEN_WORDS = "white-space: pre-wrap; word-break: normal; overflow-wrap: anywhere"  # JupyterLab breaks inside them


def preformatted(text: str) -> str:
    """`text` as HTML, line by line as it is; what is too long for the page goes on in the next line."""
    return f'<pre style="{BETWEEN_WORDS}">{escape(text)}</pre>'


class ShowsItsRepr:
    """Shows in Jupyter what `repr` gives."""

    def _repr_html_(self) -> str:
        return preformatted(repr(self))


@dataclass(frozen=True)
class Refusal:
    """Returned in place of a result that cannot be had; the caller takes another way and can say why.

    A function that may refuse returns `Result | Refusal`, and its caller asks `isinstance(found, Refusal)`.
    """

    reason: str  # a sentence without its full stop: "joint elbow is of type planar"

    def __str__(self) -> str:
        return self.reason
