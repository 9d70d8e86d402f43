"""Read the contract out of a compiled MuJoCo model, whoever wrote its MJCF.

`m` is an MjModel or an mjx.Model of NumPy arrays, `d` the MjData or mjx.Data.
"""

from typing import Any

import numpy as np

from drake_diff.engines.common import shape_of
from drake_diff.engines.interface import DRAKES_STEP, EngineContract, float_rows, floats, limit
from drake_diff.engines.mujoco.contacts import read_geometries, read_pairs
from drake_diff.engines.mujoco.coordinates import KINDS, MujocoCoordinates, name_of
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.description import Description, Follower, JointContract, PairContract, joint_contract

CONES = {0: "pyramidal", 1: "elliptic"}  # mjtCone
INTEGRATORS = {0: "EULER", 2: "IMPLICIT", 3: "IMPLICITFAST"}  # mjtIntegrator; MuJoCo differentiates no step of others
OTHERS = {1: "RK4", 4: "DISCRETE"}
SOLVERS = {0: "PGS", 1: "CG", 2: "Newton's method"}  # mjtSolver
JOINT_TRANSMISSION = 0  # mjtTrn
JOINT_EQUALITY = 2  # mjtEq
DISABLED = (
    "constraint", "equality", "frictionloss", "limit", "contact", "spring", "damper", "gravity", "clampctrl",
    "warmstart", "filterparent", "actuation", "refsafe", "sensor", "midphase", "eulerdamp", "autoreset", "nativeccd",
    "island", "multiccd",
)  # fmt: skip  # mjtDisableBit, in the order of its bits
NO_EULERDAMP = 1 << DISABLED.index("eulerdamp")
# Of no effect on a step, or told of by the contract.
HARMLESS = ("warmstart", "eulerdamp", "filterparent", "refsafe", "sensor", "midphase", "autoreset", "island")
ENABLED = ("override", "energy", "fwdinv", "invdiscrete")  # mjtEnableBit; later ones by their bits
HARMLESS_ENABLED = ("energy", "fwdinv", "invdiscrete")
# By array of the model: what is there where it is not zero. Older MuJoCos do not have all of them.
UNKNOWN = {
    "dof_frictionloss": "friction loss", "dof_dampingpoly": "damping that is not linear",
    "jnt_stiffnesspoly": "springs that are not linear", "jnt_springyield": "springs that yield",
    "body_gravcomp": "gravity compensation", "jnt_actfrclimited": "limits of joint forces",
    "actuator_biasprm": "actuators with a bias", "actuator_damping": "actuators with damping",
    "actuator_dampingpoly": "actuators with damping", "actuator_armature": "actuators with armature",
    "actuator_delay": "actuators with a delay", "actuator_gaintype": "actuators whose gain is not fixed",
    "geom_adhesion": "adhesion", "pair_adhesion": "adhesion", "geom_surfacevel": "moving surfaces",
}  # fmt: skip
COUNTED = {
    "na": "activation states", "neq": "equality constraints", "ntendon": "tendons", "nflex": "flexible bodies",
    "nmocap": "bodies that are moved by hand", "nplugin": "plugins",
}  # fmt: skip


def check_known(m: Any) -> None:
    """Refuse, naming it, what the contract has no line for."""
    number = int(m.opt.integrator)
    if number not in INTEGRATORS:
        expected = f"one of {', '.join(INTEGRATORS.values())}, whose steps MuJoCo differentiates"
        raise ModelError(f"integrator of the MJCF: expected {expected}, got {OTHERS.get(number, number)}")
    found = [said for name, said in COUNTED.items() if getattr(m, name, 0)]
    found += [said for name, said in UNKNOWN.items() if np.any(getattr(m, name, 0))]
    if m.opt.density or m.opt.viscosity or np.any(m.opt.wind):
        found.append("a fluid")
    if getattr(m.opt, "disableactuator", 0):
        found.append("disabled groups of actuators")
    off = _named_bits(int(m.opt.disableflags), DISABLED, HARMLESS)
    on = _named_bits(int(getattr(m.opt, "enableflags", 0)), ENABLED, HARMLESS_ENABLED)
    found += [f"disabled parts of the physics ({', '.join(off)})"] if off else []
    found += [f"enabled options ({', '.join(on)})"] if on else []
    if found:
        raise ModelError(f"the MJCF has {', '.join(dict.fromkeys(found))}, which Drake's plant does not have")


def _named_bits(flags: int, names: tuple[str, ...], harmless: tuple[str, ...]) -> list[str]:
    bits = [i for i in range(flags.bit_length()) if flags >> i & 1]
    return [name for name in (names[i] if i < len(names) else f"bit {i}" for i in bits) if name not in harmless]


