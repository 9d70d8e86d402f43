"""Before anything runs: what in a model cannot be differentiated, or would be differentiated wrongly, and what to do.

`audit` runs a list of checks, each a function of a `Place` (the model at a point) that yields its findings. The checks
of contact come after the others; every number in them was measured on the Drake that this package is tested with.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.geometry import Box, Cylinder, Sphere
from pydrake.multibody.plant import ContactModel, DiscreteContactApproximation
from pydrake.multibody.tree import FixedOffsetFrame, WeldJoint

from drake_diff._base.arrays import Array
from drake_diff.certificates.finding import (
    FILE_CHECKS,
    PARALLEL,
    SEVERITIES,
    Collider,
    Finding,
    Findings,
    Pair,
    Place,
    Severity,
)
from drake_diff.derivatives.step import StepDerivatives, differentiate_step
from drake_diff.exceptions import DrakeDiffError, GradientError, ModelError, SimulationError
from drake_diff.model.contact_geometry import MEETS_A_SPHERE
from drake_diff.model.file_facts import Mimic
from drake_diff.model.model import Model
from drake_diff.model.parameters import IDENTITY_OFFSET
from drake_diff.model.plant import PROXIMITY, actuators, instances, joints
from drake_diff.model.step import advance, check_point, set_state


@dataclass(frozen=True)
class AuditOptions:
    """What an audit takes for near, large and many."""

    pairs_told: int = 6  # of links, each with a finding of its own; a humanoid has hundreds
    at_limit: float = 1e-6  # [m or rad] from a joint's limit
    huge: float = 1e3  # of an entry of A or B: sap's reach 14, lagged contact's 4e4
    nearly_parallel: float = 1e-2  # [rad]: jumps were measured up to 1e-3 and beyond
    in_plane: float = 1e-6  # [m] from a plane of symmetry
    reach: float = 1e-3  # [m] faces nearer than this count as touching
    on_axis: float = 1e-9  # [m] from a sphere's centre to a cylinder's axis
    touch: float = 1e-9  # [m] of signed distance, where Drake computes it exactly
    rough_touch: float = 1e-6  # [m] where it iterates (measured: 1e-7 off for an ellipsoid)


AUDIT = AuditOptions()

ROUND = ("Sphere", "Ellipsoid", "Capsule")

UNITS = dict(zip(PROXIMITY, ("", " N/m", " s/m", " s", " Pa"), strict=True))


def audit(model: Model, x: ArrayLike | None = None, u: ArrayLike | None = None) -> Findings:
    """List what stands in the way of gradients of a model at a point, the worst first.

    Args:
        model: the model to look at; it is left as it was.
        x: (nx,) the state [q; v], the model's default state if left out.
        u: (nu,) [N or N m] the input, zero if left out.

    Returns:
        A list of `Finding`, sorted by severity; empty if there is nothing to say. It prints one below the other.

    Raises:
        ShapeError, NonFiniteError: a bad x or u. Whatever Drake refuses is a finding instead.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
        >>> dd.audit(model, [0, 0, 0, 0], [50.0])[0]
        error saturated_effort (force): its effort is at the limit 20 (u is 50): there the derivative by u is exactly 0
          -> stay inside the limit (the bounds of a Problem do), or raise it in the file
    """
    x = model.default_state if x is None else x
    point = Place(model, *check_point(model, x, np.zeros(model.nu) if u is None and model.nu else u))
    checks = _CHECKS if point.has_poses else _CHECKS_WITHOUT_POSES
    findings = [finding for check in checks for finding in check(point)]
    if not model.can_rebuild:  # a diagram has no arguments
        findings = [replace(finding, arguments={}) for finding in findings]
    return Findings(sorted(findings, key=lambda f: (SEVERITIES.index(f.severity), f.subject, f.code)))


Found = Iterator[Finding]


def _no_step(point: Place) -> Found:
    if point.step_error is not None:
        remedy = "choose x and u that `step` can take; if it names contact, see the finding pair_refused"
        yield Finding("error", "no_step", "step", f"the double step fails here: {_short(point.step_error)}", remedy)


def _pd_gains(point: Place) -> Found:
    plant = point.model.plant
    for instance in instances(plant):
        with_gains = [a for a in actuators(plant) if a.model_instance() == instance and a.has_controller()]
        if not with_gains:
            continue
        message = "Drake's conversion to AutoDiffXd drops these PD gains; drake_diff puts them back"
        if point.model.feeds(plant.get_desired_state_input_port(instance)):
            message += "; their target is what your diagram feeds the desired state port"
        else:
            target = ", ".join(f"{value:g}" for value in point.model.pd_targets[instance])
            message += f"; their target [q; v] is fixed at ({target}), the default position at rest"
        remedy = "set the joints' default positions to move the target, or put the PD law in a policy of the rollout"
        yield Finding("info", "pd_gains", ", ".join(a.name() for a in with_gains), message, remedy)


def _identity_frame(point: Place) -> Found:
    names = []
    for joint in joints(point.model.plant):
        frame = joint.frame_on_parent()
        if isinstance(frame, FixedOffsetFrame) and not isinstance(joint, WeldJoint):
            names += [joint.name()] if frame.GetFixedPoseInBodyFrame().IsExactlyIdentity() else []
    if names:
        message = (
            "the frame on the parent is exactly the identity, where Drake drops the derivative by the joint's offset; "
            f"drake_diff keeps it by an offset of {IDENTITY_OFFSET:g} m"
        )
        remedy = "nothing to do with drake_diff; in your own AutoDiffXd code add that offset"
        yield Finding("info", "identity_frame", ", ".join(names), message, remedy)


def _joint_limit(point: Place) -> Found:
    names, limits = point.model.position_names, zip(*point.model.position_limits, strict=True)
    for name, q, (low, high) in zip(names, point.x[: point.model.nq], limits, strict=True):
        if q <= low + AUDIT.at_limit or q >= high - AUDIT.at_limit:
            message = f"{q:.9g} is at or beyond its limits [{low:g}, {high:g}]: the derivative is that of one side"
            remedy = "start inside the limits, or use `smooth_step`, which averages over both sides"
            yield Finding("warning", "joint_limit", name, message, remedy)


def _saturated_effort(point: Place) -> Found:
    model, plant, twin = point.model, point.model.plant, point.model.double
    remedy = "stay inside the limit (the bounds of a Problem do), or raise it in the file"
    yield from _left_out_actuators(model)
    if not model.nu:
        return
    driven = [actuators(plant)[i] for i in model.inputs.actuator[model.inputs.actuator >= 0]]
    u_own = point.u[model.inputs.actuator >= 0]
    effort = u_own  # [N or N m] what the actuators apply: u with PD control, clamped; u alone if no step succeeds
    if point.step_error is None:
        advance(twin, point.x, point.u)
        net = np.array(plant.get_net_actuation_output_port().Eval(twin.context))
        effort = net[model.inputs.actuator[model.inputs.actuator >= 0]]
    set_state(twin, np.concatenate([point.x[: model.nq], np.zeros(model.nv)]))
    twin.set_input(point.u)
    # The effort nearest to what no acceleration at rest takes.
    B = model.actuation[:, model.inputs.actuator >= 0]
    hold = np.linalg.lstsq(B, twin.inverse_dynamics(np.zeros(model.nv)), rcond=None)[0]
    for actuator, u, now, rest in zip(driven, u_own, effort, hold, strict=True):
        limit = float(actuator.effort_limit())
        if abs(now) >= limit:
            corner = abs(u) == limit and not actuator.has_controller()
            slope = "that of the inside, and 0 outside" if corner else "exactly 0"
            message = f"its effort is at the limit {limit:g} (u is {u:.6g}): there the derivative by u is {slope}"
            yield Finding("error", "saturated_effort", actuator.name(), message, remedy)
        elif abs(rest) > limit:
            message = f"to hold x at rest takes {rest:.6g} (without contact), beyond the limit {limit:g}"
            yield Finding("warning", "saturated_effort", actuator.name(), message, remedy)


def _left_out_actuators(model: Model) -> Found:
    driven = {actuator.joint().name() for actuator in actuators(model.plant)}
    for note in model.notes:
        joint = re.search(r'joint "([^"]+)" which has a zero effort limit', note)
        if joint and joint[1] not in driven:
            message = f"Drake leaves out actuators with an effort limit of 0, so there is no input: {note}"
            remedy = (
                "load_model(..., actuators=) drives the joint all the same, or give it an effort above 0 in the file"
            )
            yield Finding("error", "saturated_effort", joint[1], message, remedy, {"actuators": [joint[1]]})


def _jacobian(point: Place) -> Found:
    if point.step_error is not None:
        return
    result: StepDerivatives | DrakeDiffError = point.by_autodiff
    if isinstance(result, ModelError):
        remedy = "give that system a scalar conversion (TemplateSystem), take it out, or accept differences"
        yield Finding("error", "autodiff_refused", "diagram", str(result), remedy)
    elif isinstance(result, SimulationError) and not any(pair.refused for pair in point.pairs):
        remedy = "leave out what it names, or accept differences (method finite_difference)"
        yield Finding("error", "autodiff_refused", "step", f"the AutoDiffXd step throws: {_short(result)}", remedy)
    if isinstance(result, ModelError | SimulationError):
        try:
            result = differentiate_step(point.model, point.x, point.u, method="finite_difference")
        except (GradientError, SimulationError) as error:
            result = error
    if isinstance(result, DrakeDiffError):
        remedy = "move x off the singular pose; `certify` shows which entry is wrong, `smooth_step` averages over it"
        yield Finding("error", "gradient_refused", "step", str(result), remedy)
        return
    jacobian = np.abs(np.hstack([result.A, result.B]))
    row, column = np.unravel_index(int(np.argmax(jacobian)), jacobian.shape)
    if jacobian[row, column] > AUDIT.huge:
        names, count = point.model.state_names, int(np.sum(jacobian > AUDIT.huge))
        entry = f"d {names[row]} / d {(*names, *point.model.input_names)[column]}"
        message = (
            f"{entry} is {jacobian[row, column]:.3g} (by {result.method}), {count} entries are above {AUDIT.huge:g}"
        )
        remedy = (
            "contact_approximation sap has the tamest Jacobians; otherwise a shorter time step, softer contact or a "
            "longer relaxation time, lighter inertia ratios, or `smooth_step`"
        )
        yield Finding("warning", "huge_jacobian", entry, message, remedy)


def _mechanism(point: Place) -> Found:
    plant, context = point.model.plant, point.model.double.context
    mimics = () if point.model.coupling is not None else _mimics(point.model)
    if mimics:
        listed = "; ".join(map(str, mimics))
        message = f"joints follow others, and stay in the state, held by constraints: {listed}"
        if not all(m.in_drake for m in mimics):
            message = f"joints should follow others, but Drake does not read that, and they move freely: {listed}"
        remedy = 'mimic="reduce" takes them out of the state, "fix" welds them; collocation and other engines need that'
        followers = ", ".join(m.follower for m in mimics)
        yield Finding("warning", "mimic_joint", followers, message, remedy, {"mimic": "reduce"})
    if point.model.num_constraints:
        message = f"constraints in every step ({plant.num_constraints()}), which the implicit method cannot handle"
        remedy = "nothing to do: method auto takes autodiff; `certify` one state, as a few kinds have no AutoDiffXd"
        yield Finding("info", "constraints", "plant", message, remedy)
    locked = [joint.name() for joint in joints(plant) if joint.is_locked(context)]
    if locked:
        message = (
            "locked in the double context, which the AutoDiffXd twin does not know: where it would move there, the "
            "derivative is refused"
        )
        remedy = "weld it in the plant instead (WeldFrames), or joint.Unlock(model.double.context)"
        yield Finding("info", "locked_joint", ", ".join(locked), message, remedy)


def _mimics(model: Model) -> tuple[Mimic, ...]:
    """What the model's file says of joints that follow others and still can move."""
    moving = {joint.name() for joint in joints(model.plant) if joint.num_velocities()}
    return tuple(mimic for mimic in model.file_facts.followers.values() if mimic.follower in moving)


