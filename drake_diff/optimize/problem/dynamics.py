"""Dynamics x' = f(x, u) at many knots at once, with exact derivatives, from a plain function or a model's equations.

A knot is a row [x, u] of (K, nx + nu), or [x, u, p] if there are parameters p. A function that also accepts columns, x
(nx, K) and u (nu, K), is called once for all knots, as found by a comparison with single calls.
"""

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from pydrake.autodiffutils import ExtractValue, InitializeAutoDiff

from drake_diff._base.arrays import Array, Indices, array_with_gaps, count, finite_array, frozen, positive_int
from drake_diff._base.autodiff import gradient_rows, user_function
from drake_diff._base.jax_rows import JaxRows, in_jax
from drake_diff.exceptions import GradientError, InputError, ShapeError, UnknownNameError
from drake_diff.mechanics.tree import tree_for
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.model.model import Model
from drake_diff.model.parameters import (
    CONTACT_KINDS,
    ParameterCoordinates,
    ParameterVector,
    applied,
    plain_parameters,
    select,
    write_autodiff,
)
from drake_diff.model.plant import joints, labelled, radius_of_gyration
from drake_diff.optimize.problem.constraint import Bounds, arguments_of, carried, plant_limits, resolve_bounds
from drake_diff.optimize.problem.drake_systems import DrakeSystem

SMALLEST_TRIED = 1e-3  # of a parameter's first value: a smaller one's derivatives are certified at this value
SIDES = ("lower", "upper")
UNKNOWN = "unknown"  # the unit of plain dynamics' states and inputs
SAME_VALUES = 1e-9  # of the largest: allowed difference of a function's values with AutoDiffXd and floats
PROBED = 3  # number of knots at which a function is checked before its use
ORDINARY = "a function of x and u in ordinary arithmetic and NumPy functions, without float()"


