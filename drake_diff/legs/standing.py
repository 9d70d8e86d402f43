"""Standing robots: the forces that carry a posture, states at rest, and motions in which no foot moves.

Inverse kinematics computes a posture with the soles on the ground and the centre of mass over them. A small quadratic
program computes forces at the soles and inputs that hold it. From there, Gauss-Newton finds a state that a step of the
model does not change. It is an equilibrium of the steps and not of a formula.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import Refusal, ShowsItsRepr
from drake_diff.derivatives.step import linearize
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.legs.feet import GRAVITY, Legs, find_feet
from drake_diff.legs.inverse_kinematics import PointTarget, Wish, inverse_kinematics, miss
from drake_diff.legs.motion import smooth
from drake_diff.model.contact import contacts_of_the_step
from drake_diff.model.model import Model
from drake_diff.model.plant import frame_named
from drake_diff.model.step import advance, set_state
from drake_diff.motion.policy import TVLQR

# Forces and inputs that hold a posture.
FOOT_SHARE = 0.1  # least load of a foot, as a fraction of an even share of the weight, so that no foot lifts off
OF_FRICTION, OF_EFFORT = 0.7, 0.8  # largest fractions of the available friction and of an effort limit
SIDES = 8  # of the pyramid that approximates a friction cone
SIDEWAYS = 100.0  # cost of a tangential force relative to a normal one, because it lets the foot creep
# A standing posture.
ON_GROUND = 2e-5  # [m] largest distance of soles from the ground
BALANCED, LEVEL, TALL, ASIDE, POSED = 5e-3, 0.03, 0.01, 0.02, 0.5  # [m or rad] deviations that cost 1
BENT = 0.88  # height of the base, as a fraction of its height on straight legs
INSIDE = 0.08  # distance of a posture from joint limits, as a fraction of a joint's range
DEEP = 5e-5  # [m] depth of the feet in the ground
STARTS, SPREAD = 6, 0.5  # random first postures, and their largest distance [rad or m] from the file's posture
ROUNDS = 3  # iterations to find the lowest points of round feet
# Of a joint without limits: the range on each side of 0 [rad], [m]; a wider range counts as unlimited.
ANGLE, LENGTH, WIDEST = 1.0, 0.2, 4 * np.pi
# A state at rest. Units of a rotation, a height, any coordinate, and an input, as a fraction of the weight times 1 m.
TURN, HEIGHT, ANY, EFFORT = 1e-2, 1e-3, 1e-3, 1e-3
ITERATIONS, HALVINGS, FARTHEST = 40, 8, 5e-3  # [rad or m] largest change per iteration
AT_REST = 1e-7  # [rad/s or m/s] largest velocity after a step
# The softness of feet that suits searches. SINK [m/s] times the step is a foot's depth under an even share of the
# weight, and contact relaxes in RELAXES steps. Drake's own dissipation would cut off a foot's force as it lifts off.
SINK, RELAXES, DISSIPATION, NEAR_RIGID = 0.0625, 2.5, 0.5, 0.1  # DISSIPATION is in s/m
FIRST_SINK = 1e-4  # [m] least initial depth, because a sole in the air has no derivative
# A motion to a posture of least cost: shares of the way and fractions of the steps that are tried, the least way
# [rad or m], and relative limits of a way that moves the feet and of a cost's curvature.
SHARES, PARTS, LEAST_WAY, FIXED, FLAT = (1.0, 0.5, 0.25), (0.25, 0.5, 0.9), 1e-4, 1e-6, 1e-6
# A motion from rest to rest.
DURATIONS, HOLDING = (0.6, 1.0, 1.6), 0.3  # [s] of the motion, and of holding its end
SIZES = ((1.0, 1.0), (1.0, 0.2), (0.5, 0.2), (0.25, 0.1), (0.12, 0.0))  # factors on a random shift of base and arms
TURNED, SHIFTED, LOWERED = 0.1, 0.06, 0.12  # of the base: [rad], and fractions of the centre of mass's height
MOVED = 0.1  # fraction of a joint's range, for joints outside the legs
ARRIVED, SLOW_ENOUGH = 0.01, 0.02  # [rad or m] largest distance from the target rest, [rad/s or m/s] largest velocity
FEET_STAY, STILL = 1e-3, 1e-7  # [m] largest distance of a foot from its stance, and between knots (4 mm/s^2)
FIRM = 0.25  # least depth of a foot, as a fraction of its depth at rest; motors would drive a lifted foot down
FREE_BASE, FREE_JOINT, ALONG = 0.1, 0.3, 0.05  # [rad or m] deviations that cost 1; ALONG applies on the way
BASE_TURN, BASE_PLACE = 0.003, 0.001  # the same for a base whose pose is required
OVER_FEET = 0.02  # [m] the same for the centre of mass
FRAME_TOLERANCE = 1e-2  # [m] of a frame's goal; a plan aims at the middle 0.1 / 3^0.5 of it
CORRECTIONS, FRAME_MISS, JOINT_MISS = 3, 5.5e-4, 1e-3  # [m], [rad or m] errors that need no further correction
NEAR, SLOW = 0.02, 0.5  # [rad or m], [rad/s or m/s] deviations that cost 1 in a regulator
EFFORT_SHARE = 0.2  # the same for an input, as a fraction of its holding effort (at least a tenth of the largest)
AT_END = 100.0  # weight of the last state relative to a step: without it, a fall begins as the gains vanish at the end


@dataclass(frozen=True, eq=False)
class Stance:
    """A posture q (nq,), inputs u (nu,) that hold it, and forces (n, 3) [N] at the points (n, 3) [m] of the soles."""

    q: Array
    u: Array
    points: Array
    forces: Array


@dataclass(frozen=True, eq=False)
class Rest:
    """A state x (nx,) at rest, and the inputs u (nu,) that hold it in the model's own steps."""

    x: Array
    u: Array