def _pair_refused(point: Place) -> Found:
    severity: Severity = "error"
    remedy = (
        'load_model(..., contact_geometry="corner_spheres") replaces boxes, cylinders and capsules by spheres, '
        '"hydroelastic" gives every geometry a mesh, "differences" differences the step by choice; or filter the pair '
        "(CollisionFilterDeclaration, or <drake:collision_filter_group> in the file) if it never touches"
    )
    if point.model.contact_geometry == "differences":
        severity = "info"
        remedy = "nothing to do: it is differenced by choice, which needs method auto or finite_difference"
    groups: dict[tuple[str, str], list[Pair]] = {}
    for pair in point.pairs:
        if pair.refused:
            groups.setdefault(pair.bodies, []).append(pair)
    by_choice = severity == "info"
    named, rest = list(groups)[: AUDIT.pairs_told], list(groups)[AUDIT.pairs_told :]
    for bodies in named:
        arguments = {} if by_choice else _route(point.model, groups[bodies])
        advice = f'meshes="spheres" and {remedy}' if "meshes" in arguments else remedy
        message = _refusal(point, groups[bodies])
        yield Finding(severity, "pair_refused", " - ".join(bodies), message, advice, arguments)
    if rest:
        pairs = [pair for bodies in rest for pair in groups[bodies]]
        arguments = {} if by_choice else _route(point.model, pairs)
        advice = f'meshes="spheres" and {remedy}' if "meshes" in arguments else remedy
        listed = ", ".join(" - ".join(bodies) for bodies in rest[: AUDIT.pairs_told])
        message = f"of such shapes, too: {listed}" + (" ..." if len(rest) > AUDIT.pairs_told else "")
        yield Finding(severity, "pair_refused", f"{len(rest)} more pairs of links", message, advice, arguments)


