"""Newton's SolverFeatherstone on the CPU, in single precision, on a model built joint by joint from Drake's plant.

Its step is semi-implicit Euler like Drake's, except that joint damping is explicit, M a = ... - D v, a free body moves
with the velocity of its centre of mass, and its quaternion is normalized after the step. Isaac Lab's SolverMuJoCo is
MuJoCo's step (engine mujoco of this package) by mujoco-warp, which is not included in Newton.
"""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform

from drake_diff._base.arrays import Array, frozen
from drake_diff.engines.interface import (
    DRAKES_STEP,
    UNLIMITED,
    EngineContract,
    RigidEngine,
    StepJacobian,
    floats,
    geometry_contracts,
    limit,
    shape_of,
    silent,
)
from drake_diff.exceptions import MissingDependencyError, NotOfferedError
from drake_diff.mechanics.coordinates import Centers, rotation, unit
from drake_diff.mechanics.description import Geometry, JointContract, RigidLink, RigidLinks, joint_contract
from drake_diff.model.model import Model

try:
    import warp as wp

    wp.config.log_level = wp.LOG_ERROR  # suppresses messages on kernels
    import newton
except ImportError as error:
    raise MissingDependencyError("this engine needs Newton: pip install 'drake-diff[forward]'") from error

# Replaces 0 in friction and stiffness of a contact, which Newton takes for unset. The effect is negligible.
NONE = 1e-30
KINDS = {0: "prismatic", 1: "revolute", 4: "quaternion_floating"}  # newton.JointType
OF_JOINTS = ("damping", "armature", "stiffness", "limit_lower", "limit_upper", "rest_q", "axis")


