"""A rigid impact of a model at a state: the velocities after it, and their exact derivatives.

The impulses of a law solve M(q) (v+ - v-) = J(q)' P and, of every contact, three equations that say what it does:
its velocity along the normal, or its impulse, is given, and so is its slide or its friction. Their derivative is that
of an implicit function: by positions, velocities, restitution and friction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.exceptions import GradientError, InputError, SimulationError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.motion.rigid.contact import POISSON, TOUCHES, RigidContact
from drake_diff.motion.rigid.law import FRICTIONLESS, OPENS, STICKS, Asked, Impulses, solve
from drake_diff.motion.rigid.plant import Kinetics, RigidPlant

STRIKES = 1e-9  # [m/s] a contact that closes more slowly does not strike
ENERGY = 1e-8  # of the energy before, as good as 0
DEPENDENT = 1e-12  # of the largest singular value
CONSISTENT = 1e-7  # of the largest entry


@dataclass(frozen=True, eq=False)
class Impact(ShowsItsRepr):
    """An impact: the states (nx,) before and after, and what each of m contacts did. Arrays are read-only.

    Attributes:
        time: [s] when it happened in a motion; 0 of an impact by itself.
        x_before, x_after: (nx,) the states.
        contacts: The names of the m contacts.
        impulses: (m, 3) [N s] on the side of the point or sphere, in world.
        ways: What each did: "sticks", "slides" or "frictionless"; "opens" where it pushed nothing.
        energy_lost: [J]
        by_x: (nx, nx) the derivative of the state after by the state before.
        by_restitution, by_friction: (nx,) those by the coefficients; zeros by a friction that the model gives.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.01)
        >>> x = np.array(model.default_state)
        >>> x[[6, 12]] = 0.1, -2.0  # the ball's radius, 2 m/s down
        >>> dd.motion.rigid_impact(model, x, dd.motion.RigidContact(restitution=0.5, friction=0))
        Impact of sphere::ball and ground::ground: frictionless, 1.5 J lost
    """

    time: float
    x_before: Array
    x_after: Array
    contacts: tuple[str, ...]
    impulses: Array
    ways: tuple[str, ...]
    energy_lost: float
    record: Struck  # what the derivatives are made of

    def __repr__(self) -> str:
        at = f" at {self.time:.6g} s" if self.time else ""
        does = "; ".join(f"{name}: {way}" for name, way in zip(self.contacts, self.ways, strict=True))
        return f"Impact of {does}, {self.energy_lost:.4g} J lost{at}"

    @cached_property
    def by_x(self) -> Array:
        """(nx, nx)."""
        nq, found = self.record.plant.nq, np.eye(len(self.x_before))
        found[nq:] = self.record.slopes[:, : len(self.x_before)]
        return frozen(found)

    @cached_property
    def by_restitution(self) -> Array:
        """(nx,)."""
        return frozen(np.concatenate([np.zeros(self.record.plant.nq), self.record.slopes[:, -2]]))

    @cached_property
    def by_friction(self) -> Array:
        """(nx,)."""
        return frozen(np.concatenate([np.zeros(self.record.plant.nq), self.record.slopes[:, -1]]))


@dataclass(frozen=True, eq=False)
class _Part:
    """One impact, or one of Poisson's two: velocities (nv,) before and after, what was asked and what was given."""

    before: Array
    after: Array
    asked: Asked
    given: Impulses