def _route(model: Model, pairs: list[Pair]) -> dict[str, Any]:
    """The arguments with which these pairs are differentiated."""
    if model.plant.get_contact_model() != ContactModel.kPoint:
        return {"contact_geometry": "hydroelastic"}
    kinds = {collider.kind for pair in pairs for collider in (pair.a, pair.b)}
    if kinds <= MEETS_A_SPHERE:
        return {"contact_geometry": "corner_spheres"}
    from_meshes = model.source is not None and model.source.suffix in (".urdf", ".sdf")
    if from_meshes and kinds <= MEETS_A_SPHERE | {"Mesh", "Convex"}:
        return {"meshes": "spheres", "contact_geometry": "corner_spheres"}
    return {"contact_geometry": "differences"}


def _refusal(point: Place, pairs: list[Pair]) -> str:
    sides = (dict.fromkeys(p.a.label for p in pairs), dict.fromkeys(p.b.label for p in pairs))
    names, error = " against ".join(", ".join(side) for side in sides), point.by_autodiff
    if any(pair.contact == "none" for pair in pairs):
        why = "hydroelastic contact alone needs properties on both, one of them not rigid; the double step throws too"
    else:
        why = "AutoDiffXd has no point contact between these shapes, and throws once their bounding boxes meet"
    if any("HalfSpace" in (p.a.kind, p.b.kind) for p in pairs):
        why += ", and that of a tilted half space is infinite: it throws without touching"
    if not isinstance(error, SimulationError):
        return f"{names}: {why}. The AutoDiffXd step does not throw at x."
    if any(p.a.kind.lower() in str(error).lower() and p.b.kind.lower() in str(error).lower() for p in pairs):
        return f"{names}: {why}. The AutoDiffXd step throws at x over such shapes: {_short(error)}."
    return f"{names}: {why}. At x the AutoDiffXd step throws over another pair: {_short(error)}."


