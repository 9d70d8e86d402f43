"""How contacts of a tree move: their Jacobians, and how these, the velocities there and the effective mass change.

S_j = [l_j; a_j] is the motion of degree of freedom j in world about its origin, L_j = l_j + a_j x p its velocity at the
contact p, and s_j = 1, -1 or 0 where it moves the sphere's side alone, the other side alone, or both or none. Then

    J_c = (s_j L_j)_j,   dS_k / dq_j = S_j x S_k where j moves the axis of k, else 0,

dq being the small motion that a velocity makes. Drake weighs friction by w = |W| / 3 with W = J_c diag(A)^-1 J_c',
A the mass matrix with what joint damping adds in a step.
"""

from dataclasses import dataclass, field

import numpy as np

from drake_diff._base.arrays import Array, cross
from drake_diff.derivatives.contact.pairs import Touches
from drake_diff.mechanics.description import Description


@dataclass(frozen=True, eq=False)
class Topology:
    """Which degrees of freedom of a tree move which; 1 where they do, else 0."""

    moves: Array  # (nv, nv) j the axis of k
    before: Array  # (nv, nv) j is moved by k, or k is of the same joint
    turns: Array  # (nv,) 0 for the translations of free bodies
    bodies: dict[str, Array]  # (nv,) of each body, which move it


def topology_of(description: Description) -> Topology:
    """The topology of a tree of hinges, slides and free bodies; these turn about axes that only translations move."""
    nv = description.coordinates.nv
    moves, before, turns = np.zeros((nv, nv)), np.zeros((nv, nv)), np.ones(nv)
    bodies = {"world": np.zeros(nv)}
    for link in description.links:
        own = link.v_start + np.arange({"weld": 0, "quaternion_floating": 6}.get(link.kind, 1))
        above = np.flatnonzero(bodies[link.parent])
        moves[np.ix_(above, own)] = before[np.ix_(own, above)] = before[np.ix_(own, own)] = 1.0
        if len(own) > 1:
            moves[np.ix_(own[3:], own[:3])] = 1.0
            turns[own[3:]] = 0.0
        bodies[link.body] = np.array(bodies[link.parent])
        bodies[link.body][own] = 1.0
    return Topology(moves, before, turns, bodies)


def mass_matrix(S: Array, inertia: Array, topology: Topology) -> Array:
    """(N, nv, nv) M_jk = S_k' I_j S_j where k moves j, 0 where neither moves the other; I_j is what j carries."""
    lower = np.swapaxes(inertia @ S[..., None], -1, -2)[..., 0, :] @ S.swapaxes(-1, -2)
    above = topology.before.T * (1 - topology.before)
    return np.asarray(topology.before * lower + above * lower.swapaxes(-1, -2))


def diagonal_slope(S: Array, inertia: Array, topology: Topology) -> Array:
    """(N, nv, nv) d M_kk / d q_j, of motions (N, nv, 6) and the inertia (N, nv, 6, 6) that each j carries.

    Turning what j carries changes its kinetic energy as turning back the motion k before it does.
    """
    linear, angular = S[..., :3], S[..., 3:]
    l_j, a_j, l_k, a_k = linear[:, None], angular[:, None], linear[:, :, None], angular[:, :, None]
    turned = np.concatenate([cross(a_j, l_k) + cross(l_j, a_k), cross(a_j, a_k)], axis=-1)  # (N, k, j, 6)
    momentum = (inertia[:, None] @ S[:, :, None, :, None])[..., 0]
    return np.asarray(-2 * (topology.before.T * topology.turns) * (momentum * turned).sum(axis=-1))


@dataclass(frozen=True, eq=False)
class Weight:
    """w (M,) of M contacts, and dw / dW (M, 3, 3)."""

    value: Array
    part: Array


def weigh(J: Array, diagonal: Array) -> Weight:
    """Of Jacobians' transposes J (M, nv, 3) and the diagonal (M, nv) of A."""
    W = J.swapaxes(-1, -2) @ (J / diagonal[..., None])
    size = np.sqrt((W * W).sum(axis=(1, 2)))
    return Weight(size / 3, W / (3 * size)[:, None, None])


