"""Collision geometry that AutoDiffXd steps do not support, and its replacements.

In point contact, the AutoDiffXd step supports only a sphere against a sphere, box, cylinder, capsule or half space.
The whole step throws if the bounding boxes of any other pair overlap. A route around such pairs is chosen before the
plant is finalized.

This module also has the distance of shapes from a half space, which Drake does not compute. It finds the shapes that
overlap at all joint positions, such as the cover of a joint, because their contact force acts in every step.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations, product
from typing import Any

import numpy as np
from pydrake import geometry as pg
from pydrake.geometry import Box, Capsule, Convex, Cylinder, Ellipsoid, HalfSpace, Mesh
from pydrake.math import RigidTransform, sqrt
from pydrake.multibody.plant import ContactModel, MultibodyPlant
from pydrake.systems.framework import Diagram

from drake_diff._base.arrays import Array
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.model.file_facts import GeomSays, TouchFilter
from drake_diff.model.plant import bodies, joints, key_of

ROUTES = ("corner_spheres", "hydroelastic", "differences")
CORNER_RADIUS = 0.05  # of a corner sphere, relative to the smallest edge [1]: small enough to preserve the shape's size
SPHERES_PER_RIM = 8  # for a cylinder
HYDROELASTIC_MODULUS = 1e7  # [Pa], the modulus of stiff rubber

MEETS_A_SPHERE = {"Sphere", "Box", "Cylinder", "Capsule", "HalfSpace"}  # in point contact with AutoDiffXd
HYDROELASTIC_SHAPES = MEETS_A_SPHERE | {"Ellipsoid", "Convex", "Mesh"}
CONTACT_MODELS = ("point", "hydroelastic", "hydroelastic_with_fallback")


def autodiff_supports(shape_a: pg.Shape, shape_b: pg.Shape, contact_model: str) -> bool:
    """Return whether the AutoDiffXd step supports this pair of shapes in contact, as measured with Drake 1.51 and 1.58.

    For the two hydroelastic models, the shapes have the properties that the route "hydroelastic" assigns.
    Raises UnknownNameError if the contact model is unknown.
    """
    if contact_model not in CONTACT_MODELS:
        raise UnknownNameError("contact_model", got=contact_model, known=CONTACT_MODELS)
    shapes = {type(shape_a).__name__, type(shape_b).__name__}
    if contact_model == "point":
        return "Sphere" in shapes and shapes <= MEETS_A_SPHERE
    return shapes <= HYDROELASTIC_SHAPES and shapes != {"HalfSpace"}


def replace_collision_geometry(plant: MultibodyPlant, scene_graph: pg.SceneGraph, route: str) -> tuple[str, ...]:
    """Replace the collision geometry of `plant` for AutoDiffXd, and return a sentence for each change.

    Call it after all geometries are registered. Masses, inertias and visual geometry do not change. `route` is one of

    - "corner_spheres": each box, cylinder and capsule on a movable body is replaced by spheres inside it;
    - "hydroelastic": each geometry without hydroelastic properties becomes compliant, or rigid if it is a half space;
    - "differences": nothing changes, and steps that AutoDiffXd does not support are differentiated numerically.
    """
    if route not in ROUTES:
        raise UnknownNameError("contact_geometry", got=route, known=ROUTES)
    if plant.is_finalized():
        raise ModelError("the plant is finalized: its collision geometry can only be replaced before that")
    try:
        if route == "corner_spheres":
            return _to_corner_spheres(plant, scene_graph)
        if route == "hydroelastic":
            return _to_hydroelastic(plant, scene_graph)
    except RuntimeError as error:
        raise ModelError(f"Drake refuses contact_geometry={route!r}: {error}") from error
    return ("Steps with contacts that AutoDiffXd refuses are differentiated by finite differences, as chosen.",)


def _to_corner_spheres(plant: MultibodyPlant, scene_graph: pg.SceneGraph) -> tuple[str, ...]:
    inspector = scene_graph.model_inspector()
    geometries = collision_geometries(plant, scene_graph)
    fixed = {body.index() for body in plant.GetBodiesWeldedTo(plant.world_body())}
    # Pairs that a file or a user excludes from collision. Drake stores its filters by geometry, so the spheres would
    # not inherit them.
    pairs = [(a, b) for (body_a, a), (body_b, b) in combinations(geometries, 2) if body_a.index() != body_b.index()]
    filtered = [(a, b) for a, b in pairs if inspector.CollisionFiltered(a, b)]
    became = {geometry: [geometry] for _, geometry in geometries}
    notes = []
    for body, geometry in geometries:
        name, shape = f"{inspector.GetName(geometry)} on {body.name()}", inspector.GetShape(geometry)
        if isinstance(shape, pg.Convex | pg.Ellipsoid | pg.Mesh):
            notes.append(
                f"{name}: a {type(shape).__name__} is not replaced, and AutoDiffXd refuses point contact with it; "
                'use contact_geometry="hydroelastic" or "differences" if another shape can touch it.'
            )
        elif body.index() not in fixed and isinstance(shape, pg.Box | pg.Capsule | pg.Cylinder):
            became[geometry], note = _replace(plant, scene_graph, geometry, shape)
            notes.append(f"{name}: {note}")
    for a, b in filtered:
        exclude(scene_graph, became[a], became[b])
    return tuple(notes)


def exclude(scene_graph: pg.SceneGraph, some: Sequence[Any], others: Sequence[Any]) -> None:
    """Exclude contact between two groups of geometries."""
    between = pg.CollisionFilterDeclaration().ExcludeBetween(pg.GeometrySet(some), pg.GeometrySet(others))
    scene_graph.collision_filter_manager().Apply(between)


def collision_geometries(plant: MultibodyPlant, scene_graph: pg.SceneGraph) -> list[tuple[Any, Any]]:
    """Return the body and the id of every rigid geometry of the plant with the proximity role.

    plant.GetCollisionGeometriesForBody is not safe: its ids are in the plant's own list, which is reallocated.
    """
    inspector, source = scene_graph.model_inspector(), plant.get_source_id()
    frames = [(body, plant.GetBodyFrameIdIfExists(body.index())) for body in [plant.world_body(), *bodies(plant)]]
    return [
        (body, geometry)
        for body, frame in frames
        if frame is not None
        for geometry in inspector.GetGeometries(frame, pg.Role.kProximity)
        if inspector.BelongsToSource(geometry, source) and not inspector.IsDeformableGeometry(geometry)
    ]


def add_spheres(
    plant: MultibodyPlant, scene_graph: pg.SceneGraph, geometry: Any, radius: float, centres: Mapping[str, Array]
) -> list[Any]:
    """Add spheres with the properties of a geometry, and return their ids.

    `centres` (3,) [m] are in the geometry's frame, by the suffix that each sphere adds to the geometry's name.
    """
    inspector = scene_graph.model_inspector()
    body = plant.GetBodyFromFrameId(inspector.GetFrameId(geometry))
    X_BG = RigidTransform(inspector.GetPoseInFrame(geometry))
    properties = pg.ProximityProperties(inspector.GetProximityProperties(geometry))
    name = inspector.GetName(geometry).removeprefix(f"{key_of(body)[0]}::")
    return [
        plant.RegisterCollisionGeometry(body, X_BG @ RigidTransform(p), pg.Sphere(radius), name + suffix, properties)
        for suffix, p in centres.items()
    ]


def _replace(plant: MultibodyPlant, scene_graph: pg.SceneGraph, geometry: Any, shape: Any) -> tuple[list[Any], str]:
    """Replace a geometry by spheres and remove its proximity role; return their ids and a description."""
    radius, centres = _spheres(shape)
    spheres = add_spheres(plant, scene_graph, geometry, radius, {f"_corner_{i}": p for i, p in enumerate(centres)})
    scene_graph.RemoveRole(plant.get_source_id(), geometry, pg.Role.kProximity)
    became = f"a {type(shape).__name__.lower()} became {len(centres)} spheres of radius {radius:.4g} m"
    stiffness = "each with the stiffness of the original shape, as every contact point has its own spring"
    if isinstance(shape, pg.Capsule):
        return spheres, f"{became} at its ends ({stiffness}); between them there is no contact."
    if isinstance(shape, pg.Box):
        where = f"in its corners ({stiffness}: a face rests on 4 springs)"
        return spheres, f"{became} {where}; edges and faces between them have no contact."
    return spheres, f"{became} along its rims, which is approximate ({stiffness}); it rolls like a polygon."


def _spheres(shape: Any) -> tuple[float, list[Array]]:
    """Return the radius [m] of the spheres inside a shape, and their centres [m] in its frame.

    Each sphere touches the surface from inside: three faces of a box, or a cap and the side of a cylinder. The spheres
    of a capsule are its two ends.
    """
    if isinstance(shape, pg.Capsule):
        return shape.radius(), [np.array([0, 0, z * shape.length() / 2]) for z in (-1, 1)]
    if isinstance(shape, pg.Box):
        half = np.asarray(shape.size()) / 2
        radius = CORNER_RADIUS * 2 * float(np.min(half))
        return radius, [np.array(signs) * (half - radius) for signs in product((-1, 1), repeat=3)]
    radius = CORNER_RADIUS * min(2 * shape.radius(), shape.length())
    ring, height = shape.radius() - radius, shape.length() / 2 - radius
    angles = np.arange(SPHERES_PER_RIM) * 2 * np.pi / SPHERES_PER_RIM
    return radius, [np.array([ring * np.cos(a), ring * np.sin(a), z * height]) for z in (-1, 1) for a in angles]


def _to_hydroelastic(plant: MultibodyPlant, scene_graph: pg.SceneGraph) -> tuple[str, ...]:
    if plant.get_contact_model() == ContactModel.kPoint:
        expected = 'hydroelastic or hydroelastic_with_fallback, since contact_geometry is "hydroelastic"'
        raise InputError("contact_model", got="point", expected=expected)
    inspector, notes = scene_graph.model_inspector(), []
    for body, geometry in collision_geometries(plant, scene_graph):
        name = f"{inspector.GetName(geometry)} on {body.name()}"
        properties = pg.ProximityProperties(inspector.GetProximityProperties(geometry))
        if properties.HasProperty("hydroelastic", "compliance_type"):
            notes.append(f"{name}: keeps its own hydroelastic properties.")
            continue
        box = inspector.GetObbInGeometryFrame(geometry)
        if isinstance(inspector.GetShape(geometry), pg.HalfSpace) or box is None:
            pg.AddRigidHydroelasticProperties(properties)
            became = "rigid hydroelastic, as a compliant half space has no contact with a compliant body"
        else:  # preserves an existing modulus or hint
            hint = _taken(properties, "resolution_hint", float(np.min(box.half_width())))
            modulus = _taken(properties, "hydroelastic_modulus", HYDROELASTIC_MODULUS)
            pg.AddCompliantHydroelasticProperties(hint, modulus, properties)
            became = f"compliant hydroelastic, modulus {modulus:.4g} Pa, resolution {hint:.4g} m"
        scene_graph.AssignRole(plant.get_source_id(), geometry, properties, pg.RoleAssign.kReplace)
        notes.append(f"{name}: became {became}.")
    return tuple(notes)


def _taken(properties: pg.ProximityProperties, name: str, default: float) -> float:
    """Remove a hydroelastic property from a geometry's properties and return its value, or the default."""
    value = float(properties.GetPropertyOrDefault("hydroelastic", name, default))
    properties.RemoveProperty("hydroelastic", name)
    return value


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """The closest points of geometries A and B, of floats or AutoDiffXd, like Drake's SignedDistancePair."""

    id_A: Any
    id_B: Any
    p_ACa: Any  # (3,) the closest point of A, in its own frame [m]
    p_BCb: Any
    distance: Any  # [m], signed
    nhat_BA_W: Any  # (3,)


