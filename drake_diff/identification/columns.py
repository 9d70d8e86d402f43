"""Whether a recording's columns are mistaken: two exchanged, one with the other sign, or degrees where radians belong.

Each mistake is one permutation of the columns with factors, and has no number that is fitted. Short segments of the
motion say which of them come nearer to the model than the columns as they are. Those few are fitted whole, with
nothing but their first states, and one is named where it leaves noise and the columns as they are do not.
"""

from collections.abc import Callable, Sequence
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
from drake_diff.identification.motion import EulerMotion, Law, TreeMotion
from drake_diff.identification.recordings import Chart, Excerpt, guess_states, noise_by_differences
from drake_diff.identification.results import Explanation
from drake_diff.identification.tree import Tree
from drake_diff.identification.unknowns import Unknowns
from drake_diff.model.model import Model
from drake_diff.model.plant import joints

SEGMENTS = 12  # of the recording, by which mistakes are compared
FITTED = 3  # mistakes that are fitted whole, of those that come nearest
NEARER = 0.5  # of what the columns as they are leave: a mistake that leaves more is not fitted
FAR = 3.0  # more than a mistake that explains leaves: columns as they are that leave 20 times its squares
EVIDENCE = 20.0  # by which -2 log of the likelihood must fall: of 100 mistakes, by chance in 0.5 % of recordings
SAME = 6.0  # of the same: evidence of 20 to 1, below which two mistakes are not told apart
STEPS, FEW = 20, 8  # of Gauss and Newton


@dataclass(frozen=True, eq=False)
class Mistake:
    """Columns of states and inputs that are right where they are taken in this order, times these factors."""

    words: str
    order: Indices  # (nx + nu,)
    factors: Array  # (nx + nu,)

    def mended(self, piece: Excerpt) -> Excerpt:
        """The piece as it would be without the mistake."""
        nx = piece.ys.shape[1]
        us = piece.us[:, self.order[nx:] - nx] * self.factors[nx:]
        return replace(piece, ys=piece.ys[:, self.order[:nx]] * self.factors[:nx], us=us)


Fitted = Callable[[Sequence[Excerpt]], tuple[float, bool]]  # (-2 log of the likelihood, whether noise is left)


def mistakes(model: Model, chart: Chart, pieces: Sequence[Excerpt]) -> list[Mistake]:
    """Everything that is tried; of what was not measured, and of quaternions, nothing."""
    nq, nx = model.nq, model.nx
    seen = np.any([np.isfinite(piece.ys).any(axis=0) for piece in pieces], axis=0)
    sliding = {model.places(joint)[0].start for joint in joints(model.plant) if joint.type_name() == "prismatic"}
    along = [(i, nq + j) for i, j in chart.coordinates.single if i in sliding]
    along += [(i + 4 + k, nq + j + 3 + k) for i, j in chart.coordinates.free for k in range(3)]
    turning = [(i, nq + j) for i, j in chart.coordinates.single if i not in sliding]
    spins = [nq + j + k for _, j in chart.coordinates.free for k in range(3)]
    inputs, names, hypotheses = range(nx, nx + model.nu), (*model.state_names, *model.input_names), list[Mistake]()

    def add(words: str, columns: Sequence[int], sources: Sequence[int], factor: float = 1.0) -> None:
        order, factors = np.arange(len(names)), np.ones(len(names))
        order[list(columns)], factors[list(columns)] = sources, factor
        hypotheses.append(Mistake(words, order, factors))

    for first, second in (pair for alike in (along, turning) for pair in combinations(alike, 2)):
        pairs = [pair for pair in zip(first, second, strict=True) if seen[list(pair)].all()]
        for some in (*([pair] for pair in pairs), *([pairs] if len(pairs) > 1 else [])):
            words = " and ".join(f"{names[i]} and {names[k]}" for i, k in some)
            columns, sources = [i for pair in some for i in pair], [i for a, b in some for i in (b, a)]
            add(f"columns {words} are exchanged", columns, sources)
    for a, b in combinations(inputs, 2):
        add(f"columns {names[a]} and {names[b]} are exchanged", (a, b), (b, a))
    measured = [[i for i in pair if seen[i]] for pair in (*along, *turning)]
    for alone in (*_sets(*((both, *([i] for i in both)) for both in measured)), *((i,) for i in inputs)):
        add(f"{_listed([names[i] for i in alone])} the opposite sign", alone, alone, -1.0)
    angles = [i for i, _ in turning if seen[i]]
    rates = [i for i in (*(j for _, j in turning), *spins) if seen[i]]
    for group in _sets((angles + rates, angles, rates)):
        add(f"{_listed([names[i] for i in group])} degrees, not radians", group, group, np.pi / 180)
    return hypotheses


