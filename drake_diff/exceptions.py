"""The errors that drake_diff raises deliberately.

DrakeDiffError
├── InputError (ValueError)        an invalid argument; the message states what was expected and what was given
│   ├── ShapeError                 an array of the wrong shape
│   ├── NonFiniteError             NaN or infinity where a finite number is needed
│   └── UnknownNameError           an unknown joint, parameter, solver, ...; the message lists the known names
├── ModelError                     a file or diagram that cannot be used as a robot model
├── GradientError                  a derivative that must not be used
├── CertificateError               a certificate whose verdict is not "agree", or a check before an export
├── SimulationError                Drake failed to take a step
├── MissingDependencyError         an optional engine or solver is not installed; the message says what to install
├── NotOfferedError                a quantity that an engine does not compute
├── ArtifactError                  a run directory or log that is missing, incomplete or damaged
└── WriteError (OSError)           a file could not be written; the message says where partial results are

ModelWarning (UserWarning)         parts of a model file were ignored

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

LISTED = 24  # maximum number of names in a message


class DrakeDiffError(Exception):
    """The base class. All errors can be pickled: a process pool hangs if a worker raises one that cannot be pickled."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _again, (type(self), self.args), {name: _picklable(value) for name, value in vars(self).items()}


def _again(kind: type[DrakeDiffError], args: tuple[Any, ...]) -> DrakeDiffError:
    """Recreate an error from its message without calling `__init__`, which takes other arguments."""
    error = kind.__new__(kind, *args)
    error.args = args
    return error


def _picklable(value: Any) -> Any:
    """Return `value`, or its repr if it cannot be pickled and unpickled."""
    try:
        pickle.loads(pickle.dumps(value))
    except Exception:
        return repr(value)
    return value


class InputError(DrakeDiffError, ValueError):
    """An invalid argument, found before any computation; `subject`, `expected` and `got` are attributes."""

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
    """An unknown name; the message lists the most similar known names and suggests the best match."""

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
    """A derivative that must not be used: it is not finite, or its value differs from the simulator's."""


class CertificateError(DrakeDiffError):
    """A certificate whose verdict is not "agree", or a check that must hold before anything is exported."""


class SimulationError(DrakeDiffError):
    """Drake failed to take a step."""


class MissingDependencyError(DrakeDiffError):
    """An optional engine or solver is not installed."""


class NotOfferedError(DrakeDiffError):
    """A quantity that an engine does not compute, such as a gradient, a mass matrix or an energy."""


class ArtifactError(DrakeDiffError):
    """A run directory or log that is missing, incomplete or damaged."""


class WriteError(DrakeDiffError, OSError):
    """A file could not be written, for example on a full disk; `kept` is the folder with the partial run."""

    kept: Path | None = None


class ModelWarning(UserWarning):
    """Part of a model file was ignored, and the model was loaded without it."""


class GradientWarning(UserWarning):
    """A derivative that does not describe the function even a small distance away from the point."""
