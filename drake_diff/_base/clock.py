"""Time limits and signals that interrupt nested computations.

A search that receives Ctrl-C, SIGTERM or SIGHUP ends with its best plan. Other computations are interrupted.
"""

import os
import signal
import stat
import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib.machinery import ExtensionFileLoader
from traceback import walk_stack
from types import FrameType
from typing import Any

LONGEST_PIECE = 0.4  # of the time of the pieces before it, measured for CasADi on chains of 20, 50 and 100 joints
DEADLINE: ContextVar[float | None] = ContextVar("DEADLINE", default=None)  # a time of `now`
STOP: ContextVar[threading.Event | None] = ContextVar("STOP", default=None)
_uncounted = 0.0  # [s]
INTERRUPTIONS: list[int] = []  # the signals that `interrupt` handled


def uncounted(seconds: float = 0.0) -> float:
    """Return the total time [s] that no limit counts (Numba compilation) after adding `seconds` to it."""
    global _uncounted
    _uncounted += seconds
    return _uncounted


def now() -> float:
    """Return the time [s] of the monotonic clock without the time that Numba spent compiling; limits use this clock."""
    return time.monotonic() - _uncounted


class TimeIsUpError(Exception):
    """The time limit has passed; the code that set the limit reports the unfinished work."""


class StoppedError(TimeIsUpError):
    """A signal ends the computation in the same way as a time limit."""


@contextmanager
def until(deadline: float) -> Iterator[None]:
    """Make `check_time` raise after `deadline`, a time of `now()`, or after an earlier deadline of an outer block."""
    outer = DEADLINE.get()
    token = DEADLINE.set(deadline if outer is None else min(outer, deadline))
    try:
        yield
    finally:
        DEADLINE.reset(token)


@contextmanager
def until_set(flag: threading.Event) -> Iterator[None]:
    """Make `check_time` raise once `flag` is set, as a signal does; `flag` replaces the flag of an outer block."""
    token = STOP.set(flag)
    try:
        yield
    finally:
        STOP.reset(token)


def check_time(ahead: float = 0.0) -> None:
    """Raise TimeIsUpError if the time is up, or will be up before the next operation, which takes `ahead` [s]."""
    stop, deadline = STOP.get(), DEADLINE.get()
    if stop is not None and stop.is_set():
        raise StoppedError("interrupted")
    if deadline is not None and now() + ahead > deadline:
        raise TimeIsUpError("the time is up")


class Pace:
    """A check of the clock between pieces of work that cannot be interrupted, such as calls of CasADi."""

    def __init__(self) -> None:
        self.start = now()

    def go_on(self) -> None:
        """Raise TimeIsUpError if the next piece may end too late; see LONGEST_PIECE."""
        check_time(ahead=LONGEST_PIECE * (now() - self.start))


INTERRUPTED = 130  # the exit status of shells after Ctrl-C
ALIKE = (signal.SIGTERM, signal.SIGHUP)
AGAIN = 0.05  # [s] delay before a signal that arrives during an import is sent again
# C code or the garbage collector calls these functions; both print an exception and continue.
PRINTS_WHAT_IS_RAISED = {
    *("__del__", "on_disposal", "_object_compiled_hook", "_object_getbuffer_hook"),
    *("_raw_object_cache_notify", "_raw_object_cache_getbuffer"),
}


def interrupt(number: int, frame: FrameType | None) -> None:
    """Raise KeyboardInterrupt for a signal, as Python does at Ctrl-C, or later if an extension is being imported.

    An exception during the import of a C++ extension is printed and ignored, or aborts the process.
    """
    INTERRUPTIONS.append(number)
    _hush(number)
    if frame is not None and _is_imported_in(frame):
        later = threading.Timer(AGAIN, os.kill, (os.getpid(), number))
        later.daemon = True
        later.start()
        return
    raise KeyboardInterrupt


def _is_imported_in(frame: FrameType) -> bool:
    """Return whether an extension is being imported, or the innermost frame belongs to the import system."""
    loaders = (isinstance(caller.f_locals.get("self"), ExtensionFileLoader) for caller, _ in walk_stack(frame))
    return frame.f_globals.get("__name__") == "importlib._bootstrap" or any(loaders)


class _Flag(threading.Event):
    """A signal handler that sets a flag for `check_time`, and interrupts a Numba compilation immediately.

    Numba compiles for seconds, once per machine, and checks no flag. A partial compilation is discarded.
    """

    def __call__(self, number: int, frame: FrameType | None) -> None:
        _hush(number)
        self.set()
        names, compiles = set(), False
        while frame is not None:
            names.add(frame.f_code.co_name)
            compiles = compiles or frame.f_globals.get("__name__", "").startswith("numba.")
            frame = frame.f_back
        if STOP.get() is self and compiles and names.isdisjoint(PRINTS_WHAT_IS_RAISED):
            raise StoppedError("interrupted")


@contextmanager
def _handled(handler: Any, numbers: Iterable[int]) -> Iterator[None]:
    former = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, was in former.items():
            signal.signal(number, was)


def interrupt_alike() -> None:
    """Make `interrupt` handle Ctrl-C, and also SIGTERM and SIGHUP if they have their default handlers."""
    INTERRUPTIONS.clear()  # signals of an earlier command in this process, such as a notebook or a test suite
    for number in (signal.SIGINT, *ALIKE):
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, interrupt)


@contextmanager
def noted_interrupts() -> Iterator[threading.Event]:
    """Yield an event that these signals set until the block ends, or the event of an outer block; main thread only.

    For SIGTERM and SIGHUP, a user's own handler and an ignored signal (as after nohup) stay unchanged.
    """
    flag, outer = _Flag(), signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread():
        yield flag
    elif isinstance(outer, _Flag):
        yield outer
    else:
        ours = [number for number in ALIKE if signal.getsignal(number) in (signal.SIG_DFL, interrupt)]
        with _handled(flag, (signal.SIGINT, *ours)):
            yield flag


@contextmanager
def held_interrupts() -> Iterator[None]:
    """Delay signals until the block ends, for short operations that must not be interrupted."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    numbers = [n for n in (signal.SIGINT, *ALIKE) if signal.getsignal(n) not in (None, signal.SIG_IGN)]
    try:
        with _handled(lambda number, _: came.append(number), numbers):
            yield
    finally:
        for caught in came:
            signal.raise_signal(caught)


def _hush(number: int) -> None:
    """Redirect the standard streams to os.devnull after SIGHUP, since writing to a closed terminal is an error."""
    if number != signal.SIGHUP:
        return
    for stream in (0, 1, 2):
        if stat.S_ISCHR(os.fstat(stream).st_mode):  # isatty returns False after a terminal hangs up
            discard(stream)


def discard(descriptor: int) -> None:
    """Redirect a file descriptor to os.devnull."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