def read_contract(m: Any, d: Any, native: MujocoCoordinates, description: Description, **own: Any) -> EngineContract:
    """What `m` has, where `d` is at Drake's q = 0; `own` are the fields and `reasons` that MuJoCo and MJX differ in."""
    limits, B = [], np.zeros((len(native.dofs), len(native.actuator)))
    pairs, geometries = read_pairs(m), read_geometries(m, d)
    there = {g.name for g in geometries}
    left_out = [p.names for p in description.pairs if not there.issuperset(p.names) and _not_given(description, p)]
    for column, i in enumerate(native.actuator):
        name = name_of(m, m.name_actuatoradr[i])
        if int(m.actuator_trntype[i]) != JOINT_TRANSMISSION:
            raise ModelError(f"actuator {name} of the MJCF: expected a motor on a joint, got another transmission")
        row = int(np.flatnonzero(native.dofs == m.jnt_dofadr[m.actuator_trnid[i][0]])[0])
        B[row, column] = m.actuator_gainprm[i][0] * m.actuator_gear[i][0]
        # Of MuJoCo's limits of control and force that which is reached first.
        by_force = _side(name, m.actuator_forcerange[i]) if m.actuator_forcelimited[i] else np.inf
        by_control = _side(name, m.actuator_ctrlrange[i]) if m.actuator_ctrllimited[i] else np.inf
        limits.append(min(by_force / abs(float(m.actuator_gainprm[i][0])), by_control))
    law = f"soft constraint, {CONES[int(m.opt.cone)]} cone, impratio {float(m.opt.impratio):g}"
    law += f", {slips} noslip iterations" if (slips := int(getattr(m.opt, "noslip_iterations", 0))) else ""
    free, who = native.coordinates.free, own.pop("who")
    name, explicit = INTEGRATORS[int(m.opt.integrator)], bool(int(m.opt.disableflags) & NO_EULERDAMP)
    drakes = name == "IMPLICITFAST" or (name == "EULER" and not explicit)
    damping = "implicit" if drakes or name == "IMPLICIT" else "explicit"
    euler = f"MuJoCo's {name}, joint damping {damping}{', quaternions by the exponential' if free else ''}"
    reasons = {
        "integrator": f"{who} turns quaternions by the exponential of h w', Drake by its first term"
        if free
        else "the MJCF asks for it",
        "contact law": f"{who}'s contact is a damped constraint on accelerations, which has Drake's stiffness where it "
        "rests and critical damping",
        "contact pairs": f"{who} is given no geometry of the pairs {left_out}" if left_out else "",
        "limit law": f"{who}'s soft limits have their own stiffness and damping and act from the limit on, Drake's "
        "up to two steps before it",
        "solver tolerance": f"each engine has its own solver: {SOLVERS[int(m.opt.solver)]} here, SAP in Drake",
    }
    return EngineContract(
        joints=tuple(_read_joint(m, d, j) for j in native.joints),
        native_order=tuple(name_of(m, m.name_jntadr[j]) for j in range(m.njnt)),
        state="quaternion w x y z after the position; velocity of a free body linear in world, angular in the body",
        inputs=tuple(name_of(m, m.name_actuatoradr[i]) for i in native.actuator),
        actuation=float_rows(B), effort_limits=tuple(limits),
        time_step=float(m.opt.timestep), integrator=DRAKES_STEP if drakes and not free else euler,
        gravity=floats(m.opt.gravity), contact_law=law if touches(m) else "none", geometries=geometries,
        contacts=pairs,
        solver_tolerance=float(m.opt.tolerance), limit_law="soft constraint of the step's solver", reasons=reasons,
        **own,
    )  # fmt: skip


def _not_given(description: Description, pair: PairContract) -> bool:
    """Whether one of the two is of a shape that MJCF is not written for."""
    return any(not shape_of(g)[1] for g in description.geometries if g.name in pair.names)


def _side(name: str, both: Any) -> float:
    lower, upper = (float(side) for side in both)
    if lower != -upper:
        raise ModelError(f"actuator {name} of the MJCF: expected equal limits up and down, got {lower}, {upper}")
    return upper


def read_followers(m: Any) -> tuple[Follower, ...]:
    """The joints that follow others; ModelError for an equality that is something else."""
    found = []
    for k in range(m.neq):
        joint, leader, coefficients = int(m.eq_obj1id[k]), int(m.eq_obj2id[k]), [float(x) for x in m.eq_data[k][:5]]
        if int(m.eq_type[k]) != JOINT_EQUALITY or leader < 0 or not m.eq_active0[k] or any(coefficients[2:]):
            raise ModelError(f"equality {k} of the MJCF: expected a joint that follows another linearly")
        names = [name_of(m, m.name_jntadr[j]) for j in (joint, leader)]
        start, leader_start = (float(m.qpos0[m.jnt_qposadr[j]]) for j in (joint, leader))
        offset = start + coefficients[0] - coefficients[1] * leader_start
        found.append(Follower(names[0], names[1], coefficients[1], offset))
    return tuple(found)


def touches(m: Any) -> bool:
    """Whether any two geometries may."""
    return bool(read_pairs(m))


def _read_joint(m: Any, d: Any, j: int) -> JointContract:
    """Joint `j` and what it carries, where `d` is at Drake's q = 0."""
    kind, dof, body = KINDS[int(m.jnt_type[j])], int(m.jnt_dofadr[j]), int(m.jnt_bodyid[j])
    last = j == int(m.body_jntadr[body]) + int(m.body_jntnum[body]) - 1  # only it carries the body
    carried = []
    for b in (b for b in range(1, m.nbody) if last and int(m.body_weldid[b]) == body):
        R = np.array(d.ximat[b]).reshape(3, 3)
        carried.append((float(m.body_mass[b]), np.array(d.xipos[b]), R @ np.diag(m.body_inertia[b]) @ R.T))
    single = kind in ("revolute", "prismatic")
    lower, upper = -np.inf, np.inf
    if m.jnt_limited[j]:  # the limit begins to act at its margin
        lower, upper = (limit(side) for side in m.jnt_range[j] + np.array([1, -1]) * m.jnt_margin[j])
    dofs = slice(dof, dof + (1 if single else 6))
    return joint_contract(
        name=name_of(m, m.name_jntadr[j]), kind=kind, axis=np.array(d.xaxis[j]) if single else np.zeros(3),
        anchor=np.array(d.xanchor[j]), carried=carried, damping=float(np.max(m.dof_damping[dofs])),
        armature=float(np.max(m.dof_armature[dofs])),
        stiffness=float(np.ravel(m.jnt_stiffness[j])[0]) if single else 0.0,
        rest=float(m.qpos_spring[m.jnt_qposadr[j]]) if single else 0.0, lower=lower, upper=upper,
    )  # fmt: skip
