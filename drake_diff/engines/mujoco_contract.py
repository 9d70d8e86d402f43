"""Read the contract of a compiled MuJoCo model from any MJCF, and map its coordinates to Drake's, without MuJoCo.

`m` is an MjModel or an mjx.Model of NumPy arrays, `d` the MjData or mjx.Data. A free body's native velocity is (v in
world, w in the body), v_native = Q v with Q = [[0, 1], [R', 0]].

MuJoCo's contact has the force f for which the overlap r accelerates by r'' = -B r' - K d r + R f, where d is the
impedance and R = (1 - d) / d / m, with 1 / m the sum of the bodies' inverse weights. Without acceleration, this is

    f = k (r + tau r'),   k = K d^2 m / (1 - d),   tau = B / (K d)

For constant d, a weight rests at the depth m g / k, as on the spring of Drake's point contact. With solref = (-S, -D),
K is S / d^2 and B is D / d. The motion r'' = -B d r' - K d^2 r is critically damped if B is 2 sqrt(K).
"""

from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from drake_diff._base.arrays import Array, skew
from drake_diff.engines.interface import (
    DRAKES_STEP,
    EngineContract,
    float_rows,
    floats,
    geometry_contract,
    limit,
    shape_of,
)
from drake_diff.exceptions import InputError, ModelError
from drake_diff.mechanics.coordinates import rotation, unit
from drake_diff.mechanics.description import (
    Description,
    Follower,
    GeometryContract,
    JointContract,
    PairContract,
    joint_contract,
)

KINDS = {0: "quaternion_floating", 1: "ball", 2: "prismatic", 3: "revolute"}  # mjtJoint


class MujocoCoordinates:
    """Drake's joints and actuators in `m` (MjModel or mjx.Model). Raises InputError if the names do not match."""

    def __init__(self, description: Description, m: Any):
        self.coordinates = description.coordinates
        self.nq, self.nv = self.coordinates.nq, self.coordinates.nv
        wanted = description.moving
        ids = {name_of(m, m.name_jntadr[j]): j for j in range(m.njnt)}
        drives = {name_of(m, m.name_actuatoradr[i]): i for i in range(m.nu)}
        sides = (("joints", [x.joint for x in wanted], ids), ("actuators", list(description.inputs), drives))
        for kind, names, known in sides:
            if set(names) != set(known):
                expected = f"those of the plant, {sorted(names)}"
                raise InputError(f"{kind} of the MJCF", got=sorted(known), expected=expected)
        self.joints = [ids[x.joint] for x in wanted]
        self.actuator = [drives[name] for name in description.inputs]
        self.positions, self.dofs = np.zeros(self.nq, dtype=int), np.zeros(self.nv, dtype=int)
        for x, j in zip(wanted, self.joints, strict=True):
            if KINDS[int(m.jnt_type[j])] != x.kind:
                raise InputError(f"joint {x.joint} of the MJCF", got=KINDS[int(m.jnt_type[j])], expected=x.kind)
            at_q, at_v = int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
            if x.kind == "quaternion_floating":
                self.positions[x.q_start : x.q_start + 7] = at_q + np.array([3, 4, 5, 6, 0, 1, 2])
                self.dofs[x.v_start : x.v_start + 6] = at_v + np.array([3, 4, 5, 0, 1, 2])
            else:
                self.positions[x.q_start], self.dofs[x.v_start] = at_q, at_v

    def to_native(self, x: Array) -> tuple[Array, Array]:
        """Return qpos (nq,), with quaternions of norm 1, and qvel (nv,)."""
        q = unit(self.coordinates, x[: self.nq])
        qpos = np.empty(self.nq)
        qpos[self.positions] = q
        return qpos, self.turn(q) @ x[self.nq :]

    def to_drake(self, qpos: Array, qvel: Array) -> Array:
        """Return Drake's state x (nx,)."""
        q = np.array(qpos[self.positions])
        return np.concatenate([q, self.turn(q).T @ qvel])

    def control(self, u: Array) -> Array:
        """Return ctrl (nu,)."""
        ctrl = np.empty(len(self.actuator))
        ctrl[self.actuator] = u
        return ctrl

    def turn(self, q: Array) -> Array:
        """Return Q (nv, nv) with v_native = Q v."""
        Q = np.zeros((self.nv, self.nv))
        Q[self.dofs, np.arange(self.nv)] = 1.0
        for i, j in self.coordinates.free:
            Q[np.ix_(self.dofs[j : j + 3], np.arange(j, j + 3))] = rotation(q[i : i + 4]).T
        return Q

    def jacobian(self, x: Array, x_next: Array, A: Array, B: Array) -> tuple[Array, Array]:
        """Return Drake's A (nx, nx) and B (nx, nu), from A (2 nv, 2 nv) and B (2 nv, nu) in MuJoCo's tangent space."""
        into, out = self._tangent_map(x), np.linalg.inv(self._tangent_map(x_next))
        W, N = self.coordinates.motion(x[: self.nq]), self.coordinates.rate(x_next[: self.nq])
        eye = np.eye(self.nv)
        narrow, wide = block_diag(W, eye), block_diag(N, eye)
        return wide @ out @ A @ into @ narrow, wide @ out @ B[:, self.actuator]

    def on_tangent(self, x: Array, x_next: Array, by_native: Array) -> tuple[Array, Array]:
        """Return A and B for `jacobian`, from derivatives (nq + nv, nq + nv + nu) with respect to qpos, qvel, ctrl."""
        n, eye = self.nq + self.nv, np.eye(self.nv)
        q, q_next = (unit(self.coordinates, state[: self.nq]) for state in (x, x_next))
        move, see = np.zeros((self.nq, self.nv)), np.zeros((self.nv, self.nq))
        move[self.positions] = self.coordinates.rate(q) @ self.turn(q).T
        see[:, self.positions] = self.turn(q_next) @ self.coordinates.motion(q_next)
        narrowed = block_diag(see, eye) @ by_native
        return narrowed[:, :n] @ block_diag(move, eye), narrowed[:, n:]

    def _tangent_map(self, x: Array) -> Array:
        """Return the matrix (2 nv, 2 nv) from Drake's (small motion, dv) to MuJoCo's."""
        q, v = x[: self.nq], x[self.nq :]
        T = block_diag(self.turn(q), self.turn(q))
        for i, j in self.coordinates.free:
            by_turn = rotation(q[i : i + 4]).T @ skew(v[j : j + 3])
            T[np.ix_(self.nv + self.dofs[j : j + 3], np.arange(j, j + 3))] = by_turn
        return T


