"""PhysX by SAPIEN on the CPU, in single precision, on articulations built link by link from Drake's plant.

With PhysX's PGS solver, the step of hinges and slides equals Drake's. SAPIEN's default solver TGS damps in sub-steps.
The contract lists the differences for free bodies. PhysX has friction per shape, and a pair has the mean of two shapes.
"""

import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RotationMatrix

from drake_diff._base.arrays import Array
from drake_diff.engines.interface import (
    DRAKES_STEP,
    EngineContract,
    RigidEngine,
    floats,
    geometry_contracts,
    not_offered,
    principal,
    shape_of,
)
from drake_diff.exceptions import MissingDependencyError, ModelError
from drake_diff.mechanics.coordinates import Centers, rotation, unit
from drake_diff.mechanics.description import Geometry, JointContract, PairContract, RigidLink, joint_contract, split
from drake_diff.model.model import Model

try:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Failed to find system libvulkan")  # rendering is not used
        import sapien
        from sapien import physx
except ImportError as error:
    raise MissingDependencyError("this engine needs SAPIEN: pip install 'drake-diff[forward]'") from error

KINDS = {"revolute_unwrapped": "revolute", "prismatic": "prismatic", "undefined": "quaternion_floating"}
GROUPS = 32  # number of bits of a collision group
UNLIMITED = 1e6  # [rad/s or m/s] instead of PhysX's 100 and 50
# Mass [kg] and moment of inertia [kg m^2] of massless links and point masses, as PhysX takes 0 for infinite.
SMALLEST = 1e-9
ITERATIONS = 100  # of the solver, instead of 10, because the damping of one joint affects the others
NO_TERMS = "PhysX gives neither mass matrix nor inverse dynamics; SAPIEN's are those of Pinocchio on another model"


class World(NamedTuple):
    """A scene with its links, in the order of the rigid links, and the articulation of each tree."""

    system: Any
    scene: Any
    links: list[Any]
    trees: list[Any]


