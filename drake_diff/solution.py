"""What every solver returns, and measures that do not take its word."""

import enum
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from drake_diff.arrays import Array
from drake_diff.certificate import Certificate
from drake_diff.continuous import EquationsOfMotion
from drake_diff.exceptions import ModelError, SimulationError
from drake_diff.model import Model
from drake_diff.parameters import ParameterVector, applied, select
from drake_diff.problem import Problem
from drake_diff.rollout import Rollout, roll_states, rollout
from drake_diff.step import advance

FEASIBILITY_TOLERANCE = 1e-5  # defect, goal and bounds, in the state's and input's own units
# Between two knots the transcription is a cubic; further than this [state units] from an accurate integration
# its motion is not the model's.
INTEGRATION_TOLERANCE = 1e-2


class Status(enum.Enum):
    """How a solve ended; `sentence` says what that means and what to try."""

    CONVERGED = "converged"
    CONVERGED_NOT_VERIFIED = "converged_not_verified"
    ITERATION_LIMIT = "iteration_limit"
    TIME_LIMIT = "time_limit"
    INFEASIBLE = "infeasible"
    DIVERGED = "diverged"
    NO_GRADIENT = "no_gradient"
    INTERRUPTED = "interrupted"
    FAILED = "failed"

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]


_SENTENCES = {
    Status.CONVERGED: "the solver converged and every measure taken again on the plant holds",
    Status.CONVERGED_NOT_VERIFIED: "the solver stopped at a solution, but a measure or a certificate does not hold",
    Status.ITERATION_LIMIT: "the iteration limit came first; raise max_iterations or start from a better guess",
    Status.TIME_LIMIT: "the time limit came first; raise time_limit or start from a better guess",
    Status.INFEASIBLE: "the solver found no motion that keeps every bound and reaches the goal; relax a bound, "
    "give it more steps, or start from another guess",
    Status.DIVERGED: "the motion left every finite number; use a smaller time step or a better guess",
    Status.NO_GRADIENT: "nothing that may change has an effect on the goal or the cost, or its derivative must not "
    "be used; start from a guess that does",
    Status.INTERRUPTED: "the run was interrupted; this is the best motion so far",
    Status.FAILED: "the solver failed",
}


@dataclass(frozen=True)
class Iteration:
    """One row of the solver's own table; NaN where it prints no such number."""

    iteration: int
    objective: float
    primal_infeasibility: float
    dual_infeasibility: float
    step: float


