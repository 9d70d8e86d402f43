"""Initial guesses of a plan: postures that reach the goals, collision-free paths, and motions along the paths.

OMPL's RRT-Connect finds paths around obstacles, since Drake has no sampling-based planner. These are only initial
guesses; the resulting plans are verified like any other plan.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.math import BsplineBasis
from pydrake.trajectories import BsplineTrajectory

from drake_diff._base.arrays import Array, finite_array
from drake_diff.comparison.recordings import read_recording, steps_between
from drake_diff.exceptions import InputError, MissingDependencyError, ModelError, SimulationError, UnknownNameError
from drake_diff.legs.inverse_kinematics import PointTarget, Wish, inverse_kinematics
from drake_diff.legs.motion import smooth
from drake_diff.mechanics.quantities import frame_position
from drake_diff.model.assembly import closed
from drake_diff.model.model import Model
from drake_diff.model.plant import frame_named
from drake_diff.model.step import advance
from drake_diff.model.tangent import tangent_space
from drake_diff.optimize.problem.goals import FrameGoal
from drake_diff.optimize.problem.obstacles import ClearanceConstraint, Obstacle, clearances
from drake_diff.optimize.problem.problem import Problem
from drake_diff.planning.robot import (
    HOLD_SHARE,
    LONGER,
    MOST_IF_STIFF,
    SHORTEST,
    TOUCHING,
    Robot,
    coordinates_of,
    drive,
    efforts_for,
    floating,
    independent,
    places_of_velocities,
    share_to_hold,
    shares,
)

# Postures that reach goals.
REACHED = 1e-6  # [m]
LIMIT_MARGIN = 0.01  # of a joint's range: the distance from its limits
SEEDS, MORE_SEEDS = 12, 40  # initial guesses of inverse kinematics, without and with obstacles
CANDIDATES = 3  # maximum number of postures
MOVE = 0.25  # of a joint's range: the maximum distance of a random goal
RANDOM, DRAWS, NEARER = 2, 50, 0.5  # random goals, samples per goal, and reduction of the samples' distance
SOON = 2.0  # [s] time in which the joints can reach a random goal
# Paths of postures.
BENDS, WIDTH = 100, 0.4  # number of random bent paths, and their maximum deflection relative to a joint's range
MOST_LINES = 2
NEAR = 0.04  # [rad or m] distance between the checked postures of a path
SEARCHES, MOST_LOOKS, LONGEST_LEG = 3, 20_000, 0.6  # searches, checks per search, [rad or m] step length of a search
CONTROLS, CUBIC = (8, 12, 20, 40), 4  # control points of a spline along a path (the fewest without collision); order
# Motions.
FASTEST = 1.0  # [rad/s or m/s] peak speed of a joint without a velocity limit
OF_SPEED, OF_EFFORT, OF_PULL = 0.6, 0.9, 0.8  # share of speed limits, of effort limits, and of a controller's effort
LONGEST = 6.0  # [s] limit of a motion's duration
STEPS = (30, 100)  # minimum and maximum number of steps of a plan
PEAK = 1.875  # the maximum slope of the smooth profile from 0 to 1
PROBED = 1e-3  # [rad/s or m/s] size of a change by which the effect of an input is measured
SETTLED = 1e-3  # [rad or m] largest motion in a step of a joint at rest
CORRECTIONS, EXACT = 3, 1e-11  # corrections of an input; tolerance [rad/s or m/s]
PULL, DAMP = 30.0, 9.0  # [1/s^2] and [1/s] gains of a controller
# Flights: maximum [m/s], [rad/s]; ranges [m], [rad] and height [m] of a random goal; number of random goals.
FLY_SPEED, FLY_TURN, FLY_FAR, FLY_TURNED, FLY_UP, FLIGHTS = 1.0, 1.0, (1.0, 1.0, 0.5), 1.0, 0.75, 20


@dataclass(frozen=True, eq=False)
class Goals:
    """Goals of one robot: positions (3,) of frames, and joint positions by index in q; a random goal if both are empty.

    `avoid` are the obstacles.
    """

    frames: Mapping[str, Array]
    joints: Mapping[int, float]
    avoid: tuple[Obstacle, ...] = ()

    @property
    def is_free(self) -> bool:
        """Whether no goal is given."""
        return not self.frames and not self.joints


def read_goals(model: Model, goals: Mapping[str, Any], avoid: Sequence[Obstacle] = ()) -> Goals:
    """Read the `goals` for `model`: a name with three numbers is a frame, and a name with one number is a joint.

    Raises UnknownNameError if there is no such frame or joint, and InputError for invalid numbers.
    """
    places: dict[str, Array] = {}
    angles: dict[int, float] = {}
    of_joints = {name.rpartition("_")[0]: i for i, name in enumerate(model.position_names)}
    for name, value in goals.items():
        numbers = np.atleast_1d(np.asarray(value, dtype=float))
        if len(numbers) == 3:
            frame_position(model, name)  # raises UnknownNameError with the existing frames
            places[name] = finite_array(f"goal {name} [m]", numbers, (3,))
        elif len(numbers) == 1:
            if name not in of_joints or (model.nq != model.nv and of_joints[name] < model.nq - model.nv + 6):
                raise UnknownNameError("goal: joint", got=name, known=of_joints)
            index = of_joints[name]
            low, high = model.contract.positions[index].lower, model.contract.positions[index].upper
            if not low <= numbers[0] <= high:
                expected = f"a position within its limits [{low:g}, {high:g}]"
                raise InputError(f"goal {name}", got=numbers[0], expected=expected)
            angles[index] = float(numbers[0])
        else:
            expected = "three numbers (the position of a frame) or one number (the position of a joint)"
            raise InputError(f"goal {name}", got=f"{len(numbers)} numbers", expected=expected)
    for obstacle in avoid:
        if not isinstance(obstacle, Obstacle):
            raise InputError("avoid", got=repr(obstacle)[:80], expected="SphereObstacles and BoxObstacles")
    return Goals(places, angles, tuple(avoid))


def check_frames_move(robot: Robot, frames: Mapping[str, Array]) -> None:
    """Raise InputError if a frame with a goal belongs to a floating base that a repair fixed, with the reason."""
    plant, why = robot.model.plant, "; ".join(repair for repair in robot.repairs if "base='weld'" in repair)
    fixed = {int(body.index()) for body in plant.GetBodiesWeldedTo(plant.world_body())}
    for name in frames:
        if why and int(frame_named(plant, "goal", name).body().index()) in fixed:
            raise InputError(f"goal {name}", got=why, expected="a frame that moves")


def recorded_plan(
    path: Path, model: Model, goals: Mapping[str, Any], avoid: Sequence[Obstacle]
) -> tuple[Problem, Array, Array]:
    """Read a plan, and return the problem that it should solve, with its states (N+1, nx) and inputs (N, nu).

    The problem starts at the plan's first state, in steps of the plan's period. With `goals`, as those of `plan`, it
    ends there at rest, and without goals at the plan's last state.

    Raises InputError if the period is not constant, and the errors of `read_recording` and `read_goals`.
    """
    recording = read_recording(path, model)
    period = float(recording.times[-1] - recording.times[0]) / len(recording.us)
    steps_between(recording, period)
    task, x_goal = read_goals(model, goals, avoid), np.array(recording.xs[-1])
    if not task.is_free:
        x_goal = np.concatenate([np.full(model.nq, np.nan), np.zeros(model.nv)])
        x_goal[list(task.joints)] = list(task.joints.values())
    problem = Problem(
        model.at_time_step(period),
        x0=recording.xs[0],
        x_goal=x_goal,
        num_steps=len(recording.us),
        goals=[*(FrameGoal(name, position=position) for name, position in task.frames.items()), *task.avoid],
    )
    return problem, np.asarray(recording.xs), np.asarray(recording.us)


@dataclass(frozen=True, eq=False)
class Space:
    """The free space of a robot: postures without self-collision, at a distance from obstacles."""

    robot: Robot
    clear: tuple[ClearanceConstraint, ...]

    @classmethod
    def around(cls, robot: Robot, avoid: Sequence[Obstacle]) -> "Space":
        """Make the free space of a robot with obstacles to avoid."""
        return cls(robot, tuple(clearances([c for obstacle in avoid for c in obstacle.bind(robot.model)])))

    def lacking(self, qs: Array) -> Array:
        """Return the largest violation (K,) [m] of an obstacle's margin at postures qs (K, nq), negative if none."""
        xs = np.hstack([qs, np.zeros((len(qs), self.robot.model.nv))])
        return np.asarray(np.max([np.full(len(qs), -np.inf), *(c.lacking(xs) for c in self.clear)], axis=0))

    def is_free(self, qs: Array) -> bool:
        """Return whether all postures qs (K, nq) are in the free space."""
        return bool(np.max(self.lacking(qs)) <= 0) and all(self.robot.overlap(q) <= TOUCHING for q in qs)

    def check(self, subject: str, q: Array) -> None:
        """Raise InputError if posture q (nq,) is too close to an obstacle."""
        for c in self.clear:
            c.check(subject, np.concatenate([q, np.zeros(self.robot.model.nv)]))

    def obstruction(self, q: Array) -> str:
        """Describe the obstacle that is too close in posture q (nq,), or return ""."""
        x = np.concatenate([q, np.zeros(self.robot.model.nv)])
        worst = max(self.clear, key=lambda c: float(c.lacking(x[None])[0]), default=None)
        is_near = worst is not None and worst.lacking(x[None])[0] > 0
        return str(worst.check_at(x, "the goal", 0.0)) if is_near and worst else ""


