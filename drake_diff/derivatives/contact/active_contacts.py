"""The contacts of a state: the overlapping pairs, their distances and normals, and the derivatives of both.

Drake's point contact of a sphere (centre c, radius r) with a shape has the signed distance phi = d(c) - r, where d is
the shape's distance, and the normal n = grad d from the shape to the sphere. It acts at c - (r + b phi) n with
b = k_o / (k_s + k_o), where k_o is the stiffness of the other shape. Spheres, boxes, capsules and half spaces are
treated as one shape, a box with rounding R: d = |e| - R, where e is the offset of c from the box, and inside the box
the distance to the nearest face. For pairs without a sphere, the results of SceneGraph are used, see `nearest_points`.

S_j = [l_j; a_j] is the motion of degree of freedom j in world about its origin, and L_j = l_j + a_j x p its velocity at
the contact p. s_j is 1 or -1 if j moves only the sphere or only the other shape, and else 0. Then

    J_c = (s_j L_j)_j,   dS_k / dq_j = S_j x S_k where j moves the axis of k, else 0,

where dq is in the tangent space. Drake scales friction by w = |W| / 3 with W = J_c diag(A)^-1 J_c', where A is the mass
matrix plus the contribution of joint damping in a step.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Capsule, Cylinder, HalfSpace, Shape, Sphere

from drake_diff._base.arrays import Array, Indices, cross, own_array, skew
from drake_diff.derivatives.contact import kernel
from drake_diff.derivatives.contact.nearest_points import NearestPointPairs, move_apart, read_nearest_point_pairs
from drake_diff.derivatives.steps import Steps
from drake_diff.mechanics.description import Description
from drake_diff.model.model import Model


@dataclass(frozen=True, eq=False)
class Touches:
    """M overlaps of pairs, each in one of N states, in world."""

    state: Indices  # (M,)
    pair: Indices
    middle: Array  # (M, 3) midpoint of the deepest points of the two shapes [m]
    phi: Array  # (M,) the signed distance, below 0 [m]
    normal: Array  # (M, 3) from the other shape to the sphere
    change: Array  # (M, 7, 6) d[middle; normal; phi] by the sphere's twist, both relative to the other shape

    def contact_points(self, other_part: Array) -> tuple[Array, Array]:
        """Return the contact points (M, 3), and `change` (M, 7, 6) for these points and the twists at them.

        `other_part` (M,) is b, the fraction k_o / (k_s + k_o) of the stiffness of the other shape.
        """
        n, share = self.normal, (other_part - 0.5)[:, None]
        back = share * self.phi[:, None] * n  # from the point to the middle
        change = np.array(self.change)
        change[:, :, 3:] -= self.change[:, :, :3] @ skew(back)
        along = n[:, :, None] * change[:, 6:] + self.phi[:, None, None] * change[:, 3:6]
        change[:, :3] -= share[..., None] * along
        return self.middle - back, change


@dataclass(frozen=True, eq=False)
class ContactPairs:
    """P pairs of a sphere and another shape; pairs without a sphere or with an unsupported shape are not included."""

    bodies: tuple[Any, ...]  # Drake's bodies with these shapes
    ids: tuple[tuple[Any, Any], ...]  # of the sphere and of the other shape
    sphere_body: Indices  # (P,) index in bodies
    other_body: Indices
    center: Array  # (P, 3) of the sphere, in its body [m]
    radius: Array  # (P,)
    rotation: Array  # (P, 3, 3) of the other shape, in its body
    position: Array  # (P, 3)
    lower: Array  # (P, 3) the corners of the other shape's box
    upper: Array
    rounding: Array  # (P,) R
    is_round: NDArray[np.bool_]  # (P,) whether the other shape is a cylinder along z inscribed in its box

    def overlapping(self, of_pairs: Any, poses: Array) -> Any:
        """Return the kernel.Touching of the overlaps for bodies at `poses` (N, bodies, 3, 4)."""
        N = len(poses)
        shapes = self.center, self.radius, self.rotation, self.position, self.lower, self.upper, self.rounding
        spheres, first = kernel.Spheres(*map(own_array, shapes)), np.empty(N + 1, dtype=np.int64)
        pair = np.empty(N * len(self.radius), dtype=np.int64)
        M = kernel.overlapping(spheres, of_pairs.sides, poses, first, pair)
        contacts = kernel.Touching(
            first, pair[:M], np.empty((M, 3)), np.empty((M, 3)), np.empty(M), np.empty((M, 7, 6))
        )
        kernel.touch(spheres, of_pairs, poses, contacts)
        return contacts

    def touching(self, poses: Array) -> Touches:
        """Return the overlaps for bodies at `poses` (N, bodies, 3, 4)."""
        count, sides = len(self.ids), np.stack([self.sphere_body, self.other_body], axis=1)
        none, halves = np.zeros(count), np.full(count, 0.5)  # b = 1/2, so that the contact point is the midpoint
        of_pairs = kernel.Pairs(
            sides, np.zeros((len(self.bodies), 0)), none, none, none, none, halves, np.zeros((5, count, 0))
        )
        contacts = self.overlapping(of_pairs, own_array(poses))
        state = np.repeat(np.arange(len(poses)), np.diff(contacts.first))
        return Touches(state, contacts.pair, contacts.point, contacts.phi, contacts.normal, contacts.change)


def read_pairs(model: Model, *, cylinders: bool = False) -> ContactPairs:
    """Read the pairs with a sphere of `model`, optionally with `cylinders`, which `touching` does not support."""
    plant, inspector = model.plant, model.double.inspector
    ids, body_numbers, radius, boxes, rounds = [], [], [], [], []
    bodies: dict[Any, tuple[int, Any]] = {}
    for pair in sorted(inspector.GetCollisionCandidates()) if inspector is not None else ():
        shapes = [inspector.GetShape(i) for i in pair]
        first = 0 if isinstance(shapes[0], Sphere) else 1
        other = shapes[1 - first]
        box = _box_around(other) if cylinders and isinstance(other, Cylinder) else _rounded_box(other)
        if not isinstance(shapes[first], Sphere) or box is None or not move_apart(model, pair):
            continue
        ids.append((pair[first], pair[1 - first]))
        radius.append(shapes[first].radius())
        boxes.append(box)
        rounds.append(isinstance(other, Cylinder))
        pair_bodies = [plant.GetBodyFromFrameId(inspector.GetFrameId(i)) for i in ids[-1]]
        body_numbers.append([bodies.setdefault(body.index(), (len(bodies), body))[0] for body in pair_bodies])
    poses = [[inspector.GetPoseInFrame(i) for i in pair] for pair in ids]
    count, of_body = len(ids), np.array(body_numbers, dtype=np.intp).reshape(-1, 2)
    return ContactPairs(
        bodies=tuple(body for _, body in bodies.values()),
        ids=tuple(ids),
        sphere_body=of_body[:, 0],
        other_body=of_body[:, 1],
        center=np.array([X.translation() for X, _ in poses]).reshape(count, 3),
        radius=np.array(radius, dtype=float),
        rotation=np.array([X.rotation().matrix() for _, X in poses]).reshape(count, 3, 3),
        position=np.array([X.translation() for _, X in poses]).reshape(count, 3),
        lower=np.array([lower for lower, _, _ in boxes]).reshape(count, 3),
        upper=np.array([upper for _, upper, _ in boxes]).reshape(count, 3),
        rounding=np.array([rounding for _, _, rounding in boxes], dtype=float),
        is_round=np.array(rounds, dtype=bool),
    )


def _box_around(shape: Cylinder) -> tuple[Array, Array, float]:
    half = np.array([shape.radius(), shape.radius(), shape.length() / 2])
    return -half, half, 0.0


def _rounded_box(shape: Shape) -> tuple[Array, Array, float] | None:
    """Return the lower and upper corner of a shape's box and its rounding, or None for another type of shape."""
    if isinstance(shape, Sphere):
        return np.zeros(3), np.zeros(3), shape.radius()
    if isinstance(shape, Capsule):
        half = np.array([0.0, 0.0, shape.length() / 2])
        return -half, half, shape.radius()
    if isinstance(shape, Box):
        half = np.array(shape.size()) / 2
        return -half, half, 0.0
    if isinstance(shape, HalfSpace):
        return np.full(3, -np.inf), np.array([np.inf, np.inf, 0.0]), 0.0
    return None


