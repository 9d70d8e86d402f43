"""What an engine does: its motion with energy and overlap, its time, and its Jacobians on the tangent space.

Jacobians are checked against differences of the engine's own steps: one that is not the derivative of its own step
must not be used for gradients, whatever it agrees with.
"""

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.differences import central_differences, one_by_one
from drake_diff._base.refusal import Refusal
from drake_diff.certificates.certificate import Certificate, certify_displacement
from drake_diff.engines.interface import Engine, Precision
from drake_diff.exceptions import GradientError, NotOfferedError, SimulationError
from drake_diff.model.tangent import TangentSpace

BROKE_OFF = "broke off"
TIMED = 15  # calls whose median is told, after one that may compile
LONGEST = 1.0  # [s] less are timed where they take so long
# Steps of differences for engines without derivatives: where rounding and truncation are both small.
DIFFERENCE_STEP: dict[Precision, float] = {"float64": 1e-5, "float32": 1e-2}
# An engine's own derivative that is made of differences is good to 1e-8 of the row's largest entry, and the certificate
# allows a hundred times what it is told was left unsolved.
DIFFERENCES_LEAVE = 1e-10
AGREES = "agree"
NO_DERIVATIVE = (NotOfferedError, GradientError, SimulationError)  # the last: shapes that AutoDiffXd refuses
SINGLE = 1e-2  # of the largest entry: as far as differences of single precision tell


@dataclass(frozen=True, eq=False, repr=False)
class EngineMotion:
    """What one engine, or a recording, did. `status` is "ok", or what its solver said first, and when."""

    times: Array  # (n,) [s]
    xs: Array  # (n, nx)
    us: Array  # (n - 1, nu)
    energy: Array | None  # (n,) [J] kinetic and potential; None where it does not compute it
    depth: Array | None  # (n,) [m] deepest overlap
    status: str

    def __repr__(self) -> str:
        return f"{len(self.xs)} states over {self.times[-1] - self.times[0]:.6g} s: {self.status}"

    @property
    def energy_change(self) -> float | None:
        """[J] from first to last state, inputs' work and damping included; None where there is no energy."""
        return None if self.energy is None else float(self.energy[-1] - self.energy[0])


def move(engine: Engine, x0: Array, us: Array) -> EngineMotion:
    """The motion from `x0` (nx,) under `us` (N, nu), up to the first step that the engine cannot take."""
    h, xs, status = engine.contract.time_step, [x0], "ok"
    for k, u in enumerate(us):
        try:
            xs.append(engine.step(xs[-1], u))
        except SimulationError as error:
            status = f"{BROKE_OFF} at t = {k * h:.4g} s: {error}"
            break
        if engine.status != "ok" and status == "ok":
            status = f"at t = {k * h:.4g} s: {engine.status}"
    return measured(engine, np.array([k * h for k in range(len(xs))]), np.array(xs), us[: len(xs) - 1], status)


def measured(engine: Engine, times: Array, xs: Array, us: Array, status: str = "ok") -> EngineMotion:
    """The motion `xs` (n, nx) with the energies and overlaps that `engine` finds in it."""

    def where_offered(ask: Callable[[Array], float]) -> Array | None:
        try:
            return frozen([ask(x) for x in xs])
        except NotOfferedError:
            return None

    energy, depth = where_offered(engine.energy), where_offered(engine.contact_depth)
    return EngineMotion(frozen(times), frozen(xs), frozen(us), energy, depth, status)


def seconds(call: Callable[[], Any]) -> float | None:
    """The median time of `call`, its first run, which may compile, left out; None where there is none."""
    try:
        call()
    except NO_DERIVATIVE:
        return None
    taken: list[float] = []
    while len(taken) < TIMED and sum(taken) < LONGEST:
        start = perf_counter()
        call()
        taken.append(perf_counter() - start)
    return median(taken)


@dataclass(frozen=True, eq=False)
class JacobianAt:
    """[A B] (2 nv, 2 nv + nu) of one engine's step at one state, on the tangent space.

    `own` says whether it is the derivative of the engine's own step: the certificate's verdict, in single precision
    "agree" or "undecided"; None where it is made of differences.
    """

    state: str  # "start", "free", "contact", "deepest"
    jacobian: Array
    method: str
    own: str | None
    certificate: Certificate | None


def jacobian_at(
    engine: Engine, space: TangentSpace, names: tuple[str, ...], state: str, x: Array, u: Array
) -> JacobianAt:
    """The engine's Jacobian at `x` (nx,) and `u` (nu,), with the certificate; `names` (nu,) are the inputs'."""
    size, precision = space.size + len(u), engine.contract.precision

    def step(d: Array) -> Array:
        return engine.step(space.plus(x, d[: space.size]), u + d[space.size :])

    def quotients() -> Array:
        return central_differences(step, size, DIFFERENCE_STEP[precision], minus=space.minus)

    try:
        found = engine.differentiate_step(x, u)
    except NO_DERIVATIVE as error:
        why = "" if isinstance(error, NotOfferedError) else f" ({error})"
        method = f"central differences of its steps, {DIFFERENCE_STEP[precision]:g} wide{why}"
        return JacobianAt(state, frozen(quotients()), method, None, None)
    jacobian = space.jacobian(x, engine.step(x, u), found.A, found.B)
    if precision == "float32":
        gap = np.abs(jacobian - quotients()).max() / np.abs(jacobian).max()
        return JacobianAt(state, frozen(jacobian), found.method, AGREES if gap <= SINGLE else "undecided", None)
    # What the engine's solver leaves unsolved of a step in contact, relative.
    unsolved = (engine.contract.solver_tolerance or 0.0) if engine.contact_depth(x) else 0.0
    certificate = certify_displacement(
        one_by_one(step), jacobian, rows=space.names, columns=(*space.names, *names), scale=np.ones(size),
        minus=space.minus,
        unsolved=unsolved, stopped=max(unsolved, DIFFERENCES_LEAVE if "differences" in found.method else 0.0),
        method=found.method, subject=f"the Jacobian of {engine.name} at the {state} state",
    )  # fmt: skip
    return JacobianAt(state, frozen(jacobian), found.method, certificate.verdict, certificate)


def rollout_jacobian(engine: Engine, space: TangentSpace, motion: EngineMotion) -> Array | Refusal:
    """(size, size) d x_N / d x_0 along the engine's own motion; or why one of its steps has no derivative."""
    product = np.eye(space.size)
    for x, u, x_next in zip(motion.xs, motion.us, motion.xs[1:], strict=False):
        try:
            found = engine.differentiate_step(x, u)
        except NotOfferedError:
            return Refusal("the engine has no derivative of a step in contact")
        except NO_DERIVATIVE as error:
            return Refusal(str(error))
        product = space.jacobian(x, x_next, found.A) @ product
    return frozen(product)