class Pointwise:
    """A function (x (nx,), u (nu,)) -> `shape`, () or (r,), in ordinary arithmetic, evaluated at many knots.

    `probe` (3, nx + nu) are knots for a first check. Raises InputError or ShapeError if the function fails it.
    """

    def __init__(self, subject: str, f: Callable[[Any, Any], Any], nx: int, shape: tuple[int, ...], probe: Array):
        if not callable(f):
            raise InputError(subject, got=type(f).__name__, expected=ORDINARY)
        self.subject, self.f, self.nx, self.shape = subject, f, nx, shape
        self.rows = int(np.prod(shape))
        self.takes_rows = self.takes_columns = False
        self.compiled: JaxRows | None = None
        with np.errstate(all="ignore"):
            single = self.values(probe)
            carried_values, slopes = self.linearize(probe)
        terms = np.einsum("kri,ki->kr", np.abs(slopes), np.abs(probe))  # terms may cancel, or be infinite at a root
        largest = SAME_VALUES * float(np.max(np.nan_to_num([np.abs(single), terms], posinf=0.0), initial=0.0))
        if not np.allclose(carried_values, single, rtol=0, atol=largest, equal_nan=True):
            i = np.unravel_index(int(np.nanargmax(np.abs(carried_values - single))), single.shape)
            got = f"{carried_values[i]:.6g} with AutoDiffXd and {single[i]:.6g} with floats"
            raise GradientError(f"{subject} is {got} at the same x and u: write it as {ORDINARY}")
        self.compiled = in_jax(subject, f, nx, self.rows, probe)
        if getattr(f, "takes_rows", False):  # forward kinematics are compared with Drake's
            self.takes_rows = True
            self.takes_rows = bool(np.allclose(self.values(probe), single, rtol=SAME_VALUES, atol=0.0))
        try:
            self.takes_columns = True
            together, _ = self.linearize(probe)
            self.takes_columns = bool(np.allclose(together, single, rtol=1e-12, atol=1e-12, equal_nan=True))
        except Exception:  # f need not support columns, whatever the error is
            self.takes_columns = False

    def values(self, knots: Array) -> Array:
        """Return the values (K, r) at `knots` (K, nx + nu)."""
        if self.compiled is not None:
            return self.compiled.values(knots)
        if self.takes_rows:
            return np.asarray(self.f(knots[:, : self.nx], knots[:, self.nx :]), dtype=float).reshape(-1, self.rows)
        if self.takes_columns:
            return np.asarray(self._call(knots.T, len(knots)), dtype=float).reshape(self.rows, -1).T
        return np.array([np.asarray(self._call(k), dtype=float).reshape(self.rows) for k in knots])

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """Return the values (K, r) and, by AutoDiffXd, the Jacobian (K, r, nx + nu) at `knots` (K, nx + nu).

        Raises GradientError if the result has no derivatives.
        """
        if self.compiled is not None:
            return self.compiled.values(knots), self.compiled.jacobians(knots)
        count, width = knots.shape
        if not self.takes_columns:
            pairs = [self._carried(InitializeAutoDiff(k).ravel(), width) for k in knots]
            return np.array([value for value, _ in pairs]), np.array([rows for _, rows in pairs])
        seeds = np.repeat(np.eye(width), count, axis=0)
        columns = InitializeAutoDiff(value=knots.T.reshape(-1, 1), gradient=seeds).reshape(width, count)
        value, rows = self._carried(columns, width, count)
        return value.reshape(self.rows, count).T, rows.reshape(self.rows, count, width).transpose(1, 0, 2)

    def _carried(self, z: Any, width: int, *count: int) -> tuple[Array, Array]:
        return carried(self._call(z, *count).ravel(), width, self.subject, ORDINARY)

    def _call(self, z: Any, *count: int) -> Any:
        with np.errstate(all="ignore"):  # a solver's trial point may leave the domain, which results in NaN
            result = np.array(self.f(z[: self.nx], z[self.nx :]))
        if result.shape != (*self.shape, *count) and not (self.shape == () and not count and result.shape == (1,)):
            raise ShapeError(f"{self.subject}: its result", got=result.shape, expected=(*self.shape, *count))
        return result


