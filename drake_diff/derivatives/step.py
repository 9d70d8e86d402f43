"""The Jacobians of discrete steps, and the check that each must pass before it is returned."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array, frozen
from drake_diff._base.values import ShowsItsRepr
from drake_diff.derivatives.analytic import one_smooth_step
from drake_diff.derivatives.sources import ANALYTIC, CERTIFIED, IMPLICIT, OF_ONE_KIND, Chosen, check_method, choose
from drake_diff.derivatives.steps import Steps, known_steps, take_step, take_steps
from drake_diff.exceptions import GradientError, ShapeError
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, ParameterVector, applied, select
from drake_diff.model.step import check_point

# The methods that use the analytic derivative for a smooth step, with the reason.
OF_ONE_SMOOTH_STEP = {"auto": CERTIFIED, "analytic": "asked for"}
# Correct derivatives of lagged contact reach 4e4. Drake's singular poses give 1e15 and more.
MAGNITUDE_BOUND = 1e8


@dataclass(frozen=True, eq=False)
class StepDerivatives(ShowsItsRepr):
    """A step x_next = f(x, u, p) and its Jacobians, returned by `differentiate_step`. Arrays are read-only.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> dd.differentiate_step(model, [0.0, 0.0], [1.0], method="autodiff")
        StepDerivatives: A (2, 2), B (2, 1), C (2, 0) by autodiff, asked for
    """

    x_next: Array  # (nx,)
    A: Array  # (nx, nx) df/dx
    B: Array  # (nx, nu) df/du
    C: Array  # (nx, np) df/dp
    parameters: tuple[str, ...]  # (np,) the names of p
    sources: tuple[str, ...]  # (np,) the method of each column of C
    method: str  # the method of A and B
    reason: str  # the reason for this method

    def __repr__(self) -> str:
        by = f"\nC by {', '.join(map(' from '.join, zip(self.parameters, self.sources, strict=True)))}"
        shapes = ", ".join(f"{name} {getattr(self, name).shape}" for name in "ABC")
        return f"StepDerivatives: {shapes} by {self.method}, {self.reason}{by if self.parameters else ''}"


def differentiate_step(
    model: Model, x: ArrayLike, u: ArrayLike | None = None, *, parameters: Parameters = (), method: str = "auto"
) -> StepDerivatives:
    """Return the Jacobians of `step(model, x, u)`, in Drake's coordinates x = [q; v].

    Args:
        model: The discrete model.
        x: (nx,) the state, [m or rad] and [m/s or rad/s].
        u: (nu,) the input [N or N m]; may be omitted if the model has no actuators.
        parameters: Names of the parameters for C (see `list_parameters`), at the model's own values, or a mapping of
            the names to other values.
        method: The method that computes the Jacobians:

            - "autodiff": AutoDiffXd through Drake's own step;
            - "analytic": the step's own equation, with point contact, joint limits and couplers, certified equal to
              Drake's on this model. Supported parameters are friction, stiffness, dissipation and relaxation time. In
              all other cases a GradientError with the reason is raised;
            - "implicit": from the equation of a smooth step; autodiff if contact or a limit acts;
            - "finite_difference": central differences of the double step. If contact, joint limits, PD controllers or
              couplers act and their equation is known, the step is solved to rounding, as `reason` then states;
            - "auto": the fastest exact method for the model's size and the forces that act: analytic, else implicit,
              else autodiff, and differences if Drake does not support AutoDiffXd. For one step with contact and fewer
              than eight degrees of freedom, autodiff is the first choice.

    Returns:
        `x_next` (nx,), `A` (nx, nx), `B` (nx, nu) and `C` (nx, np), with the `method` used and the `reason` for it.

    Raises:
        GradientError: The AutoDiffXd step differs from the double step, a derivative is not finite or larger than 1e8,
            or method "analytic" does not support the step.
        SimulationError: Drake cannot compute the step.
        UnknownNameError: The method or a parameter does not exist.
        ShapeError, NonFiniteError: x or u is invalid for the model.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> d = dd.differentiate_step(model, [0.0, 0.0], [0.0], parameters=("hinge.damping",))
        >>> d.A.round(3)
        array([[ 0.998,  0.01 ],
               [-0.195,  0.996]])
        >>> d.parameters, d.C.shape
        (('hinge.damping',), (2, 1))
    """
    check_method(method)
    x, u = check_point(model, x, u)
    vector = select(model, parameters)
    with applied(vector) as set_model:
        return step_jacobians(set_model, vector, x, u, method)


def linearize(
    model: Model, xs: ArrayLike, us: ArrayLike, method: str = "auto", x_next: ArrayLike | None = None
) -> tuple[Array, Array, tuple[str, ...]]:
    """Return the Jacobians of many steps in one call, which is much faster than one call per step.

    Args:
        model: The discrete model.
        xs: (N, nx) the start states, or (N+1, nx) with a last state from which no step is taken.
        us: (N, nu) the inputs [N or N m].
        method: See `differentiate_step`; "auto" chooses a method for each step.
        x_next: (N, nx) the end states of the steps, if known, which avoids Drake's own steps. If an end state is found
            to be wrong, the step is computed by Drake.

    Returns:
        A (N, nx, nx), B (N, nx, nu), and the method of each step (N,).

    Raises:
        ShapeError, NonFiniteError, UnknownNameError: An argument is invalid.
        GradientError, SimulationError: See `differentiate_step`.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
        >>> motion = dd.rollout(model, [0, 0.1, 0, 0], np.zeros((20, 1)))
        >>> A, B, methods = dd.linearize(model, motion.xs, motion.us, "autodiff")
        >>> A.shape, B.shape, set(methods)
        ((20, 4, 4), (20, 4, 1), {'autodiff'})
    """
    check_method(method)
    us = finite_array("us", us, ("N", model.nu))
    xs = finite_array("xs", xs, ("N", model.nx))
    if len(xs) - len(us) not in (0, 1):
        raise ShapeError("xs", got=xs.shape, expected=(f"{len(us)} or {len(us) + 1}", model.nx))
    xs, nx = xs[: len(us)], model.nx
    ends = None if x_next is None else finite_array("x_next", x_next, (len(us), nx))
    if not len(us):
        return np.empty((0, nx, nx)), np.empty((0, nx, model.nu)), ()
    vector = select(model, ())
    steps = take_steps(model, vector, xs[0], us, xs) if ends is None else known_steps(model, vector, xs, us, ends)
    chosen = choose(steps, method)
    _check_derivatives(model, chosen.values)
    return chosen.values[:, :, :nx], chosen.values[:, :, nx:], tuple(chosen.methods)


def step_jacobians(model: Model, vector: ParameterVector, x: Array, u: Array, method: str) -> StepDerivatives:
    """Compute `differentiate_step` on a model with `vector` applied, without checks of the shapes."""
    steps = take_step(model, vector, x, u)
    jacobian = _smooth_jacobian(steps, method)
    if jacobian is not None:
        jacobian.setflags(write=False)
        x_next = steps.x_next[0]
        x_next.setflags(write=False)
        A, B, C = jacobian[:, : model.nx], jacobian[:, model.nx :], jacobian[:, len(x) + len(u) :]
        return StepDerivatives(x_next, A, B, C, (), (), ANALYTIC.name, OF_ONE_SMOOTH_STEP[method])
    return _derivatives_of(steps, choose(steps, method, single=True))[0]


def _smooth_jacobian(steps: Steps, method: str) -> Array | None:
    """Return the checked Jacobian (nx, nx + nu) of one smooth step without parameters, or None for other steps."""
    if method not in OF_ONE_SMOOTH_STEP or steps.vector.parameters or steps.some_touch:
        return None
    jacobian = one_smooth_step(steps.model, steps)
    if jacobian is not None:
        _check_derivatives(steps.model, jacobian[None])
    return jacobian


def derivatives_along(
    model: Model,
    x0: Array,
    us: Array,
    *,
    vector: ParameterVector | None = None,
    method: str = "auto",
    xs: Array | None = None,
) -> list[StepDerivatives]:
    """Return the step derivatives along the rollout from `x0` (nx,) under `us` (N, nu), with `vector` applied.

    If xs (N, nx) is given, the steps start from these states.
    """
    steps = take_steps(model, vector or select(model, ()), x0, us, xs)
    return _derivatives_of(steps, choose(steps, method))


@dataclass(frozen=True, eq=False)
class Linearization:
    """The Jacobians of N steps, one after the other or of several motions."""

    x_next: Array  # (N, nx)
    jacobians: Array  # (N, nx, nx + nu + np)
    parameters: tuple[str, ...]  # (np,)
    sources: tuple[str, ...]  # (np,) of the first step
    methods: tuple[str, ...]  # of all steps, each once


def linearize_steps(steps: Steps, method: str, *, single: bool = False) -> Linearization:
    """Return the checked Jacobians of steps whose parameters are applied."""
    jacobian = _smooth_jacobian(steps, method) if single else None
    if jacobian is not None:
        return Linearization(steps.x_next, jacobian[None], (), (), (ANALYTIC.name,))
    chosen = choose(steps, method, single=single)
    _check_derivatives(steps.model, chosen.values)
    sources = _column_sources(steps.vector, chosen.methods[0])
    return Linearization(steps.x_next, chosen.values, steps.vector.names, sources, tuple(sorted({*chosen.methods})))


def _column_sources(vector: ParameterVector, used: str) -> tuple[str, ...]:
    """Return the method of each parameter's column (np,) of a step that is differentiated by `used`."""
    if used in OF_ONE_KIND:
        return (used,) * len(vector.names)
    if used == IMPLICIT.name and vector.step_entry is not None:
        return (*vector.sources[: vector.step_entry], used, *vector.sources[vector.step_entry + 1 :])
    return vector.sources


