"""Smooth steps by the derivatives of a tree's accelerations.

Where nothing touches and no limit acts, Drake's step of a tree is (see `implicit`)

    (M + h D) a = B u + c - K q - D v - bias(q, v),   v' = v + h a,   q' = q + h N(q) v'

with M the mass matrix and reflected inertia, K the stiffness of springs and of PD control (kp), D joint damping and
what PD control adds (kd + h kp), and c what their rest positions add. As h D stands beside the reflected inertia, the
whole step is forward dynamics with h D as additional armature (`mechanics.tree`). Inputs are clipped at their effort
limits as Drake does; a PD controller at its limit, as anything that this form leaves out, shows in Drake's own step,
which is not this one then.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import Array
from drake_diff.derivatives.implicit import Form, form_of
from drake_diff.derivatives.steps import Steps
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.compiled_tree import compiled_tree
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.mechanics.description import describe_tree
from drake_diff.mechanics.tree import ForwardDynamics
from drake_diff.model.model import Model

# What a limit or a controller at its limit changes in x' is larger; x' known to rounding alone, as x + gap, is not.
STEP_TOLERANCE = 1e-10


@dataclass(frozen=True, eq=False)
class SmoothStep:
    """What of a model does not change from step to step."""

    dynamics: ForwardDynamics  # of what has h D in its armature
    coordinates: Coordinates
    form: Form
    time_step: float
    limit: Array  # (nu,) of the inputs that are clipped; infinite under PD control
    stiffness: Array  # (nv,) K
    damping: Array  # (nv,) D
    rest: Array  # (nv,) c
    positions: NDArray[np.intp]  # (nv,) the index in q of hinges and slides; 0 for free bodies, where K is 0
    limits: Array  # (2, nv) lower and upper positions of hinges and slides; infinite of free bodies
    sprung: bool  # whether any K is not 0
    loaded: bool  # whether any K, D or c is not 0
    limited: bool  # whether any input is clipped

    def __call__(self, steps: Steps) -> tuple[Array, NDArray[np.bool_]]:
        """(N, nx, nx + nu) of the steps, and which (N,) are smooth: those that lead where Drake's do."""
        jacobians, x_next = self.differentiate(steps.xs, steps.us)
        agree = np.abs(x_next - steps.x_next) <= STEP_TOLERANCE * np.maximum(np.abs(steps.x_next), 1.0)
        return jacobians, agree.all(axis=1) & ~steps.touching

    def differentiate(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """(N, nx, nx + nu) and x' (N, nx) of the steps from xs (N, nx) under us (N, nu), were they smooth."""
        c, h = self.coordinates, self.time_step
        if not c.free:
            return self._fixed(xs, us)
        q, v = xs[:, : c.nq], xs[:, c.nq :]
        force, clipped = self.force_of(q, v, us)
        by_q, by_v, inverse, a = self.dynamics.accelerate(q, v, force)
        parts = by_q - inverse * self.stiffness, by_v - inverse * self.damping, self._by_input(inverse, clipped)
        velocities = h * np.concatenate(parts, axis=2)
        velocities[:, :, c.nv : 2 * c.nv] += np.eye(c.nv)
        return self.assemble(q, velocities, v + h * a)

    def _fixed(self, xs: Array, us: Array) -> tuple[Array, Array]:
        """Of hinges and slides, where N(q) = 1."""
        n, h = self.coordinates.nv, self.time_step
        nx, nu = 2 * n, us.shape[1]
        q, v = xs[:, :n], xs[:, n:]
        force, clipped = self.force_of(q, v, us)
        by_q, by_v, inverse, a = self.dynamics.accelerate(q, v, force)
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

    def single(self, x: Array, u: Array, x_next: Array) -> Array | None:
        """(nx, nx + nu) of the step from x (nx,) under u (nu,) to x_next (nx,), in a third of the time of `__call__`.

        None of free bodies, where an input is at its limit or beyond, and where a smooth step leads elsewhere.
        """
        if self.coordinates.free or (self.limited and (np.abs(u) >= self.limit).any()):
            return None
        n, h = len(self.damping), self.time_step
        nx, width = 2 * n, 2 * n + len(u)
        q, v = x[:n], x[n:]
        force = self.form.actuation.dot(u)
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
        lower, diagonal = jacobian[n:], jacobian.reshape(-1)[:: width + 1]  # of the first nx columns; views
        np.multiply(by_q, h, out=lower[:, :n])
        np.multiply(by_v, h, out=lower[:, n:nx])
        np.multiply(inverse.take(self.form.velocity, axis=1), h, out=lower[:, nx:])
        diagonal[n:] += 1.0
        np.multiply(lower, h, out=jacobian[:n])
        diagonal[:n] += 1.0
        return jacobian

    def curvature(self, xs: Array, us: Array, along: Array) -> Array | None:
        """(N, nx + nu, nx + nu) the second derivative of along' x' (N, nx each); None of free bodies.

        v' = v + h a, where inverse dynamics give tau(q, v, a) for the forces, which are linear in q, v and u. So with
        mu = M^-1 w, w'a has the second derivative of -mu' tau(q, v, a) at the a' that the first one has.
        """
        if self.coordinates.free:
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
        """(N,) whether a joint limit pushes: Drake's does where phi + 2 h phi' < 0, phi being how far it is."""
        v_next = steps.x_next[:, self.coordinates.nq :]
        ahead = steps.xs[:, self.positions] + 2 * self.time_step * v_next
        return np.asarray(((ahead <= self.limits[0]) | (ahead >= self.limits[1])).any(axis=1))

    def force_of(self, q: Array, v: Array, us: Array) -> tuple[Array, NDArray[np.bool_] | None]:
        """(N, nv) B u + c - K q - D v, and which inputs (N, nu) are clipped, None where none is."""
        clipped = np.abs(us) > self.limit
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

    def assemble(self, q: Array, velocities: Array, v_next: Array) -> tuple[Array, Array]:
        """(N, nx, nx + nu) and x' (N, nx), from the derivative of v' by small motion, v and u, and v'."""
        c, h = self.coordinates, self.time_step
        lower = np.concatenate([velocities[:, :, : c.nv] @ c.motion(q), velocities[:, :, c.nv :]], axis=2)
        N = c.rate(q)
        upper = h * N @ lower
        upper[:, :, : c.nq] += np.eye(c.nq) + h * c.rate_by_position(v_next)
        q_next = q + h * (N @ v_next[..., None])[..., 0]
        return np.concatenate([upper, lower], axis=1), np.concatenate([q_next, v_next], axis=1)


def build_analytic(model: Model) -> SmoothStep:
    """Not certified. Raises ModelError where the plant is no such tree."""
    form = form_of(model)
    if form.driven or model.systems_act:
        raise ModelError(form.driven or model.systems_act)
    description = describe_tree(model)
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
    )
