"""A motion that was recorded elsewhere, by an engine that cannot be loaded here."""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from drake_diff.arrays import Array, finite_array
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.model import Model
from drake_diff.tangent import tangent_space

# What may be told of the engine, numbers as JSON: the time step [s], gravity (3,) [m/s^2], seeds.
FACTS = (
    "engine", "version", "precision", "time step", "integrator", "contact law", "limit law", "gravity",
    "seeds", "reset distribution",
)  # fmt: skip
NORM_TOLERANCE = 1e-3  # of a quaternion's norm: float32 and five printed digits are within it, another order is not
CLOCK_TOLERANCE = 1e-3  # of a time step: printed times and nanoseconds are within it


@dataclass(frozen=True, eq=False)
class Recording:
    """States in Drake's coordinates. `facts` is what is known of the engine's contract, by quantity."""

    name: str
    version: str
    times: Array  # (n,) [s], increasing
    xs: Array  # (n, nx)
    us: Array  # (n - 1, nu), held from one time to the next
    facts: Mapping[str, str] = field(default_factory=dict)


def check_recording(recording: Recording, model: Model) -> None:
    """Refuse what cannot be a motion of `model`: ShapeError, NonFiniteError, InputError, naming recording and row."""
    subject = f"recording {recording.name}"
    times = finite_array(f"{subject}: times", recording.times, ("n",))
    if len(times) < 2:
        raise InputError(f"{subject}: times", got=f"{len(times)}", expected="two or more")
    late = np.flatnonzero(np.diff(times) <= 0)
    if len(late):
        k = int(late[0]) + 1
        raise InputError(
            f"{subject}: time of sample {k}", got=f"{times[k]} s", expected=f"more than {times[k - 1]} s before it"
        )
    xs = finite_array(f"{subject}: xs", recording.xs, (len(times), model.nx))
    finite_array(f"{subject}: us", recording.us, (len(times) - 1, model.nu))
    for start in tangent_space(model).quaternions:
        norms = np.linalg.norm(xs[:, start : start + 4], axis=1)
        k = int(np.argmax(np.abs(norms - 1)))
        if abs(norms[k] - 1) > NORM_TOLERANCE:
            names = ", ".join(model.state_names[start : start + 4])
            raise InputError(f"{subject}: norm of ({names}) at sample {k}", got=float(norms[k]), expected="1")
    for quantity in recording.facts:
        if quantity not in FACTS:
            raise UnknownNameError(f"{subject}: fact", got=quantity, known=FACTS)


def steps_between(recording: Recording, time_step: float) -> int:
    """How many steps of `time_step` [s] lie between samples. InputError where that is no whole number, always the same.

    Both times of a sample may be off by the clock's rounding, a thousandth of a step.
    """
    periods = np.diff(recording.times)
    count = max(1, round(float(periods[0]) / time_step))
    wrong = np.flatnonzero(np.abs(periods - count * time_step) > CLOCK_TOLERANCE * time_step)
    if len(wrong):
        k = int(wrong[0])
        raise InputError(
            f"recording {recording.name}: period from sample {k} to {k + 1}",
            got=f"{periods[k]:.9g} s",
            expected=f"{count * time_step:g} s throughout, a whole multiple of the model's time step, {time_step:g} s",
        )
    return count


def inputs_of(recording: Recording, time_step: float) -> Array:
    """(N, nu) the recorded inputs, one for each step of `time_step` [s]."""
    return np.repeat(recording.us, steps_between(recording, time_step), axis=0)
