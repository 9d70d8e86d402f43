"""Parameters of contact, by body ("ball.friction", all its geometries) or by geometry ("ball/tip.friction").

Drake takes them as plain numbers only, so their derivative is a difference of the double step, but where
`contact_jacobian` has it in closed form.
"""

from collections.abc import Callable
from typing import Any

from pydrake.geometry import Capsule, Cylinder, ProximityProperties, Role, RoleAssign, SceneGraphInspector, Sphere
from pydrake.multibody.plant import CoulombFriction

from drake_diff.model import Model
from drake_diff.parameter_kinds import Found, Kind, Values
from drake_diff.plant_elements import bodies, labelled
from drake_diff.twin import Twin

_PROPERTIES = {  # quantity: (group, name, unit)
    "friction": ("material", "coulomb_friction", "1"),
    "stiffness": ("material", "point_contact_stiffness", "N/m"),
    "dissipation": ("material", "hunt_crossley_dissipation", "s/m"),
    "relaxation_time": ("material", "relaxation_time", "s"),
    "hydroelastic_modulus": ("hydroelastic", "hydroelastic_modulus", "Pa"),
}
_ROUND = (Sphere, Cylinder, Capsule)


def geometries_of(twin: Twin) -> dict[str, list[Any]]:
    """Collision geometries by the label of a body, and one by one."""
    inspector, plant = twin.inspector, twin.plant
    if inspector is None or twin.scene_graph is None:
        return {}
    found: dict[str, list[Any]] = {}
    for label, body in {"world": plant.world_body(), **labelled(bodies(plant))}.items():
        frame = plant.GetBodyFrameIdIfExists(body.index())
        own = [] if frame is None else list(inspector.GetGeometries(frame, Role.kProximity))
        if own:
            found[label] = own
            found |= {f"{label}/{inspector.GetName(i).split('::')[-1]}": [i] for i in own}
    return found


def _find(quantity: str, unit: str, read: Callable[[SceneGraphInspector, Any], float | None]) -> Kind:
    def find(model: Model) -> Found:
        for label, ids in geometries_of(model.double).items():
            values = {read(model.double.inspector, i) for i in ids}
            value = values.pop()
            if value is not None and not values:  # of geometries that differ each has its own value
                yield label, unit, value

    write = _write_radius if quantity == "radius" else _write_property(quantity)
    return Kind(quantity, "finite_difference", find, write, positive=True)


def _read_property(quantity: str) -> Callable[[SceneGraphInspector, Any], float | None]:
    group, name, _ = _PROPERTIES[quantity]

    def read(inspector: SceneGraphInspector, geometry: Any) -> float | None:
        properties = inspector.GetProximityProperties(geometry)
        if not properties.HasProperty(group, name):
            return None
        value = properties.GetProperty(group, name)
        return float(value.dynamic_friction() if quantity == "friction" else value)

    return read


def _read_radius(inspector: SceneGraphInspector, geometry: Any) -> float | None:
    shape = inspector.GetShape(geometry)
    return float(shape.radius()) if isinstance(shape, _ROUND) else None


def _write_property(quantity: str) -> Callable[[Twin, str, Values], None]:
    group, name, _ = _PROPERTIES[quantity]

    def write(twin: Twin, label: str, value: Values) -> None:
        new, inspector = float(value[0]), twin.inspector
        root = twin.scene_graph.GetMyMutableContextFromRoot(twin.root_context)
        for geometry in geometries_of(twin)[label]:
            properties = ProximityProperties(inspector.GetProximityProperties(geometry))
            properties.UpdateProperty(group, name, CoulombFriction(new, new) if quantity == "friction" else new)
            twin.scene_graph.AssignRole(root, twin.plant.get_source_id(), geometry, properties, RoleAssign.kReplace)

    return write


def _write_radius(twin: Twin, label: str, value: Values) -> None:
    radius, inspector = float(value[0]), twin.inspector
    root = twin.scene_graph.GetMyMutableContextFromRoot(twin.root_context)
    for geometry in geometries_of(twin)[label]:
        shape = inspector.GetShape(geometry)
        new = Sphere(radius) if isinstance(shape, Sphere) else type(shape)(radius, shape.length())
        twin.scene_graph.ChangeShape(root, twin.plant.get_source_id(), geometry, new)


CONTACT_KINDS = (
    *(_find(quantity, _PROPERTIES[quantity][2], _read_property(quantity)) for quantity in _PROPERTIES),
    _find("radius", "m", _read_radius),
)
