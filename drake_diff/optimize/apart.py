"""A robot's links kept apart where a search that leaves contact out drives them through each other."""

import dataclasses

import numpy as np

from drake_diff.optimize.problem.obstacles import SelfCollision
from drake_diff.optimize.problem.problem import Problem


def kept_apart(problem: Problem) -> Problem:
    """`problem` in which links keep clear of each other too, but those that are near each other at its ends.

    Raises:
        ModelError: where the links are has no formula.
    """
    goal = np.array(problem.goal)
    ends = [problem.x0] + [goal] * (not np.any(np.isnan(goal[: problem.model.nq])))
    more = SelfCollision().apart_but_at(problem.model, np.nan_to_num(np.array(ends)))
    return dataclasses.replace(problem, constraints=(*problem.constraints, *more))


def is_kept_apart(problem: Problem) -> bool:
    """Whether a goal of `problem` keeps links apart already."""
    return any(isinstance(goal, SelfCollision) and goal.weight is None for goal in problem.goals)