class Dynamics:
    """Plain dynamics x' = f(x, u) with exact derivatives, as the system of a `Problem` without a model.

    Args:
        f: a function of x (nx,) and u (nu,) that returns the nx rates, in the states' units per second. Write it with
            ordinary arithmetic and NumPy functions, without float() and without branches on the numbers, so that it
            supports AutoDiffXd. An object with the methods `values(knots)` and `linearize(knots)` is also accepted,
            with the shapes of the methods of the same names in this class.
        nx: number of states.
        nu: number of inputs.
        x_lower, x_upper: (nx,) limits of the states; infinite if not given or NaN.
        u_lower, u_upper: (nu,) limits of the inputs; infinite if not given or NaN.
        state_names: nx names; x0, x1, ... by default.
        input_names: nu names; u0, u1, ... by default.
        parameters: mapping from names to values of numbers that a `Problem` may optimize or change. `f` then is a
            function of x, u and p (np,), in the mapping's order.

    Raises:
        InputError: `f` is not such a function, with a description of the fault, or a limit or name does not fit.
        ShapeError: `f` does not return nx rates.
        GradientError: the result of `f` has no derivatives.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0] - 0.5 * x[1]], nx=2, nu=1, u_lower=[-5], u_upper=[5])
        >>> f, A, B = block.derivatives([0.0, 1.0], [2.0])
        >>> f.tolist(), A.tolist(), B.tolist()
        ([1.0, 1.5], [[0.0, 1.0], [0.0, -0.5]], [[0.0], [1.0]])
    """

    def __init__(
        self,
        f: Any,
        nx: int,
        nu: int,
        *,
        x_lower: Any = None,
        x_upper: Any = None,
        u_lower: Any = None,
        u_upper: Any = None,
        state_names: Sequence[str] | None = None,
        input_names: Sequence[str] | None = None,
        parameters: Mapping[str, Any] | ParameterVector | None = None,
    ):
        self.nx, self.nu = positive_int("nx", nx), count("nu", nu, 0)
        self.model: Model | None = None  # the model that defines the states, if any
        self.drake: DrakeSystem | None = None  # the system of `from_system`
        self.default_state = frozen(np.zeros(self.nx))
        self.state_names = _names("state_names", state_names, "x", self.nx)
        self.input_names = _names("input_names", input_names, "u", self.nu)
        self.bounds = Bounds(*(frozen(np.full(n, v)) for n in (self.nx, self.nu) for v in (-np.inf, np.inf)))
        self.bounds = self.limits(Bounds(x_lower, x_upper, u_lower, u_upper))
        given = isinstance(parameters, ParameterVector)
        self.parameters: ParameterVector = (
            parameters if isinstance(parameters, ParameterVector) else plain_parameters(parameters or {})
        )
        if hasattr(f, "linearize"):
            if self.parameters.names and not given:
                raise InputError("parameters", got="given", expected="a function f(x, u, p) that uses them")
            self.form = f
            return
        inputs, f = self.nu, user_function("dynamics", f, (self.nx,))
        by_knot = (lambda x, z: f(x, z[:inputs], z[inputs:])) if self.parameters.names else f
        self.form = Pointwise("dynamics", by_knot, self.nx, (self.nx,), self.whole(self.probe()))

    @staticmethod
    def from_system(system: Any, *, context: Any = None, input_ports: Sequence[str] | None = None) -> "Dynamics":
        """Return the dynamics of a Drake System, with derivatives by its scalar conversion to AutoDiffXd.

        A system of discrete states becomes an `optimize.DiscreteMap`. A plan in continuous time is also simulated from
        each knot to the next by Drake's `Simulator`, with the events of the system. For the plan to have replays under
        contact, certificates of steps, parameters and pages, use `load_model` or `model_from_diagram` instead.

        Args:
            system: a System with `ToAutoDiffXd`: a plant of `pydrake.examples`, a `MultibodyPlant`, a Diagram with
                exported inputs, or a Python `LeafSystem_[T]`.
            context: a context of `system` with the values of its parameters and of its default state; its default
                context if not given.
            input_ports: names of the vector input ports that are u, in this order. By default, all that are not
                connected in `context`. For a `MultibodyPlant`, only "actuation".

        Raises:
            InputError: the system has no state or several kinds of states, its rates change in time, or an input port
                is not a vector.
            GradientError: the system cannot be converted to AutoDiffXd.

        Example:
            >>> from pydrake.examples import PendulumPlant
            >>> pendulum = dd.Dynamics.from_system(PendulumPlant())
            >>> pendulum.state_names, pendulum.input_names
            (('x0', 'x1'), ('tau',))
            >>> pendulum([0.0, 0.0], [0.25]).round(6).tolist()
            [0.0, 1.0]
        """
        drake = DrakeSystem(system, context, input_ports)
        kind = DiscreteMap if drake.is_discrete else Dynamics
        dynamics = kind(drake.evaluate, len(drake.state), drake.nu, **drake.names_and_limits())
        dynamics.drake, dynamics.default_state = drake, frozen(drake.state)
        return dynamics

    def __repr__(self) -> str:
        states, inputs = ", ".join(self.state_names), ", ".join(self.input_names)
        named = f" with the parameters {', '.join(self.parameters.names)}" if self.parameters.names else ""
        return f"Dynamics of the states {states} under the inputs {inputs}{named}"

    def __call__(self, x: Any, u: Any) -> Array:
        """Return the rates (nx,) at `x` (nx,), `u` (nu,)."""
        return np.asarray(self.values(self._knot(x, u))[0])

    def derivatives(self, x: Any, u: Any) -> tuple[Array, Array, Array]:
        """Return f (nx,), A = df/dx (nx, nx) and B = df/du (nx, nu) at `x` (nx,), `u` (nu,)."""
        values, rows = self.linearize(self._knot(x, u))
        return values[0], rows[0][:, : self.nx], rows[0][:, self.nx :]

    def at(self, values: Any) -> "Dynamics":
        """Return the same dynamics with the parameter values `values` (np,)."""
        moved = copy.copy(self)
        moved.parameters = self.parameters.at(values)
        return moved

    def with_parameters(self, given: Any) -> "Dynamics":
        """Return the dynamics with only the parameters in `given`, at its values if any. Others become constant."""
        parameters = self.parameters
        if isinstance(given, ParameterVector):
            given = given.to_dict()
        names = (given,) if isinstance(given, str) else tuple(given)
        if not names:
            return self.of_no_parameters if parameters.names else self
        if not parameters.names:
            expected = "no parameters with these dynamics; see Dynamics(f, ..., parameters={name: value})"
            raise InputError("parameters", got=", ".join(map(str, names)), expected=expected)
        for name in names:
            if name not in parameters.names:
                raise UnknownNameError("parameter", got=name, known=parameters.names)
        if len(set(names)) < len(names):
            raise InputError("parameters", got=", ".join(names), expected="each name once")
        values = given if isinstance(given, Mapping) else {name: parameters.to_dict()[name] for name in names}
        dynamics, indices = copy.copy(self), {name: i for i, name in enumerate(names)}
        dynamics.parameters = plain_parameters({name: np.ravel(values[name])[0] for name in names})
        if names != parameters.names:
            dynamics.form = self._chosen(lambda p: [p[indices[n]] if n in indices else v for n, v in self._named])
        return dynamics

    @property
    def of_no_parameters(self) -> "Dynamics":
        """The dynamics with all parameters as constants."""
        dynamics = copy.copy(self)
        dynamics.parameters, values = plain_parameters({}), self.parameters.values
        dynamics.form = self._chosen(lambda p: values)
        return dynamics

    @property
    def _named(self) -> list[tuple[str, float]]:
        return list(zip(self.parameters.names, self.parameters.values.tolist(), strict=True))

    def _chosen(self, whole: Callable[[Any], Any]) -> Any:
        """Return the form for other parameters p, where `whole` computes all parameters of these dynamics from p."""
        f, nu = self.form.f, self.nu
        form = copy.copy(self.form)
        form.takes_columns, form.compiled = False, None  # both are of the earlier arguments
        form.f = lambda x, z: f(x, np.concatenate([z[:nu], np.array(whole(z[nu:]))]))
        return form

    def values(self, knots: Array) -> Array:
        """Return the rates (K, nx) at `knots` (K, nx + nu), rows [x, u]."""
        return np.asarray(self.form.values(self.whole(knots)))

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """Return the rates (K, nx) and their Jacobians [A, B] (K, nx, nx + nu) at `knots` (K, nx + nu)."""
        values, rows = self.form.linearize(self.whole(knots))
        return values, rows[:, :, : self.nx + self.nu]

    def whole(self, knots: Array) -> Array:
        """Append the parameters' values to `knots` (K, nx + nu), which results in (K, nx + nu + np)."""
        values = self.parameters.values
        return np.hstack([knots, np.tile(values, (len(knots), 1))]) if len(values) else knots

    def probe(self) -> Array:
        """Return knots (3, nx + nu) within the bounds, to check a function at."""
        return probe_within(self.bounds)

    def limits(self, given: Bounds | None) -> Bounds:
        """Return `given`, checked, with these dynamics' own bounds for missing entries."""
        return resolve_bounds(given, vars(self.bounds), self.state_names, self.input_names)

    def _knot(self, x: Any, u: Any) -> Array:
        return np.concatenate([finite_array("x", x, (self.nx,)), finite_array("u", u, (self.nu,))])[None]


