"""Postures of a robot: where its coordinates may be, which shapes overlap, what its motors hold, where it starts."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.model.contact import overlaps
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.step import set_state

INSIDE = 0.05  # of a joint's range: a start is at least that far from both its limits
TURN, SHIFT = 1.0, 0.2  # [rad], [m] the range on each side of 0 of a joint without limits
WIDEST = 4 * np.pi  # a wider range is as good as none
TOUCHING = 1e-4  # [m] of overlap: less is none
HELD = 0.63  # of the effort limits: what a start may need to be held
SEEN = 16  # postures in which a pair of shapes overlaps before it is said to do so always
ROOM, BESIDE = 0.1, 6  # [rad or m] that all joints can move at once from a start, in so many ways at random
ATTEMPTS, FINER = 60, 1000  # at a start: drawn ever farther from the file's, and near the best so far
DEPTH = 0.01  # [m] of overlap that weighs as much as all that the motors have
Pair = tuple[str, str]


@dataclass(frozen=True, eq=False)
class Start:
    """A posture q (nq,), the sum of its overlaps [m] and what it takes of the effort limits.

    `always` are the pairs of shapes that overlap in every posture that was seen, which are not looked at.
    """

    q: Array
    overlap: float
    load: float
    always: frozenset[Pair]


def start(
    shapes: Model | None, driven: Model | None, first: Array, lower: Array, upper: Array, random: np.random.Generator
) -> Start:
    """The posture `first` (nq,), or one that is better: where nothing overlaps, and which the motors of `driven` hold.

    It has room beside it where one of ATTEMPTS has, since searches go on from it in all directions.
    `lower` and `upper` (nq,) are the ranges of all coordinates; those of a free body's pose are left alone.
    """
    model = shapes or driven
    if model is None:
        return Start(first, 0.0, 0.0, frozenset())
    is_joint, margin = of_joints(model), INSIDE * (upper - lower)

    def drawn(middle: Array, width: Array, moved: NDArray[np.bool_]) -> Array:
        q = np.clip(middle + width * random.uniform(-1, 1, len(first)), lower + margin, upper - margin)
        return np.where(is_joint & moved, q, middle)

    every, whole = np.ones(len(first), dtype=bool), upper - lower
    always = pairs_always([first, *(drawn(first, whole, every) for _ in range(SEEN - 1))], shapes)

    def measured(q: Array) -> Start:
        load = 0.0 if driven is None else share_to_hold(driven, q)
        depths = {} if shapes is None else _overlaps(shapes, q)
        overlap = sum(depth for pair, depth in depths.items() if pair not in always and depth > TOUCHING)
        return Start(q, overlap, load, always)

    def has_room(q: Array) -> bool:
        beside = [q + np.where(is_joint, random.choice([-ROOM, ROOM], len(q)), 0.0) for _ in range(BESIDE)]
        return shapes is None or all(deepest(shapes, other, always) <= TOUCHING for other in beside)

    best, tight = measured(first), None
    for i in range(ATTEMPTS + FINER):
        if i == ATTEMPTS and tight is not None:
            return tight
        if _badness(best) == 0:
            if has_room(best.q):
                break
            tight, best = tight or best, replace(best, overlap=np.inf)  # unless all others are worse
        if i < ATTEMPTS:
            fraction = (i + 1) / ATTEMPTS
            q = np.where(is_joint, first + fraction * (random.uniform(lower + margin, upper - margin) - first), first)
        else:
            few = random.random(len(first)) < max(0.1, 3 / len(first))
            q = drawn(best.q, whole * 0.5 ** random.uniform(0, 6), few)
        candidate = measured(q)
        best = candidate if _badness(candidate) < _badness(best) else best
    return best


def _badness(candidate: Start) -> float:
    return candidate.overlap / DEPTH + max(0.0, candidate.load - HELD)


def pairs_always(tried: list[Array], shapes: Model | None) -> frozenset[Pair]:
    """The pairs of shapes that overlap in each of the postures (nq,)."""
    if shapes is None:
        return frozenset()
    overlaps = [{pair for pair, depth in _overlaps(shapes, q).items() if depth > TOUCHING} for q in tried]
    return frozenset(set.intersection(*overlaps))


def deepest(shapes: Model, q: Array, besides: frozenset[Pair]) -> float:
    """[m] the deepest overlap in posture q (nq,), that of the pairs `besides` apart."""
    return max((depth for pair, depth in _overlaps(shapes, q).items() if pair not in besides), default=0.0)


def _overlaps(shapes: Model, q: Array) -> dict[Pair, float]:
    set_state(shapes.double, np.concatenate([q, np.zeros(shapes.nv)]))
    return overlaps(shapes)


def share_to_hold(model: Model, q: Array) -> float:
    """The share of its effort limits that a fully driven robot needs to hold posture q (nq,)."""
    return float(np.max(shares_to_hold(model, q), initial=0.0))


def shares_to_hold(model: Model, q: Array) -> Array:
    """(nu,) the same of each input."""
    set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
    needed = model.double.inverse_dynamics(np.zeros(model.nv))
    return shares(model, np.linalg.lstsq(model.actuation, needed, rcond=None)[0])


def shares(model: Model, us: Array) -> Array:
    """(..., nu) of the effort limits, in inputs us (..., nu); 0 where there is none."""
    limits = effort_limits(model)
    return np.asarray(np.abs(us) / np.where((limits > 0) & np.isfinite(limits), limits, np.inf))


def effort_limits(model: Model) -> Array:
    """(nu,) the smaller of the two limits of each input, infinite where there is none."""
    return np.array([min(abs(u.lower), abs(u.upper)) for u in model.contract.inputs])


def ranges(model: Model) -> tuple[Array, Array]:
    """(lower, upper) (nq,): the limits of each coordinate, or a range around 0 where it has none, or a wide one."""
    lower = np.array([p.lower for p in model.contract.positions], dtype=float)
    upper = np.array([p.upper for p in model.contract.positions], dtype=float)
    reach = np.array([SHIFT if p.unit == "m" else TURN for p in model.contract.positions])
    wide = upper - lower > WIDEST  # so is what has no limits
    low = np.where(wide, np.maximum(lower, -reach), lower)
    high = np.where(wide, np.minimum(upper, reach), upper)
    beyond = low > high  # one limit alone, on the other side of 0
    low = np.where(beyond & np.isfinite(upper), upper - 2 * reach, low)
    high = np.where(beyond & np.isfinite(lower), lower + 2 * reach, high)
    return low, high


def of_joints(model: Model) -> NDArray[np.bool_]:
    """(nq,) whether a coordinate is that of a joint, and no part of a free body's pose."""
    if model.nq == model.nv:
        return np.ones(model.nq, dtype=bool)
    mask = np.zeros(model.nq, dtype=bool)
    for joint in joints(model.plant):
        if joint.num_positions() == 1:
            mask[list(model.places(joint)[0])] = True
    return mask


def inside(model: Model, lower: Array, upper: Array) -> Array:
    """The file's posture; in the middle of a joint's limits where that is outside, and inside where it is at one."""
    q = model.default_state[: model.nq].copy()
    margin = INSIDE * (upper - lower)
    outside = (q < lower) | (q > upper)
    moved = np.where(outside, (lower + upper) / 2, np.clip(q, lower + margin, upper - margin))
    return np.where(of_joints(model), moved, q)
