"""Run a panel, from its file to its table, and resume an interrupted run.

The function that the file names is evaluated in parallel through joblib, by processes of this machine or by Ray. If the
process of a trial dies, the trial is evaluated once more, alone. If that process dies too, its row is an error. Every
row is the same for any number of workers and for both engines.
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
WAVE = 8  # trials per process in one batch, the largest loss if the run is killed
CHECK_PARENT = 0.5  # [s] interval at which a worker checks whether its parent is alive
# A worker uses one core, so that its libraries must not start threads.
ONE_THREAD = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}

Function = Callable[[dict[str, Any]], Mapping[str, Any]]
# A worker dies if it is killed, runs out of memory, or crashes outside Python.
DIED: Row = {"error": "WorkerDied: the process that evaluated this trial died, and so did a second one"}


@dataclass(frozen=True)
class TrialFunction:
    """The function named by `evaluate`: "FILE.py:function" for a file in the panel's `directory`, or "module:function".

    Workers run in the panel's directory, so that paths in a panel are relative to it.
    """

    evaluate: str
    directory: str

    def load(self) -> tuple[Function, str | None]:
        """Return the function and the hash of its file, without imported modules. Raises InputError on failure."""
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
    """Return the result of `function` for one trial in JSON's types, or {"error": "Type: message"} if it raises.

    NaN and infinity become None. The global generators of NumPy and Python are seeded with the trial's seed.
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
    """Convert `value` to JSON's types."""
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
    """Yield (trial, row) in the order in which trials finish.

    `workers` None means all cores that this process may use ("local"), or all of the cluster ("ray").
    """
    left = list(trials)
    if not left:
        return
    suspects: list[PanelTrial] = []  # trials in progress when a process died
    with _loky(workers) if engine == "local" else _ray(workers, address) as (count, crash):
        # For n_jobs of 1, joblib would evaluate in this process. Two processes with one trial at a time avoid this.
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
    """Yield (trial, row) in the order in which trials finish. `started` collects the trials sent to a process."""

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
    """Return the row, or the reason why the worker cannot load the function. Runs in the worker."""
    try:
        call = _entered(function)
    except Exception as error:
        return trial, {}, f"{type(error).__name__}: {error}"
    return trial, row_of(call, trial.fields), ""


@cache
def _entered(function: TrialFunction) -> Function:
    """Load the function in the directory of its panel."""
    os.chdir(function.directory)
    return function.load()[0]


@contextmanager
def _loky(workers: int | None) -> Iterator[tuple[int, type[BaseException]]]:
    """Start processes on this machine, and yield their number and the error type of a dead process."""
    count = workers or joblib.cpu_count()
    options = {"inner_max_num_threads": 1, "initializer": _begin, "initargs": (os.getpid(),)}
    try:
        with joblib.parallel_config(backend="loky", **options):
            yield count, BrokenProcessPool
    finally:  # finished trials are on disk, and the next call evaluates the others
        get_reusable_executor().shutdown(kill_workers=True)


def _begin(parent: int) -> None:
    """Initialize a worker: ignore Ctrl-C, which a terminal sends to all processes, and end with the parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def end_with_parent() -> None:
        while os.getppid() == parent:
            time.sleep(CHECK_PARENT)
        os._exit(1)

    threading.Thread(target=end_with_parent, daemon=True).start()


@contextmanager
def _ray(workers: int | None, address: str | None) -> Iterator[tuple[int, type[BaseException]]]:
    """Connect to the cluster at `address`, or start one on this machine that listens on loopback only."""
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if address is None:
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"  # makes Ray take the loopback address, on Linux too
    try:
        import ray
        from ray.util.joblib.ray_backend import RayBackend
    except ImportError as error:
        raise MissingDependencyError(f"Ray is not installed ({error}): pip install 'drake-diff[cluster]'") from error

    class Streaming(RayBackend):  # type: ignore[misc]
        """Ray's joblib backend, with results in the order of completion, and a placeholder for a lost trial."""

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
        available = int(ray.cluster_resources().get("CPU", 1))
        if workers is not None and workers > available:
            raise InputError("workers", got=workers, expected=f"at most {available}, the cores of the cluster")
        # Ray restarts a process that died, and evaluates its trial once more.
        options = {"max_restarts": -1, "max_task_retries": 1, "scheduling_strategy": "SPREAD"}
        with joblib.parallel_config(backend="ray", ray_remote_args=options):
            yield workers or available, ray.exceptions.RayError
    finally:
        ray.shutdown()


def _check_listens(address: str | None) -> None:
    """Raise InputError if no server listens at the address. Ray would wait for minutes and end this process."""
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
    r"""Evaluate every trial of a panel file in parallel, and write the table and summary of the results.

    The record of each finished trial is written to `trials/` immediately. After a kill or Ctrl-C, the same call
    evaluates only the missing trials. Table and summary are the same to the byte as without the interruption, for any
    number of workers and for both engines. A trial that raises an error is a row with the column `error`.
    `dd.load_record`, `dd.verify` and `drake-diff list` accept the directory, and the record of each trial in it.

    Args:
        path: The panel, a TOML file in the format described in `drake_diff.panels.results`.
        out: The output directory. The default is artifacts/<name of the file>.
        workers: The number of processes. None means one for each core.
        engine: "local" (processes of this machine) or "ray".
        address: "HOST:PORT" of a running Ray cluster. None starts one on this machine.
        progress: Called with the numbers of finished trials, of all trials and of errors.

    Returns:
        The rows and the summary, as in `table.csv` and `summary.json`.

    Raises:
        InputError: The panel file is invalid, its function cannot be loaded, or `out` has files not from a panel.
        ArtifactError: `out` contains another panel or a damaged record, or another process is writing there.
        MissingDependencyError: Ray is requested and not installed.

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
        raise InputError("address", got=address, expected='no address for engine="local", or engine="ray"')
    panel = load_panel(path)
    trials = expand(panel)
    function = TrialFunction(panel.evaluate, str(path.resolve().parent))
    _, function_sha256 = function.load()
    used = provenance_of()
    # The conditions that must be equal for all trials of a table.
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
