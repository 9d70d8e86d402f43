"""The Jacobian of a smooth step from its own equation, without differentiating Drake's solver.

Where no contact, joint limit or constraint carries a force, Drake's discrete step solves, for the velocities v',

    r(v'; q, v, u) = ID(q, v, (v' - v) / h) - f(q, v) + D (v' - v) + P (q + h v') - P q - ... = 0

ID being the inverse dynamics M a + bias, f gravity, springs and joint damping -D v, all explicit in (q, v). Joint
damping D and the PD controllers are implicit. With the inputs clipped at their effort limits,

    input_i = clip(u_i - kp_i (q_i + h v'_i - q_ref_i) - kd_i (v'_i - v_ref_i)),

so dv' = -(dr/dv')^-1 dr with dr/dv' = M / h + D + B (kd + h kp) B' for the inputs that are not clipped, and
q' = q + h N(q) v'. Only r is differentiated by AutoDiffXd, at Drake's own v', which costs a third of a whole step.
r(v') = 0 is checked first, in both scalar types: where it does not hold, something else acts.
"""

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import AutoDiffXd, InitializeAutoDiff
from pydrake.multibody.tree import MultibodyForces_

from drake_diff.arrays import Array
from drake_diff.autodiff import gradient_rows, plain
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


@dataclass(frozen=True, eq=False)
class _Inputs:
    """What the actuators do to the generalized forces: each drives one velocity."""

    velocity: Array  # (nu,) the index of the velocity, and of ...
    position: Array  # ... the position
    limit: Array
    kp: Array
    kd: Array
    reference: Array  # (nu, 2)

    def effort(self, q: Any, v_next: Array, u: Any, h: float) -> tuple[Any, NDArray[np.bool_]]:
        """(nu,) the net effort, and whether it is free of its limit."""
        q_next = q[self.position] + h * v_next[self.velocity]
        wanted = (
            u - self.kp * (q_next - self.reference[:, 0]) - self.kd * (v_next[self.velocity] - self.reference[:, 1])
        )
        free = np.abs(plain(wanted)) < self.limit
        return np.where(free, wanted, np.clip(plain(wanted), -self.limit, self.limit)), free


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

    `model` has the vector applied. Raises NotSmoothError where something else than smooth forces acts.
    """
    form = _form_of(model)
    if form.excluded:
        raise NotSmoothError(form.excluded)
    inputs, v_next = form.inputs(), x_next[model.nq :]
    set_state(model.double, x)
    residual, free, size = _residual(model.double, inputs, x, v_next, u, model)
    _check_vanishes(residual, size)
    end = model.nx + model.nu
    variables = InitializeAutoDiff(np.concatenate([x, u, vector.values])).ravel()
    write_autodiff(vector, model, variables[end:])
    twin = model.autodiff
    set_state(twin, variables[: model.nx])
    residual, _, _ = _residual(twin, inputs, variables[: model.nx], v_next, variables[model.nx : end], model)
    _check_vanishes(plain(residual), size)
    by_point = gradient_rows(residual, len(variables))
    acceleration_part = model.plant.CalcMassMatrix(model.double.context) / model.time_step
    by_point[:, model.nq : model.nx] -= acceleration_part  # through (v' - v) / h
    pd = np.zeros(model.nv)
    np.add.at(pd, inputs.velocity, np.where(free, inputs.kd + model.time_step * inputs.kp, 0.0))
    by_next = acceleration_part + np.diag(model.double.damping() + pd)
    velocities = -np.linalg.solve(by_next, by_point)
    return np.vstack([_positions(model, twin, v_next, velocities, len(variables)), velocities])


def _positions(model: Model, twin: Twin, v_next: Array, velocities: Array, width: int) -> Array:
    """(nq, width) the derivative of q' = q + h N(q) v'."""
    own = np.eye(model.nq, width)
    if model.nq == model.nv:
        return own + model.time_step * velocities
    qdot = twin.plant.MapVelocityToQDot(twin.context, np.array([AutoDiffXd(v) for v in v_next]))
    n = np.array([model.plant.MapVelocityToQDot(model.double.context, e) for e in np.eye(model.nv)]).T
    return own + model.time_step * (gradient_rows(np.asarray(qdot), width) + n @ velocities)


def _residual(
    twin: Twin, inputs: _Inputs, x: Any, v_next: Array, u: Any, model: Model
) -> tuple[Any, NDArray[np.bool_], float]:
    """(nv,) r, the inputs that are free of their limits, and the size of the forces in it, in the twin's state."""
    plant, context = twin.plant, twin.context
    forces = MultibodyForces_[twin.scalar](plant)
    plant.CalcForceElementsContribution(context, forces)
    if twin.added:
        forces.mutable_generalized_forces()[:] = forces.generalized_forces() + twin.added_force()
    v = plain(x[model.nq :])
    acceleration = ((v_next - v) / model.time_step).astype(twin.scalar)
    efforts, free = inputs.effort(x[: model.nq], v_next, u, model.time_step)
    applied = np.zeros(model.nv).astype(twin.scalar)
    np.add.at(applied, inputs.velocity, efforts)
    needed = plant.CalcInverseDynamics(context, acceleration, forces)
    residual = needed + twin.damping() * (v_next - x[model.nq :]) - applied
    size = float(max(np.abs(plain(needed)).max(), np.abs(plain(applied)).max(initial=0.0), 1.0))
    return residual, free, size


def _check_vanishes(residual: Array, size: float) -> None:
    worst = float(np.abs(residual).max())
    if not worst <= RESIDUAL_TOLERANCE * size:
        raise NotSmoothError(f"contact, a joint limit or a constraint acts: {worst:.3g} N or N m are not accounted for")


@dataclass(frozen=True, eq=False)
class _Form:
    """What of a model does not change from step to step."""

    excluded: str  # why the form describes no step of the model; empty where it may
    actuators: list[Any]
    velocity: Array
    position: Array
    limit: Array
    reference: Array

    def inputs(self) -> _Inputs:
        gains = [a.get_controller_gains() if a.has_controller() else None for a in self.actuators]
        kp = np.array([g.p if g else 0.0 for g in gains])
        kd = np.array([g.d if g else 0.0 for g in gains])
        return _Inputs(self.velocity, self.position, self.limit, kp, kd, self.reference)


_FORMS: WeakKeyDictionary[Model, _Form] = WeakKeyDictionary()


def _form_of(model: Model) -> _Form:
    if model not in _FORMS:
        found = actuators(model.plant)
        _FORMS[model] = _Form(
            excluded=why_not_implicit(model),
            actuators=found,
            velocity=np.array([a.joint().velocity_start() for a in found], dtype=int),
            position=np.array([a.joint().position_start() for a in found], dtype=int),
            limit=np.array([a.effort_limit() for a in found], dtype=float),
            reference=_references(model, found),
        )
    return _FORMS[model]


def _references(model: Model, found: list[Any]) -> Array:
    """(nu, 2) the position and velocity that PD control holds; zero where there is none."""
    references = np.zeros((len(found), 2))
    for instance, target in model.pd_targets.items():
        driven = [i for i, a in enumerate(found) if a.model_instance() == instance]
        references[driven] = np.asarray(target).reshape(2, len(driven)).T
    return references


def _desired_states(model: Model) -> list[Any]:
    instances = {a.model_instance() for a in actuators(model.plant) if a.has_controller()}
    return [model.plant.get_desired_state_input_port(instance) for instance in instances]
