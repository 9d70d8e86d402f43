"""The tree of a finalized Drake plant as plain numbers, link by link, from which models of other engines are built.

`describe` reads the links as they are in Drake, welds included. `rigid_links` merges welded links, for engines and
formulas that work joint by joint. `joint_contracts` returns the merged links in one frame, to compare engines.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import numpy as np
from pydrake.geometry import Role
from pydrake.math import RigidTransform
from pydrake.multibody.tree import ForceElementIndex, PrismaticSpring, RevoluteSpring, UniformGravityFieldElement

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators, bodies, instances, joints, labelled, proximity_property, rotors

MOVING = ("revolute", "prismatic", "quaternion_floating")
SHAPES = ("Sphere", "Box", "Cylinder", "Capsule", "HalfSpace")
MATERIAL = ("friction", "stiffness", "dissipation", "relaxation_time")  # properties of one geometry of a contact
T = TypeVar("T")
Part = tuple[float, Array, Array]  # mass [kg], centre of mass (3,) [m], inertia (3, 3) about it [kg m^2]


@dataclass(frozen=True)
class JointContract:
    """One joint and its link with all welded bodies, in world at q = 0 (a free body at the origin, not rotated).

    The axes and anchors of all joints in one configuration, with the masses and inertias, describe the whole tree.
    """

    name: str
    kind: str  # revolute, prismatic, quaternion_floating
    axis: tuple[float, ...]  # unit; zero for a free body
    anchor: tuple[float, ...]  # a point on the axis [m], nearest to the origin; zero for a slide or a free body
    mass: float  # [kg]
    center_of_mass: tuple[float, ...]  # [m]
    inertia: tuple[float, ...]  # xx yy zz xy xz yz about the centre of mass [kg m^2]
    damping: float = 0.0  # [N s/m or N m s/rad]
    armature: float = 0.0  # added to the diagonal of M: rotor inertia times gear ratio squared
    stiffness: float = 0.0  # of a spring [N/m or N m/rad]
    rest: float = 0.0  # rest position of the spring [m or rad]
    lower: float = -np.inf  # position limits
    upper: float = np.inf


@dataclass(frozen=True)
class GeometryContract:
    """A geometry that can collide with others, in the world frame at q = 0 (a free body at the origin, not rotated).

    `position` is the centre, or for a half space the point of its plane nearest to the origin. `directions` has the
    same symmetries as the shape: it is empty for a sphere, the normal for a half space, a a' with the axis a for a
    cylinder or capsule, and R diag(sizes^2) R' for a box or ellipsoid (of matrices (3, 3): xx yy zz xy xz yz).
    """

    name: str
    carrier: str  # the moving joint that carries it, or "world"
    kind: str  # Drake's name of the shape, such as Sphere
    sizes: tuple[float, ...]  # [m]
    position: tuple[float, ...]  # [m]
    directions: tuple[float, ...]


@dataclass(frozen=True)
class PairContract:
    """Two geometries that may collide; a value is None if the model does not define it or the engine lacks it."""

    names: tuple[str, str]
    friction: float | None
    stiffness: float | None  # [N/m] combined stiffness of both geometries, at rest
    dissipation: float | None = None  # Hunt-Crossley dissipation [s/m]: similar and lagged contact
    relaxation_time: float | None = None  # [s] damping over stiffness: sap contact
    critical_time: float | None = None  # [s] relaxation time at which the engine's contact law is critically damped
    margin: float = 0.0  # [m] distance at which the contact force begins
    more: tuple[tuple[str, float], ...] = ()  # (name, value) of parameters that Drake's contact does not have


@dataclass(frozen=True, eq=False)
class Link:
    """A body and the joint that carries it; the poses are the joint's frames in the parent and in the body."""

    body: str
    parent: str  # "world" or another link's body
    joint: str
    kind: str  # weld or one of MOVING
    on_parent: RigidTransform
    on_child: RigidTransform
    axis: Array  # (3,) in the joint's frames
    q_start: int
    v_start: int
    mass: float
    center_of_mass: Array  # (3,) in the body
    inertia: Array  # (3, 3) about the centre of mass
    damping: float
    armature: float
    stiffness: float
    rest: float
    lower: float
    upper: float