def postures(robot: Robot, task: Goals, seed: int) -> list[Array]:
    """Return postures (nq,) that reach the goals, sorted by distance from the start; raise ModelError if none exist.

    Without goals, the postures are random: within the limits, without overlap, and such that the motors can hold them.
    """
    random, space = np.random.default_rng([seed, 1]), Space.around(robot, task.avoid)
    if task.is_free:
        return _random_goals(space, random)
    start, fixed = robot.q.copy(), np.zeros(robot.model.nq, dtype=bool)
    for index, value in task.joints.items():
        start[index], fixed[index] = value, True
    if not task.frames:
        return [_with_closed_loops(space, start, fixed)]
    candidates, nearest, blocked = list[Array](), np.inf, ""
    for i in range(MORE_SEEDS if task.avoid else SEEDS):
        if len(candidates) >= CANDIDATES and i >= SEEDS:
            break
        first = start if i == 0 else np.where(fixed, start, random.uniform(robot.lower, robot.upper))
        q, off = _reach(robot, task, first, fixed)
        nearest = min(nearest, off)
        if off <= REACHED and robot.overlap(q) <= TOUCHING and share_to_hold(robot.model, q) <= 1.0:
            blocked = space.obstruction(q)
            candidates += [] if blocked else [q]
    if not candidates and blocked:
        expected = f"a goal that one of {MORE_SEEDS} postures reaches clear of all obstacles"
        raise InputError(f"goal {', '.join(task.frames)}", got=blocked, expected=expected)
    if not candidates:
        criteria = "within all limits, without overlap and with loads that the motors can hold"
        if nearest > REACHED:
            criteria = f"within all limits: the nearest of {SEEDS} postures is {nearest:.3g} m away"
        raise ModelError(f"no posture was found with {', '.join(task.frames)} at its goal, {criteria}")
    return sorted(candidates, key=lambda q: float(np.max(np.abs(q - robot.q))))[:CANDIDATES]


