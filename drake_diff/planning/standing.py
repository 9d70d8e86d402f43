"""Postures in which a robot stands on its feet: by inverse kinematics, held by forces that friction and motors allow.

A posture is found by damped least squares, with the soles on the ground and the centre of mass over them. Forces at the
soles and inputs that hold it are a small quadratic program. Then the model's own steps are taken, under a regulator
through their contact, until the robot rests: what comes out is an equilibrium of the steps and not of a formula.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from pydrake.multibody.tree import JacobianWrtVariable
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import Refusal
from drake_diff.derivatives.step import linearize
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.model.contact import contacts_of_the_step
from drake_diff.model.model import Model
from drake_diff.model.plant import proximity_property
from drake_diff.model.repairs import frame_named
from drake_diff.model.step import advance
from drake_diff.model.tangent import tangent_space
from drake_diff.planning.feet import Foot, bottoms, center_of_mass, find_feet, own_velocities, upright
from drake_diff.planning.posture import effort_limits

GRAVITY = 9.81  # [m/s^2] of the weight, a scale
FOOT_SHARE = 0.1  # of an even share of the weight: what each foot carries at least, so that none lifts off
OF_FRICTION = 0.7  # of the friction that is possible: what a posture may need
OF_EFFORT = 0.8  # of an effort limit: what a posture may need
SIDES = 8  # of the pyramid that stands for a cone of friction
SIDEWAYS = 100.0  # how much a sideways force of a foot costs against an upright one: it lets the foot creep
# What counts as 1 where a posture is looked for.
ON_GROUND, BALANCED, LEVEL, TALL, STANCE, AT_PLACE = 2e-5, 5e-3, 0.03, 0.01, 0.02, 2e-5  # [m], of LEVEL [rad]
POSED = 0.5  # [rad or m] of a joint
BENT = 0.88  # of its height on straight legs
INSIDE = 0.08  # of a joint's range: how far from its limits a posture stays
IN = 5e-5  # [m] how deep feet are in the ground where a posture is looked for
DAMPING = 1e-4
ITERATIONS, FARTHEST, STILL = 80, 0.2, 1e-7  # [rad or m] of one iteration, and of the last
STARTS, SPREAD = 6, 0.5  # first postures, and how far [rad or m] they are drawn from the file's
SETTLES, WHILE = 3, 2.0  # rounds, each about the state that the one before came to, and [s] of a round
REST, TOO_FAST = 1e-4, 5e-3  # [rad/s or m/s] what ends a round, and what is no rest: feet creep by less
FALLEN = 0.2  # [rad or m] away from where it was to stand
SWEEPS = 200  # back from the end, of the weights of a regulator
NEAR, SLOW = 0.02, 0.5  # [rad or m], [rad/s or m/s] off that count as 1 of a regulator
EFFORT_SHARE = 0.2  # of what an input holds (of the largest at least a tenth): what counts as 1


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


@dataclass(frozen=True, eq=False)
class Wish:
    """What a posture is to be like.

    Attributes:
        q: (nq,) the posture that it is to be near.
        near: (nv,) of the tangent space, how far from q counts as 1 of each coordinate.
        feet: (m, 3) [m] where the lowest points of the soles are to be; their height counts as by ON_GROUND.
        placed: [m] how far from there sideways counts as 1.
        balanced: [m] how far the centre of mass may be from over the middle of the feet; None where it may be anywhere.
        frames: (3,) [m] where the origins of frames are to be, by name.
        inside: Of a joint's range: how far from its limits it stays.
    """

    q: Array
    near: Array
    feet: Array
    placed: float = ON_GROUND
    balanced: float | None = None
    frames: Mapping[str, Array] = field(default_factory=dict)
    inside: float = 0.0


class Legged:
    """A model on a floating base, the feet that it stands on, and where the joints may be, lower and upper (nq,)."""

    def __init__(self, model: Model, feet: Sequence[Foot], lower: Array, upper: Array):
        self.model, self.feet, self.space = model, tuple(feet), tangent_space(model)
        self.lower, self.upper = lower, upper
        self.base_q = self.space.quaternions[0]  # where its pose begins in q: a quaternion, then a place
        self.base_v = self.base_q  # and in the tangent space: a turn, then a place
        count = np.arange(model.nq)
        self.joint_q = count[(count < self.base_q) | (count >= self.base_q + 7)]
        self.joint_v = np.where(self.joint_q < self.base_q, self.joint_q, self.joint_q - 1)
        self.weight = float(model.plant.CalcTotalMass(model.double.context)) * GRAVITY
        self.touching: tuple[Indices, ...] | None = None  # the spheres of each foot that it stands on

    def moved(self, q: Array, d: Array, inside: float = 0.0) -> Array:
        """Posture q (nq,) moved by d (nv,), joints that part of their range inside their limits."""
        still = np.zeros(self.model.nv)
        posture = self.space.plus(np.concatenate([q, still]), np.concatenate([d, still]))[: self.model.nq]
        posture[self.joint_q] = np.clip(posture[self.joint_q], *self.limits(inside))
        return posture

    def limits(self, inside: float) -> tuple[Array, Array]:
        """(lower, upper) of the coordinates of joints, that part of their range inside."""
        lower, upper = self.lower[self.joint_q], self.upper[self.joint_q]
        margin = inside * (upper - lower)
        return lower + margin, upper - margin

    def apart(self, q: Array, origin: Array) -> Array:
        """(nv,) the way from `origin` to q, both (nq,)."""
        still = np.zeros(self.model.nv)
        return self.space.minus(np.concatenate([q, still]), np.concatenate([origin, still]))[: self.model.nv]

    def soles(self, q: Array) -> tuple[Array, Array, Array]:
        """(points (n, 3), their Jacobian (n, 3, nv), the foot (n,) of each) in posture q (nq,).

        Of a foot that is no face only the lowest point is one, or the one that was: see `keep_soles`.
        """
        upright(self.model, q)
        chosen = self.touching or tuple(self._standing(foot) for foot in self.feet)
        pairs = [bottoms(self.model, foot, which) for foot, which in zip(self.feet, chosen, strict=True)]
        owners = np.concatenate([np.full(len(which), i) for i, which in enumerate(chosen)])
        jacobians = [jacobian.reshape(-1, 3, self.model.nv) for _, jacobian in pairs]
        return np.vstack([points for points, _ in pairs]), np.vstack(jacobians), owners

    def keep_soles(self, q: Array) -> None:
        """Let the points that stand in posture q (nq,) be those that stand in all others."""
        upright(self.model, q)
        self.touching = tuple(self._standing(foot) for foot in self.feet)

    def _standing(self, foot: Foot) -> Indices:
        """The spheres of a foot that it stands on in the twin's posture."""
        return foot.sole if foot.is_flat else np.array([np.argmin(bottoms(self.model, foot)[0][:, 2])])

    def frictions(self) -> Array:
        """(number of feet,) the coefficients with the ground, by Drake's rule for two of them."""
        inspector, plant = self.model.double.inspector, self.model.plant
        grounds = plant.GetCollisionGeometriesForBody(plant.world_body())
        ground = max(proximity_property(inspector, g, "friction") or 0.0 for g in grounds)
        coefficients = np.array([foot.friction for foot in self.feet])
        return np.asarray(2 * coefficients * ground / np.maximum(coefficients + ground, 1e-12))


