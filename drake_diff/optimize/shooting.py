"""Shooting, single or multiple: a motion as a function of the variables it is shot from, through Drake's own steps.

In multiple shooting (Bock and Plitt, "A multiple shooting algorithm for direct solution of optimal control problems",
1984) the states that segments start from are variables too, and that each ends where the next begins is a constraint:
what a late input does need not be seen through all the steps before it. One segment is single shooting.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydrake.autodiffutils import ExtractValue
from pydrake.solvers import MathematicalProgram

from drake_diff._base.arrays import Array, frozen, positive_int
from drake_diff._base.autodiff import chain, chain_rows
from drake_diff._base.clock import check_time, now
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.exceptions import GradientError, InputError, SimulationError
from drake_diff.model.parameters import ParameterVector
from drake_diff.motion.intervals import roll
from drake_diff.motion.loss import Totals, accumulate, differentiate_loss
from drake_diff.optimize.drake_program import solve_program
from drake_diff.optimize.iterate import Iterate
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.cost import differentiate_cost, differentiate_final_cost
from drake_diff.optimize.problem.coupling import BoundCoupling
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.problem.timed import cost_at
from drake_diff.optimize.program import Iteration, Limits, NlpResult, Outcome, Report

DEFAULT_SOLVER = "snopt"
HALVINGS = 10
BACK_OFFS, SHORTER = 5, 8.0  # times that a search goes on with shorter steps, and by how much each


def check_segments(problem: Problem, method: str, segments: int) -> None:
    """Refuse a number of segments that is below 1, or that the method or the problem does not allow."""
    if positive_int("segments", segments) > 1 and method != "shooting":
        raise InputError("segments", got=segments, expected=f'1 for method="{method}"')
    if segments > problem.num_steps:
        raise InputError("segments", got=segments, expected=f"at most num_steps, {problem.num_steps}")
    if segments > 1 and problem.trajectory_cost is not None:
        raise InputError("segments", got=segments, expected="1 with a trajectory_cost, which is of the whole motion")


def solve_shooting(
    problem: Problem,
    xs: Array,
    us: Array,
    *,
    solver: str,
    limits: Limits,
    report: Report | None,
    segments: int = 1,
    values: Array | None = None,
) -> tuple[NlpResult, Array, Array]:
    """Solve `problem` from the guess xs (N+1, nx), us (N, nu); gives (result, xs, us).

    `values` (np,) are those of the problem's `design` to begin with, its own where None.

    Of xs only the states that segments start from count. The result's z is that of `ShootingVariables` of the whole
    motion. A point that cannot be stepped or differentiated is a step that was too long: the solver goes on from the
    best point before it with shorter ones, which the message counts. Raises GradientError or SimulationError if the
    motion that it ends with is such a point.
    """
    begin, start, backed, why = now(), SegmentedMotion(problem, segments).pack(xs, us, values), 0, ""
    table: list[Iteration] = []
    while True:
        # IPOPT shortens a step whose end it cannot evaluate; SNOPT, in Drake, has no way to be told.
        motion = SegmentedMotion(problem, segments, tolerate_failure=solver == "ipopt", careful=backed > 0)
        spent = now() - begin
        left = replace(
            limits, time_limit=limits.time_limit - spent, max_iterations=max(1, limits.max_iterations - len(table))
        )
        options: dict[str, Any] = {"solver": solver, "limits": left, "longest": SHORTER**-backed}
        options |= {"motions": motion.iterates, "refusal": partial(getattr, motion, "refusal")}
        result = solve_program(motion.program(), start, report=report, **options)
        table += result.iterations
        why = result.refusal or why
        refused = (Outcome.NO_GRADIENT, Outcome.DIVERGED, *[Outcome.FAILED] * bool(result.refusal))
        if result.outcome not in refused or backed == BACK_OFFS:
            break
        known = _towards(problem, segments, start, result.z)
        if known is None:  # not even the guess can be differentiated
            result = replace(result, outcome=Outcome.NO_GRADIENT)
            break
        backed, start = backed + 1, known
    again = f", started again {backed} time{'s' * (backed > 1)}" if backed else ""
    told = f"; backed off from points that were refused{again}, the last: {why}" if why else ""
    numbered = tuple(replace(row, iteration=i) for i, row in enumerate(table))
    whole = replace(result, z=result.z[: motion.whole.size], message=result.message + told, iterations=numbered)
    return whole, motion.states(result.z), motion.whole.unpack(whole.z)[1]


def _towards(problem: Problem, segments: int, start: Array, z: Array) -> Array | None:
    """The point nearest to z, on halves of the way from `start` to it, at which all steps can be differentiated."""
    motion = SegmentedMotion(problem, segments, careful=True)
    for part in (*0.5 ** np.arange(HALVINGS), 0.0):
        point = start + part * (z - start)
        try:
            motion.states(point)
        except (GradientError, SimulationError):
            continue
        return point
    return None


def roll_segments(problem: Problem, xs: Array, us: Array, segments: int) -> Array:
    """(N+1, nx): the rollouts under us (N, nu) of all segments, each from its own first state in xs (N+1, nx)."""
    motion = SegmentedMotion(problem, segments)
    return motion.states(motion.pack(xs, us))


class SegmentedMotion:
    """z = [that of the whole motion's ShootingVariables; the states that segments 1, 2, ... start from]."""

    def __init__(self, problem: Problem, count: int, *, tolerate_failure: bool = False, careful: bool = False):
        ends = np.linspace(0, problem.num_steps, count + 1).astype(int)
        self.problem, self.whole = problem, ShootingVariables(problem)
        self.segments = [
            ShootingVariables(problem, steps=range(a, b), tolerate_failure=tolerate_failure, careful=careful)
            for a, b in pairwise(ends.tolist())
        ]
        self.size = self.whole.size + (count - 1) * problem.model.nx

    @property
    def refusal(self) -> str:
        """Why a point could not be evaluated, the last one; empty if all could."""
        return next((segment.refusal for segment in self.segments if segment.refusal), "")

    def start_of(self, number: int) -> NDArray[np.int_]:
        """Where in z the free entries are of the state that segment `number` starts from."""
        if number == 0:
            return np.arange(len(self.whole.free))
        nx = self.problem.model.nx
        return self.whole.size + (number - 1) * nx + np.arange(nx)

    def indices_of(self, number: int) -> NDArray[np.int_]:
        """Where in z that of segment `number` is."""
        steps, nu, places = self.segments[number].steps, self.problem.model.nu, np.arange(self.whole.size)
        inputs = places[self.whole.inputs][steps.start * nu : steps.stop * nu]
        return np.concatenate([self.start_of(number), inputs, places[self.whole.inputs.stop :]])

    def pack(self, xs: Array, us: Array, parameters: Array | None = None) -> Array:
        """z (size,) from xs (N+1, nx), us (N, nu) and parameter values (np,), the problem's where None."""
        starts = [xs[segment.steps.start] for segment in self.segments[1:]]
        return np.concatenate([self.whole.pack(xs[0], us, parameters), *starts])

    def inputs(self, z: Array) -> Array:
        """(N, nu) the inputs."""
        return self.whole.unpack(z[: self.whole.size])[1]

    def sensitivities(self, z: Array, knots: Iterable[int]) -> dict[int, Array]:
        """(nx, size) d x_k / d z of each of `knots`."""
        found, wanted = {}, set(knots)
        for i, segment in enumerate(self.segments):
            own = self.indices_of(i)
            here = range(segment.steps.start, segment.steps.stop + segment.is_last)
            for k, sensitivity in zip(here, _sensitivities(segment, z[own]), strict=False):
                if k in wanted:
                    found[k] = np.zeros((len(sensitivity), self.size))
                    found[k][:, own] = sensitivity
        return found

    def states(self, z: Array) -> Array:
        """(N+1, nx): each segment's rollout from its own start."""
        rolled = [segment.states(z[self.indices_of(i)]) for i, segment in enumerate(self.segments)]
        return np.vstack([xs[:-1] for xs in rolled] + [rolled[-1][-1:]])

    def iterates(self, z: Array) -> tuple[Iterate, ...]:
        """The motion at z, for callbacks; none where the plant cannot be stepped along it."""
        try:
            xs = frozen(self.states(z))
        except (GradientError, SimulationError):
            return ()
        z, problem = z[: self.whole.size], self.problem
        times = frozen(self.whole.time_step(z) * np.arange(len(xs)))
        return (Iterate(problem, times, xs, frozen(self.inputs(z)), self.whole.parameters(z), by_steps=True),)

    def program(self) -> MathematicalProgram:
        """The program; a binding has the variables of one segment, a defect those of the next one's start too."""
        problem, program = self.problem, MathematicalProgram()
        z = program.NewContinuousVariables(self.size, "z")
        program.AddBoundingBoxConstraint(*self._bounds(), z).evaluator().set_description("variables")
        for i, segment in enumerate(self.segments):
            own, cost = z[self.indices_of(i)], RolloutCost(problem, segment)
            if cost.any:
                program.AddCost(cost, vars=own)
            limits = {"states": limits_of_states, "constraints": limits_of_constraints}
            for description, limits_of in limits.items():
                rows = limits_of(problem, segment)
                if len(rows.lower):
                    program.AddConstraint(rows, rows.lower, rows.upper, vars=own, description=description)
            if not segment.is_last:
                rows, both = defect(segment), np.concatenate([own, z[self.start_of(i + 1)]])
                program.AddConstraint(rows, rows.lower, rows.upper, vars=both, description="defect")
        for coupling in problem.coupled_steps():
            rows = limits_of_coupling(self, coupling)
            program.AddConstraint(rows, rows.lower, rows.upper, vars=z, description=f"coupling {coupling.label}")
        return program

    def _bounds(self) -> tuple[Array, Array]:
        b, count = self.problem.bounds, self.problem.num_steps
        lower, upper = self.problem.state_limits()
        lowest, highest = self.problem.design.lower, self.problem.design.upper
        least, most = np.tile(b.u_lower, (count, 1)), np.tile(b.u_upper, (count, 1))
        return self.pack(lower, least, lowest), self.pack(upper, most, highest)


class ShootingVariables:
    """z = [free entries of the first state; us; parameters in their coordinates] and its rollout of n steps.

    `steps` are those of a segment, all if None; the first state of a later segment is free in every entry. Given
    `around` (n+1, nx), the states are these instead of a rollout. Steps are linearized once for each z. If `careful`, a
    z that cannot be differentiated has no value either, so that a line search does not stop there.
    """

    def __init__(
        self,
        problem: Problem,
        *,
        steps: range | None = None,
        around: Array | None = None,
        tolerate_failure: bool = False,
        careful: bool = False,
    ):
        self.problem, self.around, self.tolerate_failure, self.careful = problem, around, tolerate_failure, careful
        self.refusal = ""  # why a z could not be evaluated, the last one
        self.steps = range(problem.num_steps) if steps is None else steps
        begins, nx = self.steps.start == 0, problem.model.nx
        self.free = np.flatnonzero(problem.initial_state_mask) if begins else np.arange(nx)
        self.shape = (len(self.steps), problem.model.nu)
        self.design = problem.design
        num_inputs = self.shape[0] * self.shape[1] if problem.optimizes_controls else 0
        self.inputs = slice(len(self.free), len(self.free) + num_inputs)  # where in z they are
        self.size = self.inputs.stop + self.design.count
        self._at: bytes | None = None
        self._linearization: list[StepDerivatives] = []

    @property
    def is_last(self) -> bool:
        """Whether the motion ends with these steps."""
        return self.steps.stop == self.problem.num_steps

    def pack(self, x0: Array, us: Array, parameters: Array | None = None) -> Array:
        """z (size,) from the first state x0 (nx,), us (n, nu) and parameter values (np,), the problem's where None."""
        inputs = us.ravel() if self.problem.optimizes_controls else np.zeros(0)
        values = self.design.vector.values if parameters is None else parameters
        return np.concatenate([x0[self.free], inputs, self.design.of_values(values)])

    def limits(self) -> tuple[Array, Array]:
        """(lower, upper), each (size,): the bounds of the variables."""
        b, count = self.problem.bounds, self.shape[0]
        lower = self.pack(b.x_lower, np.tile(b.u_lower, (count, 1)), self.design.lower)
        return lower, self.pack(b.x_upper, np.tile(b.u_upper, (count, 1)), self.design.upper)

    def unpack(self, z: Array) -> tuple[Array, Array]:
        """x0 (nx,) and us (n, nu) from z (size,)."""
        x0 = np.array(self.problem.x0)
        x0[self.free] = z[: len(self.free)]
        if not self.problem.optimizes_controls:
            return x0, np.array(self.problem.us[self.steps.start : self.steps.stop])
        return x0, z[self.inputs].reshape(self.shape)

    def parameters(self, z: Array) -> ParameterVector:
        """Those of the problem's `design` at z (size,)."""
        return self.design.at(z[self.inputs.stop :])

    def time_step(self, z: Array) -> float:
        """[s] the length of a step at z (size,)."""
        return self.design.time_step(self.design.values(z[self.inputs.stop :]))

    def gradient(self, z: Array, totals: Totals) -> Array:
        """(size,) the gradient by z from those by x0 (nx,), us (n, nu) and parameters (np,)."""
        inputs = totals.inputs.ravel() if self.problem.optimizes_controls else np.zeros(0)
        return np.concatenate([totals.states[0][self.free], inputs, self.pull_back(z, totals.parameters)])

    def pull_back(self, z: Array, by_parameters: Array) -> Array:
        """(..., nc) the derivative by the coordinates of the design in z."""
        return self.design.pull_back(z[self.inputs.stop :], by_parameters)

    def linearization(self, z: Array) -> list[StepDerivatives]:
        """The step derivatives along the states of z."""
        if z.tobytes() != self._at:
            (x0, us), vector = self.unpack(z), self.parameters(z)
            with self.problem.intervals(vector) as intervals:
                given = None if self.around is None else self.around[:-1]
                self._linearization = intervals.derivatives(x0, us, given)
            self._at = z.tobytes()
        return self._linearization

    def attempt(self, evaluate: Callable[[], Any], failed: Any) -> Any:
        """`evaluate()`, or `failed` (NaN) where the simulation fails and the solver takes that for too long a step."""
        try:
            return evaluate()
        except (GradientError, SimulationError) as error:
            self.refusal = str(error)
            if self.tolerate_failure:
                return failed
            raise

    def states(self, z: Array) -> Array:
        """(n+1, nx) the states of the rollout of z, or those given."""
        if self.around is not None:
            return self.around
        if self.careful:
            self.linearization(z)
        x0, us = self.unpack(z)
        if z.tobytes() == self._at:
            return np.vstack([x0, [d.x_next for d in self._linearization]])
        with self.problem.intervals(self.parameters(z)) as intervals:
            return roll(intervals, x0, us)


def state_sensitivities(variables: ShootingVariables, z: Array) -> Array:
    """(n+1, nx, size): d x_k / d z for every state of the segment."""
    sensitivities = np.empty((variables.shape[0] + 1, variables.problem.model.nx, variables.size))
    for k, sensitivity in enumerate(_sensitivities(variables, z)):
        sensitivities[k] = sensitivity
    return sensitivities


def final_sensitivity(variables: ShootingVariables, z: Array) -> Array:
    """(nx, size): d x_n / d z, backward: d x_n / d x_k from the last k on, in time and memory that grow as n.

    Forward, all inputs' columns are carried through every step, which takes n^2.
    """
    steps, nu = variables.linearization(z), variables.shape[1]
    found, after = np.zeros((variables.problem.model.nx, variables.size)), np.eye(variables.problem.model.nx)
    for k in reversed(range(len(steps))):
        check_time()
        d = steps[k]
        if variables.problem.optimizes_controls:
            start = variables.inputs.start + k * nu
            found[:, start : start + nu] = after @ d.B
        found[:, variables.inputs.stop :] += after @ variables.pull_back(z, d.C)
        after = after @ d.A
    found[:, np.arange(len(variables.free))] = after[:, variables.free]
    return found


def _sensitivities(variables: ShootingVariables, z: Array) -> Iterator[Array]:
    """d x_k / d z for k = 0 ... n, forward: S_(k+1) = A_k S_k + B_k d u_k / d z + C_k d p / d z."""
    sensitivity, nu = np.zeros((variables.problem.model.nx, variables.size)), variables.shape[1]
    sensitivity[variables.free, np.arange(len(variables.free))] = 1.0
    yield sensitivity
    for k, d in enumerate(variables.linearization(z)):
        check_time()
        sensitivity = d.A @ sensitivity
        if variables.problem.optimizes_controls:
            start = variables.inputs.start + k * nu
            sensitivity[:, start : start + nu] += d.B
        sensitivity[:, variables.inputs.stop :] += variables.pull_back(z, d.C)
        yield sensitivity


class RolloutCost:
    """What the steps of z add to the objective, as a function of floats or AutoDiffXd, by reverse accumulation."""

    def __init__(self, problem: Problem, variables: ShootingVariables):
        self.variables, self.running = variables, problem.total_running_cost
        self.first_step = problem.design.time_step(problem.design.vector.values)
        self.final = problem.total_final_cost if variables.is_last else None
        self.trajectory = problem.trajectory_cost
        self.of_parameters = problem.parameter_cost if variables.is_last else None

    @property
    def any(self) -> bool:
        """Whether there is a cost here."""
        return any(cost is not None for cost in (self.running, self.final, self.trajectory, self.of_parameters))

    def __call__(self, z: Any) -> Any:
        if z.dtype == float:
            return self.variables.attempt(lambda: self.value(z), np.nan)
        at = ExtractValue(z.reshape(-1, 1)).ravel()
        missing = np.nan, np.full(len(at), np.nan)
        value, gradient = self.variables.attempt(lambda: self.differentiate(at), missing)
        return chain(value, gradient, z)

    def value(self, z: Array) -> float:
        """The cost at z."""
        xs, us = self.variables.states(z), self.variables.unpack(z)[1]
        total = 0.0 if self.final is None else float(self.final(xs[-1]))
        if self.of_parameters is not None:
            total += float(self.of_parameters(self.variables.design.own(self.variables.parameters(z).values)))
        if self.running is not None:
            total += self.variables.time_step(z) * sum(
                float(self._rate(k)(x, u)) for k, (x, u) in enumerate(zip(xs, us, strict=False))
            )
        return total + (0.0 if self.trajectory is None else float(self.trajectory(xs, us)))

    def _rate(self, k: int) -> Any:
        """The running cost at step `k` of these; one that changes in time has steps of one length."""
        return cost_at(self.running, (self.variables.steps.start + k) * self.first_step)

    def differentiate(self, z: Array) -> tuple[float, Array]:
        """(value, gradient by z) at z."""
        total, by_xs, by_us = self.partials(z)
        gradient = self.variables.gradient(z, accumulate(self.variables.linearization(z), by_xs, by_us))
        added, by_z = self.by_design(z)
        return total + added, gradient + by_z

    def by_design(self, z: Array) -> tuple[float, Array]:
        """(what the parameters cost, the gradient (size,) by z of that and of the running cost by a step's length)."""
        design, gradient, total = self.variables.design, np.zeros(self.variables.size), 0.0
        by_values = np.zeros(len(design.vector.values))
        if self.of_parameters is not None:
            own = np.array(design.own(self.variables.parameters(z).values))
            total, by_values[: len(own)] = differentiate_final_cost(self.of_parameters, own)
        if design.moves_step and self.running is not None:
            pairs = zip(self.variables.states(z), self.variables.unpack(z)[1], strict=False)
            by_values[design.own_count] = sum(float(self._rate(k)(x, u)) for k, (x, u) in enumerate(pairs))
        gradient[self.variables.inputs.stop :] = self.variables.pull_back(z, by_values)
        return total, gradient

    def partials(self, z: Array) -> tuple[float, Array, Array]:
        """(value, its derivatives by the states (n+1, nx) and the inputs (n, nu) themselves, the steps apart) at z."""
        xs, us, h = self.variables.states(z), self.variables.unpack(z)[1], self.variables.time_step(z)
        by_xs, by_us, total = np.zeros_like(xs), np.zeros_like(us), 0.0
        if self.running is not None:
            for k, u in enumerate(us):
                value, by_x, by_u = differentiate_cost(self._rate(k), xs[k], u)
                total += h * value
                by_xs[k], by_us[k] = h * by_x, h * by_u
        if self.final is not None:
            value, by_xs[-1] = differentiate_final_cost(self.final, xs[-1])
            total += value
        if self.trajectory is not None:
            value, added_xs, added_us, _ = differentiate_loss(self.trajectory, xs, us)
            total, by_xs, by_us = total + value, by_xs + added_xs, by_us + added_us
        return total, by_xs, by_us


@dataclass(frozen=True, eq=False)
class Rows:
    """lower <= values(z) <= upper, m rows of a segment's z, or of more variables after it; floats or AutoDiffXd."""

    variables: ShootingVariables
    lower: Array
    upper: Array
    values: Callable[[Array], Array]
    jacobian: Callable[[Array], Array]

    def __call__(self, z: Any) -> Any:
        missing = np.full(len(self.lower), np.nan)
        if z.dtype == float:
            return self.variables.attempt(lambda: self.values(z), missing)
        at = ExtractValue(z.reshape(-1, 1)).ravel()
        values, jacobian = self.variables.attempt(
            lambda: (self.values(at), self.jacobian(at)), (missing, np.full((len(missing), len(at)), np.nan))
        )
        return chain_rows(values, jacobian, z)


def limits_of_states(problem: Problem, variables: ShootingVariables) -> Rows:
    """Bounds, waypoints and goal at the knots after the first, but not where the next segment begins."""
    first, last = variables.steps.start, variables.steps.stop
    lower, upper = (side[first : last + variables.is_last] for side in problem.state_limits())
    steps, entries = np.nonzero(np.isfinite(lower) | np.isfinite(upper))
    steps, entries = steps[steps > 0], entries[steps > 0]

    def values(z: Array) -> Array:
        return variables.states(z)[steps, entries]

    def jacobian(z: Array) -> Array:
        found = np.empty((len(steps), variables.size))
        for k, sensitivity in enumerate(_sensitivities(variables, z)):
            here = steps == k
            found[here] = sensitivity[entries[here]]
        return found

    return Rows(variables, lower[steps, entries], upper[steps, entries], values, jacobian)


def limits_of_constraints(problem: Problem, variables: ShootingVariables) -> Rows:
    """The problem's constraints at the knots from the first on, but not where the next segment begins."""
    first, nx, nu = variables.steps.start, problem.model.nx, problem.model.nu
    knots = range(first, variables.steps.stop + variables.is_last)
    given = problem.initial_state_is_given
    here = [(k - first, c) for c in problem.kept for k in c.at_knots(problem.num_steps, given) if k in knots]
    at_knot: dict[int, list[tuple[int, Constraint]]] = {}
    for i, (k, c) in enumerate(here):
        at_knot.setdefault(k, []).append((i, c))

    def values(z: Array) -> Array:
        xs, us = variables.states(z), variables.unpack(z)[1]
        with np.errstate(all="ignore"):  # solvers know what to do with what is not finite
            return np.concatenate([c(xs[k], us[min(k, len(us) - 1)]) for k, c in here])

    def jacobian(z: Array) -> Array:
        xs, us, found = variables.states(z), variables.unpack(z)[1], [none[0]] * len(here)
        for k, sensitivity in enumerate(_sensitivities(variables, z)):  # of all knots they would take n^2 numbers
            for row, c in at_knot.get(k, ()):
                by_xu = c.differentiate(xs[k], us[min(k, len(us) - 1)])[1]
                found[row] = by_xu[:, :nx] @ sensitivity
                if k < len(us) and problem.optimizes_controls:
                    start = variables.inputs.start + k * nu
                    found[row][:, start : start + nu] += by_xu[:, nx:]
        return np.concatenate(found)

    none = [np.zeros(0)]
    lower, upper = (np.concatenate([getattr(c, side) for _, c in here] or none) for side in ("lower", "upper"))
    return Rows(variables, lower, upper, values, jacobian)


def limits_of_coupling(motion: SegmentedMotion, coupling: BoundCoupling) -> Rows:
    """What joins several knots, by the z of the whole motion, whatever segments these are in."""
    problem, rows, first = motion.problem, coupling.rows, motion.whole.inputs.start
    (nx, nu), n = (problem.model.nx, problem.model.nu), coupling.knots.shape[1]

    def values(z: Array) -> Array:
        xs, us = motion.states(z), motion.inputs(z)
        with np.errstate(all="ignore"):
            return np.concatenate([rows(*coupling.packed(xs, us, at)) for at in coupling.knots])

    def jacobian(z: Array) -> Array:
        xs, us = motion.states(z), motion.inputs(z)
        slopes = [rows.differentiate(*coupling.packed(xs, us, at))[1] for at in coupling.knots]
        moved = {k for slope, at in zip(slopes, coupling.knots, strict=True) for k in at if np.any(slope[:, : n * nx])}
        by_z, found = motion.sensitivities(z, moved), []
        for slope, at in zip(slopes, coupling.knots, strict=True):
            row = np.zeros((len(slope), len(z)))
            for i, k in enumerate(at):
                if k in by_z:
                    row += slope[:, i * nx : (i + 1) * nx] @ by_z[k]
                if coupling.takes_input and problem.optimizes_controls:
                    start = first + k * nu
                    row[:, start : start + nu] += slope[:, n * nx + i * nu : n * nx + (i + 1) * nu]
            found.append(row)
        return np.concatenate(found)

    lower, upper = (np.tile(side, len(coupling.knots)) for side in (rows.lower, rows.upper))
    return Rows(motion.whole, lower, upper, values, jacobian)


def defect(variables: ShootingVariables) -> Rows:
    """0 = the end of a segment less the start of the next, by [z; the state that the next starts from]."""
    size, nx = variables.size, variables.problem.model.nx

    def values(z: Array) -> Array:
        return variables.states(z[:size])[-1] - z[size:]

    def jacobian(z: Array) -> Array:
        return np.hstack([final_sensitivity(variables, z[:size]), -np.eye(nx)])

    return Rows(variables, np.zeros(nx), np.zeros(nx), values, jacobian)