def _with_closed_loops(space: Space, q: Array, fixed: NDArray[np.bool_]) -> Array:
    """Return the posture near q (nq,) with closed loops and unchanged `fixed` (nq,) and perhaps steered joints."""
    robot, model = space.robot, space.robot.model
    target = closed(model, q, fixed | coordinates_of(model, robot.steered))
    target = closed(model, q, fixed) if target is None else target
    if target is None:
        names = ", ".join(np.array(model.position_names)[fixed])
        raise ModelError(f"no posture near the start has closed loops and {names} at the goal")
    space.check("goal", target)
    return target


def _reach(robot: Robot, task: Goals, first: Array, fixed: Array) -> tuple[Array, float]:
    """Return the posture closest to `first` (nq,) within the limits with the frames at their goals, and the error [m].
    Entries that are `fixed` (nq,) do not change."""
    model, plant = robot.model, robot.model.double.plant
    margin, tolerance = LIMIT_MARGIN * (robot.upper - robot.lower), REACHED / 10
    low, high = np.where(fixed, first, robot.lower + margin), np.where(fixed, first, robot.upper - margin)
    frames = [plant.get_frame(frame_named(model.plant, "goal", name).index()) for name in task.frames]
    goals = list(task.frames.values())
    targets = [PointTarget(frame, np.zeros(3), goal, tolerance) for frame, goal in zip(frames, goals, strict=True)]
    q = inverse_kinematics(model, np.clip(first, low, high), targets, Wish(first, np.ones(model.nv)), low, high)
    positions = [frame.CalcPoseInWorld(model.double.context).translation() for frame in frames]
    return np.clip(q, low, high), float(np.max(np.abs(np.subtract(positions, goals))))