@dataclass(frozen=True, eq=False)
class Struck:
    """An impact of some contacts of a plant; `slopes` are of the velocities after it."""

    plant: RigidPlant
    q: Array
    contacts: tuple[int, ...]
    strikes: NDArray[np.bool_]  # (m,) whether each closes before it
    restitution: float
    friction_is_given: bool
    kinetics: Kinetics
    parts: tuple[_Part, ...]

    @property
    def name(self) -> str:
        """Of the contacts, for messages."""
        return ", ".join(self.plant.names[i] for i in self.contacts)

    @property
    def impulses(self) -> Array:
        """(m, 3) of all parts."""
        return np.asarray(sum(part.given.values for part in self.parts))

    @cached_property
    def slopes(self) -> Array:
        """(nv, nq + nv + 2) of the velocities after by positions, velocities before, restitution and friction."""
        nq, nv, m = self.plant.nq, self.plant.nv, len(self.contacts)
        for part in self.parts:
            for i in part.given.edges:
                if self.strikes[i]:
                    where = self.plant.names[self.contacts[i]]
                    raise GradientError(f"the impact of {where} has no derivative: it is on the edge of two motions")
        total = np.zeros((nv, nq + nv + 2))
        total[:, nq : nq + nv] = np.eye(nv)
        impulses = np.zeros((m, nq + nv + 2))  # along the normals, of the part before
        for k, part in enumerate(self.parts):
            by, by_impulse = self._of(part, needs_impulse=k + 1 < len(self.parts))
            least = np.zeros((m, nq + nv + 2))
            if k:
                least = self.restitution * impulses
                pushes = np.einsum("ij,ij->i", self.kinetics.normals, self.parts[k - 1].given.values)
                least[:, -2] += pushes
            moved = np.zeros((nq + nv + 2 + m, nq + nv + 2))
            moved[:nq, :nq] = np.eye(nq)
            moved[nq : nq + nv] = total
            moved[nq + nv, -2] = moved[nq + nv + 1, -1] = 1.0
            moved[nq + nv + 2 :] = least
            total, impulses = by @ moved, by_impulse @ moved
        if not self.friction_is_given:
            total[:, -1] = 0.0
        return total

    def _of(self, part: _Part, *, needs_impulse: bool) -> tuple[Array, Array]:
        """Of a part's velocities after (nv, ...) and impulses along normals (m, ...), by q, v-, e, mu and the least."""
        plant, M, J, normals = self.plant, self.kinetics.mass, self.kinetics.J, self.kinetics.normals
        nq, nv, m = plant.nq, plant.nv, len(self.contacts)
        P, ways = part.given.values, part.given.ways
        s = plant.slopes(self.q, self.contacts, part.after - part.before, P.ravel(), part.before, part.after)
        K, right = np.zeros((nv + 3 * m, nv + 3 * m)), np.zeros((nv + 3 * m, nq + nv + 2 + m))
        K[:nv, :nv], K[:nv, nv:] = M, -J.T
        right[:nv, :nq], right[:nv, nq : nq + nv] = -s.impulse, M
        for i, (closed, way) in enumerate(ways):
            rows = slice(3 * i, 3 * i + 3)
            block = _Equations(nq, nv, m, i)
            own, by_q = J[rows], (s.before[rows], s.after[rows], s.normals[rows])
            speeds = J[rows] @ part.before, J[rows] @ part.after
            restores = bool(self.strikes[i]) and len(self.parts) == 1  # as Newton says
            e = self.restitution if restores else None
            block.normal(closed, e, own, by_q, normals[i], speeds, P[i])
            block.tangents(way, part.asked.friction[i], own, by_q, normals[i], speeds[1], P[i])
            K[nv + 3 * i : nv + 3 * i + 3], right[nv + 3 * i : nv + 3 * i + 3] = block.K, block.right
        found, spare = _solved(K, right, nv)
        if found is None:
            raise GradientError(f"the impact of {self.name} has no derivative: its contacts depend on each other")
        along = np.einsum("ij,kij->ki", normals, spare[:, nv:].reshape(-1, m, 3))
        if needs_impulse and np.max(np.abs(along), initial=0.0) > CONSISTENT:
            raise GradientError(f"the impact of {self.name} has no derivative: how contacts share it is not unique")
        values = found[nv:].reshape(m, 3, -1)
        of_normals = np.einsum("ij,ijk->ik", normals, values)
        of_normals[:, :nq] += np.einsum("ijk,ij->ik", s.normals.reshape(m, 3, nq), P)
        return found[:nv], of_normals


