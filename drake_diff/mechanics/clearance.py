"""Signed distances of the shapes of a robot from a ball, from a box and from each other, as functions of the state.

Each function takes x (nx,) of floats, AutoDiffXd or symbols and returns one number per row. `values` and `linearize`
evaluate many states at once, the latter with exact derivatives. The derivative of a distance is computed with the
nearest points fixed on their pieces.

For distances from a ball and a box, capsules that contain the robot's shapes are used. For self-collision, Drake's own
shapes are used, see `OfShapes`. The formulas for points, segments and boxes have no branch. The distance of a capsule
is the distance of its segment minus its radius. All distances are exact and continuous. Their derivatives jump only
between parallel segments and, inside a box, on the planes equidistant to two faces.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from pydrake.autodiffutils import ExtractValue

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.autodiff import chain_rows
from drake_diff.exceptions import InputError
from drake_diff.mechanics.cover import Piece, Solid, with_collision_shapes
from drake_diff.mechanics.forward_kinematics import ForwardKinematics
from drake_diff.mechanics.quantities import PLACE
from drake_diff.model.model import Model
from drake_diff.model.plant import joints

TINY = 1e-24  # [m^2] keeps the derivative of a length finite at 0; it adds at most 1e-12 m
PARALLEL = 1e-12  # regularization of the squared sine of the angle between two segments


def length(v: Any) -> Any:
    """Return the lengths (...) of vectors (..., 3)."""
    return np.sqrt(_dot(v, v) + TINY)


def along_segments(a: tuple[Any, Any], b: tuple[Any, Any], squared_a: Any, squared_b: Any) -> tuple[Any, Any]:
    """Return the parameters in [0, 1] of the nearest points of two segments (start, end).

    See Ericson, "Real-Time Collision Detection", 2005, section 5.1.9. For parallel segments, the points are one pair
    of the nearest points.
    """
    u, v, r = a[1] - a[0], b[1] - b[0], a[0] - b[0]
    uv, ur, vr, product = _dot(u, v), _dot(u, r), _dot(v, r), squared_a * squared_b
    apart = product - uv * uv + np.where(product > 0, PARALLEL * product, 1.0)
    s = _between_0_and_1((uv * vr - ur * squared_b) / apart)
    t = _between_0_and_1((uv * s + vr) * _inverse(squared_b))
    return _between_0_and_1((uv * t - ur) * _inverse(squared_a)), t


def to_box(point: Any, half: Array) -> Any:
    """Return the signed distance (...) of points (..., 3), in a box's frame, from the box of half sizes (3,)."""
    beyond = np.abs(point) - half
    outside = (beyond + np.abs(beyond)) / 2
    nearest = _larger(_larger(beyond[..., 0], beyond[..., 1]), beyond[..., 2])
    return length(outside) + (nearest - np.abs(nearest)) / 2


def away_from_box(point: Array, half: Array) -> Array:
    """Return the gradient (..., 3) of `to_box` with respect to the point."""
    beyond = np.abs(point) - half
    outside = np.maximum(beyond, 0.0)
    nearest = np.eye(3)[np.argmax(beyond, axis=-1)]
    far = length(outside)[..., None]
    way = np.where(np.max(beyond, axis=-1)[..., None] > 0, outside / far, nearest)
    return np.asarray(np.sign(point) * way)


def _dot(a: Any, b: Any) -> Any:
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def _larger(a: Any, b: Any) -> Any:
    return (a + b + np.abs(a - b)) / 2


def _between_0_and_1(t: Any) -> Any:
    return (np.abs(t) - np.abs(t - 1) + 1) / 2


def _inverse(squared: Any) -> Array:
    """Return the inverse of a squared length, or 0 if the length is 0."""
    return np.divide(1.0, squared, out=np.zeros_like(squared), where=squared > 0)


BALL_PART = 0.1  # fraction of a capsule's radius by which the balls that replace it for a box exceed it


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of a robot as arrays, one row per piece."""

    at: Indices  # (m,) the link of each piece
    start: Array  # (m, 3) [m] in the link's frame
    end: Array  # (m, 3)
    radius: Array  # (m,) [m]
    squared: Array  # (m,) [m^2] squared lengths of the segments

    def ends(self, frames: tuple[Any, Any]) -> tuple[Any, Any]:
        """Return the start and end points (..., m, 3) of the segments in world."""
        R, p = frames[0][..., self.at, :, :], frames[1][..., self.at, :]
        return (R @ self.start[..., None])[..., 0] + p, (R @ self.end[..., None])[..., 0] + p

    def ways(self, frames: tuple[Array, Array]) -> Array:
        """Return the largest displacement (K-1, m) [m] of each piece's points between successive frames (K, ...)."""
        far = [np.linalg.norm(np.diff(end, axis=0), axis=-1) for end in self.ends(frames)]
        return np.asarray(np.maximum(*far))


