"""Named physical parameters of a model as one vector, and the coordinates in which solvers change them.

A name is `element.quantity`. Units are SI, and the number of entries is in brackets:

    pole.mass                        unit inertia and centre of mass are fixed, so the inertia grows with the mass
    pole.center_of_mass[3]           in the body's frame; the unit inertia about the body's origin is fixed
    pole.inertia[6]                  xx yy zz xy xz yz about the centre of mass, for any mass and centre
    hinge.damping                    of joints with one degree of freedom
    hinge.offset[3]                  position of the joint's frame on its parent: link lengths
    hinge.spring_stiffness, hinge.spring_rest_angle, slide.spring_stiffness, slide.spring_rest_length
    motor.gear_ratio, motor.rotor_inertia, motor.kp, motor.kd
    ball.friction, ball.stiffness, ball.dissipation, ball.relaxation_time, ball.hydroelastic_modulus, ball.radius
                                     of all the body's collision geometries; ball/tip.friction is of one
    model.time_step, model.gravity[3]

An element whose name occurs in two model instances is called `instance::name`. Static friction is set to dynamic
friction, because a discrete plant uses only the latter.

There are three sources of a derivative:

- "autodiff": Drake stores the quantity in its context, for floats and for AutoDiffXd;
- "chain_rule": it enters the step as a generalized force that Drake differentiates (gravity, prismatic springs);
- "finite_difference" of the double step: Drake uses a plain number (PD gains, time step, all of contact). For
  contact, `derivatives.contact.jacobian` has the closed form in many cases.

Contact parameters are named by body ("ball.friction": all its geometries) or by geometry ("ball/tip.friction").
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from operator import attrgetter
from operator import methodcaller as get
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractGradient, ExtractValue, InitializeAutoDiff
from pydrake.geometry import Capsule, Cylinder, ProximityProperties, Role, RoleAssign, Sphere
from pydrake.math import RigidTransform_, RotationMatrix_
from pydrake.multibody import tree
from pydrake.multibody.plant import CoulombFriction

from drake_diff._base.arrays import Array, finite_array, frozen, slices_of
from drake_diff._base.autodiff import plain
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.plant import PROXIMITY, actuators, bodies, central_inertia, joints, labelled, proximity_property
from drake_diff.model.twin import GravityChange, SpringChange, Twin

# Drake drops the derivative of a frame's pose whose value is exactly the identity. A translation of this
# length [m] changes no digit of the step and preserves the derivative.
IDENTITY_OFFSET = 1e-300
AUTODIFF, CHAIN_RULE, DIFFERENCE = "autodiff", "chain_rule", "finite_difference"
DAMPING = ("N s/m", "N m s/rad")

Values = Any  # (n,) floats, or AutoDiffXd if the twin has that scalar type
Elements = Callable[[Model], Mapping[str, Any]]  # elements of a model that have the quantity, by label
Write = Callable[[Twin, str, Values], None]


@dataclass(frozen=True)
class Kind:
    """A quantity of one kind of element. `write` sets it in a twin for the element with a given label."""

    quantity: str
    source: str
    elements: Elements
    unit: str | tuple[str, str]  # if two: for translational elements, and for all others
    read: Callable[[Any], Any]  # returns an element's value in the model, or None
    write: Write
    positive: bool = False  # whether Drake refuses negative values
    on_plant: bool = False  # whether it is stored in the plant, which all contexts share

    def find(self, model: Model) -> Iterator[tuple[str, str, Any]]:
        """Yield the label of every element with the quantity, the unit, and the value in the model."""
        for label, element in self.elements(model).items():
            value, unit = self.read(element), self.unit
            if isinstance(unit, tuple):
                joint = element.joint() if hasattr(element, "joint") else element
                unit = unit[0] if joint.type_name() == "prismatic" else unit[1]
            if value is not None:
                yield label, unit, value


def _labelled(elements: Callable[[Any], list[Any]]) -> Elements:
    return lambda model: labelled(elements(model.plant))


def _model_if(holds: Callable[[Model], Any]) -> Elements:
    return lambda model: {"model": model} if holds(model) else {}


_bodies, _joints, _actuators = map(_labelled, (bodies, joints, actuators))
_rebuildable, _taking_forces = map(_model_if, (attrgetter("can_rebuild"), attrgetter("takes_forces")))


def _springs(plant: Any, kind: Any) -> dict[str, Any]:
    """Return the springs of a kind by their joint's label; two springs on one joint are omitted."""
    labels = {joint.index(): label for label, joint in labelled(joints(plant)).items()}
    elements = [plant.get_force_element(tree.ForceElementIndex(i)) for i in range(plant.num_force_elements())]
    springs = [(labels[e.joint().index()], e) for e in elements if isinstance(e, kind)]
    names = [label for label, _ in springs]
    return {label: spring for label, spring in springs if names.count(label) == 1}


