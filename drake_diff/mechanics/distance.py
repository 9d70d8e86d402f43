"""Signed distances of points, segments and boxes in ordinary arithmetic, without a branch.

The same formulas serve floats, many at once, AutoDiffXd and symbols: a capsule's distance is that of its segment less
its radius. All are exact and continuous. Their slopes jump where another feature becomes the nearest one: nowhere for a
point and a segment that are apart, between parallel segments, and on the planes inside a box that part its faces.
"""

from typing import Any

import numpy as np

from drake_diff._base.arrays import Array

TINY = 1e-24  # [m^2] keeps the slope of a length of 0 a number; it adds 1e-12 m at most
PARALLEL = 1e-12  # of the squared sine of two segments' angle: less is 0


def length(v: Any) -> Any:
    """(...) of vectors (..., 3)."""
    return np.sqrt(_dot(v, v) + TINY)


def along_segment(start: Any, end: Any, point: Any, squared: Any) -> Any:
    """(...) where the segment is nearest to the point: 0 at its start, 1 at its end; its length `squared` is known."""
    return _between_0_and_1(_dot(point - start, end - start) * _inverse(squared))


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