def name_of(m: Any, address: Any) -> str:
    """Return the name at this address of the model's text."""
    start = int(address)
    return str(m.names[start : m.names.index(b"\0", start)].decode())


PLANE, PYRAMIDAL = 0, 0  # mjtGeom, mjtCone
SHAPES = {PLANE: "HalfSpace", 2: "Sphere", 3: "Capsule", 4: "Ellipsoid", 5: "Cylinder", 6: "Box"}
FILTERPARENT, REFSAFE = 1 << 9, 1 << 11  # mjtDisableBit
SMALL = 1e-15  # mjMINVAL
Given = tuple[int, Array, Array, Array, Array, Array]


def geometry_name(m: Any, g: int) -> str:
    """Return the name of the geom, or a name from its number and its body if it has none."""
    given = name_of(m, m.name_geomadr[g])
    return given or f"geom {g} of {name_of(m, m.name_bodyadr[int(m.geom_bodyid[g])])}"


def read_geometries(m: Any, d: Any) -> tuple[GeometryContract, ...]:
    """Return all geoms, with `d` at Drake's q = 0. A mesh or height field has no sizes."""
    geometries = []
    for g in range(m.ngeom):
        body = int(m.body_weldid[int(m.geom_bodyid[g])])
        last = int(m.body_jntadr[body]) + int(m.body_jntnum[body]) - 1
        carrier = "world" if body == 0 else name_of(m, m.name_jntadr[last])
        kind = SHAPES.get(int(m.geom_type[g]), "Mesh")
        position = np.array(d.geom_xpos[g], dtype=float), np.array(d.geom_xmat[g], dtype=float).reshape(3, 3)
        size = [float(s) for s in m.geom_size[g]]
        sizes = {
            "HalfSpace": [], "Mesh": [], "Sphere": size[:1], "Ellipsoid": size, "Box": [2 * s for s in size],
        }.get(kind, [size[0], 2 * size[1]])  # fmt: skip
        geometries.append(geometry_contract(geometry_name(m, g), carrier, kind, sizes, *position))
    return tuple(geometries)