def _aligned_faces(point: Place) -> Found:
    remedy = (
        'load_model(..., contact_model="point", contact_geometry="corner_spheres") replaces one of them by spheres; '
        "or start tilted by 0.03 rad or more and `certify` the "
        "poses in contact: near the aligned pose too (measured: up to 1e-3 rad, cylinder on cylinder up to 0.04) the "
        "meshes' edges make the step jump"
    )
    for pair in point.pairs:
        angle, gap = _alignment(pair) if pair.contact == "hydroelastic" else (None, np.inf)
        if angle is None:
            continue
        severity: Severity = "info"
        consequence = "tilted now; if they come to lie flat the hydroelastic step jumps"
        if angle <= PARALLEL and gap <= AUDIT.reach:
            severity = "error"
            consequence = "the hydroelastic step jumps there, and AutoDiffXd gives a finite, plausible, wrong number"
        elif angle <= AUDIT.nearly_parallel:
            severity, consequence = "warning", "if they meet like this the hydroelastic step jumps"
        message = f"faces {angle:.2g} rad from parallel at x, {gap:.3g} m apart: {consequence}"
        arguments = {} if severity == "info" else {"contact_model": "point", "contact_geometry": "corner_spheres"}
        yield Finding(severity, "aligned_faces", pair.label, message, remedy, arguments)


