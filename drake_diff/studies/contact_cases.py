"""Seven textbook contact cases: a ball of radius r on a half space, and what rigid contact does there in closed form.

On rails (x and z, or z alone) the ball cannot turn and slides like a block. On an incline it is gravity that is turned,
not the ground. Where the rigid answer depends on the time step h, it is that of v' = v + h a, q' = q + h v', the scheme
of every engine here: what is left of a gap is due to the contact law.
"""

from dataclasses import dataclass, replace
from math import cos, exp, floor, radians, sin, sqrt
from typing import Any, Literal

import numpy as np
from pydrake.geometry import AddContactMaterial, HalfSpace, ProximityProperties, Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlantConfig
from pydrake.multibody.tree import PrismaticJoint, SpatialInertia
from pydrake.systems.framework import DiagramBuilder

from drake_diff._base.arrays import Array, positive_float
from drake_diff.exceptions import InputError
from drake_diff.model.model import Model

Kind = Literal["rest", "stop", "slide", "hold", "roll", "bounce", "damped bounce"]
FALLING: tuple[Kind, ...] = ("rest", "bounce", "damped bounce")  # on a vertical rail
RAILS = ("x", "z")  # of the others, but for "roll", where the ball is free
QUANTITIES: dict[Kind, tuple[str, str, str]] = {  # what is measured, its unit, and the derivative looked at
    "rest": ("depth at rest", "m", "d z_N / d z_0"),
    "stop": ("stopping distance", "m", "d x_N / d v_0"),
    "slide": ("speed after sliding down", "m/s", "d v_N / d v_0"),
    "hold": ("creep where it should stick", "m/s", "d x_N / d v_0"),
    "roll": ("speed after rolling down", "m/s", "d v_N / d v_0"),
    "bounce": ("rebound height, h -> 0", "m", "d z_N / d z_0"),
    "damped bounce": ("rebound height, h -> 0", "m", "d z_N / d z_0"),
}


