"""Constraints that join several knots of a motion: general couplings, periodic motions, and limits of rates.

`Coupling.bound` returns a `BoundCoupling`, one `Constraint` on the concatenated states, and inputs, of its knots, so
that every method can treat it as an ordinary constraint. A limit on accelerations, or on the rate of inputs or
accelerations, bounds x' or the slopes of the input or of x' within each interval of a motion in continuous time. In
discrete motions, inputs change from one step to the next, and the acceleration is (v_(k+1) - v_k) / h.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices, finite_array, positive_float
from drake_diff.exceptions import InputError
from drake_diff.model.model import Model
from drake_diff.model.plant import joints, labelled
from drake_diff.optimize.problem.constraint import Constraint, Described, arguments_of, short
from drake_diff.optimize.problem.dynamics import DiscreteMap, Dynamics, by_place

FORM = "a function of the states at its knots, or of the states and inputs at its knots, that returns numbers (m,)"


class Couples(Described):
    """The base of all constraints that join several knots. It holds plain values and functions, and no problem."""

    name: str

    @property
    def label(self) -> str:
        """The name in messages."""
        return self.name


class Joins(Couples):
    """The base of constraints that join selected knots."""

    def bound(self, num_steps: int, nx: int, nu: int, *, input_at_end: bool) -> "BoundCoupling":
        """Return the constraint on a motion of `num_steps` intervals. Raises InputError for absent knots or entries.

        A discrete method has no input at the last knot, collocation has one (`input_at_end`).
        """
        raise NotImplementedError


@dataclass(frozen=True, eq=False)
class BoundCoupling:
    """lower <= rows(x, u) <= upper at K places, where x are the concatenated states and u the inputs at its knots.

    `knots` (K, n) are the knots of each place, from 0 to N, with the last knot of a place in the last column.
    """

    rows: Constraint
    knots: Indices

    @property
    def label(self) -> str:
        """The name in messages."""
        return self.rows.label

    @property
    def takes_input(self) -> bool:
        """Whether it also joins inputs."""
        return self.rows.takes_input

    def packed(self, xs: Array, us: Array, knots: Indices) -> tuple[Array, Array]:
        """Return the (x, u) of `rows` at the rows `knots` (n,) of a motion xs (M+1, nx), us (M, nu) or (M+1, nu)."""
        return xs[knots].ravel(), us[np.minimum(knots, len(us) - 1)].ravel()

    def excess(self, xs: Array, us: Array, where: Indices) -> tuple[float, int]:
        """Return the largest excess over a bound and the row of its place's last knot. It is inf if a value is NaN.

        The rows `where` (N+1,) of the motion are the problem's knots.
        """
        if not len(self.knots):
            return 0.0, 0
        with np.errstate(all="ignore"):
            return max(
                (self.rows.excess(*self.packed(xs, us, where[knots])), int(where[knots[-1]])) for knots in self.knots
            )

    def scales(self, xs: Array, us: Array, spans: Array) -> Array:
        """Return the change (m,) of the values if states and inputs change by `spans` (nx + nu,) along a motion."""
        if not len(self.knots):
            return np.zeros(len(self.rows.lower))
        states, inputs = zip(*(self.packed(xs, us, knots) for knots in self.knots), strict=True)
        pair = np.split(spans, [xs.shape[1]])
        sides = [np.tile(side, self.knots.shape[1]) for side in pair]
        return self.rows.scales(np.array(states), np.array(inputs), np.concatenate(sides))

    def reach(self, xs: Array, us: Array) -> float:
        """Return a tolerance's scale, the largest range of a value as the last knot of a place moves along a motion."""
        values = []
        with np.errstate(all="ignore"):
            if len(self.knots) > 1:
                values = [self.rows(*self.packed(xs, us, knots)) for knots in self.knots]
            else:
                values = [self.rows(*self.packed(xs, us, np.append(self.knots[0, :-1], k))) for k in range(len(xs))]
        table = np.array(values)
        return float(np.max(np.ptp(table[np.isfinite(table).all(axis=1)], axis=0), initial=0.0))


