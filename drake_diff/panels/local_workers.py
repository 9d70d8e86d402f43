"""Trials in processes of this machine, one trial in each at a time."""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess

from drake_diff.exceptions import InputError
from drake_diff.panels.panel_file import Trial
from drake_diff.panels.trial_row import ONE_THREAD, Row, TrialFunction, row_of


@dataclass
class _Worker:
    process: SpawnProcess
    pipe: Connection
    ready: bool = False
    trial: Trial | None = None


def local_answers(trials: Sequence[Trial], function: TrialFunction, workers: int) -> Iterator[tuple[Trial, Row | None]]:
    """(trial, row) as they finish in `workers` processes; None for a row where the process died, which is replaced.

    InputError where a process cannot even load the function.
    """
    waiting, crew = deque(trials), [_start(function) for _ in range(min(workers, len(trials)))]
    try:
        while crew:
            ready = wait([worker.pipe for worker in crew])
            for worker in [worker for worker in crew if worker.pipe in ready]:
                trial, row = worker.trial, _receive(worker)
                if worker.pipe.closed:
                    crew.remove(worker)
                    crew += [_start(function)] if len(waiting) > sum(w.trial is None for w in crew) else []
                else:
                    _hand_out(worker, waiting, crew)
                if trial is not None:
                    yield trial, row
    finally:
        for worker in crew:
            _end(worker)


def _start(function: TrialFunction) -> _Worker:
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(function, theirs))
    with _inherited():
        process.start()
    theirs.close()
    return _Worker(process, ours)


def _receive(worker: _Worker) -> Row | None:
    """The row that a worker has sent; None, and the pipe closed, where it is dead."""
    try:
        message = worker.pipe.recv()
    except (EOFError, OSError):  # also one that died while it wrote
        _end(worker)
        if not worker.ready:
            raise InputError(
                "workers",
                got=f"one that ended with {worker.process.exitcode} before its first trial",
                expected='processes that start; a script that starts them needs `if __name__ == "__main__":`',
            ) from None
        return None
    if isinstance(message, str):
        raise InputError("evaluate in a worker", got=message, expected="a function that can be loaded")
    worker.ready = True
    return message


def _hand_out(worker: _Worker, waiting: deque[Trial], crew: list[_Worker]) -> None:
    """Give `worker` its next trial, or let it go where there is none."""
    if not waiting:
        worker.trial = None
        crew.remove(worker)
        _end(worker)
        return
    worker.trial = waiting.popleft()
    with suppress(BrokenPipeError):  # it died while it was idle: the next `wait` finds the end of its pipe
        worker.pipe.send(worker.trial.fields)


def _end(worker: _Worker) -> None:
    """Kill it at once: all that it had to say is on the disk, or is evaluated again."""
    worker.process.kill()
    worker.process.join()
    worker.pipe.close()


@contextmanager
def _inherited() -> Iterator[None]:
    """What a child must have before its first import: ONE_THREAD in its environment, and no ear for Ctrl-C.

    Ctrl-C reaches all processes of a terminal; the parent alone decides.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    resource_tracker.ensure_running()  # the first start would run it, and that unblocks the signal
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _work(function: TrialFunction, pipe: Connection) -> None:
    """The worker: says None when it is ready, or why it cannot be, then answers each trial with its row."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with suppress(EOFError, ConnectionError):  # the parent is gone, and nobody waits for an answer
        try:
            call = function.enter()
        except Exception as error:
            pipe.send(f"{type(error).__name__}: {error}")
            return
        pipe.send(None)
        while True:
            pipe.send(row_of(call, pipe.recv()))


def _end_with_parent() -> None:
    """End this process when its parent does, also in the middle of a trial."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)