@dataclass(frozen=True, eq=False)
class Geometry:
    """A collision geometry."""

    name: str
    body: str
    pose: RigidTransform
    shape: Any
    material: Mapping[str, float] = field(default_factory=dict)  # the properties in MATERIAL that the model defines


@dataclass(frozen=True)
class Follower:
    """A joint that follows another: q = ratio * q_leader + offset. The leader is not a follower itself."""

    joint: str
    leader: str
    ratio: float
    offset: float

    def __str__(self) -> str:
        return f"{self.joint} = {self.ratio:.10g} {self.leader} + {self.offset:.10g}"


@dataclass(frozen=True, eq=False)
class Description:
    """A tree of hinges, slides and free bodies; `links` has every parent before its children."""

    links: tuple[Link, ...]
    gravity: Array
    inputs: tuple[str, ...]
    actuated: tuple[str, ...]  # the joint of each input
    effort_limits: Array
    effort_sides: Array  # (nu, 2) lower and upper bound of each input, which problems enforce and steps do not
    geometries: tuple[Geometry, ...]
    pairs: tuple[PairContract, ...]
    followers: tuple[Follower, ...] = ()  # only `describe_whole` sets these

    @property
    def moving(self) -> tuple[Link, ...]:
        """The links with a degree of freedom, in the order of v."""
        return tuple(sorted((x for x in self.links if x.kind != "weld"), key=lambda x: x.v_start))

    @property
    def coordinates(self) -> Coordinates:
        free = tuple((x.q_start, x.v_start) for x in self.moving if x.kind == "quaternion_floating")
        single = tuple((x.q_start, x.v_start) for x in self.moving if x.kind != "quaternion_floating")
        return Coordinates(free, single)

    def by_velocity(self, name: str) -> Array:
        """Return the attribute `name` of the links in the order of v (nv,), with 0 for free bodies."""
        values = np.zeros(self.coordinates.nv)
        for link in self.moving:
            if link.kind != "quaternion_floating":
                values[link.v_start] = getattr(link, name)
        return values

    @property
    def actuation(self) -> Array:
        """The actuation matrix B (nv, nu)."""
        B = np.zeros((self.coordinates.nv, len(self.inputs)))
        starts = {link.joint: link.v_start for link in self.moving}
        for i, joint in enumerate(self.actuated):
            B[starts[joint], i] = 1.0
        return B


def coordinates_of(model: Model) -> Coordinates:
    """Return the indices in the state of the free bodies, the hinges and the slides of `model`."""
    places = [(joint, model.places(joint)) for joint in joints(model.plant)]
    starts = sorted((v.start, q.start, joint.num_velocities() == 6) for joint, (q, v) in places if len(v))
    free, single = (tuple((i, j) for j, i, six in starts if six == kind) for kind in (True, False))
    return Coordinates(free, single)


def describe(model: Model) -> Description:
    """Describe `model`; raise ModelError with the name of any element that is not supported for other engines."""
    refusals = [f"actuator {a.name()} has PD gains" for a in actuators(model.plant) if a.has_controller()]
    if model.num_constraints:
        refusals.append(
            f"{model.num_constraints} constraints (mimic joints, for which see mimic= of load_model, couplers, balls, "
            "welds, distances)"
        )
    if refusals:
        raise ModelError("this model cannot be given to another engine: " + "; ".join(refusals))
    return describe_tree(model)


def describe_whole(model: Model) -> Description:
    """Describe `model` as `describe` does, but with reduced mimic joints included as joints and followers."""
    description, coupling = describe(model.whole), model.coupling
    if coupling is None:
        return description
    by_start = {link.v_start: link for link in description.moving}
    followers = []
    for i in np.setdiff1d(np.arange(len(coupling.of_v)), coupling.own_v):
        link, leader = by_start[int(i)], by_start[int(coupling.own_v[coupling.of_v[i]])]
        ratio, offset = float(coupling.ratio_v[i]), float(coupling.offset[link.q_start])
        followers.append(Follower(link.joint, leader.joint, ratio, offset))
    return replace(description, followers=tuple(followers))


