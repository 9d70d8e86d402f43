"""Certify the derivatives of many steps: along a few directions first, entry by entry where these leave a doubt."""

from dataclasses import dataclass, replace

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.certificates.certificate import Certificate
from drake_diff.certificates.certify import (
    LEAP,
    SHARED,
    StepAround,
    beside_limits,
    certify_inside,
    differences_of_solved,
    in_steps,
    leap_at_limits,
    solver_tolerance,
    state_scale,
    with_room,
)
from drake_diff.certificates.first_look import FirstLook, LookAt, certificate_by
from drake_diff.certificates.neighbourhood import is_broken
from drake_diff.derivatives.polish import polished_steps
from drake_diff.derivatives.sources import step_at
from drake_diff.derivatives.step import StepDerivatives, derivatives_along
from drake_diff.exceptions import SimulationError
from drake_diff.model.model import Model
from drake_diff.model.parameters import Parameters, ParameterVector, applied, select
from drake_diff.model.tangent import tangent_space


def certify_steps(model: Model, xs: Array, us: Array, *, parameters: Parameters = ()) -> tuple[Certificate, ...]:
    """`certify_inside` at each of xs (N, nx) and us (N, nu), by a first look where that leaves no doubt.

    The derivatives are taken in one call, as by a search, and so are the steps along the directions of all points.
    What is in doubt is looked at as it is, not taken anew.
    """
    inside = with_room(model, us)
    found = []
    for x, u, within, look in zip(xs, us, inside, first_looks(model, xs, inside, parameters), strict=True):
        sure = look.certificate
        at_limit = within != u
        if sure is not None and at_limit.any():
            leap = leap_at_limits(model, x, u, np.sign(within - u), parameters)
            if np.any(np.abs(leap) > LEAP * sure.size):
                sure = None
            else:
                sure = replace(sure, told=f"{sure.told}; {beside_limits(model, at_limit)}")
        if sure is None:
            sure = certify_inside(model, x, u, parameters=parameters, derivatives=look.derivatives)
        found.append(sure)
    return tuple(found)


@dataclass(frozen=True, eq=False)
class StepLook:
    """A step along a few directions: its certificate, or why every entry has to be looked at."""

    step: StepAround
    derivatives: StepDerivatives
    look: FirstLook | None  # None where the steps are not known to rounding
    left: float  # what Drake's own leave of the momentum
    doubt: str

    @property
    def certificate(self) -> Certificate | None:
        """That the derivative is the step's; None where that is in doubt."""
        if self.look is None or self.doubt:
            return None
        d, model, names = self.derivatives, self.step.model, self.step.space.names
        solved = differences_of_solved(self.left) if self.left >= 0 else ""
        shared = SHARED if "finite_difference" in (d.method, *d.sources) else ""
        return certificate_by(
            self.look,
            scale=self.step.scale,
            rows=names,
            columns=names + model.input_names + self.step.vector.names,
            told="; ".join(text for text in (solved, shared) if text),
            method=" + ".join(dict.fromkeys((d.method, *d.sources))),
            subject=f"the step of {model.name}",
        )


def first_looks(model: Model, xs: Array, us: Array, parameters: Parameters) -> list[StepLook]:
    """Each of the steps from xs (N, nx) under us (N, nu) along a few directions, as `looks` takes them."""
    vector = select(model, parameters)
    with applied(vector) as model:
        space = tangent_space(model)
        derivatives = derivatives_along(model, xs[0], us, vector=vector, xs=xs)
        steps, plans = [], []
        for x, u, d in zip(xs, us, derivatives, strict=True):
            scale = np.concatenate([state_scale(space, x), np.maximum(1.0, np.abs(u)), vector.difference_scale()])
            steps.append(StepAround(model, vector, space, np.concatenate([x, u, vector.values]), scale))
            derivative = space.jacobian(x, d.x_next, d.A, d.B, d.C) * scale
            plans.append(LookAt(derivative, in_steps(model, space, len(scale))))
        every = zip(steps, derivatives, looks(steps, plans), strict=True)
        return [StepLook(step, d, *found) for step, d, found in every]


Looked = tuple[FirstLook | None, float, str]  # as in a StepLook


