"""The variables of a search through discrete steps besides states and inputs: parameters, and the length of a step.

If the problem has a horizon, the step length h = T / N is an additional parameter, `model.time_step`, after the
problem's own parameters. A model with this step replaces the model.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.clock import check_time
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.model.model import Model
from drake_diff.model.parameters import TIME_STEP, ParameterCoordinates, ParameterVector, select
from drake_diff.motion.intervals import roll


class Design:
    """The parameters of discrete steps as values (np,), and coordinates c (nc,) of the ones that may change.

    Args:
        model: the problem's model.
        own: the problem's own parameters, with `bounds` (lower, upper) of their values, and whether they are `free`.
        horizon: (lower, upper) [s] of all steps, if given, with `start` as its initial value.
        num_steps: the number of steps.
    """

    def __init__(
        self,
        model: Model,
        vector: ParameterVector,
        bounds: tuple[Array, Array],
        *,
        free: bool,
        horizon: tuple[float, float] | None,
        start: float,
        num_steps: int,
    ):
        self.model, self.own_count = model, len(vector.values)
        self.has_step = horizon is not None and model.can_rebuild
        self.lower, self.upper = bounds
        moving, values = vector.parameters if free else (), vector.values if free else np.zeros(0)
        self.vector, self.moved = vector, np.arange(self.own_count if free else 0)
        if self.has_step and horizon is not None:
            step, ends = select(model, (TIME_STEP,)).parameters, np.array(horizon) / num_steps
            self.vector = ParameterVector(
                model, (*vector.parameters, *step), frozen([*vector.values, start / num_steps])
            )
            self.lower, self.upper = np.append(self.lower, ends[0]), np.append(self.upper, ends[1])
            if ends[0] < ends[1]:
                self.moved = np.append(self.moved, self.own_count)
                moving, values = (*moving, *step), np.append(values, start / num_steps)
        self.coordinates = ParameterCoordinates(ParameterVector(model, tuple(moving), frozen(values)))

    @property
    def count(self) -> int:
        """The number nc of variables."""
        return len(self.moved)

    @property
    def start(self) -> Array:
        """The initial coordinates (nc,)."""
        return self.of_values(np.array(self.vector.values))

    @property
    def limits(self) -> tuple[Array, Array]:
        """The bounds (lower (nc,), upper (nc,)) of the coordinates."""
        return self.of_values(self.lower), self.of_values(self.upper)

    @property
    def moves_step(self) -> bool:
        """Whether the length of a step may change."""
        return self.has_step and self.own_count in self.moved

    def of_values(self, values: Array) -> Array:
        """Return the coordinates (nc,) of values (np,)."""
        return self.coordinates.from_values(np.asarray(values, dtype=float)[self.moved])

    def values(self, c: Array) -> Array:
        """Return the values (np,) at coordinates c (nc,)."""
        values = np.array(self.vector.values)
        values[self.moved] = self.coordinates.to_values(c)
        return values

    def own_at(self, c: Any) -> Any:
        """Return the problem's own parameters at coordinates c (nc,), which may be AutoDiffXd."""
        count = len(self.moved) - self.moves_step
        if not count:
            return self.vector.values[: self.own_count]
        tail = np.zeros(len(self.moved) - count)
        return self.coordinates.to_values(np.concatenate([c[:count], tail]))[:count]

    def at(self, c: Array) -> ParameterVector:
        """Return the parameters at coordinates c (nc,)."""
        return self.vector.at(self.values(c))

    def whole(self, values: Array, time_step: float) -> Array:
        """Return all values (np,): those of the problem's own parameters, and the step length [s] if it is one."""
        return np.append(values, time_step) if self.has_step else np.asarray(values, dtype=float)

    def own(self, values: Array) -> Array:
        """Return the problem's own parameters from all values (np,)."""
        return np.asarray(values)[: self.own_count]

    def time_step(self, values: Array) -> float:
        """Return the length of a step [s] at the values (np,)."""
        return float(values[self.own_count]) if self.has_step else self.model.time_step

    def pull_back(self, c: Array, by_values: Array) -> Array:
        """Convert a derivative with respect to all values (..., np) to the coordinates (..., nc)."""
        if not self.count:
            return np.zeros((*by_values.shape[:-1], 0))
        return self.coordinates.pull_back(c, by_values[..., self.moved])

    def of_model(self, model: Model) -> "Design":
        """Return the same design for another model with the same parameters."""
        design: Any = object.__new__(Design)
        design.__dict__.update(self.__dict__)
        design.model, design.vector = model, replace(self.vector, model=model)
        return design


