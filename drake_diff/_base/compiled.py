"""Functions that Numba compiles where it is installed (the extra `fast`); who calls them has a NumPy form of the same.

A module of such functions is loaded through `kernel`, when it is first needed: Numba takes 0.4 s to import, and
compiles once on a machine, after which the result is read from the cache beside the module.
"""

import sys
import time
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeVar, cast

from drake_diff._base.clock import uncounted

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """The function, of numbers and arrays alone, compiled; a division by zero gives what NumPy's does."""
    from numba import njit

    time_compilations()
    return cast(Function, njit(cache=True, error_model="numpy")(function))


def inner(function: Function) -> Function:
    """As `compiled`, of a function that compiled functions alone call: a shell for Python takes longest to compile."""
    from numba import njit

    return cast(Function, njit(error_model="numpy", no_cpython_wrapper=True, no_cfunc_wrapper=True)(function))


@cache
def time_compilations() -> None:
    """From now on tell the clock that limits go by how long Numba compiles."""
    from numba.core import event

    class Timer(event.Listener):  # type: ignore[misc]  # Numba has no types
        def __init__(self) -> None:
            self.depth, self.start = 0, 0.0

        def on_start(self, _: Any) -> None:
            if self.depth == 0:
                self.start = time.monotonic()
            self.depth += 1

        def on_end(self, _: Any) -> None:
            self.depth -= 1
            if self.depth == 0:
                uncounted(time.monotonic() - self.start)

    event.register("numba:compile", Timer())


@cache
def has_numba() -> bool:
    """Whether Numba is installed."""
    return find_spec("numba") is not None


def kernel(module: str) -> Any:
    """The module of compiled functions; None where Numba is not installed."""
    return (sys.modules.get(module) or import_module(module)) if has_numba() else None
