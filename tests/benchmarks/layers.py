"""Where drake_diff's own time goes: Drake's C++ with its bindings, conversions of arrays, and our Python.

Every method of the classes of pydrake's plants, trees, systems and geometry, and every function in CONVERSIONS, gets a
clock for the time of the measurement; the rest is our Python, with NumPy's work in it and the making of Drake's
objects. The clocks cost time themselves: `clocks` says by which factor the call is slower with them.
"""

import inspect
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import wraps
from typing import Any

import pydrake.autodiffutils
import pydrake.geometry
import pydrake.multibody.plant
import pydrake.multibody.tree
import pydrake.systems.framework
from cases import Case
from peers import DrakeDiff

from drake_diff._base.arrays import finite_array, frozen
from drake_diff._base.autodiff import gradient_rows, plain

CLASSES_OF = (
    pydrake.multibody.plant,
    pydrake.multibody.tree,
    pydrake.systems.framework,
    pydrake.geometry,
)
CONVERSIONS = (
    pydrake.autodiffutils.InitializeAutoDiff,
    pydrake.autodiffutils.ExtractGradient,
    pydrake.autodiffutils.ExtractValue,
    gradient_rows,
    plain,
    finite_array,
    frozen,
)
DRAKE, ARRAYS, OURS = "Drake", "conversions", "our Python"
CALLS, REPEATS = 5, 15  # short blocks, of which a busy machine disturbs few


@dataclass(frozen=True)
class Layers:
    """Seconds a call of each layer, medians; `clocks` is the time with them over the time without, in turns."""

    model: str
    quantity: str
    horizon: int | None
    seconds: dict[str, float]
    clocks: float


class Clock:
    """Time in one layer at a time: a call into another stops the one that it came from."""

    def __init__(self) -> None:
        self.layer, self.since = OURS, time.perf_counter()
        self.seconds = dict.fromkeys((DRAKE, ARRAYS, OURS), 0.0)

    def enter(self, layer: str) -> str:
        now, before = time.perf_counter(), self.layer
        self.seconds[before] += now - self.since
        self.layer, self.since = layer, now
        return before

    def on(self, function: Callable[..., Any], layer: str) -> Callable[..., Any]:
        """The function, its time counted for the layer."""

        @wraps(function)
        def timed(*args: Any, **kwargs: Any) -> Any:
            before = self.enter(layer)
            try:
                return function(*args, **kwargs)
            finally:
                self.enter(before)

        return timed


def layers(case: Case, quantity: str, horizon: int) -> Layers:
    """Of drake_diff's call for the quantity."""
    call = DrakeDiff(case).call(quantity, horizon)
    count = CALLS if quantity in ("step", "step_jacobian") else 1
    call()
    clock, plain, found = Clock(), [], []
    for _ in range(REPEATS):
        _split(call, count, clock)  # Python's caches of what was patched are filled anew
        plain.append(sum(_split(call, count, clock).values()))
        with clocked(clock):
            _split(call, count, clock)
            found.append(_split(call, count, clock))
    seconds = {layer: statistics.median(one[layer] for one in found) for layer in clock.seconds}
    clocks = statistics.median(sum(one.values()) / without for one, without in zip(found, plain, strict=True))
    return Layers(case.name, quantity, horizon or None, seconds, clocks)


def _split(call: Callable[[], Any], count: int, clock: Clock) -> dict[str, float]:
    clock.enter(OURS)
    clock.seconds = dict.fromkeys(clock.seconds, 0.0)
    for _ in range(count):
        call()
    clock.enter(OURS)
    return {layer: seconds / count for layer, seconds in clock.seconds.items()}


@contextmanager
def clocked(clock: Clock) -> Iterator[None]:
    """Clocks on Drake's methods and on the conversions, taken off at the end."""
    with ExitStack() as undo:
        for owner, name, function, layer in [*_drakes_methods(), *_conversions()]:
            setattr(owner, name, clock.on(function, layer))
            undo.callback(setattr, owner, name, function)
        yield


def _drakes_methods() -> Iterator[tuple[type, str, Any, str]]:
    classes = {c for module in CLASSES_OF for c in vars(module).values() if inspect.isclass(c)}
    for kind in {base for c in classes for base in c.__mro__}:
        if not kind.__module__.startswith("pydrake"):
            continue
        for name, value in list(vars(kind).items()):
            plain = not isinstance(value, staticmethod | classmethod | property) and callable(value)
            if plain and not name.startswith("__") and not inspect.isclass(value):
                yield kind, name, value, DRAKE


def _conversions() -> Iterator[tuple[Any, str, Any, str]]:
    for module in [m for n, m in sys.modules.items() if n.startswith("drake_diff")]:
        for name, value in list(vars(module).items()):
            if any(value is function for function in CONVERSIONS):
                yield module, name, value, ARRAYS
