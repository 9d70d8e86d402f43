"""Shooting, single or multiple: the states, costs and limits of one or more segments as one program.

In multiple shooting (Bock and Plitt, "A multiple shooting algorithm for direct solution of optimal control problems",
1984) the motion is cut into segments, the states that they start from are variables too, and that each ends where the
next begins is a constraint: what a late input does need not be seen through all the steps before it, and a guess of
the states counts. With as many segments as steps it is direct transcription of the discrete plant; single shooting is
the case of one segment.
"""

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from pydrake.solvers import MathematicalProgram

from drake_diff.arrays import Array, positive_int
from drake_diff.exceptions import InputError
from drake_diff.mathematical_program import solve_program
from drake_diff.nonlinear_program import Limits, NlpResult, Report
from drake_diff.problem import Problem
from drake_diff.shooting import RolloutCost, ShootingVariables, defect, limits_of_constraints, limits_of_states

DEFAULT_SOLVER = "snopt"


def check_segments(problem: Problem, method: str, segments: int) -> None:
    """Refuse a number of segments that is none, or that the method or the problem does not allow."""
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
) -> tuple[NlpResult, Array, Array]:
    """Solve `problem` from the guess xs (N+1, nx), us (N, nu); gives (result, xs, us).

    Of xs only the states that segments start from count. The result's z is that of `ShootingVariables` of the whole
    motion. Raises GradientError or SimulationError where a step or its derivative is refused.
    """
    # IPOPT shortens a step whose end it cannot evaluate; SNOPT, in Drake, has no way to be told.
    motion = SegmentedMotion(problem, segments, tolerate_failure=solver == "ipopt")
    result = solve_program(motion.program(), motion.pack(xs, us), solver=solver, limits=limits, report=report)
    whole = replace(result, z=result.z[: motion.whole.size])
    return whole, motion.states(result.z), motion.whole.unpack(whole.z)[1]


def roll_segments(problem: Problem, xs: Array, us: Array, segments: int) -> Array:
    """(N+1, nx): the rollouts under us (N, nu) of all segments, each from its own first state in xs (N+1, nx)."""
    motion = SegmentedMotion(problem, segments)
    return motion.states(motion.pack(xs, us))


class SegmentedMotion:
    """z = [that of the whole motion's ShootingVariables; the states that segments 1, 2, ... start from]."""

    def __init__(self, problem: Problem, count: int, *, tolerate_failure: bool = False):
        ends = np.linspace(0, problem.num_steps, count + 1).astype(int)
        self.problem, self.whole = problem, ShootingVariables(problem)
        self.segments = [
            ShootingVariables(problem, steps=range(a, b), tolerate_failure=tolerate_failure)
            for a, b in pairwise(ends.tolist())
        ]
        self.size = self.whole.size + (count - 1) * problem.model.nx

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

    def states(self, z: Array) -> Array:
        """(N+1, nx): each segment's rollout from its own start."""
        rolled = [segment.states(z[self.indices_of(i)]) for i, segment in enumerate(self.segments)]
        return np.vstack([xs[:-1] for xs in rolled] + [rolled[-1][-1:]])

    def program(self) -> MathematicalProgram:
        """The program; a binding has the variables of one segment, a defect those of the next one's start too."""
        problem, program = self.problem, MathematicalProgram()
        z = program.NewContinuousVariables(self.size, "z")
        program.AddBoundingBoxConstraint(*self._bounds(), z).evaluator().set_description("variables")
        for i, segment in enumerate(self.segments):
            own, cost = z[self.indices_of(i)], RolloutCost(problem, segment)
            if cost.any:
                program.AddCost(cost, vars=own)
            for rows, description in (
                (limits_of_states(problem, segment), "states"),
                (limits_of_constraints(problem, segment), "constraints"),
            ):
                if len(rows.lower):
                    program.AddConstraint(rows, rows.lower, rows.upper, vars=own, description=description)
            if not segment.is_last:
                rows, both = defect(segment), np.concatenate([own, z[self.start_of(i + 1)]])
                program.AddConstraint(rows, rows.lower, rows.upper, vars=both, description="defect")
        return program

    def _bounds(self) -> tuple[Array, Array]:
        b, count = self.problem.bounds, self.problem.num_steps
        lower, upper = self.problem.state_limits()
        lowest, highest = self.problem.bounds_of_parameters()
        return (
            self.pack(lower, np.tile(b.u_lower, (count, 1)), lowest),
            self.pack(upper, np.tile(b.u_upper, (count, 1)), highest),
        )
