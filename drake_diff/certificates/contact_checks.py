"""The audit's checks of contact. Their thresholds were measured with the Drake version of this package's tests."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from pydrake.multibody.plant import ContactModel

from drake_diff._base.arrays import Array
from drake_diff.certificates.finding import PARALLEL, Collider, ColliderPair, Finding, Point, Severity, listed
from drake_diff.exceptions import DrakeDiffError, ModelError, SimulationError
from drake_diff.model.contact_geometry import MEETS_A_SPHERE, inseparable_pairs, links_of
from drake_diff.model.plant import PROXIMITY, joints
from drake_diff.model.step import set_state


@dataclass(frozen=True)
class ContactCheckOptions:
    """Thresholds of the contact checks."""

    pairs: int = 6  # number of link pairs that get separate findings; a humanoid has hundreds of pairs
    nearly_parallel: float = 1e-2  # [rad]; jumps were measured up to 1e-3 and beyond
    in_plane: float = 1e-6  # [m] distance from a plane of symmetry
    reach: float = 1e-3  # [m] faces nearer than this count as touching
    on_axis: float = 1e-9  # [m] distance between a sphere's centre and a cylinder's axis
    touch: float = 1e-9  # [m] signed distance, for shapes for which Drake computes it exactly
    rough_touch: float = 1e-6  # [m] the same, for iterative distances (measured error for an ellipsoid: 1e-7)


OPTIONS = ContactCheckOptions()
ROUND = ("Sphere", "Ellipsoid", "Capsule")
UNITS = dict(zip(PROXIMITY, ("", " N/m", " s/m", " s", " Pa"), strict=True))
CORNER = re.compile(r"_corner_\d+ \(Sphere\)$")  # names of the spheres of replace_collision_geometry


def short(error: DrakeDiffError) -> str:
    """Return the first sentence of a step's error message."""
    return str(error).removeprefix("Drake cannot take this step: ").split(". ")[0].rstrip(".")


def refused_pairs(point: Point) -> Iterator[Finding]:
    """Find pairs that Drake does not support with AutoDiffXd, grouped by their links."""
    by_choice = point.model.contact_geometry == "differences"
    groups: dict[tuple[str, str], list[ColliderPair]] = {}
    for pair in point.pairs:
        if pair.refused:
            groups.setdefault(pair.bodies, []).append(pair)
    rows = [
        (" - ".join(links), _refusal(point, pairs), pairs) for links, pairs in list(groups.items())[: OPTIONS.pairs]
    ]
    if rest := list(groups)[OPTIONS.pairs :]:
        message = f"pairs of the same kinds of shapes: {listed(' - '.join(links) for links in rest)}"
        rows.append((f"{len(rest)} more pairs of links", message, [pair for links in rest for pair in groups[links]]))
    for subject, message, pairs in rows:
        arguments = {} if by_choice else _route(point, pairs)
        remedy = (
            'load_model(..., contact_geometry="corner_spheres") (for boxes, cylinders, capsules), "hydroelastic" or '
            '"differences"; or filter the pair if it never touches (CollisionFilterDeclaration, or '
            "<drake:collision_filter_group> in the file)"
        )
        if by_choice:
            remedy = "no action is needed: the step uses differences as chosen, with method auto or finite_difference"
        elif "meshes" in arguments:
            remedy = f'meshes="spheres" and {remedy}'
        yield Finding("info" if by_choice else "error", "pair_refused", subject, message, remedy, arguments)


def _route(point: Point, pairs: list[ColliderPair]) -> dict[str, Any]:
    """Return the arguments of `load_model` with which these pairs can be differentiated."""
    kinds, source = {kind for pair in pairs for kind in pair.kinds}, point.model.source
    if point.model.plant.get_contact_model() != ContactModel.kPoint:
        return {"contact_geometry": "hydroelastic"}
    if kinds <= MEETS_A_SPHERE:
        return {"contact_geometry": "corner_spheres"}
    if source is not None and source.suffix in (".urdf", ".sdf") and kinds <= MEETS_A_SPHERE | {"Mesh", "Convex"}:
        return {"meshes": "spheres", "contact_geometry": "corner_spheres"}
    return {"contact_geometry": "differences"}


def _refusal(point: Point, pairs: list[ColliderPair]) -> str:
    sides = (dict.fromkeys(p.a.label for p in pairs), dict.fromkeys(p.b.label for p in pairs))
    names, error = " against ".join(", ".join(side) for side in sides), point.by_autodiff
    why = "AutoDiffXd has no point contact between these shapes, and throws once their bounding boxes meet"
    if any(pair.contact == "none" for pair in pairs):
        why = "hydroelastic contact requires properties of both shapes, one compliant; the double step throws too"
    if any("HalfSpace" in pair.kinds for pair in pairs):
        why += ", and the bounding box of a tilted half space is infinite, so that the step throws without contact"
    if not isinstance(error, SimulationError):
        return f"{names}: {why}. The AutoDiffXd step does not throw at x."
    named = any(all(kind.lower() in str(error).lower() for kind in pair.kinds) for pair in pairs)
    over = "over such shapes" if named else "over another pair"
    return f"{names}: {why}. The AutoDiffXd step throws at x {over}: {short(error)}."


