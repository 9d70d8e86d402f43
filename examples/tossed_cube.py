"""Identify a real cube's contact from motion-captured tosses, and predict tosses that were not used.

How the cube falls before it touches the board says where its centre of mass is, and how long the cameras' metre is: it
falls by 2 % less than 9.81 of them per s^2. How it bounces, slides and comes to rest says its friction, stiffness,
dissipation and size.

    python examples/tossed_cube.py    two minutes; writes artifacts/tossed_cube/fall and artifacts/tossed_cube/impacts,
                                      each with a report.html
    drake-diff verify --time-limit 600 artifacts/tossed_cube/impacts    fits again what is kept there
"""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

import drake_diff as dd
from drake_diff.identification.flights import first_state, flights_of

FOLDER, OUT = Path(__file__).parent / "cube_tosses", Path("artifacts/tossed_cube")
RATE, STEPS = 148, 2  # [Hz], and steps between samples
CENTERS, WIDTH = 0.047, 0.1048  # [m] from the cube's centre to the spheres' in its corners; the width as published
NAMES = ["cube.friction", "cube.stiffness", "cube.relaxation_time", "cube.radius"]


def recordings() -> list[dd.Recording]:
    """Every toss in Drake's coordinates, which have angular velocities in the world's frame."""
    data, found = np.load(FOLDER / "tosses.npz"), []
    each = np.split(data["state"].astype(float), np.cumsum(data["length"])[:-1])
    for number, xs in zip(data["number"], each, strict=True):
        xs[:, 7:10] = Rotation.from_quat(xs[:, [1, 2, 3, 0]]).apply(xs[:, 7:10])
        found.append(dd.Recording(f"toss {number}", "1", np.arange(len(xs)) / RATE, xs, np.zeros((len(xs) - 1, 0))))
    return found


def cube(gravity: np.ndarray | None = None) -> dd.Model:
    return dd.load_model(FOLDER / "cube.sdf", time_step=1 / RATE / STEPS, gravity=gravity)


def falls(model: dd.Model, logs: list[dd.Recording]) -> list[dd.Recording]:
    """The poses before the first contact; velocities were differences of them."""
    found = []
    for log in logs:
        first, last = (flights_of(model, log.xs) or [(1, 0)])[0]
        if first == 0 and last >= 9:
            poses = np.hstack([log.xs[: last + 1, :7], np.full((last + 1, 6), np.nan)])
            found.append(dd.Recording(log.name, "1", log.times[: last + 1], poses, log.us[:last]))
    return found


def error(model: dd.Model, log: dd.Recording, values: dict[str, object]) -> float:
    """[% of the width] the centre's distance from where it was measured, on average over a toss."""
    x0 = first_state(model, log, parameters=values)  # looks at nothing after the first contact
    xs = dd.rollout(model, x0, num_steps=STEPS * len(log.us), parameters=values).xs[::STEPS]
    return 100 / WIDTH * float(np.mean(np.linalg.norm(xs[:, 4:7] - log.xs[:, 4:7], axis=1)))


def main(fit: int = 12, unseen: int = 8) -> None:
    logs = recordings()
    air = falls(cube(), logs[:fit])
    fall = dd.identify(cube(), air, ["model.gravity", "cube.center_of_mass"], held_out=air[-1].name)
    gravity = fall.values["model.gravity"]
    metre = 9.81 / float(np.linalg.norm(gravity))
    print(f"In the air: {fall}\nIt falls by {9.81 / metre:.3f} m/s^2: a recorded metre is {metre:.4f} m.")
    model = cube(gravity)
    impacts = dd.identify(model, logs[: fit + 1], NAMES, motion="impacts", held_out=logs[fit].name)
    print(f"Through impacts: {impacts}")
    half = metre * (CENTERS + float(impacts.values["cube.radius"]))
    print(f"Half its width is {1e3 * half:.2f} mm; {1e3 * WIDTH / 2:.2f} mm were published.")
    dd.save(fall, OUT / "fall")
    dd.save(impacts, OUT / "impacts")
    for told, values in (("by hand", {}), ("as identified", dict(impacts.values))):
        errors = [metre * error(model, log, values) for log in logs[fit : fit + unseen]]
        print(f"Tosses not used, {told}: {np.mean(errors):.1f} % of the width off on average, {np.round(errors, 1)}")


if __name__ == "__main__":
    main()
