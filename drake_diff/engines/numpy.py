"""The hand-built baseline: closed forms of `closed_form` in the step of `euler`, nothing but NumPy."""

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array, frozen, positive_float
from drake_diff.engines.closed_form import BY_MODEL, ClosedForm
from drake_diff.engines.interface import EngineContract, StepJacobian
from drake_diff.exceptions import ModelError
from drake_diff.mechanics.coordinates import euler_jacobian, euler_step
from drake_diff.model.model import Model

DRAKES_STEP = "semi-implicit Euler, joint damping implicit, q' = q + h N(q) v'"
DRAKES_STATE = "quaternion w x y z; velocity of a free body angular then linear, both in world"
EACH_CALL = "each step starts from x and u alone"


class NumpyEngine:
    """A closed form, or that of the drake_diff model's name (`match_contracts` tells whether it is the same)."""

    name, version, status = "numpy", np.__version__, "ok"

    def __init__(self, model: Model | ClosedForm, *, time_step: float | None = None):
        if isinstance(model, Model):
            if model.name not in BY_MODEL:
                known = ", ".join(sorted(BY_MODEL))
                raise ModelError(f"there is no hand calculation of the model {model.name!r}; expected one of {known}")
            self.form, self.time_step = BY_MODEL[model.name], model.time_step
        else:
            self.form, self.time_step = model, positive_float("time_step [s]", time_step)
        self.nq, self.nv = self.form.coordinates.nq, self.form.coordinates.nv

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        x, u = self._point(x, u)
        acceleration, _ = self.form.acceleration(self.time_step, x[: self.nq], x[self.nq :], u)
        return euler_step(self.form.coordinates, self.time_step, x, acceleration)

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        x, u = self._point(x, u)
        acceleration, by = self.form.acceleration(self.time_step, x[: self.nq], x[self.nq :], u)
        x_next = euler_step(self.form.coordinates, self.time_step, x, acceleration)
        jacobian = euler_jacobian(self.form.coordinates, self.time_step, x, x_next, by)
        return StepJacobian(frozen(jacobian[:, : len(x)]), frozen(jacobian[:, len(x) :]), "by hand")

    def energy(self, x: ArrayLike) -> float:
        x = finite_array("x", x, (self.nq + self.nv,))
        q, v = x[: self.nq], x[self.nq :]
        return float(v @ self.form.mass_matrix(q) @ v) / 2 + self.form.potential_energy(q)

    def contact_depth(self, x: ArrayLike) -> float:
        return self.form.contact_depth(finite_array("x", x, (self.nq + self.nv,))[: self.nq])

    def mass_matrix(self, q: ArrayLike) -> Array:
        return self.form.mass_matrix(finite_array("q", q, (self.nq,)))

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        return self.form.bias(finite_array("q", q, (self.nq,)), finite_array("v", v, (self.nv,)))

    @property
    def contract(self) -> EngineContract:
        form = self.form
        return EngineContract(
            engine=self.name,
            joints=form.joints(),
            native_order=form.joint_names,
            state=DRAKES_STATE,
            inputs=form.input_names,
            actuation=tuple(tuple(float(b) for b in row) for row in form.actuation),
            effort_limits=form.effort_limits,
            time_step=self.time_step,
            integrator=DRAKES_STEP,
            gravity=tuple(float(g) for g in form.gravity_vector),
            contact_law=form.contact_law,
            contacts=(),
            solver_tolerance=None,
            limit_law="none",
            reset=EACH_CALL,
            derivatives="by every entry of x and u",
            reasons={
                "limit law": "the hand calculation has no joint limits",
                "contact pairs": "the hand calculation has its one contact in its law",
                "solver tolerance": "nothing is solved iteratively",
            },
        )

    def _point(self, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
        return finite_array("x", x, (self.nq + self.nv,)), finite_array("u", u, (len(self.form.input_names),))
