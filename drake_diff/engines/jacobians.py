"""Engines' Jacobians on the tangent space: against another engine's, and against differences of the engine's own step.

An engine whose Jacobian is not the derivative of its own step must not be used for gradients, whatever it agrees with.
"""

from dataclasses import dataclass

import numpy as np

from drake_diff.arrays import Array, frozen
from drake_diff.certificate import Certificate, certify_displacement
from drake_diff.engines.engine import Engine, Precision
from drake_diff.engines.motion import EngineMotion
from drake_diff.exceptions import NotOfferedError
from drake_diff.finite_difference import differences
from drake_diff.tangent import TangentSpace

# Steps of differences for engines without derivatives: where rounding and truncation are both small.
DIFFERENCE_STEP: dict[Precision, float] = {"float64": 1e-5, "float32": 1e-2}


@dataclass(frozen=True, eq=False)
class JacobianAt:
    """[A B] (2 nv, 2 nv + nu) of one engine's step at one state, on the tangent space.

    `own` certifies it against differences of the engine's own step; None where it is made of them.
    """

    state: str  # "start", "free", "contact", "deepest"
    jacobian: Array
    method: str
    own: Certificate | None


def jacobian_at(
    engine: Engine, space: TangentSpace, names: tuple[str, ...], state: str, x: Array, u: Array
) -> JacobianAt:
    """The engine's Jacobian at `x` (nx,) and `u` (nu,), with the certificate; `names` (nu,) are the inputs'."""
    size = space.size + len(u)

    def step(d: Array) -> Array:
        return engine.step(space.plus(x, d[: space.size]), u + d[space.size :])

    try:
        found = engine.differentiate_step(x, u)
    except NotOfferedError:
        width = DIFFERENCE_STEP[engine.contract.precision]
        quotients = differences(step, size, width, minus=space.minus)
        return JacobianAt(state, frozen(quotients.central), f"central differences of its steps, {width:g} wide", None)
    jacobian = on_tangent(space, x, engine.step(x, u), found.A, found.B)
    certificate = certify_displacement(
        step,
        jacobian,
        rows=space.names,
        columns=(*space.names, *names),
        scale=np.ones(size),
        minus=space.minus,
        solver_tolerance=(engine.contract.solver_tolerance or 0.0) if engine.contact_depth(x) else 0.0,
        method=found.method,
        subject=f"the Jacobian of {engine.name} at the {state} state",
    )
    return JacobianAt(state, frozen(jacobian), found.method, certificate)


def on_tangent(space: TangentSpace, x: Array, x_next: Array, A: Array, B: Array) -> Array:
    """(size, size + nu) from A (nx, nx) and B (nx, nu)."""
    return np.asarray(space.derivative_of_minus(x_next) @ np.hstack([A @ space.derivative_of_plus(x), B]))


def rollout_jacobian(engine: Engine, space: TangentSpace, motion: EngineMotion) -> Array | None:
    """(size, size) d x_N / d x_0 along the engine's own motion; None where it offers no derivative."""
    product = np.eye(space.size)
    for x, u, x_next in zip(motion.xs, motion.us, motion.xs[1:], strict=False):
        try:
            found = engine.differentiate_step(x, u)
        except NotOfferedError:
            return None
        product = on_tangent(space, x, x_next, found.A, found.B)[:, : space.size] @ product
    return frozen(product)
