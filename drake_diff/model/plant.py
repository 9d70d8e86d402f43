"""Access to a plant's bodies, joints and actuators by index or name, and to the plant in a diagram."""

from collections.abc import Collection
from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd
from pydrake.common.eigen_geometry import AngleAxis
from pydrake.geometry import SceneGraph_
from pydrake.math import RigidTransform, RotationMatrix
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FrameIndex,
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

ARMATURE = "armature of "  # the prefix of undriven actuators that only represent the armature of a joint
FLOATING = ("quaternion_floating", "rpy_floating")  # types of joints without constraints
DiagramPath = tuple[int, ...]  # the indices of subsystems, level by level


def instances(plant: Any) -> list[ModelInstanceIndex]:
    """Return every model instance, including the world and Drake's default instance."""
    return [ModelInstanceIndex(i) for i in range(plant.num_model_instances())]


def instances_with_joints(plant: Any) -> list[ModelInstanceIndex]:
    """Return the model instances with positions."""
    return [i for i in instances(plant) if plant.num_positions(i) > 0]


def bodies(plant: Any) -> list[Any]:
    """Return every body except the world."""
    members = [plant.get_body(index) for i in instances(plant) for index in plant.GetBodyIndices(i)]
    return [body for body in members if body.index() != plant.world_body().index()]


def joints(plant: Any) -> list[Any]:
    """Return every joint in the order of the joint index."""
    return [plant.get_joint(JointIndex(int(i))) for i in plant.GetJointIndices()]


def actuators(plant: Any) -> list[Any]:
    """Return every drivable actuator in the order of the actuation input, in which ARMATURE actuators come last."""
    return [actuator for actuator in rotors(plant) if not actuator.name().startswith(ARMATURE)]


def rotors(plant: Any) -> list[Any]:
    """Return every actuator of Drake's plant, including undriven actuators that represent an armature."""
    return [plant.get_joint_actuator(JointActuatorIndex(int(i))) for i in plant.GetJointActuatorIndices()]


def joint_pose(joint: Any, q: float = 0.0) -> RigidTransform:
    """Return the pose of a joint's child frame in its parent frame, with a hinge or slide at q [rad or m].

    Free bodies are in their default pose, and other joints at zero.
    """
    if isinstance(joint, RevoluteJoint):
        return RigidTransform(RotationMatrix(AngleAxis(q, joint.revolute_axis())), np.zeros(3))
    if isinstance(joint, PrismaticJoint):
        return RigidTransform(q * np.asarray(joint.translation_axis()))
    if isinstance(joint, WeldJoint):
        return joint.X_FM()
    return joint.GetDefaultPose() if joint.type_name().endswith("_floating") else RigidTransform()


def labelled(elements: list[Any]) -> dict[str, Any]:
    """Return the elements by name, or by "instance::name" if two model instances use the same name."""
    names = [element.name() for element in elements]
    return {n if names.count(n) == 1 else "::".join(key_of(e)): e for e, n in zip(elements, names, strict=True)}


def key_of(element: Any) -> tuple[str, str]:
    """Return the names of an element's model instance and of the element."""
    return str(element.GetParentPlant().GetModelInstanceName(element.model_instance())), str(element.name())


def frame_named(plant: Any, subject: str, name: str, *, of_world: bool = False) -> Any:
    """Return the frame called `name`, or "instance::name"; raise UnknownNameError, which lists the existing frames.

    Frames of the world are included only if `of_world` is set.
    """
    frames, world = (plant.get_frame(FrameIndex(i)) for i in range(plant.num_frames())), plant.world_body().index()
    known = labelled([f for f in frames if f.name() and (of_world or f.body().index() != world)])
    full = {"::".join(key_of(frame)): frame for frame in known.values()}
    if name not in known and name not in full:
        raise UnknownNameError(subject, got=name, known=known)
    return known[name] if name in known else full[name]


def note(what: str, names: Collection[str]) -> tuple[str, ...]:
    """Return a sentence for the user that lists names, or nothing without names."""
    return (f"{what}: {', '.join(names)}.",) if names else ()


def central_inertia(inertia: Any) -> list[float]:
    """Return xx yy zz xy xz yz [kg m^2] of a spatial inertia about its centre of mass."""
    about_com = inertia.Shift(inertia.get_com()).CalcRotationalInertia()
    return [*about_com.get_moments(), *about_com.get_products()]


def radius_of_gyration(body: Any) -> float:
    """Return the radius of gyration [m] about the body's origin, or 0 for a body without mass."""
    moments = body.default_spatial_inertia().get_unit_inertia().get_moments()
    return float(np.sqrt(np.nan_to_num(np.sum(moments)) / 2))


# Contact quantities by their parameter names, with Drake's names.
PROXIMITY = {
    "friction": ("material", "coulomb_friction"),
    "stiffness": ("material", "point_contact_stiffness"),
    "dissipation": ("material", "hunt_crossley_dissipation"),
    "relaxation_time": ("material", "relaxation_time"),
    "hydroelastic_modulus": ("hydroelastic", "hydroelastic_modulus"),
}


def proximity_property(inspector: Any, geometry: Any, quantity: str) -> float | None:
    """Return a PROXIMITY quantity of a geometry, or None if it is not set; friction is the dynamic coefficient.

    A discrete plant uses only the dynamic coefficient.
    """
    properties = inspector.GetProximityProperties(geometry)
    if not properties.HasProperty(*PROXIMITY[quantity]):
        return None
    value = properties.GetProperty(*PROXIMITY[quantity])
    return float(value.dynamic_friction() if quantity == "friction" else value)


def scene_graph_beside(diagram: Any, path: DiagramPath) -> Any | None:
    """Return the SceneGraph, of either scalar type, nearest to the plant at `path`, or None."""
    for depth in reversed(range(len(path))):
        scene_graphs = [s for s in follow(diagram, path[:depth]).GetSystems() if isinstance(s, _SCENE_GRAPHS)]
        if scene_graphs:
            return scene_graphs[0]
    return None


def named(kind: str, elements: list[Any], name: str) -> Any:
    """Return the element called `name`; raise UnknownNameError, which lists the existing names."""
    matches = [element for element in elements if element.name() == name]
    if not matches:
        raise UnknownNameError(kind, got=name, known=[element.name() for element in elements])
    if len(matches) > 1:
        raise ModelError(f"{len(matches)} {kind}s are called {name!r}: expected exactly one")
    return matches[0]


def path_to_the_plant(diagram: Diagram) -> DiagramPath:
    """Return the path of the only MultibodyPlant in `diagram`; raise ModelError if there is none or more than one."""
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
    """Return the subsystem at `path` in the diagram or in its scalar-converted twin."""
    system = diagram
    for i in path:
        system = system.GetSystems()[i]
    return system
