"""Steps, rollouts and plans as functions of arrays of a library that differentiates, such as PyTorch and JAX."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from drake_diff._base.arrays import Entries, broadcast_shapes, finite_array, number_of_steps
from drake_diff.bridges.plans import PlanArrays, PlanFunction
from drake_diff.bridges.rollouts import rollout_function
from drake_diff.exceptions import InputError, ShapeError
from drake_diff.model.model import Model
from drake_diff.motion.rollout import check_inputs
from drake_diff.optimize.problem.problem import Problem


@dataclass(frozen=True)
class Functions:
    """The functions of `drake_diff.torch` and `drake_diff.jax`, in double precision.

    Their arrays are those of the library; other numbers are converted to its arrays of float64. Leading dimensions of
    all arguments are broadcast. The derivatives are those of `differentiate_step`, `differentiate_rollout` and
    `sensitivity`, in reverse mode, without second derivatives.
    """

    array: Callable[[Any], Any]  # a value as an array of float64
    broadcast: Callable[[Any, tuple[int, ...]], Any]
    # The states (..., N+1, nx) of rollouts, or if True the ends (..., nx) of single steps, for x0, us and parameters.
    states: Callable[..., Any]
    loop: Callable[[Callable[[Any, Any], tuple[Any, Any]], Any, int], tuple[Any, Any]]  # xs and us by (x, k) -> (x, u)
    plans: Callable[..., Any]  # the arrays of plans for a PlanFunction and the values

    def step(
        self,
        model: Model,
        x: Any,
        u: Any = None,
        parameters: Mapping[str, Any] | None = None,
        *,
        method: str = "auto",
        certify: bool = False,
    ) -> Any:
        """Return the state one time step later (..., nx), as `drake_diff.step` does.

        Args:
            model: The discrete model.
            x: (..., nx) the state.
            u: (..., nu) the input [N or N m]; may be omitted if the model has no inputs.
            parameters, method, certify: See `rollout`.
        """
        named = self._arrays(parameters)
        function = rollout_function(model, tuple(named), method, bool(certify))
        u = self.array(finite_array("u", [], (model.nu,)).copy() if u is None else u)
        return self.states(function, True, *self._full(function.of_step, self.array(x), u, *named.values()))

    def rollout(
        self,
        model: Model,
        x0: Any,
        us: Any = None,
        policy: Callable[[Any, Any], Any] | None = None,
        parameters: Mapping[str, Any] | None = None,
        *,
        num_steps: int | None = None,
        method: str = "auto",
        certify: bool = False,
    ) -> tuple[Any, Any]:
        """Return the states (..., N+1, nx) and inputs (..., N, nu) of a rollout.

        Args:
            model: The discrete model.
            x0: (..., nx) the initial state.
            us: (..., N, nu) the inputs [N or N m]; may be omitted if the model has no inputs.
            policy: `policy(x, t)` (..., nu) of the states (..., nx) and the time [s], in place of `us`. The library
                differentiates it with respect to all that it depends on. JAX traces it once.
            parameters: The model's parameters (see `list_parameters`): names, and values (...) of parameters that are
                one number, or (..., n).
            num_steps: N, if `us` is not given.
            method: As in `differentiate_rollout`. With "continuous", a GradientWarning names the columns of the
                gradient without a slope.
            certify: Whether a backward pass screens the derivatives of its steps by differences. A GradientWarning
                names the steps whose verdict is not "agree". "continuous" always checks the gradient.

        Raises:
            ShapeError, NonFiniteError, UnknownNameError, InputError: An argument is invalid, or JAX uses single
                precision.
            GradientError, SimulationError: See `differentiate_rollout`. If JAX runs a compiled function, it raises its
                JaxRuntimeError with the text of this error.
        """
        named, x0 = self._arrays(parameters), self.array(x0)
        function = rollout_function(model, tuple(named), method, bool(certify))
        if policy is None:
            us = self.array(check_inputs(model, None, num_steps).copy() if us is None else us)
            full = self._full(function.of_rollout, x0, us, *named.values())
            return self.states(function, False, *full), full[1]
        if us is not None:
            raise InputError("rollout", got="us and policy", expected="one of them")
        h = named.get("model.time_step", model.time_step)

        def advance(x: Any, k: Any) -> tuple[Any, Any]:
            u = self.array(policy(x, k * h))
            full = self._full(function.of_step, x, u, *named.values())
            if full[0].shape != x.shape:
                raise ShapeError("policy", got=tuple(u.shape), expected=(*x.shape[:-1], model.nu))
            return self.states(function, True, *full), full[1]

        start, *_ = self._full({"x0": (model.nx,), **function.parameters}, x0, *named.values())
        return self.loop(advance, start, number_of_steps(num_steps))

    def solve(
        self, problem: Problem, parameters: Mapping[str, Any], *, certify: bool = False, **options: Any
    ) -> PlanArrays:
        """Return the plan of a problem for other values of its first state, its goal or model parameters.

        Args:
            problem: The problem of a model.
            parameters: Values by name: "x0" (..., nx), "goal" (..., nx), and names of the model's parameters, with
                values (...) of parameters that are one number, or (..., n). Each entry of a batch is solved.
            certify: Whether problems are solved again on both sides, see `sensitivity`. A GradientWarning names the
                derivatives whose verdict is not "agree" and, also without `certify`, those that are one-sided.
            options: Further arguments of `drake_diff.solve`.

        Returns:
            The states `xs` (..., N+1, nx), the inputs `us` (..., N, nu), the `cost` (...) and the `horizon` (...) [s].

        Raises:
            InputError, UnknownNameError, ShapeError, NonFiniteError: An argument is invalid, such as NaN in "goal".
            GradientError: A problem was not solved, or its plan has no derivative.
        """
        named = self._arrays(parameters)
        function = PlanFunction(problem, tuple(named), options, certify)
        return PlanArrays(*self.plans(function, *self._full(function.shapes, *named.values())))

    def _arrays(self, parameters: Mapping[str, Any] | None) -> dict[str, Any]:
        return {name: self.array(value) for name, value in (parameters or {}).items()}

    def _full(self, entries: Entries, *values: Any) -> list[Any]:
        """Return the named arrays with equal leading dimensions."""
        shapes = broadcast_shapes(entries, [tuple(value.shape) for value in values])
        return [self.broadcast(value, shape) for value, shape in zip(values, shapes, strict=True)]
