"""Plan from a robot file to a verified plan in one call; the function behind `drake-diff plan`."""

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal, ShowsItsRepr
from drake_diff.certificates.audit import audit
from drake_diff.certificates.finding import Finding
from drake_diff.derivatives.step import differentiate_step
from drake_diff.exceptions import DrakeDiffError, InputError, ModelError, ModelWarning, WriteError
from drake_diff.legs.feet import Legs
from drake_diff.legs.standing import FRAME_TOLERANCE, SLOW_ENOUGH, Rest, random_shift, shift_to, state_limits
from drake_diff.model.assembly import single_coordinates
from drake_diff.model.model import Model
from drake_diff.optimize.options import Options
from drake_diff.optimize.problem.constraint import Bounds
from drake_diff.optimize.problem.cost import QuadraticCost
from drake_diff.optimize.problem.goals import FrameGoal
from drake_diff.optimize.problem.obstacles import Obstacle, along_steps, doubts_of
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.solution import Solution, Status
from drake_diff.optimize.solve import solve
from drake_diff.planning.guesses import (
    OF_EFFORT,
    Goals,
    MotionGuess,
    Space,
    along,
    by_controller,
    check_frames_move,
    flight,
    flown,
    has_passive_loops,
    lines,
    postures,
    read_goals,
    settled,
)
from drake_diff.planning.robot import (
    TOUCHING,
    Robot,
    coordinates_of,
    floating,
    independent,
    load_robot,
    of_joints,
    places_of_velocities,
)
from drake_diff.runs.directory import check_place, is_taken, name_of, written_whole
from drake_diff.runs.measurement import measure
from drake_diff.runs.plan_record import PlanRecord
from drake_diff.runs.save import keep_plan, plan_kept, write_run
from drake_diff.runs.verify import Verification, verify_own

TIMES = (None, "least")
TRIED_TWICE = 36  # velocities: for a larger robot on its feet, a second goal would take 30 s more
SMALL = 7  # velocities: larger robots get any smooth motion, as an optimal one takes minutes
FASTER = (0.02, 2.0)  # relative to the duration of the initial guess: the range of a least time
SPEED_WEIGHT = 0.01  # of a speed relative to an effort, both as shares of their limits
FEW = 40  # initial steps of a least-time problem, which is refined: a slow guess has more than a fast motion needs
FINE, COARSE = 1e-5, 1e-4  # interval error tolerances; inputs with jumps need ever more intervals for a smaller one
BESIDE = 0.05  # [rad or m] margin of each joint around the range of a guess
LOOKS = 3  # overlap is checked at every third of the ten points in each step
BUDGET, LONG_BUDGET = 40.0, 120.0  # [s] wall-clock limits of one attempt, without and with a longer search
REACHES = ((0.5, 50), (0.25, 50), (0.1, 50), (0.1, 25), (0.1, 12))  # fractions of the distance, and numbers of steps
# For contact: spheres have derivatives, and this contact does not depend on the time step.
GENTLE: dict[str, Any] = {"time_step": 0.005, "meshes": "spheres", "contact_geometry": "corner_spheres"}
GENTLE |= {"near_rigid": 0.1, "relaxation_time": 0.02}
SMALLEST_WAY = 0.01  # [rad or m] for the coordinate with the largest motion; smaller motions are rejected
NOTHING = "no initial guess was found that the motors can follow within the limits: give a goal for joints"
GENTLY = ((0.25, 100), (0.1, 100))
COMES_TO_REST = 400  # steps of GENTLE until the robot is at rest
WIDTH, DRAWS = 0.3, 30  # of a coordinate's range, and the number of samples of another start

Report = Callable[[str, str], None]


