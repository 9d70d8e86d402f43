"""The function that a panel file names, and the row that one call of it gives."""

import importlib
import importlib.util
import os
import random
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from drake_diff.exceptions import InputError

Row = dict[str, Any]
Function = Callable[[dict[str, Any]], Mapping[str, Any]]
# A worker dies when it is killed, runs out of memory, or crashes below Python.
DIED: Row = {"error": "WorkerDied: the process that evaluated this trial died, and so did the one that tried again"}
# A worker has one core: its libraries start no threads of their own.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}


@dataclass(frozen=True)
class TrialFunction:
    """What `evaluate` names: "FILE.py:function", the file beside the panel in `directory`, or "module:function".

    Workers run in the panel's directory, so that relative paths in a panel start from there.
    """

    evaluate: str
    directory: str

    def enter(self) -> Function:
        """The function, loaded, with its panel's directory as the process's own."""
        os.chdir(self.directory)
        return self.load()

    def load(self) -> Function:
        """The function; InputError where there is none."""
        name = self.evaluate.rpartition(":")[2]
        function = getattr(self._module(), name, None)
        if not callable(function):
            raise InputError("evaluate", got=f"{self.evaluate}, which is not one", expected="a function")
        return function

    def sha256(self) -> str | None:
        """The hash of the function's file; what that file imports is not covered."""
        place = self.evaluate.rpartition(":")[0]
        path = Path(self.directory, place) if place.endswith(".py") else getattr(self._module(), "__file__", None)
        return sha256(Path(path).read_bytes()).hexdigest() if path else None

    def _module(self) -> ModuleType:
        place = self.evaluate.rpartition(":")[0]
        try:
            return _from_file(Path(self.directory, place)) if place.endswith(".py") else importlib.import_module(place)
        except Exception as error:
            got = f"{self.evaluate}: {type(error).__name__}: {error}"
            raise InputError("evaluate", got=got, expected="a file or module that can be imported") from error


def _from_file(path: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("drake_diff_trials", path)
    if spec is None or spec.loader is None:
        raise ImportError(f"{path} is not a Python file")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def row_of(function: Function, fields: Mapping[str, Any]) -> Row:
    """What `function` returns for one trial, in JSON's types, or {"error": "Type: message"} where it raises.

    NaN and infinity become None. The global generators of NumPy and Python start from the trial's seed.
    """
    random.seed(fields["seed"])
    np.random.seed(fields["seed"] % 2**32)
    try:
        row = function(dict(fields))
        if not isinstance(row, Mapping):
            raise InputError("row", got=type(row).__name__, expected="a mapping of names to values")
        return {_name(key, fields): _plain(value) for key, value in row.items()}
    except (Exception, SystemExit) as error:  # sys.exit() in a trial ends that trial, not the panel
        return {"error": f"{type(error).__name__}: {error}"}


def _name(key: Any, fields: Mapping[str, Any]) -> str:
    if not isinstance(key, str) or key in fields or key == "id":
        raise InputError("row", got=repr(key), expected="names that are not the trial's own")
    return key


def _plain(value: Any) -> Any:
    """`value` in JSON's types."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, int) and abs(value) < 2**63:
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _plain(item) for key, item in value.items()}
    raise InputError("row", got=f"{type(value).__name__} {value!r:.80}", expected="numbers, words, lists and mappings")
