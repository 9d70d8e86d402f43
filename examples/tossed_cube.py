"""Identify the contact of a real cube from motion-captured tosses, and predict other tosses.

The fall determines the cameras' unit of length, and the bounces determine contact and size. The script takes 80 s:
`python examples/tossed_cube.py`. To repeat the fit: `drake-diff verify --time-limit 600 artifacts/tossed_cube/impacts`.
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import drake_diff as dd
from drake_diff.identification.impacts import first_state, flights_of

FOLDER, OUT = Path(__file__).parent / "cube_tosses", Path("artifacts/tossed_cube")
RATE, STEPS = 148, 2  # [Hz], and steps between samples
PADS, WIDTH = 0.0474, 0.1048  # [m] from the cube's centre to the centres of the pads on its faces; the published width
NAMES = ["cube.friction", "pads.friction", "cube.stiffness", "cube.radius", "pads.radius"]


def recording(name: str, xs: np.ndarray) -> dd.Recording:
    return dd.Recording(name, "1", np.arange(len(xs)) / RATE, xs, np.zeros((len(xs) - 1, 0)))


def in_the_air(model: dd.Model, log: dd.Recording) -> dd.Recording:
    """Return the poses before the first contact, without the velocities, which are differences of poses."""
    xs = log.xs[: flights_of(model, log.xs)[0][1] + 1].copy()  # each toss starts in the air
    xs[:, 7:] = np.nan
    return recording(log.name, xs)


def main(fit: int = 8, unseen: int = 8) -> None:
    data = np.load(FOLDER / "tosses.npz")
    xs, ends = data["state"].astype(float), np.cumsum(data["length"])[:-1]
    pose = Rotation.from_quat(xs[:, [1, 2, 3, 0]])
    turn = Rotation.from_rotvec(np.outer(np.repeat(data["quarter"], data["length"]), [np.pi / 2, 0, 0]))
    xs[:, :4], xs[:, 7:10] = (pose * turn).as_quat()[:, [3, 0, 1, 2]], pose.apply(xs[:, 7:10])  # in Drake's convention
    logs = [recording(f"toss {n}", part) for n, part in zip(data["number"], np.split(xs, ends), strict=True)]
    model = dd.load_model(FOLDER / "cube.sdf", time_step=1 / RATE / STEPS)
    air = [part for part in (in_the_air(model, log) for log in logs[:-unseen]) if len(part.xs) >= 10]
    fall = dd.identify(model, air, ["model.gravity"], held_out=air[-1].name)
    metre = 9.81 / float(np.linalg.norm(fall.values["model.gravity"]))
    print(f"In the air: {fall}\nIt falls by {9.81 / metre:.3f} m/s^2: a recorded metre is {metre:.4f} m.")
    model = dd.load_model(FOLDER / "cube.sdf", time_step=1 / RATE / STEPS, gravity=fall.values["model.gravity"])
    impacts = dd.identify(model, logs[: fit + 1], NAMES, motion="impacts", held_out=logs[fit].name)
    half = 1e3 * metre * (PADS + float(impacts.values["pads.radius"]))
    print(f"Through impacts: {impacts}\nHalf its width is {half:.2f} mm; {1e3 * WIDTH / 2:.2f} mm were published.")
    dd.save(fall, OUT / "fall")
    dd.save(impacts, OUT / "impacts")
    for told, values in (("by hand", {}), ("as identified", dict(impacts.values))):
        errors = []  # [% of the width] mean distance of the centre from the measured one over a toss
        for log in logs[-unseen:]:
            x0 = first_state(model, log, parameters=values)  # estimated from the samples before the first contact
            motion = dd.rollout(model, x0, num_steps=STEPS * len(log.us), parameters=values).xs[::STEPS]
            errors.append(100 * metre / WIDTH * np.linalg.norm(motion[:, 4:7] - log.xs[:, 4:7], axis=1).mean())
        print(f"Tosses not used, {told}: {np.mean(errors):.1f} % of the width off on average, {np.round(errors, 1)}")


if __name__ == "__main__":
    main()