@dataclass(frozen=True, eq=False, repr=False)
class Plan(ShowsItsRepr):
    """The result of `plan` for a robot file, from its repairs to the verdict on the artifact.

    Attributes:
        model: The planned model.
        repairs: A sentence for each repair of the file.
        findings: The findings of `audit` on the repaired model.
        solution: The plan.
        record: The record that was written.
        verification: The result of `verify` on the directory.
        directory: The directory that was written.
        tried: A sentence for each attempt with its outcome.
        apart: Whether the last attempt was verified and no shapes of the robot overlap along it.
    """

    model: Model
    repairs: tuple[str, ...]
    findings: tuple[Finding, ...]
    solution: Solution
    record: PlanRecord
    verification: Verification
    directory: Path
    tried: tuple[str, ...]
    apart: bool

    @property
    def success(self) -> bool:
        """Whether the plan was verified and its artifact was reproduced."""
        return self.apart and self.record.verdict == "pass" and self.verification.holds

    @property
    def lines(self) -> tuple[str, ...]:
        """A summary in ten lines."""
        m, s = self.model, self.solution
        severe = [f for f in self.findings if f.severity in ("error", "warning")]
        certificates = [c.verdict for c in s.certificates]
        agreeing = f"{certificates.count('agree')} of {len(certificates)} agree"
        far = np.max(np.abs(s.xs[-1] - s.problem.x0)[: m.nq])
        path = self.directory
        return (
            f"robot     {m.name}: {m.nq} positions, {m.nv} velocities, {m.nu} motors",
            f"repaired  {'; '.join(self.repairs) or 'nothing'}",
            f"audit     {', '.join(sorted({f'{f.severity} {f.code}' for f in severe})) or 'nothing to warn of'}",
            f"goal      {self._goal(far)}",
            f"guesses   {'; '.join(self.tried)}",
            f"solved    {s.method}, {len(s.us)} intervals in {s.horizon:.3g} s, cost {s.cost:.4g}{self._optima}",
            f"gradients {agreeing}",
            f"plan      {s.message}",
            f"verify    {self.verification.verdict}: {self.verification.sentence[:200]}",
            f"wrote     {path}: {', '.join(self.record.file_names)}",
        )

    @property
    def _optima(self) -> str:
        costs = [optimum["cost"] for optimum in self.solution.options.get("optima", ())]
        return f"; optima at cost {', '.join(f'{cost:.4g}' for cost in costs)}" if len(costs) > 1 else ""

    def _goal(self, far: float) -> str:
        sentences = [f"a state {far:.2g} rad or m from the start, after {self.solution.horizon:.3g} s"]
        goals = getattr(self.solution.problem, "goals", ())
        sentences += [str(goal) for goal in goals]
        sentences += doubts_of(goals, self.model)
        return ", ".join(sentences)

    def __repr__(self) -> str:
        return "\n".join(self.lines)


def plan(
    robot: str | Path,
    *,
    goals: Mapping[str, Any] | None = None,
    avoid: Sequence[Obstacle] = (),
    time: str | None = None,
    out: str | Path | None = None,
    seed: int = 0,
    restarts: int = 0,
    meshes: bool = True,
    packages: Mapping[str, str | Path] | None = None,
    report: Report | None = None,
) -> Plan:
    """Load a robot file, repair it, plan a motion to a goal, write the run and verify it.

    Args:
        robot: A URDF, SDF, MJCF (.xml) or .dmd.yaml file.
        goals: The targets at the end, at rest: three numbers [m] for the name of a frame or body, one number [rad or m]
            for the name of a joint. None selects a random reachable state.
        avoid: Obstacles: `SphereObstacle`s and `BoxObstacle`s.
        time: "least" for the shortest time; None for the least effort (for large robots: any smooth motion).
        out: The output directory; `artifacts/plan_<robot>` by default.
        seed: The random seed; the same seed gives the same plan.
        restarts: The number of additional initial guesses of each search, to list other optima and select the cheapest.
        meshes: Whether to copy the meshes to the directory; see `save`.
        packages: The folders of the file's packages by name; see `load_model`.
        report: Called with a stage and a sentence to report progress.

    Returns:
        The `Plan`. Its `success` is true if the plan and its artifact were verified.

    Raises:
        InputError: A goal, an obstacle or an option is invalid.
        ModelError: The file cannot be read, nothing in it can be driven, or a goal cannot be reached.
        ArtifactError: Another process is writing `out`.
        WriteError: A file cannot be written, for example on a full disk; the message says where the plan is.
        KeyboardInterrupt: The planning was interrupted, and `out` has an earlier run; a note says where this run is.

    Example:
        >>> from tempfile import mkdtemp
        >>> from drake_diff.planning import plan
        >>> done = plan("models/pendulum.urdf", goals={"hinge": 0.3}, out=mkdtemp())
        >>> done.success
        True
    """
    path = Path(robot)
    if time not in TIMES:
        raise InputError("time", got=repr(time), expected='None or "least"')
    note = report or (lambda stage, sentence: None)
    if out is not None:
        check_place(Path(out).resolve())  # before the planning, which takes minutes
    with warnings.catch_warnings(), ExitStack() as stack:
        warnings.simplefilter("ignore", ModelWarning)
        note("load", path.name)
        ready = load_robot(path, seed, packages)
        if time and ready.standing is not None:
            got = f"{time!r} for a robot that stands on its feet"
            raise InputError("time", got=got, expected="None: the search for the least time excludes contact")
        directory = Path(out) if out is not None else Path("artifacts") / f"plan_{ready.model.name}"
        folder = stack.enter_context(written_whole(directory))
        note("audit", str(ready.model))
        findings = tuple(audit(ready.model))
        note("guess", f"{len(findings)} finding{'s' * (len(findings) != 1)}")
        task = read_goals(ready.model, goals or {}, avoid)
        check_frames_move(ready, task.frames)
        attempts = (attempt.restarted(restarts) for attempt in _attempts(ready, task, time, seed))
        tried, solutions, apart = _first_that_holds(attempts, note, partial(_keep, folder=folder))
        if not solutions:
            raise ModelError(f"{path}: no plan could be tried: {'; '.join(tried) or NOTHING}")
        best = solutions[-1] if apart else min(solutions, key=lambda s: s.defect + s.goal_error)
        note("save", best.status.value)
        with plan_kept(best, directory.name, folder):
            record = write_run(best, folder, meshes=meshes)
        if best.status is Status.INTERRUPTED and is_taken(directory):
            raise KeyboardInterrupt  # the new run stays next to the earlier run
        stack.close()  # moves the run to its directory
        note("verify", record.verdict)
        verification = verify_own(directory)
    return Plan(ready.model, ready.repairs, findings, best, record, verification, directory, tuple(tried), apart)


