"""Closed-loop simulation on the discrete plant, with sensor, estimator, controller, actuator, pushes and a fallback.

    x_k -> sensor -> estimator -> controller -> actuator -> plant -> x_(k+1)

The controller has its own period, a whole number of the plant's steps. All randomness comes from one seed. The
computation time of the controller is measured. It affects the simulation only if a latency budget is given: a late
answer is not used, and the last command is held.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.tree import JacobianWrtVariable

from drake_diff._base.arrays import (
    LARGEST_SEED,
    Array,
    array_with_gaps,
    count,
    finite_array,
    fraction,
    frozen,
    positive_float,
    scale,
)
from drake_diff._base.values import ShowsItsRepr
from drake_diff.exceptions import InputError, NonFiniteError, SimulationError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies
from drake_diff.model.step import advance, set_state
from drake_diff.model.tangent import TangentSpace, tangent_space
from drake_diff.motion.policy import PD
from drake_diff.motion.rollout import Meter, Rollout, roll_states

Controller = Callable[[Array, float], Any]  # u (nu,) = controller(x (nx,), t [s])
OK, LATE = "ok", "late"
FAILED, UNSEEN = "the controller failed:", "nothing was seen for"  # prefixes of the controller's status
MODES = ("hold", "damp", "stop")
Reader = Callable[[int, Array], Array | None]
Drive = Callable[[int, Array], Array]


@dataclass(frozen=True, eq=False)
class Sensor:
    """A sensor that measures the state with noise, bias, its own rate, a delay and lost samples.

    A sample is y = plus(x, bias + noise N(0, 1)), on the tangent space of the state. Until a sample arrives, the first
    state is assumed to be known.

    Args:
        noise: standard deviation, a number or (nt,), in the units of the tangent space.
        bias: a number or (nt,), in the same units.
        delay: the delay of a sample in controller steps.
        every: a sample is taken in each `every`-th controller step.
        dropout: the probability that a sample is lost, in [0, 1).

    Raises:
        InputError: a number is out of its range.

    Example:
        >>> dd.loop.Sensor(noise=0.01, delay=2).delay
        2
    """

    noise: ArrayLike = 0.0
    bias: ArrayLike = 0.0
    delay: int = 0
    every: int = 1
    dropout: float = 0.0

    def __post_init__(self) -> None:
        count("Sensor.delay", self.delay, 0)
        count("Sensor.every", self.every, 1)
        fraction("Sensor.dropout", self.dropout)

    def start(self, space: TangentSpace, random: np.random.Generator) -> Reader:
        """Return a function of (k, x_k) that returns the sample that arrives at step k, or None."""
        noise, bias = scale("Sensor.noise", self.noise, space.size), np.broadcast_to(self.bias, space.size)
        if np.any(noise < 0):
            raise InputError("Sensor.noise", got=self.noise, expected="numbers of at least 0")
        samples: list[Array | None] = []

        def read(k: int, x: Array) -> Array | None:
            # Random numbers are drawn in every step, so that rate and dropout do not affect the noise of other steps.
            shift, received = noise * random.standard_normal(space.size), random.uniform() >= self.dropout
            due = k % self.every == 0 and (received or k == 0)
            samples.append(space.plus(x, bias + shift) if due else None)
            return samples[max(0, k - self.delay)]

        return read


class Estimator(Protocol):
    """A protocol for estimators, with one estimate per step. `start` is called before each run to reset the state."""

    def start(self, x0: Array) -> None:
        """Reset the estimator. `x0` (nx,) is the initial state, which is known."""
        ...

    def estimate(self, observation: Array | None, u: Array | None) -> Array:
        """Return (nx,) the estimate from the new sample, or None, and the last command (nu,), or None at first."""
        ...


class Hold:
    """An estimator that returns the last sample.

    Example:
        >>> hold = dd.loop.Hold()
        >>> hold.start([1.0, 2.0])
        >>> hold.estimate(None, None)
        [1.0, 2.0]
    """

    def start(self, x0: Array) -> None:
        self._last = x0

    def estimate(self, observation: Array | None, u: Array | None) -> Array:
        self._last = self._last if observation is None else observation
        return self._last

    def __repr__(self) -> str:
        return "Hold: the last sample"


class Predictor:
    """An estimator that simulates a model from the last sample on, under the commands since that sample.

    It compensates for a known delay of the sensor and for lost samples.

    Args:
        model: the plant as the estimator knows it.
        delay: the age of a sample when it arrives, in steps.

    Raises:
        InputError: `delay` is not a whole number of at least 0.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> loop = dd.loop.Loop(sensor=dd.loop.Sensor(delay=5), estimator=dd.loop.Predictor(model, 5))
        >>> run = dd.loop.closed_loop(model, lambda x, t: [-5 * x[0]], x0=[0.5, 0], num_steps=20, loop=loop)
        >>> bool(np.allclose(run.estimates, run.motion.xs[:-1]))
        True
    """

    def __init__(self, model: Model, delay: int):
        self.model, self.delay = model, count("Predictor.delay", delay, 0)

    def start(self, x0: Array) -> None:
        self._seen, self._k = x0, 0
        self._since: deque[Array] = deque()

    def estimate(self, observation: Array | None, u: Array | None) -> Array:
        if u is not None:
            self._since.append(u)
            self._k += 1
        if observation is not None:
            self._seen = observation
            while len(self._since) > min(self.delay, self._k):
                self._since.popleft()
        return np.asarray(roll_states(self.model, self._seen, np.array(self._since))[-1])

    def __repr__(self) -> str:
        return f"Predictor of {self.model.name}: samples {self.delay} steps old"


@dataclass(frozen=True, eq=False)
class Actuator:
    """An actuator that applies commands with a delay, its own rate, limits, a factor and a first-order lag.

    In each controller step of length H, the applied input moves towards the command that has arrived:
    u+ = u + (1 - exp(-H / lag)) (strength clip(command, lower, upper) - u). It is zero before a command arrives.

    Args:
        delay: the delay of a command in controller steps.
        every: a command is accepted in each `every`-th controller step.
        lower, upper: limits of the commands, numbers or (nu,), in the units of the input.
        strength: factor on the commands, a number or (nu,).
        lag: time constant [s].

    Raises:
        InputError: a number is out of its range.

    Example:
        >>> dd.loop.Actuator(upper=10.0, lower=-10.0, lag=0.05).lag
        0.05
    """

    delay: int = 0
    every: int = 1
    lower: ArrayLike = -np.inf
    upper: ArrayLike = np.inf
    strength: ArrayLike = 1.0
    lag: float = 0.0

    def __post_init__(self) -> None:
        count("Actuator.delay", self.delay, 0)
        count("Actuator.every", self.every, 1)
        if not (np.isfinite(self.lag) and self.lag >= 0):
            raise InputError("Actuator.lag", got=self.lag, expected="a time [s] of at least 0")
        if np.any(np.asarray(self.lower) > np.asarray(self.upper)):
            raise InputError("Actuator.lower", got=self.lower, expected=f"at most upper, {self.upper!r}")

    def start(self, nu: int, period: float) -> Drive:
        """Return a function of (k, command (nu,)) that returns the input (nu,) applied in step k."""
        strength = scale("Actuator.strength", self.strength, nu)
        follow = 1.0 if self.lag == 0 else 1 - np.exp(-period / self.lag)
        commands: list[Array] = []
        applied = np.zeros(nu)

        def drive(k: int, command: Array) -> Array:
            nonlocal applied
            commands.append(command if k % self.every == 0 else commands[-1])
            arrived = commands[k - self.delay] if k >= self.delay else np.zeros(nu)
            applied = applied + follow * (strength * np.clip(arrived, self.lower, self.upper) - applied)
            return applied

        return drive


@dataclass(frozen=True, eq=False)
class Fallback:
    """A controller that takes over if the main one fails, or after more than `patience` steps without a measurement.

    Args:
        mode: "hold" repeats the last command. "damp" applies -damping v at the actuated joints, with v from the
            estimate. "stop" applies nothing. "damp" and "stop" command servos to the positions of their joints.
        patience: the largest number of controller steps without a measurement that is tolerated.
        damping: the coefficient of "damp", [N s/m] or [N m s/rad].

    Raises:
        UnknownNameError: the mode does not exist.
        InputError: `patience` is not a whole number of at least 0.

    Example:
        >>> dd.loop.Fallback("damp", damping=2.0).patience
        10
    """

    mode: Literal["hold", "damp", "stop"] = "stop"
    patience: int = 10
    damping: ArrayLike = 1.0

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise UnknownNameError("Fallback.mode", got=self.mode, known=MODES)
        count("Fallback.patience", self.patience, 0)

    def command(self, model: Model, estimate: Array, last: Array) -> Array:
        """Return (nu,) the command in place of the controller's."""
        if self.mode == "hold":
            return last
        if self.mode == "stop" or not model.nu or model.inputs.commanded.any():  # servos damp by their own gains
            return model.neutral_input(estimate)
        at_rest = np.concatenate([estimate[: model.nq], np.zeros(model.nv)])
        return np.asarray(PD(model, 0.0, self.damping, x_ref=at_rest)(estimate, 0.0))


