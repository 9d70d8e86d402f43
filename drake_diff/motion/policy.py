"""Policies u = policy(x, t) for rollouts, and their derivatives with respect to the state and their parameters.

A policy is any function of x (nx,) and t [s] that returns u (nu,). A trainable policy has `parameters` (n,) and takes
other values as a third argument. If only some parameters act at time t, its method `active(t)` returns their slice.

A policy is written with ordinary arithmetic that AutoDiffXd supports. These NumPy functions support AutoDiffXd: tanh,
sin, cos, tan, arcsin, arccos, arctan, arctan2, sinh, cosh, exp, log, sqrt, square, power, abs, maximum, minimum, clip,
where, sum, mean, dot, @, outer, einsum, concatenate, linalg.norm. These do not: expm1, log1p, logaddexp, hypot, interp,
heaviside, var, std, and every function of the module `math`. A policy may also be written in JAX, and is not compiled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff
from pydrake.systems.controllers import DiscreteTimeLinearQuadraticRegulator

from drake_diff._base.arrays import Array, finite_array, frozen, scale
from drake_diff._base.autodiff import called, carrying, gradient_rows
from drake_diff.derivatives.sources import PARITY_TOLERANCE
from drake_diff.derivatives.step import differentiate_step, linearize
from drake_diff.exceptions import GradientError, InputError
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators
from drake_diff.model.tangent import tangent_space

FIXED_POINT_TOLERANCE = 1e-6
# Perturbation of x and the parameters to check that a float returned by a policy is a constant.
NUDGE = 1e-6
# A policy's derivatives with respect to the state (nu, nx) and the active parameters (nu, n), and these parameters.
Feedback = tuple[Array, Array, slice]


@dataclass(frozen=True, eq=False)
class ParametricPolicy:
    """The policy u = function(x, t, parameters) for any function, such as a neural network.

    The function may be another policy: ParametricPolicy(pd, better) is the PD law `pd` with other gains.

    Args:
        function: A function of x (nx,), t [s] and the parameters that returns u (nu,).
        parameters: (n,) all weights as a vector.

    Example:
        >>> from drake_diff.motion import ParametricPolicy
        >>> policy = ParametricPolicy(lambda x, t, p: np.tanh(p * x[:1]), [2.0])
        >>> policy(np.array([0.0, 1.0]), 0.0)
        array([0.])
    """

    function: Callable[[Any, float, Any], Any]
    parameters: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", finite_array("parameters", self.parameters, ("n",)))

    def __repr__(self) -> str:
        name = getattr(self.function, "__name__", type(self.function).__name__)
        return f"ParametricPolicy of {name}: {len(self.parameters)} parameters"

    def __call__(self, x: Any, t: float, parameters: Any = None) -> Any:
        return self.function(x, t, self.parameters if parameters is None else parameters)

    def active(self, t: float) -> slice:
        """Return the parameters that act at time t [s]: those of the function's own `active(t)`, if any, else all."""
        active = getattr(self.function, "active", None)
        return active(t) if active else slice(0, len(self.parameters))


class PD:
    """The policy u_i = kp_i (q_ref - q) + kd_i (v_ref - v) at the joint of actuator i. Angles are not wrapped.

    u is the effort at the joint [N or N m], as `Model.actuation` applies it, without gear ratio. Drake actuates only
    joints of one degree of freedom. `parameters` is [kp; kd] (2 nu,).

    Args:
        model: A model with actuators.
        kp: [N/m or N m/rad] a number, or (nu,).
        kd: [N s/m or N m s/rad] a number, or (nu,).
        x_ref: (nx,) the reference state, by default the model's default state.

    Raises:
        InputError: The model has no actuators, or an argument does not fit.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> dd.PD(model, kp=10.0, kd=1.0, x_ref=[0.5, 0.0])([0.0, 0.0], 0.0)
        array([5.])
    """

    def __init__(self, model: Model, kp: ArrayLike, kd: ArrayLike, x_ref: ArrayLike | None = None):
        joints = [actuator.joint() for actuator in actuators(model.plant)]
        if not model.inputs.plain:
            got = f"the inputs {', '.join(model.input_names)}"
            raise InputError("model", got=got, expected="a model whose inputs are its actuators")
        if model.inputs.commanded.any():
            raise InputError(
                "model",
                got="commanded positions as inputs",
                expected="efforts as inputs, as this policy computes efforts",
            )
        if not joints:
            raise InputError("model", got="no actuators", expected="at least one")
        self.x_ref = finite_array("x_ref", model.default_state if x_ref is None else x_ref, (model.nx,))
        self.kp, self.kd = scale("kp", kp, model.nu), scale("kd", kd, model.nu)
        self.parameters = frozen(np.concatenate([self.kp, self.kd]))
        places = [model.places(joint) for joint in joints]
        if not all(len(q) for q, _ in places):
            follower = next(joint.name() for joint, (q, _) in zip(joints, places, strict=True) if not len(q))
            raise InputError(
                "model",
                got=f"an actuator on {follower}, which follows another joint",
                expected="actuators on other joints",
            )
        self._positions = [q.start for q, _ in places]
        self._velocities = [model.nq + v.start for _, v in places]

    def __call__(self, x: Any, t: float, parameters: Any = None) -> Any:
        gains = self.parameters if parameters is None else parameters
        error = self.x_ref - x
        kp, kd = gains[: len(self.kp)], gains[len(self.kp) :]
        return kp * error[self._positions] + kd * error[self._velocities]

    def __repr__(self) -> str:
        return f"PD of the joints ({len(self.kp)}): kp {_range(self.kp)}, kd {_range(self.kd)}"