@dataclass(frozen=True, eq=False)
class _Attempt:
    """A problem, the initial guess of its search, and the search options.

    `instead` is the next attempt if the robot's shapes overlap along the solution.
    """

    name: str
    robot: Robot
    problem: Problem
    guess: MotionGuess | None
    options: Mapping[str, Any]
    instead: "_Attempt | None" = None

    def restarted(self, restarts: int) -> "_Attempt":
        """Return the attempt with a number of additional initial guesses."""
        return replace(self, options={**self.options, "restarts": restarts})

    def solved(self, progress: Callable[[str], None], on_plan: Callable[[Solution], None]) -> Solution:
        begun = None if self.guess is None else (self.guess.xs, self.guess.us)
        arguments = {**self.options, "options": replace(self.options.get("options", Options()), on_plan=on_plan)}
        return solve(self.problem, initial_guess=begun, progress=progress, **arguments)

    def depth(self, solution: Solution) -> float:
        """Return the deepest overlap [m] of shapes along a solution; 0 if not checked or if steps have all contact."""
        model = self.problem.model
        if model.contract.contact.collision_pairs and (model.options or {}).get("contact") is True:
            return 0.0  # the replays check the penetration
        every, motion = along_steps(solution.times, solution.xs)
        xs = motion(every) if solution.transcribed is None else solution.transcribed.at(every)[0]
        return max(self.robot.overlap(x[: self.problem.model.nq]) for x in xs[::LOOKS])


def _keep(plan: Solution, folder: Path) -> None:
    with plan_kept(plan, name_of(folder), folder):
        keep_plan(plan, folder)


def _first_that_holds(
    attempts: Iterator[_Attempt], note: Report, on_plan: Callable[[Solution], None]
) -> tuple[list[str], list[Solution], bool]:
    """Return the outcome of each attempt, the solutions, and whether the last is verified and without overlap.

    An interrupt ends the attempts.
    """
    tried: list[str] = []
    solutions: list[Solution] = []
    for first in attempts:
        attempt: _Attempt | None = first
        while attempt is not None:
            note("solve", attempt.name)
            try:
                solution = attempt.solved(partial(note, "solve"), on_plan)
            except WriteError:
                raise
            except DrakeDiffError as error:
                tried.append(f"{attempt.name}: failed ({error})")
                break
            depth = attempt.depth(solution) if solution.success else 0.0
            solutions.append(solution)
            tried.append(f"{attempt.name}: {solution.status.value}")
            if solution.status is Status.INTERRUPTED:
                return tried, solutions, False
            failures = measure(solution).failures if solution.success else ()
            if solution.success and depth <= TOUCHING and not failures:
                return tried, solutions, True
            tried[-1] += "".join(f", but {failure.message}" for failure in failures)
            if depth > TOUCHING:
                tried[-1] += f", but shapes overlap by {1000 * depth:.2g} mm"
            attempt = attempt.instead if depth > TOUCHING else None
    return tried, solutions, False