def _hinge_springs(model: Model) -> dict[str, Any]:
    return _springs(model.plant, tree.RevoluteSpring_[float])


def _slide_springs(model: Model) -> dict[str, Any]:
    return _springs(model.plant, tree.PrismaticSpring_[float]) if model.takes_forces else {}


def geometries_of(twin: Twin) -> dict[str, list[Any]]:
    """Return collision geometries by the label of their body, and by their own labels."""
    inspector, plant = twin.inspector, twin.plant
    if inspector is None or twin.scene_graph is None:
        return {}
    by_label: dict[str, list[Any]] = {}
    for label, body in {"world": plant.world_body(), **labelled(bodies(plant))}.items():
        frame = plant.GetBodyFrameIdIfExists(body.index())
        of_body = [] if frame is None else list(inspector.GetGeometries(frame, Role.kProximity))
        if of_body:
            by_label[label] = of_body
            by_label |= {f"{label}/{inspector.GetName(i).split('::')[-1]}": [i] for i in of_body}
    return by_label


def _read_inertia(body: Any) -> list[float] | None:
    if not body.default_mass() > 0:
        return None  # a frame without mass has no inertia, and setting one would end the process
    return central_inertia(body.default_spatial_inertia())


def _write_inertia(twin: Twin, label: str, value: Values) -> None:
    body = twin.body(label)
    xx, yy, zz, xy, xz, yz = np.asarray(value).astype(twin.scalar)
    central = tree.RotationalInertia_[twin.scalar](Ixx=xx, Iyy=yy, Izz=zz, Ixy=xy, Ixz=xz, Iyz=yz)
    mass, com = body.get_mass(twin.context), body.CalcCenterOfMassInBodyFrame(twin.context)
    body.SetSpatialInertiaInBodyFrame(
        twin.context, tree.SpatialInertia_[twin.scalar].MakeFromCentralInertia(mass, com, central)
    )


def _read_damping(joint: Any) -> Any:
    damping = joint.default_damping_vector()
    return damping if len(damping) == 1 else None


def _read_offset(joint: Any) -> Any:
    frame = joint.frame_on_parent()
    if isinstance(joint, tree.WeldJoint) or not isinstance(frame, tree.FixedOffsetFrame):
        return None
    return frame.GetFixedPoseInBodyFrame().translation()


def _write_offset(twin: Twin, label: str, value: Values) -> None:
    frame, scalar = twin.joint(label).frame_on_parent(), twin.scalar
    rotation = plain(frame.GetFixedPoseInBodyFrame().rotation().matrix())
    if np.all(plain(value) == 0) and np.array_equal(rotation, np.eye(3)):
        value = value + np.array([0.0, 0.0, IDENTITY_OFFSET])
    pose = RigidTransform_[scalar](RotationMatrix_[scalar](rotation.astype(scalar)), np.asarray(value).astype(scalar))
    frame.SetPoseInParentFrame(twin.context, pose)