def from_half_space(query: Any, ids: tuple[Any, Any]) -> ClosestPoints | None:
    """Return the pair of a half space and a box, capsule, cylinder, ellipsoid or convex hull; None for other pairs."""
    inspector = query.inspector()
    shapes = [inspector.GetShape(i) for i in ids]
    grounds = [i for i, shape in enumerate(shapes) if isinstance(shape, HalfSpace)]
    if len(grounds) != 1:
        return None
    ground, other = ids[grounds[0]], ids[1 - grounds[0]]
    X_WG, X_WO = query.GetPoseInWorld(ground), query.GetPoseInWorld(other)
    up = X_WG.rotation().matrix()[:, 2]
    low = _furthest(shapes[1 - grounds[0]], -(X_WO.rotation().matrix().T @ up))
    if low is None:
        return None
    from_ground = X_WG.rotation().matrix().T @ (
        X_WO.rotation().matrix() @ low + X_WO.translation() - X_WG.translation()
    )
    distance = from_ground[2]
    below = np.array([from_ground[0], from_ground[1], 0 * distance])
    if grounds[0] == 0:
        return ClosestPoints(ground, other, below, low, distance, -up)
    return ClosestPoints(other, ground, low, below, distance, up)


def _furthest(shape: Any, along: Any) -> Any:
    """Return the shape's furthest point (3,) along a unit vector, in its frame, or None for an unsupported shape."""
    if isinstance(shape, Box):
        return np.where(along > 0, 1, -1) * (np.array(shape.size()) / 2)
    if isinstance(shape, Capsule | Cylinder):
        end = np.array([0, 0, shape.length() / 2 if along[2] > 0 else -shape.length() / 2])
        if isinstance(shape, Capsule):
            return end + shape.radius() * along
        across = along * np.array([1, 1, 0])
        size = across @ across
        return end + (shape.radius() / sqrt(size) * across if size > 0 else 0)
    if isinstance(shape, Ellipsoid):
        half = np.array([shape.a(), shape.b(), shape.c()])
        return half**2 * along / sqrt(np.sum((half * along) ** 2))
    if isinstance(shape, Convex | Mesh):
        hull = shape.GetConvexHull()
        vertices = np.array([hull.vertex(i) for i in range(hull.num_vertices())])
        return vertices[np.argmax(vertices @ along)]
    return None


