"""One task with contact, as `contact_plans.py` runs it; its MODULES, such as `legged_tasks.py`, build them.

Each of these modules has `TASKS`, a name -> a function of a random generator that gives a Task: the start is drawn,
and the guess is none or a naive one.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import drake_diff as dd

Ask = tuple[str, Callable[[np.ndarray, np.ndarray], float], float]  # name, (xs, us) -> miss, allowed


@dataclass(frozen=True)
class Task:
    """`options` are keywords of `dd.solve`; `asks` are all that a referee measures, the goal too, besides input limits.

    `schedule` is what Crocoddyl needs to be told, None where it cannot express the task; `build` gives Drake's
    (plant, diagram) at a time step, 0 for continuous, None where the model's own file gives it. What `falls` goes
    another way from a change of 1e-12, as a biped does on one foot: its plan is measured step by step.
    """

    name: str
    problem: dd.Problem
    goal_text: str
    options: dict[str, Any] = field(default_factory=dict)
    asks: tuple[Ask, ...] = ()
    schedule: Any = None
    build: Callable[[float], Any] | None = None
    falls: bool = False


Tasks = dict[str, Callable[[np.random.Generator], Task]]
