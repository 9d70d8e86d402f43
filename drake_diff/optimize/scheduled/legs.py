"""The points that a robot's feet stand on, where they are, and postures that put them where they are to be."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.geometry import Box, Sphere
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable

from drake_diff._base.arrays import Array, Indices, cross
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.contact_geometry import collision_geometries
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, proximity_property
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

SOLE = 5e-3  # [m] points of a foot that are within that of its lowest one are its sole
# What counts as 1 where a posture is looked for.
AT_PLACE, OVER, TURNED, POSED = 2e-4, 1e-3, 0.02, 0.5  # [m] of a foot, of the centre of mass, [rad] of the base, joints
ITERATIONS, FARTHEST, STILL = 20, 0.3, 1e-5  # [rad or m] of one iteration, and of the last
DAMPING = 1e-3
INSIDE = 1e-3  # [rad or m] how far inside its limits a joint stays


class Legs:
    """The soles of some `feet` of a model on a floating base, as they are in its posture q0 (nq,).

    A sole is the lowest points of the spheres and boxes that are fixed to the foot: `owners` (n,) are the feet that
    the points belong to.

    Raises:
        InputError: The base does not float, or a foot has no such shape.
        UnknownNameError: There is no such body.
    """

    def __init__(self, model: Model, feet: Sequence[str], q0: Array):
        self.model, self.twin, self.space = model, model.double, tangent_space(model)
        if len(self.space.quaternions) != 1 or model.coupling is not None:
            got = f"{len(self.space.quaternions)} floating bodies" if model.coupling is None else "joints that follow"
            raise InputError("ContactSchedule: the model", got=got, expected="one floating base, and no joints reduced")
        self.base_q = self.base_v = self.space.quaternions[0]  # a quaternion, then a place; a turn, then a place
        self.feet = tuple(feet)
        self.mass = float(self.twin.plant.CalcTotalMass(self.twin.context))
        self.put(q0)
        soles = [_sole(model, foot) for foot in self.feet]
        self.frames = [self.twin.plant.get_frame(sole.frame) for sole in soles]
        self.centres = [sole.centres for sole in soles]
        self.radii = np.concatenate([sole.radii for sole in soles])
        self.frictions = [sole.friction for sole in soles]
        self.owners: Indices = np.concatenate([np.full(len(sole.radii), i) for i, sole in enumerate(soles)])

    def friction(self) -> float:
        """The least coefficient between a sole and the ground, by Drake's rule for two of them."""
        plant, inspector = self.model.plant, self.twin.inspector
        fixed = {int(body.index()) for body in plant.GetBodiesWeldedTo(plant.world_body())}
        every = collision_geometries(plant, self.twin.scene_graph)
        ground = [g for body, g in every if int(body.index()) in fixed]
        if not ground:
            raise InputError("ContactSchedule: the model", got="no ground", expected="one: ground=True")
        least = min(self.frictions)
        of_ground = min(proximity_property(inspector, g, "friction") or 0.0 for g in ground)
        return 2 * least * of_ground / max(least + of_ground, 1e-12)

    def put(self, q: Array, v: Array | None = None) -> None:
        """Put posture q (nq,), at rest or moving with v (nv,), into the twin."""
        set_state(self.twin, np.concatenate([q, np.zeros(self.model.nv) if v is None else v]))

    def along(self, states: Array) -> "Soles":
        """The soles in K states (K, nx) at once."""
        return self.soles([self.read(x) for x in states])

    def read(self, x: Array) -> tuple[Array, Array]:
        """What `soles` needs of a state x (nx,)."""
        nq = self.model.nq
        self.put(x[:nq], x[nq:])
        return self._read()

    def soles(self, read: Sequence[tuple[Array, Array]]) -> "Soles":
        """The soles in K states, of each what `read` told."""
        return self._of([poses for poses, _ in read], [moving for _, moving in read])

    def points(self) -> Array:
        """(n, 3) [m] the lowest points in the twin's state."""
        return self._now().places[0]

    def heights(self) -> Array:
        """(feet,) [m] of the lowest point of each foot in the twin's state."""
        heights = self.points()[:, 2]
        return np.array([np.min(heights[self.owners == i]) for i in range(len(self.feet))])

    def jacobians(self) -> tuple[Array, Array]:
        """(n, 3, nv) twice: how the material at the lowest points moves, and how their bodies turn."""
        now = self._now()
        return now.moves[0].swapaxes(1, 2), now.turns[0].swapaxes(1, 2)

    def _now(self) -> "Soles":
        poses, moving = self._read()
        return self._of([poses], [moving])

    def _read(self) -> tuple[Array, Array]:
        """(feet, 3, 4) the poses of their frames in the twin's state, and (feet, 6, nv) how these turn and move."""
        plant, context, world = self.twin.plant, self.twin.context, self.twin.plant.world_frame()
        kind, origin = JacobianWrtVariable.kV, np.zeros(3)
        poses = [frame.CalcPoseInWorld(context).GetAsMatrix34() for frame in self.frames]
        moving = [plant.CalcJacobianSpatialVelocity(context, kind, f, origin, world, world) for f in self.frames]
        return np.array(poses), np.array(moving)

    def _of(self, poses: Sequence[Array], moving: Sequence[Array]) -> "Soles":
        """The soles in K states, of each what `_read` told."""
        pose, jacobian = np.array(poses)[:, self.owners], np.array(moving)[:, self.owners].swapaxes(2, 3)
        arms = (pose[..., :3] @ np.vstack([c.T for c in self.centres])[..., None])[..., 0]
        turns, centres = jacobian[..., :3], jacobian[..., 3:] + cross(jacobian[..., :3], arms[:, :, None])
        down = np.zeros((len(self.radii), 3))
        down[:, 2] = -self.radii
        return Soles(self.base_v, down, pose[..., 3] + arms + down, turns, centres)

    def center_of_mass(self) -> tuple[Array, Array]:
        """(3,) [m] the centre of mass in the twin's state, and (3, nv) how it moves."""
        plant, context, world = self.twin.plant, self.twin.context, self.twin.plant.world_frame()
        kind = JacobianWrtVariable.kV
        jacobian = plant.CalcJacobianCenterOfMassTranslationalVelocity(context, kind, world, world)
        return plant.CalcCenterOfMassPositionInWorld(context), jacobian

    def moved(self, q: Array, d: Array) -> Array:
        """Posture q (nq,) moved by d (nv,), joints inside their limits."""
        still = np.zeros(self.model.nv)
        q_moved = self.space.plus(np.concatenate([q, still]), np.concatenate([d, still]))[: self.model.nq]
        lower, upper = self.model.position_limits
        inside = np.clip(q_moved, lower + INSIDE, np.maximum(upper - INSIDE, lower + INSIDE))
        base = slice(self.base_q, self.base_q + 7)
        inside[base] = q_moved[base]
        return inside

    def apart(self, q: Array, origin: Array) -> Array:
        """(nv,) the way from `origin` to q, both (nq,)."""
        still = np.zeros(self.model.nv)
        return self.space.minus(np.concatenate([q, still]), np.concatenate([origin, still]))[: self.model.nv]

    def posture(self, first: Array, wish: Array, mass: Array, places: Array, rolls: Array) -> Array:
        """(nq,) from posture `first` (nq,) to where the soles and the centre of mass are to be, near `wish` (nq,).

        `places` (n, 3) are those of the lowest points, `mass` (3,) that of the centre of mass. A sole of `rolls` (n,)
        stays where it touches in `first`, whatever its place says sideways: its lowest point moves as a wheel's does.
        """
        nv, q = self.model.nv, first
        near = np.full(nv, POSED)
        near[self.base_v : self.base_v + 3] = TURNED
        near[self.base_v + 3 : self.base_v + 6] = np.inf
        self.put(first)
        begun, radius = self._turns(), np.where(rolls, self.radii, 0.0)
        places = np.where(rolls[:, None] & [True, True, False], self.points(), places)
        for _ in range(ITERATIONS):
            self.put(q)
            move, turn = self.jacobians()
            angle = np.array([_vector(b @ a.T) for a, b in zip(begun, self._turns(), strict=True)])
            off = self.points() - places
            off[:, 0] -= radius * angle[:, 1]
            off[:, 1] += radius * angle[:, 0]
            move[:, 0] += (self.radii - radius)[:, None] * turn[:, 1]  # of a centre where it does not roll
            move[:, 1] -= (self.radii - radius)[:, None] * turn[:, 0]
            centre, by_v = self.center_of_mass()
            error = np.concatenate([off.ravel() / AT_PLACE, (centre - mass) / OVER, self.apart(q, wish) / near])
            slope = np.vstack([move.reshape(-1, nv) / AT_PLACE, by_v / OVER, np.diag(1 / near)])
            change = -np.linalg.solve(slope.T @ slope + DAMPING * np.eye(nv), slope.T @ error)
            size = float(np.max(np.abs(change)))
            q = self.moved(q, change * min(1.0, FARTHEST / max(size, STILL)))
            if size < STILL:
                break
        return q

    def _turns(self) -> list[Array]:
        """(3, 3) of each point, its body's rotation in the twin's state."""
        rotations = [frame.CalcPoseInWorld(self.twin.context).rotation().matrix() for frame in self.frames]
        return [rotations[i] for i in self.owners]


