"""Initial guesses: a line to the goal, a reference, arrays, Drake trajectories, or a solution on its own knots.

A guess of another length or with other knots is stretched to the problem's knots, from its first to its last state.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.trajectories import PiecewisePolynomial, StackedTrajectory, Trajectory
from scipy.integrate import solve_ivp

from drake_diff._base.arrays import Array, finite_array, positive_float
from drake_diff._base.values import Refusal
from drake_diff.derivatives.step import differentiate_step
from drake_diff.exceptions import DrakeDiffError, InputError, ShapeError
from drake_diff.legs.feet import Legs, find_feet
from drake_diff.legs.standing import AT_REST, Rest, Shift, ranges, shift_of
from drake_diff.mechanics.clearance import OfShapes
from drake_diff.model.assembly import closed
from drake_diff.model.contact import penetration
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.step import advance, set_state
from drake_diff.model.tangent import tangent_space
from drake_diff.optimize.problem.cost import TimedCost
from drake_diff.optimize.problem.obstacles import clearances
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Multipliers
from drake_diff.optimize.solution import Solution
from drake_diff.optimize.transcription.collocation import Collocated

NEWTON = 4  # steps towards the inputs that hold a state
ROUNDED = 1e-6  # inputs below this fraction of the largest holding input count as zero
NOISE = 1e-3  # noise on a stationary guess, as a fraction of the input limits, to break its symmetry
WANDER = (1.0, 0.3)  # deviation of a random guess from the straight line, as a fraction of max(1, distance to the goal)
WAVES = 4
GOAL = 1e6  # weight of a goal beside the cost, for a posture
LONGER = 3.0  # largest factor between a random horizon and the first horizon, in both directions
FORMS = "None, (xs, us), two Drake trajectories (state, input), one of states or positions, or a Solution"


@dataclass(frozen=True, eq=False)
class Guess:
    """An initial guess: xs (N+1, nx), us (N, nu), and for collocation also the last input, a horizon or a motion.

    Optimized parameters start at the problem's values if `parameters` (np,) is None.
    """

    xs: Array
    us: Array
    u_final: Array | None = None
    horizon: float | None = None  # [s]
    motion: Collocated | None = None
    line: bool = False
    parameters: Array | None = None
    multipliers: Multipliers | None = None  # of the motion on its mesh


def first_guesses(problem: Problem | PhasedProblem, method: str, given: Any, seed: int) -> list[Guess]:
    """Return a guess for each phase, from `given` (a solution, or a guess for each phase) or from straight lines."""
    if isinstance(problem, Problem):
        return [first_guess(problem, method, given, seed)]
    parts: Sequence[Any] = [None] * len(problem.phases)
    if isinstance(given, Solution):
        parts = given.phases
    elif given is not None:
        parts = given if isinstance(given, (tuple, list)) else [given]
    if len(parts) != len(problem.phases):
        expected = f"None, a PhasedSolution, or {len(problem.phases)} guesses, one for each phase"
        raise InputError("initial_guess", got=f"{len(parts)} guesses", expected=expected)
    pairs = zip(_aimed(problem), parts, strict=True)
    return [first_guess(phase, method, sampled(phase, method, guess), seed) for phase, guess in pairs]


def other_guess(problem: Problem | PhasedProblem, seed: int, number: int) -> Any:
    """Return a random initial guess by `seed`, or a list of one for each phase."""
    if isinstance(problem, Problem):
        return another_guess(problem, seed, number)
    return [another_guess(phase, seed * len(problem.phases) + i, number) for i, phase in enumerate(_aimed(problem))]


def _aimed(problem: PhasedProblem) -> list[Problem]:
    """Return the phases for their initial guesses: a phase without a goal ends where the next phase's guess begins.

    This is the state that a linear reset maps to the next x0, or the next x0 itself if the sizes agree.
    """
    phases = list(problem.phases)
    for switch in problem.switches:
        phase, other = phases[switch.before], problem.phases[switch.after]
        if switch.after == 0 or (switch.matrix is None and phase.nx != other.nx):
            continue
        end = other.x0 if switch.matrix is None else np.linalg.lstsq(switch.matrix, other.x0, rcond=None)[0]
        end = np.clip(end, phase.bounds.x_lower, phase.bounds.x_upper)
        phases[switch.before] = replace(phase, x_goal=np.where(np.isnan(phase.goal), end, phase.goal))
    return phases


def first_guess(problem: Problem, method: str, given: Any, seed: int) -> Guess:
    """Return the initial guess of a search by `method`: `given`, or a straight line if `given` is None."""
    continuous = method == "collocation"
    if given is None:
        return _line(problem, method, seed)
    if type(given) is Solution:
        same = problem.optimizes_parameters and given.vector.names == problem.parameters.names
        values = np.asarray(given.vector.values) if same else None
        horizon = given.horizon if problem.horizon is not None else None
        return replace(_of_solution(problem, given, continuous), parameters=values, horizon=horizon)
    if not (isinstance(given, (tuple, list)) and 2 <= len(given) <= 2 + continuous):
        forms = FORMS.replace("(xs, us)", "(xs, us), (xs, us, horizon)") if continuous else FORMS
        raise InputError("initial_guess", got=type(given).__name__, expected=forms)
    count = problem.num_steps
    xs = finite_array("initial_guess xs", given[0], (count + 1, problem.nx))
    at_knots = continuous and np.shape(given[1]) == (count + 1, problem.nu)
    us = finite_array("initial_guess us", given[1], (count + at_knots, problem.nu))
    horizon = positive_float("initial_guess horizon [s]", given[2]) if len(given) == 3 else None
    return Guess(xs, us[:count], us[-1] if at_knots else None, horizon)


def _of_solution(problem: Problem, given: Solution, continuous: bool) -> Guess:
    """Return the motion of a solution with the problem's numbers of states and inputs, at the problem's knots."""
    count, motion = problem.num_steps, given.transcribed
    sizes = given.xs.shape[1], given.us.shape[1]
    if sizes != (problem.nx, problem.nu):
        raise ShapeError("initial_guess: states and inputs", got=sizes, expected=(problem.nx, problem.nu))
    if motion is None:
        knots = np.linspace(0.0, len(given.us), count + 1)
        if len(given.us) == count:
            return Guess(np.asarray(given.xs), np.asarray(given.us), multipliers=given.multipliers)
        xs = np.array([np.interp(knots, np.arange(len(given.xs)), column) for column in given.xs.T]).T
        return Guess(xs, _means(given.us, knots))
    if continuous:
        xs, us = motion.at(np.linspace(0, motion.horizon, count + 1))
        return Guess(xs, us[:-1], us[-1], motion.horizon, motion, multipliers=given.multipliers)
    if len(given.knots) == count + 1:
        return Guess(given.xs[given.knots], given.inputs_at_knots[given.knots][:-1])
    return Guess(motion.at(np.linspace(0, motion.horizon, count + 1))[0], motion.means(np.arange(count + 1) / count))


def _means(us: Array, ends: Array) -> Array:
    """Return (M, nu) the means of held inputs us (N, nu) between `ends` (M+1,), in steps from 0 to N."""
    summed = np.vstack([np.zeros((1, us.shape[1])), np.cumsum(us, axis=0)])
    sums_at_ends = np.array([np.interp(ends, np.arange(len(summed)), column) for column in summed.T]).T
    return np.asarray(np.diff(sums_at_ends, axis=0) / np.diff(ends)[:, None])


def sampled(problem: Problem, method: str, given: Any) -> Any:
    """Return `given`, with two Drake trajectories sampled at the problem's knots.

    Held inputs are sampled in the middle of each step. States alone get the inputs of a default guess, and positions of
    a model alone also get their rates.
    """
    given = (_with_rates(problem, given), None) if isinstance(given, Trajectory) else given
    if not isinstance(given, (tuple, list)):
        return given
    if len(given) >= 2 and (given[1] is None or _is_empty(given[1])):
        zeros = PiecewisePolynomial(np.zeros((problem.nu, 1)))
        us = zeros if isinstance(given[0], Trajectory) else np.zeros((problem.num_steps, problem.nu))
        xs, us, *rest = sampled(problem, method, (given[0], us, *given[2:]))
        return xs, _line(problem, method, 0).us, *rest
    if not any(isinstance(signal, Trajectory) for signal in given):
        return given
    if len(given) != 2:
        raise InputError("initial_guess", got=f"{len(given)} entries", expected="two trajectories: (state, input)")
    for name, signal, rows in zip(("state", "input"), given, (problem.nx, problem.nu), strict=True):
        if not isinstance(signal, Trajectory):
            raise InputError(
                f"initial_guess {name}", got=type(signal).__name__, expected="a Drake trajectory, like the other entry"
            )
        if (signal.rows(), signal.cols()) != (rows, 1):
            raise ShapeError(f"initial_guess {name}", got=(signal.rows(), signal.cols()), expected=(rows, 1))
    state, held = given
    start, end = state.start_time(), state.end_time()
    if not (np.isfinite(end - start) and end > start):
        raise InputError("initial_guess state", got=f"from {start:g} to {end:g} s", expected="a duration in (0, inf)")
    knots = np.linspace(start, end, problem.num_steps + 1)
    if method == "collocation" or problem.horizon:  # collocation takes a free horizon
        return _guessed("state", state, knots), _guessed("input", held, knots), end - start
    return _guessed("state", state, knots), _guessed("input", held, (knots[:-1] + knots[1:]) / 2)


def _with_rates(problem: Problem, signal: Trajectory) -> Trajectory:
    """Return a trajectory of states, with the rates of the positions if it is one of a model's positions alone."""
    if not (problem.has_model and problem.model.plant.IsVelocityEqualToQDot() and signal.rows() == problem.model.nq):
        return signal
    states = StackedTrajectory()
    states.Append(signal)
    states.Append(signal.MakeDerivative())
    return states


