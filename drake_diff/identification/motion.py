"""Simulation of many segments of a model's motion at once, and the derivatives of its steps.

There are three laws of motion. Continuous time uses fixed steps of the Dormand-Prince method of order 8 (Hairer,
Norsett and Wanner, "Solving Ordinary Differential Equations I", 1993, II.5) with constant inputs; the derivatives are
those of the discrete steps. A step of length 0 changes nothing, and pads segments to equal length. Semi-implicit Euler
steps, as in simulators, take damping at the end of the step:

    v' = v + h (M + h D)^-1 (forces at q, v),    q' = q + h v'

The third law is the model's own discrete steps, with contact and limits.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.comparison.recordings import CLOCK_TOLERANCE
from drake_diff.derivatives.contact.laws import QUANTITIES
from drake_diff.derivatives.step import StepDerivatives, derivatives_along
from drake_diff.exceptions import GradientError, InputError
from drake_diff.identification.recordings import Excerpt
from drake_diff.identification.tree import (
    ORDER_4,
    ORDER_8,
    SLIP_SPEED,
    Branch,
    Grip,
    Method,
    Tree,
    TreeDynamics,
    branches_of,
    undivided,
)
from drake_diff.identification.unknowns import (
    BIAS,
    COULOMB,
    Unknowns,
    numbers_at,
    set_numbers,
)
from drake_diff.mechanics.coordinates import euler_jacobian, euler_step
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameter, ParameterVector, applied, select
from drake_diff.model.step import advance
from drake_diff.motion.rollout import roll_states

MOST_PHASES = 60  # maximum number of phases of a step: a step with more is given up, and its state is NaN
SEARCHED, MET = 99, 1e-9  # iterations of the search for a phase's end; its tolerance [rad/s, m/s] or of friction
SHORT = 1e-13  # [s] width of the bracket at which the search ends for any slope


class SlidingPhase(NamedTuple):
    """A phase of some steps in which each joint slides in one direction or sticks."""

    rows: Indices  # (n,) indices of the steps
    x: Array  # (n, nx) states at its start
    h: Array  # (n,) [s]
    u: Array
    grip: Grip
    stopped: Indices  # (n,) the joint whose sliding velocity has just reached 0; -1 if none
    before: Grip  # friction in the previous phase


def step_with_friction(dynamics: TreeDynamics, x: Array, h: Array, u: Array) -> tuple[Array, list[SlidingPhase]]:
    """Return the states after steps of lengths h (N,) from x (N, nx), and the phases of the steps."""
    nv = dynamics.nv
    nq, nothing = x.shape[1] - nv, np.zeros((len(x), nv))
    x, left, phases, released = x.copy(), h.copy(), list[SlidingPhase](), nothing.copy()
    stopped, before = np.full(len(x), -1), Grip(nothing.copy(), nothing.copy())
    for _ in range(MOST_PHASES):
        rows = np.flatnonzero(left > 0)
        if not len(rows):
            break
        here, inputs = x[rows], u[rows]
        grip = dynamics.grip(here, inputs, released[rows])
        begin = _begin(dynamics, here, grip)
        lengths, ends = left[rows], dynamics.step(begin, left[rows], inputs, grip)
        room = _room(dynamics, ends, inputs, grip)
        last = np.flatnonzero(np.any(room < 0, axis=1))
        which = np.zeros(len(rows), dtype=np.intp)
        if len(last):
            some = grip.some(last)
            lengths[last], ends[last], which[last] = _end(
                dynamics, begin[last], inputs[last], some, lengths[last], room[last]
            )
            _, holding = dynamics.accelerate_and_hold(ends[last], inputs[last], some)
        phases.append(SlidingPhase(rows, here, lengths, inputs, grip, stopped[rows], before.some(rows)))
        released[rows], stopped[rows] = 0.0, -1
        before.turn[rows], before.held[rows] = grip.turn, grip.held
        left[rows] -= lengths
        for k, i in enumerate(last):
            j = which[i]
            if grip.held[i, j]:
                released[rows[i], j] = np.sign(holding[k, j])
            else:
                ends[i, nq + j], stopped[rows[i]] = 0.0, j
        left[np.delete(rows, last)] = 0.0
        x[rows] = ends
    x[left > 0] = np.nan
    return x, phases


def friction_jacobians(dynamics: TreeDynamics, x: Array, h: Array, u: Array, by: Array) -> Array:
    """Return the Jacobians (N, nx, nx + P) of these steps; `by` (count, P) is d numbers / d parameters."""
    nx = x.shape[1]
    total = np.zeros((len(x), nx, nx + by.shape[1]))
    total[:, :, :nx] = np.eye(nx)
    for phase in step_with_friction(dynamics, x, h, u)[1]:
        begin = _begin(dynamics, phase.x, phase.grip)
        through = dynamics.step_jacobians(begin, phase.h, phase.u, by, phase.grip)
        moved = through[:, :, :nx] @ _jump(dynamics, phase) @ total[phase.rows]
        moved[:, :, nx:] += through[:, :, nx:]
        total[phase.rows] = moved
    return total


def _begin(dynamics: TreeDynamics, x: Array, grip: Grip) -> Array:
    """Return x with zero velocities of the sticking joints."""
    begin = x.copy()
    begin[:, -dynamics.nv :][grip.held > 0] = 0.0
    return begin


def _room(dynamics: TreeDynamics, x: Array, u: Array, grip: Grip) -> Array:
    """Return the margins (N, nv) of sliding or sticking at x, negative if violated, infinite without friction."""
    room = np.where(grip.turn != 0, grip.turn * x[:, -dynamics.nv :], np.inf)
    some = np.flatnonzero(np.any(grip.held > 0, axis=1))
    if len(some):
        _, holding = dynamics.accelerate_and_hold(x[some], u[some], grip.some(some))
        share = 1 - np.abs(holding) / np.maximum(dynamics.friction, 1e-300)
        room[some] = np.where(grip.held[some] > 0, share, room[some])
    return room


def _end(dynamics: TreeDynamics, x: Array, u: Array, grip: Grip, h: Array, room: Array) -> tuple[Array, Array, Indices]:
    """Return (time, state, joint) at the end of a phase with margins `room` (N, nv) at h (N,), by the Illinois method.

    Only the joints with a violated margin at h are considered. Every third iteration bisects the bracket.
    """
    sought, rows = room < 0, np.arange(len(x))

    def least(y: Array, i: Indices) -> tuple[Array, Indices]:
        margins = np.where(sought[i], _room(dynamics, y, u[i], grip.some(i)), np.inf)
        which = np.argmin(margins, axis=1)
        return margins[np.arange(len(i)), which], which

    low, high, t = np.zeros(len(x)), h.copy(), h.copy()
    at_low, at_high = np.maximum(least(x, rows)[0], 0.0), np.min(room, axis=1)
    ends, which, side = x.copy(), np.argmin(room, axis=1), np.zeros(len(x))
    i = rows
    for k in range(SEARCHED):
        secant = at_low[i] / np.maximum(at_low[i] - at_high[i], 1e-300)
        t[i] = low[i] + (high[i] - low[i]) * np.where((at_low[i] > 0) & (k % 3 < 2), secant, 0.5)
        ends[i] = dynamics.step(x[i], t[i], u[i], grip.some(i))
        margin, which[i] = least(ends[i], i)
        above = margin > 0
        at_high[i] = np.where(above, np.where(side[i] > 0, at_high[i] / 2, at_high[i]), margin)
        at_low[i] = np.where(above, margin, np.where(side[i] < 0, at_low[i] / 2, at_low[i]))
        low[i], high[i] = np.where(above, t[i], low[i]), np.where(above, high[i], t[i])
        side[i] = np.where(above, 1.0, -1.0)
        i = i[(np.abs(margin) >= MET) & (high[i] - low[i] > SHORT)]
        if not len(i):
            break
    return t, ends, which


def _jump(dynamics: TreeDynamics, phase: SlidingPhase) -> Array:
    """Return the saltation matrices (n, nx, nx) at the start of a phase.

    A perturbation changes when a joint stops, and so the velocities of all coordinates whose acceleration jumps then.
    """
    nx, nv, x, u, grip = phase.x.shape[1], dynamics.nv, phase.x, phase.u, phase.grip
    jump = np.tile(np.eye(nx), (len(x), 1, 1))
    caught = np.flatnonzero(np.any(grip.held > 0, axis=1) & (phase.stopped < 0))
    if len(caught):  # the momentum of the moving joints is conserved
        mass, free = dynamics.mass(x[caught]), 1 - grip.held[caught]
        held = mass * free[:, :, None] * free[:, None] + np.eye(nv) * grip.held[caught][:, None]
        jump[caught, nx - nv :, nx - nv :] = np.linalg.solve(held, mass * free[:, :, None])
    some = np.flatnonzero(phase.stopped >= 0)
    if len(some):
        j, rows = phase.stopped[some], np.arange(len(some))
        old, _ = dynamics.accelerate_and_hold(x[some], u[some], phase.before.some(some))
        new, _ = dynamics.accelerate_and_hold(x[some], u[some], grip.some(some))
        slowed = np.where(old[rows, j] != 0, old[rows, j], np.inf)
        jump[some, nx - nv :, nx - nv + j] += (new - old) / slowed[:, None]
    return jump


@dataclass(frozen=True, eq=False)
class Slopes:
    """The derivatives of steps of some states with respect to themselves and to the unknowns that move them."""

    states: Indices  # (nx,) among all states
    tangent: Indices  # (2 nv,) among the entries of a tangent vector
    columns: Indices  # (np,) among all unknowns
    by_x: Array  # (K, M, nx, nx)
    by_z: Array  # (K, M, nx, np)


LONGEST = 0.02  # [s] longest step in continuous time
CHUNK = 256  # number of steps that are differentiated in one call
FINITE_DIFFERENCE, DIFFERENCE = "finite_difference", 1e-5  # relative difference of a parameter


@dataclass(frozen=True, eq=False)
class TreeMotion:
    """The motion dq/dt = N(q) v, dv/dt = a of a tree whose numbers are set by unknowns.

    Joints whose Coulomb friction is unknown can stick, unless friction is `smooth` (changes sign over a small speed).
    """

    model: Model
    tree: Tree
    unknowns: Unknowns
    longest: float = LONGEST  # [s] the longest step
    segment: float = 0.15  # [s] length of a segment
    method: Method = ORDER_8
    frozen: bool = False  # whether derivatives use the equations linearized at the midpoint of a step
    smooth: bool = False
    slip: float = SLIP_SPEED  # [rad/s or m/s] over which smooth friction changes its sign

    @cached_property
    def dry(self) -> tuple[int, ...]:
        """The velocity indices of joints that can stick; a joint with followers has the friction of all of them."""
        labels = {unknown.label for unknown in self.unknowns.each if unknown.quantity == COULOMB}
        joints = {link.joint.v_start for link in self.tree.links if link.joint.joint in labels and not self.smooth}
        coupling = self.tree.coupling
        return tuple(sorted(joints if coupling is None else {int(coupling.of_v[i]) for i in joints}))

    @property
    def has_servos(self) -> bool:
        """Whether any input is a commanded position."""
        return bool(np.any(self.tree.commanded))

    @property
    def kinks(self) -> bool:
        """Whether any joint can stick."""
        return bool(self.dry)

    @property
    def words(self) -> str:
        friction = ", with Coulomb friction that sticks" if self.dry else ""
        order = 8 if self.method is ORDER_8 else 4
        return f"continuous time, by steps of order {order} of at most {1e3 * self.longest:.3g} ms{friction}"

    def cut(self, period: float) -> tuple[float, ...]:
        """Return the lengths of the steps [s] over a time between samples [s]."""
        count = max(1, int(np.ceil(period / self.longest - 1e-9)))
        return (period / count,) * count

    def shorter(self, than: float) -> "TreeMotion | None":
        """Return the law with steps of at most half the length `than` [s]."""
        return replace(self, longest=than / 2)

    def is_possible(self, values: Array) -> bool:
        """Return whether bodies with these values are physically consistent."""
        return self.unknowns.consistent(values, self.tree)

    def dynamics(self, values: Array) -> TreeDynamics:
        """Return the dynamics of the tree for these values of the unknowns."""
        numbers = set_numbers(self.model, self.tree, self.unknowns, values)
        return TreeDynamics(self.tree, numbers, self.dry, self.method, self.frozen, self.slip)

    def run(self, values: Array, starts: Array, hs: Array, us: Array) -> Array:
        """Return the states (K, M+1, nx) from starts (K, nx) by steps of hs (K, M) [s] under us (K, M, nu)."""
        dynamics, (K, M) = self.dynamics(values), hs.shape
        xs = np.empty((K, M + 1, starts.shape[1]))
        for branch in self.branches:
            alone, x = branch.restrict(dynamics), starts[:, branch.states]
            xs[:, 0, branch.states] = x
            for m in range(M):
                some = hs[:, m] > 0
                x[some] = self._step(alone, x[some], hs[some, m], us[some, m][:, branch.inputs])
                xs[:, m + 1, branch.states] = x
        return xs

    def _step(self, dynamics: TreeDynamics, x: Array, h: Array, u: Array) -> Array:
        return step_with_friction(dynamics, x, h, u)[0] if dynamics.dry else dynamics.step(x, h, u)

    @cached_property
    def branches(self) -> tuple[Branch, ...]:
        """The independent branches of the tree."""
        return branches_of(self.tree)

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array, *, together: bool = False) -> list["Slopes"]:
        """Return the derivatives of each step of each independent branch, or of the whole tree."""
        dynamics, by = self.dynamics(self.unknowns.values(z)), self.by(z)
        return [
            self._slopes(b, dynamics, by, xs, hs, us) for b in ((undivided(self.tree),) if together else self.branches)
        ]

    def _slopes(self, branch: Branch, dynamics: TreeDynamics, by: Array, xs: Array, hs: Array, us: Array) -> "Slopes":
        by, dynamics, nx = by[branch.flat], branch.restrict(dynamics), len(branch.states)
        columns = np.flatnonzero(np.any(by != 0, axis=0))
        x = xs[:, :-1, branch.states].reshape(-1, nx)
        h, u = hs.reshape(-1), us[..., branch.inputs].reshape(hs.size, -1)
        total = np.zeros((hs.size, nx, nx + len(columns)))
        total[:, :, :nx] = np.eye(nx)
        steps = np.flatnonzero(h > 0)
        for rows in np.split(steps, range(CHUNK, len(steps), CHUNK)):
            total[rows] = self._jacobians(dynamics, x[rows], h[rows], u[rows], by[:, columns])
        total = total.reshape(*hs.shape, nx, -1)
        return Slopes(branch.states, branch.tangent, columns, total[..., :nx], total[..., nx:])

    def _jacobians(self, dynamics: TreeDynamics, x: Array, h: Array, u: Array, by: Array) -> Array:
        return friction_jacobians(dynamics, x, h, u, by) if dynamics.dry else dynamics.step_jacobians(x, h, u, by)

    def by(self, z: Array) -> Array:
        """Return the derivatives (count, np) of the tree's numbers with respect to z."""
        return numbers_at(self.model, self.tree, self.unknowns, z)[1]

    def rates(self, values: Array, x: Array, u: Array) -> Array:
        """Return the time derivatives (N, nx) of states (N, nx) under u (N, nu)."""
        q, v = x[:, : self.model.nq], x[:, self.model.nq :]
        speed = (self.tree.coordinates.rate(q) @ v[..., None])[..., 0]
        return np.concatenate([speed, self.dynamics(values).accelerate(x, u)], axis=1)