@dataclass(frozen=True, eq=False, repr=False)
class Coupling(Joins):
    """A constraint of a `Problem` that joins several knots: lower <= function(x_a, x_b, ...) <= upper.

    Collocation and shooting support it. A given first state, input or waypoint is a constant in it.

    Args:
        function: Takes the states (nx,) at the `knots`, in their order, and returns a number or (m,) numbers. With
            twice as many arguments it also takes the inputs (nu,) at the knots, after the states. It uses ordinary
            arithmetic and NumPy functions that support AutoDiffXd.
        knots: Two or more whole numbers 0 ... N, where negative ones count from the end. A discrete method has no input
            at knot N, so that for a function of inputs -1 means knot N-1.
        lower: A number or (m,) numbers; no limit if None.
        upper: The same; one of the two must be given.
        name: The name in messages; by default the function's own name.

    Raises:
        InputError: No function, no limit, limits that cross, or knots that the Problem does not have.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> there = dd.optimize.Coupling(lambda a, b: b[0] - a[0], knots=(5, 15), lower=0.4, upper=0.4, name="way")
        >>> effort = dd.QuadraticCost(R=[[1.0]])
        >>> problem = dd.Problem(
        ...     block, x0=[0, 0], x_goal=[1, 0], num_steps=20, horizon=1.0, running_cost=effort, couplings=there
        ... )
        >>> solution = dd.solve(problem)
        >>> solution.success, round(float(solution.xs[15, 0] - solution.xs[5, 0]), 6)
        (True, 0.4)
    """

    function: Callable[..., Any]
    knots: Any = (0, -1)
    lower: Any = None
    upper: Any = None
    name: str = ""

    def __post_init__(self) -> None:
        if not callable(self.function):
            raise InputError("Coupling.function", got=type(self.function).__name__, expected=FORM)
        knots = np.asarray(self.knots)
        if knots.ndim != 1 or len(knots) < 2 or not np.issubdtype(knots.dtype, np.integer):
            raise InputError("Coupling.knots", got=repr(self.knots), expected="two or more whole numbers")
        limits = Constraint(lambda x: x, self.lower, self.upper, name=self.label)  # checks the limits
        self._set(knots=tuple(knots.tolist()), lower=limits.lower, upper=limits.upper)
        if arguments_of(self.function) not in (0, len(knots), 2 * len(knots)):  # 0: *states
            got = f"{arguments_of(self.function)} arguments for {len(knots)} knots"
            raise InputError(f"coupling {self.label}", got=got, expected=FORM)

    def __repr__(self) -> str:
        lower, upper = (short(side[0] if len(side) == 1 else side) for side in (self.lower, self.upper))
        what = "x, u" if self.takes_input else "x"
        return f"Coupling {self.label} of knots {list(self.knots)}: {lower} <= f({what}) <= {upper}"

    @property
    def label(self) -> str:
        return self.name or str(getattr(self.function, "__qualname__", type(self.function).__name__))

    @property
    def takes_input(self) -> bool:
        """Whether the function also takes the inputs."""
        return arguments_of(self.function) == 2 * len(self.knots)

    def bound(self, num_steps: int, nx: int, nu: int, *, input_at_end: bool) -> BoundCoupling:
        last = num_steps - 1 if self.takes_input and not input_at_end else num_steps
        given, wanted = np.array(self.knots), f"whole numbers from {-last - 1} to {last}, each once"
        knots = tuple((given % (last + 1)).tolist())
        if (given > last).any() or (given < -last - 1).any() or len(set(knots)) < len(knots):
            raise InputError(f"knots of coupling {self.label}", got=list(self.knots), expected=wanted)
        count, function = len(knots), self.function

        def of_states(x: Any) -> Any:
            return function(*np.split(x, count))

        def of_both(x: Any, u: Any) -> Any:
            return function(*np.split(x, count), *np.split(u, count))

        packed: Any = of_both if self.takes_input else of_states
        packed.func = function  # messages show the name of this function
        rows = Constraint(packed, self.lower, self.upper, name=self.label)
        return BoundCoupling(rows.resolved(np.zeros(count * nx), np.zeros(count * nu)), np.array([knots]))

    def to_dict(self) -> dict[str, Any]:
        sides = ([float(v) if np.isfinite(v) else None for v in side] for side in (self.lower, self.upper))
        values = dict(zip(("lower", "upper"), sides, strict=True))
        return {"Coupling": {"name": self.label, "knots": list(self.knots), **values}}


