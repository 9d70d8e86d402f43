"""A problem in a collocation scheme: its solution by IPOPT, the refinement of the mesh, and measures of the motion.

    minimize    int_0^T L(x, u) dt + F(x(T)),    x' = f(x, u),    x(0) = x0, x(T) = x_goal where they are given.

Small `errors` of a result mean that its motion satisfies the dynamics, not that no better motion exists. If the mesh is
too coarse for the best input, only a finer mesh shows this.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, frozen
from drake_diff._base.clock import now
from drake_diff.optimize.options import Options
from drake_diff.optimize.problem.coupling import RateLimit
from drake_diff.optimize.problem.goals import in_words
from drake_diff.optimize.problem.obstacles import ClearanceConstraint, clearances
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Limits, Multipliers, NlpResult, Outcome, Report
from drake_diff.optimize.transcription.lead import SUBSTEPS, Lead, Places, Within
from drake_diff.optimize.transcription.task import OptimalControl, Scheme

SIMPSON = np.array([1.0, *[4.0, 2.0] * (SUBSTEPS // 2 - 1), 4.0, 1.0]) / (3 * SUBSTEPS)  # SUBSTEPS is even
SLOPED = np.linspace(0, 1, 11)  # places in an interval at which slopes are computed, with its ends
EFFORT_WEIGHT, FINAL_WEIGHT = 0.1, 100.0  # of inputs and of the last state in TVLQR, relative to the states' weight
CLEARANCE_ROUNDS, MOST_INTERVALS = 5, 1000  # for plans that are too near to an obstacle between knots
ROUNDED = 1e-9  # of an interval: a place this near to its end is the end
SMALLEST_COST = 1e-6  # of the running cost's change over a range of states or inputs: a solver's residual
ACCURATE = 1e-4  # error of an interval, in the states' units
SMALLEST_ERROR = 1e-12  # of an interval: rounding, which a finer mesh does not reduce
MOST_PIECES, NARROW_PIECES = 4, 8  # of one interval in one round of refinement, without and with a narrow force or cost
FOUND = (Outcome.SOLVED, Outcome.INACCURATE)


@dataclass(frozen=True, eq=False)
class Collocated:
    """A motion of T [s] at N+1 knots: xs (N+1, nx), us (N+1, nu), and at midpoints xs_mid, us_mid (N, ...) or None.

    Between knots, x' and u are the scheme's polynomials.
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
        """Sample the motion at the m = `parts` parts of each of the problem's N equal intervals, for any mesh.

        Returns xs (m N + 1, nx), and the mean inputs us (m N, nu) over each part.
        """
        count, scheme = self.task.problem.num_steps, self.task.scheme
        inputs = scheme.per_interval(self.nodes[:, self.task.dynamics.nx :])
        if len(self.mesh) == count + 1:
            k, tau = np.repeat(np.arange(count), parts), np.tile(np.arange(parts) / parts, count)
            weights = scheme.integrated(tau + 1 / parts) - scheme.integrated(tau)
            us = parts * np.einsum("sj,sju->su", weights, inputs[k])
        else:
            ends = np.arange(parts * count + 1) / (parts * count)
            us, (k, tau) = self.means(ends), self._locate(ends[:-1])
        return np.vstack([self.between(k, tau)[0], self.xs[-1]]), us

    def means(self, ends: Array) -> Array:
        """Return the mean inputs (M, nu) between `ends` (M+1,), fractions of the horizon, also within intervals."""
        scheme, lengths = self.task.scheme, np.diff(self.mesh)[:, None]
        inputs = scheme.per_interval(self.nodes[:, self.task.dynamics.nx :])
        k, tau = self._locate(ends)
        whole = lengths * np.einsum("j,nju->nu", scheme.integrated(np.ones(1))[0], inputs)
        before = np.vstack([np.zeros(whole.shape[1]), np.cumsum(whole, axis=0)])[k]
        within = lengths[k] * np.einsum("sj,sju->su", scheme.integrated(tau), inputs[k])
        return np.asarray(np.diff(before + within, axis=0) / np.diff(ends)[:, None])

    @property
    def cost(self) -> float:
        """The running cost integrated along the dynamics' motion from each knot, plus the other costs."""
        return float(np.sum(self._integrated[-1, :, -1])) + sum(self._other_costs)

    @property
    def cost_error(self) -> float:
        """The difference of the scheme's own quadrature from that integral, plus the integral's remaining error."""
        return float(_finite(np.abs(self.quadrature - self.cost) + np.sum(self._within.errors[:, -1])))

    @cached_property
    def quadrature(self) -> float:
        """The cost by the scheme's own quadrature, which a solver minimizes."""
        return float(self._node_weights @ self._cost_rates) + sum(self._other_costs)

    @cached_property
    def cost_scale(self) -> float:
        """The sum of the absolute values of the parts of the cost at the nodes.

        It is at least a millionth of the change of the running cost if a state or input changes by its range.
        """
        middle = self.nodes[len(self.nodes) // 2]
        spans = self.task.problem.spans(self.xs, self.us)
        knots = np.vstack([middle, *(middle + side * np.diag(spans) for side in (-1, 1))])
        rates = self.task.rates(knots, np.full(len(knots), self.horizon / 2))
        floor = SMALLEST_COST * self.horizon * float(np.nanmax(np.abs(rates - rates[0]), initial=0.0))
        parts = [float(self._node_weights @ np.abs(self._cost_rates)), *np.abs(self._other_costs), floor]
        return float(_finite(np.array(sum(parts)))) or 1.0

    @property
    def _other_costs(self) -> tuple[float, float]:
        """The costs of the last state and of the parameters."""
        final = 0.0 if self.task.final is None else float(self.task.final.values(self.nodes[-1:])[0, 0])
        return final, self.task.problem.cost_of_parameters(self.task.parameters)

    @property
    def _node_weights(self) -> Array:
        """The weights (K,) [s] of the nodes in the scheme's quadrature."""
        return self.horizon * self.task.scheme.node_weights(self.mesh)

    @property
    def narrow(self) -> Any:
        """A mask (N,) of the intervals in which a force or cost acts over a small part only."""
        return self._within.narrow

    @property
    def smallest_width(self) -> float:
        """The smallest width of resolved forces and costs between knots, in each state's range; see `lead`."""
        return self._within.width

    @property
    def rate_excess(self) -> dict[str, tuple[float, int]]:
        """The largest excess over each rate limit of the problem, and its interval, from differences.

        The differences are of the scheme's own polynomials, those of the input and of x'.
        """
        excesses: dict[str, tuple[float, int]] = {}
        for limit in self.task.problem.rate_limits:
            quantity = self.nodes[:, self.task.dynamics.nx :] if limit.of_inputs else self._rates
            entries, limits = limit.entries(self.task.problem.system)
            values = self.task.scheme.at(SLOPED) @ self.task.scheme.per_interval(quantity[:, entries])
            values = self._slopes(values) if limit.of_slopes else values
            excess = np.maximum(np.abs(values) - limits, 0.0)
            worst = np.nan_to_num(np.max(excess, axis=(1, 2)), nan=np.inf)
            excesses[limit.label] = float(np.max(worst)), int(np.argmax(worst))
        return excesses

    def rates_of(self, limit: RateLimit) -> tuple[Array, Array]:
        """Return the values (S, n) that `limit` bounds in all intervals, with their ends, and times (S,).

        Accelerations are those of the dynamics at the plan's states and inputs.
        """
        count = len(self.mesh) - 1
        k, tau = np.repeat(np.arange(count), len(SLOPED)), np.tile(SLOPED, count)
        xs, us = self.between(k, tau)
        with np.errstate(all="ignore"):
            quantity = us if limit.of_inputs else self.task.dynamics.values(np.hstack([xs, us]))
        entries, _ = limit.entries(self.task.problem.system)
        values = quantity[:, entries].reshape(count, len(SLOPED), -1)
        values = self._slopes(values) if limit.of_slopes else values
        return values.reshape(len(k), -1), self.times(k, tau)

    def _slopes(self, values: Array) -> Array:
        """Return the time derivatives of `values` (N, S, n), exact for parabolas."""
        by_tau = np.gradient(values, SLOPED, axis=1, edge_order=2)
        return np.asarray(by_tau / self.lengths[:, None, None])

    @cached_property
    def defects_of_states(self) -> Array:
        """The residuals (N, nx) of the scheme's equations in each interval, in the states' units."""
        xs = self.task.scheme.per_interval(self.nodes[:, : self.task.dynamics.nx])
        rates = self.task.scheme.per_interval(self._rates)
        defects = self.task.scheme.interval_defects(self.lengths, xs, rates)
        return np.asarray(np.max(np.abs(defects), axis=1))

    @property
    def errors(self) -> Array:
        """The distances (N,) of knots k+1 from integrations from knots k under the scheme's input, or inf.

        The integration uses the steps of `Within`. Distances are in the unit of the worst coordinate.
        """
        return np.asarray(np.max(self.gaps, axis=1))

    @property
    def gaps(self) -> Array:
        """The same distances (N, nx) for each state."""
        return _finite(np.abs(self._integrated[-1, :, :-1] - self.xs[1:]))

    @property
    def between_knots(self) -> tuple[Array, Array]:
        """The times (9 N,) [s] within the intervals, and the states (9 N, nx) integrated from the knots before them."""
        count, inside = len(self.mesh) - 1, np.arange(1, SUBSTEPS) / SUBSTEPS
        times = self.times(np.tile(np.arange(count), len(inside)), np.repeat(inside, count))
        return times, self._integrated[1:-1, :, :-1].reshape(len(times), -1)

    @property
    def cost_errors(self) -> Array:
        """The errors (N,) of the running cost's quadrature, relative to `cost_scale`."""
        scheme = self.task.scheme
        quadrature = self.lengths * (scheme.per_interval(self._cost_rates) @ scheme.weights)
        return _finite(np.abs(self._integrated[-1, :, -1] - quadrature) / self.cost_scale)

    def at(self, times: Any) -> tuple[Array, Array]:
        """Return xs (S, nx) and us (S, nu) at `times` (S,) [s] from the scheme's own polynomials."""
        return self.between(*self._locate(np.asarray(times, dtype=float) / self.horizon))

    def on(self, mesh: Array, task: OptimalControl) -> Array:
        """Return the motion (K, nx + nu) at the nodes of a mesh in the scheme of `task`, inputs within its bounds."""
        return task.within(np.hstack(self.at(self.horizon * task.scheme.node_fractions(mesh))))

    @property
    def worst(self) -> Array:
        """The larger (N,) of `errors` and `cost_errors`."""
        return np.maximum(self.errors, self.cost_errors)

    @property
    def largest_error(self) -> float:
        """The largest error of an interval or of its part of the cost."""
        return float(np.max(self.worst))

    @property
    def rates(self) -> Array:
        """The rates x' (N+1, nx) at the knots."""
        return self._rates[:: self.task.scheme.nodes]

    @cached_property
    def _rates(self) -> Array:
        return self.task.moved(self.nodes, self.task.interval_of(len(self.nodes)))

    @property
    def _cost_rates(self) -> Array:
        """The running cost (K,) at the nodes."""
        return self.task.rates(self.nodes, self.horizon * self.task.scheme.node_fractions(self.mesh))

    @property
    def lengths(self) -> Array:
        """The lengths (N,) [s] of the intervals."""
        return self.horizon * np.diff(self.mesh)

    def interval_at(self, times: Array) -> Indices:
        """Return the index (S,) of the interval that contains each of `times` (S,) [s]."""
        return self._locate(times / self.horizon)[0]

    def _locate(self, fractions: Array) -> tuple[Indices, Array]:
        """Return the interval of each of `fractions` (S,) of the horizon, and the position in it, from 0 to 1."""
        k = np.clip(np.searchsorted(self.mesh, fractions, side="right") - 1, 0, len(self.mesh) - 2)
        return k, (fractions - self.mesh[k]) / np.diff(self.mesh)[k]

    def times(self, k: Indices, tau: Array) -> Array:
        """Return the times (S,) [s] of the positions `tau` in the intervals `k`."""
        return np.asarray(self.horizon * self.mesh[k] + tau * self.lengths[k])

    def between(self, k: Any, tau: Array) -> tuple[Array, Array]:
        """Return xs and us at the positions `tau` (S,) in the intervals `k` (S,)."""
        scheme, nx = self.task.scheme, self.task.dynamics.nx
        us = scheme.per_interval(self.nodes[:, nx:])[k]
        if self.task.is_map:  # the state is constant between two steps
            return self.xs[k + (tau > 1 - ROUNDED)], np.einsum("sj,sju->su", scheme.at(tau), us)
        moved = np.einsum("sj,sjx->sx", scheme.integrated(tau), scheme.per_interval(self._rates)[k])
        return self.xs[k] + self.lengths[k, None] * moved, np.einsum("sj,sju->su", scheme.at(tau), us)

    @cached_property
    def open_loop(self) -> Array:
        """The dynamics' states (N+1, nx) from the first state under the scheme's input, NaN after divergence."""
        return self._open_loop[::SUBSTEPS]

    def led(self, control: str) -> Array:
        """Return these states (10 N + 1, nx) at tenths of intervals, "open loop", or by "TVLQR" around the motion."""
        return self._open_loop if control == "open loop" else self.led_from(self.xs[0], self.gains()[0])

    @cached_property
    def _open_loop(self) -> Array:
        return self.led_from(self.xs[0], None)

    def cost_beside(self, xs: Array, gains: Array | None) -> float:
        """Return the cost of `xs` (10 N + 1, nx), see `led_from`, minus the plan's cost, by the same quadrature."""
        task, count = self.task, len(self.lengths)
        k, tau = np.repeat(np.arange(count), SUBSTEPS + 1), np.tile(np.arange(SUBSTEPS + 1) / SUBSTEPS, count)
        planned, us = self.between(k, tau)
        led = xs[(k * SUBSTEPS + np.round(tau * SUBSTEPS)).astype(int)]
        lower, upper = self.input_limits
        moved = us if gains is None else us + np.einsum("kij,kj->ki", gains[k], planned - led)
        times = self.times(k, tau)
        pair = (np.hstack([led, np.clip(moved, lower, upper)]), np.hstack([planned, us]))
        rates, plan = (np.ravel(task.rates(knots, times)).reshape(count, -1) for knots in pair)
        weights = np.array([1.0] + [0.0] * SUBSTEPS) if task.is_map else SIMPSON
        total = float(self.lengths @ ((rates - plan) @ weights))
        if task.final is not None:
            ends = np.array([np.append(x, self.nodes[-1, len(x) :]) for x in (xs[-1], self.xs[-1])])
            total += float(np.ravel(task.final.values(ends)) @ [1.0, -1.0])
        return total

    def led_from(self, x: Array, gains: Array | None) -> Array:
        """Return the dynamics' states (10 N + 1, nx) from `x` (nx,), with feedback `gains` (N, nu, nx) if given."""
        if not self.task.is_map:
            return self._lead.from_state(x, gains)
        states, (lower, upper) = [x[None]], self.input_limits
        with np.errstate(all="ignore"):
            for k, planned in enumerate(self._held[:, 0]):
                x, u = states[-1][-1], planned[self.task.dynamics.nx :]
                if gains is not None:
                    u = np.minimum(np.maximum(u + gains[k] @ (planned[: len(x)] - x), lower), upper)
                after = self.task.moved(np.concatenate((x, u))[None], np.array([k]))
                states.append(np.vstack([np.tile(x, (SUBSTEPS - 1, 1)), after]))  # the state is constant until then
        return np.concatenate(states)

    @cached_property
    def _lead(self) -> Lead:
        return Lead(self, SUBSTEPS, self._within.least)

    def gains(self, at_end: Array | None = None) -> tuple[Array, Array]:
        """Return the gains (N, nu, nx) of Riccati's recursion with Bryson's weights, as in the TVLQR of a replay.

        Also return the cost-to-go (nx, nx) of a deviation from the first state. `at_end` is that of the last state.
        """
        nx, nu, is_map = self.task.dynamics.nx, self.task.dynamics.nu, self.task.is_map
        effort = self.task.problem.input_scales(self.us)
        Q, R = np.diag(1 / self.task.problem.state_scales(self.xs) ** 2), EFFORT_WEIGHT * np.diag(1 / effort**2)
        count = len(self.xs) - 1
        by_knot = self.task.linearized(np.hstack([self.xs, self.us])[:-1], np.arange(count))
        P, gains = FINAL_WEIGHT * Q if at_end is None else at_end, np.empty((count, nu, nx))
        for k in range(count - 1, -1, -1):
            h, A, B = self.lengths[k], by_knot[k][:, :nx], by_knot[k][:, nx:]
            if not is_map:  # the step by the implicit midpoint rule
                implicit = np.eye(nx) - h / 2 * A
                A, B = np.linalg.solve(implicit, np.eye(nx) + h / 2 * A), np.linalg.solve(implicit, h * B)
            gains[k] = np.linalg.solve(h * R + B.T @ P @ B, B.T @ P @ A)
            P = h * Q + A.T @ P @ (A - B @ gains[k])
        return gains, P

    @property
    def _integrated(self) -> Array:
        """The states, integrated from each knot, at the tenths of its interval, and their cost (11, N, nx + 1)."""
        return self._within.states

    @cached_property
    def places(self) -> Places:
        """The places between the knots at which users' functions are evaluated."""
        return Places(self, self._held)

    @cached_property
    def _within(self) -> Within:
        return Within(self, self._held)

    def measured_as(self, other: "Collocated") -> None:
        """Reuse the integrated states of `other`, which has the same dynamics and cost, if both motions are equal.

        They depend only on knots, inputs, mesh, horizon and parameters, which must be equal to the last bit.
        """
        ours, theirs = ((m.mesh, m.xs, m.inputs, np.array([m.horizon]), m.task.parameters) for m in (self, other))
        same = all(np.array_equal(a, b) for a, b in zip(ours, theirs, strict=True))
        if same and self.task.scheme is other.task.scheme and "_within" in vars(other):
            vars(self)["_within"] = other._within
            vars(self).update({"places": other.places} if "places" in vars(other) else {})

    @property
    def inputs(self) -> Array:
        """The inputs (K, nu) at all nodes."""
        return self.nodes[:, self.task.dynamics.nx :]

    @cached_property
    def _held(self) -> Array:
        """The motion (N, 21, nx + nu), inputs as the plant applies them, at half steps of an interval's ten steps."""
        count, halves = len(self.mesh) - 1, np.arange(2 * SUBSTEPS + 1)
        xs, us = self.between(np.repeat(np.arange(count), len(halves)), np.tile(halves / (2 * SUBSTEPS), count))
        return np.hstack([xs, self.cut_off(us)]).reshape(count, len(halves), -1)

    def applied_at(self, times: Array) -> Array:
        """Return the inputs (S, nu) at `times` (S,) [s] as the plant applies them."""
        return self.cut_off(self.at(times)[1])

    def applied(self, k: Indices, tau: Array) -> Array:
        """Return the inputs (S, nu) in the intervals `k` at `tau` as the plant applies them."""
        return self.cut_off(self.between(k, tau)[1])

    def seen(self, c: ClearanceConstraint) -> tuple[Array, Array]:
        """Return times (S,) [s] between the knots and states (S, nx): integrated ones, and those that `c` also checks.

        The latter are from the scheme's polynomials.
        """
        times, xs = self.between_knots
        knots = self.horizon * self.mesh
        when, where = c.seen(
            np.unique(np.concatenate([knots, times])), lambda instants: self.at(instants)[0], c.between
        )
        between = ~np.isin(when, knots)
        return np.concatenate([times, when[between]]), np.vstack([xs, where[between]])

    @property
    def input_limits(self) -> tuple[Array, Array]:
        """The bounds of the task's inputs (lower (nu,), upper (nu,)) within the plant's own limits."""
        return self.cut_off(self.task.bounds.u_lower), self.cut_off(self.task.bounds.u_upper)

    def cut_off(self, us: Array) -> Array:
        """Return `us` (S, nu), clipped at the plant's own limits."""
        limits = self.task.dynamics.bounds
        return np.clip(us, limits.u_lower, limits.u_upper)


@dataclass(frozen=True, eq=False)
class Transcribed:
    """The motions of all phases that a solver returned, and its outcome."""

    phases: tuple[Collocated, ...]
    result: NlpResult
    derivatives: str  # the source of the solver's derivatives, and why a missing Hessian is missing
    refinements: tuple[tuple[float, ...], ...] = ()  # the `row` of each round
    cleared: tuple[tuple[int, float], ...] = ()  # intervals and violations of a margin [m], empty without violations

    @property
    def count(self) -> int:
        """The total number of intervals."""
        return sum(len(phase.mesh) - 1 for phase in self.phases)

    @property
    def row(self) -> tuple[float, ...]:
        """The number of intervals and the largest error, or, for several phases, their numbers of intervals."""
        if len(self.phases) == 1:
            return self.count, self.largest_error
        return tuple(len(phase.mesh) - 1 for phase in self.phases)

    @property
    def largest_error(self) -> float:
        """The largest error of an interval or of its part of the cost."""
        return max(phase.largest_error for phase in self.phases)


@dataclass(frozen=True, eq=False)
class Initial:
    """The start of a search in one phase: nodes (K, nx + nu) on a mesh, a duration [s] and parameters (np,).

    `multipliers` are those of a plan at these nodes. Nodes on a straight line are `far` from a motion.
    """

    mesh: Array
    nodes: Array
    horizon: float
    parameters: Array | None = None
    multipliers: Multipliers | None = None
    far: bool = False

    def on(self, mesh: Array, scheme: Scheme) -> "Initial":
        """Return the same start on another mesh."""
        these, then = scheme.node_fractions(mesh), scheme.node_fractions(self.mesh)
        nodes = np.array([np.interp(these, then, column) for column in self.nodes.T]).T
        return replace(self, mesh=mesh, nodes=nodes, multipliers=None)


def _finite(values: Array) -> Array:
    """Replace NaN by inf."""
    return np.asarray(np.nan_to_num(values, nan=np.inf, posinf=np.inf))


def collocated(
    problem: Problem,
    scheme: str,
    xs: Array,
    us: Array,
    us_mid: Array | None,
    horizon: float,
    mesh: Array,
    parameters: Array | None = None,
) -> Collocated:
    """Return the motion with knots xs (N+1, nx), us (N+1, nu) and midpoint inputs (N, nu), interpolated if None.

    `parameters` (np,) are values of the problem's parameters, by default its own values.
    """
    task, knots = OptimalControl(problem, scheme), np.hstack([xs, us])
    task = task if parameters is None else task.at(parameters)
    if task.scheme.nodes == 1:
        return Collocated(task, mesh, knots, horizon)
    rates, h = task.dynamics.values(knots), horizon * np.diff(mesh)[:, None]
    x_mid = (xs[:-1] + xs[1:]) / 2 + h / 8 * (rates[:-1] - rates[1:])
    u_mid = (us[:-1] + us[1:]) / 2 if us_mid is None else us_mid
    nodes = np.empty((2 * len(xs) - 1, knots.shape[1]))
    nodes[::2], nodes[1::2] = knots, np.hstack([x_mid, u_mid])
    return Collocated(task, mesh, nodes, horizon)


class Transcription:
    """A problem in a scheme, whose phases initially have their own `num_steps` equal intervals."""

    def __init__(self, problem: Problem | PhasedProblem, scheme: str):
        from drake_diff.optimize.transcription.expressions import knot_functions  # loads CasADi
        from drake_diff.optimize.transcription.nodes import link_functions

        self.problem: Any = problem
        self.tasks = [OptimalControl(phase, scheme) for phase in problem.phases]
        self.functions = [knot_functions(task) for task in self.tasks]
        self.links = link_functions(problem)

    def jacobian(self, knot: Array, k: int = 0, phase: int = 0) -> Array:
        """Return the solver's Jacobian (nx, nx + nu) of a phase's rates at `knot` (nx + nu,), or of a map's step `k`.

        A knot includes the coordinates of parameters if these are optimized."""
        f = self.functions[phase].dynamics
        return np.asarray(getattr(f, "functions", [f] * (k + 1))[k].linearize(knot[None])[1][0])

    def begin(self, phase: int, guess: Any, *, horizon: float | None = None, mesh: Any = None, **more: Any) -> Initial:
        """Return a phase's start within input bounds from xs (N+1, nx), us (N+1, nu) on a mesh, or from a motion."""
        task = self.tasks[phase]
        mesh = np.linspace(0, 1, task.problem.num_steps + 1) if mesh is None else mesh
        if isinstance(guess, Collocated):
            nodes = guess.on(mesh, task)
        else:
            where = task.scheme.node_fractions(mesh)
            nodes = task.within(np.array([np.interp(where, mesh, column) for column in np.hstack(guess).T]).T)
        first = task.problem.start_horizon if horizon is None else horizon
        return Initial(mesh, nodes, float(np.clip(first, *task.horizon)), **more)

    def program(self, meshes: Sequence[Array] | None = None) -> Any:
        """Return the `TranscribedProgram` of the phases on meshes, by default on their own equal intervals."""
        from drake_diff.optimize.transcription.nodes import Phase, TranscribedProgram

        if meshes is None:
            meshes = [np.linspace(0, 1, task.problem.num_steps + 1) for task in self.tasks]
        phases = [Phase(*parts) for parts in zip(self.tasks, meshes, self.functions, strict=True)]
        return TranscribedProgram(phases, self.problem if isinstance(self.problem, PhasedProblem) else None, self.links)

    def solve(
        self, starts: Sequence[Initial], *, limits: Limits, report: Report | None, refinement: Options | None = None
    ) -> Transcribed:
        """Solve from a start for each phase. `limits.max_iterations` applies to each round.

        A `refinement` splits the intervals whose error is above its tolerance and solves again from the last result.
        Intervals that violate the margin of an obstacle are split in any case, up to CLEARANCE_ROUNDS times.
        """
        start, motion = now(), self._solve_on(starts, limits, report)
        if motion.result.outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT):  # no time is left to measure it
            return motion
        tolerance, most, left = np.inf, MOST_INTERVALS, math.inf
        if refinement is not None:
            tolerance, most = refinement.error_tolerance, refinement.max_num_steps
            left = math.inf if len(self.tasks) == 1 else refinement.mesh_rounds
        rounds, near = [motion.row], [[_nearer(phase) for phase in motion.phases]]
        while motion.result.outcome in FOUND and len(rounds) <= left:
            error, count = motion.largest_error, motion.count
            lacking = near[-1] if len(near) <= CLEARANCE_ROUNDS else [np.zeros(1)] * len(near[-1])
            if error <= tolerance and not any(np.any(short > 0) for short in lacking):
                break
            entered = any(np.max(s) > _largest_margin(t.problem) for s, t in zip(lacking, self.tasks, strict=True))
            wanted = [np.ones_like(short) if entered else short for short in lacking]
            meshes = [_split(phase, tolerance, s) for phase, s in zip(motion.phases, wanted, strict=True)]
            missing = f"{in_words(float(max(np.max(short) for short in lacking)), 'm')} too near to an obstacle"
            reason = f"error {error:.2g}" if error > tolerance else missing
            if max(len(mesh) for mesh in meshes) - 1 > most:
                reason = f"{reason} still, with {count} intervals: raise max_num_steps"
                motion = replace(motion, result=replace(motion.result, note=reason))
                break
            if report is not None:
                report.say(f"{reason} with {count} intervals: refined to {sum(len(mesh) - 1 for mesh in meshes)}")
            # A motion through an obstacle is no guess for the next round, and a motion near an obstacle may be none.
            first = [b.on(m, t.scheme) for b, m, t in zip(starts, meshes, self.tasks, strict=True)]
            last, near_one = motion, any(np.any(short > 0) for short in lacking) and not entered
            motion = self._solve_on(first if entered else _from(last, meshes), limits.after(start), report)
            if near_one and motion.result.outcome is Outcome.INFEASIBLE:
                motion = self._solve_on(first, limits.after(start), report)
            if motion.result.outcome not in FOUND and not entered:
                motion = kept(last, motion)
                break
            rounds.append(motion.row)
            near.append([_nearer(phase) for phase in motion.phases])
        worst = [max(float(np.max(short)) for short in shortfalls) for shortfalls in near]
        cleared = [(int(row[0]), short) for row, short in zip(rounds, worst, strict=True)]
        return replace(motion, refinements=tuple(rounds), cleared=tuple(cleared) if worst[0] > 0 else ())

    def finer(
        self,
        motion: Transcribed,
        exceeded: Sequence[Sequence[int] | None],
        most: int,
        limits: Limits,
        report: Report | None,
    ) -> Transcribed | None:
        """Solve on meshes in which the coarsest intervals of `motion`, including those `exceeded`, are split.

        A phase with None instead keeps its mesh. Returns None if a phase would have more than `most` intervals.
        """
        pairs = list(zip(motion.phases, exceeded, strict=True))
        meshes = [phase.mesh if beyond is None else finer_mesh(phase, beyond, most) for phase, beyond in pairs]
        finer = [mesh for mesh in meshes if mesh is not None]
        if len(finer) < len(meshes):
            return None
        if report is not None:
            counts = [sum(len(mesh) - 1 for mesh in grids) for grids in ([p.mesh for p in motion.phases], finer)]
            report.say(f"the motion does not pass its checks with {counts[0]} intervals: refined to {counts[1]}")
        return self._solve_on(_from(motion, finer), limits, report)

    def _solve_on(self, starts: Sequence[Initial], limits: Limits, report: Report | None) -> Transcribed:
        """Solve with IPOPT on the meshes of the starts."""
        from drake_diff.optimize.transcription.program import FAR

        program = self.program([b.mesh for b in starts])
        guess = np.concatenate(
            [phase.pack(b.nodes, b.horizon, b.parameters) for phase, b in zip(program.phases, starts, strict=True)]
        )
        more = FAR if starts[0].far and len(starts) == 1 and program.phases[0].free else None
        result, derivatives = solve_program(program, guess, limits, report, starts[0].multipliers, more)
        motions = []
        for phase in program.phases:
            (nodes, horizon), task = phase.unpack(result.z), phase.task
            task = task.at(phase.parameters(result.z)) if task.varied else task
            motions.append(Collocated(task, frozen(phase.mesh), frozen(np.array(nodes)), horizon))
        return Transcribed(tuple(motions), result, derivatives)