@dataclass(frozen=True)
class ContactCase:
    """One case. `stiffness`, `dissipation` and `relaxation_time` are those of the pair of ball and ground.

    Raises InputError for a number that cannot be.

    Example:
        >>> from drake_diff.studies.contact_cases import ContactCase
        >>> case = ContactCase("stop", time_step=0.01, num_steps=40, speed=1.0)
        >>> case.rigid, case.rigid_gradient  # [m] in 20 steps that slip, and [s]
        (0.09699..., 0.2)
    """

    kind: Kind
    time_step: float  # [s]
    num_steps: int
    mass: float = 1.0  # [kg]
    radius: float = 0.1  # [m]
    gravity: float = 9.81  # [m/s^2]
    stiffness: float = 1e4  # [N/m]
    dissipation: float = 10.0  # of Hunt and Crossley, in Drake's similar and lagged [s/m]
    relaxation_time: float = 0.02  # of Drake's sap [s]
    friction: float = 0.5
    slope: float = 0.0  # [rad]
    speed: float = 0.0  # at the start, along x [m/s]
    height: float = 0.0  # of the drop [m]

    def __post_init__(self) -> None:
        for name in ("time_step", "mass", "radius", "gravity", "stiffness"):
            positive_float(name, getattr(self, name))
        if not 0 <= self.slope < np.pi / 2:
            raise InputError("slope [rad]", got=self.slope, expected="from 0 to below pi / 2")
        if self.kind in ("bounce", "damped bounce") and self.height <= 0:
            raise InputError("height [m]", got=self.height, expected="more than 0")

    @property
    def duration(self) -> float:
        """[s]"""
        return self.num_steps * self.time_step

    @property
    def normal_gravity(self) -> float:
        """[m/s^2]"""
        return self.gravity * cos(self.slope)

    @property
    def slope_gravity(self) -> float:
        """[m/s^2]"""
        return self.gravity * sin(self.slope)

    @property
    def resting_depth(self) -> float:
        """[m] m g / k: at rest the spring alone carries the weight."""
        return self.mass * self.normal_gravity / self.stiffness

    @property
    def axes(self) -> tuple[str, ...]:
        """The directions of the rails; none of a free ball."""
        return ("z",) if self.kind in FALLING else () if self.kind == "roll" else RAILS

    def place(self, name: str) -> int:
        """The index of x, z, vx or vz in the state."""
        free = ("qw", "qx", "qy", "qz", "x", "y", "z", "wx", "wy", "wz", "vx", "vy", "vz")
        names = (*self.axes, *("v" + axis for axis in self.axes)) if self.axes else free
        return names.index(name)

    @property
    def x0(self) -> Array:
        """(nx,) the start: touching as deep as it rests, or, where it falls, `height` above the ground."""
        x = np.zeros(2 * len(self.axes) or 13)
        if not self.axes:
            x[0] = 1.0
        x[self.place("z")] = self.radius + (self.height if self.kind in FALLING else -self.resting_depth)
        if self.kind not in FALLING:
            x[self.place("vx")] = self.speed
        return x

    def model(self, contact_approximation: str = "sap") -> Model:
        """The plant in Drake, which can be had again with another time step, approximation or field of this class."""
        return _build(self, contact_approximation)

    @property
    def rigid(self) -> float:
        """The rigid answer to what `QUANTITIES` names; of `rest`, the depth of a spring under a rigid weight."""
        return self._rigid_pair[0]

    @property
    def rigid_gradient(self) -> float:
        """The rigid answer to the derivative that `QUANTITIES` names."""
        return self._rigid_pair[1]

    @property
    def _rigid_pair(self) -> tuple[float, float]:
        match self.kind:
            case "rest":
                return self.resting_depth, 0.0
            case "stop":
                return stopping_staircase(self.speed, self.friction, self.gravity, self.time_step)
            case "slide":
                return sliding_speed(self.speed, self.slope, self.friction, self.gravity, self.duration), 1.0
            case "hold":
                return 0.0, 0.0
            case "roll":
                return rolling_factor(1, 1) * self.slope_gravity * self.duration, rolling_factor(1, 1)
            case _:
                e = hunt_crossley_restitution(self.dissipation, sqrt(2 * self.gravity * self.height))
                height, _, by_height = rebound(self.height, self.gravity, e, self.duration)
                return height, by_height

    @property
    def free_fall(self) -> float:
        """[m] how high the ball is at the end where nothing holds it: z_0 - g h^2 N (N + 1) / 2 in the scheme above."""
        h, N = self.time_step, self.num_steps
        return float(self.x0[self.place("z")]) - self.normal_gravity * h**2 * N * (N + 1) / 2


def contact_cases() -> tuple[ContactCase, ...]:
    """All seven, with parameters at which contact laws can be told apart; `dataclasses.replace` gives others."""
    return (
        ContactCase("rest", 1e-3, 1500),
        ContactCase("stop", 0.01, 40, speed=1.0),
        ContactCase("slide", 0.005, 200, friction=0.1, slope=radians(15), speed=0.5),
        ContactCase("hold", 0.005, 400, slope=radians(15)),
        ContactCase("roll", 0.002, 500, friction=0.6, slope=radians(20), stiffness=1e5),
        ContactCase("bounce", 2e-4, 1000, dissipation=0.0, relaxation_time=0.0, height=0.05),
        ContactCase("damped bounce", 2e-4, 1000, dissipation=0.3, relaxation_time=2e-3, height=0.05),
    )


def stopping_staircase(speed: float, friction: float, gravity: float, time_step: float) -> tuple[float, float]:
    """[m] v^2 / (2 mu g) in steps of h: h (n v - mu g h n (n + 1) / 2), n = floor(v / (mu g h)); derivative h n [s]."""
    n = floor(speed / (friction * gravity * time_step))
    return slid(speed, friction * gravity, time_step, n), time_step * n


def slid(speed: float, deceleration: float, time_step: float, n: int) -> float:
    """[m] the way of `n` steps of v' = v - h a, x' = x + h v'."""
    return time_step * (n * speed - deceleration * time_step * n * (n + 1) / 2)


