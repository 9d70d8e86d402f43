"""Changes of a loaded plant by arguments of `load_model`: actuators, a fixed base, and welded joints.

Each function changes a plant before it is finalized, in the same way for every file format, and returns a sentence for
each change.

Mimic joints copy another joint, such as a gripper's second finger: q_follower = ratio q_leader + offset.

Drake has both joints in the state and connects them by a nearly rigid constraint in every step. `load_model` can weld
them (`fix_mimics`), or reduce the state to its independent coordinates. With q = E q_own + c and v = E v_own, motion
that satisfies the constraints obeys

    E' M(q) E dv_own/dt = E' (B u + forces(q, v) - C(q, v) v)

(Featherstone, "Rigid Body Dynamics Algorithms", 2008, section 3.2). The constraint's impulse in a step is orthogonal to
E, so the momentum along E results from all other impulses. With the matrix A = M + h D of Drake's step,

    v'_own = (E' A E)^-1 E' A v'

is the step of the reduced equations up to rounding, without contacts and active limits. Otherwise, Drake's impulses
belong to its own v', which differs from E v'_own by the compliance of the near-rigid constraint.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake import geometry as pg
from pydrake.autodiffutils import ExtractValue
from pydrake.math import RigidTransform
from pydrake.multibody.plant import CoulombFriction, MultibodyPlant
from pydrake.multibody.tree import (
    PdControllerGains,
    PrismaticJoint,
    PrismaticSpring,
    RevoluteJoint,
    RevoluteSpring,
    WeldJoint,
)
from scipy.sparse.csgraph import connected_components

from drake_diff._base.arrays import LARGEST, Array, finite_array
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.model.contact_geometry import collision_geometries, exclude
from drake_diff.model.file_facts import FileFacts, Mimic
from drake_diff.model.load_file import DRAKES_REFUSALS
from drake_diff.model.plant import (
    ARMATURE,
    actuators,
    bodies,
    frame_named,
    joint_pose,
    joints,
    key_of,
    labelled,
    named,
    note,
)

GROUND_FRICTION = 0.5  # for ground=True: the default friction of Drake's SceneGraph
Actuated = str | tuple[str, ...] | dict[str, float | None] | None

Gains = tuple[float, float]


def as_actuated(value: Any) -> Actuated:
    """Normalize the argument `actuators` to None, "all", names, or efforts [N or N m] by name.

    Raises InputError for any other value.
    """
    if value is None or value == "all":
        return value
    if isinstance(value, Mapping):
        return {str(name): _effort(str(name), effort) for name, effort in value.items()}
    return as_names("actuators", value, 'None, "all", names of joints, or an effort limit for each name')


def _effort(name: str, effort: Any) -> float | None:
    """Return the limit, or None if it is infinite, because records contain no infinity."""
    if effort is None or effort == np.inf:
        return None
    if isinstance(effort, bool) or not isinstance(effort, (int, float, np.number)) or not effort > 0:
        expected = "an effort limit above 0 [N or N m], or None"
        raise InputError(f"actuators[{name!r}]", got=repr(effort), expected=expected)
    return float(effort)


def as_names(subject: str, value: Any, expected: str = "names of joints") -> tuple[str, ...]:
    """Return `value` as a tuple of names; raise InputError if it is not a list of names."""
    if isinstance(value, str) or not isinstance(value, Collection) or not all(isinstance(n, str) for n in value):
        raise InputError(subject, got=repr(value), expected=expected)
    return tuple(value)


def can_be_driven(joint: Any) -> bool:
    """Return whether Drake supports an actuator on a joint, which must be revolute or prismatic."""
    return isinstance(joint, (RevoluteJoint, PrismaticJoint))


def add_actuators(plant: MultibodyPlant, asked: Actuated, facts: FileFacts) -> tuple[str, ...]:
    """Add an actuator to each joint of `asked` that has none, and return notes on the changes.

    An actuator has the name of its joint. Its effort limit defaults to the file's; a limit of 0 means no limit. For
    all joints of `asked`, with or without an actuator before, a range from 0 to 0 also means no limit.
    """
    if asked is None:
        return ()
    driven = {actuator.joint().index(): actuator for actuator in actuators(plant)}
    given_here = isinstance(asked, dict)
    added, opened, notes = dict[str, float](), list[str](), list[str]()
    for name, joint in _chosen(plant, asked, facts).items():
        says = facts.joints.get(key_of(joint))
        given = asked[name] if isinstance(asked, dict) else None if says is None else says.effort
        limit = given if given is not None and given > 0 else np.inf
        if given_here and says is not None:
            facts.joints[key_of(joint)] = replace(says, sides=None)
        if joint.position_upper_limits()[0] == 0 == joint.position_lower_limits()[0]:
            joint.set_position_limits([-np.inf], [np.inf])
            opened.append(name)
        if joint.index() in driven:
            notes += _limit_again(driven[joint.index()], limit) if given_here else []
            continue
        actuator = plant.AddJointActuator(joint.name(), joint, limit)
        if says is not None and says.armature:
            actuator.set_default_rotor_inertia(says.armature)
        added[name] = limit
    limited = [f"{name} ({limit:g})" for name, limit in added.items() if np.isfinite(limit)]
    unlimited = [name for name, limit in added.items() if not np.isfinite(limit)]
    whose, why = ("given", "as requested") if given_here else ("of the file", "as the file has no limit or 0")
    return (
        *notes,
        *note(f"{len(limited)} actuators added, with the effort limits {whose}", limited),
        *note(f"{len(unlimited)} actuators added without an effort limit, {why}", unlimited),
        *note("Ranges from 0 to 0 of driven joints removed", opened),
    )


def add_armatures(plant: MultibodyPlant, facts: FileFacts) -> tuple[str, ...]:
    """Add MJCF's armature to joints without an actuator, since Drake supports it only on actuators."""
    driven, added = {actuator.joint().index() for actuator in actuators(plant)}, []
    for joint in joints(plant):
        says = facts.joints.get(key_of(joint))
        if says is not None and says.armature and joint.index() not in driven and can_be_driven(joint):
            rotor = plant.AddJointActuator(ARMATURE + joint.name(), joint)
            rotor.set_default_rotor_inertia(says.armature)
            added.append(f"{joint.name()} ({says.armature:g})")
    return note("Armature of joints without an actuator", added)


