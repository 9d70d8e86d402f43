"""A finding of an audit, the point that its checks look at, and the checks of what a robot file says.

A stranger's file loads, and then cannot be driven, falls through the floor, or has masses that nobody wrote. A finding
has the argument of `load_model` that mends it.
"""

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from pydrake.geometry import HalfSpace, ProximityProperties, VolumeMesh
from pydrake.multibody.plant import ContactModel, DiscreteContactApproximation

from drake_diff._base.arrays import Array
from drake_diff._base.values import ShowsItsRepr
from drake_diff.derivatives.step import StepDerivatives, differentiate_step
from drake_diff.exceptions import DrakeDiffError, GradientError, ModelError, SimulationError
from drake_diff.model.contact_geometry import autodiff_supports, collision_geometries, inseparable_pairs, links_of
from drake_diff.model.model import Model
from drake_diff.model.plant import FLOATING, PROXIMITY, actuators, bodies, joints, labelled
from drake_diff.model.repairs import can_be_driven
from drake_diff.model.step import advance, set_state

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")


@dataclass(frozen=True, repr=False)
class Finding(ShowsItsRepr):
    """Something to know before a model is differentiated.

    `severity` is "error" if Drake throws here or the derivative is wrong, "warning" if it may be or a number was not
    chosen, and "info" if it is taken care of or a limit to know. `code` is a stable name of the kind of finding,
    `subject` the part of the model, `message` says what is found and `remedy` what to change. `arguments` are those of
    `load_model` with which the same file has no such finding; empty where the file, x or u has to change.

    Example:
        >>> from drake_diff.certificates import Finding
        >>> Finding("info", "locked_joint", "elbow", "is locked", "unlock it")
        info locked_joint (elbow): is locked
          -> unlock it
    """

    severity: Severity
    code: str
    subject: str
    message: str
    remedy: str
    arguments: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __str__(self) -> str:
        return f"{self.severity} {self.code} ({self.subject}): {self.message}\n  -> {self.remedy}"

    __repr__ = __str__


class Findings(list[Finding], ShowsItsRepr):
    """What an audit found, the worst first: a list that prints one finding below the other."""

    def __str__(self) -> str:
        return "\n".join(map(str, self)) or "nothing found"

    __repr__ = __str__


PARALLEL = 1e-6  # [rad] between face normals


@dataclass(frozen=True, eq=False)
class Collider:
    """A collision geometry at x. `own` is what the file or the user gave it, `all` what Drake uses."""

    id: Any
    label: str
    body: str
    shape: Any
    pose: Any  # X_WG
    box: Any  # its oriented box in its own frame; None for a half space
    compliance: Literal["none", "rigid", "compliant"]
    own: ProximityProperties
    all: ProximityProperties

    @property
    def kind(self) -> str:
        return type(self.shape).__name__

    def axis(self, i: int) -> Array:
        """(3,) the unit vector of its frame in the world."""
        return np.asarray(self.pose.rotation().matrix())[:, i]

    def extent(self, direction: Array) -> tuple[float, float]:
        """Where its box begins and ends [m] along a direction in the world."""
        if self.box is None:
            middle, along = float(direction @ self.pose.translation()), float(direction @ self.axis(2))
            infinite = abs(along) < 1 - PARALLEL
            return (-np.inf if infinite or along > 0 else middle), (np.inf if infinite or along < 0 else middle)
        pose = self.pose @ self.box.pose()
        middle = float(direction @ pose.translation())
        half = float(np.abs(direction @ pose.rotation().matrix()) @ self.box.half_width())
        return middle - half, middle + half


@dataclass(frozen=True, eq=False)
class Pair:
    """Two geometries that can collide."""

    a: Collider
    b: Collider
    model: Any

    @property
    def label(self) -> str:
        return f"{self.a.label} - {self.b.label}"

    @property
    def bodies(self) -> tuple[str, str]:
        return self.a.body, self.b.body

    @property
    def contact(self) -> Literal["point", "hydroelastic", "none"]:
        """What Drake computes between them; "none" is what it throws at."""
        both = {self.a.compliance, self.b.compliance}
        soft_half_space = both == {"compliant"} and "HalfSpace" in (self.a.kind, self.b.kind)
        hydroelastic = "none" not in both and both != {"rigid"} and not soft_half_space
        if self.model == ContactModel.kPoint:
            return "point"
        if hydroelastic:
            return "hydroelastic"
        return "none" if self.model == ContactModel.kHydroelastic else "point"

    @property
    def refused(self) -> bool:
        return self.contact == "none" or not autodiff_supports(self.a.shape, self.b.shape, self.contact)

    def of_kinds(self, a: type, b: type) -> tuple[Collider, Collider] | None:
        """The two in the order of the shapes that are asked for."""
        for first, other in ((self.a, self.b), (self.b, self.a)):
            if isinstance(first.shape, a) and isinstance(other.shape, b):
                return first, other
        return None