def aligned_faces(point: Point) -> Iterator[Finding]:
    """Find flat faces that may meet in hydroelastic contact, where the step jumps."""
    remedy = (
        'load_model(..., contact_model="point", contact_geometry="corner_spheres") replaces one of them by spheres; or '
        "start tilted by 0.03 rad or more (cylinder on cylinder 0.04) and `certify` the poses in contact"
    )
    for pair in point.pairs:
        angle, gap = _alignment(pair) if pair.contact == "hydroelastic" else (None, np.inf)
        if angle is None:
            continue
        severity: Severity = "info"
        consequence = "the hydroelastic step would jump if the faces became parallel"
        if angle <= PARALLEL and gap <= OPTIONS.reach:
            severity = "error"
            consequence = "the hydroelastic step jumps there, and AutoDiffXd gives a finite, plausible, wrong number"
        elif angle <= OPTIONS.nearly_parallel:
            severity, consequence = "warning", "the hydroelastic step jumps if the faces meet at this angle"
        message = f"the faces are {angle:.2g} rad from parallel at x and {gap:.3g} m apart: {consequence}"
        arguments = {} if severity == "info" else {"contact_model": "point", "contact_geometry": "corner_spheres"}
        yield Finding(severity, "aligned_faces", pair.label, message, remedy, arguments)


def _alignment(pair: ColliderPair) -> tuple[float | None, float]:
    """Return the smallest angle [rad] between two face normals, None without flat faces, and the gap [m] along them.

    The gap is negative if the bounding boxes overlap. Drake's mesh of a round shape counts as flat if its centre lies
    in a plane of symmetry of a box's mesh, or in a plane of symmetry through the axis of a cylinder's mesh.
    """
    for first, other in pair.both_orders:
        if first.kind in ROUND and other.kind in ("Box", "Cylinder"):
            offset = other.pose.inverse() @ first.pose.translation()
            if np.min(np.abs(offset[: 3 if other.kind == "Box" else 2])) > OPTIONS.in_plane:
                return None, np.inf
    faces = list(product(*(_normals(*both) for both in pair.both_orders)))
    if not faces:
        return None, np.inf
    gaps = []
    for direction in (n for both in faces for n in both):
        (low_a, high_a), (low_b, high_b) = pair.a.extent(direction), pair.b.extent(direction)
        gaps.append(max(low_a - high_b, low_b - high_a))
    return min(float(np.linalg.norm(np.cross(n, m))) for n, m in faces), max(gaps)


def _normals(collider: Collider, other: Collider) -> list[Array]:
    """Return the normals of the collider's flat faces, or of the planes with which its mesh is aligned."""
    meshed = other.kind in ("Box", "Cylinder")
    if collider.kind == "Box" or (collider.kind in ("Sphere", "Ellipsoid") and meshed):
        return [collider.axis(i) for i in range(3)]
    upright = collider.kind in ("Cylinder", "HalfSpace") or (collider.kind == "Capsule" and meshed)
    return [collider.axis(2)] if upright else []


def spheres_on_axes(point: Point) -> Iterator[Finding]:
    """Find spheres on a cylinder's axis, where AutoDiffXd is singular."""
    distances: dict[str, float] = {}  # [m]
    for pair in (pair for pair in point.pairs if pair.contact == "point"):
        for first, other in pair.both_orders:
            if (first.kind, other.kind) == ("Sphere", "Cylinder"):
                offset = first.pose.translation() - other.pose.translation()
                distances[pair.label] = float(np.linalg.norm(np.cross(other.axis(2), offset)))
    consequences: dict[bool, tuple[Severity, str]] = {
        True: ("error", "AutoDiffXd is singular on the axis in contact (NaN, or a plausible wrong number)"),
        False: ("info", "AutoDiffXd would be singular exactly on the axis"),
    }
    for on_axis, (severity, consequence) in consequences.items():
        labels = [label for label, distance in distances.items() if (distance < OPTIONS.on_axis) == on_axis]
        if labels:
            nearest = min(distances[label] for label in labels)
            message = f"the sphere's centre is {nearest:.3g} m from the cylinder's axis: {consequence}"
            remedy = "move the sphere off the axis by 1e-6 m or more, or replace the cylinder by a box"
            yield Finding(severity, "cylinder_axis", listed(labels), message, remedy)


