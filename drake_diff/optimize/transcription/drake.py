"""Direct collocation: Drake's DirectCollocation over the model's equations of motion in continuous time."""

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractValue

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import chain
from drake_diff.model.equations import ContinuousSystem, EquationsOfMotion
from drake_diff.optimize.drake_program import solve_program
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
    transcription = _Transcription(problem)
    guess = transcription.pack(xs, np.vstack([us, us[-1:]]))
    result = solve_program(transcription.program, guess, solver=solver, limits=limits, report=report)
    found_xs, found_us = transcription.unpack(result.z)
    return result, found_xs, found_us[:-1], found_us[-1]


class _Transcription:
    """Drake's program with this problem's costs and constraints on it."""

    def __init__(self, problem: Problem):
        from pydrake.planning import DirectCollocation  # as slow to import as NumPy, and of this method alone

        self.problem = problem
        h, count = problem.model.time_step, problem.num_steps
        system = ContinuousSystem(EquationsOfMotion(problem.model))
        self.drake = DirectCollocation(system, system.CreateDefaultContext(), count + 1, h, h)
        self.program = self.drake.prog()
        self.states = [self.drake.state(k) for k in range(count + 1)]
        self.inputs = [self.drake.input(k) for k in range(count + 1)]
        self._add_limits()
        self._add_costs()

    def pack(self, xs: Array, us: Array) -> Array:
        """The decision variables from xs (N+1, nx) and us (N+1, nu)."""
        z = np.zeros(self.program.num_vars())
        for variables, values in zip(self.states + self.inputs, [*xs, *us], strict=True):
            self.program.SetDecisionVariableValueInVector(variables, values, z)
        for k in range(self.problem.num_steps):
            self.program.SetDecisionVariableValueInVector(
                self.drake.time_step(k), np.array([self.problem.model.time_step]), z
            )
        return z

    def unpack(self, z: Array) -> tuple[Array, Array]:
        """xs (N+1, nx) and us (N+1, nu) from the decision variables."""
        xs = [z[self.program.FindDecisionVariableIndices(v)] for v in self.states]
        us = [z[self.program.FindDecisionVariableIndices(v)] for v in self.inputs]
        return np.array(xs), np.array(us)

    def _add_limits(self) -> None:
        """Bounds, equal where an end is given."""
        for variables, lower, upper in zip(self.states, *self.problem.state_limits(), strict=True):
            self.program.AddBoundingBoxConstraint(lower, upper, variables)
        b = self.problem.bounds
        for variables in self.inputs:
            self.program.AddBoundingBoxConstraint(b.u_lower, b.u_upper, variables)

    def _add_costs(self) -> None:
        running, final, nx = self.problem.running_cost, self.problem.final_cost, self.problem.nx
        h, count = self.problem.time_step, self.problem.num_steps

        def differentiate_running(z: Array) -> tuple[float, Array]:
            value, by_x, by_u = differentiate_cost(running, z[:nx], z[nx:])
            return value, np.concatenate([by_x, by_u])

        for k, (x, u) in enumerate(zip(self.states, self.inputs, strict=True)):
            weight = h / 2 if k in (0, count) else h
            if isinstance(running, QuadraticCost):
                self._add_quadratic_form(weight, running.Q, running.x_ref, x)
                self._add_quadratic_form(weight, running.R, running.u_ref, u)
            elif running is not None:
                self.program.AddCost(_Cost(differentiate_running, weight), vars=np.concatenate([x, u]))
        if isinstance(final, QuadraticCost):
            self._add_quadratic_form(1.0, final.Q, final.x_ref, self.states[-1])
        elif final is not None:
            self.program.AddCost(_Cost(partial(differentiate_final_cost, final), 1.0), vars=self.states[-1])

    def _add_quadratic_form(self, weight: float, form: Any, reference: Any, variables: Any) -> None:
        if form is None or not len(variables):
            return
        r = np.zeros(len(variables)) if reference is None else reference
        self.program.AddQuadraticCost(
            2 * weight * form, -2 * weight * form @ r, weight * float(r @ form @ r), variables, is_convex=True
        )


class _Cost:
    """weight * cost(z) for a MathematicalProgram, floats or AutoDiffXd, from its value and gradient."""

    def __init__(self, differentiate: Callable[[Array], tuple[float, Array]], weight: float):
        self.differentiate, self.weight = differentiate, weight

    def __call__(self, z: Any) -> Any:
        value, gradient = self.differentiate(z if z.dtype == float else ExtractValue(z).ravel())
        return self.weight * value if z.dtype == float else chain(self.weight * value, self.weight * gradient, z)
