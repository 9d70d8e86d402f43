"""Direct collocation: Drake's DirectCollocation over the model's equations of motion in continuous time."""

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
        self._add_ends()
        self._add_bounds()
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

    def _add_ends(self) -> None:
        problem = self.problem
        fixed = ~problem.initial_state_mask
        if fixed.any():
            self._add_box(problem.x0[fixed], problem.x0[fixed], self.states[0][fixed], "initial state")
        wanted = ~np.isnan(problem.goal)
        if wanted.any():
            self._add_box(problem.goal[wanted], problem.goal[wanted], self.states[-1][wanted], "goal")

    def _add_bounds(self) -> None:
        b = self.problem.bounds
        free = self.problem.initial_state_mask
        if free.any():
            self._add_box(b.x_lower[free], b.x_upper[free], self.states[0][free], "initial state bounds")
        for k, variables in enumerate(self.states[1:], start=1):
            self._add_box(b.x_lower, b.x_upper, variables, f"state bounds at knot {k}")
        for k, variables in enumerate(self.inputs):
            self._add_box(b.u_lower, b.u_upper, variables, f"input bounds at knot {k}")

    def _add_box(self, lower: Array, upper: Array, variables: Any, name: str) -> None:
        binding = self.program.AddBoundingBoxConstraint(lower, upper, variables)
        binding.evaluator().set_description(name)

    def _add_costs(self) -> None:
        problem, h = self.problem, self.problem.model.time_step
        if problem.running_cost is not None:
            for k, (x, u) in enumerate(zip(self.states, self.inputs, strict=True)):
                weight = h / 2 if k in (0, problem.num_steps) else h
                self._add_running_cost(weight, x, u)
        if isinstance(problem.final_cost, QuadraticCost):
            self._add_quadratic_form(1.0, problem.final_cost.Q, problem.final_cost.x_ref, self.states[-1])
        elif problem.final_cost is not None:
            self.program.AddCost(_FinalCost(problem), vars=self.states[-1])

    def _add_running_cost(self, weight: float, x: Any, u: Any) -> None:
        cost = self.problem.running_cost
        if isinstance(cost, QuadraticCost):
            self._add_quadratic_form(weight, cost.Q, cost.x_ref, x)
            self._add_quadratic_form(weight, cost.R, cost.u_ref, u)
        else:
            self.program.AddCost(_RunningCost(self.problem, weight), vars=np.concatenate([x, u]))

    def _add_quadratic_form(self, weight: float, form: Any, reference: Any, variables: Any) -> None:
        if form is None or not len(variables):
            return
        r = np.zeros(len(variables)) if reference is None else reference
        self.program.AddQuadraticCost(
            2 * weight * form, -2 * weight * form @ r, weight * float(r @ form @ r), variables, is_convex=True
        )


class _RunningCost:
    """weight * running_cost(x, u) for a MathematicalProgram, floats or AutoDiffXd."""

    def __init__(self, problem: Problem, weight: float):
        self.cost, self.nx, self.weight = problem.running_cost, problem.model.nx, weight

    def __call__(self, z: Any) -> Any:
        if z.dtype == float:
            return self.weight * float(self.cost(z[: self.nx], z[self.nx :]))
        at = ExtractValue(z).ravel()
        value, by_x, by_u = differentiate_cost(self.cost, at[: self.nx], at[self.nx :])
        return chain(self.weight * value, self.weight * np.concatenate([by_x, by_u]), z)


class _FinalCost:
    """final_cost(x) for a MathematicalProgram, floats or AutoDiffXd."""

    def __init__(self, problem: Problem):
        self.cost = problem.final_cost

    def __call__(self, x: Any) -> Any:
        if x.dtype == float:
            return float(self.cost(x))  # type: ignore[misc]
        value, gradient = differentiate_final_cost(self.cost, ExtractValue(x).ravel())  # type: ignore[arg-type]
        return chain(value, gradient, x)