@dataclass(frozen=True, eq=False)
class Solution:
    """A motion xs (N+1, nx) under us (N, nu), how it was found, and what it measures on Drake's double plant.

    The inputs of a discrete method are held over each step. Those of collocation are linear between knots, `us`
    holding knots 0 ... N-1 and `u_final` (nu,) the last one. `cost`, `defect`, `bound_violation` and the rest
    are computed from xs and us each time a Solution is made, never taken from the solver.
    """

    problem: Problem
    method: str
    solver: str
    status: Status
    message: str
    xs: Array
    us: Array
    u_final: Array | None = None
    parameters: Array | None = None  # (np,) the values of `problem.parameters`; the problem's own where None
    iterations: tuple[Iteration, ...] = ()
    certificates: tuple[Certificate, ...] = ()
    gradient_norms: Array | None = None  # (N+1,) |d cost / d x_k| at the solution, where the method has it
    options: dict[str, Any] = field(default_factory=dict)
    solver_message: str = ""
    wall_time: float = 0.0  # [s]

    @property
    def success(self) -> bool:
        """Whether the solver converged and everything measured again holds."""
        return self.status is Status.CONVERGED

    @property
    def vector(self) -> ParameterVector:
        """The problem's parameters as they were found."""
        return self.problem.parameters if self.parameters is None else self.problem.parameters.at(self.parameters)

    @cached_property
    def cost(self) -> float:
        """The objective of xs and us, as `Problem` defines it; inf where it is not finite."""
        total = self.problem.objective(self.xs, self.inputs_at_knots)
        return total if np.isfinite(total) else float("inf")

    @property
    def times(self) -> Array:
        """(N+1,) [s] of the states."""
        return np.asarray(self.problem.model.time_step * np.arange(len(self.xs)), dtype=float)

    @property
    def inputs_at_knots(self) -> Array:
        """The inputs at the knots: (N, nu) held ones, (N+1, nu) where they are linear in between."""
        return self.us if self.u_final is None else np.vstack([self.us, self.u_final])

    @cached_property
    def defects(self) -> Array:
        """(N,) how far each interval is from the dynamics, as a state change, in the worst coordinate's unit.

        Discrete: |x_(k+1) - step(x_k, u_k)|. Collocation: h |dx/dt - f(x, u)| of the cubic through the knots at
        its midpoint, Drake's own defect times h.
        """
        if self.us.shape != self.problem.us.shape or self.xs.shape != (len(self.us) + 1, self.problem.model.nx):
            return np.full(max(self.problem.num_steps, 1), np.inf)
        if self.u_final is not None:
            return np.array([self._collocation_defect(k) for k in range(len(self.us))])
        with applied(self.vector) as model:
            return np.array([self._step_defect(model, k) for k in range(len(self.us))])

    @property
    def defect(self) -> float:
        """The largest of `defects`."""
        return _largest(self.defects)

    @cached_property
    def integration_errors(self) -> Array:
        """(N,) distance of knot k+1 from an accurate integration of the dynamics from knot k.

        Of a discrete method the step is the dynamics, and this is its defect.
        """
        if self.u_final is None:
            return self.defects
        return np.array([self._integration_error(k) for k in range(len(self.us))])

    @property
    def integration_error(self) -> float:
        """The largest of `integration_errors`."""
        return _largest(self.integration_errors)

    @cached_property
    def bound_violation(self) -> float:
        """The largest excess over a bound of a state that is not given, an input, or a parameter."""
        b = self.problem.bounds
        states, inputs = self.xs[1:], self.inputs_at_knots
        free = self.problem.initial_state_mask
        if not (np.all(np.isfinite(states)) and np.all(np.isfinite(inputs))):
            return float("inf")
        excess = [b.x_lower - states, states - b.x_upper, b.u_lower - inputs, inputs - b.u_upper]
        lowest, highest = self.problem.bounds_of_parameters()
        excess += [lowest - self.vector.values, self.vector.values - highest]
        excess += [(b.x_lower - self.xs[0])[free], (self.xs[0] - b.x_upper)[free]]
        return float(max(np.max(e, initial=0.0) for e in excess))

    @cached_property
    def goal_error(self) -> float:
        """The largest distance of the final state from the goal, free entries apart."""
        return _largest(np.abs(self.problem.goal_error(self.xs[-1])))

    @cached_property
    def initial_state_error(self) -> float:
        """The largest distance of xs[0] from the problem's x0, free entries apart."""
        fixed = ~self.problem.initial_state_mask
        return _largest(np.abs(self.xs[0] - self.problem.x0)[fixed])

    @cached_property
    def replay(self) -> Rollout | None:
        """The discrete plant's own open-loop motion from xs[0] under us; None where it cannot be taken.

        An input that is linear between knots is held at its mean over each step.
        """
        knots = self.inputs_at_knots
        us = self.us if self.u_final is None else (knots[:-1] + knots[1:]) / 2
        try:
            return rollout(self.problem.model, self.xs[0], us, parameters=self.vector.to_dict())
        except (SimulationError, ValueError):
            return None  # not finite, or beyond what Drake can step: recorded as missing, never as zero

    @cached_property
    def half_step_error(self) -> float:
        """How far from xs[-1] the same held inputs lead at half the time step: what a step size decided.

        inf where the model cannot be built again (it came from a diagram) or stepped.
        """
        if self.replay is None:
            return float("inf")
        try:
            finer = self.problem.model.at_time_step(self.problem.model.time_step / 2)
            with applied(select(finer, self.vector.to_dict())) as model:
                end = roll_states(model, self.xs[0], np.repeat(self.replay.us, 2, axis=0))[-1]
        except (ModelError, SimulationError):
            return float("inf")
        return _largest(np.abs(end - self.xs[-1]))

    @cached_property
    def _equations(self) -> EquationsOfMotion:
        return EquationsOfMotion(self.problem.model)

    def _step_defect(self, model: Model, k: int) -> float:
        try:
            return _largest(np.abs(self.xs[k + 1] - advance(model.double, self.xs[k], self.us[k])))
        except SimulationError:
            return float("inf")

    def _collocation_defect(self, k: int) -> float:
        h, f, u = self.problem.model.time_step, self._equations, self.inputs_at_knots
        x0, x1 = self.xs[k], self.xs[k + 1]
        if not (np.all(np.isfinite(self.xs[k : k + 2])) and np.all(np.isfinite(u[k : k + 2]))):
            return float("inf")
        f0, f1 = f(x0, u[k]), f(x1, u[k + 1])
        middle = (x0 + x1) / 2 + h / 8 * (f0 - f1)
        slope = 1.5 / h * (x1 - x0) - (f0 + f1) / 4
        return _largest(h * np.abs(slope - f(middle, (u[k] + u[k + 1]) / 2)))

    def _integration_error(self, k: int) -> float:
        u = self.inputs_at_knots
        if not (np.all(np.isfinite(self.xs[k : k + 2])) and np.all(np.isfinite(u[k : k + 2]))):
            return float("inf")
        end = _integrate(self._equations, self.xs[k], u[k], u[k + 1], self.problem.model.time_step)
        return _largest(np.abs(self.xs[k + 1] - end))


def _largest(values: Array) -> float:
    """The largest value; inf where one is not a number, 0 where there is none."""
    values = np.asarray(values, dtype=float)
    return float("inf") if np.any(np.isnan(values)) else float(np.max(values, initial=0.0))


def _integrate(f: EquationsOfMotion, x: Array, u0: Array, u1: Array, h: float) -> Array:
    """(nx,): the classical Runge-Kutta method over `h` with u linear, halved until it moves by less than 1e-9."""
    coarse = _runge_kutta(f, x, u0, u1, h, 2)
    for substeps in (4, 8, 16, 32, 64):
        fine = _runge_kutta(f, x, u0, u1, h, substeps)
        if _largest(np.abs(fine - coarse)) < 1e-9:
            break
        coarse = fine
    return fine


def _runge_kutta(f: EquationsOfMotion, x: Array, u0: Array, u1: Array, h: float, substeps: int) -> Array:
    dt = h / substeps
    for i in range(substeps):
        start, middle, end = (u0 + (u1 - u0) * s / substeps for s in (i, i + 0.5, i + 1))
        k1 = f(x, start)
        k2 = f(x + dt / 2 * k1, middle)
        k3 = f(x + dt / 2 * k2, middle)
        k4 = f(x + dt * k3, end)
        x = x + dt / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return x
