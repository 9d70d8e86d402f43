"""Smooth steps by Pinocchio's derivatives of forward dynamics, certified equal to AutoDiffXd before they are used.

Where nothing touches and no limit acts, Drake's step of a tree is (see `implicit`)

    (M + h D) a = B u + c - K q - D v - bias(q, v),   v' = v + h a,   q' = q + h N(q) v'

with M the mass matrix and reflected inertia, K the stiffness of springs and of PD control (kp), D joint damping and
what PD control adds (kd + h kp), and c what their rest positions add. As h D stands beside the reflected inertia, the
whole step is Pinocchio's articulated-body algorithm with h D as additional armature, and its derivatives are those of
`computeABADerivatives`. Inputs are clipped at their effort limits as Drake does; a PD controller at its limit, as
anything that this form leaves out, shows in Drake's own step, which is not this one then.
"""

from dataclasses import dataclass
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff

from drake_diff.arrays import Array
from drake_diff.autodiff import gradient_rows
from drake_diff.engines.body_frame import native_positions, turn, turn_derivatives, turning
from drake_diff.engines.description import Description, describe_tree
from drake_diff.engines.euler import Coordinates
from drake_diff.exceptions import MissingDependencyError, ModelError, SimulationError
from drake_diff.implicit import Form, Steps, form_of
from drake_diff.model import Model
from drake_diff.step import advance, set_state

# Of the largest entry: two derivatives of one smooth step differ by rounding, which a mass matrix may magnify.
SAME_JACOBIAN = 1e-9
# Of the largest entry of x' (or 1): the same equation solved in another order.
SAME_STEP = 1e-12
# What a limit or a controller at its limit changes in x' is larger; x' known to rounding alone, as x + gap, is not.
STEP_TOLERANCE = 1e-10
CERTIFIED_STATES, STATES_TRIED = 3, 60


