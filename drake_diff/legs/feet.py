"""Feet of a robot with a floating base: the limbs that can carry it, and the points that it stands on."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from pydrake.geometry import Box, Sphere
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable

from drake_diff._base.arrays import Array, Indices, cross
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.legs.inverse_kinematics import PointTarget
from drake_diff.model.contact_geometry import collision_geometries
from drake_diff.model.model import Model
from drake_diff.model.plant import FLOATING, bodies, joints, proximity_property
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

FEWEST = 2  # feet; none of our postures balances a robot on one foot
LEVEL = 0.15  # of the centre of mass's height: ends of legs are at most this far above the lowest end of a limb
SOLE = 5e-3  # [m] the sole has the points of a foot that are at most this far above its lowest point
TRAVEL = 0.1  # of the centre of mass's height: least vertical travel of the end of a leg
DRAWN = 60  # random postures for the travel
GRAVITY = 9.81  # [m/s^2] for the weight, which is used as a scale
Shapes = dict[int, list[Any]]  # geometries, keyed by the index of their body


@dataclass(frozen=True, eq=False)
class Foot:
    """The end of a leg: spheres and corners of boxes that are fixed to a body, and those that the robot stands on.

    Attributes:
        bodies: The names of the foot's bodies, which are welded to each other.
        frame: The frame of one of these bodies in the double plant.
        centres: (k, 3) [m] the centres of the spheres in that frame.
        radii: (k,) [m] the radii, 0 for a corner.
        friction: The smallest friction coefficient of all shapes.
        joints: The indices in v of the joints between the base and the foot.
        sole: The indices of the spheres that the robot stands on. One or two cannot carry a torque about the foot.
    """

    bodies: tuple[str, ...]
    frame: Any
    centres: Array
    radii: Array
    friction: float
    joints: tuple[int, ...] = ()
    sole: Indices = field(default_factory=lambda: np.zeros(0, dtype=int))

    @property
    def name(self) -> str:
        """The name of the body that `frame` belongs to."""
        return str(self.frame.body().name())

    @property
    def is_flat(self) -> bool:
        """Whether the sole is a face, which aligns the foot with the ground."""
        middle = self.centres[self.sole] - np.mean(self.centres[self.sole], axis=0)
        return len(middle) > 2 and bool(np.linalg.svd(middle, compute_uv=False)[1] > SOLE)


class Legs:
    """A model on a floating base, its feet, and the joint limits `lower` and `upper` (nq,).

    The sole points of all `feet` are numbered together. `owners` (n,) are the feet that they belong to.
    """

    def __init__(self, model: Model, feet: Sequence[Foot], lower: Array, upper: Array):
        self.model, self.twin, self.space = model, model.double, tangent_space(model)
        self.feet, self.lower, self.upper = tuple(feet), lower.copy(), upper.copy()
        self.base_q = self.base_v = self.space.quaternions[0]  # q: quaternion, position; v: angular velocity, velocity
        base, count = slice(self.base_q, self.base_q + 7), np.arange(model.nq)
        self.lower[base], self.upper[base] = -np.inf, np.inf
        self.joint_q: Indices = count[(count < self.base_q) | (count >= self.base_q + 7)]
        self.joint_v: Indices = np.where(self.joint_q < self.base_q, self.joint_q, self.joint_q - 1)
        self.mass = float(self.twin.plant.CalcTotalMass(self.twin.context))
        self.weight = self.mass * GRAVITY
        self.owners: Indices = np.concatenate([np.full(len(foot.sole), i) for i, foot in enumerate(self.feet)])
        self.centres = np.vstack([foot.centres[foot.sole] for foot in self.feet])
        self.radii = np.concatenate([foot.radii[foot.sole] for foot in self.feet])

    @classmethod
    def named(cls, model: Model, names: Sequence[str], q: Array) -> "Legs":
        """Return legs whose feet are the bodies of these names. Their soles are the lowest points in posture q (nq,).

        Raises InputError if the base does not float or a foot has no shape, UnknownNameError for an unknown body.
        """
        quaternions = tangent_space(model).quaternions
        if len(quaternions) != 1 or model.coupling is not None:
            got = f"{len(quaternions)} floating bodies" if model.coupling is None else "reduced mimic joints"
            raise InputError("ContactSchedule: model", got=got, expected="one floating base, no reduced mimic joints")
        set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
        plant, known, feet = model.double.plant, [str(body.name()) for body in bodies(model.plant)], list[Foot]()
        shapes = _shapes(model)
        for name in names:
            if name not in known:
                raise UnknownNameError("ContactSchedule.feet", got=name, known=known)
            body = plant.GetBodyByName(name)
            foot = _foot(model, shapes, body, (int(b.index()) for b in plant.GetBodiesWeldedTo(body)))
            if foot is None:
                expected = 'a sphere or a box; see meshes="spheres" and contact_geometry="corner_spheres"'
                got = "no such shape"
                raise InputError(f"ContactSchedule: shapes of foot {name}", got=got, expected=expected)
            feet.append(foot)
        return cls(model, feet, *model.position_limits)

    def on_lowest(self, q: Array) -> "Legs":
        """Return legs on which a foot without a face stands on its lowest point in posture q (nq,)."""
        self.put(q)
        lowest = [np.argmin(_bottoms(self.model, foot)[:, 2]) for foot in self.feet]
        feet = [f if f.is_flat else replace(f, sole=np.array([i])) for f, i in zip(self.feet, lowest, strict=True)]
        return Legs(self.model, feet, self.lower, self.upper)

    @cached_property
    def frictions(self) -> Array:
        """(feet,) the friction coefficients with the ground's smallest one, combined by Drake's rule."""
        plant, inspector = self.model.plant, self.twin.inspector
        shapes, fixed = _shapes(self.model), plant.GetBodiesWeldedTo(plant.world_body())
        ground = [geometry for body in fixed for geometry in shapes.get(int(body.index()), ())]
        if not ground:
            raise InputError("the model", got="no ground", expected="a ground: load_model(..., ground=True)")
        least = min(proximity_property(inspector, shape, "friction") or 0.0 for shape in ground)
        coefficients = np.array([foot.friction for foot in self.feet])
        return np.asarray(2 * coefficients * least / np.maximum(coefficients + least, 1e-12))

    def put(self, q: Array, v: Array | None = None) -> None:
        """Set the double plant to posture q (nq,), at rest or with velocity v (nv,)."""
        set_state(self.twin, np.concatenate([q, np.zeros(self.model.nv) if v is None else v]))

    def moved(self, q: Array, d: Array) -> Array:
        """Return posture q (nq,) moved by d (nv,)."""
        still = np.zeros(self.model.nv)
        return self.space.plus(np.concatenate([q, still]), np.concatenate([d, still]))[: self.model.nq]

    def apart(self, q: Array, origin: Array) -> Array:
        """Return (nv,) the displacement from `origin` to q, both (nq,)."""
        still = np.zeros(self.model.nv)
        return self.space.minus(np.concatenate([q, still]), np.concatenate([origin, still]))[: self.model.nv]

    def read(self, x: Array) -> tuple[Array, Array]:
        """Read the poses and Jacobians that `soles` needs in a state x (nx,)."""
        self.put(x[: self.model.nq], x[self.model.nq :])
        return self._read()

    def soles(self, read: Sequence[tuple[Array, Array]]) -> "Soles":
        """Compute the soles in K states, from the results of `read` in these states."""
        poses, moving = (np.array(values)[:, self.owners] for values in zip(*read, strict=True))
        jacobian = moving.swapaxes(2, 3)
        arms = (poses[..., :3] @ self.centres[..., None])[..., 0]
        turns, centres = jacobian[..., :3], jacobian[..., 3:] + cross(jacobian[..., :3], arms[:, :, None])
        down = np.zeros((len(self.radii), 3))
        down[:, 2] = -self.radii
        return Soles(self.base_v, down, poses[..., 3] + arms + down, turns, centres)

    def points(self) -> Array:
        """Return (n, 3) [m] the lowest points of the soles in the double plant's state."""
        return self._now().places[0]

    def points_in(self, q: Array) -> Array:
        """Return (n, 3) [m] the lowest points of the soles in posture q (nq,)."""
        self.put(q)
        return self.points()

    def heights(self) -> Array:
        """Return (feet,) [m] the height of each foot's lowest point in the double plant's state."""
        heights = self.points()[:, 2]
        return np.array([np.min(heights[self.owners == i]) for i in range(len(self.feet))])

    def jacobian(self) -> Array:
        """Return (n, 3, nv) the Jacobian of the material points that are lowest in the double plant's state."""
        return self._now().moves[0].swapaxes(1, 2)

    def _now(self) -> "Soles":
        return self.soles([self._read()])

    def _read(self) -> tuple[Array, Array]:
        """Return (feet, 3, 4) the poses of the feet's frames, and (feet, 6, nv) their spatial Jacobians."""
        plant, context, world = self.twin.plant, self.twin.context, self.twin.plant.world_frame()
        kind, origin, frames = JacobianWrtVariable.kV, np.zeros(3), [foot.frame for foot in self.feet]
        poses = [frame.CalcPoseInWorld(context).GetAsMatrix34() for frame in frames]
        moving = [plant.CalcJacobianSpatialVelocity(context, kind, f, origin, world, world) for f in frames]
        return np.array(poses), _of_model(self.model, np.array(moving))

    def center_of_mass(self) -> Array:
        """Return (3,) [m] the centre of mass in the double plant's state."""
        return np.asarray(self.twin.plant.CalcCenterOfMassPositionInWorld(self.twin.context))

    def center_of_mass_velocity(self, v: Array) -> Array:
        """Return (3,) [m/s] the velocity of the centre of mass in the double plant's posture under v (nv,)."""
        plant, context, world = self.twin.plant, self.twin.context, self.twin.plant.world_frame()
        kind = JacobianWrtVariable.kV
        jacobian = plant.CalcJacobianCenterOfMassTranslationalVelocity(context, kind, world, world)
        return np.asarray(_of_model(self.model, jacobian) @ v)

    def at(
        self, positions: Array, tolerance: Any, rolls: Collection[int] = (), unit: Any = np.inf
    ) -> list[PointTarget]:
        """Return targets for the lowest points of the soles at `positions` (n, 3) [m]; three points for a face.

        The points of `rolls` stay where they touch in the double plant's posture, for any horizontal position. For a
        foot without a face, the lowest material point stays, and the centre of its sphere moves as that of a wheel.
        """
        targets = list[PointTarget]()
        for i, owner in enumerate(self.owners):
            foot, centre, up = self.feet[owner], self.centres[i], np.array([0.0, 0.0, self.radii[i]])
            if i in self._spare:
                continue
            position, pose = positions[i] + up, foot.frame.CalcPoseInWorld(self.twin.context)
            if i in rolls:
                stays = pose.multiply(centre)
                position = np.array([*stays[:2], position[2]])
                if not foot.is_flat:
                    lowest = pose.inverse().multiply(stays - up)
                    targets.append(PointTarget(foot.frame, lowest, [*stays[:2], np.nan], tolerance))
                    position[:2] = np.nan
            targets.append(PointTarget(foot.frame, centre, position, tolerance, unit))
        return targets

    @cached_property
    def _spare(self) -> frozenset[int]:
        """The points of faces that three other points of the face determine."""
        spare = set[int]()
        for i, foot in enumerate(self.feet):
            of_foot = np.flatnonzero(self.owners == i)
            if foot.is_flat:
                spread = self.centres[of_foot] - self.centres[of_foot[0]]
                lengths = np.linalg.norm(spread, axis=1)
                line = spread[np.argmax(lengths)] / np.max(lengths)
                third = np.argmax(np.linalg.norm(np.cross(spread, line), axis=1))
                spare |= set(of_foot.tolist()) - {int(of_foot[k]) for k in (0, np.argmax(lengths), third)}
        return frozenset(spare)