@dataclass(frozen=True, eq=False)
class Place:
    """A model at x, u: what several checks ask for, computed once."""

    model: Model
    x: Array
    u: Array

    @cached_property
    def has_poses(self) -> bool:
        """Whether Drake can place the bodies: not with a quaternion of zeros."""
        plant, context = self.model.plant, self.model.double.context
        set_state(self.model.double, self.x)
        try:
            plant.EvalBodyPoseInWorld(context, plant.world_body())
        except RuntimeError:
            return False
        return True

    @cached_property
    def step_error(self) -> SimulationError | None:
        """Why the double step fails here."""
        try:
            advance(self.model.double, self.x, self.u)
        except SimulationError as error:
            return error
        return None

    @cached_property
    def by_autodiff(self) -> StepDerivatives | DrakeDiffError:
        """The Jacobians by AutoDiffXd through the whole step, or why there are none."""
        try:
            return differentiate_step(self.model, self.x, self.u, method="autodiff")
        except (GradientError, ModelError, SimulationError) as error:
            return error

    @cached_property
    def query(self) -> Any:
        """Drake's QueryObject; it sees the state that the double context has when it is asked."""
        return self.model.plant.get_geometry_query_input_port().Eval(self.model.double.context)

    @cached_property
    def colliders(self) -> dict[Any, Collider]:
        """Those that can collide, by id, at x."""
        set_state(self.model.double, self.x)
        colliders = {}
        for id_ in sorted({g for pair in self.candidates for g in pair}, key=lambda g: g.get_value()):
            inspector, model_inspector = self.query.inspector(), self.model.double.scene_graph.model_inspector()
            body = self.model.plant.GetBodyFromFrameId(inspector.GetFrameId(id_))
            shape, body_name = inspector.GetShape(id_), body.name() if body is not None else "?"
            colliders[id_] = Collider(
                id=id_,
                label=f"{body_name}/{inspector.GetName(id_).split('::')[-1]} ({type(shape).__name__})",
                body=body_name,
                shape=shape,
                pose=self.query.GetPoseInWorld(id_),
                box=inspector.GetObbInGeometryFrame(id_),
                compliance=_compliance(self, id_, shape),
                own=model_inspector.GetProximityProperties(id_),
                all=inspector.GetProximityProperties(id_),
            )
        return colliders

    @cached_property
    def candidates(self) -> list[tuple[Any, Any]]:
        """The ids of the geometries that can collide."""
        port = self.model.plant.get_geometry_query_input_port()
        if self.model.double.scene_graph is None or not port.HasValue(self.model.double.context):
            return []
        return sorted(self.query.inspector().GetCollisionCandidates(), key=lambda p: [g.get_value() for g in p])

    @cached_property
    def pairs(self) -> list[Pair]:
        contact = self.model.plant.get_contact_model()
        return [Pair(self.colliders[a], self.colliders[b], contact) for a, b in self.candidates]


def _compliance(point: Place, id_: Any, shape: Any) -> Literal["none", "rigid", "compliant"]:
    """How hydroelastic contact sees a geometry. Python cannot read Drake's compliance_type, so by its mesh."""
    scene_graph = point.model.double.scene_graph
    if not isinstance(shape, HalfSpace):
        mesh = point.query.inspector().maybe_get_hydroelastic_mesh(id_)
        return "none" if mesh is None else "compliant" if isinstance(mesh, VolumeMesh) else "rigid"
    properties = scene_graph.model_inspector().GetProximityProperties(id_)
    if properties.HasProperty("hydroelastic", "compliance_type"):
        return "compliant" if properties.HasProperty("hydroelastic", "slab_thickness") else "rigid"
    default = scene_graph.get_config().default_proximity_properties.compliance_type
    return "none" if default == "undefined" else "compliant" if default == "compliant" else "rigid"


