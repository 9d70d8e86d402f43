"""A Pinocchio model built joint by joint from Drake's plant; `body_frame` has its coordinates."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array, Indices
from drake_diff.exceptions import MissingDependencyError, ModelError
from drake_diff.mechanics.description import Link

try:
    import pinocchio as pin
except ImportError as error:
    raise MissingDependencyError(
        "Pinocchio is not installed: pip install 'drake-diff[engines]', or 'drake-diff[fast]' alone"
    ) from error


BEND_STEP = (
    3e-8  # [rad or m], of a position or of 1: first derivatives are known to 1e-15, so that 1e-6 of theirs is left
)


@dataclass(frozen=True, eq=False)
class PinocchioDynamics:
    """Accelerations of a Pinocchio model, whose armature is part of its inertia, in its own coordinates."""

    model: Any  # pin.Model
    data: Any
    derivatives: Any  # pin.computeABADerivatives
    outputs: list[memoryview]  # where in data it leaves da/dq, da/dv, da/dforce and a: four joined are one copy
    views: tuple[Array, Array, Array, Array]  # the same as arrays, overwritten by each call
    joint_of: Indices  # (nv,) of each degree of freedom, less 1

    @classmethod
    def of(cls, links: tuple[Link, ...], gravity: Array, armature: Array) -> "PinocchioDynamics":
        """Of the links, with an armature (nv,); raises ModelError as `build`."""
        model, _ = build(links, gravity)
        data = model.createData()
        model.armature = armature
        views = data.ddq_dq, data.ddq_dv, data.Minv, data.ddq
        outputs = [memoryview(x).cast("B") for x in views]
        joint_of = np.repeat(np.arange(model.njoints - 1), list(model.nvs)[1:])
        return cls(model, data, pin.computeABADerivatives, outputs, views, joint_of)

    @property
    def armature(self) -> Array:
        """(nv,)."""
        return np.array(self.model.armature)

    def accelerate(self, q: Array, v: Array, force: Array) -> tuple[Array, Array, Array, Array]:
        """da/dq, da/dv, da/dforce (each (N, nv, nv)) and a (N, nv) under generalized forces (N, nv)."""
        model, data, derivatives, outputs = self.model, self.data, self.derivatives, self.outputs
        rows = []
        for q_k, v_k, force_k in zip(q, v, force, strict=True):
            derivatives(model, data, q_k, v_k, force_k)
            rows.append(b"".join(outputs))
        n = v.shape[1]
        found = np.frombuffer(b"".join(rows)).reshape(len(q), 3 * n * n + n)
        by_q, by_v, inverse = (found[:, k * n * n : (k + 1) * n * n].reshape(len(q), n, n) for k in range(3))
        return by_q, by_v, inverse, found[:, 3 * n * n :]

    def accelerate_one(self, q: Array, v: Array, force: Array) -> tuple[Array, Array, Array, Array]:
        """As `accelerate`, of one state (nq,) and (nv,); until the next call."""
        self.derivatives(self.model, self.data, q, v, force)
        return self.views

    def bend(self, q: Array, v: Array, a: Array, along: Array) -> tuple[Array, Array, Array, Array]:
        """Second derivatives of along' tau (N, n each), tau being inverse dynamics: by q q, v q, a q and v v.

        Each (N, n, n); of hinges and slides alone. Those by q are differences of Pinocchio's exact first derivatives.
        By v v none is needed: with the Christoffel symbols it follows from how the mass matrix changes.
        """
        model, data, derivatives = self.model, self.data, pin.computeRNEADerivatives
        outputs = [memoryview(x).cast("B") for x in (data.dtau_dq, data.dtau_dv, data.M.T)]
        (count, n), rows = v.shape, []
        steps = BEND_STEP * np.maximum(1.0, np.abs(q))
        moved = q[:, None] + np.concatenate([np.zeros((count, 1, n)), steps[:, :, None] * np.eye(n)], axis=1)
        size = BEND_STEP / np.maximum(np.max(np.abs(along), axis=1), np.finfo(float).tiny)
        for points, last, v_k, a_k in zip(moved, q + size[:, None] * along, v, a, strict=True):
            for point in (*points, last):
                derivatives(model, data, point, v_k, a_k)
                rows.append(b"".join(outputs))
        found = np.frombuffer(b"".join(rows)).reshape(count, n + 2, 3, n, n)
        rates = np.einsum("ki,kjbim->kjbm", along, found[:, : n + 1])
        slopes = (rates[:, 1:] - rates[:, :1]) / (moved[:, 1:] - moved[:, :1]).diagonal(axis1=1, axis2=2)[
            ..., None, None
        ]
        by_qq, by_vq, by_aq = (slopes[:, :, i].swapaxes(1, 2) for i in range(3))
        twice = (found[:, -1, 2] - found[:, 0, 2]) / size[:, None, None]
        return by_qq, by_vq, by_aq, by_aq + by_aq.swapaxes(1, 2) - twice

    def motions(self, q: Array, v: Array, force: Array) -> tuple[Array, Array, Array]:
        """(N, nv, 6) the motion [linear; angular] of each degree of freedom in world, about its origin, at unit speed.

        And (N, nv, 6, 6) the spatial inertia of what it carries, and a (N, nv).
        """
        data, joints = self.data, range(1, self.model.njoints)
        motion = memoryview(data.J.T).cast("B")
        motions, inertias, accelerations = [], [], []
        for q_k, v_k, force_k in zip(q, v, force, strict=True):
            self.derivatives(self.model, data, q_k, v_k, force_k)
            motions.append(motion.tobytes())
            carried = data.oYcrb
            inertias.append([carried[j].matrix() for j in joints])
            accelerations.append(np.array(data.ddq))
        S = np.frombuffer(b"".join(motions)).reshape(*v.shape, 6)
        return S, np.array(inertias)[:, self.joint_of], np.array(accelerations)


def build(links: tuple[Link, ...], gravity: Array) -> tuple[Any, float]:
    """The pin.Model, and the potential energy of what is fixed to the world.

    Raises ModelError where Pinocchio takes no such inertia, or orders the joints otherwise.
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
