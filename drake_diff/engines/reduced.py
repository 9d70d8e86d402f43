"""An engine that has all joints of a plant, asked about the independent coordinates of a model with mimic joints.

With E of `model.mimic`, A = M + h D and the engine's forces f, Drake's Euler step of the reduced equations has

    a_own = (E' A E)^-1 E' (f - bias - D E v_own).

Its derivative is that of the engine's own step under the forces which hold all joints to a = E a_own.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array
from drake_diff.engines.common import EulerEngine
from drake_diff.engines.interface import EngineContract, float_rows
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.mimic import Coupling
from drake_diff.model.model import Model

TAKEN = ("drake", "pinocchio", "casadi")  # engines that a model with reduced coordinates can be given to


class ReducedEngine(EulerEngine):
    """`whole` is the engine on `model.whole`, one of an Euler step of the description of its plant."""

    def __init__(self, whole: Any, model: Model):
        if model.coupling is None:
            raise ModelError("an engine of reduced coordinates: expected a model with mimic joints that are reduced")
        self.whole = whole
        self.model, self.coupling = model, model.coupling
        self.name, self.version, self.method = whole.name, whole.version, whole.method
        self.coordinates, self.time_step, self.status = coordinates_of(model), model.time_step, "ok"
        self.nq, self.nv, self.nu = model.nq, model.nv, model.nu

    def energy(self, x: ArrayLike) -> float:
        return float(self.whole.energy(self.coupling.state(self._state(x)[0])))

    def mass_matrix(self, q: ArrayLike) -> Array:
        E = self.coupling.spread
        return np.asarray(E.T @ self.whole.mass_matrix(self.coupling.positions(self._positions(q))) @ E)

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        q, v = self._motion(q, v)
        return np.asarray(self.coupling.forces(self._bias(q, v)))

    def _bias(self, q: Array, v: Array) -> Array:
        return np.asarray(self.whole.bias(self.coupling.positions(q), self.coupling.velocities(v)))

    def _balance(self, x: Array, u: Array) -> tuple[Array, Array, Array]:
        """A (m, m), a_own (nv,), and the forces (m,) that hold all joints to E a_own."""
        q, v, whole, coupling = x[: self.nq], x[self.nq :], self.whole, self.coupling
        A = whole.mass_matrix(coupling.positions(q)) + self.time_step * np.diag(whole.damping)
        force = whole._effort(u) - self._bias(q, v) - whole.damping * coupling.velocities(v)
        own = coupling.next_velocities(A, np.linalg.solve(A, force))
        return A, own, A @ coupling.velocities(own) - force

    def _acceleration(self, x: Array, u: Array) -> Array:
        return self._balance(x, u)[1]

    def _acceleration_derivative(self, x: Array, u: Array) -> tuple[Array, Array]:
        A, own, holding = self._balance(x, u)
        with self.whole.holding(holding):
            _, by = self.whole._acceleration_derivative(self.coupling.state(x), u)
        E, m = self.coupling.spread, len(A)
        by = A @ np.hstack([by[:, :m] @ E, by[:, m : 2 * m] @ E, by[:, 2 * m :]])
        return own, np.linalg.solve(E.T @ A @ E, E.T @ by)

    @property
    def contract(self) -> EngineContract:
        return reduced_contract(self.whole.contract, self.model)


def reduced_contract(contract: EngineContract, model: Model) -> EngineContract:
    """Of the independent coordinates: followers show in M(q) and the bias, and in the damping of what they follow."""
    coupling: Coupling | None = model.coupling
    if coupling is None:
        return contract
    damping, kept, start = np.zeros(len(coupling.of_v)), [], 0
    joints: Mapping[int, Any] = {}
    for joint in contract.joints:
        joints = {**joints, start: joint}
        damping[start] = joint.damping
        start += 6 if joint.kind == "quaternion_floating" else 1
    own_damping, (lower, upper) = coupling.forces(coupling.ratio_v * damping), model.position_limits
    places = {int(j): k for k, j in enumerate(coupling.own_v)}
    single = {j: i for i, j in coordinates_of(model).single}
    for start, joint in joints.items():
        k = places.get(start)
        if k is None:
            continue
        if k in single:
            limits = {"lower": float(lower[single[k]]), "upper": float(upper[single[k]])}
            joint = replace(joint, damping=float(own_damping[k]), **limits)
        kept.append(joint)
    names = {joint.name for joint in kept}
    return replace(
        contract,
        joints=tuple(kept),
        native_order=tuple(name for name in contract.native_order if name in names),
        actuation=float_rows(coupling.spread.T @ np.array(contract.actuation).reshape(len(coupling.of_v), -1)),
    )
