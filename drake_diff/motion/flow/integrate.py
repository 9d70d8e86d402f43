"""Error-controlled integration of a `FlowPlant`, which ends a step where a contact's switch turns.

Friction that holds is a damper of rate up to 15/8 mu f / (v_s m), which keeps explicit steps short long after the
motion itself has become slow. Where the explicit steps come near the end of their stability, those of a Rosenbrock
method take over, until explicit ones would be as long.

Between two events the modes are fixed and the equations smooth, so that the method keeps its order, and so does the
derivative of what it does. A switch that turns twice within a step has turned at neither end of it: where it comes
nearer to 0 at the start and goes away from it at the end, what is between them is looked at. A step ends, too, where a
sphere passes from a face of a shape to its edge: how the normal turns jumps there.
"""

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.exceptions import SimulationError
from drake_diff.motion.flow.plant import FlowPlant
from drake_diff.motion.tableaus import (
    LEAST,
    ROSENBROCK_COUPLINGS,
    ROSENBROCK_GAMMA,
    ROSENBROCK_STAGES,
    factor,
)

STABLE = 1.0  # of a step's length times the rate at which its stages move apart; the explicit method is stable to 3.3
HITS = 5  # steps in a row over it before the other method takes over
LOOK = 8  # steps of the other method between looks at the largest rate


@dataclass(frozen=True, eq=False)
class _Part:
    """What runs a part's functions on the stepper's own arrays."""

    explicit: Any
    rates: Any
    slopes: Any
    kept: tuple[Any, ...]


class Stepper:
    """Tries steps from the state `x` under `u`: the results are `ahead` (nx,) and the rates there, `after` (nx,)."""

    def __init__(self, plant: FlowPlant, materials: Array):
        nx, nu = plant.model.nx, plant.model.nu
        self.plant, self.materials = plant, np.array(materials, dtype=float)
        self.x, self.u = np.zeros(nx), np.zeros(nu)
        self.ahead, self.after = np.zeros(nx), np.zeros(nx)
        self.is_stiff, self._hits, self._left = False, 0, 0
        self._h, self._told = np.zeros(1), np.zeros(2)
        self._stage, self._rates, self._slopes = np.zeros(nx), np.zeros(nx), np.zeros((nx + nu, nx))
        self._at, self._jacobian, self._changes = np.empty(0), np.zeros((nx, nx)), np.zeros((8, nx))
        self._parts: dict[tuple[int, ...], _Part] = {}
        self.push(())

    def push(self, pushing: tuple[int, ...]) -> None:
        """Take the equations where the pairs `pushing` push."""
        if pushing not in self._parts:
            equations = self.plant.part(pushing)
            given = self.u, self.materials
            results = self.ahead, self.after, self._told
            buffer, explicit = on_arrays(equations.step, (self.x, *given, self._h), results)
            kept_too, rates = on_arrays(equations.rates, (self._stage, *given), (self._rates,))
            kept_last, slopes = on_arrays(equations.slopes, (self._stage, *given), (self._rates, self._slopes))
            self._parts[pushing] = _Part(explicit, rates, slopes, (buffer, kept_too, kept_last))
        self._part = self._parts[pushing]
        self.is_stiff, self._hits = False, 0
        self.moved()

    def moved(self) -> None:
        """The state or the input is another one."""
        self._at = np.empty(0)

    def rates(self) -> Array:
        """(nx,) at the state."""
        self._stage[:] = self.x
        self._part.rates()
        return self._rates

    def attempt(self, length: float) -> float:
        """A step of `length` [s] into `ahead` and `after`; its error relative to max(1, |x|)."""
        error = self._implicit(length) if self.is_stiff else self._explicit(length)
        if not np.isfinite(error) or not np.isfinite(np.sum(self.ahead)):
            return float("inf")
        return error

    def accept(self, length: float) -> None:
        """Go where the last attempt led."""
        if not self.is_stiff:
            self._hits = self._hits + 1 if length * self._told[1] > STABLE else 0
            if self._hits == HITS:
                self.is_stiff, self._hits, self._left = True, 0, LOOK
        else:
            self._left -= 1
            if self._left == 0:
                self._left = LOOK
                self.is_stiff = bool(length * np.max(np.abs(np.linalg.eigvals(self._jacobian))) > STABLE)
        self.x[:] = self.ahead
        self.moved()

    def _explicit(self, length: float) -> float:
        self._h[0] = length
        self._part.explicit()
        return float(self._told[0])

    def _implicit(self, length: float) -> float:
        if not self._at.size:
            self._stage[:] = self.x
            self._part.slopes()
            self._at = self._rates.copy()
            self._jacobian = self._slopes[: len(self.x)].T.copy()
        W = -self._jacobian
        W[np.diag_indices(len(W))] += 1 / (ROSENBROCK_GAMMA * length)
        try:
            solve = np.linalg.inv(W)
        except np.linalg.LinAlgError:
            return float("inf")
        changes = self._changes
        changes[0] = solve @ self._at
        for i in range(1, 8):
            self._stage[:] = self.x + ROSENBROCK_STAGES[i] @ changes[:i]
            self._part.rates()
            changes[i] = solve @ (self._rates + ROSENBROCK_COUPLINGS[i] @ changes[:i] / length)
        self.ahead[:] = self._stage + changes[7]
        self._stage[:] = self.ahead
        self._part.rates()
        self.after[:] = self._rates
        size = np.maximum(1.0, np.maximum(np.abs(self.x), np.abs(self.ahead)))
        return float(np.sqrt(np.mean((changes[7] / size) ** 2)))