def read_pairs(m: Any) -> tuple[PairContract, ...]:
    """Return all pairs of geoms that may collide: explicit pairs, then the pairs that pass MuJoCo's filters."""
    listed = {frozenset(map(int, pair)): i for i, pair in enumerate(zip(m.pair_geom1, m.pair_geom2, strict=True))}
    return (
        *(_contract(m, (int(m.pair_geom1[i]), int(m.pair_geom2[i])), *_of_pair(m, i)) for i in listed.values()),
        *(_contract(m, both, *_of_geoms(m, *both)) for both in _unfiltered(m) if frozenset(both) not in listed),
    )


def _unfiltered(m: Any) -> Iterator[tuple[int, int]]:
    excluded = {int(signature) for signature in m.exclude_signature}
    weld = [int(w) for w in m.body_weldid]
    parent = [weld[int(m.body_parentid[w])] for w in weld]
    related = not int(m.opt.disableflags) & FILTERPARENT
    for a in range(m.ngeom):
        for b in range(a + 1, m.ngeom):
            bits = int(m.geom_contype[a]) & int(m.geom_conaffinity[b])
            bits |= int(m.geom_contype[b]) & int(m.geom_conaffinity[a])
            i, j = sorted((int(m.geom_bodyid[a]), int(m.geom_bodyid[b])))
            one_family = related and weld[i] and weld[j] and (weld[i] == parent[j] or weld[j] == parent[i])
            both_flat = int(m.geom_type[a]) == int(m.geom_type[b]) == PLANE
            if bits and weld[i] != weld[j] and not one_family and not both_flat and (i << 16) + j not in excluded:
                yield a, b


def _of_pair(m: Any, i: int) -> Given:
    """Return the contact's dimension, friction (5,), solref (2,), solreffriction (2,), solimp (5,), (margin, gap)."""
    numbers = (np.array(getattr(m, f"pair_{name}")[i]) for name in ("friction", "solref", "solreffriction", "solimp"))
    friction, solref, of_friction, solimp = numbers
    return int(m.pair_dim[i]), friction, solref, of_friction, solimp, np.array([m.pair_margin[i], m.pair_gap[i]])


def _of_geoms(m: Any, a: int, b: int) -> Given:
    """Return the values of `_of_pair` by MuJoCo's rules for two geoms."""
    apart = np.array([max(numbers[a], numbers[b]) for numbers in (m.geom_margin, m.geom_gap)])
    none, rank = np.zeros(2), int(m.geom_priority[a]) - int(m.geom_priority[b])
    if rank:
        g = a if rank > 0 else b
        friction = np.array(m.geom_friction[g])[[0, 0, 1, 2, 2]]
        return int(m.geom_condim[g]), friction, np.array(m.geom_solref[g]), none, np.array(m.geom_solimp[g]), apart
    weights = [0.0 if weight < SMALL else float(weight) for weight in (m.geom_solmix[a], m.geom_solmix[b])]
    share = weights[0] / sum(weights) if any(weights) else 0.5
    solref_a, solref_b = np.array(m.geom_solref[a]), np.array(m.geom_solref[b])
    mixed = share * solref_a + (1 - share) * solref_b
    solref = mixed if min(solref_a[0], solref_b[0]) > 0 else np.minimum(solref_a, solref_b)
    solimp = share * np.array(m.geom_solimp[a]) + (1 - share) * np.array(m.geom_solimp[b])
    friction = np.maximum(m.geom_friction[a], m.geom_friction[b])[[0, 0, 1, 2, 2]]
    return max(int(m.geom_condim[a]), int(m.geom_condim[b])), friction, solref, none, solimp, apart