@dataclass(frozen=True, eq=False)
class Soles:
    """The n lowest points of feet in K states: where they are, and how each degree of freedom turns and moves them."""

    base: int  # where the base's turn, then its place, are among the velocities
    down: Array  # (n, 3) [m] from the centre of a sphere to its lowest point, 0 of a corner
    places: Array  # (K, n, 3) [m]
    turns: Array  # (K, n, nv, 3) of the body
    centres: Array  # (K, n, nv, 3) of the sphere's centre

    @property
    def moves(self) -> Array:
        """(K, n, nv, 3) of the material at the lowest point."""
        return self.centres + cross(self.turns, self.down[:, None])

    def velocities(self, v: Array) -> Array:
        """(K, n, 3) [m/s] of the material at the lowest points under v (K, nv)."""
        return np.asarray((v[:, None, None] @ self.moves)[:, :, 0])

    def slopes(self, v: Array) -> Array:
        """(K, n, nv, 3) how `velocities` change with the posture.

        How a column of a Jacobian turns: that of a joint with all joints before it, and none of them with a later one.
        """
        b, nv = self.base, v.shape[1]
        joints, base = np.r_[:b, b + 6 : nv], slice(b, b + 3)
        rates = v[:, None, joints, None]
        turn, move, base_turn = self.turns[:, :, joints], self.centres[:, :, joints], self.turns[:, :, base]
        turning, moving = rates * turn, rates * move  # each joint's part
        later, after = _from_here_on(turning), _from_here_on(moving)
        spin = (v[:, None, None, base] @ base_turn)[:, :, 0]  # (K, n, 3) of the base
        before = spin[:, :, None] + turning.cumsum(axis=2) - turning
        turned, slopes = np.zeros(self.turns.shape), np.zeros(self.turns.shape)
        turned[:, :, joints] = cross(turn, later - turning)
        turned[:, :, base] = cross(base_turn, later[:, :, :1])
        slopes[:, :, joints] = cross(turn, after) + cross(before, move)
        slopes[:, :, base] = cross(base_turn, after[:, :, :1]) + cross(spin[:, :, None], self.centres[:, :, base])
        return np.asarray(slopes + cross(turned, self.down[:, None]))


