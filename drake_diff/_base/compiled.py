"""Functions that Numba compiles on the first call on a machine and afterwards loads from a cache.

The cache is in `__pycache__` next to the module. If that folder is not writable, as in a read-only installation, the
cache is in `NUMBA_CACHE_DIR` or in Numba's folder in the home directory. If there is no writable folder, each process
compiles. A compilation longer than `NOTICED` is logged to the logger "drake_diff".
"""

import logging
import os
import signal
import sys
import time
from collections.abc import Callable
from functools import cache
from hashlib import sha256
from importlib import import_module
from typing import Any, TypeVar, cast

from drake_diff._base.clock import uncounted
from drake_diff.exceptions import InputError

NOTICED = 1.0  # [s]
NUMBA_SETTINGS = ".numba_config.yaml"
LOGGER = logging.getLogger("drake_diff")
Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """Compile a function of numbers and arrays; a division by zero gives the result of NumPy."""
    njit = import_numba().njit
    time_compilations()
    try:
        dispatcher = njit(cache=True, error_model="numpy")(function)
    except RuntimeError:  # Numba finds no folder for a cache
        return cast(Function, njit(error_model="numpy")(function))
    separate_versions(dispatcher._cache._cache_file)
    return cast(Function, dispatcher)


def separate_versions(cached: Any) -> None:
    """Give each version of Numba and of the source its own cache files, and ignore an index that cannot be read.

    With common files, a process that starts while another one writes them may load code of the other version, as Numba
    writes the index first. The index cannot be read if it names a class that was renamed.
    """
    version = sha256(repr((cached._version, cached._source_stamp)).encode()).hexdigest()[:12]
    cached._index_path = cached._index_path.removesuffix(".nbi") + f"-{version}.nbi"
    cached._data_name_pattern = cached._data_name_pattern.replace(".{number", f"-{version}.{{number")
    load_index = cached._load_index

    def read() -> Any:
        try:
            return load_index()
        except (AttributeError, ImportError):
            return {}

    cached._load_index = read


def inner(function: Function) -> Function:
    """Compile a function that only compiled functions call; skip the Python wrapper, whose compilation is slowest."""
    return cast(
        Function, import_numba().njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)
    )


def import_numba() -> Any:
    """Import Numba without its settings file in the working directory, which may set where Numba loads code from."""
    if "numba" not in sys.modules:
        if os.path.lexists(NUMBA_SETTINGS):
            raise InputError(
                NUMBA_SETTINGS,
                got="a file in the working directory",
                expected="no such file, as it can make Numba run foreign code; use NUMBA_ environment variables",
            )
        from numba.core import config

        config._config_fname = os.devnull  # Numba reads the file before each compilation
    import numba

    return numba


@cache
def time_compilations() -> None:
    """Exclude Numba's compilation from all time limits from now on, and log its duration."""
    from numba.core import event

    class Timer(event.Listener):  # type: ignore[misc]  # Numba has no types
        def __init__(self) -> None:
            self.depth, self.start, self.alarm = 0, 0.0, 0.0

        def on_start(self, _: Any) -> None:
            if self.depth == 0:
                self.start = time.monotonic()
                self.alarm, _ = signal.setitimer(signal.ITIMER_REAL, 0)  # a time limit of the process, see `sandbox`
            self.depth += 1

        def on_end(self, given: Any) -> None:
            self.depth -= 1
            if self.depth == 0:
                seconds = time.monotonic() - self.start
                uncounted(seconds)
                signal.setitimer(signal.ITIMER_REAL, self.alarm)
                report_compilation(getattr((given.data or {}).get("dispatcher"), "__name__", "a function"), seconds)

    event.register("numba:compile", Timer())


def report_compilation(name: str, seconds: float) -> None:
    """Log the compilation of a function if it took longer than `NOTICED`."""
    if seconds >= NOTICED:
        LOGGER.warning("Numba compiled %s in %.1f s, once on this machine", name, seconds)


def kernel(module: str) -> Any:
    """Return a module of compiled functions, and import it on first use."""
    return sys.modules.get(module) or import_module(module)
