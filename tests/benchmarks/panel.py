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

from loky import cpu_count

import drake_diff as dd

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


REPEATS = 3  # in turns, and the best of each: what else the machine does slows some of them


def measure(path: Path, workers: int, out: Path) -> tuple[float, float, float, bytes]:
    """Trials per second, seconds to the first, the parent's processor milliseconds per trial, and the table."""
    times: list[float] = []
    begin, used = time.monotonic(), time.process_time()
    dd.panels.run_panel(path, out=out, workers=workers, progress=lambda *_: times.append(time.monotonic()))
    parent = 1e3 * (time.process_time() - used) / len(times)
    return (len(times) - 1) / (times[-1] - times[0]), times[0] - begin, parent, (out / "table.csv").read_bytes()


def main(seeds: int) -> None:
    folder = Path(tempfile.mkdtemp())
    (folder / "roll.py").write_text(FUNCTION)
    path = folder / "panel.toml"
    path.write_text(f'evaluate = "roll.py:roll"\nseeds = {seeds}\n[[cells]]\nmodel = "cart-pole"\n')
    print(f"{cpu_count()} cores for this process; load before: {os.getloadavg()[0]:.1f}")
    crews = (1, 2, 4)
    found = {crew: [] for crew in crews}
    for turn in range(REPEATS):
        for crew in crews:
            found[crew].append(measure(path, crew, folder / f"{crew}_{turn}"))
    one, tables = max(row[0] for row in found[1]), {row[3] for rows in found.values() for row in rows}
    for crew, rows in found.items():
        rates, starts, parents, _ = zip(*rows, strict=True)
        told = ", ".join(f"{rate:.1f}" for rate in rates)
        print(
            f"{crew} workers: {told} trials/s, the best {max(rates) / one:.2f} of one worker's; "
            f"{min(starts):.1f} s to the first; parent {min(parents):.2f} ms of processor per trial"
        )
    print(f"{len(tables)} different tables, load after: {os.getloadavg()[0]:.1f}")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
