"""The Jacobians of smooth steps from their own equation, without differentiating Drake's solver.

If no contact, joint limit or constraint exerts a force, Drake's discrete step solves, for the velocities v',

    r(v'; q, v, u) = ID(q, v, (v' - v) / h) - f(q, v) + D (v' - v) + P (q + h v') - P q - ... = 0

ID is the inverse dynamics M a + bias. f are gravity, springs and joint damping -D v, all explicit in (q, v). Joint
damping D and the PD controllers are implicit. With the inputs clipped at their effort limits,

    input_i = clip(u_i - kp_i (q_i + h v'_i - q_ref_i) - kd_i (v'_i - v_ref_i)),

so dv' = -(dr/dv')^-1 dr with dr/dv' = M / h + D + B (kd + h kp) B' for the inputs that are not clipped, and
q' = q + h N(q) v'. With respect to the time step, dr = (B kp v' - M (v' - v) / h^2) dh. Only r is differentiated, at
Drake's own v', by AutoDiffXd (`Implicit`).
r(v') = 0 is checked. If it does not hold, another force acts, or the AutoDiffXd plant differs from the double plant.

For a tree (`SmoothStep`), the derivatives of the tree's accelerations are used in the equivalent form

    (M + h D) a = B u + c - K q - D v - bias(q, v),   v' = v + h a,   q' = q + h N(q) v'

where M is the mass matrix plus reflected inertia, K the stiffness of springs and of PD control (kp), D joint damping
plus the damping of PD control (kd + h kp), and c the constant force of their rest positions. As h D is added to the
reflected inertia, the step is forward dynamics with h D as additional armature (`mechanics.tree`). The columns of B
depend on q for BodyForces. Inputs are clipped at their effort limits as in Drake. A PD controller at its limit, and any
force that this form does not include, is detected because Drake's own step then differs.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import gradient_rows
from drake_diff._base.values import Refusal
from drake_diff.derivatives.steps import Jacobians, NotSmoothError, Steps
from drake_diff.exceptions import DrakeDiffError, ModelError
from drake_diff.mechanics.casadi_tree import body_forces_of
from drake_diff.mechanics.coordinates import Coordinates, euler_jacobian, euler_step
from drake_diff.mechanics.description import describe_tree
from drake_diff.mechanics.tree import ForwardDynamics, compiled_tree
from drake_diff.model.model import Model
from drake_diff.model.parameters import write_autodiff
from drake_diff.model.plant import actuators, joints
from drake_diff.model.step import set_state

# Rounding error of the force balance, relative to the largest force. The residual of a solver is larger.
RESIDUAL_TOLERANCE = 1e-9


class Implicit:
    """The Jacobians of smooth steps from their own equation; columns of parameters that need differences are zero.

    The column of the time step is not zero, as the equation contains it.
    """

    name = "implicit"

    def differentiate(self, steps: Steps) -> Jacobians | Refusal:
        """Differentiate step by step."""
        form, values = form_of(steps.model), np.empty((len(steps), steps.model.nx, steps.width))
        if form.excluded:
            return Refusal(form.excluded)
        refused: dict[int, DrakeDiffError] = {}
        for k, touches in enumerate(steps.touching.tolist()):
            if touches:
                refused[k] = NotSmoothError("geometries touch")
                continue
            missing = differentiate_equation(form, steps, k, values[k])
            if not missing <= RESIDUAL_TOLERANCE:
                why = f"contact, a joint limit or a constraint acts: {missing:.3g} of the forces are not accounted for"
                refused[k] = NotSmoothError(why)
        return Jacobians(values, refused, timed=True)


def differentiate_equation(form: "Form", steps: Steps, k: int, jacobian: Array) -> float:
    """Write step k's derivative to `jacobian` (nx, nx + nu + np) and return the relative residual of the forces.

    If the residual exceeds the tolerance, nothing is written, as the equation does not describe the step.
    """
    model, vector = steps.model, steps.vector
    x, u, v_next = steps.xs[k], steps.us[k], steps.x_next[k, model.nq :]
    steps.stand_at(k)
    twin, nq, nx, h = model.double, model.nq, model.nx, model.time_step
    change, damping = v_next - x[nq:], twin.damping()
    effort, free, (kp, kd) = form.effort(x[:nq], v_next, u, h)
    applied = form.actuation @ np.minimum(np.maximum(effort, -form.limit), form.limit)  # three times faster than clip()

    by_system = u if model.body_forces else u[:0]
    variables = InitializeAutoDiff(np.concatenate([x, vector.values, by_system])).ravel()
    end = nx + len(vector.values)
    write_autodiff(vector, model, variables[nx:end])
    set_state(model.autodiff, variables[:nx])
    if len(by_system):
        model.autodiff.set_input(variables[end:])
    needed = model.autodiff.inverse_dynamics(np.array([AutoDiffXd(a) for a in change / h])).reshape(-1, 1)
    force, rest = ExtractValue(needed).ravel(), damping * change - applied
    missing = float(np.abs(force + rest).max() / max(1.0, np.abs(force).max(), np.abs(rest).max()))
    if not missing <= RESIDUAL_TOLERANCE:
        return missing
    rows = gradient_rows(needed, len(variables))
    if vector.parameters:
        rows = rows + gradient_rows(model.autodiff.damping() * change, len(variables))
    pressed = form.actuation * free  # (nv, nu) the actuation of the efforts that are not at their limits
    by_u = rows[:, end:] - pressed * form.per_input if len(by_system) else -pressed * form.per_input
    by_point = np.concatenate([rows[:, :nx], by_u, rows[:, nx:end]], axis=1)
    by_next = model.double.mass_matrix() / h
    by_next[form.diagonal] += damping
    by_point[:, nq:nx] -= by_next  # through (v' - v) / h and D (v' - v)
    if form.pd:
        np.add.at(by_point.T, form.position, (pressed * kp * form.ratio).T)  # two inputs may have the same coordinate
        by_next += (pressed * (kd + h * kp)) @ form.actuation.T
    step = None if vector.step_entry is None else nx + model.nu + vector.step_entry
    if step is not None:
        by_point[:, step] = -(model.double.mass_matrix() @ change) / h**2
        if form.pd:
            by_point[:, step] += (pressed * kp * form.ratio) @ v_next[form.velocity]
    velocities = -np.linalg.solve(by_next, by_point)
    jacobian[:nq] = _positions(model, form, v_next, velocities, len(variables))
    jacobian[nq:] = velocities
    if step is not None:
        jacobian[:nq, step] += np.asarray(twin.rates(v_next))
    return missing


def _positions(model: Model, form: "Form", v_next: Array, velocities: Array, width: int) -> Array:
    """Return the derivative (nq, nx + nu + np) of q' = q + h N(q) v', with the AutoDiffXd twin at the step's state."""
    if form.q_dot_is_v:
        moved = model.time_step * velocities
        moved[form.diagonal] += 1.0
        return np.asarray(moved)
    moved_positions = np.eye(model.nq, velocities.shape[1])
    twin = model.autodiff
    q_dot = twin.rates(np.array([AutoDiffXd(v) for v in v_next]))
    moved_positions[:, : model.nx] += model.time_step * gradient_rows(q_dot, width)[:, : model.nx]
    n = np.array([model.double.rates(e) for e in np.eye(model.nv)]).T
    return np.asarray(moved_positions + model.time_step * n @ velocities)