def as_gains(value: Any, inputs: str | None) -> Gains | dict[str, Gains] | None:
    """Normalize the argument `gains`.

    Raises InputError for a pair without kp above 0 and kd of at least 0, or if the inputs are not commanded positions.
    """
    if value is not None and inputs != "position":
        raise InputError("inputs", got=f"{inputs!r} and gains", expected='inputs="position" with gains')
    if isinstance(value, Mapping):
        return {str(name): _pair(f"gains[{name!r}]", pair) for name, pair in value.items()}
    return None if value is None else _pair("gains", value)


def _pair(subject: str, value: Any) -> Gains:
    kp, kd = finite_array(subject, value, (2,)).tolist()
    if not (kp > 0 and kd >= 0):
        raise InputError(subject, got=(kp, kd), expected="(kp, kd) with kp above 0 and kd at least 0")
    return kp, kd


def add_servos(
    plant: MultibodyPlant, inputs: str | None, gains: Gains | dict[str, Gains] | None, facts: FileFacts
) -> tuple[str, ...]:
    """Set the gains of servos on actuators, and add actuators to joints that have none."""
    if inputs != "position":
        return ()
    if gains is None:
        without = [actuator.name() for actuator in actuators(plant) if not actuator.has_controller()]
        if without or not actuators(plant):
            expected = "(kp, kd), as the file has no servo of " + (", ".join(without) or "any joint")
            raise InputError("gains", got=None, expected=expected)
        return ()
    indices = [actuator.joint().index() for actuator in actuators(plant)]
    driven = [name for name, joint in labelled(joints(plant)).items() if joint.index() in indices]
    chosen = _chosen(plant, list(gains) if isinstance(gains, dict) else driven, facts, "gains")
    chosen |= {} if isinstance(gains, dict) else _chosen(plant, "all", facts)
    notes = add_actuators(plant, tuple(n for n, joint in chosen.items() if joint.index() not in indices), facts)
    by_joint = {actuator.joint().index(): actuator for actuator in actuators(plant)}
    for name, joint in chosen.items():
        kp, kd = gains[name] if isinstance(gains, dict) else gains
        by_joint[joint.index()].set_controller_gains(PdControllerGains(p=kp, d=kd))
        if says := facts.joints.get(key_of(joint)):
            facts.joints[key_of(joint)] = replace(says, damping_ratio=0.0)
    return (*notes, f"{len(chosen)} inputs are commanded positions, with the gains given: {', '.join(chosen)}.")


