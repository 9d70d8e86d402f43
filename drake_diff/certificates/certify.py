"""Certify the derivatives of steps: along a few directions first, and entry by entry where these leave a doubt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drake_diff._base.arrays import Array
from drake_diff._base.differences import one_by_one
from drake_diff.certificates.certificate import LIMITS, Certificate, ModeChange, certificate_of, jitter
from drake_diff.certificates.differences import Neighbourhood, look_around
from drake_diff.certificates.directions import Claim, Screen
from drake_diff.derivatives.refine_step import RefinedSteps, refine_steps
from drake_diff.derivatives.smooth_step import form_of
from drake_diff.derivatives.sources import check_method, step_at
from drake_diff.derivatives.step import StepDerivatives, derivatives_along, step_jacobians
from drake_diff.exceptions import SimulationError
from drake_diff.model.contact import SEPARATED, active_modes
from drake_diff.model.contract import SAP_RELATIVE_TOLERANCE
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, ParameterVector, applied, select
from drake_diff.model.plant import actuators
from drake_diff.model.step import advance, check_point
from drake_diff.model.tangent import TangentSpace, tangent_space

SHARED = (
    "the derivative is computed by differences too, with another step size: an error of this method stays unnoticed"
)


@dataclass(frozen=True)
class CertifyOptions:
    """Distances and tolerances for the differences of a step."""

    limit_reach: float = 0.05  # [m or rad] a joint limit within this distance may act in one of the displaced steps
    effort_room: float = 0.02  # relative to the scale of an input: twice the widest step of the differences
    effort_part: float = 0.5  # relative to an effort limit: upper bound of this distance for small limits
    leap: float = 1e-6  # relative to an entry's size: ignored change of a derivative from an effort limit to inside it
    neighbourhood: float = 1e-4  # in scaled coordinates: distance at which changes of the contact mode are searched
    touched: float = 1e-2  # relative error of the derivative's prediction above which a row counts as affected


STEP = CertifyOptions()


def certify(
    model: Model,
    x: ArrayLike,
    u: ArrayLike | None = None,
    *,
    parameters: Parameters = (),
    method: str = "auto",
    derivatives: StepDerivatives | None = None,
    thorough: bool = False,
) -> Certificate:
    """Compare the Jacobians of one step with differences of the double step.

    A few random directions decide first, with some 25 steps. Where they leave a doubt, every entry is compared.

    Args:
        model: The model.
        x: (nx,) The state [q; v].
        u: (nu,) [N or N m] The input; optional if the model has no inputs.
        parameters: Names, or values by name, of the parameters that the step is also differentiated with respect to.
        method: As in `differentiate_step`.
        derivatives: The derivatives to certify. The default is the result of `differentiate_step`.
        thorough: Whether every entry is compared in any case, and changes of the contact mode are searched nearby.

    Returns:
        The certificate. Its rows are the next state, its columns [x; u; parameters], with states on the tangent space
        (a quaternion has three entries).

    Raises:
        UnknownNameError: A method or parameter does not exist.
        ShapeError, NonFiniteError: x or u is invalid.
        GradientError, SimulationError: The step or its derivative cannot be computed.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> certificate = dd.certify(model, [0.5, 0.0], [0.1]).require()
        >>> certificate.verdict, certificate.derivative.shape
        ('agree', (2, 3))
    """
    check_method(method)
    x, u = check_point(model, x, u)
    vector, look_beside = select(model, parameters), not derivatives
    if not thorough:
        with applied(vector) as applied_model:
            derivatives = derivatives or step_jacobians(applied_model, vector, x, u, method)
            sure = StepLook.of_step(applied_model, vector, x, u, derivatives).certificate
        if sure is not None:
            return sure
    return _certified(model, x, u, vector, method, derivatives, look_beside)


def _certified(
    model: Model,
    x: Array,
    u: Array,
    vector: ParameterVector,
    method: str,
    derivatives: StepDerivatives | None,
    look_beside: bool,
) -> Certificate:
    """Implement `certify`. `look_beside` also computes the derivative at a distance of 1e-9 by `method`."""
    with applied(vector) as model:
        step, nx = StepAround.of_point(model, vector, x, u), model.nx
        d, beside = derivatives or step_jacobians(model, vector, x, u, method), None
        if look_beside and not vector.parameters:
            jittered = step.moved(jitter(np.ones_like(step.scale)))
            beside = step.jacobian(step_jacobians(model, vector, jittered[:nx], jittered[nx:], method), jittered[:nx])
        derivative = step.jacobian(d, x)
        around, note, left = step.look_around()
        certificate = certificate_of(
            around, derivative, beside, stopped=left, second=step.units, **step.labels(d, note)
        )
        if certificate.verdict != "agree":
            certificate = replace(certificate, told=_joined(certificate.told, _limits_that_act(model, x)))
        if not model.contract.contact.collision_pairs:
            return certificate
        return replace(certificate, mode_changes=_find_mode_changes(step, derivative))


def _joined(*texts: str) -> str:
    """Join the texts that are not empty."""
    return "; ".join(text for text in texts if text)


def _limits_that_act(model: Model, x: Array) -> str:
    """Describe the positions at or beyond a joint limit, where a step has a corner and its forces are stiff."""
    limits = []
    for name, q, low, high in zip(model.position_names, x, *model.position_limits, strict=False):
        reach = STEP.neighbourhood * max(1.0, abs(q))
        if q <= low + reach or q >= high - reach:
            where = "beyond" if q < low or q > high else "at"
            limits.append(f"{name} is {q:.6g}, {where} its limits [{low:g}, {high:g}]")
    return f"joint limits act: {', '.join(limits)}" if limits else ""


def certify_inside(
    model: Model, x: Array, u: Array, *, parameters: Parameters = (), derivatives: StepDerivatives | None = None
) -> Certificate:
    """Certify a step as `certify` does, but inside the effort limits, as the inputs of a plan often are at a limit.

    Drake clips inputs at the limit, which is a corner. The differences are therefore taken at a distance from the
    limit. If the derivative at the limit differs from the derivative just inside it, this difference is added to the
    certified derivative. `derivatives` are the derivatives inside the limits, if they are known.
    """
    inside = _with_room(model, u)
    certificate = _certified(model, x, inside, select(model, parameters), "auto", derivatives, look_beside=True)
    if np.array_equal(inside, u):
        return certificate
    note = _joined(certificate.told, _beside_limits(model, inside != u))
    leap = _leap_at_limits(model, x, u, np.sign(inside - u), parameters)
    if np.any(np.abs(leap) > STEP.leap * certificate.size):
        note += f", at which the derivative differs by up to {np.max(np.abs(leap)):.3g}"
        certificate = replace(certificate.of(certificate.derivative + leap), mode_changes=certificate.mode_changes)
    return replace(certificate, told=note)


def _beside_limits(model: Model, at_limit: NDArray[np.bool_]) -> str:
    """Return the note of a certificate on inputs at their effort limit."""
    return f"{', '.join(np.array(model.input_names)[at_limit])} certified beside the limit of its effort"


def _input_scale(model: Model, us: Array) -> Array:
    """Return the scale (..., nu) of inputs (..., nu): their magnitude, but at least min(1, effort limit)."""
    return np.maximum(np.minimum(1.0, form_of(model).cut), np.abs(us))


def _with_room(model: Model, us: Array) -> Array:
    """Move inputs (..., nu) inside the effort limits by a margin for differences."""
    limits = form_of(model).cut
    room = np.minimum(STEP.effort_room * _input_scale(model, us), STEP.effort_part * limits)
    return np.minimum(np.maximum(us, room - limits), limits - room)


def _leap_at_limits(model: Model, x: Array, u: Array, inward: Array, parameters: Parameters) -> Array:
    """Return the derivative at u (nu,) minus that at a relative distance of 1e-9, to the side of `inward` (nu,)."""
    vector = select(model, parameters)
    beside = u + LIMITS.jitter * _input_scale(model, u) * inward
    with applied(vector) as model:
        space = tangent_space(model)
        both = (step_jacobians(model, vector, x, inputs, "auto") for inputs in (u, beside))
        exactly, inside = (space.jacobian(x, d.x_next, d.A, d.B, d.C) for d in both)
    return np.asarray(exactly - inside)


def certify_steps(model: Model, xs: Array, us: Array, *, parameters: Parameters = ()) -> tuple[Certificate, ...]:
    """Certify the steps at xs (N, nx) and us (N, nu), along a few directions where these leave no doubt.

    The derivatives are computed in one call, as in an optimization. `certify_inside` reuses them for steps in doubt.
    """
    inside, certificates = _with_room(model, us), []
    for x, u, within, look in zip(xs, us, inside, first_looks(model, xs, inside, parameters), strict=True):
        sure, at_limit = look.certificate, within != u
        if sure is not None and at_limit.any():
            leap = _leap_at_limits(model, x, u, np.sign(within - u), parameters)
            small = np.all(np.abs(leap) <= STEP.leap * sure.size)
            sure = replace(sure, told=f"{sure.told}; {_beside_limits(model, at_limit)}") if small else None
        if sure is None:
            sure = certify_inside(model, x, u, parameters=parameters, derivatives=look.derivatives)
        certificates.append(sure)
    return tuple(certificates)


class UnsolvedError(Exception):
    """A step cannot be solved to rounding. The message gives the reason."""


def solved(refined: RefinedSteps) -> RefinedSteps:
    """Return `refined`, or raise UnsolvedError if a step is refused."""
    for k, why in refined.refused.items():
        raise UnsolvedError(f"{why} (step {k})" if len(refined.refused) < len(refined.left) else str(why))
    return refined


@dataclass(frozen=True)
class StepAround:
    """The next state as a function of scaled displacements of [x; u; parameters] from `point` (nx + nu + np,)."""

    model: Model
    vector: ParameterVector
    space: TangentSpace
    point: Array
    scale: Array

    @classmethod
    def of_point(cls, model: Model, vector: ParameterVector, x: Array, u: Array) -> StepAround:
        """Create the function around the step from x (nx,) under u (nu,), while `vector` is applied."""
        space = tangent_space(model)
        scale = np.concatenate([state_scale(space, x), _input_scale(model, u), vector.difference_scale()])
        return cls(model, vector, space, np.concatenate([x, u, vector.values]), scale)

    @property
    def units(self) -> tuple[Array, Array]:
        """The units of the state (size,) and of all columns, with time counted in steps."""
        size, nv = self.space.size, self.model.nv
        state = np.where(np.arange(size) < size - nv, 1.0, 1 / self.model.time_step)
        return state, np.concatenate([state, np.ones(len(self.scale) - size)])

    def jacobian(self, d: StepDerivatives, x: Array) -> Array:
        """Return the Jacobian (size, n) of derivatives at x (nx,) with respect to scaled displacements."""
        return self.space.jacobian(x, d.x_next, d.A, d.B, d.C) * self.scale

    def labels(self, d: StepDerivatives, note: str) -> dict[str, Any]:
        """Return the names, the scale and the notes of a certificate of `d`."""
        return {
            "scale": self.scale,
            "rows": self.space.names,
            "columns": self.space.names + self.model.input_names + self.vector.names,
            "method": " + ".join(dict.fromkeys((d.method, *d.sources))),
            "subject": f"the step of {self.model.name}",
            "told": _joined(note, SHARED if "finite_difference" in (d.method, *d.sources) else ""),
        }

    def moved(self, displacement: Array) -> Array:
        """Return the point (nx + nu + np,) at a displacement (n,)."""
        return move(self.space, self.model.nx, self.point, self.scale * displacement)

    def drake(self, displacement: Array) -> Array:
        """Return the next state (nx,) of Drake's own step. The double twin keeps the context of this step."""
        return step_at(self.model, self.vector, *self._split(self.moved(displacement)))

    def solved(self, displacements: Array, held: Array | None = None) -> RefinedSteps:
        """Solve the steps at displacements (K, n) to rounding, with the residual momentum `held` in their balance."""
        points = self._split(np.array([self.moved(d) for d in displacements]))
        momenta = None if held is None else np.repeat(held, len(displacements), axis=0)
        return solved(refine_steps(self.model, self.vector, *points, momenta))

    def _split(self, points: Array) -> tuple[Array, Array, Array]:
        nx, end = self.model.nx, self.model.nx + self.model.nu
        return points[..., :nx], points[..., nx:end], points[..., end:]

    @property
    def tolerance(self) -> float:
        """The relative tolerance with which Drake solves the step."""
        return solver_tolerance(self.model, *self._split(self.point)[:2])

    def look_around(self) -> tuple[Neighbourhood, str, float]:
        """Return the differences of the step, solved to rounding if possible, a note on their source, and the residual
        of Drake's own step at the point, relative to the momentum."""
        space, n, tolerance = self.space, len(self.scale), self.tolerance
        if not tolerance:
            return look_around(one_by_one(self.drake), n, space.minus), "", 0.0
        worst = []

        def ends(displacements: Array) -> Array:
            refined = self.solved(displacements)
            worst.append(float(np.max(refined.left)))
            return refined.x_next

        try:
            left = float(self.solved(np.zeros((1, n))).left[0])  # raises UnsolvedError early
            around = look_around(ends, n, space.minus)
        except UnsolvedError as why:
            size = np.delete(np.maximum(1.0, np.abs(self.drake(np.zeros(n)))), list(space.quaternions))
            around = look_around(one_by_one(self.drake), n, space.minus, tolerance * size)
            return around, differences_of_drake(str(why)), tolerance
        return around, differences_of_solved(max(left, *worst)), left

    def ends(self) -> Callable[[Array], tuple[Array, float]]:
        """Return a function from displacements (K, n) to next states and the residual of Drake's own steps.

        The steps keep the residual of Drake's own step at the point, so that they agree with it there. The residual is
        relative to the momentum, and negative if the step has no solver. Raises UnsolvedError.
        """
        if not self.tolerance:
            return lambda displacements: (np.array([self.drake(d) for d in displacements]), -1.0)
        missing = np.nan_to_num(self.solved(np.zeros((1, len(self.scale)))).missing)

        def held(displacements: Array) -> tuple[Array, float]:
            refined = self.solved(displacements, missing)
            return refined.x_next, float(np.max(refined.left))

        return held

    def screened(self, derivative: Array) -> Screened:
        """Screen the derivative. Return the result, the residual of Drake's steps and the doubt."""
        residuals = [-1.0]
        if not np.isfinite(derivative).all():
            return None, -1.0, "the derivative is not finite"

        def values(displacements: Array) -> Array:
            x_next, residual = ends(displacements)
            residuals.append(residual)
            return x_next

        try:
            ends = self.ends()
            screen = Screen(Claim.of_matrix(derivative, self.units), values, self.space.minus)
        except (UnsolvedError, SimulationError) as why:
            return None, -1.0, str(why)
        return screen, max(residuals), screen.doubt


