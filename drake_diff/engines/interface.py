"""What every engine offers, whatever simulates inside it: Drake's coordinates, one contract, one step."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array
from drake_diff.mechanics.description import GeometryContract, JointContract, PairContract

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
