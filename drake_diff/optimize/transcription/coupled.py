"""Rows of a program that are functions of chosen variables, whatever nodes these belong to.

One function of w entries of z (states and inputs of several nodes, the horizon) at each of K places gives m rows there:
traced to an expression, with an exact Jacobian and Hessian, or called back with AutoDiffXd's derivatives and no Hessian
(`expressions.Symbolic`, `expressions.Called`).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.optimize.problem.coupling import BoundCoupling, RateLimit
from drake_diff.optimize.problem.phases import PhasedProblem, duration_of
from drake_diff.optimize.program import Iterate
from drake_diff.optimize.transcription.expressions import KnotFunction, KnotFunctions, constraint_function
from drake_diff.optimize.transcription.task import OptimalControl

Entries = tuple[Any, Any, Any]  # rows, columns (K, nonzeros) and where in `values` the nonzeros are


@dataclass(frozen=True, eq=False)
class CoupledRows:
    """lower <= function(z[columns[k]]) <= upper at each place k, with `columns` (K, w), no entry twice in a place."""

    label: str
    function: KnotFunction
    columns: Indices
    lower: Array  # (m,)
    upper: Array

    @property
    def count(self) -> int:
        """How many rows of the program they are."""
        return self.function.rows * len(self.columns)

    @property
    def sides(self) -> tuple[Array, Array]:
        """(lower, upper), each (count,), place by place."""
        return np.tile(self.lower, len(self.columns)), np.tile(self.upper, len(self.columns))

    def values(self, z: Any) -> Any:
        """(count,) at the variables z (n,), an MX."""
        return ca.vec(self.function.values(self._taken(z)))

    def jacobian(self, z: Any) -> tuple[Entries, Any]:
        """((rows, columns, index), source): the entry at rows, columns is source[index]."""
        rows, entries = self.function.jacobian_at
        positions, index = self._numbered(len(rows))
        return (self.function.rows * positions + rows, self.columns[:, entries], index), self.function.jacobian(
            self._taken(z)
        )

    def hessian(self, z: Any, multipliers: Any) -> tuple[Entries, Any]:
        """The same of the upper triangle of the second derivative of multipliers' (count,) values, if it is known."""
        function: Any = self.function
        rows, entries = function.hessian_at
        weights = ca.reshape(multipliers, self.function.rows, len(self.columns))
        first, other = self.columns[:, rows], self.columns[:, entries]
        _, index = self._numbered(len(rows))
        places = np.minimum(first, other), np.maximum(first, other), index
        return places, function.hessian(self._taken(z), weights)

    def _taken(self, z: Any) -> Any:
        return ca.reshape(z[self.columns.ravel().tolist()], self.columns.shape[1], len(self.columns))

    def _numbered(self, nonzeros: int) -> tuple[Indices, Indices]:
        """The place of each nonzero (K, nonzeros), and its number."""
        index = np.arange(len(self.columns) * nonzeros).reshape(len(self.columns), nonzeros)
        return np.arange(len(self.columns))[:, None], index


@dataclass(frozen=True, eq=False)
class SlopeRows:
    """|slopes| <= limit at the ends of all intervals, where the slope by time of a line or parabola is largest.

    As rows weights @ y within limit * T, with y the variables z or, `of_rates`, the rates F of all nodes: linear in T.
    With a free T there are two rows for each, one for either side.
    """

    of_rates: bool
    places: Indices  # (m, s+1) of the nodes' values in y
    weights: Array  # (m, s+1)
    limits: Array  # (m,) [per s]
    horizon: float | None  # [s] None where it is free

    @property
    def count(self) -> int:
        """How many rows of the program they are."""
        return len(self.limits) * (2 if self.horizon is None else 1)

    @property
    def sides(self) -> tuple[Array, Array]:
        """(lower, upper), each (count,)."""
        if self.horizon is not None:
            return -self.horizon * self.limits, self.horizon * self.limits
        zero, none = np.zeros(len(self.limits)), np.full(len(self.limits), np.inf)
        return np.append(-none, zero), np.append(zero, none)

    @property
    def by_time(self) -> Array:
        """(count,) the derivative by a free T."""
        return np.append(-self.limits, self.limits)

    @property
    def entries(self) -> tuple[Indices, Indices, Array]:
        """Rows, places in y and weights, each (count, s+1)."""
        times = self.count // max(len(self.limits), 1)
        rows = np.repeat(np.arange(self.count)[:, None], self.places.shape[1], axis=1)
        return rows, np.tile(self.places, (times, 1)), np.tile(self.weights, (times, 1))