POSTURES = 100  # in addition to the default configuration
FIRST = 10  # number of first postures in which a pair must overlap at least once
FLUSH = 1e-9  # [m]
REACH = 4.0  # [m or rad] for joints without limits and for floating bodies
TOLD = 6  # maximum number of link pairs in a sentence
Pairs = Sequence[tuple[Any, Any]]


def inseparable_pairs(plant: MultibodyPlant, diagram: Diagram) -> Pairs:
    """Return the pairs of geometries that overlap at the default positions and in 100 seeded postures within limits.

    Flush geometries count, because rounding decides their contact. Joints that follow others are independent in these
    postures, and floating bodies take any pose. Raises ModelError if Drake cannot determine the overlaps.
    """
    root, random = diagram.CreateDefaultContext(), np.random.default_rng(0)
    context, port = plant.GetMyMutableContextFromRoot(root), plant.get_geometry_query_input_port()
    if not port.HasValue(context):
        return ()
    postures = [plant.GetPositions(context)] + [_posture(plant, random) for _ in range(POSTURES)]
    pairs: set[tuple[Any, Any]] = set()
    for k, q in enumerate([*postures[:FIRST], *postures]):
        plant.SetPositions(context, q)
        query = port.Eval(context)
        try:
            here = {tuple(sorted((contact.id_A, contact.id_B))) for contact in query.ComputePointPairPenetration()}
        except RuntimeError as error:
            raise ModelError(f"Drake cannot tell which shapes overlap: {error}") from error
        pairs = pairs | here if k < FIRST else {pair for pair in pairs if pair in here or _are_flush(query, *pair)}
        if not pairs and k >= FIRST:
            break
    return tuple(sorted(pairs))