def _from(motion: Transcribed, meshes: Sequence[Array]) -> list[Initial]:
    """Return the starts of a search on other meshes."""
    pairs = zip(motion.phases, meshes, strict=True)
    return [Initial(mesh, p.on(mesh, p.task), p.horizon, np.asarray(p.task.parameters)) for p, mesh in pairs]


def solve_program(
    program: Any,
    guess: Array,
    limits: Limits,
    report: Report | None,
    multipliers: Multipliers | None = None,
    more: dict[str, Any] | None = None,
) -> tuple[NlpResult, str]:
    """Solve with IPOPT, by an exact Hessian if it exists and is finite. Return the result and derivatives' source.

    If `multipliers` have the sizes of the program, they are used first. If that fails, the search is repeated without.
    """
    from drake_diff.optimize.transcription.program import NOT_FINITE, solve_ipopt

    why, start = program.why_not, now()
    derivatives = f"first derivatives, limited-memory Hessian: {why}" if why else "symbolic, exact Hessian"
    if program.linearized and not why:
        derivatives = f"symbolic, Hessian without some curvature: {program.linearized}"
    usable = multipliers if multipliers and multipliers.sizes == (program.size, len(program.sides[0])) else None
    options: dict[str, Any] = {"more": more, "motions": program.iterates}
    result = solve_ipopt(program, guess, limits, report, exact=not why, multipliers=usable, **options)
    if usable and result.outcome not in (*FOUND, Outcome.INTERRUPTED, Outcome.TIME_LIMIT):
        result = solve_ipopt(program, guess, limits.after(start), report, exact=not why, **options)
    elif usable:
        result = replace(result, message=f"{result.message}, from the guess's multipliers")
    if why and result.outcome is Outcome.INACCURATE:  # the limited-memory Hessian converges slowly near the end
        options |= {"multipliers": result.multipliers, "more": None}
        finer = solve_ipopt(program, result.z, limits.after(start), report, exact=True, **options)
        if finer.outcome is Outcome.SOLVED:
            finer = replace(finer, iterations=(*result.iterations, *finer.iterations))
            return finer, f"{derivatives}; at the end a Hessian by differences"
    if not why and result.message == NOT_FINITE:
        again = solve_ipopt(program, guess, limits, report, exact=False, **options)
        if again.message != NOT_FINITE:  # the Hessian was not finite
            return again, "symbolic, limited-memory Hessian: the exact one is not finite at an iterate"
    return result, derivatives