class NewtonEngine(RigidEngine):
    """An engine for hinges, slides and free bodies, with spheres, boxes, cylinders, capsules and half spaces."""

    name, version = "newton (SolverFeatherstone)", str(newton.__version__)

    def __init__(self, model: Model):
        super().__init__(model)
        with silent():
            self.newton, self.shapes = _build(self.tree, self.description.gravity)
        self.solver = newton.solvers.SolverFeatherstone(self.newton, update_mass_matrix_interval=1)
        # Newton's indices in Drake's order, and Newton's centres of mass.
        q_starts, v_starts = self.newton.joint_q_start.numpy(), self.newton.joint_qd_start.numpy()
        self.positions, self.dofs = np.zeros(self.nq, dtype=int), np.zeros(self.nv, dtype=int)
        of_free = {}
        for i, link in enumerate(self.tree.links):
            q, v, at_q, at_v = link.joint.q_start, link.joint.v_start, int(q_starts[i]), int(v_starts[i])
            if link.free:
                self.positions[q : q + 7] = at_q + np.array([6, 3, 4, 5, 0, 1, 2])
                self.dofs[v : v + 6] = at_v + np.array([3, 4, 5, 0, 1, 2])
                of_free[v] = _numbers(self.newton.body_com)[i]
            else:
                self.positions[q], self.dofs[v] = at_q, at_v
        self.centers = Centers(self.coordinates, tuple(of_free[v] for _, v in self.coordinates.free))
        self.laws = {tuple(sorted(self.shapes[name] for name in p.names)): p for p in self.tree.pairs}
        pairs = wp.array(list(self.laws), dtype=wp.vec2i, device="cpu") if self.laws else None
        options = {"broad_phase": "explicit", "shape_pairs_filtered": pairs, "requires_grad": False}
        self.pipeline: Any = newton.CollisionPipeline(self.newton, **options) if self.laws else None

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        before, control = self._given(*self._point(x, u))
        after = self.newton.state(requires_grad=True)
        contacts = self._contacts(before)
        self.solver.step(before, after, control, contacts, self.time_step)
        contact_count, room = 0 if contacts is None else int(contacts.rigid_contact_count.numpy()[0]), _count(contacts)
        self.status = "ok" if contact_count <= room else f"{contact_count} contacts, but Newton's buffer holds {room}"
        return self._drakes(after, x, u)

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        """Differentiate a step without contact, as Newton's tape keeps contact points fixed in the bodies.

        In contact, raise NotOfferedError. The tape would make a sliding ball spin by 15 rad/s per metre in one step.
        """
        x, u = self._point(x, u)
        if self.contact_depth(x) > 0:
            raise NotOfferedError("Newton's tape does not differentiate contact, and bodies touch in this state")
        before, control = self._given(x, u)
        after, tape = self.newton.state(requires_grad=True), wp.Tape()
        with tape:
            self.solver.step(before, after, control, None, self.time_step)
        x_next, rows = self._drakes(after, x, u), []
        for result in (after.joint_q, after.joint_qd):
            for row in np.eye(result.shape[0], dtype=np.float32):
                tape.backward(grads={result: wp.array(row, dtype=wp.float32, device="cpu")})
                given = (before.joint_q, before.joint_qd, control.joint_f)
                rows.append(np.concatenate([array.grad.numpy() for array in given]))
                tape.zero()
        here = np.concatenate([self.positions, self.nq + self.dofs])
        by = np.array(rows, dtype=float)[here]
        out = self.centers.inverse_derivative(x_next)
        A = out @ by[:, here] @ self.centers.derivative(x)
        B = out @ by[:, self.nq + self.nv + self.dofs] @ self._effort_by_input(u)
        return StepJacobian(frozen(A), frozen(B), "warp tape")

    def energy(self, x: ArrayLike) -> float:
        _, q, v = self._state(x)
        state = self._state_at_rest(q)
        fallen = float(_numbers(self.newton.body_mass) @ _centers_of_mass(self.newton, state) @ self._gravity())
        stretch, stiffness = self._native_springs(state)
        springs = float(stretch @ (stiffness * stretch)) / 2
        return float(v @ self.mass_matrix(q) @ v) / 2 - fallen + springs + self.tree.anchored_energy

    def contact_depth(self, x: ArrayLike) -> float:
        state = self._state_at_rest(self._state(x)[1])
        contacts = self._contacts(state)
        if contacts is None:
            return 0.0
        distance = wp.zeros(contacts.rigid_contact_max, dtype=wp.float32, device="cpu")
        newton.eval_rigid_contact_kinematics(self.newton, state, contacts, out_distance=distance)
        return max([0.0, *(-_numbers(distance)[: _count(contacts)])])

    def mass_matrix(self, q: ArrayLike) -> Array:
        q = self._positions(q)
        Q = self.centers.turn(q)
        return np.asarray(Q.T @ self._mass(self._state_at_rest(q)) @ Q)

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        q, v = self._motion(q, v)
        state, Q = self._given(np.concatenate([q, v]), np.zeros(self.nu))[0], self.centers.turn(q)
        gravity, velocity = (wp.zeros(self.nv, dtype=wp.float32, device="cpu") for _ in range(2))
        newton.eval_inverse_dynamics_passive(self.newton, state, gravity_force=gravity, coriolis_force=velocity)
        stretch, stiffness = self._native_springs(state)
        needed = (_numbers(gravity) + _numbers(velocity))[self.dofs] + stiffness * stretch
        return np.asarray(Q.T @ (needed + self._mass(state) @ self.centers.turning(q, v)))

    @property
    def contract(self) -> EngineContract:
        damper, slope = (_listed(getattr(self.newton, f"shape_material_{name}")) for name in ("kd", "kf"))
        springs, dampers = (_listed(getattr(self.newton, f"joint_limit_{name}")) for name in ("ke", "kd"))
        law = f"explicit spring, damper of {damper} N s/m while closing, friction of {slope} N s/m up to mu N"
        how = ["joint damping explicit"] if np.any(_numbers(self.newton.joint_damping)) else []
        if self.coordinates.free:
            how.append("free bodies by v' of the centre of mass, quaternions by their rate, then of norm 1")
        return EngineContract(
            **self._plant_fields(), engine=self.name,
            joints=_read_joints(self.newton, self._state_at_rest(self._zero()[: self.nq]), self.tree),
            native_order=tuple(self.newton.joint_label),
            state="position of the body's origin, quaternion x y z w after it; velocity of a free body linear of its "
            "centre of mass then angular, in world",
            integrator=", ".join(["semi-implicit Euler", *how]) if how else DRAKES_STEP,
            gravity=floats(self._gravity()), contact_law=law if self.pipeline else "none",
            geometries=geometry_contracts(self.description),
            contacts=tuple(replace(pair, dissipation=None, relaxation_time=None) for pair in self.tree.pairs),
            limit_law=f"explicit springs of {springs} and dampers of {dampers} (SI) beyond the limit",
            derivatives="by every number of Newton's state, warp's tape backwards", precision="float32",
            reasons={
                "integrator": "Newton's joint damping is explicit, and its free bodies move by their centres of mass",
                "contact law": "Newton's SolverFeatherstone has explicit springs, dampers and viscous friction up to "
                "Coulomb's, each with its own numbers",
                "contact pairs": f"contact pairs are missing: {list(self.tree.left_out)}" if self.tree.left_out else "",
                "dissipation": "Newton's contacts have their own dampers",
                "limit law": "Newton's limits have their own stiffness and damping",
                "solver tolerance": "nothing is solved iteratively",
            },
        )  # fmt: skip

    def _gravity(self) -> Array:
        return np.asarray(_numbers(self.newton.gravity)[0])

    def _state_at_rest(self, q: Array) -> Any:
        return self._given(np.concatenate([q, np.zeros(self.nv)]), np.zeros(self.nu))[0]

    def _given(self, x: Array, u: Array) -> tuple[Any, Any]:
        """Return a new state of Newton, with the poses of its bodies, and a new control."""
        state, control = self.newton.state(requires_grad=True), self.newton.control(requires_grad=True)
        q = unit(self.coordinates, x[: self.nq])
        native_q, native_v, force = np.zeros(self.nq), np.zeros(self.nv), np.zeros(self.nv)
        native_q[self.positions], native_v[self.dofs] = q, self.centers.turn(q) @ x[self.nq :]
        force[self.dofs] = self._effort(u)
        with np.errstate(over="ignore"):  # overflow of float32 gives inf, and SimulationError after the step
            for array, values in ((state.joint_q, native_q), (state.joint_qd, native_v), (control.joint_f, force)):
                array.assign(values.astype(np.float32))
        newton.eval_fk(self.newton, state.joint_q, state.joint_qd, state)
        return state, control

    def _drakes(self, after: Any, x: ArrayLike, u: ArrayLike) -> Array:
        q, v = _numbers(after.joint_q)[self.positions], _numbers(after.joint_qd)[self.dofs]
        return self._drake_state("Newton", q, v, x, u)

    def _mass(self, state: Any) -> Array:
        """Return the mass matrix (nv, nv) for Newton's velocities in Drake's order."""
        blocks, M = _numbers(newton.eval_mass_matrix(self.newton, state)), np.zeros((self.nv, self.nv))
        starts = self.newton.joint_qd_start.numpy()
        for block, tree in zip(blocks, self.tree.trees, strict=True):
            a, b = int(starts[tree.start]), int(starts[tree.stop])
            M[a:b, a:b] = block[: b - a, : b - a]
        return M[np.ix_(self.dofs, self.dofs)]

    def _native_springs(self, state: Any) -> tuple[Array, Array]:
        """Return the deflection (nv,) of the springs and their stiffness, 0 for free bodies."""
        stretch, native = np.zeros(self.nv), _numbers(state.joint_q) - _numbers(self.newton.joint_rest_q)
        for i, j in self.coordinates.single:
            stretch[j] = native[self.positions[i]]
        return stretch, _numbers(self.newton.joint_stiffness)[self.dofs]

    def _contacts(self, state: Any) -> Any:
        """Compute the contacts, with the stiffness and friction of Drake's pairs where defined, else Newton's."""
        if self.pipeline is None:
            return None
        contacts = self.pipeline.contacts()
        self.pipeline.collide(state, contacts)
        stiffness, friction = np.zeros((2, contacts.rigid_contact_max), dtype=np.float32)
        sides = [array.numpy() for array in (contacts.rigid_contact_shape0, contacts.rigid_contact_shape1)]
        for i in range(_count(contacts)):
            pair = self.laws[tuple(sorted(int(side[i]) for side in sides))]
            stiffness[i] = 0.0 if pair.stiffness is None else max(pair.stiffness, NONE)
            friction[i] = 1.0 if pair.friction is None else max(pair.friction, NONE)  # factor on Newton's friction of 1
        for name, values in (("stiffness", stiffness), ("friction", friction), ("damping", np.zeros_like(stiffness))):
            setattr(contacts, f"rigid_contact_{name}", wp.array(values, dtype=wp.float32, device="cpu"))
        return contacts


