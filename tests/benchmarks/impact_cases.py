"""Seeded random motions through impact, each as a discrete model and as the same plant in continuous time.

`case(seed, number)` returns one case of a seed: a bounce, a toss, a slide that sticks, a roll, a rod or a pendulum
that strikes the ground, two bodies that hit each other, or a ball thrown at a box, capsule, cylinder or sphere. A case
depends only on its formulas and the seed. `Case.diagram(time_step)` builds the plant with Drake and does not use the
package. Only `Case.model()` imports it.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import pi, sqrt
from typing import Any

import numpy as np
from pydrake.geometry import (
    AddContactMaterial,
    Box,
    Capsule,
    Cylinder,
    HalfSpace,
    ProximityProperties,
    Sphere,
)
from pydrake.math import RigidTransform, RollPitchYaw, RotationMatrix
from pydrake.multibody.plant import AddMultibodyPlant, CoulombFriction, MultibodyPlant, MultibodyPlantConfig
from pydrake.multibody.tree import FixedOffsetFrame, PrismaticJoint, PrismaticSpring, RevoluteJoint, SpatialInertia
from pydrake.systems.framework import Diagram, DiagramBuilder

FAMILIES = ("bounce", "toss", "slide", "roll", "rod", "two", "wall", "pendulum")
STIFFNESS = "stiffness"
INTERVAL = 0.01  # [s] the model's step
STICTION = 1e-3  # [m/s]
AXES = {"x": [1.0, 0, 0], "y": [0, 1.0, 0], "z": [0, 0, 1.0]}


@dataclass(frozen=True)
class Material:
    """The material of one body in contact, with Drake's parameters."""

    friction: float
    stiffness: float  # [N/m]
    dissipation: float  # [s/m] of Hunt and Crossley
    relaxation_time: float  # [s] of sap

    def properties(self) -> ProximityProperties:
        found = ProximityProperties()
        friction = CoulombFriction(self.friction, self.friction)
        AddContactMaterial(self.dissipation, self.stiffness, friction, found)
        found.AddProperty("material", "relaxation_time", self.relaxation_time)
        return found


@dataclass(frozen=True)
class Mover:
    """A body with spheres of one `radius`: free without `axes`, "xz" on slides, "hinge" rotates about y at `pivot`."""

    name: str
    mass: float
    sizes: tuple[float, ...]  # a ball's radius, or the sides of a solid box
    radius: float
    centers: tuple[tuple[float, float, float], ...]
    material: Material
    axes: str = ""
    pivot: float = 0.0  # [m] height of the hinge
    arm: float = 0.0  # [m] distance of the ball below the hinge
    spring: float = 0.0  # [N/m] on the first slide, relaxed at 0
    effort: float = 0.0  # [N m] limit of a motor in the hinge

    def inertia(self) -> SpatialInertia:
        if len(self.sizes) == 1:
            ball = SpatialInertia.SolidSphereWithMass(self.mass, *self.sizes)
            return ball.Shift([0, 0, self.arm])  # about the body's origin, from which the ball hangs
        return SpatialInertia.SolidBoxWithMass(self.mass, *self.sizes)


@dataclass(frozen=True)
class Obstacle:
    """A shape that is fixed in the world: "ground", "box", "capsule", "cylinder" or "sphere"."""

    kind: str
    sizes: tuple[float, ...]
    position: tuple[float, float, float]
    turn: tuple[float, float, float]  # roll, pitch and yaw
    material: Material

    def shape(self) -> Any:
        shapes = {"ground": HalfSpace, "box": Box, "capsule": Capsule, "cylinder": Cylinder, "sphere": Sphere}
        return shapes[self.kind](*self.sizes)

    def pose(self) -> RigidTransform:
        return RigidTransform(RotationMatrix(RollPitchYaw(np.array(self.turn))), np.array(self.position))


