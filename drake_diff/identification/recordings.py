"""Measurements as pieces with independent first states: samples, noise, and a guess of states.

Differences of states are tangent vectors [position; velocity], with a rotation vector in world for a free body.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import file_digest, sha256
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drake_diff._base.arrays import MOST_STEPS, Array, array_with_gaps
from drake_diff.comparison.recordings import Recording, check_sizes, checked_motion, read_recording
from drake_diff.exceptions import InputError, UnknownNameError
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.contact import separations
from drake_diff.model.model import Model
from drake_diff.model.plant import actuators
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

LEAST = 8  # minimum number of samples of a piece
WINDOW = 9  # minimum number of samples for a cubic fit
WINDOW_TIME = 0.05  # [s] all samples within this time of the centre are also used
ORDERS = 8  # highest order of the differences of samples from which the noise is estimated
NO_NOISE = 1e-9  # minimum noise as a fraction of a column's range: recordings without noise are rounded
FEWEST = 6  # minimum number of differences for an estimate of the noise
FEWEST_WITH_JUMPS = 20  # minimum number of differences for an estimate by their median
NEARLY = 1e-7  # [m] largest overlap of a body that rests
MAD = 1.4826  # ratio of a normal distribution's standard deviation to the median of absolute deviations


@dataclass(frozen=True, eq=False)
class Excerpt:
    """A piece of a recording."""

    name: str
    times: Array  # (n,) [s]
    ys: Array  # (n, nx) measured states; NaN if unmeasured
    us: Array  # (n-1, nu) inputs, constant from each sample to the next
    held_out: bool
    recording: int = 0  # index of its recording
    earlier: tuple[Array, Array] | None = None  # times (m,) and inputs (m, nu) of the recording before this piece
    outs: Array | None = None  # (n, m) sensor readings; NaN if unmeasured

    @property
    def switches(self) -> tuple[Array, Array]:
        """The times (m,) [s] at which inputs begin, from the recording's first one on, and the inputs (m, nu)."""
        if self.earlier is None:
            return self.times[:-1], self.us
        times, us = self.earlier
        return np.concatenate([times, self.times[:-1]]), np.concatenate([us, self.us])

    def part(self, first: int, last: int) -> "Excerpt":
        """Return the piece from one sample to another, both included."""
        span = slice(first, last + 1)
        earlier = Excerpt(self.name, self.times[: first + 1], self.ys, self.us[:first], False, 0, self.earlier).switches
        outs = None if self.outs is None else self.outs[span]
        return replace(
            self, times=self.times[span], ys=self.ys[span], us=self.us[first:last], earlier=earlier, outs=outs
        )


def read_pieces(
    model: Model,
    recordings: Recording | str | Path | Sequence[Recording | str | Path],
    held_out: float | str,
    columns: Sequence[str] = (),
) -> list[Excerpt]:
    """Split recordings into fitted and held-out pieces; `held_out` is a fraction at the end, or a recording's name.

    `columns` are the columns of sensors that are read.

    Raises InputError, ShapeError or NonFiniteError that names recording and entry.
    """
    given = [recordings] if isinstance(recordings, (Recording, str, Path)) else list(recordings)
    if not given:
        raise InputError("recordings", got="none", expected="at least one Recording or file of a recording")
    logs = [r if isinstance(r, Recording) else read_recording(r, model, gaps=True) for r in given]
    names = [r.name for r in logs]
    if isinstance(held_out, str):
        if held_out not in names:
            raise UnknownNameError("recording to be held out", got=held_out, known=names)
        if set(names) == {held_out}:
            raise InputError("held_out", got=held_out, expected="one of several recordings, as the others are fitted")
    elif not 0 <= held_out <= 0.8:
        raise InputError(
            "held_out", got=held_out, expected="a fraction of the samples from 0 to 0.8, or the name of a recording"
        )
    pieces = []
    for i, r in enumerate(logs):
        whole = replace(_checked(r, model, columns), recording=i)
        if isinstance(held_out, str):
            pieces.append(replace(whole, held_out=r.name == held_out))
            continue
        last, count = len(whole.times) - 1, round(held_out * len(whole.times))
        count = count if LEAST <= count <= last - LEAST else 0
        pieces.append(whole.part(0, last - count))
        if count:
            pieces.append(replace(whole.part(last - count, last), held_out=True))
    return pieces


