"""Read the contract out of a compiled MuJoCo model, whoever wrote its MJCF.

`m` is an MjModel or an mjx.Model of NumPy arrays, `d` the MjData or mjx.Data.
"""

from typing import Any

import numpy as np

from drake_diff.engines.interface import DRAKES_STEP, EngineContract, float_rows, floats, limit
from drake_diff.engines.mujoco.coordinates import KINDS, MujocoCoordinates, name_of
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.description import Description, JointContract, PairContract, joint_contract

CONES = {0: "pyramidal", 1: "elliptic"}  # mjtCone
INTEGRATORS = {0: "EULER", 1: "RK4", 2: "IMPLICIT", 3: "IMPLICITFAST"}  # mjtIntegrator
NO_EULERDAMP = 1 << 15  # mjDSBL_EULERDAMP
JOINT_TRANSMISSION = 0  # mjtTrn


def check_known(m: Any, flags: int) -> None:
    """Refuse, naming it, what the contract has no line for; `flags` are the disable flags that it may have."""
    found = {
        "activation states": m.na,
        "equality constraints": m.neq,
        "tendons": m.ntendon,
        "friction loss": np.any(m.dof_frictionloss),
        "gravity compensation": np.any(m.body_gravcomp),
        "a fluid": m.opt.density or m.opt.viscosity or np.any(m.opt.wind),
        "limits of joint forces": np.any(m.jnt_actfrclimited),
        "disabled parts of the physics": int(m.opt.disableflags) & ~flags,
    }
    named = ", ".join(name for name, there in found.items() if there)
    if named:
        raise ModelError(f"the MJCF has {named}, which Drake's plant does not have")


def read_contract(m: Any, d: Any, native: MujocoCoordinates, description: Description, **own: Any) -> EngineContract:
    """What `m` has, where `d` is at Drake's q = 0; `own` are the fields and `reasons` that MuJoCo and MJX differ in."""
    left_out, pairs, limits, B = [], [], [], np.zeros((len(native.dofs), len(native.actuator)))
    for pair in description.pairs:
        i = pair_index(m, pair.names)
        if i < 0:
            left_out.append(pair.names)
        else:
            s = -float(m.pair_solref[i][0])
            stiffness = s * resting_stiffness(m, i) if s > 0 else None
            pairs.append(PairContract(pair.names, float(m.pair_friction[i][0]), stiffness))
    for column, i in enumerate(native.actuator):
        if int(m.actuator_trntype[i]) != JOINT_TRANSMISSION or np.any(m.actuator_biasprm[i]):
            raise ModelError(f"actuator {name_of(m, m.name_actuatoradr[i])} of the MJCF is not a motor on a joint")
        row = int(np.flatnonzero(native.dofs == m.jnt_dofadr[m.actuator_trnid[i][0]])[0])
        B[row, column] = m.actuator_gainprm[i][0] * m.actuator_gear[i][0]
        # Of MuJoCo's limits of control and force that which is reached first.
        by_force = float(m.actuator_forcerange[i][1]) if m.actuator_forcelimited[i] else np.inf
        by_control = float(m.actuator_ctrlrange[i][1]) if m.actuator_ctrllimited[i] else np.inf
        limits.append(min(by_force / abs(float(m.actuator_gainprm[i][0])), by_control))
    law = f"soft constraint, {CONES[int(m.opt.cone)]} cone, impratio {float(m.opt.impratio):g}"
    free, who = native.coordinates.free, own.pop("who")
    name, explicit = INTEGRATORS[int(m.opt.integrator)], bool(int(m.opt.disableflags) & NO_EULERDAMP)
    drakes = name == "IMPLICITFAST" or (name == "EULER" and not explicit)
    damping = "implicit" if drakes or name == "IMPLICIT" else "explicit"
    euler = f"MuJoCo's {name}, joint damping {damping}{', quaternions by the exponential' if free else ''}"
    reasons = {
        "integrator": f"{who} turns quaternions by the exponential of h w', Drake by its first term"
        if free
        else "the MJCF asks for it",
        "contact law": f"{who}'s contact is a damped constraint on accelerations: the stiffness is Drake's "
        "where it rests, the damping critical whatever Drake's is",
        "contact pairs": f"{who} has no contact of the pairs {left_out}" if left_out else "",
        "limit law": f"{who}'s soft limits have their own stiffness and damping",
        "solver tolerance": "each engine has its own solver: Newton's method here, SAP in Drake",
    }
    return EngineContract(
        joints=tuple(_read_joint(m, d, j) for j in native.joints),
        native_order=tuple(name_of(m, m.name_jntadr[j]) for j in range(m.njnt)),
        state="quaternion w x y z after the position; velocity of a free body linear in world, angular in the body",
        inputs=tuple(name_of(m, m.name_actuatoradr[i]) for i in native.actuator),
        actuation=float_rows(B), effort_limits=tuple(limits),
        time_step=float(m.opt.timestep), integrator=DRAKES_STEP if drakes and not free else euler,
        gravity=floats(m.opt.gravity), contact_law=law if touches(m) else "none", contacts=tuple(pairs),
        solver_tolerance=float(m.opt.tolerance), limit_law="soft constraint of the step's solver", reasons=reasons,
        **own,
    )  # fmt: skip