@dataclass(frozen=True)
class Case:
    """One motion, its loss at the end, and the columns of its gradient that are tested.

    A column is an index of the state, a contact parameter "body.quantity", the common "stiffness" of all shapes, or the
    constant "input". The stiffness is that of both sides, because in Drake's discrete plants a contact force acts
    nearer to the stiffer side, and in its continuous plants it acts in the middle.
    """

    seed: int
    number: int
    family: str
    law: str  # "lagged", "similar" or "sap"
    movers: tuple[Mover, ...]
    obstacles: tuple[Obstacle, ...]
    gravity: tuple[float, float, float]
    x0: tuple[float, ...]
    num_steps: int
    weights: tuple[float, ...]  # of the final state; loss = weights x, or (weights x - target)^2 / 2
    target: float | None
    columns: tuple[int | str, ...]  # the first is the one used in comparisons with others
    input: float = 0.0

    @property
    def name(self) -> str:
        return f"{self.family} {self.seed}.{self.number}"

    @property
    def duration(self) -> float:
        return self.num_steps * INTERVAL

    def loss(self, x: Any) -> Any:
        along = sum(w * x[i] for i, w in enumerate(self.weights) if w)
        return along if self.target is None else 0.5 * (along - self.target) ** 2

    def value(self, column: int | str) -> float:
        """Return the value of a column's variable."""
        if isinstance(column, int):
            return self.x0[column]
        if column == "input":
            return self.input
        if column == STIFFNESS:
            return self.movers[0].material.stiffness
        return float(getattr(self.movers[0].material, column.split(".")[1]))

    def unit(self, column: int | str) -> float:
        """Return the change of a column for a width of 1: the state's unit, or the parameter's own value."""
        return 1.0 if isinstance(column, int) or column == "input" else self.value(column)

    def changed(self, column: int | str, by: float) -> "Case":
        """Return the case with a column's variable increased by `by`."""
        if isinstance(column, int):
            x0 = list(self.x0)
            x0[column] += by
            return replace(self, x0=tuple(x0))
        if column == "input":
            return replace(self, input=self.input + by)
        body, _, quantity = column.rpartition(".")
        material = replace(self.movers[0].material, **{quantity: self.value(column) + by})
        movers = tuple(replace(m, material=material) if body in ("", m.name) else m for m in self.movers)
        fixed = tuple(replace(one, material=material) if not body else one for one in self.obstacles)
        return replace(self, movers=movers, obstacles=fixed)

    def parameters(self, column: int | str) -> tuple[str, ...]:
        """Return the package's names of a column's parameters. Their derivatives add up to the column's derivative."""
        if isinstance(column, int) or column == "input":
            return ()
        bodies = [mover.name for mover in self.movers] + ["world"] * bool(self.obstacles)
        return tuple(f"{body}.stiffness" for body in bodies) if column == STIFFNESS else (column,)

    def diagram(self, time_step: float, *, contact: bool = True) -> tuple[MultibodyPlant, Diagram]:
        """Build the plant, and return it with its diagram."""
        builder = DiagramBuilder()
        plant = self.add(builder, time_step, contact=contact)
        return plant, builder.Build()

    def add(self, builder: DiagramBuilder, time_step: float, *, contact: bool) -> MultibodyPlant:
        """Add the plant to a diagram under construction. Without `contact` the plant has no shapes."""
        config = MultibodyPlantConfig(
            time_step=time_step,
            contact_model="point",
            stiction_tolerance=STICTION,
            discrete_contact_approximation=self.law,
            use_sampled_output_ports=False,
        )
        plant, _ = AddMultibodyPlant(config, builder)
        plant.mutable_gravity_field().set_gravity_vector(np.array(self.gravity))
        for mover in self.movers:
            body = plant.AddRigidBody(mover.name, mover.inertia())
            _join(plant, mover, body)
            for i, center in enumerate(mover.centers if contact else ()):
                shape, pose = Sphere(mover.radius), RigidTransform(np.array(center))
                plant.RegisterCollisionGeometry(body, pose, shape, f"{mover.name}_{i}", mover.material.properties())
        for i, one in enumerate(self.obstacles if contact else ()):
            properties = one.material.properties()
            plant.RegisterCollisionGeometry(plant.world_body(), one.pose(), one.shape(), f"{one.kind}_{i}", properties)
        plant.Finalize()
        return plant

    def model(self) -> Any:
        """Return the package's model with steps of `INTERVAL`."""
        import drake_diff as dd

        return dd.model_from_diagram(self.diagram(INTERVAL)[1])