def on_arrays(function: Any, arguments: tuple[Array, ...], results: tuple[Array, ...]) -> tuple[Any, Any]:
    """A function of CasADi's on arrays that stay where they are: (what has to be kept, what runs it)."""
    buffer, run = function.buffer()
    for i, a in enumerate(arguments):
        if a.size:
            buffer.set_arg(i, a.data)
    for i, a in enumerate(results):
        if a.size:
            buffer.set_res(i, a.data)
    return buffer, run


TOLERANCE = 1e-9  # of each step, relative to max(1, |x|)
BUDGET = 30.0  # [s] of this thread's own work
ROOT = 1e-13  # of a step: how near to its event it ends
SHORTEST = 1e-14  # [s] a step that is shorter does not move time
BEYOND = 1e-4  # of the way to where a switch is expected to be 0: how far beyond it the next look is
EDGE = 1e-9  # [m] a body that moves along an edge passes it all the time by less
NOTHING = np.zeros(0, dtype=np.intp)
SHALLOW = 1e-13  # [m] overlap that begins and ends within a step and is not looked for


@dataclass(frozen=True)
class FlowEvent:
    """A switch of a contact that turned: 2 i of pair i for touch and lift-off, 2 i + 1 for its bracket."""

    time: float  # [s]
    step: int  # the number of the step that ended there
    switch: int
    modes: tuple[float, float]  # of the pair, from then on
    x: Array  # (nx,)


@dataclass
class Flow:
    """Accepted steps: `xs` (M+1, nx) at `times` (M+1,), lengths `hs` (M,), inputs and modes in each; and events."""

    times: list[float]
    xs: list[Array]
    hs: list[float] = field(default_factory=list)
    us: list[Array] = field(default_factory=list)
    modes: list[Array] = field(default_factory=list)
    events: list[FlowEvent] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)  # after how many steps each interval of the inputs ended
    deep: list[int] = field(default_factory=list)  # steps at whose end a sphere's centre is within another shape
    tried: int = 0


@dataclass(frozen=True, eq=False)
class _Switches:
    """(2 P + edges,) of what is watched, and its rates."""

    values: Array
    rates: Array


