"""The messages of identification: about parameters, unidentifiable combinations, causes and motions."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.identification.unknowns import Unknowns
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.model import Model

Sizes = tuple[float, float, str]  # rms errors before and after, and their unit
DEGREES = {"rad": "degrees", "rad/s": "degrees/s"}
PART = 0.03  # fraction of the largest change in a combination below which a change is omitted
COMBINED = ("friction", "stiffness")  # Drake combines those of two bodies in contact: 2 a b / (a + b), or half of it
NOISE_IS_LEFT = "the residuals are noise, and held-out samples are predicted"
NO_CHANGE = "Not explained: no change that was tried explains the recording"


def in_usual_units(before: float, after: float, unit: str) -> Sizes:
    """Return two errors with their unit; angles are in degrees."""
    factor = 180 / np.pi if unit in DEGREES else 1.0
    return factor * before, factor * after, DEGREES.get(unit, unit)


def where_left(model: Model, motions: Sequence[tuple[Array, Array]], noise: Array) -> tuple[str, ...]:
    """Return where a joint's error is largest in units of its noise, from measured and predicted states (n, nx)."""
    ys, xs = (np.concatenate(states) for states in zip(*motions, strict=True))
    most, worst = 0.0, None
    for i, j in coordinates_of(model).single:
        seen = np.isfinite(ys[:, i])
        error = ys[seen, i] - xs[seen, i]
        if len(error) and np.sqrt(np.mean(error**2)) > most * noise[j]:
            most, worst = float(np.sqrt(np.mean(error**2)) / noise[j]), (i, model.nq + j, seen, error)
    if worst is None:
        return ()
    i, j, seen, error = worst
    unit, rate = model.contract.positions[i].unit, model.contract.velocities[j - model.nq].unit
    error = error * in_usual_units(1.0, 1.0, unit)[0]
    rms = float(np.sqrt(np.mean(error**2)))
    places = [_worst_third(error, np.abs(xs[seen, j]), "speeds", rate)]
    places.append(_worst_third(error, xs[seen, i], "positions", unit))
    for sign, word in ((1, "positive"), (-1, "negative")):
        some = error[sign * xs[seen, j] > 0]
        if len(some) and np.mean(some**2) > rms**2:
            places.append(f"{np.sqrt(np.mean(some**2)):.3g} at {word} velocities, {np.mean(some):+.3g} in the mean")
    text = f"{rms:.3g} {in_usual_units(1.0, 1.0, unit)[2]} rms, measured minus model {np.mean(error):+.3g} in the mean"
    return (f"the largest error, relative to the noise, is in {model.state_names[i]}: {text}; {'; '.join(places)}",)


def _worst_third(error: Array, values: Array, name: str, unit: str) -> str:
    """Return the third of the samples with the largest error, in words: with low, middle or high values."""
    low, high = np.quantile(values, [1 / 3, 2 / 3])
    masks = values <= low, (values > low) & (values < high), values >= high
    rms = [float(np.sqrt(np.mean(error[mask] ** 2))) if np.any(mask) else 0.0 for mask in masks]
    a, b, unit = in_usual_units(float(low), float(high), unit)
    ranges = f"below {a:.3g}", f"from {a:.3g} to {b:.3g}", f"above {b:.3g}"
    return f"{max(rms):.3g} at {name} {ranges[int(np.argmax(rms))]} {unit}"


def structure_line(falls: Mapping[str, float], held_out: bool, least: float = 0.02) -> str:
    """Return which changes of the model's structure would reduce the error, by at least the fraction `least`."""
    best = sorted((lack for lack in falls if falls[lack] >= least), key=lambda lack: -falls[lack])
    error = "the error of held-out samples" if held_out else "the error"
    if not best:
        return (
            f"no other friction, backlash, delay, gain or constant effort would reduce {error} by {100 * least:.0f} %"
        )
    parts = ", ".join(f"{lack} by {100 * falls[lack]:.0f} %" for lack in best[:3])
    return f"changes of the model's structure would reduce {error}, as the linearized motion predicts: {parts}"


