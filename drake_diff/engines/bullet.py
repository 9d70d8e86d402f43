"""Bullet by pybullet, in double precision, on multibodies built link by link from Drake's plant.

Bullet has no armature. The engine applies spring forces together with actuator forces. Friction and stiffness are set
per link and combined per pair: mu = mu_a mu_b and 1/k = 1/k_a + 1/k_b. The contract lists the differences to Drake.
"""

from collections.abc import Sequence
from functools import partial
from importlib.metadata import version
from itertools import permutations
from tempfile import NamedTemporaryFile
from typing import Any
from weakref import finalize

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RotationMatrix

from drake_diff._base.arrays import Array
from drake_diff.engines.formats import bullet_urdf
from drake_diff.engines.interface import (
    DRAKES_STEP,
    EngineContract,
    RigidEngine,
    geometry_contracts,
    limit,
    not_offered,
    shape_of,
    silent,
)
from drake_diff.exceptions import MissingDependencyError, NotOfferedError
from drake_diff.mechanics.coordinates import Centers, rotation, unit
from drake_diff.mechanics.description import Geometry, JointContract, PairContract, RigidLink, joint_contract, split
from drake_diff.model.model import Model

try:
    with silent():
        import pybullet as p
except ImportError as error:
    raise MissingDependencyError(
        "this engine needs pybullet, which has wheels up to Python 3.11: pip install 'drake-diff[forward]'"
    ) from error

Owner = tuple[int, int]  # numbers of Bullet's body and link, where link -1 is the base
KINDS = {p.JOINT_REVOLUTE: "revolute", p.JOINT_PRISMATIC: "prismatic"}
SMALLEST = 1e-30  # replaces 0, as logarithm and inverse are needed
EVERY_TIME_STEP = {"reportSolverAnalytics": 1, "warmStartingFactor": 0.0, "contactSlop": 0.0}
# By default, Bullet damps all bodies, limits joint speeds to 100 rad/s or m/s, and adds a margin to cylinders.
INERT = {"linearDamping": 0.0, "angularDamping": 0.0, "maxJointVelocity": 1e10, "collisionMargin": 0.0}
NO_OTHER_FRICTION = {"rollingFriction": 0.0, "spinningFriction": 0.0, "restitution": 0.0}
NO_BIAS = "pybullet's inverse dynamics of a free body is not that of Bullet's own step"


class Client:
    """pybullet's functions on a separate server, which is disconnected when the object is deleted."""

    def __init__(self) -> None:
        self.number = p.connect(p.DIRECT)
        finalize(self, p.disconnect, self.number)

    def __getattr__(self, name: str) -> Any:
        return partial(getattr(p, name), physicsClientId=self.number)


