"""Laws of rigid impact: which impulses a set of contacts gives, by Newton's or Poisson's restitution and Coulomb.

An impact takes no time, moves nothing, and changes the velocities by M (v+ - v-) = J' P. With the contacts' velocities
w = J v and their parts along the normals w_n,

    Newton:    0 <= P_n          complementary to   w_n+ + e w_n- >= 0     (0 in place of e w_n- where w_n- >= 0)
    Poisson:   first the inelastic impact, e = 0, whose impulse is P_c, then another with
               0 <= P_n - e P_c  complementary to   w_n+ >= 0
    Coulomb:   |P_t| <= mu P_n, and where the contact slides on, P_t = -mu P_n w_t+ / |w_t+|

of each, and of each of Poisson's two parts (Glocker and Pfeiffer, "Multiple impacts with friction in rigid multibody
systems", 1995). All ways in which contacts may open, stick and slide are tried; where two of them lead to different
velocities the law has no unique answer.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np

from drake_diff._base.arrays import Array, cross
from drake_diff.exceptions import SimulationError

OPENS, STICKS, SLIDES, FRICTIONLESS = "opens", "sticks", "slides", "frictionless"
MOST_FRICTIONAL, MOST = 5, 8  # contacts at once: 3 and 2 ways of each
SAME = 1e-8  # of the largest velocity: the same motion
EDGE = 1e-7  # of the largest velocity: the edge between two ways
ROUNDED = 1e-10  # of the largest velocity: as good as 0
SINGULAR = 1e-11  # of the largest singular value
ROUNDS = 200  # of the direction of a slide
STARTS, AROUND = 8, 36  # directions from which several slides are sought, and one is
Ways = tuple[tuple[bool, str], ...]  # of each contact: whether it is closed, and OPENS, STICKS, SLIDES or FRICTIONLESS


@dataclass(frozen=True, eq=False)
class Impulses:
    """What m contacts give: P (m, 3) [N s] in world, the velocities (m, 3) after, and what each does."""

    values: Array
    after: Array
    ways: Ways
    edges: tuple[int, ...]  # contacts that do so only just: a change of the motion may lead to another way


@dataclass(frozen=True, eq=False)
class Asked:
    """What a part of a law asks of m contacts: velocities along the normals, and impulses, are at least these."""

    W: Array  # (3 m, 3 m) J M^-1 J'
    before: Array  # (m, 3) velocities
    normals: Array  # (m, 3)
    speeds: Array  # (m,) along the normals
    least: Array  # (m,) impulses
    friction: Array  # (m,)

    def __len__(self) -> int:
        return len(self.normals)


def solve(asked: Asked, name: str) -> Impulses:
    """The impulses; SimulationError where there are none, or where they lead to different motions."""
    count = len(asked)
    most = MOST_FRICTIONAL if np.any((asked.friction > 0) & np.isfinite(asked.friction)) else MOST
    if count > most:
        raise SimulationError(f"{count} contacts strike at once at {name}: expected at most {most}")
    size = max(float(np.max(np.abs(asked.before))), float(np.max(np.abs(asked.speeds))), 1e-300)
    found: list[Impulses] = []
    for ways in product(*[_ways(asked, i) for i in range(count)]):
        for values, after in _of_ways(asked, ways, size):
            found.append(Impulses(values, after, ways, _edges(asked, ways, values, after, size)))
    if not found:
        raise SimulationError(f"no impulses of restitution and friction satisfy the impact of {name}")
    apart = [float(np.max(np.abs(each.after - found[0].after))) for each in found]
    if max(apart) > SAME * size:
        ends = sorted({", ".join(way for _, way in each.ways) for each in found})
        raise SimulationError(
            f"the impact of {name} has no unique answer: its contacts may end as {' or '.join(ends)}, with "
            f"velocities up to {max(apart):.3g} m/s apart"
        )
    return min(found, key=_rank)


def _edges(asked: Asked, ways: Ways, values: Array, after: Array, size: float) -> tuple[int, ...]:
    """The contacts whose impulse or velocity is at the end of what their way allows."""
    found, little = [], EDGE * size
    impulse = little / _scale(asked)
    for i, (closed, way) in enumerate(ways):
        n, mu = asked.normals[i], asked.friction[i]
        push, speed = float(n @ values[i]), float(n @ after[i])
        slack = push - asked.least[i] if closed else (speed - asked.speeds[i]) / _scale(asked)
        if way == STICKS and np.isfinite(mu):
            slack = min(slack, mu * push - float(np.linalg.norm(values[i] - push * n)))
        if way == SLIDES:
            slack = min(slack, float(np.linalg.norm(after[i] - speed * n)) / _scale(asked))
        if slack <= impulse:
            found.append(i)
    return tuple(found)


def _rank(found: Impulses) -> tuple[int, int]:
    """Closed before open, sticking before sliding, where both are the same motion."""
    return sum(not closed for closed, _ in found.ways), sum(way == SLIDES for _, way in found.ways)


def _ways(asked: Asked, i: int) -> list[tuple[bool, str]]:
    """What contact i may do: (closed, how its tangents behave)."""
    mu = asked.friction[i]
    along = [FRICTIONLESS] if mu == 0 else [STICKS] if np.isinf(mu) else [STICKS, SLIDES]
    if asked.least[i] > 0:  # of Poisson's second part: it pushes at least so much
        return [(closed, way) for closed in (True, False) for way in along]
    return [*((True, way) for way in along), (False, OPENS)]


def _of_ways(asked: Asked, ways: Ways, size: float) -> Iterator[tuple[Array, Array]]:
    """The impulses (m, 3) and velocities (m, 3) in which every contact does what `ways` says."""
    sliding = [i for i, (_, way) in enumerate(ways) if way == SLIDES]
    for directions in _directions(asked, ways, sliding, size):
        found = _linear(asked, ways, directions)
        if found is None:
            continue
        values, spare = found
        after = _after(asked, values)
        if _keeps(asked, ways, values, after, size):
            yield values, after
        elif len(spare) and _fits(asked, ways, after, size):
            other = _within(asked, ways, values, spare, size)
            if other is not None:
                yield other, after


def _after(asked: Asked, values: Array) -> Array:
    return asked.before + (asked.W @ values.ravel()).reshape(-1, 3)


def _directions(asked: Asked, ways: Ways, sliding: list[int], size: float) -> Iterator[Array]:
    """Directions (m, 3) of slides that are those of the velocities to which their friction leads."""
    base = np.zeros((len(asked), 3))
    if not sliding:
        yield base
    elif len(sliding) == 1:
        yield from _all_round(asked, ways, sliding[0], size)
    else:
        for turn in range(STARTS):
            directions = base.copy()
            for i in sliding:
                one, other = _plane(asked, i)
                angle = 2 * np.pi * turn / STARTS
                directions[i] = np.cos(angle) * one + np.sin(angle) * other
            found = _settled(asked, ways, directions, sliding, size)
            if found is not None:
                yield found


def _plane(asked: Asked, i: int) -> tuple[Array, Array]:
    """Two directions (3,) along the plane of contact i, the first that of its velocity before."""
    n = asked.normals[i]
    t = asked.before[i] - n * (n @ asked.before[i])
    if np.linalg.norm(t) <= ROUNDED:
        t = np.eye(3)[int(np.argmin(np.abs(n)))]
        t = t - n * (n @ t)
    t = t / np.linalg.norm(t)
    return t, cross(n, t)


def _all_round(asked: Asked, ways: Ways, i: int, size: float) -> Iterator[Array]:
    """Every direction of the one contact that slides, by looking all round."""
    directions, (one, other) = np.zeros((len(asked), 3)), _plane(asked, i)

    def slide(angle: float) -> tuple[float, float]:
        """The velocity's part across the direction, and along it."""
        c, s = np.cos(angle), np.sin(angle)
        directions[i] = c * one + s * other
        found = _linear(asked, ways, directions)
        if found is None:
            return np.nan, np.nan
        after = _after(asked, found[0])[i]
        return float((c * other - s * one) @ after), float(directions[i] @ after)

    angles = np.linspace(-np.pi / AROUND, 2 * np.pi - np.pi / AROUND, AROUND + 1)
    seen, still = [slide(angle) for angle in angles], ROUNDED * size
    for k in range(AROUND):
        (f_low, along), (f_high, also) = seen[k], seen[k + 1]
        if not f_low * f_high <= 0 or max(along, also) <= 0:
            continue
        value, along = slide(_zero(lambda angle: slide(angle)[0], angles[k], angles[k + 1], f_low, f_high))
        if abs(value) <= 1e-9 * max(along, 0.0) and along > still:  # it may be beyond all bounds in between
            yield directions.copy()


