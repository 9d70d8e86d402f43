"""The program of a problem by collocation: its phases on their meshes, in sequence, and the links between them.

With the rates F at all nodes, the defects of an interval are states @ x - T h slopes @ F. The Bernstein coefficients of
bounded states are rows of the same form, and those of bounded inputs are linear rows. Path constraints, couplings and
rate limits add rows, and resets link the ends of phases.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, frozen
from drake_diff.optimize.knots import PointFunction, constraint_function
from drake_diff.optimize.problem.coupling import RateLimit
from drake_diff.optimize.problem.phases import PhasedProblem
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.program import Iterate
from drake_diff.optimize.transcription.expressions import KnotFunctions, Timed
from drake_diff.optimize.transcription.program import COST, BlockProgram, Term
from drake_diff.optimize.transcription.task import OptimalControl


def link_functions(problem: Problem | PhasedProblem) -> tuple[PointFunction, ...]:
    """Return the function of each switch on its two concatenated states, as a symbolic expression if possible."""
    if not isinstance(problem, PhasedProblem):
        return ()
    return tuple(constraint_function(s.link, len(s.columns), s.probe) for s in problem.switches)


class Phase:
    """The variables of a phase in z: nodes row by row, coordinates of parameters, and a free duration."""

    def __init__(self, task: OptimalControl, mesh: Array, functions: KnotFunctions):
        self.task, self.mesh, self.functions = task, mesh, functions
        self.nx, self.width = task.dynamics.nx, task.dynamics.nx + task.dynamics.nu
        self.fractions = task.scheme.node_fractions(mesh)
        self.every = np.arange(len(self.fractions))
        self.free = task.horizon[0] < task.horizon[1]
        limits = zip(task.node_limits(mesh), task.coordinate_limits(), task.horizon, strict=True)
        self.lower, self.upper = (np.concatenate([a.ravel(), c, [time] * self.free]) for a, c, time in limits)
        self.size, self.first = len(self.lower), 0  # `first` is set by the program

    def columns(self, nodes: Indices) -> Indices:
        """Return the indices (K, nx + nu) in z of `nodes` (K,)."""
        return np.asarray(self.first + nodes[:, None] * self.width + np.arange(self.width))

    @property
    def coordinates_at(self) -> Indices:
        """The indices (np,) in z of the parameters' coordinates."""
        return self.first + self.every.size * self.width + np.arange(len(self.task.coordinates))

    @property
    def time_at(self) -> int | None:
        """The index in z of a free duration, or None."""
        return self.first + self.size - 1 if self.free else None

    @property
    def names(self) -> list[str]:
        """The names (size,) of the variables."""
        names = (*self.task.dynamics.state_names, *self.task.dynamics.input_names)
        others = self.task.problem.parameters.names if self.task.varied else ()
        return [f"{name} at node {k}" for k in self.every for name in names] + [*others, *["horizon"] * self.free]

    def pack(self, nodes: Array, horizon: float, parameters: Array | None = None) -> Array:
        """Return the variables (size,) for `nodes` (K, nx + nu), a duration [s] and parameters (np,), or the task's."""
        task = self.task
        if parameters is not None and task.varied is not None:
            task = task.at(np.clip(parameters, *task.problem.bounds_of_parameters()))
        return np.concatenate([nodes.ravel(), task.coordinates, [np.clip(horizon, *self.task.horizon)] * self.free])

    def unpack(self, z: Array) -> tuple[Array, float]:
        """Return the nodes (K, nx + nu) and the duration [s] from all variables."""
        nodes = z[self.first : self.first + self.every.size * self.width].reshape(-1, self.width)
        return nodes, self.task.horizon[0] if self.time_at is None else float(z[self.time_at])

    def parameters(self, z: Array) -> Array:
        """Return the values (np,) of the problem's parameters from all variables."""
        moved, problem = self.task.varied, self.task.problem
        if moved is None:
            return self.task.parameters
        return np.clip(moved.coordinates.to_values(z[self.coordinates_at]), *problem.bounds_of_parameters())

    def spans(self, z: Array) -> Array:
        """Return how far (size,) its variables may move from z."""
        (nodes, horizon), f = self.unpack(z), self.functions.dynamics
        points = np.hstack([nodes, np.tile(z[self.coordinates_at], (len(nodes), 1))])
        rows, columns = f.jacobian_at
        with np.errstate(all="ignore"):
            largest = np.nan_to_num(np.max(np.abs(f.jacobian(points)), axis=0), posinf=0.0)
        slopes = np.zeros((self.nx, points.shape[1]))
        np.maximum.at(slopes, (rows, columns), largest)
        xs, us = np.split(nodes, [self.nx], axis=1)
        of_node = self.task.problem.search_spans(xs, us, slopes[:, : self.width], horizon)
        spans = np.ones(len(self.task.coordinates))
        return np.concatenate([np.tile(of_node, len(nodes)), spans, [horizon] * self.free])

    def iterate(self, z: Array) -> Iterate:
        """Return the motion for callbacks."""
        problem, (nodes, horizon) = self.task.problem, self.unpack(z)
        vector = problem.parameters.at(self.parameters(z)) if self.task.varied else problem.parameters
        knots = np.array(nodes[:: self.task.scheme.nodes])
        xs, us = frozen(knots[:, : self.nx]), frozen(knots[:-1, self.nx :])
        return Iterate(problem, frozen(horizon * self.mesh), xs, us, vector, by_steps=False)