def _build(tree: RigidLinks, gravity: Array) -> tuple[Any, dict[str, int]]:
    """Build Newton's model, and return it with the number of each geometry's shape."""
    builder = newton.ModelBuilder(gravity=tuple(float(g) for g in gravity))
    for members in tree.trees:
        joints = []
        for link in (tree.links[i] for i in members):
            body = {"mass": link.mass, "com": floats(link.center_of_mass), "inertia": wp.mat33(*floats(link.inertia))}
            number = builder.add_link(**body, lock_inertia=True, label=link.joint.body)
            joints.append(_add_joint(builder, link, int(number)))
        builder.add_articulation(joints)
    shapes = {geometry.name: _add_shape(builder, number, geometry) for number, geometry in tree.geometries}
    return builder.finalize(device="cpu", requires_grad=True, skip_validation_inertia=True), shapes


def _add_joint(builder: Any, link: RigidLink, number: int) -> int:
    joint = link.joint
    if link.free:
        return int(builder.add_joint_free(number, label=joint.joint))
    add = builder.add_joint_revolute if joint.kind == "revolute" else builder.add_joint_prismatic
    lower, upper = (float(side) for side in np.clip([joint.lower, joint.upper], -UNLIMITED, UNLIMITED))
    return int(
        add(
            link.parent, number, parent_xform=_pose(link.on_parent), axis=floats(link.axis), damping=joint.damping,
            armature=joint.armature, stiffness=joint.stiffness, rest_q=joint.rest, limit_lower=lower,
            limit_upper=upper, label=joint.joint,
        )
    )  # fmt: skip