def describe_tree(model: Model, *, body_forces: bool = False) -> Description:
    """Describe `model` as `describe` does, but ignore PD control and constraints, and BodyForces if requested."""
    plant = model.plant
    refusals = [
        f"joint {j.name()} is of type {j.type_name()}" for j in joints(plant) if j.type_name() not in ("weld", *MOVING)
    ]
    refusals += [f"joint {j.name()} is locked" for j in joints(plant) if j.is_locked(model.double.context)]
    damped = [j for j in joints(plant) if np.any(j.default_damping_vector())]
    refusals += [
        f"the free body of joint {j.name()} is damped" for j in damped if j.type_name() == "quaternion_floating"
    ]
    if model.coupling is not None:
        refusals.append('its mimic joints are reduced (mimic="fix" holds them)')
    if model.forces:
        refusals.append("forces are added to Drake's")
    refusals += [model.systems_act] if model.systems_act and not (body_forces and model.body_forces) else []
    springs = springs_of(plant)
    if refusals or isinstance(springs, Refusal):
        reasons = [*refusals, str(springs)] if isinstance(springs, Refusal) else refusals
        raise ModelError("this model cannot be given to another engine: " + "; ".join(reasons))
    body_names, joint_names = names_of(plant)
    geometries, pairs = _geometries(model, body_names)
    return Description(
        links=tuple(read_links(plant, springs)),
        gravity=np.array(plant.gravity_field().gravity_vector()),
        inputs=model.input_names,
        actuated=tuple(joint_names[a.joint().index()] for a in actuators(plant)),
        effort_limits=np.array([a.effort_limit() for a in actuators(plant)]),
        effort_sides=np.column_stack([model.inputs.lower, model.inputs.upper]),
        geometries=geometries,
        pairs=pairs,
    )


def names_of(plant: Any) -> tuple[dict[Any, str], dict[Any, str]]:
    """Return the names of bodies and of joints by index."""
    body_names = {body.index(): label for label, body in labelled(bodies(plant)).items()}
    body_names[plant.world_body().index()] = "world"
    return body_names, {joint.index(): label for label, joint in labelled(joints(plant)).items()}


def springs_of(plant: Any) -> dict[Any, tuple[float, float]] | Refusal:
    """Return (stiffness, rest position) by joint, or a Refusal if a force element is not gravity or a joint spring."""
    springs: dict[Any, tuple[float, float]] = {}
    for i in range(plant.num_force_elements()):
        element = plant.get_force_element(ForceElementIndex(i))
        if isinstance(element, UniformGravityFieldElement):
            if not all(element.is_enabled(model_instance=k) for k in instances(plant)):
                return Refusal("gravity is off for a part of the model")
        elif isinstance(element, RevoluteSpring) and element.joint().index() not in springs:
            springs[element.joint().index()] = element.default_stiffness(), element.default_nominal_angle()
        elif isinstance(element, PrismaticSpring) and element.joint().index() not in springs:
            springs[element.joint().index()] = element.stiffness(), element.nominal_position()
        else:
            return Refusal(f"force element {i} is of type {type(element).__name__}, or the second of its joint")
    return springs