def _attempts(robot: Robot, task: Goals, least: str | None, seed: int) -> Iterator[_Attempt]:
    """Yield attempts until one is verified."""
    if robot.standing is not None:
        yield from _of_standing(robot, robot.standing, task, seed)
        return
    Space.around(robot, task.avoid).check("start", robot.q)
    if robot.model.body_forces:
        yield from _of_flying(robot, task, seed)
    elif robot.steered is not None and (rested := settled(robot)) is not None:
        yield from _of_driven(rested, task, least, seed)
    elif task.is_free:
        yield from _of_reachable(robot, task, seed)
    else:
        yield from _of_passive(robot, task)


def _of_flying(robot: Robot, task: Goals, seed: int) -> Iterator[_Attempt]:
    """Yield attempts for thrusters: along a guess if they can produce any acceleration, or else with least effort."""
    guess = flight(robot, task.frames, seed)
    model, x0 = guess.model, guess.xs[0]
    effect = differentiate_step(model, x0, model.neutral_input(x0)).B[model.nq :]
    if np.linalg.matrix_rank(effect) == model.nv:
        yield _feasible(robot, task, guess)
        return
    x_goal = x0.copy()  # at rest in the current orientation
    for _, q, _ in floating(model):
        x_goal[q + 4 : q + 7] = np.nan if task.frames else x0[q + 4 : q + 7] + flown(np.random.default_rng([seed, 4]))
    for longer in (1, 2):
        steps = longer * guess.num_steps
        problem = _problem(robot, task, guess, x_goal, running_cost=_effort(model), num_steps=steps)
        options = {"method": "collocation", "time_limit": LONG_BUDGET, "options": Options(refine=True)}
        yield _Attempt(f"least effort in {steps} steps", robot, problem, None, options)


def _of_standing(robot: Robot, standing: tuple[Legs, Rest], task: Goals, seed: int) -> Iterator[_Attempt]:
    """Yield attempts of a robot with fixed foot positions; a random goal is replaced once if needed."""
    legs, rest = standing
    for again in range(1 + (task.is_free and robot.model.nv <= TRIED_TWICE)):
        if task.is_free:
            shift = random_shift(legs, rest, [seed, again], robot.overlap)
        else:
            shift = shift_to(legs, rest, task.frames, task.joints)
        if isinstance(shift, Refusal):
            raise ModelError(f"no other posture was found that the standing robot reaches: {shift}")
        moved = np.max(np.abs(legs.apart(shift.xs[-1][: robot.model.nq], robot.q)))
        name = f"a motion with fixed feet, by up to {moved:.2g} rad or m, to a posture at rest"
        yield _feasible(robot, task, MotionGuess(name, robot.model, shift.xs, shift.us, 0.0))


def _of_driven(robot: Robot, task: Goals, least: str | None, seed: int) -> Iterator[_Attempt]:
    """Yield attempts of a fully driven robot, for each posture at the goals, the best guess first."""
    if least:
        _check_that_limits_bound_time(robot.model)
    collocates = not (robot.model.inputs.commanded.any() or has_passive_loops(robot))
    space = Space.around(robot, task.avoid)
    for target in postures(robot, task, seed):
        guesses = _guesses(space, target, seed)
        for guess in guesses[:2]:
            if least or (robot.model.nv <= SMALL and collocates):
                yield _collocated(robot, task, guess, least)
            if not least:
                yield _feasible(robot, task, guess)


def _check_that_limits_bound_time(model: Model) -> None:
    """Raise InputError if speed is unlimited: without effort or speed limits there is no least time."""
    fast = [v.name for v in model.contract.velocities if np.isinf([v.lower, v.upper]).any()]
    strong = [u.name for u in model.contract.inputs if np.isinf([u.lower, u.upper]).any()]
    if model.inputs.commanded.any():
        expected = "efforts as inputs, as collocation finds the least time and does not support servos"
        raise InputError('time="least"', got="commanded positions", expected=expected)
    if fast and strong:
        got = f"no speed limit of {', '.join(fast[:4])} and no effort limit of {', '.join(strong[:4])}"
        raise InputError('time="least"', got=got, expected="limits of all speeds or of all motors in the file")