Found = Iterator[Finding]
NAMES_TOLD = 8  # of links or joints; of more the others are counted
SAME_MASS = 1e-6  # relative: a file's mass and trace of inertia against the plant's
NO_MASS = 1e-12  # [kg or kg m^2] of a joint's own entry of the mass matrix
CORNER = re.compile(r"_corner_\d+$")  # what replace_collision_geometry calls its spheres
IGNORED = re.compile(r"ignored|not currently support|only supports|unsupported|Skipping transmission", re.IGNORECASE)
SKIPPED = re.compile(r"\d+ collision meshes skipped")  # those that exist and that Drake cannot use
HARMLESS = (
    "safety_controller",
    "calibration",
    "found in a 'link'",
    "fixed joint",
    "texture",
    "material",
    "transmission'",
    "only Gazebo reads",
    *("camera", "light", "visual", "'site'", "sensor", "statistic", "timestep", "integrator", "keyframe", "'user'"),
    *("'cone'", "iterations", "custom", "'size'"),
)


def _listed(names: Any) -> str:
    unique = list(dict.fromkeys(names))
    more = f" and {len(unique) - NAMES_TOLD} more" if len(unique) > NAMES_TOLD else ""
    return ", ".join(unique[:NAMES_TOLD]) + more


def _no_actuator(point: Place) -> Found:
    model, facts = point.model, point.model.file_facts
    if model.source is None:
        return
    driven = {actuator.joint().index() for actuator in actuators(model.plant)}
    undriven = []
    for name, joint in labelled(joints(model.plant)).items():
        key = (model.plant.GetModelInstanceName(joint.model_instance()), joint.name())
        says = facts.joints.get(key)
        passive = says is not None and says.passive
        if can_be_driven(joint) and joint.index() not in driven and not passive and key not in facts.followers:
            undriven.append((name, 0.0 if says is None else says.effort or 0.0))
    remedy = 'load_model(..., actuators="all"), names of joints, or {joint: effort limit}; nothing if it is passive'
    if undriven and not driven:
        message = f"none of its {len(undriven)} joints has an actuator in the file, so that there is no input"
        subject = _listed(name for name, _ in undriven)
        yield Finding("warning", "no_actuator", subject, message, remedy, {"actuators": "all"})
        return
    meant = [name for name, effort in undriven if effort > 0]
    if meant:
        message = f"{len(meant)} joints have an effort limit in the file and no actuator; {len(driven)} others have one"
        yield Finding("info", "undriven", _listed(meant), message, remedy, {"actuators": meant})


def _lost_armature(point: Place) -> Found:
    plant, facts = point.model.plant, point.model.file_facts
    driven = {actuator.joint().index() for actuator in actuators(plant)}
    lost = [
        name
        for name, joint in labelled(joints(plant)).items()
        if (says := facts.joints.get((plant.GetModelInstanceName(joint.model_instance()), joint.name()))) is not None
        and (says.armature and joint.index() not in driven and can_be_driven(joint))
    ]
    if lost:
        message = "Drake has the armature of a joint only with an actuator on it: here their inertia is too small"
        remedy = "load_model(..., actuators=) with these joints"
        yield Finding("warning", "lost_armature", _listed(lost), message, remedy, {"actuators": lost})


def _left_out_actuators(point: Place) -> Found:
    plant, facts = point.model.plant, point.model.file_facts
    for note in point.model.notes:
        match = re.match(r"(\d+ actuators left out)[^:]*: (.*)\.$", note)
        if not match:
            continue
        message = f"{match[1]}, of kinds or transmissions that Drake does not read: {match[2]}"
        remedy = "drive joints with a torque of their own, load_model(..., actuators=), or write the file with motors"
        driven = {actuator.joint().index() for actuator in actuators(plant)}
        missing = [
            name
            for name, joint in labelled(joints(plant)).items()
            if can_be_driven(joint)
            and joint.index() not in driven
            and (plant.GetModelInstanceName(joint.model_instance()), joint.name()) in facts.left_out
        ]
        others = any(not joint for _, joint in facts.left_out)  # of tendons and sites, which no joint stands for
        if missing or others:
            arguments = {"actuators": missing} if missing and not others else {}
            yield Finding("warning", "left_out", "actuators", message, remedy, arguments)


