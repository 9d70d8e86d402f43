"""Results of identification: values with their intervals, and the change that explains a recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from drake_diff._base.arrays import Array
from drake_diff._base.values import ShowsItsRepr
from drake_diff.comparison.recordings import Recording
from drake_diff.exceptions import InputError
from drake_diff.identification.messages import NOISE_IS_LEFT, Sizes, identification_sentence
from drake_diff.identification.recordings import Excerpt
from drake_diff.identification.unknowns import Unknowns
from drake_diff.model.model import Model


@dataclass(frozen=True, eq=False)
class Request:
    """The arguments of a call of `identify`."""

    model: Model
    recordings: tuple[Recording, ...]
    files: tuple[tuple[Path, str] | None, ...]  # per recording, its file and the file's hash, or None
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
    """A piece of a recording together with the model's motion."""

    piece: Excerpt
    xs: Array  # (n, nx) with the estimated values
    xs_before: Array | None  # (n, nx) with the model's own values, from the best first state; None if not computed


@dataclass(frozen=True, eq=False)
class Identification(ShowsItsRepr):
    """Estimates of a model's parameters from recordings, as returned by `dd.identify`."""

    values: Mapping[str, Any]  # by name, in the form of the model's parameters: a number or an array
    start: Mapping[str, Any]  # the model's own values
    intervals: Mapping[str, Array]  # (2,) or (k, 2): lower and upper ends of 95 % intervals
    units: Mapping[str, str]
    unidentifiable: tuple[str, ...]  # combinations that the recordings do not determine, in words
    explained: bool  # whether the residuals look like noise, and held-out samples are predicted
    reason: str  # the reason of `explained`
    sentence: str
    noise: Mapping[str, float]  # the standard deviation of each measured entry, given or estimated from the residuals
    error_before: float  # of the held-out samples (of all if none are held out), in standard deviations of the noise
    error_after: float
    residuals: tuple[Array, ...]  # per fitted piece (n, 2 nv + m), in standard deviations; NaN if unmeasured
    columns: tuple[str, ...]  # (np,) the name of each entry of the values
    entries: tuple[str, ...]  # (2 nv + m,) the name of each column of the residuals
    covariance: Array  # (np, np) of the values; infinite if nothing is known
    score: float  # -2 log likelihood, up to a constant of the data
    count: int  # number of measurements
    converged: bool
    steps: int
    motion: str  # the law of motion that was fitted
    motions: tuple[Followed, ...]  # of the fitted pieces, then of the held-out ones
    sizes: Mapping[str, Sizes] = field(default_factory=dict)  # by entry, the rms errors before and after, and the unit
    remains: tuple[str, ...] = ()  # if not explained: where the error is, and which change of structure would reduce it
    at_half_step: Mapping[str, Any] | None = None  # through impacts, the values with half the time step, if available
    asked: Request | None = None  # the request, which `dd.save` writes and `dd.verify` repeats

    @property
    def request(self) -> Request:
        """The request. Raises InputError if there is none, as for a result of `identify_contact`."""
        if self.asked is None:
            subject, got = "identification", "an Identification without its request"
            raise InputError(subject, got=got, expected="the result of dd.identify")
        return self.asked

    def __repr__(self) -> str:
        return self.sentence


@dataclass(frozen=True, eq=False)
class Explanation(ShowsItsRepr):
    """The smallest change of a model that explains recordings, as returned by `dd.explain`."""

    names: tuple[str, ...]  # one or two changed quantities; empty if the model is unchanged, or no change explains
    values: Mapping[str, Any]  # by name, including those of the alternatives
    intervals: Mapping[str, Array]  # (2,) or (k, 2): lower and upper ends of 95 % intervals
    alternatives: tuple[tuple[str, ...], ...]  # other changes that the recordings cannot distinguish from this one
    explained: bool  # whether the model explains the recordings, unchanged or with the change
    sentence: str
    evidence: Mapping[str, float]  # by fitted change, the decrease of -2 log likelihood

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
    sizes: Mapping[str, Sizes] | None = None,
    held_out: bool = False,
    **rest: Any,
) -> Identification:
    """Return an identification of values (np,) with intervals (np, 2); it is explained if `reason` is empty."""
    return Identification(
        values=unknowns.named(values),
        start=unknowns.named(unknowns.start),
        intervals=unknowns.named_intervals(intervals),
        units={unknown.name: unknown.unit for unknown in unknowns.each},
        unidentifiable=open_,
        explained=not reason,
        reason=reason or NOISE_IS_LEFT,
        sentence=identification_sentence(unknowns, values, intervals, open_, errors, sizes or {}, reason, held_out),
        sizes=sizes or {},
        error_before=errors[0],
        error_after=errors[1],
        columns=unknowns.columns,
        **rest,
    )
