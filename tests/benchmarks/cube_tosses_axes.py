"""How a recorded cube's axes lie in it: turned by quarter turns about x, from one set of throws to the next.

The centre of mass of the cube of cube_tosses.py is 6 mm off the middle, and where it lies among the recorded axes
differs: along -z, y, z or -y. Throws of one set follow each other and go the same way, and have the same axes. The
motion before the first contact says which: what is left of the centre's path beside a parabola. All throws of a set
vote. Their paths also bend sideways a little, each set's alike, as no gravity does that slides feel too; so that is
fitted beside, along and across the way they go.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from drake_diff._base.arrays import Array

QUARTERS = np.array([[[1, 0, 0], [0, c, -s], [0, s, c]] for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))], dtype=float)
LEAST = 6  # samples in the air
APART = np.radians(15)  # throws whose ways differ by more are of different sets
ORDERS = 3  # polynomials beside a straight line whose part in a path is looked at
ROUNDS = 20
TAILS = 3.0  # degrees of freedom: the scatter has outliers


@dataclass(frozen=True, eq=False)
class Axes:
    """What the motions in the air say."""

    quarter: Array  # (n,) int, turns about x from the recorded axes to those with the centre along -z
    sure: Array  # (n,) the probability of that turn
    sets: int
    center: Array  # (3,) [m] of mass, by those axes
    errors: Array  # (3,) standard errors of it


def rotations(quaternions: Array) -> Array:
    """(n, 3, 3) of (n, 4) w, x, y, z."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1)[:, None]).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), -1, 0)


def turned(xs: Array, quarter: int) -> Array:
    """The same motion (n, 13) by axes of the body that are turned so often about x."""
    c, s = np.cos(quarter * np.pi / 4), np.sin(quarter * np.pi / 4)
    w, x, y, z = xs[:, :4].T
    return np.concatenate(
        [np.stack([c * w - s * x, c * x + s * w, c * y + s * z, c * z - s * y], axis=1), xs[:, 4:]], 1
    )


def axes_of(flights: dict[int, Array], count: int, rate: float, fitted: set[int]) -> Axes:
    """Of `count` tosses in the order in which they were thrown; `flights` has their motions (n, 13) in the air.

    The centre of mass, how paths bend and how they scatter are found from those of `fitted`; each of a set votes for
    its turn. A toss without a flight has none.
    """
    sets = _sets({i: xs for i, xs in sorted(flights.items()) if len(xs) >= LEAST})
    parts = {i: _parts(flights[i], along, rate) for members, along in sets for i in members}
    law = _Law(
        np.array([0, 0, -9.6]),
        np.array([0, 0, -5e-3]),
        np.tile(np.array([[80e-6], [40e-6], [35e-6]]) ** 2, 3),
        np.zeros(3),
    )
    for _ in range(ROUNDS):
        chance = law.chances([members for members, _ in sets], parts)
        law = law.fitted({i: (chance[i], parts[i]) for i in fitted & set(parts)})
    quarter, sure = np.zeros(count, dtype=int), np.full(count, 0.25)
    for i, p in chance.items():
        quarter[i], sure[i] = int(np.argmax(p)), float(np.max(p))
    return Axes(quarter, sure, len(sets), law.center, law.errors)


Part = tuple[Array, Array, Array]


@dataclass(frozen=True, eq=False)
class _Law:
    """How paths in the air differ from straight lines."""

    bend: Array  # (3,) [m/s^2] along the way of a set, to its left and up
    center: Array  # (3,) [m] of mass, by axes that are turned
    variance: Array  # (ORDERS, 3) of the scatter beside it
    errors: Array  # (3,) standard errors of the centre

    def left(self, part: Part, k: int) -> Array:
        y, t, R = part
        return np.asarray(y - np.outer(t, self.bend) + R @ QUARTERS[k] @ self.center)

    def chances(self, sets: list[list[int]], parts: dict[int, Part]) -> dict[int, Array]:
        """(4,) of each toss: the probabilities of its turns, which are those of its set."""
        found: dict[int, Array] = {}
        for members in sets:
            logs = np.zeros(4)
            for i in members:
                for k in range(4):
                    squares = self.left(parts[i], k) ** 2 / self.variance / TAILS
                    logs[k] -= (TAILS + 1) / 2 * np.sum(np.log1p(squares))
            likely = np.exp(logs - np.max(logs))
            found |= dict.fromkeys(members, likely / np.sum(likely))
        return found

    def fitted(self, tosses: dict[int, tuple[Array, Part]]) -> "_Law":
        """The law by weighted least squares over all turns, each as likely as it was."""
        H, v, squares = np.zeros((6, 6)), np.zeros(6), np.zeros((ORDERS, 3))
        for chance, part in tosses.values():
            y, t, R = part
            for k in range(4):
                A = np.concatenate([t[:, None, None] * np.eye(3), -R @ QUARTERS[k]], axis=2)
                r = self.left(part, k)
                w = chance[k] * (TAILS + 1) / (TAILS + r**2 / self.variance)
                H += np.einsum("dji,dj,djk->ik", A, w / self.variance, A)
                v += np.einsum("dji,dj,dj->i", A, w / self.variance, y)
                squares += w * r**2
        bend, center = np.split(np.linalg.solve(H, v), 2)
        return _Law(bend, center, squares / len(tosses), np.sqrt(np.diag(np.linalg.inv(H))[3:]))


def _sets(flights: dict[int, Array]) -> list[tuple[list[int], Array]]:
    """The tosses of each set of throws, and the axes along which it goes (3, 3)."""
    way = {i: xs[-1, 4:6] - xs[0, 4:6] for i, xs in flights.items()}
    angle = {i: float(np.arctan2(y, x)) for i, (x, y) in way.items()}
    sets: list[list[int]] = []
    for i in flights:
        if not sets or abs(np.angle(np.exp(1j * (angle[i] - angle[sets[-1][-1]])))) > APART:
            sets.append([])
        sets[-1].append(i)
    found = []
    for members in sets:
        mean = np.angle(np.mean(np.exp(1j * np.array([angle[i] for i in members]))))
        c, s = np.cos(mean), np.sin(mean)
        found.append((members, np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])))
    return found


def _parts(xs: Array, along: Array, rate: float) -> Part:
    """Of the path (ORDERS, 3), of t^2 / 2 (ORDERS,) and of rotations (ORDERS, 3, 3), the parts of each polynomial."""
    n, t = len(xs), np.arange(len(xs)) / rate
    Q = np.linalg.qr(legendre.legvander(np.linspace(-1, 1, n), ORDERS + 1))[0][:, 2:]
    return Q.T @ xs[:, 4:7] @ along.T, Q.T @ (t**2 / 2), np.einsum("td,tij->dij", Q, along @ rotations(xs[:, :4]))