def stand(model: Model, lower: Array, upper: Array) -> tuple[Legged, Rest] | Refusal:
    """The robot on its feet, at rest, joints within lower and upper (nq,); or why it cannot stand.

    The base floats, z is up, and the ground is at z = 0.
    """
    file = model.default_state[: model.nq].copy()
    feet = find_feet(model, file)
    if isinstance(feet, Refusal):
        return feet
    robot = Legged(model, feet, lower, upper)
    stance = standing_posture(robot, file)
    if isinstance(stance, Refusal):
        return stance
    rest = settled(robot, stance)
    if not isinstance(rest, Refusal):
        robot.keep_soles(rest.x[: model.nq])
    return rest if isinstance(rest, Refusal) else (robot, rest)


def standing_posture(robot: Legged, file: Array) -> Stance | Refusal:
    """On bent legs, the feet about where they are in the file's posture (nq,) and the centre of mass over them."""
    model = robot.model
    q = file.copy()
    q[robot.base_q + 6] -= float(np.min(robot.soles(file)[0][:, 2]))
    feet = robot.soles(q)[0]
    feet[:, 2] = -IN
    wanted = robot.moved(q, np.zeros(model.nv), INSIDE)
    wanted[robot.base_q + 6] *= BENT
    near = np.full(model.nv, POSED)
    near[robot.base_v : robot.base_v + 6] = LEVEL, LEVEL, LEVEL, STANCE, STANCE, TALL
    wish = Wish(wanted, near, feet, placed=STANCE, balanced=BALANCED, inside=INSIDE)
    random, best, least = np.random.default_rng(0), None, np.inf
    why = Refusal("")
    for _ in range(STARTS):
        drawn = np.zeros(model.nv)
        drawn[robot.joint_v] = random.uniform(-SPREAD, SPREAD, len(robot.joint_v))
        posture = find_posture(robot, robot.moved(wanted, drawn, INSIDE), wish)
        off = float(np.sum(_residuals(robot, posture, wish)[0] ** 2))
        stance = hold(robot, posture) if off < least else why
        if isinstance(stance, Refusal):
            why = stance if stance.reason else why
        else:
            best, least = stance, off
    return best or why


