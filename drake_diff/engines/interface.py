"""The protocol of engines, and base classes for the engines of this package: arguments, Euler step, plant data."""

import os
import sys
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RotationMatrix

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff.exceptions import NotOfferedError, SimulationError
from drake_diff.mechanics.coordinates import Centers, Coordinates, euler_acceleration, euler_jacobian, euler_step, zero
from drake_diff.mechanics.description import (
    Description,
    GeometryContract,
    JointContract,
    PairContract,
    describe,
    rigid_links,
    without_welds,
)
from drake_diff.model.model import Model

Precision = Literal["float64", "float32"]
DRAKES_STEP = "semi-implicit Euler, joint damping implicit, q' = q + h N(q) v'"
DRAKES_STATE = "quaternion w x y z; velocity of a free body angular then linear, both in world"
EACH_CALL = "each step starts from x and u alone"
UNLIMITED = 1e10  # written for "no limit", as readers take a missing limit for 0, and some cannot read inf


@dataclass(frozen=True, kw_only=True, repr=False)
class EngineContract:
    """The properties that an engine uses, read from the engine itself, in SI units and in the order of x and u."""

    engine: str
    joints: tuple[JointContract, ...]
    native_order: tuple[str, ...]  # order of the joints inside the engine
    state: str = DRAKES_STATE  # state of a free body inside the engine
    inputs: tuple[str, ...]
    actuation: tuple[tuple[float, ...], ...]  # (nv, nu): generalized force per unit of input, gears included
    effort_limits: tuple[float, ...]  # (nu,)
    time_step: float
    integrator: str = DRAKES_STEP
    gravity: tuple[float, ...]
    contact_law: str = "none"
    geometries: tuple[GeometryContract, ...] = ()
    contacts: tuple[PairContract, ...] = ()  # by names of `geometries`
    solver_tolerance: float | None = None  # relative; None without an iterative solver
    limit_law: str = "none"
    reset: str = EACH_CALL
    precision: Precision = "float64"  # of the engine's arithmetic
    derivatives: str = "none"  # variables of the derivatives in the engine, before the map to Drake's x and u
    # By quantity of the match: the reason why this engine differs from Drake.
    reasons: Mapping[str, str] = field(default_factory=dict)

    @property
    def by_velocity(self) -> tuple[JointContract, ...]:
        """The joint of each velocity (nv,)."""
        return tuple(j for j in self.joints for _ in range(6 if j.kind == "quaternion_floating" else 1))

    @property
    def damping(self) -> Array:
        """The damping (nv,) of the joints, 0 for free bodies."""
        return np.array([0.0 if j.kind == "quaternion_floating" else j.damping for j in self.by_velocity])

    def effort(self, u: Array) -> Array:
        """Return B u (nv,), clipped at the effort limits."""
        limits, B = np.array(self.effort_limits), np.array(self.actuation, dtype=float)
        return np.asarray(B.reshape(len(B), len(u)) @ np.clip(u, -limits, limits))

    def __repr__(self) -> str:
        joints, inputs = (", ".join(names) or "none" for names in ([j.name for j in self.joints], self.inputs))
        return (
            f"{self.engine}, {self.precision}, {self.time_step:g} s: {self.integrator}\n"
            f"  joints: {joints}\n  inputs: {inputs}\n  contact: {self.contact_law}; limits: {self.limit_law}"
        )


class StepJacobian(NamedTuple):
    """A (nx, nx) and B (nx, nu) of one step in Drake's coordinates, and the method that computed them."""

    A: Array
    B: Array
    method: str

    def __repr__(self) -> str:
        return f"A {self.A.shape} and B {self.B.shape} by {self.method}"


