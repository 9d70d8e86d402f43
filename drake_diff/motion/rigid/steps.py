"""The motion of hard contact over a model's intervals, impact by impact, and its derivative with saltation matrices.

Between events the motion is smooth. At an impact at time t* with the gap g falling, the reset x+ = R(x-) and the rates
f- and f+ before and after, what a small change of the state becomes is (Leine and Nijmeijer, "Dynamics and Bifurcations
of Non-Smooth Mechanical Systems", 2004)

    Xi = dR/dx + (f+ - dR/dx f-) g_x / (g_x f-)

and where a closed contact lets go, as its force falls through 0, R is the identity and g that force.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.exceptions import GradientError, ModelError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector, select
from drake_diff.motion.dormand_prince import LEAST, STAGES, factor
from drake_diff.motion.flow.steps import Chooser
from drake_diff.motion.rigid.contact import TOUCHES, RigidContact
from drake_diff.motion.rigid.impact import STRIKES, Impact, plant_of, strike
from drake_diff.motion.rigid.plant import Closed, Smooth
from drake_diff.motion.rollout import check_inputs

METHOD = "rigid"
TOLERANCE = 1e-11  # of each step, relative to max(1, |x|)
BUDGET = 30.0  # [s] of wall time
SHORTEST = 1e-13  # [s]
ENDLESS = 1e-5  # [s] between two impacts of a contact: they have no end
GRAZES = 1e-9  # of the sizes of a gap's slope and of the rates: less is no crossing
MOST_HALVES, MOST_ROUNDS = 30, 100
LOOKED = 8  # places in a step at which gaps are looked at
TOGETHER = 1e-9  # [m] gaps that close at once
PARTS = 1e-9  # [N] relative to the largest force of a contact: one that pulls


@dataclass(frozen=True, eq=False)
class Piece:
    """An accepted step: where it began, under which input, for how long [s], and which contacts were closed."""

    x: Array
    u: Array
    h: float
    closed: Closed


@dataclass(frozen=True, eq=False)
class Release:
    """A contact that let go at the state `x` (nx,) as its force fell to 0; which were closed before and after."""

    time: float
    x: Array
    u: Array
    contact: int
    before: Closed
    after: Closed


@dataclass(frozen=True, eq=False)
class Struck:
    """An impact on the way; which contacts were closed before and after, and which of them struck."""

    impact: Impact
    u: Array
    striking: tuple[int, ...]
    before: Closed
    after: Closed


@dataclass
class RigidFlow:
    """A motion: its pieces and events in order, and how many there were at the end of each interval."""

    begin: Array
    parts: list[Piece | Struck | Release] = field(default_factory=list)
    ends: list[int] = field(default_factory=list)
    xs: list[Array] = field(default_factory=list)  # (nx,) at the end of each interval

    @property
    def events(self) -> list[Struck | Release]:
        """In order."""
        return [part for part in self.parts if not isinstance(part, Piece)]

    @property
    def impacts(self) -> tuple[Impact, ...]:
        """In order."""
        return tuple(part.impact for part in self.parts if isinstance(part, Struck))


@dataclass(frozen=True, eq=False)
class RigidMotion(ShowsItsRepr):
    """A motion with hard contact; `rigid_motion` makes one. Arrays are read-only.

    Attributes:
        times: (N+1,) [s].
        xs: (N+1, nx) the states.
        us: (N, nu) the inputs.
        impacts: `Impact`s in order.
        by_x0: (nx, nx) the derivative of the last state by the first.
        by_restitution, by_friction: (nx,) of the last state.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.01)
        >>> x0 = np.array(model.default_state)
        >>> x0[6] = 0.6
        >>> dd.motion.rigid_motion(model, x0, dd.motion.RigidContact(0.8, friction=0), num_steps=100)
        RigidMotion of 1 s with 2 impacts, at 0.319275, 0.830116 s
    """

    times: Array
    xs: Array
    us: Array
    impacts: tuple[Impact, ...]
    _steps: RigidSteps
    _flow: RigidFlow

    def __repr__(self) -> str:
        count = len(self.impacts)
        at = ", ".join(f"{impact.time:.6g}" for impact in self.impacts[:8])
        more = ", ..." if count > 8 else ""
        told = f", at {at}{more} s" if count else ""
        return f"RigidMotion of {self.times[-1]:g} s with {count} impact{'s' * (count != 1)}{told}"

    @cached_property
    def derivatives(self) -> tuple[StepDerivatives, ...]:
        """Of each interval, by the state, the input, restitution and friction; GradientError where one has none."""
        return tuple(self._steps.derivatives(self._flow))

    @cached_property
    def _by_start(self) -> Array:
        """(nx, nx + np)."""
        nx = self.xs.shape[1]
        total = np.hstack([np.eye(nx), np.zeros((nx, len(self._steps.names)))])
        for step in self.derivatives:
            total = step.A @ total
            total[:, nx:] += step.C
        return total

    @property
    def by_x0(self) -> Array:
        """(nx, nx)."""
        return frozen(self._by_start[:, : self.xs.shape[1]])

    @property
    def by_restitution(self) -> Array:
        """(nx,)."""
        return frozen(self._by_start[:, self.xs.shape[1]])

    @property
    def by_friction(self) -> Array:
        """(nx,)."""
        if len(self._steps.names) < 2:
            raise GradientError("friction is the model's own: give RigidContact(friction=...) for a derivative by it")
        return frozen(self._by_start[:, self.xs.shape[1] + 1])


class RigidSteps:
    """The motion of a model's hard contacts; ModelError where it has none."""

    def __init__(self, model: Model, vector: ParameterVector, law: RigidContact, tolerance: float = TOLERANCE):
        if vector.parameters:
            raise ModelError(
                f"hard contact has no derivative by {vector.parameters[0].name}: it has those by its own restitution "
                "and friction, which need not be asked for"
            )
        self.model, self.law, self.plant, self.tolerance = model, law, plant_of(model, law), tolerance
        self.friction = self.plant.frictions(law.friction)
        self.names = ("restitution", "friction") if law.friction is not None else ("restitution",)

    def roll(self, x0: Array, choose: Chooser, count: int) -> tuple[Array, Array, RigidFlow]:
        """xs (N+1, nx) at the ends of the intervals, us (N, nu), and the motion."""
        runner, h = _Runner(self, x0), self.model.time_step
        xs, us = np.empty((count + 1, self.model.nx)), np.empty((count, self.model.nu))
        xs[0] = x0
        for k in range(count):
            us[k] = choose(xs[k], k)
            xs[k + 1] = runner.advance(us[k], k * h, (k + 1) * h)
        return xs, us, runner.found

    def motion(self, x0: Array, us: Array) -> RigidMotion:
        """Under the inputs `us` (N, nu)."""
        xs, _, flow = self.roll(x0, lambda x, k: us[k], len(us))
        times = frozen(self.model.time_step * np.arange(len(xs)))
        return RigidMotion(times, frozen(xs), frozen(us), flow.impacts, self, flow)

    def derivatives(self, flow: RigidFlow) -> list[StepDerivatives]:
        """Of the intervals of a motion; GradientError where an event has none."""
        nx, nu, steps, begin = self.model.nx, self.model.nu, list[StepDerivatives](), 0
        for end, x_next in zip(flow.ends, flow.xs, strict=True):
            total = np.hstack([np.eye(nx), np.zeros((nx, nu + 2))])
            for part in flow.parts[begin:end]:
                if isinstance(part, Piece):
                    change = self._along(part)
                    total = change[:, :nx] @ total
                    total[:, nx : nx + nu] += change[:, nx:]
                else:
                    total = self._across(part, total)
            columns = (frozen(total[:, :nx]), frozen(total[:, nx : nx + nu]))
            C = frozen(total[:, nx + nu : nx + nu + len(self.names)])
            impacts = sum(isinstance(part, Struck) for part in flow.parts[begin:end])
            told = f"the motion of hard contact, {impacts} impact{'s' * (impacts != 1)}"
            by = (METHOD,) * len(self.names)
            steps.append(StepDerivatives(frozen(x_next), *columns, C, self.names, by, METHOD, told))
            begin = end
        return steps

    def _along(self, piece: Piece) -> Array:
        """(nx, nx + nu) of a step at its length."""
        nx, nu, smooth = self.model.nx, self.model.nu, self.plant.smooth(piece.closed)
        identity = np.hstack([np.eye(nx), np.zeros((nx, nu))])
        values, changes, at, change = list[Array](), list[Array](), piece.x, identity
        for weights in STAGES:
            values.append(smooth.rates_at(at, piece.u))
            slope = smooth.slopes_at(at, piece.u)
            moved = slope[:, :nx] @ change
            moved[:, nx:] += slope[:, nx:]
            changes.append(moved)
            at = piece.x + piece.h * np.tensordot(weights, values, axes=1)
            change = identity + piece.h * np.tensordot(weights, changes, axes=1)
        return change

    def _across(self, event: Struck | Release, total: Array) -> Array:
        """(nx, nx + nu + 2) after an event, of what it was before."""
        nx, nu, plant = self.model.nx, self.model.nu, self.plant
        if isinstance(event, Release):
            before, after = plant.smooth(event.before), plant.smooth(event.after)
            rates, rates_after = before.rates_at(event.x, event.u), after.rates_at(event.x, event.u)
            i = [contact for contact, _ in event.before].index(event.contact)
            row = before.normal_slopes_at(event.x, event.u)[i]
            reset, by = np.eye(nx), row[:nx] @ total
            by[nx : nx + nu] += row[nx:]
            name, when = plant.names[event.contact], event.time
        else:
            impact = event.impact
            before, after = plant.smooth(event.before), plant.smooth(event.after)
            rates, rates_after = before.rates_at(impact.x_before, event.u), after.rates_at(impact.x_after, event.u)
            if len(event.striking) > 1:
                names = ", ".join(plant.names[i] for i in event.striking)
                raise GradientError(
                    f"{names} strike at once at {impact.time:.6g} s: which comes first changes with the state, so that "
                    "there is no derivative"
                )
            row = plant.gap_slopes(impact.x_before)[event.striking[0]]
            reset, by = impact.by_x, row @ total
            name, when = plant.names[event.striking[0]], impact.time
        rate = float(row[:nx] @ rates)
        jump = rates_after - reset @ rates
        if abs(rate) <= GRAZES * float(np.linalg.norm(row[:nx]) * np.linalg.norm(rates)):
            if isinstance(event, Release) and np.max(np.abs(jump)) <= GRAZES * max(1.0, float(np.max(np.abs(rates)))):
                return total
            raise GradientError(f"{name} barely touches at {when:.6g} s: there is no derivative")
        found = np.asarray(reset @ total + np.outer(jump / rate, by))
        if isinstance(event, Struck):
            found[:, nx + nu] += event.impact.by_restitution
            found[:, nx + nu + 1] += event.impact.by_friction
        return found