def _setter(element: Callable[[Twin, str], Any], name: str, *, vector: bool = False) -> Write:
    """Return a function that writes a number, or a vector, by the method `name` of Drake's element."""

    def write(twin: Twin, label: str, value: Values) -> None:
        getattr(element(twin, label), name)(twin.context, value if vector else value[0])

    return write


def _hinge_spring(twin: Twin, label: str) -> Any:
    return _springs(twin.plant, tree.RevoluteSpring_[twin.scalar])[label]


def _set_slide(field: str) -> Write:
    def write(twin: Twin, label: str, value: Values) -> None:
        name = f"{label}.spring"
        if name not in twin.added:
            twin.added[name] = SpringChange.none(_springs(twin.plant, tree.PrismaticSpring_[twin.scalar])[label])
        setattr(twin.added[name], field, value[0])

    return write


def _gain(quantity: str, which: str, unit: tuple[str, str]) -> Kind:
    def write(twin: Twin, label: str, value: Values) -> None:
        actuator = twin.actuator(label)
        gains = {"p": actuator.get_controller_gains().p, "d": actuator.get_controller_gains().d}
        gains[which] = float(value[0])
        actuator.set_controller_gains(tree.PdControllerGains(**gains))

    def read(actuator: Any) -> float | None:
        return float(getattr(actuator.get_controller_gains(), which)) if actuator.has_controller() else None

    return Kind(quantity, DIFFERENCE, _actuators, unit, read, write, positive=True, on_plant=True)


def _read_gravity(model: Model) -> Any:
    return model.plant.gravity_field().gravity_vector()


def _write_gravity(twin: Twin, label: str, value: Values) -> None:
    vector = plain(value)
    twin.plant.mutable_gravity_field().set_gravity_vector(vector)
    if np.asarray(value).dtype == object:  # the plant stores the value, and a force carries its derivative
        twin.added["gravity"] = GravityChange(value - vector)


_set_center_of_mass = _setter(Twin.body, "SetCenterOfMassInBodyFrame", vector=True)
_set_damping = _setter(Twin.joint, "SetDampingVector", vector=True)
_set_stiffness, _set_rest_angle = _setter(_hinge_spring, "SetStiffness"), _setter(_hinge_spring, "SetNominalAngle")
_set_rotor_inertia = _setter(Twin.actuator, "SetRotorInertia")

# In the order of writing: later writes reset values that earlier writes change.
MECHANISM_KINDS = (
    # The time step of a plant is fixed, so nothing is written; another model is used (`parameters.applied`).
    Kind("time_step", DIFFERENCE, _rebuildable, "s", attrgetter("time_step"), lambda *_: None, positive=True),
    Kind("gravity", CHAIN_RULE, _taking_forces, "m/s^2", _read_gravity, _write_gravity, on_plant=True),
    Kind("mass", AUTODIFF, _bodies, "kg", get("default_mass"), _setter(Twin.body, "SetMass"), positive=True),
    Kind("center_of_mass", AUTODIFF, _bodies, "m", get("default_com"), _set_center_of_mass),
    Kind("inertia", AUTODIFF, _bodies, "kg m^2", _read_inertia, _write_inertia),
    Kind("damping", AUTODIFF, _joints, DAMPING, _read_damping, _set_damping, positive=True),
    Kind("offset", AUTODIFF, _joints, "m", _read_offset, _write_offset),
    Kind(
        "spring_stiffness", AUTODIFF, _hinge_springs, "N m/rad", get("default_stiffness"), _set_stiffness, positive=True
    ),
    Kind("spring_rest_angle", AUTODIFF, _hinge_springs, "rad", get("default_nominal_angle"), _set_rest_angle),
    Kind(
        "spring_stiffness", CHAIN_RULE, _slide_springs, "N/m", get("stiffness"), _set_slide("stiffness"), positive=True
    ),
    Kind("spring_rest_length", CHAIN_RULE, _slide_springs, "m", get("nominal_position"), _set_slide("rest")),
    Kind("gear_ratio", AUTODIFF, _actuators, "1", get("default_gear_ratio"), _setter(Twin.actuator, "SetGearRatio")),
    Kind(
        "rotor_inertia", AUTODIFF, _actuators, "kg m^2", get("default_rotor_inertia"), _set_rotor_inertia, positive=True
    ),
    _gain("kp", "p", ("N/m", "N m/rad")),
    _gain("kd", "d", DAMPING),
)


