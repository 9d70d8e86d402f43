"""Relaxed stages of a search through contact, and the motion of the true plant that they lead to.

The reach of contact shrinks from stage to stage, and each begins where the one before ended. The true plant then
follows what each stage found, under the feedback of a linear-quadratic regulator: the one that it follows best is where
the search on the true plant begins. A stage only warms up the next, and the schedule goes on where one does not end.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.clock import TimeIsUpError
from drake_diff._base.values import Refusal
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.model.contact import thinnest_geometry
from drake_diff.model.plant import bodies
from drake_diff.optimize.ilqr.expansion import Motion, jacobians_along
from drake_diff.optimize.ilqr.riccati import LinearQuadratic, solve_riccati
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.relaxed.plant import RelaxedPlant, Softness, relaxed_plant
from drake_diff.optimize.relaxed.search import Found, RelaxedSearch

STAGES, ITERATIONS = 5, 60  # each reach is half of the one before
LARGEST_REACH, SMALLEST_REACH = 0.1, 0.01  # [m] of the first stage
NEAREST = 6.0  # where nothing touches, the first reach is this part of the nearest gap
SLIP, LEAST_SLIP = 0.1, 0.02  # [m/s] in the first stage, and in any
REBOUND = 0.1  # [m/s] contact that parts faster than twice that does not push
SHARE = 1 / 3  # of its weight that pushes a body which just touches
WITHOUT_GRAVITY = 1.0  # [m/s^2]
# What the whole range of an input is worth to the regulator, where that of a state's is 1; at the last it does nothing.
WEIGHTS = (0.1, 10.0, 1e9)


def describe(problem: Problem) -> RelaxedPlant:
    """What the stages need to know of the model; InputError where a problem or a model is none of theirs."""
    if not problem.initial_state_is_given:
        raise InputError("continuation", got="'relaxed' with a free initial state", expected="one that is given")
    plant = problem.model.cache("relaxed plant", lambda: relaxed_plant(problem.model))
    if isinstance(plant, Refusal):
        raise InputError("continuation", got=f"'relaxed': {plant.reason}", expected="another model, or 'auto'")
    if not plant.pairs.ids:
        raise InputError("continuation", got="'relaxed': no sphere may touch anything", expected="a pair that may")
    return plant


def relaxed_schedule(problem: Problem, plant: RelaxedPlant) -> tuple[Softness, ...]:
    """The stages, from the model's sizes and masses: reaches from half of the thinnest shape or a sixth of the gap.

    What just touches pushes with a third of the lighter one's weight, and no contact is stiffer than the model's own.
    """
    model = problem.model
    gap = float(np.min(plant.distances(problem.x0[None, : model.nq])))
    first = float(np.clip(max(thinnest_geometry(model)[0] / 2, gap / NEAREST), SMALLEST_REACH, LARGEST_REACH))
    weight, stiffest, schedule = _weights(problem, plant) * SHARE, plant.material.stiffness * np.log(2), []
    for number in range(STAGES):
        reach = first / 2**number
        force = np.minimum(weight, stiffest * reach)
        schedule.append(Softness(reach, force, max(LEAST_SLIP, SLIP / 2**number), REBOUND))
    return tuple(schedule)


def _weights(problem: Problem, plant: RelaxedPlant) -> Array:
    """(P,) [N] the weight of the lighter of the two trees that each pair is of, or what moves it in the time given."""
    drake, mass = problem.model.plant, dict[int, float]()  # by the tree's first degree of freedom

    def tree(body: Any) -> int | None:
        moving = np.flatnonzero(plant.moving(body))
        return int(moving[0]) if len(moving) else None

    for body in bodies(drake):
        first = tree(body)
        if first is not None:
            mass[first] = mass.get(first, 0.0) + float(body.default_mass())
    acceleration = float(np.linalg.norm(drake.gravity_field().gravity_vector())) or WITHOUT_GRAVITY
    trees = [tree(body) for body in plant.pairs.bodies]
    pairs = zip(plant.pairs.sphere_body, plant.pairs.other_body, strict=True)
    lighter = [min(mass[first] for i in pair if (first := trees[i]) is not None) for pair in pairs]
    return np.array(lighter) * acceleration


def solve_relaxed(
    problem: Problem,
    plant: RelaxedPlant,
    xs: Array,
    *,
    is_over: Callable[[], bool],
    log: Callable[[Softness, Found], None],
    tell: Callable[[str], None],
) -> tuple[Array, Array]:
    """The motion of the true plant (xs (N+1, nx), us (N, nu)) that follows a stage best; it begins at a guess's xs."""
    search, starts = RelaxedSearch(problem, plant), list[tuple[float, Array, Array]]()
    closed: tuple[Array, Any] | None = None
    q = np.array(xs[:, : problem.model.nq])
    q[0] = problem.x0[: problem.model.nq]
    for i, _ in plant.coordinates.free:
        q[:, i : i + 4] /= np.linalg.norm(q[:, i : i + 4], axis=1, keepdims=True)
    try:
        for softness in relaxed_schedule(problem, plant):
            result = search.run(q, softness, ITERATIONS, is_over, tell)
            q = result.motion.q
            log(softness, result)
            for weight in WEIGHTS:
                followed = follow(problem, result.motion.xs, result.motion.us, weight)
                if followed is not None:
                    apart = (followed[0] - result.motion.xs) / problem.ranges(result.motion.xs)
                    starts.append((float(np.mean(apart**2)) + result.gap + result.violation, *followed))
            if is_over():
                break
            if result.ended != "inaccurate":
                closed = q, search.learned
            elif closed is not None:  # the next one begins where the last that closed ended
                q, search.learned = closed
    except TimeIsUpError:  # while the true plant follows one: what has followed before that stays
        tell("the true plant follows no more relaxed stages")
    if not starts:
        raise SimulationError("the true plant can follow none of the relaxed stages")
    _, xs, us = min(starts, key=lambda start: start[0])
    return xs, us