class TranscribedProgram(BlockProgram):
    """The program of phases, with the `links` and the horizon of `problem` if there are several.

    `states_at` (N+1, nx), `inputs_at` (N+1, nu) and `horizon_at` are the indices in z for the first phase.
    """

    horizon_unit = 1.0

    def __init__(
        self, phases: Sequence[Phase], problem: PhasedProblem | None = None, links: Sequence[PointFunction] = ()
    ):
        super().__init__(*(np.concatenate([getattr(p, side) for p in phases]) for side in ("lower", "upper")))
        self.phases, first = phases, 0
        for phase in phases:
            phase.first, first = first, first + phase.size
        for phase in phases:
            self._add_phase(phase)
        reasons = [phase.functions.why_not(linear=False) for phase in phases]
        self.linearized = next(filter(None, (phase.functions.why_not(linear=True) for phase in phases)), "")
        if problem is not None:
            reasons = [f"{name}, {why}" if why else "" for name, why in zip(problem.names, reasons, strict=True)]
            reasons += [f"a reset: {f.why_not}" if f.why_not else "" for f in links]
            self._add_links(problem, links)
        self.why_not = next(filter(None, reasons), "")

    @property
    def states_at(self) -> Indices:
        first = self.phases[0]
        return first.columns(first.every[:: first.task.scheme.nodes])[:, : first.nx]

    @property
    def inputs_at(self) -> Indices:
        first = self.phases[0]
        return first.columns(first.every[:: first.task.scheme.nodes])[:, first.nx :]

    @property
    def horizon_at(self) -> int | None:
        return self.phases[0].time_at

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names (n,) of the variables."""
        return tuple(name for phase in self.phases for name in phase.names)

    def spans(self, z: Array) -> Array:
        """Return the spans (n,) of `Problem.search_spans`, 1 for coordinates, and a free duration for itself."""
        return np.concatenate([phase.spans(z) for phase in self.phases])

    def iterates(self, z: Array) -> tuple[Iterate, ...]:
        """Return the motion of each phase at z, for callbacks."""
        return tuple(phase.iterate(z) for phase in self.phases)

    def _add_links(self, problem: PhasedProblem, links: Sequence[PointFunction]) -> None:
        for s, function in zip(problem.switches, links, strict=True):
            before, after = self.phases[s.before], self.phases[s.after]
            ends = before.columns(before.every[-1:])[0, : before.nx], after.columns(after.every[:1])[0, : after.nx]
            rows = self.add_rows(s.link.lower, s.link.upper)
            self.add(function, np.concatenate(ends)[None]).weigh(rows, np.arange(len(rows)), 1.0)
        if problem.horizon is not None:
            given = sum(phase.task.horizon[0] for phase in self.phases if not phase.free)
            rows = self.add_rows(*(np.array([side - given]) for side in problem.horizon))
            self.add_linear(rows, np.array([p.time_at for p in self.phases if p.free], dtype=int), 1.0)

    def _add_phase(self, phase: Phase) -> None:
        task, f, every = phase.task, phase.functions, phase.every
        points = phase.columns(every)
        tails = np.tile(phase.coordinates_at, (len(every), 1))
        timed: dict[str, Any] = {"time_at": phase.time_at, "time": task.horizon[0]}
        dynamics = self.add(f.dynamics, np.hstack([points, tails]), **timed)
        self._add_defects(phase, dynamics)
        rate = f.rate.at(task.horizon[0] * phase.fractions) if isinstance(f.rate, Timed) else f.rate
        self.add(rate, points, **timed).weigh(COST, every, task.scheme.node_weights(phase.mesh), by_time=True)
        if f.final is not None:
            self.add(f.final, points[-1:]).weigh(COST, 0, 1.0)
        if f.parameters is not None:
            self.add(f.parameters, phase.coordinates_at[None]).weigh(COST, 0, 1.0)
        for path, c in zip(f.paths, task.problem.kept, strict=True):
            self._add_values(path, points[task.nodes_of(c, phase.mesh)], c.lower, c.upper)
        knots = task.nodes_at(range(task.problem.num_steps + 1), phase.mesh)
        for joined, coupling in zip(f.joined, task.couplings, strict=True):
            places = points[knots[coupling.knots]]
            sides = (places[:, :, : phase.nx], places[:, :, phase.nx :])
            columns = np.hstack([side.reshape(len(places), -1) for side in sides])
            self._add_values(joined, columns, coupling.rows.lower, coupling.rows.upper)
        for limit in task.problem.rate_limits:
            self._add_slopes(phase, dynamics, limit)
        self._add_inputs(phase)

    def _add_values(self, function: PointFunction, columns: Indices, lower: Array, upper: Array) -> None:
        """Add rows that constrain the values of a function at points by limits (m,)."""
        rows = self.add_rows(np.tile(lower, len(columns)), np.tile(upper, len(columns)))
        self.add(function, columns).weigh(rows, np.arange(len(rows)), 1.0)

    def _add_defects(self, phase: Phase, dynamics: Term) -> None:
        """Add the defects, and the Bernstein coefficients of bounded states."""
        scheme, b, every = phase.task.scheme, phase.task.bounds, np.arange(phase.nx)
        none = np.zeros((len(phase.mesh) - 1, len(scheme.states), phase.nx))
        self._add_intervals(phase, dynamics, scheme.states, scheme.slopes, every, none, none)
        bounded = np.flatnonzero((np.isfinite(b.x_lower) | np.isfinite(b.x_upper)) & (b.x_lower < b.x_upper))
        shape = len(phase.mesh) - 1, len(scheme.hull_states), len(bounded)
        lower, upper = (np.array(np.broadcast_to(side[bounded], shape)) for side in (b.x_lower, b.x_upper))
        for k, node in ((0, 0), (-1, -1)):  # no limit on coefficients of given numbers only
            given = np.flatnonzero(self._given(phase, phase.every[node])[bounded])
            ends = np.flatnonzero(scheme.hull_states[:, node])
            lower[k, ends[:, None], given], upper[k, ends[:, None], given] = -np.inf, np.inf
        self._add_intervals(phase, dynamics, scheme.hull_states, scheme.hull_slopes, bounded, lower, upper)

    def _given(self, phase: Phase, node: int) -> Any:
        """Return a mask (nx,) of the states of a node that are given together with all variables of their rates."""
        places = np.concatenate([phase.columns(np.array([node]))[0], phase.coordinates_at])
        given = self.lower[places] == self.upper[places]
        rows, columns = phase.functions.dynamics.jacobian_at
        rates = np.array([np.all(given[columns[rows == i]]) for i in range(phase.nx)], dtype=bool)
        return given[: phase.nx] & rates

    def _add_intervals(
        self,
        phase: Phase,
        dynamics: Term,
        states: Array,
        slopes: Array,
        coordinates: Indices,
        lower: Array,
        upper: Array,
    ) -> None:
        """Add rows states @ x - T h slopes @ F for some coordinates in each interval, within limits (N, r, C)."""
        rows = self.add_rows(lower.ravel(), upper.ravel()).reshape(*lower.shape[:2], 1, len(coordinates))
        lengths = np.diff(phase.mesh)[:, None, None, None]
        nodes = _nodes(phase)[:, None, :, None]
        self.add_linear(rows, phase.first + nodes * phase.width + coordinates, states[None, :, :, None])
        dynamics.weigh(rows, nodes * phase.nx + coordinates, -lengths * slopes[None, :, :, None], by_time=True)

    def _add_slopes(self, phase: Phase, dynamics: Term, limit: RateLimit) -> None:
        """Constrain |slopes| <= limit at the ends of all intervals, where the slope of a line or parabola is largest.

        The rows are weights @ values within limit * T. With a free T each limit has two rows, one for each side. An
        `Acceleration` limits the Bernstein coefficients of the scheme's x', between which x' stays.
        """
        scheme, (entries, limits) = phase.task.scheme, limit.entries(phase.task.problem.system)
        if not limit.of_slopes:
            coefficients = scheme.bernstein
            most = np.broadcast_to(limits, (len(phase.mesh) - 1, len(coefficients), len(entries)))
            rows = self.add_rows(-most.ravel(), most.ravel()).reshape(*most.shape[:2], 1, len(entries))
            dynamics.weigh(rows, _nodes(phase)[:, None, :, None] * phase.nx + entries, coefficients[None, :, :, None])
            return
        ends = np.array([[-1.0, 0.0, 1.0]]) if limit.of_inputs and scheme.input_is_linear else scheme.end_slopes
        most = np.broadcast_to(limits, (len(phase.mesh) - 1, len(ends), len(entries)))
        weights = ends[None, :, :, None] / np.diff(phase.mesh)[:, None, None, None]
        nodes, zero, none = _nodes(phase)[:, None, :, None], np.zeros(most.size), np.full(most.size, np.inf)
        widest = phase.task.horizon[0] * most.ravel()
        sides = {-1: (-none, zero), 1: (zero, none)} if phase.free else {0: (-widest, widest)}
        for sign, (lower, upper) in sides.items():
            rows = self.add_rows(lower, upper)
            places = rows.reshape(*most.shape[:2], 1, len(entries))
            if limit.of_inputs:
                self.add_linear(places, phase.first + nodes * phase.width + phase.nx + entries, weights)
            else:
                dynamics.weigh(places, nodes * phase.nx + entries, weights)
            if phase.time_at is not None:
                self.add_linear(rows, phase.time_at, sign * most.ravel())

    def _add_inputs(self, phase: Phase) -> None:
        """Constrain inputs to lines, or the inner Bernstein coefficient of bounded inputs that are parabolas."""
        scheme, b, nu = phase.task.scheme, phase.task.bounds, phase.task.dynamics.nu
        if scheme.nodes == 1:
            return
        inputs, weights, lower, upper = np.arange(nu), (-1.0, 2.0, -1.0), np.zeros(nu), np.zeros(nu)
        if not scheme.input_is_linear:
            bounded = (np.isfinite(b.u_lower) | np.isfinite(b.u_upper)) & (b.u_lower < b.u_upper)
            inputs, weights, lower, upper = inputs[bounded], (-0.5, 2.0, -0.5), b.u_lower[bounded], b.u_upper[bounded]
        nodes = _nodes(phase)
        rows = self.add_rows(np.tile(lower, len(nodes)), np.tile(upper, len(nodes))).reshape(len(nodes), 1, -1)
        columns = phase.first + nodes[:, :, None] * phase.width + phase.nx + inputs
        self.add_linear(rows, columns, np.array(weights)[None, :, None])


def _nodes(phase: Phase) -> Indices:
    """Return the nodes (N, s+1) of each interval, of which adjacent intervals share one."""
    s = phase.task.scheme.nodes
    return np.asarray(s * np.arange(len(phase.mesh) - 1)[:, None] + np.arange(s + 1))
