"""Verify a given plan without a search: arrays, Drake trajectories, or the result of another tool."""

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pydrake.trajectories import PiecewisePolynomial, PiecewiseTrajectory, Trajectory

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float
from drake_diff.certificates.certificate import Certificate
from drake_diff.certificates.certify import certify_steps
from drake_diff.exceptions import GradientError, InputError, ShapeError, SimulationError, UnknownNameError
from drake_diff.motion.rollout import CONTINUOUS
from drake_diff.optimize.guess import trajectory_values
from drake_diff.optimize.measure import GIVEN, certify_equations, telling_knots
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import NlpResult, Outcome
from drake_diff.optimize.solution import NO_INPUT, Search, Solution, Status
from drake_diff.optimize.transcription.collocation import Transcription
from drake_diff.optimize.transcription.task import DEFAULT_SCHEME, MAP
from drake_diff.optimize.verification import judged, refused

PLANTS = ("steps", "continuous")
SAME_TIME = 1e-6  # of an interval: knots of a trajectory that are this near to each other are one knot
LARGEST_TOLERANCE = 1e-2  # that of replays in the plan's own plant
NOTES = {  # by the name of the search that made the plan
    None: "a given plan: no better plan was searched for",
    "PathTiming": "the least time along a given path: other paths were not searched",
}


def check_plan(
    problem: Any,
    xs: Any,
    us: Any = None,
    *,
    plant: str | None = None,
    horizon: float | None = None,
    tolerance: float = 1e-4,
) -> Solution:
    """Verify a given plan of `problem` without a search, with the checks of `solve`.

    A plan in "steps" has inputs that are held over each step, and its states must be those of the model's own steps. A
    "continuous" plan has inputs that change between its knots, and an accurate integration from each knot must meet the
    next one. As after `solve`, the plan must hold in its own plant, in finer steps and in continuous time, open loop or
    under TVLQR. `solution.checks` lists all checks. The plan is not compared with better plans.

    Args:
        problem: the task, with its start, goal, bounds, constraints and costs. It needs a goal, a constraint or a cost.
        xs: (N+1, nx) the states at the problem's knots; or a Drake trajectory, as `ReconstructStateTrajectory` returns.
        us: the inputs: (N, nu) held over each step, (N+1, nu) at the knots of an input that is linear in between, or a
            Drake trajectory. None for a system without inputs.
        plant: "steps" or "continuous". By default, arrays (N, nu) of a model, inputs that are constant between their
            breaks, and trajectories of models with contact, constraints or PD control are in steps. Other plans are
            continuous. A trajectory in "steps" is sampled at the problem's knots, its input in the middle of each step.
        horizon: [s] the duration of arrays, if the problem's horizon is free. A trajectory has its own duration.
        tolerance: relative tolerance, at most 0.01, of the start, goal, bounds, constraints and steps at the knots.
            Solvers of others stop at larger residuals than ours, and files are often written with few digits.

    Returns:
        A `Solution` whose method is "check_plan". `success` is true if every check passes. It can be saved, compared,
        verified and replayed like the result of `solve`.

    Raises:
        InputError: the plan has another duration than the problem, or the plant does not fit the system.
        ShapeError: the arrays or trajectories do not have the sizes of the problem.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> problem = dd.Problem(block, x0=[0, 0], x_goal=[1, 0], num_steps=4, horizon=1.0)
        >>> t = np.linspace(0, 1, 5)
        >>> states, inputs = np.column_stack([3 * t**2 - 2 * t**3, 6 * t - 6 * t**2]), (6 - 12 * t)[:, None]
        >>> dd.check_plan(problem, states, inputs).message
        'verified: holds open loop in continuous time'
        >>> dd.check_plan(problem, states, 0.9 * inputs).success
        False
    """
    if not isinstance(problem, Problem):
        expected = "a Problem without phases" if isinstance(problem, PhasedProblem) else "a Problem"
        raise InputError("problem", got=type(problem).__name__, expected=expected)
    tolerance = _check_tolerance(tolerance)
    if plant is not None and plant not in PLANTS:
        raise UnknownNameError("plant", got=plant, known=PLANTS)
    if us is None and problem.nu == 0:
        us = NO_INPUT if isinstance(xs, Trajectory) else np.zeros((problem.num_steps + 1, 0))
    is_trajectory = [isinstance(signal, Trajectory) for signal in (xs, us)]
    if any(is_trajectory) and not all(is_trajectory):
        expected = "two arrays, or two Drake trajectories"
        raise InputError("xs, us", got=f"{type(xs).__name__}, {type(us).__name__}", expected=expected)
    chosen = plant or _default_plant(problem, us)
    _check_plant(problem, chosen)
    fields = _sampled(problem, xs, us, chosen) if all(is_trajectory) else _arrays(problem, xs, us, chosen)
    if horizon is not None:
        if all(is_trajectory) or problem.horizon is None:
            raise InputError("horizon", got=horizon, expected="no value, as the plan or the problem has a duration")
        fields["free_horizon"] = positive_float("horizon [s]", horizon)
    arguments = {"method": GIVEN, "plant": chosen, "tolerance": tolerance}
    scheme = "step" if chosen == "steps" or problem.motion == CONTINUOUS else DEFAULT_SCHEME
    fields["scheme"] = MAP if problem.is_map else scheme
    return checked(Solution(problem, GIVEN, "no search", Status.FAILED, "", **fields), arguments)