@dataclass(frozen=True, eq=False)
class Soles:
    """The n lowest points of feet in K states, and the rotations and motions of these by each degree of freedom."""

    base: int  # index in v of the base's angular velocity, which is followed by its velocity
    down: Array  # (n, 3) [m] from the centre of a sphere to its lowest point, 0 for a corner
    places: Array  # (K, n, 3) [m]
    turns: Array  # (K, n, nv, 3) rotation of the body by each degree of freedom
    centres: Array  # (K, n, nv, 3) motion of the sphere's centre by each degree of freedom

    @property
    def moves(self) -> Array:
        """(K, n, nv, 3) the motion of the lowest material point by each degree of freedom."""
        return self.centres + cross(self.turns, self.down[:, None])

    def velocities(self, v: Array) -> Array:
        """Return (K, n, 3) [m/s] the velocities of the lowest material points under v (K, nv)."""
        return np.asarray((v[:, None, None] @ self.moves)[:, :, 0])

    def slopes(self, v: Array) -> Array:
        """Return (K, n, nv, 3) the derivatives of `velocities` with respect to the posture, for independent joints.

        A joint's column of a Jacobian rotates with all joints before it. It does not rotate with a later joint.
        """
        b, nv = self.base, v.shape[1]
        joints, base = np.r_[:b, b + 6 : nv], slice(b, b + 3)
        rates = v[:, None, joints, None]
        turn, move, base_turn = self.turns[:, :, joints], self.centres[:, :, joints], self.turns[:, :, base]
        turning, moving = rates * turn, rates * move  # the contribution of each joint
        later, after = _from_here_on(turning), _from_here_on(moving)
        spin = (v[:, None, None, base] @ base_turn)[:, :, 0]  # (K, n, 3) angular velocity of the base
        before = spin[:, :, None] + turning.cumsum(axis=2) - turning
        turned, slopes = np.zeros(self.turns.shape), np.zeros(self.turns.shape)
        turned[:, :, joints] = cross(turn, later - turning)
        turned[:, :, base] = cross(base_turn, later[:, :, :1])
        slopes[:, :, joints] = cross(turn, after) + cross(before, move)
        slopes[:, :, base] = cross(base_turn, after[:, :, :1]) + cross(spin[:, :, None], self.centres[:, :, base])
        return np.asarray(slopes + cross(turned, self.down[:, None]))