def _contract(
    m: Any, both: tuple[int, int], dim: int, friction: Array, solref: Array, of_friction: Array, solimp: Array,
    apart: Array,
) -> PairContract:  # fmt: skip
    more = {"friction across": float(friction[1]) if friction[1] != friction[0] else 0.0} if dim > 1 else {}
    more |= {"torsional friction [m]": float(friction[2])} if dim > 3 else {}
    more |= {"rolling friction [m]": float(max(friction[3:]))} if dim > 4 else {}
    more |= {"solreffriction": float(np.abs(of_friction).max()), "gap [m]": float(apart[1])}
    least, most = (float(d) for d in np.clip(solimp[:2], 1e-4, 0.9999))
    K, B = _reference(m, solref, solimp)
    if solimp[2] <= SMALL:  # without width, MuJoCo uses the mean of the two
        least = most = (least + most) / 2
    stiffness = _stiffness(m, both, dim, friction, K, least)
    if least != most:
        more["stiffness beyond the width of solimp [N/m]"] = _stiffness(m, both, dim, friction, K, most)
    return PairContract(
        names=(geometry_name(m, both[0]), geometry_name(m, both[1])),
        friction=float(friction[0]) if dim > 1 else 0.0,
        stiffness=stiffness,
        relaxation_time=B / (K * least) if K else None,
        critical_time=2 / (float(np.sqrt(K)) * least) if K else None,
        margin=float(apart[0]),
        more=tuple((name, value) for name, value in more.items() if value),
    )


def _reference(m: Any, solref: Array, solimp: Array) -> tuple[float, float]:
    """Return K and B from solref, which is (-stiffness, -damping) or (time constant, damping ratio)."""
    d = float(np.clip(solimp[1], 1e-4, 0.9999))
    if solref[0] <= 0:
        return -float(solref[0]) / d**2, -float(solref[1]) / d
    shortest = 0.0 if int(m.opt.disableflags) & REFSAFE else 2 * float(m.opt.timestep)
    time, ratio = max(float(solref[0]), shortest), float(solref[1])
    return 1 / (d * time * ratio) ** 2, 2 / (d * time)


def _stiffness(m: Any, both: tuple[int, int], dim: int, friction: Array, K: float, d: float) -> float:
    """Return the stiffness [N/m] of a contact at rest, at the impedance `d`. A pyramid's edges share the force."""
    bodies = [int(m.geom_bodyid[g]) for g in both]
    inverse_mass = sum(float(m.body_invweight0[b][0]) for b in bodies)
    stiffness = K * d**2 / ((1 - d) * inverse_mass) if inverse_mass else np.inf
    if dim == 1 or int(m.opt.cone) != PYRAMIDAL:
        return float(stiffness)
    mu = float(friction[0])
    return float(stiffness * (dim - 1) * float(m.opt.impratio) / (mu**2 * (1 + mu**2)))


CONES = {PYRAMIDAL: "pyramidal", 1: "elliptic"}  # mjtCone
INTEGRATORS = {0: "EULER", 2: "IMPLICIT", 3: "IMPLICITFAST"}  # mjtIntegrator; MuJoCo cannot differentiate others
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
# Flags without effect on a step, or reported by the contract.
HARMLESS = ("warmstart", "eulerdamp", "filterparent", "refsafe", "sensor", "midphase", "autoreset", "island")
ENABLED = ("override", "energy", "fwdinv", "invdiscrete")  # mjtEnableBit; later flags are named by their bits
HARMLESS_ENABLED = ("energy", "fwdinv", "invdiscrete")
# Features for which an array of the model is not zero, by array. Older versions of MuJoCo lack some arrays.
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
    "nmocap": "mocap bodies", "nplugin": "plugins",
}  # fmt: skip


def check_known(m: Any) -> None:
    """Raise ModelError with the names of features that the contract does not cover."""
    number = int(m.opt.integrator)
    if number not in INTEGRATORS:
        expected = f"one of {', '.join(INTEGRATORS.values())}, whose steps MuJoCo differentiates"
        raise ModelError(f"integrator of the MJCF: expected {expected}, got {OTHERS.get(number, number)}")
    unknown = [description for name, description in COUNTED.items() if getattr(m, name, 0)]
    unknown += [description for name, description in UNKNOWN.items() if np.any(getattr(m, name, 0))]
    if m.opt.density or m.opt.viscosity or np.any(m.opt.wind):
        unknown.append("a fluid")
    if getattr(m.opt, "disableactuator", 0):
        unknown.append("disabled groups of actuators")
    off = _named_bits(int(m.opt.disableflags), DISABLED, HARMLESS)
    on = _named_bits(int(getattr(m.opt, "enableflags", 0)), ENABLED, HARMLESS_ENABLED)
    unknown += [f"disabled parts of the physics ({', '.join(off)})"] if off else []
    unknown += [f"enabled options ({', '.join(on)})"] if on else []
    if unknown:
        raise ModelError(f"the MJCF has {', '.join(dict.fromkeys(unknown))}, which Drake's plant does not have")


