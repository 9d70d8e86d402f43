"""Error-controlled integration of motions whose equations change when a contact becomes active or inactive.

A `System` has switches, which are on where their values are positive. A step ends where a switch changes sign, so the
switches are constant and the equations are smooth within a step. The method and the derivative of its result then keep
their orders. A switch that changes sign twice within a step shows no change at the ends of the step. If its value moves
towards 0 at the start and away from 0 at the end, the interior of the step is searched. A system that does not know the
rates of its switches names the fractions of a step at which to check them.

Static friction acts as a damper of rate up to 15/8 mu f / (v_s m), which requires short explicit steps long after the
motion itself has become slow. Near the limit of stability of the explicit method (Dormand and Prince), the integrator
changes to Rodas5P, until explicit steps could be as long.
"""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from drake_diff._base.arrays import Array
from drake_diff.exceptions import SimulationError
from drake_diff.model.contact import ContactPoint
from drake_diff.motion.tableaus import (
    ERROR,
    ROSENBROCK_COUPLINGS,
    ROSENBROCK_GAMMA,
    ROSENBROCK_STAGES,
    STAGES,
    factor,
)

TOLERANCE = 1e-9  # error of each step, relative to max(sizes, |x|)
SHORTEST = 1e-14  # [s] minimum length of a step
ROOT = 1e-13  # tolerance of an event's time, relative to the step
SHALLOW = 1e-13  # [m] smaller overlaps that begin and end within a step are ignored
STABLE = 1.0  # threshold of step length times the rate of the stages; the explicit method is stable up to 3.3
HITS = 5  # consecutive explicit steps over STABLE before the change to implicit steps
LOOK = 8  # implicit steps between evaluations of the largest rate
Pairs = tuple[int, ...]  # active pairs
Flags = NDArray[np.bool_]


class System:
    """Rates x' of a state (n,) for a given set of active pairs, `pushing`, and the switches of all pairs.

    The first switches are `per_pair` for each pair. More may follow, at which steps end but rates do not jump.
    """

    time_step: float  # [s] the initial step length
    num_pairs: int
    per_pair = 1
    slack: Any = 0.0  # (switches,) a wrong sign by less than this is ignored
    pushing: Pairs = ()
    contact_is_stiff = False  # whether steps are implicit while a pair is active
    used = 0  # number of evaluations of the rates
    most = 1_000_000  # maximum of `used`
    sizes: Any = 1.0  # (n,) minimum scales of the states for relative errors

    def push(self, pairs: Pairs) -> None:
        """Set the active pairs."""
        self.pushing = pairs

    def rates(self, x: Array) -> Array:
        """Return the rates (n,) at `x`."""
        raise NotImplementedError

    def slopes(self, x: Array, rates: Array) -> Array:
        """Return the Jacobian (n, n) of the rates at `x`, where the rates are `rates` (n,)."""
        raise NotImplementedError

    def watch(self, x: Array, rates: Array) -> tuple[Array, Array]:
        """Return the switches' values, and their rates if the state changes at `rates`, or 0 for unknown rates."""
        raise NotImplementedError

    def pushing_where(self, on: Flags) -> Pairs:
        """Return the active pairs if the switches `on` are on."""
        raise NotImplementedError

    def relevant(self, on: Flags) -> Flags:
        """Return the switches whose change of sign affects the equations, if the switches `on` are on."""
        return np.ones(len(on), dtype=bool)

    def parts(self, h: float) -> Sequence[float]:
        """Return the fractions of a step of length `h` [s] at which to check for switches that have changed."""
        return ()

    def check(self, x: Array) -> None:
        """Raise SimulationError if the equations do not support the state `x`."""

    def points_at(self, x: Array, pairs: Pairs) -> Iterable[tuple[int, ContactPoint]]:
        """Return the contact points at `x` of those of `pairs` that have a contact force."""
        return ()

    def explicit(self, x: Array, rates: Array, h: float) -> tuple[Array, Array, float, float]:
        """Take a step of `h` [s]; return the end state, the rates there, the error, and the rate of the stages."""
        slopes, state, before = [rates], x, x
        for weights in STAGES:
            before, state = state, x + h * (np.array(weights) @ np.array(slopes))
            slopes.append(self.rates(state))
        with np.errstate(over="ignore", invalid="ignore"):
            apart = float(np.linalg.norm(state - before))
            stiffness = float(np.linalg.norm(slopes[-1] - slopes[-2])) / apart if apart else 0.0
        return state, slopes[-1], relative(h * (ERROR @ np.array(slopes)), x, state, self.sizes), stiffness


@dataclass(frozen=True)
class SwitchEvent:
    """The index of a switch that changed sign, and the active pairs after the event."""

    switch: int
    pushing: Pairs


@dataclass(frozen=True, eq=False)
class Step:
    """An accepted step from `x` to `ahead` (n,) of length `h` [s], and the events at its end."""

    x: Array
    ahead: Array
    h: float
    pushing: Pairs
    events: tuple[SwitchEvent, ...]


