"""CasADi expressions that adam-robotics builds from URDF, in Drake's semi-implicit Euler step, with CasADi's Jacobians.

adam supports one tree on one floating base. The plant is therefore split into one tree per free body, with this body as
the base, and one tree on the world. Gravity is set explicitly (adam's default is 9.80665 m/s^2).
"""

from importlib.metadata import version
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array
from drake_diff.engines.formats import carried_by, inertial_urdf
from drake_diff.engines.interface import EngineContract, EulerEngine, PlantEngine, floats, limit
from drake_diff.exceptions import MissingDependencyError, ModelError
from drake_diff.mechanics.casadi_tree import quaternion_rotation
from drake_diff.mechanics.description import Description, JointContract, Link, joint_contract
from drake_diff.model.model import Model

try:
    from adam.casadi.casadi_like import CasadiLike, SpatialMath
    from adam.core import RBDAlgorithms
    from adam.model import Model as AdamModel
    from adam.model.std_factories.std_joint import StdJoint
    from adam.model.std_factories.std_model import URDFModelFactory
except ImportError as error:
    message = f"this engine needs adam-robotics ({error}): pip install 'drake-diff[engines]'"
    raise MissingDependencyError(message) from error

NO_CONTACT = "adam's dynamics have no contact here"


class CasadiEngine(PlantEngine, EulerEngine):
    """An engine for trees of hinges, slides and free bodies, without contact and joint limits."""

    name, version, method = "casadi", version("adam-robotics"), "casadi"

    def __init__(self, model: Model):
        """Build the functions of q, v and a: M and bias, the potential energy, d(M a + bias) / dq and / dv."""
        super().__init__(model)
        self.gravity = self.description.gravity
        bases: list[Link | None] = [x for x in self.description.moving if x.kind == "quaternion_floating"]
        if carried_by(self.description, "world"):
            bases.append(None)
        self.trees = [_Tree(self.description, base) for base in bases]
        q, v, a = (ca.SX.sym(name, n) for name, n in (("q", self.nq), ("v", self.nv), ("a", self.nv)))
        M, bias, potential = ca.SX(self.nv, self.nv), ca.SX(self.nv, 1), ca.SX(0)
        for tree in self.trees:
            potential += tree.potential(q, self.gravity)
            if len(tree.dofs):
                own_M, own_bias = tree.dynamics(q, v, self.gravity)
                M[tree.dofs, tree.dofs], bias[tree.dofs] = own_M, own_bias
        for link in self.description.moving:
            if link.kind != "quaternion_floating":
                stretch = q[link.q_start] - link.rest
                M[link.v_start, link.v_start] += link.armature
                bias[link.v_start] += link.stiffness * stretch
                potential += link.stiffness * stretch**2 / 2
        needed = ca.mtimes(M, a) + bias
        options = {"cse": True}
        self.terms = ca.Function("terms", [q, v], [ca.densify(M), ca.densify(bias)], options)
        self.potential = ca.Function("potential", [q], [potential], options)
        by = [ca.densify(ca.jacobian(needed, z)) for z in (q, v)]
        self.derivatives = ca.Function("derivatives", [q, v, a], by, options)

    def energy(self, x: ArrayLike) -> float:
        _, q, v = self._state(x)
        return float(v @ self.mass_matrix(q) @ v) / 2 + float(self.potential(q))

    def mass_matrix(self, q: ArrayLike) -> Array:
        return np.array(self.terms(self._positions(q), np.zeros(self.nv))[0])

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        return np.array(self.terms(*self._motion(q, v))[1]).ravel()

    def _needed_derivative(self, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        by_q, by_v = (np.array(term) for term in self.derivatives(q, v, a))
        return by_q @ self.coordinates.rate(q), by_v

    @property
    def contract(self) -> EngineContract:
        joints = {joint.name: joint for tree in self.trees for joint in tree.joints()}
        return EngineContract(
            engine=self.name, joints=tuple(joints[link.joint] for link in self.description.moving),
            native_order=tuple(joints),
            state="homogeneous transform; velocity of a free body linear then angular, in world",
            gravity=floats(self.gravity), derivatives="by q and v, adam's expressions differentiated by CasADi",
            reasons={
                "contact law": NO_CONTACT,
                "contact pairs": NO_CONTACT,
                "limit law": "adam's dynamics have no joint limits",
                "solver tolerance": "nothing is solved iteratively",
            },
            **self._plant_fields(),
        )  # fmt: skip


class _Tree:
    """The tree on one base, or on the world if `base` is None, in adam. `dofs` are its indices in Drake's v."""

    def __init__(self, description: Description, base: Link | None):
        if base and base.parent != "world":
            raise ModelError(f"joint {base.joint}: adam's floating base must float in the world, not on {base.parent}")
        self.base, self.root = base, base.body if base else "world"
        self.moving = [x for x in carried_by(description, self.root) if x.kind != "weld"]
        self.moving.sort(key=lambda x: x.v_start)
        self.math = SpatialMath()
        self.model = AdamModel.build(
            _Factory(inertial_urdf(description, self.root), self.math), [x.joint for x in self.moving]
        )
        self.positions = [x.q_start for x in self.moving]
        at_base = [base.v_start + i for i in range(6)] if base else []
        self.dofs = at_base + [x.v_start for x in self.moving]
        self.links = {x.joint: x for x in self.moving}

    def dynamics(self, q: Any, v: Any, gravity: Array) -> tuple[Any, Any]:
        """Return M (n, n) and bias (n,) in the order of `dofs`."""
        n, world, base_v = len(self.moving), ca.SX.eye(6), ca.SX.zeros(6)
        algorithms = RBDAlgorithms(self.model, self.math)  # in the "mixed" representation
        own_q, own_v = q[self.positions], v[self.dofs[len(self.dofs) - n :]]
        if self.base:
            i, W = self.base.v_start, _turn(self.base)
            world = ca.blockcat([[ca.SX(3, 3), W], [W, ca.SX(3, 3)]])  # from Drake's (w, v_o) to adam's (v, w)
            base_v = ca.mtimes(world, v[i : i + 6])
        H = self._base_pose(q)
        M, _ = algorithms.crba(H, own_q if n else ca.SX.zeros(1))  # adam needs at least one position
        bias = algorithms.rnea(H, own_q, base_v, own_v, np.append(gravity, np.zeros(3)))
        into = ca.diagcat(world, ca.SX.eye(n))
        start = 0 if self.base else 6
        M = ca.mtimes([into.T, M.array, into])[start:, start:]
        return M, ca.mtimes(into.T, bias.array)[start:]

    def potential(self, q: Any, gravity: Array) -> Any:
        """Return the potential energy [J], 0 at height 0."""
        total = ca.SX(0)
        for name, H in self._poses(q).items():
            link = self.model.links[name]
            center = ca.mtimes(H, link.homogeneous().array)[:3, 3]
            total -= link.inertial.mass.array * ca.dot(ca.DM(gravity), center)
        return total

    def _base_pose(self, q: Any) -> Any:
        """Return the pose (4, 4) of the root, whose axes are parallel to the world's at q = 0."""
        if self.base is None:
            return ca.SX.eye(4)
        i, X = self.base.q_start, self.base.on_parent
        R = ca.mtimes([_turn(self.base), quaternion_rotation(q[i : i + 4]), _turn(self.base).T])
        p = X.translation() + ca.mtimes(_turn(self.base), q[i + 4 : i + 7])
        return ca.blockcat([[R, p], [ca.SX(1, 3), ca.SX(1)]])

    def _poses(self, q: Any) -> dict[str, Any]:
        """Return the pose (4, 4) of each link."""
        poses = {self.root: self._base_pose(q)}
        for node in list(self.model.tree)[1:]:
            joint = node.parent_arc
            motion = CasadiLike(q[self.links[joint.name].q_start] if joint.name in self.links else ca.SX(0))
            poses[node.name] = ca.mtimes(poses[joint.parent], joint.homogeneous(q=motion).array)
        return poses

    def joints(self) -> tuple[JointContract, ...]:
        """Read the joints from adam."""
        carrier = {self.root: self.base.joint if self.base else None}
        carried: dict[str | None, list[tuple[float, Array, Array]]] = {}
        zero = ca.SX.zeros(1 + max([*self.positions, self.base.q_start + 6 if self.base else 0]))
        if self.base:
            zero[self.base.q_start] = 1.0
        poses = {name: np.array(ca.evalf(H)) for name, H in self._poses(zero).items()}
        for node in self.model.tree:
            if node.parent_arc is not None:
                joint = node.parent_arc
                carrier[node.name] = carrier[joint.parent] if joint.type == "fixed" else joint.name
            inertial = self.model.links[node.name].inertial
            H = poses[node.name] @ np.array(ca.evalf(self.model.links[node.name].homogeneous().array))
            R, inertia = H[:3, :3], np.array(ca.evalf(inertial.inertia.get_matrix().array))
            inertia_of_part = (float(inertial.mass.array), H[:3, 3], R @ inertia @ R.T)
            carried.setdefault(carrier[node.name], []).append(inertia_of_part)
        contracts = []
        if self.base:
            free, name, origin = "quaternion_floating", self.base.joint, np.zeros(3)
            contracts.append(joint_contract(name=name, kind=free, axis=origin, anchor=origin, carried=carried[name]))
        for name in self.model.actuated_joints:
            joint, link = self.model.joints[name], self.links[name]
            H, kind = poses[joint.child], "prismatic" if joint.type == "prismatic" else "revolute"
            limits = (-np.inf, np.inf) if joint.type == "continuous" else (joint.limit.lower, joint.limit.upper)
            numbers = {k: getattr(link, k) for k in ("damping", "armature", "stiffness", "rest")}
            numbers |= {"axis": H[:3, :3] @ np.array(ca.evalf(joint.axis.array)).ravel(), "anchor": H[:3, 3]}
            numbers |= {"lower": limit(limits[0]), "upper": limit(limits[1])}
            contracts.append(joint_contract(name=name, kind=kind, carried=carried[name], **numbers))
        return tuple(contracts)


class _Joint(StdJoint):  # type: ignore[misc]  # adam has no types
    """A joint for adam 0.5.0, whose slides use the parent's axes, parallel in `urdf`, and 12 motion entries for 6."""

    def motion_subspace(self) -> Any:
        if self.type != "prismatic":
            return super().motion_subspace()
        return CasadiLike(ca.vertcat(self.axis.array, ca.SX.zeros(3)))


class _Factory(URDFModelFactory):  # type: ignore[misc]
    def build_joint(self, joint: Any) -> _Joint:
        return _Joint(joint, self.math)


def _turn(base: Link) -> Any:
    """Return the rotation matrix (3, 3) of the frame in which a free body's coordinates are given."""
    return ca.SX(ca.DM(base.on_parent.rotation().matrix()))
