"""What every engine offers, and what the engines here have in common: arguments, Euler's step, the plant's numbers."""

import os
import sys
from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NamedTuple, Protocol
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RotationMatrix

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff.exceptions import SimulationError
from drake_diff.mechanics.coordinates import (
    Centers,
    Coordinates,
    euler_acceleration,
    euler_jacobian,
    euler_step,
    zero,
)
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
UNLIMITED = 1e10  # written for "no limit": readers take a missing limit for 0, and not all can read inf


@dataclass(frozen=True, kw_only=True, repr=False)
class EngineContract:
    """What an engine uses, read out of the engine itself; SI units, in the order of the x and u that it takes."""

    engine: str
    joints: tuple[JointContract, ...]
    native_order: tuple[str, ...]  # of the joints inside the engine
    state: str = DRAKES_STATE  # how a free body's state is held inside the engine
    inputs: tuple[str, ...]
    actuation: tuple[tuple[float, ...], ...]  # (nv, nu): generalized force per unit of input, gears included
    effort_limits: tuple[float, ...]  # (nu,)
    time_step: float
    integrator: str = DRAKES_STEP
    gravity: tuple[float, ...]
    contact_law: str = "none"
    geometries: tuple[GeometryContract, ...] = ()
    contacts: tuple[PairContract, ...] = ()  # the names are those of `geometries`
    solver_tolerance: float | None = None  # relative; None where nothing is solved iteratively
    limit_law: str = "none"
    reset: str = EACH_CALL
    precision: Precision = "float64"  # of the engine's arithmetic
    derivatives: str = "none"  # by what they are taken in the engine, before they are mapped to Drake's x and u
    # By quantity of the match: why this engine cannot have what Drake has.
    reasons: Mapping[str, str] = field(default_factory=dict)

    def __repr__(self) -> str:
        joints, inputs = (", ".join(names) or "none" for names in ([j.name for j in self.joints], self.inputs))
        return (
            f"{self.engine}, {self.precision}, {self.time_step:g} s: {self.integrator}\n"
            f"  joints: {joints}\n  inputs: {inputs}\n  contact: {self.contact_law}; limits: {self.limit_law}"
        )


class StepJacobian(NamedTuple):
    """A (nx, nx) and B (nx, nu) of one step in Drake's coordinates, and where they come from."""

    A: Array
    B: Array
    method: str

    def __repr__(self) -> str:
        return f"A {self.A.shape} and B {self.B.shape} by {self.method}"


class Engine(Protocol):
    """One model in one simulator, in Drake's coordinates: what `load_engine` returns and `dd.compare` takes.

    `x = [q; v]` and `u` have Drake's order, quaternions are (w, x, y, z), and velocities of free bodies are (angular,
    linear) in the world frame. Every result depends on the arguments alone, not on earlier calls. An engine of your
    own needs no base class: an object with these names will do.

    Raises:
        ShapeError, NonFiniteError: an argument has the wrong shape or is not finite.
        NotOfferedError: the engine does not compute this; the message says why.
        SimulationError: the engine cannot take the step.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> engine = dd.engines.load_engine("numpy", model)
        >>> print(engine.step([0.0, 1.0], [0.0]).round(5))
        [0.00996 0.99602]
    """

    @property
    def name(self) -> str:
        """The engine's name, with the options that were chosen."""

    @property
    def version(self) -> str:
        """The library's version."""

    @property
    def contract(self) -> EngineContract:
        """What the engine uses, read back from it."""

    @property
    def status(self) -> str:
        """How the last step went: "ok", or what the engine's solver said."""

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        """The state (nx,) one time step after `x` (nx,) under `u` (nu,)."""

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        """The Jacobians of `step`."""

    def energy(self, x: ArrayLike) -> float:
        """Kinetic and potential energy [J]; potential energy is 0 with all mass at height 0 and springs at rest."""

    def contact_depth(self, x: ArrayLike) -> float:
        """The deepest overlap [m], 0 where nothing touches or the engine has no contact."""

    def mass_matrix(self, q: ArrayLike) -> Array:
        """(nv, nv), armature included."""

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        """(nv,) in M dv/dt + bias = B u - damping v: velocity products less gravity and springs."""


def floats(values: Any) -> tuple[float, ...]:
    """A vector as a contract holds it."""
    return tuple(float(value) for value in np.ravel(values))


def float_rows(matrix: Any) -> tuple[tuple[float, ...], ...]:
    """A matrix as a contract holds it."""
    return tuple(floats(row) for row in matrix)


def limit(value: float) -> float:
    """A limit that was read back, infinite where UNLIMITED was written for it."""
    return float(value) if abs(value) < UNLIMITED else float(np.copysign(np.inf, value))