@dataclass(frozen=True, eq=False)
class _Reach:
    """The end point of a step of length `h`."""

    h: float
    x: Array
    rates: Array
    stiffness: float
    values: Array  # of the switches
    slopes: Array  # rates of the switches


class Integrator:
    """An integrator for the motion of a system from a state."""

    def __init__(self, system: System, tolerance: float = TOLERANCE, deadline: float = np.inf):
        self.system, self.tolerance, self.deadline = system, tolerance, deadline
        self._here: _Reach
        self._jacobian: Array | None
        self._is_stiff, self._hits, self._left = False, 0, 0  # hits: steps over STABLE; left: steps until the LOOK

    def start(self, x: Array) -> None:
        """Start the integration at `x` (n,)."""
        system, x = self.system, np.array(x, dtype=float)
        system.used, self._length = 0, system.time_step
        self._set(system.watch(x, np.zeros(len(x)))[0] > 0)
        self._choose_method()
        self._stand(x)

    def advance(self, duration: float) -> list[Step]:
        """Integrate over the next `duration` [s] under the system's input and return the steps.

        Raises SimulationError if the rates are not finite or the motion is too stiff, and TimeoutError if this thread's
        CPU time (`time.thread_time`) exceeds the deadline [s].
        """
        self._stand(self._here.x)
        steps, left = list[Step](), duration
        while left > SHORTEST * max(1.0, duration):
            steps.append(self._advance(left))
            left -= steps[-1].h
        return steps

    def _advance(self, left: float) -> Step:
        length = min(self._length, left)
        is_cut = length < self._length
        while True:
            if self.system.used > self.system.most:
                raise SimulationError(f"the motion is too stiff: {self.system.most} evaluations do not reach its end")
            if self.deadline < np.inf and time.thread_time() > self.deadline:
                raise TimeoutError
            x, rates, error, stiffness = self._take(length)
            if error <= self.tolerance:
                break
            length, is_cut = length * factor(error / self.tolerance), False
            if length < SHORTEST:
                raise SimulationError("the integration cannot continue: the rates are not finite, or jump")
        next_length = length * factor(error / self.tolerance)
        self._length = max(self._length, next_length) if is_cut else next_length  # a cut step must not reduce it
        end = self._until_change(_Reach(length, x, rates, stiffness, *self.system.watch(x, rates)))
        return self._accept(end)

    def _take(self, h: float) -> tuple[Array, Array, float, float]:
        """Take a step; return the end state, the rates there, the error, and the rate of the stages."""
        here = self._here
        reach = (*self._implicit(h), 0.0) if self._is_stiff else self.system.explicit(here.x, here.rates, h)
        return reach if np.isfinite(reach[2]) and np.isfinite(np.sum(reach[0])) else (*reach[:2], np.inf, 0.0)

    def _implicit(self, h: float) -> tuple[Array, Array, float]:
        system, x, rates = self.system, self._here.x, self._here.rates
        if self._jacobian is None:
            self._jacobian = system.slopes(x, rates)
        W = -self._jacobian
        W[np.diag_indices(len(x))] += 1 / (ROSENBROCK_GAMMA * h)
        try:
            inverse = np.linalg.inv(W)
        except np.linalg.LinAlgError:
            return x, rates, np.inf
        stages, state = np.empty((len(ROSENBROCK_STAGES), len(x))), x
        for i, (weights, couplings) in enumerate(zip(ROSENBROCK_STAGES, ROSENBROCK_COUPLINGS, strict=True)):
            state = x + weights @ stages[:i]
            value = system.rates(state) if i else rates
            stages[i] = inverse @ (value + couplings @ stages[:i] / h)
        ahead = state + stages[-1]
        return ahead, system.rates(ahead), relative(stages[-1], x, ahead, system.sizes)

    def _reach(self, h: float) -> _Reach:
        x, rates, _, stiffness = self._take(h)
        return _Reach(h, x, rates, stiffness, *self.system.watch(x, rates))

    def _margin(self, values: Array) -> float:
        """Return a value below 0 if a relevant switch has changed sign since the start of the step."""
        signed = np.where(self._on, values, -values) + self.system.slack
        return float(np.min(signed, where=self._relevant, initial=np.inf))

    def _until_change(self, reach: _Reach) -> _Reach:
        """Return the end of the step, shortened to just after the first change of a switch within it."""
        while True:
            if self._margin(reach.values) < 0:
                reach = self._locate(reach.h)
            inside = self._look_inside(reach)
            if inside is None:
                return reach
            reach = inside

    def _locate(self, length: float) -> _Reach:
        near = max(ROOT * length, SHORTEST)

        def margin(h: float) -> float:
            return self._margin(self._reach(h).values if h else self._here.values)

        root = float(brentq(margin, 0.0, length, xtol=near))
        while True:
            reach = self._reach(min(root + near, length))
            if reach.h == length or self._margin(reach.values) < 0:
                return reach
            near *= 2

    def _look_inside(self, reach: _Reach) -> _Reach | None:
        """Return a shorter step to where a switch differs that has the same sign at both ends, or None."""
        here, h = self._here, reach.h
        for s in self.system.parts(h):  # cubic Hermite interpolation
            ends = (1 + 2 * s) * (1 - s) ** 2 * here.x + s * s * (3 - 2 * s) * reach.x
            state = ends + h * s * (1 - s) * ((1 - s) * here.rates - s * reach.rates)
            if self._margin(self.system.watch(state, here.rates)[0]) < 0:
                inside = self._reach(s * h)
                if self._margin(inside.values) < 0:
                    return inside
        on = self._on
        returns = ((here.slopes > 0) != on) & ((reach.slopes > 0) == on) & ((reach.values > 0) == on) & self._relevant
        dips = (self._search_dip(i, here, reach) for i in np.flatnonzero(returns[: self._of_pairs]).tolist())
        return next((dip for dip in dips if dip is not None), None)

    def _search_dip(self, i: int, first: _Reach, last: _Reach) -> _Reach | None:
        """Find where a switch, assumed to be convex in time, differs between two states at which it is unchanged."""
        side = 1.0 if self._on[i] else -1.0
        while last.h - first.h > SHORTEST:
            a, b, ra, rb = (side * values[i] for values in (first.values, last.values, first.slopes, last.slopes))
            width = last.h - first.h
            meeting = min(max((b - a - rb * width) / (ra - rb), 0.0), width)  # intersection of the tangents
            if min(a + ra * meeting, b) > -SHALLOW:
                return None
            middle = self._reach(first.h + min(max(meeting, 0.01 * width), 0.99 * width))
            if self._margin(middle.values) < 0:
                return middle
            if side * middle.slopes[i] < 0:
                first = middle
            else:
                last = middle
        return None

    def _accept(self, end: _Reach) -> Step:
        if self._is_stiff:
            self._left -= 1
            stays = self.system.contact_is_stiff and bool(self.system.pushing)
            if self._left <= 0 and self._jacobian is not None and not stays:
                self._left = LOOK
                self._is_stiff = bool(end.h * np.max(np.abs(np.linalg.eigvals(self._jacobian))) > STABLE)
        else:
            self._hits = self._hits + 1 if end.h * end.stiffness > STABLE else 0
            if self._hits == HITS:
                self._is_stiff, self._hits, self._left = True, 0, LOOK
        start, pushing = self._here.x, self.system.pushing
        self._here, self._jacobian = replace(end, h=0.0), None
        self.system.check(end.x)
        return Step(start, end.x, end.h, pushing, self._settle(end.values > 0))

    def _settle(self, on: Flags) -> tuple[SwitchEvent, ...]:
        """Set the switches to their current signs and return the events, pair by pair."""
        changed, events, between = on != self._on, list[SwitchEvent](), self._on.copy()
        if not changed.any():
            return ()
        width, before = self.system.per_pair, self.system.pushing
        turned = np.flatnonzero((changed & self._relevant)[: self._of_pairs])
        for pair in dict.fromkeys((turned // width).tolist()):
            both = slice(width * pair, width * (pair + 1))
            between[both] = on[both]
            events.append(SwitchEvent(int(turned[turned // width == pair][0]), self.system.pushing_where(between)))
        self._set(on)
        if self.system.pushing != before:
            self._choose_method()
            self._stand(self._here.x)
        return tuple(events)

    def _set(self, on: Flags) -> None:
        self._on, self._relevant = on, self.system.relevant(on)
        self._of_pairs = self.system.num_pairs * self.system.per_pair
        pushing = self.system.pushing_where(on)
        if pushing != self.system.pushing:
            self.system.push(pushing)

    def _choose_method(self) -> None:
        self._is_stiff, self._hits, self._left = bool(self.system.contact_is_stiff and self.system.pushing), 0, LOOK

    def _stand(self, x: Array) -> None:
        rates = self.system.rates(x)
        self._here = _Reach(0.0, x, rates, 0.0, *self.system.watch(x, rates))
        self._jacobian = None


def relative(error: Array, x: Array, ahead: Array, sizes: Any = 1.0) -> float:
    """Return the root mean square of an error relative to max(sizes, |x|)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean((error / np.maximum(sizes, np.maximum(np.abs(x), np.abs(ahead)))) ** 2)))


def deepest_contacts(system: System, steps: Sequence[Step]) -> tuple[ContactPoint, ...]:
    """Return, for each active pair in an interval, its contact point of largest depth at the ends of steps."""
    deepest: dict[int, ContactPoint] = {}
    for step in steps:
        for x in (step.x, step.ahead) if step.pushing else ():
            for pair, point in system.points_at(x, step.pushing):
                if pair not in deepest or point.depth > deepest[pair].depth:
                    deepest[pair] = point
    return tuple(deepest[pair] for pair in sorted(deepest))
