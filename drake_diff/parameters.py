"""Named physical parameters: how each is read from and set in a context of either scalar type.

A name is `element.quantity`. Of a body: `pole.mass` [kg] (the unit inertia stays, so the inertia grows with the
mass) and `pole.center_of_mass` [m] (three entries in the body's frame; the inertia about the body's origin
stays). Of a joint: `hinge.damping` [N s/m or N m s/rad] and `hinge.offset` [m] (three entries: where the joint's
frame sits on its parent). AutoDiffXd carries all of them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.math import RigidTransform_, RotationMatrix_
from pydrake.multibody.tree import FixedOffsetFrame, RigidBody, WeldJoint

from drake_diff.arrays import Array, frozen
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model import Model, Twin
from drake_diff.plant_elements import bodies, joints

# Drake drops the derivative of a frame's pose whose value is exactly the identity. A translation of this
# length [m] changes no number in the step and keeps the derivative.
IDENTITY_OFFSET = 1e-300


@dataclass(frozen=True)
class Parameter:
    """One named parameter: its unit, its value in the model, and where its derivative comes from."""

    name: str
    unit: str
    value: Array
    derivative_source: str = "autodiff"

    @property
    def positive(self) -> bool:
        """Whether Drake ends the process on a value below zero."""
        return self.name.endswith((".mass", ".damping"))


def list_parameters(model: Model) -> list[Parameter]:
    """Every parameter of `model`, sorted by name."""
    found = []
    for body in bodies(model.plant):
        found += [_parameter(model, body, "mass"), _parameter(model, body, "center_of_mass")]
    for joint in joints(model.plant):
        if len(joint.default_damping_vector()) == 1:
            found.append(_parameter(model, joint, "damping"))
        if isinstance(joint.frame_on_parent(), FixedOffsetFrame) and not isinstance(joint, WeldJoint):
            found.append(_parameter(model, joint, "offset"))
    return sorted(found, key=lambda parameter: parameter.name)


def find_parameters(model: Model, names: Sequence[str]) -> tuple[Parameter, ...]:
    """The parameters called `names`, in that order; UnknownNameError lists those that exist."""
    known = {parameter.name: parameter for parameter in list_parameters(model)}
    for name in names:
        if name not in known:
            raise UnknownNameError("parameter", got=name, known=known)
    return tuple(known[name] for name in names)


def difference_scale(parameters: Sequence[Parameter]) -> Array:
    """(np,) by how much differences move each entry, relative to their step: never to where Drake takes no value.

    Raises InputError where a parameter sits at zero and cannot be moved to both sides.
    """
    scale = [np.zeros(0)]
    for p in parameters:
        if p.positive and not np.all(p.value > 0):
            raise InputError(p.name, got=float(p.value[0]), expected="a value above 0, to difference on both sides")
        scale.append(np.array(p.value) if p.positive else np.maximum(1.0, np.abs(p.value)))
    return np.concatenate(scale)


def column_names(parameters: Sequence[Parameter]) -> tuple[str, ...]:
    """One name per entry of the stacked vector: a parameter of three entries gets [0], [1], [2]."""
    return tuple(p.name if len(p.value) == 1 else f"{p.name}[{i}]" for p in parameters for i in range(len(p.value)))


def stacked_values(parameters: Sequence[Parameter]) -> Array:
    """(np,) the values of `parameters`, one after the other."""
    return np.concatenate([np.zeros(0), *(p.value for p in parameters)])


def set_parameters(twin: Twin, parameters: Sequence[Parameter], values: Any) -> None:
    """Write the stacked `values` (np,), floats or AutoDiffXd as the twin's scalar type asks, into its context."""
    start = 0
    for parameter in parameters:
        stop = start + len(parameter.value)
        element, quantity = parameter.name.rsplit(".", 1)
        _WRITE[quantity](twin, element, values[start:stop])
        start = stop


def _parameter(model: Model, element: Any, quantity: str) -> Parameter:
    unit, read = _READ[quantity]
    name, value = f"{element.name()}.{quantity}", np.atleast_1d(read(element, model))
    if quantity == "damping" and element.type_name() == "prismatic":
        unit = "N s/m"
    return Parameter(name, unit, frozen(value))


_READ: dict[str, tuple[str, Any]] = {
    "mass": ("kg", lambda body, model: body.default_mass()),
    "center_of_mass": ("m", lambda body, model: body.default_com()),
    "damping": ("N m s/rad", lambda joint, model: joint.default_damping_vector()),
    "offset": (
        "m",
        lambda joint, model: joint.frame_on_parent().GetFixedPoseInBodyFrame().translation(),
    ),
}


def _write_mass(twin: Twin, body: str, value: Any) -> None:
    _body(twin, body).SetMass(twin.context, value[0])


def _write_center_of_mass(twin: Twin, body: str, value: Any) -> None:
    _body(twin, body).SetCenterOfMassInBodyFrame(twin.context, value)


def _write_damping(twin: Twin, joint: str, value: Any) -> None:
    twin.plant.GetJointByName(joint).SetDampingVector(twin.context, value)


def _write_offset(twin: Twin, joint: str, value: Any) -> None:
    frame = twin.plant.GetJointByName(joint).frame_on_parent()
    scalar = type(value[0]) if value.dtype == object else float
    rotation = frame.GetFixedPoseInBodyFrame().rotation().matrix()
    if rotation.dtype == object:
        rotation = np.vectorize(lambda entry: entry.value())(rotation)
    if _is_zero(value) and np.array_equal(rotation, np.eye(3)):
        value = value + np.array([0.0, 0.0, IDENTITY_OFFSET])
    pose = RigidTransform_[scalar](RotationMatrix_[scalar](rotation.astype(float).astype(scalar)), value)
    frame.SetPoseInParentFrame(twin.context, pose)


def _is_zero(value: Any) -> bool:
    return all((v.value() if hasattr(v, "value") else v) == 0 for v in value)


def _body(twin: Twin, name: str) -> RigidBody:
    return twin.plant.GetBodyByName(name)


_WRITE = {
    "mass": _write_mass,
    "center_of_mass": _write_center_of_mass,
    "damping": _write_damping,
    "offset": _write_offset,
}