def slopes_of(limit: RateLimit, task: OptimalControl, mesh: Array) -> SlopeRows:
    """The rows of a rate limit on `mesh` (N+1,)."""
    f, scheme = task.dynamics, task.scheme
    entries, limits = limit.entries(task.problem.system)
    ends, size, first = scheme.end_slopes, f.nx, entries
    if limit.of_inputs:
        ends = np.array([[-1.0, 0.0, 1.0]]) if scheme.input_is_linear else ends
        size, first = f.nx + f.nu, f.nx + entries
    lengths, shape = np.diff(mesh), (len(mesh) - 1, len(ends), len(entries))
    nodes = scheme.nodes * np.arange(len(lengths))[:, None] + np.arange(scheme.nodes + 1)
    places = nodes[:, None, None, :] * size + first[None, None, :, None]
    weights = ends[None, :, None, :] / lengths[:, None, None, None]
    whole = (*shape, scheme.nodes + 1)
    free = task.horizon[0] < task.horizon[1]
    return SlopeRows(
        of_rates=not limit.of_inputs,
        places=np.broadcast_to(places, whole).reshape(-1, scheme.nodes + 1),
        weights=np.broadcast_to(weights, whole).reshape(-1, scheme.nodes + 1),
        limits=np.broadcast_to(limits, shape).ravel(),
        horizon=None if free else task.horizon[0],
    )


def rows_of(c: BoundCoupling, function: KnotFunction, nodes: Indices, nx: int, width: int) -> CoupledRows:
    """Those of a coupling where `nodes` (N+1,) are the problem's knots, of nx + nu = `width` entries each."""
    first = nodes[c.knots][:, :, None] * width
    states = (first + np.arange(nx)).reshape(len(c.knots), -1)
    inputs = (first + np.arange(nx, width)).reshape(len(c.knots), -1)
    return CoupledRows(c.label, function, np.hstack([states, inputs]), c.rows.lower, c.rows.upper)


class SparseSum:
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
            gather = sparse(rows, index, coefficients, (len(places), source.numel()))
            nonzeros, start = nonzeros + ca.mtimes(gather, source), start + len(index)
        columns, rows = np.divmod(places, self.shape[0])
        starts = np.searchsorted(columns, np.arange(self.shape[1] + 1))
        return ca.MX(ca.Sparsity(*self.shape, starts.tolist(), rows.tolist()), nonzeros)


def sparse(rows: Any, columns: Any, values: Any, shape: tuple[int, int]) -> Any:
    """A DM of `shape` with `values` other than 0 at (rows, columns)."""
    rows, columns, values = (a.ravel() for a in np.broadcast_arrays(rows, columns, values))
    nonzero = values != 0
    return ca.DM.triplet(rows[nonzero].tolist(), columns[nonzero].tolist(), ca.DM(values[nonzero]), *shape)


# Problems in phases: their programs side by side, z = [z_0, z_1, ...], and rows that link their ends.


@dataclass(frozen=True, eq=False)
class PhasedFunctions:
    """Those of the phases, and of the links between them."""

    names: Sequence[str]
    phases: Sequence[KnotFunctions]
    links: Sequence[KnotFunction]

    @property
    def why_not(self) -> str:
        """Which of them has no second derivative and why, "" where all have."""
        named = [(f"{name}, ", f.why_not) for name, f in zip(self.names, self.phases, strict=True)]
        named += [("a reset: ", f.why_not) for f in self.links]
        return next((name + why for name, why in named if why), "")

    @property
    def error(self) -> Exception | None:
        """The first error that one of them raised."""
        every = [f.error for f in self.phases] + [getattr(f, "error", None) for f in self.links]
        return next((error for error in every if error is not None), None)


def link_functions(problem: PhasedProblem) -> tuple[KnotFunction, ...]:
    """What each switch asks of the two states side by side, symbolic if it can be."""
    return tuple(constraint_function(s.link, len(s.columns), s.probe) for s in problem.switches)