@dataclass(frozen=True, eq=False, repr=False)
class Standing(ShowsItsRepr):
    """A robot at rest on its feet.

    Attributes:
        model: The model, with soft feet.
        x0: (nx,) the state.
        u: (nu,) the inputs under which a step of the model preserves the state.
        feet: The names of the feet's bodies, as for a `ContactSchedule`.
    """

    model: Model
    x0: Array
    u: Array
    feet: tuple[str, ...]

    def __repr__(self) -> str:
        return f"Standing({self.model.name} on {', '.join(self.feet)})"


@dataclass(frozen=True, eq=False)
class Shift:
    """A motion xs (N+1, nx) under us (N, nu) of the model's own steps, from rest to rest."""

    xs: Array
    us: Array


def stand(model: Model) -> Standing:
    """Find a posture on bent legs in which a robot is at rest on its feet, and the inputs that hold it.

    The feet are the lowest limbs in the file's posture that end in spheres or boxes. The result's model has the
    softness of `ContactSchedule.with_soft_feet`, unless the file gives one.

    Args:
        model: A model with a floating base and a ground at z = 0, upright in its default state, such as
            `load_model(file, base="free", ground=True, contact="ground", actuators="all", meshes="spheres",
            contact_geometry="corner_spheres", time_step=0.01)`.

    Returns:
        The model, the state x0, the inputs and the feet.

    Raises:
        InputError: The model cannot stand; the message gives the reason.

    Example:
        >>> options = {"base": "free", "ground": True, "contact": "ground", "actuators": "all"}
        >>> robot = dd.legs.stand(dd.load_model("models/quadruped.urdf", time_step=0.02, **options))
        >>> robot.feet
        ('FL_foot', 'FR_foot', 'RL_foot', 'RR_foot')
        >>> round(float(robot.x0[robot.model.state_names.index("trunk_z")]), 3)
        0.329
    """
    if not isinstance(model, Model):
        raise InputError("legs.stand: model", got=repr(model)[:80], expected="a model")
    result = stand_softly(model)
    if isinstance(result, Refusal):
        raise InputError("legs.stand: model", got=str(result), expected="a robot on feet that its motors can hold")
    legs, rest = result
    return Standing(legs.model, rest.x, rest.u, tuple(foot.name for foot in legs.feet))


def stand_softly(model: Model) -> tuple[Legs, Rest] | Refusal:
    """Return the legs of the model with soft feet, and the state in which it stands at rest, or a Refusal."""
    feet = find_feet(model, model.default_state[: model.nq])
    if isinstance(feet, Refusal):
        return feet
    soft = with_soft_feet(model, len(feet))
    return stand_at_rest(soft, *ranges(soft, np.pi))  # legs may bend further than random postures


