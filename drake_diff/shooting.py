"""Single shooting: inputs, initial state, parameters are the variables, Drake's own steps the dynamics."""

from collections.abc import Callable
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractValue
from pydrake.solvers import MathematicalProgram

from drake_diff.arrays import Array
from drake_diff.autodiff import chain, chain_rows
from drake_diff.cost import differentiate_cost, differentiate_final_cost
from drake_diff.exceptions import SimulationError
from drake_diff.nonlinear_program import Limits, NlpResult, Report, solve_program
from drake_diff.parameter_coordinates import ParameterCoordinates
from drake_diff.parameters import ParameterVector, applied
from drake_diff.problem import Problem
from drake_diff.rollout import roll_states
from drake_diff.rollout_gradient import Totals, accumulate, differentiate_loss, linearize
from drake_diff.step_derivatives import StepDerivatives

DEFAULT_SOLVER = "snopt"


def solve_shooting(
    problem: Problem, xs: Array, us: Array, *, solver: str, limits: Limits, report: Report | None
) -> tuple[NlpResult, Array, Array]:
    """Solve `problem` from the guess xs[0] (nx,), us (N, nu); gives (result, xs, us).

    Raises GradientError or SimulationError where a step or its derivative is refused.
    """
    # IPOPT shortens a step whose end it cannot evaluate; SNOPT, in Drake, has no way to be told.
    variables = ShootingVariables(problem, tolerate_failure=solver == "ipopt")
    program = _program(problem, variables)
    guess = variables.pack(xs[0], us)
    result = solve_program(program, guess, solver=solver, limits=limits, report=report)
    return result, variables.states(result.z), variables.unpack(result.z)[1]


class ShootingVariables:
    """z = [free entries of x0; us; parameters in their coordinates] and its rollout, linearized once for each z."""

    def __init__(self, problem: Problem, *, tolerate_failure: bool = False):
        self.problem = problem
        self.tolerate_failure = tolerate_failure
        self.free = np.flatnonzero(problem.initial_state_mask)
        self.shape = (problem.num_steps, problem.model.nu)
        self.coordinates = ParameterCoordinates(problem.parameters) if problem.optimizes_parameters else None
        self.num_parameters = len(problem.parameters.values) if problem.optimizes_parameters else 0
        self._end = len(self.free) + (self.shape[0] * self.shape[1] if problem.optimizes_controls else 0)
        self.size = self._end + self.num_parameters
        self._at: bytes = b""
        self._linearization: list[StepDerivatives] = []

    def pack(self, x0: Array, us: Array, parameters: Array | None = None) -> Array:
        """z (size,) from x0 (nx,), us (N, nu) and parameter values (np,), the problem's where None."""
        inputs = us.ravel() if self.problem.optimizes_controls else np.zeros(0)
        values = self.problem.parameters.values if parameters is None else parameters
        coordinates = np.zeros(0) if self.coordinates is None else self.coordinates.from_values(values)
        return np.concatenate([x0[self.free], inputs, coordinates])

    def unpack(self, z: Array) -> tuple[Array, Array]:
        """x0 (nx,) and us (N, nu) from z (size,)."""
        x0 = np.array(self.problem.x0)
        x0[self.free] = z[: len(self.free)]
        if not self.problem.optimizes_controls:
            return x0, np.array(self.problem.us)
        return x0, z[len(self.free) : self._end].reshape(self.shape)

    def parameters(self, z: Array) -> ParameterVector:
        """The problem's parameters at z (size,)."""
        if self.coordinates is None:
            return self.problem.parameters
        return self.problem.parameters.at(self.coordinates.to_values(z[self._end :]))

    def gradient(self, z: Array, totals: Totals) -> Array:
        """(size,) the gradient by z from those by x0 (nx,), us (N, nu) and parameters (np,)."""
        inputs = totals.inputs.ravel() if self.problem.optimizes_controls else np.zeros(0)
        return np.concatenate([totals.states[0][self.free], inputs, self.pull_back(z, totals.parameters)])

    def pull_back(self, z: Array, by_parameters: Array) -> Array:
        """(..., num_parameters) the derivative by the parameters' coordinates in z."""
        if self.coordinates is None:
            return np.zeros((*by_parameters.shape[:-1], 0))
        return self.coordinates.pull_back(z[self._end :], by_parameters)

    def linearization(self, z: Array) -> list[StepDerivatives]:
        """The step derivatives along the rollout of z."""
        if z.tobytes() != self._at:
            (x0, us), vector = self.unpack(z), self.parameters(z)
            with applied(vector) as model:
                self._linearization, self._at = linearize(model, x0, us, vector=vector), z.tobytes()
        return self._linearization

    def attempt(self, evaluate: Callable[[], Any], failed: Any) -> Any:
        """`evaluate()`, or `failed` (NaN) where the simulation fails and the solver takes that for too long a step."""
        try:
            return evaluate()
        except SimulationError:
            if self.tolerate_failure:
                return failed
            raise

    def states(self, z: Array) -> Array:
        """(N+1, nx) the states of the rollout of z."""
        x0, us = self.unpack(z)
        if z.tobytes() == self._at:
            return np.vstack([x0, [d.x_next for d in self._linearization]])
        with applied(self.parameters(z)) as model:
            return roll_states(model, x0, us)


