"""What a motion by discrete steps comes from: its variables, and the derivatives along it by them."""

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.clock import check_time
from drake_diff.derivatives.step import StepDerivatives
from drake_diff.model.parameters import ParameterVector
from drake_diff.motion.intervals import roll
from drake_diff.optimize.problem.problem import Problem


class ShootingVariables:
    """z = [free entries of the first state; us; parameters in their coordinates] and its rollout of N steps.

    Given `around` (N+1, nx), the states are these instead of a rollout. Steps are linearized once for each z.
    """

    def __init__(self, problem: Problem, *, around: Array | None = None):
        self.problem, self.around, self.design = problem, around, problem.design
        self.free = np.flatnonzero(problem.initial_state_mask)
        self.shape = (problem.num_steps, problem.model.nu)
        num_inputs = self.shape[0] * self.shape[1] if problem.optimizes_controls else 0
        self.inputs = slice(len(self.free), len(self.free) + num_inputs)  # where in z they are
        self.size = self.inputs.stop + self.design.count
        self._at: bytes | None = None
        self._linearization: list[StepDerivatives] = []

    def pack(self, x0: Array, us: Array, parameters: Array | None = None) -> Array:
        """z (size,) from the first state x0 (nx,), us (N, nu) and parameter values (np,), the problem's where None."""
        inputs = us.ravel() if self.problem.optimizes_controls else np.zeros(0)
        values = self.design.vector.values if parameters is None else parameters
        return np.concatenate([x0[self.free], inputs, self.design.of_values(values)])

    def limits(self) -> tuple[Array, Array]:
        """(lower, upper), each (size,): the bounds of the variables."""
        b, count = self.problem.bounds, self.shape[0]
        lower = self.pack(b.x_lower, np.tile(b.u_lower, (count, 1)), self.design.lower)
        return lower, self.pack(b.x_upper, np.tile(b.u_upper, (count, 1)), self.design.upper)

    def unpack(self, z: Array) -> tuple[Array, Array]:
        """x0 (nx,) and us (N, nu) from z (size,)."""
        x0 = np.array(self.problem.x0)
        x0[self.free] = z[: len(self.free)]
        if not self.problem.optimizes_controls:
            return x0, np.array(self.problem.us)
        return x0, z[self.inputs].reshape(self.shape)

    def parameters(self, z: Array) -> ParameterVector:
        """Those of the problem's `design` at z (size,)."""
        return self.design.at(z[self.inputs.stop :])

    def time_step(self, z: Array) -> float:
        """[s] the length of a step at z (size,)."""
        return self.design.time_step(self.design.values(z[self.inputs.stop :]))

    def pull_back(self, z: Array, by_parameters: Array) -> Array:
        """(..., nc) the derivative by the coordinates of the design in z."""
        return self.design.pull_back(z[self.inputs.stop :], by_parameters)

    def linearization(self, z: Array) -> list[StepDerivatives]:
        """The step derivatives along the states of z."""
        if z.tobytes() != self._at:
            (x0, us), vector = self.unpack(z), self.parameters(z)
            with self.problem.intervals(vector) as intervals:
                given = None if self.around is None else self.around[:-1]
                self._linearization = intervals.derivatives(x0, us, given)
            self._at = z.tobytes()
        return self._linearization

    def states(self, z: Array) -> Array:
        """(N+1, nx) the states of the rollout of z, or those given."""
        if self.around is not None:
            return self.around
        x0, us = self.unpack(z)
        if z.tobytes() == self._at:
            return np.vstack([x0, [d.x_next for d in self._linearization]])
        with self.problem.intervals(self.parameters(z)) as intervals:
            return roll(intervals, x0, us)


def final_sensitivity(variables: ShootingVariables, z: Array) -> Array:
    """(nx, size): d x_n / d z, backward: d x_n / d x_k from the last k on, in time and memory that grow as n.

    Forward, all inputs' columns are carried through every step, which takes n^2.
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