def read_given(
    model: Model, recordings: Recording | str | Path | Sequence[Recording | str | Path]
) -> tuple[tuple[Recording, ...], tuple[tuple[Path, str] | None, ...]]:
    """Read all recordings; return them, and for each its file with the hash, or None."""
    given = [recordings] if isinstance(recordings, (Recording, str, Path)) else list(recordings)
    logs, files = [], []
    for source in given:
        files.append(
            None
            if isinstance(source, Recording) or not Path(source).exists()
            else (Path(source), hash_of(Path(source)))
        )
        logs.append(source if isinstance(source, Recording) else read_recording(source, model, gaps=True))
    return tuple(logs), tuple(files)


def hash_of(path: Path) -> str:
    """Return the hash of a file; that of a directory is over the names and hashes of its files."""
    if path.is_file():
        with path.open("rb") as file:
            return file_digest(file, "sha256").hexdigest()
    names = sorted(p.relative_to(path).as_posix() for p in path.rglob("*") if p.is_file())
    return sha256("".join(f"{hash_of(path / name)} {name}\n" for name in names).encode()).hexdigest()


def columns_of(recordings: Sequence[Recording]) -> tuple[str, ...]:
    """Return the sensor columns of all recordings."""
    return tuple(dict.fromkeys(name for recording in recordings for name in recording.outputs))


def _checked(recording: Recording, model: Model, columns: Sequence[str]) -> Excerpt:
    subject = f"recording {recording.name}"
    times, xs, us = checked_motion(recording, model, least=LEAST, gaps=True)
    ys = np.array(xs)
    if times[-1] - times[0] > MOST_STEPS * model.time_step:
        k = int(np.argmax(np.diff(times)))
        got = f"{times[-1] - times[0]:.6g} s, with {times[k + 1] - times[k]:.6g} s between samples {k} and {k + 1}"
        raise InputError(f"{subject}: times", got=got, expected=f"at most {MOST_STEPS} steps of {model.time_step:g} s")
    for start in tangent_space(model).quaternions:
        turn = ys[:, start : start + 4]
        turn[np.isnan(turn).any(axis=1)] = np.nan
        norms = np.linalg.norm(turn, axis=1)
        if np.any(np.abs(norms - 1) > 0.1):
            k = int(np.argmax(np.abs(norms - 1) > 0.1))
            got, name = norms[k], model.state_names[start]
            raise InputError(f"{subject}: norm of the quaternion {name}... in sample {k}", got=got, expected="1")
        turn /= norms[:, None]
        seen = np.flatnonzero(np.isfinite(norms))
        signs = np.sign(np.sum(turn[seen[1:]] * turn[seen[:-1]], axis=1))
        turn[seen[1:]] *= np.cumprod(np.where(signs == 0, 1, signs))[:, None]
    if not np.any(np.isfinite(ys[:, : model.nq])):
        raise InputError(f"{subject}: xs", got="no position", expected="some measured positions")
    outs = np.full((len(times), len(columns)), np.nan)
    for j, name in enumerate(columns):
        if name in recording.outputs:
            outs[:, j] = array_with_gaps(f"{subject}: {name}", recording.outputs[name], (len(times),))
    check_sizes(subject, outs, columns)
    return Excerpt(recording.name, times - times[0], ys, us, held_out=False, outs=outs)


def given_noise(model: Model, noise: Mapping[str, float] | None, columns: Sequence[str] = ()) -> Array:
    """Return the user's noise (2 nv + m,) of each entry; NaN if not given.

    Names are those of states; a free body's rotation is named base_rx, base_ry, base_rz.
    """
    names = (*tangent_space(model).names, *columns)
    deviations = np.full(len(names), np.nan)
    for name, value in (noise or {}).items():
        if name not in names:
            raise UnknownNameError("noise of", got=name, known=names)
        if isinstance(value, bool) or not np.isfinite(value) or value <= 0:
            raise InputError(f"noise of {name}", got=value, expected="a standard deviation above 0")
        deviations[names.index(name)] = value
    return deviations


