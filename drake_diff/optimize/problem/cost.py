"""Costs of a state and an input, and their gradients."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, finite_array
from drake_diff._base.autodiff import gradient_of
from drake_diff._base.differences import central_differences
from drake_diff.exceptions import InputError, ShapeError
from drake_diff.optimize.problem.constraint import short

RunningCost = Callable[[Any, Any], Any]  # (x, u) -> scalar
FinalCost = Callable[[Any], Any]  # (x) -> scalar


@dataclass(frozen=True, eq=False, repr=False)
class QuadraticCost:
    """The cost (x - x_ref)' Q (x - x_ref) + (u - u_ref)' R (u - u_ref), without a factor of one half.

    It serves as a running cost, called with x and u, and as a final cost, called with x alone. What is not given
    is zero.

    Args:
        Q: (nx, nx) weights of the states, symmetric and positive semidefinite.
        R: (nu, nu) weights of the inputs, symmetric and positive semidefinite.
        x_ref: (nx,) state that costs nothing, in the states' units.
        u_ref: (nu,) input that costs nothing, in the inputs' units.

    Raises:
        InputError: a weight is not square, not symmetric or not positive semidefinite; ShapeError and
            NonFiniteError where a size or a number is wrong.

    Example:
        >>> cost = dd.QuadraticCost(Q=[[2.0]], R=[[1.0]], x_ref=[1.0])
        >>> float(cost(np.array([3.0]), np.array([0.5])))
        8.25
    """

    Q: Any = None
    R: Any = None
    x_ref: Any = None
    u_ref: Any = None

    def __post_init__(self) -> None:
        for name in ("Q", "R"):
            if getattr(self, name) is not None:
                matrix = finite_array(name, getattr(self, name), ("n", "n"))
                largest = np.abs(matrix).max(initial=1)
                if matrix.shape[0] != matrix.shape[1]:
                    raise InputError(name, got=f"shape {matrix.shape}", expected="a square matrix")
                if not np.allclose(matrix, matrix.T, rtol=0, atol=1e-12 * largest):
                    raise InputError(name, got="a matrix that is not symmetric", expected="a symmetric matrix")
                lowest = float(np.min(np.linalg.eigvalsh(matrix), initial=0.0))
                if lowest < -1e-12 * largest:
                    got = f"lowest eigenvalue {lowest:.3g}"
                    raise InputError(name, got=got, expected="a positive semidefinite matrix")
                object.__setattr__(self, name, matrix)
        for name, weight in (("x_ref", self.Q), ("u_ref", self.R)):
            if getattr(self, name) is not None:
                size = "n" if weight is None else len(weight)
                object.__setattr__(self, name, finite_array(name, getattr(self, name), (size,)))

    def __repr__(self) -> str:
        given = {name: value for name, value in vars(self).items() if value is not None}
        return f"QuadraticCost({', '.join(f'{name}={short(value)}' for name, value in given.items())})"

    def check_sizes(self, name: str, nx: int, nu: int) -> None:
        """Raise ShapeError where a part has not the size of the states (nx,) or inputs (nu,); `name` is the cost's."""
        for part, size in (("Q", nx), ("R", nu), ("x_ref", nx), ("u_ref", nu)):
            value = getattr(self, part)
            if value is not None and len(value) != size:
                raise ShapeError(f"{name}.{part}", got=value.shape, expected=(size,) * value.ndim)

    def __call__(self, x: Any, u: Any = None) -> Any:
        """The cost of x (nx,) and u (nu,): floats or AutoDiffXd."""
        total = 0.0 * x[0]
        for weight, z, reference in ((self.Q, x, self.x_ref), (self.R, u, self.u_ref)):
            if weight is not None and z is not None:
                d = _apart(z, reference)
                total = total + d @ (weight @ d)
        return total

    def along(self, xs: Array, us: Array) -> Array:
        """(K,) the costs of xs (K, nx) and us (K, nu)."""
        total = 0.0 * xs[:, 0]  # NaN where that is
        for weight, z, reference in ((self.Q, xs, self.x_ref), (self.R, us, self.u_ref)):
            if weight is not None:
                d = _apart(z, reference)
                total += np.einsum("ki,ki->k", d, d @ weight)
        return total