@dataclass(frozen=True)
class ServoOptions:
    """How motions with servos are simulated and fitted."""

    step: float = 0.005  # [s] the longest step
    slip: float = 0.05  # [rad/s or m/s] over which friction changes its sign; a sharper change needs steps below 1 ms
    window: float = 0.5  # [s] length of a piece with its own first state
    least: int = 20  # number of steps in a piece, at least, as fewer do not show whether residuals are noise
    few: int = 8  # number of windows from which the initial guess of a delay is found
    step_error: float = 2e-3  # in units of the noise: largest change of a window's end by steps of half the length
    same_noise: float = 0.03  # relative change of the noise below which it is not estimated again
    settled: float = 0.02  # predicted decrease of |r|^2 at the end of a fit: a seventh of a standard deviation
    roughly: float = 1.0  # the same with approximate derivatives


SERVOS = ServoOptions()


def servo_motion(model: Model, tree: Tree, unknowns: Unknowns) -> TreeMotion:
    """Return the law for robots with servos: short steps, as servos are stiff, and friction that changes smoothly.

    Its derivatives are approximate; `frozen=False` makes them exact.
    """
    return TreeMotion(
        model, tree, unknowns, SERVOS.step, np.inf, method=ORDER_4, frozen=True, smooth=True, slip=SERVOS.slip
    )