class SapienEngine(RigidEngine):
    """An engine for hinges, slides and free bodies, with spheres, boxes, cylinders, capsules and half spaces.

    `status` is "ok" after every step with a finite result, as PhysX does not report the convergence of its solver.
    """

    name, version = "sapien (PhysX, PGS)", str(sapien.__version__)

    def __init__(self, model: Model):
        super().__init__(model)
        owner = {geometry.name: number for number, geometry in self.tree.geometries}
        sides = {pair.names: sorted(owner[name] for name in pair.names) for pair in self.tree.pairs}
        # A link and its parent never collide in PhysX.
        self.adjacent = [names for names, (a, b) in sides.items() if a >= 0 and self.tree.links[b].parent == a]
        self.pairs = tuple(pair for pair in self.tree.pairs if pair.names not in self.adjacent)
        self.groups = groups_by_shape(self.pairs)
        # Friction of each shape, fitted to the friction of the pairs. The contract reports the result.
        given = [(pair.names, 2 * pair.friction) for pair in self.pairs if pair.friction is not None]
        self.friction = {name: max(value, 0.0) for name, value in split(given).items()}
        centers = {x.joint.v_start: x.center_of_mass for x in self.tree.links if x.free}
        self.centers = Centers(self.coordinates, tuple(centers[v] for _, v in self.coordinates.free))

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        x, u = self._point(x, u)
        world = self._world(x, self._effort(u) - self.stiffness * self._stretch(x[: self.nq]))
        world.scene.step()
        q, v = np.zeros(self.nq), np.zeros(self.nv)
        for tree, members in zip(world.trees, self.tree.trees, strict=True):
            rigid = {self.tree.links[i].joint.joint: self.tree.links[i].joint for i in members}
            for joint, position, speed in zip(tree.active_joints, tree.qpos, tree.qvel, strict=True):
                q[rigid[joint.name].q_start], v[rigid[joint.name].v_start] = position, speed
            root = self.tree.links[members.start]
            if root.free:
                i, j = root.joint.q_start, root.joint.v_start
                q[i : i + 4], q[i + 4 : i + 7] = tree.root_pose.q, tree.root_pose.p
                v[j + 3 : j + 6], v[j : j + 3] = tree.root_linear_velocity, tree.root_angular_velocity
        return self._drake_state("PhysX", q, v, x, u)

    differentiate_step = not_offered("PhysX has no derivatives of its step")
    mass_matrix = bias = not_offered(NO_TERMS)

    def energy(self, x: ArrayLike) -> float:
        x, q, v = self._state(x)
        world = self._world(x, np.zeros(self.nv))
        gravity = np.array(world.system.config.gravity, dtype=float)
        total = self._spring_energy(q) + self.tree.anchored_energy
        for link, rigid in zip(world.links, self.tree.links, strict=True):
            mass, center, inertia, _ = _read_part(link)
            w, v_center = np.array(link.angular_velocity, dtype=float), np.array(link.linear_velocity, dtype=float)
            total += mass * (v_center @ v_center / 2 - gravity @ center) + float(w @ inertia @ w) / 2
            if not rigid.free:
                total += float(link.joint.armature[0]) * float(v[rigid.joint.v_start]) ** 2 / 2
        return float(total)

    def contact_depth(self, x: ArrayLike) -> float:
        """Return the penetration depth. PhysX computes contacts in a step, from the poses before the step."""
        world = self._world(self._state(x)[0], np.zeros(self.nv))
        world.scene.step()
        points = [point for contact in world.system.get_contacts() for point in contact.points]
        return max([0.0, *(-float(point.separation) for point in points)])

    @property
    def contract(self) -> EngineContract:
        left_out = [*self.tree.left_out, *self.adjacent]
        world = self._world(self._zero(), np.zeros(self.nv))
        joints = {x.joint.v_start: _read_joint(link, x) for link, x in zip(world.links, self.tree.links, strict=True)}
        names = [joint.name for tree in world.trees for joint in tree.joints if joint.type in KINDS]
        contacts = []
        for pair in self.pairs:
            a, b = (self._material(name).dynamic_friction for name in pair.names)
            contacts.append(PairContract(pair.names, float(a + b) / 2, None))
        euler = (
            "semi-implicit Euler, joint damping implicit, free bodies by v' of the centre of mass, quaternions by the "
            "exponential of h w', w' scaled to the angular momentum before"
        )
        return EngineContract(
            **{**self._plant_fields(), "time_step": float(world.system.timestep)}, engine=self.name,
            joints=tuple(joints[v] for v in sorted(joints)), native_order=tuple(names),
            state="position of the body's origin, quaternion w x y z after it; velocity of a free body linear of its "
            "centre of mass then angular, in world",
            integrator=euler if self.coordinates.free else DRAKES_STEP, gravity=floats(world.system.config.gravity),
            contact_law="rigid, Coulomb's friction by patches" if self.pairs else "none",
            geometries=geometry_contracts(self.description), contacts=tuple(contacts),
            limit_law="rigid", precision="float32",
            reasons={
                "integrator": "PhysX moves free bodies by their centres of mass and turns them by the exponential",
                "contact law": "PhysX's contacts are rigid",
                "contact pairs": f"contact pairs are missing: {left_out}" if left_out else "",
                "stiffness": "PhysX's contacts are rigid: they have no stiffness",
                "dissipation": "PhysX's contacts are rigid: they have no damping",
                "limit law": "PhysX's limits are rigid",
                "solver tolerance": "PhysX runs a fixed number of iterations",
            },
        )  # fmt: skip

    def _world(self, x: Array, force: Array) -> World:
        """Create a scene at `x` (nx,) with `force` (nv,) on its joints, as PhysX keeps contacts between steps."""
        # PhysX's configuration is global. It is read when a system and a link are created.
        of_scene, of_body = physx.get_scene_config(), physx.get_body_config()
        gravity = [float(g) for g in self.description.gravity]
        try:
            physx.set_scene_config(gravity=gravity, enable_tgs=False, enable_enhanced_determinism=True)
            physx.set_body_config(solver_position_iterations=ITERATIONS, sleep_threshold=0.0)
            system = physx.PhysxCpuSystem()
        finally:
            physx.set_scene_config(of_scene)
            physx.set_body_config(of_body)
        scene = sapien.Scene([system])
        system.timestep = self.time_step
        links = self._links(scene)
        trees = [links[tree.start].articulation for tree in self.tree.trees]
        for geometry in (g for number, g in self.tree.geometries if number < 0 and g.name in self.groups):
            body = physx.PhysxRigidStaticComponent()
            body.attach(self._shape(geometry))
            entity = sapien.Entity()
            entity.add_component(body)
            scene.add_entity(entity)
        q = unit(self.coordinates, x[: self.nq])
        v = self.centers.turn(q) @ x[self.nq :]
        for tree, members in zip(trees, self.tree.trees, strict=True):
            self._set_tree_state(tree, members, q, v, force)
        return World(system, scene, links, trees)

    def _links(self, scene: Any) -> list[Any]:
        links: list[Any] = []
        for i, rigid in enumerate(self.tree.links):
            parent = links[rigid.parent] if rigid.parent >= 0 else None if rigid.free else _fixed(scene)
            link = physx.PhysxArticulationLinkComponent(parent)
            entity = sapien.Entity()
            entity.add_component(link)
            moments, turn = principal(rigid.inertia)
            link.mass = max(rigid.mass, SMALLEST)
            link.cmass_local_pose = sapien.Pose(rigid.center_of_mass, turn)
            link.inertia = np.maximum(moments, SMALLEST)
            link.linear_damping = link.angular_damping = 0.0  # removes PhysX's default damping and limits
            link.max_linear_velocity = link.max_angular_velocity = UNLIMITED
            for geometry in (g for number, g in self.tree.geometries if number == i and g.name in self.groups):
                link.attach(self._shape(geometry))
            joint, fields = link.joint, rigid.joint
            joint.name = link.name = fields.joint
            if not rigid.free:
                along = RigidTransform(RotationMatrix.MakeFromOneVector(rigid.axis, 0), np.zeros(3))  # PhysX's axis: x
                joint.type = "revolute_unwrapped" if fields.kind == "revolute" else "prismatic"
                joint.pose_in_parent, joint.pose_in_child = _pose(rigid.on_parent @ along), _pose(along)
                joint.limit = np.array([[fields.lower, fields.upper]], dtype=np.float32)
                joint.friction, joint.armature = 0.0, np.array([fields.armature], dtype=np.float32)
                joint.max_velocity = UNLIMITED
                joint.set_drive_properties(0.0, fields.damping)
            links.append(link)
            scene.add_entity(entity)
        return links

    def _shape(self, geometry: Geometry) -> Any:
        (kind, sizes), X, material = shape_of(geometry), geometry.pose, self._material(geometry.name)
        if kind == "Sphere":
            shape = physx.PhysxCollisionShapeSphere(sizes["radius"][0], material)
        elif kind == "Box":
            shape = physx.PhysxCollisionShapeBox([side / 2 for side in sizes["size"]], material)
        else:  # PhysX's axis is x, Drake's z
            X = X @ RigidTransform(RotationMatrix.MakeYRotation(-np.pi / 2), np.zeros(3))
            if kind == "HalfSpace":
                shape = physx.PhysxCollisionShapePlane(material)
            else:
                make = physx.PhysxCollisionShapeCylinder if kind == "Cylinder" else physx.PhysxCollisionShapeCapsule
                shape = make(sizes["radius"][0], sizes["length"][0] / 2, material)
        shape.local_pose = _pose(X)
        shape.set_collision_groups([*self.groups[geometry.name], 0, 0])
        return shape

    def _material(self, name: str) -> Any:
        """Return the material of this geometry, SAPIEN's default if its friction is not defined."""
        if name not in self.friction:
            return physx.get_default_material()
        return physx.PhysxMaterial(self.friction[name], self.friction[name], 0.0)

    def _set_tree_state(self, tree: Any, members: range, q: Array, v: Array, force: Array) -> None:
        tree.set_solver_position_iterations(ITERATIONS)
        tree.sleep_threshold = 0.0
        rigid = {self.tree.links[i].joint.joint: self.tree.links[i] for i in members}
        root = self.tree.links[members.start]
        if root.free:
            i, j = root.joint.q_start, root.joint.v_start
            tree.root_pose = sapien.Pose(q[i + 4 : i + 7], q[i : i + 4])
            tree.root_linear_velocity, tree.root_angular_velocity = v[j + 3 : j + 6], v[j : j + 3]
        joints = [rigid[joint.name].joint for joint in tree.active_joints]
        if joints:
            with np.errstate(over="ignore"):  # overflow of float32 gives inf, and SimulationError
                tree.qpos = q[[x.q_start for x in joints]].astype(np.float32)
                tree.qvel = v[[x.v_start for x in joints]].astype(np.float32)
                tree.qf = force[[x.v_start for x in joints]].astype(np.float32)


