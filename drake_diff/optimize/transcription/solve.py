"""A problem in a collocation scheme: transcribed, solved by IPOPT, and solved again on a mesh that is refined.

    minimize    int_0^T L(x, u) dt + F(x(T)),    x' = f(x, u),    x(0) = x0, x(T) = x_goal where they are given.

`errors` of a result say that its motion is what the dynamics do, not that no better one exists: where the mesh is
too coarse for the best input, only a finer one tells.
"""

import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits, Outcome, Report
from drake_diff.optimize.transcription.motion import Collocated, Transcribed
from drake_diff.optimize.transcription.task import OptimalControl, node_fractions

MOST_PIECES = 4  # of one interval in one round of refinement
FOUND = (Outcome.SOLVED, Outcome.INACCURATE)


@dataclass(frozen=True)
class MeshRefinement:
    """Until when a mesh is refined: `errors` and `cost_errors` at most `tolerance`, or `most` intervals."""

    tolerance: float
    most: int


class Transcription:
    """A `Problem` in a scheme, on its own `num_steps` equal intervals to begin with."""

    def __init__(self, problem: Problem, scheme: str):
        from drake_diff.optimize.transcription.expressions import knot_functions  # loads CasADi

        self.problem, self.task = problem, OptimalControl(problem, scheme)
        self.mesh = np.linspace(0, 1, problem.num_steps + 1)
        self.functions = knot_functions(self.task)

    def jacobian(self, knot: Array) -> Array:
        """(nx, nx + nu) of the rates at `knot` (nx + nu,), as the solver gets it."""
        return np.asarray(self.functions.dynamics.jacobian_of(knot))

    def nodes_at(self, mesh: Array, guess: Any) -> Array:
        """(K, nx + nu) the nodes of a guess, xs (N+1, nx) and us (N+1, nu) or a motion, within the input's bounds."""
        f, where = self.task.dynamics, node_fractions(mesh, self.task.scheme)
        if isinstance(guess, Collocated):
            nodes = np.hstack(guess.at(guess.horizon * where))
        else:
            nodes = np.array([np.interp(where, mesh, column) for column in np.hstack(guess).T]).T
        nodes[:, f.nx :] = np.clip(nodes[:, f.nx :], self.task.bounds.u_lower, self.task.bounds.u_upper)
        return nodes

    def solve(
        self,
        guess: Any,
        *,
        horizon: float | None = None,
        limits: Limits,
        report: Report | None,
        refinement: MeshRefinement | None = None,
    ) -> Transcribed:
        """From a guess that `nodes_at` takes, and of `horizon` [s]; `limits.max_iterations` hold for each round.

        A refinement splits the intervals whose error is above its tolerance and solves again from what was found.
        """
        start, mesh = time.monotonic(), self.mesh
        first = float(np.clip(self.problem.start_horizon if horizon is None else horizon, *self.task.horizon))
        motion = self._solve_on(mesh, self.nodes_at(mesh, guess), first, limits, report)
        if refinement is None:
            return motion
        rounds = [(len(mesh) - 1, float(np.max(_worst(motion))))]
        while motion.result.outcome in FOUND and rounds[-1][1] > refinement.tolerance:
            count, error = rounds[-1]
            mesh = _split(motion, refinement.tolerance)
            if len(mesh) - 1 > refinement.most:
                told = f"the error is still {error:.2g} with {count} intervals: raise max_num_steps"
                motion = replace(motion, result=replace(motion.result, note=told))
                break
            if report is not None:
                report.say(f"error {error:.2g} with {count} intervals: refined to {len(mesh) - 1}")
            left = replace(limits, time_limit=max(0.0, limits.time_limit - (time.monotonic() - start)))
            motion = self._solve_on(mesh, self.nodes_at(mesh, motion), motion.horizon, left, report)
            rounds.append((len(mesh) - 1, float(np.max(_worst(motion)))))
        return replace(motion, refinements=tuple(rounds))

    def _solve_on(
        self, mesh: Array, nodes: Array, horizon: float, limits: Limits, report: Report | None
    ) -> Transcribed:
        """IPOPT on one mesh, from `nodes` (K, nx + nu) and `horizon` [s]."""
        from drake_diff.optimize.transcription.program import NOT_FINITE, TranscribedProgram, solve_ipopt

        program, why = TranscribedProgram(self.task, mesh, self.functions), self.functions.why_not
        guess = program.pack(nodes, horizon)
        told = f"first derivatives, limited-memory Hessian: {why}" if why else "symbolic, exact Hessian"
        result = solve_ipopt(program, guess, limits, report, exact=not why)
        if not why and result.message == NOT_FINITE:
            again = solve_ipopt(program, guess, limits, report, exact=False)
            if again.message != NOT_FINITE:  # then it was the Hessian
                told, result = "symbolic, limited-memory Hessian: the exact one is not finite at an iterate", again
        found, horizon = program.unpack(result.z)
        return Transcribed(self.task, frozen(mesh), frozen(found), horizon, result, told)


def _worst(motion: Transcribed) -> Array:
    return np.maximum(motion.errors, motion.cost_errors)


def _split(motion: Transcribed, tolerance: float) -> Array:
    """The mesh with intervals above the tolerance in as many pieces as the scheme's order asks for, at most 4."""
    errors = _worst(motion)
    wanted = (errors / tolerance) ** (1 / (motion.task.scheme.order + 1))
    pieces = np.where(errors > tolerance, np.clip(np.ceil(wanted), 2, MOST_PIECES), 1).astype(int)
    ends = zip(motion.mesh[:-1], motion.mesh[1:], pieces, strict=True)
    return np.append(np.concatenate([a + (b - a) * np.arange(n) / n for a, b, n in ends]), 1.0)
