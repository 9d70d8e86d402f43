"""Drake itself as an engine, with a fixed contact approximation and a fixed source of the derivatives."""

from functools import cached_property
from importlib.metadata import version

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array
from drake_diff.derivatives.sources import check_method
from drake_diff.derivatives.step import differentiate_step
from drake_diff.engines.interface import Arguments, EngineContract, StepJacobian, float_rows, floats, geometry_contracts
from drake_diff.engines.load import reduced_contract
from drake_diff.mechanics.description import Description, describe, joint_contracts
from drake_diff.model.contact import penetration
from drake_diff.model.model import Model
from drake_diff.model.step import set_state, step


class DrakeEngine(Arguments):
    """An engine that uses Drake, with `contact` sap, similar or lagged (default: the model's) and a step `method`."""

    version, status = version("drake"), "ok"

    def __init__(self, model: Model, *, contact: str | None = None, method: str = "autodiff"):
        check_method(method)
        approximation = model.contract.contact.approximation
        self.model = model if contact in (None, approximation) else model.with_contact(str(contact))
        self.method = method
        self.name = f"drake ({self.model.contract.contact.approximation}, {method})"

    @cached_property
    def description(self) -> Description:
        """The description for the contract, with all joints. Raises ModelError for unsupported plant elements."""
        return describe(self.model.whole)

    def step(self, x: ArrayLike, u: ArrayLike) -> Array:
        return step(self.model, x, u)

    def differentiate_step(self, x: ArrayLike, u: ArrayLike) -> StepJacobian:
        derivatives = differentiate_step(self.model, x, u, method=self.method)
        return StepJacobian(derivatives.A, derivatives.B, derivatives.method)

    def energy(self, x: ArrayLike) -> float:
        set_state(self.model.double, finite_array("x", x, (self.model.nx,)))
        plant, context = self.model.plant, self.model.double.context
        return float(plant.CalcKineticEnergy(context) + plant.CalcPotentialEnergy(context))

    def contact_depth(self, x: ArrayLike) -> float:
        set_state(self.model.double, finite_array("x", x, (self.model.nx,)))
        return penetration(self.model)

    def mass_matrix(self, q: ArrayLike) -> Array:
        q = finite_array("q", q, (self.model.nq,))
        set_state(self.model.double, np.concatenate([q, np.zeros(self.model.nv)]))
        return np.asarray(self.model.double.mass_matrix())

    def bias(self, q: ArrayLike, v: ArrayLike) -> Array:
        q, v = finite_array("q", q, (self.model.nq,)), finite_array("v", v, (self.model.nv,))
        set_state(self.model.double, np.concatenate([q, v]))
        return np.asarray(self.model.double.inverse_dynamics(np.zeros(self.model.nv)) - self.model.double.damping() * v)

    @property
    def contract(self) -> EngineContract:
        contact = self.model.contract.contact
        whole = EngineContract(
            engine=self.name, joints=joint_contracts(self.description),
            native_order=tuple(link.joint for link in self.description.moving), inputs=self.model.input_names,
            actuation=float_rows(self.description.actuation), effort_limits=floats(self.description.effort_limits),
            time_step=self.model.time_step, gravity=floats(self.description.gravity),
            contact_law=f"{contact.model}, {contact.approximation}" if contact.collision_pairs else "none",
            geometries=geometry_contracts(self.description), contacts=self.description.pairs,
            solver_tolerance=contact.solver_relative_tolerance,
            limit_law="implicit springs in the step's solver, from two steps before the limit on",
            derivatives="by every entry of x and u",
        )  # fmt: skip
        return reduced_contract(whole, self.model)