def damp_servos(plant: MultibodyPlant, facts: FileFacts) -> tuple[str, ...]:
    """Set kv [N m s/rad or N s/m] of servos that have a damping ratio in MJCF, after the plant is finalized.

    kv is 2 ratio sqrt(kp / w), where w is the joint's own entry of the inverse mass matrix in the file's pose.
    """
    damped = []
    with_ratio = {key: says.damping_ratio for key, says in facts.joints.items() if says.damping_ratio}
    inverse = np.linalg.pinv(plant.CalcMassMatrix(plant.CreateDefaultContext())) if with_ratio else np.zeros((0, 0))
    for actuator in actuators(plant):
        ratio, i = with_ratio.get(key_of(actuator.joint())), actuator.joint().velocity_start()
        if ratio and actuator.has_controller():
            kp = actuator.get_controller_gains().p
            kd = 2 * ratio * float(np.sqrt(kp / inverse[i, i]))
            actuator.set_controller_gains(PdControllerGains(p=kp, d=kd))
            damped.append(f"{actuator.name()} ({kd:.4g})")
    return note("Gains kv of servos from their damping ratios", damped)


def _chosen(
    plant: MultibodyPlant, asked: str | Collection[str], facts: FileFacts, subject: str = "actuators"
) -> dict[str, Any]:
    """Return the requested joints by name; raise UnknownNameError or InputError for a joint that cannot be driven."""
    possible = {name: joint for name, joint in labelled(joints(plant)).items() if can_be_driven(joint)}
    copies = {name for name, joint in possible.items() if key_of(joint) in facts.followers}
    if asked == "all":
        return {name: joint for name, joint in possible.items() if name not in copies}
    for name in asked:
        if name not in possible:
            raise UnknownNameError(f"{subject}: revolute or prismatic joint", got=name, known=possible)
        if name in copies:
            raise InputError(subject, got=repr(name), expected="a joint that mimics no other joint")
    return {name: possible[name] for name in asked}


def take_away_speeds_of_zero(plant: MultibodyPlant) -> tuple[str, ...]:
    """Remove velocity limits of 0 from all joints: they are placeholders in files, and Drake's steps ignore them."""
    stopped = {
        name: joint
        for name, joint in labelled(joints(plant)).items()
        if joint.num_velocities() == 1 and joint.velocity_upper_limits()[0] == 0 == joint.velocity_lower_limits()[0]
    }
    for joint in stopped.values():
        joint.set_velocity_limits([-np.inf], [np.inf])
    return note("Velocity limits of 0 removed", list(stopped))


def position_in_file(plant: MultibodyPlant, facts: FileFacts, joint: Any) -> float:
    """Return the position of a hinge or slide [rad or m] in its file's pose, which a .dmd.yaml does not change."""
    says = facts.joints.get(key_of(joint))
    if says is not None or joint.num_velocities() != 1:
        return 0.0 if says is None else says.start
    return float(joint.default_positions()[0])


def _limit_again(actuator: Any, limit: float) -> list[str]:
    was = float(actuator.effort_limit())
    if was == limit:
        return []
    actuator.set_effort_limit(limit)
    return [f"The effort limit of {actuator.name()} became {limit:g}; the file has {was:g}."]


