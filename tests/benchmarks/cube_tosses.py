"""Identify a cube's contact from motion-captured tosses, and test the result on held-out tosses.

    python tests/benchmarks/cube_tosses.py TOSSES.npz [--fit 20] [--held-out 30] [--steps 2] [--seed 0]

TOSSES.npz has `length` and `state` of real tosses at 148 Hz (ContactNets, BSD-3): quaternion, position, angular
velocity in the body's frame and velocity. Each held-out toss is simulated from its first state. Its error is the mean
distance of the centre over time, in % of the cube's width. First states are the measured ones, or those whose motion
fits the positions before the first contact. Lengths are corrected by gravity, because in the air these cubes accelerate
by less than 9.81 m/s^2. The centre of mass is not in the middle, and the recorded axes of the cube are rotated between
sets of throws. cube_tosses_axes.py corrects the axes, based on the motion before the first contact. The Drake model has
eight corner spheres, and pads on the faces with their own friction.
"""

import argparse
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)
import numpy as np
from cube_tosses_axes import axes_of, rotations, turned

import drake_diff as dd
from drake_diff._base.arrays import Array
from drake_diff.identification import Identification, first_state, identify_contact
from drake_diff.identification.impacts import flights_of

RATE, WIDTH, MASS, INERTIA = 148.0, 0.1048, 0.37, 0.00081  # [Hz, m, kg, kg m^2] as published with the tosses
INSET = 0.0024  # [m] radius of a corner sphere, chosen by hand; its centre is this far inside three faces
GYRATION = (INERTIA / MASS) ** 0.5  # [m]
LENGTHS = {"half_width": WIDTH / 2, "corner": INSET, "gyration": GYRATION}
BY_HAND = {"friction": 0.15, "stiffness": 2e4, "relaxation_time": 0.005}  # [1, N/m, s]
NAMES = ("cube.friction", "pads.friction", "cube.stiffness", "cube.relaxation_time")
PAD, APART, RECESS = 0.005, 0.03, 1e-4  # [m] radius of a pad, its offset from the face's centre, depth of the corners


def sdf(half_width: float, corner: float, gyration: float, center: Array) -> str:
    """Return the SDF of the cube above z = 0, with values by hand, and of a much stiffer board with equal friction.

    Eight spheres are the corners of the cube. Four pads on each face lie a little further out and carry a flat cube.
    The board is a thick box, because Drake's query for overlaps crashed the process with pads above a plane.
    """
    at, inertia = half_width - corner - RECESS, MASS * gyration**2

    def properties(stiffness: float, friction: float, relaxation_time: float) -> str:
        return (
            "<drake:proximity_properties>"
            f"<drake:point_contact_stiffness>{stiffness}</drake:point_contact_stiffness>"
            f"<drake:relaxation_time>{relaxation_time}</drake:relaxation_time>"
            f"<drake:mu_static>{friction}</drake:mu_static><drake:mu_dynamic>{friction}</drake:mu_dynamic>"
            "</drake:proximity_properties>"
        )

    own = properties(BY_HAND["stiffness"], BY_HAND["friction"], BY_HAND["relaxation_time"])

    def spheres(name: str, radius: float, places: list[tuple[float, ...]]) -> str:
        return "".join(
            f'<collision name="{name}{i}"><pose>{a} {b} {c} 0 0 0</pose>'
            f"<geometry><sphere><radius>{radius}</radius></sphere></geometry>{own}</collision>"
            for i, (a, b, c) in enumerate(places)
        )

    corners = spheres("corner", corner, [(a * at, b * at, c * at) for a, b, c in product((-1, 1), repeat=3)])
    face = [(side * (half_width - PAD), a * APART, b * APART) for side, a, b in product((-1, 1), repeat=3)]
    pads = spheres("pad", PAD, [place[k:] + place[:k] for place in face for k in range(3)])
    moments = f"<ixx>{inertia}</ixx><iyy>{inertia}</iyy><izz>{inertia}</izz><ixy>0</ixy><ixz>0</ixz><iyz>0</iyz>"
    return (
        '<sdf version="1.9" xmlns:drake="drake.mit.edu"><world name="toss"><model name="board"><static>true</static>'
        '<link name="board"><collision name="board"><pose>0 0 -1 0 0 0</pose>'
        "<geometry><box><size>20 20 2</size></box></geometry>"
        f"{properties(1e12, BY_HAND['friction'], 0.0)}</collision></link></model>"
        f'<model name="cube"><link name="cube"><inertial><pose>{center[0]} {center[1]} {center[2]} 0 0 0</pose>'
        f"<mass>{MASS}</mass><inertia>{moments}</inertia></inertial>{corners}</link>"
        '<link name="pads"><inertial><mass>1e-9</mass><inertia><ixx>1e-12</ixx><iyy>1e-12</iyy><izz>1e-12</izz>'
        f"<ixy>0</ixy><ixz>0</ixz><iyz>0</iyz></inertia></inertial>{pads}</link>"
        '<joint name="glued" type="fixed"><parent>cube</parent><child>pads</child></joint></model></world></sdf>'
    )