def rigid_motion(
    model: Model,
    x0: ArrayLike,
    contact: RigidContact,
    us: ArrayLike | None = None,
    *,
    num_steps: int | None = None,
) -> RigidMotion:
    """The motion of a model whose contacts are hard, impact by impact, and its derivatives.

    Args:
        model: The model, in whose intervals the inputs are held.
        x0: (nx,) the first state.
        contact: Restitution, friction and the law.
        us: (N, nu) the inputs [N or N m]; may be left out where the model has no actuators.
        num_steps: N, where `us` does not say it.

    Returns:
        States, impacts and derivatives.

    Raises:
        SimulationError: An impact has no unique answer; a contact slides on with friction, or bounces infinitely
            often; shapes touch that have no law here, or a joint limit is reached.
        ModelError: The model has no such motion.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.01)
        >>> x0 = np.array(model.default_state)
        >>> x0[6] = 0.2
        >>> landed = dd.motion.rigid_motion(model, x0, dd.motion.RigidContact(friction=0), num_steps=30)
        >>> landed.impacts[0], landed.xs[-1, [6, 12]].round(6).tolist()  # where it stays
        (Impact of sphere::ball and ground::ground: frictionless, 0.981 J lost at 0.142784 s, [0.1, 0.0])
    """
    first, inputs = finite_array("x0", x0, (model.nx,)), check_inputs(model, us, num_steps)
    return RigidSteps(model, select(model, ()), contact).motion(np.asarray(first), inputs)


