"""Functions of a knot [x, u] within a CasADi program: traced to expressions where that is possible, else called back.

Both kinds give `values` (m, K) at all K knots in one call, and the nonzeros of the K Jacobians by the knot; expressions
also those of the Hessians of weights (m, K) times values. `jacobian_at` and `hessian_at` are (rows, columns) of the
nonzeros of one knot.
"""

import os
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import Refusal
from drake_diff.mechanics.casadi_tree import PlantFunctions, symbolic_plant
from drake_diff.mechanics.fixed_contacts import FixedContactPlant
from drake_diff.optimize.knots import trace
from drake_diff.optimize.problem.constraint import Constraint
from drake_diff.optimize.problem.coupling import BoundCoupling
from drake_diff.optimize.problem.dynamics import DiscreteMap, PlantKnots, Pointwise
from drake_diff.optimize.transcription.task import OptimalControl, TimedRate

THREAD_WORTH = 500_000  # instructions of 1 to 5 ns; to start a thread costs 50 us
Values = Callable[[Array], Array]  # knots (K, nx + nu) -> (K, m)
Linearize = Callable[[Array], tuple[Array, Array]]  # -> (K, m), (K, m, nx + nu)


class Symbolic:
    """A function of which CasADi has the expression; `why_not` of a second derivative is none."""

    why_not = ""

    def __init__(self, function: Any, *known: Any):
        self.function, self.rows, self.width, self.known = function, function.size1_out(0), function.size1_in(0), known
        self.jacobian_at = _places(self._jacobian.sparsity_out(0))

    def values(self, knots: Any) -> Any:
        return _at_all(self.function, knots, *self.known)

    def jacobian(self, knots: Any) -> Any:
        return ca.vec(_at_all(self._jacobian, knots, *self.known).nz[:])

    def jacobian_of(self, knot: Array, step: int = 0) -> Array:
        """(m, nx + nu) at one `knot` (nx + nu,), the same of every step."""
        return np.asarray(self._jacobian(knot).full())

    def hessian(self, knots: Any, weights: Any) -> Any:
        return ca.vec(_at_all(self._hessian, knots, weights, *self.known).nz[:])

    @property
    def hessian_at(self) -> tuple[Indices, Indices]:
        return _places(self._hessian.sparsity_out(0))

    @cached_property
    def _jacobian(self) -> Any:
        knot, *known = self._symbols()
        return ca.Function("jacobian", [knot, *known], [ca.jacobian(self.function(knot, *known), knot)])

    @cached_property
    def _hessian(self) -> Any:
        """The upper triangle."""
        (knot, *known), weights = self._symbols(), ca.SX.sym("weights", self.rows)
        hessian, _ = ca.hessian(ca.dot(weights, self.function(knot, *known)), knot)
        return ca.Function("hessian", [knot, weights, *known], [ca.triu(hessian)])

    def _symbols(self) -> list[Any]:
        """The knot, and what is known beside it."""
        return [ca.SX.sym(f"z{i}", self.function.size1_in(i)) for i in range(self.function.n_in())]


def _at_all(function: Any, knots: Any, *others: Any) -> Any:
    return _mapped(function, knots.shape[1])(knots, *others)