def _join(plant: MultibodyPlant, mover: Mover, body: Any) -> None:
    """Add the mover's joints."""
    parent = plant.world_frame()
    if mover.axes == "hinge":
        pivot = FixedOffsetFrame("pivot", parent, RigidTransform([0, 0, mover.pivot]))
        joint = plant.AddJoint(RevoluteJoint("hinge", plant.AddFrame(pivot), body.body_frame(), np.array([0, 1.0, 0])))
        plant.AddJointActuator("motor", joint, mover.effort)
        return
    for axis in mover.axes:
        name = f"{mover.name}_{axis}"
        link = body if axis == mover.axes[-1] else plant.AddRigidBody(name, SpatialInertia.Zero())
        joint = plant.AddJoint(PrismaticJoint(name, parent, link.body_frame(), np.array(AXES[axis])))
        if mover.spring and axis == mover.axes[0]:
            plant.AddForceElement(PrismaticSpring(joint, 0.0, mover.spring))
        parent = link.body_frame()


def case(seed: int, number: int, family: str | None = None) -> Case:
    """Return case `number` of a seed. Without a `family`, the families alternate."""
    random = np.random.default_rng([seed, number])
    family = family or FAMILIES[number % len(FAMILIES)]
    made = MAKERS[family](random)
    return replace(made, seed=seed, number=number, family=family)


@dataclass
class _Draw:
    """The random draws of the makers, from a generator."""

    random: Any

    def between(self, low: float, high: float) -> float:
        return float(self.random.uniform(low, high))

    def scale(self, low: float, high: float) -> float:
        """Draw a log-uniform number."""
        return float(10 ** self.random.uniform(np.log10(low), np.log10(high)))

    def chance(self, share: float) -> bool:
        return bool(self.random.uniform() < share)

    def one_of(self, *options: Any) -> Any:
        return options[int(self.random.integers(len(options)))]

    def material(self, mass: float, depth: float, load: float) -> Material:
        """Draw the material of one side, twice as stiff as the pair, whose stiffness is from 1e2 to 1e6 N/m.

        A `load` [N] at rest penetrates by at most half of `depth` [m], and the ball's period is at least 1 ms.
        """
        softest = max(1e2, 2 * load / depth)
        stiffness = min(self.scale(softest, max(1e6, 2 * softest)), max(softest, mass * (2 * pi / 1e-3) ** 2))
        relaxation = self.between(0, 1) / sqrt(stiffness / mass)
        dissipation = 0.0 if self.chance(0.2) else self.between(0, 1.5)
        return Material(self.between(0.1, 1.0), 2 * stiffness, dissipation, min(relaxation, 0.02) / 2)

    def law(self, share_of_sap: float = 0.3) -> str:
        return "sap" if self.chance(share_of_sap) else self.one_of("lagged", "similar")

    def vector(self, size: float) -> tuple[float, float, float]:
        return tuple(self.between(-size, size) for _ in range(3))

    def quaternion(self) -> tuple[float, ...]:
        q = self.random.standard_normal(4)
        return tuple((q / np.linalg.norm(q)).tolist())


def _case(
    draw: _Draw,
    law: str,
    movers: tuple[Mover, ...],
    x0: tuple[float, ...],
    duration: float,
    of: int,
    columns: tuple[int | str, ...],
    *,
    gravity: tuple[float, float, float] = (0, 0, -9.81),
    obstacles: tuple[Obstacle, ...] | None = None,
    input: float = 0.0,
) -> Case:
    """Make a case whose loss is entry `of` of the final state, or for one in four, half its squared target error."""
    weights = tuple(1.0 if i == of else 0.0 for i in range(len(x0)))
    target = draw.between(-1, 1) if draw.chance(0.25) else None
    ground = Obstacle("ground", (), (0, 0, 0), (0, 0, 0), movers[0].material)
    return Case(
        0, 0, "", law, movers, (ground,) if obstacles is None else obstacles, gravity, x0,
        max(5, round(duration / INTERVAL)), weights, target, columns, input,
    )  # fmt: skip


