"""How far the shapes of a robot are from a ball, from a box and from each other, as functions of the state.

Each is a function of x (nx,) in ordinary arithmetic, for floats, AutoDiffXd and symbols, with one number a row, and for
many states at once `values`, and `linearize` with exact derivatives: the slope of a distance is that of its nearest
points, held where they are on their pieces.

From a ball and a box they are capsules that contain its shapes; from each other they are Drake's own shapes, see
`OfShapes`. The formulas of points, segments and boxes have no branch; a capsule's distance is that of its segment less
its radius. All are exact and continuous. Their slopes jump where another feature becomes the nearest one: nowhere for a
point and a segment that are apart, between parallel segments, and on the planes inside a box that part its faces.
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

TINY = 1e-24  # [m^2] keeps the slope of a length of 0 a number; it adds 1e-12 m at most
PARALLEL = 1e-12  # of the squared sine of two segments' angle: less is 0


def length(v: Any) -> Any:
    """(...) of vectors (..., 3)."""
    return np.sqrt(_dot(v, v) + TINY)


def along_segments(a: tuple[Any, Any], b: tuple[Any, Any], squared_a: Any, squared_b: Any) -> tuple[Any, Any]:
    """Where each of two segments (start, end) is nearest to the other.

    As in Ericson, "Real-Time Collision Detection", 2005, section 5.1.9.
    For parallel ones these are two of the nearest places.
    """
    u, v, r = a[1] - a[0], b[1] - b[0], a[0] - b[0]
    uv, ur, vr, product = _dot(u, v), _dot(u, r), _dot(v, r), squared_a * squared_b
    apart = product - uv * uv + np.where(product > 0, PARALLEL * product, 1.0)
    s = _between_0_and_1((uv * vr - ur * squared_b) / apart)
    t = _between_0_and_1((uv * s + vr) * _inverse(squared_b))
    return _between_0_and_1((uv * t - ur) * _inverse(squared_a)), t


def to_box(point: Any, half: Array) -> Any:
    """(...) the signed distance of points (..., 3), in the frame of a box of half sizes (3,), from its surface."""
    beyond = np.abs(point) - half
    outside = (beyond + np.abs(beyond)) / 2
    nearest = _larger(_larger(beyond[..., 0], beyond[..., 1]), beyond[..., 2])
    return length(outside) + (nearest - np.abs(nearest)) / 2


def away_from_box(point: Array, half: Array) -> Array:
    """(..., 3) the slope of `to_box`: the way in which the distance of a point grows."""
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
    """Of a squared length, 0 of a point's."""
    return np.divide(1.0, squared, out=np.zeros_like(squared), where=squared > 0)


BALL_PART = 0.1  # of a capsule's radius: how far the balls that it becomes beside a box stick out of it


@dataclass(frozen=True, eq=False)
class Pieces:
    """Pieces of a robot, in rows."""

    at: Indices  # (m,) the link of each
    start: Array  # (m, 3) [m] in its frame
    end: Array  # (m, 3)
    radius: Array  # (m,) [m]
    squared: Array  # (m,) [m^2] the squared lengths

    def ends(self, frames: tuple[Any, Any]) -> tuple[Any, Any]:
        """(..., m, 3) where the segments start and end in the world."""
        R, p = frames[0][..., self.at, :, :], frames[1][..., self.at, :]
        return (R @ self.start[..., None])[..., 0] + p, (R @ self.end[..., None])[..., 0] + p

    def ways(self, frames: tuple[Array, Array]) -> Array:
        """(K-1, m) [m] the longest of the straight ways of each piece's points, from frame to frame (K, ...)."""
        far = [np.linalg.norm(np.diff(end, axis=0), axis=-1) for end in self.ends(frames)]
        return np.asarray(np.maximum(*far))


def in_rows(pieces: Sequence[Piece]) -> Pieces:
    """The same, in rows."""
    return Pieces(
        np.array([p.link for p in pieces], dtype=np.intp),
        np.array([p.start for p in pieces]).reshape(-1, 3),
        np.array([p.end for p in pieces]).reshape(-1, 3),
        np.array([p.radius for p in pieces]),
        np.array([p.squared for p in pieces]),
    )