def _alignment(pair: Pair) -> tuple[float | None, float]:
    """The angle [rad] between the two nearest face normals, and the gap [m] along them; None without flat faces.

    The gap is negative where the boxes overlap. Drake's mesh of a round shape counts as flat too, where its centre
    lies in a plane of symmetry of a box's mesh or in an upright one of a cylinder's.
    """
    for first, other in ((pair.a, pair.b), (pair.b, pair.a)):
        if first.kind in ROUND and other.kind in ("Box", "Cylinder"):
            offset = other.pose.inverse() @ first.pose.translation()
            if np.min(np.abs(offset[: 3 if other.kind == "Box" else 2])) > AUDIT.in_plane:
                return None, np.inf
    faces = [(n, m) for n in _normals(pair.a, pair.b) for m in _normals(pair.b, pair.a)]
    if not faces:
        return None, np.inf
    gaps = []
    for direction in (n for both in faces for n in both):
        (low_a, high_a), (low_b, high_b) = pair.a.extent(direction), pair.b.extent(direction)
        gaps.append(max(low_a - high_b, low_b - high_a))
    return min(float(np.linalg.norm(np.cross(n, m))) for n, m in faces), max(gaps)


def _normals(collider: Collider, other: Collider) -> list[Array]:
    """The normals of its flat faces, or of the planes that its mesh lines up with."""
    meshed = other.kind in ("Box", "Cylinder")
    if collider.kind == "Box" or (collider.kind in ("Sphere", "Ellipsoid") and meshed):
        return [collider.axis(i) for i in range(3)]
    upright = collider.kind in ("Cylinder", "HalfSpace") or (collider.kind == "Capsule" and meshed)
    return [collider.axis(2)] if upright else []


def _cylinder_axis(point: Place) -> Found:
    beside: dict[str, float] = {}  # [m]
    remedy = "move the sphere off the axis by 1e-6 m or more, or replace the cylinder by a box"
    for pair in point.pairs:
        both = pair.of_kinds(Sphere, Cylinder)
        if both is None or pair.contact != "point":
            continue
        offset = both[0].pose.translation() - both[1].pose.translation()
        distance = float(np.linalg.norm(np.cross(both[1].axis(2), offset)))
        if distance >= AUDIT.on_axis:
            beside[pair.label] = distance
            continue
        consequence = "if they touch AutoDiffXd is singular on it (NaN, or a plausible wrong number)"
        message = f"the sphere's centre is {distance:.3g} m from the cylinder's axis: {consequence}"
        yield Finding("error", "cylinder_axis", pair.label, message, remedy)
    if beside:
        subject = next(iter(beside)) if len(beside) == 1 else f"{len(beside)} pairs"
        consequence = "exactly on it AutoDiffXd would be singular"
        message = f"the sphere's centre is {min(beside.values()):.3g} m from the cylinder's axis: {consequence}"
        yield Finding("info", "cylinder_axis", subject, message, remedy)