@dataclass(frozen=True, eq=False)
class Push:
    """An impulse at the centre of mass of a body.

    Args:
        body: the body's name.
        impulse: (3,) [N s], in the world frame.
        at: simulated time [s].

    Example:
        >>> dd.loop.Push("cart", impulse=[0.5, 0, 0], at=1.0).body
        'cart'
    """

    body: str
    impulse: ArrayLike
    at: float


@dataclass(frozen=True, eq=False)
class Loop:
    """The components around a controller. By default, sensor and actuator are ideal.

    Args:
        sensor: measures the state.
        estimator: computes the controller's state from the measurements.
        actuator: applies the controller's commands.
        fallback: takes over if the controller fails; None ends the run at the failure.
        pushes: impulses on the plant.
        substeps: the number of the plant's steps in one controller step.
        latency_budget: [s] that the controller may take for an answer. If it takes longer, its last timely command is
            held (at first nothing is applied), and an event reports this. None waits for every answer.

    Example:
        >>> dd.loop.Loop(sensor=dd.loop.Sensor(noise=0.01), substeps=2).substeps
        2
    """

    sensor: Sensor = field(default_factory=Sensor)
    estimator: Estimator = field(default_factory=Hold)
    actuator: Actuator = field(default_factory=Actuator)
    fallback: Fallback | None = None
    pushes: Sequence[Push] = ()
    substeps: int = 1
    latency_budget: float | None = None