def _from_here_on(parts: Array) -> Array:
    """(K, n, joints, 3) the sum of a joint's part and those of all later ones."""
    return parts[:, :, ::-1].cumsum(axis=2)[:, :, ::-1]


def _vector(R: Array) -> Array:
    """The rotation vector of a small rotation (3, 3)."""
    return np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]]) / 2


@dataclass(frozen=True, eq=False)
class _Sole:
    """Spheres of `radii` (k,) [m] about `centres` (3, k) [m] in a frame, by its index; corners have the radius 0."""

    frame: Any
    centres: Array
    radii: Array
    friction: float


def _sole(model: Model, foot: str) -> _Sole:
    """What is lowest of a foot in the twin's state."""
    plant, twin = model.plant, model.double
    names = [str(body.name()) for body in bodies(plant)]
    if foot not in names:
        raise UnknownNameError("ContactSchedule.feet", got=foot, known=names)
    frame = plant.GetBodyByName(foot).body_frame()
    rigid = {int(b.index()) for b in plant.GetBodiesWeldedTo(plant.GetBodyByName(foot))}
    centres, radii, frictions = list[Array](), list[float](), list[float]()
    inspector = twin.inspector
    for body, geometry in collision_geometries(plant, twin.scene_graph) if inspector is not None else ():
        if int(body.index()) not in rigid:
            continue
        frictions.append(proximity_property(inspector, geometry, "friction") or 0.0)
        shape, pose = inspector.GetShape(geometry), inspector.GetPoseInFrame(geometry)
        here = plant.CalcRelativeTransform(twin.context, frame, plant.get_body(BodyIndex(body.index())).body_frame())
        if isinstance(shape, Sphere):
            centres.append(here.multiply(pose.translation()))
            radii.append(shape.radius())
        elif isinstance(shape, Box):
            corners = np.array(np.meshgrid(*[[-s / 2, s / 2] for s in shape.size()])).reshape(3, -1)
            centres += [here.multiply(pose.multiply(corner)) for corner in corners.T]
            radii += [0.0] * 8
    if not centres:
        expected = 'spheres or boxes: meshes="spheres" and contact_geometry="corner_spheres" make them of other shapes'
        raise InputError(f"ContactSchedule: shapes of foot {foot}", got="none to stand on", expected=expected)
    world = plant.CalcPointsPositions(twin.context, frame, np.array(centres).T, plant.world_frame())
    bottom = world[2] - np.array(radii)
    lowest = np.flatnonzero(bottom <= np.min(bottom) + SOLE)
    return _Sole(frame.index(), np.array(centres)[lowest].T, np.array(radii)[lowest], min(frictions))