def read_tosses(path: Path) -> list[Array]:
    """Read the tosses, each (n, 13), as Drake's states, with the angular velocity in the world frame."""
    data = np.load(path)
    tosses = np.split(data["state"].astype(float), np.cumsum(data["length"])[:-1])
    for x in tosses:
        x[:, 7:10] = np.einsum("tij,tj->ti", rotations(x[:, :4]), x[:, 7:10])
    return tosses


def recording(name: str, xs: Array) -> dd.Recording:
    return dd.Recording(name, "1", np.arange(len(xs)) / RATE, xs, np.zeros((len(xs) - 1, 0)))


def model_of(
    steps: int,
    center: Array,
    *,
    half_width: float = WIDTH / 2,
    corner: float = INSET,
    gyration: float = GYRATION,
) -> dd.Model:
    """Load the cube with its centre of mass at `center` [m] and `steps` time steps between two samples."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "cube.sdf"
        path.write_text(sdf(half_width, corner, gyration, center))
        return dd.load_model(path, time_step=1 / RATE / steps)


def flights(tosses: list[Array], model: dd.Model) -> dict[int, Array]:
    """Return the part of each toss (n, 13) before the first contact, if it has at least 6 samples."""
    found = {}
    for i, xs in enumerate(tosses):
        spans = flights_of(model, xs)
        if spans and spans[0][0] == 0:
            found[i] = xs[: spans[0][1] + 1]
    return found


def in_the_air(flown: list[Array]) -> tuple[Array, Array]:
    """Estimate gravity [m/s^2] and centre of mass [m] (6,) before the first contact, and their standard errors.

    The model p = p0 + v0 t + g t^2 / 2 - R c is fitted by least squares, with p0 and v0 of each toss eliminated. The
    errors are estimated from the scatter between tosses.
    """
    each = []
    for xs in flown:
        if len(xs) >= 10:
            t = np.arange(len(xs)) / RATE
            A = np.concatenate([t[:, None, None] ** 2 / 2 * np.eye(3), -rotations(xs[:, :4])], axis=2)
            Q = np.linalg.qr(np.stack([np.ones_like(t), t], axis=1))[0]
            rest = np.eye(len(t)) - Q @ Q.T
            each.append((np.einsum("st,tij->sij", rest, A).reshape(-1, 6), (rest @ xs[:, 4:7]).ravel()))
    H = sum(A.T @ A for A, _ in each)
    found = np.linalg.solve(H, sum(A.T @ y for A, y in each))
    scores = np.array([A.T @ (y - A @ found) for A, y in each])
    return found, np.sqrt(np.diag(np.linalg.solve(H, np.linalg.solve(H, scores.T @ scores).T)))


def scaled(tosses: list[Array], by: float) -> list[Array]:
    """Return the tosses with all lengths multiplied by `by`."""
    columns = np.ones(13)
    columns[[4, 5, 6, 10, 11, 12]] = by
    return [xs * columns for xs in tosses]


def errors_of(model: dd.Model, tosses: list[Array], starts: list[Array], values: dict[str, object]) -> Array:
    """Return the error [% of the width] of each toss, simulated from its start."""
    found, each = [], round(1 / RATE / model.time_step)
    for xs, x0 in zip(tosses, starts, strict=True):
        motion = dd.rollout(model, x0, np.zeros(((len(xs) - 1) * each, 0)), parameters=values).xs[::each, 4:7]
        found.append(np.mean(np.linalg.norm(motion - xs[:, 4:7], axis=1)) / WIDTH * 100)
    return np.array(found)


def told(name: str, each: Array) -> str:
    below = f"below 10 %: {np.sum(each < 10)} of {len(each)}"
    return f"{name}: mean {np.mean(each):.1f} %, median {np.median(each):.1f} %, {below}"


def tell(found: Identification) -> None:
    print(found)
    for name, interval in found.intervals.items():
        print(f"  {name}: {np.round(found.values[name], 6)} in {np.round(interval, 6).tolist()}")
    half = float(str(found.values["half_width"]))
    print(f"half width {1e3 * half:.2f} mm, published {1e3 * WIDTH / 2:.2f} mm: {100 * (2 * half / WIDTH - 1):+.2f} %")
    for body in ("cube", "pads"):
        own, other = float(np.asarray(found.values[f"{body}.friction"])), BY_HAND["friction"]
        print(f"friction of the pair {2 * own * other / (own + other):.4f} ({body}), published about 0.15")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tosses", type=Path)
    parser.add_argument("--fit", type=int, default=20)
    parser.add_argument("--held-out", type=int, default=30)
    parser.add_argument("--steps", type=int, default=2, help="between two samples")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    tosses = read_tosses(given.tosses)
    order = np.random.default_rng(given.seed).permutation(len(tosses))
    parts = order[: given.fit], order[: len(order) - given.held_out], order[len(order) - given.held_out :]
    middle = model_of(given.steps, np.zeros(3))
    axes = axes_of(flights(tosses, middle), len(tosses), RATE, set(parts[1].tolist()))
    print(
        f"{axes.sets} sets of throws; axes are {np.bincount(axes.quarter).tolist()} times turned by so many quarters;"
    )
    print(f"of the {len(parts[2])} held out {np.sum(axes.sure[parts[2]] > 0.95)} are sure to 95 %", flush=True)
    tosses = [turned(xs, quarter) for xs, quarter in zip(tosses, axes.quarter, strict=True)]
    fitted, others, held = ([tosses[i] for i in part] for part in parts)
    g, g_off = (v[:3] for v in in_the_air(list(flights(others, middle).values())))
    center, fall = axes.center, float(np.linalg.norm(g))
    print(f"{len(others)} tosses that were not held out fall by {np.round(g, 4)} +- {np.round(g_off, 4)} m/s^2:")
    print(f"lengths are taken times {9.81 / fall:.4f}")
    print(f"their centre of mass is at {np.round(1e3 * center, 2)} +- {np.round(1e3 * axes.errors, 2)} mm", flush=True)
    fitted, held = (scaled(each, 9.81 / fall) for each in (fitted, held))
    logs = [recording(f"toss {i}", x) for i, x in enumerate(fitted)]
    center = center * 9.81 / fall
    begun = time.process_time()
    found = identify_contact(lambda **lengths: model_of(given.steps, center, **lengths), logs, NAMES, lengths=LENGTHS)
    print(f"{time.process_time() - begun:.0f} s of CPU")
    tell(found)
    values = dict(found.values)
    lengths = {name: float(str(values.pop(name))) for name in LENGTHS}
    identified, measured = model_of(given.steps, center, **lengths), [x[0] for x in held]
    by_hand = [first_state(middle, recording("toss", x)) for x in held]
    flown = [first_state(identified, recording("toss", x)) for x in held]
    print(told("Drake, by hand, first states by flight", errors_of(middle, held, by_hand, {})))
    print(told("Drake, identified, measured first states", errors_of(identified, held, measured, dict(values))))
    errors = errors_of(identified, held, flown, dict(values))
    print(told("Drake, identified, first states by flight", errors))
    sure = axes.sure[parts[2]] > 0.95
    print(told("  those of them whose axes are sure to 95 %", errors[sure]), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
