"""The Jacobian of a smooth step from its own equation, without differentiating Drake's solver.

Where no contact, joint limit or constraint carries a force, Drake's discrete step solves, for the velocities v',

    r(v'; q, v, u) = ID(q, v, (v' - v) / h) - f(q, v) + D (v' - v) + P (q + h v') - P q - ... = 0

ID being the inverse dynamics M a + bias, f gravity, springs and joint damping -D v, all explicit in (q, v). Joint
damping D and the PD controllers are implicit. With the inputs clipped at their effort limits,

    input_i = clip(u_i - kp_i (q_i + h v'_i - q_ref_i) - kd_i (v'_i - v_ref_i)),

so dv' = -(dr/dv')^-1 dr with dr/dv' = M / h + D + B (kd + h kp) B' for the inputs that are not clipped, and
q' = q + h N(q) v'. Only r is differentiated, at Drake's own v': of a tree of hinges and slides by its own formulas
(`tree_dynamics`), for many steps in one call; else, and by parameters, by AutoDiffXd.
r(v') = 0 is checked: where it does not hold, something else acts, or the AutoDiffXd plant is not the double one.
"""

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import gradient_rows
from drake_diff.exceptions import GradientError
from drake_diff.mechanics.tree import TreeDynamics, tree_for
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, write_autodiff
from drake_diff.model.plant import actuators, is_driven, joints
from drake_diff.model.step import advance, set_state

# Rounding of the forces that balance, relative to the largest of them. What a solver leaves is larger.
RESIDUAL_TOLERANCE = 1e-9
# From so many joints on NumPy's calls for one state cost less than AutoDiffXd's arithmetic.
TREE_JOINTS = 5


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
    form = form_of(model)
    if form.excluded:
        raise NotSmoothError(form.excluded)
    if form.can_touch and model.double.touches():
        raise NotSmoothError("geometries touch")
    if form.tree is not None and model.nv >= TREE_JOINTS and not model.has_other_parameters:
        jacobians, missing = _by_tree(model, form, form.tree, x[None], u[None], x_next[None])
        _check_vanishes(missing[0])
        return np.asarray(jacobians[0])
    return _by_autodiff(model, form, vector, x, u, x_next)


@dataclass(frozen=True, eq=False)
class Steps:
    """N steps from starts (N, nx) under us (N, nu) to ends (N, nx), and where a contact acts (N,)."""

    starts: Array
    us: Array
    ends: Array
    touching: NDArray[np.bool_]

    def part(self, which: NDArray[np.intp]) -> "Steps":
        """Some of the steps."""
        return Steps(self.starts[which], self.us[which], self.ends[which], self.touching[which])


def take_steps(model: Model, x0: Array, us: Array, xs: Array | None = None, x_next: Array | None = None) -> Steps:
    """Drake's steps from x0 (nx,) under us (N, nu), or from each of xs (N, nx).

    Where the steps from xs are known to lead to `x_next` (N, nx), Drake is asked only what overlaps.
    """
    form = form_of(model)
    starts, ends = np.empty((len(us), model.nx)), np.empty((len(us), model.nx))
    touching = np.zeros(len(us), dtype=bool)
    if xs is not None and x_next is not None:
        for k in range(len(us) if form.can_touch else 0):
            set_state(model.double, xs[k])
            touching[k] = model.double.overlaps()
        return Steps(xs, us, x_next, touching)
    x = x0
    for k, u in enumerate(us):
        starts[k] = x if xs is None else xs[k]
        x = ends[k] = advance(model.double, starts[k], u)
        touching[k] = form.can_touch and model.double.touches()
    return Steps(starts, us, ends, touching)


def implicit_jacobians(model: Model, steps: Steps) -> tuple[Array, NDArray[np.bool_]] | None:
    """(N, nx, nx + nu) of the steps, and which of them (N,) are smooth; the Jacobians of the others mean nothing.

    None where there is no tree, or parameters are set: then the steps are differentiated one by one.
    """
    form = form_of(model)
    if form.excluded or form.tree is None or model.has_other_parameters:
        return None
    jacobians, missing = _by_tree(model, form, form.tree, steps.starts, steps.us, steps.ends)
    return jacobians, ~steps.touching & (missing <= RESIDUAL_TOLERANCE)


def _by_tree(
    model: Model, form: "Form", tree: TreeDynamics, xs: Array, us: Array, x_nexts: Array
) -> tuple[Array, Array]:
    """(N, nx, nx + nu) the derivatives of N steps, and (N,) the force that is not accounted for, as a part."""
    n, h, damping = model.nv, model.time_step, tree.damping
    q, v, v_next = xs[:, :n], xs[:, n:], x_nexts[:, n:]
    effort, free, (kp, kd) = form.effort(q, v_next, us, h)
    d = tree(tree.place(model, q), q, v, (v_next - v) / h)
    rest = damping * (v_next - v) - np.clip(effort, -form.limit, form.limit) @ form.actuation.T
    diagonal = np.arange(n)
    by_next = d.mass / h
    by_next[:, diagonal, diagonal] += damping
    pressed = form.actuation * free[:, None, :]
    by_point = np.concatenate([d.by_q, d.by_v - by_next, -pressed], axis=2)
    if form.pd:
        by_point[:, :, form.position] += pressed * kp
        by_next = by_next + (pressed * (kd + h * kp)) @ form.actuation.T
    velocities = -np.linalg.solve(by_next, by_point)
    positions = h * velocities
    positions[:, diagonal, diagonal] += 1.0
    return np.concatenate([positions, velocities], axis=1), _missing(d.tau, rest)


