"""Equations of motion derived by hand for some of the files in models/, and an engine for them that needs only NumPy.

Their derivatives are complex-step derivatives of M(q) a + bias(q, v) at fixed a, which have no truncation error.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy import cos, sin
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, positive_float
from drake_diff._base.differences import complex_steps
from drake_diff.engines.interface import EngineContract, EulerEngine, float_rows, floats
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.coordinates import Coordinates
from drake_diff.mechanics.description import JointContract, joint_contract
from drake_diff.model.model import Model

(X, Y, Z), ORIGIN, NO_INERTIA = np.eye(3), np.zeros(3), np.zeros((3, 3))
Limits = tuple[float, float]


@dataclass(frozen=True)
class HandForm(ABC):
    """Equations of motion for joints of one degree of freedom by default, with q (nv,), v (nv,) and u (nu,)."""

    gravity: float = 9.81  # [m/s^2], downwards
    joint_names: tuple[str, ...] = ()
    input_names: tuple[str, ...] = ()
    joint_damping: tuple[float, ...] = ()
    effort_limits: tuple[float, ...] = ()
    limits: Mapping[str, Limits] = field(default_factory=dict)

    @property
    def coordinates(self) -> Coordinates:
        return Coordinates((), tuple((i, i) for i in range(len(self.joint_names))))

    @property
    def gravity_vector(self) -> Array:
        """The gravity vector (3,) [m/s^2]."""
        return -self.gravity * Z

    @property
    def actuation(self) -> Array:
        """B (nv, nu), with which input i drives joint i."""
        return np.eye(self.coordinates.nv, len(self.input_names))

    @property
    def damping(self) -> Array:
        """The joint damping (nv,), which is implicit in the step."""
        return np.array(self.joint_damping) if self.joint_damping else np.zeros(self.coordinates.nv)

    @abstractmethod
    def mass_matrix(self, q: Array) -> Array:
        """Return M (nv, nv)."""

    @abstractmethod
    def bias(self, q: Array, v: Array) -> Array:
        """Return the bias forces (nv,)."""

    @abstractmethod
    def potential_energy(self, q: Array) -> float:
        """Return the potential energy [J]."""

    @abstractmethod
    def joints(self) -> tuple[JointContract, ...]:
        """Return the joints for the contract."""

    def needed_derivative(self, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return the derivatives (nv, nv) of M a + bias with respect to small motion and to v."""
        by_q = complex_steps(lambda z: self.mass_matrix(z) @ a + self.bias(z, v), q)
        return by_q @ self.coordinates.rate(q), complex_steps(lambda z: self.bias(q, z), v)

    def _joint(
        self, index: int, kind: str, axis: Array, anchor: Array, mass: float, com: Array, inertia: Array = NO_INERTIA,
        **spring: float,
    ) -> JointContract:  # fmt: skip
        lower, upper = self.limits.get(self.joint_names[index], (-np.inf, np.inf))
        damping = 0.0 if kind == "quaternion_floating" else float(self.damping[index])
        return joint_contract(
            name=self.joint_names[index], kind=kind, axis=axis, anchor=anchor, carried=[(mass, com, inertia)],
            damping=damping, lower=lower, upper=upper, **spring,
        )  # fmt: skip


@dataclass(frozen=True)
class Projectile(HandForm):
    """A free ball with q = (quaternion, position) and v = (angular velocity, linear velocity)."""

    joint_names: tuple[str, ...] = ("ball",)
    mass: float = 1.0
    inertia: float = 0.001

    @property
    def coordinates(self) -> Coordinates:
        return Coordinates(((0, 0),), ())

    def mass_matrix(self, q: Array) -> Array:
        return np.diag([self.inertia] * 3 + [self.mass] * 3)

    def bias(self, q: Array, v: Array) -> Array:
        return np.array([0, 0, 0, 0, 0, self.mass * self.gravity])

    def potential_energy(self, q: Array) -> float:
        return float(self.mass * self.gravity * q[6])

    def joints(self) -> tuple[JointContract, ...]:
        inertia = self.inertia * np.eye(3)
        return (self._joint(0, "quaternion_floating", ORIGIN, ORIGIN, self.mass, ORIGIN, inertia),)