def ranges(model: Model, turn: float = ANGLE) -> tuple[Array, Array]:
    """Return (lower, upper) (nq,): each coordinate's limits, or a range around 0 if it is unlimited or very wide.

    That range is `turn` [rad] to each side for an angle.
    """
    lower = np.array([p.lower for p in model.contract.positions], dtype=float)
    upper = np.array([p.upper for p in model.contract.positions], dtype=float)
    reach = np.array([LENGTH if p.unit == "m" else turn for p in model.contract.positions])
    wide = upper - lower > WIDEST  # true also without limits
    low = np.where(wide, np.maximum(lower, -reach), lower)
    high = np.where(wide, np.minimum(upper, reach), upper)
    beyond = low > high  # a single limit on the other side of 0
    low = np.where(beyond & np.isfinite(upper), upper - 2 * reach, low)
    high = np.where(beyond & np.isfinite(lower), lower + 2 * reach, high)
    return low, high


def state_limits(model: Model) -> tuple[Array, Array]:
    """Return (lower, upper) (nx,) the limits of a state, without those of positions with equal limits.

    Drake holds such a position only to about 1e-6.
    """
    terms = [*model.contract.positions, *model.contract.velocities]
    low, high = np.array([t.lower for t in terms]), np.array([t.upper for t in terms])
    return np.where(low == high, -np.inf, low), np.where(low == high, np.inf, high)


def stand_at_rest(model: Model, lower: Array, upper: Array) -> tuple[Legs, Rest] | Refusal:
    """Return the legs of a robot and the state in which it stands at rest, within lower and upper (nq,), or a Refusal.

    The base floats, z is up, and the ground is at z = 0.
    """
    file = model.default_state[: model.nq].copy()
    feet = find_feet(model, file)
    if isinstance(feet, Refusal):
        return feet
    stance = standing_posture(Legs(model, feet, lower, upper), file)
    if isinstance(stance, Refusal):
        return stance
    legs = Legs(model, feet, lower, upper).on_lowest(stance.q)
    rest = settled(legs, stance)
    return rest if isinstance(rest, Refusal) else (legs, rest)


def standing_posture(legs: Legs, file: Array) -> Stance | Refusal:
    """Find a stance on bent legs, with feet near those of the file's posture (nq,) and the centre of mass over them."""
    model, legs = legs.model, legs.on_lowest(file)
    q, base = file.copy(), legs.base_v
    q[legs.base_q + 6] -= float(np.min(legs.points_in(file)[:, 2]))
    places = legs.points_in(q)
    places[:, 2] = -DEEP
    wanted, unit = q.copy(), np.full(model.nv, POSED)
    wanted[legs.base_q + 6] *= BENT
    unit[base : base + 6] = LEVEL, LEVEL, LEVEL, ASIDE, ASIDE, TALL
    wish = Wish(wanted, unit, [*np.mean(places[:, :2], axis=0), np.nan], BALANCED)
    margin = _margin(legs, INSIDE)
    near = [ASIDE, ASIDE, np.inf]
    tolerance = [np.inf, np.inf, max(ON_GROUND, *(_unevenness(legs.centres[legs.owners == i]) for i in legs.owners))]
    random, why, least = np.random.default_rng(0), Refusal(""), np.inf
    best: Stance | None = None
    for _ in range(STARTS):
        drawn = np.zeros(model.nv)
        drawn[legs.joint_v] = random.uniform(-SPREAD, SPREAD, len(legs.joint_v))
        posture = legs.moved(wanted, drawn)
        for _ in range(ROUNDS):
            legs = legs.on_lowest(posture)
            posture = inverse_kinematics(
                model, posture, legs.at(places, tolerance, unit=near), wish, legs.lower + margin, legs.upper - margin
            )
        off_place = np.abs(legs.points_in(posture) - places)
        cost = float(np.sum((legs.apart(posture, wanted) / unit) ** 2) + np.sum((off_place / near) ** 2))
        off = float(np.max(off_place[:, 2])) - tolerance[2]
        if off > FEET_STAY:
            why = Refusal(f"the feet cannot reach the ground: distance {off:.2g} m")
        elif cost < least:
            stance = hold(legs, posture)
            if isinstance(stance, Refusal):
                why = stance
            else:
                best, least = stance, cost
    return best or why


