"""Test whether `dd.explain` names a change in a model with contact: sphere, block, box, hopper or quadruped.

    pip install -e '.[test]'
    python tests/benchmarks/identify_contact_causes.py [--seed 0] [--count 24] [--robots anymal go2] [--by finer]

Each case is a motion of 0.6 s, sampled every 10 ms. Drake simulates it with the model's own steps of 5 or 2.5 ms.
Positions have a noise of 0.1 mm and 0.5 mrad, velocities of 5 mm/s and 25 mrad/s. A sphere and a block are thrown onto
the ground, a pusher moves a box, and a controller makes a hopper land and hop with recorded torques. In every third
case nothing is changed, and any named change is a false alarm. In the others, one parameter changes by 15 to 50 %: a
friction, stiffness, dissipation, radius (by 3 to 10 %), mass or damping, vertical gravity (by 5 to 20 %), or the height
of the ground (by 3 to 10 mm). A change that moves nothing by more than five times its noise is drawn again.

anymal, go2 and solo12 of example-robot-data, named by --robots, drop onto their feet and squat under a PD controller.
With --by finer, Drake uses a fifth of the model's step. With --by mujoco, MuJoCo simulates and nothing is changed: the
model's parameters are right and its contact law is not, so "not explained" is as good as "right".
"""

import argparse
import sys
import time
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np
from helpers.contact_recordings import DOGS, recorded
from rates import success_rate

import drake_diff as dd

ROBOTS = ("sphere_on_ground", "sliding_block", "hopper", "box_push")
STEPS = (0.005, 0.0025)  # [s]


def measure(robot, step, is_changed, seed, by="same"):
    model, log, name, truth = recorded(robot, step, is_changed, seed, by)
    begin = time.process_time()
    w = dd.explain(model, log)
    seconds = time.process_time() - begin
    every = [w.names, *w.alternatives]
    if not name:
        verdict = "false alarm" if w.names else "right" if w.explained else "not explained"
    elif w.names == (name,) and not w.alternatives:
        verdict = "named alone"
    elif (name,) in every:
        verdict = "named among alternatives"
    else:
        verdict = "another named" if w.names else "nothing" if w.explained else "not explained"
    inside = []
    if verdict.startswith("named"):
        within, value = np.atleast_2d(w.intervals[name]), np.atleast_1d(next(iter(truth.values())))
        known = np.isfinite(within).all(axis=1)
        inside = list(((within[:, 0] <= value) & (value <= within[:, 1]))[known])
    return verdict, inside, seconds, name, truth, w.sentence


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=24)
    parser.add_argument("--robots", nargs="+", default=ROBOTS, choices=(*ROBOTS, *DOGS))
    parser.add_argument("--by", default="same", choices=("same", "finer", "mujoco"))
    given = parser.parse_args()
    verdicts, insides, times = {}, [], []
    for i in range(given.count):
        turn, which = divmod(i, len(given.robots))
        robot, step, is_changed = given.robots[which], STEPS[turn % 2], turn % 3 != 2 and given.by != "mujoco"
        seed = 10000 * given.seed + i
        verdict, inside, seconds, name, truth, said = measure(robot, step, is_changed, seed, given.by)
        verdicts.setdefault(is_changed, []).append(verdict)
        insides += inside
        times.append(seconds)
        told = f"{name} {np.round(next(iter(truth.values())), 5)}" if name else "nothing"
        missed = f", outside {inside.count(False)} of {len(inside)} intervals" if not all(inside) else ""
        print(f"{i:3} {robot:16} {1e3 * step:3g} ms {seconds:5.1f} s {verdict}{missed}: {told} -> {said}", flush=True)
    for is_changed, each in sorted(verdicts.items()):
        for verdict in sorted(set(each)):
            rate = success_rate(each.count(verdict), len(each))
            what, within = "changed" if is_changed else "right", f"{100 * rate.lower:.3g} to {100 * rate.upper:.3g} %"
            print(f"{what} models, {verdict}: {each.count(verdict)} of {len(each)} ({within})")
    print(f"intervals that have the truth: {sum(insides)} of {len(insides)}")
    print(f"processor time: {np.mean(times):.3g} s a recording, {max(times):.3g} s at most")


if __name__ == "__main__":
    main()