def _is_empty(signal: Any) -> bool:
    return isinstance(signal, PiecewisePolynomial) and not signal.get_number_of_segments()


def _guessed(name: str, trajectory: Any, times: Array) -> Array:
    return trajectory_values(f"initial_guess {name}", trajectory, times)


def trajectory_values(subject: str, trajectory: Any, times: Array) -> Array:
    """Return the values (S, rows) of a Drake trajectory at `times` (S,) [s]; InputError if some are not finite."""
    inside = np.clip(times, trajectory.start_time(), trajectory.end_time())
    return finite_array(subject, trajectory.vector_values(inside).T, (len(times), trajectory.rows()))


def _line(problem: Problem, method: str, seed: int) -> Guess:
    """Return a straight line to the goal or the reference, with the problem's inputs or inputs near zero."""
    xs, followed = _way(problem)
    us = np.array(problem.us)
    if method != "collocation" and followed is None and (shift := on_feet(problem, fast=False)) is not None:
        return Guess(shift.xs, np.clip(shift.us, problem.bounds.u_lower, problem.bounds.u_upper))
    if method == "collocation" and followed is None and not us.any() and _keeps_shapes_clear(problem):
        xs, us = _from_rest_to_rest(problem)
    if problem.optimizes_controls and not us.any() and followed is not None:
        us = (followed[:-1] + followed[1:]) / 2
    if problem.optimizes_controls and not us.any():
        us = us + _holding(problem, xs)
    if method == "shooting" and problem.optimizes_controls and not us.any():
        limit = np.minimum(np.abs(problem.bounds.u_lower), np.abs(problem.bounds.u_upper))
        size = np.where(np.isfinite(limit), np.minimum(limit, 100.0), 1.0)
        us = NOISE * size * np.random.default_rng(seed).standard_normal(us.shape)
    inside = np.clip(us, problem.bounds.u_lower, problem.bounds.u_upper)
    return Guess(xs, inside if problem.optimizes_controls else us, line=True)