class Engine(Protocol):
    """A model in a simulator, in Drake's coordinates, as returned by `load_engine` and accepted by `dd.compare`.

    `x = [q; v]` and `u` have Drake's order, quaternions are (w, x, y, z), and velocities of free bodies are (angular,
    linear) in the world frame. Every result depends on the arguments alone, not on earlier calls. A custom engine needs
    no base class. It only needs these attributes and methods.

    Raises:
        ShapeError, NonFiniteError: An argument has the wrong shape or is not finite.
        NotOfferedError: The engine does not compute this value. The message gives the reason.
        SimulationError: The engine cannot take the step.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> engine = dd.engines.load_engine("numpy", model)
        >>> print(engine.step([0.0, 1.0], [0.0]).round(5))
        [0.00996 0.99602]
    """

    @property
    def name(self) -> str:
        """The engine's name, with the chosen options."""

    @property
    def version(self) -> str:
        """The library's version."""

    @property
    def contract(self) -> EngineContract:
        """The properties that the engine uses, read from the engine."""

    @property
    def status(self) -> str:
        """The status of the last step: "ok", or the message of the engine's solver."""

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        """Compute the state (nx,) one time step after `x` (nx,) under `u` (nu,)."""

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        """Compute the Jacobians of `step`."""

    def energy(self, x: ArrayLike) -> float:
        """Return the total energy [J]. The potential energy is 0 with all mass at height 0 and springs at rest."""

    def contact_depth(self, x: ArrayLike) -> float:
        """Return the largest penetration depth [m], 0 without contact or if the engine does not support contact."""

    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return the mass matrix (nv, nv), including armature."""

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return bias (nv,) in M dv/dt + bias = B u - damping v: velocity products minus gravity and springs."""


def floats(values: Any) -> tuple[float, ...]:
    """Convert a vector to the type that contracts use."""
    return tuple(float(value) for value in np.ravel(values))


def float_rows(matrix: Any) -> tuple[tuple[float, ...], ...]:
    """Convert a matrix to the type that contracts use."""
    return tuple(floats(row) for row in matrix)


def limit(value: float) -> float:
    """Convert a limit read from an engine, with infinity for values from UNLIMITED on."""
    return float(value) if abs(value) < UNLIMITED else float(np.copysign(np.inf, value))


def not_offered(why: str) -> Any:
    """Return a method that raises NotOfferedError with the message `why`, where {name} is the engine's name."""

    def method(self: Arguments, *_: Any, **__: Any) -> Any:
        raise NotOfferedError(why.format(name=self.name))

    method.__doc__ = "Raise NotOfferedError."
    return method


