"""MuJoCo MJX: MuJoCo's step written in JAX, on the same MJCF, in float64, differentiated forward by `jax.jacfwd`.

MJX drops the derivative with respect to the angular velocity of a free body that does not rotate. The engine adds it.
If a pair with an elliptic cone does not slip, MJX differentiates a square root at 0, which raises a GradientError.
"""

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, frozen
from drake_diff.engines.interface import EngineContract, PlantEngine, StepJacobian
from drake_diff.engines.mujoco import mujoco_model
from drake_diff.engines.mujoco_contract import PYRAMIDAL, MujocoCoordinates, read_contract, touches
from drake_diff.exceptions import GradientError, MissingDependencyError, ModelError, SimulationError
from drake_diff.model.model import Model

try:
    import jax
    import jax.numpy as jnp
    from mujoco import mjx
except ImportError as error:
    raise MissingDependencyError(f"this engine needs MJX ({error}): pip install 'drake-diff[mjx]'") from error

# Residual M a - f, relative to f (at least 1 N or N m). MJX does not report convergence, which leaves about 1e-12.
UNBALANCED = 1e-6
STILL = 1e-8  # [rad/s] speed below which MJX drops the rotation


class MjxEngine(PlantEngine):
    """The MJX engine. `path` is a custom MJCF file, whose joints and actuators have the names of Drake's plant.

    `mjcf` is the generated or given text. Raises ModelError if MJX does not support the model.
    """

    name, version = "mjx", version("mujoco-mjx")

    def __init__(self, model: Model, *, path: str | Path | None = None):
        super().__init__(model)
        self.mjcf, compiled = mujoco_model(self.description, model.time_step, path)
        if not touches(compiled):
            compiled.opt.cone = PYRAMIDAL  # MJX does not support joint limits with elliptic cones and no contact
        with jax.enable_x64(True):
            try:
                self.mjx = mjx.put_model(compiled, impl="jax")
                self.data = mjx.make_data(self.mjx)
            except NotImplementedError as error:
                raise ModelError(f"MJX cannot take this model: {error}") from error
        self.model = jax.tree.map(np.asarray, self.mjx)  # MJX's values, for reading
        self.native = MujocoCoordinates(self.description, self.model)

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        x, u = self._point(x, u)
        state, unbalanced = self._run(_step, x, u)
        if not np.all(np.isfinite(state)):
            raise SimulationError(f"MJX cannot take this step: from x = {x}, u = {u}")
        self.status = "ok" if unbalanced <= UNBALANCED else f"the solver left {unbalanced:.1e} of the forces unbalanced"
        return self.native.to_drake(state[: self.nq], state[self.nq :])

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        x, u = self._point(x, u)
        x_next = self.step(x, u)
        by, _ = self._run(_step_derivative, x, u)
        if not np.all(np.isfinite(by)):
            raise GradientError(f"MJX's derivative of this step is not finite: from x = {x}, u = {u}")
        A, B = self.native.on_tangent(x, x_next, by)
        method = "jax.jacfwd" + self._put_turns_back(x_next, A, B)
        A, B = self.native.jacobian(x, x_next, A, B)
        return StepJacobian(frozen(A), frozen(B), method)

    def _put_turns_back(self, x_next: Array, A: Array, B: Array) -> str:
        """Add derivatives of bodies without rotation, which move by h w' in native tangents, and return the remark."""
        _, qvel = self.native.to_native(x_next)
        starts = [j for _, j in self.native.coordinates.free]
        still = [d for d in (self.native.dofs[j : j + 3] for j in starts) if np.all(np.abs(qvel[d]) <= STILL)]
        h = float(self.model.opt.timestep)
        for dofs in still:
            A[dofs], B[dofs] = h * A[self.nv + dofs], h * B[self.nv + dofs]
            A[dofs, dofs] += 1.0
        return ", turns from rest by hand" if still else ""

    def energy(self, x: ArrayLike) -> float:
        x, q, v = self._state(x)
        terms, m = self._terms(x), self.model
        height = m.body_mass @ (terms.xipos @ m.opt.gravity)
        springs = 0.0
        for j in self.native.joints:
            if m.jnt_stiffness[j]:
                index = int(m.jnt_qposadr[j])
                springs += float(m.jnt_stiffness[j] * (terms.qpos[index] - m.qpos_spring[index]) ** 2) / 2
        return float(v @ self.mass_matrix(q) @ v) / 2 - float(height) + springs

    def contact_depth(self, x: ArrayLike) -> float:
        x, _, _ = self._state(x)
        if not touches(self.model):
            return 0.0
        return float(max(0.0, -np.min(self._run(_distances_at, x, np.zeros(self.nu)))))

    def mass_matrix(self, q: ArrayLike) -> Array:
        q = self._positions(q)
        Q = self.native.turn(q)
        M = self._run(_mass_at, np.concatenate([q, np.zeros(self.nv)]), np.zeros(self.nu))
        return np.asarray(Q.T @ M @ Q)

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        q, v = self._motion(q, v)
        terms = self._terms(np.concatenate([q, v]))
        springs = terms.qfrc_passive + self.model.dof_damping * terms.qvel
        return np.asarray(self.native.turn(q).T @ (terms.qfrc_bias - springs))

    @property
    def contract(self) -> EngineContract:
        terms = self._terms(self._zero())
        precision = str(self.model.qpos0.dtype)
        return read_contract(
            self.model, terms, self.native, self.description, who="MJX", engine=self.name, precision=precision,
            derivatives="by tangent vectors of qpos and by qvel, jax.jacfwd",
        )  # fmt: skip

    def _terms(self, x: Array) -> Any:
        """Return mjx.Data of NumPy arrays, with the terms that depend only on position and velocity."""
        return self._run(_terms_at, x, np.zeros(self.nu))

    def _run(self, function: Any, x: Array, u: Array) -> Any:
        with jax.enable_x64(True):  # JAX's global setting, float32 by default, is unchanged
            native = np.concatenate([*self.native.to_native(x), self.native.control(u)])
            return jax.tree.map(np.asarray, function(self.mjx, self.data, native))


