"""Certificates of the derivatives that a collocation gets: at some knots, against differences of the equations."""

from functools import partial
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.certificates.certificate import Certificate, certify_jacobian
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.optimize.problem.dynamics import DiscreteMap
from drake_diff.optimize.problem.problem import Problem

CERTIFIED_KNOTS = 5


def certified_knots(us: Array) -> Array:
    """The knots, out of those of us (N, nu), at which derivatives are certified."""
    return np.unique(np.linspace(0, len(us) - 1, CERTIFIED_KNOTS).astype(int))


def certify_equations(problem: Problem, jacobian: Any, xs: Array, us: Array) -> tuple[Certificate, ...]:
    """Certificates, at some knots, of the Jacobian that the solver gets against the equations themselves."""
    system, is_map = problem.system, problem.is_map
    values = EquationsOfMotion(problem.model).values if problem.has_model else problem.dynamics.values
    return tuple(
        certify_jacobian(
            system.at_step(int(k)).values if isinstance(system, DiscreteMap) else values,
            np.concatenate([xs[k], us[k]]),
            partial(jacobian, k=int(k)) if is_map else jacobian,
            batched=True,
            rows=tuple(f"next {name}" if is_map else f"d({name})/dt" for name in problem.state_names),
            columns=problem.state_names + problem.input_names,
            method="discrete map" if is_map else "continuous time",
            subject=f"the map of {problem.name}" if is_map else f"the equations of motion of {problem.name}",
        )
        for k in certified_knots(us)
    )
