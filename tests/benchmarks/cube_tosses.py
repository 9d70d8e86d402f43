"""A cube's contact identified from motion-captured tosses, and judged on tosses that were not used.

    python tests/benchmarks/cube_tosses.py TOSSES.npz [--fit 20] [--held-out 30] [--steps 2] [--seed 0] [--mujoco]

TOSSES.npz has `length` and `state` of real tosses at 148 Hz (ContactNets, BSD-3): quaternion, position, angular
velocity in the body's frame and velocity. Each toss that was held out is simulated from its first state; its error is
the mean distance of the centre over time, in % of the cube's width. First states are those measured, or those whose
motion goes through the positions before the first contact. Lengths are put right by gravity: in the air these cubes
fall by less than 9.81 m/s^2. Drake fits eight corner spheres; --mujoco gives the same simulated steps to MuJoCo's sysid
toolbox (pip install mujoco[sysid]).
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

import drake_diff as dd  # noqa: E402
from drake_diff._base.arrays import Array  # noqa: E402
from drake_diff.identification import first_state, identify_contact  # noqa: E402
from drake_diff.identification.flights import flights_of  # noqa: E402

RATE, WIDTH, MASS, INERTIA = 148.0, 0.1048, 0.37, 0.00081  # [Hz, m, kg, kg m^2] as published with the tosses
INSET = 0.0024  # [m] by hand, radius of a corner sphere: its centre is so far inside of three faces
GYRATION = (INERTIA / MASS) ** 0.5  # [m]
LENGTHS = {"half_width": WIDTH / 2, "corner": INSET, "gyration": GYRATION}
BY_HAND = {"friction": 0.15, "stiffness": 2e4, "relaxation_time": 0.005}  # [1, N/m, s]
NAMES = ("cube.friction", "cube.stiffness", "cube.relaxation_time", "cube.center_of_mass")


def sdf(half_width: float, corner: float, gyration: float) -> str:
    """The cube above the plane z = 0, as by hand; the plane is much stiffer, with the same friction."""
    at, inertia = half_width - corner, MASS * gyration**2

    def properties(stiffness: float, friction: float, relaxation_time: float) -> str:
        return (
            "<drake:proximity_properties>"
            f"<drake:point_contact_stiffness>{stiffness}</drake:point_contact_stiffness>"
            f"<drake:relaxation_time>{relaxation_time}</drake:relaxation_time>"
            f"<drake:mu_static>{friction}</drake:mu_static><drake:mu_dynamic>{friction}</drake:mu_dynamic>"
            "</drake:proximity_properties>"
        )

    own = properties(BY_HAND["stiffness"], BY_HAND["friction"], BY_HAND["relaxation_time"])
    corners = "".join(
        f'<collision name="corner{i}"><pose>{a * at} {b * at} {c * at} 0 0 0</pose>'
        f"<geometry><sphere><radius>{corner}</radius></sphere></geometry>{own}</collision>"
        for i, (a, b, c) in enumerate(product((-1, 1), repeat=3))
    )
    moments = f"<ixx>{inertia}</ixx><iyy>{inertia}</iyy><izz>{inertia}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>"
    return (
        '<sdf version="1.9" xmlns:drake="drake.mit.edu"><world name="toss"><model name="board"><static>true</static>'
        '<link name="board"><collision name="board"><geometry><plane><normal>0 0 1</normal></plane></geometry>'
        f"{properties(1e12, BY_HAND['friction'], 0.0)}</collision></link></model>"
        f'<model name="cube"><link name="cube"><inertial><mass>{MASS}</mass><inertia>{moments}</inertia></inertial>'
        f"{corners}</link></model></world></sdf>"
    )


def rotations(quaternions: Array) -> Array:
    """(n, 3, 3) of (n, 4) w, x, y, z."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1)[:, None]).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), -1, 0)


def read_tosses(path: Path) -> list[Array]:
    """Each (n, 13) in Drake's state: the angular velocity in the world's frame."""
    data = np.load(path)
    tosses = np.split(data["state"].astype(float), np.cumsum(data["length"])[:-1])
    for x in tosses:
        x[:, 7:10] = np.einsum("tij,tj->ti", rotations(x[:, :4]), x[:, 7:10])
    return tosses


def recording(name: str, xs: Array) -> dd.Recording:
    return dd.Recording(name, "1", np.arange(len(xs)) / RATE, xs, np.zeros((len(xs) - 1, 0)))