def contact_defaults(point: Point) -> Iterator[Finding]:
    """Find contact parameters that are not set, so that defaults apply."""
    groups: dict[tuple[str, ...], list[Collider]] = {}
    for collider in point.colliders:
        contacts = {pair.contact for pair in point.pairs if collider in (pair.a, pair.b)}
        read = ["friction", "relaxation_time" if point.is_sap else "dissipation"]  # properties that the step uses
        read += ["stiffness"] * ("point" in contacts)
        read += ["hydroelastic_modulus"] * ("hydroelastic" in contacts and collider.compliance == "compliant")
        if missing := tuple(name for name in read if not collider.has(name)):
            groups.setdefault(missing, []).append(collider)
    for missing, colliders in groups.items():
        values = {name: _value(colliders[0], name) for name in missing}
        defaults = ", ".join(f"{PROXIMITY[name][1]} {value}" for name, value in values.items())
        message = f"no value is set, so that the scene graph's defaults apply: {defaults}"
        if values.get("relaxation_time") == "0.1 s":
            message += " (with which a ball hardly bounces)"
        tags = ", ".join(f"drake:{'mu_dynamic' if name == 'friction' else PROXIMITY[name][1]}" for name in missing)
        remedy = f"set them in <drake:proximity_properties> ({tags}) or in the geometry's ProximityProperties"
        yield Finding("warning", "default_decides", ", ".join(c.label for c in colliders), message, remedy)


def _value(collider: Collider, name: str) -> str:
    """Return the value that Drake uses, with its unit."""
    if not collider.used.HasProperty(*PROXIMITY[name]):
        return "(Drake's own)"
    value = collider.used.GetProperty(*PROXIMITY[name])
    return f"{value.dynamic_friction() if name == 'friction' else value:g}{UNITS[name]}"


def unread_compliance(point: Point) -> Iterator[Finding]:
    """Find a dissipation property that the contact approximation does not read."""
    given, read = ("dissipation", "relaxation_time") if point.is_sap else ("relaxation_time", "dissipation")
    names = [collider.label for collider in point.colliders if collider.has(given) and not collider.has(read)]
    if names:
        by, other = ("sap reads", "similar") if point.is_sap else ("similar and lagged read", "sap")
        message = f"{PROXIMITY[given][1]} is set, but {by} {PROXIMITY[read][1]}, which is not set"
        remedy = f'set drake:{PROXIMITY[read][1]} too, or load_model(..., contact_approximation="{other}")'
        yield Finding("warning", "unread_compliance", listed(names), message, remedy, {"contact_approximation": other})


def pairs_at_touch(point: Point) -> Iterator[Finding]:
    """Find pairs with a signed distance of zero, where the derivative is one-sided."""
    set_state(point.model.double, point.x)
    unmeasured = []
    for pair in point.pairs:
        try:
            distance = point.query.ComputeSignedDistancePairClosestPoints(pair.a.id, pair.b.id).distance
        except RuntimeError:  # Drake computes no signed distance for these shapes
            unmeasured.append(pair.label)
            continue
        exact = (pair.kinds <= MEETS_A_SPHERE and "Sphere" in pair.kinds) or pair.kinds == {"Box"}
        if abs(distance) < (OPTIONS.touch if exact else OPTIONS.rough_touch):
            message = f"the shapes just touch (signed distance {distance:.2g} m), where the derivative is one-sided"
            remedy = "start with a small gap or a small overlap, or use `smooth_step`"
            yield Finding("warning", "touching", pair.label, message, remedy)
    if unmeasured:
        message = (
            "Drake computes no distance between these shapes, so that the audit cannot check whether they just touch"
        )
        remedy = "compare the steps from x and from x moved by 1e-6 m, or replace one shape by spheres (corner_spheres)"
        yield Finding("info", "not_measured", ", ".join(unmeasured), message, remedy)


def inseparable(point: Point) -> Iterator[Finding]:
    """Find pairs that overlap at all joint positions."""
    model = point.model
    if model.double.scene_graph is None or not model.contract.contact.collision_pairs:
        return
    try:
        pairs = inseparable_pairs(model.plant, model.diagram)
    except ModelError:
        return  # no step can be taken then, which another check reports
    if pairs:
        message = (
            f"the links overlap at all joint positions (pairs of shapes: {len(pairs)}) and push each other apart in "
            "every step; in a deep overlap Drake's contact point jumps and has no derivative"
        )
        remedy = 'load_model(..., contact="separable") lets only these pairs pass through each other'
        subject = links_of(model.plant, model.double.scene_graph, pairs)
        yield Finding("warning", "never_apart", subject, message, remedy, {"contact": "separable"})


def corners_on_both_sides(point: Point) -> Iterator[Finding]:
    """Find two kinematic trees that can only touch at the spheres in their corners."""
    plant = point.model.plant
    above = {joint.child_body().name(): joint.parent_body() for joint in joints(plant)}

    def root(name: str) -> str:
        while name in above and not plant.IsAnchored(above[name]):
            name = above[name].name()
        return name

    links = [
        " - ".join(sorted(pair.bodies))
        for pair in point.pairs
        if CORNER.search(pair.a.label) and CORNER.search(pair.b.label) and root(pair.a.body) != root(pair.b.body)
    ]
    if links:
        message = (
            "both links have spheres in their corners only, which miss each other, so that one falls through the other"
        )
        remedy = (
            'contact_geometry="hydroelastic" with contact_model="hydroelastic_with_fallback", or "differences"; or '
            "cover the touching face of one link with spheres in the file"
        )
        yield Finding("warning", "corners_miss", listed(links), message, remedy, {"contact_geometry": "differences"})