class LQR:
    """The policy u = u_ref - K minus(x, x_ref): discrete-time LQR of the model's step at a fixed point x_ref, u_ref.

    K minimizes sum_k d_k' Q d_k + e_k' R e_k (without the time step), with d = minus(x, x_ref) in the tangent space of
    the state (nt,; nx minus one for each quaternion) and e = u - u_ref. `gain` is K (nu, nt), `cost_to_go` P (nt, nt)
    with the cost d' P d, `parameters` K row by row (nu * nt,).

    Args:
        model: The discrete model.
        x_ref: (nx,) the fixed point.
        u_ref: (nu,) the input at the fixed point [N or N m].
        Q: (nt, nt) symmetric and positive semidefinite.
        R: (nu, nu) symmetric and positive definite.

    Raises:
        InputError: step(x_ref, u_ref) differs from x_ref by over 1e-6, no gain stabilizes it, or a weight is invalid.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
        >>> from drake_diff.motion import LQR
        >>> LQR(model, [0, np.pi, 0, 0], [0], np.eye(4), np.eye(1)).gain.shape
        (1, 4)
    """

    def __init__(self, model: Model, x_ref: ArrayLike, u_ref: ArrayLike, Q: ArrayLike, R: ArrayLike):
        self.x_ref, self.u_ref = finite_array("x_ref", x_ref, (model.nx,)), finite_array("u_ref", u_ref, (model.nu,))
        self._space = tangent_space(model)
        Q, R = _weight("Q", Q, self._space.size), _weight("R", R, model.nu, definite=True)
        d = differentiate_step(model, self.x_ref, self.u_ref)
        drift = float(np.abs(self._space.minus(d.x_next, self.x_ref)).max(initial=0.0))
        if not drift <= FIXED_POINT_TOLERANCE:
            raise InputError("x_ref, u_ref", got=f"a step that moves by {drift:.3g}", expected="a fixed point")
        A, B = np.hsplit(self._space.jacobian(self.x_ref, self.x_ref, d.A, d.B), [self._space.size])
        try:
            gain, cost_to_go = DiscreteTimeLinearQuadraticRegulator(A=A, B=B, Q=Q, R=R)
        except (RuntimeError, SystemExit) as error:  # pydrake raises SystemExit for a failed DRAKE_DEMAND
            expected = "a fixed point that the inputs can stabilize, and Q that weights all unstable directions"
            raise InputError("LQR", got=str(error), expected=expected) from error
        self.gain, self.cost_to_go = frozen(gain), frozen(cost_to_go)
        self.parameters = frozen(self.gain.ravel())

    def __call__(self, x: Any, t: float, parameters: Any = None) -> Any:
        gain = self.gain if parameters is None else parameters.reshape(self.gain.shape)
        return self.u_ref - gain @ self._space.minus(x, self.x_ref)

    def __repr__(self) -> str:
        return f"LQR: gain {self.gain.shape}, |K| {np.linalg.norm(self.gain):.3g}"