def groups_by_shape(pairs: tuple[PairContract, ...]) -> dict[str, tuple[int, int]]:
    """Return each shape's bit and its partners' bits. Shapes with the same partners share a bit. Raises ModelError."""
    names = sorted({name for pair in pairs for name in pair.names})
    partners = {a: frozenset(b for pair in pairs if a in pair.names for b in pair.names if b != a) for a in names}
    kinds = list(dict.fromkeys(partners[name] for name in names))
    if len(kinds) > GROUPS:
        raise ModelError(f"PhysX supports {GROUPS} collision groups; this model needs {len(kinds)}")
    bit = {name: 1 << kinds.index(partners[name]) for name in names}
    return {name: (bit[name], sum({bit[partner] for partner in partners[name]})) for name in names}


def _read_part(link: Any) -> tuple[float, Array, Array, Array]:
    """Return mass, centre of mass (3,), inertia (3, 3) about it and orientation of the body (3, 3), in world."""
    pose, frame = link.entity_pose, link.cmass_local_pose
    body = rotation(np.array(pose.q, dtype=float))
    R = body @ rotation(np.array(frame.q, dtype=float))
    center = np.array(pose.p, dtype=float) + body @ np.array(frame.p, dtype=float)
    return float(link.mass), center, R @ np.diag(np.array(link.inertia, dtype=float)) @ R.T, body


