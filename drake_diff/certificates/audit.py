"""Audit a model: list the properties that prevent its derivatives or make them wrong, each with a remedy.

`audit` runs a list of checks. Each check is a function that takes a `Point` and yields findings about the step, about
contact (`contact_checks`), or about the robot file. A file that loads may still describe a robot that has no actuators,
falls through the ground, or has default masses that the file does not give.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.tree import FixedOffsetFrame, WeldJoint

from drake_diff.certificates.contact_checks import (
    aligned_faces,
    contact_defaults,
    corners_on_both_sides,
    inseparable,
    pairs_at_touch,
    refused_pairs,
    short,
    spheres_on_axes,
    unread_compliance,
)
from drake_diff.certificates.finding import SEVERITIES, Finding, Findings, Point, Severity, listed
from drake_diff.derivatives.sources import too_large_for_autodiff
from drake_diff.exceptions import DrakeDiffError, ModelError, SimulationError
from drake_diff.model.contact_geometry import collision_geometries
from drake_diff.model.model import Model
from drake_diff.model.parameters import IDENTITY_OFFSET
from drake_diff.model.plant import FLOATING, actuators, bodies, central_inertia, instances, joints
from drake_diff.model.step import advance, check_point, set_state

AT_LIMIT = 1e-6  # [m or rad] distance to a joint limit within which the joint counts as at the limit
HUGE = 1e3  # smallest entry of A or B that is reported; entries reach 14 with sap, 4e4 with lagged
SAME_MASS = 1e-6  # relative tolerance between the file's and the plant's mass, and trace of the inertia
NO_MASS = 1e-12  # [kg or kg m^2] diagonal entry of the mass matrix below which a joint moves no mass
IGNORED = re.compile(r"ignored|not currently support|only supports|unsupported|Skipping transmission", re.IGNORECASE)
SKIPPED = re.compile(r"\d+ collision meshes skipped")  # mesh files that exist but that Drake cannot use
HARMLESS = (
    *("safety_controller", "calibration", "found in a 'link'", "fixed joint", "texture", "material", "transmission'"),
    *("only Gazebo reads", "camera", "light", "visual", "'site'", "sensor", "statistic", "timestep", "integrator"),
    *("keyframe", "'user'", "'cone'", "iterations", "custom", "'size'"),
)


def audit(model: Model, x: ArrayLike | None = None, u: ArrayLike | None = None) -> Findings:
    """List the problems that a model has with gradients at a point, the most severe first.

    Args:
        model: The model to check. It is not changed.
        x: (nx,) The state [q; v]. The default is the model's default state.
        u: (nu,) [N or N m] The input. The default is zero, or the current position for servos.

    Returns:
        A list of `Finding`, sorted by severity. It is empty if the checks find nothing.

    Raises:
        ShapeError, NonFiniteError: x or u is invalid. An error raised by Drake becomes a finding instead.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
        >>> dd.audit(model, [0, 0, 0, 0], [50.0])[0]
        error saturated_effort (force): at the effort limit 20 (u is 50), the derivative with respect to u is exactly 0
          -> stay inside the limit (the bounds of a Problem do), or raise it in the file
    """
    x = model.default_state if x is None else x
    x = model.finite_state("x", x)
    point = Point(model, *check_point(model, x, model.neutral_input(x) if u is None else u))
    checks = _CHECKS if point.has_poses else _CHECKS_WITHOUT_POSES
    findings = [finding for check in checks for finding in check(point)]
    if not model.can_rebuild:  # a model from a diagram was not loaded with arguments of load_model
        findings = [replace(finding, arguments={}) for finding in findings]
    return Findings(sorted(findings, key=lambda f: (SEVERITIES.index(f.severity), f.subject, f.code)))


Found = Iterator[Finding]


def _no_step(point: Point) -> Found:
    if point.step_error is not None:
        remedy = "choose x and u for which `step` succeeds; if the error names contact, see finding pair_refused"
        yield Finding("error", "no_step", "step", f"the step fails at x and u: {short(point.step_error)}", remedy)


def _pd_gains(point: Point) -> Found:
    plant = point.model.plant
    for instance in instances(plant):
        names = [a.name() for a in actuators(plant) if a.model_instance() == instance and a.has_controller()]
        if not names:
            continue
        target = "the signal that your diagram connects to the desired state port"
        if point.model.servos:
            target = "the commanded positions, which are inputs"
        elif not point.model.feeds(plant.get_desired_state_input_port(instance)):
            values = ", ".join(f"{value:g}" for value in point.model.pd_targets[instance])
            target = f"[q; v] fixed at ({values}), the default position at rest"
        message = (
            f"Drake's conversion to AutoDiffXd drops these PD gains, and drake_diff restores them. Target: {target}"
        )
        remedy = "set the joints' default positions to move the target, or put the PD law in a policy of the rollout"
        yield Finding("info", "pd_gains", ", ".join(names), message, remedy)


def _identity_frame(point: Point) -> Found:
    movable = [joint for joint in joints(point.model.plant) if not isinstance(joint, WeldJoint)]
    offsets = [(j.name(), j.frame_on_parent()) for j in movable if isinstance(j.frame_on_parent(), FixedOffsetFrame)]
    names = [name for name, frame in offsets if frame.GetFixedPoseInBodyFrame().IsExactlyIdentity()]
    if names:
        message = (
            "the joint's frame on its parent is exactly the identity, so Drake drops the derivative with respect "
            f"to the joint's offset; drake_diff moves the frame by {IDENTITY_OFFSET:g} m to keep this derivative"
        )
        remedy = "no action is needed in drake_diff; add the same offset in your own AutoDiffXd code"
        yield Finding("info", "identity_frame", ", ".join(names), message, remedy)


def _joint_limit(point: Point) -> Found:
    names, limits = point.model.position_names, zip(*point.model.position_limits, strict=True)
    for name, q, (low, high) in zip(names, point.x[: point.model.nq], limits, strict=True):
        if q <= low + AT_LIMIT or q >= high - AT_LIMIT:
            message = f"{q:.9g} is at or beyond its limits [{low:g}, {high:g}], where the derivative is one-sided"
            remedy = "start inside the limits, or use `smooth_step`, which averages over both sides"
            yield Finding("warning", "joint_limit", name, message, remedy)


def _saturated_effort(point: Point) -> Found:
    model, plant, twin = point.model, point.model.plant, point.model.double
    remedy = "stay inside the limit (the bounds of a Problem do), or raise it in the file"
    if not model.nu:
        return
    is_effort = model.inputs.actuator >= 0
    index = model.inputs.actuator[is_effort]
    efforts = point.u[is_effort]  # [N or N m], replaced below by the clamped effort with PD control if a step succeeds
    if point.step_error is None:
        advance(twin, point.x, point.u)
        efforts = np.array(plant.get_net_actuation_output_port().Eval(twin.context))[index]
    set_state(twin, np.concatenate([point.x[: model.nq], np.zeros(model.nv)]))
    twin.set_input(point.u)
    # The efforts that hold the robot at rest without acceleration, in the least-squares sense.
    hold = np.linalg.lstsq(model.actuation[:, is_effort], twin.inverse_dynamics(np.zeros(model.nv)), rcond=None)[0]
    every = actuators(plant)
    for i, u, effort, rest in zip(index, point.u[is_effort], efforts, hold, strict=True):
        actuator = every[i]
        limit = float(actuator.effort_limit())
        if abs(effort) >= limit:
            corner = abs(u) == limit and not actuator.has_controller()
            slope = "one-sided: 0 beyond the limit" if corner else "exactly 0"
            message = f"at the effort limit {limit:g} (u is {u:.6g}), the derivative with respect to u is {slope}"
            yield Finding("error", "saturated_effort", actuator.name(), message, remedy)
        elif abs(rest) > limit:
            message = f"an effort of {rest:.6g} would hold x at rest (without contact), but the limit is {limit:g}"
            yield Finding("warning", "saturated_effort", actuator.name(), message, remedy)


def _zero_effort(point: Point) -> Found:
    driven = {row.joint.name() for row in point.joints if row.driven}
    for note in point.model.notes:
        joint = re.search(r'joint "([^"]+)" which has a zero effort limit', note)
        if joint and joint[1] not in driven:
            message = f"Drake leaves out actuators with an effort limit of 0, so there is no input: {note}"
            remedy = "drive the joint with load_model(..., actuators=), or give it an effort limit above 0 in the file"
            yield Finding("error", "saturated_effort", joint[1], message, remedy, {"actuators": [joint[1]]})


def _jacobian(point: Point) -> Found:
    if point.step_error is not None:
        return
    if too_large := too_large_for_autodiff(point.model):
        remedy = "load_model(..., fix_joints=) for joints that need not move, or `dd.differentiate_step` by differences"
        yield Finding("warning", "too_large", "step", f"the audit skips the Jacobian of the step: {too_large}", remedy)
        return
    result = point.by_autodiff
    if isinstance(result, ModelError):
        remedy = "give that system a scalar conversion (TemplateSystem), remove it, or use method finite_difference"
        yield Finding("error", "autodiff_refused", "diagram", str(result), remedy)
    elif isinstance(result, SimulationError) and not any(pair.refused for pair in point.pairs):
        remedy = "remove the element that the error names, or use method finite_difference"
        yield Finding("error", "autodiff_refused", "step", f"the AutoDiffXd step throws: {short(result)}", remedy)
    if isinstance(result, ModelError | SimulationError):
        result = point.differentiate("finite_difference")
    if isinstance(result, DrakeDiffError):
        remedy = "move x off the singular pose; `certify` shows the wrong entry, `smooth_step` averages nearby states"
        yield Finding("error", "gradient_refused", "step", str(result), remedy)
        return
    jacobian = np.abs(np.hstack([result.A, result.B]))
    row, column = np.unravel_index(int(np.argmax(jacobian)), jacobian.shape)
    if jacobian[row, column] > HUGE:
        names, count = point.model.state_names, int(np.sum(jacobian > HUGE))
        entry = f"d {names[row]} / d {(*names, *point.model.input_names)[column]}"
        message = f"{entry} is {jacobian[row, column]:.3g} (by {result.method}), {count} entries are above {HUGE:g}"
        remedy = (
            'contact_approximation="sap" gives the smallest Jacobians; otherwise use a shorter time step, softer '
            "contact, a longer relaxation time, smaller ratios of inertia, or `smooth_step`"
        )
        yield Finding("warning", "huge_jacobian", entry, message, remedy)


def _mimics(point: Point) -> Found:
    moving = {joint.name() for joint in joints(point.model.plant) if joint.num_velocities()}
    mimics = [m for m in point.model.file_facts.followers.values() if m.follower in moving]
    if mimics and point.model.coupling is None:
        says = "mimic joints that Drake does not read, so that they move freely"
        if all(m.in_drake for m in mimics):
            says = "mimic joints that stay in the state, coupled by constraints"
        remedy = 'mimic="reduce" (out of the state) or mimic="fix" (welds); collocation and other engines need this'
        subject, message = ", ".join(m.follower for m in mimics), f"{says}: {'; '.join(map(str, mimics))}"
        yield Finding("warning", "mimic_joint", subject, message, remedy, {"mimic": "reduce"})


def _constraints(point: Point) -> Found:
    plant, context = point.model.plant, point.model.double.context
    if point.model.num_constraints:
        message = f"the plant has constraints ({plant.num_constraints()}), which the implicit method does not support"
        remedy = "no action is needed: method auto uses autodiff; `certify` a state, as AutoDiffXd lacks a few kinds"
        yield Finding("info", "constraints", "plant", message, remedy)
    if locked := [joint.name() for joint in joints(plant) if joint.is_locked(context)]:
        message = (
            "the joint is locked in the context for double, but not for AutoDiffXd, so that the derivative is refused"
        )
        remedy = "weld it in the plant instead (WeldFrames), or joint.Unlock(model.double.context)"
        yield Finding("info", "locked_joint", ", ".join(locked), message, remedy)


def _undriven(point: Point) -> Found:
    if point.model.source is None:
        return
    driven = sum(row.driven for row in point.joints)
    undriven = [r for r in point.joints if not (r.driven or r.follows or (r.says is not None and r.says.passive))]
    meant = [row.name for row in undriven if row.says is not None and (row.says.effort or 0) > 0]
    remedy = 'load_model(..., actuators="all"), names of joints, or {joint: effort limit}; no action if it is passive'
    if undriven and not driven:
        message = f"the file has no actuator for any of the {len(undriven)} joints, so that the model has no input"
        names, all_joints = listed(row.name for row in undriven), {"actuators": "all"}
        yield Finding("warning", "no_actuator", names, message, remedy, all_joints)
    elif meant:
        message = f"{len(meant)} joints have an effort limit in the file but no actuator; {driven} others have one"
        yield Finding("info", "undriven", listed(meant), message, remedy, {"actuators": meant})


def _left_out_actuators(point: Point) -> Found:
    missing = [row.name for row in point.joints if row.left_out and not row.driven]
    others = any(not joint for _, joint in point.model.file_facts.left_out)  # actuators of tendons and sites
    for note in point.model.notes:
        match = re.match(r"(\d+ actuators left out)[^:]*: (.*)\.$", note)
        if match and (missing or others):
            message = f"{match[1]}, of kinds or transmissions that Drake does not read: {match[2]}"
            remedy = "drive the joints by efforts with load_model(..., actuators=), or use motors in the file"
            arguments = {"actuators": missing} if missing and not others else {}
            yield Finding("warning", "left_out", "actuators", message, remedy, arguments)


def _switched_off(point: Point) -> Found:
    off, gravity = point.model.file_facts.disabled, point.model.plant.gravity_field().gravity_vector()
    message = "the file disables this effect, but Drake simulates it"
    if off & {"contact", "constraint"} and point.pairs:
        remedy = "load_model(..., contact=False)"
        yield Finding("warning", "switched_off", "contact", message, remedy, {"contact": False})
    if "gravity" in off and np.any(gravity):
        remedy = "load_model(..., gravity=[0, 0, 0])"
        yield Finding("warning", "switched_off", "gravity", message, remedy, {"gravity": [0.0, 0.0, 0.0]})


def _massless(point: Point) -> Found:
    plant = point.model.plant
    for base in sorted(plant.GetFloatingBaseBodies()):
        welded = plant.GetBodiesWeldedTo(plant.get_body(base))
        if sum(body.default_mass() for body in welded) == 0:
            message = "the body floats and has no mass, so that the step is singular"
            carries = any(joint.num_velocities() and joint.parent_body() in welded for joint in joints(plant))
            remedy = 'load_model(..., base="weld") if it is fixed to the world, else ' if carries else ""
            remedy, arguments = f"{remedy}give it a mass in the file", {"base": "weld"} if carries else {}
            yield Finding("error", "massless_root", plant.get_body(base).name(), message, remedy, arguments)
    set_state(point.model.double, point.x)
    mass = np.diag(plant.CalcMassMatrix(point.model.double.context))
    light = [row.name for row in point.joints if mass[row.joint.velocity_start()] < NO_MASS]
    if light:
        message = "these joints move no mass and no inertia, so that the step is singular"
        fixed = _fixed(point, light)
        remedy = "load_model(..., fix_joints=) fixes them, or give the links a mass in the file"
        remedy = remedy if fixed else "give the links a mass in the file"
        yield Finding("error", "massless_joint", listed(light), message, remedy, fixed)


def _fixed(point: Point, names: list[str]) -> dict[str, Any]:
    """Return the argument that fixes these joints, or {} if no joint could move then."""
    return {"fix_joints": names} if len(names) < point.model.plant.num_velocities() else {}


def _skipped_meshes(point: Point) -> Found:
    for note in point.model.notes:
        if re.search(r"\bmeshes skipped", note):
            remedy = 'load_model(..., meshes="convex") or "spheres" uses collision meshes; packages= gives folders'
            summary = note.split(":")[0].split("; ")[0]
            arguments = {"meshes": "spheres"} if SKIPPED.match(note) else {}
            severity: Severity = "warning" if "collision" in note else "info"
            yield Finding(severity, "meshes_skipped", "meshes", summary, remedy, arguments)


def _lost_shapes(point: Point) -> Found:
    model, scene_graph = point.model, point.model.double.scene_graph
    if scene_graph is None or (model.options or {}).get("contact") is False:
        return
    with_shapes = {body.index() for body, _ in collision_geometries(model.plant, scene_graph)}
    given = [b for b in bodies(model.plant) if (says := point.link_says(b)) is not None and says.collisions]
    lost = [body.name() for body in given if body.index() not in with_shapes]
    if lost:
        much = "the model" if len(lost) == len(given) else "these links"
        remedy = 'load_model(..., meshes="convex") or "spheres"; contact=False declares a model without contact'
        arguments = {"meshes": "spheres"} if _has_usable_meshes(point) else {"contact": False}
        message = f"no collision shape of {much} is loaded, so that links pass through other bodies"
        yield Finding("warning", "collision_gone", listed(lost), message, remedy, arguments)


def _has_usable_meshes(point: Point) -> bool:
    """Return whether collision meshes were skipped that `meshes="convex"` would load."""
    return any(SKIPPED.match(note) for note in point.model.notes)


def _falls(point: Point) -> Found:
    plant, scene_graph = point.model.plant, point.model.double.scene_graph
    if not np.any(plant.gravity_field().gravity_vector()) or scene_graph is None:
        return
    fixed = {body.name() for body in plant.GetBodiesWeldedTo(plant.world_body())}
    floating = {joint.child_body().index(): joint for joint in joints(plant) if joint.type_name() in FLOATING}
    shapes = {body.name() for body, _ in collision_geometries(plant, scene_graph)}
    for base in sorted(plant.GetFloatingBaseBodies()):
        affected = plant.GetBodiesKinematicallyAffectedBy([floating[base].index()])
        tree = {plant.get_body(index).name() for index in affected}
        moves = sum(j.num_velocities() > 0 and j.child_body().name() in tree for j in joints(plant)) > 1
        stands = any(set(pair.bodies) & tree and set(pair.bodies) & fixed for pair in point.pairs)
        if stands or not (moves or shapes & tree):
            continue
        why, arguments = "the world has no ground or fixed shape below it", dict[str, Any](ground=True)
        if not shapes & tree:
            why = "it has no collision shapes"
            arguments = {"meshes": "spheres", "ground": True} if _has_usable_meshes(point) else {"base": "weld"}
        message = f"it floats and falls without end: {why}"
        remedy = (
            'load_model(..., ground=True), with meshes="convex" or "spheres" if it has no shapes; base="weld" if it '
            "is fixed to the world, or no action if it flies"
        )
        yield Finding("warning", "falls", plant.get_body(base).name(), message, remedy, arguments)


def _invented_inertia(point: Point) -> Found:
    plant, kinds = point.model.plant, dict[tuple[Severity, str], list[str]]()
    for body in bodies(plant):
        says = point.link_says(body)
        if says is not None and not plant.IsAnchored(body) and (kind := _invention(body, says)):
            kinds.setdefault(kind, []).append(body.name())
    for (severity, message), names in kinds.items():
        remedy = "give a mass above 0, and an inertia whose principal moments satisfy the triangle inequality"
        yield Finding(severity, "invented_inertia", listed(names), message, remedy)


def _invention(body: Any, says: Any) -> tuple[Severity, str] | None:
    inertia = body.default_spatial_inertia()
    mass, trace = inertia.get_mass(), sum(central_inertia(inertia)[:3])
    if says.mass is None and says.defaults:
        return "warning", "the file gives no mass, so that the format's default of 1 kg applies"
    if says.mass is not None and not np.isclose(mass, says.mass, rtol=SAME_MASS, atol=0):
        message = (
            f"no inertia fits the file's mass of {says.mass:g} kg; Drake uses a ball of water of {mass:g} kg instead"
        )
        return "error", message
    if says.trace is None and says.defaults:
        return "warning", "the file gives no inertia, so that the format's default of 1 kg m^2 about each axis applies"
    if says.trace is not None and not np.isclose(trace, says.trace, rtol=SAME_MASS, atol=1e-12):
        return (
            "warning",
            "the file's inertia is not physically valid; Drake uses the inertia of a ball of water of the same mass",
        )
    return None


def _ignored(point: Point) -> Found:
    kinds = Counter[str]()
    for note in point.model.notes:
        first = re.sub(r"^.*?warning: ", "", note.splitlines()[0])
        first = re.sub(r"(Skipping transmission since it's attached to a fixed joint).*", r"\1", first)
        if IGNORED.search(first) and "meshes skipped" not in first:
            kinds[re.sub(r"(joint|link|geom) '?[\w/.:-]+'?(?= has)|'-?[\d.eE+-]+'", r"\1 ...", first)] += 1
    for kind, count in kinds.items():
        quoted = re.search(r"'([^']+)'", kind)
        severity: Severity = "info" if any(word in kind for word in HARMLESS) else "warning"
        message = f"Drake does not read this part of the file ({count} times): {kind}"
        remedy = "no action if it does not matter; else use an element that Drake reads, or change the plant"
        yield Finding(severity, "ignored", quoted[1] if quoted else "file", message, remedy)


def _zero_limits(point: Point) -> Found:
    kinds: dict[tuple[str, str], list[str]] = {}
    for row in point.joints:
        joint, mended = row.joint, "mimic" if row.follows else ""
        low, high = float(joint.position_lower_limits()[0]), float(joint.position_upper_limits()[0])
        if joint.velocity_lower_limits()[0] == 0 == joint.velocity_upper_limits()[0]:
            kinds.setdefault(("the velocity limit is 0", mended), []).append(row.name)
        if low == high:
            mended = mended or ("" if low else "actuators")
            kinds.setdefault((f"the position limits are both {low:g}", mended), []).append(row.name)
    for (kind, mended), names in kinds.items():
        arguments = _fixed(point, names)
        remedy = "load_model(..., fix_joints=) fixes these joints" if arguments else "give it limits in the file"
        if mended == "actuators":
            arguments = {"actuators": names}
            remedy = (
                "load_model(..., actuators=) removes ranges from 0 to 0 of the joints that it names; or fix_joints="
            )
        elif mended == "mimic":
            remedy, arguments = 'load_model(..., mimic="fix") welds joints that follow others', {"mimic": "fix"}
        yield Finding("error", "zero_limit", listed(names), f"{kind}: no plan can move these joints", remedy, arguments)


_CHECKS_WITHOUT_POSES: tuple[Callable[[Point], Found], ...] = (_no_step, _pd_gains, _identity_frame, _joint_limit)
_CHECKS = (
    *_CHECKS_WITHOUT_POSES,
    *(refused_pairs, aligned_faces, spheres_on_axes, contact_defaults, unread_compliance, pairs_at_touch),
    *(inseparable, corners_on_both_sides),
    *(_saturated_effort, _zero_effort, _jacobian, _mimics, _constraints),
    *(_undriven, _left_out_actuators, _switched_off, _massless, _skipped_meshes, _lost_shapes),
    *(_falls, _invented_inertia, _ignored, _zero_limits),
)