@dataclass(frozen=True, eq=False)
class Form:
    """The data of a model's equation that does not change from step to step."""

    excluded: str  # why the form describes no step of the model; "" if it may describe one
    driven: str  # the same, ignoring constraints and the forces of the diagram's systems
    actuators: list[Any]
    velocity: NDArray[np.int64]  # (nu,) the index in v of the joint that an input drives; 0 for other inputs
    position: NDArray[np.int64]  # (nu,) likewise the index in q
    ratio: Array  # (nu,) the joint's position is ratio * entry + offset; 1 and 0 unless it follows another joint
    offset: Array
    actuation: Array  # (nv, nu)
    limit: Array  # (nu,) effort limits
    cut: Array  # (nu,) limits at which Drake clips an input; infinite with PD control, where Drake clips the sum
    reference: Array  # (2, nu) the reference positions and velocities of PD control; 0 if an input commands them
    commanded: NDArray[np.bool_]  # (nu,) whether the input is a commanded position
    diagonal: tuple[Any, ...]  # indices of the diagonal of a matrix (nv, nv)
    pd: bool  # whether there are PD controllers
    q_dot_is_v: bool

    def effort(self, q: Array, v_next: Array, u: Array, h: float) -> tuple[Array, NDArray[np.bool_], Any]:
        """Return the inputs (..., nu) before clipping, whether they are within their limits, and (kp, kd).

        Exactly at a limit the derivative is that of the interior, as with AutoDiffXd. Optimal plans stay at limits.
        """
        kp, kd = self.gains()
        effort = self.feedforward(u)
        if self.pd:
            v = self.ratio * v_next[..., self.velocity]
            moved = self.ratio * q[..., self.position] + self.offset + h * v - self.reference[0]
            effort = effort - kp * moved - kd * (v - self.reference[1])
        return effort, np.abs(effort) <= self.limit, (kp, kd)

    @property
    def per_input(self) -> Array:
        """The derivative (nu,) of the effort with respect to the input: kp for a commanded position, else 1."""
        return np.where(self.commanded, self.gains()[0], 1.0)

    def feedforward(self, u: Array) -> Array:
        """Return the efforts (..., nu) of inputs (..., nu), for commanded positions with the joints at 0."""
        return u * self.per_input if self.commanded.any() else u

    def gains(self) -> tuple[Array, Array]:
        """Return kp (nu,) and kd (nu,), zero without a controller; they may change with parameters."""
        if not self.pd:
            return np.zeros(len(self.limit)), np.zeros(len(self.limit))
        gains = [a.get_controller_gains() if a.has_controller() else None for a in self.actuators]
        return np.array([g.p if g else 0.0 for g in gains]), np.array([g.d if g else 0.0 for g in gains])


