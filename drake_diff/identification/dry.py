"""The motion of a tree in continuous time with dry friction that holds joints still.

A joint slides one way or the other, against a constant torque, or it is held: its acceleration is 0 for as long as the
torque that this takes is within the friction. Each of these motions is smooth. Within a step the time is sought at
which one ends, where a velocity is 0 or a torque leaves the friction, and the next one goes on from there.

Friction can also give way: what it holds moves as with an inertia g and a damping d more, for as long as the torque
|g a + d v| that this takes is within the friction. Simulators hold joints so: by MuJoCo's `frictionloss` 1/g is its R,
and d/g the rate by which its reference slows a joint down. This force has no jumps.

Derivatives go through such an end as Aizerman and Gantmacher (1958) say: a joint that stops passes on no velocity, and
where it goes on the other way, what it had is stretched by how its acceleration jumps.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.identification.chart import Chart
from drake_diff.identification.flow import CHUNK, ContinuousMotion
from drake_diff.identification.frozen import exponential
from drake_diff.identification.set_tree import SetTree, caught, held_inverse
from drake_diff.identification.tree import Grip, Mask, Numbers, Tree
from drake_diff.identification.unknowns import COULOMB, Unknowns
from drake_diff.model.model import Model

REST = 1e-9  # [rad/s, m/s] below which a joint is at rest
MOST_PARTS = 60  # of a step: one with more has no end that could be told, and none is
SEARCHED, MET = 99, 1e-9  # steps of the search for an end; [rad/s, m/s] or of the friction: how near it is then
SHORT = 1e-13  # [s] between which an end is known well enough, however steep it is there


class Part(NamedTuple):
    """Of some steps at once, a part in which joints slide one way or are held."""

    rows: Indices
    x: Array  # (n, nx) at its start
    h: Array  # (n,) [s]
    u: Array
    turn: Array  # (n, nv) 1 or -1 of a joint that slides; 0 of others
    held: Mask  # (n, nv) which joints are held
    stopped: Indices  # (n,) the joint that slid and has just come to 0; -1 where none has
    turned: Array  # (n, nv) which way joints slid before that,
    holding: Mask  # (n, nv) and which of them were held

    def some(self, s: slice) -> "Part":
        """Of some of the steps."""
        return Part(
            self.rows[s],
            self.x[s],
            self.h[s],
            self.u[s],
            self.turn[s],
            self.held[s],
            self.stopped[s],
            self.turned[s],
            self.holding[s],
        )


@dataclass(frozen=True, eq=False)
class DryMotion(ContinuousMotion):
    """As `ContinuousMotion`, with dry friction in some joints; steps may be differentiated frozen halfway."""

    joints: tuple[int, ...] = ()  # degrees of freedom; one that others follow has the friction of all of them
    gives: bool = False  # whether friction gives way; of one joint only
    calm: bool = False

    def exact(self) -> "DryMotion | None":
        """Differentiated by the method's own derivatives; None where it is."""
        return replace(self, calm=False) if self.calm else None

    def run(self, values: Array, starts: Array, hs: Array, us: Array) -> Array:
        """(K, M+1, nx) states from starts (K, nx) by steps of hs (K, M) [s] under us (K, M, nu)."""
        tree = self.set_tree(values)
        xs = np.empty((len(starts), hs.shape[1] + 1, starts.shape[1]))
        xs[:, 0] = starts
        for m in range(hs.shape[1]):
            xs[:, m + 1], _ = self._steps(tree, xs[:, m], hs[:, m], us[:, m])
        return xs

    def grip_at(self, numbers: Numbers, q: Array, v: Array, u: Array) -> Grip:
        """(which way joints slide (N, nv), which are held (N, nv)) in states (N, nq), (N, nv) under u (N, nu)."""
        nothing, tree = np.zeros(v.shape), SetTree(self.tree, numbers)
        return self._grip(tree, np.concatenate([q, v], axis=1), u, nothing, nothing > 0)

    def rates(self, values: Array, x: Array, u: Array) -> Array:
        """(N, nx) by time, of states (N, nx) under u (N, nu)."""
        tree = self.set_tree(values)
        grip = self.grip_at(tree.numbers, x[:, : self.model.nq], x[:, self.model.nq :], u)
        return self._rates(x, self._accelerations(tree, x, u, grip))

    def _accelerations(self, tree: SetTree, x: Array, u: Array, grip: Grip | None) -> Array:
        """(N, nv) in states x (N, nx) under u (N, nu)."""
        return super()._accelerations(tree, x, u, None) if grip is None else self._pushes(tree, x, u, *grip)[0]

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array) -> tuple[Array, Array]:
        """Of each step: by the state (K, M, nx, nx), and by z (K, M, nx, np)."""
        tree, by = self.set_tree_at(z)
        (K, M), nx = hs.shape, xs.shape[2]
        x, u = xs[:, :-1].reshape(K * M, nx), us.reshape(K * M, -1)
        _, parts = self._steps(tree, x, hs.reshape(-1), u)
        found = np.zeros((K * M, nx, nx + by.shape[1]))
        found[:, :, :nx] = np.eye(nx)
        for part in parts:
            for k in range(0, len(part.rows), CHUNK):
                one = part.some(slice(k, k + CHUNK))
                moved = self._taken_up(tree, one) @ found[one.rows]
                through = self._through(tree, by, one)
                moved = through[:, :, :nx] @ moved
                moved[:, :, nx:] += through[:, :, nx:]
                found[one.rows] = moved
        found = found.reshape(K, M, nx, -1)
        return found[..., :nx], found[..., nx:]

    def _steps(self, tree: SetTree, x: Array, h: Array, u: Array) -> tuple[Array, list[Part]]:
        """Where steps from x (N, nx) of lengths h (N,) end, and their parts."""
        nv = self.model.nv
        x, left, parts = x.copy(), h.copy(), list[Part]()
        released, stays = np.zeros((len(x), nv)), np.zeros((len(x), nv), dtype=bool)
        stopped, turned, holding = np.full(len(x), -1), np.zeros((len(x), nv)), np.zeros((len(x), nv), dtype=bool)
        for _ in range(MOST_PARTS):
            rows = np.flatnonzero(left > 0)
            if not len(rows):
                break
            turn, held = self._grip(tree, x[rows], u[rows], released[rows], stays[rows])
            ends = self._moved(tree, x[rows], left[rows], u[rows], turn, held)
            room = self._room(tree, ends, u[rows], turn, held)
            lengths, which = left[rows].copy(), np.zeros(len(rows), dtype=np.intp)
            last = np.flatnonzero(np.any(room < 0, axis=1))
            if len(last):
                own = x[rows][last], u[rows][last], turn[last], held[last]
                lengths[last], ends[last], which[last] = self._end(tree, *own, lengths[last], room[last])
            parts.append(Part(rows, x[rows], lengths, u[rows], turn, held, stopped[rows], turned[rows], holding[rows]))
            released[rows], stopped[rows], stays[rows] = 0.0, -1, False
            turned[rows], holding[rows] = turn, held
            if len(last):
                j, at = which[last], rows[last]
                slid = ~held[last, j]
                if self.gives:
                    stays[at[slid], j[slid]] = True
                else:
                    ends[last[slid], self.model.nq + j[slid]] = 0.0
                    stopped[at[slid]] = j[slid]
                _, push = self._pushes(tree, ends[last], u[at], turn[last], held[last])
                released[at[~slid], j[~slid]] = np.sign(push[~slid, j[~slid]])
            x[rows] = ends
            left[rows] = left[rows] - lengths
            done = np.ones(len(rows), dtype=bool)
            done[last] = False
            left[rows[done]] = 0.0
        x[left > 0] = np.nan
        return x, parts

    @property
    def kinks(self) -> bool:
        """Whether derivatives say little of larger changes."""
        return True

    @property
    def words(self) -> str:
        return f"{super().words}, with dry friction that holds"

    @property
    def own(self) -> Mask:
        """(nv,) which joints have dry friction."""
        return np.isin(np.arange(self.model.nv), self.joints)

    def _grip(self, tree: SetTree, x: Array, u: Array, released: Array, stays: Mask) -> Grip:
        """(turn, held) of a motion that begins at x; a joint at rest is held where friction can."""
        v, own, friction = x[:, self.model.nq :], self.own, tree.friction()
        turn = np.where(own, released if self.gives else np.where(np.abs(v) > REST, np.sign(v), released), 0.0)
        held = own & (turn == 0)
        for _ in self.joints:
            some = np.flatnonzero(np.any(held, axis=1))
            if not len(some):
                break
            _, push = self._pushes(tree, x[some], u[some], turn[some], held[some])
            beyond = np.where(held[some] & ~stays[some], np.abs(push) - friction, -np.inf)
            j = np.argmax(beyond, axis=1)
            let = beyond[np.arange(len(some)), j] > 0
            if not np.any(let):
                break
            turn[some[let], j[let]] = np.sign(push[let, j[let]])
            held[some[let], j[let]] = False
        return turn, held

    def _pushes(self, tree: SetTree, x: Array, u: Array, turn: Array, held: Mask) -> tuple[Array, Array]:
        """(accelerations (N, nv), what pushes joints that are held (N, nv))."""
        nq = self.model.nq
        mass, force = tree.pushed(x[:, :nq], x[:, nq:], u, turn)
        if self.gives:
            mass, force = caught(tree.numbers, mass, force, x[:, nq:], held)
        if self.gives or not np.any(held):
            a = np.linalg.solve(mass, force[..., None])[..., 0]
            push = tree.numbers.held_inertia * a + tree.numbers.held_damping * x[:, nq:]
            return np.asarray(a), np.where(held, push, 0.0)
        a = (held_inverse(mass, held) @ force[..., None])[..., 0]
        return a, np.where(held, force - (mass @ a[..., None])[..., 0], 0.0)

    def _moved(self, tree: SetTree, x: Array, h: Array, u: Array, turn: Array, held: Mask) -> Array:
        """The states (N, nx) after h (N,)."""

        x = x.copy()
        if not self.gives:
            x[:, self.model.nq :][held] = 0.0
        return self._stepped(tree, x, h, u, (turn, held))

    def _room(self, tree: SetTree, x: Array, u: Array, turn: Array, held: Mask) -> Array:
        """(N, nv) by how much each joint slides or is held as it should at x, negative beyond."""
        room = np.where(turn != 0, turn * x[:, self.model.nq :], np.inf)
        size = np.maximum(tree.friction(), 1e-300)
        some = np.flatnonzero(np.any(held, axis=1))
        if self.gives:
            every = np.broadcast_to(self.own, held.shape)
            _, push = self._pushes(tree, x, u, np.zeros_like(turn), every)
            return np.where(every, np.where(held, 1 - np.abs(push) / size, turn * push / size - 1), np.inf)
        if len(some):
            _, push = self._pushes(tree, x[some], u[some], turn[some], held[some])
            room[some] = np.where(held[some], 1 - np.abs(push) / size, room[some])
        return room

    def _end(
        self,
        tree: SetTree,
        x: Array,
        u: Array,
        turn: Array,
        held: Mask,
        h: Array,
        room: Array,
    ) -> tuple[Array, Array, Indices]:
        """(when a motion ends that has this room (N, nv) at h (N,), where, by which joint): regula falsi of Illinois.

        Looked at are the joints that are beyond at h; every third step halves what is left.
        """

        def least(x: Array, i: Indices) -> tuple[Array, Indices]:
            each = np.where(sought[i], self._room(tree, x, u[i], turn[i], held[i]), np.inf)
            which = np.argmin(each, axis=1)
            return each[np.arange(len(i)), which], which

        sought, every = room < 0, np.arange(len(x))
        low, high, t = np.zeros(len(x)), h.copy(), h.copy()
        at_low, at_high = np.maximum(least(x, every)[0], 0.0), np.min(room, axis=1)
        ends, which = x.copy(), np.argmin(room, axis=1)
        side = np.zeros(len(x))  # the end that moved last
        i = every
        for k in range(SEARCHED):
            secant = (at_low[i] > 0) & (k % 3 < 2)
            part = np.where(secant, at_low[i] / np.maximum(at_low[i] - at_high[i], 1e-300), 0.5)
            t[i] = low[i] + (high[i] - low[i]) * part
            ends[i] = self._moved(tree, x[i], t[i], u[i], turn[i], held[i])
            found, which[i] = least(ends[i], i)
            above = found > 0
            at_high[i] = np.where(above, np.where(side[i] > 0, at_high[i] / 2, at_high[i]), found)
            at_low[i] = np.where(above, found, np.where(side[i] < 0, at_low[i] / 2, at_low[i]))
            low[i], high[i] = np.where(above, t[i], low[i]), np.where(above, high[i], t[i])
            side[i] = np.where(above, 1.0, -1.0)
            i = i[(np.abs(found) >= MET) & (high[i] - low[i] > SHORT)]
            if not len(i):
                break
        return t, ends, which

    def _taken_up(self, tree: SetTree, part: Part) -> Array:
        """(n, nx, nx) what becomes of a small change of the state where the part begins.

        Of a joint that has come to 0 it has changed when: what is accelerated otherwise from then on is moved by that.
        """
        nq, nx = self.model.nq, part.x.shape[1]
        found = np.tile(np.eye(nx), (len(part.rows), 1, 1))
        x, u = part.x, part.u
        some = np.flatnonzero(np.any(part.held, axis=1) & (part.stopped < 0))
        if len(some) and not self.gives:
            mass, _ = tree.pushed(x[some, :nq], x[some, nq:], u[some], part.turn[some])
            found[some, nq:, nq:] = held_inverse(mass, part.held[some]) @ mass
        some = np.flatnonzero(part.stopped >= 0)
        if len(some):
            j, own = part.stopped[some], np.arange(len(some))
            before, _ = self._pushes(tree, x[some], u[some], part.turned[some], part.holding[some])
            after, _ = self._pushes(tree, x[some], u[some], part.turn[some], part.held[some])
            slowed = before[own, j]
            found[some, nq:, nq + j] += (after - before) / np.where(slowed != 0, slowed, np.inf)[:, None]
        return found

    def _through(self, tree: SetTree, by: Array, part: Part) -> Array:
        """(n, nx, nx + np) the end of a part by its start and by z."""
        grip = part.turn, part.held
        x = part.x.copy()
        if not self.gives:
            x[:, self.model.nq :][part.held] = 0.0
        if not self.calm:
            return self._step_slopes(tree, by, x, part.h, part.u, grip)
        halfway = self._moved(tree, x, part.h / 2, part.u, *grip)
        _, J, C = self._rate_slopes(tree, by, halfway, part.u, grip)
        h = part.h[:, None, None]
        whole, phi = exponential(h * J)
        return np.concatenate([whole, h * (phi @ C)], axis=2)


def dry_places(tree: Tree, unknowns: Unknowns) -> tuple[int, ...]:
    """Of the velocities: those of joints of which dry friction is an unknown."""
    dry, coupling = {one.label for one in unknowns.each if one.quantity == COULOMB}, tree.dynamics.coupling
    places = {link.joint.v_start for link in tree.links if link.joint.joint in dry}
    if coupling is not None:
        places = {int(coupling.of_v[i]) for i in places}
    return tuple(sorted(places))


def smooth_or_dry(model: Model, tree: Tree, chart: Chart, unknowns: Unknowns, longest: float) -> ContinuousMotion:
    """The motion in continuous time, with dry friction that holds in those joints of which it is an unknown."""
    places = dry_places(tree, unknowns)
    own = (model, tree, chart, unknowns, longest)
    return DryMotion(*own, joints=places) if places else ContinuousMotion(*own)