class LoopEvent(NamedTuple):
    """An event at the simulated time `t` [s]: fallback, recovery, push, late or failure."""

    t: float
    kind: str
    message: str


@dataclass(frozen=True, eq=False)
class LoopRows:
    """The recorded rows of a loop, one for each controller step. `xs` and `us` have one for each step of the plant."""

    xs: Array  # (n+1, nx)
    us: Array  # (n, nu)
    observations: Array  # (N, nx), NaN where nothing arrived
    estimates: Array  # (N, nx)
    commands: Array  # (N, nu)
    applied: Array  # (N, nu)
    controller_status: tuple[str, ...]  # "ok", "late", or why the fallback was active
    latencies: Array  # (N,) [s] the computation times of the controller on this machine
    ended: str
    failed_part: str
    controller_error: str


@dataclass(frozen=True, eq=False)
class ClosedLoop(LoopRows, ShowsItsRepr):
    """The result of a closed-loop simulation, with one row per controller step in read-only arrays; `save` writes it.

    `xs` and `us` are the plant's own steps, and `motion` has the measures along them. `ended` is "", or says when and
    why the run ended early. `failed_part` is "", or the part of the loop whose exception ended it: "controller",
    "sensor" or "estimator". `controller_error` is the type and message of the controller's exception.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> run = dd.loop.closed_loop(model, lambda x, t: [-x[0] - x[1]], x0=[0.1, 0], num_steps=50)
        >>> run.commands.shape, run.xs.shape, run.us.shape, run.ended
        ((50, 1), (51, 2), (50, 1), '')
    """

    motion: Rollout
    times: Array  # (N,) [s] of the controller's steps
    events: tuple[LoopEvent, ...]
    model: Model
    controller: Controller
    loop: Loop
    seed: int

    @property
    def latency_budget(self) -> float | None:
        """The time [s] that the controller had for an answer, or None without a limit."""
        return self.loop.latency_budget

    @property
    def late(self) -> int:
        """The number of the controller's answers that took longer than the budget, or 0 without a budget."""
        return 0 if self.latency_budget is None else int(np.sum(self.latencies > self.latency_budget))

    def __repr__(self) -> str:
        ok = self.controller_status.count(OK)
        lines = [
            f"closed loop of {self.model.name} under {name_of(self.controller)}",
            f"  {len(self.times)} steps of the controller, {len(self.us)} of the plant",
            f"  controller: ok in {ok} of {len(self.times)} steps; {len(self.events)} events",
            f"  last state: {np.array2string(self.xs[-1], precision=4, threshold=20)}",
        ]
        return "\n".join(lines + ([f"  ended early {self.ended}"] if self.ended else []))