def checked(plan: Solution, arguments: dict[str, Any]) -> Solution:
    """Certify and judge a plan; `arguments` are those of `check_plan`, to repeat the call from the stored plan.

    "search" in `arguments` is the name of the search that made the plan, if it was not given.
    """
    _check_tolerance(arguments["tolerance"])
    start, certificates = time.monotonic(), tuple[Certificate, ...]()
    draft = replace(plan, search=Search(arguments))
    error: Exception | None = None
    try:
        if np.all(np.isfinite(plan.xs)):
            certificates = _certify(draft)
    except (GradientError, SimulationError) as refusal:
        error = refusal
    draft = replace(draft, certificates=certificates)
    result = NlpResult(np.zeros(0), Outcome.SOLVED, "", (), note=NOTES.get(arguments.get("search"), NOTES[None]))
    solution = judged(draft, result) if error is None else refused(draft, error)
    return solution.told(wall_time=time.monotonic() - start)


def _check_tolerance(given: Any) -> float:
    tolerance = positive_float("tolerance", given)
    if tolerance > LARGEST_TOLERANCE:
        raise InputError("tolerance", got=given, expected=f"at most {LARGEST_TOLERANCE:g}, a part of each range")
    return tolerance


def _certify(plan: Solution) -> tuple[Certificate, ...]:
    """Certify the derivatives of the dynamics at the knots of the plan that are most likely to differ."""
    problem = plan.problem
    if plan.scheme != "step":
        transcription = Transcription(problem, plan.scheme)
        return certify_equations(problem, transcription.jacobian, plan.xs, plan.us, transcription.tasks[0])
    if problem.motion == CONTINUOUS:  # contact at high frequency: the replays integrate it
        return ()
    knots = telling_knots(problem, plan.xs)
    model = problem.model if plan.free_horizon is None else problem.model.at_time_step(plan.time_step)
    return tuple(certify_steps(model, plan.xs[knots], plan.us[knots], parameters=plan.vector.to_dict()))


def _default_plant(problem: Problem, us: Any) -> str:
    if problem.is_map:
        return "steps"
    if not problem.has_model or problem.motion == CONTINUOUS:
        return "continuous"
    contract = problem.model.contract
    if contract.contact.collision_pairs or not contract.is_unconstrained:
        return "steps"
    if isinstance(us, Trajectory):
        return "steps" if _is_held(us) else "continuous"
    return "continuous" if np.shape(us)[:1] == (problem.num_steps + 1,) else "steps"


def _is_held(signal: Trajectory) -> bool:
    """Return whether a trajectory is constant between its breaks."""
    if not isinstance(signal, PiecewisePolynomial):
        return False
    return all(signal.getSegmentPolynomialDegree(i) == 0 for i in range(signal.get_number_of_segments()))


