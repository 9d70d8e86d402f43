"""One discrete step of Drake's double plant, and a step counter as a machine-independent cost of a search."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, finite_array
from drake_diff.exceptions import DrakeDiffError, SimulationError
from drake_diff.model.model import Model, load_model
from drake_diff.model.parameters import applied, select
from drake_diff.model.twin import Twin


def step(
    model: Model, x: ArrayLike, u: ArrayLike | None = None, *, parameters: Mapping[str, Any] | None = None
) -> Array:
    """Return the state one time step later, computed by Drake's double plant.

    Args:
        model: The model.
        x: (nx,) The state [q; v].
        u: (nu,) The input [N or N m], constant over the step; optional if the model has no inputs.
        parameters: Names (see `list_parameters`) and the values that replace the model's own for this step.

    Returns:
        (nx,) The next state.

    Raises:
        ShapeError, NonFiniteError: x or u is invalid.
        UnknownNameError, InputError: A parameter does not exist, or its value is invalid.
        SimulationError: Drake cannot take the step, or its result is not finite.

    Example:
        >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
        >>> dd.step(model, [0, 0, 0, 0], [1.0]).round(6)
        array([ 0.0001, -0.0002,  0.01  , -0.02  ])
        >>> dd.step(model, [0, 0, 0, 0], [1.0], parameters={"cart.mass": 2.0}).round(6)
        array([ 5.e-05, -1.e-04,  5.e-03, -1.e-02])
    """
    point = check_point(model, x, u)
    with applied(select(model, parameters or ())) as set_model:
        return advance(set_model.double, *point)


def check_point(model: Model, x: ArrayLike, u: ArrayLike | None) -> tuple[Array, Array]:
    """Return `x` and `u` as finite arrays of the model's sizes."""
    no_input = u is None and model.nu == 0
    return model.finite_state("x", x), finite_array("u", [] if no_input else u, (model.nu,))


def set_state(twin: Twin, x: Any) -> None:
    """Set the state `x` (nx,), floats or AutoDiffXd, in the twin's context.

    Raises SimulationError if a float is not finite; Drake would end the process with SystemExit.
    """
    if not _is_finite(np.asarray(x)):
        raise SimulationError(f"a state is not finite: {x}")
    twin.set_state(x)


def advance(twin: Twin, x: Any, u: Any) -> Any:
    """Return the state (nx,) after one step of the twin, for floats or AutoDiffXd; sizes are not checked.

    The context stays at (x, u), so that Drake's intermediate results (contacts, efforts) can be read.
    """
    plant, context = twin.plant, twin.context
    set_state(twin, x)
    if not _is_finite(np.asarray(u)):
        raise SimulationError(f"an input is not finite: {u}")
    twin.set_input(u)
    stepped()
    if twin.forces:
        plant.get_applied_generalized_force_input_port().FixValue(context, twin.added_force())
    try:
        # value() is a view that the next step overwrites.
        x_next = twin.next_state(np.array(plant.EvalUniquePeriodicDiscreteUpdate(context).value()))
    except (RuntimeError, SystemExit) as error:  # SystemExit: a failed condition in Drake, such as a stiffness above 0
        raise SimulationError(f"Drake cannot take this step: {error}") from error
    if not _is_finite(x_next):
        raise SimulationError(f"the step leads to {x_next}, which is not finite, from x = {x}, u = {u}")
    return x_next


def _is_finite(numbers: Any) -> bool:
    """Return whether an array (n,) of floats is finite; AutoDiffXd arrays are not checked.

    The norm is much faster to compute than a check of each entry, and is infinite if it overflows.
    """
    return numbers.dtype != float or math.isfinite(math.hypot(*numbers.tolist()))


class StepCount:
    """The number `steps` of simulated steps in a block of `count_steps`."""

    def __init__(self, within: StepCount | None = None):
        self.steps, self._within = 0, within

    def add(self, steps: int) -> None:
        """Add a number of steps to this count and to those of the enclosing blocks."""
        self.steps += steps
        if self._within is not None:
            self._within.add(steps)

    def __repr__(self) -> str:
        return f"StepCount: {self.steps} steps"


_counting: ContextVar[StepCount | None] = ContextVar("counting", default=None)


@contextmanager
def count_steps() -> Iterator[StepCount]:
    """Count the simulated steps in a block, so that different searches can have the same budget.

    A step is one of Drake's plant, with double or AutoDiffXd, or an interval `time_step` of a continuous-time motion.
    The count includes the steps of rollouts and searches, and those for derivatives, certificates and replays. A
    closed-form derivative takes no steps. The block counts only its own thread, no other threads or processes.

    Returns:
        A context manager that yields a `StepCount`.

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
    """Add a number of simulated steps to the enclosing block, if any."""
    count = _counting.get()
    if count is not None:
        count.add(steps)


def try_to_read(path: str, options: Mapping[str, Any]) -> None:
    """Load a model and make a step, in a child process; errors in the file are ignored, as the caller raises them."""
    with warnings.catch_warnings(), suppress(DrakeDiffError):
        warnings.simplefilter("ignore")
        model = load_model(path, **options)
        advance(model.double, model.default_state, np.zeros(model.nu))