def _random_goals(space: Space, random: np.random.Generator) -> list[Array]:
    goals = [q for q in (_random_posture(space, random) for _ in range(RANDOM)) if q is not None]
    if not goals:
        message = "no goal posture was found: no random posture is free of overlap and can be held by the motors"
        raise ModelError(f"{message}: give a goal")
    return goals


def _random_posture(space: Space, random: np.random.Generator) -> Array | None:
    """Sample a posture near the start, within the limits, without overlap, that the motors can hold, preferably within
    HOLD_SHARE; return None if there is none."""
    robot = space.robot
    far = speed_limits(robot.model) * min(SOON, _durations(robot, 0.0)[1]) / PEAK
    reach = np.minimum(MOVE * (robot.upper - robot.lower), far)
    margin = 0.2 * MOVE * (robot.upper - robot.lower)
    best, least = None, 1.0
    for i in range(DRAWS):
        fraction = NEARER ** (i // (DRAWS // 5))  # some robots can only hold nearby postures
        q = robot.q + fraction * random.uniform(-1, 1, len(reach)) * reach
        target = robot.closed(np.clip(q, robot.lower + margin, robot.upper - margin))
        if target is None or np.any((target < robot.lower) | (target > robot.upper)):
            continue
        passed = PostureLine("", np.array([robot.q, target]), robot).at(np.array([0.25, 0.5, 0.75, 1.0]))
        if any(robot.overlap(q) > TOUCHING for q in passed) or space.obstruction(target):
            continue
        load = max(share_to_hold(robot.model, q) for q in passed[[1, 3]])
        if load <= HOLD_SHARE:
            return target
        if load < least:
            best, least = target, load
    return best


@dataclass(frozen=True, eq=False)
class PostureLine:
    """A path of postures: a clamped B-spline with control points (K, nq), from the first to the last control point.

    Along it, the robot's loops are closed where possible, without a change of the steered joints.
    """

    name: str
    controls: Array
    robot: Robot

    def at(self, s: Array) -> Array:
        """Return the postures (M, nq) at s (M,), from 0 at the start to 1 at the end."""
        count = len(self.controls)
        curve = BsplineTrajectory(BsplineBasis(min(count, CUBIC), count), [c[:, None] for c in self.controls])
        postures = [(q, self.robot.closed(q)) for q in np.asarray(curve.vector_values(s)).T]
        return np.array([q if near is None else near for q, near in postures])

    @property
    def length(self) -> float:
        """The length [rad or m] of the control polygon, using the largest coordinate of each segment."""
        return float(np.sum(np.max(np.abs(np.diff(self.controls, axis=0)), axis=1)))

    @property
    def postures(self) -> Array:
        """Closely spaced postures (M, nq) from the first to the last."""
        return self.at(np.linspace(0, 1, 2 + int(np.ceil(self.length / NEAR))))


def lines(space: Space, target: Array, seed: int) -> list[PostureLine]:
    """Return paths from the robot's start to `target` (nq,), the best first.

    The result is the straight path if it is collision-free, or else the shortest collision-free paths among bent paths
    and RRT-Connect searches, or else the straight path, which a solver may correct. Raises MissingDependencyError if
    only a search could help and OMPL is not installed.
    """
    robot = space.robot
    straight = PostureLine("a straight line in joint space", np.array([robot.q, target]), robot)
    if space.is_free(straight.postures):
        return [straight]
    random = np.random.default_rng([seed, 3])
    can_search, candidates = find_spec("ompl") is not None, []
    bent = "a curve in joint space" if can_search else "a curve in joint space (no search: ompl is not installed)"
    for i in range(BENDS):
        pull = WIDTH * (i + 1) / BENDS * random.uniform(-1, 1, len(target)) * (robot.upper - robot.lower)
        middle = np.clip((robot.q + target) / 2 + pull, robot.lower, robot.upper)
        line = PostureLine(bent, np.array([robot.q, middle, target]), robot)
        if space.is_free(line.postures):
            candidates.append(line)
    if not (can_search or candidates):
        raise MissingDependencyError("a path around the obstacles needs a search by OMPL: pip install ompl")
    searched = [_search(space, target, seed + i) for i in range(SEARCHES if can_search else 0)]
    candidates += [line for line in searched if line is not None]
    return sorted(candidates, key=lambda line: line.length)[:MOST_LINES] or [straight]


def _search(space: Space, target: Array, seed: int) -> PostureLine | None:
    """Search for a path around obstacles by RRT-Connect; return None if none is found.

    Source: Kuffner and LaValle, "RRT-Connect: an efficient approach to single-query path planning", 2000.
    """
    chain = _chain(space, target, seed)
    if chain is None:
        return None
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))])
    for count in CONTROLS:
        knots = np.array(BsplineBasis(CUBIC, count).knots())
        even = along[-1] * np.array([np.mean(knots[i + 1 : i + CUBIC]) for i in range(count)])  # for a uniform speed
        controls = np.array([np.interp(even, along, column) for column in chain.T]).T
        line = PostureLine("a path found by RRT-Connect", controls, space.robot)
        if space.is_free(line.postures):
            return line
    return None