def _margin(legs: Legs, share: float) -> Array:
    """Return (nq,) a share of the range of each joint, and 0 for the base."""
    margin = np.zeros(legs.model.nq)
    margin[legs.joint_q] = share * (legs.upper - legs.lower)[legs.joint_q]
    return margin


def _unevenness(points: Array) -> float:
    """Return [m] the largest distance of points (k, 3) from the plane through them."""
    middle = points - np.mean(points, axis=0)
    return float(np.max(np.abs(middle @ np.linalg.svd(middle)[2][2]))) if len(points) > 3 else 0.0


def hold(legs: Legs, q: Array, needed: Array | None = None) -> Stance | Refusal:
    """Return the least forces and inputs that hold posture q (nq,), or a Refusal.

    `needed` (nv,) is the generalized force that they must produce, for a motion. By default, they balance the weight.
    """
    model, owners = legs.model, legs.owners
    points = legs.points_in(q)
    friction = OF_FRICTION * legs.frictions[owners]
    needed = model.double.inverse_dynamics(np.zeros(model.nv)) if needed is None else needed
    limits = model.effort_limits
    count, share = len(points), legs.weight / len(legs.feet)
    scale = np.where(np.isfinite(limits), limits, legs.weight)
    program = MathematicalProgram()
    f = program.NewContinuousVariables(3 * count)  # in even shares of the weight
    u = program.NewContinuousVariables(model.nu)  # as fractions of the limits
    balance = np.hstack([share * legs.jacobian().reshape(-1, model.nv).T, model.actuation * scale])
    program.AddLinearEqualityConstraint(balance / legs.weight, needed / legs.weight, np.concatenate([f, u]))
    angles = np.arange(SIDES) * 2 * np.pi / SIDES
    for i in range(count):
        cone = np.column_stack([np.cos(angles), np.sin(angles), np.full(SIDES, -friction[i])])
        program.AddLinearConstraint(cone, np.full(SIDES, -np.inf), np.zeros(SIDES), f[3 * i : 3 * i + 3])
    for foot in range(len(legs.feet)):
        upward = f[2::3][owners == foot]
        program.AddLinearConstraint(np.ones((1, len(upward))), [FOOT_SHARE], [np.inf], upward)
    program.AddBoundingBoxConstraint(0.0, np.inf, f[2::3])
    program.AddBoundingBoxConstraint(-OF_EFFORT, OF_EFFORT, u[np.isfinite(limits)])
    program.AddQuadraticCost(2 * np.diag(np.tile([SIDEWAYS, SIDEWAYS, 1.0], count)), np.zeros(3 * count), f)
    program.AddQuadraticCost(2 * np.eye(model.nu), np.zeros(model.nu), u)
    result = ClarabelSolver().Solve(program)
    if not result.is_success():
        return Refusal("no contact forces within the friction cones and motor efforts within their limits balance it")
    forces = share * np.asarray(result.GetSolution(f)).reshape(-1, 3)
    still = np.zeros(model.nv)
    u_hold = model.commands(np.append(q, still), still, scale * np.asarray(result.GetSolution(u)))
    return Stance(q, u_hold, points, forces)


def input_limits(model: Model) -> Array:
    """Return (2, nu) the lower and the upper limits of the inputs."""
    return np.array([[u.lower for u in model.contract.inputs], [u.upper for u in model.contract.inputs]])


def settled(legs: Legs, stance: Stance) -> Rest | Refusal:
    """Return the state near a stance that is at rest in the model's own steps, or a Refusal."""
    q = stance.q.copy()
    q[legs.base_q + 6] -= float(np.max(stance.points[:, 2])) + DEEP  # all soles touch, and so have derivatives
    return at_rest(legs, q, stance.u, np.arange(legs.model.nv), np.full(legs.model.nv, ANY))


def standing(legs: Legs, posture: Array) -> Rest:
    """Return the state at rest with joints as in `posture` (nq,), and the inputs under which a step preserves it.

    Only roll, pitch and height of the base are varied.

    Raises:
        InputError: No such state is found, a foot is in the air, another body touches, or a motor is too weak.
    """
    base, none = legs.base_v, np.zeros(legs.model.nu)
    rest = at_rest(
        legs, _level(legs, posture), none, np.array([base, base + 1, base + 5]), np.array([TURN, TURN, HEIGHT])
    )
    if isinstance(rest, Refusal):
        expected = "a posture at rest on exactly the feet of the schedule, with the centre of mass above them"
        raise InputError("ContactSchedule.standing: joints", got=str(rest), expected=expected)
    return rest