def _way(problem: Problem) -> tuple[Array, Array | None]:
    """Return (N+1, nx) a straight line to the goal, or the running cost's reference, bent to meet both ends.

    The second value has the inputs (N+1, nu) of the reference, or is None without them.
    """
    s, goal = np.linspace(0, 1, problem.num_steps + 1)[:, None], np.array(problem.goal)
    line = problem.x0 + s * (np.where(np.isnan(goal), problem.x0, goal) - problem.x0)
    cost = problem.running_cost
    reference = cost.followed(problem.start_horizon * s[:, 0]) if isinstance(cost, TimedCost) else None
    if reference is None:
        return _with_closed_loops(problem, line), None
    xs, us = reference
    bent = xs + (1 - s) * (problem.x0 - xs[0]) + s * (np.where(np.isnan(goal), xs[-1], goal) - xs[-1])
    return np.where(np.isnan(bent), line, bent), us


def _keeps_shapes_clear(problem: Problem) -> bool:
    """Return whether a rest-to-rest motion of driven hinges and slides must keep shapes apart."""
    of_shapes = any(isinstance(c.clearance, OfShapes) for c in clearances(problem.kept))
    if not (of_shapes and problem.has_model and problem.optimizes_controls):
        return False
    model = problem.model
    is_plain = model.nq == model.nv and not model.inputs.commanded.any() and not model.file_facts.held_points
    at_rest = not np.any(problem.x0[model.nq :]) and not np.any(np.nan_to_num(problem.goal[model.nq :]))
    return is_plain and at_rest and bool(np.linalg.matrix_rank(model.actuation) == model.nv)


