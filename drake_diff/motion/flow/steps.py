"""The flow over a model's own intervals as steps, and their Jacobians: what `method="continuous"` takes."""

from collections.abc import Callable

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff.derivatives.contact.laws import QUANTITIES, material_change
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.model.model import Model
from drake_diff.model.parameters import ParameterVector
from drake_diff.model.step import stepped
from drake_diff.motion.flow.integrate import TOLERANCE, Flow, Integrator
from drake_diff.motion.flow.plant import flow_plant, material_of, numbers_of
from drake_diff.motion.flow.transitions import transitions

METHOD = "continuous"
Chooser = Callable[[Array, int], Array]  # the state (nx,) and the number of the interval -> the input (nu,)


class FlowSteps:
    """The flow of a model, to which a vector of contact parameters is applied; ModelError where it has none."""

    def __init__(self, model: Model, vector: ParameterVector, tolerance: float = TOLERANCE):
        for parameter in vector.parameters:
            if parameter.kind.quantity not in QUANTITIES:
                raise ModelError(
                    f'method="continuous" takes no {parameter.name}: of parameters it takes contact\'s '
                    f"{', '.join(QUANTITIES)}"
                )
        self.model, self.vector, self.plant = model, vector, flow_plant(model)
        self.material, self._limits = material_of(self.plant), model.position_limits
        self.integrator = Integrator(self.plant, numbers_of(self.plant, self.material), tolerance)

    def roll(self, x0: Array, choose: Chooser, count: int) -> tuple[Array, Array, Flow]:
        """xs (N+1, nx) at the ends of the intervals, us (N, nu), and the flow."""
        model, flow = self.model, self.integrator.begin(x0)
        xs, us = np.empty((count + 1, model.nx)), np.empty((count, model.nu))
        xs[0] = x0
        for k in range(count):
            us[k] = choose(xs[k], k)
            begin = len(flow.hs)
            stepped()
            xs[k + 1] = self.integrator.advance(flow, us[k], model.time_step)
            self._check_limits(np.array(flow.xs[begin:]))
        return xs, us, flow

    def _check_limits(self, xs: Array) -> None:
        lower, upper = self._limits
        qs = xs[:, : self.model.nq]
        beyond = np.flatnonzero(np.any((qs < lower) | (qs > upper), axis=0))
        if len(beyond):
            name = self.model.state_names[beyond[0]]
            raise SimulationError(f"{name} reaches a joint limit, whose motion in continuous time is not known here")

    def derivatives(self, flow: Flow) -> list[StepDerivatives]:
        """Of the intervals of a flow."""
        nu, names = self.model.nu, self.vector.names
        material = self.integrator.materials
        by_parameters = np.zeros((len(material), len(names)))
        if names:
            change = material_change(self.plant.pairs, self.material, self.vector, self.model.double)
            by_parameters = numbers_of(self.plant, change)
        found = transitions(self.plant, flow, material, by_parameters)
        steps, begin = [], 0
        for end in flow.ends:
            A, B = np.eye(self.model.nx), np.zeros((self.model.nx, nu))
            C = np.zeros((self.model.nx, len(names)))
            for m in range(begin, end):
                by_x = found.by_x[m]
                A, B = by_x @ A, by_x @ B + found.by_u[m]
                C = by_x @ C + found.by_parameters[m]
            x_next = frozen(flow.xs[end])
            told = f"the flow by {end - begin} steps"
            steps.append(
                StepDerivatives(x_next, frozen(A), frozen(B), frozen(C), names, (METHOD,) * len(names), METHOD, told)
            )
            begin = end
        return steps