def read_links(plant: Any, springs: dict[Any, tuple[float, float]], *, backwards: bool = False) -> list[Link]:
    """Return every link of a plant, parents before their children.

    With `backwards`, a weld, hinge or slide whose child is nearer to the world than its parent is reversed. The link
    then moves the joint's parent, but its mass and inertia are not those of this body.
    """
    body_names, joint_names = names_of(plant)
    reflected = dict.fromkeys(joint_names, 0.0)
    for a in rotors(plant):
        reflected[a.joint().index()] += a.default_rotor_inertia() * a.default_gear_ratio() ** 2
    numbered = [(j, j.index()) for j in joints(plant)]
    waiting = [_link(j, joint_names[i], body_names, reflected[i], springs.get(i, (0.0, 0.0))) for j, i in numbered]
    waiting.sort(key=lambda link: link.v_start)
    placed, ordered = {"world"}, []
    while waiting:
        link = next((x for x in waiting if x.parent in placed), None)
        if link is None and backwards:
            link = next((x for x in waiting if x.body in placed and x.kind in ("weld", "revolute", "prismatic")), None)
        if link is None:
            names = ", ".join(x.joint for x in waiting)
            raise ModelError(f"the child of a joint is nearer to the world than its parent: {names}")
        waiting.remove(link)
        if link.parent not in placed:
            ends = {"body": link.parent, "parent": link.body, "on_parent": link.on_child, "on_child": link.on_parent}
            link = replace(link, axis=-link.axis, **ends)
        placed.add(link.body)
        ordered.append(link)
    return ordered


def _link(joint: Any, name: str, body_names: dict[Any, str], armature: float, spring: tuple[float, float]) -> Link:
    body, kind = joint.child_body(), joint.type_name()
    inertia = body.default_spatial_inertia()
    single = kind in ("revolute", "prismatic")
    about_com = inertia.Shift(inertia.get_com()).CalcRotationalInertia().CopyToFullMatrix3()
    axis = {"revolute": "revolute_axis", "prismatic": "translation_axis"}.get(kind)
    on_parent = joint.frame_on_parent().GetFixedPoseInBodyFrame()
    return Link(
        body=body_names[body.index()],
        parent=body_names[joint.parent_body().index()],
        joint=name,
        kind=kind,
        on_parent=on_parent @ joint.X_FM() if kind == "weld" else on_parent,
        on_child=joint.frame_on_child().GetFixedPoseInBodyFrame(),
        axis=np.array(getattr(joint, axis)()) if axis else np.zeros(3),
        q_start=joint.position_start() if kind != "weld" else -1,
        v_start=joint.velocity_start() if kind != "weld" else -1,
        mass=float(inertia.get_mass()),
        center_of_mass=np.array(inertia.get_com()),
        inertia=np.array(about_com),
        damping=float(joint.default_damping_vector()[0]) if single else 0.0,
        armature=armature,
        stiffness=float(spring[0]),
        rest=float(spring[1]),
        lower=float(joint.position_lower_limits()[0]) if single else -np.inf,
        upper=float(joint.position_upper_limits()[0]) if single else np.inf,
    )


def _geometries(model: Model, body_names: dict[Any, str]) -> tuple[tuple[Geometry, ...], tuple[PairContract, ...]]:
    inspector = model.double.inspector
    if inspector is None:
        return (), ()
    geometries, names = [], {}
    for i, geometry in enumerate(inspector.GetAllGeometryIds(Role.kProximity)):
        body = body_names[model.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry)).index()]
        names[geometry] = f"{inspector.GetName(geometry)}#{i}"
        pose, shape = inspector.GetPoseInFrame(geometry), inspector.GetShape(geometry)
        given = {name: proximity_property(inspector, geometry, name) for name in MATERIAL}
        material = {name: float(value) for name, value in given.items() if value is not None and np.isfinite(value)}
        geometries.append(Geometry(names[geometry], body, pose, shape, material))
    pairs = []
    for ids in sorted(inspector.GetCollisionCandidates(), key=lambda ids: (names[ids[0]], names[ids[1]])):
        pairs.append(_pair(inspector, ids, (names[ids[0]], names[ids[1]])))
    return tuple(geometries), tuple(pairs)