class ShootingVariables:
    """z = [free entries of the first state; us; parameters in their coordinates] and its rollout of N steps.

    With `around` (N+1, nx), the states are these instead of a rollout. Steps are linearized once for each z.
    """

    def __init__(self, problem: Any, *, around: Array | None = None):
        self.problem, self.around, self.design = problem, around, problem.design
        self.free = np.flatnonzero(problem.initial_state_mask)
        self.shape = (problem.num_steps, problem.model.nu)
        num_inputs = self.shape[0] * self.shape[1] if problem.optimizes_controls else 0
        self.inputs = slice(len(self.free), len(self.free) + num_inputs)  # the slice of z
        self.size = self.inputs.stop + self.design.count
        self._at: bytes | None = None
        self._linearization: list[StepDerivatives] = []

    def pack(self, x0: Array, us: Array, parameters: Array | None = None) -> Array:
        """Return z (size,) from x0 (nx,), us (N, nu) and parameter values (np,), by default the problem's."""
        inputs = us.ravel() if self.problem.optimizes_controls else np.zeros(0)
        values = self.design.vector.values if parameters is None else parameters
        return np.concatenate([x0[self.free], inputs, self.design.of_values(values)])

    def limits(self) -> tuple[Array, Array]:
        """Return the bounds (lower, upper) of the variables, each (size,)."""
        b, count = self.problem.bounds, self.shape[0]
        lower = self.pack(b.x_lower, np.tile(b.u_lower, (count, 1)), self.design.lower)
        return lower, self.pack(b.x_upper, np.tile(b.u_upper, (count, 1)), self.design.upper)

    def unpack(self, z: Array) -> tuple[Array, Array]:
        """Return x0 (nx,) and us (N, nu) from z (size,)."""
        x0 = np.array(self.problem.x0)
        x0[self.free] = z[: len(self.free)]
        if not self.problem.optimizes_controls:
            return x0, np.array(self.problem.us)
        return x0, z[self.inputs].reshape(self.shape)

    def parameters(self, z: Array) -> ParameterVector:
        """Return the parameters of the problem's `design` at z (size,)."""
        return self.design.at(z[self.inputs.stop :])

    def time_step(self, z: Array) -> float:
        """Return the length of a step [s] at z (size,)."""
        return self.design.time_step(self.design.values(z[self.inputs.stop :]))

    def pull_back(self, z: Array, by_parameters: Array) -> Array:
        """Return the derivative (..., nc) with respect to the coordinates of the design in z."""
        return self.design.pull_back(z[self.inputs.stop :], by_parameters)

    def linearization(self, z: Array) -> list[StepDerivatives]:
        """Return the step derivatives along the states of z."""
        if z.tobytes() != self._at:
            (x0, us), vector = self.unpack(z), self.parameters(z)
            with self.problem.intervals(vector) as intervals:
                given = None if self.around is None else self.around[:-1]
                self._linearization = intervals.derivatives(x0, us, given)
            self._at = z.tobytes()
        return self._linearization

    def states(self, z: Array) -> Array:
        """Return the states (N+1, nx) of the rollout of z, or the states `around`."""
        if self.around is not None:
            return self.around
        x0, us = self.unpack(z)
        if z.tobytes() == self._at:
            return np.vstack([x0, [d.x_next for d in self._linearization]])
        with self.problem.intervals(self.parameters(z)) as intervals:
            return roll(intervals, x0, us)


@np.errstate(over="ignore", invalid="ignore")  # the effect of an early variable may exceed every number
def final_sensitivity(variables: ShootingVariables, z: Array) -> Array:
    """Return d x_n / d z (nx, size) by a backward recursion from the last step, in time and memory that grow as n.

    A forward recursion would carry the columns of all inputs through every step, which costs n^2.
    """
    steps, nu = variables.linearization(z), variables.shape[1]
    jacobian, after = np.zeros((variables.problem.model.nx, variables.size)), np.eye(variables.problem.model.nx)
    for k in reversed(range(len(steps))):
        check_time()
        d = steps[k]
        if variables.problem.optimizes_controls:
            start = variables.inputs.start + k * nu
            jacobian[:, start : start + nu] = after @ d.B
        jacobian[:, variables.inputs.stop :] += after @ variables.pull_back(z, d.C)
        after = after @ d.A
    jacobian[:, np.arange(len(variables.free))] = after[:, variables.free]
    return jacobian