def _from_rest_to_rest(problem: Problem) -> tuple[Array, Array]:
    """Return the straight line, timed by the quintic polynomial that begins and ends at rest, and its efforts.

    A search that begins far from a feasible motion passes through shapes before it finds one.
    """
    model, duration = problem.model, problem.start_horizon
    s, goal = np.linspace(0, 1, problem.num_steps + 1)[:, None], np.array(problem.goal)
    way = np.where(np.isnan(goal), problem.x0, goal)[: model.nq] - problem.x0[: model.nq]
    q = problem.x0[: model.nq] + s**3 * (10 - 15 * s + 6 * s**2) * way
    v = 30 * (s - s**2) ** 2 * way / duration
    a = 60 * s * (1 - s) * (1 - 2 * s) * way / duration**2
    twin, efforts = model.double, []
    for x, acceleration in zip(np.hstack([q, v]), a, strict=True):
        twin.set_state(x)
        needed = twin.inverse_dynamics(acceleration) + twin.damping() * x[model.nq :]
        efforts.append(np.linalg.lstsq(model.actuation, needed, rcond=None)[0])
    return np.hstack([q, v]), (np.array(efforts[:-1]) + efforts[1:]) / 2


def _with_closed_loops(problem: Problem, xs: Array) -> Array:
    """Return xs (N+1, nx) with closed loops, where the coordinates that the goal fixes allow it."""
    if not problem.has_model or not problem.model.file_facts.held_points:
        return xs
    model = problem.model
    fixed, postures = ~np.isnan(problem.goal[: model.nq]), [xs[0, : model.nq]]
    for x in xs[1:]:
        near = np.where(fixed, x[: model.nq], postures[-1])
        q = closed(model, near, fixed)
        postures.append(near if q is None else q)
    return np.hstack([postures, xs[:, model.nq :]])


def another_guess(problem: Problem, seed: int, number: int) -> tuple[Any, ...]:
    """Return a random smooth motion near the straight line for collocation: xs (N+1, nx), us (N+1, nu), a horizon.

    The states add a few sines and the inputs are a few cosines with normally distributed amplitudes. Guesses near the
    line and far from it alternate. A free horizon is the first one times a random factor. For dynamics without inputs,
    number 1 is a simulation from x0 instead.
    """
    random = np.random.default_rng([seed, number])
    far, s = WANDER[number % len(WANDER)], np.linspace(0, 1, problem.num_steps + 1)[:, None]
    b, way = problem.bounds, _way(problem)[0]
    limit = np.minimum(np.abs(b.u_lower), np.abs(b.u_upper))
    size = np.where(np.isfinite(limit), np.minimum(limit, 100.0) / 2, 1.0)
    waves = [random.standard_normal(problem.nx) * np.sin(j * np.pi * s) / j for j in range(1, WAVES)]
    swings = [random.standard_normal(problem.nu) * np.cos(j * np.pi * s) / (j + 1) for j in range(WAVES)]
    xs = way + far * np.maximum(1.0, np.abs(way[-1] - problem.x0)) * sum(waves)
    if problem.initial_state_mask.any():  # a free initial state is random as well
        xs = xs + far * (1 - s) * np.where(problem.initial_state_mask, random.standard_normal(problem.nx), 0.0)
    us = size * sum(swings)
    if isinstance(problem.system, Model):
        us = np.where(problem.system.inputs.commanded, problem.system.neutral_input(xs), us)
    us = np.clip(us, b.u_lower, b.u_upper)
    is_passive = number == 1 and problem.nu == 0 and not problem.has_model and not problem.is_map
    if is_passive:
        xs = _passive(problem, way)
    first = int(problem.initial_state_is_given)
    xs[first:] = np.clip(xs[first:], b.x_lower, b.x_upper)
    for start in tangent_space(problem.model).quaternions if problem.has_model else ():
        xs[:, start : start + 4] /= np.linalg.norm(xs[:, start : start + 4], axis=1, keepdims=True)
    if not problem.horizon or problem.horizon[0] == problem.horizon[1]:
        return xs, us
    longer = 1.0 if is_passive else LONGER ** random.uniform(-1, 1)
    return xs, us, float(np.clip(problem.start_horizon * longer, *problem.horizon))