Screened = tuple[Screen | None, float, str]


@dataclass(frozen=True, eq=False)
class StepLook:
    """The screen of the derivatives of a step: its certificate, or why every entry must be compared."""

    step: StepAround
    derivatives: StepDerivatives
    screen: Screen | None  # None if the steps cannot be solved to rounding
    left: float  # residual of Drake's own steps, relative to the momentum
    doubt: str

    @classmethod
    def of_step(cls, model: Model, vector: ParameterVector, x: Array, u: Array, d: StepDerivatives) -> StepLook:
        """Screen the derivatives `d` of the step from x (nx,) under u (nu,), while `vector` is applied."""
        step = StepAround.of_point(model, vector, x, u)
        return cls(step, d, *step.screened(step.jacobian(d, x)))

    @property
    def certificate(self) -> Certificate | None:
        """The certificate that the derivative is correct, or None in case of doubt."""
        if self.screen is None or self.doubt:
            return None
        note = differences_of_solved(self.left) if self.left >= 0 else ""
        a = self.step.jacobian(self.derivatives, self.step.point[: self.step.model.nx])
        return self.screen.certificate(a, **self.step.labels(self.derivatives, note))


def first_looks(model: Model, xs: Array, us: Array, parameters: Parameters) -> list[StepLook]:
    """Screen the derivatives of the steps from xs (N, nx) under us (N, nu)."""
    vector = select(model, parameters)
    with applied(vector) as model:
        derivatives = derivatives_along(model, xs[0], us, vector=vector, xs=xs)
        return [StepLook.of_step(model, vector, *step) for step in zip(xs, us, derivatives, strict=True)]


