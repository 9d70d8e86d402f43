"""The convex problem that Drake's discrete step solves, solved to rounding by Newton's method.

For A = M + h D, v* the velocity without impulses and convex potentials l_c of contacts and joints, v' is the only
minimum of

    l(v') = (v' - v*)' A (v' - v*) / 2 + sum_c l_c(J_c v'),

where A (v' - v*) = sum_c J_c' g_c(J_c v'), g_c = -dl_c / d(J_c v') being the impulses (see `contact.laws` and
`joint_impulses`). Drake's solver stops where what is missing is 1e-6 of the momentum; a few Newton steps from there
leave rounding only. A line search along each step looks for the minimum of l, of which it needs the slope alone.
"""

from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.derivatives.contact.laws import Cone, HuntCrossley
from drake_diff.derivatives.joint_impulses import JointImpulses

Indices = NDArray[np.intp]
ROUNDING = 64 * float(np.finfo(float).eps)  # of the sums
SOLVED = 1e-12  # of the momentum; from there on steps are taken as long as they halve what is missing
MAX_STEPS = 60
BISECTIONS = 30


@dataclass(frozen=True, eq=False)
class ContactImpulses:
    """M contacts, each in one of N problems; `law` has any velocity, which is replaced."""

    problem: Indices  # (M,)
    jacobian: Array  # (M, nv, 3) J'
    law: Cone | HuntCrossley

    def part(self, which: Indices, position: Indices) -> "ContactImpulses":
        """Some of them, in the problems that `position` says."""
        return ContactImpulses(position, self.jacobian[which], _law_part(self.law, which))

    def at(self, v: Array) -> tuple[Array, Array]:
        """The impulses (M, 3) at the velocities v (N, nv), and their derivatives (M, 3, 3) by -J v'."""
        velocity = (v[self.problem][:, None, :] @ self.jacobian)[:, 0]
        solved = replace(self.law, velocity=velocity).solve()
        return solved.impulse, -solved.by_velocity()


def _law_part(law: Cone | HuntCrossley, which: Indices) -> Cone | HuntCrossley:
    arrays = {f.name: getattr(law, f.name)[which] for f in fields(law) if isinstance(getattr(law, f.name), np.ndarray)}
    return replace(law, **arrays)


def _add(total: Array, where: Indices, parts: Array) -> None:
    """Add each of parts (M, ...) to the entry of `total` that `where` (M,) says: np.add.at, many times as fast."""
    if len(where):
        order, begins, rows = _grouped(where)
        total[rows] += np.add.reduceat(parts[order], begins, axis=0)


def _add_squares(total: Array, where: Indices, size: Array, vectors: Array) -> None:
    """Add size w w' of each of vectors (M, n) to the entry of `total` (N, n, n) that `where` (M,) says."""
    if not len(where):
        return
    order, begins, rows = _grouped(where)
    counts = np.diff(begins, append=len(where))
    at = np.repeat(np.arange(len(rows)), counts), np.arange(len(where)) - np.repeat(begins, counts)
    stacked = np.zeros((2, len(rows), int(np.max(counts)), vectors.shape[1]))
    stacked[0][at], stacked[1][at] = vectors[order], (size[:, None] * vectors)[order]
    total[rows] += stacked[0].swapaxes(1, 2) @ stacked[1]


def _grouped(where: Indices) -> tuple[Indices, Indices, Indices]:
    """The order by group, where each group begins in it, and the groups."""
    order = np.argsort(where, kind="stable")
    begins = np.flatnonzero(np.diff(where[order], prepend=-1))
    return order, begins, where[order][begins]


@dataclass(frozen=True, eq=False)
class Balance:
    """What is left of the momentum balance of N problems at some velocities."""

    missing: Array  # (N, nv) A (v' - v*) - J' g
    given: Array  # (N, nv) J' g
    curvature: Array  # (N, nv, nv) the second derivative of l