def _are_flush(query: Any, a: Any, b: Any) -> bool:
    """Return whether two disjoint geometries touch up to rounding, or False if Drake cannot measure the distance."""
    try:
        return bool(query.ComputeSignedDistancePairClosestPoints(a, b).distance <= FLUSH)
    except RuntimeError:
        return False


def _posture(plant: MultibodyPlant, random: np.random.Generator) -> Array:
    """Return random positions (nq,) within the limits, with unit quaternions."""
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    middle = np.clip(0.0, lower, upper)
    lower, upper = np.maximum(lower, middle - REACH), np.minimum(upper, middle + REACH)
    q = np.array(random.uniform(lower, upper))
    for joint in joints(plant):
        if joint.type_name() == "quaternion_floating":
            start = joint.position_start()
            q[start : start + 4] = random.standard_normal(4)
            q[start : start + 4] /= np.linalg.norm(q[start : start + 4])
    return q


def links_of(plant: MultibodyPlant, scene_graph: pg.SceneGraph, pairs: Pairs) -> str:
    """List the links of the pairs for a sentence, without duplicates, and the number of omitted pairs."""
    inspector = scene_graph.model_inspector()
    names = (
        " - ".join(sorted(str(plant.GetBodyFromFrameId(inspector.GetFrameId(g)).name()) for g in pair))
        for pair in pairs
    )
    links = list(dict.fromkeys(names))
    return ", ".join(links[:TOLD]) + (f" and {len(links) - TOLD} more" if len(links) > TOLD else "")