def _chain(space: Space, target: Array, seed: int) -> Array | None:
    """Return postures (K, nq) from the start to `target`, connected by collision-free straight lines, or None."""
    from ompl import base, geometric, util

    robot, looks = space.robot, 0
    start, size = robot.q, len(target)

    def values(state: Any) -> Array:
        return np.array(state[0:size])

    def is_free(qs: Array) -> bool:
        nonlocal looks
        looks += len(qs)
        return space.is_free(qs)

    def is_over() -> bool:
        nonlocal looks
        looks += 1
        return looks > MOST_LOOKS

    class Lines(base.MotionValidator):  # type: ignore[misc]
        def checkMotion(self, a: Any, b: Any) -> bool:
            ends = np.array([values(a), values(b)])
            return is_free(PostureLine("", ends, robot).postures)

    level = util.getLogLevel()
    util.setLogLevel(util.LOG_NONE)
    try:
        util.RNG.setSeed(seed + 1)  # 0 is not a valid seed
        limits = base.RealVectorBounds(size)
        for i, ends in enumerate(zip(robot.lower, robot.upper, start, target, strict=True)):
            limits.setLow(i, min(ends))
            limits.setHigh(i, max(ends))
        states = base.RealVectorStateSpace(size)
        states.setBounds(limits)
        information = base.SpaceInformation(states)
        information.setStateValidityChecker(lambda state: is_free(values(state)[None]))
        information.setMotionValidator(Lines(information))
        information.setup()
        first, last = information.allocState(), information.allocState()
        first[0:size], last[0:size] = start.tolist(), target.tolist()
        problem = base.ProblemDefinition(information)
        problem.setStartAndGoalStates(first, last)
        planner = geometric.RRTConnect(information)
        planner.setRange(LONGEST_LEG)
        planner.setProblemDefinition(problem)
        planner.setup()
        planner.solve(base.PlannerTerminationCondition(is_over))
        path = problem.getSolutionPath() if problem.hasExactSolution() else None
        if path is None:
            return None
        geometric.PathSimplifier(information).simplify(path, base.PlannerTerminationCondition(is_over))
        return np.array([values(path.getState(i)) for i in range(path.getStateCount())])
    finally:
        util.setLogLevel(level)


