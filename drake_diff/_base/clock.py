"""Until when what runs here may go on: a limit that holds in whatever is called, however deep."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

LONGEST_PIECE = 0.4  # of what the pieces before it took, as CasADi's take on chains of 20, 50 and 100 joints
DEADLINE: ContextVar[float | None] = ContextVar("DEADLINE", default=None)  # of the monotonic clock


class TimeIsUpError(Exception):
    """The time that was given is over; whoever gave it tells what was not done."""


@contextmanager
def until(deadline: float) -> Iterator[None]:
    """`check_time` raises after `deadline`, a time of `time.monotonic()`, or that of a block around this one."""
    outer = DEADLINE.get()
    token = DEADLINE.set(deadline if outer is None else min(outer, deadline))
    try:
        yield
    finally:
        DEADLINE.reset(token)


def check_time(ahead: float = 0.0) -> None:
    """Raise TimeIsUpError where the time is over, or will be before what comes next, that takes `ahead` [s]."""
    deadline = DEADLINE.get()
    if deadline is not None and time.monotonic() + ahead > deadline:
        raise TimeIsUpError("the time is up")


class Pace:
    """Looks at the clock between pieces of work none of which can be interrupted, such as a call of CasADi."""

    def __init__(self) -> None:
        self.start = time.monotonic()

    def go_on(self) -> None:
        """Raise TimeIsUpError where the next piece may end too late: see LONGEST_PIECE."""
        check_time(ahead=LONGEST_PIECE * (time.monotonic() - self.start))