class Integrator:
    """The flow of a plant from a state, with contacts of given materials."""

    def __init__(self, plant: FlowPlant, materials: Array, tolerance: float = TOLERANCE):
        model, self.count = plant.model, 2 * plant.num_pairs
        watched = self.count + len(plant.edge_pairs)
        self.plant, self.tolerance, self.materials = plant, tolerance, np.array(materials, dtype=float)
        self.stepper = Stepper(plant, self.materials)
        self.h_next, self.began = model.time_step, 0.0
        self.modes = np.zeros(self.count)
        self._on, self._matters = (np.zeros(watched, dtype=bool) for _ in range(2))
        self._start = _Switches(np.zeros(watched), np.zeros(watched))  # where the step begins
        self._x, self._rates = np.zeros(model.nx), np.zeros(model.nx)
        self._values, self._changes = np.zeros(watched), np.zeros(watched)
        arguments = self._x, self.stepper.u, self.materials, self._rates
        self._buffer, self._run = on_arrays(plant.watched, arguments, (self._values, self._changes))

    def begin(self, x0: Array) -> Flow:
        """A flow that stands at `x0` (nx,)."""
        self.stepper.x[:], self.h_next = x0, self.plant.model.time_step
        self._set(np.zeros(self.count))
        self.stepper.push(())
        self.began = time.thread_time()
        return Flow([0.0], [np.array(x0, dtype=float)])

    def advance(self, flow: Flow, u: Array, interval: float, budget: float = BUDGET) -> Array:
        """(nx,) where a flow leads in `interval` [s] more under `u` (nu,); SimulationError where it has no end."""
        if not flow.hs or not np.array_equal(u, self.stepper.u):
            self.stepper.u[:] = u
            self.stepper.moved()
            self._look()
        self._settle(flow)
        now, end = flow.times[-1], (len(flow.ends) + 1) * interval
        near = SHORTEST * max(1.0, end)
        while end - now > near:
            if time.thread_time() - self.began > budget:
                raise SimulationError(
                    f"the flow is too stiff: {budget:g} s of work reached {now:.4g} s by {len(flow.hs)} steps, not "
                    f"{end:.4g} s"
                )
            self.h_next = self._advance(flow, now, min(self.h_next, end - now), self.h_next)
            now = flow.times[-1]
        flow.times[-1] = end
        flow.ends.append(len(flow.hs))
        return flow.xs[-1]

    def _advance(self, flow: Flow, now: float, length: float, wanted: float) -> float:
        """One accepted step of at most `length` [s] from `now`; the length that would do next."""
        is_cut = length < wanted
        while True:
            ratio = self.stepper.attempt(length) / self.tolerance
            flow.tried += 1
            change = factor(ratio)
            if ratio <= 1:
                break
            length, is_cut = length * (change if np.isfinite(ratio) else LEAST), False
            if length < SHORTEST:
                raise SimulationError(f"the flow cannot go on at {now:.6g} s: its rates are not finite or jump")
        after = max(wanted, length * change) if is_cut else length * change  # a step that is cut says nothing
        end = self._switches_ahead()
        while True:
            if len(self._turned(end)):
                length, end = self._find(length, end)
            dip = self._dip(length, end)
            if dip is None:
                break
            length, end = dip
        self._accept(flow, now + length, length, end)
        return after

    def _switches_ahead(self) -> _Switches:
        """Where the last attempt led."""
        self._x[:], self._rates[:] = self.stepper.ahead, self.stepper.after
        self._run()
        return _Switches(self._values.copy(), self._changes.copy())

    def _after(self, length: float) -> _Switches:
        """After a step of another `length` [s]."""
        self.stepper.attempt(length)
        return self._switches_ahead()

    def _set(self, modes: Array) -> None:
        """Take new modes: a bracket matters where its pair overlapped, and an edge where its pair pushes."""
        self.modes[:] = modes
        overlaps, pushes = modes[::2] > 0.5, modes[::2] * modes[1::2] > 0.5
        self._on[: self.count] = modes > 0.5
        self._matters[: self.count : 2], self._matters[1 : self.count : 2] = True, overlaps
        self._matters[self.count :] = pushes[self.plant.edge_pairs]

    def _turned(self, end: _Switches) -> Indices:
        """The switches that differ from the modes at the step's end, and the edges that a pair that pushes passed."""
        turned = ((end.values > 0) != self._on) & self._matters
        if not turned.any():
            return NOTHING
        n, moved = self.count, np.abs(end.values - self._start.values)
        turned[n:] &= moved[n:] > EDGE
        return np.flatnonzero(turned)

    def _find(self, length: float, end: _Switches) -> tuple[float, _Switches]:
        """The length of the step at whose end the first of the switches that turned is 0, just past it."""
        low, high, first, last = 0.0, length, self._start, end
        near, slow = max(ROOT * length, SHORTEST), 0
        while high - low > near:
            before = high - low
            middle = 0.5 * before if slow > 1 else _crossing(before, first, last, self._turned(last), near)
            switches = self._after(low + middle)
            if len(self._turned(switches)):
                high, last = low + middle, switches
            else:
                low, first = low + middle, switches
            slow = slow + 1 if high - low > before / 2 and slow <= 1 else 0
        return high, self._after(high)

    def _dip(self, length: float, end: _Switches) -> tuple[float, _Switches] | None:
        """The length of a step within this one at whose end a switch has turned that is back at its end, or None."""
        n, on = self.count, self._on[: self.count]
        toward, away = self._start.rates[:n] > 0, end.rates[:n] > 0
        falls = (toward != on) & (away == on) & ((end.values[:n] > 0) == on) & self._matters[:n]
        if not falls.any():
            return None
        side = np.where(on, 1.0, -1.0)
        looked = False
        for i in np.flatnonzero(falls).tolist():
            low, high, first, last = 0.0, length, self._start, end
            while high - low > SHORTEST:
                middle, least = _meeting(high - low, side[i], first, last, i)
                if least > -SHALLOW:
                    break
                looked, switches = True, self._after(low + middle)
                if len(self._turned(switches)):
                    return low + middle, switches
                if side[i] * switches.rates[i] < 0:
                    low, first = low + middle, switches
                else:
                    high, last = low + middle, switches
        if looked:
            self.stepper.attempt(length)
        return None

    def _accept(self, flow: Flow, now: float, length: float, end: _Switches) -> None:
        flow.times.append(now)
        flow.hs.append(length)
        flow.us.append(self.stepper.u.copy())
        flow.modes.append(self.modes.copy())
        self.stepper.accept(length)
        flow.xs.append(self.stepper.x.copy())
        self.plant.check(self.stepper.x)
        if (end.values[: self.count : 2] > self.plant.pairs.radius).any():
            flow.deep.append(len(flow.hs) - 1)
        self._start = end
        self._on[self.count :] = end.values[self.count :] > 0
        self._settle(flow)

    def _look(self) -> None:
        """Where the step begins."""
        self._x[:], self._rates[:] = self.stepper.x, self.stepper.rates()
        self._run()
        self._start = _Switches(self._values.copy(), self._changes.copy())
        self._on[self.count :] = self._values[self.count :] > 0

    def _settle(self, flow: Flow) -> None:
        """Set the modes to what the switches say at the state, and note what turns; of a pair apart nothing pushes."""
        on = self._start.values[: self.count] > 0
        if not (on != self._on[: self.count]).any():
            return
        modes = self.modes.copy()
        for i in range(self.plant.num_pairs):
            was, now = modes[2 * i : 2 * i + 2] > 0.5, on[2 * i : 2 * i + 2]
            modes[2 * i : 2 * i + 2] = now
            switch = 2 * i + int(was[0] == now[0])
            if was[0] != now[0] or (now[0] and was[1] != now[1]):
                both = float(now[0]), float(now[1])
                flow.events.append(FlowEvent(flow.times[-1], len(flow.hs), switch, both, self.stepper.x.copy()))
        pushed = pushing_of(self.modes)
        self._set(modes)
        if pushing_of(modes) != pushed:
            self.stepper.push(pushing_of(modes))
            self._look()


