"""Add a small motion to a state, subtract two states: quaternions live here and nowhere else.

A tangent vector has one entry for each coordinate, except that the four of a quaternion become three: the
rotation vector [rad] that Drake's angular velocity w_WB integrates to, expressed in the parent frame.
With q a quaternion (w, x, y, z) and * the quaternion product,
    plus(q, d)  = |q| n / |n|,  n = (1, d / 2) * q / |q|      (so that d plus / d d at 0 is d q / d t per w)
    minus(p, q) = 2 vec(p * conj(q)) / scal(p * conj(q))      (its inverse: minus(plus(q, d), q) = d)
"""

from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.model.model import Model
from drake_diff.model.plant import joints


@dataclass(frozen=True)
class TangentSpace:
    """The tangent space of a model's state, of dimension `size` = nx minus the number of quaternions."""

    nx: int
    quaternions: tuple[int, ...]  # where in x each starts
    names: tuple[str, ...]

    @property
    def size(self) -> int:
        return self.nx - len(self.quaternions)

    def plus(self, x: Array, dx: Array) -> Array:
        """(nx,): the state `x` (nx,) moved by the tangent vector `dx` (size,)."""
        moved, taken = np.array(x, dtype=float), 0
        for start, stop, is_quaternion in self._blocks():
            if is_quaternion:
                moved[start:stop] = _turn(x[start:stop], dx[taken : taken + 3])
                taken += 3
            else:
                moved[start:stop] += dx[taken : taken + stop - start]
                taken += stop - start
        return moved

    def minus(self, x1: Array, x0: Array) -> Array:
        """(size,): the tangent vector at `x0` that leads to `x1`."""
        if not self.quaternions:
            return x1 - x0
        parts = [
            _turn_between(x1[start:stop], x0[start:stop]) if is_quaternion else x1[start:stop] - x0[start:stop]
            for start, stop, is_quaternion in self._blocks()
        ]
        return np.concatenate(parts)

    def derivative_of_plus(self, x: Array) -> Array:
        """(nx, size): d plus(x, d) / d d at d = 0."""
        derivative, column = np.zeros((self.nx, self.size)), 0
        for start, stop, is_quaternion in self._blocks():
            if is_quaternion:
                derivative[start:stop, column : column + 3] = 0.5 * _right_product(x[start:stop])[:, 1:]
                column += 3
            else:
                width = stop - start
                derivative[start:stop, column : column + width] = np.eye(width)
                column += width
        return derivative

    def derivative_of_minus(self, x: Array) -> Array:
        """(size, nx): d minus(y, x) / d y at y = x."""
        derivative, row = np.zeros((self.size, self.nx)), 0
        for start, stop, is_quaternion in self._blocks():
            if is_quaternion:
                q = x[start:stop]
                derivative[row : row + 3, start:stop] = 2 * _right_product(_conjugate(q))[1:] / (q @ q)
                row += 3
            else:
                width = stop - start
                derivative[row : row + width, start:stop] = np.eye(width)
                row += width
        return derivative

    def jacobian(self, x: Array, x_next: Array, by_x: Array, *others: Array) -> Array:
        """(size, size + ...): a step's Jacobians by x (nx, nx), by u, ... (nx, n) side by side, of tangents."""
        if not self.quaternions:
            return np.hstack([by_x, *others])
        return np.asarray(self.derivative_of_minus(x_next) @ np.hstack([by_x @ self.derivative_of_plus(x), *others]))

    def _blocks(self) -> list[tuple[int, int, bool]]:
        """(start, stop, whether it is a quaternion) of each quaternion and each run between them, in order."""
        blocks, start = [], 0
        for q in self.quaternions:
            blocks += [(start, q, False), (q, q + 4, True)]
            start = q + 4
        return [block for block in [*blocks, (start, self.nx, False)] if block[1] > block[0]]


def tangent_space(model: Model) -> TangentSpace:
    """The tangent space of the state of `model`."""
    free = [joint for joint in joints(model.plant) if joint.type_name() == "quaternion_floating"]
    starts = sorted(joint.position_start() for joint in free)
    names = list(model.state_names)
    for start in reversed(starts):
        stem = names[start].removesuffix("_qw")
        names[start : start + 4] = [f"{stem}_rx", f"{stem}_ry", f"{stem}_rz"]
    return TangentSpace(model.nx, tuple(starts), tuple(names))


def _conjugate(q: Array) -> Array:
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def _right_product(q: Array) -> Array:
    """(4, 4): the matrix R with R p = p * q."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])


def _turn(q: Array, rotation: Array) -> Array:
    turned = _right_product(q) @ np.concatenate([[1.0], rotation / 2])
    return np.asarray(turned * (np.linalg.norm(q) / np.linalg.norm(turned)))


def _turn_between(q1: Array, q0: Array) -> Array:
    between = _right_product(_conjugate(q0)) @ q1
    return np.asarray(2 * between[1:] / between[0])