def _contact_kind(quantity: str, unit: str, read: Callable[[Any, Any], Any], change: Callable[..., None]) -> Kind:
    """Make a Kind from `read(inspector, geometry)` (None without a value) and `change(twin, geometry, value, root)`."""

    def values(model: Model) -> dict[str, set[Any]]:
        geometries = geometries_of(model.double)
        return {label: {read(model.double.inspector, i) for i in ids} for label, ids in geometries.items()}

    def write(twin: Twin, label: str, value: Values) -> None:
        root = twin.scene_graph.GetMyMutableContextFromRoot(twin.root_context)
        for geometry in geometries_of(twin)[label]:
            change(twin, geometry, float(value[0]), root)

    # If the geometries of a body differ, each has its own parameter and the body has none.
    return Kind(quantity, DIFFERENCE, values, unit, lambda v: v.pop() if len(v) == 1 else None, write, positive=True)


def _change_property(twin: Twin, geometry: Any, value: float, root: Any, *, quantity: str) -> None:
    properties = ProximityProperties(twin.inspector.GetProximityProperties(geometry))
    friction_or_number = CoulombFriction(value, value) if quantity == "friction" else value
    properties.UpdateProperty(*PROXIMITY[quantity], friction_or_number)
    twin.scene_graph.AssignRole(root, twin.plant.get_source_id(), geometry, properties, RoleAssign.kReplace)


def _read_radius(inspector: Any, geometry: Any) -> float | None:
    shape = inspector.GetShape(geometry)
    return float(shape.radius()) if isinstance(shape, Sphere | Cylinder | Capsule) else None


def _change_radius(twin: Twin, geometry: Any, radius: float, root: Any) -> None:
    shape = twin.inspector.GetShape(geometry)
    new = Sphere(radius) if isinstance(shape, Sphere) else type(shape)(radius, shape.length())
    twin.scene_graph.ChangeShape(root, twin.plant.get_source_id(), geometry, new)


def _property_kind(quantity: str, unit: str) -> Kind:
    read = partial(proximity_property, quantity=quantity)
    return _contact_kind(quantity, unit, read, partial(_change_property, quantity=quantity))


CONTACT_KINDS = (
    *map(_property_kind, PROXIMITY, ("1", "N/m", "s/m", "s", "Pa")),
    _contact_kind("radius", "m", _read_radius, _change_radius),
)


KINDS = (*MECHANISM_KINDS, *CONTACT_KINDS)
EFFECTS = {
    "mass": "the inertia scales with it",
    "center_of_mass": "the inertia about the body's origin stays",
    "inertia": "about the centre of mass, mass and centre stay",
}
TIME_STEP = "model.time_step"


