"""MuJoCo, on MJCF generated from Drake's plant, numbers to the last digit, or on the user's own.

With Euler or implicitfast joint damping is implicit, (M + h D) a = ..., and v' = v + h a: Drake's free step, but for a
free body's quaternion (`exponential_gap`). The contract says where an MJCF asks for another.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, frozen, positive_float
from drake_diff.engines.formats import mjcf
from drake_diff.engines.interface import (
    EngineContract,
    PlantEngine,
    StepJacobian,
)
from drake_diff.engines.mujoco_contract import MujocoCoordinates, check_known, read_contract, read_followers
from drake_diff.exceptions import InputError, MissingDependencyError, ModelError, SimulationError
from drake_diff.mechanics.description import Description, Follower
from drake_diff.model.model import Model

try:
    import mujoco
except ImportError as error:
    raise MissingDependencyError("this engine needs MuJoCo: pip install 'drake-diff[engines]'") from error

BAD = ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC")  # warnings after which a step means nothing
# What sticks slips beyond 1e-5 m/s or so, and a larger step would leave the mode: good to 1e-9.
DIFFERENCE_STEP = 1e-6
# Where nothing touches: at this step and at twice it, extrapolated, truncation is far below rounding's 1e-11.
FREE_STEP = 3e-5
# What the two may differ by; if a contact is made between them, they differ by 1 and more.
SAME_JACOBIAN = 1e-7


class MujocoEngine(PlantEngine):
    """`path` is the user's own MJCF, with joints and actuators of the names that Drake's plant has.

    `time_step` [s] is another than the model's, for a generated MJCF. `mjcf` is the text that was generated or read.
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
        """A (2 nv, 2 nv) and B (2 nv, nu) in MuJoCo's tangent coordinates and inputs."""
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
        mujoco.mj_resetData(self.model, self.data)  # which takes the warm start too
        self.data.qpos[:], self.data.qvel[:] = self.native.to_native(x)
        self.data.ctrl[:] = self.native.control(u)


def mujoco_model(description: Description, time_step: float, path: str | Path | None) -> tuple[str, Any]:
    """The MJCF, generated or read from `path`, and its MjModel; ModelError for what the contract has no line for."""
    if path is None:
        text = generated(description, time_step)
        model = _compile(text)
    else:
        text, model = Path(path).read_text(), _read(path)
    check_known(model)
    return text, model


def followers_in(path: str | Path) -> tuple[Follower, ...]:
    """The joints that follow others in an MJCF; ModelError for equalities of another kind."""
    return read_followers(_read(path))


def _read(path: str | Path) -> Any:
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ModelError(f"MuJoCo cannot read {path}: {error}") from error


def generated(description: Description, time_step: float) -> str:
    """The MJCF that is compared and exported; ModelError where MuJoCo cannot have the model."""
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