@dataclass(frozen=True, eq=False, repr=False)
class Periodic(Joins):
    """A periodic motion: x_N = M x_0 + offset, for all or some entries of the state.

    The first state is usually free, `optimize=("controls", "initial_state")`, in all entries or those of a mask. An
    `offset` displaces the repetition, as in a step of a walk or a full turn. Collocation and shooting support it.

    Args:
        M: (n, nx) the map from the first state to the entries of the last one; the identity if None. A mirror image
            swaps left and right.
        offset: (n,) the displacement, in the states' units; 0 if None.
        entries: The n periodic entries of the state, as whole numbers; all nx entries if None.

    Raises:
        InputError: Invalid values, or entries that the Problem's state does not have.
        ShapeError: Sizes that do not fit.

    Example:
        >>> spring = dd.Dynamics(lambda x, u: [x[1], u[0] - 4.0 * x[0]], nx=2, nu=1)
        >>> problem = dd.Problem(
        ...     spring, x0=[0.3, 0], num_steps=20, horizon=3.0, optimize=("controls", "initial_state"),
        ...     initial_state_mask=[False, True], running_cost=dd.QuadraticCost(R=[[1.0]]),
        ...     couplings=dd.optimize.Periodic(),
        ... )
        >>> solution = dd.solve(problem)
        >>> solution.success, bool(np.abs(solution.xs[-1] - solution.xs[0]).max() < 1e-6)
        (True, True)
    """

    M: Any = None
    offset: Any = None
    entries: Any = None
    name: str = "periodic"

    def __post_init__(self) -> None:
        entries = self.entries
        if entries is not None:
            array = np.asarray(entries)
            whole = array.ndim == 1 and len(array) and np.issubdtype(array.dtype, np.integer)
            if not whole or len(set(array.tolist())) < len(array) or np.any(array < 0):
                raise InputError("Periodic.entries", got=repr(entries)[:80], expected="whole numbers, each once")
            entries = tuple(array.tolist())
        size: Any = "n" if entries is None else len(entries)
        offset = None if self.offset is None else finite_array("Periodic.offset", self.offset, (size,))
        size = size if offset is None else len(offset)
        M = None if self.M is None else finite_array("Periodic.M", self.M, (size, "nx"))
        self._set(M=M, offset=offset, entries=entries)

    def bound(self, num_steps: int, nx: int, nu: int, *, input_at_end: bool) -> BoundCoupling:
        entries = np.arange(nx) if self.entries is None else np.array(self.entries)
        if np.max(entries) >= nx:
            raise InputError("Periodic.entries", got=entries.tolist(), expected=f"indices from 0 to {nx - 1}")
        offset = np.zeros(len(entries)) if self.offset is None else finite_array("offset", self.offset, (len(entries),))
        M = np.eye(nx)[entries] if self.M is None else finite_array("Periodic.M", self.M, (len(entries), nx))

        def apart(first: Any, last: Any) -> Any:
            """Sum over nonzero entries only, so that each row depends only on the entries that it needs."""
            moved = [sum(M[i, j] * first[j] for j in np.flatnonzero(M[i])) for i in range(len(entries))]
            return np.array([last[e] - m - offset[i] for i, (e, m) in enumerate(zip(entries, moved, strict=True))])

        coupling = Coupling(apart, lower=0.0, upper=0.0, name=self.label)
        return coupling.bound(num_steps, nx, nu, input_at_end=input_at_end)


def excess_of(couplings: Sequence[BoundCoupling], xs: Array, us: Array, where: Indices) -> dict[str, tuple[float, int]]:
    """Return the largest excess by label and the row of its last knot; see `BoundCoupling.excess`."""
    excesses: dict[str, tuple[float, int]] = {}
    for c in couplings:
        worst = c.excess(xs, us, where)
        excesses[c.label] = max(worst, excesses.get(c.label, worst))
    return excesses


System = Model | Dynamics


class RateLimit(Couples):
    """The base of `InputRate`, `Acceleration` and `Jerk`. `limit` is a number, or a mapping from names to numbers."""

    limit: Any
    of_inputs = False
    of_slopes = True  # limits the slopes of the input or of x', or else x' itself

    def __post_init__(self) -> None:
        subject, limit = f"{type(self).__name__}.limit", self.limit
        if not isinstance(limit, Mapping):
            self._set(limit=positive_float(f"{subject} [per s]", limit))
        elif not limit:
            raise InputError(subject, got="no names", expected="a limit for each name")
        else:  # in the order of a record
            self._set(limit={str(name): positive_float(f"{subject} of {name}", limit[name]) for name in sorted(limit)})

    def entries(self, system: System) -> tuple[Indices, Array]:
        """Return the limited inputs, or the limited entries of x', and their limits."""
        kind = type(self).__name__
        if isinstance(system, DiscreteMap):
            raise InputError(kind, got="a DiscreteMap", expected="a system whose time is in seconds")
        known = self._known(system)
        if not isinstance(self.limit, dict):
            if not len(known):
                raise InputError(kind, got="one limit", expected="limits by name, as plain dynamics have no velocities")
            places = sorted(set(known.values()))
            return np.array(places), np.full(len(places), self.limit)
        limits = by_place(kind, known, self.limit)
        return np.array(list(limits)), np.array(list(limits.values()))

    def of_steps(self, system: System, num_steps: int, time_step: float) -> BoundCoupling:
        """Return the constraint on a motion of `num_steps` steps of `time_step` [s]."""
        places, limits = self.entries(system)

        weights = (1.0, -2.0, 1.0) if self.of_slopes and not self.of_inputs else (-1.0, 1.0)
        knots = len(weights)

        def change(values: Any) -> Any:
            parts = zip(weights, np.split(values, knots), strict=True)
            return sum(weight * part[places] for weight, part in parts) / time_step ** (knots - 1)

        function: Any = (lambda x, u: change(u)) if self.of_inputs else (lambda x: change(x))
        count = num_steps if self.of_inputs else num_steps + 1
        rows = Constraint(function, -limits, limits, name=self.label)
        return BoundCoupling(rows, np.arange(max(count - knots + 1, 0))[:, None] + np.arange(knots))

    def _known(self, system: System) -> dict[str, int]:
        raise NotImplementedError