@dataclass(frozen=True, eq=False)
class Parameter:
    """A named parameter: its value in the model (n,), its unit and range, and the source of its derivative."""

    name: str
    unit: str
    value: Array
    lower: float
    upper: float
    derivative_source: str  # "autodiff", "chain_rule" or "finite_difference"
    kind: Kind = field(repr=False)

    def __repr__(self) -> str:
        value = ", ".join(f"{v:g}" for v in self.value)
        value = value if len(self.value) == 1 else f"({value})"
        least = ", at least 0" if self.lower == 0 else ""
        effect = f"; {self.effect}" if self.effect else ""
        return f"{self.name} = {value} {self.unit}{least}{effect}; derivative by {self.derivative_source}"

    @property
    def effect(self) -> str:
        """What else a change of a mass or a centre of mass changes, or what an inertia keeps; "" for the others."""
        return EFFECTS.get(self.kind.quantity, "")

    @property
    def label(self) -> str:
        """The element's name."""
        return self.name.rsplit(".", 1)[0]

    @property
    def columns(self) -> tuple[str, ...]:
        """A name for each entry."""
        return (self.name,) if len(self.value) == 1 else tuple(f"{self.name}[{i}]" for i in range(len(self.value)))


def list_parameters(model: Model) -> list[Parameter]:
    """Return every physical parameter with respect to which `model` can be differentiated, sorted by name.

    Args:
        model: The model; values are from its file or diagram.

    Returns:
        Parameters with `.name`, `.unit`, `.value` (n,), `.lower`, `.upper` and `.derivative_source`: "autodiff"
        (through Drake's step), "chain_rule" (through a generalized force) or "finite_difference".

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> dd.list_parameters(model)[0]
        hinge.damping = 0.1 N m s/rad, at least 0; derivative by autodiff
        >>> dd.step(model, [0.1, 0.0], [0.0], parameters={"hinge.damping": 0.0}).round(4)
        array([ 0.0998, -0.0196])
    """

    def read() -> tuple[Parameter, ...]:
        parameters = []
        for kind in KINDS:
            for label, unit, value in kind.find(model):
                lower = 0.0 if kind.positive else -np.inf
                value = frozen(np.atleast_1d(value))
                parameters.append(Parameter(f"{label}.{kind.quantity}", unit, value, lower, np.inf, kind.source, kind))
        return tuple(sorted(parameters, key=lambda parameter: parameter.name))

    return list(model.cache("parameters", read))


@dataclass(frozen=True, eq=False)
class ParameterVector:
    """Selected parameters of a model in sequence, with their assigned values (np,)."""

    model: Model
    parameters: tuple[Parameter, ...]
    values: Array

    def __reduce__(self) -> tuple[Any, ...]:
        return _select_again, (self.model, self.to_dict())

    @cached_property
    def names(self) -> tuple[str, ...]:
        """A name for each entry: `pole.mass`, `pole.center_of_mass[0]`, ..."""
        return tuple(name for p in self.parameters for name in p.columns)

    @cached_property
    def sources(self) -> tuple[str, ...]:
        """The source of the derivative with respect to each entry: "autodiff", "chain_rule" or "finite_difference"."""
        return tuple(p.derivative_source for p in self.parameters for _ in p.value)

    @cached_property
    def slices(self) -> tuple[slice, ...]:
        """The slice of each parameter in the vector."""
        return slices_of(len(p.value) for p in self.parameters)

    @cached_property
    def differenced(self) -> NDArray[np.int64]:
        """The indices of the entries whose derivatives are finite differences of the double step."""
        return np.flatnonzero([source == "finite_difference" for source in self.sources])

    def at(self, values: Any) -> "ParameterVector":
        """Return the same parameters with the values `values` (np,)."""
        return replace(self, values=frozen(values))

    def to_dict(self) -> dict[str, Array]:
        """Return the values by parameter name."""
        return {p.name: self.values[s] for p, s in self.pairs}

    @cached_property
    def step_entry(self) -> int | None:
        """The index of the time step in the vector, or None if it is not a parameter."""
        return next((s.start for p, s in self.pairs if p.name == TIME_STEP), None)

    def time_step(self, values: Array) -> float:
        """Return the time step [s] for `values` (np,)."""
        return self.model.time_step if self.step_entry is None else float(values[self.step_entry])

    def write(self, twin: Twin, values: Any) -> None:
        """Set every parameter in the twin, with floats, or with AutoDiffXd if the twin has that scalar type."""
        for p, s in self._in_order:
            # The AutoDiffXd twin copied the plain numbers from the double twin's context.
            if twin.scalar is float or p.kind.source != "finite_difference":
                p.kind.write(twin, p.label, values[s])
            elif p.kind.on_plant:
                p.kind.write(twin, p.label, self.values[s])

    def restore(self, twin: Twin) -> None:
        """Reset the twin to the model's own values."""
        twin.reset()
        for p, _ in self._in_order:
            if p.kind.on_plant:
                p.kind.write(twin, p.label, p.value)

    @cached_property
    def _in_order(self) -> list[tuple[Parameter, slice]]:
        return sorted(self.pairs, key=lambda pair: KINDS.index(pair[0].kind))

    def difference_scale(self, entries: Any = slice(None)) -> Array:
        """Return the scale of finite-difference steps for `entries`, which never reach values that Drake refuses.

        Raises InputError if a parameter cannot change in both directions.
        """
        scale = np.full(len(self.values), np.nan)
        wanted = np.zeros(len(self.values), dtype=bool)
        wanted[entries] = True
        for p, s in self.pairs:
            value = self.values[s]
            if not wanted[s].any():
                continue
            if p.kind.quantity == "inertia":
                scale[s] = room_of_inertia(value)
                if scale[s][0] <= 0:
                    expected = "an inertia that stays valid under small changes, unlike that of a point or a rod"
                    raise InputError(p.name, got=value, expected=expected)
            elif not p.kind.positive:
                scale[s] = np.maximum(1.0, np.abs(value))
            elif np.all(value > 0):
                scale[s] = value
            else:
                expected = "a value above 0 for central differences; set it by parameters={name: value}"
                raise InputError(p.name, got=float(value[0]), expected=expected)
        return scale[entries]

    @property
    def pairs(self) -> Iterator[tuple[Parameter, slice]]:
        """Each parameter with its slice of the vector."""
        return zip(self.parameters, self.slices, strict=True)


