"""The continuous-time equations of motion for collocation: a Drake System made from the discrete plant.

    M(q) dv/dt = B u + forces(q, v, u) - C(q, v) v,    dq/dt = N(q) v.

They use Drake's mass matrix, force elements (gravity, springs), joint damping and bias, and the forces of the diagram's
systems. Of these forces, only those of the systems depend on u. Contact, joint limits, PD control and constraints are
not included: they exist only in the discrete step. `mechanics.fixed_contacts` adds closed loops. With r(q, v, dv/dt, u)
the residual of inverse dynamics, d(dv/dt) = -M^-1 dr at fixed dv/dt, so AutoDiffXd never factors a matrix.
"""

from typing import Any

import numpy as np
from pydrake.autodiffutils import AutoDiffXd, ExtractValue, InitializeAutoDiff
from pydrake.systems.framework import BasicVector_, LeafSystem_
from pydrake.systems.scalar_conversion import TemplateSystem

from drake_diff._base.arrays import Array
from drake_diff._base.autodiff import gradient_rows
from drake_diff.exceptions import ModelError
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators
from drake_diff.model.step import set_state
from drake_diff.model.twin import Twin


class EquationsOfMotion:
    """The function dx/dt = f(x, u) of a model, for floats and for AutoDiffXd.

    Raises ModelError if the model has PD control or constraints, which have no continuous form.
    """

    def __init__(self, model: Model):
        check_continuous(model)
        self.model = model
        self.actuation = model.actuation
        self.systems = bool(model.inputs.fed)  # forces of systems depend on x and u
        self.plain_rates = model.plant.IsVelocityEqualToQDot()
        self._still = np.zeros(model.nv)

    def __call__(self, x: Array, u: Array) -> Array:
        """Return dx/dt (nx,) at `x` (nx,), `u` (nu,); raise SimulationError if they are not finite."""
        set_state(self.model.double, x)
        return np.asarray(self.values(np.concatenate([x, u])[None])[0])

    def values(self, knots: Array) -> Array:
        """Return dx/dt (K, nx) at `knots` (K, nx + nu) with rows [x, u]; NaN if a knot is not finite."""
        if len(knots) == 1:
            return self._rates_at(knots[0])[None]
        model, twin = self.model, self.model.double
        finite = np.isfinite(knots).all(axis=1)
        rates, still = np.full((len(knots), model.nx), np.nan), np.zeros(model.nv)
        rest, mass = np.zeros((len(knots), model.nv)), np.tile(np.eye(model.nv), (len(knots), 1, 1))
        for k in np.flatnonzero(finite).tolist():
            x = knots[k, : model.nx]
            twin.set_state(x)
            if self.systems:
                twin.set_input(knots[k, model.nx :])
            rest[k] = twin.inverse_dynamics(still)
            mass[k] = twin.mass_matrix()
            rates[k, : model.nq] = x[model.nq :] if self.plain_rates else self.q_dot(twin, x)
        force = knots[:, model.nx :] @ self.actuation.T - rest
        rates[finite, model.nq :] = np.linalg.solve(mass, force[..., None])[finite, :, 0]
        return rates

    def _rates_at(self, knot: Array) -> Array:
        """Return dx/dt (nx,) at one `knot` without the arrays for many knots."""
        twin, nx, nq = self.model.double, self.model.nx, self.model.nq
        if not np.isfinite(knot).all():
            return np.full(nx, np.nan)
        x = knot[:nx]
        twin.set_state(x)
        rates = np.empty(nx)
        rates[:nq] = x[nq:] if self.plain_rates else self.q_dot(twin, x)
        rates[nq:] = self.acceleration(knot[nx:])[0]
        return rates

    def autodiff(self, x: Any, u: Any) -> Any:
        """Return dx/dt for AutoDiffXd arguments."""
        set_state(self.model.double, ExtractValue(x).ravel())
        acceleration, mass = self.acceleration(ExtractValue(u).ravel())
        twin = self.model.autodiff
        set_state(twin, x)
        if self.systems:
            twin.set_input(u)
        residual = twin.inverse_dynamics(np.array([AutoDiffXd(a) for a in acceleration]))
        width = max(len(z.derivatives()) for z in (*x, *u, *residual))
        rows = gradient_rows(residual, width) - self.actuation @ gradient_rows(u, width)
        by_row = InitializeAutoDiff(acceleration, -np.linalg.solve(mass, rows)).ravel()
        return np.concatenate([self.q_dot(twin, x), by_row])

    def jacobian(self, knot: Array) -> Array:
        """Return the Jacobian (nx, nx + nu) at `knot` = [x; u] by AutoDiffXd."""
        variables, nx = InitializeAutoDiff(knot).ravel(), self.model.nx
        return gradient_rows(self.autodiff(variables[:nx], variables[nx:]), len(knot))

    def q_dot(self, twin: Twin, x: Any) -> Any:
        """Return N(q) v (nq,) for x (nx,), whose positions must be set in the twin."""
        v = x[self.model.nq :]
        return twin.rates(v)

    def acceleration(self, u: Array) -> tuple[Array, Array]:
        """Return (dv/dt (nv,), M (nv, nv)) for u (nu,) in the double context's state."""
        twin = self.model.double
        if self.systems:
            twin.set_input(u)
        rest = twin.inverse_dynamics(self._still)
        mass = twin.mass_matrix()
        return np.linalg.solve(mass, self.actuation @ u - rest), mass


def check_continuous(model: Model, *, loops: bool = False) -> None:
    """Raise ModelError for PD control, and for constraints other than `loops`, which have no continuous form."""
    if model.pd_targets or any(a.has_controller() for a in actuators(model.plant)):
        raise ModelError("collocation: PD-controlled actuators have no continuous form; use method='shooting'")
    if model.num_constraints > loops * len(model.file_facts.held_points):
        raise ModelError("collocation: the model's constraints have no continuous form; use method='shooting'")


@TemplateSystem.define("ContinuousSystem_")
def ContinuousSystem_(T):  # type: ignore[no-untyped-def]
    class Impl(LeafSystem_[T]):  # type: ignore[misc]
        """The Drake System of `EquationsOfMotion`, with one input u and the state x = [q; v]."""

        def _construct(self, equations, converter=None):  # type: ignore[no-untyped-def]
            LeafSystem_[T].__init__(self, converter)
            self.equations, model = equations, equations.model
            self.DeclareVectorInputPort("u", BasicVector_[T](model.nu))
            self.DeclareContinuousState(model.nq, model.nv, 0)

        def _construct_copy(self, other, converter=None):  # type: ignore[no-untyped-def]
            self._construct(other.equations, converter=converter)  # type: ignore[no-untyped-call]

        def DoCalcTimeDerivatives(self, context, derivatives):  # type: ignore[no-untyped-def]
            evaluate = self.equations if T is float else self.equations.autodiff
            x = context.get_continuous_state_vector().CopyToVector()
            derivatives.SetFromVector(evaluate(x, self.get_input_port().Eval(context)))

    return Impl


ContinuousSystem = ContinuousSystem_[None]