def in_rows(pieces: Sequence[Piece]) -> Pieces:
    """Convert pieces to arrays."""
    return Pieces(
        np.array([p.link for p in pieces], dtype=np.intp),
        np.array([p.start for p in pieces]).reshape(-1, 3),
        np.array([p.end for p in pieces]).reshape(-1, 3),
        np.array([p.radius for p in pieces]),
        np.array([p.squared for p in pieces]),
    )


class Clearance:
    """Signed distances [m] of a robot's pieces. `labels` (m,) describe the rows, `sides` are the one or two pieces."""

    def __init__(self, model: Model, kinematics: ForwardKinematics, labels: Sequence[str], *sides: Pieces):
        self.model, self.kinematics, self.labels, self.sides = model, kinematics, tuple(labels), sides

    def __call__(self, x: Any) -> Any:
        """Return the distances (m,) [m] at x (nx,)."""
        self.refuse_parameters()
        return self._distances(self.kinematics(np.asarray(x)[: self.model.nq]))

    def refuse_parameters(self) -> None:
        """Raise InputError if a parameter that the distances depend on is changed."""
        for quantity in sorted(self.model.other_quantities & PLACE):
            raise InputError("parameters", got=quantity, expected="parameters that do not change distances")

    def values(self, xs: Array) -> Array:
        """Return the distances (K, m) [m] at xs (K, nx)."""
        return np.asarray(self._distances(self.kinematics(xs[:, : self.model.nq])), dtype=float)

    def linearize(self, xs: Array) -> tuple[Array, Array]:
        """Return the distances (K, m) [m] and their derivatives with respect to the state (K, m, nx), at xs (K, nx)."""
        q = xs[:, : self.model.nq]
        frames = self.kinematics(q)
        slopes = np.zeros((len(xs), len(self.labels), self.model.nx))
        for side, (points, ways) in zip(self.sides, self._ways(frames), strict=True):
            slopes += self.kinematics.pushes(q, frames, side.at, points, ways)
        return np.asarray(self._distances(frames)), slopes

    def moved(self, xs: Array) -> Array:
        """Return upper bounds (K-1, m) [m] on the change of each distance between successive states xs (K, nx).

        Each bound is the largest displacement of a point of the row's piece, summed over its sides.
        """
        frames = self.kinematics(xs[:, : self.model.nq])
        return np.asarray(sum(side.ways(frames) for side in self.sides))

    def _distances(self, frames: tuple[Any, Any]) -> Any:
        raise NotImplementedError

    def _ways(self, frames: tuple[Array, Array]) -> Sequence[tuple[Array, Array]]:
        """Return, for each side, the nearest points (K, m, 3) and the gradients of the distances at these points."""
        raise NotImplementedError


class FromBox(Clearance):
    """Distances of balls from a box with `center` (3,), `rotation` (3, 3), and `half` of its edges' lengths (3,) [m].

    Capsules are replaced by balls, see `balls_of`.
    """

    def __init__(
        self,
        model: Model,
        kinematics: ForwardKinematics,
        pieces: Sequence[Piece],
        center: Array,
        rotation: Array,
        half: Array,
    ):
        balls = [ball for piece in pieces for ball in balls_of(piece)]
        super().__init__(model, kinematics, [p.body for p in balls], in_rows(balls))
        self.center, self.rotation, self.half = center, rotation, half

    def _within(self, frames: tuple[Any, Any]) -> tuple[Any, Any]:
        """Return the balls' centres (..., m, 3) in world and in the box's frame."""
        points, _ = self.sides[0].ends(frames)
        return points, (points - self.center) @ self.rotation

    def _distances(self, frames: tuple[Any, Any]) -> Any:
        return to_box(self._within(frames)[1], self.half) - self.sides[0].radius

    def _ways(self, frames: tuple[Array, Array]) -> Sequence[tuple[Array, Array]]:
        points, local = self._within(frames)
        return [(points, away_from_box(local, self.half) @ self.rotation.T)]


