"""The checks of an audit that are about contact: refused pairs, flat faces, cylinder axes, defaults, exact touch.

Before anything runs: what in a model cannot be differentiated, or will be differentiated wrongly, and what to do.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Box, Cylinder, Sphere
from pydrake.multibody.plant import DiscreteContactApproximation
from pydrake.multibody.tree import FixedOffsetFrame, WeldJoint

from drake_diff._base.arrays import Array
from drake_diff.certificates.audit_place import PARALLEL, SEVERITIES, Finding, Findings, Geometry, Pair, Place, short
from drake_diff.derivatives.step import StepDerivatives, differentiate_step
from drake_diff.exceptions import DrakeDiffError, GradientError, ModelError, SimulationError
from drake_diff.model.load_file import MEETS_A_SPHERE
from drake_diff.model.model import Model
from drake_diff.model.parameter_kinds import IDENTITY_OFFSET
from drake_diff.model.plant import actuators, instances, is_driven, joints
from drake_diff.model.step import advance, check_point, set_state

NEARLY_PARALLEL = 1e-2  # [rad]: jumps were measured up to 1e-3 and beyond
IN_PLANE = 1e-6  # [m] from a plane of symmetry
ROUND = ("Sphere", "Ellipsoid", "Capsule")
REACH = 1e-3  # [m] faces nearer than this count as touching
ON_AXIS = 1e-9  # [m] from a sphere's centre to a cylinder's axis
TOUCH = 1e-9  # [m] of signed distance, where Drake computes it exactly
ROUGH_TOUCH = 1e-6  # [m] where it iterates (measured: 1e-7 off for an ellipsoid)

_PROPERTIES = {  # name: (group, unit, the tag in <drake:proximity_properties>)
    "coulomb_friction": ("material", "", "drake:mu_dynamic"),
    "point_contact_stiffness": ("material", " N/m", "drake:point_contact_stiffness"),
    "hunt_crossley_dissipation": ("material", " s/m", "drake:hunt_crossley_dissipation"),
    "relaxation_time": ("material", " s", "drake:relaxation_time"),
    "hydroelastic_modulus": ("hydroelastic", " Pa", "drake:hydroelastic_modulus"),
}


def _pair_refused(place: Place) -> Findings:
    by_choice = place.model.contact_geometry == "differences"
    groups: dict[tuple[str, str], list[Pair]] = {}
    for pair in place.pairs:
        if pair.refused:
            groups.setdefault(pair.bodies, []).append(pair)
    remedy = (
        'load_model(..., contact_geometry="corner_spheres") puts spheres in place of boxes, cylinders and capsules, '
        '"hydroelastic" gives every geometry a mesh, "differences" differences the step by choice; or filter the pair '
        "(CollisionFilterDeclaration, or <drake:collision_filter_group> in the file) where it never touches"
    )
    if by_choice:
        remedy = "nothing to do: it is differenced by choice, which needs method auto or finite_difference"
    for bodies, pairs in groups.items():
        yield Finding(
            "info" if by_choice else "error", "pair_refused", " - ".join(bodies), _refusal(place, pairs), remedy
        )


def _refusal(place: Place, pairs: list[Pair]) -> str:
    sides = (dict.fromkeys(p.a.label for p in pairs), dict.fromkeys(p.b.label for p in pairs))
    names = " against ".join(", ".join(side) for side in sides)
    if any(pair.contact == "none" for pair in pairs):
        why = "hydroelastic contact alone needs properties on both, one of them not rigid; the double step throws too"
    else:
        why = "AutoDiffXd has no point contact between these shapes, and throws as soon as their bounding boxes meet"
    if any("HalfSpace" in (p.a.kind, p.b.kind) for p in pairs):
        why += ", and that of a tilted half space is infinite: it throws without touching"
    error = place.by_autodiff
    if not isinstance(error, SimulationError):
        return f"{names}: {why}. The AutoDiffXd step does not throw at x."
    if any(p.a.kind.lower() in str(error).lower() and p.b.kind.lower() in str(error).lower() for p in pairs):
        return f"{names}: {why}. The AutoDiffXd step throws at x over such shapes: {short(error)}."
    return f"{names}: {why}. At x the AutoDiffXd step throws over another pair: {short(error)}."


def _aligned_faces(place: Place) -> Findings:
    remedy = (
        "put spheres in place of one of them (corner_spheres), or start tilted by 0.03 rad and more and `certify` the "
        "poses in contact: near the aligned pose too (measured: up to 1e-3 rad, cylinder on cylinder up to 0.04) the "
        "meshes' edges make the step jump"
    )
    for pair in place.pairs:
        if pair.contact != "hydroelastic":
            continue
        angle, gap = _alignment(pair)
        if angle is None:
            continue
        text = f"faces {angle:.2g} rad from parallel at x, {gap:.3g} m apart: "
        if angle <= PARALLEL and gap <= REACH:
            text += "the hydroelastic step jumps there, and AutoDiffXd gives a finite, plausible, wrong number"
            yield Finding("error", "aligned_faces", pair.label, text, remedy)
        elif angle <= NEARLY_PARALLEL:
            text += "where they meet like this the hydroelastic step jumps"
            yield Finding("warning", "aligned_faces", pair.label, text, remedy)
        else:
            text += "tilted now; where they come to lie flat the hydroelastic step jumps"
            yield Finding("info", "aligned_faces", pair.label, text, remedy)


def _alignment(pair: Pair) -> tuple[float | None, float]:
    """The angle [rad] between the two nearest face normals, and the gap [m] along them; None without flat faces.

    Drake's mesh of a round shape is one too, where it lies in a plane of symmetry of a box's or a cylinder's mesh.
    """
    for one, other in ((pair.a, pair.b), (pair.b, pair.a)):
        if one.kind in ROUND and other.kind in ("Box", "Cylinder") and not _in_symmetry_plane(one, other):
            return None, np.inf
    faces = [(n, m) for n in _normals(pair.a, pair.b) for m in _normals(pair.b, pair.a)]
    if not faces:
        return None, np.inf
    angle = min(float(np.linalg.norm(np.cross(n, m))) for n, m in faces)
    return angle, max(_gap(pair, n) for both in faces for n in both)


def _normals(geometry: Geometry, other: Geometry) -> list[Array]:
    """The normals of its flat faces, or of the planes that its mesh lines up with."""
    if geometry.kind == "Box" or (geometry.kind in ("Sphere", "Ellipsoid") and other.kind in ("Box", "Cylinder")):
        return [geometry.axis(i) for i in range(3)]
    meshed_capsule = geometry.kind == "Capsule" and other.kind in ("Box", "Cylinder")
    return [geometry.axis(2)] if geometry.kind in ("Cylinder", "HalfSpace") or meshed_capsule else []


def _in_symmetry_plane(round_: Geometry, flat: Geometry) -> bool:
    """Whether a round shape's centre is in a plane x = 0 or y = 0 (of a box: or z = 0) of the flat one's frame."""
    offset = flat.pose.inverse() @ round_.pose.translation()
    planes = 3 if flat.kind == "Box" else 2
    return bool(np.min(np.abs(offset[:planes])) <= IN_PLANE)


def _gap(pair: Pair, direction: Array) -> float:
    """How far [m] the two boxes are apart along a direction; negative where they overlap."""
    (low_a, high_a), (low_b, high_b) = pair.a.extent(direction), pair.b.extent(direction)
    return max(low_a - high_b, low_b - high_a)


def _cylinder_axis(place: Place) -> Findings:
    for pair in place.pairs:
        both = pair.of_kinds(Sphere, Cylinder)
        if both is None or pair.contact != "point":
            continue
        offset = both[0].pose.translation() - both[1].pose.translation()
        distance = float(np.linalg.norm(np.cross(both[1].axis(2), offset)))
        message = f"the sphere's centre is {distance:.3g} m from the cylinder's axis"
        remedy = "move the sphere off the axis by 1e-6 m or more, or put a box in place of the cylinder"
        if distance < ON_AXIS:
            message += ": where they touch AutoDiffXd is singular on it (NaN, or a plausible wrong number)"
            yield Finding("error", "cylinder_axis", pair.label, message, remedy)
        else:
            message += ": exactly on it AutoDiffXd would be singular"
            yield Finding("info", "cylinder_axis", pair.label, message, remedy)


def _default_decides(place: Place) -> Findings:
    groups: dict[tuple[str, ...], list[Geometry]] = {}
    for geometry in place.geometries.values():
        pairs = [pair for pair in place.pairs if geometry in (pair.a, pair.b)]
        missing = tuple(
            name
            for name in _needed(place, geometry, {pair.contact for pair in pairs})
            if not geometry.own.HasProperty(_PROPERTIES[name][0], name)
        )
        if missing:
            groups.setdefault(missing, []).append(geometry)
    for missing, geometries in groups.items():
        values = ", ".join(f"{name} {_value(geometries[0], name)}" for name in missing)
        message = f"not given, so the scene graph's default decides: {values}"
        if "relaxation_time" in missing and _value(geometries[0], "relaxation_time") == "0.1 s":
            message += " (with which a ball hardly bounces)"
        tags = ", ".join(_PROPERTIES[name][2] for name in missing)
        remedy = f"give them in <drake:proximity_properties> ({tags}) or in the geometry's ProximityProperties"
        yield Finding("warning", "default_decides", ", ".join(g.label for g in geometries), message, remedy)


def _needed(place: Place, geometry: Geometry, contacts: set[str]) -> list[str]:
    """The properties that the step reads from a geometry."""
    sap = place.model.plant.get_discrete_contact_approximation() == DiscreteContactApproximation.kSap
    names = ["coulomb_friction", "relaxation_time" if sap else "hunt_crossley_dissipation"]
    names += ["point_contact_stiffness"] if "point" in contacts else []
    soft = geometry.compliance == "compliant"
    return names + (["hydroelastic_modulus"] if "hydroelastic" in contacts and soft else [])


def _value(geometry: Geometry, name: str) -> str:
    """The number that Drake uses, with its unit."""
    group, unit, _ = _PROPERTIES[name]
    if not geometry.all.HasProperty(group, name):
        return "(Drake's own)"
    value = geometry.all.GetProperty(group, name)
    return f"{value.dynamic_friction() if name == 'coulomb_friction' else value:g}{unit}"


def _touching(place: Place) -> Findings:
    set_state(place.model.double, place.x)
    unmeasured = []
    for pair in place.pairs:
        try:
            distance = place.query.ComputeSignedDistancePairClosestPoints(pair.a.id, pair.b.id).distance
        except RuntimeError:  # no such distance between these shapes
            unmeasured.append(pair.label)
            continue
        if abs(distance) < _touch_tolerance(pair):
            message = f"exactly at touch (signed distance {distance:.2g} m): the derivative is that of one side"
            remedy = "start a little apart or a little in contact, or take `smooth_step`"
            yield Finding("warning", "touching", pair.label, message, remedy)
    if unmeasured:
        message = "Drake computes no distance between these, so whether they are exactly at touch is not known"
        remedy = "compare x with x moved by 1e-6 m yourself, or put spheres in place of one (corner_spheres)"
        yield Finding("info", "not_measured", ", ".join(unmeasured), message, remedy)


def _touch_tolerance(pair: Pair) -> float:
    exact = {pair.a.kind, pair.b.kind} <= MEETS_A_SPHERE and pair.of_kinds(Sphere, object) is not None
    return TOUCH if exact or pair.of_kinds(Box, Box) else ROUGH_TOUCH


CONTACT_CHECKS = (_pair_refused, _aligned_faces, _cylinder_axis, _default_decides, _touching)


AT_LIMIT = 1e-6  # [m or rad] from a joint's limit
HUGE = 1e3  # of an entry of A or B: sap's reach 14, lagged contact's 4e4


def audit(model: Model, x: ArrayLike | None = None, u: ArrayLike | None = None) -> list[Finding]:
    """What stands in the way of gradients of `model` at x (nx,) and u (nu,) [N or N m], the worst first.

    x is the model's default state and u zero where they are left out. Raises ShapeError or NonFiniteError for a
    bad x or u; whatever Drake refuses is a finding.
    """
    point = check_point(
        model, model.default_state if x is None else x, np.zeros(model.nu) if u is None and model.nu else u
    )
    place = Place(model, *point)
    checks = _CHECKS if place.has_poses else _CHECKS_WITHOUT_POSES
    found = [finding for check in checks for finding in check(place)]
    return sorted(found, key=lambda f: (SEVERITIES.index(f.severity), f.subject, f.code))


def _no_step(place: Place) -> Findings:
    if place.step_error is not None:
        remedy = "choose x and u that `step` can take; where contact is named, see the finding pair_refused"
        yield Finding("error", "no_step", "step", f"the double step fails here: {short(place.step_error)}", remedy)


def _pd_gains(place: Place) -> Findings:
    plant = place.model.plant
    for instance in instances(plant):
        with_gains = [a for a in actuators(plant) if a.model_instance() == instance and a.has_controller()]
        if not with_gains:
            continue
        message = "Drake's conversion to AutoDiffXd drops these PD gains; drake_diff puts them back"
        if is_driven(place.model.diagram, place.model.path, plant.get_desired_state_input_port(instance)):
            message += "; their target is what your diagram feeds the desired state port, not differentiated by x or u"
        else:
            target = ", ".join(f"{value:g}" for value in place.model.pd_targets[instance])
            message += f"; their target [q; v] is fixed at ({target}), the default position at rest"
        remedy = "set the joints' default positions to move the target, or put the PD law in a policy of the rollout"
        yield Finding("info", "pd_gains", ", ".join(a.name() for a in with_gains), message, remedy)


def _identity_frame(place: Place) -> Findings:
    found = []
    for joint in joints(place.model.plant):
        frame = joint.frame_on_parent()
        if isinstance(frame, FixedOffsetFrame) and not isinstance(joint, WeldJoint):
            found += [joint.name()] if frame.GetFixedPoseInBodyFrame().IsExactlyIdentity() else []
    if found:
        message = (
            "the frame on the parent is exactly the identity, where Drake drops the derivative by the joint's offset; "
            f"drake_diff keeps it by an offset of {IDENTITY_OFFSET:g} m"
        )
        remedy = "nothing to do with drake_diff; in your own AutoDiffXd code add that offset"
        yield Finding("info", "identity_frame", ", ".join(found), message, remedy)


def _saturated_effort(place: Place) -> Findings:
    remedy = "stay inside the limit (Bounds of a Problem do), or raise it in the file"
    for note in place.model.notes:
        if "zero effort limit" in note:
            message = f"Drake leaves out what has an effort limit of 0, so there is no input: {note}"
            yield Finding("error", "saturated_effort", "actuators", message, "give the joint an effort above 0")
    if not place.model.nu:
        return
    effort, hold = _net_effort(place), _effort_to_hold(place)
    for actuator, u, now, rest in zip(actuators(place.model.plant), place.u, effort, hold, strict=True):
        limit = float(actuator.effort_limit())
        if abs(now) >= limit:
            message = f"its effort is at the limit {limit:g} (u is {u:.6g}): there the derivative by u is exactly 0"
            yield Finding("error", "saturated_effort", actuator.name(), message, remedy)
        elif abs(rest) > limit:
            message = f"to hold x at rest takes {rest:.6g} (without contact), beyond the limit {limit:g}"
            yield Finding("warning", "saturated_effort", actuator.name(), message, remedy)


def _net_effort(place: Place) -> Array:
    """(nu,) what the actuators apply [N or N m]: u with PD control, clamped; u alone where no step can be taken."""
    if place.step_error is not None:
        return place.u
    advance(place.model.double, place.x, place.u)
    return np.array(place.model.plant.get_net_actuation_output_port().Eval(place.model.double.context))


def _effort_to_hold(place: Place) -> Array:
    """(nu,) the effort [N or N m] nearest to what no acceleration at rest takes."""
    plant, twin = place.model.plant, place.model.double
    set_state(twin, np.concatenate([place.x[: place.model.nq], np.zeros(place.model.nv)]))
    needed = twin.inverse_dynamics(np.zeros(place.model.nv))
    return np.asarray(np.linalg.lstsq(plant.MakeActuationMatrix(), needed, rcond=None)[0])


def _jacobian(place: Place) -> Findings:
    if place.step_error is not None:
        return
    result = place.by_autodiff
    if isinstance(result, ModelError):
        remedy = "give that system a scalar conversion (TemplateSystem), take it out, or accept differences"
        yield Finding("error", "autodiff_refused", "diagram", str(result), remedy)
    elif isinstance(result, SimulationError) and not any(pair.refused for pair in place.pairs):
        remedy = "leave out what it names, or accept differences (method finite_difference)"
        yield Finding("error", "autodiff_refused", "step", f"the AutoDiffXd step throws: {short(result)}", remedy)
    if isinstance(result, ModelError | SimulationError):
        result = _by_differences(place)
    if isinstance(result, DrakeDiffError):
        remedy = "move x off the singular pose; `certify` shows which entry is wrong, `smooth_step` averages over it"
        yield Finding("error", "gradient_refused", "step", str(result), remedy)
    else:
        yield from _huge(place.model, result)


def _by_differences(place: Place) -> StepDerivatives | DrakeDiffError:
    try:
        return differentiate_step(place.model, place.x, place.u, method="finite_difference")
    except (GradientError, SimulationError) as error:
        return error


def _huge(model: Model, d: StepDerivatives) -> Findings:
    jacobian = np.abs(np.hstack([d.A, d.B]))
    row, column = np.unravel_index(int(np.argmax(jacobian)), jacobian.shape)
    if jacobian[row, column] > HUGE:
        variables, count = (*model.state_names, *model.input_names), int(np.sum(jacobian > HUGE))
        entry = f"d {model.state_names[row]} / d {variables[column]}"
        message = f"{entry} is {jacobian[row, column]:.3g} (by {d.method}), {count} entries are above {HUGE:g}"
        remedy = (
            "contact_approximation sap has the tamest Jacobians; else a shorter time step, softer contact or a longer "
            "relaxation time, lighter inertia ratios, or `smooth_step`"
        )
        yield Finding("warning", "huge_jacobian", entry, message, remedy)


def _mechanism(place: Place) -> Findings:
    plant, context = place.model.plant, place.model.double.context
    if plant.num_constraints():
        message = f"constraints in every step ({plant.num_constraints()}), which the implicit method does not know"
        remedy = "nothing to do: method auto takes autodiff; `certify` one state, as a few kinds have no AutoDiffXd"
        yield Finding("info", "constraints", "plant", message, remedy)
    locked = [joint.name() for joint in joints(plant) if joint.is_locked(context)]
    if locked:
        message = (
            "locked in the double context, which the AutoDiffXd twin does not know: where it would move there, the "
        )
        remedy = "weld it in the plant instead (WeldFrames), or joint.Unlock(model.double.context)"
        yield Finding("info", "locked_joint", ", ".join(locked), message + "derivative is refused", remedy)


def _joint_limit(place: Place) -> Findings:
    plant, names = place.model.plant, place.model.position_names
    limits = zip(plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits(), strict=True)
    for name, q, (low, high) in zip(names, place.x[: place.model.nq], limits, strict=True):
        if q <= low + AT_LIMIT or q >= high - AT_LIMIT:
            message = f"{q:.9g} is at or beyond its limits [{low:g}, {high:g}]: the derivative is that of one side"
            remedy = "start inside the limits, or take `smooth_step`, which averages over both sides"
            yield Finding("warning", "joint_limit", name, message, remedy)


_CHECKS_WITHOUT_POSES: tuple[Callable[[Place], Findings], ...] = (_no_step, _pd_gains, _identity_frame, _joint_limit)
_CHECKS: tuple[Callable[[Place], Findings], ...] = (
    *_CHECKS_WITHOUT_POSES,
    *CONTACT_CHECKS,
    _saturated_effort,
    _jacobian,
    _mechanism,
)
