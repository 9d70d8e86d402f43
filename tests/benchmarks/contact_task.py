"""A task with contact, as `contact_plans.py` runs it. Its MODULES, such as `legged_tasks.py`, make such tasks.

Each module has `TASKS`, which maps names to functions that take a random generator and return a Task. The start is
random, and the initial guess is None or a naive guess.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import drake_diff as dd

Ask = tuple[str, Callable[[np.ndarray, np.ndarray], float], float]  # name, (xs, us) -> miss, allowed miss


@dataclass(frozen=True)
class Task:
    """A problem with `options`, the keywords of `dd.solve`, and `asks`, the requirements beyond the input limits.

    `build` returns Drake's (plant, diagram) for a time step, 0 for continuous time, or is None if the model's own plant
    is used. If `falls`, a change of 1e-12 leads to another motion, as for a biped on one foot. Such a plan is measured
    step by step.
    """

    name: str
    problem: dd.Problem
    goal_text: str
    options: dict[str, Any] = field(default_factory=dict)
    asks: tuple[Ask, ...] = ()
    build: Callable[[float], Any] | None = None
    falls: bool = False


Tasks = dict[str, Callable[[np.random.Generator], Task]]
