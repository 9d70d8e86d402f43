"""Work in a process forked from this one, which can be ended in the middle of a call that hears nothing."""

import ctypes
import os
import pickle
import select
import signal
import struct
import sys
import threading
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NoReturn

from drake_diff._base.clock import now

LOOK = 0.02  # [s] from one look at what ends the work to the next
TO_HEAR = 0.25  # [s] in which work that was sent a signal may end by itself
BREAK = ("jax", "torch", "tensorflow")  # their threads hold locks, which a forked process would wait for for ever
DIE_WITH_PARENT = 1  # of prctl(2)
LENGTH = struct.Struct("=Q")

Send = Callable[[Any], None]


@dataclass(frozen=True)
class Ended:
    """What the work `returned`, or why that is nothing: it was `stopped`, or a signal `crashed` it."""

    returned: Any = None
    stopped: bool = False
    crashed: str = ""


def can_fork() -> bool:
    """Whether work that is forked from here would go on: nobody else here holds a lock that it may need.

    Daemon threads, as those of a line of progress and of a live page, hold none that a search takes.
    """
    others = [thread for thread in threading.enumerate() if thread is not threading.main_thread()]
    in_main = threading.current_thread() is threading.main_thread()
    return sys.platform == "linux" and in_main and all(t.daemon for t in others) and not set(BREAK) & set(sys.modules)


def forked(work: Callable[[Send], Any], heard: Send, interrupted: threading.Event, deadline: float) -> Ended:
    """`work(send)` in a forked process; what it sends goes to `heard` here, and what it raises is raised here.

    It is ended at `deadline`, a time of `now`; where `interrupted` is set, soon after a signal of its own;
    and where `heard` raises. Nothing but what it sends and returns, all of which is pickled, comes back.
    """
    end, begin = os.pipe()
    alone = threading.active_count() == 1
    sys.stdout.flush()
    sys.stderr.flush()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of threads: see `can_fork`
        child = os.fork()
    if child == 0:
        os.close(end)
        _work(work, begin, flush=alone)
    os.close(begin)
    status, messages = None, _Messages(end)
    try:
        while True:
            kind, value = messages.next(LOOK)
            if kind == "sent":
                heard(value)
            elif kind == "returned":
                return Ended(value)
            elif kind == "raised":
                raise value
            elif kind == "closed":
                _, status = os.waitpid(child, 0)
                ended_by = os.waitstatus_to_exitcode(status)
                return Ended(crashed=signal.Signals(-ended_by).name if ended_by < 0 else f"status {ended_by}")
            if interrupted.is_set() and deadline > now() + TO_HEAR:
                os.kill(child, signal.SIGINT)
                deadline = now() + TO_HEAR
            if now() > deadline:
                return Ended(stopped=True)
    finally:
        if status is None:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
        os.close(end)


class _Messages:
    """What comes through a pipe, one message after the other."""

    def __init__(self, place: int):
        self.place, self.found, self.closed = place, bytearray(), False
        self.poll = select.poll()
        self.poll.register(place, select.POLLIN)

    def next(self, seconds: float) -> tuple[str, Any]:
        """The next one, as its kind and value; ("", None) where none has come within `seconds`."""
        if not self._whole() and not self.closed and self.poll.poll(1e3 * seconds):
            piece = os.read(self.place, 2**20)
            self.closed = not piece
            self.found += piece
        if not self._whole():
            return "closed" if self.closed else "", None
        (length,) = LENGTH.unpack_from(self.found)
        message = bytes(self.found[LENGTH.size : LENGTH.size + length])
        del self.found[: LENGTH.size + length]
        kind, value = pickle.loads(message)
        return kind, value

    def _whole(self) -> bool:
        size = len(self.found)
        return size >= LENGTH.size and size >= LENGTH.size + LENGTH.unpack_from(self.found)[0]


def _work(work: Callable[[Send], Any], place: int, *, flush: bool) -> NoReturn:
    """In the forked process: do the work, write what comes of it, and end, whatever happens."""

    def write(kind: str, value: Any) -> None:
        message = pickle.dumps((kind, value))
        words = memoryview(LENGTH.pack(len(message)) + message)
        while words:
            words = words[os.write(place, words) :]

    try:
        ctypes.CDLL(None).prctl(DIE_WITH_PARENT, signal.SIGKILL, 0, 0, 0)
        try:
            write("returned", work(lambda value: write("sent", value)))
        except BaseException as error:
            try:
                pickle.loads(pickle.dumps(error))
            except Exception:  # one of a user's own that cannot be pickled
                error = RuntimeError(f"{type(error).__name__}: {error}")
            write("raised", error)
        if flush:
            sys.stdout.flush()
            sys.stderr.flush()
    finally:
        os._exit(0)
