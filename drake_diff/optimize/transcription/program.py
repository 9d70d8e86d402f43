"""Optimal control by collocation as a sparse program for IPOPT: its functions and their exact derivatives.

With the rates F and their Jacobians J at all nodes, each computed once, the rest is linear in them:

    g = S z - T D F,    dg = S - T D J,    d^2 (lambda' g) = -T sum_k d^2 (nu_k' f),    nu = D' lambda

with constant sparse S and D from the scheme's states and slopes, so that the Hessian has one block a node, and a column
for a free final time T. Path constraints add rows to g and terms to the blocks of their nodes.
"""

from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.optimize.transcription.expressions import KnotFunction, KnotFunctions
from drake_diff.optimize.transcription.scheme import node_weights
from drake_diff.optimize.transcription.task import OptimalControl


class TranscribedProgram:
    """The program of an `OptimalControl` on a mesh (N+1,) of fractions of the horizon: z = [nodes row by row, T]."""

    def __init__(self, task: OptimalControl, mesh: Array, functions: KnotFunctions):
        self.task, self.mesh, self.functions = task, mesh, functions
        self.nx, self.width = task.dynamics.nx, task.dynamics.nx + task.dynamics.nu
        self.weights = node_weights(mesh, task.scheme)
        self.every = np.arange(len(self.weights))
        self.free = int(task.time_is_free)
        nodes = zip(task.node_limits(mesh), task.horizon, strict=True)
        self.lower, self.upper = (np.append(side.ravel(), [time] * self.free) for side, time in nodes)
        self.z = ca.MX.sym("z", len(self.lower))
        self.knots = ca.reshape(self.z[: self.every.size * self.width], self.width, self.every.size)
        self.time = self.z[-1] if self.free else ca.MX(task.horizon[0])
        self.paths = [(p.nodes(mesh, task.scheme), p.constraint) for p in task.paths]
        self._set_links()
        self._linear = self._linear_inputs() if task.scheme.input_is_linear else None

    def pack(self, nodes: Array, horizon: float) -> Array:
        """The decision variables of `nodes` (K, nx + nu) and `horizon` [s]."""
        return np.append(nodes.ravel(), [horizon] * self.free)

    def unpack(self, z: Array) -> tuple[Array, float]:
        """The nodes (K, nx + nu) and the horizon [s] of the decision variables."""
        nodes = z[: self.every.size * self.width].reshape(-1, self.width)
        return nodes, float(z[-1]) if self.free else self.task.horizon[0]

    @cached_property
    def sides(self) -> tuple[Array, Array]:
        """(lower, upper) of g: 0 for the defects, then each path constraint's own, node by node."""
        lower, upper = [np.zeros(self.num_defects)], [np.zeros(self.num_defects)]
        for at, constraint in self.paths:
            lower.append(np.tile(constraint.lower, len(at)))
            upper.append(np.tile(constraint.upper, len(at)))
        if self._linear is not None:
            lower.append(np.zeros(self._linear.shape[0]))
            upper.append(np.zeros(self._linear.shape[0]))
        return np.concatenate(lower), np.concatenate(upper)

    @cached_property
    def nlp(self) -> dict[str, Any]:
        """x, f and g as CasADi's nlpsol takes them."""
        f = self.time * ca.dot(self._costs, ca.DM(self.weights).T)
        if self.functions.final is not None:
            f += self.functions.final.values(self.knots[:, -1])
        g = [ca.mtimes(self._S, self.z) - self.time * ca.mtimes(self._D, ca.vec(self._rates))]
        g += [ca.vec(f.values(self.knots[:, at.tolist()])) for f, at in self._path_functions]
        if self._linear is not None:
            g.append(ca.mtimes(self._linear, self.z))
        return {"x": self.z, "f": f, "g": ca.vertcat(*g)}

    def derivatives(self, exact: bool) -> dict[str, Any]:
        """CasADi Functions by the names of nlpsol's options, "hess_lag" only where `exact`."""
        p, sigma = ca.MX.sym("p", 0), ca.MX.sym("sigma")
        multipliers = ca.MX.sym("multipliers", self.nlp["g"].numel())
        found = {
            "grad_f": ca.Function("grad_f", [self.z, p], [self.nlp["f"], self._gradient()]),
            "jac_g": ca.Function("jac_g", [self.z, p], [self.nlp["g"], self._jacobian()]),
        }
        if exact:
            hessian = self._hessian(sigma, multipliers)
            found["hess_lag"] = ca.Function("hess_lag", [self.z, p, sigma, multipliers], [hessian])
        return found

    def _set_links(self) -> None:
        """Which node enters which defect (nx rows), by its state and by its rate, and the matrices S and D of that."""
        scheme, lengths = self.task.scheme, np.diff(self.mesh)
        groups, nodes = scheme.states.shape
        k, i, j = (a.ravel() for a in np.indices((len(lengths), groups, nodes)))
        self.defect, self.node = k * groups + i, k * scheme.nodes + j
        self.state, self.slope = scheme.states[i, j], lengths[k] * scheme.slopes[i, j]
        self.num_defects = len(lengths) * groups * self.nx
        each = np.arange(self.nx)
        rows, self.rate_index = (a[:, None] * self.nx + each for a in (self.defect, self.node))
        self.link_rows, columns = rows, self.node[:, None] * self.width + each
        self._S = _sparse(rows, columns, self.state[:, None], (self.num_defects, self.z.numel()))
        self._D = _sparse(rows, self.rate_index, self.slope[:, None], (self.num_defects, self.every.size * self.nx))
        self.link_columns = columns

    def _linear_inputs(self) -> Any:
        """The matrix of 2 u_mid - u_0 - u_1, for all intervals and inputs."""
        middle = np.arange(1, self.every.size, 2)[:, None] * self.width + np.arange(self.nx, self.width)
        rows = np.arange(middle.size).reshape(middle.shape)
        columns = np.stack([middle, middle - self.width, middle + self.width])
        values = np.array([2.0, -1, -1])[:, None, None]
        return _sparse(rows, columns, values, (middle.size, self.z.numel()))

    @cached_property
    def _rates(self) -> Any:
        return self.functions.dynamics.values(self.knots)

    @cached_property
    def _rows(self) -> Any:
        return self.functions.dynamics.jacobian(self.knots)

    @cached_property
    def _costs(self) -> Any:
        return self.functions.rate.values(self.knots)

    @cached_property
    def _cost_rows(self) -> Any:
        return self.functions.rate.jacobian(self.knots)

    @property
    def _path_functions(self) -> list[tuple[KnotFunction, Indices]]:
        return [(f, at) for f, (at, _) in zip(self.functions.paths, self.paths, strict=True)]

    def _gradient(self) -> Any:
        total, last = _Sum((self.z.numel(), 1)), self.every[-1:]
        b = _Blocks(self.functions.rate.jacobian_at, self.every)
        total.add(b.column(self.width), 0, self.weights[b.node], self.time * self._cost_rows, b.index)
        if self.free:
            total.add(self.z.numel() - 1, 0, self.weights, ca.vec(self._costs), self.every)
        if self.functions.final is not None:
            b = _Blocks(self.functions.final.jacobian_at, last)
            total.add(b.column(self.width), 0, 1.0, self.functions.final.jacobian(self.knots[:, -1]), b.index)
        return ca.densify(total.matrix())

    def _jacobian(self) -> Any:
        f, total = self.functions.dynamics, _Sum((self.nlp["g"].numel(), self.z.numel()))
        total.add(self.link_rows, self.link_columns, self.state[:, None], ca.DM(1), 0)
        rows, columns = f.jacobian_at
        index = self.node[:, None] * len(rows) + np.arange(len(rows))
        at = self.defect[:, None] * self.nx + rows, self.node[:, None] * self.width + columns
        total.add(*at, -self.slope[:, None], self.time * self._rows, index)
        if self.free:
            source = ca.vec(self._rates)
            total.add(self.link_rows, self.z.numel() - 1, -self.slope[:, None], source, self.rate_index)
        first = self.num_defects
        for path, nodes in self._path_functions:
            b = _Blocks(path.jacobian_at, nodes)
            total.add(
                first + b.place * path.rows + b.rows,
                b.column(self.width),
                1.0,
                path.jacobian(self.knots[:, nodes.tolist()]),
                b.index,
            )
            first += path.rows * len(nodes)
        if self._linear is not None:
            rows, columns = (np.array(a) for a in self._linear.sparsity().get_triplet())
            total.add(first + rows, columns, np.array(self._linear.nonzeros()), ca.DM(1), 0)
        return total.matrix()

    def _hessian(self, sigma: Any, multipliers: Any) -> Any:
        """The upper triangle of d^2 (sigma f + multipliers' g) / dz^2."""
        f, rate, total = self.functions.dynamics, self.functions.rate, _Sum((self.z.numel(), self.z.numel()))
        nu = ca.mtimes(self._D.T, multipliers[: self.num_defects])
        weights = ca.DM(self.weights).T
        terms: list[tuple[Any, Indices, Any]] = [
            (f, self.every, -self.time * ca.reshape(nu, self.nx, self.every.size)),
            (rate, self.every, sigma * self.time * weights),
        ]
        if self.functions.final is not None:
            terms.append((self.functions.final, self.every[-1:], sigma))
        first = self.num_defects
        for path, nodes in self._path_functions:
            last = first + path.rows * len(nodes)
            terms.append((path, nodes, ca.reshape(multipliers[first:last], path.rows, len(nodes))))
            first = last
        for function, nodes, seeds in terms:
            b = _Blocks(function.hessian_at, nodes)
            source = function.hessian(self.knots[:, nodes.tolist()], seeds)
            total.add(b.node * self.width + b.rows, b.column(self.width), 1.0, source, b.index)
        if self.free:
            b = _Blocks(f.jacobian_at, self.every)
            source = self._rows * nu[(b.node * self.nx + b.rows).ravel().tolist()]
            total.add(b.column(self.width), self.z.numel() - 1, -1.0, source, b.index)
            b = _Blocks(rate.jacobian_at, self.every)
            source = sigma * self._cost_rows
            total.add(b.column(self.width), self.z.numel() - 1, self.weights[b.node], source, b.index)
        return total.matrix()