def name_of(component: Any) -> str:
    """Return the description of a controller, sensor or estimator, or only the name of a user's function or class."""
    if type(component).__module__.split(".")[0] == __name__.split(".")[0]:
        return repr(component)
    return str(getattr(component, "__qualname__", type(component).__qualname__))


def closed_loop(
    model: Model, controller: Controller, x0: ArrayLike, num_steps: int, loop: Loop | None = None, *, seed: int = 0
) -> ClosedLoop:
    """Simulate a controller on the plant, together with the components of a loop.

    Args:
        model: the plant.
        controller: u (nu,) = controller(x (nx,), t [s]). Its method `start(x0)`, if it has one, is called first. Its
            attribute `status`, if it has one, is recorded after each step.
        x0: (nx,) the first state.
        num_steps: the number of controller steps.
        loop: sensor, estimator, actuator, fallback and pushes; None for ideal ones.
        seed: the seed of all randomness. The same seed gives the same run.

    Returns:
        The motion, and what was measured, estimated, commanded and applied. The run ends early if the plant cannot take
        a step, if the sensor or the estimator raises an error, or if the controller raises an error or gives an invalid
        answer and there is no fallback. `ended` says why.

    Raises:
        ShapeError, NonFiniteError: `x0` or an impulse is not an array of the right shape of finite numbers.
        UnknownNameError: a push names an unknown body.
        InputError: another argument is wrong.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> loop = dd.loop.Loop(actuator=dd.loop.Actuator(upper=0.5, lower=-0.5))
        >>> run = dd.loop.closed_loop(model, lambda x, t: [2.0], x0=[0, 0], num_steps=3, loop=loop)
        >>> run.applied[:, 0]
        array([0.5, 0.5, 0.5])
    """
    x0, steps = model.finite_state("x0", x0), count("num_steps", num_steps, 1)
    return _LoopRun(model, controller, loop or Loop(), seed).result(x0, steps)


def replayed(rows: LoopRows, model: Model, controller: Controller | None, loop: Loop, seed: int) -> ClosedLoop:
    """Run each part of a loop on the recorded `rows` as its inputs, and return the outputs for comparison.

    An error of a part thus affects neither another part nor the next step of the plant. Recorded outputs replace a part
    that is not executed: the controller if `controller` is None, and the `Recorded` parts of `loop`.
    """
    return _Replay(rows, model, controller, loop, seed).result(rows.xs[0], len(rows.commands))


class OpenLoop:
    """A controller that plays inputs back: u = us[k], k = round(t / time_step). The last input is held after the end.

    Args:
        us: (N, nu) the inputs.
        time_step: [s] between them.

    Raises:
        ShapeError, NonFiniteError, InputError: `us` is not N x nu finite numbers, N at least 1, or `time_step` not > 0.

    Example:
        >>> play = dd.loop.OpenLoop([[1.0], [2.0]], time_step=0.1)
        >>> play([0, 0], 0.1), play([0, 0], 5.0)
        (array([2.]), array([2.]))
    """

    def __init__(self, us: ArrayLike, time_step: float):
        self.us, self.time_step = finite_array("us", us, ("N", "nu")), positive_float("time_step [s]", time_step)
        if not len(self.us):
            raise InputError("us", got="0 steps", expected="at least one step")

    def __call__(self, x: Any, t: float) -> Any:
        return self.us[min(max(round(t / self.time_step), 0), len(self.us) - 1)]

    def __repr__(self) -> str:
        return f"OpenLoop of {len(self.us) * self.time_step:g} s in steps of {self.time_step:g} s"


class Recorded:
    """A sensor, estimator or actuator that plays back the recorded `rows` of a user's part, one per step."""

    def __init__(self, rows: Array):
        self.rows, self.count = rows, 0

    def start(self, *_: Any) -> Callable[[int, Any], Array | None]:
        """Begin with the first row. Return a function of (k, ...) that returns row k, or None if it is all NaN."""
        self.count = 0
        return lambda k, _: None if self.rows.shape[1] and np.all(np.isnan(self.rows[k])) else self.rows[k]

    def estimate(self, *_: Any) -> Array:
        """Return the next row."""
        self.count += 1
        return self.rows[self.count - 1]


