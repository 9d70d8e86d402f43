"""Direct collocation: Drake's DirectCollocation over the model's equations of motion in continuous time."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractValue
from pydrake.solvers import MathematicalProgram

from drake_diff._base.arrays import Array, Indices, frozen
from drake_diff._base.autodiff import chain
from drake_diff.model.equations import ContinuousSystem, EquationsOfMotion
from drake_diff.optimize.drake_program import solve_program
from drake_diff.optimize.iterate import Iterate
from drake_diff.optimize.problem.cost import QuadraticCost, differentiate_cost, differentiate_final_cost
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits, NlpResult, Report


def solve_collocation(
    problem: Problem, xs: Array, us: Array, *, solver: str, limits: Limits, report: Report | None
) -> tuple[NlpResult, Array, Array, Array | None]:
    """Solve `problem` from the guess xs (N+1, nx), us (N, nu); gives (result, xs, us, u_final).

    N intervals of exactly model.time_step; inputs linear between knots; running cost by the trapezoid rule.
    Raises ModelError where the model has no continuous form.
    """
    from pydrake.planning import DirectCollocation  # as slow to import as NumPy, and of this method alone

    h, count, b = problem.model.time_step, problem.num_steps, problem.bounds
    system = ContinuousSystem(EquationsOfMotion(problem.model))
    drake = DirectCollocation(system, system.CreateDefaultContext(), count + 1, h, h)
    program = drake.prog()
    states = [drake.state(k) for k in range(count + 1)]
    inputs = [drake.input(k) for k in range(count + 1)]
    for variables, lower, upper in zip(states, *problem.state_limits(), strict=True):
        program.AddBoundingBoxConstraint(lower, upper, variables)
    for variables in inputs:
        program.AddBoundingBoxConstraint(b.u_lower, b.u_upper, variables)
    _add_hull(problem, program, states, inputs)
    _add_costs(problem, program, states, inputs)
    guess, steps = np.zeros(program.num_vars()), [drake.time_step(k) for k in range(count)]
    for variables, values in zip([*states, *inputs, *steps], [*xs, *us, us[-1], *[[h]] * count], strict=True):
        program.SetDecisionVariableValueInVector(variables, values, guess)
    places = [np.array([program.FindDecisionVariableIndices(v) for v in variables]) for variables in (states, inputs)]

    def motions(z: Array) -> tuple[Iterate, ...]:
        xs, us = frozen(z[places[0]]), frozen(z[places[1][:-1]])
        return (Iterate(problem, frozen(h * np.arange(count + 1)), xs, us, problem.parameters, by_steps=False),)

    result = solve_program(program, guess, solver=solver, limits=limits, report=report, motions=motions)
    xs, us = (result.z[at] for at in places)
    return result, xs, us[:-1], us[-1]


def _add_hull(problem: Problem, program: MathematicalProgram, states: list[Any], inputs: list[Any]) -> None:
    """Keep the inner Bernstein coefficients of bounded states, x + h f / 3 and x - h f / 3, within their bounds too."""
    b, count, h = problem.bounds, problem.num_steps, problem.model.time_step
    bounded = np.flatnonzero((np.isfinite(b.x_lower) | np.isfinite(b.x_upper)) & (b.x_lower < b.x_upper))
    equations = EquationsOfMotion(problem.model)
    for k, (x, u) in enumerate(zip(states, inputs, strict=True) if len(bounded) else ()):
        signs = np.array([1.0] * (k < count) + [-1.0] * (k > 0))
        lower, upper = (np.tile(side[bounded], len(signs)) for side in (b.x_lower, b.x_upper))
        program.AddConstraint(_Hull(equations, bounded, h / 3 * signs), lower, upper, vars=np.concatenate([x, u]))


class _Hull:
    """x + step f(x, u) of the states `bounded`, for each of `steps` [s], of floats or AutoDiffXd [x, u]."""

    def __init__(self, equations: EquationsOfMotion, bounded: Indices, steps: Array):
        self.equations, self.bounded, self.steps = equations, bounded, steps

    def __call__(self, z: Any) -> Any:
        nx = self.equations.model.nx
        rates = self.equations.values(z[None])[0] if z.dtype == float else self.equations.autodiff(z[:nx], z[nx:])
        return np.concatenate([z[self.bounded] + step * rates[self.bounded] for step in self.steps])


def _add_costs(problem: Problem, program: MathematicalProgram, states: list[Any], inputs: list[Any]) -> None:
    running, final, nx = problem.total_running_cost, problem.total_final_cost, problem.nx
    h, count = problem.time_step, problem.num_steps

    def differentiate_running(z: Array) -> tuple[float, Array]:
        value, by_x, by_u = differentiate_cost(running, z[:nx], z[nx:])
        return value, np.concatenate([by_x, by_u])

    def add_quadratic_form(weight: float, form: Any, reference: Any, variables: Any) -> None:
        if form is None or not len(variables):
            return
        r = np.zeros(len(variables)) if reference is None else reference
        constant = weight * float(r @ form @ r)
        program.AddQuadraticCost(2 * weight * form, -2 * weight * form @ r, constant, variables, is_convex=True)

    for k, (x, u) in enumerate(zip(states, inputs, strict=True)):
        weight = h / 2 if k in (0, count) else h
        if isinstance(running, QuadraticCost):
            add_quadratic_form(weight, running.Q, running.x_ref, x)
            add_quadratic_form(weight, running.R, running.u_ref, u)
        elif running is not None:
            program.AddCost(_Cost(differentiate_running, weight), vars=np.concatenate([x, u]))
    if isinstance(final, QuadraticCost):
        add_quadratic_form(1.0, final.Q, final.x_ref, states[-1])
    elif final is not None:
        program.AddCost(_Cost(partial(differentiate_final_cost, final), 1.0), vars=states[-1])


class _Cost:
    """weight * cost(z) for a MathematicalProgram, floats or AutoDiffXd, from its value and gradient."""

    def __init__(self, differentiate: Callable[[Array], tuple[float, Array]], weight: float):
        self.differentiate, self.weight = differentiate, weight

    def __call__(self, z: Any) -> Any:
        value, gradient = self.differentiate(z if z.dtype == float else ExtractValue(z).ravel())
        return self.weight * value if z.dtype == float else chain(self.weight * value, self.weight * gradient, z)
