"""MuJoCo, on MJCF generated from Drake's plant or on the user's own.

With the integrator Euler joint damping is implicit, (M + h D) a = ..., and v' = v + h a: Drake's free step. What
differs is a free body's quaternion, which MuJoCo turns by the exponential of h w' and Drake by its first term:
`exponential_gap` is that difference. implicitfast is the same step here; implicit (velocity products in it), RK4 and
Euler without eulerdamp are others, and the contract says so.

A free body's native velocity is (v in world, w in the body): v_native = Q v with Q = [[0, 1], [R', 0]].
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff.arrays import Array, finite_array, frozen
from drake_diff.engines.description import describe
from drake_diff.engines.engine import EngineContract, StepJacobian
from drake_diff.engines.euler import rotation, skew
from drake_diff.engines.mjcf import mjcf
from drake_diff.engines.mujoco_contract import (
    KINDS,
    check_known,
    pair_index,
    read_actuation,
    read_effort_limit,
    read_joint,
    read_pairs,
    resting_stiffness,
)
from drake_diff.engines.numpy_engine import DRAKES_STEP, EACH_CALL
from drake_diff.exceptions import InputError, MissingDependencyError, ModelError, SimulationError
from drake_diff.model import Model

try:
    import mujoco
except ImportError as error:
    raise MissingDependencyError("this engine needs MuJoCo: pip install 'drake-diff[engines]'") from error

# What sticks slips beyond 1e-5 m/s or so, and a larger step would leave the mode: good to 1e-9.
DIFFERENCE_STEP = 1e-6
# Where nothing touches: at this step and at twice it, extrapolated, truncation is far below rounding's 1e-11.
FREE_STEP = 3e-5
# What the two may differ by; if a contact is made between them, they differ by 1 and more.
SAME_JACOBIAN = 1e-7


class MujocoEngine:
    """`path` is the user's own MJCF, with joints and actuators of the names that Drake's plant has.

    `mjcf` is the text that was generated or read.
    """

    name = "mujoco"

    def __init__(self, model: Model, *, path: str | Path | None = None):
        self.description = describe(model)
        self.coordinates = self.description.coordinates
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self.version, self.status = str(mujoco.__version__), "ok"
        self.mjcf = self._generated(model.time_step) if path is None else Path(path).read_text()
        self.model = _compile(self.mjcf) if path is None else _read(path)
        flags = mujoco.mjtDisableBit
        check_known(self.model, int(flags.mjDSBL_WARMSTART | flags.mjDSBL_EULERDAMP))
        self.data = mujoco.MjData(self.model)
        self._find_names()

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        self._set(*self._point(x, u))
        mujoco.mj_step(self.model, self.data)
        self._check(x, u)
        return self._state()

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        x, u = self._point(x, u)
        x_next = self.step(x, u)
        self._set(x, u)
        A, B, method = self._native_jacobian()
        into, out = self._tangent_map(x), np.linalg.inv(self._tangent_map(x_next))
        W, N = self.coordinates.motion(x[: self.nq]), self.coordinates.rate(x_next[: self.nq])
        eye = np.eye(self.nv)
        narrow, wide = _diagonal(W, eye), _diagonal(N, eye)
        A, B = wide @ out @ A @ into @ narrow, wide @ out @ B
        return StepJacobian(frozen(A), frozen(B), method)

    def _native_jacobian(self) -> tuple[Array, Array, str]:
        small = self._differences(DIFFERENCE_STEP)
        near, far = self._differences(FREE_STEP), self._differences(2 * FREE_STEP)
        A, B = ((4 * a - b) / 3 for a, b in zip(near, far, strict=True))
        if np.abs(A - small[0]).max() <= SAME_JACOBIAN * max(1.0, float(np.abs(A).max())):
            return A, B, "centred differences (mjd_transitionFD), extrapolated"
        return *small, "centred differences (mjd_transitionFD)"

    def _differences(self, step: float) -> tuple[Array, Array]:
        """A (2 nv, 2 nv) and B (2 nv, nu) in MuJoCo's tangent coordinates and Drake's inputs."""
        n = 2 * self.nv
        A, B = np.zeros((n, n)), np.zeros((n, self.nu))
        mujoco.mjd_transitionFD(self.model, self.data, step, True, A, B, None, None)
        return A, B[:, self.actuator]

    def energy(self, x: ArrayLike) -> float:
        self._set(finite_array("x", x, (self.nq + self.nv,)), np.zeros(self.nu))
        mujoco.mj_forward(self.model, self.data)
        mujoco.mj_energyPos(self.model, self.data)
        mujoco.mj_energyVel(self.model, self.data)
        return float(self.data.energy.sum())

    def contact_depth(self, x: ArrayLike) -> float:
        self._set(finite_array("x", x, (self.nq + self.nv,)), np.zeros(self.nu))
        mujoco.mj_fwdPosition(self.model, self.data)
        return max([0.0, *(-float(self.data.contact[i].dist) for i in range(self.data.ncon))])

    def mass_matrix(self, q: ArrayLike) -> Array:
        q = finite_array("q", q, (self.nq,))
        self._set(np.concatenate([q, np.zeros(self.nv)]), np.zeros(self.nu))
        mujoco.mj_forward(self.model, self.data)
        M = np.zeros((self.nv, self.nv))
        for column, unit in zip(M, np.eye(self.nv), strict=True):  # M is symmetric
            mujoco.mj_mulM(self.model, self.data, column, unit)
        Q = self._turn(q)
        return np.asarray(Q.T @ M @ Q)

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        q, v = finite_array("q", q, (self.nq,)), finite_array("v", v, (self.nv,))
        self._set(np.concatenate([q, v]), np.zeros(self.nu))
        mujoco.mj_forward(self.model, self.data)
        return np.asarray(self._turn(q).T @ (self.data.qfrc_bias - self.data.qfrc_spring))

    @property
    def contract(self) -> EngineContract:
        self._set(np.concatenate([self._zero(), np.zeros(self.nv)]), np.zeros(self.nu))
        mujoco.mj_forward(self.model, self.data)
        joints = tuple(read_joint(self.model, self.data, j) for j in self.joints)
        cone = mujoco.mjtCone(self.model.opt.cone).name.removeprefix("mjCONE_").lower()
        left_out = [pair.names for pair in self.description.pairs if pair_index(self.model, pair.names) < 0]
        return EngineContract(
            engine=self.name,
            joints=joints,
            native_order=tuple(self.model.joint(j).name for j in range(self.model.njnt)),
            state="quaternion w x y z after the position; velocity of a free body linear in world, angular in the body",
            inputs=tuple(self.model.actuator(i).name for i in self.actuator),
            actuation=read_actuation(self.model, self.dofs, self.actuator),
            effort_limits=tuple(read_effort_limit(self.model, i) for i in self.actuator),
            time_step=float(self.model.opt.timestep),
            integrator=self._integrator(),
            gravity=tuple(float(g) for g in self.model.opt.gravity),
            contact_law=f"soft constraint, {cone} cone, impratio {self.model.opt.impratio:g}"
            if self._touches()
            else "none",
            contacts=read_pairs(self.model, self.description.pairs),
            solver_tolerance=float(self.model.opt.tolerance),
            limit_law="soft constraint of the step's solver",
            reset=EACH_CALL,  # by mj_resetData, which takes the warm start too
            reasons={
                "integrator": "MuJoCo turns quaternions by the exponential of h w', Drake by its first term"
                if self.coordinates.free
                else "the MJCF asks for it",
                "contact law": "MuJoCo's contact is a damped constraint on accelerations: the stiffness is Drake's "
                "where it rests, the damping critical whatever Drake's is",
                "contact pairs": f"MuJoCo has no contact pair of {left_out}" if left_out else "",
                "limit law": "MuJoCo's soft limits have their own stiffness and damping",
                "solver tolerance": "each engine's own solver: Newton's here, SAP's in Drake",
            },
        )

    def _integrator(self) -> str:
        kind, names = self.model.opt.integrator, mujoco.mjtIntegrator
        explicit = bool(self.model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP)
        drakes = kind == names.mjINT_IMPLICITFAST or (kind == names.mjINT_EULER and not explicit)
        if drakes and not self.coordinates.free:
            return DRAKES_STEP
        damping = "implicit" if drakes or kind == names.mjINT_IMPLICIT else "explicit"
        name = names(kind).name.removeprefix("mjINT_")
        turn = ", quaternions by the exponential" if self.coordinates.free else ""
        return f"MuJoCo's {name}, joint damping {damping}{turn}"

    def _touches(self) -> bool:
        return bool(self.model.npair or (np.any(self.model.geom_contype) and np.any(self.model.geom_conaffinity)))

    def _zero(self) -> Array:
        q = np.zeros(self.nq)
        for i, _ in self.coordinates.free:
            q[i] = 1.0
        return q

    def _generated(self, time_step: float) -> str:
        """The MJCF whose contacts have Drake's stiffness where they rest: see `mujoco_contract.resting_stiffness`."""
        bare = _compile(mjcf(self.description, time_step))
        solref = {}
        for pair in self.description.pairs:
            i = pair_index(bare, pair.names)
            if i >= 0 and pair.stiffness:
                s = pair.stiffness / resting_stiffness(bare, i)
                solref[pair.names] = (-s, -2 * float(np.sqrt(s)))  # critical, where nothing else holds the pair
        return mjcf(self.description, time_step, solref)

    def _find_names(self) -> None:
        """Drake's joints and actuators in MuJoCo's model, by name."""
        wanted, m = self.description.moving, self.model
        ids = {m.joint(j).name: j for j in range(m.njnt)}
        drives = {m.actuator(i).name: i for i in range(m.nu)}
        for kind, names, known in (
            ("joints", [x.joint for x in wanted], ids),
            ("actuators", list(self.description.inputs), drives),
        ):
            if set(names) != set(known):
                raise InputError(
                    f"{kind} of the MJCF", got=sorted(known), expected=f"those of the plant, {sorted(names)}"
                )
        self.joints = [ids[x.joint] for x in wanted]
        for x, j in zip(wanted, self.joints, strict=True):
            if KINDS[int(m.jnt_type[j])] != x.kind:
                raise InputError(f"joint {x.joint} of the MJCF", got=KINDS[int(m.jnt_type[j])], expected=x.kind)
        self.actuator = [drives[name] for name in self.description.inputs]
        self.positions, self.dofs = np.zeros(self.nq, dtype=int), np.zeros(self.nv, dtype=int)
        for x, j in zip(wanted, self.joints, strict=True):
            at_q, at_v = int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
            if x.kind == "quaternion_floating":
                self.positions[x.q_start : x.q_start + 7] = at_q + np.array([3, 4, 5, 6, 0, 1, 2])
                self.dofs[x.v_start : x.v_start + 6] = at_v + np.array([3, 4, 5, 0, 1, 2])
            else:
                self.positions[x.q_start], self.dofs[x.v_start] = at_q, at_v

    def _turn(self, q: Array) -> Array:
        """Q (nv, nv) with v_native = Q v."""
        Q = np.zeros((self.nv, self.nv))
        Q[self.dofs, np.arange(self.nv)] = 1.0
        for i, j in self.coordinates.free:
            Q[np.ix_(self.dofs[j : j + 3], np.arange(j, j + 3))] = rotation(q[i : i + 4]).T
        return Q

    def _tangent_map(self, x: Array) -> Array:
        """(2 nv, 2 nv) from Drake's (small motion, dv) to MuJoCo's."""
        q, v = x[: self.nq], x[self.nq :]
        T = _diagonal(self._turn(q), self._turn(q))
        for i, j in self.coordinates.free:
            by_turn = rotation(q[i : i + 4]).T @ skew(v[j : j + 3])
            T[np.ix_(self.nv + self.dofs[j : j + 3], np.arange(j, j + 3))] = by_turn
        return T

    def _point(self, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        return finite_array("x", x, (self.nq + self.nv,)), finite_array("u", u, (self.nu,))

    def _set(self, x: Array, u: Array) -> None:
        mujoco.mj_resetData(self.model, self.data)
        q = np.array(x[: self.nq])
        for i, _ in self.coordinates.free:
            q[i : i + 4] /= np.linalg.norm(q[i : i + 4])
        self.data.qpos[self.positions] = q
        self.data.qvel[:] = self._turn(q) @ x[self.nq :]
        self.data.ctrl[self.actuator] = u

    def _state(self) -> Array:
        q = np.array(self.data.qpos[self.positions])
        return np.concatenate([q, self._turn(q).T @ self.data.qvel])

    def _check(self, x: ArrayLike, u: ArrayLike) -> None:
        bad = [w.name for w in mujoco.mjtWarning.__members__.values() if _counts(self.data, w)]
        if bad or not np.all(np.isfinite(self.data.qpos)):
            raise SimulationError(f"MuJoCo cannot take this step: {bad}, from x = {np.asarray(x)}, u = {np.asarray(u)}")
        used = int(np.max(self.data.solver_niter)) if self.data.nefc else 0
        self.status = "ok" if used < self.model.opt.iterations else f"the solver used all of its {used} iterations"


def exponential_gap(x: Array, x_next: Array, h: float, q_start: int = 0, w_start: int = 7) -> Array:
    """(4,) MuJoCo's quaternion after a step less Drake's of the norm 1: exp(h w') against 1 + h w' / 2.

    The one is (cos, sin) of |h w'| / 2 and the other of arctan(|h w'| / 2), about |h w'|^3 / 24 less.
    """
    q, turn = x[q_start : q_start + 4], h * x_next[w_start : w_start + 3] / 2
    angle = float(np.linalg.norm(turn))
    axis = turn / angle if angle else turn
    difference = np.array(
        [np.cos(angle) - np.cos(np.arctan(angle)), *(np.sin(angle) - np.sin(np.arctan(angle))) * axis]
    )
    w, v = difference[0], difference[1:]
    return np.concatenate([[w * q[0] - v @ q[1:]], w * q[1:] + q[0] * v + np.cross(v, q[1:])]) / np.linalg.norm(q)


def _diagonal(a: Array, b: Array) -> Array:
    (m, n), (r, s) = a.shape, b.shape
    return np.block([[a, np.zeros((m, s))], [np.zeros((r, n)), b]])


def _counts(data: Any, warning: Any) -> bool:
    return (
        warning.name in ("mjWARN_BADQPOS", "mjWARN_BADQVEL", "mjWARN_BADQACC") and data.warning[int(warning)].number > 0
    )


def _compile(text: str) -> Any:
    try:
        return mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise ModelError(f"MuJoCo cannot take this model: {error}") from error


def _read(path: str | Path) -> Any:
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise ModelError(f"MuJoCo cannot read {path}: {error}") from error