class _Equations:
    """The three equations of contact i, differentiated: K on (v+, P) is `right` on (q, v-, e, mu, least)."""

    def __init__(self, nq: int, nv: int, m: int, i: int):
        self.nq, self.nv, self.i = nq, nv, i
        self.K, self.right = np.zeros((3, nv + 3 * m)), np.zeros((3, nq + nv + 2 + m))
        self.P = slice(nv + 3 * i, nv + 3 * i + 3)

    def normal(
        self,
        closed: bool,
        e: float | None,
        J: Array,
        by_q: tuple[Array, ...],
        n: Array,
        w: tuple[Array, Array],
        P: Array,
    ) -> None:
        """n . w+ + e n . w- = 0 where it is closed, without the second where e is None; else n . P = least."""
        before, after, dn = by_q
        nq, nv = self.nq, self.nv
        if closed:
            self.K[:, :nv] += np.outer(n, n @ J)
            self.right[:, :nq] -= np.outer(n, w[1] @ dn + n @ after)
            if e is not None:
                self.right[:, :nq] -= e * np.outer(n, w[0] @ dn + n @ before)
                self.right[:, nq : nq + nv] -= e * np.outer(n, n @ J)
                self.right[:, nq + nv] -= n * (n @ w[0])
        else:
            self.K[:, self.P] += np.outer(n, n)
            self.right[:, :nq] -= np.outer(n, P @ dn)
            self.right[:, nq + nv + 2 + self.i] += n

    def tangents(self, way: str, mu: float, J: Array, by_q: tuple[Array, ...], n: Array, w: Array, P: Array) -> None:
        """T w+ = 0 where it sticks, T P = 0 without friction, T P + mu (n . P) d = 0 where it slides along d."""
        _, after, dn = by_q
        nq, nv, T = self.nq, self.nv, np.eye(3) - np.outer(n, n)
        if way == STICKS:
            self.K[:, :nv] += T @ J
            self.right[:, :nq] -= T @ after - dn * (n @ w)
            return
        self.K[:, self.P] += T
        self.right[:, :nq] += dn * (n @ P)
        if way in (OPENS, FRICTIONLESS):
            return
        t = T @ w
        speed, push = float(np.linalg.norm(t)), float(n @ P)
        d = t / speed
        turned = mu * push * (T - np.outer(d, d)) / speed
        self.K[:, self.P] += mu * np.outer(d, n)
        self.K[:, :nv] += turned @ J
        self.right[:, :nq] -= turned @ (after - dn * (n @ w)) + mu * np.outer(d, P @ dn)
        self.right[:, nq + nv + 1] -= push * d


def _solved(K: Array, right: Array, nv: int) -> tuple[Array | None, Array]:
    """The least solution of K y = right, None where none is or the velocities are not unique; and K's null space."""
    rows = 1 / np.maximum(np.linalg.norm(K, axis=1), 1e-300)
    rows[np.linalg.norm(K, axis=1) < 1e-12] = 1.0
    scaled = K * rows[:, None]
    columns = 1 / np.maximum(np.linalg.norm(scaled, axis=0), 1e-12)
    U, s, Vt = np.linalg.svd(scaled * columns)
    rank = int(np.count_nonzero(s > DEPENDENT * s[0]))
    spare = Vt[rank:] * columns
    target = right * rows[:, None]
    found = (Vt[:rank].T @ ((U[:, :rank].T @ target) / s[:rank, None])) * columns[:, None]
    gap = np.max(np.abs(scaled @ found - target), initial=0.0)
    loose = np.max(np.abs(Vt[rank:, :nv]), initial=0.0)
    if gap > CONSISTENT * max(float(np.max(np.abs(target))), 1e-300) or loose > CONSISTENT:
        return None, spare
    return found, spare


def plant_of(model: Model, contact: RigidContact) -> RigidPlant:
    """The hard contacts of `model`, made once; ModelError where it has no such motion."""
    return model.cache(("rigid plant", contact.points), lambda: RigidPlant(model, contact.points))


