"""Lines of postures that touch nothing: straight, bent, and around what is in the way by a search at random.

The search is OMPL's RRT-Connect, since Drake has no planner that samples postures. It only makes first guesses: what
they lead to is checked as any other plan.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
from pydrake.math import BsplineBasis
from pydrake.trajectories import BsplineTrajectory

from drake_diff._base.arrays import Array
from drake_diff.exceptions import MissingDependencyError
from drake_diff.optimize.problem.obstacles import ClearanceConstraint, Obstacle, clearances
from drake_diff.planning.posture import TOUCHING
from drake_diff.planning.robot import Robot

BENDS = 100  # lines bent at random that are looked at
WIDTH = 0.4  # of a joint's range: how far such a line is pulled off the middle, at most
KEPT = 2  # lines of a kind
NEAR = 0.04  # [rad or m] between the postures of a line that are looked at
SEARCHES = 3
MOST_LOOKS = 20_000  # at postures, in one search
LONGEST_LEG = 0.6  # [rad or m] that a search adds at once
CONTROLS = (8, 12, 20, 40)  # of a curve along what a search found: the fewest that keep it clear
CUBIC = 4  # the order of such a curve


@dataclass(frozen=True, eq=False)
class Space:
    """Where a robot may be: where its shapes do not overlap, and where it keeps clear of obstacles."""

    robot: Robot
    kept: tuple[ClearanceConstraint, ...]

    @classmethod
    def of(cls, robot: Robot, avoid: Sequence[Obstacle]) -> "Space":
        """That of a robot and what it avoids."""
        return cls(robot, tuple(clearances([c for obstacle in avoid for c in obstacle.bind(robot.model)])))

    def lacking(self, qs: Array) -> Array:
        """(K,) [m] what is used of an obstacle's margin at postures qs (K, nq), at most; below 0 where none is."""
        xs = np.hstack([qs, np.zeros((len(qs), self.robot.model.nv))])
        return np.asarray(np.max([np.full(len(qs), -np.inf), *(c.lacking(xs) for c in self.kept)], axis=0))

    def is_free(self, qs: Array) -> bool:
        """Whether the robot may be in all of the postures qs (K, nq)."""
        return bool(np.max(self.lacking(qs)) <= 0) and all(self.robot.overlap(q) <= TOUCHING for q in qs)

    def check(self, subject: str, q: Array) -> None:
        """InputError where posture q (nq,) is too near to an obstacle."""
        for c in self.kept:
            c.check(subject, np.concatenate([q, np.zeros(self.robot.model.nv)]))

    def told(self, q: Array) -> str:
        """What is too near to an obstacle at posture q (nq,); "" where nothing is."""
        x = np.concatenate([q, np.zeros(self.robot.model.nv)])
        worst = max(self.kept, key=lambda c: float(c.lacking(x[None])[0]), default=None)
        return (
            str(worst.check_at(x, "that posture", 0.0)) if worst is not None and worst.lacking(x[None])[0] > 0 else ""
        )


@dataclass(frozen=True, eq=False)
class Line:
    """A curve of postures: a clamped B-spline by its control points (K, nq), the first and last of which it meets."""

    name: str
    controls: Array

    def at(self, s: Array) -> Array:
        """(M, nq) at s (M,), from 0 at the start to 1 at the end."""
        return np.asarray(self._curve().vector_values(s)).T

    def slopes(self, s: Array) -> Array:
        """(M, nq) its derivatives by s."""
        return np.asarray(self._curve().MakeDerivative().vector_values(s)).T

    def _curve(self) -> BsplineTrajectory:
        count = len(self.controls)
        return BsplineTrajectory(BsplineBasis(min(count, CUBIC), count), [c[:, None] for c in self.controls])

    @property
    def length(self) -> float:
        """[rad or m] that of its control points' chain, the largest coordinate of each piece."""
        return float(np.sum(np.max(np.abs(np.diff(self.controls, axis=0)), axis=1)))

    @property
    def postures(self) -> Array:
        """(M, nq) near each other, from the first to the last."""
        return self.at(np.linspace(0, 1, 2 + int(np.ceil(self.length / NEAR))))