@dataclass(frozen=True, eq=False)
class MotionGuess:
    """A motion xs (N+1, nx) of `model` with inputs us (N, nu), and its name.

    `effort` is the largest share of an effort limit along the motion, and `depth` [m] its deepest overlap.
    """

    name: str
    model: Model
    xs: Array
    us: Array
    effort: float
    depth: float = 0.0

    @property
    def num_steps(self) -> int:
        """The number of steps."""
        return len(self.us)

    def in_steps(self, count: int) -> "MotionGuess":
        """Resample the motion at `count` + 1 uniform times, for a search with a free horizon."""
        now, then = np.linspace(0, 1, count + 1), np.linspace(0, 1, len(self.xs))
        xs = np.array([np.interp(now, then, column) for column in self.xs.T]).T
        us = np.array([np.interp((now[1:] + now[:-1]) / 2, (then[1:] + then[:-1]) / 2, c) for c in self.us.T]).T
        return replace(self, xs=xs, us=us)


def speed_limits(model: Model) -> Array:
    """Return speed limits (nv,) for initial guesses; FASTEST for joints without a velocity limit."""
    limits = np.array([min(abs(v.lower), abs(v.upper)) for v in model.contract.velocities])
    return np.where(np.isfinite(limits), np.minimum(OF_SPEED * limits, 5 * FASTEST), FASTEST)


def along(robot: Robot, line: PostureLine, *, slower: float = 1.0) -> MotionGuess:
    """Return the smooth motion along a path, at rest at both ends, with its inputs.

    It is as fast as the joints' speed and effort limits allow, within the limits of this module. Raises SimulationError
    if Drake cannot take a step, and InputError if the motion needs more steps that resolve a spring than a plan has.
    """
    t = np.linspace(0, 1, 101)
    speeds = np.abs(np.gradient(line.at(smooth(t)), t, axis=0))
    duration, longest = _durations(robot, float(np.max(speeds / speed_limits(robot.model), initial=0.0)))
    name = line.name if slower == 1 else f"{line.name}, {slower:g} times slower"
    duration = float(np.clip(slower * duration, SHORTEST, longest))
    guess = _timed(robot, name, line.at, duration)
    while guess.effort > OF_EFFORT and duration < longest:
        duration = min(1.5 * duration, longest)
        guess = _timed(robot, name, line.at, duration)
    return guess


def _durations(robot: Robot, wanted: float) -> tuple[float, float]:
    """Return the duration [s] of a motion nearest to `wanted`, and the longest, in steps that resolve the springs."""
    step = robot.model.time_step
    longest = max(SHORTEST, min(LONGEST, LONGER * MOST_IF_STIFF * step)) if robot.stiff else LONGEST
    if longest < min(wanted, LONGEST):
        got = f"a motion of {wanted:.3g} s, in which the spring of {robot.stiff} needs time steps of {step:g} s"
        raise InputError("goals", got=got, expected=f"a nearer goal, as a plan has at most {MOST_IF_STIFF} steps")
    return max(wanted, SHORTEST), longest