def _guesses(space: Space, target: Array, seed: int) -> list[MotionGuess]:
    """Return guesses to `target` (nq,), first without overlaps, then within the effort limits."""
    robot, paths, guesses = space.robot, lines(space, target, seed), list[MotionGuess]()
    for line, slower in [*((line, 1.0) for line in paths), *([(paths[0], 2.0)] if len(paths) == 1 else [])]:
        with suppress(ModelError):  # on the way, loops cannot be closed
            guesses.append(along(robot, line, slower=slower))
    counted = coordinates_of(robot.model, robot.steered) if has_passive_loops(robot) else slice(None)
    # The loops may end on the other side of a dead point.
    guesses = [g for g in guesses if np.max(np.abs(g.xs[-1][: len(target)] - target)[counted]) < BESIDE]
    return sorted(guesses, key=lambda guess: (_touched(space, guess), max(guess.effort, OF_EFFORT)))


def _touched(space: Space, guess: MotionGuess) -> float:
    """Return the overlap or the violation [m] of an obstacle's margin along a guess, or 0 if there is none."""
    depth = guess.depth if guess.depth > TOUCHING else 0.0
    return max(0.0, depth, float(np.max(space.lacking(guess.xs[:, : space.robot.model.nq]))))


def _collocated(robot: Robot, task: Goals, guess: MotionGuess, least: str | None) -> _Attempt:
    """Minimize the effort, or the time, by collocation."""
    model, x1 = guess.model, guess.xs[-1].copy()
    asked: dict[str, Any] = {"running_cost": _effort(model)}
    if least:
        whole = guess.num_steps * model.time_step
        guess = guess.in_steps(min(guess.num_steps, FEW))
        asked = {"running_cost": 1.0, "horizon": (FASTER[0] * whole, FASTER[1] * whole)}
    problem = _problem(robot, task, guess, x1, **asked)
    what = "least time" if least else "least effort"
    error, limit = (COARSE, LONG_BUDGET) if least else (FINE, BUDGET)
    refined = Options(refine=True, error_tolerance=error)
    options = {"method": "collocation", "time_limit": limit, "options": refined}
    name = f"{what} from {guess.name}"
    near = replace(problem, bounds=_bounds(model, guess.xs[:, : model.nq]))
    instead = _Attempt(f"{name}, near this guess", robot, near, guess, options)
    return _Attempt(name, robot, problem, guess, options, instead if guess.depth <= TOUCHING else None)


def _feasible(robot: Robot, task: Goals, guess: MotionGuess) -> _Attempt:
    """Find any motion to the end of the guess within all limits; the guess itself if it is feasible."""
    x_goal, asked, nq = guess.xs[-1].copy(), dict[str, Any](), guess.model.nq
    if robot.standing is not None and not task.is_free:  # nobody asked for the posture of other joints
        x_goal[[i for i in range(nq) if i not in task.joints]] = np.nan
        still = np.full(guess.model.nv, SLOW_ENOUGH)  # a share of the range of an arm that hardly moves is nothing
        asked["goal_tolerance"] = np.concatenate([np.full(nq, np.nan), still])
    problem = _problem(robot, task, guess, x_goal, **asked)
    options = {"method": "shooting", "time_limit": BUDGET if robot.standing is None else LONG_BUDGET}
    return _Attempt(guess.name, robot, problem, guess, options)


def _problem(robot: Robot, task: Goals, guess: MotionGuess, x_goal: Array, **asked: Any) -> Problem:
    tolerance = {} if robot.standing is None else {"tolerance": FRAME_TOLERANCE}
    goals = [FrameGoal(name, position=position, **tolerance) for name, position in task.frames.items()]
    if robot.steered is not None:
        counted = independent(guess.model, x_goal[: guess.model.nq], list(task.joints))
        counted &= robot.steered | np.isin(places_of_velocities(guess.model), list(task.joints))
        x_goal = np.where(np.concatenate([coordinates_of(guess.model, counted), counted]), x_goal, np.nan)
        x_goal[list(task.joints)] = list(task.joints.values())  # the guess may have missed them
    asked = {"num_steps": guess.num_steps, **asked}
    return Problem(guess.model, x0=guess.xs[0], x_goal=x_goal, goals=[*goals, *task.avoid], **asked)


