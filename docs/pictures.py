"""Draw the pictures of docs/contact_models.md from Drake's own steps.

python docs/pictures.py    writes docs/pictures/contact_*.svg in half a minute; it needs matplotlib
"""

from collections.abc import Callable
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Polygon

import drake_diff as dd
from drake_diff.motion import RolloutGradient

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "docs/pictures"
BALL, BLOCK = ROOT / "models/sphere_on_ground.sdf", ROOT / "models/sliding_block.sdf"
X, Z, VX, VZ = 4, 6, 10, 12  # in a free body's state: quaternion, position, angular velocity, velocity
RADIUS, GRAVITY, FRICTION = 0.1, 9.81, 0.4  # radius of the ball [m], [m/s^2], friction of the block
BLUE, ORANGE, GREY = "#2060c0", "#d06000", "#707070"


def state(model: dd.Model, **values: float) -> np.ndarray:
    """Return the model's default state with some entries replaced: z=..., vx=..., vz=..."""
    x = model.default_state.copy()
    for name, value in values.items():
        x[{"z": Z, "vx": VX, "vz": VZ}[name]] = value
    return x


def shapes(axes: list[Axes]) -> None:
    """Draw how each contact model represents a tilted box that penetrates the ground, without a simulation."""
    turn = np.array([[np.cos(0.2), -np.sin(0.2)], [np.sin(0.2), np.cos(0.2)]])
    corners = turn @ np.array([[-1.0, 1, 1, -1], [-0.5, -0.5, 0.5, 0.5]]) + [[0], [0.55]]
    low, right = corners[:, 0], corners[:, 1]
    cross = low + (right - low) * (-low[1] / (right - low)[1])  # where the lower side of the box leaves the ground
    for axis, title in zip(axes, ("point contact", "corner spheres", "hydroelastic contact"), strict=True):
        axis.axhspan(-0.5, 0, color="#d8d8d0")
        axis.add_patch(Polygon(corners.T, fill=False, color=BLUE, lw=1.5))
        axis.set(title=title, xlim=(-1.5, 1.5), ylim=(-0.5, 1.5), aspect="equal")
        axis.axis("off")
    up = {"arrowprops": {"arrowstyle": "-|>", "color": ORANGE, "lw": 1.5}}
    axes[0].plot(*low, "o", color=ORANGE)
    axes[0].annotate("", (low[0], 0.75), low, **up)
    inside = turn @ np.array([[-0.85, 0.85, 0.85, -0.85], [-0.35, -0.35, 0.35, 0.35]]) + [[0], [0.55]]
    for center in inside.T:
        axes[1].add_patch(Circle(center, 0.15, fill=False, color=ORANGE, lw=1.5))
    axes[1].annotate("", (inside[0, 0], 0.75), (inside[0, 0], inside[1, 0] - 0.15), **up)
    left = corners[:, 3]
    out = low + (left - low) * (-low[1] / (left - low)[1])
    axes[2].add_patch(Polygon([low, cross, out], color=ORANGE, alpha=0.6, lw=0))
    for part, length in ((0.12, 0.55), (0.35, 0.4), (0.58, 0.28), (0.8, 0.15)):
        at = out + part * (cross - out)
        axes[2].annotate("", (at[0], length), (at[0], 0), **up)


def bounces(axes: list[Axes]) -> None:
    """Plot a drop from 0.3 m: the force over the depth of the first impact, and the height over time."""
    for law, colour in (("sap", BLUE), ("lagged", ORANGE)):
        model = dd.load_model(BALL, time_step=1e-4, contact_approximation=law)
        xs = dd.rollout(model, state(model, z=0.3), num_steps=8000).xs
        depth, force = RADIUS - xs[1:, Z], np.diff(xs[:, VZ]) / 1e-4 + GRAVITY  # for a mass of 1 kg
        first = slice(np.argmax(depth > 0), np.argmax(depth > 0) + 400)
        touching = depth[first] > -1e-3
        axes[0].plot(1e3 * depth[first][touching], force[first][touching], color=colour, label=law)
        axes[1].plot(1e-4 * np.arange(8001), xs[:, Z] - RADIUS, color=colour, label=law)
    times, gap = 1e-3 * np.arange(801), np.zeros(801)
    start, gap_0, speed = 0.0, 0.3 - RADIUS, 0.0  # at the start of a flight between two bounces
    while start < times[-1]:
        lands = start + (speed + np.sqrt(speed**2 + 2 * GRAVITY * gap_0)) / GRAVITY
        t = times[(times >= start) & (times <= lands)] - start
        gap[(times >= start) & (times <= lands)] = gap_0 + speed * t - GRAVITY * t**2 / 2
        start, gap_0, speed = lands, 0.0, 0.8 * (GRAVITY * (lands - start) - speed)
    axes[1].plot(times, gap, color=GREY, ls="--", label="rigid, e = 0.8")
    axes[0].set(xlabel="depth [mm]", ylabel="force of the ground [N]", title="one impact")
    axes[1].set(xlabel="time [s]", ylabel="gap [m]", title="its bounces")
    for axis in axes:
        axis.legend()


