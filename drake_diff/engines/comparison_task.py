"""What a comparison is of: a motion's start and inputs, and the states at which Jacobians are compared."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drake_diff.arrays import Array, finite_array
from drake_diff.engines.motion import EngineMotion
from drake_diff.engines.recording import Recording, inputs_of
from drake_diff.model import Model
from drake_diff.rollout import check_inputs
from drake_diff.sampling import sample_states

DURATION, MOST_STEPS = 1.0, 500  # [s]; of a motion that is not given


class Probe(NamedTuple):
    """A state at which Jacobians are compared: "start", "free", "contact" or "deepest"."""

    name: str
    x: Array
    u: Array


def task_of(
    model: Model,
    recordings: Sequence[Recording],
    x0: ArrayLike | None,
    us: ArrayLike | None,
    num_steps: int | None,
    seed: int,
) -> tuple[Array, Array]:
    """x0 (nx,) and us (N, nu), checked; without x0 those of the first recording, without any sampled ones."""
    if recordings and x0 is None:
        x0, us = recordings[0].xs[0], inputs_of(recordings[0], model.time_step) if us is None else us
    sample = sample_states(model, 1, seed)[0]
    if us is None:
        count = num_steps or min(MOST_STEPS, max(1, round(DURATION / model.time_step)))
        us = np.tile(sample.u, (count, 1))
    return (sample.x if x0 is None else finite_array("x0", x0, (model.nx,))), check_inputs(model, us, num_steps)


def probes_of(model: Model, motion: EngineMotion, seed: int) -> tuple[Probe, ...]:
    """The motion's start, a state sampled free and one touching, and the motion's deepest overlap."""
    probes = [Probe("start", motion.xs[0], motion.us[0])]
    probes += [Probe(sample.kind, sample.x, sample.u) for sample in sample_states(model, 2, seed + 1)]
    if motion.depth is not None and np.max(motion.depth[:-1], initial=0.0) > 0:
        k = int(np.argmax(motion.depth[:-1]))
        probes.append(Probe("deepest", motion.xs[k], motion.us[k]))
    return tuple(probes)