def touches(m: Any) -> bool:
    """Whether any two geometries may."""
    return bool(m.npair or (np.any(m.geom_contype) and np.any(m.geom_conaffinity)))


def _read_joint(m: Any, d: Any, j: int) -> JointContract:
    """Joint `j` and what it carries, where `d` is at Drake's q = 0."""
    kind, dof, body = KINDS[int(m.jnt_type[j])], int(m.jnt_dofadr[j]), int(m.jnt_bodyid[j])
    last = j == int(m.body_jntadr[body]) + int(m.body_jntnum[body]) - 1  # only it carries the body
    carried = []
    for b in (b for b in range(1, m.nbody) if last and int(m.body_weldid[b]) == body):
        R = np.array(d.ximat[b]).reshape(3, 3)
        carried.append((float(m.body_mass[b]), np.array(d.xipos[b]), R @ np.diag(m.body_inertia[b]) @ R.T))
    single = kind in ("revolute", "prismatic")
    lower, upper = (limit(side) for side in m.jnt_range[j]) if m.jnt_limited[j] else (-np.inf, np.inf)
    return joint_contract(
        name=name_of(m, m.name_jntadr[j]), kind=kind, axis=np.array(d.xaxis[j]) if single else np.zeros(3),
        anchor=np.array(d.xanchor[j]), carried=carried, damping=float(np.ravel(m.dof_damping[dof])[0]),
        armature=float(m.dof_armature[dof]), stiffness=float(np.ravel(m.jnt_stiffness[j])[0]) if single else 0.0,
        rest=float(m.qpos_spring[m.jnt_qposadr[j]]) if single else 0.0, lower=lower, upper=upper,
    )  # fmt: skip


def pair_index(m: Any, names: tuple[str, str]) -> int:
    """Which of the model's contact pairs these two geometries are; -1 where they are none."""
    for i in range(m.npair):
        if {name_of(m, m.name_geomadr[g]) for g in (m.pair_geom1[i], m.pair_geom2[i])} == set(names):
            return i
    return -1


def resting_stiffness(m: Any, i: int) -> float:
    """[N/m] per unit of a pair's direct solref stiffness S.

    At rest MuJoCo's f = S x / ((1 - d) / m_i), with d the impedance and 1 / m_i the sum of the bodies' inverse weights.
    """
    bodies = [int(m.geom_bodyid[g]) for g in (m.pair_geom1[i], m.pair_geom2[i])]
    inverse_mass = sum(float(m.body_invweight0[b][0]) for b in bodies)
    return 1 / ((1 - float(m.pair_solimp[i][1])) * inverse_mass)
