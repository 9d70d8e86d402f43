"""Time the package's import and the command's help in fresh processes, with the imports of NumPy and of a plant."""

import resource
import subprocess
import sys
import time
from collections.abc import Iterator

from suite import Row, row
from timing import Block, measure, timed

BASE = "import numpy"
STARTS = {
    BASE: ["-c", BASE],
    "import pydrake.multibody.plant": ["-c", "import pydrake.multibody.plant"],
    "import drake_diff": ["-c", "import drake_diff"],
    "drake-diff --help": ["-m", "drake_diff.cli.main", "--help"],
}
BUDGET, QUICK_BUDGET = 15.0, 5.0  # [s]


def started(quick: bool) -> Iterator[Row]:
    """Yield a row for each kind of process, with the seconds from its start to its end."""
    print("start", file=sys.stderr, flush=True)
    firsts = {name: timed(lambda words=words: _run(words))[1] for name, words in STARTS.items()}
    samples = measure({name: _processes(words) for name, words in STARTS.items()}, QUICK_BUDGET if quick else BUDGET)
    about = {"model": "no model", "joints": 0, "quantity": "start", "horizon": None}
    for name, sample in samples.items():
        yield row(about, name, "a fresh process", firsts[name], sample, (BASE, samples[BASE]), None)


def _processes(words: list[str]) -> Block:
    """Return a block that starts a process per call and measures the processor time of these processes."""

    def run(calls: int) -> tuple[float, float]:
        wall, cpu = time.perf_counter(), _processor()
        for _ in range(calls):
            _run(words)
        return time.perf_counter() - wall, _processor() - cpu

    return run


def _run(words: list[str]) -> None:
    subprocess.run([sys.executable, *words], capture_output=True, check=True)


def _processor() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