def with_exact_derivatives(law: "Law", exact: bool = True) -> "Law":
    """Return a law for servos with exact or approximate derivatives; other laws as they are."""
    return replace(law, frozen=not exact) if isinstance(law, TreeMotion) and law.has_servos else law


@dataclass(frozen=True, eq=False)
class EulerMotion(TreeMotion):
    """Semi-implicit Euler steps of the length `longest`, a whole fraction of the sample period; no free bodies."""

    smooth: bool = True

    @property
    def words(self) -> str:
        return f"semi-implicit Euler steps of {1e3 * self.longest:.4g} ms"

    def cut(self, period: float) -> tuple[float, ...]:
        """Return the lengths of the steps [s] over a time between samples [s]."""
        return (self.longest,) * max(1, round(period / self.longest))

    def shorter(self, than: float) -> None:
        """Return None, as the step length is itself estimated."""
        return

    def dynamics(self, values: Array) -> TreeDynamics:
        """Return the dynamics with damping at the end of the step."""
        dynamics = super().dynamics(values)
        numbers = dynamics.numbers
        return replace(dynamics, numbers=replace(numbers, reflected=numbers.reflected + self.longest * numbers.damping))

    def by(self, z: Array) -> Array:
        """Return the derivatives (count, np) of the tree's numbers with respect to z."""
        by, places = super().by(z), self.tree.numbers.places
        by[places("reflected")] += self.longest * by[places("damping")]
        return by

    def _step(self, dynamics: TreeDynamics, x: Array, h: Array, u: Array) -> Array:
        return euler_step(dynamics.tree.coordinates, self.longest, x, dynamics.accelerate(x, u))

    def _jacobians(self, dynamics: TreeDynamics, x: Array, h: Array, u: Array, by: Array) -> Array:
        a, by_state = dynamics.acceleration_jacobians(x, u, by)
        coordinates = dynamics.tree.coordinates
        return euler_jacobian(coordinates, self.longest, x, euler_step(coordinates, self.longest, x, a), by_state)


