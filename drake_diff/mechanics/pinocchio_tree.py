"""A Pinocchio model built joint by joint from Drake's plant; `body_frame` has its coordinates."""

from typing import Any

import numpy as np
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array
from drake_diff.exceptions import MissingDependencyError, ModelError
from drake_diff.mechanics.description import Link

try:
    import pinocchio as pin
except ImportError as error:
    raise MissingDependencyError(
        "Pinocchio is not installed: pip install 'drake-diff[engines]', or 'drake-diff[fast]' alone"
    ) from error

acceleration_derivatives = pin.computeABADerivatives


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
