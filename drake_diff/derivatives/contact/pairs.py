"""Spheres that may touch other shapes, in closed form: distance, normal, and how both change as the bodies move.

Drake's point contact of a sphere (centre c, radius r) with a shape has the signed distance phi = d(c) - r, d being the
shape's own, the normal n = grad d, from the shape to the sphere, and acts at c - (r + b phi) n with
b = k_o / (k_s + k_o), the other shape's part of the two stiffnesses. Spheres, boxes, capsules and half spaces are one
shape: what is within R of a box, d = |e| - R where e leads from the box to c, and inside the way to the nearest face.
"""

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.geometry import Box, Capsule, Cylinder, HalfSpace, Shape, Sphere

from drake_diff._base.arrays import Array, skew
from drake_diff.model.model import Model

Indices = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class Touches:
    """M pairs that overlap, each in one of N states; in world."""

    state: Indices  # (M,)
    pair: Indices
    middle: Array  # (M, 3) half way between the deepest points of the two [m]
    phi: Array  # (M,) the signed distance, below 0 [m]
    normal: Array  # (M, 3) from the other shape to the sphere
    change: Array  # (M, 7, 6) of [middle; normal; phi], as moved with the other shape, by the sphere's twist in it

    def joined(self, other: "Touches") -> "Touches":
        """These and others."""
        parts = ([getattr(of, f.name) for of in (self, other)] for f in fields(self))
        return Touches(*(np.concatenate(both) for both in parts))

    def at(self, part: Array) -> tuple[Array, Array]:
        """Where the contacts act (M, 3), and (M, 7, 6) as `change`, of that point and by the twist there.

        `part` (M,) is the other shape's of the two stiffnesses.
        """
        n, share = self.normal, (part - 0.5)[:, None]
        back = share * self.phi[:, None] * n  # from the point to the middle
        change = np.array(self.change)
        change[:, :, 3:] -= self.change[:, :, :3] @ skew(back)
        along = n[:, :, None] * change[:, 6:] + self.phi[:, None, None] * change[:, 3:6]
        change[:, :3] -= share[..., None] * along
        return self.middle - back, change


@dataclass(frozen=True, eq=False)
class ContactPairs:
    """P pairs of a sphere and another shape; those without a sphere, or with a shape not known here, are left out."""

    bodies: tuple[Any, ...]  # Drake's, of all shapes
    ids: tuple[tuple[Any, Any], ...]  # of the sphere and of the other shape
    sphere_body: Indices  # (P,) in bodies
    other_body: Indices
    center: Array  # (P, 3) of the sphere, in its body [m]
    radius: Array  # (P,)
    rotation: Array  # (P, 3, 3) of the other shape, in its body
    position: Array  # (P, 3)
    lower: Array  # (P, 3) the corners of the other shape's box
    upper: Array
    rounding: Array  # (P,) R
    is_round: NDArray[np.bool_]  # (P,) whether the other shape is the cylinder along z within its box

    def touching(self, poses: Array) -> Touches:
        """The pairs that overlap where the bodies are at `poses` (N, bodies, 3, 4)."""
        of_sphere, of_other = poses[:, self.sphere_body], poses[:, self.other_body]
        center = (of_sphere[..., :3] @ self.center[:, :, None])[..., 0] + of_sphere[..., 3]
        turned = of_other[..., :3] @ self.rotation
        origin = (of_other[..., :3] @ self.position[:, :, None])[..., 0] + of_other[..., 3]
        local = ((center - origin)[..., None, :] @ turned)[..., 0, :]
        outside = local - np.minimum(np.maximum(local, self.lower), self.upper)
        length = np.sqrt((outside * outside).sum(axis=-1))
        state, pair = np.nonzero(length < self.radius + self.rounding)  # inside the length is 0
        length, outside, turned = length[state, pair], outside[state, pair], turned[state, pair]
        if length.size and length.min() == 0.0:
            length, normal, curvature = self._with_inside(local[state, pair], outside, length, pair)
        else:
            normal = outside / length[:, None]
            curvature = _curvature(normal, outside, length)
        phi = length - self.rounding[pair] - self.radius[pair]
        normal = (turned @ normal[:, :, None])[..., 0]
        curvature = turned @ curvature @ turned.swapaxes(-1, -2)
        reach = (self.radius[pair] + phi / 2)[:, None]  # from the middle to the centre
        middle = center[state, pair] - reach * normal
        return Touches(state, pair, middle, phi, normal, _change(normal, curvature, reach[..., None]))

    def _with_inside(self, local: Array, outside: Array, length: Array, pair: Indices) -> tuple[Array, Array, Array]:
        """Distance from the box, normal and curvature, for centres that may be inside it, where the last is 0."""
        within = length == 0.0
        safe = np.where(within, 1.0, length)
        normal = outside / safe[:, None]
        curvature = np.where(within[:, None, None], 0.0, _curvature(normal, outside, safe))
        ways = np.concatenate([self.upper[pair] - local, local - self.lower[pair]], axis=1)
        face = np.argmin(ways, axis=1)
        signed = np.concatenate([np.eye(3), -np.eye(3)])[face]
        way = np.take_along_axis(ways, face[:, None], axis=1)[:, 0]
        return np.where(within, -way, length), np.where(within[:, None], signed, normal), curvature


