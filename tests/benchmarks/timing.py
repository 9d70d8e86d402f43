"""Repeated measurement in turns: each round has one block of every peer, so that a slow moment is slow for all.

What is compared is processor time, in which other work on the machine counts only by what it takes of caches; all
threads' count. The first call (import, compilation, allocation) is apart, and a block starts with one that does not
count where calls are short.
"""

import random
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

BLOCK = 0.02  # [s] of calls in one block, one call at least
SHORT = 0.01  # [s] of calls that one is made before each block for, which does not count
ROUNDS, FEWEST = 15, 3

Block = Callable[[int], tuple[float, float]]  # calls -> seconds on the wall and of the processor


class Spread(NamedTuple):
    median: float
    q1: float
    q3: float


@dataclass
class Sample:
    """Seconds a call, one number each block."""

    calls: int
    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)


def block(call: Callable[[], object]) -> Block:
    """Calls in this process."""

    def run(calls: int) -> tuple[float, float]:
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(calls):
            call()
        return time.perf_counter() - wall, time.process_time() - cpu

    return run


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """What it returns, and its seconds on the wall."""
    start = time.perf_counter()
    return call(), time.perf_counter() - start


def measure(peers: Mapping[str, Block], budget: float) -> dict[str, Sample]:
    """Up to ROUNDS rounds, FEWEST at least, the last begun before `budget` [s] is spent."""
    samples = {name: _calibrated(run) for name, run in peers.items()}
    order, turn = list(peers), random.Random(0)
    start = time.perf_counter()
    for done in range(ROUNDS):
        if done >= FEWEST and time.perf_counter() - start > budget:
            break
        turn.shuffle(order)
        for name in order:
            sample = samples[name]
            if sample.calls * SHORT > BLOCK:
                peers[name](1)
            wall, cpu = peers[name](sample.calls)
            sample.wall.append(wall / sample.calls)
            sample.cpu.append(cpu / sample.calls)
    return samples


def _calibrated(run: Block) -> Sample:
    calls = 1
    while (wall := run(calls)[0]) < BLOCK:
        calls = max(2 * calls, int(calls * BLOCK / max(wall, 1e-6)))
    return Sample(calls)


def spread(values: list[float]) -> Spread:
    """Median and quartiles."""
    q1, median, q3 = statistics.quantiles(values, n=4, method="inclusive")
    return Spread(median, q1, q3)


def ratios(ours: Sample, base: Sample) -> list[float]:
    """Processor time as a multiple of the base's, round by round."""
    return [a / b for a, b in zip(ours.cpu, base.cpu, strict=True)]