def noise_by_differences(model: Model, pieces: Sequence[Excerpt], *, jumps: bool = False) -> Array:
    """Return an upper estimate (2 nv + m,) of the noise of each entry: the least by differences of orders 1 to ORDERS.

    White noise s gives the difference of order d the deviation s sqrt(binomial(2 d, d)); motion increases it. If the
    motion `jumps`, as at impacts, the median of the differences is used, as jumps are few.
    """
    space = tangent_space(model)
    increments = [space.minus(piece.ys[1:], piece.ys[:-1]) for piece in pieces]
    increments = [
        rows if piece.outs is None else np.hstack([rows, np.diff(piece.outs, axis=0)])
        for rows, piece in zip(increments, pieces, strict=True)
    ]
    count = increments[0].shape[1]
    least, reach = np.full(count, np.inf), np.zeros(count)
    for j in range(count):
        for order in range(1, ORDERS + 1):
            parts = [np.diff(rows[:, j], n=order - 1) for rows in increments]
            known = np.concatenate([differences[np.isfinite(differences)] for differences in parts])
            size = np.inf
            if jumps and len(known) >= FEWEST_WITH_JUMPS:
                size = MAD * float(np.median(np.abs(known)))
            elif len(known) >= FEWEST:
                size = float(np.sqrt(np.mean(known**2)))
            least[j] = min(least[j], size / float(np.sqrt(comb(2 * order, order))))
        travelled = np.concatenate([rows[:, j] for rows in increments])
        reach[j] = np.nansum(np.abs(travelled)) if np.any(np.isfinite(travelled)) else 0.0
    seen = np.any([np.isfinite(rows).any(axis=0) for rows in increments], axis=0)
    least = np.where(np.isfinite(least), least, 1.0)  # too few samples for an estimate
    return np.where(seen, np.maximum(least, NO_NOISE * np.maximum(reach, 1e-3)), np.nan)


def guess_states(model: Model, piece: Excerpt, samples: NDArray[np.intp]) -> Array:
    """Guess states (len(samples), nx) at some samples by cubic fits to the samples around each.

    An unmeasured velocity is the derivative of its position. An unmeasured position is the model's default, but bodies
    of unmeasured height rest on what is below them, if anything is, at the first sample.
    """
    nq, default, coordinates = model.nq, model.default_state, coordinates_of(model)
    states = np.empty((len(samples), model.nx))
    seen = [(piece.times[known], y[known]) for y in piece.ys.T for known in [np.isfinite(y)]]
    for row, k in enumerate(samples):
        q, q_dot, v = default[:nq].copy(), np.zeros(nq), np.full(model.nv, np.nan)
        for i in range(nq):
            fitted = _cubic(*seen[i], piece.times[k])
            if fitted is not None:
                q[i], q_dot[i] = fitted
        for i, _ in coordinates.free:
            q[i : i + 4] /= np.linalg.norm(q[i : i + 4])
        for i in range(model.nv):
            fitted = _cubic(*seen[nq + i], piece.times[k])
            if fitted is not None:
                v[i] = fitted[0]
        slope = coordinates.motion(q) @ q_dot
        states[row] = np.concatenate([q, np.where(np.isnan(v), slope, v)])
    for i, j in unseen_heights(model, piece) if len(samples) else ():
        height = _resting(model, states[0], i, j)
        states[:, i] = states[:, i] if height is None else height
    return states


def heights(model: Model) -> list[tuple[int, int]]:
    """Return the positions along which nearly all weight acts, with the velocities of the same axes."""
    set_state(model.double, model.default_state)
    pulls = np.abs(model.plant.CalcGravityGeneralizedForces(model.double.context))
    coordinates = coordinates_of(model)
    pairs = [*coordinates.single, *((i + 6, j + 5) for i, j in coordinates.free)]
    most = float(np.max(pulls, initial=0.0))
    return [(i, j) for i, j in pairs if most > 0 and pulls[j] > 0.9 * most]