@dataclass(frozen=True)
class MassSpringDamper(HandForm):
    """A block on a horizontal rail: m a = u - k (q - rest) - c v'."""

    joint_names: tuple[str, ...] = ("slide",)
    input_names: tuple[str, ...] = ("slide",)
    joint_damping: tuple[float, ...] = (1.5,)
    effort_limits: tuple[float, ...] = (1000.0,)
    mass: float = 2.0
    inertia: float = 0.0033
    stiffness: float = 50.0
    rest: float = 0.1

    def mass_matrix(self, q: Array) -> Array:
        return np.array([[self.mass]])

    def bias(self, q: Array, v: Array) -> Array:
        return self.stiffness * (q - self.rest)

    def potential_energy(self, q: Array) -> float:
        return float(self.stiffness * (q[0] - self.rest) ** 2 / 2)

    def joints(self) -> tuple[JointContract, ...]:
        spring = {"stiffness": self.stiffness, "rest": self.rest}
        return (self._joint(0, "prismatic", X, ORIGIN, self.mass, ORIGIN, self.inertia * np.eye(3), **spring),)


@dataclass(frozen=True)
class Pendulum(HandForm):
    """A point mass below a hinge about +y: m l^2 a = u - m g l sin q - b v'."""

    joint_names: tuple[str, ...] = ("hinge",)
    input_names: tuple[str, ...] = ("motor",)
    joint_damping: tuple[float, ...] = (0.1,)
    effort_limits: tuple[float, ...] = (np.inf,)
    mass: float = 1.0
    length: float = 0.5

    def mass_matrix(self, q: Array) -> Array:
        return np.array([[self.mass * self.length**2]])

    def bias(self, q: Array, v: Array) -> Array:
        return np.array([self.mass * self.gravity * self.length * sin(q[0])])

    def potential_energy(self, q: Array) -> float:
        return -self.mass * self.gravity * self.length * cos(q[0])

    def joints(self) -> tuple[JointContract, ...]:
        return (self._joint(0, "revolute", Y, ORIGIN, self.mass, -self.length * Z),)


@dataclass(frozen=True)
class DoublePendulum(HandForm):
    """Two uniform thin rods below hinges about +y. The second angle is relative to the first."""

    joint_names: tuple[str, ...] = ("shoulder", "elbow")
    input_names: tuple[str, ...] = ("shoulder_motor", "elbow_motor")
    effort_limits: tuple[float, ...] = (np.inf, np.inf)
    masses: tuple[float, float] = (1.0, 0.7)
    lengths: tuple[float, float] = (0.8, 0.5)

    @property
    def _moments(self) -> tuple[float, float, float]:
        (m1, m2), (l1, l2) = self.masses, self.lengths
        return m1 * l1**2 / 3 + m2 * l1**2, m2 * l2**2 / 3, m2 * l1 * l2 / 2

    @property
    def _weights(self) -> tuple[float, float]:
        (m1, m2), (l1, l2) = self.masses, self.lengths
        return (m1 / 2 + m2) * self.gravity * l1, m2 * self.gravity * l2 / 2

    def mass_matrix(self, q: Array) -> Array:
        (a, b, c), c2 = self._moments, cos(q[1])
        return np.array([[a + b + 2 * c * c2, b + c * c2], [b + c * c2, b]])

    def bias(self, q: Array, v: Array) -> Array:
        (_, _, c), (g1, g2), s2 = self._moments, self._weights, sin(q[1])
        lower = g2 * sin(q[0] + q[1])
        upper = g1 * sin(q[0]) + lower
        return np.array([upper - c * s2 * (2 * v[0] + v[1]) * v[1], lower + c * s2 * v[0] ** 2])

    def potential_energy(self, q: Array) -> float:
        g1, g2 = self._weights
        return -g1 * cos(q[0]) - g2 * cos(q[0] + q[1])

    def joints(self) -> tuple[JointContract, ...]:
        (m1, m2), (l1, l2) = self.masses, self.lengths
        across = np.diag([1.0, 1.0, 0.0]) / 12
        return (
            self._joint(0, "revolute", Y, ORIGIN, m1, -l1 / 2 * Z, m1 * l1**2 * across),
            self._joint(1, "revolute", Y, -l1 * Z, m2, -(l1 + l2 / 2) * Z, m2 * l2**2 * across),
        )