def differences_of_solved(left: float) -> str:
    """Return the note on differences of solved steps, for which Drake's own steps have at most the residual `left`."""
    return (
        f"differences of the step's equation solved to rounding, which Drake's own steps keep to {left:.1g} of the "
        f"momentum (its solver stops at {SAP_RELATIVE_TOLERANCE:g})"
    )


def differences_of_drake(why: str) -> str:
    """Return the note on differences of Drake's own steps, and `why` the steps are not solved to rounding."""
    return f"differences of Drake's own steps, which end at {SAP_RELATIVE_TOLERANCE:g} of the momentum: {why}"


def _find_mode_changes(step: StepAround, derivative: Array) -> tuple[ModeChange, ...]:
    """Displace each state and input by 1e-4 of its scale to both sides and compare the modes of Drake's step."""
    model, space, f = step.model, step.space, step.drake
    directions = np.eye(derivative.shape[1])
    centre, changes = f(np.zeros(len(directions))), []
    here = active_modes(model)
    for direction, column, scale in zip(directions, space.names + model.input_names, step.scale, strict=False):
        for reach in (STEP.neighbourhood, -STEP.neighbourhood):
            change = space.minus(f(reach * direction), centre)
            there, predicted = active_modes(model), derivative @ (reach * direction)
            size = np.maximum(np.abs(predicted), np.abs(change))
            missed = np.abs(change - predicted) > STEP.touched * np.maximum(size, 1e-6 * size.max(initial=0.0))
            touched = tuple(name for name, miss in zip(space.names, missed, strict=True) if miss)
            for pair in sorted(pair for pair in here.keys() | there.keys() if here.get(pair) != there.get(pair)):
                modes = here.get(pair, SEPARATED), there.get(pair, SEPARATED)
                changes.append(ModeChange(pair, *modes, column, float(reach * scale), touched))
    return tuple(changes)