def find_posture(robot: Legged, first: Array, wish: Wish) -> Array:
    """(nq,) the posture nearest to what is wished for, by damped least squares from posture `first` (nq,)."""
    q, joint_v = first, robot.joint_v
    lower, upper = robot.limits(wish.inside)
    for _ in range(ITERATIONS):
        error, jacobian = _residuals(robot, q, wish)
        down = jacobian.T @ error
        stuck = np.zeros(robot.model.nv, dtype=bool)
        values = q[robot.joint_q]
        stuck[joint_v] = ((values <= lower) & (down[joint_v] > 0)) | ((values >= upper) & (down[joint_v] < 0))
        jacobian = np.where(stuck, 0.0, jacobian)
        normal = jacobian.T @ jacobian + DAMPING * np.eye(jacobian.shape[1])
        change = np.asarray(-np.linalg.solve(normal, np.where(stuck, 0.0, down)), dtype=float)
        change *= min(1.0, FARTHEST / max(float(np.max(np.abs(change))), 1e-12))
        q = robot.moved(q, change, wish.inside)
        if np.max(np.abs(change)) < STILL:
            break
    return q


def _residuals(robot: Legged, q: Array, wish: Wish) -> tuple[Array, Array]:
    """How far posture q (nq,) is from what is wished for, and how that changes by the tangent vector (nv,)."""
    model, nv = robot.model, robot.model.nv
    points, by_v, _ = robot.soles(q)
    off = points - wish.feet
    rows, slopes = [off[:, 2] / ON_GROUND], [by_v[:, 2] / ON_GROUND]
    rows.append(off[:, :2].ravel() / wish.placed)
    slopes.append(by_v[:, :2].reshape(-1, nv) / wish.placed)
    if wish.balanced is not None:
        mass, by_mass = center_of_mass(model)
        rows.append((mass[:2] - np.mean(points[:, :2], axis=0)) / wish.balanced)
        slopes.append((by_mass[:2] - np.mean(by_v[:, :2], axis=0)) / wish.balanced)
    for name, position in wish.frames.items():
        here, by_frame = _origin(model, name)
        rows.append((here - position) / AT_PLACE)
        slopes.append(by_frame / AT_PLACE)
    rows.append(robot.apart(q, wish.q) / wish.near)
    slopes.append(np.diag(1 / wish.near))
    return np.concatenate(rows), np.vstack(slopes)


def _origin(model: Model, name: str) -> tuple[Array, Array]:
    """(3,) [m] where the origin of a frame is in the twin's state, and (3, nv) how it moves."""
    twin = model.double
    plant, context, world = twin.plant, twin.context, twin.plant.world_frame()
    frame = plant.get_frame(frame_named(model.plant, "goal", name).index())
    none = np.zeros((3, 1))
    here = plant.CalcPointsPositions(context, frame, none, world).ravel()
    kind = JacobianWrtVariable.kV
    return here, own_velocities(
        model, plant.CalcJacobianTranslationalVelocity(context, kind, frame, none, world, world)
    )


def hold(robot: Legged, q: Array, needed: Array | None = None) -> Stance | Refusal:
    """The least forces and inputs that hold posture q (nq,); or that there are none.

    `needed` (nv,) is the generalized force that they are to make in place of what holds the weight, for a motion.
    """
    model = robot.model
    points, by_v, owners = robot.soles(q)
    friction = OF_FRICTION * robot.frictions()[owners]
    needed = model.double.inverse_dynamics(np.zeros(model.nv)) if needed is None else needed
    limits = effort_limits(model)
    count, share = len(points), robot.weight / len(robot.feet)
    scale = np.where(np.isfinite(limits), limits, robot.weight)
    program = MathematicalProgram()
    f = program.NewContinuousVariables(3 * count)  # in shares of the weight
    u = program.NewContinuousVariables(model.nu)  # in parts of the limits
    balance = np.hstack([share * by_v.reshape(-1, model.nv).T, model.actuation * scale])
    program.AddLinearEqualityConstraint(balance / robot.weight, needed / robot.weight, np.concatenate([f, u]))
    angles = np.arange(SIDES) * 2 * np.pi / SIDES
    for i in range(count):
        cone = np.column_stack([np.cos(angles), np.sin(angles), np.full(SIDES, -friction[i])])
        program.AddLinearConstraint(cone, np.full(SIDES, -np.inf), np.zeros(SIDES), f[3 * i : 3 * i + 3])
    for foot in range(len(robot.feet)):
        upward = f[2::3][owners == foot]
        program.AddLinearConstraint(np.ones((1, len(upward))), [FOOT_SHARE], [np.inf], upward)
    program.AddBoundingBoxConstraint(0.0, np.inf, f[2::3])
    program.AddBoundingBoxConstraint(-OF_EFFORT, OF_EFFORT, u[np.isfinite(limits)])
    program.AddQuadraticCost(2 * np.diag(np.tile([SIDEWAYS, SIDEWAYS, 1.0], count)), np.zeros(3 * count), f)
    program.AddQuadraticCost(2 * np.eye(model.nu), np.zeros(model.nu), u)
    result = ClarabelSolver().Solve(program)
    if not result.is_success():
        return Refusal("no forces of its feet, within friction, and of its motors, within their limits, balance it")
    forces = share * np.asarray(result.GetSolution(f)).reshape(-1, 3)
    return Stance(q, scale * np.asarray(result.GetSolution(u)), points, forces)


