"""Whether a recording's columns are mistaken: two exchanged, one with the other sign, or degrees where radians belong.

Each mistake is one permutation of the columns with factors, and has no number that is fitted. Short segments of the
motion say which of them come nearer to the model than the columns as they are. Those few are fitted whole, with
nothing but their first states, and one is named where it leaves noise and the columns as they are do not.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations

import numpy as np

from drake_diff._base.arrays import Array, Indices
from drake_diff.comparison.recordings import CLOCK_TOLERANCE
from drake_diff.exceptions import DrakeDiffError
from drake_diff.identification.fit import cut_segments
from drake_diff.identification.identify import Problem
from drake_diff.identification.judge import HOPELESS, likelihood_of, noise_of
from drake_diff.identification.motion import ContinuousMotion, EulerMotion, Law
from drake_diff.identification.recordings import Chart, Piece, guess_states, noise_by_differences
from drake_diff.identification.results import Explanation
from drake_diff.identification.tree import Mask, Tree
from drake_diff.identification.unknowns import Unknowns
from drake_diff.model.model import Model
from drake_diff.model.plant import joints

SEGMENTS = 12  # of the recording, by which mistakes are compared
AT_ONCE = 64  # mistakes whose segments move side by side
FITTED = 3  # mistakes that are fitted whole, of those that come nearest
NEARER = 0.5  # of what the columns as they are leave: a mistake that leaves more is not fitted
FAR = (
    3.0  # more than a mistake that explains leaves: columns as they are that leave 20 times its squares are not fitted
)
EVIDENCE = 20.0  # by which -2 log of the likelihood must fall: of 100 mistakes, by chance in 0.5 % of recordings
SAME = 6.0  # of the same: evidence of 20 to 1, below which two mistakes are not told apart
STEPS, FEW = 20, 8  # of Gauss and Newton


@dataclass(frozen=True, eq=False)
class Mistake:
    """Columns of states and inputs that are right where they are taken in this order, times these factors."""

    words: str
    order: Indices  # (nx + nu,)
    factors: Array  # (nx + nu,)

    def mended(self, piece: Piece) -> Piece:
        """The piece as it would be without the mistake."""
        nx = piece.ys.shape[1]
        us = piece.us[:, self.order[nx:] - nx] * self.factors[nx:]
        return replace(piece, ys=piece.ys[:, self.order[:nx]] * self.factors[:nx], us=us)


Fitted = Callable[[Sequence[Piece]], tuple[float, bool]]  # (-2 log of the likelihood, whether noise is left)


def mistakes(model: Model, chart: Chart, pieces: Sequence[Piece]) -> list[Mistake]:
    """Everything that is tried; of what was not measured, nothing."""
    seen = np.any([np.isfinite(piece.ys).any(axis=0) for piece in pieces], axis=0)
    return list(_columns(model, chart, seen).every())


@dataclass(frozen=True, eq=False)
class _Columns:
    """The columns of a model's recordings, and which of them were measured."""

    names: tuple[str, ...]  # of states, then of inputs
    inputs: range
    seen: Mask
    along: list[tuple[int, int]]  # position and velocity of what moves along lines
    turning: list[tuple[int, int]]  # of what turns
    rates: list[int]  # velocities of what turns, those of free bodies too

    def every(self) -> Iterator[Mistake]:
        yield from self.exchanges()
        yield from self.mirrors()
        yield from self.degrees()

    def exchanges(self) -> Iterator[Mistake]:
        for alike in (self.along, self.turning):
            for first, second in combinations(alike, 2):
                pairs = [pair for pair in zip(first, second, strict=True) if self.seen[list(pair)].all()]
                yield from (self.exchanged(pair) for pair in pairs)
                if len(pairs) > 1:
                    yield self.exchanged(*pairs)
        yield from map(self.exchanged, combinations(self.inputs, 2))

    def mirrors(self) -> Iterator[Mistake]:
        for pair in (*self.along, *self.turning):
            both = tuple(column for column in pair if self.seen[column])
            yield from (self.scaled(columns, "the other sign", -1.0) for columns in _parts(both, *((i,) for i in both)))
        yield from (self.scaled((i,), "the other sign", -1.0) for i in self.inputs)

    def degrees(self) -> Iterator[Mistake]:
        angles = tuple(i for i, _ in self.turning if self.seen[i])
        rates = tuple(i for i in self.rates if self.seen[i])
        for columns in _parts(angles + rates, angles, rates):
            yield self.scaled(columns, "degrees, not radians", np.pi / 180)

    def made(self, words: str, columns: Sequence[int], sources: Sequence[int], factor: float) -> Mistake:
        order, factors = np.arange(len(self.names)), np.ones(len(self.names))
        order[list(columns)], factors[list(columns)] = sources, factor
        return Mistake(words, order, factors)

    def exchanged(self, *pairs: tuple[int, int]) -> Mistake:
        words = " and ".join(f"{self.names[i]} and {self.names[k]}" for i, k in pairs)
        columns, sources = [i for pair in pairs for i in pair], [i for a, b in pairs for i in (b, a)]
        return self.made(f"columns {words} are exchanged", columns, sources, 1.0)

    def scaled(self, columns: Sequence[int], what: str, factor: float) -> Mistake:
        return self.made(f"{_listed([self.names[i] for i in columns])} {what}", columns, columns, factor)