@dataclass(frozen=True)
class ConstantCost:
    """A running cost of `rate` [per s], so that the objective is `rate` times the horizon."""

    rate: float

    def __call__(self, x: Any, u: Any) -> Any:
        return self.rate + 0.0 * x[0]

    def along(self, xs: Array, us: Array) -> Array:
        """(K,) the costs of xs (K, nx) and us (K, nu)."""
        return np.full(len(xs), self.rate)


@dataclass(frozen=True, eq=False)
class CostToGo:
    """gradient' d + d' hessian d / 2 with d = x - x_ref: a final cost that stands for all that comes after.

    x_ref and gradient (nx,), hessian (nx, nx), symmetric; in the cost's unit.
    """

    x_ref: Array
    gradient: Array
    hessian: Array

    def __call__(self, x: Any) -> Any:
        """The cost of x (nx,): floats or AutoDiffXd."""
        d = x - self.x_ref
        return self.gradient @ d + d @ (self.hessian @ d) / 2


def _apart(z: Any, reference: Any) -> Any:
    return z if reference is None else z - reference


def _slope(weight: Any, z: Array, reference: Any) -> Array:
    """(n,) the gradient of a quadratic form at z (n,)."""
    return np.zeros(len(z)) if weight is None else np.asarray(2 * weight @ _apart(z, reference))


def differentiate_cost(cost: RunningCost, x: Array, u: Array) -> tuple[float, Array, Array]:
    """(value, gradient by x (nx,), gradient by u (nu,)) of a running cost."""
    if isinstance(cost, QuadraticCost):
        return float(cost(x, u)), _slope(cost.Q, x, cost.x_ref), _slope(cost.R, u, cost.u_ref)
    value, gradient = gradient_of(lambda z: cost(z[: len(x)], z[len(x) :]), np.concatenate([x, u]))
    return value, gradient[: len(x)], gradient[len(x) :]


def differentiate_final_cost(cost: FinalCost, x: Array) -> tuple[float, Array]:
    """(value, gradient (nx,)) of a final cost."""
    if isinstance(cost, QuadraticCost):
        return float(cost(x)), _slope(cost.Q, x, cost.x_ref)
    if isinstance(cost, CostToGo):
        return float(cost(x)), cost.gradient + cost.hessian @ (x - cost.x_ref)
    return gradient_of(cost, x)


def running_cost_hessian(cost: RunningCost, x: Array, u: Array) -> Array:
    """(nx+nu, nx+nu): the Hessian by [x; u], exact for a QuadraticCost, else made positive semidefinite.

    Any other cost's Hessian is the central difference of its exact gradient, its negative eigenvalues cut to 0.
    """
    nx, nu = len(x), len(u)
    if isinstance(cost, QuadraticCost):
        hessian = np.zeros((nx + nu, nx + nu))
        hessian[:nx, :nx] = 0 if cost.Q is None else 2 * cost.Q
        hessian[nx:, nx:] = 0 if cost.R is None else 2 * cost.R
        return hessian
    return _difference_hessian(
        lambda z: np.concatenate(differentiate_cost(cost, z[:nx], z[nx:])[1:]), np.concatenate([x, u])
    )


def final_cost_hessian(cost: FinalCost, x: Array) -> Array:
    """(nx, nx): like `running_cost_hessian`, by x."""
    if isinstance(cost, QuadraticCost):
        return np.zeros((len(x), len(x))) if cost.Q is None else 2 * cost.Q
    if isinstance(cost, CostToGo):
        return cost.hessian
    return _difference_hessian(lambda z: differentiate_final_cost(cost, z)[1], x)


def _difference_hessian(gradient: Callable[[Array], Array], z: Array) -> Array:
    scale = np.maximum(1.0, np.abs(z))
    quotient = central_differences(lambda d: gradient(z + scale * d), len(z), 1e-5) / scale
    values, vectors = np.linalg.eigh((quotient + quotient.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0)) @ vectors.T)
