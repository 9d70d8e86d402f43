"""Read the contract out of Newton's model (`m`: newton.Model, `state`: newton.State)."""

from typing import Any

import numpy as np

from drake_diff.arrays import Array
from drake_diff.engines.description import joint_contract
from drake_diff.engines.engine import JointContract
from drake_diff.engines.euler import rotation
from drake_diff.engines.rigid_links import RigidLinks

KINDS = {0: "prismatic", 1: "revolute", 4: "quaternion_floating"}  # newton.JointType
UNLIMITED = 1e10  # Newton's own
OF_JOINTS = ("damping", "armature", "stiffness", "limit_lower", "limit_upper", "rest_q", "axis")


def numbers(array: Any) -> Array:
    """A warp array in double precision."""
    return np.asarray(array.numpy(), dtype=float)


def centers_of_mass(m: Any, state: Any) -> Array:
    """(bodies, 3) in world."""
    poses = zip(numbers(state.body_q), numbers(m.body_com), strict=True)
    return np.array([pose[:3] + _matrix(pose) @ center for pose, center in poses])


def read_joints(m: Any, state: Any, tree: RigidLinks) -> tuple[JointContract, ...]:
    """In Drake's order, where `state` is at Drake's q = 0."""
    values = {name: numbers(getattr(m, f"joint_{name}")) for name in OF_JOINTS}
    centers, poses, inertias, found = centers_of_mass(m, state), numbers(state.body_q), numbers(m.body_inertia), {}
    for i, link in enumerate(tree.links):
        kind, R = KINDS[int(m.joint_type.numpy()[i])], _matrix(poses[i])
        j, single = int(m.joint_qd_start.numpy()[i]), kind != "quaternion_floating"
        rest = values["rest_q"][int(m.joint_q_start.numpy()[i])]
        lower, upper = values["limit_lower"][j], values["limit_upper"][j]
        found[link.joint.v_start] = joint_contract(
            name=m.joint_label[i],
            kind=kind,
            axis=R @ values["axis"][j] if single else np.zeros(3),
            anchor=poses[i, :3],
            carried=[(float(m.body_mass.numpy()[i]), centers[i], R @ inertias[i] @ R.T)],
            damping=float(values["damping"][j]),
            armature=float(values["armature"][j]),
            stiffness=float(values["stiffness"][j]),
            rest=float(rest) if single else 0.0,
            lower=float(lower) if lower > -UNLIMITED else -np.inf,
            upper=float(upper) if upper < UNLIMITED else np.inf,
        )
    return tuple(found[start] for start in sorted(found))


def _matrix(pose: Array) -> Array:
    """(3, 3) of (p, quaternion x y z w)."""
    return rotation(pose[[6, 3, 4, 5]])