def finer_mesh(motion: Collocated, exceeded: Sequence[int], most: int) -> Array | None:
    """Return the mesh of `motion` with its coarsest intervals, including those `exceeded`, split.

    If a jerk is limited and the motion is accurate, only those `exceeded` are split, because the jerk exceeds its limit
    at switches. Returns None for more than `most` intervals, or if none is split.
    """
    lacking = np.zeros(len(motion.mesh) - 1)
    lacking[list(exceeded)] = 1.0
    tolerance = motion.largest_error / 2 ** (motion.task.scheme.order + 1)  # the effect of halving all intervals
    if motion.task.problem.limits_jerk and len(exceeded) and motion.largest_error <= ACCURATE:
        tolerance = np.inf
    mesh = _split(motion, max(tolerance, SMALLEST_ERROR), lacking)
    return None if len(mesh) - 1 > most or len(mesh) == len(motion.mesh) else mesh


def kept(last: Transcribed, failed: Transcribed) -> Transcribed:
    """Return the last motion that was found, with a note on the finer mesh that has no solution.

    If the finer solve was stopped by Ctrl-C or the time limit, this is the outcome of the whole search.
    """
    if failed.result.outcome in (Outcome.INTERRUPTED, Outcome.TIME_LIMIT):
        return replace(last, result=replace(failed.result, z=last.result.z))
    failure = f"on {failed.count} intervals no motion was found ({failed.result.message})"
    note = f"{failure}: the motion on {last.count} is kept"
    return replace(last, result=replace(last.result, note="; ".join(filter(None, (last.result.note, note)))))