def _mapped(function: Any, count: int) -> Any:
    """`function` of `count` columns, on as many cores as have enough to do: their threads start anew at every call."""
    threads = min(os.cpu_count() or 1, count * function.n_instructions() // THREAD_WORTH)
    return function.map(count, *(("thread", threads) if threads > 1 else ()))


class SymbolicPlant(Symbolic):
    """A plant's equations of motion, whose Hessians take the Jacobians that were computed at the same knots before."""

    def __init__(self, plant: PlantFunctions):
        self._plant = plant
        self.error: Exception | None = None
        self._kept: dict[int, _KnotCallback] = {}  # by the number of knots; CasADi holds no reference to its callbacks
        super().__init__(plant.function)

    def jacobian(self, knots: Any) -> Any:
        count = knots.shape[1]
        if count not in self._kept:
            self._kept[count] = _KnotCallback(self, count, self._jacobian.nnz_out(0), self._compute(count))
        return ca.vec(self._kept[count](knots))

    def hessian(self, knots: Any, weights: Any) -> Any:
        function = _mapped(self._hessian, knots.shape[1])
        rows = ca.MX(function.sparsity_in(2), self.jacobian(knots))
        return ca.vec(function(knots, weights, rows).nz[:])

    @property
    def _jacobian(self) -> Any:
        return self._plant.jacobian

    @property
    def _hessian(self) -> Any:
        return self._plant.hessian

    def _compute(self, count: int) -> Values:
        entries = np.empty((count, self._jacobian.nnz_out(0)))
        buffer, evaluate = _mapped(self._jacobian, count).buffer()
        buffer.set_res(0, entries.data)

        def nonzeros(knots: Array) -> Array:
            buffer.set_arg(0, knots.data)
            evaluate()
            return entries

        return nonzeros


class Called:
    """A function that is called back, with dense Jacobians; the first error of a call is kept, and fails the call."""

    def __init__(
        self,
        why_not: str,
        values: Values,
        linearize: Linearize,
        rows: int,
        width: int,
        at_step: Callable[[int], Any] | None = None,
    ):
        self.why_not, self.rows, self.width = why_not, rows, width
        self.evaluate, self.linearize = values, linearize
        self.error: Exception | None = None
        self.at_step = at_step  # of a map that is another one at each step
        self.jacobian_at = _places(ca.Sparsity.dense(rows, width))
        self._kept: list[Any] = []  # CasADi holds no reference to its callbacks

    def values(self, knots: Any) -> Any:
        self._kept.append(_KnotCallback(self, knots.shape[1], self.rows, self.evaluate))
        return self._kept[-1](knots)

    def jacobian(self, knots: Any) -> Any:
        def rows(points: Array) -> Array:
            return self.linearize(points)[1].transpose(0, 2, 1)

        self._kept.append(_KnotCallback(self, knots.shape[1], self.rows * self.width, rows))
        return ca.vec(self._kept[-1](knots))

    def jacobian_of(self, knot: Array, step: int = 0) -> Array:
        """(m, nx + nu) at one `knot` (nx + nu,), of a step where it changes from step to step."""
        linearize = self.linearize if self.at_step is None else self.at_step(step).linearize
        return np.asarray(linearize(knot[None])[1][0])


class _KnotCallback(ca.Callback):  # type: ignore[misc]
    """(nx + nu, K) -> (rows, K); the last result is kept, since a solver asks twice for its first iterate's."""

    def __init__(self, owner: Called | SymbolicPlant, count: int, rows: int, at_knots: Values):
        ca.Callback.__init__(self)
        self.owner, self.count, self.rows, self.at_knots = owner, count, rows, at_knots
        self.last: tuple[bytes, Array] | None = None
        self.construct("called", {})

    def get_n_in(self) -> int:
        return 1

    def get_n_out(self) -> int:
        return 1

    def get_sparsity_in(self, i: int) -> Any:
        return ca.Sparsity.dense(self.owner.width, self.count)

    def get_sparsity_out(self, i: int) -> Any:
        return ca.Sparsity.dense(self.rows, self.count)

    def has_jacobian(self) -> bool:
        return isinstance(self.owner, Called) and self.rows == self.owner.rows

    def has_jac_sparsity(self, i: int, j: int) -> bool:
        return self.has_jacobian()

    def get_jac_sparsity(self, i: int, j: int, symmetric: bool) -> Any:
        return ca.Sparsity(self._jacobian_sparsity)

    def get_jacobian(self, name: str, inputs: Any, outputs: Any, options: Any) -> Any:
        """nlpsol asks for it as it makes itself ready; the program has its own."""
        knots, values = ca.MX.sym("knots", self.owner.width, self.count), ca.MX.sym("values", self.rows, self.count)
        jacobian = ca.MX(self._jacobian_sparsity, self.owner.jacobian(knots))
        return ca.Function(name, [knots, values], [jacobian], inputs, outputs, options)

    @cached_property
    def _jacobian_sparsity(self) -> Any:
        block = ca.Sparsity.dense(self.rows, self.owner.width)
        return ca.diagcat(*[block] * self.count)

    def has_eval_buffer(self) -> bool:
        return True

    def eval_buffer(self, arguments: Any, results: Any) -> int:
        knots = np.array(np.frombuffer(arguments[0], float)).reshape(self.count, self.owner.width)
        key = knots.tobytes()
        try:
            if self.last is None or self.last[0] != key:
                self.last = key, np.array(self.at_knots(knots)).ravel()
        except Exception as error:  # must not go through C++; the solve raises or tells it
            self.owner.error = self.owner.error or error
            return 1
        np.frombuffer(results[0], float)[:] = self.last[1]
        return 0


class Timed:
    """A running cost that changes in time: of the nodes of a mesh it is one of the two kinds, see `at`."""

    error: Exception | None = None

    def __init__(self, rate: TimedRate, nx: int):
        self.rate, self.width = rate, rate.width
        with np.errstate(all="ignore"):
            self.found = trace(rate.f, nx, rate.probe, rate.values(rate.probe))
        self.why_not = self.found.reason if isinstance(self.found, Refusal) else ""

    def at(self, times: Array) -> Symbolic | Called:
        """The function of the knots at `times` (K,) [s]."""
        known = self.rate.cost.known_at(times)
        if not isinstance(self.found, Refusal):
            knot, p = ca.SX.sym("knot", self.width), ca.SX.sym("known", known.shape[1])
            return Symbolic(ca.Function("timed", [knot, p], [self.found(ca.vertcat(knot, p))]), ca.DM(known.T))

        def kept(function: Any) -> Any:
            def call(knots: Array) -> Any:
                try:
                    return function(np.hstack([knots, known]))
                except Exception as error:
                    self.error = self.error or error
                    raise

            return call

        return Called(self.why_not, kept(self.rate.values), kept(self.rate.linearize), 1, self.width)


class Stepwise:
    """A map whose expression is another one at each step, of all nodes of its mesh at once; see `Symbolic`."""

    why_not = ""

    def __init__(self, functions: list[Any]):
        self.functions, self.rows, self.width = functions, functions[0].size1_out(0), functions[0].size1_in(0)
        knot, weights = ca.SX.sym("knot", self.width), ca.SX.sym("weights", self.rows)
        slopes = [ca.jacobian(f(knot), knot) for f in functions]
        curves = [ca.triu(ca.hessian(ca.dot(weights, f(knot)), knot)[0]) for f in functions]
        self._jacobians, places = _alike("jacobian", [knot], slopes)
        self._hessians, self._curved = _alike("hessian", [knot, weights], curves)
        self.jacobian_at = _places(places)

    def values(self, knots: Any) -> Any:
        return ca.horzcat(*[f(knots[:, k]) for k, f in enumerate(self.functions)])

    def jacobian(self, knots: Any) -> Any:
        return ca.vertcat(*[f(knots[:, k]) for k, f in enumerate(self._jacobians)])

    def jacobian_of(self, knot: Array, step: int = 0) -> Array:
        """(m, nx + nu) at one `knot` (nx + nu,) of a step."""
        jacobian = np.zeros((self.rows, self.width))
        jacobian[self.jacobian_at] = np.asarray(self._jacobians[step](knot)).ravel()
        return jacobian

    def hessian(self, knots: Any, weights: Any) -> Any:
        return ca.vertcat(*[f(knots[:, k], weights[:, k]) for k, f in enumerate(self._hessians)])

    @property
    def hessian_at(self) -> tuple[Indices, Indices]:
        return _places(self._curved)


def _alike(name: str, arguments: list[Any], matrices: list[Any]) -> tuple[list[Any], Any]:
    """Functions of the nonzeros of `matrices`, all at the places at which one of them has some, and these places."""
    places = matrices[0].sparsity()
    for matrix in matrices[1:]:
        places = places.unite(matrix.sparsity())
    return [
        ca.Function(name, arguments, [ca.vertcat(*ca.project(m, places).nz[:].elements())]) for m in matrices
    ], places


KnotFunction = Symbolic | Called | Stepwise


def _places(sparsity: Any) -> tuple[Indices, Indices]:
    return np.array(sparsity.row(), dtype=np.intp), np.array(sparsity.get_col(), dtype=np.intp)


@dataclass(frozen=True, eq=False)
class KnotFunctions:
    """Those of a task; the final cost is one of the last knot, `paths` are its constraints.

    `joined` are its couplings, of the states of several knots side by side and the inputs there.
    """

    dynamics: KnotFunction
    rate: KnotFunction | Timed
    final: KnotFunction | None
    paths: tuple[KnotFunction, ...]
    joined: tuple[KnotFunction, ...] = ()
    parameters: KnotFunction | None = None  # the cost of the parameters, of their coordinates

    @property
    def why_not(self) -> str:
        """Which of them has no second derivative and why, "" where all have."""
        named = [("dynamics", self.dynamics), ("running_cost", self.rate), ("final_cost", self.final)]
        named += [("parameter_cost", self.parameters)]
        named += [(f"constraint {i}", path) for i, path in enumerate(self.paths)]
        named += [(f"coupling {i}", coupling) for i, coupling in enumerate(self.joined)]
        return next((f"{name}: {f.why_not}" for name, f in named if f is not None and f.why_not), "")

    @property
    def error(self) -> Exception | None:
        """The first error that one of them raised."""
        every = (self.dynamics, self.rate, self.final, self.parameters, *self.paths, *self.joined)
        called = [f for f in every if isinstance(f, (Called, SymbolicPlant, Timed))]
        return next((f.error for f in called if f.error is not None), None)


def knot_functions(task: OptimalControl) -> KnotFunctions:
    """The functions of `task`, each symbolic if it can be."""
    nx, probe = task.dynamics.nx, task.dynamics.probe()
    rate, final = task.rate, task.final

    def choose(
        function: Any, values: Values, linearize: Linearize, rows: int, nx: int = nx, probe: Array = probe
    ) -> KnotFunction:
        with np.errstate(all="ignore"):
            expression = trace(function, nx, probe, values(probe))
        if isinstance(expression, Refusal):
            return Called(expression.reason, values, linearize, rows, probe.shape[1])
        return Symbolic(expression)

    def joined(c: BoundCoupling) -> KnotFunction:
        count = c.knots.shape[1]
        several = [np.roll(probe, i, axis=0) for i in range(count)]  # so that no two of a place are the same knot
        beside = np.hstack([*(knots[:, :nx] for knots in several), *(knots[:, nx:] for knots in several)])
        return constraint_function(c.rows, count * nx, beside)

    cost, parameters = task.parameter_cost, None
    if cost is not None and task.varied is not None:
        tails = task.varied.probe()[:, task.varied.width :]
        parameters = choose(cost.f, cost.values, cost.linearize, 1, cost.nx, tails)
    return KnotFunctions(
        _map(task) if isinstance(task.dynamics, DiscreteMap) else _dynamics(task),
        Timed(rate, nx) if isinstance(rate, TimedRate) else choose(rate.f, rate.values, rate.linearize, 1),
        final if final is None else choose(final.f, final.values, final.linearize, 1),
        tuple(constraint_function(constraint, nx, probe) for constraint in task.problem.kept),
        tuple(joined(coupling) for coupling in task.couplings),
        parameters,
    )


def _map(task: OptimalControl) -> KnotFunction:
    """Of all nodes of N steps; after the last there is none, and the last step's stands there."""
    f, count = task.dynamics, task.problem.num_steps
    if not (isinstance(f, DiscreteMap) and f.counts):
        return _dynamics(task)
    probe, steps = f.probe(), np.minimum(np.arange(count + 1), count - 1)
    functions = [trace(f.at_step(k).f, f.nx, probe, f.at_step(k).values(probe)) for k in range(count)]
    why = next((refusal.reason for refusal in functions if isinstance(refusal, Refusal)), None)
    if why is None:
        return Stepwise([*functions, functions[-1]])

    def of(function: Any) -> Any:
        return lambda knots: function(knots, steps)

    return Called(why, of(f.values), of(f.linearize), f.nx, f.nx + f.nu, f.at_step)


def constraint_function(c: Constraint, nx: int, probe: Array) -> KnotFunction:
    """That of a constraint's values, tried at the knots `probe` (P, nx + nu)."""

    def values(knots: Array) -> Array:
        return c.along(knots[:, :nx], knots[:, nx:])

    def linearize(knots: Array) -> tuple[Array, Array]:
        return values(knots), c.slopes(knots[:, :nx], knots[:, nx:])

    with np.errstate(all="ignore"):
        function = trace(c.function if c.takes_input else lambda x, u: c.function(x), nx, probe, values(probe))
    if isinstance(function, Refusal):
        return Called(function.reason, values, linearize, len(c.lower), probe.shape[1])
    return Symbolic(function)


def _dynamics(task: OptimalControl) -> KnotFunction:
    dynamics, moved = task.dynamics, task.varied
    form, source = dynamics.form, moved or dynamics
    probe, nu = source.probe(), dynamics.nu
    function: Any = Refusal("an object with derivatives of its own")
    if isinstance(form, PlantKnots):
        function = symbolic_plant(form.model, dynamics.parameters, None if moved is None else moved.coordinates)
    elif isinstance(form, FixedContactPlant):
        function = form.expressions["rates"].function
    elif isinstance(form, Pointwise):
        start = dynamics.parameters.values

        def by_knot(x: Any, z: Any) -> Any:
            tail = start if moved is None else moved.coordinates.to_values(z[nu:])
            return form.f(x, np.concatenate([z[:nu], tail]) if len(start) else z)

        function = trace(by_knot, dynamics.nx, probe, source.values(probe))
    if isinstance(function, Refusal):
        return Called(function.reason, source.values, source.linearize, dynamics.nx, probe.shape[1])
    return SymbolicPlant(function) if isinstance(function, PlantFunctions) else Symbolic(function)
