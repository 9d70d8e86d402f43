"""Error-controlled integration of a `FlowPlant`, which ends a step where a contact's switch turns.

Between two events the modes are fixed and the equations smooth, so that the method keeps its order, and so does the
derivative of what it does. The steps are Dormand and Prince's of orders 5 and 4 ("A family of embedded Runge-Kutta
formulae", 1980).
"""

import time
from dataclasses import dataclass, field
from typing import Any

import casadi as ca
import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.exceptions import SimulationError
from drake_diff.motion.dormand_prince import ERROR, LEAST, STAGES, factor
from drake_diff.motion.flow.plant import FlowPlant

TOLERANCE = 1e-9  # of each step, relative to max(1, |x|)
BUDGET = 30.0  # [s] of wall time
ROOT = 1e-13  # of a step: how near to its event it ends
NEARER = 1e-3  # of what is left of a step: at least so far from both ends it is looked for
SHORTEST = 1e-14  # [s] a step that is shorter does not move time


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
    tried: int = 0


class Integrator:
    """Steps of a plant under fixed modes, with their error estimate."""

    def __init__(self, plant: FlowPlant, materials: Array, tolerance: float = TOLERANCE):
        model = plant.model
        self.plant, self.tolerance, self.materials = plant, tolerance, np.array(materials, dtype=float)
        self.h_next, self.began = model.time_step, 0.0
        self._steps: dict[tuple[int, ...], Any] = {}
        self.x, self.u, self.h = np.zeros(model.nx), np.zeros(model.nu), np.zeros(1)
        self.modes = np.zeros(2 * plant.num_pairs)
        self.ahead, self.error = np.zeros(model.nx), np.zeros(model.nx)
        self._at, self._values = np.zeros(model.nx), np.zeros(2 * plant.num_pairs)
        self._switch_buffer, self._switch = on_arrays(
            plant.switches, (self._at, self.u, self.materials), (self._values,)
        )
        self._set_modes(np.zeros(2 * plant.num_pairs))

    def _set_modes(self, modes: Array) -> None:
        """Take the equations where the pairs push whose two modes are 1."""
        self.modes[:] = modes
        pushing = pushing_of(modes)
        if pushing not in self._steps:
            arguments = self.x, self.u, self.materials, self.h
            self._steps[pushing] = on_arrays(step_function(self.plant, pushing), arguments, (self.ahead, self.error))
        self._buffer, self._run = self._steps[pushing]

    def begin(self, x0: Array) -> Flow:
        """A flow that stands at `x0` (nx,)."""
        self.x[:], self.h_next = x0, self.plant.model.time_step
        self._set_modes(np.zeros_like(self.modes))
        self.began = time.monotonic()
        return Flow([0.0], [np.array(x0, dtype=float)])

    def advance(self, found: Flow, u: Array, interval: float, budget: float = BUDGET) -> Array:
        """(nx,) where a flow leads in `interval` [s] more under `u` (nu,); SimulationError where it has no end."""
        self.u[:] = u
        self._settle(found)
        now, end = found.times[-1], (len(found.ends) + 1) * interval
        near = SHORTEST * max(1.0, end)
        while end - now > near:
            if time.monotonic() - self.began > budget:
                raise SimulationError(f"the flow is too stiff: {budget:g} s of work did not reach {end:.4g} s")
            self.h_next = self._advance(found, now, min(self.h_next, end - now), self.h_next)
            now = found.times[-1]
        found.times[-1] = end
        found.ends.append(len(found.hs))
        return found.xs[-1]

    def _advance(self, found: Flow, now: float, length: float, wanted: float) -> float:
        """One accepted step of at most `length` [s] from `now`; the length that would do next."""
        is_cut = length < wanted
        while True:
            ratio = self._try(length)
            found.tried += 1
            change = factor(ratio)
            if ratio <= 1:
                break
            length, is_cut = length * (change if np.isfinite(ratio) else LEAST), False
            if length < SHORTEST:
                raise SimulationError(f"the flow cannot go on at {now:.6g} s: its rates are not finite or jump")
        after = max(wanted, length * change) if is_cut else length * change  # a step that is cut says nothing
        turned = self._turned()
        if len(turned):
            length = self._find(length, turned)
        self._accept(found, now + length, length)
        return after

    def _try(self, length: float) -> float:
        """A step of `length` [s] into `ahead`; its error as a part of what is allowed."""
        self.h[0] = length
        self._run()
        if not np.all(np.isfinite(self.ahead)):
            return float("inf")
        size = self.tolerance * np.maximum(1.0, np.maximum(np.abs(self.x), np.abs(self.ahead)))
        with np.errstate(over="ignore"):
            return float(np.sqrt(np.mean((self.error / size) ** 2)))

    def _switches(self, x: Array) -> Array:
        """(2 P,) at `x` (nx,)."""
        self._at[:] = x
        self._switch()
        return self._values.copy()

    def _turned(self) -> Indices:
        """The switches that differ from the modes at the step's end; a bracket matters where its pair overlapped."""
        on, was = self._switches(self.ahead) > 0, self.modes > 0.5
        matters = np.repeat(was[::2], 2)
        matters[::2] = True
        return np.flatnonzero((on != was) & matters)

    def _find(self, length: float, turned: Indices) -> float:
        """The length of the step at whose end the first of the switches that `turned` is 0, just past it."""
        low, high, halve = 0.0, length, False
        while high - low > max(ROOT * length, SHORTEST):
            first = 0.5 if halve else self._first(self._values_at(low), self._values_at(high), turned)
            before = high - low
            middle = low + before * min(max(first, NEARER), 1 - NEARER)
            self._try(middle)
            crossed = self._turned()
            if len(crossed):
                high, turned = middle, crossed
            else:
                low = middle
            halve = high - low > before / 2
        self._try(high)
        return high

    def _values_at(self, length: float) -> Array:
        if length == 0.0:
            return self._switches(self.x)
        self._try(length)
        return self._switches(self.ahead)

    def _first(self, start: Array, end: Array, turned: Indices) -> float:
        """Where between the two, from 0 to 1, the first of the switches is 0 if they are straight lines."""
        gap = start[turned] - end[turned]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = np.where(gap != 0, start[turned] / gap, 0.5)
        return float(np.min(np.clip(at, 0.0, 1.0)))

    def _accept(self, found: Flow, now: float, length: float) -> None:
        found.times.append(now)
        found.hs.append(length)
        found.us.append(self.u.copy())
        found.modes.append(self.modes.copy())
        self.x[:] = self.ahead
        found.xs.append(self.x.copy())
        self.plant.check(self.x)
        self._settle(found)

    def _settle(self, found: Flow) -> None:
        """Set the modes to what the switches say at the state, and note what turns; of a pair apart nothing pushes."""
        on, modes = self._switches(self.x) > 0, self.modes.copy()
        if np.array_equal(on, modes > 0.5):
            return
        for i in range(self.plant.num_pairs):
            was, now = modes[2 * i : 2 * i + 2] > 0.5, on[2 * i : 2 * i + 2]
            modes[2 * i : 2 * i + 2] = now
            switch = 2 * i + int(was[0] == now[0])
            if was[0] != now[0] or (now[0] and was[1] != now[1]):
                both = float(now[0]), float(now[1])
                found.events.append(FlowEvent(found.times[-1], len(found.hs), switch, both, self.x.copy()))
        self._set_modes(modes)


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


def pushing_of(modes: Array) -> tuple[int, ...]:
    """The pairs whose two modes are on."""
    return tuple(np.flatnonzero((modes[::2] > 0.5) & (modes[1::2] > 0.5)).tolist())


def step_function(plant: FlowPlant, pushing: tuple[int, ...]) -> Any:
    """(x, u, materials, h) -> the state after a step, and its error."""
    rates, h = plant.part(pushing).rates, ca.SX.sym("h")
    x, u, materials = (ca.SX.sym(name, *rates.size_in(i)) for i, name in enumerate("xum"))
    slopes = [rates(x, u, materials)]
    ahead = x
    for weights in STAGES:
        ahead = x + h * sum(w * s for w, s in zip(weights, slopes, strict=True))
        slopes.append(rates(ahead, u, materials))
    error = h * sum(w * s for w, s in zip(ERROR, slopes, strict=True))
    return ca.Function("step", [x, u, materials, h], [ca.densify(ahead), ca.densify(error)])
