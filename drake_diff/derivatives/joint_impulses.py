"""The impulses of joint limits, of PD controllers and of couplers on joints, as Drake's solver has them.

Each acts along one direction j of the velocities, J' g with

    g = clip((v_hat - j . v') / R, lower, upper)

and w = j diag(A)^-1 j' its effective inverse mass, h the time step:

- a limit at the distance d >= 0: v_hat = -d / 2h, R = max(b w, 1 / (2 h^2 1e12)), g >= 0, where the joint may reach it
  in two steps at the velocity before the step or without constraints;
- a controller: h times its effort, so 1 / R = h (h kp + kd) and v_hat = R h (u - kp (q - q_ref) + kd v_ref), |g| at
  most h times the effort limit; gains too stiff for the time step, R < b w, are lowered by one factor until R = b w;
- a coupler q_0 = ratio q_1 + offset that is off by d: v_hat = -d / 2h, R = b w.

b = 0.1^2 / (4 pi^2) is Drake's near-rigid factor (Castro, Permenter and Han, "An unconstrained convex formulation of
compliant contact", 2022).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array

NEAR_RIGID = 0.1**2 / (4 * np.pi**2)
LIMIT_STIFFNESS = 1e12  # Drake's [N/m or N m/rad]
LIMIT_WINDOW = 2.0  # of how far a joint moves in a step: where Drake looks for its limits


@dataclass(frozen=True, eq=False)
class JointImpulses:
    """S of them, each in one of N problems."""

    problem: NDArray[np.intp]  # (S,)
    direction: Array  # (S, nv) j
    target: Array  # (S,) v_hat [m/s or rad/s]
    compliance: Array  # (S,) R [1/kg or 1/(kg m^2)]
    lower: Array  # (S,) [N s or N m s]
    upper: Array
    near_rigid: NDArray[np.bool_]  # (S,) whether R is b w

    def part(self, which: NDArray[np.intp], position: NDArray[np.intp]) -> "JointImpulses":
        """Some of them, in the problems that `position` says."""
        target, compliance = self.target[which], self.compliance[which]
        bounds = self.lower[which], self.upper[which]
        direction, near_rigid = self.direction[which], self.near_rigid[which]
        return JointImpulses(position, direction, target, compliance, *bounds, near_rigid)

    def at(self, v: Array) -> tuple[Array, Array]:
        """The impulses (S,) at the velocities v (N, nv), and their derivatives (S,) by -j . v', none at a bound."""
        wanted = (self.target - (self.direction * v[self.problem]).sum(axis=1)) / self.compliance
        free = (wanted > self.lower) & (wanted < self.upper)
        return np.clip(wanted, self.lower, self.upper), np.where(free, 1 / self.compliance, 0.0)

    def by_motion(self, v: Array, diagonal: Array, diagonal_slope: Array, h: float) -> Array:
        """(S, nv) how the impulses of limits and couplers change with the degrees of freedom, v' (N, nv) being fixed.

        Through v_hat, which falls by j / 2h, and through R where it is b w; `diagonal_slope` (N, nv, nv) has the
        derivatives of the diagonal (N, nv) of A.
        """
        impulse, slope = self.at(v)
        softer = np.where(self.near_rigid, NEAR_RIGID * impulse * slope, 0.0)[:, None]
        of_weight = (self.direction / diagonal[self.problem]) ** 2
        by_weight = (of_weight[:, None, :] @ diagonal_slope[self.problem])[:, 0]
        return np.asarray(softer * by_weight - slope[:, None] * self.direction / (2 * h))


def gather(parts: Sequence[JointImpulses], nv: int) -> JointImpulses:
    """All of some parts as one."""
    if not parts:
        none = np.zeros(0)
        return JointImpulses(np.zeros(0, dtype=np.intp), np.zeros((0, nv)), none, none, none, none, none > 0)
    names = ("problem", "direction", "target", "compliance", "lower", "upper", "near_rigid")
    return JointImpulses(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def limit_impulses(limits: Array, q: Array, v: Array, free: Array, diagonal: Array, h: float) -> list[JointImpulses]:
    """Of N states: positions q and velocities v (N, nv) of each degree of freedom, `free` (N, nv) v' without impulses.

    `limits` (2, nv) are infinite where there are none, `diagonal` (N, nv) is that of A.
    """
    window = LIMIT_WINDOW * h * np.maximum(np.abs(v), np.abs(free))
    found = []
    for sign, limit in ((1.0, limits[0]), (-1.0, limits[1])):
        with np.errstate(invalid="ignore"):
            distance = sign * (q - limit)  # infinite where there is no limit
            problem, dof = np.nonzero(distance <= window)
        if not len(problem):
            continue
        w = 1 / diagonal[problem, dof]
        direction = np.zeros((len(problem), q.shape[1]))
        direction[np.arange(len(problem)), dof] = sign
        stiffest = 1 / (2 * h * h * LIMIT_STIFFNESS)
        compliance = np.maximum(NEAR_RIGID * w, stiffest)
        none, all_ = np.zeros(len(problem)), np.full(len(problem), np.inf)
        target = -distance[problem, dof] / (2 * h)
        found.append(JointImpulses(problem, direction, target, compliance, none, all_, compliance > stiffest))
    return found


@dataclass(frozen=True, eq=False)
class Controllers:
    """C of PD control, in N states."""

    velocity: NDArray[np.intp]  # (C,) the degree of freedom of each
    kp: Array  # (N, C)
    kd: Array
    reference: Array  # (2, C) positions and velocities
    limit: Array  # (C,) of the effort

    def impulses(self, q: Array, us: Array, diagonal: Array, h: float) -> JointImpulses:
        """q and `diagonal` (N, nv) are as for limits, us (N, C) the inputs of the controllers' actuators."""
        problem, which = (index.ravel() for index in np.indices(us.shape))
        dof = self.velocity[which]
        kp, kd, softest = self.kp.ravel(), self.kd.ravel(), NEAR_RIGID / diagonal[problem, dof]
        lowered = np.minimum(1.0, 1 / (h * (h * kp + kd) * softest))
        kp, kd = lowered * kp, lowered * kd
        direction = np.zeros((len(problem), q.shape[1]))
        direction[np.arange(len(problem)), dof] = 1.0
        effort = us.ravel() - kp * (q[problem, dof] - self.reference[0, which]) + kd * self.reference[1, which]
        total, bound = h * kp + kd, h * self.limit[which]
        near_rigid = (lowered < 1).ravel()
        return JointImpulses(problem, direction, effort / total, 1 / (h * total), -bound, bound, near_rigid)