def _level(legs: Legs, posture: Array) -> Array:
    """Roll, pitch and raise the posture (nq,) until the plane through its soles is slightly below the ground."""
    q, turn = posture.copy(), np.zeros(legs.model.nv)
    q[legs.base_q : legs.base_q + 4] = 1.0, 0.0, 0.0, 0.0
    points = legs.points_in(q) - np.mean(legs.points_in(q), axis=0)
    normal = np.append(-np.linalg.lstsq(points[:, :2], points[:, 2], rcond=1e-6)[0], 1.0)
    normal /= np.linalg.norm(normal)
    turn[legs.base_v : legs.base_v + 3] = 2 * np.cross(normal, [0.0, 0.0, 1.0]) / (1 + normal[2])  # see TangentSpace
    q = legs.moved(q, turn)
    q[legs.base_q + 6] -= np.mean(legs.points_in(q)[:, 2]) + max(SINK * legs.model.time_step / 2, FIRST_SINK)
    return q


def at_rest(legs: Legs, q: Array, u: Array, freed: Indices, unit: Array) -> Rest | Refusal:
    """Return a state that a step does not change, near posture q (nq,) and inputs u (nu,), or a Refusal.

    Gauss-Newton varies the inputs and the coordinates `freed` of the tangent space, whose scale is `unit`.
    """
    model = legs.model
    x = np.concatenate([q, np.zeros(model.nv)])
    scale = np.concatenate([unit, np.full(model.nu, EFFORT * legs.weight)])
    try:
        x_next, off = _after(model, x, u)
        for _ in range(ITERATIONS):
            if off < AT_REST:
                break
            by_x, by_u, _ = linearize(model, x[None], u[None])
            slopes = legs.space.jacobian(x, x_next, by_x[0], by_u[0])[model.nv :]
            columns = np.hstack([slopes[:, freed], slopes[:, 2 * model.nv :]]) * scale
            change = -scale * np.linalg.lstsq(columns, x_next[model.nq :], rcond=1e-10)[0]
            change *= min(1.0, FARTHEST / max(float(np.max(np.abs(change[: len(freed)]))), 1e-300))
            for _ in range(HALVINGS):
                moved = np.zeros(2 * model.nv)
                moved[freed] = change[: len(freed)]
                there, inputs = legs.space.plus(x, moved), u + change[len(freed) :]
                after, left = _after(model, there, inputs)
                if left < off:
                    break
                change /= 2
            else:
                break
            x, u, x_next, off = there, inputs, after, left
        fault = _fault(legs, x, u, off)
    except (SimulationError, GradientError) as error:
        return Refusal(f"Drake cannot take a step from its standing posture: {error}")
    return Refusal(fault) if fault else Rest(x, u)


def _after(model: Model, x: Array, u: Array) -> tuple[Array, float]:
    """Return the state after a step, and its largest velocity."""
    x_next = np.array(advance(model.double, x, u))
    return x_next, float(np.max(np.abs(x_next[model.nq :])))


def _fault(legs: Legs, x: Array, u: Array, off: float) -> str:
    """Describe why the state is not at rest, not on its feet alone, or beyond a motor's limits, or return ""."""
    model = legs.model
    for entry, value in zip(model.contract.inputs, u, strict=True):
        if not entry.lower <= value <= entry.upper:
            return f"{entry.name} exceeds its limit of {abs(entry.upper if value > 0 else entry.lower):.3g}"
    advance(model.double, x, u)
    touching = {contact.body_a for contact in contacts_of_the_step(model)}
    for foot, height in zip(legs.feet, legs.heights(), strict=True):
        if not touching & set(foot.bodies):
            return f"foot {foot.name} is {1e3 * height:.3g} mm above the ground"
    if off >= AT_REST:
        return f"the speed is {off:.2g} rad/s or m/s after a step"
    others = touching.difference(*(foot.bodies for foot in legs.feet))
    return f"{min(others)} is in contact and is not a foot" if others else ""


