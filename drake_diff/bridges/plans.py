"""The plan of a problem as a function of its first state, its goal and model parameters, with derivatives."""

from __future__ import annotations

import math
import warnings
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from drake_diff._base.arrays import Array, Shape, finite_array
from drake_diff.exceptions import GradientError, GradientWarning, InputError
from drake_diff.model.parameters import select
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.sensitivity import ENDS, Sensitivity, sensitivity
from drake_diff.optimize.solution import Solution
from drake_diff.optimize.solve import solve

REMEMBERED = 256  # solutions between a forward and a backward pass; JAX passes only arrays from one to the other


class PlanArrays(NamedTuple):
    """A plan: its states (..., N+1, nx), its inputs (..., N, nu), its cost (...) and its horizon (...) [s]."""

    xs: Any
    us: Any
    cost: Any
    horizon: Any


class PlanFunction:
    """The plan of a problem for values of `names`: "x0", "goal" and names of model parameters.

    With `certify`, problems are solved again on both sides, and a GradientWarning names a derivative that differs.
    """

    def __init__(self, problem: Problem, names: tuple[str, ...], options: Mapping[str, Any], certify: bool):
        self.problem, self.names, self.options, self.certify = problem, names, options, certify
        if not names:
            raise InputError("parameters", got="none", expected="at least one value")
        parameters = [name for name in names if name not in ENDS]
        vector = select(problem.model, parameters) if parameters else None
        if "goal" in names and problem.x_goal is None:
            raise InputError("goal", got="a value", expected="none, as the problem has no goal")
        self.shapes: dict[str, Shape] = dict.fromkeys(names, (problem.nx,))
        for parameter in vector.parameters if vector else ():
            self.shapes[parameter.name] = (len(parameter.value),) if len(parameter.value) > 1 else ()
        self._solutions: OrderedDict[bytes, Solution] = OrderedDict()

    def sizes(self, batch: Shape) -> tuple[Shape, ...]:
        """Return the shapes of a plan's arrays for values with the leading dimensions `batch`."""
        p = self.problem
        return (*batch, p.num_steps + 1, p.nx), (*batch, p.num_steps, p.nu), batch, batch

    def plans(self, values: Sequence[Any]) -> tuple[Array, ...]:
        """Return the arrays of the plan for values (..., n) in the order of `names`, with equal leading dimensions."""
        rows, batch = self._rows(values)
        for row in rows:  # what the problem's costs read may differ from the last call
            self._solutions.pop(_key(row), None)
        solutions = [self._solution(*row) for row in enumerate(rows)]
        columns = zip(*((s.xs, s.us, s.cost, s.times[-1]) for s in solutions), strict=True)
        arrays = [np.array(column, dtype=float) for column in columns]
        return tuple(array.reshape(size) for array, size in zip(arrays, self.sizes(batch), strict=True))

    def pull_back(self, values: Sequence[Any], by: Sequence[Any]) -> tuple[Array, ...]:
        """Return a loss's gradients by the values from its gradients by the arrays of the plan."""
        rows, batch = self._rows(values)
        by_plans = [np.asarray(array).reshape(len(rows), -1) for array in by]
        gradients = [np.zeros((len(rows), *self.shapes[name])) for name in self.names]
        for i, row in reversed([*enumerate(rows)]):  # the last solutions are remembered
            of_plan = [array[i] for array in by_plans]
            for gradient, (name, value) in zip(gradients, self._gradient(i, row, of_plan).items(), strict=True):
                gradient[i] = value.reshape(self.shapes[name])
        return tuple(g.reshape((*batch, *g.shape[1:])) for g in gradients)

    def _rows(self, values: Sequence[Any]) -> tuple[list[tuple[Array, ...]], Shape]:
        """Return the values of each problem, and the leading dimensions."""
        arrays = [np.asarray(value, dtype=float) for value in values]
        first = arrays[0]
        batch = first.shape[: first.ndim - len(self.shapes[self.names[0]])]
        count = math.prod(batch)
        flat = [a.reshape(count, *self.shapes[name]) for name, a in zip(self.names, arrays, strict=True)]
        return list(zip(*flat, strict=True)), batch

    def _solution(self, i: int, row: tuple[Array, ...]) -> Solution:
        """Return the solution for values, those of problem `i`; equal values have the same solution."""
        key = _key(row)
        if key not in self._solutions:
            given = dict(zip(self.names, row, strict=True))
            changes: dict[str, Any] = {}
            if "x0" in given:
                changes["x0"] = given.pop("x0")
            if "goal" in given:
                free, goal = np.isnan(self.problem.x_goal), given.pop("goal")
                finite_array("goal", np.where(free, 0.0, goal), goal.shape)  # NaN would free an entry
                changes["x_goal"] = np.where(free, np.nan, goal)
            if given:
                changes["parameters"] = self.problem.parameters.to_dict() | given
            solution = solve(replace(self.problem, **changes), **self.options)
            if not solution.success:
                why = f"{solution.status.value}: {solution.message}"
                raise GradientError(f"problem {i} of the batch was not solved: {why}")
            if len(solution.us) != self.problem.num_steps:
                counts = f"from {self.problem.num_steps} to {len(solution.us)} intervals"
                raise GradientError(f"the mesh was refined {counts}: use more steps, or Options(refine=False)")
            self._solutions[key] = solution
            if len(self._solutions) > REMEMBERED:
                self._solutions.popitem(last=False)
        self._solutions.move_to_end(key)
        return self._solutions[key]

    def _gradient(self, i: int, row: tuple[Array, ...], by_plan: list[Array]) -> dict[str, Array]:
        """Return the gradients by each value; warn if the plan has no derivative, or one that is not certified."""
        solution = self._solution(i, row)
        parameters = tuple(name for name in self.names if name not in ENDS)
        gradients = {}
        for by in [name for name in self.names if name in ENDS] + [parameters] * bool(parameters):
            s = sensitivity(solution, by, certified=self.certify)
            if s.weak or (self.certify and s.verdict != "agree"):
                warnings.warn(
                    f"the derivative of the plan is not valid on both sides: {s}", GradientWarning, stacklevel=2
                )
            gradient = _pulled(s, by_plan)
            if by in ENDS:
                gradients[by] = np.zeros(self.problem.nx)
                entries = [self.problem.state_names.index(name) for name in s.columns]
                gradients[by][entries] = gradient
            else:
                sizes = [math.prod(self.shapes[name]) for name in parameters]
                gradients |= dict(zip(parameters, np.split(gradient, np.cumsum(sizes)[:-1]), strict=True))
        return {name: gradients[name] for name in self.names}


def _key(row: tuple[Array, ...]) -> bytes:
    return b"".join(value.tobytes() for value in row)


def _pulled(s: Sensitivity, by_plan: list[Array]) -> Array:
    """Return the gradient (p,) by the columns of a sensitivity, from those by the plan's arrays, flattened."""
    by_xs, by_us, by_cost, by_horizon = by_plan
    columns = len(s.columns)
    of_arrays = by_xs @ s.xs.reshape(-1, columns) + by_us @ s.us.reshape(-1, columns)
    return np.asarray(of_arrays + by_cost[0] * s.cost + by_horizon[0] * s.horizon)