def _derivatives_of(steps: Steps, chosen: Chosen) -> list[StepDerivatives]:
    model, vector = steps.model, steps.vector
    _check_derivatives(model, chosen.values)
    nx, end, names = model.nx, model.nx + model.nu, vector.names
    x_next, values = frozen(steps.x_next), frozen(chosen.values)  # their views are read-only too
    derivatives, rows = [], zip(x_next, values, chosen.methods, chosen.reasons, strict=True)
    for end_state, jacobian, used, reason in rows:
        A, B, C = jacobian[:, :nx], jacobian[:, nx:end], jacobian[:, end:]
        derivatives.append(StepDerivatives(end_state, A, B, C, names, _column_sources(vector, used), used, reason))
    return derivatives


def _check_derivatives(model: Model, jacobians: Array) -> None:
    """Raise GradientError if a derivative is not finite or, with respect to x or u, implausibly large."""
    values: Any = jacobians  # NumPy 2.5 has no types for its methods, and np.min takes twice as long
    if values.min(initial=0.0) >= -MAGNITUDE_BOUND and values.max(initial=0.0) <= MAGNITUDE_BOUND:
        return
    jacobian = jacobians.reshape(-1, jacobians.shape[2])
    bound = np.full(jacobian.shape[1], MAGNITUDE_BOUND)
    bound[model.nx + model.nu :] = np.finfo(float).max  # the magnitude depends on the parameter's unit
    size = np.where(np.isfinite(jacobian), np.abs(jacobian), np.inf) / bound
    if size.size and size.max() > 1:
        row, column = divmod(int(np.argmax(size)), size.shape[1])
        raise GradientError(
            f"the derivative of {model.state_names[row % model.nx]} by variable {column} of [x; u; parameters] is "
            f"{jacobian[row, column]:.6g}: expected a finite number of at most {MAGNITUDE_BOUND:g}"
        )