def with_soft_feet(model: Model, feet: int) -> Model:
    """Return the model with contact as soft as plans on this many feet need, unless its file gives values."""
    h = model.time_step
    weight = float(model.plant.CalcTotalMass(model.double.context)) * GRAVITY
    stiffness = 2 * weight / feet / (SINK * h)  # two touching shapes have half of this stiffness
    return model.changed(
        stiffness=stiffness, dissipation=DISSIPATION, relaxation_time=RELAXES * h, near_rigid=NEAR_RIGID
    )


def random_shift(legs: Legs, start: Rest, seed: Sequence[int], depth: Callable[[Array], float]) -> Shift | Refusal:
    """Return a motion to a random posture, with the base shifted and lowered and the arms moved, or a Refusal.

    `depth` returns the overlap of shapes [m] in a posture, which must not be more than at the start.
    """
    random = np.random.default_rng([*seed, 4])
    model, q0, base = legs.model, start.x[: legs.model.nq], legs.base_v
    deepest = max(depth(q0), 1e-4)
    legs.put(q0)
    tall = float(legs.center_of_mass()[2])
    unit = _base_first(legs)
    arms = np.array([v not in {i for foot in legs.feet for i in foot.joints} for v in legs.joint_v])
    ranges = (legs.upper - legs.lower)[legs.joint_q][arms]
    margin, why = _margin(legs, INSIDE / 2), Refusal("")
    for size, of_arms in SIZES:
        way = np.zeros(model.nv)
        way[base : base + 3] = size * TURNED * random.uniform(-1, 1, 3)
        way[base + 3 : base + 5] = size * SHIFTED * tall * random.uniform(-1, 1, 2)
        way[base + 5] = -size * LOWERED * tall * random.uniform(0.5, 1)
        way[legs.joint_v[arms]] = of_arms * MOVED * random.uniform(-1, 1, len(ranges)) * ranges
        wish = Wish(legs.moved(q0, way), unit)
        shift = _shift_to(legs, start, wish, legs.lower + margin, legs.upper - margin)
        if isinstance(shift, Refusal):
            why = shift
        elif max(depth(x[: model.nq]) for x in shift.xs[:: max(1, len(shift.us) // 20)]) > deepest:
            why = Refusal("its own shapes would overlap")
        else:
            return shift
    return why


def shift_to(legs: Legs, start: Rest, frames: Mapping[str, Array], joints: Mapping[int, float]) -> Shift | Refusal:
    """Return a motion to positions (3,) [m] of frames and values of joints by their index in q, with fixed feet."""
    model, q0, base = legs.model, start.x[: legs.model.nq], legs.base_v
    feet, unit = legs.points_in(q0), np.full(model.nv, FREE_JOINT)
    unit[base : base + 6] = FREE_BASE
    wish = Wish(q0, unit, [*np.mean(feet[:, :2], axis=0), np.nan], OVER_FEET)
    plant, indices, asked = model.double.plant, list(joints), np.array(list(joints.values()))
    origins = {n: plant.get_frame(frame_named(model.plant, "goal", n).index()) for n in frames}
    margin = _margin(legs, INSIDE / 2)
    aimed, places = asked.copy(), {name: np.array(position) for name, position in frames.items()}
    for _ in range(CORRECTIONS + 1):
        lower, upper = legs.lower + margin, legs.upper - margin  # for the regulator
        lower[indices] = upper[indices] = aimed
        targets = [PointTarget(origins[name], np.zeros(3), position, ON_GROUND) for name, position in places.items()]
        shift = _shift_to(legs, start, wish, lower, upper, targets)
        if isinstance(shift, Refusal):
            return shift
        end = shift.xs[-1][: model.nq]
        legs.put(end)
        context, off = model.double.context, asked - end[indices]
        misses = {n: frames[n] - origins[n].CalcPoseInWorld(context).translation() for n in frames}
        far = max((float(np.max(np.abs(miss))) for miss in misses.values()), default=0.0)
        if far < FRAME_MISS and np.max(np.abs(off), initial=0.0) < JOINT_MISS:
            return shift
        aimed = aimed + off
        places = {name: position + misses[name] for name, position in places.items()}
    return Refusal(
        f"its frames end {far:.2g} m and its joints {np.max(np.abs(off), initial=0.0):.2g} from their targets"
    )


def shift_of(
    legs: Legs, start: Rest, steps: int, expand: Callable[[Array], tuple[Array, Array]], *, fast: bool
) -> Shift | Refusal:
    """Return a motion of a number of steps to the posture of least cost, or part of the way there, with fixed feet.

    `expand` returns the gradient (nv,) and the Hessian (nv, nv) of the cost in a posture (nq,). A `fast` motion takes
    as few of the steps as the feet allow, and holds its end. Otherwise, it takes most of the steps.
    """
    model, q0 = legs.model, start.x[: legs.model.nq]
    unit, margin, q = _base_first(legs), _margin(legs, INSIDE / 2), q0
    for _ in range(ROUNDS):
        gradient, hessian = expand(q)
        legs.put(q)
        _, sizes, ways = np.linalg.svd(legs.jacobian().reshape(-1, model.nv))
        free = ways[np.count_nonzero(sizes > FIXED * sizes[0]) :].T
        curvature = free.T @ hessian @ free
        curvature += FLAT * np.trace(curvature) / len(curvature) * np.eye(len(curvature))
        way = -free @ np.linalg.lstsq(curvature, free.T @ gradient, rcond=None)[0]
        targets = legs.at(legs.points_in(q0), ON_GROUND, rolls=range(len(legs.owners)))
        wish = Wish(legs.moved(q, way), unit)
        q = inverse_kinematics(model, q, targets, wish, legs.lower + margin, legs.upper - margin)
    way, spans = (
        legs.apart(q, q0),
        [(moving := math.ceil(fraction * steps), steps - moving) for fraction in PARTS[0 if fast else -1 :]],
    )
    if np.max(np.abs(way)) < LEAST_WAY:
        return Refusal("the posture of least cost is the first one")
    why = Refusal("")
    for share in SHARES:
        wish = Wish(legs.moved(q0, share * way), unit)
        shift = _shift_to(legs, start, wish, legs.lower + margin, legs.upper - margin, spans=spans)
        if not isinstance(shift, Refusal):
            return shift
        why = shift
    return why


def _base_first(legs: Legs) -> Array:
    """Return (nv,) the deviations [rad or m] that cost 1, for a required pose of the base."""
    unit = np.full(legs.model.nv, FREE_JOINT)
    unit[legs.base_v : legs.base_v + 6] = np.repeat([BASE_TURN, BASE_PLACE], 3)
    return unit


def _shift_to(
    legs: Legs,
    start: Rest,
    wish: Wish,
    lower: Array,
    upper: Array,
    others: Sequence[PointTarget] = (),
    spans: Sequence[tuple[int, int]] = (),
) -> Shift | Refusal:
    """Return a motion from rest to the posture nearest to a wish, with fixed feet and the targets `others`.

    `spans` are the steps of the motion and of holding its end, the first feasible of which are used.
    """
    q0 = start.x[: legs.model.nq]
    feet, q, soles = legs.points_in(q0), q0, legs
    for _ in range(ROUNDS):  # a foot of several spheres rolls from one to the next
        targets = [*soles.at(feet, ON_GROUND, rolls=range(len(feet))), *others]
        q = inverse_kinematics(legs.model, q, targets, wish, lower, upper)
        off, soles = miss(legs.model, targets), soles.on_lowest(q)
        low = soles.points_in(q)
        off = max(off, float(np.min(feet[:, 2]) - np.min(low[:, 2])))
        if off <= FEET_STAY:
            break
        feet = np.column_stack([low[:, :2], feet[:, 2]])
    else:
        return Refusal(f"the feet would have to move by {off:.2g} m")
    stance = hold(soles, q)
    end = stance if isinstance(stance, Refusal) else settled(soles, stance)
    if isinstance(end, Refusal):
        return end
    why, nq, h = Refusal(""), legs.model.nq, legs.model.time_step
    for moving, holding in spans or [(round(duration / h), round(HOLDING / h)) for duration in DURATIONS]:
        shift = _between(legs, start, end, moving, holding)
        if isinstance(shift, Refusal):
            why = shift
            continue
        x = shift.xs[-1]
        away, speed = float(np.max(np.abs(legs.apart(x[:nq], end.x[:nq])))), float(np.max(np.abs(x[nq:])))
        if away <= ARRIVED and speed <= SLOW_ENOUGH:
            return shift
        why = Refusal(f"it ends {away:.2g} rad or m from its rest posture, at a speed of {speed:.2g} rad/s or m/s")
    return why


def _between(legs: Legs, start: Rest, end: Rest, moving: int, holding: int) -> Shift | Refusal:
    """Return the model's own steps from one rest to (nearly) another, in steps `moving` and `holding`, on its feet.

    The inputs produce a smooth motion of the posture, with forces shared among the feet. A regulator keeps the steps
    near this motion.
    """
    model, h = legs.model, legs.model.time_step
    q0, q1 = start.x[: model.nq], end.x[: model.nq]
    s = smooth(np.linspace(0, 1, moving + 1))
    feet = [legs.points_in(q) for q in (q0, q1)]  # round ones roll as the legs turn
    ground = [legs.on_lowest(q).points_in(q)[:, 2] for q in (q0, q1)]
    way, unit, qs = legs.apart(q1, q0), np.full(model.nv, ALONG), [q0]
    for fraction in s[1:-1]:
        places, height = ((1 - fraction) * first + fraction * last for first, last in (feet, ground))
        wish, q = Wish(legs.moved(q0, fraction * way), unit), qs[-1]
        for _ in range(ROUNDS):
            q = inverse_kinematics(model, q, legs.at(places, STILL), wish, legs.lower, legs.upper)
            gap = legs.on_lowest(q).points_in(q)[:, 2] - height
            if np.max(np.abs(gap)) <= ON_GROUND:
                break
            places[:, 2] -= gap
        qs.append(q)
    qs += [q1] * (holding + 1)
    v = [np.zeros(model.nv)] + [legs.apart(b, a) / h for a, b in pairwise(qs)]
    xs = np.array([np.concatenate([q, speed]) for q, speed in zip(qs, v, strict=True)])
    us = []
    for k in range(moving + 1):
        change, soles = v[k + 1] - v[k], legs.on_lowest(qs[k])
        set_state(model.double, xs[k])
        stance = hold(soles, qs[k], model.double.inverse_dynamics(change / h) + model.double.damping() * change)
        if isinstance(stance, Refusal):
            return Refusal(f"along the motion, {stance.reason}")
        us.append(stance.u)
    made = np.array(us[:-1] + [us[-1]] * holding)
    s = np.concatenate([s[:-1], np.ones(holding)])[:, None]
    return _regulated(legs, xs, made + (1 - s) * (start.u - us[0]) + s * (end.u - us[-1]))


def _regulated(legs: Legs, xs: Array, us: Array) -> Shift | Refusal:
    """Return the model's own steps along xs (N+1, nx) under us (N, nu) and a regulator, if they keep within limits."""
    model, nv = legs.model, legs.model.nv
    lower, upper = input_limits(model)
    effort = np.abs(model.efforts(xs[0], us[0]))
    size = EFFORT_SHARE * np.maximum(effort, 0.1 * float(np.max(effort))) / model.servo_gains[0]
    Q = np.diag(np.concatenate([np.full(nv, NEAR**-2.0), np.full(nv, SLOW**-2.0)]))
    try:
        policy = TVLQR(model, xs, us, Q, np.diag(size**-2.0), AT_END * Q)
        states, inputs, depths = [xs[0]], list[Array](), list[Array]()
        for k in range(len(us)):
            inputs.append(np.clip(policy(states[-1], k * model.time_step), lower, upper))
            states.append(np.array(advance(model.double, states[-1], inputs[-1])))
            depths.append(_depths(legs))
    except (SimulationError, GradientError) as error:
        return Refusal(f"Drake cannot take the steps of the motion: {error}")
    low, high = state_limits(model)
    beyond = np.any((np.array(states) < low) | (np.array(states) > high), axis=0)
    if np.any(beyond):
        return Refusal(f"{model.state_names[int(np.argmax(beyond))]} would leave its limits")
    lifted = np.min(depths, axis=0) < FIRM * depths[0]
    if np.any(lifted):
        return Refusal(f"foot {legs.feet[int(np.argmax(lifted))].name} would lift off")
    return Shift(np.array(states), np.array(inputs))


def _depths(legs: Legs) -> Array:
    """Return (feet,) [m] the depth of each foot in the ground in the last step."""
    deepest = dict[str, float]()
    for contact in contacts_of_the_step(legs.model):
        deepest[contact.body_a] = max(contact.depth, deepest.get(contact.body_a, 0.0))
    return np.array([max(deepest.get(body, 0.0) for body in foot.bodies) for foot in legs.feet])
