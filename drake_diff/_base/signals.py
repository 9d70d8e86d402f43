"""Ctrl-C, SIGTERM and SIGHUP alike: a search notes them and ends with its best plan, all else is interrupted."""

import os
import signal
import stat
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any

from drake_diff._base.clock import STOP, StoppedError

INTERRUPTED = 130  # the exit status, as shells have it after Ctrl-C
ALIKE = (signal.SIGTERM, signal.SIGHUP)
AGAIN = signal.SIGVTALRM  # of a timer of this process's own work
UNWOUND = 0.1  # [s] of work in which what is raised has left Numba, if nothing stopped it on its way
# Called by C or by the garbage collector, which print what is raised in them and go on.
GOES_NOWHERE = {
    "__del__",
    "on_disposal",
    "_object_compiled_hook",
    "_object_getbuffer_hook",
    "_raw_object_cache_notify",
    "_raw_object_cache_getbuffer",
}


def interrupt(number: int, frame: Any) -> None:
    """A handler that does what Python does at Ctrl-C."""
    _hush(number)
    raise KeyboardInterrupt


class _Flag(threading.Event):
    """A handler that notes that a signal came; where `check_time` would end what runs, it ends a compilation at once.

    Numba compiles for seconds, once on a machine, and looks at no flag; what is half compiled is thrown away.
    """

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if number != AGAIN:
            _hush(number)
            self.set()
        if STOP.get() is self:
            self._stop_compiling(frame)

    def _stop_compiling(self, frame: FrameType | None) -> None:
        names, compiles = set(), False
        while frame is not None:
            names.add(frame.f_code.co_name)
            compiles = compiles or frame.f_globals.get("__name__", "").startswith("numba.")
            frame = frame.f_back
        if not compiles:
            return
        if signal.getsignal(AGAIN) in (signal.SIG_DFL, self):  # else somebody's own timer
            signal.signal(AGAIN, self)
            signal.setitimer(signal.ITIMER_VIRTUAL, UNWOUND)
        if names.isdisjoint(GOES_NOWHERE):
            raise StoppedError("interrupted")

    def end(self) -> None:
        """Raise nothing any more."""
        if signal.getsignal(AGAIN) is self:
            signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
            signal.signal(AGAIN, signal.SIG_DFL)


def interrupt_alike() -> None:
    """From here on SIGTERM and SIGHUP raise KeyboardInterrupt, where they would have ended the process."""
    for number in ALIKE:
        if signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, interrupt)


@contextmanager
def noted_interrupts() -> Iterator[threading.Event]:
    """An event that these signals set, in the main thread, until the block ends; that of a block around it, if any.

    What a user's own handler does, and what is ignored, as after nohup, stays so for SIGTERM and SIGHUP.
    """
    flag = _Flag()
    if threading.current_thread() is not threading.main_thread():
        yield flag
        return
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, *ALIKE)}
    outer = former[signal.SIGINT]
    if isinstance(outer, _Flag):
        yield outer
        return
    taken = [n for n, was in former.items() if n == signal.SIGINT or was in (signal.SIG_DFL, interrupt)]
    for number in taken:
        signal.signal(number, flag)
    try:
        yield flag
    finally:
        flag.end()
        for number in taken:
            signal.signal(number, former[number])


@contextmanager
def held_interrupts() -> Iterator[None]:
    """What comes while the block runs does what it does when that has ended: what is short and must be whole."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[int] = []
    former = {number: signal.getsignal(number) for number in (signal.SIGINT, *ALIKE)}
    taken = [number for number, was in former.items() if was not in (None, signal.SIG_IGN)]
    for number in taken:
        signal.signal(number, lambda number, _: came.append(number))
    try:
        yield
    finally:
        for number in taken:
            signal.signal(number, former[number])
        for caught in came:
            signal.raise_signal(caught)


def _hush(number: int) -> None:
    """A terminal that has hung up takes no more words: they go nowhere, where else each would be an error."""
    if number != signal.SIGHUP:
        return
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        if stat.S_ISCHR(os.fstat(stream).st_mode):  # isatty says no of one that has hung up
            os.dup2(nowhere, stream)
    os.close(nowhere)