def flight(robot: Robot, places: Mapping[str, Array], seed: int) -> MotionGuess:
    """Return a smooth flight of floating bodies that moves the frames of `places` to their positions (3,) [m], at rest.

    Without `places`, each body flies to a random position along a straight line without overlaps, and rotates about
    the vertical.
    """
    model, random, still = robot.model, np.random.default_rng([seed, 4]), np.zeros(robot.model.nv)
    free, space = floating(model), tangent_space(model)
    guesses = list[MotionGuess]()
    for _ in range(1 if places else FLIGHTS):
        way = np.zeros(model.nv)
        for _, _, v in () if places else free:
            way[v + 3 : v + 6] = flown(random)
            way[v + 2] = FLY_TURNED * random.uniform(-1, 1)
        for name, position in places.items():
            v = _carrier(robot, name)
            way[v + 3 : v + 6] = position - frame_position(model, name)(np.append(robot.q, still))
        speeds = [max(np.linalg.norm(way[v + 3 : v + 6]) / FLY_SPEED, abs(way[v + 2]) / FLY_TURN) for _, _, v in free]
        duration = min(_durations(robot, PEAK * float(max(speeds))))

        def postures_at(s: Array, way: Array = way) -> Array:
            moves = [np.append(fraction * way, still) for fraction in s]
            return np.array([space.plus(np.append(robot.q, still), move)[: model.nq] for move in moves])

        guesses.append(_timed(robot, "a straight line through the air", postures_at, duration))
        if guesses[-1].depth <= TOUCHING:
            break
    return min(guesses, key=lambda guess: guess.depth)


def flown(random: np.random.Generator) -> Array:
    """Return a random displacement (3,) [m] in the air."""
    return np.array(FLY_FAR) * random.uniform(-1, 1, 3) + np.array([0.0, 0.0, FLY_UP])


def _carrier(robot: Robot, name: str) -> int:
    """Return the velocity index of the floating body that carries a frame or body."""
    locate, still = frame_position(robot.model, name), np.zeros(robot.model.nv)
    free = floating(robot.model)
    for _, q_start, v_start in free:
        moved = robot.q.copy()
        moved[q_start + 4] += 1.0
        if np.any(locate(np.concatenate([moved, still])) != locate(np.concatenate([robot.q, still]))):
            return v_start
    raise InputError("goals", got=name, expected=f"a frame that floats: {', '.join(label for label, _, _ in free)}")


