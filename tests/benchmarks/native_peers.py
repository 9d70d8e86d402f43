"""Peers with native coordinates: MuJoCo and MJX."""

from typing import Any, ClassVar

import numpy as np
from cases import Case
from peers import (
    Casadi,
    DrakeAutodiff,
    DrakeDiff,
    DrakeDifferences,
    Engine,
    Linear,
    Peer,
    Pinocchio,
    PinocchioAlone,
)

from drake_diff.exceptions import GradientError, MissingDependencyError, ModelError, SimulationError

LARGEST_MJX = 7  # velocities; larger models compile for minutes
SMALL = 1e-6  # eps of mjd_transitionFD, as in MuJoCo's documentation


class Native(Engine):
    """A peer whose x is (qpos, qvel) and whose Jacobian is in MuJoCo's tangent coordinates."""

    contact: ClassVar = True
    step_jacobian = Peer.step_jacobian

    def __init__(self, case: Case):
        super().__init__(case)
        self.native, nv = self.peer.native, case.model.nv
        self.x, self.u = np.concatenate(self.native.to_native(case.x)), self.native.control(case.u)
        self.ends = np.zeros(2 * nv)
        self.ends[nv + self.native.dofs] = case.ends[case.model.nq :]

    def in_drake(self, quantity: str, answer: Any) -> np.ndarray | None:
        nq = self.model.nq
        if quantity == "step":
            return self.native.to_drake(answer[:nq], answer[nq:])
        if quantity == "step_jacobian":
            x_next = self.native.to_drake(answer[0][:nq], answer[0][nq:])
            return self.on_tangent(x_next, *self.native.jacobian(self.case.x, x_next, *answer[1:]))
        return answer[:, self.native.actuator] if quantity == "rollout_gradient" and self.model.nu else None


class Mujoco(Native):
    name, engine = "MuJoCo", "mujoco"
    how: ClassVar = {"step": "mj_step", "": "mjd_transitionFD, centred, called directly"}

    def __init__(self, case: Case):
        super().__init__(case)
        import mujoco

        self.library, n, nu = mujoco, 2 * case.model.nv, case.model.nu
        self.shapes = (n, n), (n, nu)

    def step(self) -> np.ndarray:
        self.put(self.x, self.u)
        return self.stepped()

    def advance(self, x: np.ndarray, u: np.ndarray) -> Linear:
        A, B = (np.zeros(shape) for shape in self.shapes)
        self.put(x, u)
        self.library.mjd_transitionFD(self.peer.model, self.peer.data, SMALL, True, A, B, None, None)
        return self.stepped(), A, B

    def put(self, x: np.ndarray, u: np.ndarray) -> None:
        data, nq = self.peer.data, self.model.nq
        data.qpos[:], data.qvel[:], data.ctrl[:], data.qacc_warmstart[:] = x[:nq], x[nq:], u, 0.0

    def stepped(self) -> np.ndarray:
        self.library.mj_step(self.peer.model, self.peer.data)
        return np.concatenate([self.peer.data.qpos, self.peer.data.qvel])


class Mjx(Native):
    """MJX. After compilation, the process has 15 threads of MJX, and Drake's contact step takes 1.6 to 3 times as long.

    Ratios of a run with MJX can be compared with each other, but not with the ratios of a run without MJX.
    """

    name, engine = "MJX", "mjx"
    how: ClassVar = {"": "jax.jit, jax.jacfwd, float64, CPU; all threads' time; it slows Drake's contact step"}

    def __init__(self, case: Case):
        if case.model.nv > LARGEST_MJX:
            raise ModelError(f"left out: more than {LARGEST_MJX} velocities compile for minutes")
        super().__init__(case)
        import jax
        from mujoco import mjx

        nq, nv = case.model.nq, case.model.nv

        def stepped(m: Any, d: Any, z: Any) -> Any:
            d = mjx.step(m, d.replace(qpos=z[:nq], qvel=z[nq : nq + nv], ctrl=z[nq + nv :]))
            return jax.numpy.concatenate([d.qpos, d.qvel])

        self.jax, self.stepped = jax, jax.jit(stepped)
        self.derivative = jax.jit(jax.jacfwd(stepped, argnums=2))

    def run(self, function: Any, x: np.ndarray, u: np.ndarray) -> np.ndarray:
        with self.jax.enable_x64(True):
            found = np.asarray(function(self.peer.mjx, self.peer.data, np.concatenate([x, u])))
        if not np.all(np.isfinite(found)):
            raise GradientError("MJX's answer is not finite")
        return found

    def step(self) -> np.ndarray:
        return self.run(self.stepped, self.x, self.u)

    def step_jacobian(self) -> np.ndarray:
        return self.run(self.derivative, self.x, self.u)

    def advance(self, x: np.ndarray, u: np.ndarray) -> Linear:
        by, x_next = self.run(self.derivative, x, u), self.run(self.stepped, x, u)
        nq = self.model.nq
        drakes = (self.native.to_drake(z[:nq], z[nq:]) for z in (x, x_next))
        return x_next, *self.native.on_tangent(*drakes, by)

    def in_drake(self, quantity: str, answer: Any) -> np.ndarray | None:
        if quantity == "step_jacobian":
            return super().in_drake(quantity, self.advance(self.x, self.u))
        return super().in_drake(quantity, answer)


PEERS: tuple[type[Peer], ...] = (
    DrakeAutodiff, DrakeDifferences, DrakeDiff, Mujoco, Mjx, Pinocchio, PinocchioAlone, Casadi,
)  # fmt: skip


def peers_of(case: Case, left_out: set[str]) -> tuple[list[Peer], dict[str, str]]:
    """Return the peers that support the model, and why the others do not. --quick excludes the names in `left_out`."""
    found, missing = [], {}
    for kind in PEERS:
        if kind.name in left_out:
            missing[kind.name] = "left out by --quick: it compiles for 3 to 20 s a model"
            continue
        try:
            found.append(kind(case))
        except (ModelError, MissingDependencyError, SimulationError) as error:
            missing[kind.name] = str(error)
    return found, missing