def lines(space: Space, target: Array, seed: int) -> list[Line]:
    """Lines from where the robot starts to `target` (nq,), the best first.

    The straight one if it is clear; else the shortest bent ones that are, and of those that searches find; else the
    straight one, for a solver to push out of the way. MissingDependencyError where only a search could help, without
    OMPL.
    """
    robot = space.robot
    straight = Line("a straight line in the joints", np.array([robot.q, target]))
    if space.is_free(straight.postures):
        return [straight]
    random = np.random.default_rng([seed, 3])
    can_search, candidates = find_spec("ompl") is not None, []
    bent = "a bent line" if can_search else "a bent line (no search: ompl is not installed)"
    for i in range(BENDS):
        pull = WIDTH * (i + 1) / BENDS * random.uniform(-1, 1, len(target)) * (robot.upper - robot.lower)
        middle = np.clip((robot.q + target) / 2 + pull, robot.lower, robot.upper)
        line = Line(bent, np.array([robot.q, middle, target]))
        if space.is_free(line.postures):
            candidates.append(line)
    if not (can_search or candidates):
        raise MissingDependencyError("a way around what is in the way needs a search: pip install ompl")
    searched = [_searched(space, target, seed + i) for i in range(SEARCHES if can_search else 0)]
    candidates += [line for line in searched if line is not None]
    return sorted(candidates, key=lambda line: line.length)[:KEPT] or [straight]


def _searched(space: Space, target: Array, seed: int) -> Line | None:
    """Around what is in the way, by RRT-Connect; None where it finds nothing.

    Source: Kuffner and LaValle, "RRT-Connect: an efficient approach to single-query path planning", 2000.
    """
    chain = _chain(space, target, seed)
    if chain is None:
        return None
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(chain, axis=0), axis=1))])
    for count in CONTROLS:
        knots = np.array(BsplineBasis(CUBIC, count).knots())
        even = along[-1] * np.array([np.mean(knots[i + 1 : i + CUBIC]) for i in range(count)])  # of an even speed
        line = Line("a way around by a search", np.array([np.interp(even, along, column) for column in chain.T]).T)
        if space.is_free(line.postures):
            return line
    return None


def _chain(space: Space, target: Array, seed: int) -> Array | None:
    """(K, nq) postures from the start to `target`, the straight lines between which are clear; None without any."""
    from ompl import base, geometric, util

    robot, looks = space.robot, 0
    start, size = robot.q, len(target)

    def values(state: Any) -> Array:
        return np.array(state[0:size])

    def is_free(qs: Array) -> bool:
        nonlocal looks
        looks += len(qs)
        return space.is_free(qs)

    def is_over() -> bool:
        nonlocal looks
        looks += 1
        return looks > MOST_LOOKS

    class Lines(base.MotionValidator):  # type: ignore[misc]
        def checkMotion(self, a: Any, b: Any) -> bool:
            ends = np.array([values(a), values(b)])
            return is_free(Line("", ends).postures)

    level = util.getLogLevel()
    util.setLogLevel(util.LOG_NONE)
    try:
        util.RNG.setSeed(seed + 1)  # 0 is no seed
        limits = base.RealVectorBounds(size)
        for i, ends in enumerate(zip(robot.lower, robot.upper, start, target, strict=True)):
            limits.setLow(i, min(ends))
            limits.setHigh(i, max(ends))
        states = base.RealVectorStateSpace(size)
        states.setBounds(limits)
        information = base.SpaceInformation(states)
        information.setStateValidityChecker(lambda state: is_free(values(state)[None]))
        information.setMotionValidator(Lines(information))
        information.setup()
        first, last = information.allocState(), information.allocState()
        first[0:size], last[0:size] = start.tolist(), target.tolist()
        asked = base.ProblemDefinition(information)
        asked.setStartAndGoalStates(first, last)
        planner = geometric.RRTConnect(information)
        planner.setRange(LONGEST_LEG)
        planner.setProblemDefinition(asked)
        planner.setup()
        planner.solve(base.PlannerTerminationCondition(is_over))
        path = asked.getSolutionPath() if asked.hasExactSolution() else None
        if path is None:
            return None
        geometric.PathSimplifier(information).simplify(path, base.PlannerTerminationCondition(is_over))
        return np.array([values(path.getState(i)) for i in range(path.getStateCount())])
    finally:
        util.setLogLevel(level)
