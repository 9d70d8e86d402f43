"""A finding of an audit, and what its checks look at: a model at a point, with its geometries that can collide."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np
from pydrake.geometry import HalfSpace, ProximityProperties, VolumeMesh
from pydrake.multibody.plant import ContactModel

from drake_diff._base.arrays import Array
from drake_diff._base.values import ShowsItsRepr
from drake_diff.derivatives.step import StepDerivatives, differentiate_step
from drake_diff.exceptions import DrakeDiffError, GradientError, ModelError, SimulationError
from drake_diff.model.contact_geometry import autodiff_supports
from drake_diff.model.model import Model
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