class OfPairs(Clearance):
    """Distances between two capsules, one row per pair."""

    def __init__(
        self,
        model: Model,
        kinematics: ForwardKinematics,
        pairs: Sequence[tuple[Piece, Piece]],
        labels: Sequence[str] | None = None,
    ):
        labels = [f"{a.body} and {b.body}" for a, b in pairs] if labels is None else labels
        super().__init__(model, kinematics, labels, in_rows([a for a, _ in pairs]), in_rows([b for _, b in pairs]))

    def _nearest(self, frames: tuple[Any, Any]) -> tuple[Any, Any]:
        first, second = (side.ends(frames) for side in self.sides)
        s, t = along_segments(first, second, self.sides[0].squared, self.sides[1].squared)
        return first[0] + s[..., None] * (first[1] - first[0]), second[0] + t[..., None] * (second[1] - second[0])

    def _distances(self, frames: tuple[Any, Any]) -> Any:
        a, b = self._nearest(frames)
        return length(a - b) - (self.sides[0].radius + self.sides[1].radius)

    def _ways(self, frames: tuple[Array, Array]) -> Sequence[tuple[Array, Array]]:
        a, b = self._nearest(frames)
        way = (a - b) / length(a - b)[..., None]
        return [(a, way), (b, -way)]


class OfShapes(Clearance):
    """Drake's signed distances between two shapes, one row per pair; negative values are penetration depths.

    The distance of the capsules around two shapes is never larger than the distance of the shapes. Above `far`, the
    capsules' distance is used, which takes a hundredth of the time. Between `near` and `far` the two are blended. So
    no row exceeds the distance of its shapes, and rows below `near` equal it. Drake uses the convex hull of meshes. For
    two balls or capsules the capsules' distance is exact. Illustration shapes are replaced by their capsules.
    """

    def __init__(
        self, model: Model, kinematics: ForwardKinematics, pairs: Sequence[tuple[Solid, Solid]], near: float, far: float
    ):
        sides = [in_rows([pair[i].pieces[0] for pair in pairs]) for i in (0, 1)]
        super().__init__(model, kinematics, [f"{a.body} and {b.body}" for a, b in pairs], *sides)
        self.pairs, self.near, self.far, self.shapes = tuple(pairs), near, far, with_collision_shapes(model)
        self.exact = np.array(
            [None not in (a.geometry, b.geometry) and not (a.is_round and b.is_round) for a, b in pairs], dtype=bool
        )
        self.capsules = OfPairs(model, kinematics, [(p, r) for a, b in pairs for p in a.pieces for r in b.pieces])
        self.first = np.cumsum([0, *(len(a.pieces) * len(b.pieces) for a, b in pairs)])[:-1]

    def __call__(self, x: Any) -> Any:
        self.refuse_parameters()
        x = np.asarray(x)
        if x.dtype == float:
            return self.values(x[None])[0]
        values, slopes = self.linearize(ExtractValue(x.reshape(-1, 1)).T)
        return chain_rows(values[0], slopes[0], x)

    def values(self, xs: Array) -> Array:
        return self._blended(xs, np.minimum.reduceat(self.capsules.values(xs), self.first, axis=1)).values

    def linearize(self, xs: Array) -> tuple[Array, Array]:
        of_capsules, slopes = self.capsules.linearize(xs)
        ends = [*self.first[1:], of_capsules.shape[1]]
        nearest = [a + np.argmin(of_capsules[:, a:b], axis=1) for a, b in zip(self.first, ends, strict=True)]
        rows = np.arange(len(xs))[:, None], np.column_stack(nearest)
        points, way = np.zeros((2, *rows[1].shape, 3)), np.zeros((*rows[1].shape, 3))
        values, by_capsules, by_shapes = self._blended(xs, of_capsules[rows], points, way)
        q, total = xs[:, : self.model.nq], slopes[rows] * by_capsules[..., None]
        frames = self.kinematics(q)
        for side, nearest_points, sign in zip(self.sides, points, (1.0, -1.0), strict=True):
            total += by_shapes[..., None] * self.kinematics.pushes(q, frames, side.at, nearest_points, sign * way)
        return values, total

    def moved(self, xs: Array) -> Array:
        frames = self.kinematics(xs[:, : self.model.nq])
        far = np.zeros((len(xs) - 1, len(self.pairs)))
        for i, side in enumerate(self.sides):
            corners = np.array([pair[i].corners for pair in self.pairs])  # (m, 8, 3) of bounding boxes
            R, p = frames[0][:, side.at], frames[1][:, side.at]
            far += np.max(
                np.linalg.norm(np.diff(corners @ R.swapaxes(-1, -2) + p[:, :, None], axis=0), axis=-1), axis=-1
            )
        return far

    def _blended(self, xs: Array, least: Array, points: Array | None = None, way: Array | None = None) -> "_Blended":
        """Return the blended rows (K, m) and their weights at xs (K, nx), from the capsules' distances `least` (K, m).

        If given, `points` (2, K, m, 3) is filled with the shapes' nearest points in world, and `way` (K, m, 3) with the
        gradient of the distance with respect to the first of them.
        """
        share = np.clip((self.far - least) / (self.far - self.near), 0.0, 1.0) * self.exact
        weight, slope = share**2 * (3 - 2 * share), -6 * share * (1 - share) / (self.far - self.near)
        distances, twin = least.copy(), self.shapes.double
        for k in np.flatnonzero(np.any(weight > 0, axis=1) & np.all(np.isfinite(xs), axis=1)):
            twin.set_state(xs[k])
            query = twin.plant.get_geometry_query_input_port().Eval(twin.context)
            for i in np.flatnonzero(weight[k] > 0):
                a, b = (solid.geometry for solid in self.pairs[i])
                pair = query.ComputeSignedDistancePairClosestPoints(a, b)
                distances[k, i] = pair.distance
                if points is None or way is None:
                    continue
                in_a, in_b = query.GetPoseInWorld(a), query.GetPoseInWorld(b)
                points[:, k, i] = in_a.multiply(pair.p_ACa), in_b.multiply(pair.p_BCb)
                way[k, i] = pair.nhat_BA_W
                if not np.all(np.isfinite(way[k, i])):  # for shapes at distance 0
                    way[k, i] = in_a.translation() - in_b.translation()
                    way[k, i] /= length(way[k, i])
        return _Blended(
            least + weight * (distances - least), 1 - weight + slope * (distances - least), by_shapes=weight
        )


