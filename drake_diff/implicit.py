"""The Jacobian of a smooth step from its own equation, without differentiating Drake's solver.

Where no contact, joint limit or constraint carries a force, Drake's discrete step solves, for the velocities v',

    r(v'; q, v, u) = ID(q, v, (v' - v) / h) - f(q, v) + D (v' - v) + P (q + h v') - P q - ... = 0

ID being the inverse dynamics M a + bias, f gravity, springs and joint damping -D v, all explicit in (q, v). Joint
damping D and the PD controllers are implicit. With the inputs clipped at their effort limits,

    input_i = clip(u_i - kp_i (q_i + h v'_i - q_ref_i) - kd_i (v'_i - v_ref_i)),

so dv' = -(dr/dv')^-1 dr with dr/dv' = M / h + D + B (kd + h kp) B' for the inputs that are not clipped, and
q' = q + h N(q) v'. Only r is differentiated by AutoDiffXd, at Drake's own v', which costs about 0.4 of a whole step.
r(v') = 0 is checked: where it does not hold, something else acts, or the AutoDiffXd plant is not the double one.
"""

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff
from pydrake.multibody.tree import MultibodyForces_

from drake_diff.arrays import Array
from drake_diff.autodiff import gradient_rows
from drake_diff.exceptions import GradientError
from drake_diff.model import Model
from drake_diff.parameters import ParameterVector, write_autodiff
from drake_diff.plant_elements import actuators, is_driven, joints
from drake_diff.step import set_state
from drake_diff.twin import Twin

# Rounding of the forces that balance, relative to the largest of them. What a solver leaves is larger.
RESIDUAL_TOLERANCE = 1e-9


class NotSmoothError(GradientError):
    """The step is not the one that the implicit form describes."""


def why_not_implicit(model: Model) -> str:
    """What in the model the implicit form leaves out wherever it is; empty where there is nothing."""
    plant = model.plant
    if plant.num_constraints():
        return "constraints act at every step"
    for port in (plant.get_applied_generalized_force_input_port(), plant.get_applied_spatial_force_input_port()):
        if is_driven(model.diagram, model.path, port):
            return f"the diagram feeds {port.get_name()}"
    if any(joint.is_locked(model.double.context) for joint in joints(plant)):
        return "a joint is locked"
    driven = [port for port in _desired_states(model) if is_driven(model.diagram, model.path, port)]
    return "the diagram feeds PD targets" if driven else ""