@dataclass(frozen=True, eq=False, repr=False)
class InputRate(RateLimit):
    """A limit on the rate of inputs: |du/dt| <= limit, or |u_(k+1) - u_k| <= limit * h for inputs held over steps.

    Collocation bounds the slope at every time, also of a quadratic input. Collocation and shooting support it.

    Args:
        limit: [input's unit per s], for all inputs; or a mapping from names of inputs to limits.

    Raises:
        InputError: A limit that is not positive.
        UnknownNameError: The Problem has no such input.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> problem = dd.Problem(
        ...     block, x0=[0, 0], x_goal=[1, 0], num_steps=20, horizon=2.0, running_cost=dd.QuadraticCost(R=[[1.0]]),
        ...     couplings=dd.optimize.InputRate(2.0),
        ... )
        >>> solution = dd.solve(problem)
        >>> solution.success, bool(np.abs(np.diff(solution.us[:, 0])).max() <= 2.0 * 0.1 + 1e-6)
        (True, True)
    """

    limit: Any
    name: str = "input rate"
    of_inputs = True

    def _known(self, system: System) -> dict[str, int]:
        return {name: i for i, name in enumerate(system.input_names)}


class _OfVelocities(RateLimit):
    """The base of limits on the derivatives of velocities."""

    def _known(self, system: System) -> dict[str, int]:
        if not isinstance(system, Model):
            return {name: i for i, name in enumerate(system.state_names)} if isinstance(self.limit, dict) else {}
        indices = {name: system.nq + i for i, name in enumerate(system.velocity_names)}
        for name, joint in labelled(joints(system.plant)).items():
            _, velocities = system.places(joint)
            if joint.num_velocities() == 1 and len(velocities) == 1:  # excludes a joint that is coupled to another
                indices.setdefault(name, system.nq + velocities[0])
        return indices


@dataclass(frozen=True, eq=False, repr=False)
class Acceleration(_OfVelocities):
    """A limit on accelerations: |dv/dt| <= limit, or |v_(k+1) - v_k| <= limit * h in steps.

    In collocation dv/dt is the polynomial of its scheme. The verdict uses the accelerations of the dynamics between the
    knots. Collocation and shooting support it.

    Args:
        limit: [velocity's unit per s], for all velocities of a model; or a mapping to limits from names of velocities,
            or of joints with one velocity. For plain dynamics, a name is that of a state with a limited x'.

    Raises:
        InputError: A limit that is not positive.
        UnknownNameError: The Problem has no such velocity.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> problem = dd.Problem(
        ...     block, x0=[0, 0], x_goal=[1, 0], num_steps=20, horizon=(0.5, 5.0), running_cost=1.0,
        ...     couplings=dd.optimize.Acceleration({"x1": 4.0}),
        ... )
        >>> solution = dd.solve(problem)
        >>> solution.success, round(solution.cost, 2)  # 2 sqrt(1 / 4)
        (True, 1.0)
    """

    limit: Any
    name: str = "acceleration"
    of_slopes = False


@dataclass(frozen=True, eq=False, repr=False)
class Jerk(_OfVelocities):
    """A limit on the rate of accelerations: |dv'/dt| <= limit, or |v_(k+2) - 2 v_(k+1) + v_k| <= limit * h^2 in steps.

    In collocation v' is the polynomial of its scheme, whose slope is bounded at every time. The verdict uses the
    accelerations of the dynamics between the knots. Collocation and shooting support it.

    Args:
        limit: [velocity's unit per s^2], for all velocities of a model; or a mapping to limits from names of
            velocities, or of joints with one velocity. For plain dynamics, a name is that of a state with a limited x'.

    Raises:
        InputError: A limit that is not positive.
        UnknownNameError: The Problem has no such velocity.

    Example:
        >>> block = dd.Dynamics(lambda x, u: [x[1], u[0]], nx=2, nu=1)
        >>> problem = dd.Problem(
        ...     block, x0=[0, 0], x_goal=[1, 0], num_steps=20, horizon=2.0, running_cost=dd.QuadraticCost(R=[[1.0]]),
        ...     couplings=dd.optimize.Jerk({"x1": 2.0}),
        ... )
        >>> dd.solve(problem).success
        True
    """

    limit: Any
    name: str = "jerk"