def first_zero(function: Callable[[float], float], low: float, high: float) -> float:
    """Where a function that is above 0 at `low` and not at `high` is 0, to rounding: the Illinois rule, and halves."""
    f_low, f_high, side = function(low), function(high), 0
    for _ in range(MOST_ROUNDS):
        if high - low <= 4e-16 * max(high, 1e-3) or f_high == 0:
            break
        middle = high - f_high * (high - low) / (f_high - f_low)
        if not low < middle < high:
            middle = (low + high) / 2
        value = function(middle)
        if value > 0:
            low, f_low = middle, value
            f_high = f_high / 2 if side > 0 else f_high
            side = 1
        else:
            high, f_high = middle, value
            f_low = f_low / 2 if side < 0 else f_low
            side = -1
    return high


def saltation(impact: Impact, rates: Array, rates_after: Array) -> Array:
    """(nx, nx) the saltation matrix of an impact of one contact, of the rates (nx,) before and after it."""
    plant, contacts = impact.record.plant, impact.record.contacts
    row = plant.gap_slopes(impact.x_before)[contacts[int(np.flatnonzero(impact.record.strikes)[0])]]
    return np.asarray(impact.by_x + np.outer(rates_after - impact.by_x @ rates, row) / float(row @ rates))


class _Runner:
    """A motion under way."""

    def __init__(self, steps: RigidSteps, x0: Array):
        self.steps, self.plant, self.law, self.model = steps, steps.plant, steps.law, steps.model
        self.x, self.h_next, self.began = np.array(x0, dtype=float), steps.model.time_step, time.monotonic()
        self.found = RigidFlow(self.x.copy())
        self.closed: Closed = ()
        self.last: dict[int, list[float]] = {}  # the times of impacts of each contact
        self.lower, self.upper = self.model.position_limits
        gaps, rates = self.plant.gaps(self.x), self.plant.gap_rates(self.x)
        if np.any(gaps < -TOUCHES):
            i = int(np.argmin(gaps))
            raise SimulationError(f"{self.plant.names[i]} overlap by {-gaps[i]:.3g} m at the start")
        rests = np.flatnonzero((np.abs(gaps) <= TOUCHES) & (np.abs(rates) <= TOUCHES))
        self.resting = tuple((int(i), self._sticks(int(i))) for i in rests)
        self.striking_first = tuple(np.flatnonzero((gaps <= 0) & (rates < -TOUCHES)).tolist())

    def _sticks(self, contact: int) -> bool:
        return bool(self.steps.friction[contact] > 0)

    def advance(self, u: Array, now: float, end: float) -> Array:
        """(nx,) at `end` [s], from `now` on under `u` (nu,)."""
        if self.striking_first:
            self._strike(self.striking_first, u, now)
            self.striking_first = ()
        elif self.resting or self.closed:
            self.closed = self._kept(tuple(dict.fromkeys((*self.closed, *self.resting))), u, now)
        self.resting = ()
        while end - now > SHORTEST * max(1.0, end):
            if time.monotonic() - self.began > BUDGET:
                raise SimulationError(f"the motion is too stiff: {BUDGET:g} s of work did not reach {end:.4g} s")
            now += self._advance(u, now, min(self.h_next, end - now))
        self.found.ends.append(len(self.found.parts))
        self.found.xs.append(self.x.copy())
        return self.x.copy()

    def _advance(self, u: Array, now: float, length: float) -> float:
        """One accepted step of at most `length` [s], and the event at its end if there is one."""
        smooth, wanted = self.plant.smooth(self.closed), length
        while True:
            ahead, error = smooth.step_from(self.x, u, length)
            size = self.steps.tolerance * np.maximum(1.0, np.maximum(np.abs(self.x), np.abs(ahead)))
            with np.errstate(all="ignore"):
                ratio = float(np.sqrt(np.mean((error / size) ** 2))) if np.all(np.isfinite(ahead)) else float("inf")
            if ratio <= 1:
                break
            length *= factor(ratio) if np.isfinite(ratio) else LEAST
            if length < SHORTEST:
                raise SimulationError(f"the motion cannot go on at {now:.6g} s: its rates are not finite or jump")
        self.h_next = length * factor(ratio) if length < wanted or ratio > 0 else self.h_next
        self.h_next = max(self.h_next, wanted)
        event = self._first_event(smooth, u, length, ahead)
        if event is not None:
            length, ahead = event[0], smooth.step_from(self.x, u, event[0])[0]
        self.found.parts.append(Piece(self.x.copy(), u.copy(), length, self.closed))
        self.x = ahead
        self._check(now + length)
        if event is not None:
            self._turn(event[1], event[2], u, now + length)
        return length

    def _first_event(self, smooth: Smooth, u: Array, length: float, ahead: Array) -> tuple[float, str, int] | None:
        """The length, kind and contact of the first gap that closes, or force that ends, within a step."""
        held = [i for i, _ in self.closed]
        places = np.linspace(0, length, LOOKED + 1)
        states = [self.x, *(smooth.step_from(self.x, u, h)[0] for h in places[1:-1]), ahead]
        gaps = np.array([self.plant.gaps(x) for x in states])
        gaps[:, held] = np.inf
        found: list[tuple[float, str, int]] = []
        for i in np.flatnonzero(np.any(gaps[1:] <= 0, axis=0)).tolist():
            k = int(np.argmax(gaps[1:, i] <= 0)) + 1
            low: float | None = float(places[k - 1])
            if k == 1 and gaps[0, i] <= 0:
                low = self._apart(smooth, u, i, float(places[1]))
            if low is None:
                continue

            def gap(h: float, i: int = i) -> float:
                return float(self.plant.gaps(smooth.step_from(self.x, u, h)[0])[i])

            found.append((first_zero(gap, low, float(places[k])), "closes", i))
        if self.closed:
            found += self._lets_go(smooth, u, places, states)
        return min(found) if found else None

    def _apart(self, smooth: Smooth, u: Array, i: int, high: float) -> float | None:
        """A time [s] before `high` at which contact i, which opened, is apart; None where it never was."""
        low = high
        for _ in range(MOST_HALVES):
            low /= 2
            if self.plant.gaps(smooth.step_from(self.x, u, low)[0])[i] > 0:
                return low
        return None

    def _lets_go(self, smooth: Smooth, u: Array, places: Array, states: list[Array]) -> list[tuple[float, str, int]]:
        forces = [smooth.forces_at(x, u) for x in states]
        pushes = np.array([along for _, along in forces])
        found = []
        for j, (i, sticks) in enumerate(self.closed):
            size = float(np.max(np.abs(forces[0][0][j])))

            def push(h: float, j: int = j) -> float:
                return float(smooth.forces_at(smooth.step_from(self.x, u, h)[0], u)[1][j])

            def grip(h: float, i: int = i, j: int = j) -> float:
                return self._grip(i, *(a[j] for a in smooth.forces_at(smooth.step_from(self.x, u, h)[0], u)))

            below = np.flatnonzero(pushes[1:, j] < -PARTS * max(size, 1.0))
            if len(below):
                k = int(below[0]) + 1
                if pushes[k - 1, j] > 0:
                    found.append((first_zero(push, places[k - 1], places[k]), "lets go", i))
            elif sticks and np.isfinite(self.steps.friction[i]):
                grips = np.array([self._grip(i, f[j], along[j]) for f, along in forces])
                lost = np.flatnonzero(grips[1:] < -PARTS * max(size, 1.0))
                if len(lost):
                    k = int(lost[0]) + 1
                    at = first_zero(grip, places[k - 1], places[k]) if grips[k - 1] > 0 else places[k - 1]
                    found.append((at, "slips", i))
        return found

    def _grip(self, contact: int, force: Array, push: float) -> float:
        """[N] what friction could hold beyond what it does."""
        along = float(np.sqrt(max(float(force @ force) - push**2, 0.0)))
        return float(self.steps.friction[contact]) * push - along

    def _turn(self, kind: str, contact: int, u: Array, now: float) -> None:
        """What happens at an event."""
        if kind == "closes":
            gaps = self.plant.gaps(self.x)
            rates, held = self.plant.gap_rates(self.x), [i for i, _ in self.closed]
            others = [i for i in np.flatnonzero(np.abs(gaps) <= TOGETHER).tolist() if i not in held]
            striking = tuple(i for i in others if i == contact or rates[i] < -STRIKES)
            self._strike(striking, u, now)
        elif kind == "lets go":
            before = self.closed
            self.closed = self._kept(tuple(c for c in before if c[0] != contact), u, now)
            self.found.parts.append(Release(now, self.x.copy(), u.copy(), contact, before, self.closed))
        else:
            self._slips(contact, now)

    def _slips(self, contact: int, now: float) -> None:
        raise SimulationError(
            f"{self.plant.names[contact]} slides on with friction from {now:.6g} s on, which hard contact does not "
            'follow: take friction=0 or numpy.inf, or method="continuous"'
        )

    def _strike(self, striking: tuple[int, ...], u: Array, now: float) -> None:
        self._check_end(striking, now)
        held = tuple(i for i, _ in self.closed)
        contacts = (*held, *(i for i in striking if i not in held))
        impact = strike(self.plant, self.x, self.law, contacts, held, now)
        before, self.x = self.closed, np.array(impact.x_after)
        rates = self.plant.gap_rates(self.x)
        stays = []
        for i, way in zip(contacts, impact.ways, strict=True):
            if abs(rates[i]) <= STRIKES:
                if way == "slides":
                    self._slips(i, now)
                stays.append((i, self._sticks(i)))
        self.closed = self._kept(tuple(stays), u, now)
        self.found.parts.append(Struck(impact, u.copy(), striking, before, self.closed))

    def _check_end(self, striking: tuple[int, ...], now: float) -> None:
        """SimulationError where a contact bounces infinitely often."""
        for i in striking:
            times = self.last.setdefault(i, [])
            times.append(now)
            if len(times) > 2 and 0 < times[-1] - times[-2] < ENDLESS:
                one, other = times[-2] - times[-3], times[-1] - times[-2]
                part = min(other / one, 0.999999) if one > 0 else 0.0
                limit = now + other * part / (1 - part)
                raise SimulationError(
                    f"{self.plant.names[i]} bounces infinitely often: the bounces end at {limit:.6g} s, after which "
                    "this motion does not go"
                )

    def _kept(self, candidates: Closed, u: Array, now: float) -> Closed:
        """Those of the contacts that may be closed that stay so: they push, and the others part."""
        if not candidates:
            return ()
        found = []
        for bits in range(2 ** len(candidates)):
            closed = tuple(c for k, c in enumerate(candidates) if not bits >> k & 1)
            smooth = self.plant.smooth(closed)
            forces, along = smooth.forces_at(self.x, u)
            size = max(float(np.max(np.abs(forces), initial=0.0)), 1.0)
            if not np.all(np.isfinite(along)) or np.any(along < -PARTS * size):
                continue
            rate = smooth.rates_at(self.x, u)
            others = [c[0] for c in candidates if c not in closed]
            rising = self.plant.gap_accelerations(self.x, rate)[others]
            if np.all(rising >= -1e-9 * max(1.0, float(np.max(np.abs(rate))))):
                found.append((closed, forces, along))
        if not found:
            names = ", ".join(self.plant.names[i] for i, _ in candidates)
            raise SimulationError(f"no forces keep {names} apart from {now:.6g} s on")
        closed, forces, along = found[0]
        for j, (i, sticks) in enumerate(closed):
            friction = self.steps.friction[i]
            beyond = np.isfinite(friction) and self._grip(i, forces[j], along[j]) < -1e-9 * max(1.0, along[j])
            if sticks and beyond:
                self._slips(i, now)
        return closed

    def _check(self, now: float) -> None:
        self.plant.flow.check(self.x)
        gaps = self.plant.gaps(self.x)
        i = int(np.argmin(gaps)) if len(gaps) else 0
        if len(gaps) and gaps[i] < -TOUCHES:
            raise SimulationError(f"{self.plant.names[i]} enter each other by {-gaps[i]:.3g} m at {now:.6g} s")
        q = self.x[: self.model.nq]
        beyond = np.flatnonzero((q < self.lower) | (q > self.upper))
        if len(beyond):
            name = self.model.state_names[beyond[0]]
            raise SimulationError(f"{name} reaches a joint limit at {now:.6g} s, whose motion is not known here")