class Arguments:
    """Checks what an engine is asked about: ShapeError or NonFiniteError."""

    nq: int
    nv: int
    nu: int

    def _state(self, x: ArrayLike) -> tuple[Array, Array, Array]:
        """x (nx,), q (nq,) and v (nv,)."""
        x = finite_array("x", x, (self.nq + self.nv,))
        return x, x[: self.nq], x[self.nq :]

    def _point(self, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        return finite_array("x", x, (self.nq + self.nv,)), finite_array("u", u, (self.nu,))

    def _positions(self, q: ArrayLike) -> Array:
        return finite_array("q", q, (self.nq,))

    def _motion(self, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        return finite_array("q", q, (self.nq,)), finite_array("v", v, (self.nv,))


class EulerEngine(Arguments):
    """An engine whose M and bias are put into Drake's Euler step, without contact unless it says otherwise."""

    coordinates: Coordinates
    time_step: float
    damping: Array  # (nv,) of the joints, implicit
    method: str  # by which its derivatives are taken

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        x, u = self._point(x, u)
        with np.errstate(over="ignore", invalid="ignore"):  # what runs away is said below
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
        """(nv,) (v' - v) / h of the step."""
        q, v = x[: self.nq], x[self.nq :]
        force = self._effort(u) - self.bias(q, v)
        return euler_acceleration(self.mass_matrix(q), self.damping, self.time_step, v, force)

    def _acceleration_derivative(self, x: Array, u: Array) -> tuple[Array, Array]:
        """The acceleration, and its derivative (nv, 2 nv + nu) by small motion, by v and by u."""
        q, v, acceleration, D = x[: self.nq], x[self.nq :], self._acceleration(x, u), np.diag(self.damping)
        by_motion, by_v = self._needed_derivative(q, v, acceleration)
        residual = np.hstack([by_motion, by_v + D, -self._effort_by_input(u)])
        return acceleration, np.asarray(-np.linalg.solve(self.mass_matrix(q) + self.time_step * D, residual))

    @abstractmethod
    def mass_matrix(self, q: ArrayLike) -> Array:
        """(nv, nv)."""

    @abstractmethod
    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        """(nv,)."""

    @abstractmethod
    def _effort(self, u: Array) -> Array:
        """(nv,) B u, cut at the effort limits."""

    @abstractmethod
    def _effort_by_input(self, u: Array) -> Array:
        """(nv, nu) the derivative of `_effort`."""

    @abstractmethod
    def _needed_derivative(self, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(nv, nv) each, of the force M a + bias that `a` (nv,) needs: by small motion and by v."""


class PlantEngine(Arguments):
    """An engine built from the description of Drake's plant, whose numbers it holds by Drake's velocities."""

    def __init__(self, model: Model):
        self.description = describe(model)
        self.coordinates = self.description.coordinates
        self.time_step, self.status = model.time_step, "ok"
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self.damping, self.armature, self.stiffness, self.rest = (
            self.description.by_velocity(name) for name in ("damping", "armature", "stiffness", "rest")
        )
        self.actuation, self.limits = self.description.actuation, self.description.effort_limits

    def _effort(self, u: Array) -> Array:
        """(nv,) B u, cut at the effort limits."""
        return np.asarray(self.actuation @ np.clip(u, -self.limits, self.limits))

    def _effort_by_input(self, u: Array) -> Array:
        """(nv, nu) the derivative of `_effort`."""
        return np.asarray(self.actuation * (np.abs(u) <= self.limits))

    def _stretch(self, q: Array) -> Array:
        """(nv,) of the springs on hinges and slides."""
        stretch = -self.rest
        for i, j in self.coordinates.single:
            stretch[j] += q[i]
        return stretch

    def _spring_energy(self, q: Array) -> float:
        """[J]."""
        stretch = self._stretch(q)
        return float(stretch @ (self.stiffness * stretch)) / 2

    def _zero(self) -> Array:
        """x (nx,) at which contracts are read: q = 0, free bodies unturned at the origin, nothing moves."""
        return np.concatenate([zero(self.coordinates), np.zeros(self.nv)])

    def _plant_fields(self) -> dict[str, Any]:
        """The fields of the contract that an engine takes over from Drake as they are."""
        return {
            "inputs": self.description.inputs,
            "actuation": float_rows(self.actuation),
            "effort_limits": floats(self.limits),
            "time_step": self.time_step,
        }


class RigidEngine(PlantEngine):
    """An engine built link by link, whose free bodies move by the velocity of their centres of mass.

    It has trees of hinges, slides and free bodies, and contacts of spheres, boxes, cylinders, capsules and half spaces.
    """

    centers: Centers

    def __init__(self, model: Model):
        super().__init__(model)
        self.tree = rigid_links(self.description)

    def _drake_state(self, who: str, q: Array, v: Array, x: ArrayLike, u: ArrayLike) -> Array:
        """Drake's state (nx,) of q and the velocities of centres of mass; SimulationError where it is not finite."""
        if not (np.all(np.isfinite(q)) and np.all(np.isfinite(v))):
            raise SimulationError(f"{who} cannot take this step, from x = {np.asarray(x)}, u = {np.asarray(u)}")
        return np.concatenate([q, np.linalg.solve(self.centers.turn(q), v)])


@contextmanager
def silent() -> Iterator[None]:
    """What libraries print from C on stdout and stderr goes nowhere."""
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
    """Numbers as text, to the last digit."""
    return " ".join(repr(float(value)) for value in np.ravel(np.asarray(values, dtype=float)))


def xml_text(root: ElementTree.Element) -> str:
    """The document, indented."""
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode")


def shape_of(geometry: Any) -> tuple[str, dict[str, list[float]]]:
    """The kind of Drake's shape, such as "Sphere", and its sizes [m], none of those that no engine is given."""
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
    """Each geometry of a kind that engines are given, where q = 0."""
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


def without_damping(pair: PairContract) -> PairContract:
    """Of an engine whose contacts have friction and stiffness of the model, and dampers of their own or none."""
    return replace(pair, dissipation=None, relaxation_time=None)


def geometry_contract(
    name: str, carrier: str, kind: str, sizes: Sequence[float], position: Array, R: Array
) -> GeometryContract:
    """From the centre (3,) and the axes R (3, 3) in world; what is round or flat is so about its z axis."""
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
    """Principal moments (3,) of `inertia` (3, 3), and the quaternion (w, x, y, z) of their axes.

    MuJoCo checks A + B >= C exactly: what rounding takes from it, at most 1e-14 of the largest, is put back.
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
