"""Trials as tasks of Ray: on a cluster that runs already, or on one of this machine alone."""

import os
import socket
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

from drake_diff.exceptions import InputError, MissingDependencyError
from drake_diff.panels.panel_file import Trial
from drake_diff.panels.trial_row import ONE_THREAD, Function, Row, TrialFunction, row_of

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