def _from_here_on(parts: Array) -> Array:
    """Return (K, n, joints, 3) the sum of the parts of a joint and all later joints."""
    return parts[:, :, ::-1].cumsum(axis=2)[:, :, ::-1]


def find_feet(model: Model, q: Array) -> tuple[Foot, ...] | Refusal:
    """Return the feet of a floating-base robot that stands upright in the file's posture q (nq,), or a Refusal."""
    if len(model.plant.GetFloatingBaseBodies()) != 1:
        return Refusal(f"{len(model.plant.GetFloatingBaseBodies())} bodies float")
    set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
    shapes = _shapes(model)
    candidates = _limbs(model, shapes)
    if len(candidates) < FEWEST:
        return Refusal(
            f"{len(candidates) or 'none'} of its limbs {'ends' if len(candidates) == 1 else 'end'} in a sphere or a box"
        )
    heights = np.array([_lowest(model, limb) for limb in candidates])
    ground = float(np.min(heights))
    plant, context = model.double.plant, model.double.context
    fixed = {int(body.index()) for body in plant.GetBodiesWeldedTo(plant.world_body())}
    moving = [body for body in bodies(plant) if int(body.index()) not in fixed]
    shaped = [foot for body in moving if (foot := _foot(model, shapes, body, [int(body.index())]))]
    if min(_lowest(model, foot) for foot in shaped) < ground - SOLE:
        return Refusal("its lowest point is not at the end of a limb")
    tall = float(plant.CalcCenterOfMassPositionInWorld(context)[2]) - ground
    lower = [b.name() for b in moving if b.EvalPoseInWorld(context).translation()[2] < ground - LEVEL * tall]
    if lower:
        return Refusal(f"{lower[0]} is below the feet and has no collision shape")
    legs = [limb for limb, height in zip(candidates, heights, strict=True) if height - ground <= LEVEL * tall]
    drawn = sum(_travel(model, q, limb) >= TRAVEL * tall for limb in legs)
    if drawn < max(FEWEST, len(legs)):
        return Refusal(f"{drawn or 'none'} of the {len(legs)} lowest limbs can be retracted")
    return tuple(legs)


