"""What identification says in words: of parameters, of what recordings leave open, of causes and of motions."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.identification.unknowns import Unknowns

PART = 0.03  # of the largest change in a combination: what is not told
COMBINED = ("friction", "stiffness")  # of two bodies that touch, which Drake makes one of: 2 a b / (a + b), half of it
NOISE_IS_LEFT = "what is left is like noise, and what was held out is predicted"
NO_CHANGE = "Not explained: no change that was tried explains the recording"


def changed_to(name: str, values: Array, intervals: Array, start: Array, unit: str) -> str:
    """What a quantity (k,) is, with its intervals (k, 2), and what it is in the model."""
    columns = [name] if len(start) == 1 else [f"{name}[{k}]" for k in range(len(start))]
    unit = f" {unit}" if unit not in ("", "1") else ""
    return ", ".join(
        f"{column} is {v:.4g}{unit} ({low:.4g} to {high:.4g}), not {was:.4g}"
        if np.isfinite(low) and np.isfinite(high)
        else f"{column} cannot be known"
        for column, v, (low, high), was in zip(columns, values, intervals, start, strict=True)
    )


def unidentifiable(unknowns: Unknowns, z: Array, directions: Sequence[Array]) -> tuple[str, ...]:
    """In words, the combinations that the data leave open, by their directions (np,) in z."""
    by_z, values = unknowns.by_z(z), unknowns.values(z)
    sentences = []
    for direction in directions:
        change = by_z @ direction
        sentences.append(_words(unknowns, values, change))
    return tuple(dict.fromkeys(sentences))


def _words(unknowns: Unknowns, values: Array, change: Array) -> str:
    sizes = np.concatenate(
        [np.full(len(unknown.start), unknown.size or 1.0) for unknown in unknowns.each]
    )  # of an inertia, a third of its trace
    parts = np.abs(change) / sizes
    columns = [int(j) for j in np.argsort(-parts, kind="stable") if parts[j] > PART * np.max(parts)]
    names = [unknowns.columns[j] for j in columns]
    quantities = {unknowns.each[i].name for i in _owners(unknowns, columns)}
    if len(quantities) == 1:
        (name,) = quantities
        if len(columns) == 1:
            return f"{names[0]}: a change of it leaves the motion as it is"
        return f"{name}: a change of {_listed(names)} together leaves the motion as it is"
    both = {name.rsplit(".", 1)[1] for name in quantities}
    seen = (
        _seen_of_two(values[columns], change[columns], both.pop() if len(both) == 1 else "")
        if len(columns) == 2
        else ""
    )
    if seen:
        return f"{names[0]} and {names[1]}: only their {seen} is seen"
    # Told as what a tenth of the first one's size does.
    factor = 0.1 / parts[columns[0]]
    if change[columns[0]] < 0:
        factor = -factor
    changes = [
        f"{name} by {factor * change[j]:+.3g} {unknowns.units[j]}" for name, j in zip(names[:6], columns, strict=False)
    ]
    more = f" and {len(columns) - 6} more" if len(columns) > 6 else ""
    return f"a change of {' with '.join(changes)}{more} leaves the motion as it is"


def _seen_of_two(values: Array, change: Array, quantity: str) -> str:
    """What of two values stays as it is in a small change of both; "" where no word says it.

    `quantity` is what both are, if it is the same. Of equal values several words would be true: the likeliest is told.
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


def _owners(unknowns: Unknowns, columns: Sequence[int]) -> set[int]:
    return {i for i, s in enumerate(unknowns.slices) for j in columns if s.start <= j < s.stop}


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def identification_sentence(
    unknowns: Unknowns,
    values: Array,
    intervals: Array,
    unidentifiable: Sequence[str],
    errors: tuple[float, float],
    *,
    explained: bool,
    reason: str,
) -> str:
    """What recordings say of parameters (np,) with intervals (np, 2), and by how much the error falls."""
    changed, unchanged, vague = [], 0, 0
    for j, name in enumerate(unknowns.columns):
        low, high = intervals[j]
        was, now, unit = unknowns.start[j], values[j], unknowns.units[j]
        if not (np.isfinite(low) and np.isfinite(high)):
            vague += 1
        elif low <= was <= high:
            unchanged += 1
        else:
            by = f", {100 * (now / was - 1):+.3g} %" if was else ""
            size = abs(now - was) / max(high - low, 1e-300)
            changed.append((size, f"{name} is {now:.4g} {unit} ({low:.4g} to {high:.4g}), not {was:.4g}{by}"))
    changed.sort(key=lambda pair: -pair[0])
    limits = [bound for unknown in unknowns.each for bound in [(unknown.lower, unknown.upper)] * len(unknown.start)]
    at_bound = [
        f"{name} is at its bound, {now:.4g} {unit}".rstrip()
        for name, now, unit, bounds in zip(unknowns.columns, values, unknowns.units, limits, strict=True)
        if any(np.isfinite(bound) and bound != 0 and abs(now - bound) <= 1e-9 * abs(bound) for bound in bounds)
    ]
    clauses = [text for _, text in changed[:4]] + at_bound[:3]
    if len(changed) > 4:
        clauses.append(f"{len(changed) - 4} more differ")
    if not changed:
        clauses.append("no parameter differs from the model's by more than its interval")
    if unchanged and changed:
        clauses.append(f"{unchanged} {'stays' if unchanged == 1 else 'stay'} within the interval")
    if vague:
        more = f", and {len(unidentifiable) - 1} more such" if len(unidentifiable) > 1 else ""
        first = f" ({unidentifiable[0]}{more})" if unidentifiable else ""
        clauses.append(f"{vague} cannot be known from these recordings{first}")
    verdict = "Explained" if explained else "Not explained"
    error = f"the error falls from {errors[0]:.3g} to {errors[1]:.3g} times the noise"
    return f"{verdict}: {'; '.join(clauses)}; {error}; {reason}."


def excitation_sentence(
    duration: float,
    deviations: Mapping[str, Any],
    random: Mapping[str, Any],
    rest: Mapping[str, Any],
    units: Mapping[str, str],
    unidentifiable: Sequence[str],
    gain: float,
) -> str:
    """How well a motion tells parameters, beside a random one and a recording at rest."""
    clauses = []
    for name, value in deviations.items():
        now, was = np.atleast_1d(value), np.atleast_1d(random[name])
        if len(now) == 1:
            unit = f" {units[name]}" if units[name] not in ("", "1") else ""
            clauses.append(
                f"{name} to {now[0]:.3g}{unit} (random {was[0]:.3g}, at rest {np.atleast_1d(rest[name])[0]:.3g})"
            )
        else:
            clauses.append(f"{name} to {', '.join(f'{d:.3g}' for d in now)} {units[name]}")
    more = f" and {len(clauses) - 4} more" if len(clauses) > 4 else ""
    open_ = f" Open: {'; '.join(unidentifiable[:3])}." if unidentifiable else ""
    return (
        f"{duration:.3g} s that tell {', '.join(clauses[:4])}{more}, at one standard deviation: "
        f"{gain:.3g} times better than a random motion.{open_}"
    )