def _switched_off(point: Place) -> Found:
    facts, gravity = point.model.file_facts, point.model.plant.gravity_field().gravity_vector()
    begin = "the file switches it off, and Drake has it all the same"
    if facts.disabled & {"contact", "constraint"} and point.pairs:
        yield Finding("warning", "switched_off", "contact", begin, "load_model(..., contact=False)", {"contact": False})
    if "gravity" in facts.disabled and np.any(gravity):
        remedy = "load_model(..., gravity=[0, 0, 0])"
        yield Finding("warning", "switched_off", "gravity", begin, remedy, {"gravity": [0.0, 0.0, 0.0]})


def _massless(point: Place) -> Found:
    plant = point.model.plant
    for base in sorted(plant.GetFloatingBaseBodies()):
        held = plant.GetBodiesWeldedTo(plant.get_body(base))
        if sum(body.default_mass() for body in held) == 0:
            message = "it has no mass and floats, so that nothing holds up what hangs on it and the step is singular"
            remedy, arguments = "give it a mass in the file", dict[str, Any]()
            if any(joint.num_velocities() and joint.parent_body() in held for joint in joints(plant)):
                remedy, arguments = (
                    'load_model(..., base="weld") if it stands fixed, else give it a mass in the file',
                    {"base": "weld"},
                )
            yield Finding("error", "massless_root", plant.get_body(base).name(), message, remedy, arguments)
    set_state(point.model.double, point.x)
    mass = np.diag(plant.CalcMassMatrix(point.model.double.context))
    light = [
        name
        for name, joint in labelled(joints(plant)).items()
        if can_be_driven(joint) and mass[joint.velocity_start()] < NO_MASS
    ]
    if light:
        message = "nothing that they move has a mass or an inertia, so that the step is singular"
        remedy = "give the links a mass in the file"
        arguments = _fixed(point.model, light)
        if arguments:
            remedy = f"load_model(..., fix_joints=) fixes them, or {remedy}"
        yield Finding("error", "massless_joint", _listed(light), message, remedy, arguments)


def _fixed(model: Model, names: list[str]) -> dict[str, Any]:
    """The argument that fixes these joints, none where nothing could move then."""
    return {"fix_joints": names} if len(names) < model.plant.num_velocities() else {}


def _lost_shapes(point: Place) -> Found:
    model, scene_graph = point.model, point.model.double.scene_graph
    for note in model.notes:
        if re.search(r"\bmeshes skipped", note):
            severity: Severity = "warning" if "collision" in note else "info"
            remedy = (
                'load_model(..., meshes="convex") or "spheres" takes collision meshes; packages= says where they are'
            )
            summary = note.split(":")[0].split("; ")[0]
            arguments = {"meshes": "spheres"} if SKIPPED.match(note) else {}
            yield Finding(severity, "meshes_skipped", "meshes", summary, remedy, arguments)
    if scene_graph is None or (model.options or {}).get("contact") is False:
        return
    with_shapes = {body.index() for body, _ in collision_geometries(model.plant, scene_graph)}
    lost, given = [], 0
    for body in bodies(model.plant):
        says = model.file_facts.links.get((model.plant.GetModelInstanceName(body.model_instance()), body.name()))
        if says is not None and says.collisions:
            given += 1
            lost += [] if body.index() in with_shapes else [body.name()]
    if lost:
        much = "no collision shape of the file is left" if len(lost) == given else "they have lost all collision shapes"
        remedy = 'load_model(..., meshes="convex") or "spheres"; contact=False says that nothing is to touch'
        message = f"{much}, so that they pass through things"
        mends: dict[str, Any] = {"meshes": "spheres"} if _has_usable_meshes(model) else {"contact": False}
        yield Finding("warning", "collision_gone", _listed(lost), message, remedy, mends)


def _never_apart(point: Place) -> Found:
    model, scene_graph = point.model, point.model.double.scene_graph
    if scene_graph is None or not model.contract.contact.collision_pairs:
        return
    try:
        pairs = inseparable_pairs(model.plant, model.diagram)
    except ModelError:
        return  # as no step of it can be taken then, which is a finding of its own
    if pairs:
        message = (
            f"they overlap wherever the joints are (pairs of shapes: {len(pairs)}), and push each other apart in every "
            "step; of deep overlaps Drake's point of contact jumps, and has no derivative"
        )
        remedy = 'load_model(..., contact="separable") lets these pairs alone pass through each other'
        subject = links_of(model.plant, scene_graph, pairs)
        yield Finding("warning", "never_apart", subject, message, remedy, {"contact": "separable"})


def _has_usable_meshes(model: Model) -> bool:
    """Whether collision meshes were left out that `meshes="convex"` would take."""
    return any(SKIPPED.match(note) for note in model.notes)