class Arguments:
    """Checks of an engine's arguments, which raise ShapeError or NonFiniteError, and the force of its inputs."""

    name: str
    version: str
    nq: int
    nv: int
    nu: int
    actuation: Array  # (nv, nu)
    limits: Array  # (nu,) of the inputs

    def __repr__(self) -> str:
        return f"Engine {self.name} {self.version}; print(engine.contract) shows its properties"

    def _state(self, x: ArrayLike) -> tuple[Array, Array, Array]:
        """Return x (nx,), q (nq,) and v (nv,)."""
        x = finite_array("x", x, (self.nq + self.nv,))
        return x, x[: self.nq], x[self.nq :]

    def _point(self, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        return finite_array("x", x, (self.nq + self.nv,)), finite_array("u", u, (self.nu,))

    def _positions(self, q: ArrayLike) -> Array:
        return finite_array("q", q, (self.nq,))

    def _motion(self, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        return finite_array("q", q, (self.nq,)), finite_array("v", v, (self.nv,))

    def _effort(self, u: Array) -> Array:
        """Return B u (nv,), clipped at the effort limits."""
        return np.asarray(self.actuation @ np.clip(u, -self.limits, self.limits))

    def _effort_by_input(self, u: Array) -> Array:
        """Return the derivative (nv, nu) of `_effort`."""
        return np.asarray(self.actuation * (np.abs(u) <= self.limits))


class EulerEngine(Arguments):
    """An engine that computes Drake's Euler step from its own M and bias, by default without contact."""

    coordinates: Coordinates
    time_step: float
    damping: Array  # (nv,) joint damping, implicit
    method: str  # name of the method of its derivatives

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        x, u = self._point(x, u)
        with np.errstate(over="ignore", invalid="ignore"):  # reported as SimulationError below
            x_next = euler_step(self.coordinates, self.time_step, x, self._acceleration(x, u))
        if not np.all(np.isfinite(x_next)):
            raise SimulationError(f"the step leads to {x_next}, which is not finite, from x = {x}, u = {u}")
        return x_next

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        x, u = self._point(x, u)
        acceleration, by = self._acceleration_derivative(x, u)
        x_next = euler_step(self.coordinates, self.time_step, x, acceleration)
        jacobian = euler_jacobian(self.coordinates, self.time_step, x[None], x_next[None], np.asarray(by)[None])[0]
        return StepJacobian(frozen(jacobian[:, : len(x)]), frozen(jacobian[:, len(x) :]), self.method)

    def contact_depth(self, x: ArrayLike) -> float:
        self._state(x)
        return 0.0

    def _acceleration(self, x: Array, u: Array) -> Array:
        """Return the acceleration (v' - v) / h (nv,) of the step."""
        q, v = x[: self.nq], x[self.nq :]
        force = self._effort(u) - self.bias(q, v)
        return euler_acceleration(self.mass_matrix(q), self.damping, self.time_step, v, force)

    def _acceleration_derivative(self, x: Array, u: Array) -> tuple[Array, Array]:
        """Return the acceleration and its derivative (nv, 2 nv + nu) with respect to small motion, v and u."""
        q, v, acceleration, D = x[: self.nq], x[self.nq :], self._acceleration(x, u), np.diag(self.damping)
        by_motion, by_v = self._needed_derivative(q, v, acceleration)
        residual = np.hstack([by_motion, by_v + D, -self._effort_by_input(u)])
        return acceleration, np.asarray(-np.linalg.solve(self.mass_matrix(q) + self.time_step * D, residual))

    @abstractmethod
    def mass_matrix(self, q: ArrayLike) -> Array:
        """Return the mass matrix (nv, nv)."""

    @abstractmethod
    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        """Return the bias forces (nv,)."""

    @abstractmethod
    def _needed_derivative(self, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Return the derivatives (nv, nv) of the force M a + bias with respect to small motion and to v."""


class PlantEngine(Arguments):
    """An engine built from the description of Drake's plant, with the joint data in the order of Drake's v."""

    def __init__(self, model: Model):
        self.description = describe(model)
        self.coordinates = self.description.coordinates
        self.time_step, self.status = model.time_step, "ok"
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self.damping, self.armature, self.stiffness, self.rest = (
            self.description.by_velocity(name) for name in ("damping", "armature", "stiffness", "rest")
        )
        self.actuation, self.limits = self.description.actuation, self.description.effort_limits

    def _stretch(self, q: Array) -> Array:
        """Return the deflection (nv,) of the springs on hinges and slides."""
        stretch = -self.rest
        for i, j in self.coordinates.single:
            stretch[j] += q[i]
        return stretch

    def _spring_energy(self, q: Array) -> float:
        """Return the energy [J] of the springs."""
        stretch = self._stretch(q)
        return float(stretch @ (self.stiffness * stretch)) / 2

    def _zero(self) -> Array:
        """Return the state (nx,) at which contracts are read: q = 0, v = 0, free bodies unrotated at the origin."""
        return np.concatenate([zero(self.coordinates), np.zeros(self.nv)])

    def _plant_fields(self) -> dict[str, Any]:
        """Return the fields of the contract that an engine copies from Drake."""
        return {
            "inputs": self.description.inputs,
            "actuation": float_rows(self.actuation),
            "effort_limits": floats(self.limits),
            "time_step": self.time_step,
        }


class RigidEngine(PlantEngine):
    """An engine built link by link, in which free bodies have the velocity of their centres of mass.

    It supports hinges, slides, free bodies, and contact of spheres, boxes, cylinders, capsules and half spaces.
    """

    centers: Centers

    def __init__(self, model: Model):
        super().__init__(model)
        self.tree = rigid_links(self.description)

    def _drake_state(self, who: str, q: Array, v: Array, x: ArrayLike, u: ArrayLike) -> Array:
        """Return Drake's state (nx,) from q and velocities of centres of mass, or raise SimulationError."""
        if not (np.all(np.isfinite(q)) and np.all(np.isfinite(v))):
            raise SimulationError(f"{who} cannot take this step, from x = {np.asarray(x)}, u = {np.asarray(u)}")
        return np.concatenate([q, np.linalg.solve(self.centers.turn(q), v)])


@contextmanager
def silent() -> Iterator[None]:
    """Discard the C-level output of libraries on stdout and stderr."""
    sys.stdout.flush()
    sys.stderr.flush()
    originals = [(stream, os.dup(stream)) for stream in (1, 2)]
    with open(os.devnull, "w") as nowhere:
        try:
            for stream, _ in originals:
                os.dup2(nowhere.fileno(), stream)
            yield
        finally:
            for stream, original in originals:
                os.dup2(original, stream)
                os.close(original)


def row(values: object) -> str:
    """Format numbers with all digits."""
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values, dtype=float)))