class DiscreteMap(Dynamics):
    """A map x_(k+1) = f(x_k, u_k), or f(x_k, u_k, k), with exact derivatives, as the system of a `Problem`.

    Its time is the step index. The cost is sum_k running_cost(x_k, u_k) + final_cost(x_N), or running_cost(x, u, t) at
    t = k. `f` may include events at known steps, such as a reset, because k is a plain whole number.

    Args:
        f: a function of x (nx,), u (nu,) and, if it has a third argument, the step k, that returns the nx next states.
            The rules for the `f` of `Dynamics` apply; it may branch on k.
        nx, nu: numbers of states and inputs.
        x_lower, x_upper, u_lower, u_upper, state_names, input_names: as for `Dynamics`.

    Raises:
        InputError, ShapeError, GradientError: as for `Dynamics`.

    Example:
        >>> saved = dd.optimize.DiscreteMap(lambda x, u, k: [1.1 * x[0] - u[0] + (5.0 if k == 2 else 0.0)], nx=1, nu=1)
        >>> [float(saved.values([[10.0, 1.0]], [k])[0, 0]) for k in (0, 2)]
        [10.0, 15.0]
    """

    def __init__(self, f: Any, nx: int, nu: int, **limits: Any):
        self.counts = arguments_of(f) > 2
        self.f = f = user_function("dynamics", f, (nx,))
        self.steps: dict[int, Pointwise] = {}
        super().__init__((lambda x, u: f(x, u, 0)) if self.counts else f, nx, nu, **limits)

    def __repr__(self) -> str:
        return super().__repr__().replace("Dynamics", "DiscreteMap", 1)

    def at_step(self, k: int) -> Any:
        """Return the map of step `k`, with the methods `values` and `linearize`."""
        if not self.counts:
            return self.form
        if k not in self.steps:
            self.steps[k] = Pointwise(
                f"dynamics at step {k}", lambda x, u: self.f(x, u, k), self.nx, (self.nx,), self.probe()
            )
        return self.steps[k]

    def values(self, knots: Array, steps: Any = None) -> Array:
        """Return the next states (K, nx) at `knots` (K, nx + nu), rows [x, u], for `steps` (K,), by default step 0."""
        knots = np.asarray(knots, dtype=float)
        states = np.empty((len(knots), self.nx))
        for k, rows in self._by_step(len(knots), steps):
            states[rows] = self.at_step(k).values(knots[rows])
        return states

    def linearize(self, knots: Array, steps: Any = None) -> tuple[Array, Array]:
        """Return the next states (K, nx) and their Jacobians [A, B] (K, nx, nx + nu); see `values`."""
        knots = np.asarray(knots, dtype=float)
        states, slopes = np.empty((len(knots), self.nx)), np.empty((len(knots), self.nx, self.nx + self.nu))
        for k, rows in self._by_step(len(knots), steps):
            states[rows], slopes[rows] = self.at_step(k).linearize(knots[rows])
        return states, slopes

    def _by_step(self, count: int, steps: Any) -> Iterator[tuple[int, Any]]:
        """Yield each step and its rows."""
        if steps is None or not self.counts:
            yield 0, slice(None)
            return
        every = np.asarray(steps)
        for k in np.unique(every):
            yield int(k), np.flatnonzero(every == k)