def _nearer(motion: Collocated) -> Array:
    """Return the violation (N,) [m] of a margin in each interval, 0 if it is within its tolerance."""
    lacking = np.zeros(len(motion.mesh) - 1)
    for c in clearances(motion.task.problem.kept):
        times, xs = motion.seen(c)
        shortfalls = np.nan_to_num(c.lacking(xs), posinf=0.0)
        np.maximum.at(lacking, motion.interval_at(times), np.where(shortfalls > c.between, shortfalls, 0.0))
    return lacking


def _largest_margin(problem: Problem) -> float:
    return max((c.margin for c in clearances(problem.kept)), default=0.0)


def _split(motion: Collocated, tolerance: float, lacking: Array) -> Array:
    """Split intervals above the tolerance into as many pieces as the scheme's order requires, at most 4.

    Intervals that are too near to an obstacle, by `lacking`, are split at least in two.
    """
    errors = motion.worst
    wanted = (errors / tolerance) ** (1 / (motion.task.scheme.order + 1))
    pieces = np.where(errors > tolerance, np.clip(np.ceil(wanted), 2, MOST_PIECES), 1).astype(int)
    pieces[(errors > tolerance) & motion.narrow] = NARROW_PIECES
    near = lacking > 0
    near[1:], near[:-1] = near[1:] | (lacking[:-1] > 0), near[:-1] | (lacking[1:] > 0)  # and neighbours
    pieces = np.maximum(pieces, 1 + near)
    ends = zip(motion.mesh[:-1], motion.mesh[1:], pieces, strict=True)
    return np.append(np.concatenate([a + (b - a) * np.arange(n) / n for a, b, n in ends]), 1.0)