class PhasedProgram:
    """The program of the phases' `programs`, in their order, with the links of `problem`."""

    def __init__(self, problem: PhasedProblem, programs: Sequence[Any], links: Sequence[KnotFunction]):
        self.programs = programs
        self.functions = PhasedFunctions(problem.names, [program.functions for program in programs], links)
        self.starts = np.concatenate([[0], np.cumsum([program.z.numel() for program in programs])]).tolist()
        self.z = ca.MX.sym("z", self.starts[-1])
        self.lower, self.upper = (
            np.concatenate([getattr(program, side) for program in programs]) for side in ("lower", "upper")
        )
        self.links: list[CoupledRows] = []
        for s, function in zip(problem.switches, links, strict=True):
            program = programs[s.before]
            last = self.starts[s.before] + program.every[-1] * program.width + np.arange(len(s.columns))
            first = self.starts[s.after] + np.arange(len(s.rows))
            columns = np.concatenate([last, first])[None]
            self.links.append(CoupledRows(s.label, function, columns, s.link.lower, s.link.upper))
        self._whole = () if problem.horizon is None else problem.horizon
        self._given = sum(duration_of(p.task.problem)[0] for p in programs if not p.free)

    def split(self, z: Array) -> list[Array]:
        """The decision variables of each phase."""
        return np.split(z, self.starts[1:-1])

    def iterates(self, z: Array) -> tuple[Iterate, ...]:
        """The motion of each phase at z, for callbacks."""
        return tuple(
            iterate
            for program, variables in zip(self.programs, self.split(z), strict=True)
            for iterate in program.iterates(variables)
        )

    @cached_property
    def sides(self) -> tuple[Array, Array]:
        """(lower, upper) of g: the phases', those of the links, and what the free durations may sum to."""
        parts = [*(p.sides for p in self.programs), *(link.sides for link in self.links)]
        if self._whole:
            least, most = self._whole
            parts.append((np.array([least - self._given]), np.array([most - self._given])))
        lower, upper = zip(*parts, strict=True)
        return np.concatenate(lower), np.concatenate(upper)

    @cached_property
    def nlp(self) -> dict[str, Any]:
        """x, f and g as CasADi's nlpsol takes them."""
        functions = [ca.Function("phase", [p.z], [p.nlp["f"], p.nlp["g"]]) for p in self.programs]
        pairs = [function(z) for function, z in zip(functions, self._parts, strict=True)]
        g = [*(rows for _, rows in pairs), *(link.values(self.z) for link in self.links)]
        g += [ca.mtimes(self._durations, self.z)] * bool(self._whole)
        return {"x": self.z, "f": sum(f for f, _ in pairs), "g": ca.vertcat(*g)}

    def derivatives(self, exact: bool) -> dict[str, Any]:
        """CasADi Functions by the names of nlpsol's options, "hess_lag" only where `exact`."""
        p, sigma = ca.MX.sym("p", 0), ca.MX.sym("sigma")
        multipliers = ca.MX.sym("multipliers", self.nlp["g"].numel())
        pairs = list(zip([program.derivatives(exact) for program in self.programs], self._parts, strict=True))
        slope = ca.vertcat(*[phase_functions["grad_f"](z, p)[1] for phase_functions, z in pairs])
        rows = [phase_functions["jac_g"](z, p)[1] for phase_functions, z in pairs]
        ends = np.cumsum([0, *(block.size1() for block in rows)]).tolist()
        linked = SparseSum((sum(link.count for link in self.links), self.z.numel()))
        first = 0
        for link in self.links:
            (positions, columns, index), source = link.jacobian(self.z)
            linked.add(first + positions, columns, 1.0, source, index)
            first += link.count
        jacobian = [ca.diagcat(*rows), linked.matrix(), *[ca.MX(self._durations)] * bool(self._whole)]
        functions = {
            "grad_f": ca.Function("grad_f", [self.z, p], [self.nlp["f"], slope]),
            "jac_g": ca.Function("jac_g", [self.z, p], [self.nlp["g"], ca.vertcat(*jacobian)]),
        }
        if exact:
            within = zip(pairs, ends[:-1], ends[1:], strict=True)
            hessian = ca.diagcat(
                *[phase_functions["hess_lag"](z, p, sigma, multipliers[a:b]) for (phase_functions, z), a, b in within]
            )
            bent, first = SparseSum((self.z.numel(), self.z.numel())), ends[-1]
            for link in self.links:
                (positions, columns, index), source = link.hessian(self.z, multipliers[first : first + link.count])
                bent.add(positions, columns, 1.0, source, index)
                first += link.count
            functions["hess_lag"] = ca.Function("hess_lag", [self.z, p, sigma, multipliers], [hessian + bent.matrix()])
        return functions

    @cached_property
    def _parts(self) -> list[Any]:
        """The variables of each phase."""
        return [self.z[a:b] for a, b in zip(self.starts[:-1], self.starts[1:], strict=True)]

    @cached_property
    def _durations(self) -> Any:
        """(1, n) 1 at each free duration."""
        places = [end - 1 for program, end in zip(self.programs, self.starts[1:], strict=True) if program.free]
        return ca.DM.triplet([0] * len(places), places, ca.DM.ones(len(places)), 1, self.z.numel())