def _zero(function: Callable[[float], float], low: float, high: float, f_low: float, f_high: float) -> float:
    """Where a function is 0 between two places of different sign, to rounding: the Illinois rule, and halves."""
    side, best = 0, (low, f_low)
    for _ in range(ROUNDS):
        if high - low <= 1e-15 * max(abs(low), abs(high)):
            break
        middle = high - f_high * (high - low) / (f_high - f_low) if f_high != f_low else (low + high) / 2
        if not low < middle < high:
            middle = (low + high) / 2
        value = function(middle)
        best = (middle, value)
        if value == 0:
            break
        if value * f_low > 0:
            f_high = f_high / 2 if side > 0 else f_high
            low, f_low, side = middle, value, 1
        else:
            f_low = f_low / 2 if side < 0 else f_low
            high, f_high, side = middle, value, -1
    return best[0]


def _settled(asked: Asked, ways: Ways, directions: Array, sliding: list[int], size: float) -> Array | None:
    """The directions (m, 3) in which several slides settle, each to that of the velocity; None if they never do."""
    change = np.inf
    for _ in range(ROUNDS):
        found = _linear(asked, ways, directions)
        if found is None:
            return None
        after, new = _after(asked, found[0]), directions.copy()
        for i in sliding:
            n = asked.normals[i]
            t = after[i] - n * (n @ after[i])
            speed = float(np.linalg.norm(t))
            if speed <= ROUNDED * size:
                return None
            new[i] = t / speed
        before, change = change, float(np.max(np.abs(new - directions)))
        if change <= 1e-14 or (change <= 1e-11 and change >= before):
            return new
        directions = new
    return directions if change <= 1e-9 else None


