"""Stretches of a recording in which nothing touches, and the states at which they start.

A motion through the air is as smooth as the positions that were measured of it. The state whose motion goes through all
of them is far better known than any single velocity, which is a difference of neighbouring positions.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.comparison.recordings import CLOCK_TOLERANCE, Recording
from drake_diff.derivatives.step import derivatives_along
from drake_diff.exceptions import InputError
from drake_diff.identification.chart import Chart
from drake_diff.identification.measured import Piece, read_pieces
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, select
from drake_diff.model.step import set_state

LEAST = 6  # samples of a flight: fewer say little of a velocity
CLEAR = 1  # samples between a flight and a sample at which shapes overlap
ITERATIONS = 3  # of Gauss and Newton: through the air a motion is nearly linear in its first state


def flights_of(model: Model, xs: Array) -> list[tuple[int, int]]:
    """First and last sample of each stretch of xs (n, nx) that is clear of the model's contacts."""
    if not model.contract.contact.collision_pairs:
        return [(0, len(xs) - 1)]
    touching = np.zeros(len(xs), dtype=bool)
    for k, x in enumerate(xs):
        set_state(model.double, x)
        touching[k] = model.double.overlaps()
    edges = np.flatnonzero(np.diff(np.concatenate([[1], touching.astype(int), [1]])))
    found = []
    for first, end in edges.reshape(-1, 2):
        a, b = first + CLEAR * (first > 0), end - 1 - CLEAR * (end < len(xs))
        if b - a + 1 >= LEAST:
            found.append((int(a), int(b)))
    return found


@dataclass(frozen=True, eq=False)
class Start:
    """A first state, and what measured positions leave open of it."""

    x: Array  # (nx,)
    spread: Array  # (2 nv, k): small motions from x, of one standard deviation each

    def others(self, chart: Chart, count: int, random: np.random.Generator) -> list[Array]:
        """First states (nx,) that the same positions could have had."""
        return [chart.plus(self.x, self.spread @ random.standard_normal(self.spread.shape[1])) for _ in range(count)]


def start_of(model: Model, chart: Chart, piece: Piece, scale: Array) -> Start:
    """The state whose motion goes through the positions of a piece in which nothing touches.

    By least squares, each position in units of its `scale` (nv,). Its spread is that of the scatter of what is left.
    Parameters that are applied act.
    """
    each, nv = steps_between(model, piece), model.nv
    us, x, none = np.repeat(piece.us, each, axis=0), piece.ys[0], select(model, ())
    for _ in range(ITERATIONS):
        steps = derivatives_along(model, x, us, vector=none)
        xs = np.array([x] + [step.x_next for step in steps[each - 1 :: each]])
        by_start, slopes = chart.from_motion(x), []
        for k, step in enumerate(steps):
            if k % each == 0:
                slopes.append(by_start)
            by_start = step.A @ by_start
        slopes.append(by_start)
        J = (chart.to_motion(xs) @ np.array(slopes))[:, :nv] / scale[:, None]
        e = chart.minus(piece.ys, xs)[:, :nv] / scale
        inverse = np.linalg.pinv(J.reshape(-1, 2 * nv))
        d = np.asarray(inverse @ e.ravel(), dtype=float)
        x = chart.plus(x, d)
    left = np.sqrt(np.sum((e - J @ d) ** 2, axis=0) / (len(e) - 2))  # a place and a velocity of each are fitted
    return Start(np.asarray(x), inverse * np.tile(left, len(e)))


def steps_between(model: Model, piece: Piece) -> int:
    """How many of the model's steps lie between two samples. InputError where it is no whole number."""
    periods = np.diff(piece.times)
    each = max(1, round(float(np.median(periods)) / model.time_step))
    if np.any(np.abs(periods - each * model.time_step) > CLOCK_TOLERANCE * model.time_step * each):
        got = f"from {1e3 * np.min(periods):.6g} to {1e3 * np.max(periods):.6g} ms"
        expected = f"the same, and a whole number of steps of {1e3 * model.time_step:.6g} ms"
        raise InputError(f"times between samples of {piece.name}", got=got, expected=expected)
    return each


def millisecond(chart: Chart, pieces: list[Piece]) -> Array:
    """(nv,) how far each position moves in a millisecond: what an impact that much earlier or later changes."""
    speeds = np.sqrt(np.mean(np.concatenate([p.ys[:, chart.coordinates.nq :] ** 2 for p in pieces]), axis=0))
    for _, j in chart.coordinates.free:  # along one axis it may not have moved
        for three in (slice(j, j + 3), slice(j + 3, j + 6)):
            speeds[three] = np.sqrt(np.mean(speeds[three] ** 2))
    return np.asarray(1e-3 * np.maximum(speeds, max(1e-3 * np.max(speeds), 1e-9)))


def first_state(model: Model, recording: Recording, *, parameters: Mapping[str, Any] | None = None) -> Array:
    """The state at the start of a recording, by its motion before anything touches.

    What is measured of a motion before the first contact is all that goes into it: the state whose motion, by the
    model's own steps, goes through the measured positions.

    Args:
        model: Its steps are taken, so that the state fits a rollout of this model and time step.
        recording: Every position measured; its velocities are where the search begins.
        parameters: Other values of the model's parameters, by name.

    Returns:
        (nx,); the first measured state itself where fewer than 6 samples come before the first contact.

    Raises:
        InputError: The times between samples are no whole number of steps.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.005)
        >>> x0 = np.array([1.0, 0, 0, 0, 0, 0, 0.5, 0, 0, 0, 1.0, 0, 0])
        >>> xs = dd.rollout(model, x0, np.zeros((20, 0))).xs.copy()
        >>> xs[:, 10] += 0.01  # a velocity that is wrong
        >>> log = dd.Recording("throw", "1", 0.005 * np.arange(21), xs, np.zeros((20, 0)))
        >>> print(round(float(dd.identification.first_state(model, log)[10]), 6))
        1.0
    """
    (piece,) = read_pieces(model, recording, 0.0)
    chart, vector = Chart(coordinates_of(model)), select(model, parameters or ())
    found = flights_of(model, piece.ys)
    if not found or found[0][0] > 0:
        return np.array(piece.ys[0])
    with applied(vector) as own:
        return start_of(own, chart, piece.part(*found[0]), millisecond(chart, [piece])).x