def _parts(*groups: tuple[int, ...]) -> list[tuple[int, ...]]:
    """Each set of columns once, without those that have none."""
    return [columns for columns in dict.fromkeys(groups) if columns]


def _columns(model: Model, chart: Chart, seen: Mask) -> _Columns:
    """Those of quaternions are in no group."""
    nq, nx = model.nq, model.nx
    sliding = {model.places(joint)[0].start for joint in joints(model.plant) if joint.type_name() == "prismatic"}
    along = [(i, nq + j) for i, j in chart.coordinates.single if i in sliding]
    along += [(i + 4 + k, nq + j + 3 + k) for i, j in chart.coordinates.free for k in range(3)]
    turning = [(i, nq + j) for i, j in chart.coordinates.single if i not in sliding]
    rates = [j for _, j in turning] + [nq + j + k for _, j in chart.coordinates.free for k in range(3)]
    names = (*model.state_names, *model.input_names)
    return _Columns(names, range(nx, nx + model.nu), seen, along, turning, rates)


def _listed(names: Sequence[str]) -> str:
    """What has something, and has it or have it: "column a has", "columns a and b have"."""
    if len(names) == 1:
        return f"column {names[0]} has"
    if len(names) > 4:
        return f"{len(names)} columns of angles, {names[0]} to {names[-1]}, have"
    return f"columns {', '.join(names[:-1])} and {names[-1]} have"


def mistaken_columns(
    model: Model, chart: Chart, pieces: Sequence[Piece], law: Law, fits: Sequence[Fitted]
) -> Explanation | None:
    """The mistake of columns that alone explains recordings; None where they are explained as they are, or by none.

    `law` moves short segments. Each of `fits` says how well the model, as it is, goes through whole recordings.
    """
    every = mistakes(model, chart, pieces)
    none = Mistake("", np.arange(model.nx + model.nu), np.ones(model.nx + model.nu))
    left, *others = _left(model, law, chart, pieces, [none, *every])
    nearer = [(every[i], others[i]) for i in np.argsort(others, kind="stable")[:FITTED] if others[i] < NEARER * left]
    measured = np.isfinite(np.concatenate([piece.ys for piece in pieces])).sum(axis=0)
    for fitted in fits:
        scores: dict[str, float] = {}
        for mistake, _ in nearer:
            score, explains = fitted([mistake.mended(piece) for piece in pieces])
            if explains:  # in the columns' own units
                scores[mistake.words] = score - 2 * float(measured @ np.log(np.abs(mistake.factors[: model.nx])))
        if not scores:
            continue
        before, explains = (np.inf, False) if left - nearer[0][1] > FAR else fitted(pieces)
        falls = {words: before - score for words, score in scores.items() if before - score > EVIDENCE}
        if explains or not falls:
            return None
        first, *rest = sorted(falls, key=lambda words: scores[words])
        alike = [words for words in rest if scores[words] - scores[first] < SAME]
        tail = "the recording cannot tell" if alike else "this explains the recording"
        sentence = f"{', or '.join((first, *alike))}: {tail}."
        return Explanation((first,), {}, {}, tuple((words,) for words in alike), True, sentence, falls)
    return None