def friction(axes: list[Axes]) -> None:
    """Plot the speed of a block on the ground after one step over its initial speed."""
    speeds = np.linspace(0, 0.1, 101)
    for law, colour in (("sap", BLUE), ("lagged", ORANGE)):
        model = dd.load_model(BLOCK, time_step=0.01, contact_approximation=law)
        rest = dd.rollout(model, model.default_state, num_steps=200).xs[-1]
        after = []
        for speed in speeds:
            x = rest.copy()
            x[VX] += speed
            after.append(dd.step(model, x)[VX])
        axes[0].plot(speeds, after, color=colour, label=law)
    edge = FRICTION * GRAVITY * 0.01
    axes[0].plot(speeds, np.maximum(speeds - edge, 0), color=GREY, ls="--", label="Coulomb")
    axes[0].axvline(edge, color=GREY, lw=0.5)
    axes[0].set(xlabel="speed [m/s]", ylabel="speed after a step of 10 ms [m/s]", title="a block on the ground")
    axes[0].legend()


def touchdown(axes: list[Axes]) -> None:
    """Plot the speed after one step near the ground, and the height after half a second over the initial height."""
    ball = dd.load_model(BALL, time_step=0.005)
    gaps = np.linspace(-0.002, 0.01, 121)
    axes[0].plot(1e3 * gaps, [dd.step(ball, state(ball, z=RADIUS + gap, vz=-1.0))[VZ] for gap in gaps], color=BLUE)
    axes[0].set(xlabel="gap before the step [mm]", ylabel="vertical speed after it [m/s]", title="one step of 5 ms")
    heights = np.linspace(0.57, 0.63, 121)
    ends = [dd.rollout(ball, state(ball, z=z), num_steps=100).xs[-1, Z] for z in heights]
    axes[1].plot(heights, ends, color=BLUE, label="Drake's steps of 5 ms")

    def height(x: np.ndarray) -> float:
        return x[Z]

    def gradient(z: float, **options: str) -> RolloutGradient:
        return dd.differentiate_rollout(ball, state(ball, z=z), None, height, num_steps=100, **options)

    motions = [gradient(z, method="continuous").loss for z in heights[::12]]
    axes[1].plot(heights[::12], motions, color=ORANGE, label="the motion they stand for")
    for found, colour, reach in ((gradient(0.6), BLUE, 0.003), (gradient(0.6, method="continuous"), ORANGE, 0.012)):
        near = np.array([-reach, reach])
        axes[1].plot(0.6 + near, found.loss + found.by_x0[Z] * near, color=colour, lw=3, alpha=0.5)
    axes[1].set(xlabel="height at first [m]", ylabel="height after 0.5 s [m]", title="a bounce")
    axes[1].legend()


PICTURES: dict[str, tuple[int, Callable[[list[Axes]], None]]] = {
    "contact_shapes": (3, shapes),
    "contact_bounces": (2, bounces),
    "contact_friction": (1, friction),
    "contact_touchdown": (2, touchdown),
}


def draw(name: str, folder: Path) -> None:
    """Write one picture as an SVG file that is reproducible to the last byte."""
    count, paint = PICTURES[name]
    matplotlib.use("svg")
    with matplotlib.rc_context({"svg.hashsalt": name, "font.size": 9}):
        figure, axes = pyplot.subplots(1, count, figsize=(7.5 if count > 1 else 4.5, 2.2 if count > 2 else 3.0))
        paint(list(np.atleast_1d(axes)))
        figure.tight_layout()
        figure.savefig(folder / f"{name}.svg", metadata={"Date": None})
        pyplot.close(figure)


if __name__ == "__main__":
    for each in PICTURES:
        draw(each, FOLDER)