@dataclass(frozen=True, eq=False)
class ConvexSteps:
    """N problems."""

    A: Array  # (N, nv, nv)
    momentum: Array  # (N, nv) A v*, which is better known than v* where A is ill conditioned
    contacts: ContactImpulses | None
    joints: JointImpulses
    same_tree: NDArray[np.bool_]  # (nv, nv)

    def part(self, which: Indices) -> "ConvexSteps":
        """Some of the problems."""
        position = np.full(len(self.A), -1, dtype=np.intp)
        position[which] = np.arange(len(which))
        contacts, joints = self.contacts, self.joints
        own = np.flatnonzero(position[joints.problem] >= 0)
        joints = joints.part(own, position[joints.problem[own]])
        if contacts is not None:
            own = np.flatnonzero(position[contacts.problem] >= 0)
            contacts = contacts.part(own, position[contacts.problem[own]])
        return ConvexSteps(self.A[which], self.momentum[which], contacts, joints, self.same_tree)

    def taking_part(self) -> NDArray[np.bool_]:
        """(N, nv) the degrees of freedom of the trees that an impulse may reach, which Drake solves for."""
        reached = np.zeros(self.momentum.shape, dtype=bool)
        if self.contacts is not None:
            np.logical_or.at(reached, self.contacts.problem, (self.contacts.jacobian != 0).any(axis=2))
        np.logical_or.at(reached, self.joints.problem, self.joints.direction != 0)
        return np.asarray(reached @ self.same_tree)

    def at(self, v: Array) -> Balance:
        """The balance at v (N, nv)."""
        given, curvature = np.zeros_like(v), np.array(self.A)
        if self.contacts is not None:
            J, (impulse, slope) = self.contacts.jacobian, self.contacts.at(v)
            _add(given, self.contacts.problem, (J @ impulse[..., None])[..., 0])
            _add(curvature, self.contacts.problem, J @ slope @ J.swapaxes(-1, -2))
        j, (pull, stiffness) = self.joints.direction, self.joints.at(v)
        _add(given, self.joints.problem, j * pull[:, None])
        _add_squares(curvature, self.joints.problem, stiffness, j)
        had = (self.A @ v[..., None])[..., 0]
        return Balance(had - self.momentum - given, given, curvature)

    def norm(self, momentum: Array) -> Array:
        """(N,) that of Drake's solver, |diag(A)^-1/2 p| of p (N, nv)."""
        return np.asarray(np.sqrt((momentum * momentum / np.einsum("kii->ki", self.A)).sum(axis=1)))

    def scale(self, v: Array, given: Array) -> Array:
        """(N,) the momentum that Drake's solver compares with."""
        had = (self.A @ v[..., None])[..., 0]
        return np.asarray(np.maximum(self.norm(had), self.norm(given)))

    def rounding(self, v: Array, at: Balance) -> Array:
        """(N,) what of the momentum rounding may leave at v (N, nv): of sums, and of stiff impulses.

        The sums may be far larger than what they amount to, as where a heavy tree has a light link.
        """
        of_sums = (np.abs(at.curvature) @ np.abs(v)[..., None])[..., 0] + np.abs(self.momentum)
        return np.maximum(SOLVED * self.scale(v, at.given), ROUNDING * self.norm(of_sums)) + np.finfo(float).tiny

    def solve(self, v: Array, at: Balance) -> tuple[Array, NDArray[np.bool_]]:
        """v' (N, nv) to rounding from v (N, nv) with its balance, and whether it was reached (N,)."""
        v, reached = np.array(v), np.zeros(len(v), dtype=bool)
        open_, problems = np.arange(len(v)), self
        for _ in range(MAX_STEPS):
            own = v[open_]
            size = problems.norm(at.missing)
            step = np.array(-np.linalg.solve(at.curvature, at.missing[..., None])[..., 0], dtype=float)
            ahead = problems.at(own + step)
            ahead_size = problems.norm(ahead.missing)
            near = size <= problems.rounding(own, at)
            last = near & (ahead_size >= size / 2)  # as far as rounding lets it
            slope = (ahead.missing * step).sum(axis=1)
            search = ~near & (slope > 0) & (ahead_size > size / 2)  # beyond the minimum along the step
            if search.any():
                which = np.flatnonzero(search)
                step[which] *= _along(problems.part(which), own[which], step[which])[:, None]
            better = ~last | (ahead_size < size)
            v[open_[better]] = (own + step)[better]
            reached[open_[last]] = True
            if last.all():
                break
            if search.any() or last.any():
                open_, problems = open_[~last], problems.part(np.flatnonzero(~last))
                at = problems.at(v[open_])
            else:
                at = ahead
        return v, reached


def _along(problems: ConvexSteps, v: Array, step: Array) -> Array:
    """(N,) the part of each step (N, nv) at which l is smallest along it, l being larger again at its end."""
    lower, upper = np.zeros(len(v)), np.ones(len(v))
    for _ in range(BISECTIONS):
        middle = (lower + upper) / 2
        falls = (problems.at(v + middle[:, None] * step).missing * step).sum(axis=1) < 0
        lower, upper = np.where(falls, middle, lower), np.where(falls, upper, middle)
    return (lower + upper) / 2