def _bounce(random: Any) -> Case:
    """Draw a ball on rails that falls on the ground, once or up to a dozen times, or only at the end."""
    draw = _Draw(random)
    mass, radius, g = draw.scale(0.05, 5), draw.between(0.03, 0.2), draw.between(1, 15)
    axes = draw.one_of("z", "xz")
    ball = Mover("ball", mass, (radius,), radius, ((0, 0, 0),), draw.material(mass, radius / 5, mass * g), axes)
    z, vz = radius + draw.between(0.02, 0.6), draw.between(-3, 1)
    fall = (vz + sqrt(vz * vz + 2 * g * (z - radius))) / g
    duration = min(fall * draw.between(1.1, 3) + 0.05, 1.5)
    if draw.chance(0.2):  # it touches a few ms before the end or narrowly misses
        duration = max(round(fall, 2), 0.05)
        touch = duration + draw.between(-4e-3, 4e-3)
        vz = min(vz, 0.0)
        z = radius - vz * touch + g * touch**2 / 2
    x0 = (z, vz) if axes == "z" else (0.0, z, draw.between(-2, 2), vz)
    of = draw.one_of(0, 1) if axes == "z" else draw.one_of(0, 1, 2)
    columns = (1, 0, STIFFNESS) if axes == "z" else (3, 1, "ball.friction")
    return _case(draw, draw.law(), (ball,), x0, duration, of, columns, gravity=(0, 0, -g))


def corners(sides: tuple[float, ...], radius: float) -> tuple[tuple[float, float, float], ...]:
    half = np.array(sides) / 2 - radius
    return tuple(tuple((half * (2 * np.array([i & 1, i >> 1 & 1, i >> 2]) - 1)).tolist()) for i in range(8))


def _toss(random: Any) -> Case:
    """Draw a box with a sphere in each corner, thrown down with or without spin: one impact up to a long tumble."""
    draw = _Draw(random)
    mass, side, g = draw.scale(0.05, 2), draw.between(0.06, 0.2), draw.between(1, 10)
    sides = (side,) * 3 if draw.chance(0.5) else tuple(side * draw.between(0.6, 1.5) for _ in range(3))
    radius = draw.between(0.01, 0.1) * min(sides)
    box = Mover("box", mass, sides, radius, corners(sides, radius), draw.material(mass, min(sides) / 5, mass * g))
    reach = float(np.linalg.norm(sides)) / 2
    z, vz = reach + draw.between(0, 0.15), draw.between(-2.5, -0.2)
    spin = draw.vector(4.0) if draw.chance(0.6) else (0.0, 0.0, 0.0)
    x0 = (*draw.quaternion(), 0.0, 0.0, z, *spin, *draw.vector(0.7)[:2], vz)
    fall = (vz + sqrt(vz * vz + 2 * g * (z - reach / 2))) / g
    law = draw.law(0.15)
    duration = fall + draw.scale(0.03, 0.2 if law == "sap" else 1.5)  # the reference of sap's law is expensive
    columns = (12, 7, STIFFNESS)
    return _case(draw, law, (box,), x0, duration, draw.one_of(4, 5, 6, 12), columns, gravity=(0, 0, -g))


def _slide(random: Any) -> Case:
    """Draw a ball that cannot turn, on a level, on an incline or with a spring. It slips and sticks in turn."""
    draw = _Draw(random)
    mass, radius, g = draw.scale(0.1, 5), draw.between(0.03, 0.2), draw.between(3, 12)
    kind = draw.one_of("level", "incline", "spring")
    slope = draw.between(0.05, 0.6) if kind == "incline" else 0.0
    spring = mass * draw.between(4, 12) ** 2 if kind == "spring" else 0.0
    material = draw.material(mass, radius / 5, mass * g)
    block = Mover("block", mass, (radius,), radius, ((0, 0, 0),), material, "xz", spring=spring)
    depth = mass * g * np.cos(slope) / (material.stiffness / 2)
    x0 = (draw.between(0.05, 0.4) if spring else 0.0, float(radius - depth), draw.between(-2.5, 2.5), 0.0)
    gravity = (float(g * np.sin(slope)), 0.0, float(-g * np.cos(slope)))
    columns = (2, 0, "block.friction") if spring else (2, "block.friction")
    return _case(draw, draw.law(), (block,), x0, draw.between(0.1, 1), 0, columns, gravity=gravity)