def _passive(problem: Problem, xs: Array) -> Array:
    """Return the simulation (N+1, nx) from xs[0] during the first horizon, or xs if the states diverge."""
    times = np.linspace(0, problem.start_horizon, len(xs))
    motion = solve_ivp(lambda _, x: problem.dynamics(x, []), (0, times[-1]), xs[0], t_eval=times)
    return motion.y.T.copy() if motion.success else xs


def _holding(problem: Problem, xs: Array) -> Array:
    """Return (N, nu) inputs within bounds that best hold the first state for one step, or 0 for actuators of joints.

    Rotors and thrusters do not steer without thrust: no rotor moves a falling quadrotor sideways. Joint actuators do,
    except those of a robot that stands on contacts and would fall. The guess of a servo is the position of its joint in
    xs (N+1, nx).
    """
    model = problem.model if isinstance(problem.system, Model) else None
    if model is None or (model.inputs.plain and not _stands(model, problem.x0)):
        return np.zeros((len(xs) - 1, problem.nu)) if model is None else model.neutral_input(xs[1:])
    bounds, still = problem.bounds, np.concatenate([problem.x0[: model.nq], np.zeros(model.nv)])
    none = np.clip(np.zeros(model.nu), bounds.u_lower, bounds.u_upper)
    inputs, rounds = none, NEWTON if model.contract.contact.collision_pairs else 1
    try:
        for _ in range(rounds):  # the force of a contact is not linear in the inputs
            d = differentiate_step(model, still, inputs)
            missing = d.B[model.nq :] @ inputs - d.x_next[model.nq :]
            best = np.linalg.lstsq(d.B[model.nq :], missing, rcond=None)[0]
            inputs = np.clip(best, bounds.u_lower, bounds.u_upper)
    except DrakeDiffError:
        return np.tile(none, (len(xs) - 1, 1))
    held = np.where(np.abs(inputs) > ROUNDED * np.abs(inputs).max(), inputs, none)
    return np.where(model.inputs.commanded, model.neutral_input(xs[1:]), held)


def on_feet(problem: Problem, *, fast: bool) -> Shift | None:
    """Return a motion on fixed feet to the posture of least cost, for a robot at rest on its feet in x0, or None.

    A slow motion is the better guess for a search, and a `fast` one often costs less.
    """
    model = problem.model if isinstance(problem.system, Model) else None
    given = problem.initial_state_is_given and problem.optimizes_controls and not problem.us.any()
    if model is None or not (given and problem.has_cost and model.inputs.plain and _stands(model, problem.x0)):
        return None
    from drake_diff.optimize.knots import costs_of  # loads CasADi

    count, h, q = problem.num_steps, model.time_step, problem.x0[: model.nq]
    feet, u = find_feet(model, q), _holding(problem, problem.x0[None].repeat(2, axis=0))[0]
    try:
        speeds = np.array(advance(model.double, problem.x0, u))[model.nq :]
        if isinstance(feet, Refusal) or np.max(np.abs([*problem.x0[model.nq :], *speeds])) > AT_REST:
            return None
        legs = Legs(model, feet, *ranges(model, np.pi)).on_lowest(q)
        goal = np.where(np.isnan(problem.goal), 0.0, GOAL)

        def expand(q: Array) -> tuple[Array, Array]:
            x = np.concatenate([q, np.zeros(model.nv)])
            xs, us = np.tile(x, (count + 1, 1)), np.tile(u, (count, 1))
            slopes = costs_of(problem, xs, us, h).expand(xs, us)
            gradient, hessian = (terms.sum(axis=0)[..., : model.nx] for terms in slopes)
            moved = legs.space.derivative_of_plus(x)[:, : model.nv]
            gradient = gradient + goal * np.nan_to_num(x - problem.goal)
            return moved.T @ gradient, moved.T @ (hessian[: model.nx] + np.diag(goal)) @ moved

        shift = shift_of(legs, Rest(problem.x0, u), count, expand, fast=fast)
    except DrakeDiffError:
        return None
    return None if isinstance(shift, Refusal) else shift


def _stands(model: Model, x: Array) -> bool:
    """Return whether a floating robot with joints touches something in the state x (nx,)."""
    roots = model.plant.GetFloatingBaseBodies()
    has_legs = any(joint.parent_body().index() in roots for joint in joints(model.plant))
    if not (has_legs and model.contract.contact.collision_pairs):
        return False
    set_state(model.double, x)
    return penetration(model) > 0
