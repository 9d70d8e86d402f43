"""A user's equations of motion as an engine, and the comparison of each part of their forces with another engine."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from tokenize import TokenError
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array
from drake_diff.engines.contract import FUNCTION_DOES_NOT_SAY, SAME_NUMBER, ContractLine, Match
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.interface import DRAKES_STEP, Arguments, Engine, EngineContract, float_rows, not_offered
from drake_diff.exceptions import InputError, NotOfferedError, SimulationError, UnknownNameError
from drake_diff.mechanics.coordinates import euler_step
from drake_diff.mechanics.description import JointContract, coordinates_of
from drake_diff.model.model import Model
from drake_diff.model.tangent import sample_states

EXPLICIT, RK4 = "semi-implicit Euler, joint damping explicit, q' = q + h N(q) v'", "Runge-Kutta of order 4"
INTEGRATORS: Mapping[str, str] = {"drake": DRAKES_STEP, "semi-implicit Euler": EXPLICIT, "RK4": RK4}
# Quantities of the match that a function of accelerations does not define. Its forces are compared instead.
NOT_SAID = (
    "frames", "mass", "center of mass", "inertia", "damping", "armature", "springs", "position limits", "gravity",
    "actuator mapping",
)  # fmt: skip
UNSAID = float("nan")
PARTS = ("forces at rest", "velocity products", "damping forces", "forces of the inputs")
LACKING = "{name}: a function of accelerations does not provide"
ALONE = 1e-6  # relative remainder of a part below which a factor explains the whole difference
# Relative rounding of a force M(q) a, times the condition number of M.
ROUNDING = 1e-14


@dataclass(frozen=True)
class UserFunction:
    """The recorded description of a function: its name, the hash of its source, and its parameters."""

    name: str
    sha256: str | None  # of the source, None if the source is not available
    parameters: Mapping[str, float]


class Parts(NamedTuple):
    """The generalized forces (nv,) of one engine at one state, as listed in PARTS."""

    rest: Array
    products: Array
    damping: Array
    inputs: Array


class ClosedForm(Arguments):
    """A user's equations of motion in NumPy as an engine, for a comparison with Drake by `dd.compare`.

    The function returns accelerations. At random states, `compare` separates them into forces at rest (gravity,
    springs), velocity products, damping and forces of the inputs, and compares each part with Drake's by joint. The
    forces are computed with Drake's M(q), so that a wrong inertia shows in every part. If a part differs, the models
    differ, and the detail names the joint and, if there is one, the factor. Contact and joint limits are not compared.

    The inputs are clipped at the model's effort limits before the call. A record identifies the function only by its
    name and the hash of its source, which does not cover objects outside the function.

    Args:
        model: The model that defines the coordinates and the time step.
        acceleration: (q (nq,), v (nv,), u (nu,)) -> dv/dt (nv,), or with `parameters` (q, v, u, parameters). SI units.
            A free body has Drake's coordinates: quaternion w x y z and position; angular and linear velocity in world.
        name: The name in results.
        parameters: Named numbers that are passed to the function and recorded.
        integrator: "drake" (semi-implicit Euler, in which forces that are linear and odd in v use the next velocity, as
            Drake's joint damping does), "semi-implicit Euler" (v' = v + h a) or "RK4".
        contact: A description of the contact law, if the function includes contact. A step in contact is then either
            the same as Drake's or unexplained, as friction and stiffness are unknown.

    Raises:
        UnknownNameError: There is no such integrator.
        InputError: The function fails, or returns different values for the same arguments.
        ShapeError, NonFiniteError: The function returns another shape, NaN or infinity at a state of the model.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> mine = dd.engines.ClosedForm(
        ...     model,
        ...     lambda q, v, u, p: (u - 0.1 * v - p["mass"] * 9.81 * 0.5 * np.sin(q)) / (p["mass"] * 0.5**2),
        ...     name="my pendulum", parameters={"mass": 1.0},
        ... )
        >>> print(dd.compare(model, [mine], num_steps=20).engines[1].verdict)
        same
    """

    status, version = "ok", "equations"

    def __init__(
        self,
        model: Model,
        acceleration: Callable[..., ArrayLike],
        *,
        name: str = "closed form",
        parameters: Mapping[str, float] | None = None,
        integrator: str = "drake",
        contact: str | None = None,
    ):
        if not callable(acceleration):
            raise InputError("acceleration", got=repr(acceleration)[:80], expected="a function of q, v and u")
        if not isinstance(name, str) or not name:
            raise InputError("name", got=repr(name), expected="a name")
        if integrator not in INTEGRATORS:
            raise UnknownNameError("integrator", got=integrator, known=INTEGRATORS)
        self.name, self.integrator, self.contact, self._acceleration = name, integrator, contact, acceleration
        numbers = {} if parameters is None else parameters
        given = {str(key): float(finite_array(f"parameters[{key!r}]", x, ())) for key, x in numbers.items()}
        self._extra = () if parameters is None else (MappingProxyType(given),)
        self.function = UserFunction(_name_of(acceleration), _source_hash(acceleration), given)
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu
        self.coordinates, self.time_step = coordinates_of(model), model.time_step
        self._drakes = DrakeEngine(model).contract
        self._limits = np.array(self._drakes.effort_limits)
        self._try(model)

    def _try(self, model: Model) -> None:
        """Call the function twice at a state, to report errors early."""
        sample = sample_states(model, 1)[0]
        expected = "a function of only q, v and u"
        try:
            first, second = (self.acceleration(sample.x[: self.nq], sample.x[self.nq :], sample.u) for _ in range(2))
        except SimulationError as error:
            raise InputError("acceleration", got=str(error), expected=expected) from error
        if not np.array_equal(first, second):
            raise InputError("acceleration", got=f"{first} and then {second} for the same arguments", expected=expected)

    def acceleration(self, q: ArrayLike, v: ArrayLike, u: ArrayLike) -> Array:
        """Compute dv/dt (nv,) in Drake's order.

        Args:
            q: (nq,) Positions.
            v: (nv,) Velocities.
            u: (nu,) Inputs, which are clipped at their limits.

        Returns:
            (nv,) The accelerations.

        Raises:
            ShapeError, NonFiniteError: An argument or the function's result has another shape or is not finite.
            SimulationError: The function fails.
        """
        q, v = self._motion(q, v)
        u = np.clip(finite_array("u", u, (self.nu,)), -self._limits, self._limits)
        try:
            given = self._acceleration(q, v, u, *self._extra)
        except (ArithmeticError, LookupError, TypeError, ValueError) as error:
            raise SimulationError(f"{self.name} fails at q = {q}, v = {v}: {type(error).__name__}: {error}") from error
        return finite_array(f"{self.name}: acceleration at q = {q}, v = {v}", given, (self.nv,))

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        """Compute the state (nx,) one time step after `x` (nx,) under `u` (nu,)."""
        x, u = self._point(x, u)
        q, v, h = x[: self.nq], x[self.nq :], self.time_step
        try:
            if self.integrator == "RK4":
                x_next = self._runge_kutta(x, u)
            else:
                a = self.acceleration(q, v, u)
                if self.integrator == "drake":  # (1 - h dodd/dv) a = f, which is (M + h D) a = M f
                    a = np.asarray(np.linalg.solve(np.eye(self.nv) - h * self._damping_by_velocity(q), a), dtype=float)
                x_next = euler_step(self.coordinates, h, x, a)
        except (InputError, np.linalg.LinAlgError) as error:
            raise SimulationError(str(error)) from error
        if not np.all(np.isfinite(x_next)):
            raise SimulationError(f"the step leads to {x_next}, which is not finite, from x = {x}, u = {u}")
        return x_next

    def _runge_kutta(self, x: Array, u: Array) -> Array:
        h = self.time_step

        def rate(x: Array) -> Array:
            q, v = x[: self.nq], x[self.nq :]
            return np.concatenate([self.coordinates.rate(q) @ v, self.acceleration(q, v, u)])

        a = rate(x)
        b = rate(x + h / 2 * a)
        c = rate(x + h / 2 * b)
        return np.asarray(x + h / 6 * (a + 2 * b + 2 * c + rate(x + h * c)))

    def _damping_by_velocity(self, q: Array) -> Array:
        """Return the odd part (nv, nv) of the acceleration at unit velocities. Velocity products are even."""
        u = np.zeros(self.nu)
        columns = [(self.acceleration(q, e, u) - self.acceleration(q, -e, u)) / 2 for e in np.eye(self.nv)]
        return np.array(columns).reshape(self.nv, self.nv).T

    def parts(self, M: Array, q: Array, v: Array, u: Array) -> Parts:
        """Compute the parts of the forces from the accelerations and `M` (nv, nv)."""
        still, no_u = np.zeros(self.nv), np.zeros(self.nu)
        rest, ahead, back = (self.acceleration(q, w, no_u) for w in (still, v, -v))
        accelerations = (rest, (ahead + back) / 2 - rest, (ahead - back) / 2, self.acceleration(q, v, u) - ahead)
        return Parts(*(M @ a for a in accelerations))

    def terms(self, M: Array, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """Return bias, B u and joint damping, (nv,) each, that yield these accelerations with `M` (nv, nv)."""
        q, v = x[: self.nq], x[self.nq :]
        damping = -np.diag(M @ self._damping_by_velocity(q))
        inputs = self.parts(M, q, v, u).inputs
        return inputs - damping * v - M @ self.acceleration(q, v, u), inputs, damping

    def part_lines(self, match: Match, states: Sequence[tuple[Array, Array]]) -> tuple[ContractLine, ...]:
        """Compare each part of the forces at `states` (q, v). This requires that the other engine offers M(q)."""
        theirs = next(engine for engine in match.engines if engine is not self)
        random, contract = np.random.default_rng(1), theirs.contract
        limit = np.minimum(np.array(contract.effort_limits), 1.0)
        us = [limit * random.uniform(-1, 1, len(limit)) for _ in states]
        try:
            masses = [theirs.mass_matrix(q) for q, _ in states]
            wanted = [_parts_of(theirs, *state, u) for state, u in zip(states, us, strict=True)]
            given = [self.parts(M, *s, u) for M, s, u in zip(masses, states, us, strict=True)]
        except (InputError, NotOfferedError, SimulationError) as error:
            return tuple(ContractLine(force, "different", f"not comparable: {error}") for force in PARTS)
        tolerance = max(SAME_NUMBER[match.precision], ROUNDING * max(float(np.linalg.cond(M)) for M in masses))
        names = [joint.name for joint in contract.by_velocity]
        scale = np.array([max(float(np.abs(force).max(initial=0.0)) for force in parts) for parts in wanted])
        lines = []
        for i, quantity in enumerate(PARTS):
            a, b = (np.array([parts[i] for parts in all_parts]) for all_parts in (wanted, given))
            off = np.abs(b - a) > tolerance * np.maximum(scale, np.abs(b).max(axis=1, initial=0.0))[:, None]
            wrong = [f"of {names[j]}, {_how_different(a[:, j], b[:, j])}" for j in np.flatnonzero(off.any(axis=0))]
            summary = f"of {', '.join(dict.fromkeys(names))}, at {len(states)} random states"
            lines.append(ContractLine(quantity, "different" if wrong else "equal", "; ".join(wrong) or summary))
        wrong_inputs = lines[-1].verdict == "different"
        if wrong_inputs and sum(line.verdict == "different" for line in lines) > 1:
            remark = "a wrong inertia looks like this, as the forces are taken with M(q) of the other engine"
            lines[-1] = replace(lines[-1], detail=f"{lines[-1].detail}; {remark}")
        return tuple(lines)

    # Comparisons of Jacobians use differences of the steps.
    differentiate_step = not_offered(f"{LACKING} derivatives")
    energy = not_offered(f"{LACKING} energy")
    contact_depth = not_offered(f"{LACKING} overlap")
    mass_matrix = not_offered(f"{LACKING} M(q) alone")
    bias = not_offered(f"{LACKING} forces alone")

    @property
    def contract(self) -> EngineContract:
        """The model's coordinates, effort limits and time step. A function does not define the other quantities."""
        unsaid: dict[str, Any] = {
            "axis": (UNSAID,) * 3, "anchor": (UNSAID,) * 3, "center_of_mass": (UNSAID,) * 3, "inertia": (UNSAID,) * 6,
            **dict.fromkeys(("mass", "damping", "armature", "stiffness", "rest"), UNSAID),
        }  # fmt: skip
        joints = tuple(JointContract(name=joint.name, kind=joint.kind, **unsaid) for joint in self._drakes.joints)
        touching = dict.fromkeys(("contact pairs", "contact law", "solver tolerance"), FUNCTION_DOES_NOT_SAY)
        none = {
            "contact pairs": "the equations have no contact", "contact law": "the equations have no contact",
            "solver tolerance": "nothing is solved iteratively",
        }  # fmt: skip
        return EngineContract(
            engine=self.name, joints=joints, native_order=self._drakes.native_order, inputs=self._drakes.inputs,
            actuation=float_rows(np.full((self.nv, self.nu), UNSAID)), effort_limits=self._drakes.effort_limits,
            time_step=self.time_step, integrator=INTEGRATORS[self.integrator], gravity=(UNSAID,) * 3,
            contact_law=self.contact or "none",
            reasons={
                **dict.fromkeys(NOT_SAID, FUNCTION_DOES_NOT_SAY),
                "limit law": "the equations have no joint limits",
                **(touching if self.contact else none),
            },
        )  # fmt: skip