def unseen_heights(model: Model, piece: Excerpt) -> list[tuple[int, int]]:
    """Return the `heights` that are not measured, of bodies that nothing drives and that may touch others."""
    if not model.contract.contact.collision_pairs or np.any(model.inputs.actuator < 0):
        return []
    driven = {int(actuator.joint().velocity_start()) for actuator in actuators(model.plant)}
    unseen = ~np.any(np.isfinite(piece.ys), axis=0)
    return [(i, j) for i, j in heights(model) if unseen[i] and j not in driven] if np.any(unseen[: model.nq]) else []


def unseen_at_rest(model: Model, piece: Excerpt) -> list[int]:
    """Return the velocities that begin at rest: of `unseen_heights`, and of free bodies along axes without positions.

    It is empty if bodies cannot touch, or if a diagram's systems, such as propellers, move them.
    """
    if not model.contract.contact.collision_pairs or np.any(model.inputs.actuator < 0):
        return []
    seen = np.any(np.isfinite(tangent_space(model).minus(piece.ys, piece.ys)), axis=0)
    free = {j for _, first in coordinates_of(model).free for j in range(first, first + 6)}
    return [j for j in free.union(j for _, j in unseen_heights(model, piece)) if not seen[j]]


def unsupported(model: Model, pieces: Sequence[Excerpt]) -> tuple[str, ...]:
    """Return the names of `unseen_heights` with nothing below the body at the first sample of a piece."""
    names = []
    for piece in pieces:
        unseen, x = unseen_heights(model, piece), guess_states(model, piece, np.zeros(1, dtype=int))[0]
        names += [model.position_names[i] for i, j in unseen if _resting(model, x, i, j) is None]
    return tuple(dict.fromkeys(names))


def _resting(model: Model, x: Array, i: int, j: int) -> float | None:
    """Return the position i of the body at x (nx,) at which it begins to touch others, or None if nothing is below.

    It falls by steps of Newton's method, as distances of convex shapes are convex in a translation: none is passed.
    """
    set_state(model.double, x)
    up = -np.sign(model.plant.CalcGravityGeneralizedForces(model.double.context)[j])

    def touches(rise: float) -> bool:
        moved = x.copy()
        moved[i] += up * rise
        set_state(model.double, moved)
        return bool(model.double.overlaps())

    is_in, rises = touches(0.0), [0.0]
    while touches(rises[-1]) == is_in:
        near = [] if is_in else [(pair.distance, up * pair.gradient[i]) for pair in separations(model.double)]
        # It passes by a wall, whose rate is 0; at a first touch, a rate may be NaN. Distances have errors of 1e-6 m.
        ways = [float(np.nan_to_num(distance / rate)) for distance, rate in near if not rate < 1e-3]
        if len(rises) > 100 or rises[-1] > 8.0 or not (is_in or ways):
            return None
        rises.append(max(2 * rises[-1], 1e-3) if is_in else rises[-1] - max(min(ways), 1e-4))
    touching, free = sorted(rises[-2:])
    while abs(free - touching) > NEARLY:
        middle = (free + touching) / 2
        touching, free = (middle, free) if touches(middle) else (touching, middle)
    return float(x[i] + up * touching)


def _cubic(times: Array, y: Array, time: float) -> Any:
    """Return (value, slope) at `time` of a cubic fit to the measured `y` (n,) around it; None if too few exist."""
    if len(times) < 2:
        return None
    begin, here, end = np.searchsorted(times, time + np.array([-WINDOW_TIME, 0.0, WINDOW_TIME]))
    near = slice(max(0, min(begin - 1, here - WINDOW)), max(end, here + WINDOW) + 1)
    t = times[near] - time
    order = np.argsort(np.abs(t), kind="stable")
    used = order[: max(WINDOW, int(np.sum(np.abs(t) <= WINDOW_TIME)))]
    degree = min(3, len(used) - 1)
    size = float(np.max(np.abs(t[used]))) or 1.0
    fitted = np.linalg.lstsq(np.vander(t[used] / size, degree + 1, increasing=True), y[near][used], rcond=None)[0]
    return fitted[0], fitted[1] / size
