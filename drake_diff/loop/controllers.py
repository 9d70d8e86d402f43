"""Controllers that need no more than a plan: its inputs as they are, or TVLQR about it."""

from typing import Any

from numpy.typing import ArrayLike

from drake_diff.arrays import finite_array, positive_float, positive_int
from drake_diff.exceptions import InputError
from drake_diff.replay import track
from drake_diff.rollout import Policy
from drake_diff.solution import Solution


class OpenLoop:
    """u = us[k], k = round(t / time_step) within 0..N-1, whatever x is: the last input is held after the end.

    `us` (N, nu), `time_step` [s].
    """

    def __init__(self, us: ArrayLike, time_step: float):
        self.us, self.time_step = finite_array("us", us, ("N", "nu")), positive_float("time_step [s]", time_step)
        if not len(self.us):
            raise InputError("us", got="0 steps", expected="at least one step")

    def __call__(self, x: Any, t: float) -> Any:
        return self.us[min(max(round(t / self.time_step), 0), len(self.us) - 1)]


def tracking(solution: Solution, parts: int = 1) -> Policy:
    """TVLQR about `solution` in steps of a `parts`-th of its own, clipped to the problem's input bounds.

    A collocated motion may need 2 to 16 parts before the plant's steps follow it. The weights are those of the
    solution's own replays (`replay.regulator_weights`). Raises GradientError or ModelError where the plant cannot be
    linearized along the plan or built at that time step.
    """
    plan = solution.plan
    return track(plan, plan.model_at(parts), *plan.sample(positive_int("parts", parts)))
