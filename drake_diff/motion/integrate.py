"""Error-controlled integration of motions whose equations change where a contact begins or stops to push.

A `System` has switches, values that are above 0 where they are on. Between two events the switches stay and the
equations are smooth, so that a method keeps its order, and so does the derivative of what it does: a step ends where a
switch turns. One that turns twice within a step has turned at neither end of it. Where it comes nearer to 0 at the
start and goes away from it at the end, what is between them is looked at; a system that does not know how its
switches change names the parts of a step at which to look.

Friction that holds is a damper of rate up to 15/8 mu f / (v_s m), which keeps explicit steps short long after the
motion itself has become slow. Where the explicit steps of Dormand and Prince come near the end of their stability,
those of Rodas5P take over, until explicit ones would be as long.
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

TOLERANCE = 1e-9  # of each step, relative to max(sizes, |x|)
SHORTEST = 1e-14  # [s] a step that is shorter does not move time
ROOT = 1e-13  # of a step: how near to its event it ends
SHALLOW = 1e-13  # [m] overlap that begins and ends within a step and is not looked for
STABLE = 1.0  # of a step's length times the rate at which its stages move apart; the explicit method is stable to 3.3
HITS = 5  # explicit steps in a row over it before implicit ones take over
LOOK = 8  # implicit steps between looks at the largest rate
Pairs = tuple[int, ...]  # those that push
Flags = NDArray[np.bool_]


class System:
    """Rates x' of a state (n,) where a given set of pairs pushes, `pushing`, and the switches of all pairs.

    The first switches are `per_pair` of each pair; more may follow, at which steps end and rates do not jump.
    """

    time_step: float  # [s] the length of step to begin with
    num_pairs: int
    per_pair = 1
    slack: Any = 0.0  # (switches,) by how much the wrong sign is none
    pushing: Pairs = ()
    contact_is_stiff = False  # whether steps are implicit wherever a pair pushes
    used = 0  # evaluations of the rates
    most = 1_000_000  # of these
    sizes: Any = 1.0  # (n,) of the states: errors are relative to these at least

    def push(self, pairs: Pairs) -> None:
        """Take the equations where `pairs` push."""
        self.pushing = pairs

    def rates(self, x: Array) -> Array:
        """(n,)"""
        raise NotImplementedError

    def slopes(self, x: Array, rates: Array) -> Array:
        """(n, n) of the rates at `x`, where they are `rates` (n,)."""
        raise NotImplementedError

    def watch(self, x: Array, rates: Array) -> tuple[Array, Array]:
        """The switches' values, and how these change where the state changes by `rates`; 0 where it is not known."""
        raise NotImplementedError

    def pushing_where(self, on: Flags) -> Pairs:
        """The pairs that push where these switches are on."""
        raise NotImplementedError

    def relevant(self, on: Flags) -> Flags:
        """The switches that change something when they turn, where these are on."""
        return np.ones(len(on), dtype=bool)

    def parts(self, h: float) -> Sequence[float]:
        """The parts of a step of length `h` [s] at which to look for switches that have turned."""
        return ()

    def check(self, x: Array) -> None:
        """SimulationError where the motion has no state `x`."""

    def points_at(self, x: Array, pairs: Pairs) -> Iterable[tuple[int, ContactPoint]]:
        """Of each of `pairs` that pushes at `x`."""
        return ()

    def explicit(self, x: Array, rates: Array, h: float) -> tuple[Array, Array, float, float]:
        """Where a step of `h` [s] leads, the rates there, its error, and the rate at which its stages move apart."""
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
    """The number of a switch that turned, and the pairs that push from then on."""

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
    """Where a step of length `h` leads."""

    h: float
    x: Array
    rates: Array
    stiffness: float
    values: Array  # of the switches
    slopes: Array


class Integrator:
    """The motion of a system from a state."""

    def __init__(self, system: System, tolerance: float = TOLERANCE, deadline: float = np.inf):
        self.system, self.tolerance, self.deadline = system, tolerance, deadline
        self._here: _Reach
        self._jacobian: Array | None
        self._is_stiff, self._hits, self._left = False, 0, 0  # explicit steps over STABLE, implicit ones to the LOOK

    def start(self, x: Array) -> None:
        """Stand at `x` (n,)."""
        system, x = self.system, np.array(x, dtype=float)
        system.used, self._length = 0, system.time_step
        self._set(system.watch(x, np.zeros(len(x)))[0] > 0)
        self._choose_method()
        self._stand(x)

    def advance(self, duration: float) -> list[Step]:
        """The steps of the next `duration` [s] under the system's input.

        SimulationError where the motion has no end: its rates are not finite, or it is too stiff. TimeoutError where
        this thread has worked (`time.thread_time`) until the deadline [s].
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
        self._length = max(self._length, next_length) if is_cut else next_length  # a step that is cut says nothing
        end = self._until_change(_Reach(length, x, rates, stiffness, *self.system.watch(x, rates)))
        return self._accept(end)

    def _take(self, h: float) -> tuple[Array, Array, float, float]:
        """Where a step leads, the rates there, its error, and the rate at which its stages move apart."""
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
        """Below 0 where a switch has another sign than at the start of the step."""
        signed = np.where(self._on, values, -values) + self.system.slack
        return float(np.min(signed, where=self._relevant, initial=np.inf))

    def _until_change(self, reach: _Reach) -> _Reach:
        """The end of the step, or of what is before the first switch that turns in it, just past that."""
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
        """What leads to where a switch has turned that is back at the end of the step."""
        here, h = self._here, reach.h
        for s in self.system.parts(h):  # by the cubic of both ends' slopes
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
        """Where a switch has turned between two states, at the second of which it is back: it is taken as convex."""
        side = 1.0 if self._on[i] else -1.0
        while last.h - first.h > SHORTEST:
            a, b, ra, rb = (side * values[i] for values in (first.values, last.values, first.slopes, last.slopes))
            width = last.h - first.h
            meeting = min(max((b - a - rb * width) / (ra - rb), 0.0), width)  # of the tangents
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
        """Take the switches as they are now; the events, pair by pair."""
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
    """The root mean square of an error, relative to max(sizes, |x|)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean((error / np.maximum(sizes, np.maximum(np.abs(x), np.abs(ahead)))) ** 2)))


def deepest_contacts(system: System, steps: Sequence[Step]) -> tuple[ContactPoint, ...]:
    """Of each pair that pushes in an interval, where it is deepest at an end of a step."""
    deepest: dict[int, ContactPoint] = {}
    for step in steps:
        for x in (step.x, step.ahead) if step.pushing else ():
            for pair, point in system.points_at(x, step.pushing):
                if pair not in deepest or point.depth > deepest[pair].depth:
                    deepest[pair] = point
    return tuple(deepest[pair] for pair in sorted(deepest))