def _parts_of(engine: Engine, q: Array, v: Array, u: Array) -> Parts:
    """Compute the parts of the forces from an engine's terms. Raises NotOfferedError if it has none."""
    contract = engine.contract
    rest = -engine.bias(q, np.zeros(len(v)))
    return Parts(rest, -engine.bias(q, v) - rest, -contract.damping * v, contract.effort(u))


def _how_different(wanted: Array, given: Array) -> str:
    """Describe how one joint's force over the states differs from the expected force."""
    size, gap = float(wanted @ wanted), float(np.abs(given - wanted).max())
    at_most = f"off by up to {gap:.4g} of {np.abs(wanted).max():.4g}"
    if not size:
        return f"{at_most}: expected 0"
    factor = float(given @ wanted) / size
    if np.abs(given - factor * wanted).max() > ALONE * max(float(np.abs(given).max()), ALONE * np.abs(wanted).max()):
        return at_most
    return f"{at_most}: {factor:.6g} times the expected value"


def _name_of(function: Any) -> str:
    return str(getattr(function, "__qualname__", type(function).__qualname__))


def _source_hash(function: Any) -> str | None:
    """Return the hash of the source of a function, or of the class of a callable object."""
    shown = function if inspect.isroutine(function) else type(function)
    try:
        return sha256(inspect.getsource(shown).encode()).hexdigest()
    except (OSError, TypeError, SyntaxError, TokenError):  # the file is missing or has changed
        return None