def _default_decides(point: Place) -> Found:
    sap = point.model.plant.get_discrete_contact_approximation() == DiscreteContactApproximation.kSap
    groups: dict[tuple[str, ...], list[Collider]] = {}
    for collider in point.colliders.values():
        contacts = {pair.contact for pair in point.pairs if collider in (pair.a, pair.b)}
        read = ["friction", "relaxation_time" if sap else "dissipation"]  # by the step
        read += ["stiffness"] * ("point" in contacts)
        read += ["hydroelastic_modulus"] * ("hydroelastic" in contacts and collider.compliance == "compliant")
        missing = tuple(name for name in read if not collider.own.HasProperty(*PROXIMITY[name]))
        if missing:
            groups.setdefault(missing, []).append(collider)
    for missing, colliders in groups.items():
        values = {name: _value(colliders[0], name) for name in missing}
        defaults = ", ".join(f"{PROXIMITY[name][1]} {value}" for name, value in values.items())
        message = f"not given, so the scene graph's default decides: {defaults}"
        if values.get("relaxation_time") == "0.1 s":
            message += " (with which a ball hardly bounces)"
        tags = ", ".join(f"drake:{'mu_dynamic' if name == 'friction' else PROXIMITY[name][1]}" for name in missing)
        remedy = f"give them in <drake:proximity_properties> ({tags}) or in the geometry's ProximityProperties"
        yield Finding("warning", "default_decides", ", ".join(c.label for c in colliders), message, remedy)


def _value(collider: Collider, name: str) -> str:
    """The number that Drake uses, with its unit."""
    if not collider.all.HasProperty(*PROXIMITY[name]):
        return "(Drake's own)"
    value = collider.all.GetProperty(*PROXIMITY[name])
    return f"{value.dynamic_friction() if name == 'friction' else value:g}{UNITS[name]}"


def _touching(point: Place) -> Found:
    set_state(point.model.double, point.x)
    unmeasured = []
    for pair in point.pairs:
        try:
            distance = point.query.ComputeSignedDistancePairClosestPoints(pair.a.id, pair.b.id).distance
        except RuntimeError:  # no such distance between these shapes
            unmeasured.append(pair.label)
            continue
        exact = {pair.a.kind, pair.b.kind} <= MEETS_A_SPHERE and pair.of_kinds(Sphere, object) is not None
        if abs(distance) < (AUDIT.touch if exact or pair.of_kinds(Box, Box) else AUDIT.rough_touch):
            message = f"exactly at touch (signed distance {distance:.2g} m): the derivative is that of one side"
            remedy = "start a little apart or a little in contact, or use `smooth_step`"
            yield Finding("warning", "touching", pair.label, message, remedy)
    if unmeasured:
        message = "Drake computes no distance between these, so whether they are exactly at touch is not known"
        remedy = "compare x with x moved by 1e-6 m yourself, or replace one of them by spheres (corner_spheres)"
        yield Finding("info", "not_measured", ", ".join(unmeasured), message, remedy)


def _short(error: DrakeDiffError) -> str:
    return str(error).removeprefix("Drake cannot take this step: ").split(". ")[0].rstrip(".")


_CHECKS_WITHOUT_POSES: tuple[Callable[[Place], Found], ...] = (_no_step, _pd_gains, _identity_frame, _joint_limit)
_CHECKS = (
    *_CHECKS_WITHOUT_POSES,
    *(_pair_refused, _aligned_faces, _cylinder_axis, _default_decides, _touching),
    *(_saturated_effort, _jacobian, _mechanism),
    *FILE_CHECKS,
)