class _Blended(NamedTuple):
    """Distances (K, m), and their derivatives with respect to the distances of capsules and of shapes."""

    values: Array
    by_capsules: Array
    by_shapes: Array


def from_ball(
    model: Model, kinematics: ForwardKinematics, pieces: Sequence[Piece], center: Array, radius: float
) -> OfPairs:
    """Return the distances of capsules from a ball fixed in world, with `center` (3,) and `radius` [m]."""
    ball = Piece("world", -1, center, center, radius, "sphere")
    return OfPairs(model, kinematics, [(piece, ball) for piece in pieces], [piece.body for piece in pieces])


class Swept(Clearance):
    """Another clearance at the positions `before` (p,) [s] earlier, extrapolated with the current velocities.

    This is the motion during a semi-implicit step, except that rotations of free bodies and ball joints stay constant.
    """

    def __init__(self, other: Clearance, before: Array):
        super().__init__(other.model, other.kinematics, other.labels * len(before))
        self.other, self.before = other, before
        self.moves = np.zeros((other.model.nx, other.model.nx))  # 1 where a position's rate is a velocity
        for joint in joints(other.model.plant):
            q, v = other.model.places(joint)
            kind = joint.type_name()
            if kind == "quaternion_floating":
                q, v = q[4:], v[3:]
            elif kind == "rpy_floating":
                q, v = q[3:], v[3:]
            for i, j in () if kind == "ball_rpy" else zip(q, v, strict=True):
                self.moves[i, other.model.nq + j] = 1.0

    def __call__(self, x: Any) -> Any:
        return np.concatenate([self.other(self._earlier(np.asarray(x), time)) for time in self.before])

    def values(self, xs: Array) -> Array:
        return np.hstack([self.other.values(self._earlier(xs, time)) for time in self.before])

    def moved(self, xs: Array) -> Array:
        return np.hstack([self.other.moved(self._earlier(xs, time)) for time in self.before])

    def linearize(self, xs: Array) -> tuple[Array, Array]:
        linearized = [self.other.linearize(self._earlier(xs, time)) for time in self.before]
        identity = np.eye(self.moves.shape[0])
        slopes = [
            rows @ (identity - time * self.moves) for (_, rows), time in zip(linearized, self.before, strict=True)
        ]
        return np.hstack([values for values, _ in linearized]), np.concatenate(slopes, axis=1)

    def _earlier(self, x: Any, time: float) -> Any:
        return x - time * (x @ self.moves.T)


def balls_of(piece: Piece) -> list[Piece]:
    """Return balls that contain a capsule and exceed it by at most a tenth of its radius; a ball is unchanged."""
    half_length = float(np.sqrt(piece.squared)) / 2
    if half_length == 0:
        return [piece]
    within = np.sqrt((1 + BALL_PART) ** 2 - 1) * piece.radius  # half the length of the tube that one ball contains
    count = int(np.ceil(half_length / within))
    radius = float(np.hypot(piece.radius, half_length / count))
    centers = [piece.start + share * (piece.end - piece.start) for share in np.linspace(0, 1, count + 1)]
    return [replace(piece, start=c, end=c, radius=radius) for c in centers]
