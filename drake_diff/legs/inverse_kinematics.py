"""Postures by Drake's `InverseKinematics`: points where they are to be, all else as near as may be to a posture."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.multibody.inverse_kinematics import (
    AddMultibodyPlantConstraints,
    ComPositionConstraint,
    PositionConstraint,
    PositionCost,
)
from pydrake.solvers import MathematicalProgram, SnoptSolver, SolverOptions

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError
from drake_diff.model.model import Model
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

OPTIONS = SolverOptions()
OPTIONS.SetOption(SnoptSolver.id(), "Major iterations limit", 200)
OPTIONS.SetOption(SnoptSolver.id(), "Major feasibility tolerance", 1e-9)


@dataclass(frozen=True, eq=False)
class Target:
    """Where a point (3,) [m] of a frame of the twin's plant is to be: `position` (3,) [m], NaN where anywhere will do.

    `tolerance` [m] is how far it may be from there, a number or (3,), infinite where it is only to be near; `unit` [m]
    of what is off counts as 1, infinite where nothing counts.
    """

    frame: Any
    point: ArrayLike
    position: ArrayLike
    tolerance: ArrayLike
    unit: ArrayLike = np.inf


@dataclass(frozen=True, eq=False)
class Wish:
    """What a posture is to be near, where that is possible.

    Attributes:
        q: (nq,) a posture.
        unit: (nv,) of the tangent space, how far from q counts as 1 of each coordinate; infinite where it is free.
        center_of_mass: (3,) [m] where the centre of mass is to be, NaN where anywhere will do; None everywhere.
        balance: [m] how far from there counts as 1.
    """

    q: Array
    unit: Array
    center_of_mass: ArrayLike | None = None
    balance: float = 1.0


def inverse_kinematics(
    model: Model, first: Array, targets: Sequence[Target], wish: Wish, lower: Array, upper: Array
) -> Array:
    """The posture (nq,) that has the points at their targets and is nearest to a wish, by SNOPT from `first` (nq,).

    It is within the limits of the plant and `lower` and `upper` (nq,), and keeps the constraints of the plant: loops
    that are closed, joints that follow others. Where there is none, it is what the search ended at: look how far its
    points are off. The twin is left in it.
    """
    twin, program = model.double, MathematicalProgram()
    plant, context, world, coupling = twin.plant, twin.context, twin.plant.world_frame(), twin.coupling
    every = program.NewContinuousVariables(plant.num_positions(), "q")
    try:
        AddMultibodyPlantConstraints(plant, every, program, context)
    except RuntimeError as error:
        raise ModelError(f"no inverse kinematics of {model.name}: {error}") from error
    q = every if coupling is None else every[coupling.own_q]
    program.AddBoundingBoxConstraint(lower, upper, q)
    for target in targets:
        position = np.nan_to_num(target.position)
        reach = np.where(np.isnan(target.position), np.inf, target.tolerance)
        bounds = position - reach, position + reach
        program.AddConstraint(PositionConstraint(plant, world, *bounds, target.frame, target.point, context), every)
        if np.any(np.isfinite(target.unit)):
            counts = np.diag(np.broadcast_to(target.unit, 3) ** -2.0)
            program.AddCost(PositionCost(plant, world, position, target.frame, target.point, counts, context), every)
    goal, weight = _nearness(model, first, wish)
    costs, start = [(q, goal, weight)], first if coupling is None else coupling.positions(first)
    if wish.center_of_mass is not None:
        center = program.NewContinuousVariables(3, "center of mass")
        program.AddConstraint(ComPositionConstraint(plant, None, world, context), np.append(every, center))
        over = np.asarray(wish.center_of_mass, dtype=float)
        costs.append((center, np.nan_to_num(over), np.where(np.isnan(over), 0.0, wish.balance**-2.0)))
        plant.SetPositions(context, start)
        start = np.append(start, plant.CalcCenterOfMassPositionInWorld(context))
    for variables, middle, weights in costs:
        program.AddQuadraticErrorCost(np.diag(weights), middle, variables)
        for variable, counts in zip(variables, weights, strict=True):
            if counts > 0:
                program.SetVariableScaling(variable, counts**-0.5)  # so that the cost's second derivative is even
    result = SnoptSolver().Solve(program, start, OPTIONS)
    posture = np.array(result.GetSolution(q))
    set_state(twin, np.append(posture, np.zeros(model.nv)))
    return posture


def miss(model: Model, targets: Sequence[Target]) -> float:
    """[m] how far the points are from their targets in the twin's state beyond the tolerance, at most."""
    off = [0.0]
    for target in targets:
        there = target.frame.CalcPoseInWorld(model.double.context).multiply(target.point)
        off += np.nan_to_num(np.abs(there - target.position) - target.tolerance, neginf=0.0).tolist()
    return max(off)


def _nearness(model: Model, first: Array, wish: Wish) -> tuple[Array, Array]:
    """(nq,) twice: what each coordinate is to be near, a quaternion on the side of `first`, and how much it counts."""
    goal, starts = np.array(wish.q), tangent_space(model).quaternions
    weight = np.array([wish.unit[i - int(np.searchsorted(starts, i))] for i in range(model.nq)]) ** -2.0
    for number, start in enumerate(starts):
        turn = slice(start, start + 4)
        goal[turn] *= -1.0 if goal[turn] @ first[turn] < 0 else 1.0
        weight[turn] = (2 / wish.unit[start - number]) ** 2  # a unit quaternion changes by half of its body's turn
    return goal, weight