def hold_base(plant: MultibodyPlant, base: str | None) -> tuple[str, ...]:
    """Weld floating bodies to the world ("weld"), check for a floating body ("free"), or weld the frame with a name.

    Raises UnknownNameError if the frame does not exist, and ModelError if the base does not match the request.
    """
    if base is None:
        return ()
    if not isinstance(base, str):
        raise InputError("base", got=repr(base), expected='None, "weld", "free" or the name of a frame')
    trees = floating_trees(plant)
    if base == "free":
        if not trees:
            raise ModelError('base="free": expected a floating body; ' + _what_holds(plant))
        return ()
    if base == "weld":
        with_joints = [tree for tree in trees if _can_move(plant, tree)]
        if trees and not with_joints:
            names = ", ".join(tree[0].name() for tree in trees)
            raise ModelError(
                f'base="weld": expected floating bodies with joints, so that the robot can still move, got {names}'
            )
        notes = []
        for root, *_ in with_joints:
            pose = plant.GetDefaultFloatingBaseBodyPose(root)
            plant.WeldFrames(plant.world_frame(), root.body_frame(), pose)
            notes.append(f"The base {root.name()} was welded to the world.")
        return tuple(notes)
    frame = frame_named(plant, "base: frame", base)
    try:
        plant.WeldFrames(plant.world_frame(), frame)
    except DRAKES_REFUSALS as error:
        raise ModelError(f"base={base!r}: {_plain(error)}") from error
    if not any(frame.body() in tree for tree in trees):
        raise ModelError(f"base={base!r}: expected a frame of a floating body; " + _what_holds(plant))
    return (f"The frame {base} was welded to the world.",)


def weld_link(plant: MultibodyPlant, name: str) -> None:
    """Weld the link called `name` to the world; raise ModelError if a joint connects it to a parent."""
    link = named("link", bodies(plant), name)
    try:
        plant.WeldFrames(plant.world_frame(), link.body_frame())
    except DRAKES_REFUSALS as error:
        expected = "expected weld_base to be a link without a joint to its parent"
        raise ModelError(f"{expected}: {error}") from error


def floating_trees(plant: MultibodyPlant) -> list[list[Any]]:
    """Return the trees of bodies that are not connected to the world by joints, each with its root first."""
    members = [plant.world_body(), *bodies(plant)]
    index = {body.index(): i for i, body in enumerate(members)}
    ends = [(index[j.parent_body().index()], index[j.child_body().index()]) for j in joints(plant)]
    linked = np.zeros((len(members), len(members)), dtype=bool)
    for a, b in ends:
        linked[a, b] = True
    _, group = connected_components(linked, directed=False)
    children = {b for _, b in ends}
    trees = [np.flatnonzero(group == g).tolist() for g in dict.fromkeys(group.tolist()) if g != group[0]]
    return [[members[i] for i in sorted(tree, key=lambda i: i in children)] for tree in trees]


def _can_move(plant: MultibodyPlant, tree: list[Any]) -> bool:
    indices = {body.index() for body in tree}
    return any(joint.num_velocities() and joint.child_body().index() in indices for joint in joints(plant))


def _what_holds(plant: MultibodyPlant) -> str:
    world = plant.world_body().index()
    held = [j for j in joints(plant) if world in (j.parent_body().index(), j.child_body().index())]
    holders = ", ".join(f"{j.name()} ({j.type_name()}) of {j.child_body().name()}" for j in held)
    return f"joints to the world: {holders or 'none, as there is no body'}"


def fix(plant: MultibodyPlant, names: tuple[str, ...]) -> tuple[str, ...]:
    """Replace the named joints by welds at their default position or nearest limit, and return a note."""
    known = {name: joint for name, joint in labelled(joints(plant)).items() if joint.num_velocities()}
    fixed_at = []
    for name in names:
        if name not in known:
            raise UnknownNameError("fix_joints: joint that can move", got=name, known=known)
        joint = known[name]
        if not can_be_driven(joint):
            kind = f"a {joint.type_name()} joint, {name}"
            raise InputError("fix_joints", got=kind, expected="revolute or prismatic joints")
        if plant.num_constraints():
            raise ModelError(
                f"fix_joints={name!r}: Drake cannot remove a joint from a model with constraints, and this one has "
                f"{plant.num_constraints()} besides mimic joints: fix the joint in the file"
            )
        low, high = float(joint.position_lower_limits()[0]), float(joint.position_upper_limits()[0])
        q = float(np.clip(joint.default_positions()[0], low, high))
        weld(plant, joint, q, f"fix_joints={name!r}")
        fixed_at.append(f"{name} at {q:g}")
    return note(f"{len(fixed_at)} joints fixed", fixed_at)


