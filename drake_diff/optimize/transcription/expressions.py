"""The functions of a collocation program: dynamics, costs, constraints and couplings of its nodes."""

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.jax_rows import in_jax
from drake_diff._base.values import Refusal
from drake_diff.mechanics.casadi_tree import PlantFunctions, symbolic_plant
from drake_diff.mechanics.fixed_contacts import FixedContactPlant
from drake_diff.mechanics.symbol import Mapped
from drake_diff.optimize.knots import (
    Called,
    InJax,
    Linearize,
    PointFunction,
    Traced,
    Values,
    constraint_function,
    trace,
)
from drake_diff.optimize.problem.coupling import BoundCoupling
from drake_diff.optimize.problem.dynamics import DiscreteMap, PlantKnots, Pointwise
from drake_diff.optimize.transcription.task import OptimalControl, TimedRate


class PlantRates(Traced):
    """A plant's equations of motion, whose Hessians use the Jacobians at the same points."""

    def __init__(self, plant: PlantFunctions):
        super().__init__(plant.function)
        self._values = Mapped(plant.function)
        self._slopes = Mapped(plant.jacobian)
        self._curves = Mapped(plant.hessian)

    def hessian(self, points: Array, weights: Array, jacobian: Array) -> Array:
        return self._curves(points, weights, jacobian)[0]


class Stepwise(PointFunction):
    """A map with a different function at each step. The K points are those of the K `functions`."""

    def __init__(self, functions: list[PointFunction]):
        self.functions, self.rows, self.width = functions, functions[0].rows, functions[0].width
        self.why_not = next((f.why_not for f in functions if f.why_not), "")
        self.jacobian_at = np.repeat(np.arange(self.rows), self.width), np.tile(np.arange(self.width), self.rows)
        self.hessian_at = np.triu_indices(self.width)

    def values(self, points: Array) -> Array:
        return np.vstack([f.values(z[None]) for f, z in zip(self.functions, points, strict=True)])

    def jacobian(self, points: Array) -> Array:
        return np.array([f.linearize(z[None])[1].ravel() for f, z in zip(self.functions, points, strict=True)])

    def hessian(self, points: Array, weights: Array, jacobian: Array) -> Array:
        dense = np.zeros((len(points), self.width, self.width))
        for f, z, w, block in zip(self.functions, points, weights, dense, strict=True):
            block[f.hessian_at] = f.hessian(z[None], w[None], f.jacobian(z[None]))[0]
        return np.asarray(dense[:, *self.hessian_at])


class Timed:
    """A running cost that depends on time. With known times, `at` returns it as a function of knots."""

    linear = False

    def __init__(self, rate: TimedRate, nx: int):
        self.rate, self.width = rate, rate.width
        with np.errstate(all="ignore"):
            self.expression = trace(rate.f, nx, rate.probe, rate.values(rate.probe))
        refused = isinstance(self.expression, Refusal)
        self.compiled = in_jax("running_cost", rate.f, nx, 1, rate.probe, self.width) if refused else None
        self.why_not = "" if self.compiled is not None or not refused else self.expression.reason

    def at(self, times: Array) -> PointFunction:
        """Return the function of the knots at `times` (K,) [s]."""
        known, rate = self.rate.cost.known_at(times), self.rate
        if not isinstance(self.expression, Refusal):
            knot, p = ca.SX.sym("knot", self.width), ca.SX.sym("known", known.shape[1])
            return Traced(ca.Function("timed", [knot, p], [self.expression(ca.vertcat(knot, p))]), known)

        def values(knots: Array) -> Array:
            return rate.values(np.hstack([knots, known]))

        def linearize(knots: Array) -> tuple[Array, Array]:
            return rate.linearize(np.hstack([knots, known]))

        if self.compiled is not None:
            return InJax(self.compiled, known)
        return Called(self.why_not, values, linearize, 1, self.width)