def _of_reachable(robot: Robot, task: Goals, seed: int) -> Iterator[_Attempt]:
    """Yield attempts to states that a controller reaches, which are therefore reachable.

    The order is: the model as in the file, then paths without contact, then from a state of rest in contact.
    """
    random = np.random.default_rng([seed, 2])
    fractions = random.uniform(-1, 1, robot.model.nq)
    target = robot.q + fractions * (robot.upper - robot.lower) / 2

    def reach(begun: Robot, model: Model, way: float, steps: int, how: str = "") -> Iterator[MotionGuess]:
        name = f"a state that a controller reaches ({way:g} of the way in {steps} steps){how and f', {how}'}"
        guess = by_controller(begun, model, target, steps=steps, reach=way, name=name)
        if guess is not None and _goes(guess):
            yield guess

    def guesses() -> Iterator[MotionGuess]:
        yield from reach(robot, robot.model, *REACHES[0])
        if robot.apart is not None:
            space, elsewhere = Space.around(robot, task.avoid), _elsewhere(robot, random)
            for way, begun in product(REACHES, (robot, elsewhere)):
                made = reach(begun, robot.apart, *way, "without contact (contact=False)")
                yield from (guess for guess in made if _touched(space, guess) <= 0)
            gentle = robot.model.changed(**GENTLE)
            rest = by_controller(robot, gentle, robot.q, steps=COMES_TO_REST, reach=0.0, name="")
            settled = robot if rest is None else replace(robot, q=rest.xs[-1][: gentle.nq])
            how = f"from its state of rest, with spheres in its shapes and steps of {GENTLE['time_step']:g} s"
            for way in GENTLY:
                yield from reach(settled, gentle, *way, how)
        for way in REACHES[1:]:
            yield from reach(robot, robot.model, *way)

    yield from (_feasible(robot, task, guess) for guess in guesses())


def _elsewhere(robot: Robot, random: np.random.Generator) -> Robot:
    """Return the robot with another start, since the file's posture may be one with a slight contact."""
    is_joint = of_joints(robot.model)
    for i in range(DRAWS):
        width = WIDTH * (i + 1) / DRAWS * (robot.upper - robot.lower)
        drawn = np.clip(robot.q + width * random.uniform(-1, 1, len(robot.q)), robot.lower, robot.upper)
        q = np.where(is_joint, drawn, robot.q)
        if robot.overlap(q) == 0:
            return replace(robot, q=q)
    return robot


def _of_passive(robot: Robot, task: Goals) -> Iterator[_Attempt]:
    """Yield attempts of an underactuated robot to joint goals; all other joints end at their start, at rest."""
    if task.frames:
        raise InputError("goal", got=", ".join(task.frames), expected="goals of joints, as not every joint has a motor")
    model = robot.model
    x0 = np.concatenate([robot.q, np.zeros(model.nv)])
    goal, budget = x0.copy(), BUDGET
    if model.file_facts.held_points:  # the loops determine all other coordinates
        goal[:], budget = np.nan, LONG_BUDGET
        places, rates = single_coordinates(model)
        goal[model.nq + rates[np.isin(places, list(task.joints))]] = 0.0
    goal[list(task.joints)] = list(task.joints.values())
    for steps in (100, 150):
        problem = Problem(
            model,
            x0=x0,
            x_goal=goal,
            num_steps=steps,
            goals=task.avoid,
            running_cost=_effort(model),
        )
        yield _Attempt(f"least effort in {steps} steps", robot, problem, None, {"method": "auto", "time_limit": budget})


def _effort(model: Model) -> QuadraticCost:
    limits = model.effort_limits
    size = np.where(np.isfinite(limits) & (limits > 0), limits, 1.0)
    size[model.inputs.commanded] = np.inf  # servo efforts are not a function of the inputs only
    speeds = np.concatenate([np.zeros(model.nq), np.full(model.nv, SPEED_WEIGHT)])
    return QuadraticCost(Q=np.diag(speeds), R=np.diag(1.0 / size**2))


def _bounds(model: Model, near: Array) -> Bounds:
    """Return the model's limits, with each joint within the range of the postures `near` (K, nq) plus a margin."""
    free, (lower, upper) = np.full(model.nv, np.nan), model.position_limits
    low, high = np.maximum(lower, np.min(near, axis=0) - BESIDE), np.minimum(upper, np.max(near, axis=0) + BESIDE)
    return Bounds(x_lower=np.concatenate([low, free]), x_upper=np.concatenate([high, free]))


def _goes(guess: MotionGuess) -> bool:
    """Return whether the motion is large enough and within the model's limits."""
    low, high = state_limits(guess.model)
    goes = np.max(np.ptp(guess.xs[:, : guess.model.nq], axis=0)) >= SMALLEST_WAY
    return bool(goes and np.all((guess.xs >= low) & (guess.xs <= high)))
