"""Run a panel: from its file to its table, going on where an earlier run was stopped.

The function that the file names is evaluated in parallel through joblib: by processes of this machine, or Ray. A trial
whose process dies is evaluated once more, alone; if that process dies too, its row is an error. Every row is the same
for any number of workers and for both engines.
"""

import importlib
import importlib.util
import os
import random
import signal
import socket
import threading
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import Any

import joblib
import numpy as np
from joblib.externals.loky import get_reusable_executor
from joblib.externals.loky.process_executor import BrokenProcessPool

from drake_diff._base.arrays import positive_int
from drake_diff.exceptions import InputError, MissingDependencyError, UnknownNameError
from drake_diff.panels.results import (
    PAGE,
    PanelTable,
    PanelTrial,
    Row,
    begun_record,
    ended_record,
    expand,
    finished_trials,
    load_panel,
    write_ranking,
    write_table,
)
from drake_diff.runs.provenance import provenance_of

ENGINES = ("local", "ray")
WAVE = 8  # trials for each process that may end before their rows are written: a kill loses no more
CHECK_PARENT = 0.5  # seconds between two checks of a worker that its parent lives
# A worker has one core: its libraries start no threads.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

Function = Callable[[dict[str, Any]], Mapping[str, Any]]
# A worker dies when it is killed, runs out of memory, or crashes below Python.
DIED: Row = {"error": "WorkerDied: the process that evaluated this trial died, and so did a second one"}


@dataclass(frozen=True)
class TrialFunction:
    """What `evaluate` names: "FILE.py:function", the file beside the panel in `directory`, or "module:function".

    Workers run in the panel's directory, so that relative paths in a panel start from there.
    """

    evaluate: str
    directory: str

    def load(self) -> tuple[Function, str | None]:
        """The function, and the hash of its file, which does not cover what that imports. InputError without one."""
        source, _, name = self.evaluate.rpartition(":")
        try:
            if source.endswith(".py"):
                spec: Any = importlib.util.spec_from_file_location("drake_diff_trials", Path(self.directory, source))
                module = importlib.util.module_from_spec(spec)
                spec.loader.exec_module(module)
            else:
                module = importlib.import_module(source)
        except Exception as error:
            got = f"{self.evaluate}: {type(error).__name__}: {error}"
            raise InputError("evaluate", got=got, expected="a file or module that can be imported") from error
        function, file = getattr(module, name, None), getattr(module, "__file__", None)
        if not callable(function):
            raise InputError("evaluate", got=f"{self.evaluate}, which is not callable", expected="a function")
        return function, sha256(Path(file).read_bytes()).hexdigest() if file else None


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
                raise InputError("row", got=repr(key), expected="names other than the fields of a trial")
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


def evaluate(
    trials: Sequence[PanelTrial], function: TrialFunction, workers: int | None, engine: str, address: str | None
) -> Generator[tuple[PanelTrial, Row]]:
    """(trial, row) as they finish.

    `workers` None means all cores that this process may use ("local"), or all of the cluster ("ray").
    """
    left = list(trials)
    if not left:
        return
    suspects: list[PanelTrial] = []  # in flight when a process died
    with _loky(workers) if engine == "local" else _ray(workers, address) as (count, crash):
        # joblib evaluates in this process where n_jobs is 1: then there are two processes, and one trial at a time.
        options = {"n_jobs": max(2, count), "pre_dispatch": count, "batch_size": 1}
        with joblib.Parallel(**options, return_as="generator_unordered") as parallel:
            while left:
                started: dict[str, PanelTrial] = {}
                done: set[str] = set()
                try:
                    for trial, row in _answers(parallel, left[: WAVE * count], function, started):
                        done.add(trial.id)
                        yield trial, row
                except crash:
                    started = started or {left[0].id: left[0]}
                suspects += [trial for trial in started.values() if trial.id not in done]
                left = [trial for trial in left if trial.id not in started]
            for trial in suspects:
                try:
                    row = next((row for _, row in _answers(parallel, [trial], function, {})), DIED)
                except crash:
                    row = DIED
                yield trial, row