Parameters = Sequence[str] | Mapping[str, Any] | ParameterVector


def select(model: Model, parameters: Parameters) -> ParameterVector:
    """Select named parameters in the given order; a mapping also sets values, which default to the model's own.

    Raises UnknownNameError, which lists the known names, ShapeError, NonFiniteError, or InputError for a value out
    of range.
    """
    if isinstance(parameters, ParameterVector):
        return parameters
    names = (parameters,) if isinstance(parameters, str) else tuple(parameters)
    if not names:
        return ParameterVector(model, (), frozen([]))
    if len(set(names)) < len(names):
        raise InputError("parameters", got=", ".join(names), expected="each name once")
    known = {parameter.name: parameter for parameter in list_parameters(model)}
    for name in names:
        if name not in known:
            raise UnknownNameError("parameter", got=name, known=known)
    selected = tuple(known[name] for name in names)
    for p in selected:
        whole = f"{p.label.rsplit('/', 1)[0]}.{p.kind.quantity}"
        if p.kind in CONTACT_KINDS and "/" in p.label and whole in names:
            expected = "one of the two names, as the first includes the second"
            raise InputError("parameters", got=f"{whole} and {p.name}", expected=expected)
    given = parameters if isinstance(parameters, Mapping) else {}
    values = [_check_value(p, given[p.name]) if p.name in given else p.value for p in selected]
    return ParameterVector(model, selected, frozen(np.concatenate(values)))


def _select_again(model: Model | None, values: dict[str, Array]) -> ParameterVector:
    """Restore a pickled vector from its values by name, so that it has the Kinds of this module."""
    return plain_parameters(values) if model is None else select(model, values)


