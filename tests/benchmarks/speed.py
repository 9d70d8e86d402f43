"""Measure the time of derivatives relative to Drake's own step of the same motion, for docs/measured.md.

    python tests/benchmarks/speed.py [--quick] [--write docs/measured.md]

A Panda with seven joints moves freely, and a Go2 stands on its feet with time steps of 5, 20 and 50 ms.
The processor time of one thread is measured in rounds, in which each function is called in turn. A figure is the median
of the rounds' ratios. --write writes the table to the section `speed` of the page.
"""

import argparse
import gc
import platform
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)
import mujoco
import numpy as np
from pages import write_section
from panda_arm import panda_arm, state
from pydrake.multibody.tree import BodyIndex

sys.path.insert(0, str(Path(__file__).parents[1]))

from helpers.robots import FOOT, example_robot

import drake_diff as dd
from drake_diff.derivatives.steps import known_steps
from drake_diff.engines.mujoco import MujocoEngine
from drake_diff.exceptions import ModelWarning
from drake_diff.model.parameters import select
from drake_diff.model.step import advance
from drake_diff.optimize.ilqr.riccati import LinearQuadratic, solve_riccati

KNOTS, ROUNDS, QUICK_ROUNDS = 50, 15, 5
LEG = (0.0, 0.8, -1.6)  # [rad] hip, thigh and calf of the standing Go2
GAINS = {0.005: (40.0, 1.0), 0.02: (40.0, 0.5), 0.05: (20.0, 0.2)}  # (kp, kd) by time step [s] that keep it upright
Motion = tuple[dd.Model, np.ndarray, np.ndarray]
Call = tuple[Callable[[], object], int]  # function and its number of steps


def free_arm() -> Motion:
    with tempfile.TemporaryDirectory() as folder:
        model = dd.load_model(panda_arm(Path(folder)), time_step=0.005, weld_base="panda_link0")
    x, u = state(model, np.random.default_rng(0))
    x[model.nq :] *= 0.2
    us = np.tile(u, (KNOTS, 1))
    return model, np.array(dd.rollout(model, x, us).xs), us


def standing_robot(time_step: float) -> Motion:
    """Return a motion of a Go2 on four feet, 1 mm in the ground at the start, under PD control of its joints."""
    model = example_robot("go2.urdf", time_step, feet=True)
    x, nq = model.default_state, model.nq
    x[:7], x[7:nq], x[nq:] = [1, 0, 0, 0, 0, 0, 1], np.tile(LEG, 4), 0.0
    context = model.plant.CreateDefaultContext()
    model.plant.SetPositions(context, x[:nq])
    bodies = (model.plant.get_body(BodyIndex(i)) for i in range(1, model.plant.num_bodies()))
    x[6] += FOOT - 1e-3 - min(model.plant.EvalBodyPoseInWorld(context, b).translation()[2] for b in bodies)
    driven = np.argmax(model.actuation != 0, axis=0)
    (kp, kd), rest, xs, us = GAINS[time_step], x[driven + 1], [x], []
    for _ in range(KNOTS):
        us.append(kp * (rest - xs[-1][driven + 1]) - kd * xs[-1][nq + driven])
        xs.append(dd.step(model, xs[-1], us[-1]))
    return model, np.array(xs), np.array(us)