def touch_what_can_separate(plant: MultibodyPlant, scene_graph: pg.SceneGraph, diagram: Diagram) -> tuple[str, ...]:
    """Exclude pairs that overlap in every posture; call it on the built diagram before its contexts are in use."""
    pairs = inseparable_pairs(plant, diagram)
    for a, b in pairs:
        exclude(scene_graph, [a], [b])
    if not pairs:
        return ()
    number = f"{len(pairs)} pairs of shapes pass" if len(pairs) > 1 else "One pair of shapes passes"
    return (
        f"{number} through each other, as they overlap at all joint positions: {links_of(plant, scene_graph, pairs)}.",
    )


def touch_as_mujoco(
    plant: MultibodyPlant, scene_graph: pg.SceneGraph, touching: Mapping[str, TouchFilter], *, give: bool
) -> tuple[str, ...]:
    """Set the collision filters of MJCF shapes as in MuJoCo, by instance; pairs are added only with `give`.

    Returns a sentence for each change. Drake filters neighbouring bodies, but not if a body has two joints, and it has
    no collision masks. Call it on the built diagram before its contexts are in use.
    """
    inspector, excluded, allowed = scene_graph.model_inspector(), list[tuple[Any, Any]](), list[tuple[Any, Any]]()
    for instance, says in touching.items():
        shapes = _shapes_of(plant, scene_graph, instance, says, alone=len(touching) == 1)
        for (a, g), (b, h) in combinations(shapes, 2):
            if says.may_touch(a, b) == inspector.CollisionFiltered(g, h):
                (allowed if says.may_touch(a, b) else excluded).append((g, h))
    notes = []
    for pairs, rule in ((excluded, "pass through each other"), (allowed if give else [], "touch")):
        for g, h in pairs:
            declaration = pg.CollisionFilterDeclaration()
            declare = declaration.AllowBetween if rule == "touch" else declaration.ExcludeBetween
            scene_graph.collision_filter_manager().Apply(declare(pg.GeometrySet([g]), pg.GeometrySet([h])))
        if pairs:
            notes.append(f"As in MuJoCo, {len(pairs)} pairs of shapes {rule}: {links_of(plant, scene_graph, pairs)}.")
    return tuple(notes)


def _shapes_of(
    plant: MultibodyPlant, scene_graph: pg.SceneGraph, instance: str, says: TouchFilter, *, alone: bool
) -> list[tuple[GeomSays, Any]]:
    """Return the shapes of an instance with the file's data; include the world's shapes if the instance is `alone`."""
    inspector, by_body = scene_graph.model_inspector(), dict[str, list[Any]]()
    for body, geometry in collision_geometries(plant, scene_graph):
        whose, _ = key_of(body)
        if whose == instance or (alone and body.index() == plant.world_body().index()):
            by_body.setdefault("world" if whose != instance else body.name(), []).append(geometry)
    names = list(dict.fromkeys(geom.body for geom in says.geoms))
    nameless = [name for name in names if name.startswith("?")], [name for name in by_body if name not in names]
    called = dict(zip(*nameless, strict=True)) if len(nameless[0]) == len(nameless[1]) else {}
    shapes = []
    for geom in says.geoms:
        for geometry in by_body.get(called.get(geom.body, geom.body), ()):
            if re.sub(r"^.*::|_corner_\d+$", "", inspector.GetName(geometry)) == geom.name:
                shapes.append((geom, geometry))
    return shapes