def plain_parameters(values: Mapping[str, Any]) -> ParameterVector:
    """Return a vector of named numbers without a model, in the order of `values`."""
    parameters = []
    for name, value in values.items():
        if not (isinstance(name, str) and name):
            raise InputError("parameters", got=repr(name), expected="names with their values")
        kind = Kind("", AUTODIFF, lambda model: {}, "", lambda element: None, lambda twin, label, value: None)
        value = finite_array(f"parameter {name}", np.atleast_1d(value), (1,))
        parameters.append(Parameter(name, "unknown", value, -np.inf, np.inf, AUTODIFF, kind))
    return ParameterVector(cast(Model, None), tuple(parameters), frozen([p.value[0] for p in parameters]))


def _check_value(p: Parameter, given: Any) -> Array:
    value = finite_array(p.name, np.atleast_1d(given), (len(p.value),))
    if np.any(value < p.lower):
        raise InputError(p.name, got=given, expected=f"at least {p.lower:g} {p.unit}")
    if p.kind.quantity == "inertia" and room_of_inertia(value) < 0:
        raise InputError(p.name, got=given, expected="a physically valid inertia of a distribution of mass")
    return value


@contextmanager
def applied(vector: ParameterVector) -> Iterator[Model]:
    """Yield the vector's model with the values set, or a model with another time step; reset the values at the end.

    Values that an outer block has set stay, unless the vector has other values for them.
    """
    if not vector.parameters:
        yield vector.model
        return
    h = vector.time_step(vector.values)
    model = vector.model if h == vector.model.time_step else vector.model.at_time_step(h)
    model.contract  # noqa: B018  the model's own, so it is read before anything else is set
    outer, outer_quantities = model.applied, model.other_quantities
    quantities = frozenset(p.kind.quantity for p in vector.parameters if p.name != TIME_STEP)
    of_plant = ", ".join(p.name for p in vector.parameters if p.kind.on_plant)
    with model.shared.changed(of_plant) if of_plant else nullcontext():
        try:
            vector.write(model.double, vector.values)
            model.set_applied(vector if outer is None else _joined(outer, vector), quantities | outer_quantities)
            yield model
        finally:
            model.set_applied(outer, outer_quantities)
            vector.restore(model.double)
            if outer is not None:
                outer.write(model.double, outer.values)
            if model.has_autodiff:  # created in this block, or before it
                vector.restore(model.autodiff)


def _joined(outer: ParameterVector, inner: ParameterVector) -> ParameterVector:
    """Return the parameters of both vectors, with the values of `inner` for those of both."""
    pairs = {p.name: (p, vector.values[s]) for vector in (outer, inner) for p, s in vector.pairs}
    parameters, values = zip(*pairs.values(), strict=True)
    return ParameterVector(inner.model, parameters, frozen(np.concatenate(values)))


def write_autodiff(vector: ParameterVector, model: Model, variables: Any) -> None:
    """Set `variables` (np,) AutoDiffXd in the AutoDiffXd twin of a model to which the vector is applied."""
    if model.has_other_parameters:
        model.autodiff.root_context.SetTimeStateAndParametersFrom(model.double.root_context)
        if model.applied is not None and len(model.applied.values) > len(vector.values):
            model.applied.write(model.autodiff, model.applied.values)  # parameters outside the context, such as gravity
        vector.write(model.autodiff, variables)


