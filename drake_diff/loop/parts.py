"""What stands around a controller: sensor, estimator, actuator, and a fallback for where the controller fails."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, count, part, scale
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.step import advance
from drake_diff.model.tangent import TangentSpace
from drake_diff.motion.policy import PD

MODES = ("hold", "damp", "stop")
Reader = Callable[[int, Array], Array | None]
Drive = Callable[[int, Array], Array]


@dataclass(frozen=True, eq=False)
class Sensor:
    """Measures the state with noise and bias, at its own rate, late, and with samples lost.

    A sample is y = plus(x, bias + noise N(0, 1)), on the tangent space of the state. The first state is taken to be
    known until a sample arrives.

    Args:
        noise: standard deviation, a number or (nt,), in the units of the tangent space.
        bias: a number or (nt,), in the same units.
        delay: by how many of the controller's steps a sample is late.
        every: a sample is taken in each `every`-th step of the controller.
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
        part("Sensor.dropout", self.dropout)

    def start(self, space: TangentSpace, random: np.random.Generator) -> Reader:
        """A function of (k, x_k) that gives what arrives at step k, None where nothing does."""
        noise, bias = scale("Sensor.noise", self.noise, space.size), np.broadcast_to(self.bias, space.size)
        if np.any(noise < 0):
            raise InputError("Sensor.noise", got=self.noise, expected="numbers of at least 0")
        samples: list[Array | None] = []

        def read(k: int, x: Array) -> Array | None:
            # Drawn in every step, so that another rate or dropout leaves the noise of the other steps as it is.
            shift, received = noise * random.standard_normal(space.size), random.uniform() >= self.dropout
            due = k % self.every == 0 and (received or k == 0)
            samples.append(space.plus(x, bias + shift) if due else None)
            return samples[max(0, k - self.delay)]

        return read


class Estimator(Protocol):
    """Makes one estimate a step. `start` is called before each run, so that nothing is left of the run before."""

    def start(self, x0: Array) -> None:
        """Forget everything; `x0` (nx,) is the state that is known to begin with."""
        ...

    def estimate(self, observation: Array | None, u: Array | None) -> Array:
        """(nx,) from what arrived, None where nothing did, and the last command (nu,), None at first."""
        ...


class Hold:
    """The estimator that takes the last sample for the state.

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


class Predictor:
    """The estimator that rolls the last sample forward through a model, under the commands since it was taken.

    It makes up for a known delay of the sensor, and for lost samples.

    Args:
        model: the plant as the estimator knows it.
        delay: how many steps old a sample is when it arrives.

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
        x = np.array(self._seen)
        for command in self._since:
            x = np.asarray(advance(self.model.double, x, command))
        return x


@dataclass(frozen=True, eq=False)
class Actuator:
    """Applies commands late, at its own rate, limited, weaker, and through a lag of first order.

    In each step of the controller, of length H, what is applied moves towards the command that has arrived:
    u+ = u + (1 - exp(-H / lag)) (strength clip(command, lower, upper) - u). Before that, nothing is applied.

    Args:
        delay: by how many of the controller's steps a command is late.
        every: a command is taken over in each `every`-th step of the controller.
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
        """A function of (k, command (nu,)) that gives what is applied in step k, (nu,)."""
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
    """Takes over where the controller fails, or where nothing was measured for more than `patience` steps.

    Args:
        mode: "hold" repeats the last command, "damp" applies -damping v at the actuated joints, with v from the
            estimate, "stop" applies nothing.
        patience: how many steps of the controller without a measurement are borne.
        damping: of "damp", [N s/m] or [N m s/rad].

    Raises:
        UnknownNameError: there is no such mode.
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
        """(nu,) in place of the controller's."""
        if self.mode == "hold":
            return last
        if self.mode == "stop" or not model.nu:
            return np.zeros(model.nu)
        at_rest = np.concatenate([estimate[: model.nq], np.zeros(model.nv)])
        return np.asarray(PD(model, 0.0, self.damping, x_ref=at_rest)(estimate, 0.0))