def _pair(inspector: Any, ids: Sequence[Any], names: tuple[str, str]) -> PairContract:
    """Combine the properties of two geometries as Drake does. See `derivatives.contact.laws`."""
    read = {name: [proximity_property(inspector, i, name) for i in ids] for name in MATERIAL}
    known = {name: (float(a), float(b)) for name, (a, b) in read.items() if a is not None and b is not None}
    friction, stiffness = (
        harmonic(np.array([known[name]])).item() if name in known else None for name in ("friction", "stiffness")
    )
    dissipation = None
    if stiffness and "dissipation" in known:
        (k_a, k_b), (d_a, d_b) = known["stiffness"], known["dissipation"]
        dissipation = (k_b * d_a + k_a * d_b) / (k_a + k_b)
    return PairContract(
        names,
        friction=None if friction is None else 2 * friction,
        stiffness=stiffness,
        dissipation=dissipation,
        relaxation_time=sum(known["relaxation_time"]) if "relaxation_time" in known else None,
    )


def harmonic(sides: Array) -> Array:
    """Return a b / (a + b) (P,) for sides (P, 2), or 0 where both are 0."""
    total = sides.sum(axis=1)
    return np.asarray(sides.prod(axis=1) / np.where(total > 0, total, 1.0))


@dataclass(frozen=True, eq=False)
class RigidLink:
    """A moving link and the bodies welded to it, in the child frame of its joint."""

    joint: Link
    parent: int  # index of the parent in `RigidLinks.links`, -1 for the world
    on_parent: RigidTransform  # pose of the frame on the parent at q = 0
    axis: Array  # (3,) unit; zero for a free body
    mass: float
    center_of_mass: Array  # (3,)
    inertia: Array  # (3, 3) about the centre of mass

    @property
    def free(self) -> bool:
        return self.joint.kind == "quaternion_floating"


@dataclass(frozen=True, eq=False)
class RigidLinks:
    """The links of a description without welds, every parent before its children, one tree after the other."""

    links: tuple[RigidLink, ...]
    trees: tuple[range, ...]  # ranges of indices in `links`
    geometries: tuple[tuple[int, Geometry], ...]  # (index of the link or -1 for the world, geometry); SHAPES only
    pairs: tuple[PairContract, ...]  # pairs of `geometries`
    left_out: tuple[tuple[str, str], ...]  # the other pairs
    anchored_energy: float  # [J] the potential energy of the bodies fixed to the world


def rigid_links(description: Description) -> RigidLinks:
    """Merge the welded links of a description.

    Raises ModelError if a free body is not joined to the world by its own frame.
    """
    for link in description.moving:
        is_identity = all(pose.IsExactlyIdentity() for pose in (link.on_parent, link.on_child))
        if link.kind == "quaternion_floating" and (link.parent != "world" or not is_identity):
            raise ModelError(f"joint {link.joint}: expected a free body to be joined to the world by its own frame")
    links, on, anchored = without_welds(description.links)
    starts = [i for i, link in enumerate(links) if link.parent < 0]
    known = tuple(
        (on[g.body][0], Geometry(g.name, g.body, on[g.body][1] @ g.pose, g.shape, g.material))
        for g in description.geometries
        if type(g.shape).__name__ in SHAPES
    )
    names = {g.name for _, g in known}
    pairs = tuple(pair for pair in description.pairs if set(pair.names) <= names)
    return RigidLinks(
        links=links,
        trees=tuple(range(a, b) for a, b in zip(starts, [*starts[1:], len(links)], strict=True)),
        geometries=known,
        pairs=pairs,
        left_out=tuple(pair.names for pair in description.pairs if pair not in pairs),
        anchored_energy=-sum(m * float(description.gravity @ c) for m, c, _ in anchored),
    )


