"""Tangent vectors of states: addition to a state and subtraction of states, including quaternions.

A tangent vector has one entry for each coordinate, except that the four entries of a quaternion become three: the
rotation vector [rad], the integral of Drake's angular velocity w_WB, expressed in the parent frame.
With q a quaternion (w, x, y, z) and * the quaternion product,
    plus(q, d)  = |q| n / |n|,  n = (1, d / 2) * q / |q|      (so that d plus / d d at 0 is d q / d t per w)
    minus(p, q) = 2 vec(p * conj(q)) / scal(p * conj(q))      (its inverse: minus(plus(q, d), q) = d)

`sample_states` returns seeded test states, both in free motion and with small overlaps of geometries.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from drake_diff._base.arrays import Array, Indices, frozen
from drake_diff.exceptions import SimulationError
from drake_diff.model.contact import penetration
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.step import set_state


@dataclass(frozen=True)
class TangentSpace:
    """The tangent space of a model's state, of dimension `size` = nx minus the number of quaternions."""

    nx: int
    quaternions: tuple[int, ...]  # the start of each quaternion in x
    names: tuple[str, ...]

    @property
    def size(self) -> int:
        return self.nx - len(self.quaternions)

    def plus(self, x: Array, dx: Array) -> Array:
        """Return the states `x` (..., nx) moved by the tangent vectors `dx` (..., size)."""
        moved, (of_x, of_d) = np.array(x, dtype=float), self._plain
        moved[..., of_x] += dx[..., of_d]
        for q, r in self._turns:
            turned = x[..., q] + (_right_product(x[..., q])[..., 1:] @ dx[..., r, None])[..., 0] / 2
            norms = (np.linalg.norm(values, axis=-1, keepdims=True) for values in (x[..., q], turned))
            moved[..., q] = turned * np.divide(*norms)
        return moved

    def minus(self, x1: Array, x0: Array) -> Array:
        """Return the tangent vectors (..., size) at `x0` (..., nx) that lead to `x1` (..., nx)."""
        if not self.quaternions:
            return x1 - x0
        of_x, of_d = self._plain
        plain = x1[..., of_x] - x0[..., of_x]
        difference = np.empty((*plain.shape[:-1], self.size), plain.dtype)  # also for AutoDiffXd
        difference[..., of_d] = plain
        for q, r in self._turns:
            between = (_right_product(_conjugate(x0[..., q])) @ x1[..., q, None])[..., 0]
            difference[..., r] = 2 * between[..., 1:] / between[..., :1]
        return difference

    def scale(self, ranges: Array) -> Array:
        """Convert ranges (nx,) of a state's entries to ranges (size,) of a tangent vector, isotropic for rotations.

        A quaternion changes by half of the rotation angle of its body.
        """
        scales, (of_x, of_d) = np.empty(self.size), self._plain
        scales[of_d] = ranges[of_x]
        for q, r in self._turns:
            scales[r] = 2 * np.max(ranges[q])
        return scales

    def derivative_of_plus(self, x: Array) -> Array:
        """Return the derivatives (..., nx, size) of plus(x, d) with respect to d at d = 0."""
        derivative = np.zeros((*x.shape[:-1], self.nx, self.size))
        derivative[..., *self._plain] = 1.0
        for q, r in self._turns:
            derivative[..., q, r] = 0.5 * _right_product(x[..., q])[..., 1:]
        return derivative

    def derivative_of_minus(self, x: Array) -> Array:
        """Return the derivatives (..., size, nx) of minus(y, x) with respect to y at y = x."""
        derivative = np.zeros((*x.shape[:-1], self.size, self.nx))
        derivative[..., *self._plain[::-1]] = 1.0
        for q, r in self._turns:
            squares = (x[..., q] ** 2).sum(axis=-1)[..., None, None]
            derivative[..., r, q] = 2 * _right_product(_conjugate(x[..., q]))[..., 1:, :] / squares
        return derivative

    def jacobian(self, x: Array, x_next: Array, by_x: Array, *others: Array) -> Array:
        """Convert a step's Jacobians in x (nx, nx) and u, ... (nx, n) to tangents, side by side (size, size + ...)."""
        if not self.quaternions:
            return np.hstack([by_x, *others])
        return np.asarray(self.derivative_of_minus(x_next) @ np.hstack([by_x @ self.derivative_of_plus(x), *others]))

    @cached_property
    def _turns(self) -> list[tuple[slice, slice]]:
        """The slices of each quaternion in x, and of its rotation vector in a tangent vector."""
        return [(slice(q, q + 4), slice(q - k, q - k + 3)) for k, q in enumerate(self.quaternions)]

    @cached_property
    def _plain(self) -> tuple[Indices, Indices]:
        """The indices of all other entries in x, and in a tangent vector."""
        others = np.setdiff1d(np.arange(self.nx), [q + i for q in self.quaternions for i in range(4)])
        return others, others - np.searchsorted(self.quaternions, others)


def tangent_space(model: Model) -> TangentSpace:
    """Return the tangent space of the state of `model`."""
    free = [joint for joint in joints(model.plant) if joint.type_name() == "quaternion_floating"]
    starts = sorted(model.places(joint)[0].start for joint in free)
    names = list(model.state_names)
    for start in reversed(starts):
        stem = names[start].removesuffix("_qw")
        names[start : start + 4] = [f"{stem}_rx", f"{stem}_ry", f"{stem}_rz"]
    return TangentSpace(model.nx, tuple(starts), tuple(names))


