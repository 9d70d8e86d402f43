"""Iterations of `dd.solve` from a solution, with the multipliers that it carries and without, on tasks that change.

    pip install -e '.[test]'
    python tests/benchmarks/warm_starts.py [--count 3] [--seed 0] [--markdown]

Tasks of `task_cases.py` that collocation solves. Each is solved, then again from its solution with the first state
moved by a random part of 1 (0: the same task), by --seed. `cold` is the search from a straight line.
"""

import argparse
import logging
import os
import sys
import warnings
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")
sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np  # noqa: E402
from tasks import drawn  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff.exceptions import DrakeDiffError, ModelWarning  # noqa: E402

NAMES = (
    *("pendulum_weak_motor", "pendulum_least_time", "cart_pole_least_effort", "cart_pole_rail_and_force"),
    *("cart_pole_least_time", "acrobot_swing_up", "crane_least_time", "crane_small_sway", "block_top_speed"),
    *("ur5_joint_goal", "parallel_parking", "bicycle_around_disks", "dubins_least_time"),
    *("planar_quadrotor_least_time", "planar_quadrotor_flip"),
)
MOVED = (0.0, 1e-3, 1e-2, 1e-1, 0.3)  # of the first state
WAYS = ("cold", "motion", "motion and multipliers")


def moved(problem, size, random):
    """The problem with each entry of its first state moved by up to `size`, within its bounds."""
    b, x0 = problem.bounds, np.array(problem.x0)
    x0 = np.clip(x0 + size * random.uniform(-1, 1, len(x0)), b.x_lower, b.x_upper)
    return replace(problem, x0=x0)


def counted(count, seed):
    """Iterations by how far the state was moved, a list of those of each way; and how many were no success."""
    taken, lost = defaultdict(list), defaultdict(int)
    for name in NAMES:
        for number in range(count):
            problem = drawn(name, seed, number).problem
            known = dd.solve(problem, method="collocation")
            if not known.success:
                continue
            for size in MOVED:
                random = np.random.default_rng([seed, number])
                try:
                    asked = moved(problem, size, random)
                except DrakeDiffError:  # the moved state is not allowed
                    continue
                guesses = (None, replace(known, multipliers=None), known)
                found = [dd.solve(asked, method="collocation", initial_guess=guess) for guess in guesses]
                for way, solution in zip(WAYS, found, strict=True):
                    lost[size, way] += not solution.success
                if all(solution.success for solution in found):
                    taken[size].append([len(solution.iterations) - 1 for solution in found])
    return taken, lost


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=3)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--markdown", action="store_true")
    options = parser.parse_args()
    logging.getLogger("drake").setLevel(logging.ERROR)
    warnings.simplefilter("ignore", ModelWarning)
    taken, lost = counted(options.count, options.seed)
    mark = "|" if options.markdown else " "
    rows = [("first state moved by", "solves", *WAYS, "most with multipliers", "lost (cold, motion, both)")]
    for size in MOVED:
        counts = np.array(taken[size])
        means = [f"{mean:.1f}" for mean in np.mean(counts, axis=0)]
        told = ", ".join(str(lost[size, way]) for way in WAYS)
        rows.append((f"{size:g}", str(len(counts)), *means, str(np.max(counts[:, -1])), told))
    for i, row in enumerate(rows):
        print(mark, f" {mark} ".join(row), mark)
        if options.markdown and not i:
            print("|" + "---|" * len(row))


if __name__ == "__main__":
    main()