def weld(plant: MultibodyPlant, joint: Any, q: float, subject: str) -> None:
    """Replace a revolute or prismatic joint by a weld at q, without actuators; `subject` begins Drake's errors."""
    for actuator in [a for a in actuators(plant) if a.joint().index() == joint.index()]:
        plant.RemoveJointActuator(actuator)
    name, parent, child = joint.name(), joint.frame_on_parent(), joint.frame_on_child()
    moved = joint_pose(joint, q)
    try:
        plant.RemoveJoint(joint)
    except DRAKES_REFUSALS as error:
        raise ModelError(f"{subject}: {_plain(error)}") from error
    plant.AddJoint(WeldJoint(name, parent, child, moved))


def add_springs(plant: MultibodyPlant, facts: FileFacts) -> tuple[str, ...]:
    """Add the joint springs of a file that Drake's parser ignores, which are those of MJCF."""
    sentences = []
    for name, joint in labelled(joints(plant)).items():
        says = facts.joints.get(key_of(joint))
        if says is None or says.spring is None or not can_be_driven(joint):
            continue
        stiffness, rest = says.spring
        if not (np.isfinite(rest) and 0 <= stiffness < np.inf):  # Drake ends the process for other values
            raise ModelError(
                f"{name}: expected a spring of finite stiffness, 0 or more, got {stiffness:g} about {rest:g}"
            )
        spring = RevoluteSpring if isinstance(joint, RevoluteJoint) else PrismaticSpring
        plant.AddForceElement(spring(joint, rest, stiffness))
        sentences.append(f"{name} ({stiffness:g} about {rest:g})")
    return note(f"{len(sentences)} springs of joints, which Drake's parser does not read", sentences)


def check_contact(value: Any) -> None:
    """Raise InputError if the argument `contact` is invalid."""
    if not (isinstance(value, bool) or value in ("ground", "separable")):
        raise InputError("contact", got=repr(value), expected='True, False, "ground" or "separable"')


def take_away_contact(plant: MultibodyPlant, scene_graph: pg.SceneGraph) -> tuple[str, ...]:
    """Disable all contact: remove the proximity role of every collision shape, which is then also not drawn."""
    geometries = collision_geometries(plant, scene_graph)
    for _, geometry in geometries:
        scene_graph.RemoveRole(plant.get_source_id(), geometry, pg.Role.kProximity)
    return (f"{len(geometries)} collision shapes removed: the model has no contact.",) if geometries else ()


def touch_the_world_alone(plant: MultibodyPlant, scene_graph: pg.SceneGraph) -> tuple[str, ...]:
    """Exclude contact between moving bodies, except with the world; call it after all shapes are registered."""
    fixed = {body.index() for body in plant.GetBodiesWeldedTo(plant.world_body())}
    moving = [geometry for body, geometry in collision_geometries(plant, scene_graph) if body.index() not in fixed]
    exclude(scene_graph, moving, moving)
    return (f"{len(moving)} collision shapes touch only bodies fixed to the world, not each other.",) if moving else ()


def as_ground(value: Any) -> float | bool | None:
    """Normalize the argument `ground` to None, True or a friction coefficient; raise InputError if it is invalid."""
    if value is None or value is True:
        return value
    number = isinstance(value, (int, float, np.integer, np.floating)) and not isinstance(value, (bool, np.timedelta64))
    if not number or not 0 <= value <= LARGEST:
        raise InputError("ground", got=f"{value!r:.80}", expected="a friction coefficient of at least 0, or True")
    return float(value)


