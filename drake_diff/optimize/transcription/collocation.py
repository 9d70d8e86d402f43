"""A problem in a collocation scheme: solved by IPOPT, again on a mesh that is refined, and the motion measured.

    minimize    int_0^T L(x, u) dt + F(x(T)),    x' = f(x, u),    x(0) = x0, x(T) = x_goal where they are given.

`errors` of a result say that its motion is what the dynamics do, not that no better one exists: where the mesh is
too coarse for the best input, only a finer one tells.
"""

import time
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, frozen
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits, NlpResult, Outcome, Report
from drake_diff.optimize.transcription.task import OptimalControl

SUBSTEPS = 10  # of the Runge-Kutta method that measures an interval
DENSE = np.linspace(0, 1, 21)[1:-1]  # where bounds are looked at between two knots
MOST_PIECES = 4  # of one interval in one round of refinement
FOUND = (Outcome.SOLVED, Outcome.INACCURATE)


@dataclass(frozen=True)
class Excess:
    """The largest excess over a bound of a state and of an input between the nodes, and where the larger one is."""

    state: float
    input: float
    where: str


@dataclass(frozen=True, eq=False)
class Collocated:
    """A motion at N+1 knots: xs (N+1, nx), us (N+1, nu), at the midpoints xs_mid, us_mid (N, ...) or None; T [s].

    Between knots x' and u are the scheme's polynomials.
    """

    task: OptimalControl
    mesh: Array  # (N+1,) fractions of the horizon
    nodes: Array  # (K, nx + nu): knots, and midpoints between them
    horizon: float

    @property
    def xs(self) -> Array:
        return self.nodes[:: self.task.scheme.nodes, : self.task.dynamics.nx]

    @property
    def us(self) -> Array:
        return self.nodes[:: self.task.scheme.nodes, self.task.dynamics.nx :]

    @property
    def xs_mid(self) -> Array | None:
        return None if self.task.scheme.nodes == 1 else self.nodes[1::2, : self.task.dynamics.nx]

    @property
    def us_mid(self) -> Array | None:
        return None if self.task.scheme.nodes == 1 else self.nodes[1::2, self.task.dynamics.nx :]

    def sample(self, parts: int) -> tuple[Array, Array]:
        """The motion at the m-th `parts` of each of the problem's N equal intervals, whatever the mesh.

        xs (m N + 1, nx), and the mean inputs us (m N, nu) over each part.
        """
        count, scheme = self.task.problem.num_steps, self.task.scheme
        inputs = scheme.per_interval(self.nodes[:, self.task.dynamics.nx :])
        if len(self.mesh) == count + 1:
            k, tau = np.repeat(np.arange(count), parts), np.tile(np.arange(parts) / parts, count)
            weights = scheme.integrated(tau + 1 / parts) - scheme.integrated(tau)
            us = parts * np.einsum("sj,sju->su", weights, inputs[k])
        else:  # parts may end within the intervals of a refined mesh
            ends, lengths = np.arange(parts * count + 1) / (parts * count), np.diff(self.mesh)[:, None]
            k, tau = self._place(ends)
            whole = lengths * np.einsum("j,nju->nu", scheme.integrated(np.ones(1))[0], inputs)
            before = np.vstack([np.zeros(whole.shape[1]), np.cumsum(whole, axis=0)])[k]
            within = lengths[k] * np.einsum("sj,sju->su", scheme.integrated(tau), inputs[k])
            us = np.diff(before + within, axis=0) * (parts * count)
            k, tau = k[:-1], tau[:-1]
        return np.vstack([self._between(k, tau)[0], self.xs[-1]]), us

    @cached_property
    def cost(self) -> float:
        """The scheme's own quadrature of the running cost, and the final cost."""
        weights = self.horizon * self.task.scheme.node_weights(self.mesh)
        final = 0.0 if self.task.final is None else float(self.task.final.values(self.nodes[-1:])[0, 0])
        return float(weights @ self.task.rate.values(self.nodes)[:, 0]) + final

    @cached_property
    def defects(self) -> Array:
        """(N,) how far each interval is from the scheme's equations, in the worst coordinate's unit."""
        xs = self.task.scheme.per_interval(self.nodes[:, : self.task.dynamics.nx])
        rates = self.task.scheme.per_interval(self._rates)
        defects = self.task.scheme.interval_defects(self._lengths, xs, rates)
        return np.asarray(np.max(np.abs(defects), axis=(1, 2)))

    @property
    def errors(self) -> Array:
        """(N,) distance of knot k+1 from an integration from knot k under the scheme's input; inf where it diverges.

        Ten steps of the classical Runge-Kutta method, in the worst coordinate's unit.
        """
        return _finite(np.max(np.abs(self._integrated[:, :-1] - self.xs[1:]), axis=1))

    @property
    def cost_errors(self) -> Array:
        """(N,) the same of the running cost's quadrature, as a part of the whole cost (of 1 where that is less)."""
        scheme, rates = self.task.scheme, self.task.rate.values(self.nodes)[:, 0]
        quadrature = self._lengths * (scheme.per_interval(rates) @ scheme.weights)
        return _finite(np.abs(self._integrated[:, -1] - quadrature) / max(1.0, abs(self.cost)))

    def at(self, times: Any) -> tuple[Array, Array]:
        """xs (S, nx) and us (S, nu) at `times` (S,) [s] by the scheme's own polynomials."""
        return self._between(*self._place(np.asarray(times, dtype=float) / self.horizon))

    @cached_property
    def _rates(self) -> Array:
        return self.task.dynamics.values(self.nodes)

    @property
    def _lengths(self) -> Array:
        return self.horizon * np.diff(self.mesh)

    def _place(self, fractions: Array) -> tuple[Indices, Array]:
        """The interval that each of `fractions` (S,) of the horizon lies in, and where in it, from 0 to 1."""
        k = np.clip(np.searchsorted(self.mesh, fractions, side="right") - 1, 0, len(self.mesh) - 2)
        return k, (fractions - self.mesh[k]) / np.diff(self.mesh)[k]

    def _between(self, k: Any, tau: Array) -> tuple[Array, Array]:
        """xs and us in the intervals `k` (S,) at `tau` (S,) of each."""
        scheme, nx = self.task.scheme, self.task.dynamics.nx
        us = scheme.per_interval(self.nodes[:, nx:])[k]
        moved = np.einsum("sj,sjx->sx", scheme.integrated(tau), scheme.per_interval(self._rates)[k])
        return self.xs[k] + self._lengths[k, None] * moved, np.einsum("sj,sju->su", scheme.at(tau), us)

    @property
    def open_loop(self) -> Array:
        """(N+1, nx) where the dynamics lead from the first state under the scheme's input; NaN once they diverge."""
        z = np.append(self.xs[0], 0.0)[None]
        found = [z[0]]
        for k in range(len(self.mesh) - 1):
            z = self._integrate(np.array([k]), z)
            found.append(z[0])
        return np.array(found)[:, : self.task.dynamics.nx]

    @cached_property
    def _integrated(self) -> Array:
        """(N, nx + 1) where each knot leads within its interval, and what that costs."""
        every = np.arange(len(self.mesh) - 1)
        return self._integrate(every, np.column_stack([self.xs[:-1], np.zeros(len(every))]))

    def _integrate(self, k: Indices, z: Array) -> Array:
        """(S, nx + 1) where `z` at the starts of the intervals `k` (S,) leads at their ends: states, and the cost."""
        dynamics, rates, nx = self.task.dynamics, self.task.rate, self.task.dynamics.nx
        dt = self._lengths[k, None] / SUBSTEPS

        def rate(z: Array, step: float) -> Array:
            knots = np.hstack([z[:, :nx], self._between(k, np.full(len(k), step / SUBSTEPS))[1]])
            return np.column_stack([dynamics.values(knots), rates.values(knots)])

        with np.errstate(all="ignore"):
            for i in range(SUBSTEPS):
                k1 = rate(z, i)
                k2 = rate(z + dt / 2 * k1, i + 0.5)
                k3 = rate(z + dt / 2 * k2, i + 0.5)
                z = z + dt / 6 * (k1 + 2 * k2 + 2 * k3 + rate(z + dt * k3, i + 1))
        return z