def _program(problem: Problem, variables: ShootingVariables) -> MathematicalProgram:
    program = MathematicalProgram()
    z = program.NewContinuousVariables(variables.size, "z")
    b = problem.bounds
    lowest, highest = problem.bounds_of_parameters()
    lower = variables.pack(b.x_lower, np.tile(b.u_lower, (problem.num_steps, 1)), lowest)
    upper = variables.pack(b.x_upper, np.tile(b.u_upper, (problem.num_steps, 1)), highest)
    program.AddBoundingBoxConstraint(lower, upper, z).evaluator().set_description("variables")
    if any(cost is not None for cost in (problem.running_cost, problem.final_cost, problem.trajectory_cost)):
        program.AddCost(RolloutCost(problem, variables), vars=z)
    wanted = np.flatnonzero(~np.isnan(problem.goal))
    if len(wanted):
        goal = problem.goal[wanted]
        rows = _StateRows(variables, [(problem.num_steps, int(i)) for i in wanted])
        program.AddConstraint(rows, goal, goal, vars=z, description="goal")
    bounded = [
        (k, int(i))
        for k in range(1, problem.num_steps + 1)
        for i in np.flatnonzero(np.isfinite(b.x_lower) | np.isfinite(b.x_upper))
    ]
    if bounded:
        columns = [i for _, i in bounded]
        rows = _StateRows(variables, bounded)
        program.AddConstraint(rows, b.x_lower[columns], b.x_upper[columns], vars=z, description="state bounds")
    return program


class RolloutCost:
    """The objective as a function of z, floats or AutoDiffXd, by reverse accumulation."""

    def __init__(self, problem: Problem, variables: ShootingVariables):
        self.problem, self.variables = problem, variables

    def __call__(self, z: Any) -> Any:
        if z.dtype == float:
            return self.variables.attempt(lambda: self.value(z), np.nan)
        at = ExtractValue(z.reshape(-1, 1)).ravel()
        missing = np.nan, np.full(len(at), np.nan), None
        value, gradient, _ = self.variables.attempt(lambda: self.differentiate(at), missing)
        return chain(value, gradient, z)

    def value(self, z: Array) -> float:
        """The objective at z."""
        return self.problem.objective(self.variables.states(z), self.variables.unpack(z)[1])

    def differentiate(self, z: Array) -> tuple[float, Array, Array]:
        """(value, gradient by z, gradients by every state (N+1, nx)) at z."""
        problem, (_, us) = self.problem, self.variables.unpack(z)
        linearization = self.variables.linearization(z)
        xs, h = self.variables.states(z), problem.model.time_step
        by_xs, by_us, total = np.zeros_like(xs), np.zeros_like(us), 0.0
        if problem.running_cost is not None:
            for k, u in enumerate(us):
                value, by_x, by_u = differentiate_cost(problem.running_cost, xs[k], u)
                total += h * value
                by_xs[k], by_us[k] = h * by_x, h * by_u
        if problem.final_cost is not None:
            value, by_xs[-1] = differentiate_final_cost(problem.final_cost, xs[-1])
            total += value
        if problem.trajectory_cost is not None:
            value, added_xs, added_us = differentiate_loss(problem.trajectory_cost, xs, us)
            total, by_xs, by_us = total + value, by_xs + added_xs, by_us + added_us
        totals = accumulate(linearization, by_xs, by_us)
        return total, self.variables.gradient(z, totals), totals.states


class _StateRows:
    """Chosen entries (step, coordinate) of the states as a function of z, floats or AutoDiffXd."""

    def __init__(self, variables: ShootingVariables, entries: list[tuple[int, int]]):
        self.variables = variables
        self.steps = np.array([k for k, _ in entries])
        self.coordinates = np.array([i for _, i in entries])

    def __call__(self, z: Any) -> Any:
        missing = np.full(len(self.steps), np.nan)
        if z.dtype == float:
            return self.variables.attempt(lambda: self._values(z), missing)
        at = ExtractValue(z.reshape(-1, 1)).ravel()
        values, jacobian = self.variables.attempt(
            lambda: (self._values(at), state_sensitivities(self.variables, at)[self.steps, self.coordinates]),
            (missing, np.full((len(missing), len(at)), np.nan)),
        )
        return chain_rows(values, jacobian, z)

    def _values(self, z: Array) -> Array:
        return self.variables.states(z)[self.steps, self.coordinates]


def state_sensitivities(variables: ShootingVariables, z: Array) -> Array:
    """(N+1, nx, size): d x_k / d z, forward: S_(k+1) = A_k S_k + B_k d u_k / d z + C_k d p / d z."""
    linearization = variables.linearization(z)
    nx, nu, free = variables.problem.model.nx, variables.shape[1], len(variables.free)
    sensitivities = np.zeros((len(linearization) + 1, nx, variables.size))
    sensitivities[0, variables.free, np.arange(free)] = 1.0
    for k, d in enumerate(linearization):
        sensitivities[k + 1] = d.A @ sensitivities[k]
        if variables.problem.optimizes_controls:
            start = free + k * nu
            sensitivities[k + 1][:, start : start + nu] += d.B
        sensitivities[k + 1][:, variables.size - variables.num_parameters :] += variables.pull_back(z, d.C)
    return sensitivities
