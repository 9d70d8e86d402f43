"""Tasks on which one order of gradient does well and another badly, after Suh et al. 2022: see `gradient_panel`.

Each is so small that a panel of all takes minutes. The ball has a mass of 1 kg and a radius of 0.1 m; gravity is
9.81 m/s^2.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, RevoluteJoint, SpatialInertia, UnitInertia
from pydrake.systems.framework import DiagramBuilder

from drake_diff._base.arrays import Array
from drake_diff.model.model import Model, model_from_diagram
from drake_diff.motion.gradient import differentiate_rollout
from drake_diff.motion.rollout import roll_states
from drake_diff.studies.gradient_estimates import GradientCase

GRAVITY, MASS, RADIUS, ROD = 9.81, 1.0, 0.1, 0.5
AXES = {"x": [1, 0, 0], "z": [0, 0, 1]}


def double_integrator(
    time_step: float = 0.1, num_steps: int = 10, sigmas: tuple[float, ...] = (0.1, 0.3, 1.0)
) -> GradientCase:
    """Two forces [N], each for half of the time, bring a mass to x = 1 m: f is quadratic, so dF/dx = df/dx."""
    model = _ball(time_step, "x", motor=True)
    half = num_steps // 2
    inputs = np.repeat(np.eye(2), half, axis=0)
    v = time_step / MASS * np.cumsum(inputs, axis=0)
    x_end, v_end = time_step * v.sum(axis=0), v[-1]
    hessian = 2 * np.outer(x_end, x_end) + 0.2 * np.outer(v_end, v_end)

    def closed_form(z: Array, sigma: float) -> tuple[float, Array]:
        value = (x_end @ z - 1) ** 2 + 0.1 * (v_end @ z) ** 2 + sigma**2 / 2 * np.trace(hessian)
        return float(value), hessian @ z - 2 * x_end

    best = closed_form(np.linalg.solve(hessian, 2 * x_end), max(sigmas))[0]
    return _rollout_case(
        model,
        lambda x: (x[0] - 1) ** 2 + 0.1 * x[1] ** 2,
        inputs=inputs,
        name="double_integrator",
        about="two forces bring a mass to a place: smooth, quadratic",
        start=np.zeros(2),
        sigmas=sigmas,
        rate=0.8 / float(np.trace(hessian)),
        goal=best + 0.2,  # of the 1 that the start is above it
        closed_form=closed_form,
    )


def wall(distance: float = 0.06, height: float = 0.02, sigmas: tuple[float, ...] = (0.05, 0.1, 0.2)) -> GradientCase:
    """The angle [rad] of a throw at 1 m/s, as far as it goes; a wall stops what flies below its top: f jumps there.

    f = -x^2 with x the place [m] where the ball comes down, or that of the wall (Suh et al., ball with wall).
    """
    a = GRAVITY * distance**2 / 2
    root, kink = np.sqrt(distance**2 - 4 * a * (a + height)), np.arcsin(GRAVITY * distance) / 2
    # Of a period of pi: the angles [rad] at which the ball just clears the wall, and at which it just reaches it.
    edges = np.array([*np.arctan((distance + root * np.array([-1, 1])) / (2 * a)), kink, np.pi / 2 - kink])

    def land(theta: Array) -> tuple[Array, Array]:
        reach = np.sin(2 * theta) / GRAVITY
        top = distance * np.tan(theta) - GRAVITY * distance**2 / (2 * np.cos(theta) ** 2)
        stopped = (reach >= distance) & (top < height)
        slope = -4 * reach * np.cos(2 * theta) / GRAVITY
        return np.where(stopped, -(distance**2), -(reach**2)), np.where(stopped, 0.0, slope)

    def closed_form(x: Array, sigma: float) -> tuple[float, Array]:
        return _smoothed_pieces(lambda t: land(t)[0], edges, float(x[0]), sigma)

    return GradientCase(
        name="wall",
        about="the angle of a throw over a wall: the loss jumps where the ball just clears it",
        f=lambda x: float(land(x)[0][0]),
        derivative=lambda x: land(x)[1],
        start=np.array([0.6]),
        sigmas=sigmas,
        rate=2.0,
        goal=-0.006,  # F is -0.0041 at the start and -0.0075 at its least, of sigma = 0.2
        closed_form=closed_form,
    )


def _smoothed_pieces(f: Callable[[Array], Array], edges: Array, x: float, sigma: float) -> tuple[float, Array]:
    """F and dF/dx = E[f(x + w) w] / sigma^2, Gauss-Legendre between `edges` (of period pi), to 10 sigma."""
    low, high = x - 10 * sigma, x + 10 * sigma
    periods = np.arange(np.floor(low / np.pi) - 1, np.ceil(high / np.pi) + 1)
    inner = np.sort((edges + np.pi * periods[:, None]).ravel())
    breaks = np.unique([*np.linspace(low, high, 41), *inner[(inner > low) & (inner < high)]])
    nodes, weights = np.polynomial.legendre.leggauss(16)
    value = slope = 0.0
    for a, b in pairwise(breaks):
        t = (a + b) / 2 + (b - a) / 2 * nodes
        w = t - x
        mass = f(t) * np.exp(-((w / sigma) ** 2) / 2) * weights * (b - a) / 2 / (sigma * np.sqrt(2 * np.pi))
        value, slope = value + mass.sum(), slope + (mass * w).sum() / sigma**2
    return float(value), np.array([slope])


def bounce(
    stiffness: float = 1e5, time_step: float = 0.01, num_steps: int = 20, sigmas: tuple[float, ...] = (0.01, 0.03)
) -> GradientCase:
    """The height [m] to drop a ball from, so that at the end it is 0.15 m high; the contact has `stiffness` [N/m]."""
    return _rollout_case(
        _ball(time_step, "z", stiffness=stiffness),
        lambda x: 100 * (x[0] - 0.15) ** 2,
        states=np.array([[1.0], [0.0]]),
        inputs=np.zeros((num_steps, 1)),
        name=f"bounce_k{stiffness:.0e}".replace("+0", ""),
        about=f"a ball dropped on ground of {stiffness:g} N/m: the stiffer, the steeper between the steps",
        start=np.array([0.28]),
        sigmas=sigmas,
        rate=0.001,
        goal=0.15,  # F is 0.09 from 0.346 m, whence it has not landed yet; 0.3 (stiff) to 0.6 (soft) at the start
    )


def push(time_step: float = 0.02, num_steps: int = 20, sigmas: tuple[float, ...] = (0.5, 2.0)) -> GradientCase:
    """A force [N] that slides a ball by 0.3 m: friction of 0.5 holds it up to 4.9 N, the start is 2 N."""
    return _rollout_case(
        _ball(time_step, "xz", stiffness=1e4, friction=0.5, motor=True),
        lambda x: 10 * (x[0] - 0.3) ** 2,
        inputs=np.ones((num_steps, 1)),
        x0=np.array([0, RADIUS - MASS * GRAVITY / 1e4, 0, 0]),  # at rest in the ground
        name="push",
        about="a force below the friction limit: the derivative there is next to 0",
        start=np.array([2.0]),
        sigmas=sigmas,
        rate=8.0,
        goal=0.45,  # F is 0.89 at the start and 0.22 at its least, of sigma = 2
    )


def double_pendulum(
    time_step: float = 0.02,
    num_steps: int = 150,
    sigmas: tuple[float, ...] = (0.1, 0.3),
    *,
    rate: float = 0.05,
    goal: float = 0.4,
) -> GradientCase:
    """The angles [rad] to let a double pendulum go from, so that its tip is far to one side at the end: chaos."""
    builder, plant = _plant(time_step)
    # Two point masses at the ends of rods that weigh nothing, hinged about y; no actuators.
    end, frame = np.array([0, 0, -ROD]), plant.world_frame()
    for name in ("upper", "lower"):
        body = plant.AddRigidBody(name, SpatialInertia(MASS, end, UnitInertia.PointMass(end)))
        plant.AddJoint(RevoluteJoint(name, frame, body.body_frame(), [0, 1, 0]))
        frame = plant.AddFrame(FixedOffsetFrame(f"{name}_end", body.body_frame(), RigidTransform(end)))
    plant.Finalize()
    return _rollout_case(
        model_from_diagram(builder.Build()),
        lambda x: 1 + (np.sin(x[0]) + np.sin(x[0] + x[1])) / 2,
        states=np.eye(4, 2),
        inputs=np.zeros((num_steps, 2)),
        name=f"double_pendulum_{num_steps * time_step:g}s",
        about=f"a double pendulum let go for {num_steps * time_step:g} s: derivatives grow with the horizon",
        start=np.array([2.0, 0.5]),
        sigmas=sigmas,
        rate=rate,
        goal=goal,
    )


# What a panel compares where nothing else is asked, by the names of the cases.
CASES: dict[str, Callable[[], GradientCase]] = {
    "double_integrator": double_integrator,
    "wall": wall,
    "bounce_k1e3": lambda: bounce(1e3),
    "bounce_k1e5": lambda: bounce(1e5),
    "push": push,
    "double_pendulum_0.5s": lambda: double_pendulum(num_steps=25, rate=0.3, goal=1.1),
    "double_pendulum_3s": lambda: double_pendulum(num_steps=150),
}


def _rollout_case(
    model: Model,
    loss: Callable[[Any], Any],
    *,
    inputs: Array,
    states: Array | None = None,
    x0: Array | None = None,
    **fields: Any,
) -> GradientCase:
    """The case of `loss` of the last state, from x0 + states z under the force inputs z: (nx, n) and (N, n)."""
    start = np.zeros(model.nx) if x0 is None else x0
    moved = np.zeros((model.nx, inputs.shape[1])) if states is None else states

    def inputs_of(z: Array) -> Array:
        return (inputs @ z)[:, None] if model.nu else np.zeros((len(inputs), 0))

    def f(z: Array) -> float:
        return float(loss(roll_states(model, start + moved @ z, inputs_of(z))[-1]))

    def derivative(z: Array) -> Array:
        found = differentiate_rollout(model, start + moved @ z, inputs_of(z), loss)
        return moved.T @ found.by_x0 + (inputs.T @ found.by_us[:, 0] if model.nu else 0)

    return GradientCase(f=f, derivative=derivative, **fields)


def _plant(time_step: float) -> tuple[DiagramBuilder, MultibodyPlant]:
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=time_step, discrete_contact_approximation="sap", use_sampled_output_ports=False
    )
    return builder, AddMultibodyPlant(config, builder)[0]


def _ball(
    time_step: float, axes: str, *, stiffness: float | None = None, friction: float = 0.0, motor: bool = False
) -> Model:
    """A ball on slides along `axes`, a motor on the first, over a ground where there is a `stiffness`."""
    builder, plant = _plant(time_step)
    parent = plant.world_frame()
    for axis in axes:
        last = axis == axes[-1]
        inertia = SpatialInertia.SolidSphereWithMass(MASS, RADIUS) if last else SpatialInertia.Zero()
        body = plant.AddRigidBody(f"ball_{axis}", inertia)
        joint = plant.AddJoint(PrismaticJoint(axis, parent, body.body_frame(), AXES[axis]))
        if motor and axis == axes[0]:
            plant.AddJointActuator("motor", joint)
        parent = body.body_frame()
    if stiffness is not None:
        surface = ProximityProperties()
        mu = CoulombFriction(friction, friction)
        AddContactMaterial(dissipation=0.0, point_stiffness=2 * stiffness, friction=mu, properties=surface)
        surface.AddProperty("material", "relaxation_time", 1e-4)
        plant.RegisterCollisionGeometry(body, RigidTransform(), Sphere(RADIUS), "ball", surface)
        plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", surface)
    plant.Finalize()
    return model_from_diagram(builder.Build())
