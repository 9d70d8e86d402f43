"""Evaluate displaced rollouts for a certificate, and check the loss and the policy separately.

A rollout's gradient includes the derivative of u = policy(x, t). It is wrong if the policy depends on earlier calls,
because the derivative with respect to the policy's memory is missing, and if the policy's own derivative is wrong.
Calls of the policy alone show both faults. Rollouts show their effect on the gradient.

A loss or a policy may be a staircase: rounding, a table or an integer make it flat, or nearly flat, between jumps. Its
derivative is correct but useless, and differences of rollouts miss the jumps of wide stairs. The function alone can be
evaluated far from the trajectory at little cost, over lengths from 1e-4 to 10 times the scale, along one line and, for
a policy, along each state. A single jump of a policy (a switch) matters only if the trajectory passes it.
"""

import pickle
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from io import BytesIO
from types import CellType, FunctionType, MethodType
from typing import Any

import cloudpickle
import numpy as np

from drake_diff._base.arrays import Array, Indices, finite_array
from drake_diff._base.differences import central_differences
from drake_diff.certificates.certify import move, solved, solver_tolerance, state_scale
from drake_diff.certificates.differences import line
from drake_diff.derivatives.refine_step import refine_steps
from drake_diff.derivatives.sources import PARITY_TOLERANCE
from drake_diff.exceptions import GradientError
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, applied
from drake_diff.model.plant import actuators
from drake_diff.model.step import advance
from drake_diff.model.tangent import TangentSpace, tangent_space
from drake_diff.motion.gradient import RolloutGradient, differentiate_rollout
from drake_diff.motion.loss import Loss, evaluate_loss
from drake_diff.motion.policy import ParametricPolicy, active_parameters, differentiate_policy, policy_parameters

WIDEST = 0.25  # relative to the scale of a state or a parameter: largest displacement in differences
MANY = 256  # number of rollouts whose steps are solved in one call
Point = tuple[Array, Array, Array, ParameterVector]  # x0 (nx,), us (N, nu), the policy's parameters, the model's


@dataclass(frozen=True, eq=False)
class DisplacedDirection:
    """A direction in which a rollout is displaced: a column of its gradient, or an input equally at all times."""

    name: str
    columns: Indices  # of the gradient, whose sum is the slope along the direction
    scale: float
    vector: Array  # (n,) displacement per unit of the direction
    room: float  # largest displacement in differences, in the unit of the direction