def xml_text(root: ElementTree.Element) -> str:
    """Return the indented text of the document."""
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def shape_of(geometry: Any) -> tuple[str, dict[str, list[float]]]:
    """Return the kind of Drake's shape, such as "Sphere", and its sizes [m], empty for unsupported shapes."""
    shape, kind = geometry.shape, type(geometry.shape).__name__
    if kind == "Sphere":
        return kind, {"radius": [shape.radius()]}
    if kind in ("Cylinder", "Capsule"):
        return kind, {"radius": [shape.radius()], "length": [shape.length()]}
    if kind == "Box":
        return kind, {"size": [shape.width(), shape.depth(), shape.height()]}
    if kind == "Ellipsoid":
        return kind, {"radii": [shape.a(), shape.b(), shape.c()]}
    return kind, {"normal": [0.0, 0.0, 1.0]} if kind == "HalfSpace" else {}


def geometry_contracts(description: Description) -> tuple[GeometryContract, ...]:
    """Return the geometries of supported kinds, at q = 0."""
    moving, on, _ = without_welds(description.links)
    frames: list[RigidTransform] = []
    for link in moving:
        frames.append(link.on_parent if link.parent < 0 else frames[link.parent] @ link.on_parent)
    contracts = []
    for g in description.geometries:
        link_index, pose = on[g.body]
        pose = pose @ g.pose if link_index < 0 else frames[link_index] @ pose @ g.pose
        kind, sizes = shape_of(g)
        carrier = "world" if link_index < 0 else moving[link_index].joint.joint
        if sizes:
            lengths = () if kind == "HalfSpace" else floats(np.concatenate(list(sizes.values())))
            X = (pose.translation(), pose.rotation().matrix())
            contracts.append(geometry_contract(g.name, carrier, kind, lengths, *X))
    return tuple(contracts)


def geometry_contract(
    name: str, carrier: str, kind: str, sizes: Sequence[float], position: Array, R: Array
) -> GeometryContract:
    """Build a contract from the centre (3,) and the axes R (3, 3) in world. The z axis is the axis of symmetry."""
    directions = np.zeros(0)
    if kind == "HalfSpace":
        directions, position = R[:, 2], R[:, 2] * (R[:, 2] @ position)
    elif kind in ("Cylinder", "Capsule"):
        directions = _upper_half(np.outer(R[:, 2], R[:, 2]))
    elif kind in ("Box", "Ellipsoid"):
        directions = _upper_half(R @ np.diag(np.square(sizes)) @ R.T)
    return GeometryContract(name, carrier, kind, floats(sizes), floats(position), floats(directions))


def _upper_half(matrix: Array) -> Array:
    return np.asarray(matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])


def principal(inertia: Array) -> tuple[Array, Array]:
    """Return the principal moments (3,) of `inertia` (3, 3), and the quaternion (w, x, y, z) of their axes.

    MuJoCo checks A + B >= C exactly. A violation by rounding, of at most 1e-14 of the largest moment, is corrected.
    """
    moments, axes = np.linalg.eigh(inertia)
    if np.array_equal(inertia, np.diag(np.diag(inertia))):
        moments, axes = np.diag(inertia).copy(), np.eye(3)
    axes = axes * np.sign(np.linalg.det(axes))
    order = np.argsort(moments)
    missing = moments[order[2]] - moments[order[1]] - moments[order[0]]
    if 0 < missing <= 1e-14 * moments[order[2]]:
        moments[order[0]] += 2 * missing
    return moments, np.asarray(RotationMatrix(axes).ToQuaternion().wxyz())