class MovedDynamics:
    """x' = f(x, u, p) at knots [x, u, c], where c (np,) are a solver's coordinates of the parameters."""

    def __init__(self, dynamics: Dynamics, coordinates: ParameterCoordinates):
        self.dynamics, self.coordinates = dynamics, coordinates
        self.width = dynamics.nx + dynamics.nu

    def values(self, knots: Array) -> Array:
        """Return the rates (K, nx) at `knots` (K, nx + nu + np)."""
        return np.asarray(self.dynamics.form.values(self._by_values(knots)))

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        """Return the rates (K, nx) and their Jacobians (K, nx, nx + nu + np)."""
        values, rows = self.dynamics.form.linearize(self._by_values(knots))
        rows = np.array(rows)
        for k, c in enumerate(knots[:, self.width :]):
            rows[k][:, self.width :] = self.coordinates.pull_back(c, rows[k][:, self.width :])
        return values, rows

    def probe(self) -> Array:
        """Return knots (3, nx + nu + np) to check a function at."""
        knots, start = self.dynamics.probe(), self.coordinates.start
        tail = self.coordinates.from_values(np.array(start.values))
        return np.hstack([knots, tail + 0.1 * np.linspace(0, 1, len(knots))[:, None] * np.where(tail == 0, 1.0, tail)])

    def tried_at(self, c: Array) -> tuple[Array, Array]:
        """Return coordinates (np,) near `c` at which differences verify derivatives, and the scale of each.

        A parameter that must not be negative in Drake varies in proportion to its own positive value.
        """
        coordinates, sizes = np.array(c), np.maximum(1.0, np.abs(c))
        for parameter, s in self.coordinates.start.pairs:
            if parameter.kind.positive:
                coordinates[s] = sizes[s] = np.maximum(c[s], SMALLEST_TRIED)
        return coordinates, sizes

    def _by_values(self, knots: Array) -> Array:
        values = [self.coordinates.to_values(c) for c in knots[:, self.width :]]
        return np.hstack([knots[:, : self.width], values])