@dataclass(frozen=True)
class CartPole(HandForm):
    """Kelly's cart-pole: a driven cart on a rail along x, and a point mass on a massless pole at a hinge about -y."""

    joint_names: tuple[str, ...] = ("slide", "hinge")
    input_names: tuple[str, ...] = ("force",)
    effort_limits: tuple[float, ...] = (20.0,)
    limits: Mapping[str, Limits] = field(default_factory=lambda: {"slide": (-2.0, 2.0)})
    cart: float = 1.0
    bob: float = 0.3
    length: float = 0.5

    def mass_matrix(self, q: Array) -> Array:
        ml = self.bob * self.length
        return np.array([[self.cart + self.bob, ml * cos(q[1])], [ml * cos(q[1]), ml * self.length]])

    def bias(self, q: Array, v: Array) -> Array:
        return self.bob * self.length * sin(q[1]) * np.array([-(v[1] ** 2), self.gravity])

    def potential_energy(self, q: Array) -> float:
        return -self.bob * self.gravity * self.length * cos(q[1])

    def joints(self) -> tuple[JointContract, ...]:
        return (
            self._joint(0, "prismatic", X, ORIGIN, self.cart, ORIGIN),
            self._joint(1, "revolute", -Y, ORIGIN, self.bob, -self.length * Z),
        )


# The equations for the file of the same name in models/.
BY_MODEL: dict[str, HandForm] = {
    "projectile": Projectile(), "mass_spring_damper": MassSpringDamper(), "pendulum": Pendulum(),
    "double_pendulum": DoublePendulum(), "cart_pole": CartPole(),
}  # fmt: skip


class NumpyEngine(EulerEngine):
    """An engine for a closed form, or for the one with the model's name (check it with `match_contracts`)."""

    name, version, status, method = "numpy", np.__version__, "ok", "by hand"

    def __init__(self, model: Model | HandForm, *, time_step: float | None = None):
        if isinstance(model, Model):
            if model.name not in BY_MODEL:
                known = ", ".join(sorted(BY_MODEL))
                raise ModelError(f"there is no hand calculation of the model {model.name!r}; expected one of {known}")
            self.form, self.time_step = BY_MODEL[model.name], model.time_step
        else:
            self.form, self.time_step = model, positive_float("time_step [s]", time_step)
        self.coordinates = self.form.coordinates
        self.nq, self.nv, self.nu = self.coordinates.nq, self.coordinates.nv, len(self.form.input_names)
        self.damping, self.actuation = self.form.damping, self.form.actuation
        self.limits = np.array(self.form.effort_limits)

    def _needed_derivative(self, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        return self.form.needed_derivative(q, v, a)

    def energy(self, x: ArrayLike) -> float:
        _, q, v = self._state(x)
        return float(v @ self.form.mass_matrix(q) @ v) / 2 + self.form.potential_energy(q)

    def mass_matrix(self, q: ArrayLike) -> Array:
        return self.form.mass_matrix(self._positions(q))

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        return self.form.bias(*self._motion(q, v))

    @property
    def contract(self) -> EngineContract:
        return EngineContract(
            engine=self.name, joints=self.form.joints(), native_order=self.form.joint_names,
            inputs=self.form.input_names, actuation=float_rows(self.actuation),
            effort_limits=self.form.effort_limits, time_step=self.time_step, gravity=floats(self.form.gravity_vector),
            contact_law="none", derivatives="by every entry of x and u",
            reasons={
                "limit law": "the hand calculation has no joint limits",
                "contact pairs": "a hand calculation has no contact",
                "solver tolerance": "nothing is solved iteratively",
            },
        )  # fmt: skip