def add_ground(plant: MultibodyPlant, ground: float | bool | None) -> tuple[str, ...]:
    """Add the half space z <= 0 with a friction coefficient, or with the default coefficient for True."""
    if ground is None:
        return ()
    friction = GROUND_FRICTION if ground is True else float(ground)
    properties = pg.ProximityProperties()
    pg.AddContactMaterial(friction=CoulombFriction(friction, friction), properties=properties)
    try:
        plant.RegisterCollisionGeometry(plant.world_body(), RigidTransform(), pg.HalfSpace(), "ground", properties)
    except DRAKES_REFUSALS as error:
        raise ModelError(f"ground: the file has its own ground: omit ground= ({_plain(error)})") from error
    return (f"A ground was added at z = 0, with friction {friction:g}.",) if ground is True else ()


def _plain(error: BaseException) -> str:
    """Return Drake's error message without the name of its internal function."""
    return str(error).split("(): ", 1)[-1].strip()


SLACK = 1e-9  # [m or rad] tolerance for limits that meet in one point up to rounding


@dataclass(frozen=True, eq=False)
class JointCoupling:
    """The independent ("own") coordinates of a plant with mimic joints, and the map to all coordinates.

    Each entry of the plant's q (n,) is ratio * own entry `of_q` + offset, each of its v (m,) ratio * own entry `of_v`.
    """

    mimics: tuple[Mimic, ...]
    own_q: NDArray[np.intp]  # (nq,) indices of the independent coordinates in the plant's q
    own_v: NDArray[np.intp]  # (nv,)
    of_q: NDArray[np.intp]  # (n,)
    of_v: NDArray[np.intp]  # (m,)
    ratio_q: Array  # (n,)
    ratio_v: Array  # (m,)
    offset: Array  # (n,)

    @property
    def spread(self) -> Array:
        """The matrix E (m, nv)."""
        E = np.zeros((len(self.of_v), len(self.own_v)))
        E[np.arange(len(self.of_v)), self.of_v] = self.ratio_v
        return E

    def positions(self, q: Any) -> Any:
        """Return the plant's q (..., n) for the own q (..., nq), floats or AutoDiffXd."""
        return self.ratio_q * q[..., self.of_q] + self.offset

    def velocities(self, v: Any) -> Any:
        """Return the plant's v (..., m) for the own v (..., nv)."""
        return self.ratio_v * v[..., self.of_v]

    def state(self, x: Any) -> Any:
        """Return the plant's [q; v] (..., n + m) for the own x (..., nx)."""
        nq = len(self.own_q)
        return np.concatenate([self.positions(x[..., :nq]), self.velocities(x[..., nq:])], axis=-1)

    def own_state(self, state: Any) -> Any:
        """Return the own x for the plant's [q; v], without the followers."""
        return np.concatenate([state[: len(self.of_q)][self.own_q], state[len(self.of_q) :][self.own_v]])

    def forces(self, force: Any) -> Any:
        """Return E' f (nv,) for the plant's generalized force f (m,), floats or AutoDiffXd."""
        reduced = force[self.own_v]
        for i in np.setdiff1d(np.arange(len(self.of_v)), self.own_v):
            reduced[self.of_v[i]] = reduced[self.of_v[i]] + self.ratio_v[i] * force[i]
        return reduced

    def limits(self, lower: Array, upper: Array, *, of_velocities: bool = False) -> tuple[Array, Array]:
        """Return the own lower and upper limits (n,) that satisfy all limits of the plant."""
        leader, ratio = (self.of_v, self.ratio_v) if of_velocities else (self.of_q, self.ratio_q)
        offset = np.zeros(len(leader)) if of_velocities else self.offset
        count = len(self.own_v if of_velocities else self.own_q)
        low, high = np.full(count, -np.inf), np.full(count, np.inf)
        for i, k in enumerate(leader):
            ends = sorted(((lower[i] - offset[i]) / ratio[i], (upper[i] - offset[i]) / ratio[i]))
            low[k], high[k] = max(low[k], ends[0]), min(high[k], ends[1])
        return low, high

    def next_velocities(self, A: Any, v: Any) -> Any:
        """Return the own velocities (nv,) for the plant's v (m,) after a step with the matrix A (m, m)."""
        E = self.spread
        if A.dtype == float:
            return np.linalg.solve(E.T @ A @ E, E.T @ (A @ v))
        value = ExtractValue(A)
        mass = E.T @ value @ E
        solution = np.linalg.solve(mass, E.T @ (value @ ExtractValue(v.reshape(-1, 1)).ravel()))
        missing = self.forces(A @ (v - self.velocities(solution)))  # 0 with nonzero derivatives: a Newton step
        return solution + np.linalg.inv(mass) @ missing