def settled(robot: Legged, stance: Stance) -> Rest | Refusal:
    """Where a stance comes to rest in the model's own steps, held by a regulator; or why it does not."""
    model = robot.model
    x, u = np.concatenate([stance.q, np.zeros(model.nv)]), stance.u
    x[robot.base_q + 6] -= float(np.max(stance.points[:, 2])) + IN  # a regulator is found where all soles touch
    lower, upper = input_limits(model)
    speed = np.inf
    try:
        for _ in range(SETTLES):
            gain, about = regulator(robot, x, u), (x, u)
            for _ in range(int(WHILE / model.time_step)):
                u = np.clip(about[1] - gain @ robot.space.minus(x, about[0]), lower, upper)
                x = np.array(advance(model.double, x, u))
                speed = float(np.max(np.abs(x[model.nq :])))
                if speed < REST:
                    break
            away = float(np.max(np.abs(robot.apart(x[: model.nq], stance.q))))
            if away > FALLEN:
                return Refusal(f"it falls from where forces hold it: {away:.2g} rad or m away")
            if speed < REST:
                break
        if speed > TOO_FAST:
            return Refusal(f"it does not come to rest: {speed:.2g} rad/s or m/s after {SETTLES * WHILE:g} s")
        x = np.concatenate([x[: model.nq], np.zeros(model.nv)])
        advance(model.double, x, u)
    except (SimulationError, GradientError) as error:
        return Refusal(f"its standing cannot be stepped: {error}")
    touching = {contact.body_a for contact in contacts_of_the_step(model)}
    lifted = [foot.name for foot in robot.feet if not touching & set(foot.bodies)]
    others = touching.difference(*[foot.bodies for foot in robot.feet])
    if lifted or others:
        fault = f"{lifted[0]} is off the ground" if lifted else f"{min(others)} is on the ground"
        return Refusal(f"at rest {fault}")
    return Rest(x, u)


def regulator(robot: Legged, x: Array, u: Array) -> Array:
    """(nu, nt) the gain that keeps the state x (nx,) under u (nu,) by feedback through the step with contact."""
    model, space = robot.model, robot.space
    by_x, by_u, _ = linearize(model, x[None], u[None])
    x_next = np.array(advance(model.double, x, u))
    A, B = np.hsplit(space.jacobian(x, x_next, by_x[0], by_u[0]), [space.size])
    Q, R = weights(robot, u)
    P, gain = Q, np.zeros((model.nu, space.size))
    for _ in range(SWEEPS):
        gain = np.asarray(np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A), dtype=float)
        P = Q + A.T @ P @ (A - B @ gain)
        P = (P + P.T) / 2
    return gain


def weights(robot: Legged, u: Array) -> tuple[Array, Array]:
    """(Q (nt, nt), R (nu, nu)) of a regulator about inputs of the size of u (nu,)."""
    nv = robot.model.nv
    Q = np.diag(np.concatenate([np.full(nv, NEAR**-2.0), np.full(nv, SLOW**-2.0)]))
    size = EFFORT_SHARE * np.maximum(np.abs(u), 0.1 * float(np.max(np.abs(u))))
    return Q, np.diag(size**-2.0)


def input_limits(model: Model) -> tuple[Array, Array]:
    """(lower, upper) (nu,) of the inputs."""
    return np.array([u.lower for u in model.contract.inputs]), np.array([u.upper for u in model.contract.inputs])