def changed_to(name: str, values: Array, intervals: Array, start: Array, unit: str) -> str:
    """Return the values (k,) of a quantity with their intervals (k, 2) and the model's values, in words."""
    columns = [name] if len(start) == 1 else [f"{name}[{k}]" for k in range(len(start))]
    return ", ".join(
        _estimate(column, v, interval, was, unit) if np.all(np.isfinite(interval)) else f"{column} cannot be known"
        for column, v, interval, was in zip(columns, values, intervals, start, strict=True)
    )


def _estimate(column: str, value: float, interval: Array, was: float, unit: str) -> str:
    unit = f" {unit}" if unit not in ("", "1") else ""
    return f"{column} is {value:.4g}{unit} ({interval[0]:.4g} to {interval[1]:.4g}), not {was:.4g}"


def unidentifiable(unknowns: Unknowns, z: Array, directions: Sequence[Array]) -> tuple[str, ...]:
    """Return the combinations that the data leave undetermined, in words, for their directions (np,) in z."""
    by_z, values = unknowns.by_z(z), unknowns.values(z)
    return tuple(dict.fromkeys(_combination(unknowns, values, by_z @ direction) for direction in directions))


def _combination(unknowns: Unknowns, values: Array, change: Array) -> str:
    sizes = np.concatenate([np.full(len(unknown.start), unknown.size or 1.0) for unknown in unknowns.each])
    shares = np.abs(change) / sizes
    columns = [int(j) for j in np.argsort(-shares, kind="stable") if shares[j] > PART * np.max(shares)]
    names = [unknowns.columns[j] for j in columns]
    quantities = {u.name for u, s in unknowns.items() for j in columns if s.start <= j < s.stop}
    if len(names) == 1:
        return f"{names[0]}: a change of this value leaves the motion as it is"
    if len(quantities) == 1:
        together = f"{', '.join(names[:-1])} and {names[-1]}"
        return f"{quantities.pop()}: a change of {together} together leaves the motion as it is"
    if len(names) == 2:
        kinds = {name.rsplit(".", 1)[1] for name in quantities}
        seen = _seen_of_two(values[columns], change[columns], kinds.pop() if len(kinds) == 1 else "")
        if seen:
            return f"{names[0]} and {names[1]}: only their {seen} is seen"
    factor = np.sign(change[columns[0]]) * 0.1 / shares[columns[0]]  # a change by a tenth of the first one's size
    changes = [f"{unknowns.columns[j]} by {factor * change[j]:+.3g} {unknowns.units[j]}" for j in columns[:6]]
    more = f" and {len(columns) - 6} more" if len(columns) > 6 else ""
    return f"a change of {' with '.join(changes)}{more} leaves the motion as it is"


def _seen_of_two(values: Array, change: Array, quantity: str) -> str:
    """Return the combination ("sum", "product", ...) of two values that a small change of both preserves, or "".

    `quantity` is the common quantity, if any. If several words apply, as for equal values, the likeliest is returned.
    """
    if np.any(values * change == 0):
        return ""
    absolute, relative = change[0] / change[1], change[0] / change[1] * values[1] / values[0]
    words = {"product": relative, "quotient": -relative}
    if quantity in COMBINED:
        words = {"harmonic mean": relative * values[1] / values[0]}
    elif quantity:
        words = {"sum": absolute, "quotient": -relative, "product": relative, "difference": -absolute}
    return next((word for word, ratio in words.items() if abs(ratio + 1) < 0.02), "")