def _curvature(normal: Array, outside: Array, length: Array) -> Array:
    """(M, 3, 3) (P - n n') / |e|, P onto the axes along which e is not 0."""
    across = (outside != 0.0)[:, :, None] * np.eye(3)
    return np.asarray((across - normal[:, :, None] * normal[:, None, :]) / length[:, None, None])


def _change(normal: Array, curvature: Array, reach: Array) -> Array:
    """(M, 7, 6) of Touches, of the derivative of the normal by where the centre is in the other shape's frame."""
    change, of_center = np.zeros((len(normal), 7, 6)), np.empty((len(normal), 3, 6))
    of_center[..., :3], of_center[..., 3:] = np.eye(3), -reach * skew(normal)
    change[:, 3:6] = curvature @ of_center
    change[:, :3] = of_center - reach * change[:, 3:6]
    change[:, :3, :3] -= normal[:, :, None] * normal[:, None, :] / 2
    change[:, 6, :3] = normal
    return change


def read_pairs(model: Model, *, cylinders: bool = False) -> ContactPairs:
    """The pairs of spheres of `model`, none where there are none; with cylinders, which `touching` does not know."""
    plant, inspector = model.plant, model.double.inspector
    ids, at, radius, boxes, rounds = [], [], [], [], []
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
        own = [plant.GetBodyFromFrameId(inspector.GetFrameId(i)) for i in ids[-1]]
        at.append([bodies.setdefault(body.index(), (len(bodies), body))[0] for body in own])
    poses = [[inspector.GetPoseInFrame(i) for i in pair] for pair in ids]
    count, of_body = len(ids), np.array(at, dtype=np.intp).reshape(-1, 2)
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


def move_apart(model: Model, pair: tuple[Any, Any]) -> bool:
    """Whether two geometries are on bodies that are not welded together, on which contact would do nothing."""
    plant, inspector = model.plant, model.double.inspector
    body, other = (plant.GetBodyFromFrameId(inspector.GetFrameId(i)) for i in pair)
    return all(welded.index() != body.index() for welded in plant.GetBodiesWeldedTo(other))


def _box_around(shape: Cylinder) -> tuple[Array, Array, float]:
    half = np.array([shape.radius(), shape.radius(), shape.length() / 2])
    return -half, half, 0.0


def _rounded_box(shape: Shape) -> tuple[Array, Array, float] | None:
    """The box's lower and upper corner and the rounding of a shape, None where it is none."""
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
