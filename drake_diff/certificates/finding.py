"""The findings of an audit, and the properties of a model at a point that its checks read."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from pydrake.geometry import HalfSpace, VolumeMesh
from pydrake.multibody.plant import ContactModel, DiscreteContactApproximation

from drake_diff._base.arrays import Array
from drake_diff._base.values import ShowsItsRepr
from drake_diff.derivatives.step import StepDerivatives, differentiate_step
from drake_diff.exceptions import DrakeDiffError, GradientError, ModelError, SimulationError
from drake_diff.model.contact_geometry import autodiff_supports
from drake_diff.model.model import Model
from drake_diff.model.plant import PROXIMITY, actuators, joints, key_of, labelled
from drake_diff.model.repairs import can_be_driven
from drake_diff.model.step import advance, set_state

Severity = Literal["error", "warning", "info"]
SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")
LONGEST_LIST = 8  # number of names in a message; further names are only counted
PARALLEL = 1e-6  # [rad] between face normals


@dataclass(frozen=True, repr=False)
class Finding(ShowsItsRepr):
    """A property of a model that affects its derivatives.

    `severity` is "error" if Drake raises an error or the derivative is wrong, "warning" if the derivative may be wrong
    or a default value applies, and "info" for a limitation or a problem that the package handles. `code` is a stable
    name of the kind of finding, `subject` is the part of the model, `message` describes the finding, and `remedy` the
    proposed change. `arguments` of `load_model` avoid the finding; they are empty if the file, x or u has to change.

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
    """The findings of an audit, the most severe first: a list that prints one finding below the other."""

    def __str__(self) -> str:
        return "\n".join(map(str, self)) or "nothing found"

    __repr__ = __str__


def listed(names: Any) -> str:
    """Return the first names, and the number of further names."""
    unique = list(dict.fromkeys(names))
    more = f" and {len(unique) - LONGEST_LIST} more" if len(unique) > LONGEST_LIST else ""
    return ", ".join(unique[:LONGEST_LIST]) + more


@dataclass(frozen=True, eq=False)
class Collider:
    """A collision geometry at x, with the properties `given` by the file or the user and those `used` by Drake."""

    id: Any
    label: str
    body: str
    shape: Any
    pose: Any  # X_WG
    box: Any  # oriented bounding box in the geometry's frame; None for a half space
    compliance: Literal["none", "rigid", "compliant"]
    given: Any  # ProximityProperties
    used: Any

    @property
    def kind(self) -> str:
        return type(self.shape).__name__

    def has(self, quantity: str) -> bool:
        """Return whether a quantity of PROXIMITY is given."""
        return bool(self.given.HasProperty(*PROXIMITY[quantity]))

    def axis(self, i: int) -> Array:
        """Return the unit vector (3,) of axis i of the geometry's frame, in the world frame."""
        return np.asarray(self.pose.rotation().matrix())[:, i]

    def extent(self, direction: Array) -> tuple[float, float]:
        """Return the interval [m] that the bounding box covers along a direction in the world frame."""
        if self.box is None:
            middle, along = float(direction @ self.pose.translation()), float(direction @ self.axis(2))
            infinite = abs(along) < 1 - PARALLEL
            return (-np.inf if infinite or along > 0 else middle), (np.inf if infinite or along < 0 else middle)
        pose = self.pose @ self.box.pose()
        middle = float(direction @ pose.translation())
        half = float(np.abs(direction @ pose.rotation().matrix()) @ self.box.half_width())
        return middle - half, middle + half


@dataclass(frozen=True, eq=False)
class ColliderPair:
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
    def kinds(self) -> set[str]:
        return {self.a.kind, self.b.kind}

    @property
    def contact(self) -> Literal["point", "hydroelastic", "none"]:
        """The kind of contact that Drake computes for the pair, or "none" if Drake raises an error."""
        both = {self.a.compliance, self.b.compliance}
        soft_half_space = both == {"compliant"} and "HalfSpace" in self.kinds
        if self.model == ContactModel.kPoint:
            return "point"
        if "none" not in both and both != {"rigid"} and not soft_half_space:
            return "hydroelastic"
        return "none" if self.model == ContactModel.kHydroelastic else "point"

    @property
    def refused(self) -> bool:
        return self.contact == "none" or not autodiff_supports(self.a.shape, self.b.shape, self.contact)

    @property
    def both_orders(self) -> tuple[tuple[Collider, Collider], ...]:
        return (self.a, self.b), (self.b, self.a)


@dataclass(frozen=True, eq=False)
class JointFacts:
    """A joint that can have an actuator, and the file's information about it."""

    name: str
    joint: Any
    driven: bool
    follows: bool
    left_out: bool  # whether an actuator of the joint was left out
    says: Any  # JointSays or None


