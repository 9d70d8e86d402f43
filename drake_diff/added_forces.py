"""Generalized forces that are added to a step: those of a parameter that Drake has not, and those of a model."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np


class AddedForce(Protocol):
    """A force that acts over a step as if it were part of the model, explicit in the state before it."""

    def force(self, plant: Any, context: Any) -> Any:
        """(nv,) the generalized force [N or N m] in the state of `context`."""

    def potential(self, plant: Any, context: Any) -> float:
        """[J] what the force adds to the potential energy."""


@dataclass
class SpringChange:
    """A prismatic spring with another stiffness k [N/m] and rest length l [m]: -k (q - l) + k0 (q - l0) is added."""

    position: int
    velocity: int
    own_stiffness: float
    own_rest: float
    stiffness: Any
    rest: Any

    @classmethod
    def none(cls, spring: Any) -> "SpringChange":
        """The spring as it is."""
        k, rest, joint = spring.stiffness(), spring.nominal_position(), spring.joint()
        k, rest = (float(getattr(number, "value", lambda n=number: n)()) for number in (k, rest))
        return cls(joint.position_start(), joint.velocity_start(), k, rest, k, rest)

    def force(self, plant: Any, context: Any) -> Any:
        q = plant.GetPositions(context)[self.position]
        added = self.own_stiffness * (q - self.own_rest) - self.stiffness * (q - self.rest)
        return np.array([added if i == self.velocity else 0.0 * added for i in range(plant.num_velocities())])

    def potential(self, plant: Any, context: Any) -> float:
        q = plant.GetPositions(context)[self.position]
        own = self.own_stiffness * (q - self.own_rest) ** 2
        return float(self.stiffness * (q - self.rest) ** 2 - own) / 2


@dataclass
class GravityChange:
    """Gravity beyond that of the plant [m/s^2]: generalized gravity is linear in the vector g."""

    added: Any  # (3,)

    def force(self, plant: Any, context: Any) -> Any:
        field = plant.mutable_gravity_field()
        own = field.gravity_vector()
        total = 0.0
        for axis, amount in zip(np.eye(3), self.added, strict=True):
            field.set_gravity_vector(axis)
            total = total + amount * field.CalcGravityGeneralizedForces(context)
        field.set_gravity_vector(own)
        return total

    def potential(self, plant: Any, context: Any) -> float:
        return 0.0  # the plant's own gravity carries the value; what is added has only a derivative
