"""What every engine offers, whatever simulates inside it: Drake's coordinates, one contract, one step."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol

from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array
from drake_diff.mechanics.joints import JointContract, PairContract

Precision = Literal["float64", "float32"]


@dataclass(frozen=True)
class EngineContract:
    """What an engine uses, read out of the engine itself; SI units, in the order of the x and u that it takes."""

    engine: str
    joints: tuple[JointContract, ...]
    native_order: tuple[str, ...]  # of the joints inside the engine
    state: str  # how a free body's state is held inside the engine
    inputs: tuple[str, ...]
    actuation: tuple[tuple[float, ...], ...]  # (nv, nu): generalized force per input, the gear's doing included
    effort_limits: tuple[float, ...]  # (nu,)
    time_step: float
    integrator: str
    gravity: tuple[float, ...]
    contact_law: str
    contacts: tuple[PairContract, ...]
    solver_tolerance: float | None  # relative; None where nothing is solved iteratively
    limit_law: str
    reset: str
    precision: Precision = "float64"  # of the engine's arithmetic
    derivatives: str = "none"  # by what they are taken in the engine, before they are mapped to Drake's x and u
    # By quantity of the match: why this engine cannot have what Drake has.
    reasons: Mapping[str, str] = field(default_factory=dict)


class StepJacobian(NamedTuple):
    """A (nx, nx) and B (nx, nu) of one step in Drake's coordinates, and where they come from."""

    A: Array
    B: Array
    method: str


class Engine(Protocol):
    """One model in one simulator. `x = [q; v]` and `u` are Drake's: order, quaternion (w, x, y, z), v in world.

    Everything depends on the arguments alone, not on the calls before. What an engine does not compute raises
    NotOfferedError, with the reason.
    """

    @property
    def name(self) -> str:
        """The engine's, with what was chosen in it."""
        ...

    @property
    def version(self) -> str:
        """Of the library."""
        ...

    @property
    def contract(self) -> EngineContract:
        """What the engine uses."""
        ...

    @property
    def status(self) -> str:
        """Of the last step: "ok", or what the engine's solver said."""
        ...

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        """(nx,) one time step after `x` (nx,) under `u` (nu,). ShapeError, NonFiniteError, SimulationError."""
        ...

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        """The Jacobians of `step`."""
        ...

    def energy(self, x: ArrayLike) -> float:
        """[J] kinetic and potential; potential energy is 0 with all mass at height 0 and springs at rest."""
        ...

    def contact_depth(self, x: ArrayLike) -> float:
        """[m] the deepest overlap, 0 where nothing touches or the engine has no contact."""
        ...

    def mass_matrix(self, q: ArrayLike) -> Array:
        """(nv, nv), armature included."""
        ...

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        """(nv,) in M dv/dt + bias = B u - damping v: velocity products less gravity and springs."""
        ...
