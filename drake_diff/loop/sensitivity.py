"""How far perturbations displace the last state to first order: what the gradients say before anything is tried.

Along the unperturbed motion, with A_k, B_k, C_k the derivatives of step k by state, input and parameters on the tangent
space and K_k that of the controller's answer by what it sees (u = -K_k x), the closed loop moves by

    d_(k+1) = (A_k - B_k K_k) d_k + C_k dp + B_k K_k (-n_k)

so a displacement d_0, a change dp and a noise n_k lead to a last displacement that is linear in each. What is told is
its root mean square: sqrt(E |d_N|^2) of independent perturbations as `loop.perturbation` draws them.
"""

import numpy as np

from drake_diff.arrays import Array
from drake_diff.loop.estimator import Hold
from drake_diff.loop.perturbation import PERTURBATIONS, parameters_of
from drake_diff.loop.trial import Task
from drake_diff.model import Model
from drake_diff.parameters import applied, select
from drake_diff.rollout_gradient import derivatives_along
from drake_diff.step_derivatives import StepDerivatives
from drake_diff.tangent import tangent_space

UNIFORM = 1 / np.sqrt(3)  # the standard deviation of U of level 1
DIFFERENCE = (
    1e-5  # of the controller's answer by what it sees: about the cube root of rounding, central differences' best
)
FACTORS = ("inertia", "mass", "friction", "stiffness", "damping", "gravity")
TOLD = ("initial_state", "sensor_noise", "sensor_bias", "actuator_strength", *FACTORS)


class Sensitivity:
    """The first-order effect of perturbations on the last state of a task's unperturbed run.

    Only of runs in an ideal loop: with a delay, a lag, lost samples, another estimator or a fallback in charge
    `predicted` is None.
    """

    def __init__(self, task: Task):
        self.task, self.space = task, tangent_space(task.model)
        loop = task.loop
        self.is_known = (
            loop.substeps == 1
            and loop.sensor.delay == loop.actuator.delay == 0
            and loop.sensor.every == loop.actuator.every == 1
            and loop.actuator.lag == 0
            and loop.sensor.dropout == 0
            and type(loop.estimator) is Hold
            and not task.nominal.run.ended
            and not any(event.kind == "fallback" for event in task.nominal.run.events)
        )
        self.parameters = {name: parameters_of(task.model, name) for name in FACTORS}
        self._products: tuple[Array, Array, Array, Array] | None = None

    def predicted(self, name: str, level: float) -> float | None:
        """The root mean square of the last state's displacement; None where no gradient tells."""
        if not self.is_known or name not in TOLD or not PERTURBATIONS[name].is_of(self.task.model):
            return None
        found = float(level * np.linalg.norm(self._effect(name)))
        return found if np.isfinite(found) else None

    def _effect(self, name: str) -> Array:
        """(nt, .) the last state's derivative by what a perturbation of level 1 draws, times its spread."""
        start, _, noise, factor = self._effects()
        if name == "initial_state":
            return start
        if name == "sensor_noise":
            return noise
        if name == "sensor_bias":  # the same at every step
            return np.asarray(UNIFORM * noise.reshape(self.space.size, -1, self.space.size).sum(axis=1))
        return np.asarray(UNIFORM * (factor if name == "actuator_strength" else self._by_factor(name)))

    def _by_factor(self, quantity: str) -> Array:
        """(nt, n) the derivative by a factor of each parameter of a quantity."""
        columns, at = [], 0
        for name in FACTORS:
            for value in self.parameters[name].values():
                width = len(np.atleast_1d(value))
                if name == quantity:
                    columns.append(self._effects()[1][:, at : at + width] @ np.atleast_1d(value))
                at += width
        return np.array(columns).T

    def _effects(self) -> tuple[Array, Array, Array, Array]:
        """(nt, .) of the start, the parameters, every step's noise, and a factor of each input."""
        if self._products is None:
            self._products = self._along()
        return self._products

    def _along(self) -> tuple[Array, Array, Array, Array]:
        task, size = self.task, self.space.size
        run, h = task.nominal.run, task.model.time_step
        xs, us = run.motion.xs, run.applied
        start, noise, factor = np.eye(size), np.zeros((size, 0)), np.zeros((size, task.model.nu))
        by_parameter: Array | None = None
        # The inertia apart: a mass that is changed alone takes it along, one that is set beside it does not.
        inertia, others = list(self.parameters["inertia"]), [n for q in FACTORS[1:] for n in self.parameters[q]]
        groups = [inertia, others] if inertia else [others]
        with applied(select(task.setup.model, task.setup.parameters)) as model:
            along = [_along(model, xs[:-1], us, names) for names in groups]
        for k, u in enumerate(us):
            steps = [found[k] for found in along]
            found = self.space.jacobian(xs[k], xs[k + 1], steps[0].A, steps[0].B, *(step.C for step in steps))
            A, B, C = np.split(found, [size, size + task.model.nu], axis=1)
            K = self._gain(xs[k], k * h)
            loop = A + B @ K
            start, noise = loop @ start, np.hstack([loop @ noise, B @ K])
            factor = loop @ factor + B * u
            by_parameter = C if by_parameter is None else loop @ by_parameter + C
        return start, np.zeros((size, 0)) if by_parameter is None else by_parameter, noise, factor

    def _gain(self, x: Array, t: float) -> Array:
        """(nu, nt) the derivative of the controller's answer by what it sees, by central differences."""
        columns = []
        for e in DIFFERENCE * np.eye(self.space.size):
            ahead, behind = (np.asarray(self.task.policy(self.space.plus(x, d), t), dtype=float) for d in (e, -e))
            columns.append((ahead - behind) / (2 * DIFFERENCE))
        return np.array(columns).T.reshape(self.task.model.nu, self.space.size)


def _along(model: Model, xs: Array, us: Array, names: list[str]) -> list[StepDerivatives]:
    """The derivatives, by the parameters `names` too, of the steps from each of xs (N, nx) under us (N, nu)."""
    vector = select(model, names)
    with applied(vector) as set_model:
        return derivatives_along(set_model, xs[0], us, vector=vector, xs=xs)
