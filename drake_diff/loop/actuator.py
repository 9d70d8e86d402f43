"""What becomes of a command: held, late, weaker, slow and limited."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from drake_diff.arrays import Array
from drake_diff.exceptions import InputError
from drake_diff.loop.checks import count, scale

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
