"""Until when what runs here may go on: a limit, or a signal, that holds in whatever is called, however deep."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

LONGEST_PIECE = 0.4  # of what the pieces before it took, as CasADi's take on chains of 20, 50 and 100 joints
DEADLINE: ContextVar[float | None] = ContextVar("DEADLINE", default=None)  # of `now`


STOP: ContextVar[threading.Event | None] = ContextVar("STOP", default=None)


_uncounted = 0.0  # [s]


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
