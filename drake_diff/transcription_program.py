"""Optimal control by collocation as a sparse program for IPOPT and SNOPT.

The variables are the nodes (knots and midpoints), row by row, and a free final time. Constraints span a few
neighbouring intervals and have those intervals' variables alone, with the pattern of their Jacobian.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractValue
from pydrake.solvers import MathematicalProgram

from drake_diff.arrays import Array, finite_array
from drake_diff.autodiff import chain, chain_rows
from drake_diff.bounds import Bounds
from drake_diff.cost import FinalCost, QuadraticCost, differentiate_cost, differentiate_final_cost
from drake_diff.dynamics import Dynamics, Pointwise
from drake_diff.transcription_scheme import Scheme, interval_defects, node_weights, per_interval

# Variables of one constraint: several intervals share one, which saves calls, while AutoDiffXd stays small.
CHUNK = 64


class RunningRate:
    """A running cost at many knots: a number [per s], a QuadraticCost, or a function (x, u) -> scalar."""

    def __init__(self, cost: Any, dynamics: Dynamics):
        self.cost, self.nx, self.width = cost, dynamics.nx, dynamics.nx + dynamics.nu
        self.quadratic = isinstance(cost, QuadraticCost)
        self.constant = None
        if cost is None or np.isscalar(cost):
            self.constant = float(finite_array("running_cost", 0.0 if cost is None else cost, ()))
        elif self.quadratic:
            cost.check_sizes("running_cost", dynamics.nx, dynamics.nu)
        else:
            self._at = Pointwise("running_cost", cost, self.nx, (), dynamics.probe())

    def values(self, knots: Array) -> Array:
        """(K,) at `knots` (K, nx + nu)."""
        if self.constant is not None:
            return np.full(len(knots), self.constant)
        if self.quadratic:
            return np.array([float(self.cost(k[: self.nx], k[self.nx :])) for k in knots])
        return self._at.values(knots)[:, 0]

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """(K,) and the gradients (K, nx + nu)."""
        if self.constant is not None:
            return self.values(knots), np.zeros(knots.shape)
        if self.quadratic:
            found = [differentiate_cost(self.cost, k[: self.nx], k[self.nx :]) for k in knots]
            return np.array([v for v, _, _ in found]), np.array([np.concatenate(g) for _, *g in found])
        values, rows = self._at.linearize(knots)
        return values[:, 0], rows[:, 0]


@dataclass(frozen=True, eq=False)
class OptimalControl:
    """What is transcribed, checked: NaN in `x0` and `x_goal` (nx,) is free; `horizon` (lower, upper) [s]."""

    dynamics: Dynamics
    x0: Array
    x_goal: Array
    horizon: tuple[float, float]
    rate: RunningRate
    final_cost: FinalCost | None
    bounds: Bounds
    scheme: Scheme

    @property
    def time_is_free(self) -> bool:
        return self.horizon[0] < self.horizon[1]

    def final(self, x: Array) -> float:
        """The final cost at `x` (nx,)."""
        return 0.0 if self.final_cost is None else float(self.final_cost(x))


class KnotCache:
    """The dynamics at knots, each evaluated once however many constraints and calls ask for it."""

    def __init__(self, dynamics: Dynamics, capacity: int):
        self.dynamics, self.capacity = dynamics, capacity
        self._values: dict[bytes, Array] = {}
        self._rows: dict[bytes, Array] = {}

    def values(self, knots: Array) -> Array:
        """(K, nx) the rates at `knots` (K, nx + nu)."""
        return self._look_up(knots, self._values, self._evaluate)[0]

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """(K, nx) the rates and (K, nx, nx + nu) their Jacobians."""
        values, keys = self._look_up(knots, self._rows, self._linearize)
        return values, np.array([self._rows[key] for key in keys])

    def _look_up(self, knots: Array, known: dict[bytes, Array], find: Callable[..., None]) -> tuple[Array, list[bytes]]:
        keys = [knot.tobytes() for knot in knots]
        if len(self._values) + len(keys) > self.capacity:
            self._values.clear()
            self._rows.clear()
        missing = [i for i, key in enumerate(keys) if key not in known]
        if missing:
            find(knots[missing], [keys[i] for i in missing])
        return np.array([self._values[key] for key in keys]), keys

    def _evaluate(self, knots: Array, keys: list[bytes]) -> None:
        self._values.update(zip(keys, self.dynamics.values(knots), strict=True))

    def _linearize(self, knots: Array, keys: list[bytes]) -> None:
        values, rows = self.dynamics.linearize(knots)
        self._values.update(zip(keys, values, strict=True))
        self._rows.update(zip(keys, rows, strict=True))


class TranscribedProgram:
    """The program of an `OptimalControl` on a mesh (N+1,) of fractions of the horizon: z = [nodes row by row, T]."""

    def __init__(self, task: OptimalControl, mesh: Array):
        self.task, self.mesh = task, mesh
        self.width = task.dynamics.nx + task.dynamics.nu
        self.num_nodes = task.scheme.nodes * (len(mesh) - 1) + 1
        self.cache = KnotCache(task.dynamics, 10 * self.num_nodes)
        self.program = MathematicalProgram()
        self.nodes = self.program.NewContinuousVariables(self.num_nodes, self.width, "node")
        self.time = self.program.NewContinuousVariables(int(task.time_is_free), "horizon")
        self._add_bounds()
        self._add_dynamics()
        self._add_costs()

    def pack(self, nodes: Array, horizon: float) -> Array:
        """The decision variables of `nodes` (K, nx + nu) and `horizon` [s]."""
        z = np.zeros(self.program.num_vars())
        self.program.SetDecisionVariableValueInVector(self.nodes, nodes, z)
        self.program.SetDecisionVariableValueInVector(self.time, np.full(len(self.time), horizon), z)
        return z

    def unpack(self, z: Array) -> tuple[Array, float]:
        """The nodes (K, nx + nu) and the horizon [s] of the decision variables."""
        found = z[self.program.FindDecisionVariableIndices(self.nodes.ravel())]
        times = z[self.program.FindDecisionVariableIndices(self.time)]
        return found.reshape(self.nodes.shape), float(times[0]) if len(times) else self.task.horizon[0]

    def _add_bounds(self) -> None:
        task, b, nx = self.task, self.task.bounds, self.task.dynamics.nx
        lower = np.tile(np.concatenate([b.x_lower, b.u_lower]), (self.num_nodes, 1))
        upper = np.tile(np.concatenate([b.x_upper, b.u_upper]), (self.num_nodes, 1))
        for node, wanted in ((0, task.x0), (-1, task.x_goal)):
            for side in (lower, upper):
                side[node, :nx] = np.where(np.isnan(wanted), side[node, :nx], wanted)
        self.program.AddBoundingBoxConstraint(lower.ravel(), upper.ravel(), self.nodes.ravel())
        if task.time_is_free:
            self.program.AddBoundingBoxConstraint(*task.horizon, self.time)

    def _add_dynamics(self) -> None:
        scheme, count = self.task.scheme, len(self.mesh) - 1
        size = max(1, CHUNK // (scheme.nodes * self.width))
        for start in range(0, count, size):
            chunk = _Defects(self, slice(start, min(start + size, count)))
            zero = np.zeros(chunk.num_rows)
            nodes = self.nodes[scheme.nodes * start : scheme.nodes * chunk.intervals.stop + 1]
            variables = np.concatenate([nodes.ravel(), self.time])
            name = f"dynamics, intervals {start} to {chunk.intervals.stop - 1}"
            binding = self.program.AddConstraint(chunk, zero, zero, vars=variables, description=name)
            binding.evaluator().SetGradientSparsityPattern(chunk.pattern())

    def _add_costs(self) -> None:
        task, weights = self.task, node_weights(self.mesh, self.task.scheme)
        if task.rate.cost is not None:
            size = max(1, CHUNK // self.width)
            for start in range(0, self.num_nodes, size):
                part = slice(start, start + size)
                variables = np.concatenate([self.nodes[part].ravel(), self.time])
                self.program.AddCost(_RunningCost(task, weights[part]), vars=variables)
        if task.final_cost is not None:
            self.program.AddCost(_FinalCost(task), vars=self.nodes[-1, : task.dynamics.nx])


class _Defects:
    """The defects of some intervals as a function of their nodes and a free T, floats or AutoDiffXd."""

    def __init__(self, whole: TranscribedProgram, intervals: slice):
        self.task, self.cache, self.intervals = whole.task, whole.cache, intervals
        self.lengths = np.diff(whole.mesh)[intervals]
        self.nodes = self.task.scheme.nodes * len(self.lengths) + 1
        self.width = whole.width
        self.num_rows = self.task.scheme.states.shape[0] * len(self.lengths) * self.task.dynamics.nx
        self.num_variables = self.nodes * self.width + int(self.task.time_is_free)

    def __call__(self, z: Any) -> Any:
        plain = z if z.dtype == float else ExtractValue(z.reshape(-1, 1)).ravel()
        knots = np.ascontiguousarray(plain[: self.nodes * self.width].reshape(self.nodes, self.width))
        horizon = float(plain[-1]) if self.task.time_is_free else self.task.horizon[0]
        if z.dtype == float:
            return self._defects(knots, self.cache.values(knots), horizon).ravel()
        fs, rows = self.cache.linearize(knots)
        return chain_rows(self._defects(knots, fs, horizon).ravel(), self._jacobian(fs, rows, horizon), z)

    def _defects(self, knots: Array, fs: Array, horizon: float) -> Array:
        scheme, nx = self.task.scheme, self.task.dynamics.nx
        xs, fs = per_interval(knots[:, :nx], scheme), per_interval(fs, scheme)
        return interval_defects(scheme, horizon * self.lengths, xs, fs)

    def _jacobian(self, fs: Array, rows: Array, horizon: float) -> Array:
        """(num_rows, num_variables): states[i, j] [I, 0] - h slopes[i, j] [A_j, B_j], and by T."""
        scheme, nx, s = self.task.scheme, self.task.dynamics.nx, self.task.scheme.nodes
        identity, groups = np.eye(nx, self.width), len(scheme.states)
        jacobian = np.zeros((len(self.lengths), groups, nx, self.num_variables))
        for k, h in enumerate(horizon * self.lengths):
            for j in range(s + 1):
                columns = slice((s * k + j) * self.width, (s * k + j + 1) * self.width)
                for i in range(groups):
                    block = scheme.states[i, j] * identity - h * scheme.slopes[i, j] * rows[s * k + j]
                    jacobian[k, i, :, columns] = block
        if self.task.time_is_free:
            jacobian[..., -1] = -self.lengths[:, None, None] * (scheme.slopes @ per_interval(fs, scheme))
        return jacobian.reshape(self.num_rows, self.num_variables)

    def pattern(self) -> list[tuple[int, int]]:
        """The (row, column) that may not be zero: where rates and Jacobians with nothing in common leave something."""
        fs = np.sqrt(2.0 + np.arange(self.nodes * self.task.dynamics.nx)).reshape(self.nodes, -1)
        where = self._jacobian(fs, np.full((*fs.shape, self.width), np.pi), 1.0)
        return [(int(row), int(column)) for row, column in np.argwhere(where != 0)]


class _RunningCost:
    """T sum_k weights_k L(x_k, u_k) of some nodes, floats or AutoDiffXd."""

    def __init__(self, task: OptimalControl, weights: Array):
        self.task, self.weights = task, weights

    def __call__(self, z: Any) -> Any:
        plain = z if z.dtype == float else ExtractValue(z.reshape(-1, 1)).ravel()
        free = int(self.task.time_is_free)
        knots = plain[: len(plain) - free].reshape(len(self.weights), -1)
        horizon = float(plain[-1]) if free else self.task.horizon[0]
        if z.dtype == float:
            return horizon * float(self.weights @ self.task.rate.values(knots))
        values, gradients = self.task.rate.linearize(knots)
        total = float(self.weights @ values)
        by_nodes = horizon * (self.weights[:, None] * gradients).ravel()
        return chain(horizon * total, np.concatenate([by_nodes, np.full(free, total)]), z)


class _FinalCost:
    """The final cost of the last state, floats or AutoDiffXd."""

    def __init__(self, task: OptimalControl):
        self.task = task

    def __call__(self, x: Any) -> Any:
        if x.dtype == float:
            return self.task.final(x)
        value, gradient = differentiate_final_cost(self.task.final_cost, ExtractValue(x).ravel())  # type: ignore[arg-type]
        return chain(value, gradient, x)
