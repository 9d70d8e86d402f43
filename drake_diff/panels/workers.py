"""The function that a panel file names, evaluated in parallel: by processes of this machine (loky), or a Ray cluster.

Both engines give the same rows. A process evaluates one trial at a time; where it dies, only its trial is lost, and
that trial is evaluated once more. A worker that dies in the second try too is an error in the trial's row.
"""

import importlib
import importlib.util
import multiprocessing.resource_tracker
import os
import random
import signal
import socket
import threading
import time
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import AbstractContextManager, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import Any

import loky
import numpy as np

from drake_diff.exceptions import InputError, MissingDependencyError, UnknownNameError
from drake_diff.panels.panel_file import PanelTrial

ENGINES = ("local", "ray")
PER_CORE = 2  # tasks in flight for each core of a cluster: the next one is there when one ends
CHECK_PARENT = 0.5  # seconds between two looks of a worker at whether its parent still lives

Row = dict[str, Any]
Function = Callable[[dict[str, Any]], Mapping[str, Any]]
# A worker dies when it is killed, runs out of memory, or crashes below Python.
DIED: Row = {"error": "WorkerDied: the process that evaluated this trial died, and so did the one that tried again"}
STARTS = 3  # processes in turn that may be killed before they begin a trial
NOT_STARTED: Row = {
    "error": f"WorkerDied: {STARTS} processes in turn were killed at their start, before this trial began: there may "
    "be too little memory for so many workers"
}
# A worker has one core: its libraries start no threads of their own.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
Answers = Generator[tuple[PanelTrial, Row | None]]  # None for a row: the process died
Evaluate = Callable[[Sequence[PanelTrial]], Answers]


@dataclass(frozen=True)
class TrialFunction:
    """What `evaluate` names: "FILE.py:function", the file beside the panel in `directory`, or "module:function".

    Workers run in the panel's directory, so that relative paths in a panel start from there.
    """

    evaluate: str
    directory: str

    def enter(self) -> Function:
        """The function, loaded, with its panel's directory as the process's own."""
        os.chdir(self.directory)
        return self.load()

    def load(self) -> Function:
        """The function; InputError where there is none."""
        name = self.evaluate.rpartition(":")[2]
        function = getattr(self._module(), name, None)
        if not callable(function):
            raise InputError("evaluate", got=f"{self.evaluate}, which is not one", expected="a function")
        return function

    def sha256(self) -> str | None:
        """The hash of the function's file; what that file imports is not covered."""
        place = self.evaluate.rpartition(":")[0]
        path = Path(self.directory, place) if place.endswith(".py") else getattr(self._module(), "__file__", None)
        return sha256(Path(path).read_bytes()).hexdigest() if path else None

    def _module(self) -> ModuleType:
        place = self.evaluate.rpartition(":")[0]
        try:
            if not place.endswith(".py"):
                return importlib.import_module(place)
            spec = importlib.util.spec_from_file_location("drake_diff_trials", Path(self.directory, place))
            if spec is None or spec.loader is None:
                raise ImportError(f"{place} is not a Python file")
            module = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(module)
            return module
        except Exception as error:
            got = f"{self.evaluate}: {type(error).__name__}: {error}"
            raise InputError("evaluate", got=got, expected="a file or module that can be imported") from error


def row_of(function: Function, fields: Mapping[str, Any]) -> Row:
    """What `function` returns for one trial, in JSON's types, or {"error": "Type: message"} where it raises.

    NaN and infinity become None. The global generators of NumPy and Python start from the trial's seed.
    """
    random.seed(fields["seed"])
    np.random.seed(fields["seed"] % 2**32)
    try:
        row = function(dict(fields))
        if not isinstance(row, Mapping):
            raise InputError("row", got=type(row).__name__, expected="a mapping of names to values")
        for key in row:
            if not isinstance(key, str) or key in fields or key == "id":
                raise InputError("row", got=repr(key), expected="names that are not the trial's own")
        return {key: _plain(value) for key, value in row.items()}
    except (Exception, SystemExit) as error:  # sys.exit() in a trial ends that trial, not the panel
        return {"error": f"{type(error).__name__}: {error}"}