class PybulletEngine(RigidEngine):
    """An engine for hinges, slides and free bodies, with spheres, boxes, cylinders, capsules and half spaces."""

    name, version = "pybullet", version("pybullet")

    def __init__(self, model: Model):
        super().__init__(model)
        with silent():
            self.bullet: Any = Client()
        self.bullet.setTimeStep(model.time_step)
        self.bullet.setGravity(*(float(g) for g in self.description.gravity))
        self.bullet.setPhysicsEngineParameter(**EVERY_TIME_STEP)
        self.places: dict[int, Owner] = {}  # by rigid link
        self.owners: dict[str, Owner] = {}  # by geometry
        for tree in self.tree.trees:
            self._build(tree)
        for geometry in (g for number, g in self.tree.geometries if number < 0):
            shape = self.bullet.createCollisionShape(**_shape(geometry))
            pose = (list(geometry.pose.translation()), _turn(geometry.pose.rotation().matrix()))
            self.owners[geometry.name] = (self.bullet.createMultiBody(0, shape, -1, *pose), -1)
        self._set_contacts()
        bodies = {x.joint.v_start: self.places[i] for i, x in enumerate(self.tree.links) if x.free}
        moving_dofs = [self.bullet.getDynamicsInfo(*bodies[v]) for _, v in self.coordinates.free]
        self.centers = Centers(self.coordinates, tuple(np.array(info[3]) for info in moving_dofs))
        axes = [_matrix(info[4]) for info in moving_dofs]
        bases = [bodies[v][0] for _, v in self.coordinates.free]
        # For each free body, its indices in q and v, and its base, centre of mass and principal axes in Bullet.
        self.free = tuple(zip(self.coordinates.free, bases, self.centers.centers, axes, strict=True))
        self.joints = [(self.places[i], link) for i, link in enumerate(self.tree.links) if not link.free]
        self.untouched = self.bullet.saveState()

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        x, u = self._point(x, u)
        self._set(x)
        force = self._effort(u) - self.stiffness * self._stretch(x[: self.nq])
        for owner, link in self.joints:
            self.bullet.setJointMotorControl2(*owner, p.TORQUE_CONTROL, force=float(force[link.joint.v_start]))
        islands = self.bullet.stepSimulation()
        used = max([0, *(island["numIterationsUsed"] for island in islands or ())])
        room = int(self.bullet.getPhysicsEngineParameters()["numSolverIterations"])
        q, v = np.zeros(self.nq), np.zeros(self.nv)
        for owner, link in self.joints:
            q[link.joint.q_start], v[link.joint.v_start] = self.bullet.getJointState(*owner)[:2]
        for (i, j), base, center, turned in self.free:
            position, turn = self.bullet.getBasePositionAndOrientation(base)
            R = _matrix(turn) @ turned.T
            q[i : i + 4] = RotationMatrix(R).ToQuaternion().wxyz()
            q[i : i + 4] *= np.sign(q[i : i + 4] @ x[i : i + 4])  # the sign for which q is continuous
            q[i + 4 : i + 7] = np.array(position) - R @ center
            v[j + 3 : j + 6], v[j : j + 3] = self.bullet.getBaseVelocity(base)
        x_next = self._drake_state("Bullet", q, v, x, u)
        self.status = "ok" if used < room else f"the solver used all of its {room} iterations"
        return x_next

    differentiate_step = not_offered("Bullet has no derivatives of its step")

    def energy(self, x: ArrayLike) -> float:
        x, q, v = self._state(x)
        kinetic = float(v @ self.mass_matrix(q) @ v) / 2
        self._set(x)
        parts = [_read_part(self.bullet, owner) for owner in self.places.values()]
        fallen = sum(mass * float(self.description.gravity @ center) for mass, center, _, _ in parts)
        return kinetic - fallen + self._spring_energy(q) + self.tree.anchored_energy

    def contact_depth(self, x: ArrayLike) -> float:
        self._set(self._state(x)[0])
        self.bullet.performCollisionDetection()
        return max([0.0, *(-float(point[8]) for point in self.bullet.getContactPoints())])

    def mass_matrix(self, q: ArrayLike) -> Array:
        q = self._positions(q)
        M, T = np.zeros((self.nv, self.nv)), self.centers.turn(q)
        for tree in self.tree.trees:
            owner, body, joints = self._dofs(tree), self.places[tree.start][0], self._joint_positions(tree, q)
            M[np.ix_(owner, owner)] = self.bullet.calculateMassMatrix(body, joints or [0.0])  # not an empty list
        for (i, j), _, _, turned in self.free:
            into = np.kron(np.eye(2), (rotation(q[i : i + 4]) @ turned).T)
            T[j : j + 6] = into @ T[j : j + 6]
        return np.asarray(T.T @ M @ T)

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Raise NotOfferedError for models with free bodies."""
        q, v = self._motion(q, v)
        if self.coordinates.free:
            raise NotOfferedError(NO_BIAS)
        needed = self.stiffness * self._stretch(q)
        for tree in self.tree.trees:
            owner = self._dofs(tree)
            given = (self._joint_positions(tree, q), [float(v[j]) for j in owner], [0.0] * len(owner))
            needed[owner] += self.bullet.calculateInverseDynamics(self.places[tree.start][0], *given)
        return np.asarray(needed)

    @property
    def contract(self) -> EngineContract:
        self._set(self._zero())
        order = sorted(range(len(self.tree.links)), key=lambda i: self.tree.links[i].joint.v_start)
        parameters = self.bullet.getPhysicsEngineParameters()
        damping = sorted({self.bullet.getDynamicsInfo(*o)[8] for o in self.owners.values()})
        law = f"springs and dampers of {damping} N s/m, implicit, by sequential impulses"
        free = ", free bodies by v' of the centre of mass, quaternions by the exponential of h w'"
        euler = f"semi-implicit Euler, joint damping explicit{free if self.coordinates.free else ''}"
        return EngineContract(
            **{**self._plant_fields(), "time_step": float(parameters["fixedTimeStep"])}, engine=self.name,
            joints=tuple(_read_joint(self.bullet, self.places[i], self.tree.links[i]) for i in order),
            native_order=tuple(link.joint.joint for link in self.tree.links),
            state="position of the centre of mass, quaternion x y z w of the principal axes; velocity of a free body "
            "linear of its centre of mass then angular, in world",
            integrator=euler if np.any(self.damping) or self.coordinates.free else DRAKES_STEP,
            gravity=tuple(float(parameters[f"gravityAcceleration{axis}"]) for axis in "XYZ"),
            contact_law=law if self.tree.pairs else "none",
            geometries=geometry_contracts(self.description), contacts=self._read_pairs(),
            limit_law="beyond the limit, impulses to a velocity back of at least 0.2 (Bullet's ERP) of the way / h",
            reasons={
                "armature": "Bullet has no rotor inertia",
                "integrator": "Bullet's joint damping is explicit; its free bodies move by their centres of mass and "
                "turn by the exponential of h w'",
                "contact law": "Bullet's contact is a spring and a damper in the constraints of its impulses",
                "contact pairs": "Bullet lets links touch, not geometries; " f"not built: {list(self.tree.left_out)}",
                "friction": "Bullet has friction by link, not by pair",
                "stiffness": "Bullet has stiffness by link, not by pair",
                "dissipation": "Bullet's contacts are built without dampers",
                "limit law": "Bullet's limits are rigid",
                "solver tolerance": "Bullet runs a limited number of iterations and has no tolerance",
            },
        )  # fmt: skip

    def _build(self, members: range) -> None:
        links = [(i, self.tree.links[i]) for i in members]
        flags = p.URDF_USE_INERTIA_FROM_FILE | p.URDF_USE_SELF_COLLISION | p.URDF_USE_SELF_COLLISION_INCLUDE_PARENT
        with NamedTemporaryFile("w", suffix=".urdf") as file:
            file.write(bullet_urdf(links, self.tree.geometries))
            file.flush()
            body = self.bullet.loadURDF(file.name, useFixedBase=not links[0][1].free, flags=flags)
        numbers = {"link_-1": -1, f"link_{members.start}": -1}
        for k in range(self.bullet.getNumJoints(body)):
            numbers[self.bullet.getJointInfo(body, k)[12].decode()] = k
            self.bullet.setJointMotorControl2(body, k, p.VELOCITY_CONTROL, force=0)
        for i in members:
            self.places[i] = (body, numbers[f"link_{i}"])
            self.bullet.changeDynamics(*self.places[i], **INERT)
        self.owners |= {g.name: self.places[i] for i, g in self.tree.geometries if i in members}

    def _set_contacts(self) -> None:
        """Set friction and stiffness of links, by least squares if pairs disagree; the contract reports the result."""
        for owner in set(self.owners.values()):
            self.bullet.setCollisionFilterGroupMask(*owner, 0, 0)
        pairs = [(self._owners_of(pair), pair) for pair in self.tree.pairs]
        for ((a, i), (b, j)), _ in pairs:
            self.bullet.setCollisionFilterPair(a, b, i, j, 1)
        friction = split([(x, np.log(max(pair.friction, SMALLEST))) for x, pair in pairs if pair.friction is not None])
        compliance = split([(x, 1 / max(pair.stiffness, SMALLEST)) for x, pair in pairs if pair.stiffness is not None])
        for owner in {owner for sides, _ in pairs for owner in sides}:
            values = dict(NO_OTHER_FRICTION)
            if owner in friction:
                values["lateralFriction"] = float(np.exp(friction[owner]))
            if owner in compliance:
                values |= {"contactStiffness": 1 / max(compliance[owner], SMALLEST), "contactDamping": 0.0}
            self.bullet.changeDynamics(*owner, **values)

    def _owners_of(self, pair: PairContract) -> tuple[Owner, Owner]:
        """Return the two links of a pair of geometries, the smaller first."""
        a, b = sorted(self.owners[name] for name in pair.names)
        return a, b

    def _read_pairs(self) -> tuple[PairContract, ...]:
        """Return all pairs of geometries whose links can collide in Bullet: Drake's pairs first, then others."""
        owners, links = self.owners, {self._owners_of(pair) for pair in self.tree.pairs}
        pairs = [pair.names for pair in self.tree.pairs]
        for a, b in permutations(owners, 2):
            both = a < b and tuple(sorted((owners[a], owners[b]))) in links
            if both and (a, b) not in pairs and (b, a) not in pairs:
                pairs.append((a, b))
        contracts = []
        for names in pairs:
            body, two = (self.bullet.getDynamicsInfo(*owners[name]) for name in names)
            k_one, k_two = float(body[9]), float(two[9])
            stiffness = k_one * k_two / (k_one + k_two) if min(k_one, k_two) > 0 else None
            contracts.append(PairContract(names, float(body[1] * two[1]), stiffness))
        return tuple(contracts)

    def _dofs(self, members: range) -> list[int]:
        """Return the indices in Drake's v of a tree's velocities in Bullet's order."""
        starts = [(link.joint.v_start, 6 if link.free else 1) for link in self._ordered(members)]
        return [start + k for start, count in starts for k in range(count)]

    def _joint_positions(self, members: range, q: Array) -> list[float]:
        return [float(q[link.joint.q_start]) for link in self._ordered(members) if not link.free]

    def _ordered(self, members: range) -> list[RigidLink]:
        """Return the links of a tree in Bullet's order."""
        return [self.tree.links[i] for i in sorted(members, key=lambda i: self.places[i][1])]

    def _set(self, x: Array) -> None:
        self.bullet.restoreState(self.untouched)
        q, v = unit(self.coordinates, x[: self.nq]), self.centers.turn(x[: self.nq]) @ x[self.nq :]
        for (i, j), base, center, turned in self.free:
            R = rotation(q[i : i + 4])
            position = list(q[i + 4 : i + 7] + R @ center)
            self.bullet.resetBasePositionAndOrientation(base, position, _turn(R @ turned))
            self.bullet.resetBaseVelocity(base, list(v[j + 3 : j + 6]), list(v[j : j + 3]))
        for owner, link in self.joints:
            self.bullet.resetJointState(*owner, float(q[link.joint.q_start]), float(v[link.joint.v_start]))


