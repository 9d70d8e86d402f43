"""How many steps were simulated: the price of a search in a unit that no machine changes."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class StepCount:
    """Steps that were simulated in the block of `count_steps` that made it; `steps` is their number so far."""

    def __init__(self, within: "StepCount | None" = None):
        self.steps, self._within = 0, within

    def add(self, steps: int) -> None:
        """Count so many more, here and in the blocks around."""
        self.steps += steps
        if self._within is not None:
            self._within.add(steps)

    def __repr__(self) -> str:
        return f"StepCount: {self.steps} steps"


_counting: ContextVar[StepCount | None] = ContextVar("counting", default=None)


@contextmanager
def count_steps() -> Iterator[StepCount]:
    """Count the steps that are simulated in a block, so that searches of any kind can be given the same budget.

    One is a step of Drake's plant, by numbers or by AutoDiffXd, or an interval of `time_step` of a motion in continuous
    time. All are counted: those of a rollout or a search, and those by which derivatives, certificates and replays are
    taken. A derivative by formula takes none. The block counts what its own thread does, no other threads or processes.

    Returns:
        A context that gives a `StepCount`.

    Example:
        >>> from drake_diff.model import count_steps
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> with count_steps() as count:
        ...     motion = dd.rollout(model, [0.1, 0], np.zeros((20, 1)))
        >>> count
        StepCount: 20 steps
    """
    count = StepCount(_counting.get())
    token = _counting.set(count)
    try:
        yield count
    finally:
        _counting.reset(token)


def stepped(steps: int = 1) -> None:
    """Tell the block around, if there is one, that so many steps were simulated."""
    count = _counting.get()
    if count is not None:
        count.add(steps)