def plant_dynamics(model: Model, parameters: Any = ()) -> Dynamics:
    """Return a model's equations of motion in continuous time, with its limits of positions, velocities and efforts.

    Args:
        model: a model without PD control and without constraints other than closed loops. Contact is omitted.
        parameters: the parameters of the dynamics: names of the model's parameters, or a mapping from names to values.

    Returns:
        `Dynamics` of x = [q; v] (nx,) under the actuation u (nu,), in the model's units.

    Raises:
        ModelError: the model has no continuous form.
        InputError: a parameter belongs to contact, which is omitted.

    Example:
        >>> dynamics = dd.optimize.plant_dynamics(dd.load_model("models/pendulum.urdf", time_step=0.01))
        >>> dynamics([0.0, 1.0], [0.0]).round(3).tolist()  # its speed, and damping 0.1 over an inertia of 0.25
        [1.0, -0.4]
    """
    vector = select(model, parameters)
    for parameter in vector.parameters:
        if parameter.kind in CONTACT_KINDS:
            expected = "a parameter that does not belong to contact, which collocation ignores"
            raise InputError("parameters", got=parameter.name, expected=expected)
    form: Any
    if model.file_facts.held_points and not vector.parameters:
        from drake_diff.mechanics.fixed_contacts import loop_plant  # loads CasADi

        form = loop_plant(model)
    else:
        form = PlantKnots(model, vector)
    return Dynamics(
        form,
        model.nx,
        model.nu,
        parameters=vector,
        **plant_limits(model),
        state_names=model.state_names,
        input_names=model.input_names,
    )