def _answers(
    parallel: Any, trials: Sequence[PanelTrial], function: TrialFunction, started: dict[str, PanelTrial]
) -> Iterator[tuple[PanelTrial, Row]]:
    """(trial, row) as they finish; `started` collects those that were given to a process."""

    def tasks() -> Iterator[Any]:
        for trial in trials:
            started[trial.id] = trial
            yield joblib.delayed(_answer)(function, trial)

    with closing(parallel(tasks())) as answers:
        for trial, row, refusal in answers:
            if refusal:
                raise InputError("evaluate in a worker", got=refusal, expected="a function that a worker can load")
            if trial is not None:
                yield trial, row


def _answer(function: TrialFunction, trial: PanelTrial) -> tuple[PanelTrial, Row, str]:
    """In the worker: the row, or why the function cannot be loaded there."""
    try:
        call = _entered(function)
    except Exception as error:
        return trial, {}, f"{type(error).__name__}: {error}"
    return trial, row_of(call, trial.fields), ""


@cache
def _entered(function: TrialFunction) -> Function:
    """The function, loaded in the directory of its panel."""
    os.chdir(function.directory)
    return function.load()[0]


@contextmanager
def _loky(workers: int | None) -> Iterator[tuple[int, type[BaseException]]]:
    """Processes of this machine; how many, and the error of one that died."""
    count = workers or joblib.cpu_count()
    options = {"inner_max_num_threads": 1, "initializer": _begin, "initargs": (os.getpid(),)}
    try:
        with joblib.parallel_config(backend="loky", **options):
            yield count, BrokenProcessPool
    finally:  # finished trials are on the disk; others are evaluated again by the next call
        get_reusable_executor().shutdown(kill_workers=True)


def _begin(parent: int) -> None:
    """In a new worker: ignore Ctrl-C, which a terminal sends to all processes, and end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(CHECK_PARENT)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def _ray(workers: int | None, address: str | None) -> Iterator[tuple[int, type[BaseException]]]:
    """The cluster at `address`, or one on this machine that listens on loopback only."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if address is None:
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # makes Ray take the loopback address, on Linux too
    try:
        import ray
        from ray.util.joblib.ray_backend import RayBackend
    except ImportError as error:
        raise MissingDependencyError(f"Ray is not installed ({error}): pip install 'drake-diff[cluster]'") from error

    class Streaming(RayBackend):  # type: ignore[misc]
        """Ray's backend of joblib, which returns results as they come, and no trial in place of a lost one."""

        supports_return_generator = True

        def retrieve_result_callback(self, result: Any) -> Any:
            lost = isinstance(result, ray.exceptions.RayError)
            return [(None, {}, "")] if lost else super().retrieve_result_callback(result)

    joblib.register_parallel_backend("ray", Streaming)
    cores = {"num_cpus": max(2, workers or os.cpu_count() or 2), "include_dashboard": False} if address is None else {}
    _check_listens(address)
    environment = {"env_vars": ONE_THREAD}
    try:
        ray.init(address or "local", runtime_env=environment, log_to_driver=False, logging_level="error", **cores)
    except ConnectionError as error:
        raise InputError(
            "address", got=f"{address}: {error}", expected="the address of a running Ray cluster"
        ) from error
    try:
        if address is None and ray.util.get_node_ip_address() != "127.0.0.1":
            expected = "no import of ray before run_panel, so that Ray listens on loopback only"
            raise InputError("ray", got="an earlier import", expected=expected)
        # A process that died is started again, and Ray evaluates its trial once more.
        options = {"max_restarts": -1, "max_task_retries": 1, "scheduling_strategy": "SPREAD"}
        with joblib.parallel_config(backend="ray", ray_remote_args=options):
            yield workers or int(ray.cluster_resources().get("CPU", 1)), ray.exceptions.RayError
    finally:
        ray.shutdown()


