"""Measure in rounds with one block of each peer, so that a slow period of the machine affects all peers.

The compared time is the processor time of all threads, which other work on the machine affects only through caches.
The first call (import, compilation, allocation) is timed separately. If calls are short, a block starts with a call
that does not count.
"""

import random
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

BLOCK = 0.02  # [s] of calls in one block, at least one call
SHORT = 0.01  # [s] per call, below which a block starts with a call that does not count
ROUNDS, FEWEST = 15, 3

Block = Callable[[int], tuple[float, float]]  # number of calls -> wall time and processor time [s]


class Spread(NamedTuple):
    median: float
    q1: float
    q3: float


@dataclass
class Sample:
    """Seconds per call, with one value for each block."""

    calls: int
    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)


def block(call: Callable[[], object]) -> Block:
    """Return a block of calls in this process."""

    def run(calls: int) -> tuple[float, float]:
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(calls):
            call()
        return time.perf_counter() - wall, time.process_time() - cpu

    return run


def timed(call: Callable[[], Any]) -> tuple[Any, float]:
    """Return the result of a call and its wall time [s]."""
    start = time.perf_counter()
    return call(), time.perf_counter() - start


def measure(peers: Mapping[str, Block], budget: float) -> dict[str, Sample]:
    """Run at least FEWEST and at most ROUNDS rounds. No other round begins after `budget` [s]."""
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
    """Return the median and the quartiles."""
    q1, median, q3 = statistics.quantiles(values, n=4, method="inclusive")
    return Spread(median, q1, q3)


def ratios(ours: Sample, base: Sample) -> list[float]:
    """Return the processor time as a multiple of the base's for each round."""
    return [a / b for a, b in zip(ours.cpu, base.cpu, strict=True)]