def follow(problem: Problem, xs: Array, us: Array, weight: float) -> tuple[Array, Array] | None:
    """The true plant as it follows xs (N+1, nx), us (N, nu) under feedback; None where it cannot be stepped along."""
    bounds = problem.bounds
    us = np.clip(us, bounds.u_lower, bounds.u_upper)
    ends = np.empty_like(xs[1:])
    try:
        with problem.intervals(problem.parameters) as intervals:
            for k, u in enumerate(us):
                ends[k] = intervals.end(xs[k], u)
            feedback = _feedback(problem, xs, us, ends, weight)
            states, inputs = np.array(xs), np.array(us)
            states[0] = problem.x0
            for k in range(len(us)):
                inputs[k] = np.clip(us[k] + feedback[k] @ (states[k] - xs[k]), bounds.u_lower, bounds.u_upper)
                states[k + 1] = intervals.end(states[k], inputs[k])
    except (GradientError, SimulationError):
        return None
    return (states, inputs) if np.all(np.isfinite(states)) else None


def _feedback(problem: Problem, xs: Array, us: Array, ends: Array, weight: float) -> Array:
    """(N, nu, nx) that of the regulator which weighs states by their ranges along xs, inputs by theirs and `weight`."""
    (N, nu), nx = us.shape, problem.nx
    F = jacobians_along(problem, Motion(xs, us, ends - xs[1:]))
    limit = np.minimum(np.abs(problem.bounds.u_lower), np.abs(problem.bounds.u_upper))
    size = np.where(np.isfinite(limit), limit, np.maximum(np.max(np.abs(us), axis=0), 1.0))
    Q, R = 1 / problem.ranges(xs) ** 2, weight / size**2
    model = LinearQuadratic(
        F=F,
        gaps=np.zeros((N, nx)),
        gradients=np.zeros((N + 1, nx + nu)),
        hessians=np.repeat(np.diag(np.concatenate([Q, R]))[None], N + 1, axis=0),
        lower=np.full((N, nu), -np.inf),
        upper=np.full((N, nu), np.inf),
        start_lower=np.zeros(nx),
        start_upper=np.zeros(nx),
    )
    policy = solve_riccati(model, 0.0)
    if policy is None:
        raise GradientError("no regulator follows the motion")
    return policy.feedback