def _check_plant(problem: Problem, plant: str) -> None:
    """Raise InputError for a plant that the system does not have."""
    if plant == "steps" and not (problem.has_model or problem.is_map):
        raise InputError("plant", got='"steps"', expected='"continuous", as plain dynamics have no discrete step')
    if plant == "steps" and problem.motion == CONTINUOUS:
        raise InputError("plant", got='"steps"', expected='"continuous", as the problem has motion="continuous"')
    if plant == "continuous" and problem.is_map:
        raise InputError("plant", got='"continuous"', expected='"steps", as the system is a DiscreteMap')


def _arrays(problem: Problem, xs: Any, us: Any, plant: str) -> dict[str, Any]:
    """Return the fields of a Solution from arrays at the problem's knots."""
    count, at_knots = problem.num_steps, plant == "continuous" and problem.motion != CONTINUOUS
    shape = np.shape(us)
    if at_knots and shape == (count, problem.nu):
        expected = f'shape {(count + 1, problem.nu)} at the knots, or plant="steps" for held inputs'
        raise InputError("us", got=f"shape {shape}", expected=expected)
    us = us[: count + at_knots] if problem.nu == 0 else us
    states = finite_array("xs", xs, (count + 1, problem.nx))
    inputs = finite_array("us", us, (count + at_knots, problem.nu))
    last = {"u_final": frozen(inputs[-1])} if at_knots else {}
    return {"xs": frozen(states), "us": frozen(inputs[:count]), **last}


def _sampled(problem: Problem, state: Trajectory, held: Trajectory, plant: str) -> dict[str, Any]:
    """Return the fields of a Solution from Drake trajectories, whose breaks become knots of a continuous plan."""
    for name, signal, rows in (("xs", state, problem.nx), ("us", held, problem.nu)):
        if (signal.rows(), signal.cols()) != (rows, 1):
            raise ShapeError(f"{name}, a trajectory", got=(signal.rows(), signal.cols()), expected=(rows, 1))
    start, count = state.start_time(), problem.num_steps
    duration = state.end_time() - start
    if not 0 < duration < np.inf:
        raise InputError("xs, a trajectory", got=f"{duration:g} s long", expected="a duration in (0, inf)")
    fixed = problem.start_horizon
    if problem.horizon is None and not problem.is_map and abs(duration - fixed) > SAME_TIME * fixed:
        expected = f"{fixed:.6g} s: {count} steps of {problem.time_step:.6g} s"
        raise InputError("xs, a trajectory", got=f"{duration:.6g} s long", expected=expected)
    fields: dict[str, Any] = {} if problem.horizon is None else {"free_horizon": duration}
    if plant == "steps" or problem.motion == CONTINUOUS:
        knots = start + duration * np.linspace(0, 1, count + 1)
        fields["xs"] = trajectory_values("xs", state, knots)
        fields["us"] = trajectory_values("us", held, (knots[:-1] + knots[1:]) / 2)
        if problem.is_map and _is_held(state):  # Drake's trajectories of held states lack the last one
            last = problem.dynamics(fields["xs"][-2], fields["us"][-1])
            fields["xs"] = frozen(np.vstack([fields["xs"][:-1], last]))
        return fields
    mesh = _mesh(count, [(_breaks(s) - start) / duration for s in (state, held)])
    knots = start + duration * mesh
    inputs = trajectory_values("us", held, knots)
    fields |= {"xs": trajectory_values("xs", state, knots), "us": inputs[:-1], "u_final": inputs[-1]}
    fields["us_mid"] = trajectory_values("us", held, (knots[:-1] + knots[1:]) / 2)
    return fields | ({"mesh": frozen(mesh)} if len(mesh) != count + 1 else {})


def _breaks(signal: Trajectory) -> Array:
    is_piecewise = isinstance(signal, PiecewiseTrajectory)
    return np.asarray(signal.get_segment_times() if is_piecewise else [], dtype=float)


def _mesh(count: int, breaks: Sequence[Array]) -> Array:
    """Return the problem's own knots and the breaks within the motion, as fractions of its duration."""
    uniform = np.linspace(0, 1, count + 1)
    others = np.unique(np.concatenate(breaks))
    near = np.abs(others[:, None] - uniform[None]).min(axis=1, initial=np.inf) <= SAME_TIME / count
    others = others[~near & (others > 0) & (others < 1)]
    return np.sort(np.concatenate([uniform, others[np.diff(others, prepend=-1) > SAME_TIME / count]]))
