"""Before anything runs: what in a model cannot be differentiated, or will be differentiated wrongly, and what to do."""

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.tree import FixedOffsetFrame, WeldJoint

from drake_diff.arrays import Array
from drake_diff.audit_contact import CONTACT_CHECKS
from drake_diff.audit_place import SEVERITIES, Finding, Findings, Place, short
from drake_diff.exceptions import DrakeDiffError, GradientError, ModelError, SimulationError
from drake_diff.model import Model
from drake_diff.parameter_kinds import IDENTITY_OFFSET
from drake_diff.plant_elements import actuators, instances, is_driven, joints
from drake_diff.step import advance, check_point, set_state
from drake_diff.step_derivatives import StepDerivatives, differentiate_step

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
