"""The orientation of a recorded cube's axes, which is rotated by quarter turns about x between sets of throws.

The centre of mass of the cube in cube_tosses.py is 6 mm off the middle. In the recorded axes its direction differs: -z,
y, z or -y. The throws of one set are consecutive and have the same direction and the same axes. The axes are estimated
from the motion before the first contact, as the deviation of the centre's path from a parabola. All throws of a set
vote. The paths of a set also bend sideways a little, all alike. Gravity is not the reason, as slides would show it too.
The bend along and across the direction of the throws is therefore fitted as well.
"""

from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from drake_diff._base.arrays import Array

QUARTERS = np.array([[[1, 0, 0], [0, c, -s], [0, s, c]] for c, s in ((1, 0), (0, 1), (-1, 0), (0, -1))], dtype=float)
LEAST = 6  # minimum number of samples in the air
APART = np.radians(15)  # throws whose directions differ by more belong to different sets
ORDERS = 3  # number of polynomials, besides a straight line, onto which a path is projected
ROUNDS = 20
TAILS = 3.0  # degrees of freedom of a t-distribution, because the scatter has outliers


@dataclass(frozen=True, eq=False)
class Axes:
    """The axes that are estimated from the motions in the air."""

    quarter: Array  # (n,) int, quarter turns about x from the recorded axes to axes with the centre of mass along -z
    sure: Array  # (n,) the probability of that turn
    sets: int
    center: Array  # (3,) [m] centre of mass in these axes
    errors: Array  # (3,) standard errors of the centre of mass


def rotations(quaternions: Array) -> Array:
    """Return the rotation matrices (n, 3, 3) of quaternions (n, 4) w, x, y, z."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1)[:, None]).T
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.moveaxis(np.array(rows), -1, 0)


def turned(xs: Array, quarter: int) -> Array:
    """Return the same motion (n, 13) with body axes that are rotated by `quarter` quarter turns about x."""
    c, s = np.cos(quarter * np.pi / 4), np.sin(quarter * np.pi / 4)
    w, x, y, z = xs[:, :4].T
    return np.concatenate(
        [np.stack([c * w - s * x, c * x + s * w, c * y + s * z, c * z - s * y], axis=1), xs[:, 4:]], 1
    )


def axes_of(flights: dict[int, Array], count: int, rate: float, fitted: set[int]) -> Axes:
    """Estimate the axes of `count` tosses in the order of the throws; `flights` has their motions (n, 13) in the air.

    The centre of mass, the bend of the paths and their scatter are estimated from the tosses in `fitted`. Each toss of
    a set votes for the turn of the set. A toss without a flight has no vote.
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
    """The deviation of paths in the air from straight lines."""

    bend: Array  # (3,) [m/s^2] along the direction of a set, to its left and up
    center: Array  # (3,) [m] centre of mass in the rotated axes
    variance: Array  # (ORDERS, 3) of the remaining scatter
    errors: Array  # (3,) standard errors of the centre of mass

    def left(self, part: Part, k: int) -> Array:
        y, t, R = part
        return np.asarray(y - np.outer(t, self.bend) + R @ QUARTERS[k] @ self.center)

    def chances(self, sets: list[list[int]], parts: dict[int, Part]) -> dict[int, Array]:
        """Return the probabilities (4,) of the turns of each toss, which are those of its set."""
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
        """Fit the law by weighted least squares over all turns, weighted with their previous probabilities."""
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
    """Return the tosses of each set of throws, and axes (3, 3) whose first is the direction of the set."""
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
    """Project the path (ORDERS, 3), t^2 / 2 (ORDERS,) and the rotations (ORDERS, 3, 3) onto the polynomials."""
    n, t = len(xs), np.arange(len(xs)) / rate
    Q = np.linalg.qr(legendre.legvander(np.linspace(-1, 1, n), ORDERS + 1))[0][:, 2:]
    return Q.T @ xs[:, 4:7] @ along.T, Q.T @ (t**2 / 2), np.einsum("td,tij->dij", Q, along @ rotations(xs[:, :4]))
