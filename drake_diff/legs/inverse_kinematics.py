"""Inverse kinematics with Drake's kinematic constraints and SNOPT."""

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
from pydrake.solvers import MathematicalProgram, SnoptSolver, SolutionResult, SolverOptions

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError
from drake_diff.model.model import Model
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

OPTIONS = SolverOptions()
OPTIONS.SetOption(SnoptSolver.id(), "Major iterations limit", 200)
OPTIONS.SetOption(SnoptSolver.id(), "Major feasibility tolerance", 1e-9)


@dataclass(frozen=True, eq=False)
class PointTarget:
    """The target position (3,) [m] in the world of a point (3,) [m] of a frame. NaN leaves a coordinate free.

    `tolerance` [m], a number or (3,), bounds the distance; infinity bounds nothing. The cost is (distance / `unit`)^2,
    with `unit` in [m]; infinity means no cost.
    """

    frame: Any
    point: ArrayLike
    position: ArrayLike
    tolerance: ArrayLike
    unit: ArrayLike = np.inf


@dataclass(frozen=True, eq=False)
class Wish:
    """The cost of a posture: the squared distance from a nominal posture, and of the centre of mass from a position.

    Attributes:
        q: (nq,) the nominal posture.
        unit: (nv,) in the tangent space, the distance from q that costs 1; infinite for a free coordinate.
        center_of_mass: (3,) [m] its target position, NaN for a free coordinate; None for no such cost.
        balance: [m] the distance from that position that costs 1.
    """

    q: Array
    unit: Array
    center_of_mass: ArrayLike | None = None
    balance: float = 1.0


def inverse_kinematics(
    model: Model, first: Array, targets: Sequence[PointTarget], wish: Wish, lower: Array, upper: Array
) -> Array:
    """Return the posture (nq,) of least cost with the points at their targets, by SNOPT from the posture `first` (nq,).

    It satisfies the joint limits `lower` and `upper` (nq,), closed loops and mimic joints. If no such posture exists,
    the last iterate is returned, and `miss` measures its error. The double plant of the model is left in this posture.
    Raises ModelError if Drake cannot express a constraint of the plant.
    """
    twin, program = model.double, MathematicalProgram()
    plant, context, world, coupling = twin.plant, twin.context, twin.plant.world_frame(), twin.coupling
    every = program.NewContinuousVariables(plant.num_positions(), "q")
    try:
        AddMultibodyPlantConstraints(plant, every, program, context)
    except RuntimeError as error:
        raise ModelError(f"inverse kinematics does not support {model.name}: {error}") from error
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
    costs = [(q, goal, weight)]
    if wish.center_of_mass is not None:
        center = program.NewContinuousVariables(3, "center of mass")
        program.AddConstraint(ComPositionConstraint(plant, None, world, context), np.append(every, center))
        over = np.asarray(wish.center_of_mass, dtype=float)
        costs.append((center, np.nan_to_num(over), np.where(np.isnan(over), 0.0, wish.balance**-2.0)))
    for variables, middle, weights in costs:
        program.AddQuadraticErrorCost(np.diag(weights), middle, variables)
        for variable, counts in zip(variables, weights, strict=True):
            if counts > 0:
                program.SetVariableScaling(variable, counts**-0.5)  # scales the cost to a uniform second derivative
    for start in (first, goal):  # numerical difficulties, such as a singular basis, usually belong to a single start
        plant.SetPositions(context, start if coupling is None else coupling.positions(start))
        guess = [*plant.GetPositions(context), *plant.CalcCenterOfMassPositionInWorld(context)]
        result = SnoptSolver().Solve(program, np.array(guess[: program.num_vars()]), OPTIONS)
        if result.get_solution_result() != SolutionResult.kSolverSpecificError:
            break
    posture = np.array(result.GetSolution(q))
    set_state(twin, np.append(posture, np.zeros(model.nv)))
    return posture


def miss(model: Model, targets: Sequence[PointTarget]) -> float:
    """Return the largest distance [m] of a point from its target beyond the tolerance, in the double plant's state."""
    off = [0.0]
    for target in targets:
        there = target.frame.CalcPoseInWorld(model.double.context).multiply(target.point)
        off += np.nan_to_num(np.abs(there - target.position) - target.tolerance, neginf=0.0).tolist()
    return max(off)


def _nearness(model: Model, first: Array, wish: Wish) -> tuple[Array, Array]:
    """Return (nq,) the nominal coordinates, with quaternions on the side of `first`, and (nq,) their weights."""
    goal, starts = np.array(wish.q), tangent_space(model).quaternions
    weight = np.array([wish.unit[i - int(np.searchsorted(starts, i))] for i in range(model.nq)]) ** -2.0
    for number, start in enumerate(starts):
        turn = slice(start, start + 4)
        goal[turn] *= -1.0 if goal[turn] @ first[turn] < 0 else 1.0
        weight[turn] = (2 / wish.unit[start - number]) ** 2  # a unit quaternion changes by half of its body's rotation
    return goal, weight