def _read_part(bullet: Any, owner: Owner) -> tuple[float, Array, Array, Array]:
    """Return mass, centre of mass (3,), inertia (3, 3) about it and principal axes (3, 3) of a link, in world."""
    info = bullet.getDynamicsInfo(*owner)
    state = bullet.getBasePositionAndOrientation(owner[0]) if owner[1] < 0 else bullet.getLinkState(*owner, 0, 1)
    R = _matrix(state[1])
    return float(info[0]), np.array(state[0]), R @ np.diag(info[2]) @ R.T, R


def _read_joint(bullet: Any, owner: Owner, link: RigidLink) -> JointContract:
    """Read a joint from Bullet at Drake's q = 0. The springs are those of the engine."""
    mass, center, inertia, R = _read_part(bullet, owner)
    name, carried = link.joint.joint, [(mass, center, inertia)]
    if owner[1] < 0:
        free = "quaternion_floating"
        return joint_contract(name=name, kind=free, axis=np.zeros(3), anchor=center, carried=carried)
    info = bullet.getJointInfo(*owner)
    _, above, _, turned = _read_part(bullet, (owner[0], info[16]))
    lower, upper = (limit(side) for side in info[8:10]) if info[8] <= info[9] else (-np.inf, np.inf)
    return joint_contract(
        name=name, kind=KINDS[info[2]], axis=R @ info[13], anchor=above + turned @ info[14], carried=carried,
        damping=float(info[6]), stiffness=link.joint.stiffness, rest=link.joint.rest, lower=lower, upper=upper,
    )  # fmt: skip


def _shape(geometry: Geometry) -> dict[str, Any]:
    """Return the keyword arguments of Bullet's collision shape."""
    kind, sizes = shape_of(geometry)
    if kind == "HalfSpace":
        return {"shapeType": p.GEOM_PLANE, "planeNormal": [0, 0, 1]}
    if kind == "Box":
        return {"shapeType": p.GEOM_BOX, "halfExtents": [side / 2 for side in sizes["size"]]}
    if kind == "Sphere":
        return {"shapeType": p.GEOM_SPHERE, "radius": sizes["radius"][0]}
    long = p.GEOM_CYLINDER if kind == "Cylinder" else p.GEOM_CAPSULE
    return {"shapeType": long, "radius": sizes["radius"][0], "height": sizes["length"][0]}


def _turn(R: Array) -> list[float]:
    """Return the quaternion (x, y, z, w)."""
    return list(RotationMatrix(R).ToQuaternion().wxyz()[[1, 2, 3, 0]])


def _matrix(xyzw: Sequence[float]) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion."""
    return rotation(np.array(xyzw)[[3, 0, 1, 2]])