def identification_sentence(
    unknowns: Unknowns,
    values: Array,
    intervals: Array,
    unidentifiable: Sequence[str],
    errors: tuple[float, float],
    sizes: Mapping[str, Sizes],
    reason: str,
    held_out: bool = False,
) -> str:
    """Return the sentence about the estimates (np,), their intervals (np, 2) and the decrease of the error.

    The error of a motion that is not explained is in the units of its entries (`sizes`), as its noise is not known.
    """
    start, width = unknowns.start, np.maximum(intervals[:, 1] - intervals[:, 0], 1e-300)
    known = np.all(np.isfinite(intervals), axis=1)
    within = known & (intervals[:, 0] <= start) & (start <= intervals[:, 1])
    changed = np.flatnonzero(known & ~within)
    changed = changed[np.argsort(-np.abs(values - start)[changed] / width[changed], kind="stable")]
    clauses = []
    for j in changed[:4]:
        by = f", {100 * (values[j] / start[j] - 1):+.3g} %" if start[j] else ""
        clauses.append(_estimate(unknowns.columns[j], values[j], intervals[j], start[j], unknowns.units[j]) + by)
    bounds = np.array([(u.lower, u.upper) for u in unknowns.each for _ in u.start]).reshape(-1, 2)
    at_bound = np.isfinite(bounds) & (bounds != 0) & (np.abs(values[:, None] - bounds) <= 1e-9 * np.abs(bounds))
    for j in np.flatnonzero(at_bound.any(axis=1))[:3]:
        clauses.append(f"{unknowns.columns[j]} is at its bound, {values[j]:.4g} {unknowns.units[j]}".rstrip())
    if len(changed) > 4:
        clauses.append(f"{len(changed) - 4} more differ")
    if not len(changed):
        clauses.append("no parameter differs from the model's by more than its interval")
    elif np.any(within):
        clauses.append(f"{np.sum(within)} {'stays' if np.sum(within) == 1 else 'stay'} within the interval")
    if not np.all(known):
        more = f", and {len(unidentifiable) - 1} more such" if len(unidentifiable) > 1 else ""
        first = f" ({unidentifiable[0]}{more})" if unidentifiable else ""
        clauses.append(f"{np.sum(~known)} cannot be known from these recordings{first}")
    verdict = f"Not explained: {'; '.join(clauses)}" if reason else f"Explained: {'; '.join(clauses)}"
    error = f"the error {_change(*errors)} times the noise"
    if reason and sizes:
        unit = next(iter(sizes.values()))[2]  # of positions, which come first
        alike = {name: size[:2] for name, size in sizes.items() if size[2] == unit}
        worst = max(alike, key=lambda name: alike[name][1])
        rms = np.sqrt(np.mean(np.square(list(alike.values())), axis=0))
        samples = " of held-out samples" if held_out else ""
        error = f"the rms error{samples} {_change(*rms)} {unit}, at most {alike[worst][1]:.3g} in {worst}"
    return f"{verdict}; {error}; {reason or NOISE_IS_LEFT}."


def _change(before: float, after: float) -> str:
    """Return whether an error falls or rises, and both values."""
    if f"{before:.3g}" == f"{after:.3g}":
        return f"stays at {after:.3g}"
    return f"{'falls' if after <= before else 'rises'} from {before:.3g} to {after:.3g}"


def excitation_sentence(
    duration: float,
    deviations: Sequence[Mapping[str, Any]],
    units: Mapping[str, str],
    unidentifiable: Sequence[str],
    gain: float,
) -> str:
    """Return the sentence about a motion; `deviations` are by it, by a random motion and by a recording at rest."""
    clauses = []
    for name in deviations[0]:
        now, random, rest = (", ".join(f"{d:.3g}" for d in np.atleast_1d(values[name])) for values in deviations)
        unit = f" {units[name]}" if units[name] not in ("", "1") else ""
        clauses.append(f"{name} to {now}{unit} (random {random}, at rest {rest})")
    more = f" and {len(clauses) - 4} more" if len(clauses) > 4 else ""
    open_ = f" Open: {'; '.join(unidentifiable[:3])}." if unidentifiable else ""
    return (
        f"A motion of {duration:.3g} s that determines {', '.join(clauses[:4])}{more} (one standard deviation), "
        f"{gain:.3g} times better than a random motion.{open_}"
    )
