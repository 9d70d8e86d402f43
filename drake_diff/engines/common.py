"""What the engines here have in common: their arguments checked, the plant's numbers in Drake's order, its shapes."""

import os
import sys
import tempfile
from abc import abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any
from xml.etree import ElementTree

import numpy as np
from numpy.typing import ArrayLike
from pydrake.math import RigidTransform, RotationMatrix

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff.engines.interface import StepJacobian, float_rows, floats
from drake_diff.exceptions import SimulationError
from drake_diff.mechanics.coordinates import Centers, Coordinates, euler_jacobian, euler_step, zero
from drake_diff.mechanics.description import (
    Description,
    GeometryContract,
    PairContract,
    describe,
    rigid_links,
    without_welds,
)
from drake_diff.model.model import Model


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
    """An engine whose dynamics are put into Drake's Euler step, without contact unless it says otherwise."""

    coordinates: Coordinates
    time_step: float
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
        jacobian = euler_jacobian(self.coordinates, self.time_step, x, x_next, by)
        return StepJacobian(frozen(jacobian[:, : len(x)]), frozen(jacobian[:, len(x) :]), self.method)

    def contact_depth(self, x: ArrayLike) -> float:
        self._state(x)
        return 0.0

    def _acceleration(self, x: Array, u: Array) -> Array:
        """(nv,) (v' - v) / h of the step."""
        return self._acceleration_derivative(x, u)[0]

    @abstractmethod
    def _acceleration_derivative(self, x: Array, u: Array) -> tuple[Array, Array]:
        """The acceleration, and its derivative (nv, 2 nv + nu) by small motion, by v and by u."""


class PlantEngine(Arguments):
    """An engine built from the description of Drake's plant, whose numbers it holds by Drake's velocities."""

    def __init__(self, model: Model):
        self.description = describe(model)
        self.coordinates = self.description.coordinates
        self.time_step, self.status = model.time_step, "ok"
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self._holding = np.zeros(model.nv)  # forces that act for a while beside the inputs
        self.damping, self.armature, self.stiffness, self.rest = (
            self.description.by_velocity(name) for name in ("damping", "armature", "stiffness", "rest")
        )
        self.actuation, self.limits = self.description.actuation, self.description.effort_limits

    def _effort(self, u: Array) -> Array:
        """(nv,) B u, cut at the effort limits."""
        return np.asarray(self.actuation @ np.clip(u, -self.limits, self.limits)) + self._holding

    @contextmanager
    def holding(self, force: Array) -> Iterator[None]:
        """A generalized force (nv,) acts beside the inputs, whatever the state, until it ends."""
        self._holding = force
        try:
            yield
        finally:
            self._holding = np.zeros(self.nv)

    def _effort_by_input(self, u: Array) -> Array:
        """(nv, nu) the derivative of `_effort`."""
        return np.asarray(self.actuation * (np.abs(u) <= self.limits))

    def _stretch(self, q: Array) -> Array:
        """(nv,) of the springs on hinges and slides."""
        found = -self.rest
        for i, j in self.coordinates.single:
            found[j] += q[i]
        return found

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

    def _found(self, who: str, q: Array, v: Array, x: ArrayLike, u: ArrayLike) -> Array:
        """Drake's state (nx,) of q and the velocities of centres of mass; SimulationError where it is not finite."""
        if not (np.all(np.isfinite(q)) and np.all(np.isfinite(v))):
            raise SimulationError(f"{who} cannot take this step, from x = {np.asarray(x)}, u = {np.asarray(u)}")
        return np.concatenate([q, np.linalg.solve(self.centers.turn(q), v)])


@contextmanager
def without_lines(*greetings: str) -> Iterator[None]:
    """What libraries print from C on stdout and stderr comes when it ends, but for lines that begin as a greeting."""
    with _filtered(1, greetings), _filtered(2, greetings):
        yield


@contextmanager
def _filtered(stream: int, greetings: tuple[str, ...]) -> Iterator[None]:
    """Of one file descriptor."""
    _flush()
    kept = os.dup(stream)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), stream)
        try:
            yield
        finally:
            _flush()
            os.dup2(kept, stream)
            os.close(kept)
            file.seek(0)
            for line in file.read().splitlines(keepends=True):
                if not line.startswith(tuple(g.encode() for g in greetings)):
                    os.write(stream, line)


def _flush() -> None:
    sys.stdout.flush()
    sys.stderr.flush()


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
    found = []
    for g in description.geometries:
        place, pose = on[g.body]
        pose = pose @ g.pose if place < 0 else frames[place] @ pose @ g.pose
        kind, sizes = shape_of(g)
        carrier = "world" if place < 0 else moving[place].joint.joint
        if sizes:
            lengths = () if kind == "HalfSpace" else floats(np.concatenate(list(sizes.values())))
            X = (pose.translation(), pose.rotation().matrix())
            found.append(geometry_contract(g.name, carrier, kind, lengths, *X))
    return tuple(found)


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