@dataclass(frozen=True, eq=False)
class Topology:
    """Incidence (0 or 1) of the degrees of freedom of a tree with axes and bodies."""

    moves: Array  # (nv, nv) entry j, k: whether j moves the axis of k
    bodies: dict[str, Array]  # body name -> (nv,) whether each degree of freedom moves the body


def topology_of(description: Description) -> Topology:
    """Return the topology of a tree; only its translations move the rotation axes of a free body."""
    nv = description.coordinates.nv
    moves = np.zeros((nv, nv))
    bodies = {"world": np.zeros(nv)}
    for link in description.links:
        dofs = link.v_start + np.arange({"weld": 0, "quaternion_floating": 6}.get(link.kind, 1))
        above = np.flatnonzero(bodies[link.parent])
        moves[np.ix_(above, dofs)] = 1.0
        if len(dofs) > 1:
            moves[np.ix_(dofs[3:], dofs[:3])] = 1.0
        bodies[link.body] = np.array(bodies[link.parent])
        bodies[link.body][dofs] = 1.0
    return Topology(moves, bodies)


def weigh(J: Array, diagonal: Array) -> Array:
    """Return w (M,) for transposed Jacobians J (M, nv, 3) and the diagonal (M, nv) of A."""
    W = J.swapaxes(-1, -2) @ (J / diagonal[..., None])
    return np.asarray(np.sqrt((W * W).sum(axis=(1, 2))) / 3)