class _Blocks:
    """The nonzeros at `at` (rows, columns) of one block a node, as arrays (nodes, nonzeros)."""

    def __init__(self, at: tuple[Indices, Indices], nodes: Indices):
        self.rows, self.columns = (np.tile(a, (len(nodes), 1)) for a in at)
        self.place = np.repeat(np.arange(len(nodes))[:, None], len(at[0]), axis=1)
        self.node = np.repeat(nodes[:, None], len(at[0]), axis=1)
        self.index = np.arange(self.rows.size).reshape(self.rows.shape)

    def column(self, width: int) -> Indices:
        """The decision variables of the columns."""
        return self.node * width + self.columns


class _Sum:
    """A sparse matrix whose entries are sums: matrix[row, column] += coefficient * source[index]."""

    def __init__(self, shape: tuple[int, int]):
        self.shape = shape
        self.places: list[Indices] = []
        self.parts: list[tuple[Array, Any, Indices]] = []

    def add(self, rows: Any, columns: Any, coefficients: Any, source: Any, index: Any) -> None:
        """Add entries, one for each of `index`; the others are broadcast to it and it to them."""
        rows, columns, coefficients, index = (
            a.ravel() for a in np.broadcast_arrays(rows, columns, coefficients, index)
        )
        self.places.append(columns * self.shape[0] + rows)
        self.parts.append((coefficients, source, index))

    def matrix(self) -> Any:
        """An MX of the places that were added to."""
        places, targets = np.unique(np.concatenate(self.places), return_inverse=True)
        nonzeros, start = 0, 0
        for coefficients, source, index in self.parts:
            rows = targets[start : start + len(index)]
            gather = _sparse(rows, index, coefficients, (len(places), source.numel()))
            nonzeros, start = nonzeros + ca.mtimes(gather, source), start + len(index)
        columns, rows = np.divmod(places, self.shape[0])
        starts = np.searchsorted(columns, np.arange(self.shape[1] + 1))
        return ca.MX(ca.Sparsity(*self.shape, starts.tolist(), rows.tolist()), nonzeros)


def _sparse(rows: Any, columns: Any, values: Any, shape: tuple[int, int]) -> Any:
    """A DM of `shape` with `values` other than 0 at (rows, columns)."""
    rows, columns, values = (a.ravel() for a in np.broadcast_arrays(rows, columns, values))
    kept = values != 0
    return ca.DM.triplet(rows[kept].tolist(), columns[kept].tolist(), ca.DM(values[kept]), *shape)