@dataclass(frozen=True, eq=False)
class ParameterCoordinates:
    """The coordinates z (np,) in which a solver changes parameters: scaled, and always physically valid.

    A parameter is divided by the size of its first value; an inertia has log-Cholesky coordinates (`to_log_cholesky`).
    """

    start: ParameterVector

    def __post_init__(self) -> None:
        self.from_values(self.start.values)  # raises an error for an inertia without coordinates

    @property
    def scale(self) -> Array:
        """(np,) The magnitude of each first value; 1 if it is zero or if the coordinate is not a quotient."""
        size = np.abs(self.start.values)
        scale = np.where(size > 0, size, 1.0)
        for s in self.inertias:
            scale[s] = 1.0
        return scale

    @property
    def inertias(self) -> list[slice]:
        """The slices of the inertias in the vector."""
        return [s for p, s in self.start.pairs if p.kind.quantity == "inertia"]

    def from_values(self, values: Array) -> Array:
        """Return z for parameter values (np,); infinite bounds of an inertia stay infinite."""
        z = values / self.scale
        for s in self.inertias:
            z[s] = to_log_cholesky(values[s]) if np.all(np.isfinite(values[s])) else values[s]
        return z

    def to_values(self, z: Array) -> Array:
        """Return the parameter values (np,) for z."""
        values = z * self.scale
        for s in self.inertias:
            values[s] = from_log_cholesky(z[s])
        return values

    def pull_back(self, z: Array, by_values: Array) -> Array:
        """Convert a derivative (..., np) with respect to the values to a derivative with respect to z."""
        by_z = by_values * self.scale
        for s in self.inertias:
            by_z[..., s] = by_values[..., s] @ derivative_of_from_log_cholesky(z[s])[1]
        return np.asarray(by_z)


def matrix(inertia: Any) -> Any:
    """Return the matrix (3, 3) for the six numbers xx yy zz xy xz yz."""
    xx, yy, zz, xy, xz, yz = inertia
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def second_moment(inertia: Array) -> Array:
    """Return the second moment S (3, 3) [kg m^2] for an inertia (6,) about the centre of mass."""
    full = matrix(inertia)
    return np.asarray(np.trace(full) / 2 * np.eye(3) - full)


def room_of_inertia(inertia: Array) -> float:
    """Return the safe change [kg m^2] of every entry before the inertia is invalid; negative if it is invalid."""
    eigenvalues = np.linalg.eigvalsh(second_moment(inertia))
    smallest, largest = float(eigenvalues[0]), float(np.abs(eigenvalues).max())
    return 0.0 if abs(smallest) <= 1e-12 * largest else smallest / 3


def to_log_cholesky(inertia: Array) -> Array:
    """Return coordinates (6,) of an inertia (6,), such that every vector of coordinates is a physically valid inertia.

    An inertia I about the centre of mass belongs to a mass distribution if and only if the second moment
    S = tr(I) / 2 - I is positive semidefinite. With S = L L', L lower triangular and its diagonal (e^a, e^b, e^c), the
    numbers (a, b, c, L10, L20, L21) are free. They are the log-Cholesky coordinates of Rucker and Wensing, "Smooth
    parameterization of rigid-body inertia" (2022), that remain for a given mass and centre of mass.

    Raises InputError for a point or a rod, whose coordinates are infinite.
    """
    if room_of_inertia(inertia) <= 0:
        raise InputError("inertia", got=inertia, expected="the inertia of a body that is neither a point nor a rod")
    lower = np.linalg.cholesky(second_moment(inertia))
    return np.array([*np.log(np.diag(lower)), lower[1, 0], lower[2, 0], lower[2, 1]])


def from_log_cholesky(coordinates: Any) -> Any:
    """Return xx yy zz xy xz yz (6,) for coordinates (6,), floats or AutoDiffXd."""
    a, b, c, l10, l20, l21 = coordinates
    zero = 0.0 * a
    lower = np.array([[np.exp(a), zero, zero], [l10, np.exp(b), zero], [l20, l21, np.exp(c)]])
    S = lower @ lower.T
    trace = S[0, 0] + S[1, 1] + S[2, 2]
    return np.array([trace - S[0, 0], trace - S[1, 1], trace - S[2, 2], -S[0, 1], -S[0, 2], -S[1, 2]])


def derivative_of_from_log_cholesky(coordinates: Array) -> tuple[Array, Array]:
    """Return the inertia (6,) and its derivative (6, 6) with respect to the coordinates."""
    result = from_log_cholesky(InitializeAutoDiff(coordinates).ravel()).reshape(-1, 1)
    return ExtractValue(result).ravel(), np.asarray(ExtractGradient(result))