@dataclass(frozen=True, eq=False)
class Transcribed(Collocated):
    """What a solver found, and how it ended; `refinements` are (intervals, largest error) of each round."""

    result: NlpResult
    derivatives: str  # where the solver's came from, and why there is no Hessian where there is none
    refinements: tuple[tuple[int, float], ...] = ()


def _finite(values: Array) -> Array:
    """With inf for what is no number."""
    return np.asarray(np.nan_to_num(values, nan=np.inf, posinf=np.inf))


def violation_between_nodes(motion: Collocated) -> Excess:
    """How far a collocated motion leaves its bounds between the nodes, where the solver enforces nothing.

    A cost below the optimum of the problem with its bounds goes together with an excess here.

    Args:
        motion: `Solution.transcribed` of a solution by collocation.

    Returns:
        An `Excess`: the largest of a `state` and of an `input` over a bound, each in its own unit, at 19 points within
        each interval, and `where` the larger one is.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1, x_upper=[1 / 9, np.inf])
        >>> effort = dd.QuadraticCost(R=[[0.5]])
        >>> problem = dd.Problem(block, x0=[0, 1], x_goal=[0, -1], num_steps=10, horizon=1.0, running_cost=effort)
        >>> excess = dd.optimize.violation_between_nodes(dd.solve(problem).transcribed)
        >>> round(excess.state, 5), excess.input
        (0.0001, 0.0)
    """
    task, b, count = motion.task, motion.task.bounds, len(motion.mesh) - 1
    k, tau = np.repeat(np.arange(count), len(DENSE)), np.tile(DENSE, count)
    xs, us = motion._between(k, tau)
    beyond = [np.maximum(b.x_lower - xs, xs - b.x_upper), np.maximum(b.u_lower - us, us - b.u_upper)]
    both = np.maximum(np.hstack(beyond), 0.0)
    at, column = np.unravel_index(int(np.argmax(both)), both.shape)
    name = (task.dynamics.state_names + task.dynamics.input_names)[column]
    time = motion.horizon * motion.mesh[k[at]] + tau[at] * motion._lengths[k[at]]
    where = f"{name} by {both[at, column]:.3g} at {time:.4g} s" if both[at, column] > 0 else "nowhere"
    by_state, by_input = np.split(both, [task.dynamics.nx], axis=1)
    return Excess(float(np.max(by_state)), float(np.max(by_input)), where)


def collocated(
    problem: Problem, scheme: str, xs: Array, us: Array, us_mid: Array | None, horizon: float, mesh: Array
) -> Collocated:
    """The motion with knots xs (N+1, nx), us (N+1, nu) and midpoint inputs (N, nu), linear in between where None."""
    task, knots = OptimalControl(problem, scheme), np.hstack([xs, us])
    if task.scheme.nodes == 1:
        return Collocated(task, mesh, knots, horizon)
    rates, h = task.dynamics.values(knots), horizon * np.diff(mesh)[:, None]
    x_mid = (xs[:-1] + xs[1:]) / 2 + h / 8 * (rates[:-1] - rates[1:])
    u_mid = (us[:-1] + us[1:]) / 2 if us_mid is None else us_mid
    nodes = np.empty((2 * len(xs) - 1, knots.shape[1]))
    nodes[::2], nodes[1::2] = knots, np.hstack([x_mid, u_mid])
    return Collocated(task, mesh, nodes, horizon)


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
        f, where = self.task.dynamics, self.task.scheme.node_fractions(mesh)
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