@dataclass(frozen=True, eq=False)
class Analytic:
    """What of a model does not change from step to step."""

    pinocchio: Any  # pin.Model, with h D in its armature
    data: Any
    derivatives: Any  # pin.computeABADerivatives
    outputs: list[memoryview]  # where in data it leaves da/dq, da/dv, da/dforce and a: four joined are one copy
    coordinates: Coordinates
    form: Form
    time_step: float
    limit: Array  # (nu,) of the inputs that are clipped; infinite under PD control
    stiffness: Array  # (nv,) K
    damping: Array  # (nv,) D
    rest: Array  # (nv,) c
    positions: NDArray[np.intp]  # (nv,) the index in q of hinges and slides; 0 for free bodies, where K is 0
    sprung: bool  # whether any K is not 0

    def __call__(self, steps: Steps) -> tuple[Array, NDArray[np.bool_]]:
        """(N, nx, nx + nu) of the steps, and which (N,) are smooth: those that lead where Drake's do."""
        jacobians, x_next = self.differentiate(steps.starts, steps.us)
        agree = np.abs(x_next - steps.ends) <= STEP_TOLERANCE * np.maximum(np.abs(steps.ends), 1.0)
        return jacobians, agree.all(axis=1) & ~steps.touching

    def differentiate(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """(N, nx, nx + nu) and x' (N, nx) of the steps from xs (N, nx) under us (N, nu), were they smooth."""
        return self._free(xs, us) if self.coordinates.free else self._fixed(xs, us)

    def _fixed(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """Of hinges and slides, where N(q) = 1 and Pinocchio's velocities are Drake's."""
        n, h = self.coordinates.nv, self.time_step
        nx, nu = 2 * n, us.shape[1]
        q, v = xs[:, :n], xs[:, n:]
        force, clipped = self._force(q, v, us)
        by_q, by_v, inverse, a = self._accelerate(q, v, force)
        jacobians = np.empty((len(xs), nx, nx + nu))
        upper, lower = jacobians[:, :n], jacobians[:, n:]
        np.multiply(by_q - inverse * self.stiffness if self.sprung else by_q, h, out=lower[:, :, :n])
        np.multiply(by_v - inverse * self.damping, h, out=lower[:, :, n:nx])
        np.multiply(self._by_input(inverse, clipped), h, out=lower[:, :, nx:])
        diagonal = jacobians.reshape(len(xs), -1)[:, :: nx + nu + 1]  # of the first nx columns; a view
        diagonal[:, n:] += 1.0
        np.multiply(lower, h, out=upper)
        diagonal[:, :n] += 1.0
        v_next = v + h * a
        return jacobians, np.concatenate([q + h * v_next, v_next], axis=1)

    def _accelerate(self, q: Array, v: Array, force: Array) -> tuple[Array, Array, Array, Array]:
        """Pinocchio's da/dq, da/dv, da/dforce (each (N, nv, nv)) and a (N, nv)."""
        model, data, derivatives, outputs = self.pinocchio, self.data, self.derivatives, self.outputs
        rows = []
        for q_k, v_k, force_k in zip(q, v, force, strict=True):
            derivatives(model, data, q_k, v_k, force_k)
            rows.append(b"".join(outputs))
        n = v.shape[1]
        found = np.frombuffer(b"".join(rows)).reshape(len(q), 3 * n * n + n)
        by_q, by_v, inverse = (found[:, k * n * n : (k + 1) * n * n].reshape(len(q), n, n) for k in range(3))
        return by_q, by_v, inverse, found[:, 3 * n * n :]

    def _force(self, q: Array, v: Array, us: Array) -> tuple[Array, NDArray[np.bool_] | None]:
        """(N, nv) B u + c - K q - D v, and which inputs (N, nu) are clipped, None where none is."""
        clipped = np.abs(us) >= self.limit
        some = bool(clipped.any())
        if some:
            us = np.clip(us, -self.limit, self.limit)
        force = us @ self.form.actuation.T + self.rest - self.damping * v
        if self.sprung:
            force -= self.stiffness * q[:, self.positions]
        return force, clipped if some else None

    def _by_input(self, inverse: Array, clipped: NDArray[np.bool_] | None) -> Array:
        """(N, nv, nu) M^-1 B, 0 for clipped inputs."""
        columns = inverse.take(self.form.velocity, axis=2)
        return columns if clipped is None else columns * ~clipped[:, None]

    def _free(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """Jacobians and x' (N, nx) with free bodies, whose velocities Pinocchio has in their own frames."""
        c, h = self.coordinates, self.time_step
        q, v = xs[:, : c.nq], xs[:, c.nq :]
        force, clipped = self._force(q, v, us)
        Q = turn(c, q)
        native_v = (Q @ v[..., None])[..., 0]
        by_q, by_v, inverse, native = self._accelerate(native_positions(c, q), native_v, force)
        into, out, out_v = turn_derivatives(c, q, v, native)
        Q_t = np.swapaxes(Q, -1, -2)
        by_motion = Q_t @ (by_q @ Q + by_v @ into - inverse * self.stiffness) + out
        by_velocity = Q_t @ (by_v @ Q - inverse * self.damping) + out_v
        by_input = Q_t @ self._by_input(inverse, clipped)
        lower = h * np.concatenate([by_motion @ c.motion(q), by_velocity, by_input], axis=2)
        lower[:, :, c.nq : c.nq + c.nv] += np.eye(c.nv)
        a = (Q_t @ native[..., None])[..., 0] + turning(c, v)
        v_next, N = v + h * a, c.rate(q)
        upper = h * N @ lower
        upper[:, :, : c.nq] += np.eye(c.nq) + h * c.rate_by_position(v_next)
        q_next = q + h * (N @ v_next[..., None])[..., 0]
        return np.concatenate([upper, lower], axis=1), np.concatenate([q_next, v_next], axis=1)


def analytic_of(model: Model) -> Analytic | str:
    """The model's analytic step, certified when it is first asked for; else why there is none."""
    if model.has_other_parameters:
        return "parameters are applied that are not the model's own"
    if model not in _FOUND:
        try:
            _FOUND[model] = certified(model, build_analytic(model))
        except (ModelError, MissingDependencyError) as error:
            _FOUND[model] = str(error)
    return _FOUND[model]


_FOUND: WeakKeyDictionary[Model, Analytic | str] = WeakKeyDictionary()


def build_analytic(model: Model) -> Analytic:
    """Not certified. Raises ModelError where the plant is no such tree, MissingDependencyError without Pinocchio."""
    form = form_of(model)
    if form.excluded:
        raise ModelError(form.excluded)
    description = describe_tree(model)
    from drake_diff.engines.pinocchio_model import acceleration_derivatives, build  # here, as Pinocchio is an extra

    built, _ = build(description.links, description.gravity)
    stiffness, damping, rest = _springs(model, form, description)
    data = built.createData()
    built.armature = description.by_velocity("armature") + model.time_step * damping
    positions = np.zeros(model.nv, dtype=int)
    for i, j in description.coordinates.single:
        positions[j] = i
    controlled = np.array([a.has_controller() for a in form.actuators], dtype=bool)
    return Analytic(
        pinocchio=built,
        data=data,
        derivatives=acceleration_derivatives,
        outputs=[memoryview(x).cast("B") for x in (data.ddq_dq, data.ddq_dv, data.Minv, data.ddq)],
        coordinates=description.coordinates,
        form=form,
        time_step=model.time_step,
        limit=np.where(controlled, np.inf, form.limit),
        stiffness=stiffness,
        damping=damping,
        rest=rest,
        positions=positions,
        sprung=bool(stiffness.any()),
    )


def _springs(model: Model, form: Form, description: Description) -> tuple[Array, Array, Array]:
    """K, D and c (each (nv,)), those of PD control included."""
    kp, kd = form.gains()
    stiffness, damping = description.by_velocity("stiffness"), description.by_velocity("damping")
    rest = stiffness * description.by_velocity("rest")
    np.add.at(stiffness, form.velocity, kp)
    np.add.at(damping, form.velocity, kd + model.time_step * kp)
    np.add.at(rest, form.velocity, kp * form.reference[0] + kd * form.reference[1])
    return stiffness, damping, rest


def certified(model: Model, analytic: Analytic) -> Analytic | str:
    """`analytic` where it is Drake's step and AutoDiffXd's derivative at three random states, else why not."""
    here = model.plant.GetPositionsAndVelocities(model.double.context)
    try:
        return _first_difference(model, analytic) or analytic
    finally:
        set_state(model.double, here)


def _first_difference(model: Model, analytic: Analytic) -> str:
    random, left = np.random.default_rng(0), CERTIFIED_STATES
    for _ in range(STATES_TRIED):
        x, u = _random_point(model, analytic.coordinates, random)
        try:
            end = advance(model.double, x, u)
            if _is_left_out(model, analytic, x, u, end):
                continue
            variables = InitializeAutoDiff(np.concatenate([x, u])).ravel()
            exact = advance(model.autodiff, variables[: model.nx], variables[model.nx :])
        except (SimulationError, ModelError) as error:
            return f"AutoDiffXd, to certify it by, is refused: {error}"
        why = _difference(model, analytic, (x, u, end), exact)
        if why:
            return why
        left -= 1
        if not left:
            return ""
    smooth = CERTIFIED_STATES - left
    return f"of {STATES_TRIED} random states geometries touch or controllers are at their limits in all but {smooth}"


def _is_left_out(model: Model, analytic: Analytic, x: Array, u: Array, end: Array) -> bool:
    """Whether the step from (x, u) to `end`, has contact or a controller at its limit; the twin is there."""
    form = analytic.form
    _, free, _ = form.effort(x[: model.nq], end[model.nq :], u, model.time_step)
    return bool(np.any(~free[np.isinf(analytic.limit)])) or (form.can_touch and model.double.touches())


def _difference(model: Model, analytic: Analytic, point: tuple[Array, Array, Array], exact: Any) -> str:
    x, u, end = point
    jacobians, ends = analytic.differentiate(x[None], u[None])
    rows = gradient_rows(exact, model.nx + model.nu)
    gap = float(np.abs(ends[0] - end).max())
    if not gap <= SAME_STEP * max(1.0, float(np.abs(end).max())):
        return f"its step differs from Drake's by {gap:.2g}"
    if not np.abs(ExtractValue(exact.reshape(-1, 1)).ravel() - end).max() <= SAME_JACOBIAN * max(
        1.0, np.abs(end).max()
    ):
        return "the AutoDiffXd step is not the double step"
    gap = float(np.abs(jacobians[0] - rows).max())
    if not gap <= SAME_JACOBIAN * float(np.abs(rows).max()):
        return f"its Jacobian differs from AutoDiffXd's by {gap:.2g}"
    return ""


def _random_point(model: Model, coordinates: Coordinates, random: np.random.Generator) -> tuple[Array, Array]:
    """A state in the middle half of the limits, quaternions of unit norm, and inputs within half their limits."""
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    q = random.standard_normal(model.nq)
    limited = np.isfinite(lower) & np.isfinite(upper)
    part = random.uniform(0.25, 0.75, int(limited.sum()))
    q[limited] = lower[limited] + part * (upper - lower)[limited]
    for i, _ in coordinates.free:
        q[i : i + 4] /= np.linalg.norm(q[i : i + 4])
    limit = np.minimum(form_of(model).limit, 2.0)
    return np.concatenate([q, random.standard_normal(model.nv)]), random.uniform(-0.5, 0.5, model.nu) * limit


def analytic_jacobian(model: Model, x: Array, u: Array, x_next: Array) -> Array | str:
    """(nx, nx + nu) the derivative of the step by [x; u], or why it cannot be had so.

    The double twin stands at the step from (x, u) to `x_next`, as `step.advance` leaves it.
    """
    analytic = analytic_of(model)
    if isinstance(analytic, str):
        return analytic
    if analytic.form.can_touch and model.double.touches():
        return "geometries touch"
    jacobians, smooth = analytic(Steps(x[None], u[None], x_next[None], np.zeros(1, dtype=bool)))
    return np.asarray(jacobians[0]) if smooth[0] else "contact, a limit or a constraint acts"
