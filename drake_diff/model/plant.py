"""The bodies, joints and actuators of a plant, found by index or by name; the plant in a diagram."""

from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import SceneGraph_
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    JointActuatorIndex,
    JointIndex,
    ModelInstanceIndex,
    PrismaticJoint,
    RevoluteJoint,
    WeldJoint,
)
from pydrake.systems.framework import Diagram

from drake_diff.exceptions import ModelError, UnknownNameError

_SCENE_GRAPHS = (SceneGraph_[float], SceneGraph_[AutoDiffXd])

ARMATURE = "armature of "  # the prefix of actuators that only carry the armature of a joint, which nothing drives
FLOATING = ("quaternion_floating", "rpy_floating")  # the types of joints that hold nothing
DiagramPath = tuple[int, ...]  # the position among the subsystems, level by level


def instances(plant: Any) -> list[ModelInstanceIndex]:
    """Every model instance, the world and Drake's default one included."""
    return [ModelInstanceIndex(i) for i in range(plant.num_model_instances())]


def instances_with_joints(plant: Any) -> list[ModelInstanceIndex]:
    """The model instances that have positions."""
    return [i for i in instances(plant) if plant.num_positions(i) > 0]


def bodies(plant: Any) -> list[Any]:
    """Every body but the world."""
    members = [plant.get_body(index) for i in instances(plant) for index in plant.GetBodyIndices(i)]
    return [body for body in members if body.index() != plant.world_body().index()]


def joints(plant: Any) -> list[Any]:
    """Every joint, in the order of its index."""
    return [plant.get_joint(JointIndex(int(i))) for i in plant.GetJointIndices()]


def actuators(plant: Any) -> list[Any]:
    """Every actuator that can be driven, in the order of the actuation input, where those of ARMATURE come last."""
    return [actuator for actuator in rotors(plant) if not actuator.name().startswith(ARMATURE)]


def rotors(plant: Any) -> list[Any]:
    """Every actuator of Drake's, also those that nothing drives and that give their joints an armature."""
    return [plant.get_joint_actuator(JointActuatorIndex(int(i))) for i in plant.GetJointActuatorIndices()]


def joint_pose(joint: Any, q: float = 0.0) -> RigidTransform:
    """The pose of a joint's child frame in its parent frame, a hinge or slide being at the position q [rad or m].

    Free bodies are in their default pose and others at zero.
    """
    if isinstance(joint, RevoluteJoint):
        return RigidTransform(RotationMatrix(AngleAxis(q, joint.revolute_axis())), np.zeros(3))
    if isinstance(joint, PrismaticJoint):
        return RigidTransform(q * np.asarray(joint.translation_axis()))
    if isinstance(joint, WeldJoint):
        return joint.X_FM()
    return joint.GetDefaultPose() if joint.type_name().endswith("_floating") else RigidTransform()


def labelled(elements: list[Any]) -> dict[str, Any]:
    """The elements by name, or by "instance::name" where two model instances use the same."""
    names = [element.name() for element in elements]
    by_label = {}
    for element, name in zip(elements, names, strict=True):
        if names.count(name) > 1:
            name = f"{element.GetParentPlant().GetModelInstanceName(element.model_instance())}::{name}"
        by_label[name] = element
    return by_label


def radius_of_gyration(body: Any) -> float:
    """[m] of the file's inertia about the body's origin; 0 of a body without mass."""
    moments = body.default_spatial_inertia().get_unit_inertia().get_moments()
    return float(np.sqrt(np.nan_to_num(np.sum(moments)) / 2))


# The quantities of contact by the names that parameters have, with Drake's names for them.
PROXIMITY = {
    "friction": ("material", "coulomb_friction"),
    "stiffness": ("material", "point_contact_stiffness"),
    "dissipation": ("material", "hunt_crossley_dissipation"),
    "relaxation_time": ("material", "relaxation_time"),
    "hydroelastic_modulus": ("hydroelastic", "hydroelastic_modulus"),
}


def proximity_property(inspector: Any, geometry: Any, quantity: str) -> float | None:
    """One of PROXIMITY of a geometry, None where the model gives none; of friction the dynamic coefficient.

    A discrete plant uses no other.
    """
    properties = inspector.GetProximityProperties(geometry)
    if not properties.HasProperty(*PROXIMITY[quantity]):
        return None
    value = properties.GetProperty(*PROXIMITY[quantity])
    return float(value.dynamic_friction() if quantity == "friction" else value)


def scene_graph_beside(diagram: Any, path: DiagramPath) -> Any | None:
    """The SceneGraph, of either scalar type, nearest to the plant at `path`; None where there is none."""
    for depth in reversed(range(len(path))):
        scene_graphs = [s for s in follow(diagram, path[:depth]).GetSystems() if isinstance(s, _SCENE_GRAPHS)]
        if scene_graphs:
            return scene_graphs[0]
    return None


def named(kind: str, elements: list[Any], name: str) -> Any:
    """The one of `elements` called `name`; UnknownNameError lists those that exist."""
    matches = [element for element in elements if element.name() == name]
    if not matches:
        raise UnknownNameError(kind, got=name, known=[element.name() for element in elements])
    if len(matches) > 1:
        raise ModelError(f"{len(matches)} {kind}s are called {name!r}: expected exactly one")
    return matches[0]


def path_to_the_plant(diagram: Diagram) -> DiagramPath:
    """Where in `diagram` its only MultibodyPlant is; ModelError where there is none or more than one."""
    paths = _paths_to_plants(diagram, ())
    if len(paths) != 1:
        raise ModelError(f"diagram: expected exactly one MultibodyPlant, got {len(paths)}")
    return paths[0]


def _paths_to_plants(diagram: Diagram, here: DiagramPath) -> list[DiagramPath]:
    paths: list[DiagramPath] = []
    for i, system in enumerate(diagram.GetSystems()):
        if isinstance(system, MultibodyPlant):
            paths.append((*here, i))
        elif isinstance(system, Diagram):
            paths += _paths_to_plants(system, (*here, i))
    return paths


def follow(diagram: Any, path: DiagramPath) -> Any:
    """The subsystem at `path`; works on the diagram and on its scalar-converted twin."""
    system = diagram
    for i in path:
        system = system.GetSystems()[i]
    return system
