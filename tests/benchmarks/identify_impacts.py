"""Whether the intervals of `identify_contact` have the truth: tosses of a cube whose contact is drawn by seed.

    python tests/benchmarks/identify_impacts.py [--seed 0] [--count 10]

Each case is six tosses of 0.4 s at 148 Hz, by steps a tenth as long as those that are fitted, so that the truth is not
the fit's own. Poses have noise of 0.1 mm and 1 mrad, and velocities are differences of them. The cube has eight corner
spheres, and an impact lasts for about six steps of the fit, which takes two between samples. Friction, radius and
stiffness of the corners are sought, from values that are off by up to 40, 10 and 65 %.
"""

import argparse
import os
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

import numpy as np  # noqa: E402
from rates import success_rate  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff.identification import identify_contact  # noqa: E402

RATE, STEPS, FINER, TOSSES, SAMPLES = 148, 2, 10, 6, 60
AT, MASS, INERTIA = 0.047, 0.37, 0.00081  # [m] of a corner's centre; [kg, kg m^2]
START = {"cube.friction": 0.15, "cube.radius": 0.0054, "cube.stiffness": 4e3}
MILLIMETRES, MILLIRADIANS = 0.1, 1.0  # of noise


def sdf():
    def properties(stiffness, relaxation_time):
        return (
            "<drake:proximity_properties>"
            f"<drake:point_contact_stiffness>{stiffness}</drake:point_contact_stiffness>"
            f"<drake:relaxation_time>{relaxation_time}</drake:relaxation_time>"
            f"<drake:mu_static>{START['cube.friction']}</drake:mu_static>"
            f"<drake:mu_dynamic>{START['cube.friction']}</drake:mu_dynamic></drake:proximity_properties>"
        )

    corners = "".join(
        f'<collision name="corner{i}"><pose>{a * AT} {b * AT} {c * AT} 0 0 0</pose><geometry><sphere>'
        f"<radius>{START['cube.radius']}</radius></sphere></geometry>{properties(START['cube.stiffness'], 0.005)}"
        "</collision>"
        for i, (a, b, c) in enumerate(product((-1, 1), repeat=3))
    )
    moments = f"<ixx>{INERTIA}</ixx><iyy>{INERTIA}</iyy><izz>{INERTIA}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>"
    return (
        '<sdf version="1.9" xmlns:drake="drake.mit.edu"><world name="toss"><model name="board"><static>true</static>'
        '<link name="board"><collision name="board"><geometry><plane><normal>0 0 1</normal></plane></geometry>'
        f'{properties(1e12, 0)}</collision></link></model><model name="cube"><link name="cube"><inertial>'
        f"<mass>{MASS}</mass><inertia>{moments}</inertia></inertial>{corners}</link></model></world></sdf>"
    )


def measured(xs, random):
    """(n, 13) with noise in the poses, and velocities that are differences of them."""
    xs = xs.copy()
    xs[:, 4:7] += 1e-3 * MILLIMETRES * random.standard_normal((len(xs), 3))
    off = Rotation.from_rotvec(1e-3 * MILLIRADIANS * random.standard_normal((len(xs), 3)))
    turn = off * Rotation.from_quat(xs[:, [1, 2, 3, 0]])
    xs[:, :4] = turn.as_quat()[:, [3, 0, 1, 2]]
    ahead = np.sign(np.sum(xs[1:, :4] * xs[:-1, :4], axis=1))
    xs[:, :4] *= np.concatenate([[1], np.cumprod(ahead)])[:, None]
    rates = RATE * (turn[1:] * turn[:-1].inv()).as_rotvec()
    xs[:, 7:10] = np.concatenate([rates[:1], (rates[1:] + rates[:-1]) / 2, rates[-1:]])
    xs[:, 10:13] = np.gradient(xs[:, 4:7], 1 / RATE, axis=0)
    return xs


def case(model, seed):
    """The truth by name, and its tosses."""
    random = np.random.default_rng(seed)
    truth = {
        "cube.friction": START["cube.friction"] * np.exp(random.uniform(-0.4, 0.5)),
        "cube.radius": START["cube.radius"] + random.uniform(-5e-4, 5e-4),
        "cube.stiffness": START["cube.stiffness"] * np.exp(random.uniform(-0.5, 0.5)),
    }
    starts = []
    for _ in range(TOSSES):
        turn = random.standard_normal(4)
        velocities = random.uniform(-4, 4, 3), np.array([1.0, 0, 0]) + random.uniform(-0.4, 0.4, 3)
        starts.append(np.concatenate([turn / np.linalg.norm(turn), [0, 0, 0.16], *velocities]))
    finer, each, logs = model.at_time_step(model.time_step / FINER), STEPS * FINER, []
    for k, x0 in enumerate(starts):
        xs = measured(dd.rollout(finer, x0, num_steps=SAMPLES * each, parameters=truth).xs[::each], random)
        logs.append(dd.Recording(f"toss {k}", "1", np.arange(len(xs)) / RATE, xs, np.zeros((len(xs) - 1, 0))))
    return truth, logs


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="of the first case; the others follow")
    parser.add_argument("--count", type=int, default=10)
    given = parser.parse_args()
    covered, offs, halves, seconds = [], [], [], []
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cube.sdf"
        path.write_text(sdf())
        model = dd.load_model(path, time_step=1 / RATE / STEPS)
        cases = [case(model, seed) for seed in range(given.seed, given.seed + given.count)]
        for seed, (truth, logs) in enumerate(cases, given.seed):
            begun = time.process_time()
            found = identify_contact(model, logs, list(truth))
            seconds.append(time.process_time() - begun)
            told = []
            for name, value in truth.items():
                low, high = found.intervals[name]
                covered.append(bool(low <= value <= high))
                offs.append(float(found.values[name]) / value - 1)
                halves.append((high - low) / 2 / value)
                missed = "" if covered[-1] else " MISSED"
                told.append(f"{name} {100 * offs[-1]:+.1f} %, +- {100 * halves[-1]:.1f} %{missed}")
            print(f"{seed:3} {seconds[-1]:5.1f} s  {'; '.join(told)}", flush=True)
    for k, name in enumerate(START):
        own = slice(k, None, len(START))
        rate = success_rate(sum(covered[own]), len(covered[own]))
        print(
            f"{name}: {sum(covered[own])} of {len(covered[own])} intervals have the truth ({rate.lower:.3f} to "
            f"{rate.upper:.3f}), off by {100 * np.median(np.abs(offs[own])):.2g} % as a rule, half an interval "
            f"{100 * np.median(halves[own]):.2g} %"
        )
    rate = success_rate(sum(covered), len(covered))
    print(
        f"all: {sum(covered)} of {len(covered)} ({rate.lower:.3f} to {rate.upper:.3f}), {np.mean(seconds):.3g} s a fit"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