@dataclass(frozen=True, eq=False)
class Point:
    """A model at x, u, with properties that several checks need, each computed once."""

    model: Model
    x: Array
    u: Array

    @cached_property
    def has_poses(self) -> bool:
        """Whether Drake can compute body poses, which fails for a quaternion of zeros."""
        plant = self.model.plant
        set_state(self.model.double, self.x)
        try:
            plant.EvalBodyPoseInWorld(self.model.double.context, plant.world_body())
        except RuntimeError:
            return False
        return True

    @cached_property
    def step_error(self) -> SimulationError | None:
        """The error of the double step at x and u, None if it succeeds."""
        try:
            advance(self.model.double, self.x, self.u)
        except SimulationError as error:
            return error
        return None

    def differentiate(self, method: str) -> StepDerivatives | DrakeDiffError:
        """Return the Jacobians of the step, or the error that prevents them."""
        try:
            return differentiate_step(self.model, self.x, self.u, method=method)
        except (GradientError, ModelError, SimulationError) as error:
            return error

    @cached_property
    def by_autodiff(self) -> StepDerivatives | DrakeDiffError:
        return self.differentiate("autodiff")

    @cached_property
    def is_sap(self) -> bool:
        return bool(self.model.plant.get_discrete_contact_approximation() == DiscreteContactApproximation.kSap)

    @cached_property
    def joints(self) -> list[JointFacts]:
        """The joints that can have an actuator."""
        plant, facts = self.model.plant, self.model.file_facts
        driven = {actuator.joint().index() for actuator in actuators(plant)}
        rows = []
        for name, joint in labelled(joints(plant)).items():
            if can_be_driven(joint):
                key, is_driven = key_of(joint), joint.index() in driven
                follows, left_out = key in facts.followers, key in facts.left_out
                rows.append(JointFacts(name, joint, is_driven, follows, left_out, facts.joints.get(key)))
        return rows

    def link_says(self, body: Any) -> Any:
        """Return the file's information about a body, or None if there is none."""
        return self.model.file_facts.links.get(key_of(body))

    @cached_property
    def query(self) -> Any:
        """Drake's QueryObject, which evaluates the state that the double context has at the time of a query."""
        return self.model.plant.get_geometry_query_input_port().Eval(self.model.double.context)

    @cached_property
    def pairs(self) -> list[ColliderPair]:
        port, plant = self.model.plant.get_geometry_query_input_port(), self.model.plant
        if self.model.double.scene_graph is None or not port.HasValue(self.model.double.context):
            return []
        ids = sorted(self.query.inspector().GetCollisionCandidates(), key=lambda p: [g.get_value() for g in p])
        set_state(self.model.double, self.x)
        colliders = {g: self._collider(g) for g in dict.fromkeys(g for pair in ids for g in pair)}
        return [ColliderPair(colliders[a], colliders[b], plant.get_contact_model()) for a, b in ids]

    @cached_property
    def colliders(self) -> list[Collider]:
        """The collision geometries that can collide."""
        return sorted({c for pair in self.pairs for c in (pair.a, pair.b)}, key=lambda c: c.id.get_value())

    def _collider(self, geometry: Any) -> Collider:
        inspector, model_inspector = self.query.inspector(), self.model.double.scene_graph.model_inspector()
        body = self.model.plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
        shape, body_name = inspector.GetShape(geometry), body.name() if body is not None else "?"
        return Collider(
            id=geometry,
            label=f"{body_name}/{inspector.GetName(geometry).split('::')[-1]} ({type(shape).__name__})",
            body=body_name,
            shape=shape,
            pose=self.query.GetPoseInWorld(geometry),
            box=inspector.GetObbInGeometryFrame(geometry),
            compliance=self._compliance(geometry, shape),
            given=model_inspector.GetProximityProperties(geometry),
            used=inspector.GetProximityProperties(geometry),
        )

    def _compliance(self, geometry: Any, shape: Any) -> Literal["none", "rigid", "compliant"]:
        """Return the hydroelastic type of a geometry, from its mesh, as Python cannot read Drake's compliance_type."""
        scene_graph = self.model.double.scene_graph
        if not isinstance(shape, HalfSpace):
            mesh = self.query.inspector().maybe_get_hydroelastic_mesh(geometry)
            return "none" if mesh is None else "compliant" if isinstance(mesh, VolumeMesh) else "rigid"
        properties = scene_graph.model_inspector().GetProximityProperties(geometry)
        if properties.HasProperty("hydroelastic", "compliance_type"):
            return "compliant" if properties.HasProperty("hydroelastic", "slab_thickness") else "rigid"
        default = scene_graph.get_config().default_proximity_properties.compliance_type
        return "none" if default == "undefined" else "compliant" if default == "compliant" else "rigid"
