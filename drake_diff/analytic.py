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
    coordinates: Coordinates
    form: Form
    time_step: float
    limit: Array  # (nu,) of the inputs that are clipped; infinite under PD control
    stiffness: Array  # (nv,) K
    damping: Array  # (nv,) D
    rest: Array  # (nv,) c
    positions: NDArray[np.intp]  # (nv,) the index in q of hinges and slides; 0 for free bodies, where K is 0
    velocity_next: NDArray[np.intp]  # where v' stands by v in the flat Jacobian (nx, nx + nu), and q' by q
    position_next: NDArray[np.intp]

    def __call__(self, steps: Steps) -> tuple[Array, NDArray[np.bool_]]:
        """(N, nx, nx + nu) of the steps, and which (N,) are smooth: those that lead where Drake's do."""
        jacobians, x_next = (
            self._free(steps.starts, steps.us) if self.coordinates.free else self._fixed(steps.starts, steps.us)
        )
        size = np.maximum(np.abs(steps.ends).max(axis=1), 1.0)
        return jacobians, ~steps.touching & (np.abs(x_next - steps.ends).max(axis=1) <= STEP_TOLERANCE * size)

    def _fixed(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """Jacobians and x' (N, nx) of hinges and slides, where N(q) = 1."""
        n, h, velocity = self.coordinates.nv, self.time_step, self.form.velocity
        nx, nu = 2 * n, len(velocity)
        q, v = xs[:, :n], xs[:, n:]
        force = self._force(q, v, us)
        jacobians, a = np.empty((len(xs), nx, nx + nu)), np.empty((len(xs), n))
        lower = jacobians[:, n:]
        inverse = np.empty((len(xs), n, n))
        self._differentiate(q, v, force, (lower[:, :, :n], lower[:, :, n:nx], inverse, a))
        lower[:, :, :n] -= inverse * self.stiffness
        lower[:, :, n:nx] -= inverse * self.damping
        lower[:, :, nx:] = inverse[:, :, velocity] * (np.abs(us) < self.limit)[:, None]
        lower *= h
        flat = jacobians.reshape(len(xs), -1)
        flat[:, self.velocity_next] += 1.0
        np.multiply(lower, h, out=jacobians[:, :n])
        flat[:, self.position_next] += 1.0
        v_next = v + h * a
        return jacobians, np.concatenate([q + h * v_next, v_next], axis=1)

    def _differentiate(self, q: Array, v: Array, force: Array, into: tuple[Array, Array, Array, Array]) -> None:
        """Pinocchio's da/dq, da/dv, da/dforce (each (N, nv, nv)) and a (N, nv), written into the arrays given."""
        model, data, derivatives = self.pinocchio, self.data, self.derivatives
        for q_k, v_k, force_k, by_q, by_v, inverse, a in zip(q, v, force, *into, strict=True):
            by_q[:], by_v[:], inverse[:] = derivatives(model, data, q_k, v_k, force_k)
            a[:] = data.ddq

    def _force(self, q: Array, v: Array, us: Array) -> Array:
        """(N, nv) B u + c - K q - D v."""
        force = self.rest - self.stiffness * q[:, self.positions] - self.damping * v
        return np.asarray(force + np.clip(us, -self.limit, self.limit) @ self.form.actuation.T)

    def _free(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """Jacobians and x' (N, nx) with free bodies, whose velocities Pinocchio has in their own"""
        c, h = self.coordinates, self.time_step
        q, v = xs[:, : c.nq], xs[:, c.nq :]
        force = self._force(q, v, us)
        Q = turn(c, q)
        by_q, by_v, inverse = (np.empty((len(xs), c.nv, c.nv)) for _ in range(3))
        native = np.empty((len(xs), c.nv))
        self._differentiate(native_positions(c, q), (Q @ v[..., None])[..., 0], force, (by_q, by_v, inverse, native))
        into, out, out_v = turn_derivatives(c, q, v, native)
        Q_t = np.swapaxes(Q, -1, -2)
        by_motion = Q_t @ (by_q @ Q + by_v @ into - inverse * self.stiffness) + out
        by_velocity = Q_t @ (by_v @ Q - inverse * self.damping) + out_v
        by_input = Q_t @ inverse[:, :, self.form.velocity] * (np.abs(us) < self.limit)[:, None]
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
    from pinocchio import computeABADerivatives

    from drake_diff.engines.pinocchio_model import build  # here, as Pinocchio is an extra

    built, _ = build(description.links, description.gravity)
    stiffness, damping, rest = _springs(model, form, description)
    built.armature = description.by_velocity("armature") + model.time_step * damping
    positions = np.zeros(model.nv, dtype=int)
    for i, j in description.coordinates.single:
        positions[j] = i
    controlled = np.array([a.has_controller() for a in form.actuators], dtype=bool)
    width = model.nx + model.nu
    return Analytic(
        pinocchio=built,
        data=built.createData(),
        derivatives=computeABADerivatives,
        coordinates=description.coordinates,
        form=form,
        time_step=model.time_step,
        limit=np.where(controlled, np.inf, form.limit),
        stiffness=stiffness,
        damping=damping,
        rest=rest,
        positions=positions,
        velocity_next=np.arange(model.nq, model.nx) * (width + 1),
        position_next=np.arange(model.nq) * (width + 1),
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
            if analytic.form.can_touch and model.double.touches():
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
    return f"of {STATES_TRIED} random states geometries touch in all but {CERTIFIED_STATES - left}"


def _difference(model: Model, analytic: Analytic, point: tuple[Array, Array, Array], exact: Any) -> str:
    x, u, end = point
    find = analytic._free if analytic.coordinates.free else analytic._fixed
    jacobians, ends = find(x[None], u[None])
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