@dataclass(frozen=True, eq=False)
class Displaced:
    """A rollout of N steps under `us` (N, nu), or under `policy`, and all variables of its gradient.

    A displacement (n,) is [x0 on the tangent space; the inputs step by step, or the policy's parameters; the model's
    parameters], each relative to `scale` (n,).
    """

    model: Model
    x0: Array
    us: Array  # (N, nu), or (N, 0) with a policy
    loss: Loss
    policy: Any
    vector: ParameterVector
    method: str

    @cached_property
    def space(self) -> TangentSpace:
        return tangent_space(self.model)

    @property
    def subject(self) -> str:
        return f"the rollout of {self.model.name}"

    @property
    def time_step(self) -> float:
        """The time step [s] that the parameters specify."""
        return self.vector.time_step(self.vector.values)

    @cached_property
    def _values(self) -> Array:
        """The displaced values (n - size,) except the state."""
        return np.concatenate([self.us.ravel(), policy_parameters(self.policy), self.vector.values])

    @cached_property
    def scale(self) -> Array:
        """The scale (n,) of a displacement: the magnitude of the displaced values, at least 1."""
        given = self._values[: len(self._values) - len(self.vector.values)]
        steps = np.maximum(1.0, np.abs(given))
        return np.concatenate([state_scale(self.space, self.x0), steps, self.vector.difference_scale()])

    @property
    def columns(self) -> tuple[str, ...]:
        """The names (n,) of the columns."""
        inputs = tuple(f"{name}[{k}]" for k in range(len(self.us)) for name in self.model.input_names)
        if self.policy is not None:
            inputs = tuple(f"policy[{i}]" for i in range(len(policy_parameters(self.policy))))
        return tuple(f"{name}[0]" for name in self.space.names) + inputs + self.vector.names

    @property
    def kinds(self) -> Indices:
        """The kind (n,) of each column: positions, velocities, each input, the policy's, each model parameter."""
        of_x0 = [0] * self.model.nv + [1] * self.model.nv
        given = [2 + i for _ in self.us for i in range(self.us.shape[1])] + [2] * len(policy_parameters(self.policy))
        first = 2 + max(1, self.us.shape[1])
        of_model = [first + i for i, p in enumerate(self.vector.parameters) for _ in p.value]
        return np.array([*of_x0, *given, *of_model], dtype=np.intp)

    @property
    def units(self) -> list[str]:
        """The unit (n,) of each column for given inputs, which is the same for columns of the same kind."""
        contract = self.model.contract
        units = [f"position [{term.unit}]" for term in contract.positions]
        units += [f"velocity [{term.unit}]" for term in contract.velocities]
        inputs = len(self.us) * [f"input [{term.unit}]" for term in contract.inputs]
        return [u for i, u in enumerate(units) if i not in self.space.quaternions] + inputs + list(self.vector.names)

    @cached_property
    def lines(self) -> tuple[DisplacedDirection, ...]:
        """The directions of each state, each input at all times or each policy parameter, and each model parameter."""
        (count, nu), size, n = self.us.shape, self.space.size, len(self.scale)
        units, names, scales = np.eye(n) / self.scale, self.columns, self.scale.tolist()
        single = [
            DisplacedDirection(names[j], np.array([j]), scales[j], units[j], WIDEST * scales[j]) for j in range(n)
        ]
        if self.policy is not None:
            return tuple(single)
        limits = self.model.inputs.of_actuators([a.effort_limit() for a in actuators(self.model.plant)])
        cut = np.where(self.model.inputs.actuator >= 0, limits, np.inf)
        inputs = []
        for j in range(nu):
            columns, sizes = size + j + nu * np.arange(count), np.abs(self.us[:, j])
            name, room = f"{self.model.input_names[j]} at all times", float(np.abs(cut[j] - sizes).min())
            inputs.append(
                DisplacedDirection(name, columns, max(1.0, float(sizes.max())), units[columns].sum(axis=0), room)
            )
        return (*single[:size], *inputs, *single[size + count * nu :])

    def point(self, displacement: Array) -> Point:
        """Return the initial state, the inputs and the parameters at a displacement (n,)."""
        point = move(self.space, self.model.nx, np.concatenate([self.x0, self._values]), self.scale * displacement)
        sizes = self.model.nx, self.us.size, len(policy_parameters(self.policy))
        x0, us, parameters, values = np.split(point, np.cumsum(sizes))
        return x0, us.reshape(self.us.shape), parameters, self.vector.at(values)

    def gradient(self, displacement: Array) -> RolloutGradient:
        """Compute the gradient at a displacement (n,)."""
        x0, us, parameters, values = self.point(displacement)
        options: dict[str, Any] = {"parameters": values, "method": self.method}
        if self.policy is None:
            return differentiate_rollout(self.model, x0, us, self.loss, **options)
        policy = with_parameters(fresh(self.policy), parameters)
        return differentiate_rollout(self.model, x0, None, self.loss, policy=policy, num_steps=len(self.us), **options)

    def flat(self, g: RolloutGradient) -> Array:
        """Return the gradient (n,) with respect to the displaced variables, without `scale`."""
        by_x0 = g.by_x0 @ self.space.derivative_of_plus(g.xs[0])
        return np.concatenate([by_x0, g.by_us.ravel() if self.policy is None else g.by_policy, g.by_parameters])

    def losses(self, displacements: Array, policy: Any = None) -> Array:
        """Return losses (K, 1) of the double plant's rollouts at displacements (K, n). `policy` keeps its memory."""
        return np.array([[self._roll(d, policy)] for d in displacements])

    def _roll(self, displacement: Array, policy: Any) -> float:
        x0, us, parameters, values = self.point(displacement)
        ask = self.inputs(us, parameters, policy)
        xs, inputs = np.empty((len(us) + 1, self.model.nx)), np.empty((len(us), self.model.nu))
        xs[0] = x0
        with applied(values) as model:
            for k in range(len(us)):
                inputs[k] = ask(xs[k], k, model.time_step)
                xs[k + 1] = advance(model.double, xs[k], inputs[k])
        return evaluate_loss(self.loss, xs, inputs)

    def left_by_drake(self, g: RolloutGradient) -> tuple[Array, float]:
        """Return the errors (N, size) of Drake's own steps along `g`, and their largest residual.

        The residual is relative to the momentum. Raises UnsolvedError if a step cannot be solved to rounding.
        """
        with applied(self.vector) as model:
            refined = solved(refine_steps(model, self.vector, g.xs[:-1], g.us))
        return self.space.minus(refined.drake, refined.x_next), float(np.max(refined.left))

    def solved_losses(self, left: Array, displacements: Array) -> Array:
        """Return losses (K, 1) as `losses`, with every step solved to rounding and then displaced by `left` (N, size).

        `left` are the errors of Drake's own steps, so that the undisplaced rollout is Drake's own, and differences are
        those of the equation of the steps along it. Raises UnsolvedError as `left_by_drake`.
        """
        parts = np.array_split(displacements, -(-len(displacements) // MANY))
        return np.vstack([self._solved(left, chunk) for chunk in parts])

    def _solved(self, left: Array, displacements: Array) -> Array:
        count, size = len(self.us), len(displacements)
        points = [self.point(d) for d in displacements]
        asks = [self.inputs(us, parameters, None) for _, us, parameters, _ in points]
        values = np.array([vector.values for *_, vector in points])
        times = [self.vector.time_step(row) for row in values]
        xs, inputs = np.empty((size, count + 1, self.model.nx)), np.empty((size, count, self.model.nu))
        xs[:, 0] = [x0 for x0, *_ in points]
        with applied(self.vector) as model:
            for k in range(count):
                inputs[:, k] = [ask(x, k, h) for ask, x, h in zip(asks, xs[:, k], times, strict=True)]
                refined = solved(refine_steps(model, self.vector, xs[:, k], inputs[:, k], values))
                xs[:, k + 1] = self.space.plus(refined.x_next, left[k])
        return np.array([[evaluate_loss(self.loss, *motion)] for motion in zip(xs, inputs, strict=True)])

    def solver_tolerance(self, g: RolloutGradient) -> float:
        """Return the relative tolerance of Drake's steps along `g`, 0 if they are accurate to rounding."""
        with applied(self.vector) as model:
            return max(solver_tolerance(model, x, u) for x, u in zip(g.xs[:-1], g.us, strict=True))

    def inputs(self, us: Array, parameters: Array, policy: Any) -> Callable[[Array, int, float], Array]:
        """Return the function of a state, a step index and a time step [s] that computes the input (nu,)."""
        if self.policy is None:
            return lambda x, k, h: us[k]
        asked, nu = with_parameters(fresh(self.policy) if policy is None else policy, parameters), self.model.nu
        return lambda x, k, h: finite_array("policy(x, t)", asked(x.copy(), k * h), (nu,))


SHARED = ("pydrake.", "drake_diff.model.")  # packages whose objects, such as models and plants, a copy shares
REMEMBERING = (FunctionType, MethodType, CellType, partial, dict, list, tuple, set, deque, np.ndarray)


@dataclass(frozen=True)
class ProbeOptions:
    """Options for separate checks of a loss and a policy."""

    steps: tuple[float, ...] = (1e-4, 1e-6)  # of a policy's differences; a wrong derivative differs from both
    missed: float = 1e-3  # relative to the row's largest entry: error above which a derivative is wrong
    least: float = 1e-6  # relative to the input: a smaller derivative may be rounding
    asked: int = 5  # number of times along the trajectory at which the derivative is compared
    cells: int = 16  # number of intervals, both sides together
    stairs: int = 3  # least number of cells with a jump; fewer are a switch, which the trajectory may never reach
    quarterings: int = 10
    settled: int = 2  # quarterings that reduce the deviation of a smooth function to 1/256, of a corner to 1/16
    remains: float = 0.125  # part of the deviation that is left then at a jump, which keeps its size
    rounded: float = 1e-12  # relative to the largest value: a smaller jump is rounding
    spread: float = 1e-6  # relative to the range of the values: a smaller jump is ignored
    moves: float = 1e-9  # relative to the largest state: a smaller step is rounding
    single_parameters: int = 8  # number of policy parameters that are checked individually
    wide: int = 2  # number of short lengths left out for single variables, as the common line covers them
    single: float = 5e-7  # relative to an input: the resolution of single precision is no staircase


ASK = ProbeOptions()


class _Copier(cloudpickle.Pickler):  # type: ignore[misc]  # cloudpickle has no types
    """A pickler of objects that can have state: containers, arrays, closures and objects of Python classes.

    All other objects are shared with the original. `shared` contains them at the index that replaces them.
    """

    def __init__(self, file: BytesIO):
        super().__init__(file, protocol=4)  # later protocols share the buffers of arrays
        self.shared: list[Any] = []

    def persistent_id(self, thing: Any) -> int | None:
        made_by: Any = type(thing).__new__
        can_remember = isinstance(thing, REMEMBERING) or made_by is object.__new__
        if can_remember and not type(thing).__module__.startswith(SHARED):
            return None
        self.shared.append(thing)
        return len(self.shared) - 1


def fresh(policy: Any) -> Any:
    """Copy `policy` with its memory: containers, arrays and closures are copied at any depth.

    Models are shared, as are objects that are not of Python classes, and the globals of an importable module.
    """
    file = BytesIO()
    copier = _Copier(file)
    copier.dump(policy)
    file.seek(0)
    restorer = pickle.Unpickler(file)
    restorer.persistent_load = copier.shared.__getitem__  # type: ignore[method-assign]
    return restorer.load()


def with_parameters(policy: Any, parameters: Array) -> Any:
    """Return `policy` with other `parameters` (n,), or the policy itself if it has no parameters."""
    return ParametricPolicy(policy, parameters) if len(policy_parameters(policy)) else policy


def check_memory(policy: Any, g: RolloutGradient, time_step: float) -> None:
    """Raise GradientError if a policy returns another u at a state and time of `g` after other calls.

    `policy` has been called along another trajectory before. It is called from the last step to the first.
    """
    for k in reversed(range(len(g.us))):
        u, again = g.us[k], finite_array("policy(x, t)", policy(g.xs[k].copy(), k * time_step), (g.us.shape[1],))
        if not np.all(np.abs(again - u) <= PARITY_TOLERANCE * np.maximum(1.0, np.abs(u))):
            i = int(np.argmax(np.abs(again - u)))
            raise GradientError(
                f"the policy depends on earlier calls: at t = {k * time_step:g} s and the same x, u[{i}] was "
                f"{u[i]:.9g} and is {again[i]:.9g} after another motion; make it a function of x and t only"
            )


def wrong_derivative(policy: Any, space: TangentSpace, g: RolloutGradient, time_step: float) -> str:
    """Describe an error of the policy's own derivative at five times along `g`, or return "" if it is correct."""
    parameters, nu = policy_parameters(policy), g.us.shape[1]
    for k in np.unique(np.linspace(0, len(g.us) - 1, ASK.asked).astype(int)):
        x, t = g.xs[k], float(k * time_step)
        acting = np.arange(len(parameters))[active_parameters(policy, t)]
        scale = np.maximum(1.0, np.abs(parameters[acting]))
        columns = (*space.names, *(f"its parameter {i}" for i in acting))

        def moved(d: Array, x: Array = x, t: float = t, acting: Indices = acting, scale: Array = scale) -> Array:
            values = np.array(parameters)
            values[acting] += scale * d[space.size :]
            return finite_array(
                "policy(x, t)", with_parameters(policy, values)(space.plus(x, d[: space.size]), t), (nu,)
            )

        u, by_x, by_parameters = differentiate_policy(policy, x, t, nu)
        stated = np.hstack([by_x @ space.derivative_of_plus(x), by_parameters[:, acting] * scale])
        quotients = [central_differences(moved, len(columns), h) for h in ASK.steps]
        size = np.maximum(np.abs(stated), np.abs(quotients[-1])).max(axis=1, initial=0.0, keepdims=True)
        size = np.maximum(size, ASK.least * np.maximum(1.0, np.abs(u))[:, None])
        gap = np.minimum(*(np.abs(stated - some) for some in quotients)) / size
        if np.max(gap, initial=0.0) > ASK.missed:
            i, j = np.unravel_index(int(np.argmax(gap)), gap.shape)
            unit = np.concatenate([np.ones(space.size), scale])[j]
            return (
                f"the policy's derivative is wrong: at t = {t:g} s the derivative of u[{i}] with respect to "
                f"{columns[j]} is {stated[i, j] / unit:.6g}, and differences of the policy give "
                f"{quotients[-1][i, j] / unit:.6g}"
            )
    return ""


LINE = 2  # seed of the lines along which a loss or a policy is evaluated
LENGTHS = tuple(10.0**k for k in range(-4, 2))  # of the line, to each side
OUTSIDE = (ValueError, ArithmeticError, LookupError)  # errors of a function outside its domain

Jump = tuple[float, float]  # places before and after the jump


def stairs_of_loss(loss: Loss, g: RolloutGradient, space: TangentSpace) -> str:
    """Describe the jumps of the loss near the trajectory of `g`, or return "" if the loss is not a staircase."""
    by_x = line((len(g.xs), space.size), LINE)
    states = (space.derivative_of_plus(g.xs) @ by_x[..., None])[..., 0]
    inputs = line(g.us.shape, LINE)

    def along(s: float) -> float:
        return evaluate_loss(loss, g.xs + s * states, g.us + s * inputs)

    if not (jump := _stairs(along, 0.0)):
        return ""
    size = along(jump[1]) - along(jump[0])
    return (
        f"the loss is a staircase: it jumps in {jump[2]} of {ASK.cells} parts of a line through the motion, by "
        f"{size:.3g} at {jump[0]:.3g}"
    )


def stairs_of_policy(policy: Callable[..., Array], g: RolloutGradient, space: TangentSpace, time_step: float) -> str:
    """Describe the jumps of the policy near the trajectory of `g`, or return "" if it does not jump.

    A staircase is searched at three states of the trajectory, along a line and along each state and parameter. A switch
    is searched between consecutive states, and beyond the extremes of each state over its largest change in one step.
    A switch farther away has no effect.
    """
    probe = _PolicyProbe(fresh(policy), g, space, time_step)
    return next((text for text in (*probe.staircases(), *probe.switches()) if text), "")


@dataclass(frozen=True)
class _PolicyProbe:
    """Evaluations of a policy along lines through the states of `g`."""

    policy: Any
    g: RolloutGradient
    space: TangentSpace
    time_step: float

    def staircases(self) -> Iterator[str]:
        """Search staircases along a line at the first, middle and last state, and along each variable at the middle."""
        size, parameters, middle = self.space.size, policy_parameters(self.policy), len(self.g.us) // 2
        scale = np.concatenate([np.ones(size), np.maximum(1.0, np.abs(parameters))])
        through, all_parameters = np.append(line(size, LINE), 0 * parameters), np.append(np.zeros(size), 0 * parameters)
        for k in sorted({0, middle, len(self.g.us) - 1}):
            yield self._staircase(k, through, "a line through x")
        all_parameters[size:] = line(len(parameters), LINE)
        names = (*self.space.names, *(f"its parameter {i}" for i in range(len(parameters))))
        single = list(zip(np.eye(len(scale)), names, strict=True))[: size + ASK.single_parameters]
        for way, name in (*single, *[(all_parameters, "a line through its parameters")] * bool(len(parameters))):
            yield self._staircase(middle, way * scale, name, LENGTHS[ASK.wide :])

    def switches(self) -> Iterator[str]:
        """Search switches between consecutive states, and beyond the extremes of each state."""
        xs, none = self.g.xs, np.zeros(len(policy_parameters(self.policy)))
        steps = self.space.minus(xs[1:], xs[:-1])
        moves = np.max(np.abs(steps), axis=1) > ASK.moves * np.max(np.abs(xs))
        for k in np.flatnonzero(moves).tolist():
            yield self._switch(k, np.append(steps[k], none), "to the next state")
        offsets = np.cumsum(np.vstack([np.zeros((1, self.space.size)), steps]), axis=0)[:-1]
        for i, (name, reach) in enumerate(zip(self.space.names, np.max(np.abs(steps), axis=0), strict=True)):
            for sign in (1.0, -1.0) if reach > ASK.moves * np.max(np.abs(xs)) else ():
                k, way = int(np.argmax(sign * offsets[:, i])), np.zeros(self.space.size + len(none))
                way[i] = sign * reach
                yield self._switch(k, way, f"along {name} by {sign * reach:.3g}")

    def _staircase(self, k: int, way: Array, name: str, lengths: Sequence[float] = LENGTHS) -> str:
        jump = _stairs(self._along(k, way), self._least(k), lengths)
        where = f"in {jump[2]} of {ASK.cells} parts of {name}, first at {jump[0]:.3g}" if jump else ""
        return f"the policy is a staircase: {self._jump_text(k, way, jump[:2])} {where}" if jump else ""

    def _switch(self, k: int, way: Array, name: str) -> str:
        least = max(self._least(k), ASK.rounded * float(np.abs(self.g.us).max()))
        with np.errstate(all="ignore"), suppress(*OUTSIDE):
            jumps = _jumps(self._along(k, way), np.linspace(0.0, 1.0, ASK.cells // 2 + 1), least)
            if jumps:
                return f"the policy jumps: {self._jump_text(k, way, jumps[0])} on the line from this state {name}"
        return ""

    def _jump_text(self, k: int, way: Array, jump: Jump) -> str:
        change = self._u(k, way, jump[1]) - self._u(k, way, jump[0])
        i = int(np.argmax(np.abs(change)))
        return f"at t = {k * self.time_step:g} s u[{i}] changes by {change[i]:.3g}"

    def _least(self, k: int) -> float:
        return ASK.single * float(np.abs(self.g.us[k]).sum())

    def _along(self, k: int, way: Array) -> Callable[[float], float]:
        weight = line(self.g.us.shape[1], LINE)
        return lambda s: float(weight @ self._u(k, way, s))

    def _u(self, k: int, way: Array, s: float) -> Array:
        """Return u (nu,) at the displacement `s` times `way` (size + parameters,) from the state at step k."""
        by_state, by_parameters = np.split(s * way, [self.space.size])
        asked = self.policy
        if np.any(by_parameters):
            asked = with_parameters(asked, policy_parameters(asked) + by_parameters)
        return np.asarray(asked(self.space.plus(self.g.xs[k], by_state), k * self.time_step), dtype=float)


def _stairs(
    f: Callable[[float], float], least: float, lengths: Sequence[float] = LENGTHS
) -> tuple[float, float, int] | None:
    """Return the first jump of a function of one number and its number of cells with jumps, None if no staircase."""
    with np.errstate(all="ignore"):
        for length in lengths:
            try:
                jumps = _jumps(f, np.linspace(-length, length, ASK.cells + 1), least)
            except OUTSIDE:
                return None
            if len(jumps) >= ASK.stairs:
                return *jumps[0], len(jumps)
    return None


def _jumps(f: Callable[[float], float], ends: Array, least: float) -> list[Jump]:
    """Return the largest jump of a function of one number in each cell between `ends` (c + 1,) that has a jump."""
    values = np.array([f(float(s)) for s in ends])
    threshold = max(least, ASK.rounded * float(np.max(np.abs(values))), ASK.spread * float(np.ptp(values)))
    if not np.max(np.abs(np.diff(values, 3))) > threshold:  # third differences are small for a smooth f
        return []
    cells = (_jump(f, ends[i : i + 2], values[i : i + 2], threshold) for i in range(len(ends) - 1))
    return [jump for jump in cells if jump]


def _jump(f: Callable[[float], float], ends: Array, values: Array, least: float) -> Jump | None:
    """Return the jump of `f` between two places (2,), or None. The quarter that deviates most is divided again."""
    sizes: list[float] = []
    for k in range(ASK.quarterings):
        places = np.linspace(float(ends[0]), float(ends[1]), 5)
        heights = np.array([values[0], *(f(float(s)) for s in places[1:-1]), values[1]])
        changes = np.diff(heights)
        apart = np.abs(changes - np.median(changes))
        i = int(np.argmax(apart))
        sizes.append(float(apart[i]))
        if not apart[i] > least or (k == ASK.settled and apart[i] < ASK.remains * sizes[0]):
            return None
        ends, values = places[i : i + 2], heights[i : i + 2]
    return (float(ends[0]), float(ends[1])) if sizes[-1] > sizes[ASK.settled] / 2 else None