def _limbs(model: Model, shapes: Shapes) -> list[Foot]:
    """Return the outermost bodies with shapes of all chains of joints from the base."""
    plant = model.double.plant
    group = {int(b.index()): frozenset(int(w.index()) for w in plant.GetBodiesWeldedTo(b)) for b in bodies(plant)}
    moving = [joint for joint in joints(plant) if joint.num_velocities() and joint.type_name() not in FLOATING]
    before = {i: joint for joint in moving for i in group[int(joint.child_body().index())]}
    parents = {i for joint in moving for i in group.get(int(joint.parent_body().index()), ())}
    feet = dict[frozenset[int], Foot]()
    for last in moving:
        if group[int(last.child_body().index())] & parents:
            continue
        chain = [last]
        while int(chain[-1].parent_body().index()) in before:
            chain.append(before[int(chain[-1].parent_body().index())])
        for end in (group[int(joint.child_body().index())] for joint in chain):
            shaped = [i for i in sorted(end) if any(_points(model, shapes, i))]
            if shaped and end not in feet:
                foot = _foot(model, shapes, plant.get_body(BodyIndex(shaped[0])), end)
                velocities = tuple(i for joint in chain for i in model.places(joint)[1])
                feet |= {end: replace(foot, joints=velocities)} if foot is not None else {}
            if shaped:
                break
    return list(feet.values())


