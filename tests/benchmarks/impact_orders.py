"""How value and slope of two impacts converge: along the flow by its tolerance, through Drake's steps by their length.

    python tests/benchmarks/impact_orders.py [--out FILE.json] [--picture docs/impacts_orders.png]

BALL bounces without loss or gravity and has a closed form. CUBE is tossed, and its reference is Drake's continuous
plant by Runge-Kutta 3 at an accuracy of 1e-11, with central differences of two widths, extrapolated. An order is the
slope of a straight line through log(error): over that of the tolerance, of the length of Drake's steps, or, along the
flow, of the number of steps in which something pushes.
"""

import argparse
import json
import logging
import os
from dataclasses import replace
from math import cos, pi, sin, sqrt
from pathlib import Path

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")  # read when NumPy is imported: small matrices are slower on threads

import numpy as np  # noqa: E402
from impact_cases import Case, Material, Mover, Obstacle, corners  # noqa: E402
from impact_peers import drake  # noqa: E402
from impact_truth import Motion  # noqa: E402

from drake_diff.model.parameters import select  # noqa: E402
from drake_diff.motion.flow.integrate import pushing_of  # noqa: E402
from drake_diff.motion.flow.steps import FlowSteps  # noqa: E402

SPEED, START, RADIUS, PAIR = 2.0, 1.0, 0.1, 1e4


def _case(family: str, mover: Mover, gravity: float, x0: tuple[float, ...], of: int, column: int) -> Case:
    ground = Obstacle("ground", (), (0, 0, 0), (0, 0, 0), mover.material)
    weights = tuple(float(i == of) for i in range(len(x0)))
    return Case(0, 0, family, "lagged", (mover,), (ground,), (0, 0, -gravity), x0, 100, weights, None, (column,))


BALL = _case(
    "bounce",
    Mover("ball", 1.0, (RADIUS,), RADIUS, ((0, 0, 0),), Material(0.5, 2 * PAIR, 0.0, 0.0), "z"),
    0.0,
    (START, -SPEED),
    0,
    1,
)
CUBE = _case(
    "toss",
    Mover("cube", 0.1, (0.1,) * 3, 1e-3, corners((0.1,) * 3, 1e-3), Material(0.5, 4e3, 0.5, 0.0)),
    2.0,
    (cos(pi / 6), sin(pi / 6), 0, 0, 0, 0, 0.2, 0, 0, 0, 0, -0.1, -2.0),
    5,
    12,
)
TOLERANCES = tuple(10.0**-k for k in range(4, 13))
STEPS = (1e-2, 5e-3, 2e-3, 1e-3, 5e-4, 2e-4, 1e-4, 5e-5)  # [s]


def reference(one: Case) -> tuple[float, float]:
    """Value and slope of BALL in closed form; of CUBE by Drake's continuous plant."""
    if one is BALL:
        left = one.duration - pi / sqrt(PAIR)
        return RADIUS + SPEED * left - (START - RADIUS), -left
    motion, column = Motion(one, 1e-11), one.columns[0]

    def slope(width: float) -> float:
        ends = [one.loss(motion.end(one.changed(column, sign * width).x0)) for sign in (1, -1)]
        return float(ends[0] - ends[1]) / (2 * width)

    return float(one.loss(motion.end())), (4 * slope(1e-3) - slope(2e-3)) / 3


def along_the_flow(one: Case, tolerance: float) -> tuple[float, float, int]:
    """(value, slope, steps that push) of the package's method "continuous" at another tolerance than its own."""
    model = one.model()
    steps = FlowSteps(model, select(model, ()), tolerance)
    xs, _, flow = steps.roll(np.array(one.x0), lambda x, k: np.zeros(model.nu), one.num_steps)
    change = np.eye(model.nx)[:, one.columns[0]]
    for step in steps.derivatives(flow):
        change = step.A @ change
    return (
        float(one.loss(xs[-1])),
        float(np.dot(one.weights, change)),
        sum(bool(pushing_of(modes)) for modes in flow.modes),
    )


def order(over, errors) -> float:
    """p of error = c over^p, from the first to the least."""
    last = int(np.argmin(errors)) + 1
    return float(np.polyfit(np.log(over[:last]), np.log(errors[:last]), 1)[0])


def measure(one: Case, law: str | None) -> dict:
    """The errors of value and slope: along the flow, or through Drake's steps of a contact approximation."""
    value, slope = reference(one)
    if law is None:
        found = [along_the_flow(one, tolerance) for tolerance in TOLERANCES]
        over = {"tolerance": TOLERANCES, "steps": [count for _, _, count in found]}
    else:
        found = [drake(replace(one, law=law), one.columns[0], h) for h in STEPS]
        over = {"h": STEPS}
    return over | {"value": [abs(f[0] - value) for f in found], "slope": [abs(f[1] - slope) for f in found]}


def picture(found: dict, out: Path) -> None:
    """Both motions: errors along the flow by its tolerance, and through Drake's steps (lagged) by their length."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(1, 2, figsize=(9, 3.6), sharey=True)
    titles = {"continuous": 'method="continuous"', "lagged": "Drake's discrete steps, lagged"}
    for axis, (law, over) in zip(axes, (("continuous", "tolerance"), ("lagged", "h")), strict=True):
        for color, (name, laws) in zip(("C0", "C1"), found.items(), strict=True):
            for what, line in (("value", "--"), ("slope", "-")):
                one = laws[law]
                axis.loglog(one[over], one[what], line, color=color, marker=".", label=f"{name}: {what}")
        axis.set(title=titles[law], xlabel="tolerance" if over == "tolerance" else "step [s]", ylim=(1e-13, 1e3))
        axis.grid(alpha=0.3)
    axes[0].set_ylabel("error")
    axes[1].legend(fontsize=8, loc="lower right")
    figure.tight_layout()
    figure.savefig(out, dpi=80, metadata={"Software": None})


def run() -> dict:
    """Both motions, along the flow and through Drake's steps."""
    names = {"a ball bounces": BALL, "a cube is tossed": CUBE}
    return {
        name: {law or "continuous": measure(one, law) for law in (None, "lagged", "similar")}
        for name, one in names.items()
    }


def told(name: str, law: str, one: dict, what: str) -> str:
    """One curve: its orders, and its errors."""
    errors = one[what]
    orders = ", ".join(f"order {abs(order(one[by], errors)):.1f} by {by}" for by in one if by not in ("value", "slope"))
    return f"{name}, {law}, {what}: {orders}; errors " + " ".join(f"{e:.1e}" for e in errors)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--picture", type=Path)
    options = parser.parse_args()
    logging.getLogger("drake").setLevel(logging.ERROR)  # what it tells of every half space
    found = run()
    for name, laws in found.items():
        for law, one in laws.items():
            for what in ("value", "slope"):
                print(told(name, law, one, what), flush=True)
    if options.out:
        options.out.write_text(json.dumps(found, indent=1) + "\n")
    if options.picture:
        picture(found, options.picture)


if __name__ == "__main__":
    main()