def _falls(point: Place) -> Found:
    plant = point.model.plant
    if not np.any(plant.gravity_field().gravity_vector()) or point.model.double.scene_graph is None:
        return
    fixed = {body.name() for body in plant.GetBodiesWeldedTo(plant.world_body())}
    floating = {joint.child_body().index(): joint for joint in joints(plant) if joint.type_name() in FLOATING}
    for base in sorted(plant.GetFloatingBaseBodies()):
        affected = plant.GetBodiesKinematicallyAffectedBy([floating[base].index()])
        tree = {plant.get_body(index).name() for index in affected}
        shapes = {body.name() for body, _ in collision_geometries(plant, point.model.double.scene_graph)}
        moving = sum(j.num_velocities() > 0 and j.child_body().name() in tree for j in joints(plant)) > 1
        standing = any(set(pair.bodies) & tree and set(pair.bodies) & fixed for pair in point.pairs)
        if standing or not (moving or shapes & tree):
            continue
        name = plant.get_body(base).name()
        remedy = 'load_model(..., ground=True), base="weld" if it stands fixed, or nothing if it flies'
        why = "there is nothing fixed below it that it could touch"
        arguments: dict[str, Any] = {"ground": True}
        if not shapes & tree:
            why = "nothing of it can touch, as it has no collision shapes"
            remedy = 'load_model(..., meshes="convex" or "spheres", ground=True), base="weld", or nothing if it flies'
            arguments = {"base": "weld"}
            if _has_usable_meshes(point.model):
                arguments = {"meshes": "spheres", "ground": True}
        yield Finding("warning", "falls", name, f"it floats and falls for ever: {why}", remedy, arguments)


def _invented_inertia(point: Place) -> Found:
    plant = point.model.plant
    fixed = {int(body.index()) for body in plant.GetBodiesWeldedTo(plant.world_body())}
    kinds: dict[tuple[Severity, str], list[str]] = {}
    for body in bodies(plant):
        says = point.model.file_facts.links.get((plant.GetModelInstanceName(body.model_instance()), body.name()))
        if says is None or int(body.index()) in fixed:
            continue
        inertia = body.default_spatial_inertia()
        mass, about_center = inertia.get_mass(), inertia.Shift(inertia.get_com()).CalcRotationalInertia()
        trace = float(np.trace(about_center.CopyToFullMatrix3()))
        kind: tuple[Severity, str] | None = None
        if says.mass is None and says.defaults:
            kind = ("warning", "the file gives no mass, so that it is the format's own, 1 kg")
        elif says.mass is not None and not np.isclose(mass, says.mass, rtol=SAME_MASS, atol=0):
            kind = (
                "error",
                f"the file's mass {says.mass:g} kg goes with no inertia; Drake takes {mass:g} kg, a ball of water",
            )
        elif says.trace is None and says.defaults:
            kind = ("warning", "the file gives no inertia, so that it is the format's own, 1 kg m^2 about each axis")
        elif says.trace is not None and not np.isclose(trace, says.trace, rtol=SAME_MASS, atol=1e-12):
            kind = (
                "warning",
                "no body can have the file's inertia; Drake takes that of a ball of water of the same mass",
            )
        if kind is not None:
            kinds.setdefault(kind, []).append(body.name())
    for (severity, message), names in kinds.items():
        remedy = (
            "give a mass above 0, and an inertia whose moments each are at most the sum of the other two, in the file"
        )
        yield Finding(severity, "invented_inertia", _listed(names), message, remedy)


def _unread_compliance(point: Place) -> Found:
    sap = point.model.plant.get_discrete_contact_approximation() == DiscreteContactApproximation.kSap
    given, read = ("dissipation", "relaxation_time") if sap else ("relaxation_time", "dissipation")
    names = [
        collider.label
        for collider in point.colliders.values()
        if collider.own.HasProperty(*PROXIMITY[given]) and not collider.own.HasProperty(*PROXIMITY[read])
    ]
    if names:
        by = "sap" if sap else "similar and lagged"
        message = f"{PROXIMITY[given][1]} is given, and {by} read {PROXIMITY[read][1]}, which is not"
        other = "similar" if sap else "sap"
        remedy = f'give drake:{PROXIMITY[read][1]} too, or load_model(..., contact_approximation="{other}")'
        yield Finding("warning", "unread_compliance", _listed(names), message, remedy, {"contact_approximation": other})