def _plain(value: Any) -> Any:
    """`value` in JSON's types."""
    if isinstance(value, (np.generic, np.ndarray)):
        value = value.tolist()
    if value is None or isinstance(value, (str, bool)):
        return value
    if isinstance(value, int) and abs(value) < 2**63:
        return value
    if isinstance(value, float):
        return value if np.isfinite(value) else None
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        return {key: _plain(item) for key, item in value.items()}
    raise InputError("row", got=f"{type(value).__name__} {value!r:.80}", expected="numbers, words, lists and mappings")


def evaluate_all(
    trials: Sequence[PanelTrial], function: TrialFunction, workers: int | None, engine: str, address: str | None
) -> Generator[tuple[PanelTrial, Row]]:
    """(trial, row) as they finish. A trial whose process dies is evaluated once more, after all others.

    `workers` None means all cores that this process may use ("local"), or all that there are ("ray").
    """
    left = list(trials)
    if not left:
        return
    pool: AbstractContextManager[Evaluate]
    if engine == "ray":
        pool = _ray(function, workers, address)
    else:
        pool = nullcontext(partial(_local_answers, function=function, workers=workers or loky.cpu_count()))
    with pool as evaluate:
        for _ in range(2):
            died = []
            with closing(evaluate(left)) as answers:
                for trial, row in answers:
                    if row is None:
                        died.append(trial)
                    else:
                        yield trial, row
            left = died
    for trial in left:
        yield trial, DIED


def check_engine(engine: str, address: str | None) -> None:
    """Refuse an unknown engine, and an address for an engine that takes none."""
    if engine not in ENGINES:
        raise UnknownNameError("engine", got=engine, known=ENGINES)
    if address is not None and engine != "ray":
        raise InputError("address", got=address, expected='none for engine="local"; engine="ray" takes it')


def _answer(function: TrialFunction, fields: dict[str, Any]) -> tuple[Row | None, str]:
    """In the worker: a row, or why the function cannot be loaded there."""
    try:
        call = _entered(function)
    except Exception as error:
        return None, f"{type(error).__name__}: {error}"
    return row_of(call, fields), ""


@cache
def _entered(function: TrialFunction) -> Function:
    return function.enter()


def _accept(answer: tuple[Row | None, str]) -> Row | None:
    """In the parent: the row of an answer; InputError where the function could not be loaded."""
    row, refusal = answer
    if refusal:
        raise InputError("evaluate in a worker", got=refusal, expected="a function that can be loaded there")
    return row


def _local_answers(trials: Sequence[PanelTrial], function: TrialFunction, workers: int) -> Answers:
    """Each process is a pool of its own: a larger pool cannot tell in which trial a process died."""
    waiting = iter(trials)
    running: dict[Future[Any], tuple[_Worker, PanelTrial]] = {}
    staff: list[_Worker] = []
    try:
        for _, trial in zip(range(workers), waiting, strict=False):
            staff.append(_Worker(function))
            running[staff[-1].begin(trial)] = staff[-1], trial
        while running:
            for future in wait(running, return_when=FIRST_COMPLETED).done:
                worker, trial = running.pop(future)
                row = None
                with suppress(loky.BrokenProcessPool):
                    row = _accept(future.result())
                if row is None and worker.died_at_its_start:
                    if worker.starts < STARTS:
                        warnings.warn("a worker was killed at its start: it is started again", RuntimeWarning, 2)
                        running[worker.begin(trial, again=True)] = worker, trial
                        continue
                    row = NOT_STARTED
                for other in waiting:
                    running[worker.begin(other)] = worker, other
                    break
                yield trial, row
    finally:  # killed at once: all that was finished is on the disk, the rest is evaluated again
        for worker in staff:
            worker.pool.shutdown(kill_workers=True)