class _LoopRun:
    """A simulation in progress."""

    def __init__(self, model: Model, controller: Controller, loop: Loop, seed: int):
        random = np.random.default_rng(count("seed", seed, 0, LARGEST_SEED))
        self.model, self.controller, self.loop, self.seed = model, controller, loop, seed
        self.period = count("Loop.substeps", loop.substeps, 1) * model.time_step
        if loop.latency_budget is not None:
            positive_float("Loop.latency_budget [s]", loop.latency_budget)
        self.read = loop.sensor.start(tangent_space(model), random)
        self.drive = loop.actuator.start(model.nu, self.period)
        self.pushes = []  # (the plant's step, body, impulse)
        for push in loop.pushes:
            if not (np.isfinite(push.at) and push.at >= 0):
                raise InputError("Push.at", got=push.at, expected="a time [s] of at least 0")
            if not model.plant.HasBodyNamed(push.body):
                raise UnknownNameError("Push.body", got=push.body, known=tuple(b.name() for b in bodies(model.plant)))
            body, impulse = model.plant.GetBodyByName(push.body), finite_array("Push.impulse", push.impulse, (3,))
            self.pushes.append((round(push.at / model.time_step), body, impulse))
        self.rows: list[tuple[Array, Array, Array, Array, str, float]] = []
        self.events: list[LoopEvent] = []
        self.unseen, self.in_charge = 0, True
        self.start_errors: dict[str, Exception] = {}
        self.ended = self.failed_part = self.controller_error = ""

    def result(self, x0: Array, num_steps: int) -> ClosedLoop:
        for name, component in (("estimator", self.loop.estimator), ("controller", self.controller)):
            try:
                if hasattr(component, "start"):
                    component.start(x0)
            except Exception as error:  # treated like an error of the first call
                self.start_errors[name] = error
        meter, xs = Meter(self.model), [x0]
        us: list[Array] = []
        for k in range(num_steps):
            u = self._decide(k, self._given("xs", len(us), xs[-1]))
            if u is None:
                break
            for _ in range(self.loop.substeps):
                x = self._pushed(len(us), self._given("xs", len(us), xs[-1]))
                try:
                    after = np.asarray(advance(self.model.double, x, u))
                except SimulationError as error:
                    self._end(k, f"the plant could not be stepped: {error}")
                    break
                meter.measure_step(x, after)
                xs.append(after)
                us.append(u)
            if self.ended:
                break
        self._finish()
        last = self._given("xs", len(us), xs[-1])
        set_state(self.model.double, last)
        meter.measure_state(last)
        motion = meter.result(np.array(xs), np.array(us).reshape(len(us), self.model.nu))
        steps, nx, nu = len(self.rows), self.model.nx, self.model.nu

        def column(i: int, size: int) -> Array:
            return frozen(np.array([row[i] for row in self.rows], dtype=float).reshape(steps, size))

        return ClosedLoop(
            xs=motion.xs,
            us=motion.us,
            motion=motion,
            times=frozen(self.period * np.arange(steps)),
            observations=column(0, nx),
            estimates=column(1, nx),
            commands=column(2, nu),
            applied=column(3, nu),
            controller_status=tuple(row[4] for row in self.rows),
            events=tuple(self.events),
            latencies=frozen([row[5] for row in self.rows]),
            ended=self.ended,
            failed_part=self.failed_part,
            controller_error=self.controller_error,
            model=self.model,
            controller=self.controller,
            loop=self.loop,
            seed=self.seed,
        )

    def _given(self, name: str, k: int, made: Any) -> Any:
        """Return the input of the next part of the loop, here the output `made` of this part."""
        return made

    def _finish(self) -> None:
        """Complete a run that has ended; a replay adds the recorded failure of a part."""

    def _decide(self, k: int, x: Array) -> Array | None:
        """Return the input that the actuator applies in step k, or None if the run ends."""
        fallback, t = self.loop.fallback, k * self.period
        last, component = self._given("commands", k - 1, self.rows[-1][2]) if self.rows else None, "sensor"
        try:  # sensor and estimator may be a user's code, like the controller
            seen = self.read(k, x)
            if seen is not None:
                seen = array_with_gaps("the measurement", seen, x.shape)
            shown = np.full(self.model.nx, np.nan) if seen is None else seen
            seen, component = self._given("observations", k, seen), "estimator"
            if component in self.start_errors:
                raise self.start_errors[component]
            made = array_with_gaps("the estimate", self.loop.estimator.estimate(seen, last), x.shape)
            estimate = self._given("estimates", k, made)
        except Exception as error:
            self.failed_part = component
            self._end(k, f"the {component} failed: {type(error).__name__}: {error}")
            return None
        self.unseen = 0 if seen is not None else self.unseen + 1
        if fallback is not None and self.unseen > fallback.patience:
            command, status, taken = None, f"{UNSEEN} {self.unseen} steps", 0.0
        else:
            command, status, taken = self._command(estimate, t)
            budget = self.loop.latency_budget
            if command is not None and budget is not None and taken > budget:
                message = (
                    f"the controller took {taken:.3g} s, expected at most {budget:.3g} s: the last command stays in "
                    "effect"
                )
                self.events.append(LoopEvent(t, "late", message))
                command, status = self.model.neutral_input(estimate) if last is None else last, LATE
        if command is not None and not self.in_charge:
            self.events.append(LoopEvent(t, "recovery", "the controller is active again"))
        elif command is None and self.in_charge and fallback is not None:
            self.events.append(LoopEvent(t, "fallback", f"{fallback.mode}: {status}"))
        self.in_charge = command is not None
        if command is None:
            if fallback is None:
                self.failed_part = "controller"
                self._end(k, status)
                return None
            self.controller_error = ""
            last = self.model.neutral_input(estimate) if last is None else last
            command = fallback.command(self.model, estimate, last)
        applied = self.drive(k, self._given("commands", k, command))
        self.rows.append((shown, made, command, applied, status, taken))
        return np.asarray(self._given("applied", k, applied))

    def _command(self, estimate: Array, t: float) -> tuple[Array | None, str, float]:
        """Return the controller's command (None without one), its status, and its computation time [s]."""
        begin = perf_counter()
        try:
            if "controller" in self.start_errors:
                raise self.start_errors["controller"]
            command = finite_array("the controller's command", self.controller(np.array(estimate), t), (self.model.nu,))
            status = str(getattr(self.controller, "status", OK))
        except Exception as error:  # a user's code may raise anything, which is a failure of the controller, not ours
            self.controller_error = f"{type(error).__name__}: {error}"
            reason = "it is not finite" if isinstance(error, NonFiniteError) else self.controller_error
            return None, f"{FAILED} {reason}", perf_counter() - begin
        return command, status, perf_counter() - begin

    def _end(self, k: int, why: str) -> None:
        self.ended = f"at t = {k * self.period:.4g} s: {why}"
        self.events.append(LoopEvent(k * self.period, "failure", why))

    def _pushed(self, k: int, x: Array) -> Array:
        """Return the state after the pushes at plant step k, which change its velocity by dv with M dv = J' p."""
        plant, context = self.model.plant, self.model.double.context
        for push_step, body, impulse in self.pushes:
            if push_step == k:
                set_state(self.model.double, x)
                J = plant.CalcJacobianTranslationalVelocity(
                    context, JacobianWrtVariable.kV, body.body_frame(), body.CalcCenterOfMassInBodyFrame(context),
                    plant.world_frame(), plant.world_frame(),
                )  # fmt: skip
                dv = np.linalg.solve(self.model.double.mass_matrix(), self.model.double.own_force(J.T @ impulse))
                x = np.concatenate([x[: self.model.nq], x[self.model.nq :] + dv])
                message = f"{body.name()} is pushed by {np.linalg.norm(impulse):.3g} N s"
                self.events.append(LoopEvent(k * self.model.time_step, "push", message))
        return x


class _Replay(_LoopRun):
    """A run whose parts get recorded inputs."""

    def __init__(self, rows: LoopRows, model: Model, controller: Controller | None, loop: Loop, seed: int):
        self.recorded, self.is_given = rows, controller is None
        super().__init__(model, controller or OpenLoop(np.zeros((1, model.nu)), model.time_step), loop, seed)

    def _given(self, name: str, k: int, made: Any) -> Any:
        row = getattr(self.recorded, name)[k]
        return None if name == "observations" and np.all(np.isnan(row)) else row

    def _command(self, estimate: Array, t: float) -> tuple[Array | None, str, float]:
        k, rows = len(self.rows), self.recorded
        taken = float(rows.latencies[k])
        if not self.is_given:
            command, status, _ = super()._command(estimate, t)
            return command, status, taken
        status = rows.controller_status[k]
        if status == LATE or status.startswith(UNSEEN):  # these follow from the other rows
            status = OK
        return None if status.startswith(FAILED) else rows.commands[k], status, taken

    def _finish(self) -> None:
        if not self.ended and self.recorded.failed_part:
            self.failed_part, self.controller_error = self.recorded.failed_part, self.recorded.controller_error
            self._end(len(self.rows), self.recorded.ended.partition(": ")[2])