def _timed(robot: Robot, name: str, postures_at: Callable[[Array], Array], duration: float) -> MotionGuess:
    """Return the motion through postures (M, nq) at s (M,) from 0 to 1 in `duration` [s], with its inputs."""
    model = robot.model
    steps = int(np.clip(round(duration / model.time_step), STEPS[0], MOST_IF_STIFF if robot.stiff else STEPS[1]))
    if not robot.stiff and duration / steps > LONGER * model.time_step:
        model = model.at_time_step(float(f"{duration / steps:.1g}"))
    # It reaches the goal one step before the end and rests there: Drake's step uses the velocity after the step.
    path = postures_at(smooth(np.clip(np.arange(steps + 1) / (steps - 1), 0.0, 1.0)))
    space, still = tangent_space(model), np.zeros(model.nv)
    xs, us = [np.append(robot.q, still)], list[Array]()
    for q in path[1:]:
        way = space.minus(np.append(q, still), np.append(xs[-1][: model.nq], still))[: model.nv]
        u, x_next = _inputs(model, xs[-1], way / model.time_step, robot.steered)
        us.append(u)
        xs.append(x_next)
    depth = max(robot.overlap(x[: model.nq]) for x in xs[:: max(1, steps // 25)])
    effort = float(np.max(shares(model, model.efforts(np.array(xs[1:]), np.array(us)))))
    return MotionGuess(name, model, np.array(xs), np.array(us), effort, depth)


def _inputs(model: Model, x: Array, wanted: Array, steered: NDArray[np.bool_] | None = None) -> tuple[Array, Array]:
    """Return the inputs (nu,) for a step from x (nx,) to the velocities `wanted` (nv,), and the next state (nx,).

    The inputs correct only `steered` velocities, all by default.
    """
    twin, nq, per_input = model.double, model.nq, model.servo_gains[0]
    counted = np.ones(model.nv, dtype=bool) if steered is None else steered
    # The step's equation with implicit damping; numerical probing of the step would meet joint limits.
    efforts = efforts_for(model, x, np.where(counted, wanted - x[nq:], 0.0))
    effect, u = drive(model, x[:nq]) * per_input, model.commands(x, wanted, efforts)
    for i in range(CORRECTIONS + 1):
        if not counted.all():  # an input beyond its limits has no effect
            u = np.clip(u, model.inputs.lower, model.inputs.upper)
        x_next = np.array(advance(twin, x, u))
        off = (wanted - x_next[nq:])[counted]
        if i == CORRECTIONS or np.max(np.abs(off), initial=0.0) < EXACT:
            break
        if i == 1 or not counted.all():  # the equation lacks controllers, limits, and the rotation of thrusters
            reach = np.max(np.abs(effect), axis=0)
            sizes = np.divide(PROBED, reach, out=1 / per_input, where=reach > 0)
            sizes = np.where(u + sizes > model.inputs.upper, -sizes, sizes)
            probes = [np.array(advance(twin, x, u + d))[nq:] - x_next[nq:] for d in np.diag(sizes)]
            effect = np.array(probes).T / sizes
        u = u + np.linalg.lstsq(effect[counted], off, rcond=None)[0]
    return np.asarray(u), x_next


def settled(robot: Robot) -> Robot | None:
    """Return the robot with the joints of its loops that no motor steers where springs and limits bring them.

    Returns None if they do not stay there or if Drake cannot take a step.
    """
    if not has_passive_loops(robot):
        return robot
    model, still = robot.model, robot.q
    try:
        rest = _timed(robot, "", lambda s: np.tile(still, (len(s), 1)), STEPS[1] * model.time_step).xs[-1]
    except (ModelError, SimulationError):
        return None
    q, chosen = rest[: model.nq], coordinates_of(model, robot.steered)
    is_still = np.all(np.abs(rest[model.nq :]) * model.time_step < SETTLED)
    inside = np.all(((robot.lower <= q) & (q <= robot.upper))[chosen])
    return replace(robot, q=q) if is_still and inside else None


def has_passive_loops(robot: Robot) -> bool:
    """Return whether springs, gravity and limits, and not motors, determine a joint of the robot's loops."""
    return robot.steered is not None and bool(np.any(independent(robot.model, robot.q) & ~robot.steered))


def by_controller(
    robot: Robot, model: Model, target: Array, *, steps: int, reach: float, name: str
) -> MotionGuess | None:
    """Simulate `model` with controllers that move each joint toward `target` (nq,) by a fraction `reach` of the way.

    Returns None if Drake cannot take a step.
    """
    x = np.concatenate([robot.q, np.zeros(model.nv)])
    limits = np.minimum(model.effort_limits, 1e4)
    xs, us = [x], []
    try:
        effect = drive(model, robot.q)
        joint_v = np.argmax(np.abs(effect), axis=0)  # the velocity on which an input acts most
        gain = model.time_step / effect[joint_v, np.arange(model.nu)]
        joint_q = places_of_velocities(model)[joint_v]
        for k in range(steps):
            s = np.array(min(1.0, 1.25 * (k + 1) / steps))
            aim = robot.q[joint_q] + reach * smooth(s) * (target[joint_q] - robot.q[joint_q])
            u = gain * (PULL * (aim - x[joint_q]) - DAMP * x[model.nq + joint_v])
            efforts = np.clip(u, -OF_PULL * limits, OF_PULL * limits)
            u = model.commands(x, x[model.nq :], efforts)
            x = np.array(advance(model.double, x, u))
            xs.append(x)
            us.append(u)
    except SimulationError:
        return None
    depth = max(robot.overlap(x[: model.nq]) for x in xs) if model is robot.apart else 0.0
    effort = float(np.max(shares(model, model.efforts(np.array(xs[1:]), np.array(us)))))
    return MotionGuess(name, model, np.array(xs), np.array(us), effort, depth)
