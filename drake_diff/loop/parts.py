"""What a controller sees of the state: noisy, biased, late, at its own rate, and at times not at all.

From what a sensor gives to the state that a controller acts on: the seam where an estimator goes in.

What becomes of a command: held, late, weaker, slow and limited.

What a loop does where its controller cannot be followed: hold, damp or stop, until it can be again.
"""

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

Reader = Callable[[int, Array], Array | None]


@dataclass(frozen=True, eq=False)
class Sensor:
    """y = plus(x, bias + noise N(0, 1)) of every `every`-th state, `delay` steps late, lost with probability `dropout`.

    `noise` (standard deviation) and `bias` are a number or (nt,), in the units of the tangent space; steps are the
    controller's. The first state is taken to be known until a sample arrives.
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
            shift, kept = noise * random.standard_normal(space.size), random.uniform() >= self.dropout
            due = k % self.every == 0 and (kept or k == 0)
            samples.append(space.plus(x, bias + shift) if due else None)
            return samples[max(0, k - self.delay)]

        return read


class Estimator(Protocol):
    """One estimate a step. `start` is called before each run, so that nothing is left of the run before."""

    def start(self, x0: Array) -> None:
        """Forget everything; `x0` (nx,) is the state that is known to begin with."""
        ...

    def estimate(self, observation: Array | None, u: Array | None) -> Array:
        """(nx,) from what arrived, None where nothing did, and the last command (nu,), None at first."""
        ...


class Hold:
    """The last thing that was seen."""

    def start(self, x0: Array) -> None:
        self._last = x0

    def estimate(self, observation: Array | None, u: Array | None) -> Array:
        self._last = self._last if observation is None else observation
        return self._last


class Predictor:
    """The last thing seen, `delay` steps old, rolled forward through `model` under the commands since.

    It makes up for a known delay of the sensor, and for lost samples.
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


Drive = Callable[[int, Array], Array]


@dataclass(frozen=True, eq=False)
class Actuator:
    """Every `every`-th command, `delay` steps late, clipped to `lower` and `upper`, times `strength`, through a lag.

    The lag is first order with the time constant `lag` [s]: u+ = u + (1 - exp(-H / lag)) (command - u), H the
    controller's period. Numbers or (nu,). Nothing is applied before the first command arrives.
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


MODES = ("hold", "damp", "stop")


@dataclass(frozen=True, eq=False)
class Fallback:
    """It takes over where the controller fails, or nothing was seen for more than `patience` steps.

    hold: the last command; damp: -damping v at the actuated joints [N s/m or N m s/rad], of the estimate; stop: no
    effort.
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
