"""Hand calculations of contact: a ball that lands on a spring, and a block that regularized friction stops."""

from dataclasses import dataclass
from math import cos, sin, sqrt
from typing import ClassVar

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.engines.closed_form import ORIGIN, NumpyEngine, Slider, Z
from drake_diff.mechanics.description import JointContract


@dataclass(frozen=True)
class SphereOnGround(Slider):
    """A ball on a vertical slide above z = 0; q is the height of its centre, x = radius - q how deep it is.

    f = k (x - (h + relaxation_time) v') while x > 0 and f > 0: SAP's normal force where it is not near-rigid, and
    that of similar and lagged without dissipation (relaxation_time 0).
    """

    joint_names: tuple[str, ...] = ("ball_z",)
    contact_law: str = "linear spring and relaxation time, implicit"
    radius: float = 0.1
    stiffness: float = 1e4
    relaxation_time: float = 0.0
    axis: ClassVar[Array] = Z

    def contact_depth(self, q: Array) -> float:
        return max(0.0, float(self.radius - q[0]))

    def joints(self) -> tuple[JointContract, ...]:
        inertia = 0.4 * self.mass * self.radius**2 * np.eye(3)
        return (self._joint(0, "prismatic", Z, ORIGIN, self.mass, ORIGIN, inertia),)

    def acceleration(self, h: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        depth, free = self.contact_depth(q), v - self.gravity * h
        soft, push = self.relaxation_time + h, h * self.stiffness / self.mass
        if depth == 0 or depth <= soft * free[0]:
            return (free - v) / h, np.zeros((1, 2))
        v_next = (free + push * depth) / (1 + push * soft)
        by_height, by_speed = -push / (1 + push * soft), 1 / (1 + push * soft)
        return (v_next - v) / h, np.array([[by_height, by_speed - 1]]) / h


@dataclass(frozen=True)
class SlidingBlock(Slider):
    """A block down an incline whose normal force is at rest: v' = w - c v' / sqrt(v'^2 + s^2), c = mu g h cos(slope).

    w is the velocity without friction and s the stiction tolerance [m/s]: Drake's lagged friction.
    """

    joint_names: tuple[str, ...] = ("block_x",)
    input_names: tuple[str, ...] = ("push",)
    effort_limits: tuple[float, ...] = (np.inf,)
    contact_law: str = "regularized Coulomb friction, implicit, normal force at rest"
    friction: float = 0.5
    stiction_tolerance: float = 1e-4
    slope: float = 0.0  # [rad]

    @property
    def gravity_vector(self) -> Array:
        return self.gravity * np.array([sin(self.slope), 0, -cos(self.slope)])

    def acceleration(self, h: float, q: Array, v: Array, u: Array) -> tuple[Array, Array]:
        w = float(v[0]) + h * (self.gravity * sin(self.slope) + float(u[0]) / self.mass)
        c, s = self.friction * self.gravity * h * cos(self.slope), self.stiction_tolerance
        # The root of v + c v / sqrt(v^2 + s^2) = w lies between 0 and w: halved until no float is left between.
        low, high = min(0.0, w), max(0.0, w)
        while low < (v_next := (low + high) / 2) < high:
            if v_next + c * v_next / sqrt(v_next**2 + s**2) < w:
                low = v_next
            else:
                high = v_next
        by_w = 1 / (1 + c * s**2 / (v_next**2 + s**2) ** 1.5)
        by = np.array([[0.0, by_w - 1, by_w * h / self.mass]]) / h
        return np.array([v_next - v[0]]) / h, by


class ContactEngine(NumpyEngine):
    """One of these forms, whose acceleration is that of the step with its contact."""

    def _acceleration(self, x, u):
        return self._acceleration_derivative(x, u)[0]

    def _acceleration_derivative(self, x, u):
        return self.form.acceleration(self.time_step, x[: self.nq], x[self.nq :], u)