def _called(plant: MultibodyPlant, mimic: Mimic, name: str) -> list[Any]:
    """Return the joints with a name, only from the mimic's model instance if the name is not unique."""
    same_name = [j for j in joints(plant) if j.name() == name]
    same_instance = [j for j in same_name if plant.GetModelInstanceName(j.model_instance()) == mimic.instance]
    return same_instance if len(same_name) > 1 else same_name


def _joint(plant: MultibodyPlant, mimic: Mimic, name: str) -> Any:
    matches = _called(plant, mimic, name)
    if len(matches) != 1:
        raise ModelError(f"mimic: the joint {mimic.follower} follows {mimic.leader}, but no joint {name} exists")
    if not can_be_driven(matches[0]):
        kind = matches[0].type_name()
        raise ModelError(f"mimic: {mimic}: expected revolute or prismatic joints, got the {kind} joint {name}")
    return matches[0]


def joints_of_mimics(plant: MultibodyPlant, mimics: tuple[Mimic, ...]) -> list[tuple[Mimic, Any, Any]]:
    """Return each mimic with its follower and leader joints."""
    triples = [(m, _joint(plant, m, m.follower), _joint(plant, m, m.leader)) for m in mimics]
    for mimic, _, _ in triples:
        if mimic.ratio == 0 or not np.isfinite([mimic.ratio, mimic.offset]).all():
            raise ModelError(f"mimic: {mimic}: expected a finite ratio other than 0")
    return triples


def _resolved(pairs: list[tuple[Mimic, Any, Any]]) -> dict[Any, tuple[Any, float, float]]:
    """Map the index of each follower to its final leader with q = ratio * (leader's q) + offset."""
    direct = {follower.index(): (leader, m.ratio, m.offset) for m, follower, leader in pairs}
    resolved = {}
    for follower in direct:
        leader, ratio, offset = direct[follower]
        seen = {follower}
        while leader.index() in direct:
            if leader.index() in seen:
                raise ModelError(f"mimic: {leader.name()} follows itself through other joints")
            seen.add(leader.index())
            leader, r, o = direct[leader.index()]
            ratio, offset = ratio * r, ratio * o + offset
        resolved[follower] = (leader, ratio, offset)
    return resolved


def uncoupled(plant: MultibodyPlant, mimics: Iterable[Mimic]) -> tuple[Mimic, ...]:
    """Remove the constraints of mimic joints from a plant that is not finalized, and return the mimic joints.

    Raises ModelError if a constraint cannot be removed, or if the plant has other constraints, because pydrake does not
    identify them.
    """
    couplings = tuple(mimics)
    _resolved(joints_of_mimics(plant, couplings))
    known, count = sum(m.in_drake for m in couplings), int(plant.num_constraints())
    if couplings and count != known:
        raise ModelError(
            f"mimic: the model has {count} constraints for {known} mimic joints, and Drake does not identify "
            "them: remove the other constraints (balls, welds, distances) from the file"
        )
    for constraint in plant.GetConstraintIds() if couplings else ():
        plant.RemoveConstraint(constraint)
    return couplings