class Clearance:
    """Signed distances [m] of a robot's pieces: `labels` (m,) tell what each row is of, `sides` its one or two."""

    def __init__(self, model: Model, kinematics: ForwardKinematics, labels: Sequence[str], *sides: Pieces):
        self.model, self.kinematics, self.labels, self.sides = model, kinematics, tuple(labels), sides

    def __call__(self, x: Any) -> Any:
        """(m,) [m] at x (nx,)."""
        self.refuse_parameters()
        return self._distances(self.kinematics(np.asarray(x)[: self.model.nq]))

    def refuse_parameters(self) -> None:
        """InputError where a parameter that distances depend on is changed."""
        for quantity in sorted(self.model.other_quantities & PLACE):
            raise InputError("parameters", got=quantity, expected="parameters that do not change distances")

    def values(self, xs: Array) -> Array:
        """(K, m) [m] at xs (K, nx)."""
        return np.asarray(self._distances(self.kinematics(xs[:, : self.model.nq])), dtype=float)

    def linearize(self, xs: Array) -> tuple[Array, Array]:
        """(K, m) [m], and their derivatives by the state (K, m, nx), at xs (K, nx)."""
        q = xs[:, : self.model.nq]
        frames = self.kinematics(q)
        slopes = np.zeros((len(xs), len(self.labels), self.model.nx))
        for side, (points, ways) in zip(self.sides, self._ways(frames), strict=True):
            slopes += self.kinematics.pushes(q, frames, side.at, points, ways)
        return np.asarray(self._distances(frames)), slopes

    def moved(self, xs: Array) -> Array:
        """(K-1, m) [m] how far what each row is of moves from one of xs (K, nx) to the next: no distance changes more.

        That is the longest of the straight ways of its points.
        """
        frames = self.kinematics(xs[:, : self.model.nq])
        return np.asarray(sum(side.ways(frames) for side in self.sides))

    def _distances(self, frames: tuple[Any, Any]) -> Any:
        raise NotImplementedError

    def _ways(self, frames: tuple[Array, Array]) -> Sequence[tuple[Array, Array]]:
        """Of each side its nearest points (K, m, 3), and the ways in which the distances grow as these move."""
        raise NotImplementedError


class FromBox(Clearance):
    """Of balls from a box, at `center` (3,), turned by `rotation` (3, 3), of `half` its edges (3,) [m].

    Capsules become balls, see `balls_of`.
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
        """(..., m, 3) the balls' centres in the world and in the box's frame."""
        points, _ = self.sides[0].ends(frames)
        return points, (points - self.center) @ self.rotation

    def _distances(self, frames: tuple[Any, Any]) -> Any:
        return to_box(self._within(frames)[1], self.half) - self.sides[0].radius

    def _ways(self, frames: tuple[Array, Array]) -> Sequence[tuple[Array, Array]]:
        points, local = self._within(frames)
        return [(points, away_from_box(local, self.half) @ self.rotation.T)]


class OfPairs(Clearance):
    """Of two capsules from each other, a row for each pair."""

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
    """Of two shapes from each other, a row for each pair: Drake's signed distance, below 0 by the depth of an overlap.

    The capsules around two shapes are never further apart than these. Where the capsules are further apart than `far`
    their distance stands for that of the shapes, which takes a hundredth of the time; between `near` and `far` it goes
    over into it. So no row is above the distance of its shapes, and those below `near` are that distance. Of meshes
    Drake takes the convex hull. Of two balls or capsules ours is exact. Shapes that are only drawn are their capsules.
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
            corners = np.array([pair[i].corners for pair in self.pairs])  # (m, 8, 3), which contain it
            R, p = frames[0][:, side.at], frames[1][:, side.at]
            far += np.max(
                np.linalg.norm(np.diff(corners @ R.swapaxes(-1, -2) + p[:, :, None], axis=0), axis=-1), axis=-1
            )
        return far

    def _blended(self, xs: Array, least: Array, points: Array | None = None, way: Array | None = None) -> "_Blended":
        """The rows (K, m) at xs (K, nx), of capsules with the distances `least` (K, m), and what slopes are made of.

        Fills, where they are given, the shapes' nearest `points` (2, K, m, 3) in the world, and the `way` (K, m, 3) in
        which the distance grows as the first of them moves.
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
                if not np.all(np.isfinite(way[k, i])):  # of shapes that just touch
                    way[k, i] = in_a.translation() - in_b.translation()
                    way[k, i] /= length(way[k, i])
        return _Blended(
            least + weight * (distances - least), 1 - weight + slope * (distances - least), by_shapes=weight
        )


class _Blended(NamedTuple):
    """Distances (K, m), and their derivatives by those of capsules and of shapes."""

    values: Array
    by_capsules: Array
    by_shapes: Array


def from_ball(
    model: Model, kinematics: ForwardKinematics, pieces: Sequence[Piece], center: Array, radius: float
) -> OfPairs:
    """The distances of capsules from a ball at `center` (3,) of a `radius` [m], which the world carries."""
    ball = Piece("world", -1, center, center, radius, "sphere")
    return OfPairs(model, kinematics, [(piece, ball) for piece in pieces], [piece.body for piece in pieces])


class Swept(Clearance):
    """Another clearance, where the positions were `before` (p,) [s], at the velocities that they have now.

    That is the way of a semi-implicit step, but for the turning of a free body or a ball, which is left as it is.
    """

    def __init__(self, other: Clearance, before: Array):
        super().__init__(other.model, other.kinematics, other.labels * len(before))
        self.other, self.before = other, before
        self.moves = np.zeros((other.model.nx, other.model.nx))  # the rates of the positions that are velocities
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
    """Balls that contain a capsule and stick out of it by a tenth of its radius; a ball is itself."""
    half_length = float(np.sqrt(piece.squared)) / 2
    if half_length == 0:
        return [piece]
    within = np.sqrt((1 + BALL_PART) ** 2 - 1) * piece.radius  # on both sides, a ball contains that much of the tube
    count = int(np.ceil(half_length / within))
    radius = float(np.hypot(piece.radius, half_length / count))
    centers = [piece.start + share * (piece.end - piece.start) for share in np.linspace(0, 1, count + 1)]
    return [replace(piece, start=c, end=c, radius=radius) for c in centers]