def calls_of(motion: Motion) -> dict[str, Call]:
    """Return the functions to time. The first is the base of the ratios."""
    model, xs, us = motion
    x, u, ends = xs[KNOTS // 2], us[KNOTS // 2], xs[1:]

    def simulate() -> None:
        for x, u in zip(xs, us, strict=False):
            advance(model.double, x, u)

    calls: dict[str, Call] = {
        "Drake's own step": (simulate, KNOTS),
        "`linearize`, a step": (lambda: dd.linearize(model, xs[:-1], us, x_next=ends), KNOTS),
        "`differentiate_step`": (lambda: dd.differentiate_step(model, x, u), 1),
        "AutoDiffXd, a step": (lambda: dd.differentiate_step(model, x, u, method="autodiff"), 1),
    }
    if not known_steps(model, select(model, ()), xs[:-1], us, ends).some_touch:
        bodies = MujocoEngine(model)
        bodies._set(x, u)
        A, B = np.zeros((model.nx, model.nx)), np.zeros((model.nx, model.nu))
        calls["MuJoCo's centred differences"] = (
            lambda: mujoco.mjd_transitionFD(bodies.model, bodies.data, 1e-6, True, A, B, None, None),
            1,
        )
    calls["Riccati sweep, a step"] = (_sweep(motion), KNOTS)
    return calls


def _sweep(motion: Motion) -> Callable[[], object]:
    model, xs, us = motion
    A, B, _ = dd.linearize(model, xs[:-1], us, x_next=xs[1:])
    n, m = model.nx, model.nu
    gradients, hessians = np.full((KNOTS + 1, n + m), 1e-2), np.tile(0.1 * np.eye(n + m), (KNOTS + 1, 1, 1))
    gradients[-1, n:], hessians[-1] = 0.0, np.diag([1.0] * n + [0.0] * m)
    problem = LinearQuadratic(
        F=np.concatenate([A, B], axis=2),
        gaps=np.zeros((KNOTS, n)),
        gradients=gradients,
        hessians=hessians,
        lower=-100.0 - us,
        upper=100.0 - us,
        start_lower=np.zeros(n),
        start_upper=np.zeros(n),
    )
    assert solve_riccati(problem, 0.0) is not None
    return lambda: solve_riccati(problem, 0.0)


def gradients_of(motion: Motion, count: int) -> dict[str, Call]:
    """Return a rollout, and its gradients for a loss of the last state and for a loss of the whole motion."""
    model, xs, us = motion
    inputs, x0 = np.resize(us, (count, model.nu)), xs[0]
    return {
        "rollout": (lambda: dd.rollout(model, x0, inputs), count),
        "of the end": (lambda: dd.differentiate_rollout(model, x0, inputs, lambda x: x @ x), count),
        "of all": (
            lambda: dd.differentiate_rollout(model, x0, inputs, lambda xs, us: (xs * xs).sum() + (us * us).sum()),
            count,
        ),
    }


def measured(calls: dict[str, Call], rounds: int) -> tuple[float, dict[str, float]]:
    """Return the median time of the first function [us], and the median ratio of each function to the first."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    repeats = {}
    for name, (call, count) in calls.items():
        call()
        repeats[name] = max(1, 20 // count)
    gc.collect()
    for _ in range(rounds):
        for name, (call, count) in calls.items():
            start = time.process_time()
            for _ in range(repeats[name]):
                call()
            times[name].append(1e6 * (time.process_time() - start) / count / repeats[name])
    base = next(iter(calls))
    ratios = {
        name: statistics.median(a / b for a, b in zip(found, times[base], strict=True)) for name, found in times.items()
    }
    return statistics.median(times[base]), ratios


def table(quick: bool) -> str:
    """Return the table in Markdown."""
    motions = {"Panda, free": free_arm()} | {f"Go2 stands, {1e3 * h:g} ms": standing_robot(h) for h in GAINS}
    found = {name: measured(calls_of(motion), QUICK_ROUNDS if quick else ROUNDS) for name, motion in motions.items()}
    rows = list(dict.fromkeys(row for _, ratios in found.values() for row in ratios))
    lines = [f"| Processor time | {' | '.join(motions)} |", "|---|" + "---|" * len(motions)]
    for row in rows:
        cells = []
        for base, ratios in found.values():
            times = f"{ratios[row]:.2g} times" if row in ratios else ""
            cells.append(f"{base:.0f} us" if row == rows[0] else times)
        lines.append(f"| {row} | {' | '.join(cells)} |")
    counts = (10, 100, 1000) if quick else (10, 100, 1000, 10_000)
    names = ["Panda, free", "Go2 stands, 5 ms"]
    for count in counts:
        of = [measured(gradients_of(motions[name], count), 3 if count > 100 else ROUNDS)[1] for name in names]
        cells = [f"{one['of the end']:.2g} and {one['of all']:.2g} rollouts" for one in of]
        lines.append(
            f"| gradient of {count:,} steps, of a loss of the end and of the whole | {' | '.join(cells)} | | |"
        )
    machine = f"Python {platform.python_version()}, MuJoCo {mujoco.__version__}"
    return "\n".join([*lines, "", f"Times Drake's own step of the same motion, or `rollout`; {machine}."])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer rounds, no 10,000 steps")
    parser.add_argument("--write", type=Path, help="the page that has the section")
    given = parser.parse_args()
    warnings.simplefilter("ignore", ModelWarning)
    text = table(given.quick)
    print(text)
    if given.write:
        write_section(given.write, "speed", text)


if __name__ == "__main__":
    main()