def _placed(m: Any, d: Any, native: Any) -> Any:
    return d.replace(qpos=native[: m.nq], qvel=native[m.nq : m.nq + m.nv], ctrl=native[m.nq + m.nv :])


def _stepped(m: Any, d: Any, native: Any) -> tuple[Any, Any]:
    """Return the state (nq + nv,) after the step, and the relative residual of the solver's forces."""
    d = mjx.step(m, _placed(m, d, native))
    force = d.qfrc_smooth + d.qfrc_constraint
    left = jnp.abs(mjx.mul_m(m, d, d.qacc) - force).max() / jnp.maximum(1.0, jnp.abs(force).max())
    return jnp.concatenate([d.qpos, d.qvel]), left


def _kinematics(m: Any, d: Any, native: Any) -> Any:
    return mjx.com_pos(m, mjx.kinematics(m, _placed(m, d, native)))


def _position_and_velocity(m: Any, d: Any, native: Any) -> Any:
    return mjx.rne(m, mjx.passive(m, mjx.com_vel(m, _kinematics(m, d, native))))


def _mass_matrix(m: Any, d: Any, native: Any) -> Any:
    return mjx.full_m(m, mjx.crb(m, _kinematics(m, d, native)))


def _distances(m: Any, d: Any, native: Any) -> Any:
    return mjx.collision(m, _kinematics(m, d, native))._impl.contact.dist


_terms_at, _mass_at, _distances_at = (jax.jit(f) for f in (_position_and_velocity, _mass_matrix, _distances))
_step = jax.jit(_stepped)
_step_derivative = jax.jit(jax.jacfwd(_stepped, argnums=2, has_aux=True))