def _ignored(point: Place) -> Found:
    kinds: dict[str, list[str]] = {}
    for note in point.model.notes:
        first = re.sub(r"^.*?warning: ", "", note.splitlines()[0])
        first = re.sub(r"(Skipping transmission since it's attached to a fixed joint).*", r"\1", first)
        if IGNORED.search(first) and "meshes skipped" not in first:
            kinds.setdefault(
                re.sub(r"(joint|link|geom) '?[\w/.:-]+'?(?= has)|'-?[\d.eE+-]+'", r"\1 ...", first), []
            ).append(note)
    for kind, notes in kinds.items():
        quoted = re.search(r"'([^']+)'", kind)
        severity: Severity = "info" if any(word in kind for word in HARMLESS) else "warning"
        message = f"{len(notes)} times in the file, and Drake does not read it: {kind}"
        remedy = (
            "nothing if it does not matter, else say it in a way that Drake reads, or change the plant in a diagram"
        )
        yield Finding(severity, "ignored", quoted[1] if quoted else "file", message, remedy)


def _zero_limits(point: Place) -> Found:
    plant, kinds = point.model.plant, dict[tuple[str, str], list[str]]()
    followers = point.model.file_facts.followers
    driven = {actuator.joint().index() for actuator in actuators(plant)}
    for name, joint in labelled(joints(plant)).items():
        if not can_be_driven(joint):
            continue
        low, high = float(joint.position_lower_limits()[0]), float(joint.position_upper_limits()[0])
        mended = "" if joint.index() in driven else "actuators"
        if (plant.GetModelInstanceName(joint.model_instance()), joint.name()) in followers:
            mended = "mimic"
        if joint.velocity_lower_limits()[0] == 0 == joint.velocity_upper_limits()[0]:
            kinds.setdefault(("the velocity limit is 0", mended), []).append(name)
        if low == high:
            how = "" if mended == "actuators" and low else mended
            kinds.setdefault((f"the position limits are both {low:g}", how), []).append(name)
    for (kind, mended), names in kinds.items():
        arguments = _fixed(point.model, names)
        remedy = "load_model(..., fix_joints=) fixes such joints there" if arguments else "give it limits in the file"
        if mended == "actuators":
            remedy = (
                "load_model(..., actuators=) takes limits of 0 of the joints that it drives as none; or fix_joints="
            )
            arguments = {"actuators": names}
        elif mended == "mimic":
            remedy, arguments = 'load_model(..., mimic="fix") welds joints that follow others', {"mimic": "fix"}
        message = f"{kind}: no plan can move what has it"
        yield Finding("error", "zero_limit", _listed(names), message, remedy, arguments)


def _corners_on_both_sides(point: Place) -> Found:
    trees = _trees(point.model.plant)
    met: dict[str, None] = {}
    for pair in point.pairs:
        both = [re.sub(r" \(Sphere\)$", "", label) for label in (pair.a.label, pair.b.label)]
        if all(CORNER.search(label) for label in both) and trees[pair.a.body] != trees[pair.b.body]:
            met[" - ".join(sorted(pair.bodies))] = None
    if met:
        message = "both are spheres in their corners alone, which miss each other: what one holds falls out of it"
        remedy = (
            'contact_geometry="hydroelastic" with contact_model="hydroelastic_with_fallback", or "differences"; or '
            "give one of them spheres over the face that touches, in the file"
        )
        yield Finding("warning", "corners_miss", _listed(met), message, remedy, {"contact_geometry": "differences"})


def _trees(plant: Any) -> dict[str, str]:
    """For each body the first one, from the world on, of those that hang together with it and move."""
    fixed = {body.name() for body in plant.GetBodiesWeldedTo(plant.world_body())}
    above = {joint.child_body().name(): joint.parent_body().name() for joint in joints(plant)}

    def first(name: str) -> str:
        while name in above and above[name] not in fixed:
            name = above[name]
        return name

    return {body.name(): first(body.name()) for body in [plant.world_body(), *bodies(plant)]}


FILE_CHECKS: tuple[Callable[[Place], Found], ...] = (
    _no_actuator,
    _left_out_actuators,
    _lost_armature,
    _switched_off,
    _massless,
    _lost_shapes,
    _never_apart,
    _falls,
    _invented_inertia,
    _unread_compliance,
    _ignored,
    _zero_limits,
    _corners_on_both_sides,
)
