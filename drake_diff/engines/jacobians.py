"""Engines' Jacobians on the tangent space, checked against differences of the engine's own steps.

An engine whose Jacobian is not the derivative of its own step must not be used for gradients, whatever it agrees with.
"""

from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.differences import central_differences, one_by_one
from drake_diff.certificates.certificate import Certificate, certify_displacement
from drake_diff.engines.interface import Engine, Precision
from drake_diff.engines.motion import EngineMotion
from drake_diff.exceptions import NotOfferedError
from drake_diff.model.tangent import TangentSpace

# Steps of differences for engines without derivatives: where rounding and truncation are both small.
DIFFERENCE_STEP: dict[Precision, float] = {"float64": 1e-5, "float32": 1e-2}
# An engine's own derivative that is made of differences is good to 1e-8 of the row's largest entry, and the certificate
# allows a hundred times what it is told was left unsolved.
DIFFERENCES_LEAVE = 1e-10
AGREES = "agree"
SINGLE = 1e-2  # of the largest entry: as far as differences of single precision tell


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
    except NotOfferedError:
        method = f"central differences of its steps, {DIFFERENCE_STEP[precision]:g} wide"
        return JacobianAt(state, frozen(quotients()), method, None, None)
    jacobian = space.jacobian(x, engine.step(x, u), found.A, found.B)
    if precision == "float32":
        gap = np.abs(jacobian - quotients()).max() / np.abs(jacobian).max()
        return JacobianAt(state, frozen(jacobian), found.method, AGREES if gap <= SINGLE else "undecided", None)
    # What the engine's solver leaves unsolved of a step in contact, relative.
    unsolved = (engine.contract.solver_tolerance or 0.0) if engine.contact_depth(x) else 0.0
    certificate = certify_displacement(
        one_by_one(step),
        jacobian,
        rows=space.names,
        columns=(*space.names, *names),
        scale=np.ones(size),
        minus=space.minus,
        solver_tolerance=max(unsolved, DIFFERENCES_LEAVE if "differences" in found.method else 0.0),
        method=found.method,
        subject=f"the Jacobian of {engine.name} at the {state} state",
    )
    return JacobianAt(state, frozen(jacobian), found.method, certificate.verdict, certificate)


def rollout_jacobian(engine: Engine, space: TangentSpace, motion: EngineMotion) -> Array | None:
    """(size, size) d x_N / d x_0 along the engine's own motion; None where it offers no derivative."""
    product = np.eye(space.size)
    for x, u, x_next in zip(motion.xs, motion.us, motion.xs[1:], strict=False):
        try:
            found = engine.differentiate_step(x, u)
        except NotOfferedError:
            return None
        product = space.jacobian(x, x_next, found.A) @ product
    return frozen(product)
