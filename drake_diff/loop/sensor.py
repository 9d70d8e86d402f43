"""What a controller sees of the state: noisy, biased, late, at its own rate, and at times not at all."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from drake_diff.arrays import Array
from drake_diff.exceptions import InputError
from drake_diff.loop.checks import count, part, scale
from drake_diff.tangent import TangentSpace

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