class PlantKnots:
    """The equations of motion at many knots, with exact derivatives.

    With r the residual of inverse dynamics at acceleration a, da = -M^-1 dr. A tree of revolute and prismatic joints
    gives this for all knots in one call, AutoDiffXd for others. Knots [x, u, p] have parameters p, equal or not.
    """

    def __init__(self, model: Model, vector: ParameterVector):
        self.equations, self.model, self.vector = EquationsOfMotion(model), model, vector
        self.tree = None if vector.parameters else tree_for(model)
        self.may_jump = self.equations.systems and not model.body_forces
        self.width = model.nx + model.nu

    def values(self, knots: Array) -> Array:
        if not self.vector.parameters:
            return self.equations.values(knots)
        values = np.full((len(knots), self.model.nx), np.nan)
        for rows, vector in self._alike(knots):
            with applied(vector):
                values[rows] = self.equations.values(knots[rows, : self.width])
        return values

    def _alike(self, knots: Array) -> Iterator[tuple[Any, ParameterVector]]:
        """Yield the rows of knots with equal parameters, without knots whose parameters Drake rejects."""
        every, group = np.unique(knots[:, self.width :], axis=0, return_inverse=True)
        for i, values in enumerate(every):
            lower = np.concatenate([np.full(len(p.value), p.lower) for p in self.vector.parameters])
            if np.all(np.isfinite(values)) and np.all(values >= lower):
                yield np.flatnonzero(np.ravel(group) == i), self.vector.at(values)

    def linearize(self, knots: Array) -> tuple[Array, Array]:
        if self.vector.parameters:
            values = np.full((len(knots), self.model.nx), np.nan)
            rows = np.full((len(knots), self.model.nx, knots.shape[1]), np.nan)
            for alike, vector in self._alike(knots):
                with applied(vector):
                    for k in alike:
                        values[k], rows[k] = self._linearize(knots[k])
            return values, rows
        if self.tree is None:
            pairs = [self._linearize(k) for k in knots]
            return np.array([value for value, _ in pairs]), np.array([rows for _, rows in pairs])
        n, actuation = self.model.nv, self.equations.actuation
        q, values = knots[:, :n], self.values(knots)
        d = self.tree(q, values[:, :n], values[:, n:])
        by_u = np.broadcast_to(-actuation, (len(knots), *actuation.shape))
        rows = np.zeros((len(knots), 2 * n, knots.shape[1]))
        rows[:, :n, n : 2 * n] = np.eye(n)
        rows[:, n:] = -np.linalg.solve(d.mass, np.concatenate([d.by_q, d.by_v, by_u], axis=2))
        return values, rows

    def _linearize(self, knot: Array) -> tuple[Array, Array]:
        """Linearize at a knot [x, u, p], whose parameters are applied."""
        variables, nx = InitializeAutoDiff(knot).ravel(), self.model.nx
        if len(knot) > self.width:
            write_autodiff(self.vector, self.model, variables[self.width :])
        rates = self.equations.autodiff(variables[:nx], variables[nx : self.width])
        return ExtractValue(rates.reshape(-1, 1)).ravel(), gradient_rows(rates, len(knot))


def _names(subject: str, given: Sequence[str] | None, letter: str, count: int) -> tuple[str, ...]:
    names = tuple(f"{letter}{i}" for i in range(count)) if given is None else tuple(given)
    if len(names) != count or isinstance(given, str):
        raise InputError(subject, got=given, expected=f"{count} names")
    return names


# Functions for coordinates by name: users' names and their places in the state and the input.


def coordinates(system: Model | Dynamics, subject: str, given: Mapping[str, Any]) -> dict[int, Any]:
    """Convert names to places in the state; see `places_of` and `by_place`."""
    return by_place(subject, places_of(system), given)


def by_place(subject: str, known: Mapping[str, int], given: Mapping[str, Any]) -> dict[int, Any]:
    """Convert the names of `given` to the places that are `known` for them.

    Raises UnknownNameError for an unknown name, and InputError if two names have the same place.
    """
    values = dict[int, Any]()
    for name, value in given.items():
        if name not in known:
            raise UnknownNameError(subject, got=name, known=known)
        if known[name] in values:
            other = next(n for n in given if known[n] == known[name])
            raise InputError(
                subject, got=f"{other} and {name}", expected="one of the two names, as both are the same coordinate"
            )
        values[known[name]] = value
    return values


def places_of(system: Model | Dynamics) -> dict[str, int]:
    """Return the place in the state of each state name, and of the name of each joint with one position."""
    places = {name: i for i, name in enumerate(system.state_names)}
    model = system if isinstance(system, Model) else system.model
    if model is not None:
        for name, joint in labelled(joints(model.plant)).items():
            positions, _ = model.places(joint)
            if joint.num_positions() == 1 and len(positions) == 1:  # excludes a joint that is coupled to another
                places.setdefault(name, positions[0])
    return places