def looks(steps: list[StepAround], plans: list[LookAt]) -> list[Looked]:
    """What the steps, all of one model, do at the `plans`; what Drake's own leave, and the doubt.

    A step in doubt is looked at once more, nearer to the point.
    """
    found = _taken(steps, plans)
    for k, (step, (look, _, doubt)) in enumerate(zip(steps, found, strict=True)):
        if look is not None and doubt:
            nearer = _look_nearer(step, look)
            found[k] = found[k] if nearer[2] else nearer
    return found


def _taken(steps: list[StepAround], plans: list[LookAt]) -> list[Looked]:
    first, nx = steps[0], steps[0].model.nx
    xs, us = (np.array([step.point[part] for step in steps]) for part in (slice(nx), slice(nx, nx + first.model.nu)))
    points = [np.array([step.moved(d) for d in plan.displacements]) for step, plan in zip(steps, plans, strict=True)]
    try:
        ends = ends_around(first.model, first.vector, xs, us, points)
    except SimulationError as error:  # of one of them, which its certificate tells
        ends = [(np.zeros(0), -1.0, str(error))] * len(points)
    found = list[Looked]()
    for plan, (values, left, why) in zip(plans, ends, strict=True):
        look = None if why else plan.taken(values, first.space.minus)
        found.append((look, left, why if look is None else look.doubt()))
    return found


def _look_nearer(step: StepAround, look: FirstLook) -> Looked:
    """`looks` over a tenth of the widths, where a contact that begins or slides a little farther away is not met.

    Stairs that are longer than these are met there neither, nor is a corner by a column of small weight: they are
    sought along a line, as by a look at every entry.
    """
    plan = LookAt(look.derivative, look.second, nearer=True)
    ((near, left, doubt),) = _taken([step], [plan])
    if near is None or doubt:
        return near, left, doubt
    row, nx, end = step.point[None], step.model.nx, step.model.nx + step.model.nu

    def changes(displacements: Array) -> Array:
        points = np.array([step.point, *[step.moved(d) for d in displacements]])
        ((ends, _, why),) = ends_around(step.model, step.vector, row[:, :nx], row[:, nx:end], [points])
        if why:
            raise SimulationError(why)
        return np.array([step.space.minus(each, ends[0]) for each in ends[1:]])

    try:
        return near, left, is_broken(changes, len(step.scale))
    except SimulationError as error:
        return near, left, str(error)


def ends_around(
    model: Model, vector: ParameterVector, xs: Array, us: Array, points: list[Array]
) -> list[tuple[Array, float, str]]:
    """Where the steps lead from each of `points` (p, nx + nu + np), the first of which is that of xs and us; with what
    Drake's own leave of the momentum, negative where nothing is solved for; and why they are not known to rounding.

    They leave what Drake's own leaves at the first point, so that they begin there.
    """
    nx, end = model.nx, model.nx + model.nu
    found: list[tuple[Array, float, str]] = [(np.zeros(0), -1.0, "")] * len(points)
    solved = [k for k, (x, u) in enumerate(zip(xs, us, strict=True)) if solver_tolerance(model, x, u)]
    for k in set(range(len(points))).difference(solved):
        ends = [step_at(model, vector, at[:nx], at[nx:end], at[end:]) for at in points[k]]
        found[k] = (np.array(ends), -1.0, "")
    if not solved:
        return found
    first = np.array([points[k][0] for k in solved])
    here = polished_steps(model, vector, first[:, :nx], first[:, nx:end], first[:, end:])
    every, counts = np.vstack([points[k] for k in solved]), [len(points[k]) for k in solved]
    held = np.repeat(np.nan_to_num(here.missing), counts, axis=0)
    there = polished_steps(model, vector, every[:, :nx], every[:, nx:end], every[:, end:], held)
    begins = np.cumsum([0, *counts])
    for i, k in enumerate(solved):
        part = slice(int(begins[i]), int(begins[i + 1]))
        whys = [str(why) for at, why in there.refused.items() if part.start <= at < part.stop]
        found[k] = (there.x_next[part], float(np.max(there.left[part])), whys[0] if whys else "")
    return found