def without_welds(
    links: Sequence[Link],
) -> tuple[tuple[RigidLink, ...], dict[str, tuple[int, RigidTransform]], list[Part]]:
    """Return the moving links merged with their welded bodies, a map of bodies to links, and the parts fixed to world.

    The map gives for each body the index of its link (-1 for the world) and its pose on the link. The links of each
    tree are contiguous. The parts are in the world frame.
    """
    tree = {"world": -1}
    for i, link in enumerate(links):
        up = tree[link.parent]
        tree[link.body] = i if up < 0 and link.kind != "weld" else up
    on: dict[str, tuple[int, RigidTransform]] = {"world": (-1, RigidTransform())}
    moving: list[tuple[Link, int, RigidTransform]] = []
    carried: dict[int, list[Part]] = {-1: []}
    for link in sorted(links, key=lambda link: tree[link.body]):  # links fixed to the world come first
        parent, pose = on[link.parent]
        frame = pose @ link.on_parent
        if link.kind == "weld":
            on[link.body] = (parent, frame @ link.on_child.inverse())
        else:
            on[link.body] = (len(moving), link.on_child.inverse())
            moving.append((link, parent, frame))
        number, pose = on[link.body]
        carried.setdefault(number, []).append(_moved((link.mass, link.center_of_mass, link.inertia), pose))
    rigid = []
    for i, (link, parent, frame) in enumerate(moving):
        axis = link.axis if link.kind == "quaternion_floating" else link.axis / np.linalg.norm(link.axis)
        rigid.append(RigidLink(link, parent, frame, axis, *merged(carried[i])))
    return tuple(rigid), on, carried[-1]


def _moved(body: Part, pose: RigidTransform) -> Part:
    """Transform a part to the frame in which its own frame has the pose `pose`."""
    mass, center_of_mass, inertia = body
    R = pose.rotation().matrix()
    return mass, pose @ center_of_mass, R @ inertia @ R.T


def joint_contracts(description: Description) -> tuple[JointContract, ...]:
    """Return each moving joint with its link and the welded bodies, in the world frame at q = 0, in the order of v."""
    frames: list[RigidTransform] = []
    contracts: dict[int, JointContract] = {}
    for link in without_welds(description.links)[0]:
        joint, frame = link.joint, link.on_parent if link.parent < 0 else frames[link.parent] @ link.on_parent
        frames.append(frame)
        contracts[joint.v_start] = joint_contract(
            name=joint.joint,
            kind=joint.kind,
            axis=frame.rotation().matrix() @ link.axis,
            anchor=frame.translation(),
            carried=[_moved((link.mass, link.center_of_mass, link.inertia), frame)],
            **{k: getattr(joint, k) for k in ("damping", "armature", "stiffness", "rest", "lower", "upper")},
        )
    return tuple(contracts[start] for start in sorted(contracts))


def joint_contract(*, kind: str, axis: Array, anchor: Array, carried: list[Part], **rest: Any) -> JointContract:
    """Make a JointContract from parts (mass, centre of mass (3,), inertia about it (3, 3)) in the world frame."""
    mass, com, total = merged(carried)
    i, j = [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]
    on_axis = anchor - axis * (axis @ anchor) if kind == "revolute" else np.zeros(3)
    numbers = [tuple(float(n) for n in values) for values in (axis, on_axis, com, total[i, j])]
    axis_, anchor_, center, inertia = numbers
    return JointContract(
        kind=kind, axis=axis_, anchor=anchor_, mass=mass, center_of_mass=center, inertia=inertia, **rest
    )


def merged(parts: list[Part]) -> Part:
    """Merge parts (mass, centre of mass (3,), inertia about it (3, 3)) into one."""
    mass = float(sum(m for m, _, _ in parts))
    com = sum((m * c for m, c, _ in parts), np.zeros(3)) / mass if mass else np.zeros(3)
    total = np.zeros((3, 3))
    for m, c, inertia in parts:
        arm = c - com
        total += inertia + m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return mass, com, total


def split(given: Sequence[tuple[tuple[T, T], float]]) -> dict[T, float]:
    """Solve s_a + s_b = value for each pair (a, b) by least squares; return the solution of minimum norm."""
    sides = list(dict.fromkeys(side for pair, _ in given for side in pair))
    sums = np.zeros((len(given), len(sides)))
    for row, (pair, _) in zip(sums, given, strict=True):
        for side in pair:
            row[sides.index(side)] += 1.0
    values = np.linalg.lstsq(sums, np.array([value for _, value in given]), rcond=None)[0] if given else []
    return dict(zip(sides, (float(value) for value in values), strict=True))