def sliding_speed(speed: float, slope: float, friction: float, gravity: float, duration: float) -> float:
    """[m/s] v + g (sin a - mu cos a) t; its derivative by v is 1."""
    return speed + gravity * (sin(slope) - friction * cos(slope)) * duration


def rolling_factor(radius: float, effective_radius: float) -> float:
    """1 / (1 + 0.4 (r / r_e)^2) for a solid ball that rolls on radius r_e: 5 / 7 where r_e = r.

    Its acceleration is that times g sin a, and so much of a speed that it is given without turning is left once it
    rolls. 0.4 m r^2 is a solid ball's inertia.
    """
    return 1 / (1 + 0.4 * (radius / effective_radius) ** 2)


def rebound(height: float, gravity: float, restitution: float, duration: float) -> tuple[float, float, float]:
    """After a drop from H: the height of the rebound e^2 H [m]; at time t the height [m] and its derivative by H.

    With v = sqrt(2 g H) and t' = t - v / g these are e v t' - g t'^2 / 2 and (1 + e) g t' / v - e: the fall, then the
    saltation matrix [[-e, 0], [(1 + e) g / v, -e]] of the impact, then the flight.
    """
    v = sqrt(2 * gravity * height)
    left = duration - v / gravity
    z = restitution * v * left - gravity * left**2 / 2
    return restitution**2 * height, z, (1 + restitution) * gravity * left / v - restitution


def hunt_crossley_restitution(dissipation: float, speed: float) -> float:
    """e of f = k x (1 + d v) without gravity at impact speed v: d v (1 + e) = log((1 + d v) / (1 - e d v)).

    The integral of v dv / (1 + d v) = -(k / m) x dx from touch to touch, bisected. It depends on neither k nor m.
    """
    s = dissipation * speed
    if s == 0:
        return 1.0
    low, high = 0.0, min(1.0, 1 / s)
    for _ in range(100):
        e = (low + high) / 2
        # Below the root 1 - e s is more than (1 + s) exp(-s (1 + e)).
        low, high = (e, high) if 1 - e * s > (1 + s) * exp(-s * (1 + e)) else (low, e)
    return (low + high) / 2


def _build(case: ContactCase, approximation: str) -> Model:
    builder = DiagramBuilder()
    config = MultibodyPlantConfig(
        time_step=case.time_step,
        contact_model="point",
        discrete_contact_approximation=approximation,
        use_sampled_output_ports=False,
    )
    plant, _ = AddMultibodyPlant(config, builder)
    plant.mutable_gravity_field().set_gravity_vector([case.slope_gravity, 0, -case.normal_gravity])
    ball = plant.AddRigidBody("ball", SpatialInertia.SolidSphereWithMass(case.mass, case.radius))
    parent = plant.world_frame()
    for axis in case.axes:
        last = axis == case.axes[-1]
        body = ball if last else plant.AddRigidBody(f"ball_{axis}", SpatialInertia.Zero())
        direction = [float(axis == name) for name in "xyz"]
        plant.AddJoint(PrismaticJoint(f"ball_{axis}", parent, body.body_frame(), direction))
        parent = body.body_frame()
    # Of each side: Drake adds relaxation times, halves equal stiffnesses and averages dissipations and frictions.
    material, mu = ProximityProperties(), CoulombFriction(case.friction, case.friction)
    AddContactMaterial(
        dissipation=case.dissipation, point_stiffness=2 * case.stiffness, friction=mu, properties=material
    )
    material.AddProperty("material", "relaxation_time", case.relaxation_time / 2)
    plant.RegisterCollisionGeometry(ball, RigidTransform(), Sphere(case.radius), "ball", material)
    plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), HalfSpace(), "ground", material)
    plant.Finalize()

    def rebuild(*, contact_approximation: str = approximation, **changes: Any) -> Model:
        return _build(replace(case, **changes), contact_approximation)

    return Model(builder.Build(), source=None, rebuild=rebuild)
