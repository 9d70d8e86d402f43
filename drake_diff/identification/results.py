"""What identification finds: values with their intervals, and the change that explains a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drake_diff._base.arrays import Array
from drake_diff._base.values import ShowsItsRepr
from drake_diff.comparison.recordings import Recording
from drake_diff.identification.messages import NOISE_IS_LEFT, identification_sentence
from drake_diff.identification.recordings import Excerpt
from drake_diff.identification.unknowns import Unknowns
from drake_diff.model.model import Model


@dataclass(frozen=True, eq=False)
class Request:
    """What `identify` was called with."""

    model: Model
    recordings: tuple[Recording, ...]
    files: tuple[tuple[Path, str] | None, ...]  # of each, the file that it was read from and its hash
    parameters: tuple[str, ...] | str
    noise: Mapping[str, float]
    held_out: float | str
    motion: str
    max_iterations: int
    priors: Mapping[str, Any] = field(default_factory=dict)
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    sensors: Mapping[str, tuple[str, Sequence[float]]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Followed:
    """A stretch of a recording beside the model's motion."""

    piece: Excerpt
    xs: Array  # (n, nx) with the values that were found
    xs_before: (
        Array | None
    )  # with the model's own, from a first state that fits best; None where that was not looked at


@dataclass(frozen=True, eq=False)
class Identification(ShowsItsRepr):
    """What recordings say of a model's parameters; `dd.identify` makes one."""

    values: Mapping[str, Any]  # by name, as the model's parameters take them; a number or an array
    start: Mapping[str, Any]  # the model's own
    intervals: Mapping[str, Array]  # (2,) or (k, 2): lower and upper, with 95 % of the probability
    units: Mapping[str, str]
    unidentifiable: tuple[str, ...]  # combinations that the recordings leave open, in words
    explained: bool  # whether what is left looks like noise, and held-out samples are predicted
    reason: str  # why
    sentence: str
    noise: Mapping[str, float]  # the standard deviation of each measured entry, given or from the residuals
    error_before: float  # of the held-out samples (of all, where none are), in standard deviations of the noise
    error_after: float
    residuals: tuple[Array, ...]  # of each fitted piece (n, 2 nv + m), in standard deviations; NaN where unmeasured
    columns: tuple[str, ...]  # (np,) a name for each entry of the values
    entries: tuple[str, ...]  # (2 nv + m,) a name for each column of the residuals
    covariance: Array  # (np, np) of the values; infinite where nothing is known
    score: float  # -2 log of the likelihood, up to a constant of the data
    count: int  # how many numbers were measured
    converged: bool
    steps: int
    motion: str  # which motion was fitted
    motions: tuple[Followed, ...]  # of what was fitted, then of what was held out
    at_half_step: Mapping[str, Any] | None = None  # through impacts, the values by steps of half the length, if it has
    asked: Request | None = None  # what was asked: `dd.save` writes it, and `dd.verify` asks it again

    def __repr__(self) -> str:
        return self.sentence


@dataclass(frozen=True, eq=False)
class Explanation(ShowsItsRepr):
    """The smallest change of a model that explains recordings; `dd.explain` makes one."""

    names: tuple[str, ...]  # what is changed: one name, or two; empty where nothing is, or nothing explains
    values: Mapping[str, Any]  # by name, of the alternatives too
    intervals: Mapping[str, Array]  # (2,) or (k, 2): lower and upper, with 95 % of the probability
    alternatives: tuple[tuple[str, ...], ...]  # other changes that the recordings cannot tell from this one
    explained: bool  # whether the model explains the recordings: as it is, or with the change
    sentence: str
    evidence: Mapping[str, float]  # by what was fitted: by how much it lowers -2 log of the likelihood

    def __repr__(self) -> str:
        return self.sentence


def identification(
    unknowns: Unknowns,
    values: Array,
    intervals: Array,
    *,
    open_: tuple[str, ...],
    errors: tuple[float, float],
    reason: str,
    **rest: Any,
) -> Identification:
    """Of values (np,) with intervals (np, 2), explained where there is no `reason` against it."""
    return Identification(
        values=unknowns.named(values),
        start=unknowns.named(unknowns.start),
        intervals=unknowns.named_intervals(intervals),
        units={unknown.name: unknown.unit for unknown in unknowns.each},
        unidentifiable=open_,
        explained=not reason,
        reason=reason or NOISE_IS_LEFT,
        sentence=identification_sentence(unknowns, values, intervals, open_, errors, reason),
        error_before=errors[0],
        error_after=errors[1],
        columns=unknowns.columns,
        **rest,
    )