def _add_shape(builder: Any, number: int, geometry: Geometry) -> int:
    kind, sizes = shape_of(geometry)
    frame = {"body": number, "xform": _pose(geometry.pose), "label": geometry.name}
    if kind == "HalfSpace":
        return int(builder.add_shape_plane(width=0.0, length=0.0, **frame))
    if kind == "Sphere":
        return int(builder.add_shape_sphere(radius=sizes["radius"][0], **frame))
    if kind == "Box":
        halves = {name: side / 2 for name, side in zip(("hx", "hy", "hz"), sizes["size"], strict=True)}
        return int(builder.add_shape_box(**halves, **frame))
    add = builder.add_shape_cylinder if kind == "Cylinder" else builder.add_shape_capsule
    return int(add(radius=sizes["radius"][0], half_height=sizes["length"][0] / 2, **frame))


def _numbers(array: Any) -> Array:
    """Convert a warp array to double precision."""
    return np.asarray(array.numpy(), dtype=float)


def _centers_of_mass(m: Any, state: Any) -> Array:
    """Return the centres of mass (bodies, 3) in world."""
    poses = zip(_numbers(state.body_q), _numbers(m.body_com), strict=True)
    return np.array([pose[:3] + _matrix(pose) @ center for pose, center in poses])


def _read_joints(m: Any, state: Any, tree: RigidLinks) -> tuple[JointContract, ...]:
    """Read the joints in Drake's order, with `state` at Drake's q = 0."""
    values = {name: _numbers(getattr(m, f"joint_{name}")) for name in OF_JOINTS}
    centers, poses, inertias = _centers_of_mass(m, state), _numbers(state.body_q), _numbers(m.body_inertia)
    contracts = {}
    for i, link in enumerate(tree.links):
        kind, R = KINDS[int(m.joint_type.numpy()[i])], _matrix(poses[i])
        j, single = int(m.joint_qd_start.numpy()[i]), kind != "quaternion_floating"
        rest = values["rest_q"][int(m.joint_q_start.numpy()[i])]
        contracts[link.joint.v_start] = joint_contract(
            name=m.joint_label[i], kind=kind, axis=R @ values["axis"][j] if single else np.zeros(3),
            anchor=poses[i, :3], carried=[(float(m.body_mass.numpy()[i]), centers[i], R @ inertias[i] @ R.T)],
            damping=float(values["damping"][j]), armature=float(values["armature"][j]),
            stiffness=float(values["stiffness"][j]), rest=float(rest) if single else 0.0,
            lower=limit(values["limit_lower"][j]), upper=limit(values["limit_upper"][j]),
        )  # fmt: skip
    return tuple(contracts[start] for start in sorted(contracts))


def _matrix(pose: Array) -> Array:
    """Return the rotation matrix (3, 3) of the pose (p, quaternion x y z w)."""
    return rotation(pose[[6, 3, 4, 5]])


def _listed(array: Any) -> str:
    """Format the distinct values of an array."""
    return " or ".join(f"{value:g}" for value in sorted(set(_numbers(array))))


def _pose(X: RigidTransform) -> Any:
    w, x, y, z = X.rotation().ToQuaternion().wxyz()
    return wp.transform(floats(X.translation()), wp.quat(x, y, z, w))


def _count(contacts: Any) -> int:
    return 0 if contacts is None else min(int(contacts.rigid_contact_count.numpy()[0]), int(contacts.rigid_contact_max))
