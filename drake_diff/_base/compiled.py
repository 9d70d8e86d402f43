"""Functions that Numba compiles where it is installed (the extra `fast`); who calls them has a NumPy form of the same.

A module of such functions is loaded through `kernel`, when it is first needed: Numba takes 0.4 s to import, and
compiles once on a machine, after which the result is read from the cache beside the module.
"""

import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeVar, cast

Function = TypeVar("Function", bound=Callable[..., Any])


def compiled(function: Function) -> Function:
    """The function, of numbers and arrays alone, compiled; a division by zero gives what NumPy's does."""
    from numba import njit

    return cast(Function, njit(cache=True, error_model="numpy")(function))


@cache
def has_numba() -> bool:
    """Whether Numba is installed."""
    return find_spec("numba") is not None


def kernel(module: str) -> Any:
    """The module of compiled functions; None where Numba is not installed."""
    return (sys.modules.get(module) or import_module(module)) if has_numba() else None