@dataclass(frozen=True, eq=False)
class Contacts:
    """M contacts, and the motions of the degrees of freedom at the contact points."""

    touch: Touches
    moves: Array  # (nv, nv)
    sphere: Array  # (M, nv) 1 where a degree of freedom moves the sphere
    other: Array  # (M, nv) 1 where a degree of freedom moves the other shape
    angular: Array  # (M, nv, 3) a
    point: Array  # (M, 3) p
    at_point: Array  # (M, nv, 3) L
    change: Array  # (M, 7, 6) d[p; normal; phi] / d(twist at p): see `Touches`
    unknown: dict[int, str] = field(default_factory=dict)  # the states for which `change` is not known

    @property
    def side(self) -> Array:
        """The signs s (M, nv)."""
        return self.sphere - self.other

    @property
    def jacobian(self) -> Array:
        """The transpose of J (M, nv, 3)."""
        return np.asarray(self.side[..., None] * self.at_point)

    def displacement(self) -> tuple[Array, Array, Array]:
        """Differentiate p (M, nv, 3), the normal (M, nv, 3) and phi (M, nv) with respect to each degree of freedom."""
        twist = np.concatenate([self.at_point, self.angular], axis=-1)
        moved = (self.side[..., None] * twist) @ self.change.swapaxes(-1, -2)
        other = self.other[..., None]
        normal = moved[..., 3:6] + other * cross(self.angular, self.touch.normal[:, None, :])
        return moved[..., :3] + other * self.at_point, normal, moved[..., 6]

    def velocity_change(self, v: Array, point: Array) -> Array:
        """Differentiate J v for constant v (M, nv) as (M, nv, 3); `point` (M, nv, 3) is the derivative of p."""
        u = v * self.side
        turned = cross(u[:, None, :] @ self.angular, point)
        after = (self.moves * u[:, None, :]) @ np.concatenate([self.at_point, self.angular], axis=-1)
        return np.asarray(turned + cross(self.angular, after[..., :3]) + cross(self.at_point, after[..., 3:]))

    def force_change(self, force: Array, point: Array) -> Array:
        """Differentiate J' f for constant f (M, 3) as (M, nv, nv), likewise."""
        twisted = cross(force[:, None, :], self.angular)  # f x a
        across = twisted @ self.at_point.swapaxes(-1, -2)  # (f x a_k) . L_j = -a_k . (f x L_j)
        moved = twisted @ point.swapaxes(-1, -2) + self.moves.T * (across.swapaxes(-1, -2) - across)
        return np.asarray(self.side[..., None] * moved)


SPHERES, JOINT_LIMITS = "spheres", "joint limits"  # kinds of impulses, in addition to pairs of other shapes


def is_iterated(kind: str) -> bool:
    """Check if SceneGraph computes the contact point of such shapes iteratively. See `AllPairs.kinds`."""
    return kind not in (SPHERES, JOINT_LIMITS) and not {"Sphere", "HalfSpace"} & set(kind.split(" and "))