def pushing_of(modes: Array) -> tuple[int, ...]:
    """The pairs whose two modes are on."""
    return tuple(np.flatnonzero((modes[::2] > 0.5) & (modes[1::2] > 0.5)).tolist())


def _crossing(length: float, first: _Switches, last: _Switches, turned: Indices, near: float) -> float:
    """Where the first of the switches that turned is 0 by cubics through both ends, a little beyond the nearer end."""
    crossing = length
    for i in turned:
        a, b, ra, rb = first.values[i], last.values[i], length * first.rates[i], length * last.rates[i]
        t = a / (a - b) if a != b else 0.5
        for _ in range(4):
            value = a + t * (ra + t * (3 * (b - a) - 2 * ra - rb + t * (2 * (a - b) + ra + rb)))
            slope = ra + t * (2 * (3 * (b - a) - 2 * ra - rb) + t * 3 * (2 * (a - b) + ra + rb))
            t = min(max(t - value / slope, 0.0), 1.0) if slope else 0.5
        crossing = min(crossing, t * length)
    beyond = max(0.4 * near, BEYOND * min(crossing, length - crossing))
    crossing += beyond if 2 * crossing < length else -beyond
    return min(max(crossing, 0.4 * near), length - 0.4 * near)


def _meeting(length: float, side: float, first: _Switches, last: _Switches, i: int) -> tuple[float, float]:
    """Where the tangents at both ends of a switch meet, and how far from 0: below all between, where it is convex."""
    a, b = side * first.values[i], side * last.values[i]
    ra, rb = side * first.rates[i], side * last.rates[i]
    meeting = (b - a - rb * length) / (ra - rb)
    meeting = min(max(meeting, 0.0), length)
    return min(max(meeting, 0.01 * length), 0.99 * length), min(a + ra * meeting, b)