@dataclass(frozen=True, eq=False)
class DiscreteMotion:
    """Drake's discrete steps, of a length that is a whole fraction of the sample period."""

    model: Model  # with this time step
    unknowns: Unknowns
    vector: ParameterVector  # the unknowns that are parameters of the model
    own: Indices  # indices of the vector's entries among the unknowns
    segment: float = np.inf  # [s] a whole piece: in contact, a motion cannot start at a noisy state
    differenced: list[str] = field(default_factory=list)  # notes on derivatives that Drake refused
    kinks: bool = False

    @property
    def words(self) -> str:
        return ", ".join([f"the model's own steps of {1e3 * self.model.time_step:.4g} ms", *self.differenced[:1]])

    def cut(self, period: float) -> tuple[float, ...]:
        """Return the lengths of the steps [s] over a time between samples [s]."""
        return (self.model.time_step,) * round(period / self.model.time_step)

    def shorter(self, than: float) -> None:
        """Return None, as the model's own step is fitted."""
        return

    def run(self, values: Array, starts: Array, hs: Array, us: Array) -> Array:
        """Return the states (K, M+1, nx) from starts (K, nx) by steps of hs (K, M) [s], 0 for none, under us."""
        xs = np.empty((len(starts), hs.shape[1] + 1, self.model.nx))
        with applied(self.vector.at(values[self.own])) as model:
            for k, count in enumerate(np.count_nonzero(hs, axis=1)):
                xs[k, : count + 1] = roll_states(model, starts[k], us[k, :count])
                xs[k, count + 1 :] = xs[k, count]
        return xs

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array, *, together: bool = True) -> list[Slopes]:
        """Return the derivatives of each step; the states are always `together`, as contact may couple them."""
        vector, by_z = self.vector.at(self.unknowns.values(z)[self.own]), self.unknowns.by_z(z)[self.own]
        K, M, nx = *hs.shape, xs.shape[2]
        by_x, by = np.tile(np.eye(nx), (K, M, 1, 1)), np.zeros((K, M, nx, len(z)))
        taken = hs > 0
        starts, inputs = xs[:, :-1][taken], us[taken]
        analytic = all(p.kind.quantity in QUANTITIES and np.all(vector.values[s] > 0) for p, s in vector.pairs)
        exact = {p.name: vector.values[s] for p, s in vector.pairs if analytic or p.kind.source != FINITE_DIFFERENCE}
        with applied(vector) as model:
            steps = self._derivatives(model, select(model, exact), starts, inputs)
        by_values, column = np.empty((len(starts), nx, len(vector.values))), 0
        for p, s in vector.pairs:
            if p.name in exact:
                count = s.stop - s.start
                by_values[..., s] = np.array([step.C[:, column : column + count] for step in steps])
                column += count
            else:
                by_values[..., s] = _differences(vector, p, s, starts, inputs)
        by_x[taken] = np.array([step.A for step in steps])
        by[taken] = by_values @ by_z
        tangent = np.arange(2 * self.model.nv)
        return [Slopes(np.arange(nx), tangent, np.arange(len(z)), by_x, by)]

    def _derivatives(self, model: Model, vector: ParameterVector, xs: Array, us: Array) -> Sequence[StepDerivatives]:
        """Differentiate the steps from xs (N, nx) under us (N, nu), also with respect to the vector's parameters."""
        try:
            return derivatives_along(model, xs[0], us, vector=vector, xs=xs)
        except GradientError:
            self.differenced.append("some derivatives by differences")
            return derivatives_along(model, xs[0], us, vector=vector, xs=xs, method=FINITE_DIFFERENCE)