def rigid_impact(model: Model, x: ArrayLike, contact: RigidContact, *, contacts: Any = None) -> Impact:
    """The impact of hard contacts at a state: the state after it, the impulses, and the derivatives.

    Args:
        model: The model.
        x: (nx,) the state before.
        contact: Restitution, friction and the law.
        contacts: Names of those that take part; if not given, those whose gap is at most 1e-6 m.

    Returns:
        The `Impact`.

    Raises:
        SimulationError: No impulses satisfy the law, they are not unique, or they add energy.
        UnknownNameError: There is no such contact.
        InputError: No contact touches.
        ModelError: The model has no such motion.

    Example:
        >>> model = dd.load_model("models/two_spheres.sdf", time_step=0.01)  # of 1 kg and 0.5 kg, on a line
        >>> hit = dd.motion.rigid_impact(model, [0, 0.2, 3, 0], dd.motion.RigidContact(1.0, friction=0))
        >>> hit.x_after[2:].round(9).tolist()
        [1.0, 4.0]
    """
    plant, state = plant_of(model, contact), np.asarray(finite_array("x", x, (model.nx,)))
    if contacts is None:
        chosen = tuple(np.flatnonzero(plant.gaps(state) <= TOUCHES).tolist())
    else:
        named = (contacts,) if isinstance(contacts, str) else tuple(contacts)
        for name in named:
            if name not in plant.names:
                raise UnknownNameError("contact", got=name, known=plant.names)
        chosen = tuple(plant.names.index(name) for name in named)
    if not chosen:
        least = float(np.min(plant.gaps(state), initial=np.inf))
        raise InputError("x", got=f"gaps of at least {least:.3g} m", expected="contacts that touch")
    return strike(plant, state, contact, chosen)


def strike(
    plant: RigidPlant,
    x: Array,
    contact: RigidContact,
    contacts: tuple[int, ...],
    held: tuple[int, ...] = (),
    time: float = 0.0,
) -> Impact:
    """The impact of `contacts` at the state `x` (nx,), of which those that are `held` were closed before."""
    q, v = x[: plant.nq], x[plant.nq :]
    strikes = np.array([i not in held for i in contacts]) & (plant.gap_rates(x)[list(contacts)] < 0)
    restitution, is_poisson, friction = contact.restitution, contact.law == POISSON, plant.frictions(contact.friction)
    kinetics = plant.kinetics(q, contacts)
    names = ", ".join(plant.names[i] for i in contacts)
    J, M, m = kinetics.J, kinetics.mass, len(contacts)
    pushed = np.linalg.solve(M, J.T)
    W, mu = J @ pushed, friction[list(contacts)]
    W = (W + W.T) / 2
    w = (J @ v).reshape(m, 3)
    along = np.einsum("ij,ij->i", kinetics.normals, w)
    speeds = np.where(strikes & ~np.array([is_poisson] * m), -restitution * along, 0.0)
    asked = Asked(W, w, kinetics.normals, speeds, np.zeros(m), mu)
    given = solve(asked, names)
    parts = [_Part(v, v + pushed @ given.values.ravel(), asked, given)]
    if is_poisson and restitution > 0:
        least = restitution * np.maximum(np.einsum("ij,ij->i", kinetics.normals, given.values), 0.0)
        asked = Asked(W, given.after, kinetics.normals, np.zeros(m), least, mu)
        given = solve(asked, names)
        parts.append(_Part(parts[0].after, parts[0].after + pushed @ given.values.ravel(), asked, given))
    after = parts[-1].after
    before_energy, energy = float(v @ M @ v) / 2, float(after @ M @ after) / 2
    if energy > before_energy * (1 + ENERGY):
        law = "Poisson's" if is_poisson else "Newton's"
        other = "" if is_poisson else '; law="poisson" may not'
        raise SimulationError(
            f"{law} restitution of {restitution:g} with friction adds {energy - before_energy:.4g} J to the "
            f"{before_energy:.4g} J before the impact of {names}{other}"
        )
    is_given = contact.friction is not None
    record = Struck(plant, q, contacts, strikes, restitution, is_given, kinetics, tuple(parts))
    return Impact(
        time=time,
        x_before=frozen(x),
        x_after=frozen(np.concatenate([q, after])),
        contacts=tuple(plant.names[i] for i in contacts),
        impulses=frozen(record.impulses),
        ways=tuple(way for _, way in parts[-1].given.ways),
        energy_lost=before_energy - energy,
        record=record,
    )
