"""Trials in processes of this machine, one trial in each at a time.

Trials as tasks of Ray: on a cluster that runs already, or on one of this machine alone.

Trials evaluated by an engine: processes of this machine, or Ray.
"""

import multiprocessing
import os
import signal
import socket
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from drake_diff.exceptions import InputError, MissingDependencyError, UnknownNameError
from drake_diff.panels.panel_file import Trial
from drake_diff.panels.trial_row import DIED, ONE_THREAD, Function, Row, TrialFunction, row_of


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


PER_CORE = 2  # tasks in flight for each core of a cluster: the next is there when one ends


@contextmanager
def ray_pool(function: TrialFunction, workers: int | None, address: str | None) -> Iterator[Callable[..., Any]]:
    """Connect to the cluster at `address`, or start one here with `workers` cores that listens on loopback only.

    Yields a function like `local_answers`, of the trials alone. On a cluster `workers` trials are in flight.
    """
    ray = _import(address)
    cores = {"num_cpus": workers or os.cpu_count(), "include_dashboard": False} if address is None else {}
    _check_listens(address)
    environment = {"env_vars": ONE_THREAD}
    try:
        ray.init(address or "local", runtime_env=environment, log_to_driver=False, logging_level="error", **cores)
    except ConnectionError as error:
        raise InputError("address", got=f"{address}: {error}", expected="a Ray cluster of ours") from error
    try:
        if address is None and ray.util.get_node_ip_address() != "127.0.0.1":
            raise InputError("ray", got="an import of it before", expected="none: it listens on all interfaces so")
        yield lambda trials: _answers(ray, trials, function, workers)
    finally:
        ray.shutdown()


def _check_listens(address: str | None) -> None:
    """Refuse an address at which nothing listens: Ray itself would wait for minutes, and end this process."""
    host, _, port = (address or "").rpartition(":")
    try:
        if address is not None:
            socket.create_connection((host, int(port)), timeout=5).close()
    except (OSError, ValueError, OverflowError) as error:
        raise InputError("address", got=f"{address}: {error}", expected="HOST:PORT of a running Ray head") from error


def _import(address: str | None) -> Any:
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if address is None:
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # what makes Ray take the loopback address, Linux too
    try:
        import ray
    except ImportError as error:
        raise MissingDependencyError(f"ray is not there ({error}): pip install 'drake-diff[cluster]'") from error
    return ray


def _answers(
    ray: Any, trials: Sequence[Trial], function: TrialFunction, workers: int | None
) -> Iterator[tuple[Trial, Row | None]]:
    lost = (ray.exceptions.WorkerCrashedError, ray.exceptions.NodeDiedError, ray.exceptions.OutOfMemoryError)
    task = ray.remote(max_retries=0)(_answer)  # who died is evaluated again by `evaluate_all`, as of every engine
    waiting, flying = iter(trials), {}
    while True:
        room = workers or PER_CORE * int(ray.cluster_resources().get("CPU", 1))
        for trial in waiting:
            flying[task.remote(function, trial.fields)] = trial
            if len(flying) >= room:
                break
        if not flying:
            return
        for done in ray.wait(list(flying))[0]:
            trial = flying.pop(done)
            try:
                row, refusal = ray.get(done)
            except lost:
                row, refusal = None, ""
            if refusal:
                raise InputError("evaluate in a worker", got=refusal, expected="a function that can be loaded there")
            yield trial, row


def _answer(function: TrialFunction, fields: dict[str, Any]) -> tuple[Row | None, str]:
    """The task: a row, or why the function cannot be loaded on that machine."""
    try:
        call = _entered(function)
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"
    return row_of(call, fields), ""


@cache
def _entered(function: TrialFunction) -> Function:
    return function.enter()


ENGINES = ("local", "ray")


def evaluate_all(
    trials: Sequence[Trial], function: TrialFunction, workers: int | None, engine: str, address: str | None
) -> Generator[tuple[Trial, Row]]:
    """(trial, row) as they finish. A trial whose process dies is evaluated once more, after all others.

    `workers` is None for all cores that this process may use ("local") or that there are ("ray").
    """
    left = list(trials)
    if not left:
        return
    with _pool(function, workers, engine, address) as answers:
        for _ in range(2):
            died = []
            with closing(answers(left)) as answered:
                for trial, row in answered:
                    if row is None:
                        died.append(trial)
                    else:
                        yield trial, row
            left = died
    for trial in left:
        yield trial, DIED


def check_engine(engine: str, address: str | None) -> None:
    """Refuse an engine that there is none of, and an address where it means nothing."""
    if engine not in ENGINES:
        raise UnknownNameError("engine", got=engine, known=ENGINES)
    if address is not None and engine != "ray":
        raise InputError("address", got=address, expected='none for engine="local"; engine="ray" takes it')


def _pool(
    function: TrialFunction, workers: int | None, engine: str, address: str | None
) -> AbstractContextManager[Callable[..., Any]]:
    return ray_pool(function, workers, address) if engine == "ray" else _local_pool(function, workers)


def cores() -> int:
    """The cores that this process may use, where the system tells; else those of the machine."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _local_pool(function: TrialFunction, workers: int | None) -> Iterator[Callable[..., Any]]:
    yield lambda trials: local_answers(trials, function, workers or cores())