class _Worker:
    """A process that evaluates one trial at a time; another one where it has died."""

    def __init__(self, function: TrialFunction):
        self.function, self.pool, self.starts = function, _one_process(), 0

    def begin(self, trial: PanelTrial, *, again: bool = False) -> Future[Any]:
        """The answer to a trial, which is begun `again` where the process before was killed at its start."""
        self.starts = self.starts + 1 if again else 1
        with _deaf_to_ctrl_c():
            for _ in range(2):  # what has died is told when it is given more
                try:
                    self.ready = self.pool.submit(os.getpid)  # answered before the trial is begun
                    return self.pool.submit(_answer, self.function, trial.fields)
                except loky.BrokenProcessPool:
                    self.pool = _one_process()
        self.ready = Future()
        self.ready.set_exception(loky.BrokenProcessPool("killed at its start"))
        return self.ready

    @property
    def died_at_its_start(self) -> bool:
        """Whether the process that had the last trial never began it."""
        return self.ready.exception() is not None


def _one_process() -> loky.ProcessPoolExecutor:
    return loky.ProcessPoolExecutor(1, initializer=_begin, initargs=(os.getpid(),), env=ONE_THREAD)


@contextmanager
def _deaf_to_ctrl_c() -> Iterator[None]:
    """A process that starts here inherits a blocked Ctrl-C, which a terminal sends to all: the parent alone decides."""
    multiprocessing.resource_tracker.ensure_running()  # starting it later would unblock the signal (Python 3.11)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _begin(parent: int) -> None:
    """In a new worker: ignore Ctrl-C, and end with the parent, in the middle of a trial too."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(CHECK_PARENT)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def _ray(function: TrialFunction, workers: int | None, address: str | None) -> Iterator[Evaluate]:
    """Connect to the cluster at `address`, or start one here with `workers` cores that listens on loopback only.

    On a cluster, `workers` trials are in flight at a time.
    """
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if address is None:
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # makes Ray take the loopback address, on Linux too
    try:
        import ray
    except ImportError as error:
        raise MissingDependencyError(f"Ray is not installed ({error}): pip install 'drake-diff[cluster]'") from error
    cores = {"num_cpus": workers or os.cpu_count(), "include_dashboard": False} if address is None else {}
    _check_listens(address)
    environment = {"env_vars": ONE_THREAD}
    try:
        ray.init(address or "local", runtime_env=environment, log_to_driver=False, logging_level="error", **cores)
    except ConnectionError as error:
        raise InputError("address", got=f"{address}: {error}", expected="a Ray cluster of ours") from error
    try:
        if address is None and ray.util.get_node_ip_address() != "127.0.0.1":
            expected = "it not to be imported before run_panel: only then does it listen on loopback alone"
            raise InputError("ray", got="it is imported already", expected=expected)
        yield lambda trials: _ray_answers(ray, trials, function, workers)
    finally:
        ray.shutdown()


def _check_listens(address: str | None) -> None:
    """Refuse an address where nothing listens: Ray itself would wait for minutes, and then end this process."""
    host, _, port = (address or "").rpartition(":")
    try:
        if address is not None:
            socket.create_connection((host, int(port)), timeout=5).close()
    except (OSError, ValueError, OverflowError) as error:
        raise InputError("address", got=f"{address}: {error}", expected="HOST:PORT of a running Ray head") from error


def _ray_answers(ray: Any, trials: Sequence[PanelTrial], function: TrialFunction, workers: int | None) -> Answers:
    errors = ray.exceptions
    lost = (
        errors.WorkerCrashedError, errors.NodeDiedError, errors.OutOfMemoryError,
        errors.ObjectLostError,  # a row of 100 kB and more stays with its node until it is fetched, and dies with it
    )  # fmt: skip
    task = ray.remote(max_retries=0)(_answer)  # `evaluate_all` tries again, for both engines
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
            trial, row = flying.pop(done), None
            with suppress(*lost):
                row = _accept(ray.get(done))
            yield trial, row