def solver_tolerance(model: Model, x: Array, u: Array) -> float:
    """Return the relative tolerance of the step at (`x`, `u`): SAP's tolerance if SAP may have a problem, else 0."""
    advance(model.double, x, u)
    q, reach = x[: model.nq], STEP.limit_reach + 2 * model.time_step * np.abs(x[model.nq :]).max(initial=0)
    lower, upper = model.position_limits
    near_limit = np.any(q < lower + reach) or np.any(q > upper - reach)
    pd = any(actuator.has_controller() for actuator in actuators(model.plant))
    return SAP_RELATIVE_TOLERANCE if model.double.touches() or near_limit or pd or model.num_constraints else 0.0


def state_scale(space: TangentSpace, x: Array) -> Array:
    """Return the scale (size,) of each coordinate: its magnitude, at least 1, and 1 for rotations."""
    magnitude = np.maximum(1.0, np.abs(x))
    magnitude[[i for q in space.quaternions for i in range(q, q + 4)]] = 1.0
    return np.delete(magnitude, list(space.quaternions))


def move(space: TangentSpace, nx: int, point: Array, displacement: Array) -> Array:
    """Return [x; u; ...] moved by a displacement. The state (nx,) is moved on its tangent space."""
    return np.concatenate([space.plus(point[:nx], displacement[: space.size]), point[nx:] + displacement[space.size :]])