def model_of(steps: int, half_width: float = WIDTH / 2, corner: float = INSET, gyration: float = GYRATION) -> dd.Model:
    """By so many steps between two samples."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cube.sdf"
        path.write_text(sdf(half_width, corner, gyration))
        return dd.load_model(path, time_step=1 / RATE / steps)


def fall_of(tosses: list[Array], model: dd.Model) -> float:
    """[m/s^2] how fast they fall before the first contact, on average."""
    found = []
    for xs in tosses:
        flights = flights_of(model, xs)
        if flights and flights[0][0] == 0 and flights[0][1] >= 8:
            t = np.arange(flights[0][1] + 1) / RATE
            A = np.stack([np.ones_like(t), t, -(t**2) / 2], axis=1)
            found.append(np.linalg.lstsq(A, xs[: len(t), 6], rcond=None)[0][2])
    return float(np.mean(found))


def scaled(tosses: list[Array], by: float) -> list[Array]:
    """All lengths times `by`."""
    columns = np.ones(13)
    columns[[4, 5, 6, 10, 11, 12]] = by
    return [xs * columns for xs in tosses]


def errors_of(model: dd.Model, tosses: list[Array], starts: list[Array], values: dict[str, object]) -> Array:
    """[% of the width] of each toss, from its start."""
    found, each = [], round(1 / RATE / model.time_step)
    for xs, x0 in zip(tosses, starts, strict=True):
        motion = dd.rollout(model, x0, np.zeros(((len(xs) - 1) * each, 0)), parameters=values).xs[::each, 4:7]
        found.append(np.mean(np.linalg.norm(motion - xs[:, 4:7], axis=1)) / WIDTH * 100)
    return np.array(found)


def told(name: str, each: Array) -> str:
    below = f"below 10 %: {np.sum(each < 10)} of {len(each)}"
    return f"{name}: mean {np.mean(each):.1f} %, median {np.median(each):.1f} %, {below}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tosses", type=Path)
    parser.add_argument("--fit", type=int, default=20)
    parser.add_argument("--held-out", type=int, default=30)
    parser.add_argument("--steps", type=int, default=2, help="between two samples")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--mujoco", action="store_true")
    given = parser.parse_args()
    tosses = read_tosses(given.tosses)
    order = np.random.default_rng(given.seed).permutation(len(tosses))
    fitted = [tosses[i] for i in order[: given.fit]]
    held = [tosses[i] for i in order[len(order) - given.held_out :]]
    fall = fall_of(fitted, model_of(given.steps))
    print(f"the tosses that are fitted fall by {fall:.3f} m/s^2: lengths are taken times {9.81 / fall:.4f}", flush=True)
    fitted, held = (scaled(each, 9.81 / fall) for each in (fitted, held))
    logs = [recording(f"toss {i}", x) for i, x in enumerate(fitted)]
    begun = time.process_time()
    found = identify_contact(lambda **lengths: model_of(given.steps, **lengths), logs, NAMES, lengths=LENGTHS)
    print(f"{found}\n{found.steps} simulated steps, {time.process_time() - begun:.0f} s of CPU", flush=True)
    for name, interval in found.intervals.items():
        print(f"  {name}: {np.round(found.values[name], 6)} in {np.round(interval, 6).tolist()}")
    values = dict(found.values)
    lengths = {name: float(str(values.pop(name))) for name in LENGTHS}
    half = lengths["half_width"]
    print(f"half width {1e3 * half:.2f} mm, published {1e3 * WIDTH / 2:.2f} mm: {100 * (2 * half / WIDTH - 1):+.2f} %")
    own, other = float(np.asarray(found.values["cube.friction"])), BY_HAND["friction"]
    print(f"friction of the pair {2 * own * other / (own + other):.4f}, published about 0.15")
    by_hand, identified = model_of(given.steps), model_of(given.steps, **lengths)
    measured = [x[0] for x in held]
    flown = [first_state(by_hand, recording("toss", x)) for x in held]
    for tag, starts in (("measured first states", measured), ("first states by flight", flown)):
        print(told(f"Drake, by hand, {tag}", errors_of(by_hand, held, starts, {})))
        print(told(f"Drake, identified, {tag}", errors_of(identified, held, starts, dict(values))), flush=True)
    if given.mujoco:
        from cube_tosses_mujoco import fit_by_sysid

        # MuJoCo's velocity of a flight is that of Drake's steps: both take v + g h first, and then x + v h.
        begins = [first_state(by_hand, log) for log in logs]
        for line in fit_by_sysid(fitted, held, begins, flown, found.steps, given.steps):
            print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