def _check_listens(address: str | None) -> None:
    """Refuse an address where nothing listens: Ray waits for minutes, and then ends this process."""
    host, _, port = (address or "").rpartition(":")
    try:
        if address is not None:
            socket.create_connection((host, int(port)), timeout=5).close()
    except (OSError, ValueError, OverflowError) as error:
        raise InputError("address", got=f"{address}: {error}", expected="HOST:PORT of a running Ray head") from error


Progress = Callable[[int, int, int], None]


def run_panel(
    path: str | Path,
    *,
    out: str | Path | None = None,
    workers: int | None = None,
    engine: str = "local",
    address: str | None = None,
    progress: Progress | None = None,
) -> PanelTable:
    r"""Evaluate every trial of a panel file in parallel, and write the table and summary of what was found.

    Each finished trial has at once its record in `trials/`. After a kill or Ctrl-C the same call evaluates only what
    is missing. Table and summary are the same to the byte as without the interruption, for any number of workers and
    for both engines. A trial that raises is a row with the column `error`. `dd.load_record`, `dd.verify` and
    `drake-diff list` take the directory, and the record of each trial in it.

    Args:
        path: the panel, a TOML file; `drake_diff.panels.results` says what stands in it.
        out: the directory to write; artifacts/<name of the file> where None.
        workers: how many processes; None means one for each core.
        engine: "local" (processes of this machine) or "ray".
        address: "HOST:PORT" of a running Ray cluster; None starts one on this machine.
        progress: called with the numbers of finished trials, of all trials and of errors.

    Returns:
        The rows and the summary, as in `table.csv` and `summary.json`.

    Raises:
        InputError: the panel file is wrong, its function cannot be loaded, or `out` holds what no panel wrote.
        ArtifactError: `out` holds another panel or a damaged record, or another process is writing there.
        MissingDependencyError: Ray is asked for and not installed.

    Example:
        >>> from pathlib import Path
        >>> from tempfile import mkdtemp
        >>> folder = Path(mkdtemp())
        >>> _ = (folder / "trials.py").write_text("def square(trial): return {'cost': trial['x'] ** 2}")
        >>> _ = (folder / "panel.toml").write_text('evaluate = "trials.py:square"\n[axes]\nx = [1, 2, 3]')
        >>> from drake_diff.panels import run_panel
        >>> [row["cost"] for row in run_panel(folder / "panel.toml", out=folder / "out", workers=1).rows]
        [1, 4, 9]
    """
    path = Path(path)
    count = None if workers is None else positive_int("workers", workers)
    if engine not in ENGINES:
        raise UnknownNameError("engine", got=engine, known=ENGINES)
    if address is not None and engine != "ray":
        raise InputError("address", got=address, expected='none for engine="local"; engine="ray" takes it')
    panel = load_panel(path)
    trials = expand(panel)
    function = TrialFunction(panel.evaluate, str(path.resolve().parent))
    _, function_sha256 = function.load()
    used = provenance_of()
    # What must be the same for two trials to stand in one table.
    made = {
        "sha256": panel.sha256,
        "evaluate": panel.evaluate,
        "function_sha256": function_sha256,
        "fixed": panel.fixed,
        "python": used.python,
        "platform": used.platform,
        **{name: used.packages.get(name) for name in ("drake", "drake-diff", "numpy")},
    }
    directory = Path(out) if out is not None else Path("artifacts") / path.stem
    start = time.monotonic()
    begun = begun_record(directory, len(trials), made)
    with finished_trials(directory, begun, made) as finished:
        errors = sum("error" in row for row in finished.rows.values())
        left = [trial for trial in trials if trial.id not in finished.rows]
        with closing(evaluate(left, function, count, engine, address)) as evaluated:
            for trial, row in evaluated:
                finished.add(trial, row)
                errors += "error" in row
                if progress:
                    progress(len(finished.rows), len(trials), errors)
        table = write_table(directory, trials, finished.rows, made)
        record = ended_record(begun, table, time.monotonic() - start)
        write_ranking(directory / PAGE, table.summary, record)
        record.write(directory)
        return table