@dataclass(frozen=True, eq=False)
class Contacts:
    """M contacts, and the motions of the degrees of freedom there."""

    touch: Touches
    moves: Array  # (nv, nv)
    sphere: Array  # (M, nv) 1 where it moves the sphere
    other: Array  # (M, nv) 1 where it moves the other shape
    angular: Array  # (M, nv, 3) a
    point: Array  # (M, 3) p
    at_point: Array  # (M, nv, 3) L
    change: Array  # (M, 7, 6) of p, the normal and phi by the twist there: see `pairs.Touches`
    unknown: dict[int, str] = field(default_factory=dict)  # the states of which that is not known

    @property
    def side(self) -> Array:
        """(M, nv) s."""
        return self.sphere - self.other

    @property
    def jacobian(self) -> Array:
        """(M, nv, 3) the transpose of J."""
        return np.asarray(self.side[..., None] * self.at_point)

    def weight(self, diagonal: Array) -> Weight:
        """With the diagonal (M, nv) of A."""
        return weigh(self.jacobian, diagonal)

    def displacement(self) -> tuple[Array, Array, Array]:
        """How p (M, nv, 3), the normal (M, nv, 3) and phi (M, nv) move with each degree of freedom."""
        twist = np.concatenate([self.at_point, self.angular], axis=-1)
        found = (self.side[..., None] * twist) @ self.change.swapaxes(-1, -2)
        other = self.other[..., None]
        normal = found[..., 3:6] + other * cross(self.angular, self.touch.normal[:, None, :])
        return found[..., :3] + other * self.at_point, normal, found[..., 6]

    def velocity_change(self, v: Array, point: Array, moves: bool = True) -> Array:
        """(M, K, 3) the change of J v for fixed v (M, nv), of K changes of p (M, K, 3).

        The K are the degrees of freedom, or, where nothing `moves`, p alone changes.
        """
        u = v * self.side
        found = cross(u[:, None, :] @ self.angular, point)
        if not moves:
            return found
        after = (self.moves * u[:, None, :]) @ np.concatenate([self.at_point, self.angular], axis=-1)
        return np.asarray(found + cross(self.angular, after[..., :3]) + cross(self.at_point, after[..., 3:]))

    def force_change(self, force: Array, point: Array, moves: bool = True) -> Array:
        """(M, nv, K) the change of J' f for fixed f (M, 3), of K changes of p (M, K, 3) as above."""
        twisted = cross(force[:, None, :], self.angular)  # f x a
        found = twisted @ point.swapaxes(-1, -2)
        if moves:
            across = twisted @ self.at_point.swapaxes(-1, -2)  # (f x a_k) . L_j = -a_k . (f x L_j)
            found = found + self.moves.T * (across.swapaxes(-1, -2) - across)
        return np.asarray(self.side[..., None] * found)

    def weight_change(self, weight: Weight, diagonal: Array, by_motion: Array | None, point: Array) -> Array:
        """(M, K) the change of w, of K changes of p (M, K, 3).

        `diagonal` (M, nv) is that of A, `by_motion` (M, nv, nv) its derivative where the K are the degrees of freedom.
        """
        y = self.side[..., None] ** 2 * (self.at_point @ weight.part) / diagonal[..., None]
        turned = cross(self.angular, y)
        found = -(point @ turned.sum(axis=1)[..., None])[..., 0]
        if by_motion is None:
            return np.asarray(2 * found)
        moved = self.moves @ np.concatenate([cross(self.at_point, y), turned], axis=-1)
        found += (self.angular * moved[..., :3]).sum(axis=-1) + (self.at_point * moved[..., 3:]).sum(axis=-1)
        own = (self.at_point * y).sum(axis=-1) / diagonal
        return np.asarray(2 * found - (own[:, None, :] @ by_motion)[:, 0])
