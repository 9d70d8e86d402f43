"""Certificates of the derivatives that a collocation gets: at some knots, against differences of the equations."""

from functools import partial
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.certificates.certificate import Certificate, certify_jacobian
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.optimize.problem.dynamics import DiscreteMap
from drake_diff.optimize.problem.problem import Problem
from drake_diff.optimize.transcription.task import OptimalControl

CERTIFIED_KNOTS = 5


def certified_knots(us: Array) -> Array:
    """The knots, out of those of us (N, nu), at which derivatives are certified."""
    return np.unique(np.linspace(0, len(us) - 1, CERTIFIED_KNOTS).astype(int))


def certify_equations(
    problem: Problem, jacobian: Any, xs: Array, us: Array, task: OptimalControl | None = None
) -> tuple[Certificate, ...]:
    """Certificates, at some knots, of the Jacobian that the solver gets against the equations themselves.

    Where parameters are optimized it has columns by their coordinates, near those of `task`, a collocation's.
    """
    system, is_map, tail, sizes, names = problem.system, problem.is_map, np.zeros(0), np.zeros(0), ()
    if task is not None and task.varied is not None:
        values, names = task.varied.values, problem.parameters.names
        tail, sizes = task.varied.tried_at(task.coordinates)
    elif problem.has_model and not problem.parameters.parameters:
        values = EquationsOfMotion(problem.model).values
    else:
        values = problem.dynamics.values
    knots = {int(k): np.concatenate([xs[k], us[k]]) for k in certified_knots(us)}
    return tuple(
        certify_jacobian(
            system.at_step(k).values if isinstance(system, DiscreteMap) else values,
            np.concatenate([knot, tail]),
            partial(jacobian, k=k) if is_map else jacobian,
            batched=True,
            rows=tuple(f"next {name}" if is_map else f"d({name})/dt" for name in problem.state_names),
            columns=problem.state_names + problem.input_names + names,
            method="discrete map" if is_map else "continuous time",
            subject=f"the map of {problem.name}" if is_map else f"the equations of motion of {problem.name}",
            scale=np.concatenate([np.maximum(1.0, np.abs(knot)), sizes]),
        )
        for k, knot in knots.items()
    )
