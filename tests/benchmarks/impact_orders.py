"""How value and slope of two impacts converge: along the flow by its tolerance, through Drake's steps by their length.

BALL bounces without loss or gravity and has a closed form. CUBE is tossed, and its reference is Drake's continuous
plant by Runge-Kutta 3 at an accuracy of 1e-11, with central differences of two widths, extrapolated. An order is the
slope of a straight line through log(error): over that of the tolerance, of the length of Drake's steps, or, along the
flow, of the number of steps in which something pushes.
"""

import os
from dataclasses import replace
from math import cos, pi, sin, sqrt

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")  # read when NumPy is imported: small matrices are slower on threads

import numpy as np  # noqa: E402
from impact_cases import Case, Material, Mover, Obstacle, corners  # noqa: E402
from impact_truth import Motion  # noqa: E402
from pydrake.autodiffutils import AutoDiffXd  # noqa: E402

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


def drake(one: Case, column: int, step: float) -> tuple[float, float]:
    """The loss, and its derivative by a number of the first state, through AutoDiffXd in Drake alone."""
    _, double = one.diagram(step)
    diagram = double.ToAutoDiffXd()
    plant = next(system for system in diagram.GetSystems() if hasattr(system, "SetPositionsAndVelocities"))
    root = diagram.CreateDefaultContext()
    context = plant.GetMyContextFromRoot(root)
    if plant.num_actuators():
        plant.get_actuation_input_port().FixValue(context, np.array([AutoDiffXd(one.input)]))
    x = [AutoDiffXd(float(value), [float(i == column)]) for i, value in enumerate(one.x0)]
    plant.SetPositionsAndVelocities(context, np.array(x))
    for _ in range(round(one.duration / step)):
        ahead = diagram.EvalUniquePeriodicDiscreteUpdate(root)
        root.SetDiscreteState(ahead)
    loss = one.loss(plant.GetPositionsAndVelocities(context))
    gradient = loss.derivatives()
    return float(loss.value()), float(gradient[0]) if len(gradient) else 0.0


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