def still_moving(plant: MultibodyPlant, mimics: Iterable[Mimic]) -> tuple[Mimic, ...]:
    """Return the mimics whose follower was not fixed by name; raise ModelError if a leader was fixed."""

    def fixed(mimic: Mimic, name: str) -> bool:
        return any(joint.num_velocities() == 0 for joint in _called(plant, mimic, name))

    left = tuple(mimic for mimic in mimics if not fixed(mimic, mimic.follower))
    for mimic in left:
        if fixed(mimic, mimic.leader):
            raise ModelError(f"fix_joints={mimic.leader!r}: {mimic.follower} mimics it: fix {mimic.follower} too")
    return left


def fix_mimics(plant: MultibodyPlant, mimics: tuple[Mimic, ...]) -> tuple[str, ...]:
    """Weld followers and leaders, and return a note with their positions.

    The leader is at its default position, or at the nearest position that all joints' limits allow.
    """
    followers = _resolved(joints_of_mimics(plant, mimics))
    by_index = {j.index(): j for j in joints(plant)}
    welds: list[tuple[Any, float]] = []
    for leader in {leader.index(): leader for leader, _, _ in followers.values()}.values():
        led = [(by_index[f], r, o) for f, (who, r, o) in followers.items() if who.index() == leader.index()]
        moving = [(leader, 1.0, 0.0), *led]
        ends = [
            sorted((float(end[0]) - offset) / ratio for end in (j.position_lower_limits(), j.position_upper_limits()))
            for j, ratio, offset in moving
        ]
        low, high = max(low for low, _ in ends), min(high for _, high in ends)
        _check_limits(leader.name(), low, high)
        q = float(np.clip(leader.default_positions()[0], low, max(low, high)))
        welds += [(joint, ratio * q + offset) for joint, ratio, offset in moving]
    positions = [f"{joint.name()} at {q:.6g}" for joint, q in welds]  # before the joints are removed
    for joint, q in welds:
        weld(plant, joint, q, f"mimic='fix': {joint.name()}")
    return note(f"{len(welds)} mimic joints and the joints that they follow were fixed", positions)


def _check_limits(leader: str, low: float, high: float) -> None:
    if low > high + SLACK:
        raise ModelError(f"mimic: no position of {leader} is within its limits and those of all joints that follow it")


def couple(plant: MultibodyPlant, mimics: tuple[Mimic, ...]) -> tuple[str, ...]:
    """Add the constraints of mimic joints to Drake again, and return a note on the reduction."""
    for mimic, follower, leader in joints_of_mimics(plant, mimics):
        plant.AddCouplerConstraint(follower, leader, mimic.ratio, mimic.offset)
    return note(f"{len(mimics)} mimic joints were reduced", [str(mimic) for mimic in mimics])


def coupling_of(plant: MultibodyPlant, mimics: tuple[Mimic, ...]) -> JointCoupling | None:
    """Return the independent coordinates of a finalized plant, or None if it has no mimic joints."""
    if not mimics:
        return None
    followers = _resolved(joints_of_mimics(plant, mimics))
    n, m = plant.num_positions(), plant.num_velocities()
    leading_q, leading_v, ratio_q, ratio_v, offset = np.arange(n), np.arange(m), np.ones(n), np.ones(m), np.zeros(n)
    for index, (leader, ratio, add) in followers.items():
        i, j = (plant.get_joint(index).position_start(), plant.get_joint(index).velocity_start())
        leading_q[i], leading_v[j] = leader.position_start(), leader.velocity_start()
        ratio_q[i], ratio_v[j], offset[i] = ratio, ratio, add
    own_q, own_v = np.flatnonzero(leading_q == np.arange(n)), np.flatnonzero(leading_v == np.arange(m))
    of_q, of_v = np.searchsorted(own_q, leading_q), np.searchsorted(own_v, leading_v)
    coupling = JointCoupling(mimics, own_q, own_v, of_q, of_v, ratio_q, ratio_v, offset)
    names = plant.GetPositionNames(add_model_instance_prefix=False)
    lows, highs = coupling.limits(plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits())
    for i, low, high in zip(own_q, lows, highs, strict=True):
        _check_limits(names[i].rsplit("_", 1)[0], low, high)
    return coupling
