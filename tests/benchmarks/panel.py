"""Trials per second of a panel, as a ratio to one worker: rollouts of the cart-pole, 20 in each trial.

    python tests/benchmarks/panel.py [SEEDS]

Of the time between the first and the last trial that finish: what processes take to start (an import of drake_diff
each) is printed apart, and so is the parent's processor time, all that workers can wait for. Other processes on the
machine spoil the ratio: the load is printed.
"""

import os
import sys
import tempfile
import time
from pathlib import Path

import drake_diff as dd
from drake_diff.panels.workers import cores

ROOT = Path(__file__).parent.parent.parent
FUNCTION = f"""
import numpy as np
import drake_diff as dd

MODEL = dd.load_model({str(ROOT / "models" / "cart_pole.urdf")!r}, time_step=0.01)

def roll(trial):
    rng = np.random.default_rng(trial["seed"])
    ends = [dd.rollout(MODEL, 0.1 * rng.normal(size=4), np.zeros((100, 1))).xs[-1] for _ in range(20)]
    return {{"angle": float(np.mean(ends, axis=0)[1])}}
"""


def measure(path: Path, workers: int) -> tuple[float, float, float, bytes]:
    """Trials per second, seconds to the first, the parent's processor milliseconds per trial, and the table."""
    times: list[float] = []
    begin, used = time.monotonic(), time.process_time()
    out = path.parent / str(workers)
    dd.run_panel(path, out=out, workers=workers, progress=lambda *_: times.append(time.monotonic()))
    parent = 1e3 * (time.process_time() - used) / len(times)
    return (len(times) - 1) / (times[-1] - times[0]), times[0] - begin, parent, (out / "table.csv").read_bytes()


def main(seeds: int) -> None:
    folder = Path(tempfile.mkdtemp())
    (folder / "roll.py").write_text(FUNCTION)
    path = folder / "panel.toml"
    path.write_text(f'evaluate = "roll.py:roll"\nseeds = {seeds}\n[[cells]]\nmodel = "cart-pole"\n')
    print(f"{cores()} cores for this process; load before: {os.getloadavg()[0]:.1f}")
    one, _, parent, first = measure(path, 1)
    print(f"1 worker: {one:.1f} trials/s, parent {parent:.2f} ms of processor per trial")
    for workers in (2, 4):
        rate, start, parent, table = measure(path, workers)
        same = "the same table" if table == first else "ANOTHER TABLE"
        print(
            f"{workers} workers: {rate:.1f} trials/s, {rate / one:.2f} of one, {start:.1f} s to the first, "
            f"parent {parent:.2f} ms, {same}"
        )


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 400)