class TVLQR:
    """LQR along a trajectory: u = us[k] - K_k minus(x, xs[k]) - l_k, with k = round(t / time_step) within 0..N-1.

    With the step's Jacobians A_k, B_k in the tangent space (nt,), backward from P_N = Qf and p_N = 0,
        K_k = (R + B' P B)^-1 B' P A,  P_k = Q + A' P (A - B K_k)   with P = P_(k+1),
        l_k = (R + B' P B)^-1 B' r,    p_k = (A - B K_k)' r         with r = P c_k + p_(k+1).
    This minimizes sum_k d_k' Q d_k + e_k' R e_k + d_N' Qf d_N (without the time step) for the linearized motion. The
    `defects` c_k are the differences of the step from xs[k] under us[k] and xs[k + 1]. Along the model's own
    trajectory, l_k is 0. `gains` (N, nu, nt), `cost_to_go` (N+1, nt, nt), `parameters` the gains as (N * nu * nt,).

    Args:
        model: The discrete model.
        xs: (N+1, nx) the trajectory.
        us: (N, nu) its inputs [N or N m].
        Q: (nt, nt) symmetric and positive semidefinite.
        R: (nu, nu) symmetric and positive definite.
        Qf: (nt, nt) the weight of the final state, by default Q.
        jacobians: (N, nx, nx + nu) of the map from state to state, if it is not the step of the model.
        defects: (N, nt) the c_k, by default 0.

    Raises:
        InputError: The shapes of the arrays do not match each other or the model, or a weight is invalid.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> us = np.ones((30, 1))
        >>> xs = dd.rollout(model, [0, 0], us).xs
        >>> from drake_diff.motion import TVLQR
        >>> TVLQR(model, xs, us, np.eye(2), np.eye(1)).gains.shape
        (30, 1, 2)
    """

    def __init__(
        self,
        model: Model,
        xs: ArrayLike,
        us: ArrayLike,
        Q: ArrayLike,
        R: ArrayLike,
        Qf: ArrayLike | None = None,
        *,
        jacobians: Array | None = None,
        defects: ArrayLike | None = None,
    ):
        self.us = finite_array("us", us, ("N", model.nu))
        if not len(self.us):
            raise InputError("us", got="0 steps", expected="at least one step")
        self.xs = finite_array("xs", xs, (len(self.us) + 1, model.nx))
        self.time_step = model.time_step
        self._space = tangent_space(model)
        Q, R = _weight("Q", Q, self._space.size), _weight("R", R, model.nu, definite=True)
        if jacobians is None:
            A, B, _ = linearize(model, self.xs, self.us)
        else:
            A, B = np.split(jacobians, [model.nx], axis=2)
        if self._space.quaternions:
            points = zip(self.xs[:-1], self.xs[1:], A, B, strict=True)
            A, B = np.split(np.array([self._space.jacobian(*point) for point in points]), [self._space.size], axis=2)
        shape = (len(self.us), self._space.size)
        c = np.zeros(shape) if defects is None else finite_array("defects", defects, shape)
        gains, cost_to_go = list[Array](), [Q if Qf is None else _weight("Qf", Qf, self._space.size)]
        offsets, p = list[Array](), np.zeros(self._space.size)
        for A_k, B_k, c_k in zip(A[::-1], B[::-1], c[::-1], strict=True):
            P = cost_to_go[-1]
            BP = B_k.T.dot(P)
            r = P.dot(c_k) + p
            solved = np.linalg.solve(R + BP.dot(B_k), np.column_stack([BP.dot(A_k), B_k.T.dot(r)]))
            gains.append(solved[:, :-1])
            offsets.append(solved[:, -1])
            p = (A_k - B_k.dot(gains[-1])).T.dot(r)
            before = Q + A_k.T.dot(P).dot(A_k - B_k.dot(gains[-1]))
            cost_to_go.append((before + before.T) / 2)
        self.gains, self.cost_to_go = frozen(gains[::-1]), frozen(cost_to_go[::-1])
        self.offsets = frozen(offsets[::-1])
        self.parameters = frozen(self.gains.ravel())

    def __call__(self, x: Any, t: float, parameters: Any = None) -> Any:
        k = self._index(t)
        gain = self.gains[k] if parameters is None else parameters[self.active(t)].reshape(self.gains[k].shape)
        return self.us[k] - gain @ self._space.minus(x, self.xs[k]) - self.offsets[k]

    def active(self, t: float) -> slice:
        """Return the parameters that act at time t [s]. Derivatives with respect to all others are zero."""
        k, size = self._index(t), self.gains[0].size
        return slice(k * size, (k + 1) * size)

    def _index(self, t: float) -> int:
        return min(max(round(t / self.time_step), 0), len(self.us) - 1)

    def __repr__(self) -> str:
        return f"TVLQR along {len(self.us)} steps, {len(self.us) * self.time_step:g} s: gains {self.gains.shape}"


def _range(values: Array) -> str:
    low, high = float(np.min(values)), float(np.max(values))
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def policy_parameters(policy: Any) -> Array:
    """Return the parameters (n,) of a policy, or an empty array for a plain function."""
    return finite_array("policy.parameters", getattr(policy, "parameters", ()), ("n",))


