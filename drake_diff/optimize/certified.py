"""Certificates of the derivatives that a collocation gets: at some knots, against differences of the equations."""

from functools import partial
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.certificates.certificate import Certificate, certify_jacobian
from drake_diff.certificates.directions import LookAt, certificate_by
from drake_diff.model.equations import EquationsOfMotion
from drake_diff.optimize.problem.dynamics import DiscreteMap
from drake_diff.optimize.problem.problem import SMALLEST_RANGE, Problem
from drake_diff.optimize.transcription.task import OptimalControl

FIRST_KNOTS, BENDS = 3, 3  # of a guess; of a result, beside its first and last knot


def first_knots(us: Array) -> Indices:
    """The knots, out of those of us (N, nu), at which the derivatives at a guess are certified."""
    return np.unique(np.linspace(0, len(us) - 1, FIRST_KNOTS).astype(np.intp))


def telling_knots(xs: Array) -> Indices:
    """The knots of the motion xs (N+1, nx) at which derivatives are certified: both ends, and where it bends most.

    Forces change there: touches begin or end, or an input switches.
    """
    count = len(xs) - 1
    bends = np.abs(np.diff(xs, n=2, axis=0)) / np.maximum(np.ptp(xs, axis=0), SMALLEST_RANGE)
    knots = 1 + np.argsort(-np.max(bends, axis=1, initial=0.0), kind="stable")[:BENDS]
    return np.unique([0, *knots.tolist(), count - 1]).astype(np.intp)


def certify_equations(
    problem: Problem,
    jacobian: Any,
    xs: Array,
    us: Array,
    task: OptimalControl | None = None,
    *,
    knots: Indices | None = None,
) -> tuple[Certificate, ...]:
    """Certificates, at `knots`, of the Jacobian that the solver gets against the equations themselves.

    Without them, at those that tell most of the motion.

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
    named: dict[str, Any] = {
        "rows": tuple(f"next {name}" if is_map else f"d({name})/dt" for name in problem.state_names),
        "columns": problem.state_names + problem.input_names + names,
        "method": "discrete map" if is_map else "continuous time",
        "subject": f"the map of {problem.name}" if is_map else f"the equations of motion of {problem.name}",
    }
    certificates = []
    for k in (telling_knots(xs[: len(us) + 1]) if knots is None else knots).tolist():
        knot = np.concatenate([xs[k], us[k]])
        point, scale = np.concatenate([knot, tail]), np.concatenate([np.maximum(1.0, np.abs(knot)), sizes])
        f = system.at_step(k).values if isinstance(system, DiscreteMap) else values
        derivative = partial(jacobian, k=k) if is_map else jacobian
        plan = LookAt(np.asarray(derivative(point), dtype=float) * scale)
        look = plan.taken(np.asarray(f(point + scale * plan.displacements), dtype=float))
        if look.doubt():
            certificates.append(certify_jacobian(f, point, derivative, batched=True, scale=scale, **named))
        else:
            certificates.append(certificate_by(look, scale=scale, told="", **named))
    return tuple(certificates)