def _conjugate(q: Array) -> Array:
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def _right_product(q: Array) -> Array:
    """Return the matrices R (..., 4, 4) with R p = p * q, for quaternions (..., 4)."""
    return (q @ _RIGHT_PRODUCT).reshape(*q.shape[:-1], 4, 4)


_W, _X, _Y, _Z = np.eye(4)
# Row k is R of the k-th unit quaternion, flattened.
_RIGHT_PRODUCT = (
    np.array([[_W, -_X, -_Y, -_Z], [_X, _W, _Z, -_Y], [_Y, -_Z, _W, _X], [_Z, _Y, -_X, _W]]).reshape(16, 4).T
)


FREE, CONTACT = "free", "contact"
ATTEMPTS = 200  # number of attempts to sample a state of the wanted kind
DEPTH = (1e-4, 1e-3)  # [m] overlap of the geometries in a contact state
BISECTIONS = 40
SPEED = 0.5  # [m/s or rad/s] standard deviation, within the velocity limits
REACH = 1.0  # [m] of a slide, or of a free body, without limits
ONE_WAY = 2.0  # [N or N m] range of inputs with a fixed sign, from the limit nearest to 0
EFFORT = 0.2  # fraction of the effort limit, or of 1 N or N m without a limit


@dataclass(frozen=True, eq=False)
class SampledState:
    """A state x (nx,) and an input u (nu,), and whether geometries are in contact."""

    kind: str
    x: Array
    u: Array


def sample_states(model: Model, count: int, seed: int = 0) -> list[SampledState]:
    """Return `count` states, every second one in contact if possible; the same seed gives the same states."""
    random = np.random.default_rng(seed)
    lower, upper = model.inputs.lower, model.inputs.upper
    limit = model.effort_limits
    effort = EFFORT * np.where(limit < 1e6, limit, 1.0)
    middle = np.zeros(model.nu)
    one_way = ((lower >= 0) | (upper <= 0)) & ~model.inputs.commanded
    for i in np.flatnonzero(one_way).tolist():  # forces with a fixed sign
        near = lower[i] if lower[i] >= 0 else upper[i]
        far = float(np.clip(near + ONE_WAY * (1 if lower[i] >= 0 else -1), lower[i], upper[i]))
        middle[i], effort[i] = (near + far) / 2, EFFORT * abs(far - near)
    touches = model.contract.contact.collision_pairs > 0
    samples: list[SampledState] = []
    for i in range(count):
        x = _touching(model, random) if touches and i % 2 else None
        kind = FREE if x is None else CONTACT
        x = _free(model, random) if x is None else x
        u = model.commands(x, x[model.nq :], middle + effort * random.uniform(-1, 1, model.nu))
        samples.append(SampledState(kind, frozen(x), frozen(u)))
    return samples


def _free(model: Model, random: np.random.Generator) -> Array:
    """Return a state without overlap, or the last attempt if there is none."""
    for _ in range(ATTEMPTS):
        x = any_state(model, random)
        if _depth(model, x) == 0:
            break
    return x


def _touching(model: Model, random: np.random.Generator) -> Array | None:
    """Bisect between a free state and one with overlap to a state with a small overlap, or return None."""
    space = tangent_space(model)
    free = _free(model, random)
    for _ in range(ATTEMPTS // 10):
        inside = any_state(model, random)
        for start in space.quaternions:  # floating bodies move down, towards the ground
            inside[start + 6] -= REACH * random.uniform(0, 2)
        if _depth(model, inside) <= 0:
            continue
        way, low, high = space.minus(inside, free), 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            x = space.plus(free, middle * way)
            depth = _depth(model, x)
            if DEPTH[0] <= depth <= DEPTH[1]:
                return x
            low, high = (middle, high) if depth < DEPTH[0] else (low, middle)
    return None


def any_state(model: Model, random: np.random.Generator) -> Array:
    """Return a random state within the limits, at least 5 % of the range inside, or near the default without limits."""
    nq = model.nq
    x = np.array(model.default_state)
    lower, upper = model.position_limits
    limited = np.isfinite(lower) & np.isfinite(upper)
    lower, upper = np.where(limited, lower, 0), np.where(limited, upper, 0)
    reach = np.array([np.pi if coordinate.unit == "rad" else REACH for coordinate in model.contract.positions])
    middle, half = np.where(limited, (lower + upper) / 2, x[:nq]), np.where(limited, 0.45 * (upper - lower), reach)
    x[:nq] = middle + half * random.uniform(-1, 1, nq)
    for start in tangent_space(model).quaternions:  # the start of a floating body's seven coordinates
        x[start : start + 4] = random.standard_normal(4)
        x[start : start + 4] /= np.linalg.norm(x[start : start + 4])
        x[start + 6] += REACH
    x[nq:] = np.clip(SPEED * random.standard_normal(model.nv), *model.velocity_limits)
    return x


def _depth(model: Model, x: Array) -> float:
    set_state(model.double, x)
    try:
        return penetration(model)
    except SimulationError:  # Drake cannot measure these shapes, so the state is used without a check
        return 0.0
