"""The way of a robot's centre of mass, and the forces at its feet, where it is known which of them stand when.

A quadratic program in the positions of the centre of mass at the knots and the forces at the standing points in each
step. Newton's law holds exactly; forces are in a pyramid of friction, alike, and change little from step to step; their
moment about the centre of mass is small, so that the robot keeps its turn. That moment is bilinear, so it is taken
about the way of the program before, and there are a few of them.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydrake.solvers import ClarabelSolver, MathematicalProgram

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal

ROUNDS = 3
ALIKE, CHANGE, MOMENT, NEAR = (
    1e-2,
    1.0,
    100.0,
    0.1,
)  # weights, of forces in weights of the robot and lengths in its size
EASES = 0.2  # [s] in which a point is unloaded before a slow phase without it
STEP = 0.02  # [s] of which these weights are; they are rates, so that they say the same in steps of another length
SHARES = 0.5, 0.2, 0.02  # of an even share of the weight: what a standing point carries at least; the first that can be


def plan_forces(
    mass: float,
    gravity: Array,
    time_step: float,
    start: tuple[Array, Array],
    way: Array,
    places: Array,
    stands: NDArray[np.bool_],
    friction: float,
    slow: Sequence[tuple[int, int]] = (),
) -> tuple[Array, Array] | Refusal:
    """Positions (N+1, 3) [m] of the centre of mass, and forces (N, n, 3) [N]; or why there are none.

    Args:
        mass: [kg]
        gravity: (3,) [m/s^2]
        time_step: [s]
        start: Place and velocity (3,) of the centre of mass at first.
        way: (N+1, 3) [m] what it is to be near; it ends there, at rest.
        places: (N+1, n, 3) [m] of the points.
        stands: (N, n) whether a point carries in a step.
        friction: The largest sideways force, as a part of the upright one.
        slow: First steps of phases, and of those after them, into and out of which points are unloaded bit by bit.
    """
    size = max(float(np.max(np.ptp(places[0], axis=0))) / 2, 1e-3)

    eased, unloaded = _eased(stands, slow, round(EASES / time_step))

    def rounds(least: float) -> tuple[Array, Array] | Refusal:
        plan: tuple[Array, Array] | Refusal = (np.array(way), np.zeros(0))
        for _ in range(ROUNDS):
            if isinstance(plan, Refusal):
                break
            program = _Program(mass, gravity, time_step, size, stands)
            program.follow(start, way)
            program.share(friction, least * eased)
            program.ease(unloaded)
            program.keep_turn(places, plan[0])
            plan = program.solve()
        return plan

    tried = (rounds(least) for least in SHARES)
    plan: tuple[Array, Array] | Refusal = Refusal("")
    for plan in tried:
        if not isinstance(plan, Refusal):
            break
    return plan


class _Program:
    def __init__(self, mass: float, gravity: Array, time_step: float, size: float, stands: NDArray[np.bool_]):
        self.gravity, self.h, self.size, self.stands = gravity, time_step, size, stands
        self.pull = float(np.linalg.norm(gravity)) or 1.0
        self.weight = mass * self.pull
        self.part = time_step / STEP
        self.program = MathematicalProgram()
        self.at = self.program.NewContinuousVariables(len(stands) + 1, 3)
        self.carries = np.argwhere(stands)  # (m, 2): step and point
        self.forces = self.program.NewContinuousVariables(max(len(self.carries), 1), 3)  # in weights
        self.of_step = [np.flatnonzero(self.carries[:, 0] == k) for k in range(len(stands))]

    def follow(self, start: tuple[Array, Array], way: Array) -> None:
        """Newton's law by the step's own rule, the given first state, and rest at the end of the way."""
        program, positions, h = self.program, self.at, self.h
        first, speed = start
        program.AddBoundingBoxConstraint(first, first, positions[0])
        program.AddBoundingBoxConstraint(way[-1], way[-1], positions[-1])
        program.AddLinearEqualityConstraint(
            np.hstack([np.eye(3), -np.eye(3)]), np.zeros(3), np.concatenate([positions[-1], positions[-2]])
        )
        push = -(h**2) * self.pull * np.eye(3)
        for k, carrying in enumerate(self.of_step):
            blocks, known = [np.eye(3)], h**2 * self.gravity
            variables = [positions[k + 1]]
            if k == 0:
                known = known + first + h * speed
            else:
                blocks += [-2 * np.eye(3), np.eye(3)]
                variables += [positions[k], positions[k - 1]]
            blocks += [push] * len(carrying)
            variables += [self.forces[j] for j in carrying]
            program.AddLinearEqualityConstraint(np.hstack(blocks), known, np.concatenate(variables))
        near = np.sqrt(NEAR * self.part) / self.size * np.eye(positions.size)
        program.Add2NormSquaredCost(near, near @ way.ravel(), positions.ravel())

    def share(self, friction: float, least: Array) -> None:
        """Forces within friction, upwards, alike among the points, and alike from step to step."""
        program, steps = self.program, {(int(k), int(i)): j for j, (k, i) in enumerate(self.carries)}
        sides = np.array([[1, 0, -friction], [-1, 0, -friction], [0, 1, -friction], [0, -1, -friction]])
        up, alike = -self.gravity / self.pull, np.sqrt(ALIKE * self.part) * np.eye(3)
        change = np.sqrt(CHANGE / self.part) * np.hstack([np.eye(3), -np.eye(3)])
        for (k, i), j in steps.items():
            force, share = self.forces[j], 1 / len(self.of_step[k])
            program.AddLinearConstraint(sides, np.full(4, -np.inf), np.zeros(4), force)
            program.AddBoundingBoxConstraint(least[k, i] * share, np.inf, force[2])
            program.Add2NormSquaredCost(alike, alike @ (share * up), force)
            before = steps.get((k - 1, i))
            if before is not None:
                program.Add2NormSquaredCost(change, np.zeros(3), np.concatenate([force, self.forces[before]]))

    def ease(self, unloaded: NDArray[np.bool_]) -> None:
        """Forces that come from nothing, or go to it, where that is so of a point (N, n)."""
        change = np.sqrt(CHANGE / self.part) * np.eye(3)
        for j, (k, i) in enumerate(self.carries):
            if unloaded[k, i]:
                self.program.Add2NormSquaredCost(change, np.zeros(3), self.forces[j])

    def keep_turn(self, places: Array, way: Array) -> None:
        """No moment about the way (N+1, 3) of the centre of mass, as nearly as may be."""
        for k, carrying in enumerate(self.of_step):
            if len(carrying):
                arms = (places[k, self.carries[carrying, 1]] - way[k]) / self.size
                moment = np.sqrt(MOMENT * self.part) * np.hstack([_cross(arm) for arm in arms])
                self.program.Add2NormSquaredCost(moment, np.zeros(3), self.forces[carrying].ravel())

    def solve(self) -> tuple[Array, Array] | Refusal:
        if not len(self.carries):
            self.program.AddBoundingBoxConstraint(0.0, 0.0, self.forces)
        result = ClarabelSolver().Solve(self.program)
        if not result.is_success():
            return Refusal("no forces of its feet, within friction, bring its centre of mass to where it is to end")
        forces = np.zeros((*self.stands.shape, 3))
        forces[self.stands] = self.weight * np.asarray(result.GetSolution(self.forces))[: len(self.carries)]
        return np.asarray(result.GetSolution(self.at)), forces


def _eased(stands: NDArray[np.bool_], slow: Sequence[tuple[int, int]], steps: int) -> tuple[Array, NDArray[np.bool_]]:
    """(N, n) parts of the least share; and whether a step is a point's last before a slow phase, or its first after."""
    shares, last = np.ones(stands.shape), np.zeros(stands.shape, dtype=bool)
    for a, b in slow:
        leaves, lands = stands[a - 1] & ~stands[a], stands[b] & ~stands[b - 1]
        last[a - 1, leaves] = last[b, lands] = True
        for i in range(steps):
            if a - 1 - i >= 0:
                shares[a - 1 - i, leaves] = np.minimum(shares[a - 1 - i, leaves], i / steps)
            if b + i < len(stands):
                shares[b + i, lands] = np.minimum(shares[b + i, lands], i / steps)
    return shares, last


def _cross(arm: Array) -> Array:
    """(3, 3): arm x."""
    x, y, z = arm
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