@dataclass(frozen=True, eq=False)
class Placed:
    """N states with the poses of the bodies and the overlaps found by SceneGraph."""

    poses: Array  # (N, bodies, 3, 4)
    state: Indices  # (M,) the state of each overlap
    pair: Indices  # (M,)
    found: Array  # (M, 7) the midpoint, the normal and phi
    to_one_side: set[int] = field(default_factory=set)  # the states with one-sided derivatives only


@dataclass(frozen=True, eq=False)
class AllPairs:
    """P pairs, beginning with the pairs of spheres."""

    bodies: tuple[Any, ...]  # Drake's bodies with these shapes
    ids: tuple[tuple[Any, Any], ...]
    sides: Indices  # (P, 2) indices in bodies
    spheres: ContactPairs
    others: NearestPointPairs

    def locate(self, steps: Steps, poses: Array) -> Placed:
        """Find the overlaps at the steps' states, with the bodies at `poses` (N, bodies, 3, 4)."""
        overlaps: list[tuple[int, int, Array]] = []
        for k in np.flatnonzero(steps.touching & bool(self.others.ids)).tolist():
            steps.stand_at(k)
            overlaps += [(k, len(self.spheres.ids) + i, overlap) for i, overlap in self.others.find(steps.model)]
        state, pair = (np.array([row[i] for row in overlaps], dtype=np.intp) for i in (0, 1))
        return Placed(poses, state, pair, np.array([overlap for *_, overlap in overlaps]).reshape(-1, 7))

    def kinds(self, placed: Placed, count: int) -> list[set[str]]:
        """Return the kinds of contact in each of `count` states with contact: spheres, or the names of both shapes.

        Contacts with one-sided derivatives only are kinds of their own.
        """
        shapes_that_touch: list[set[str]] = [set() for _ in range(count)]
        for state, pair in zip(placed.state, placed.pair, strict=True):
            shapes = self.others.shapes[pair - len(self.spheres.ids)]
            side = " and to one side" if int(state) in placed.to_one_side else ""
            shapes_that_touch[state].add(" and ".join(sorted(type(shape).__name__ for shape in shapes)) + side)
        return [kinds or {SPHERES} for kinds in shapes_that_touch]

    def of_scene_graph(self, placed: Placed) -> Touches:
        """Return the overlaps found by SceneGraph, without derivatives."""
        overlaps = placed.found
        nothing = np.full((len(overlaps), 7, 6), np.nan)
        return Touches(placed.state, placed.pair, overlaps[:, :3], overlaps[:, 6], overlaps[:, 3:6], nothing)

    def complete(self, touch: Touches, placed: Placed, twists: Array) -> dict[int, str]:
        """Fill in the derivatives of SceneGraph's overlaps; return the states with unknown derivatives and the reasons.

        `twists` (M, nv, 6) are the first shape's twists relative to the second for each degree of freedom, at `middle`.
        """
        count, unknown = len(self.spheres.ids), {}
        for pair in np.unique(touch.pair[touch.pair >= count]):
            which = np.flatnonzero(touch.pair == pair)
            a, b = (placed.poses[touch.state[which], side] for side in self.sides[pair])
            overlaps = np.concatenate([touch.middle[which], touch.normal[which], touch.phi[which, None]], axis=1)
            touch.change[which], known, sided = self.others.change(int(pair) - count, (a, b), overlaps, twists[which])
            names = " and a ".join(type(shape).__name__ for shape in self.others.shapes[pair - count])
            bodies = " and ".join(body.name() for body in self.others.bodies[pair - count])
            for state in touch.state[which[~known]]:
                unknown[int(state)] = f"Drake's contact point of a {names}, of {bodies}, jumps or has no derivative"
            placed.to_one_side.update(touch.state[which[sided]].tolist())
        return unknown


def read_all_pairs(model: Model) -> AllPairs:
    """Read all pairs of `model` that may collide; empty if there are none."""
    spheres = read_pairs(model)
    others = read_nearest_point_pairs(model, set(spheres.ids))
    bodies = {body.index(): body for body in (*spheres.bodies, *(b for both in others.bodies for b in both))}
    order = {index: i for i, index in enumerate(bodies)}
    of_spheres = np.stack([spheres.sphere_body, spheres.other_body], axis=1)
    sides = np.array([[order[b.index()] for b in both] for both in others.bodies], dtype=np.intp).reshape(-1, 2)
    ids = (*spheres.ids, *others.ids)
    return AllPairs(tuple(bodies.values()), ids, np.concatenate([of_spheres, sides]), spheres, others)
