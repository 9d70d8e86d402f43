"""Trials evaluated by an engine: processes of this machine, or Ray."""

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager
from typing import Any

from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.panels.local_workers import local_answers
from drake_diff.panels.panel_file import Trial
from drake_diff.panels.ray_workers import ray_pool
from drake_diff.panels.trial_row import DIED, Row, TrialFunction

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