@dataclass(frozen=True, eq=False)
class KnotFunctions:
    """The functions of a task. The final cost is a function of the last knot, and `paths` are its constraints.

    `joined` are its couplings, functions of the concatenated states of several knots and their inputs.
    """

    dynamics: PointFunction
    rate: PointFunction | Timed
    final: PointFunction | None
    paths: tuple[PointFunction, ...]
    joined: tuple[PointFunction, ...] = ()
    parameters: PointFunction | None = None  # the cost of the parameters as a function of their coordinates

    def why_not(self, *, linear: bool) -> str:
        """Return "" if all functions with this `linear` have second derivatives, or the first one without and why."""
        named = [("dynamics", self.dynamics), ("running_cost", self.rate), ("final_cost", self.final)]
        named += [("parameter_cost", self.parameters)]
        named += [(f"constraint {i}", path) for i, path in enumerate(self.paths)]
        named += [(f"coupling {i}", coupling) for i, coupling in enumerate(self.joined)]
        lacking = [(name, f.why_not) for name, f in named if f is not None and f.why_not and f.linear == linear]
        return next((f"{name}: {why}" for name, why in lacking), "")


def knot_functions(task: OptimalControl) -> KnotFunctions:
    """Return the functions of `task`, as symbolic expressions if possible."""
    nx, probe, rate, final = task.dynamics.nx, task.dynamics.probe(), task.rate, task.final
    cost, parameters = task.parameter_cost, None
    if cost is not None and task.varied is not None:
        tails = task.varied.probe()[:, task.varied.width :]
        parameters = _chosen(cost.f, cost.values, cost.linearize, 1, cost.nx, tails)
    return KnotFunctions(
        _dynamics(task),
        Timed(rate, nx) if isinstance(rate, TimedRate) else _chosen(rate.f, rate.values, rate.linearize, 1, nx, probe),
        final if final is None else _chosen(final.f, final.values, final.linearize, 1, nx, probe),
        tuple(constraint_function(constraint, nx, probe) for constraint in task.problem.kept),
        tuple(joined_function(coupling, nx, probe) for coupling in task.couplings),
        parameters,
    )


def joined_function(c: BoundCoupling, nx: int, probe: Array) -> PointFunction:
    """Return the function of a coupling, of the concatenated states at the knots of a place, then of the inputs."""
    count = c.knots.shape[1]
    several = [np.roll(probe, i, axis=0) for i in range(count)]  # so that a place has different knots
    beside = np.hstack([*(knots[:, :nx] for knots in several), *(knots[:, nx:] for knots in several)])
    return constraint_function(c.rows, count * nx, beside)


def _chosen(f: Any, values: Values, linearize: Linearize, rows: int, nx: int, probe: Array) -> PointFunction:
    with np.errstate(all="ignore"):
        expression = trace(f, nx, probe, values(probe))
    if not isinstance(expression, Refusal):
        return Traced(expression)
    if (compiled := in_jax("function", f, nx, rows, probe)) is not None:
        return InJax(compiled)
    return Called(expression.reason, values, linearize, rows, probe.shape[1])


def _dynamics(task: OptimalControl) -> PointFunction:
    dynamics, moved = task.dynamics, task.varied
    form, source = dynamics.form, moved or dynamics
    probe, nx, nu = source.probe(), dynamics.nx, dynamics.nu
    if isinstance(dynamics, DiscreteMap) and dynamics.counts:  # the last knot has no step and repeats it
        steps = [dynamics.at_step(k) for k in range(task.problem.num_steps)]
        functions = [_chosen(step.f, step.values, step.linearize, nx, nx, probe) for step in steps]
        return Stepwise([*functions, functions[-1]])
    function: Any = Refusal("an object with derivatives of its own")
    if isinstance(form, PlantKnots):
        function = symbolic_plant(form.model, dynamics.parameters, None if moved is None else moved.coordinates)
    elif isinstance(form, FixedContactPlant):
        function = form.functions
    elif isinstance(form, Pointwise):
        start = dynamics.parameters.values

        def by_knot(x: Any, z: Any) -> Any:
            tail = start if moved is None else moved.coordinates.to_values(z[nu:])
            return form.f(x, np.concatenate([z[:nu], tail]) if len(start) else z)

        return _chosen(by_knot, source.values, source.linearize, nx, nx, probe)
    if isinstance(function, Refusal):
        return Called(function.reason, source.values, source.linearize, nx, probe.shape[1])
    return PlantRates(function) if isinstance(function, PlantFunctions) else Traced(function)