def _by_autodiff(model: Model, form: "Form", vector: ParameterVector, x: Array, u: Array, x_next: Array) -> Array:
    twin, nq, nx, h = model.double, model.nq, model.nx, model.time_step
    v_next = x_next[nq:]
    change, damping = v_next - x[nq:], twin.damping()
    effort, free, (kp, kd) = form.effort(x[:nq], v_next, u, h)
    applied = form.actuation @ np.clip(effort, -form.limit, form.limit)

    variables = InitializeAutoDiff(np.concatenate([x, vector.values])).ravel()
    write_autodiff(vector, model, variables[nx:])
    set_state(model.autodiff, variables[:nx])
    needed = model.autodiff.inverse_dynamics(np.array([AutoDiffXd(a) for a in change / h])).reshape(-1, 1)
    _check_vanishes(_missing(ExtractValue(needed).ravel(), damping * change - applied))
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


def _missing(needed: Array, rest: Array) -> Array:
    """(...,) the largest force (..., nv) that is not accounted for, relative to the largest of those that are."""
    size = np.maximum(np.maximum(np.abs(needed).max(axis=-1), np.abs(rest).max(axis=-1)), 1.0)
    return np.asarray(np.abs(needed + rest).max(axis=-1) / size)


def _check_vanishes(missing: Array) -> None:
    if not missing <= RESIDUAL_TOLERANCE:
        raise NotSmoothError(
            f"contact, a joint limit or a constraint acts: {float(missing):.3g} of the forces are not accounted for"
        )


def _positions(model: Model, v_next: Array, velocities: Array, num_parameters: int) -> Array:
    """(nq, nx + nu + np) the derivative of q' = q + h N(q) v'; the AutoDiffXd twin stands at the step's state."""
    if model.plant.IsVelocityEqualToQDot():
        moved = model.time_step * velocities
        moved[form_of(model).diagonal] += 1.0
        return np.asarray(moved)
    own = np.eye(model.nq, velocities.shape[1])
    twin = model.autodiff
    q_dot = np.asarray(twin.plant.MapVelocityToQDot(twin.context, np.array([AutoDiffXd(v) for v in v_next])))
    own[:, : model.nx] += model.time_step * gradient_rows(q_dot, model.nx + num_parameters)[:, : model.nx]
    n = np.array([model.plant.MapVelocityToQDot(model.double.context, e) for e in np.eye(model.nv)]).T
    return np.asarray(own + model.time_step * n @ velocities)


@dataclass(frozen=True, eq=False)
class Form:
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
    tree: TreeDynamics | None

    def effort(self, q: Array, v_next: Array, u: Array, h: float) -> tuple[Array, NDArray[np.bool_], Any]:
        """(..., nu) what the inputs are before they are clipped, whether they are free of their limits, and kp, kd."""
        kp, kd = self.gains()
        effort = u
        if self.pd:
            moved = q[..., self.position] + h * v_next[..., self.velocity] - self.reference[0]
            effort = u - kp * moved - kd * (v_next[..., self.velocity] - self.reference[1])
        return effort, np.abs(effort) < self.limit, (kp, kd)

    def gains(self) -> tuple[Array, Array]:
        """kp (nu,) and kd (nu,), zero where there is no controller; they may change as parameters do."""
        if not self.pd:
            return np.zeros(len(self.actuators)), np.zeros(len(self.actuators))
        gains = [a.get_controller_gains() if a.has_controller() else None for a in self.actuators]
        return np.array([g.p if g else 0.0 for g in gains]), np.array([g.d if g else 0.0 for g in gains])


_FORMS: WeakKeyDictionary[Model, Form] = WeakKeyDictionary()


def form_of(model: Model) -> Form:
    """Read once, from the model's own parameters: while it has others, no tree is made and nothing is kept."""
    if model in _FORMS:
        return _FORMS[model]
    found = actuators(model.plant)
    velocity = np.array([a.joint().velocity_start() for a in found], dtype=int)
    actuation = np.zeros((model.nv, len(found)))
    actuation[velocity, np.arange(len(found))] = 1.0
    form = Form(
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
        tree=tree_for(model),
    )
    if not model.has_other_parameters:
        _FORMS[model] = form
    return form


def _references(model: Model, found: list[Any]) -> Array:
    references = np.zeros((2, len(found)))
    for instance, target in model.pd_targets.items():
        driven = [i for i, a in enumerate(found) if a.model_instance() == instance]
        references[:, driven] = np.asarray(target).reshape(2, len(driven))
    return references


def _desired_states(model: Model) -> list[Any]:
    instances = {a.model_instance() for a in actuators(model.plant) if a.has_controller()}
    return [model.plant.get_desired_state_input_port(instance) for instance in instances]