def _roll(random: Any) -> Case:
    """Draw a ball that slips until it rolls. It starts on the ground or a little above it."""
    draw = _Draw(random)
    mass, radius, g = draw.scale(0.05, 5), draw.between(0.03, 0.2), draw.between(3, 12)
    material = draw.material(mass, radius / 5, mass * g)
    ball = Mover("ball", mass, (radius,), radius, ((0, 0, 0),), material)
    z = radius - mass * g / (material.stiffness / 2) if draw.chance(0.6) else radius + draw.between(0.005, 0.1)
    v = (draw.between(-2, 2), draw.between(-2, 2), 0.0)
    x0 = (*draw.quaternion(), 0.0, 0.0, z, *draw.vector(20.0), *v)
    columns = (10, 8, "ball.friction")
    return _case(draw, draw.law(), (ball,), x0, draw.between(0.1, 0.7), draw.one_of(4, 8), columns, gravity=(0, 0, -g))


def _rod(random: Any) -> Case:
    """Draw a rod with a sphere at each end that falls on the ground."""
    draw = _Draw(random)
    mass, length, g = draw.scale(0.1, 3), draw.between(0.2, 0.8), draw.between(2, 12)
    radius = draw.between(0.01, 0.03)
    ends = ((-length / 2, 0.0, 0.0), (length / 2, 0.0, 0.0))
    rod = Mover("rod", mass, (length, 2 * radius, 2 * radius), radius, ends, draw.material(mass, radius, mass * g))
    tilt, turn = draw.between(0.1, 1.4), draw.between(-pi, pi)
    q = RotationMatrix(RollPitchYaw(0.0, tilt, turn)).ToQuaternion().wxyz()
    low = length / 2 * np.sin(tilt) + radius
    z, vz = float(low + draw.between(0.0, 0.3)), draw.between(-2, 0)
    spin = draw.vector(3.0) if draw.chance(0.5) else (0.0, 0.0, 0.0)
    x0 = (*q.tolist(), 0.0, 0.0, z, *spin, *draw.vector(1.0)[:2], vz)
    fall = float((vz + sqrt(vz * vz + 2 * g * (z - low))) / g)
    columns = (12, 8, "rod.friction")
    return _case(
        draw,
        draw.law(0.15),
        (rod,),
        x0,
        fall + draw.scale(0.03, 0.5),
        draw.one_of(4, 5, 6, 8),
        columns,
        gravity=(0, 0, -g),
    )


def _two(random: Any) -> Case:
    """Draw two balls that hit each other: on one rail, in a plane without gravity, or one falling on the other."""
    draw = _Draw(random)
    masses, radii = (draw.scale(0.05, 5), draw.scale(0.05, 5)), (draw.between(0.03, 0.15), draw.between(0.03, 0.15))
    light = min(masses)
    kind = draw.one_of("rail", "plane", "stack")
    g = draw.between(2, 12) if kind == "stack" else 0.0
    material = draw.material(light, min(radii) / 3, sum(masses) * g)
    axes = {"rail": "x", "plane": "", "stack": "z"}[kind]
    a, b = (
        Mover(name, m, (r,), r, ((0, 0, 0),), material, axes) for name, m, r in zip("ab", masses, radii, strict=True)
    )
    gap, apart = draw.between(0.02, 0.4), sum(radii)
    if kind == "rail":
        speeds = draw.between(0.3, 3), draw.between(-2, 0.1)
        x0 = (0.0, apart + gap, *speeds)
        duration = gap / (speeds[0] - speeds[1]) + draw.between(0.02, 0.6)
        return _case(
            draw, draw.law(), (a, b), x0, duration, draw.one_of(0, 1, 2), (2, 1, STIFFNESS),
            gravity=(0, 0, 0), obstacles=(),
        )  # fmt: skip
    if kind == "stack":
        x0 = (radii[0] + draw.between(0.02, 0.3), radii[0] * 2 + radii[1] + 0.3 + gap, 0.0, draw.between(-2, 0))
        duration = draw.between(0.3, 0.9)
        return _case(draw, draw.law(), (a, b), x0, duration, 1, (3, 1, STIFFNESS), gravity=(0, 0, -g))
    aside, speed = draw.between(-0.8, 0.8) * apart, draw.between(0.5, 3)
    still = (1.0, 0.0, 0.0, 0.0)
    at = (sqrt(apart**2 - aside**2) + gap, aside, 0.0)
    x0 = (*still, 0.0, 0.0, 0.0, *still, *at, *draw.vector(5.0), speed, 0.0, 0.0, *draw.vector(5.0), 0.0, 0.0, 0.0)
    duration = gap / speed + draw.between(0.05, 0.5)
    return _case(
        draw, draw.law(), (a, b), x0, duration, draw.one_of(5, 11, 12), (23, 18, "a.friction"),
        gravity=(0, 0, 0), obstacles=(),
    )  # fmt: skip