def _differences(vector: ParameterVector, parameter: Parameter, entries: slice, xs: Array, us: Array) -> Array:
    """Return differences (N, nx, k) of steps from xs (N, nx) with respect to a parameter that Drake has as a float."""
    columns = []
    for i in range(entries.start, entries.stop):
        value = vector.values[i]
        size = DIFFERENCE * max(abs(value), float(np.max(np.abs(parameter.value))), DIFFERENCE)
        low, high, ends = max(value - size, parameter.lower), value + size, []
        for moved in (low, high):
            values = vector.values.copy()
            values[i] = moved
            with applied(vector.at(values)) as model:
                ends.append(np.array([advance(model.double, x, u) for x, u in zip(xs, us, strict=True)]))
        columns.append((ends[1] - ends[0]) / (high - low))
    return np.stack(columns, axis=-1)


Law = TreeMotion | DiscreteMotion


def discrete_motion(model: Model, unknowns: Unknowns, pieces: Sequence[Excerpt]) -> DiscreteMotion:
    """Return the law by the model's steps, shortened if needed so that a whole number fits between samples.

    Raises InputError if samples are not equidistant, ModelError if a model from a diagram would need another time step.
    """
    every = np.concatenate([np.diff(piece.times) for piece in pieces])
    period = float(np.median(every))
    if np.any(np.abs(every - period) > CLOCK_TOLERANCE * min(period, model.time_step)):
        got = f"from {1e3 * np.min(every):.6g} to {1e3 * np.max(every):.6g} ms"
        raise InputError(
            "times between samples", got=got, expected="a constant period, as the model's own steps are fitted"
        )
    h = period / max(1, round(period / model.time_step))
    if abs(h - model.time_step) > CLOCK_TOLERANCE * model.time_step:
        model = model.at_time_step(h)
    parameters = {unknown.name: s for unknown, s in unknowns.items() if unknown.quantity != BIAS}
    entries = [i for s in parameters.values() for i in range(s.start, s.stop)]
    return DiscreteMotion(model, unknowns, select(model, list(parameters)), np.array(entries, dtype=int))
