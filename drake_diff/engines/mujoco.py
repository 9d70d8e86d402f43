"""MuJoCo, on MJCF generated from Drake's plant with all digits, or on a custom MJCF file.

With Euler or implicitfast, joint damping is implicit, (M + h D) a = ..., and v' = v + h a. This is Drake's step without
contact, except that quaternions are updated by the exponential map. The contract reports other integrators of an MJCF.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, frozen, positive_float
from drake_diff.engines.formats import mjcf
from drake_diff.engines.interface import EngineContract, PlantEngine, StepJacobian
from drake_diff.engines.mujoco_contract import MujocoCoordinates, check_known, read_contract, read_followers
from drake_diff.exceptions import InputError, MissingDependencyError, ModelError, SimulationError
from drake_diff.mechanics.description import Description, Follower
from drake_diff.model.model import Model

try:
    import mujoco
except ImportError as error:
    raise MissingDependencyError("this engine needs MuJoCo: pip install 'drake-diff[engines]'") from error

BAD = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")  # warnings after which a step is invalid
# Sticking contacts slip beyond about 1e-5 m/s, so that a larger step would leave the mode. Accurate to 1e-9.
DIFFERENCE_STEP = 1e-6
# Without contact, extrapolation from this step and twice this step has truncation errors far below rounding, 1e-11.
FREE_STEP = 3e-5
# Largest difference between the results of both steps. If a contact begins between them, they differ by 1 or more.
SAME_JACOBIAN = 1e-7


class MujocoEngine(PlantEngine):
    """The MuJoCo engine. `path` is a custom MJCF file, whose joints and actuators have the names of Drake's plant.

    `time_step` [s] replaces the model's time step in a generated MJCF. `mjcf` is the generated or given text.
    """

    name, version = "mujoco", str(mujoco.__version__)

    def __init__(self, model: Model, *, path: str | Path | None = None, time_step: float | None = None):
        super().__init__(model)
        if path is not None and time_step is not None:
            raise InputError("time_step [s]", got=time_step, expected="no time step, as the given MJCF file sets it")
        self.time_step = model.time_step if time_step is None else positive_float("time_step [s]", time_step)
        self.mjcf, self.model = mujoco_model(self.description, self.time_step, path)
        self.data = mujoco.MjData(self.model)
        self.native = MujocoCoordinates(self.description, self.model)

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        self._set(*self._point(x, u))
        mujoco.mj_step(self.model, self.data)
        bad = [name for name in BAD if self.data.warning[int(getattr(mujoco.mjtWarning, name))].number > 0]
        if bad or not np.all(np.isfinite(self.data.qpos)):
            raise SimulationError(f"MuJoCo cannot take this step: {bad}, from x = {np.asarray(x)}, u = {np.asarray(u)}")
        used = int(np.max(self.data.solver_niter)) if self.data.nefc else 0
        self.status = "ok" if used < self.model.opt.iterations else f"the solver used all of its {used} iterations"
        return self.native.to_drake(self.data.qpos, self.data.qvel)

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        x, u = self._point(x, u)
        x_next = self.step(x, u)
        self._set(x, u)
        small = self._differences(DIFFERENCE_STEP)
        near, far = self._differences(FREE_STEP), self._differences(2 * FREE_STEP)
        A, B = ((4 * a - b) / 3 for a, b in zip(near, far, strict=True))
        method = "centred differences (mjd_transitionFD), extrapolated"
        if not np.abs(A - small[0]).max() <= SAME_JACOBIAN * max(1.0, float(np.abs(A).max())):
            (A, B), method = small, "centred differences (mjd_transitionFD)"
        A, B = self.native.jacobian(x, x_next, A, B)
        return StepJacobian(frozen(A), frozen(B), method)

    def _differences(self, step: float) -> tuple[Array, Array]:
        """Return A (2 nv, 2 nv) and B (2 nv, nu) in MuJoCo's tangent coordinates and inputs."""
        n = 2 * self.nv
        A, B = np.zeros((n, n)), np.zeros((n, self.nu))
        mujoco.mjd_transitionFD(self.model, self.data, step, True, A, B, None, None)
        return A, B

    def energy(self, x: ArrayLike) -> float:
        self._set(self._state(x)[0], np.zeros(self.nu))
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_energyPos(self.model, self.data)
        mujoco.mj_energyVel(self.model, self.data)
        return float(self.data.energy.sum())

    def contact_depth(self, x: ArrayLike) -> float:
        self._set(self._state(x)[0], np.zeros(self.nu))
        mujoco.mj_fwdPosition(self.model, self.data)
        return max([0.0, *(-float(self.data.contact[i].dist) for i in range(self.data.ncon))])

    def mass_matrix(self, q: ArrayLike) -> Array:
        q = self._positions(q)
        self._set(np.concatenate([q, np.zeros(self.nv)]), np.zeros(self.nu))
        mujoco.mj_forward(self.model, self.data)
        M = np.zeros((self.nv, self.nv))
        for column, unit in zip(M, np.eye(self.nv), strict=True):  # M is symmetric
            mujoco.mj_mulM(self.model, self.data, column, unit)
        Q = self.native.turn(q)
        return np.asarray(Q.T @ M @ Q)

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        q, v = self._motion(q, v)
        self._set(np.concatenate([q, v]), np.zeros(self.nu))
        mujoco.mj_forward(self.model, self.data)
        return np.asarray(self.native.turn(q).T @ (self.data.qfrc_bias - self.data.qfrc_spring))

    @property
    def contract(self) -> EngineContract:
        self._set(self._zero(), np.zeros(self.nu))
        mujoco.mj_forward(self.model, self.data)
        derivatives = "by tangent vectors of qpos and by qvel, centred differences in C"
        fields = {"who": "MuJoCo", "engine": self.name, "derivatives": derivatives}
        return read_contract(self.model, self.data, self.native, self.description, **fields)

    def _set(self, x: Array, u: Array) -> None:
        mujoco.mj_resetData(self.model, self.data)  # also removes the warm start
        self.data.qpos[:], self.data.qvel[:] = self.native.to_native(x)
        self.data.ctrl[:] = self.native.control(u)


def mujoco_model(description: Description, time_step: float, path: str | Path | None) -> tuple[str, Any]:
    """Return the MJCF, generated or read from `path`, and its MjModel. Raises ModelError for unsupported features."""
    if path is None:
        text = generated(description, time_step)
        model = _compile(text)
    else:
        text, model = Path(path).read_text(), _read(path)
    check_known(model)
    return text, model


def followers_in(path: str | Path) -> tuple[Follower, ...]:
    """Return the joints that follow others in an MJCF. Raises ModelError for equalities of another kind."""
    return read_followers(_read(path))


def _read(path: str | Path) -> Any:
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ModelError(f"MuJoCo cannot read {path}: {error}") from error


def generated(description: Description, time_step: float) -> str:
    """Return the MJCF for comparison and export. Raises ModelError if MuJoCo does not support the model."""
    bare = mjcf(description, time_step)
    if not description.pairs:
        return bare
    m = _compile(bare)
    return mjcf(description, time_step, {m.body(b).name: float(m.body_invweight0[b][0]) for b in range(m.nbody)})


def _compile(text: str) -> Any:
    try:
        return mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise ModelError(f"MuJoCo cannot take this model: {error}") from error