def _foot(model: Model, shapes: Shapes, body: Any, rigid: Iterable[int]) -> Foot | None:
    """Return the spheres and corners of the bodies `rigid` in the frame of `body`, with the lowest ones as the sole.

    The result is None if the bodies have no sphere and no box.
    """
    plant, context, inspector = model.double.plant, model.double.context, model.double.inspector
    centres, radii, frictions, names = list[Array](), list[float](), list[float](), list[str]()
    for i in sorted(rigid):
        other = plant.get_body(BodyIndex(i))
        pose = plant.CalcRelativeTransform(context, body.body_frame(), other.body_frame())
        names.append(str(other.name()))
        for shape, points, radius in _points(model, shapes, i):
            centres += [pose.multiply(point) for point in points]
            radii += [radius] * len(points)
            frictions.append(proximity_property(inspector, shape, "friction") or 0.0)
    if not centres:
        return None
    foot = Foot(tuple(names), body.body_frame(), np.array(centres), np.array(radii), min(frictions))
    heights = _bottoms(model, foot)[:, 2]
    return replace(foot, sole=np.flatnonzero(heights - np.min(heights) <= SOLE))


def _points(model: Model, shapes: Shapes, body: int) -> Iterable[tuple[Any, list[Array], float]]:
    """Yield the geometry, centre or corners in the body's frame, and radius of each sphere and box of a body."""
    inspector = model.double.inspector
    for geometry in shapes.get(body, ()):
        shape, pose = inspector.GetShape(geometry), inspector.GetPoseInFrame(geometry)
        if isinstance(shape, Sphere):
            yield geometry, [pose.translation()], shape.radius()
        elif isinstance(shape, Box):
            corners = np.array(np.meshgrid(*[[-s / 2, s / 2] for s in shape.size()])).reshape(3, -1)
            yield geometry, [pose.multiply(corner) for corner in corners.T], 0.0


def _shapes(model: Model) -> Shapes:
    """Return the geometries that can touch."""
    shapes: Shapes = {}
    if model.double.inspector is not None:
        for body, geometry in collision_geometries(model.double.plant, model.double.scene_graph):
            shapes.setdefault(int(body.index()), []).append(geometry)
    return shapes


def _bottoms(model: Model, foot: Foot) -> Array:
    """Return (k, 3) [m] the lowest points of all spheres of a foot in the double plant's state."""
    points = foot.frame.CalcPoseInWorld(model.double.context).multiply(foot.centres.T).T
    return np.asarray(points - np.outer(foot.radii, [0.0, 0.0, 1.0]))


def _lowest(model: Model, foot: Foot) -> float:
    return float(np.min(_bottoms(model, foot)[:, 2]))


def _travel(model: Model, q: Array, limb: Foot) -> float:
    """Return [m] the vertical travel of a limb's end in random postures of the limb's own joints."""
    random, space = np.random.default_rng(0), tangent_space(model)
    x, heights = np.concatenate([q, np.zeros(model.nv)]), []
    for _ in range(DRAWN):
        turned = np.zeros(space.size)
        turned[list(limb.joints)] = random.uniform(-1.5, 1.5, len(limb.joints))
        set_state(model.double, np.append(space.plus(x, turned)[: model.nq], np.zeros(model.nv)))
        heights.append(_lowest(model, limb))
    return float(np.ptp(heights))


def _of_model(model: Model, jacobian: Array) -> Array:
    """Convert a Jacobian from the plant's velocities to the model's, which may be fewer."""
    return np.asarray(jacobian if model.double.coupling is None else jacobian @ model.double.coupling.spread)