def implicit_jacobian(model: Model, vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Array:
    """(nx, nx + nu + np) the derivative of the step by [x; u; parameters]; differenced parameters have zeros.

    The vector is applied to `model`, whose double twin stands at the step from (x, u) to `x_next`, as
    `step.advance` leaves it. Raises NotSmoothError where something else than smooth forces acts.
    """
    form, twin, nq, nx, h = _form_of(model), model.double, model.nq, model.nx, model.time_step
    if form.excluded:
        raise NotSmoothError(form.excluded)
    if form.can_touch and _touches(twin):
        raise NotSmoothError("geometries touch")
    v_next = x_next[nq:]
    change, damping = v_next - x[nq:], twin.damping()
    kp, kd = form.gains()
    effort = u - kp * (x[form.position] + h * v_next[form.velocity] - form.reference[0])
    effort -= kd * (v_next[form.velocity] - form.reference[1])
    free = np.abs(effort) < form.limit
    applied = form.actuation @ np.clip(effort, -form.limit, form.limit)

    variables = InitializeAutoDiff(np.concatenate([x, vector.values])).ravel()
    write_autodiff(vector, model, variables[nx:])
    set_state(model.autodiff, variables[:nx])
    needed = _needed(model.autodiff, np.array([AutoDiffXd(a) for a in change / h])).reshape(-1, 1)
    _check_vanishes(ExtractValue(needed).ravel(), damping * change - applied)
    rows = gradient_rows(needed, len(variables))
    if vector.parameters:
        rows = rows + gradient_rows(model.autodiff.damping() * change, len(variables))
    pressed = form.actuation * free  # (nv, nu) what an input that is not at its limit does
    by_point = np.concatenate([rows[:, :nx], -pressed, rows[:, nx:]], axis=1)
    by_next = model.plant.CalcMassMatrix(twin.context) / h
    by_next[form.diagonal] += damping
    by_point[:, nq:nx] -= by_next  # through (v' - v) / h and D (v' - v)
    if form.pd:
        by_point[:, form.position] += pressed * kp
        by_next += (pressed * (kd + h * kp)) @ form.actuation.T
    velocities = -np.linalg.solve(by_next, by_point)
    return np.concatenate([_positions(model, v_next, velocities, len(vector.values)), velocities])


def _touches(twin: Twin) -> bool:
    contacts = twin.plant.get_contact_results_output_port().Eval(twin.context)
    return bool(contacts.num_point_pair_contacts() or contacts.num_hydroelastic_contacts())


def _needed(twin: Twin, acceleration: Any) -> Any:
    """(nv,) M a + bias less gravity, springs, damping and added forces, in the twin's state."""
    forces = MultibodyForces_[twin.scalar](twin.plant)
    twin.plant.CalcForceElementsContribution(twin.context, forces)
    needed = twin.plant.CalcInverseDynamics(twin.context, acceleration, forces)
    return needed - twin.added_force() if twin.added else needed  # `forces` of AutoDiffXd are a copy: not writable


def _check_vanishes(needed: Array, rest: Array) -> None:
    worst = float(np.abs(needed + rest).max())
    if not worst <= RESIDUAL_TOLERANCE * max(float(np.abs(needed).max()), float(np.abs(rest).max()), 1.0):
        raise NotSmoothError(f"contact, a joint limit or a constraint acts: {worst:.3g} N or N m are not accounted for")


def _positions(model: Model, v_next: Array, velocities: Array, num_parameters: int) -> Array:
    """(nq, nx + nu + np) the derivative of q' = q + h N(q) v'; the AutoDiffXd twin stands at the step's state."""
    if model.plant.IsVelocityEqualToQDot():
        moved = model.time_step * velocities
        moved[_form_of(model).diagonal] += 1.0
        return np.asarray(moved)
    own = np.eye(model.nq, velocities.shape[1])
    twin = model.autodiff
    q_dot = np.asarray(twin.plant.MapVelocityToQDot(twin.context, np.array([AutoDiffXd(v) for v in v_next])))
    own[:, : model.nx] += model.time_step * gradient_rows(q_dot, model.nx + num_parameters)[:, : model.nx]
    n = np.array([model.plant.MapVelocityToQDot(model.double.context, e) for e in np.eye(model.nv)]).T
    return np.asarray(own + model.time_step * n @ velocities)


@dataclass(frozen=True, eq=False)
class _Form:
    """What of a model does not change from step to step."""

    excluded: str  # why the form describes no step of the model; empty where it may
    actuators: list[Any]
    velocity: NDArray[np.int64]  # (nu,) the index in v of the joint that an input drives, and in q
    position: NDArray[np.int64]
    actuation: Array  # (nv, nu)
    limit: Array
    reference: Array  # (2, nu) the positions and velocities that PD control holds
    diagonal: tuple[Any, ...]  # the indices of that of (nv, nv)
    pd: bool
    can_touch: bool

    def gains(self) -> tuple[Array, Array]:
        """kp (nu,) and kd (nu,), zero where there is no controller; they may change as parameters do."""
        if not self.pd:
            return np.zeros(len(self.actuators)), np.zeros(len(self.actuators))
        gains = [a.get_controller_gains() if a.has_controller() else None for a in self.actuators]
        return np.array([g.p if g else 0.0 for g in gains]), np.array([g.d if g else 0.0 for g in gains])


_FORMS: WeakKeyDictionary[Model, _Form] = WeakKeyDictionary()


def _form_of(model: Model) -> _Form:
    if model not in _FORMS:
        found = actuators(model.plant)
        velocity = np.array([a.joint().velocity_start() for a in found], dtype=int)
        actuation = np.zeros((model.nv, len(found)))
        actuation[velocity, np.arange(len(found))] = 1.0
        _FORMS[model] = _Form(
            excluded=why_not_implicit(model),
            actuators=found,
            velocity=velocity,
            position=np.array([a.joint().position_start() for a in found], dtype=int),
            actuation=actuation,
            limit=np.array([a.effort_limit() for a in found], dtype=float),
            reference=_references(model, found),
            diagonal=np.diag_indices(model.nv),
            pd=any(a.has_controller() for a in found),
            can_touch=model.contract.contact.collision_pairs > 0,
        )
    return _FORMS[model]


def _references(model: Model, found: list[Any]) -> Array:
    references = np.zeros((2, len(found)))
    for instance, target in model.pd_targets.items():
        driven = [i for i, a in enumerate(found) if a.model_instance() == instance]
        references[:, driven] = np.asarray(target).reshape(2, len(driven))
    return references


def _desired_states(model: Model) -> list[Any]:
    instances = {a.model_instance() for a in actuators(model.plant) if a.has_controller()}
    return [model.plant.get_desired_state_input_port(instance) for instance in instances]