def form_of(model: Model) -> Form:
    """Return the form of a model, cached, as it does not change with parameters."""
    return model.cache("implicit form", lambda: _read_form(model), of_structure=True)


def _read_form(model: Model) -> Form:
    plant_actuators, inputs = actuators(model.plant), model.inputs
    joined = [(a.joint().velocity_start(), a.joint().position_start(), a.effort_limit()) for a in plant_actuators]
    starts_and_limits = inputs.of_actuators(np.reshape(joined, (len(plant_actuators), 3)))
    velocity, position = starts_and_limits[:, 0].astype(int), starts_and_limits[:, 1].astype(int)
    controlled = inputs.of_actuators([a.has_controller() for a in plant_actuators]).astype(bool)
    ratio, offset = np.ones(len(position)), np.zeros(len(position))
    if model.coupling is not None:
        ratio, offset = model.coupling.ratio_q[position], model.coupling.offset[position]
        velocity, position = model.coupling.of_v[velocity], model.coupling.of_q[position]
    references = np.zeros((2, len(plant_actuators)))
    for instance, target in model.pd_targets.items():
        driven = [i for i, a in enumerate(plant_actuators) if a.model_instance() == instance]
        references[:, driven] = np.asarray(target).reshape(2, -1)[:, : len(driven)]
    why, others = _why_driven(model), "" if model.body_forces else model.systems_act
    return Form(
        excluded="constraints act at every step" if model.num_constraints else why or others,
        driven=why,
        actuators=plant_actuators,
        velocity=velocity,
        position=position,
        ratio=ratio,
        offset=offset,
        actuation=model.actuation,
        limit=np.where(inputs.actuator >= 0, starts_and_limits[:, 2], np.inf),
        cut=np.where((inputs.actuator >= 0) & ~controlled, starts_and_limits[:, 2], np.inf),
        reference=inputs.of_actuators(references.T).T,
        commanded=inputs.commanded,
        diagonal=np.diag_indices(model.nv),
        pd=any(a.has_controller() for a in plant_actuators),
        q_dot_is_v=bool(model.plant.IsVelocityEqualToQDot()),
    )


def _why_driven(model: Model) -> str:
    """Return why forces other than constraints make the form invalid for every step of the model, or ""."""
    plant = model.plant
    if any(joint.is_locked(model.double.context) for joint in joints(plant)):
        return "a joint is locked"
    controlled = [a for a in actuators(plant) if a.has_controller()]
    if controlled and not model.inputs.plain:
        return "PD controllers act beside the diagram's own inputs"
    targets = {a.model_instance(): plant.get_desired_state_input_port(a.model_instance()) for a in controlled}
    return "the diagram feeds PD targets" if any(model.feeds(port) for port in targets.values()) else ""


# A limit or a controller at its limit changes x' by more. Rounding of x', when it is computed as x + gap, is smaller.
STEP_TOLERANCE = 1e-10