def state_of(system: Model | Dynamics, subject: str, given: Any, elsewhere: Array) -> Any:
    """Convert a mapping from names to values to a state (nx,), with `elsewhere` for other entries, or return it."""
    if not isinstance(given, Mapping):
        return given
    state = np.array(elsewhere, dtype=float)
    for i, value in coordinates(system, subject, given).items():
        state[i] = array_with_gaps(f"{subject}, {system.state_names[i]}", value, ())
    return state


def bounds_of(system: Model | Dynamics, given: Any) -> Any:
    """Convert a mapping from names to (lower, upper), with None for no bound, to `Bounds`. Return other values as is.

    A name belongs to a coordinate or, if no such coordinate exists, to an input.
    """
    if not isinstance(given, Mapping):
        return given
    places, inputs = places_of(system), {name: i for i, name in enumerate(system.input_names)}
    sides = {f"{kind}_{side}": np.full(n, np.nan) for kind, n in (("x", system.nx), ("u", system.nu)) for side in SIDES}
    for name, pair in given.items():
        if name not in places and name not in inputs:
            raise UnknownNameError("bounds", got=name, known=[*places, *inputs])
        if not (isinstance(pair, (tuple, list)) and len(pair) == 2):
            raise InputError(
                f"bounds of {name}", got=repr(pair)[:80], expected="(lower, upper), with None for no bound"
            )
        kind, index = ("x", places[name]) if name in places else ("u", inputs[name])
        for side, value in zip(SIDES, pair, strict=True):
            if value is not None:
                bound = array_with_gaps(f"bounds of {name}", value, ())
                if np.isnan(bound):
                    raise InputError(f"bounds of {name}", got=repr(pair)[:80], expected="numbers, or None for no bound")
                sides[f"{kind}_{side}"][index] = bound
    return Bounds(**sides)


def vectors_of(model: Model) -> list[tuple[Indices, Indices, float, bool]]:
    """Return each joint's places of translation or rotation and of its rate, its size, and whether it rotates.

    The entries of each are one quantity, whose moving entries depend on the axes. The natural size is a radian, or the
    radius of gyration [m] of the body that the joint moves, or of the largest one if that body has no mass.
    """
    vectors, units = list[tuple[Indices, Indices, float, bool]](), [c.unit for c in model.contract.positions]
    rates = [c.unit for c in model.contract.velocities]
    for joint in joints(model.plant):
        q, v = model.places(joint)
        for turns in (True, False):
            places = [i for i in q if (units[i] != "m") == turns]
            moving = [model.nq + i for i in v if (rates[i] != "m/s") == turns]
            if places and moving:
                size = 1.0 if turns else _moved_size(model, joint)
                vectors.append((np.array(places), np.array(moving), size, turns))
    return vectors


def _moved_size(model: Model, joint: Any) -> float:
    moved = [model.plant.get_body(i) for i in model.plant.GetBodiesKinematicallyAffectedBy([joint.index()])]
    return radius_of_gyration(joint.child_body()) or max(map(radius_of_gyration, moved), default=0.0)


def probe_within(b: Bounds) -> Array:
    """Return knots (3, nx + nu) within bounds, to check a function at."""
    lower, upper = np.concatenate([b.x_lower, b.u_lower]), np.concatenate([b.x_upper, b.u_upper])
    return np.clip(np.random.default_rng(0).uniform(0.5, 1.5, (PROBED, len(lower))), lower, upper)


def units_of(problem: Any) -> tuple[str, ...]:
    """Return the units (nx + nu,) of the states and inputs of a `Problem`."""
    if problem.moved is None:
        return (UNKNOWN,) * (problem.nx + problem.nu)
    contract = problem.moved.contract
    return tuple(c.unit for c in contract.positions + contract.velocities + contract.inputs)
