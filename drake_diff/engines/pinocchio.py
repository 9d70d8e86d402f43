"""Pinocchio, on a model built joint by joint from Drake's plant, with RNEA derivatives in Drake's semi-implicit Euler.

`native_positions` and `turn` of `mechanics.coordinates` define Pinocchio's coordinates of free bodies.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array
from drake_diff.engines.interface import EngineContract, EulerEngine, PlantEngine, floats
from drake_diff.exceptions import MissingDependencyError, ModelError
from drake_diff.mechanics.coordinates import native_positions, turn, turn_derivatives, turning
from drake_diff.mechanics.description import JointContract, Link, joint_contract
from drake_diff.model.model import Model

try:
    import pinocchio as pin
except ImportError as error:
    raise MissingDependencyError("this engine needs Pinocchio: pip install 'drake-diff[engines]'") from error


class PinocchioEngine(PlantEngine, EulerEngine):
    """An engine for trees of hinges, slides and free bodies, without contact and joint limits."""

    name, version, method = "pinocchio", str(pin.__version__), "analytic (RNEA derivatives)"

    def __init__(self, model: Model):
        super().__init__(model)
        self.pin, self.anchored_energy = build(self.description.links, self.description.gravity)
        self.pin.armature = self.armature
        self.data = self.pin.createData()

    def energy(self, x: ArrayLike) -> float:
        _, q, v = self._state(x)
        gravity = float(pin.computePotentialEnergy(self.pin, self.data, native_positions(self.coordinates, q)))
        return float(v @ self.mass_matrix(q) @ v) / 2 + gravity + self._spring_energy(q) + self.anchored_energy

    def mass_matrix(self, q: ArrayLike) -> Array:
        q = self._positions(q)
        Q = turn(self.coordinates, q)
        return np.asarray(Q.T @ self._mass(native_positions(self.coordinates, q)) @ Q)

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        q, v = self._motion(q, v)
        Q, native_q = turn(self.coordinates, q), native_positions(self.coordinates, q)
        needed = pin.rnea(self.pin, self.data, native_q, Q @ v, -Q @ turning(self.coordinates, v))
        return np.asarray(Q.T @ needed + self.stiffness * self._stretch(q))

    def _needed_derivative(self, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return the derivatives of Q' tau(q, Q v, Q (a - w x v)), with Q from `turn`."""
        Q, native_q = turn(self.coordinates, q), native_positions(self.coordinates, q)
        native_v, native_a = Q @ v, Q @ (a - turning(self.coordinates, v))
        needed = pin.rnea(self.pin, self.data, native_q, native_v, native_a)
        by_q, by_v, _ = pin.computeRNEADerivatives(self.pin, self.data, native_q, native_v, native_a)
        velocity_by_motion, a_by_motion, a_by_v = turn_derivatives(self.coordinates, Q, v, native_a)
        _, needed_by_motion, _ = turn_derivatives(self.coordinates, Q, v, needed)
        M = self.mass_matrix(q)
        by_motion = needed_by_motion + Q.T @ (by_q @ Q + by_v @ velocity_by_motion) - M @ a_by_motion
        return by_motion + np.diag(self.stiffness), Q.T @ by_v @ Q - M @ a_by_v

    def _mass(self, native_q: Array) -> Array:
        upper = np.triu(pin.crba(self.pin, self.data, native_q))
        return np.asarray(upper + np.triu(upper, 1).T)

    @property
    def contract(self) -> EngineContract:
        return EngineContract(
            engine=self.name, joints=self._joints(), native_order=tuple(self.pin.names)[1:],
            state="quaternion x y z w after the position; velocity of a free body linear then angular, in the body",
            gravity=floats(self.pin.gravity.linear),
            derivatives="by tangent vectors of q in the body, and by v in the body",
            reasons={
                "contact law": "Pinocchio's forward dynamics has no contact here",
                "contact pairs": "Pinocchio's forward dynamics has no contact here",
                "limit law": "Pinocchio's forward dynamics has no joint limits",
                "solver tolerance": "nothing is solved iteratively",
            },
            **self._plant_fields(),
        )  # fmt: skip

    def _joints(self) -> tuple[JointContract, ...]:
        pin.forwardKinematics(self.pin, self.data, pin.neutral(self.pin))
        contracts = []
        for i in range(1, self.pin.njoints):
            pose, inertia, link = self.data.oMi[i], self.pin.inertias[i], self.description.moving[i - 1]
            R, j = pose.rotation, self.pin.idx_vs[i]
            carried = (float(inertia.mass), pose.act(inertia.lever), R @ inertia.inertia @ R.T)
            S = np.asarray(self.data.joints[i].S) if self.pin.nvs[i] == 1 else np.zeros((6, 1))
            hinge = bool(np.any(S[3:]))
            kind = "quaternion_floating" if self.pin.nvs[i] == 6 else "revolute" if hinge else "prismatic"
            contracts.append(
                joint_contract(
                    name=self.pin.names[i], kind=kind, axis=R @ (S[3:] if hinge else S[:3]).ravel(),
                    anchor=pose.translation, carried=[carried], damping=float(self.damping[j]),
                    armature=float(self.pin.armature[j]), stiffness=float(self.stiffness[j]),
                    rest=float(self.rest[j]), lower=link.lower, upper=link.upper,
                )
            )  # fmt: skip
        return tuple(contracts)


def build(links: tuple[Link, ...], gravity: Array) -> tuple[Any, float]:
    """Build the pin.Model, and compute the potential energy of the bodies that are fixed to the world.

    Raises ModelError if Pinocchio does not accept an inertia, or orders the joints differently.
    """
    model, fixed = pin.Model(), 0.0
    model.gravity.linear = gravity
    carrier: dict[str, tuple[int, Any]] = {"world": (0, pin.SE3.Identity())}
    kinds = {"revolute": pin.JointModelRevoluteUnaligned, "prismatic": pin.JointModelPrismaticUnaligned}
    for link in links:
        parent, pose = carrier[link.parent]
        frame, in_frame = pose * _pose(link.on_parent), _pose(link.on_child.inverse())
        if link.kind == "weld":
            carrier[link.body] = (parent, frame * in_frame)
        else:
            kind = kinds.get(link.kind)
            joint = kind(link.axis / np.linalg.norm(link.axis)) if kind else pin.JointModelFreeFlyer()
            carrier[link.body] = (model.addJoint(parent, joint, frame, link.joint), in_frame)
        number, pose = carrier[link.body]
        try:
            inertia = pin.Inertia(link.mass, link.center_of_mass, link.inertia)
        except RuntimeError as error:
            raise ModelError(f"Pinocchio does not take the inertia of {link.body}: {error}") from error
        model.appendBodyToJoint(number, inertia, pose)
        if number == 0:
            fixed -= link.mass * float(gravity @ pose.act(link.center_of_mass))
    starts = [x.v_start for x in links if x.kind != "weld"]
    if list(model.idx_vs)[1:] != starts:
        raise ModelError(f"Pinocchio's joints: expected them to start at {starts} in v, got {list(model.idx_vs)[1:]}")
    return model, fixed


def _pose(X: RigidTransform) -> Any:
    return pin.SE3(np.array(X.rotation().matrix()), np.array(X.translation()))