def _wall(random: Any) -> Case:
    """Draw a ball thrown at a fixed shape, which it sometimes barely touches. The law is Hunt and Crossley's."""
    draw = _Draw(random)
    mass, radius, g = draw.scale(0.05, 3), draw.between(0.03, 0.12), draw.between(0, 10)
    kind = draw.one_of("box", "capsule", "cylinder", "sphere")
    material = draw.material(mass, radius / 5, mass * g)
    ball = Mover("ball", mass, (radius,), radius, ((0, 0, 0),), material)
    thick = draw.between(0.1, 0.3)
    sizes = {
        "box": (2 * thick, draw.between(0.3, 0.8), draw.between(0.3, 0.8)),
        "capsule": (thick, draw.between(0.2, 0.6)),
        "cylinder": (thick, draw.between(0.3, 0.8)),
        "sphere": (thick,),
    }[kind]
    turn = draw.vector(0.4) if kind != "box" else draw.vector(0.2)
    speed, far = draw.between(1, 4), 2 * thick + radius + draw.between(0.05, 0.3)
    aside = draw.between(-0.08, 0.08)
    if kind == "sphere" and draw.chance(0.5):  # it barely touches or narrowly misses
        aside = thick + radius - draw.between(-2e-3, 6e-3)
    place = Obstacle(kind, sizes, (far, 0.0, 0.0), turn, material)
    reach = (far - thick - radius) / speed
    x0 = (*draw.quaternion(), 0.0, aside, draw.between(-0.05, 0.05), *draw.vector(10.0), speed, 0.0, g * reach / 2)
    duration = reach + draw.between(0.05, 0.4)
    return _case(
        draw, draw.law(0.0), (ball,), x0, duration, draw.one_of(4, 5, 6), (10, 5, "ball.friction"),
        gravity=(0, 0, -g), obstacles=(place,),
    )  # fmt: skip


def _pendulum(random: Any) -> Case:
    """Draw a ball on an arm, with a motor in its hinge, that strikes the ground."""
    draw = _Draw(random)
    mass, radius, g = draw.scale(0.1, 3), draw.between(0.03, 0.1), draw.between(2, 12)
    arm = draw.between(0.3, 0.8)
    low = draw.between(0.3, 0.9) * arm  # distance of the ball below the pivot when it touches
    material = draw.material(mass, radius / 2, 2 * mass * g)
    material = replace(material, friction=draw.between(0.05, 0.3))  # more friction would jam the arm
    ball = Mover(
        "ball", mass, (radius,), radius, ((0, 0, -arm),), material, "hinge", pivot=low + radius, arm=arm, effort=100.0
    )
    touch = float(np.arccos(low / arm))
    side = draw.one_of(-1.0, 1.0)
    x0 = (side * (touch + draw.between(0.05, 0.8)), -side * draw.between(0, 2))
    torque = draw.between(-0.2, 0.2) * mass * g * arm
    return _case(
        draw, draw.law(), (ball,), x0, draw.between(0.2, 0.9), draw.one_of(0, 1), (1, "input", STIFFNESS),
        gravity=(0, 0, -g), input=torque,
    )  # fmt: skip


MAKERS: Mapping[str, Callable[[Any], Case]] = {
    "bounce": _bounce,
    "toss": _toss,
    "slide": _slide,
    "roll": _roll,
    "rod": _rod,
    "two": _two,
    "wall": _wall,
    "pendulum": _pendulum,
}
