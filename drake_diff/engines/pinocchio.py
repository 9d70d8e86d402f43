"""Pinocchio: a model built joint by joint from Drake's plant, its RNEA derivatives in Drake's semi-implicit Euler step.

See `body_frame` for its coordinates.
"""

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff.engines.interface import EngineContract, StepJacobian
from drake_diff.engines.numpy import DRAKES_STEP, EACH_CALL
from drake_diff.exceptions import MissingDependencyError
from drake_diff.mechanics.coordinates import (
    euler_acceleration,
    euler_jacobian,
    euler_step,
    native_positions,
    turn,
    turn_derivatives,
    turning,
)
from drake_diff.mechanics.description import describe, joint_contract
from drake_diff.mechanics.joints import JointContract
from drake_diff.mechanics.pinocchio_tree import build
from drake_diff.model.model import Model

try:
    import pinocchio as pin
except ImportError as error:
    raise MissingDependencyError("this engine needs Pinocchio: pip install 'drake-diff[engines]'") from error


class PinocchioEngine:
    """Trees of hinges, slides and free bodies; no contact and no joint limits."""

    name, status = "pinocchio", "ok"

    def __init__(self, model: Model):
        self.description = describe(model)
        self.time_step = model.time_step
        self.coordinates = self.description.coordinates
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self.damping, self.stiffness = (self.description.by_velocity(name) for name in ("damping", "stiffness"))
        self.rest = self.description.by_velocity("rest")
        self.actuation, self.limits = self.description.actuation, self.description.effort_limits
        self.pin, self.anchored_energy = build(self.description.links, self.description.gravity)
        self.pin.armature = self.description.by_velocity("armature")
        self.data = self.pin.createData()
        self.version = str(pin.__version__)

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        x, u = self._point(x, u)
        acceleration = self._drakes(x, self._acceleration(x, u))
        return euler_step(self.coordinates, self.time_step, x, acceleration)

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        x, u = self._point(x, u)
        native = self._acceleration(x, u)
        acceleration = self._drakes(x, native)
        x_next = euler_step(self.coordinates, self.time_step, x, acceleration)
        by = self._acceleration_derivative(x, u, native)
        jacobian = euler_jacobian(self.coordinates, self.time_step, x, x_next, by)
        nx = self.nq + self.nv
        return StepJacobian(frozen(jacobian[:, :nx]), frozen(jacobian[:, nx:]), "analytic (RNEA derivatives)")

    def energy(self, x: ArrayLike) -> float:
        x = finite_array("x", x, (self.nq + self.nv,))
        q, v = x[: self.nq], x[self.nq :]
        stretch = self._single(q) - self.rest
        springs = float(stretch @ (self.stiffness * stretch)) / 2
        gravity = float(pin.computePotentialEnergy(self.pin, self.data, self._q(q)))
        return float(v @ self.mass_matrix(q) @ v) / 2 + gravity + springs + self.anchored_energy

    def contact_depth(self, x: ArrayLike) -> float:
        finite_array("x", x, (self.nq + self.nv,))
        return 0.0

    def mass_matrix(self, q: ArrayLike) -> Array:
        q = finite_array("q", q, (self.nq,))
        Q = turn(self.coordinates, q)
        return np.asarray(Q.T @ self._mass(self._q(q)) @ Q)

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        q, v = finite_array("q", q, (self.nq,)), finite_array("v", v, (self.nv,))
        Q = turn(self.coordinates, q)
        needed = pin.rnea(self.pin, self.data, self._q(q), Q @ v, -Q @ turning(self.coordinates, v))
        return np.asarray(Q.T @ needed + self.stiffness * (self._single(q) - self.rest))

    def _point(self, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        return finite_array("x", x, (self.nq + self.nv,)), finite_array("u", u, (self.nu,))

    def _acceleration(self, x: Array, u: Array) -> Array:
        """(nv,) of the step, native."""
        q, v = x[: self.nq], x[self.nq :]
        native_q, native_v = self._q(q), turn(self.coordinates, q) @ v
        springs = self.stiffness * (self._single(q) - self.rest)
        force = self.actuation @ np.clip(u, -self.limits, self.limits) - springs
        force -= pin.rnea(self.pin, self.data, native_q, native_v, np.zeros(self.nv))
        return euler_acceleration(self._mass(native_q), self.damping, self.time_step, native_v, force)

    def _drakes(self, x: Array, native: Array) -> Array:
        return np.asarray(turn(self.coordinates, x[: self.nq]).T @ native + turning(self.coordinates, x[self.nq :]))

    def _acceleration_derivative(self, x: Array, u: Array, native: Array) -> Array:
        """(nv, 2 nv + nu) of Drake's acceleration by small motion, by v and by u."""
        q, v = x[: self.nq], x[self.nq :]
        Q, native_q, D = turn(self.coordinates, q), self._q(q), np.diag(self.damping)
        by_q, by_v, _ = pin.computeRNEADerivatives(self.pin, self.data, native_q, Q @ v, native)
        by_v = by_v + D
        velocity_by_motion, out_by_motion, out_by_v = turn_derivatives(self.coordinates, Q, v, native)
        residual = np.hstack(
            [
                by_q @ Q + by_v @ velocity_by_motion + np.diag(self.stiffness),
                by_v @ Q,
                -self.actuation * (np.abs(u) <= self.limits),
            ]
        )
        by = -Q.T @ np.linalg.solve(self._mass(native_q) + self.time_step * D, residual)
        by[:, : self.nv] += out_by_motion
        by[:, self.nv : 2 * self.nv] += out_by_v
        return np.asarray(by)

    def _mass(self, native_q: Array) -> Array:
        upper = np.triu(pin.crba(self.pin, self.data, native_q))
        return np.asarray(upper + np.triu(upper, 1).T)

    def _q(self, q: Array) -> Array:
        return native_positions(self.coordinates, q)

    def _single(self, q: Array) -> Array:
        """(nv,) the positions of hinges and slides."""
        found = np.zeros(self.nv)
        for i, j in self.coordinates.single:
            found[j] = q[i]
        return found

    @property
    def contract(self) -> EngineContract:
        return EngineContract(
            engine=self.name,
            joints=self._joints(),
            native_order=tuple(self.pin.names)[1:],
            state="quaternion x y z w after the position; velocity of a free body linear then angular, in the body",
            inputs=self.description.inputs,
            actuation=tuple(tuple(float(b) for b in row) for row in self.actuation),
            effort_limits=tuple(float(limit) for limit in self.limits),
            time_step=self.time_step,
            integrator=DRAKES_STEP,
            gravity=tuple(float(g) for g in self.pin.gravity.linear),
            contact_law="none",
            contacts=(),
            solver_tolerance=None,
            limit_law="none",
            reset=EACH_CALL,
            derivatives="by tangent vectors of q in the body, and by v in the body",
            reasons={
                "contact law": "Pinocchio's forward dynamics has no contact here",
                "contact pairs": "Pinocchio's forward dynamics has no contact here",
                "limit law": "Pinocchio's forward dynamics has no joint limits",
                "solver tolerance": "nothing is solved iteratively",
            },
        )

    def _joints(self) -> tuple[JointContract, ...]:
        neutral = pin.neutral(self.pin)
        pin.forwardKinematics(self.pin, self.data, neutral)
        found = []
        for i in range(1, self.pin.njoints):
            pose, inertia, link = self.data.oMi[i], self.pin.inertias[i], self.description.moving[i - 1]
            R, j = pose.rotation, self.pin.idx_vs[i]
            carried = (float(inertia.mass), pose.act(inertia.lever), R @ inertia.inertia @ R.T)
            S = np.asarray(self.data.joints[i].S) if self.pin.nvs[i] == 1 else np.zeros((6, 1))
            hinge = bool(np.any(S[3:]))
            kind = "quaternion_floating" if self.pin.nvs[i] == 6 else "revolute" if hinge else "prismatic"
            found.append(
                joint_contract(
                    name=self.pin.names[i], kind=kind, axis=R @ (S[3:] if hinge else S[:3]).ravel(),
                    anchor=pose.translation, carried=[carried], damping=float(self.damping[j]),
                    armature=float(self.pin.armature[j]), stiffness=float(self.stiffness[j]),
                    rest=float(self.rest[j]), lower=link.lower, upper=link.upper,
                )
            )  # fmt: skip
        return tuple(found)