def _read_joint(link: Any, rigid: RigidLink) -> JointContract:
    """Read a joint from PhysX at Drake's q = 0. The springs are those of the engine."""
    mass, center, inertia, body = _read_part(link)
    joint, kind = link.joint, KINDS[link.joint.type]
    single, pose = kind != "quaternion_floating", link.joint.pose_in_child
    limit = np.array(joint.limit, dtype=float).ravel() if single else np.array([-np.inf, np.inf])
    axis = body @ rotation(np.array(pose.q, dtype=float))[:, 0] if single else np.zeros(3)
    return joint_contract(
        name=joint.name, kind=kind, axis=axis,
        anchor=np.array(link.entity_pose.p, dtype=float) + body @ np.array(pose.p, dtype=float),
        carried=[(mass, center, inertia)], damping=float(joint.damping) if single else 0.0,
        armature=float(joint.armature[0]) if single else 0.0, stiffness=rigid.joint.stiffness, rest=rigid.joint.rest,
        lower=float(limit[0]), upper=float(limit[1]),
    )  # fmt: skip


def _fixed(scene: Any) -> Any:
    """Create a link that is fixed to the world."""
    link = physx.PhysxArticulationLinkComponent(None)
    entity = sapien.Entity()
    entity.add_component(link)
    link.mass, link.inertia = 1.0, np.ones(3)
    link.joint.type = "fixed"
    scene.add_entity(entity)
    return link


def _pose(X: RigidTransform) -> Any:
    return sapien.Pose(X.translation(), X.rotation().ToQuaternion().wxyz())