def mistaken_in_the_air(
    model: Model, tree: Tree, chart: Chart, pieces: Sequence[Piece], stated: Array
) -> Explanation | None:
    """The same of motions in which nothing touches, in continuous time or by the model's own Euler steps.

    `stated` (2 nv,) is the noise, NaN where it is not known.
    """
    arguments = model, tree, Unknowns((), as_in_files=True)
    periods = np.concatenate([np.diff(piece.times) for piece in pieces]) / model.time_step
    whole = np.round(periods)
    steps = not chart.coordinates.free and np.all(whole > 0) and np.all(np.abs(periods - whole) < CLOCK_TOLERANCE)
    law = ContinuousMotion(*arguments)
    fits = [partial(_fitted, model, law, chart, stated)]
    if steps:
        euler = EulerMotion(*arguments, model.time_step)
        fits.append(partial(_fitted, model, euler, chart, stated))
    return mistaken_columns(model, chart, pieces, law, fits)


def _left(model: Model, law: Law, chart: Chart, pieces: Sequence[Piece], candidates: Sequence[Mistake]) -> list[float]:
    """What some short segments leave without each mistake, from states that are guessed: mean log of 1 + squares."""
    s, nx = cut_segments(law, pieces, model.nu), model.nx
    some = np.unique(np.linspace(0, len(s.first) - 1, SEGMENTS).round().astype(int))
    losses: list[float] = []
    for first in range(0, len(candidates), AT_ONCE):
        batch = candidates[first : first + AT_ONCE]
        mended = [[candidate.mended(piece) for piece in pieces] for candidate in batch]
        starts = [
            guess_states(model, chart, mended_pieces[s.of_piece[k]], np.array([s.first[k]], dtype=np.intp))
            for mended_pieces in mended
            for k in some
        ]
        us = [s.us[some][:, :, candidate.order[nx:] - nx] * candidate.factors[nx:] for candidate in batch]
        with np.errstate(all="ignore"):
            count = len(some)
            firsts = [np.concatenate(starts[count * i : count * (i + 1)]) for i in range(len(batch))]
            xs = side_by_side(law, firsts, s.hs[some], us)
            for mended_pieces, moved in zip(mended, xs, strict=True):
                noise = noise_by_differences(chart, mended_pieces)
                misses = [
                    chart.minus(mended_pieces[s.of_piece[k]].ys[s.samples[k]], moved[i, s.at[k]]) / noise
                    for i, k in enumerate(some)
                ]
                squares = np.concatenate(misses) ** 2
                known = np.log1p(squares[np.isfinite(squares)])
                losses.append(float(np.mean(known)) if len(known) else np.inf)
    return losses


def side_by_side(law: Law, starts: Sequence[Array], hs: Array, us: Sequence[Array]) -> list[Array]:
    """The motion of each mistake's segments; NaN of those that grow beyond what numbers hold."""
    try:
        xs = law.run(np.zeros(0), np.concatenate(starts), np.tile(hs, (len(starts), 1)), np.concatenate(us))
    except np.linalg.LinAlgError:
        if len(starts) == 1:
            return [np.full((*hs.shape[:1], hs.shape[1] + 1, starts[0].shape[1]), np.nan)]
        half = len(starts) // 2
        return [*side_by_side(law, starts[:half], hs, us[:half]), *side_by_side(law, starts[half:], hs, us[half:])]
    return list(xs.reshape(len(starts), len(hs), *xs.shape[1:]))


def _fitted(model: Model, law: Law, chart: Chart, stated: Array, pieces: Sequence[Piece]) -> tuple[float, bool]:
    """(-2 log of the likelihood with the noise that is left, whether what is left is noise).

    Where a few steps leave far more than noise, no more are taken.
    """
    nothing = Unknowns((), as_in_files=True)
    problem = Problem(model, chart, nothing, list(pieces), stated, noise_by_differences(chart, pieces))
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            fit, starts = problem.prepared(law)
            size = noise_of(fit, fit.solve(problem.unknowns.z_first, starts, FEW))
            if np.any(size[np.isfinite(size)] > HOPELESS * problem.first_noise[np.isfinite(size)]):
                return np.inf, False
            fit, solved = problem.solve(law, STEPS)
    except (DrakeDiffError, np.linalg.LinAlgError):  # its motion grows beyond what numbers hold
        return np.inf, False
    score = likelihood_of(fit, solved, stated, problem.scatter)
    return score, not problem.doubt(fit, solved, "")
