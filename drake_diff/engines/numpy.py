"""The baseline by hand: the closed forms of `closed_form` in Drake's Euler step, with nothing but NumPy."""

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, positive_float
from drake_diff.engines.closed_form import BY_MODEL, ClosedForm
from drake_diff.engines.common import Arguments, euler_step_jacobian
from drake_diff.engines.interface import EngineContract, StepJacobian, float_rows, floats
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.coordinates import euler_step
from drake_diff.model.model import Model


class NumpyEngine(Arguments):
    """A closed form, or the one for the model's name (`match_contracts` tells whether it is the same model)."""

    name, version, status = "numpy", np.__version__, "ok"

    def __init__(self, model: Model | ClosedForm, *, time_step: float | None = None):
        if isinstance(model, Model):
            if model.name not in BY_MODEL:
                known = ", ".join(sorted(BY_MODEL))
                raise ModelError(f"there is no hand calculation of the model {model.name!r}; expected one of {known}")
            self.form, self.time_step = BY_MODEL[model.name], model.time_step
        else:
            self.form, self.time_step = model, positive_float("time_step [s]", time_step)
        self.nq, self.nv, self.nu = self.form.coordinates.nq, self.form.coordinates.nv, len(self.form.input_names)

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        x, u = self._point(x, u)
        acceleration, _ = self.form.acceleration(self.time_step, x[: self.nq], x[self.nq :], u)
        return euler_step(self.form.coordinates, self.time_step, x, acceleration)

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        x, u = self._point(x, u)
        acceleration, by = self.form.acceleration(self.time_step, x[: self.nq], x[self.nq :], u)
        return euler_step_jacobian(self.form.coordinates, self.time_step, x, acceleration, by, "by hand")

    def energy(self, x: ArrayLike) -> float:
        _, q, v = self._state(x)
        return float(v @ self.form.mass_matrix(q) @ v) / 2 + self.form.potential_energy(q)

    def contact_depth(self, x: ArrayLike) -> float:
        return self.form.contact_depth(self._state(x)[1])

    def mass_matrix(self, q: ArrayLike) -> Array:
        return self.form.mass_matrix(self._positions(q))

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        return self.form.bias(*self._motion(q, v))

    @property
    def contract(self) -> EngineContract:
        return EngineContract(
            engine=self.name,
            joints=self.form.joints(),
            native_order=self.form.joint_names,
            inputs=self.form.input_names,
            actuation=float_rows(self.form.actuation),
            effort_limits=self.form.effort_limits,
            time_step=self.time_step,
            gravity=floats(self.form.gravity_vector),
            contact_law=self.form.contact_law,
            derivatives="by every entry of x and u",
            reasons={
                "limit law": "the hand calculation has no joint limits",
                "contact pairs": "the hand calculation has its one contact in its law",
                "solver tolerance": "nothing is solved iteratively",
            },
        )