def _named_bits(flags: int, names: tuple[str, ...], harmless: tuple[str, ...]) -> list[str]:
    bits = [i for i in range(flags.bit_length()) if flags >> i & 1]
    return [name for name in (names[i] if i < len(names) else f"bit {i}" for i in bits) if name not in harmless]


def read_contract(m: Any, d: Any, native: MujocoCoordinates, description: Description, **fields: Any) -> EngineContract:
    """Read the contract of `m`, with `d` at Drake's q = 0. `fields` are those in which MuJoCo and MJX differ."""
    limits, B = [], np.zeros((len(native.dofs), len(native.actuator)))
    pairs, geometries = read_pairs(m), read_geometries(m, d)
    there, not_given = {g.name for g in geometries}, {g.name for g in description.geometries if not shape_of(g)[1]}
    left_out = [p.names for p in description.pairs if not there.issuperset(p.names) and not_given & set(p.names)]
    for column, i in enumerate(native.actuator):
        name = name_of(m, m.name_actuatoradr[i])
        if int(m.actuator_trntype[i]) != JOINT_TRANSMISSION:
            raise ModelError(f"actuator {name} of the MJCF: expected a motor on a joint, got another transmission")
        row = int(np.flatnonzero(native.dofs == m.jnt_dofadr[m.actuator_trnid[i][0]])[0])
        B[row, column] = m.actuator_gainprm[i][0] * m.actuator_gear[i][0]
        # The tighter of MuJoCo's limits on control and force.
        sides = [np.sort(m.actuator_forcerange[i] / m.actuator_gainprm[i][0])] if m.actuator_forcelimited[i] else []
        sides += [m.actuator_ctrlrange[i]] if m.actuator_ctrllimited[i] else []
        limits.append(max(abs(max(s[0] for s in sides)), abs(min(s[1] for s in sides))) if sides else np.inf)
    law = f"soft constraint, {CONES[int(m.opt.cone)]} cone, impratio {float(m.opt.impratio):g}"
    law += f", {slips} noslip iterations" if (slips := int(getattr(m.opt, "noslip_iterations", 0))) else ""
    free, who = native.coordinates.free, fields.pop("who")
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
        gravity=floats(m.opt.gravity), contact_law=law if pairs else "none", geometries=geometries,
        contacts=pairs,
        solver_tolerance=float(m.opt.tolerance), limit_law="soft constraint of the step's solver", reasons=reasons,
        **fields,
    )  # fmt: skip


def read_followers(m: Any) -> tuple[Follower, ...]:
    """Return the joints that follow others. Raises ModelError for other kinds of equalities."""
    followers = []
    for k in range(m.neq):
        joint, leader, coefficients = int(m.eq_obj1id[k]), int(m.eq_obj2id[k]), [float(x) for x in m.eq_data[k][:5]]
        if int(m.eq_type[k]) != JOINT_EQUALITY or leader < 0 or not m.eq_active0[k] or any(coefficients[2:]):
            raise ModelError(f"equality {k} of the MJCF: expected a joint that follows another linearly")
        names = [name_of(m, m.name_jntadr[j]) for j in (joint, leader)]
        start, leader_start = (float(m.qpos0[m.jnt_qposadr[j]]) for j in (joint, leader))
        offset = start + coefficients[0] - coefficients[1] * leader_start
        followers.append(Follower(names[0], names[1], coefficients[1], offset))
    return tuple(followers)


def touches(m: Any) -> bool:
    """Return whether any two geometries may collide."""
    return bool(read_pairs(m))


def _read_joint(m: Any, d: Any, j: int) -> JointContract:
    """Read joint `j` and the bodies that it carries, with `d` at Drake's q = 0."""
    kind, dof, body = KINDS[int(m.jnt_type[j])], int(m.jnt_dofadr[j]), int(m.jnt_bodyid[j])
    last = j == int(m.body_jntadr[body]) + int(m.body_jntnum[body]) - 1  # only the last joint of a body carries it
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
