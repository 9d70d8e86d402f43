"""Read the contract out of a compiled MuJoCo model (`m`: MjModel, `d`: MjData), whoever wrote its MJCF."""

from typing import Any

import numpy as np

from drake_diff.arrays import Array
from drake_diff.engines.description import joint_contract
from drake_diff.engines.engine import JointContract, PairContract
from drake_diff.engines.mjcf import UNLIMITED
from drake_diff.exceptions import ModelError

KINDS = {0: "quaternion_floating", 1: "ball", 2: "prismatic", 3: "revolute"}  # mjtJoint
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
    if any(found.values()):
        raise ModelError(f"the MJCF has {', '.join(name for name, there in found.items() if there)}, and Drake has not")


def read_joint(m: Any, d: Any, j: int) -> JointContract:
    """Joint `j` and what it carries, where `d` is at Drake's q = 0."""
    kind, dof, body = KINDS[int(m.jnt_type[j])], int(m.jnt_dofadr[j]), int(m.jnt_bodyid[j])
    last = j == int(m.body_jntadr[body]) + int(m.body_jntnum[body]) - 1  # only it carries the body
    carried = [_part(m, d, b) for b in range(1, m.nbody) if last and int(m.body_weldid[b]) == body]
    single, limited = kind in ("revolute", "prismatic"), bool(m.jnt_limited[j])
    lower, upper = (float(side) if limited else np.inf for side in m.jnt_range[j])
    return joint_contract(
        name=m.joint(j).name,
        kind=kind,
        axis=np.array(d.xaxis[j]) if single else np.zeros(3),
        anchor=np.array(d.xanchor[j]),
        carried=carried,
        damping=float(np.ravel(m.dof_damping[dof])[0]),
        armature=float(m.dof_armature[dof]),
        stiffness=float(np.ravel(m.jnt_stiffness[j])[0]) if single else 0.0,
        rest=float(m.qpos_spring[m.jnt_qposadr[j]]) if single else 0.0,
        lower=lower if limited and lower > -UNLIMITED else -np.inf,
        upper=upper if limited and upper < UNLIMITED else np.inf,
    )


def _part(m: Any, d: Any, body: int) -> tuple[float, Array, Array]:
    R = np.array(d.ximat[body]).reshape(3, 3)
    return float(m.body_mass[body]), np.array(d.xipos[body]), R @ np.diag(m.body_inertia[body]) @ R.T


def read_actuation(m: Any, dofs: Array, actuators: list[int]) -> tuple[tuple[float, ...], ...]:
    """B (nv, nu) in Drake's order; ModelError for an actuator that does not drive one joint by a motor's law."""
    B = np.zeros((len(dofs), len(actuators)))
    for column, i in enumerate(actuators):
        if int(m.actuator_trntype[i]) != JOINT_TRANSMISSION or np.any(m.actuator_biasprm[i]):
            raise ModelError(f"actuator {m.actuator(i).name} of the MJCF is no motor on a joint")
        row = int(np.flatnonzero(dofs == m.jnt_dofadr[m.actuator_trnid[i][0]])[0])
        B[row, column] = m.actuator_gainprm[i][0] * m.actuator_gear[i][0]
    return tuple(tuple(float(b) for b in row) for row in B)


def read_effort_limit(m: Any, i: int) -> float:
    """Of the input, whichever of MuJoCo's limits of control and force is reached first."""
    by_force = float(m.actuator_forcerange[i][1]) if m.actuator_forcelimited[i] else np.inf
    by_control = float(m.actuator_ctrlrange[i][1]) if m.actuator_ctrllimited[i] else np.inf
    return min(by_force / abs(float(m.actuator_gainprm[i][0])), by_control)


def pair_index(m: Any, names: tuple[str, str]) -> int:
    """Which of the model's contact pairs these two geometries are; -1 where they are none."""
    for i in range(m.npair):
        if {m.geom(int(g)).name for g in (m.pair_geom1[i], m.pair_geom2[i])} == set(names):
            return i
    return -1


def resting_stiffness(m: Any, i: int) -> float:
    """[N/m] per unit of a pair's direct solref stiffness S.

    At rest MuJoCo's f = S x / ((1 - d) / m_i), with d the impedance and 1 / m_i the sum of the bodies' inverse weights.
    """
    bodies = [int(m.geom_bodyid[g]) for g in (m.pair_geom1[i], m.pair_geom2[i])]
    inverse_mass = sum(float(m.body_invweight0[b][0]) for b in bodies)
    return 1 / ((1 - float(m.pair_solimp[i][1])) * inverse_mass)


def read_pairs(m: Any, wanted: tuple[PairContract, ...]) -> tuple[PairContract, ...]:
    """Those of Drake's pairs that the model has, with MuJoCo's friction and the stiffness where they rest."""
    found = []
    for pair in wanted:
        i = pair_index(m, pair.names)
        if i >= 0:
            s = -float(m.pair_solref[i][0])
            stiffness = s * resting_stiffness(m, i) if s > 0 else None
            found.append(PairContract(pair.names, float(m.pair_friction[i][0]), stiffness))
    return tuple(found)