@dataclass(frozen=True, eq=False)
class SmoothStep:
    """The smooth step of a tree, with the data that does not change from step to step."""

    dynamics: ForwardDynamics  # with h D in the armature
    coordinates: Coordinates
    form: Form
    time_step: float
    limit: Array  # (nu,) limits at which inputs are clipped; infinite with PD control
    stiffness: Array  # (nv,) K
    damping: Array  # (nv,) D
    rest: Array  # (nv,) c
    positions: NDArray[np.intp]  # (nv,) the index in q of hinges and slides; 0 for free bodies, where K is 0
    limits: Array  # (2, nv) lower and upper positions of hinges and slides; infinite for free bodies
    sprung: bool  # whether any K is not 0
    loaded: bool  # whether any K, D or c is not 0
    limited: bool  # whether any input is clipped
    body_forces: Any = None  # a function, see `body_forces_of`

    def __call__(self, steps: Steps) -> tuple[Array, NDArray[np.bool_]]:
        """Return the Jacobians (N, nx, nx + nu), and which steps (N,) are smooth, i.e. equal Drake's steps."""
        jacobians, x_next = self.differentiate(steps.xs, steps.us)
        agree = np.abs(x_next - steps.x_next) <= STEP_TOLERANCE * np.maximum(np.abs(steps.x_next), 1.0)
        return jacobians, agree.all(axis=1) & ~steps.touching

    def differentiate(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """Return the Jacobians (N, nx, nx + nu) and x' (N, nx) of smooth steps from xs (N, nx) under us (N, nu)."""
        c, h = self.coordinates, self.time_step
        q, v = xs[:, : c.nq], xs[:, c.nq :]
        force, clipped = self.force_of(q, v, us)
        pushes = self._pushes(q, us) if self.body_forces else None
        if pushes is not None:
            force += (pushes[0] @ us[:, -pushes[0].shape[2] :, None])[:, :, 0]
        by_q, by_v, inverse, a = self.dynamics.accelerate(q, v, force)
        by_u = self._by_input(inverse, clipped)
        if pushes is not None:
            by_q, by_u[:, :, -pushes[0].shape[2] :] = by_q + inverse @ pushes[1], inverse @ pushes[0]
        parts = by_q - inverse * self.stiffness, by_v - inverse * self.damping, by_u
        x_next = euler_step(c, h, xs, a)
        return euler_jacobian(c, h, xs, x_next, np.concatenate(parts, axis=2)), x_next

    def single(self, x: Array, u: Array, x_next: Array) -> Array | None:
        """Return the Jacobian (nx, nx + nu) of one step to x_next (nx,), in a third of the time of `__call__`.

        Returns None with free bodies or BodyForces, for inputs beyond their limits, or if the smooth step differs.
        """
        if self.coordinates.free or self.body_forces or (self.limited and (np.abs(u) >= self.limit).any()):
            return None
        n, h = len(self.damping), self.time_step
        nx, width = 2 * n, 2 * n + len(u)
        q, v = x[:n], x[n:]
        force = self.form.actuation.dot(self.form.feedforward(u))
        if self.loaded:
            force += self.rest - self.damping * v - self.stiffness * q[self.positions]
        by_q, by_v, inverse, a = self.dynamics.accelerate_one(q, v, force)
        v_next = v + h * a
        off_q, off_v = x_next[:n] - q - h * v_next, x_next[n:] - v_next
        if not off_q.dot(off_q) + off_v.dot(off_v) <= STEP_TOLERANCE**2:
            return None
        if self.loaded:
            by_q, by_v = by_q - inverse * self.stiffness, by_v - inverse * self.damping
        jacobian = np.empty((nx, width))
        lower, diagonal = jacobian[n:], jacobian.reshape(-1)[:: width + 1]  # views; diagonal of the first nx columns
        np.multiply(by_q, h, out=lower[:, :n])
        np.multiply(by_v, h, out=lower[:, n:nx])
        np.multiply(self.form.feedforward(inverse.take(self.form.velocity, axis=1)), h, out=lower[:, nx:])
        diagonal[n:] += 1.0
        np.multiply(lower, h, out=jacobian[:n])
        diagonal[:n] += 1.0
        return jacobian

    def curvature(self, xs: Array, us: Array, along: Array) -> Array | None:
        """Return the second derivative (N, nx + nu, nx + nu) of along' x' (N, nx each), or None as in `single`.

        v' = v + h a, where the inverse dynamics tau(q, v, a) equal the forces, which are linear in q, v and u. So with
        mu = M^-1 w, w'a has the second derivative of -mu' tau(q, v, a), with the first derivative of a inserted.
        """
        if self.coordinates.free or self.body_forces:
            return None
        n, h = self.coordinates.nv, self.time_step
        q, v = xs[:, :n], xs[:, n:]
        force, clipped = self.force_of(q, v, us)
        by_q, by_v, inverse, a = self.dynamics.accelerate(q, v, force)
        w = h * (along[:, n:] + h * along[:, :n])
        by_qq, by_vq, by_aq, by_vv = self.dynamics.bend(q, v, a, (inverse @ w[:, :, None])[:, :, 0])
        parts = by_q - inverse * self.stiffness, by_v - inverse * self.damping, self._by_input(inverse, clipped)
        through_q, through_v, through_u = (by_aq.swapaxes(1, 2) @ derivative for derivative in parts)
        hessian = np.zeros((len(xs), 2 * n + us.shape[1], 2 * n + us.shape[1]))
        hessian[:, :n, :n] = -(by_qq + by_qq.swapaxes(1, 2)) / 2 - through_q - through_q.swapaxes(1, 2)
        hessian[:, :n, n : 2 * n] = -by_vq.swapaxes(1, 2) - through_v
        hessian[:, :n, 2 * n :] = -through_u
        hessian[:, n:, :n] = hessian[:, :n, n:].swapaxes(1, 2)
        hessian[:, n : 2 * n, n : 2 * n] = -by_vv
        return hessian

    def at_a_limit(self, steps: Steps) -> NDArray[np.bool_]:
        """Return whether a joint limit exerts a force (N,): Drake's does if phi + 2 h phi' < 0 at the distance phi."""
        v_next = steps.x_next[:, self.coordinates.nq :]
        ahead = steps.xs[:, self.positions] + 2 * self.time_step * v_next
        return np.asarray(((ahead <= self.limits[0]) | (ahead >= self.limits[1])).any(axis=1))

    def force_of(self, q: Array, v: Array, us: Array) -> tuple[Array, NDArray[np.bool_] | None]:
        """Return B u + c - K q - D v (N, nv), and which inputs (N, nu) are clipped, or None if no input is."""
        clipped = np.abs(us) > self.limit
        some = bool(clipped.any())
        if some:
            us = np.clip(us, -self.limit, self.limit)
        force = self.form.feedforward(us) @ self.form.actuation.T + self.rest - self.damping * v
        if self.sprung:
            force -= self.stiffness * q[:, self.positions]
        return force, clipped if some else None

    def _pushes(self, q: Array, us: Array) -> tuple[Array, Array]:
        """Return the BodyForces' columns of B (N, nv, m), and their force's derivative by the tangent of q."""
        c, count = self.coordinates, len(q)
        columns, slopes = self.body_forces(q)
        columns, slopes = columns.reshape(count, -1, c.nv), slopes.reshape(count, c.nq, -1, c.nv)
        by_q = np.einsum("kimj,km->kji", slopes, us[:, -columns.shape[1] :])
        return columns.swapaxes(1, 2), by_q @ c.rate(q)

    def _by_input(self, inverse: Array, clipped: NDArray[np.bool_] | None) -> Array:
        """Return M^-1 B (N, nv, nu), with 0 for clipped inputs."""
        columns = self.form.feedforward(inverse.take(self.form.velocity, axis=2))
        return columns if clipped is None else columns * ~clipped[:, None]


def build_analytic(model: Model) -> SmoothStep:
    """Build the smooth step, not yet certified; raise ModelError if the plant is not a supported tree."""
    form = form_of(model)
    pushes = body_forces_of(model) if model.body_forces else None
    for refusal in (form.driven, "" if pushes else model.systems_act, pushes if isinstance(pushes, Refusal) else ""):
        if refusal:
            raise ModelError(str(refusal))
    description = describe_tree(model, body_forces=True)
    kp, kd = form.gains()
    stiffness, damping = description.by_velocity("stiffness"), description.by_velocity("damping")
    rest = stiffness * description.by_velocity("rest")
    np.add.at(stiffness, form.velocity, kp)
    np.add.at(damping, form.velocity, kd + model.time_step * kp)
    np.add.at(rest, form.velocity, kp * form.reference[0] + kd * form.reference[1])
    positions, limits = np.zeros(model.nv, dtype=int), np.array([[-np.inf], [np.inf]]) * np.ones(model.nv)
    for i, j in description.coordinates.single:
        positions[j] = i
        limits[:, j] = model.plant.GetPositionLowerLimits()[i], model.plant.GetPositionUpperLimits()[i]
    tree = compiled_tree(description)
    if tree is None:
        raise ModelError("a free body is not joined to the world by its own frame")
    armature = description.by_velocity("armature") + model.time_step * damping
    return SmoothStep(
        dynamics=ForwardDynamics(tree, armature),
        coordinates=description.coordinates,
        form=form,
        time_step=model.time_step,
        limit=form.cut,
        stiffness=stiffness,
        damping=damping,
        rest=rest,
        positions=positions,
        limits=limits,
        sprung=bool(stiffness.any()),
        loaded=bool(stiffness.any() or damping.any() or rest.any()),
        limited=bool(np.isfinite(form.cut).any()),
        body_forces=pushes,
    )
