"""Every error that drake_diff raises on purpose.

DrakeDiffError
├── InputError (ValueError)        what was passed in cannot be right: expected, got
│   ├── ShapeError                 an array of the wrong shape
│   ├── NonFiniteError             NaN or infinity where a number is needed
│   └── UnknownNameError           a joint, parameter, solver, ... that does not exist; lists those that do
├── ModelError                     a file or diagram that cannot be used as a robot model
├── GradientError                  a derivative that must not be used
├── CertificateError               a certificate whose verdict is not "agree", or a check before an export
├── SimulationError                Drake could not take a step
├── MissingDependencyError         an optional engine or solver that is not there; says what to install
├── NotOfferedError                something that an engine does not compute
├── ArtifactError                  a run directory or log that is missing, incomplete or damaged
└── WriteError (OSError)           the disk is full, or does not let a file be written; says what is kept where

ModelWarning (UserWarning)         what was left out of a model that is used all the same

Example:
    >>> dd.step(dd.load_model("models/pendulum.urdf", time_step=0.01), [0.0], [0.0])
    Traceback (most recent call last):
    drake_diff.exceptions.ShapeError: x: expected shape (2,), got shape (1,)
"""

import pickle
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Any

LISTED = 24  # names of a list that a message writes out


class DrakeDiffError(Exception):
    """The root of the tree. All pickle: a pool of processes whose worker raises one that does not waits for ever."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (type(self), self.args), {name: _picklable(value) for name, value in vars(self).items()}


def _again(kind: type[DrakeDiffError], args: tuple[Any, ...]) -> DrakeDiffError:
    """An error with its message; `__init__` would make the message from what it was given."""
    error = kind.__new__(kind, *args)
    error.args = args
    return error


def _picklable(value: Any) -> Any:
    """`value`, or its repr where it cannot be pickled, and read again."""
    try:
        pickle.loads(pickle.dumps(value))
    except Exception:
        return repr(value)
    return value


class InputError(DrakeDiffError, ValueError):
    """Bad input, found before anything ran; `subject`, `expected` and `got` are in the message and kept."""

    def __init__(self, subject: str, *, got: Any, expected: str):
        super().__init__(f"{subject}: expected {expected}, got {got}")
        self.subject, self.got, self.expected = subject, got, expected


class ShapeError(InputError):
    """An array of the wrong shape."""

    def __init__(self, subject: str, *, got: tuple[int, ...], expected: tuple[int | str, ...], because: str = ""):
        shape = "(" + ", ".join(str(n) for n in expected) + ("," if len(expected) == 1 else "") + ")"
        super().__init__(subject, got=f"shape {tuple(got)}{because and f': {because}'}", expected=f"shape {shape}")


class NonFiniteError(InputError):
    """NaN or infinity where a finite number is needed."""

    def __init__(self, subject: str, *, index: tuple[int, ...], got: float):
        super().__init__(f"{subject}{list(index)}", got=got, expected="a finite number")


class UnknownNameError(InputError):
    """A name that does not exist; the message lists the most similar of those that do, and the best guess."""

    def __init__(self, subject: str, *, got: object, known: Iterable[str]):
        names = sorted(map(str, known))
        similar = get_close_matches(str(got), names, n=LISTED)
        listed = names if len(names) <= LISTED else sorted({*similar, *names[: LISTED - len(similar)]})
        more = f" and {len(names) - len(listed)} more" * (len(names) > len(listed))
        guess = f"; did you mean {similar[0]!r}?" if similar else ""
        super().__init__(subject, got=f"{got!r}{guess}", expected=f"one of {', '.join(listed) or '(none)'}{more}")


class ModelError(DrakeDiffError):
    """A file or diagram that cannot be used as a robot model."""


class GradientError(DrakeDiffError):
    """A derivative that must not be used: it is not finite, or its value is not the simulator's."""


class CertificateError(DrakeDiffError):
    """A certificate whose verdict is not "agree", or a check that must hold before anything is exported."""


class SimulationError(DrakeDiffError):
    """Drake could not take a step."""


class MissingDependencyError(DrakeDiffError):
    """An optional engine or solver that is not there."""


class NotOfferedError(DrakeDiffError):
    """Something that an engine does not compute: a gradient, a mass matrix, an energy."""


class ArtifactError(DrakeDiffError):
    """A run directory or log that is missing, incomplete or damaged."""


class WriteError(DrakeDiffError, OSError):
    """The disk is full, or does not let a file be written; `kept` is the folder of what was written of a run."""

    kept: Path | None = None


class ModelWarning(UserWarning):
    """Something of a model file was left out; the model is used all the same."""


class GradientWarning(UserWarning):
    """A derivative at a point that says nothing of what is a little away from it."""