def active_parameters(policy: Any, t: float) -> slice:
    """Return the policy's parameters that act at time t [s]: those of its method `active(t)`, if any, else all."""
    return policy.active(t) if hasattr(policy, "active") else slice(0, len(policy_parameters(policy)))


def differentiate_policy(policy: Any, x: Array, t: float, nu: int) -> tuple[Array, Array, Array]:
    """Return (u (nu,), du/dx (nu, nx), du/dparameters (nu, n)) of `policy` at state `x` (nx,) and time `t` [s].

    AutoDiffXd computes the derivatives. If the policy has a method `active(t)`, as TVLQR has, the columns of other
    parameters are zero. Constant outputs are allowed. Raises ShapeError if u is not (nu,), and GradientError if the
    derivatives were lost (by float()), u is not reproducible, or a derivative is not finite.
    """
    parameters = policy_parameters(policy)
    u = finite_array("policy(x, t)", _call(policy, x.copy(), t, parameters, nu), (nu,))
    active = active_parameters(policy, t)
    variables = InitializeAutoDiff(np.concatenate([x, parameters[active]])).ravel()
    moved = parameters.astype(object)
    moved[active] = variables[len(x) :]
    with np.errstate(all="ignore"):  # _check refuses values that are not finite
        result = np.asarray(_call(policy, variables[: len(x)], t, moved), dtype=object)
    plain = np.array([not isinstance(entry, AutoDiffXd) for entry in result], dtype=bool)
    if plain.any():  # these entries must be constants, else their derivatives were lost
        near = finite_array("policy(x, t)", _call(policy, x + NUDGE, t, parameters + NUDGE, nu), (nu,))
        changed = np.flatnonzero(plain & (near != u))
        if len(changed):
            raise GradientError(
                f"the policy lost its derivatives: u[{changed[0]}] is a plain number, yet it changes with the state or "
                "the parameters (or jumps there)"
            )
    numbers = np.array([AutoDiffXd(entry) if lost else entry for entry, lost in zip(result, plain, strict=True)])
    rows = gradient_rows(numbers, len(variables)) if nu else np.zeros((0, len(variables)))
    _check(numbers, rows, u)
    by_parameters = np.zeros((nu, len(parameters)))
    by_parameters[:, active] = rows[:, len(x) :]
    return u, np.array(rows[:, : len(x)]), by_parameters


def recording_choice(policy: Any, model: Model, feedback: list[Feedback]) -> Callable[[Array, int], Array]:
    """Return a function (x (nx,), step k) -> u (nu,) that appends the policy's derivatives to `feedback`."""

    def choose(x: Array, k: int) -> Array:
        t = k * model.time_step
        u, by_x, by_parameters = differentiate_policy(policy, x, t, model.nu)
        active = active_parameters(policy, t)
        feedback.append((by_x, by_parameters[:, active].copy(), active))
        return u

    return choose


def _call(policy: Any, x: Any, t: float, parameters: Any, nu: int | None = None) -> Any:
    """Call the policy with AutoDiffXd, or with floats if `nu` is given."""
    arguments = (x, t, parameters) if hasattr(policy, "parameters") else (x, t)
    if nu is None:
        return carrying("policy", policy, *arguments)
    return called("policy", policy, *arguments, shape=(nu,))


def _check(numbers: Any, rows: Array, u: Array) -> None:
    """Raise GradientError if the values differ from the rollout's, or a derivative is not finite."""
    values = ExtractValue(numbers.reshape(-1, 1)).ravel() if len(u) else u
    if not np.all(np.abs(values - u) <= PARITY_TOLERANCE * np.maximum(1.0, np.abs(u))):
        raise GradientError(
            f"the policy returns u = {values} with AutoDiffXd and u = {u} with floats at the same x and t: make it a "
            "function of x and t only, without random numbers and memory"
        )
    if not np.all(np.isfinite(rows)):
        raise GradientError("the derivative of the policy is not finite")


def _weight(name: str, value: ArrayLike, size: int, *, definite: bool = False) -> Array:
    matrix = finite_array(name, value, (size, size))
    rounding = 1e-12 * float(np.abs(matrix).max(initial=0.0))
    if not np.allclose(matrix, matrix.T, rtol=0, atol=rounding):
        raise InputError(name, got="a matrix that is not symmetric", expected="a symmetric matrix")
    lowest = float(np.min(np.linalg.eigvalsh(matrix), initial=np.inf))
    if lowest <= rounding if definite else lowest < -rounding:
        kind = "definite" if definite else "semidefinite"
        raise InputError(name, got=f"lowest eigenvalue {lowest:.3g}", expected=f"a positive {kind} matrix")
    return matrix
