"""Until when what runs here may go on: a limit, or a signal, that holds in whatever is called, however deep.

Ctrl-C, SIGTERM and SIGHUP alike: a search notes them and ends with its best plan, all else is interrupted.
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

LONGEST_PIECE = 0.4  # of what the pieces before it took, as CasADi's take on chains of 20, 50 and 100 joints
DEADLINE: ContextVar[float | None] = ContextVar("DEADLINE", default=None)  # of `now`
STOP: ContextVar[threading.Event | None] = ContextVar("STOP", default=None)
_uncounted = 0.0  # [s]
INTERRUPTIONS: list[int] = []  # the signals that `interrupt` handled


def uncounted(seconds: float = 0.0) -> float:
    """[s] that no limit counts, in all: what Numba compiled, once on a machine. `seconds` are added to it."""
    global _uncounted
    _uncounted += seconds
    return _uncounted


def now() -> float:
    """[s] of the clock that limits go by: the monotonic one, which stands still while Numba compiles."""
    return time.monotonic() - _uncounted


class TimeIsUpError(Exception):
    """The time that was given is over; whoever gave it tells what was not done."""


class StoppedError(TimeIsUpError):
    """A signal ends what runs here, as a limit would."""


@contextmanager
def until(deadline: float) -> Iterator[None]:
    """`check_time` raises after `deadline`, a time of `now()`, or that of a block around this one."""
    outer = DEADLINE.get()
    token = DEADLINE.set(deadline if outer is None else min(outer, deadline))
    try:
        yield
    finally:
        DEADLINE.reset(token)


@contextmanager
def until_set(flag: threading.Event) -> Iterator[None]:
    """`check_time` raises once `flag` is set, as a signal does, in the place of the flag of a block around this one."""
    token = STOP.set(flag)
    try:
        yield
    finally:
        STOP.reset(token)


def check_time(ahead: float = 0.0) -> None:
    """Raise TimeIsUpError where the time is over, or will be before what comes next, that takes `ahead` [s]."""
    stop, deadline = STOP.get(), DEADLINE.get()
    if stop is not None and stop.is_set():
        raise StoppedError("interrupted")
    if deadline is not None and now() + ahead > deadline:
        raise TimeIsUpError("the time is up")


class Pace:
    """Looks at the clock between pieces of work none of which can be interrupted, such as a call of CasADi."""

    def __init__(self) -> None:
        self.start = now()

    def go_on(self) -> None:
        """Raise TimeIsUpError where the next piece may end too late: see LONGEST_PIECE."""
        check_time(ahead=LONGEST_PIECE * (now() - self.start))


INTERRUPTED = 130  # the exit status, as shells have it after Ctrl-C
ALIKE = (signal.SIGTERM, signal.SIGHUP)
AGAIN = 0.05  # [s] after which a signal that came amid an import is sent again
# Called by C or by the garbage collector, which print what is raised in them and go on.
PRINTS_WHAT_IS_RAISED = {
    *("__del__", "on_disposal", "_object_compiled_hook", "_object_getbuffer_hook"),
    *("_raw_object_cache_notify", "_raw_object_cache_getbuffer"),
}


def interrupt(number: int, frame: FrameType | None) -> None:
    """A handler that does what Python does at Ctrl-C, once no extension is being imported.

    Extensions in C++ print what is raised while they are imported and go on, or abort.
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
    """Whether an extension is being imported, or the innermost function is of the import system."""
    loaders = (isinstance(caller.f_locals.get("self"), ExtensionFileLoader) for caller, _ in walk_stack(frame))
    return frame.f_globals.get("__name__") == "importlib._bootstrap" or any(loaders)


class _Flag(threading.Event):
    """A handler that notes that a signal came; where `check_time` would end what runs, it ends a compilation at once.

    Numba compiles for seconds, once on a machine, and looks at no flag; what is half compiled is thrown away.
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
    """From here on `interrupt` handles Ctrl-C, and SIGTERM and SIGHUP where they would have ended the process."""
    INTERRUPTIONS.clear()  # of an earlier command in this process, such as a notebook or a suite of tests
    for number in (signal.SIGINT, *ALIKE):
        if signal.getsignal(number) in (signal.SIG_DFL, signal.default_int_handler):
            signal.signal(number, interrupt)


@contextmanager
def noted_interrupts() -> Iterator[threading.Event]:
    """An event that these signals set, in the main thread, until the block ends; that of a block around it, if any.

    What a user's own handler does, and what is ignored, as after nohup, stays so for SIGTERM and SIGHUP.
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
    """What comes while the block runs does what it does when that has ended: what is short and must be whole."""
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
    """A terminal that has hung up takes no more words: they go nowhere, where else each would be an error."""
    if number != signal.SIGHUP:
        return
    for stream in (0, 1, 2):
        if stat.S_ISCHR(os.fstat(stream).st_mode):  # isatty says no of one that has hung up
            discard(stream)


def discard(descriptor: int) -> None:
    """Let a file descriptor lead to os.devnull: what is written to it goes nowhere."""
    nowhere = os.open(os.devnull, os.O_RDWR)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