def _linear(asked: Asked, ways: Ways, directions: Array) -> tuple[Array, Array] | None:
    """The impulses (m, 3) for given directions of slides, and those (k, 3 m) that change no equation; None if none."""
    m = len(asked)
    scale = float(np.trace(asked.W)) / max(3 * m, 1)
    W = asked.W / scale
    A, b = np.zeros((3 * m, 3 * m)), np.zeros(3 * m)
    for i, (closed, way) in enumerate(ways):
        rows, n = slice(3 * i, 3 * i + 3), asked.normals[i]
        onto, own = np.outer(n, n), np.zeros((3, 3 * m))
        own[:, rows] = np.eye(3)
        along = np.eye(3) - onto
        if closed:
            A[rows] += onto @ W[rows]
            b[rows] += n * (asked.speeds[i] - n @ asked.before[i])
        else:
            A[rows] += onto @ own
            b[rows] += n * asked.least[i] * scale
        if way == STICKS:
            A[rows] += along @ W[rows]
            b[rows] -= along @ asked.before[i]
        else:
            A[rows] += along @ own
            if way == SLIDES:
                A[rows] += asked.friction[i] * np.outer(directions[i], n) @ own
    U, s, Vt = np.linalg.svd(A)
    rank = int(np.count_nonzero(s > SINGULAR * s[0]))
    values = Vt[:rank].T @ ((U[:, :rank].T @ b) / s[:rank])
    if np.max(np.abs(A @ values - b), initial=0.0) > 1e-9 * max(float(np.max(np.abs(b))), 1e-300):
        return None
    return (values / scale).reshape(m, 3), Vt[rank:]


def _keeps(asked: Asked, ways: Ways, values: Array, after: Array, size: float) -> bool:
    """Whether the impulses and velocities are within what the law allows."""
    return _fits(asked, ways, after, size) and _excess(asked, ways, values) <= ROUNDED * size / _scale(asked)


def _scale(asked: Asked) -> float:
    return float(np.trace(asked.W)) / max(3 * len(asked), 1)


def _fits(asked: Asked, ways: Ways, after: Array, size: float) -> bool:
    """Whether contacts that open do, and slides slide."""
    along = np.einsum("ij,ij->i", asked.normals, after)
    opened = [i for i, (closed, _) in enumerate(ways) if not closed]
    return all(along[i] >= asked.speeds[i] - ROUNDED * size for i in opened)


def _excess(asked: Asked, ways: Ways, values: Array) -> float:
    """By how much [N s] impulses are beyond what the law allows, at most."""
    worst = 0.0
    for i, (closed, way) in enumerate(ways):
        n = asked.normals[i]
        push = float(n @ values[i])
        if closed:
            worst = max(worst, asked.least[i] - push)
        if way == STICKS and np.isfinite(asked.friction[i]):
            worst = max(worst, float(np.linalg.norm(values[i] - push * n)) - asked.friction[i] * push)
    return worst


def _within(asked: Asked, ways: Ways, values: Array, spare: Array, size: float) -> Array | None:
    """Impulses (m, 3) that the law allows and that add to the same motion, if there are any: a convex search."""
    size_of_impulse, z = max(float(np.max(np.abs(values))), 1e-300), np.zeros(len(spare))
    allowed = max(ROUNDED * size / _scale(asked), 1e-9 * size_of_impulse)
    parts = spare.reshape(len(spare), -1, 3)
    for _ in range(ROUNDS):
        p = values + np.einsum("k,kij->ij", z, parts)
        if _excess(asked, ways, p) <= allowed:
            return p
        left, slopes = _beyond(asked, ways, p, parts, 1e-2 * allowed)
        z = z - np.linalg.lstsq(slopes, left, rcond=1e-10)[0]
    return None


def _beyond(asked: Asked, ways: Ways, p: Array, parts: Array, margin: float) -> tuple[Array, Array]:
    """By how much the impulses p (m, 3) are beyond each bound, and the slopes by the multiples of `parts` (k, m, 3)."""
    left, slopes = [], []
    for i, (closed, way) in enumerate(ways):
        n, own = asked.normals[i], parts[:, i]
        push = float(n @ p[i])
        if closed and asked.least[i] - push > 0:
            left.append(asked.least[i] - push + margin)
            slopes.append(-own @ n)
        if way == STICKS and np.isfinite(asked.friction[i]):
            t = p[i] - push * n
            along = float(np.linalg.norm(t))
            if along - asked.friction[i] * push > 0:
                left.append(along - asked.friction[i] * push + margin)
                slopes.append(own @ (t / max(along, 1e-300) - asked.friction[i] * n))
    return np.array(left), np.array(slopes).reshape(len(left), len(parts))