def _sets(*groups: Sequence[Sequence[int]]) -> list[tuple[int, ...]]:
    """Each set of columns of each group once, without those that have none."""
    return [columns for group in groups for columns in dict.fromkeys(map(tuple, group)) if columns]


def _listed(names: Sequence[str]) -> str:
    """What has something, and has it or have it: "column a has", "columns a and b have"."""
    if len(names) == 1:
        return f"column {names[0]} has"
    if len(names) > 4:
        return f"{len(names)} columns of angles, {names[0]} to {names[-1]}, have"
    return f"columns {', '.join(names[:-1])} and {names[-1]} have"


def mistaken_columns(
    model: Model, chart: Chart, pieces: Sequence[Excerpt], law: Law, fits: Sequence[Fitted]
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
    model: Model, tree: Tree, chart: Chart, pieces: Sequence[Excerpt], stated: Array
) -> Explanation | None:
    """The same of motions in which nothing touches, in continuous time or by the model's own Euler steps.

    `stated` (2 nv,) is the noise, NaN where it is not known.
    """
    arguments = model, tree, Unknowns((), as_in_files=True)
    periods = np.concatenate([np.diff(piece.times) for piece in pieces]) / model.time_step
    whole = np.round(periods)
    steps = not chart.coordinates.free and np.all(whole > 0) and np.all(np.abs(periods - whole) < CLOCK_TOLERANCE)
    law = TreeMotion(*arguments)
    fits = [partial(_fitted, model, law, chart, stated)]
    if steps:
        euler = EulerMotion(*arguments, model.time_step)
        fits.append(partial(_fitted, model, euler, chart, stated))
    return mistaken_columns(model, chart, pieces, law, fits)


def _left(
    model: Model, law: Law, chart: Chart, pieces: Sequence[Excerpt], candidates: Sequence[Mistake]
) -> list[float]:
    """What some short segments leave without each mistake, from states that are guessed: mean log of 1 + squares."""
    s, nx, losses = cut_segments(law, pieces, model.nu), model.nx, list[float]()
    some = np.unique(np.linspace(0, len(s.first) - 1, SEGMENTS).round().astype(int))
    for candidate in candidates:
        mended = [candidate.mended(piece) for piece in pieces]
        starts = [guess_states(model, chart, mended[s.of_piece[k]], s.first[k : k + 1]) for k in some]
        us = s.us[some][:, :, candidate.order[nx:] - nx] * candidate.factors[nx:]
        noise = noise_by_differences(chart, mended)
        with np.errstate(all="ignore"):
            xs = law.run(np.zeros(0), np.concatenate(starts), s.hs[some], us)
            misses = [
                chart.minus(mended[s.of_piece[k]].ys[s.samples[k]], x[s.at[k]]) / noise
                for k, x in zip(some, xs, strict=True)
            ]
        squares = np.concatenate(misses) ** 2
        known = np.log1p(squares[np.isfinite(squares)])
        losses.append(float(np.mean(known)) if len(known) else np.inf)
    return losses


def _fitted(model: Model, law: Law, chart: Chart, stated: Array, pieces: Sequence[Excerpt]) -> tuple[float, bool]:
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
