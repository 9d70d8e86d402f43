"""Detection of mistaken columns of a recording: two exchanged, one with the wrong sign, or degrees instead of radians.

Each mistake is a permutation of the columns with factors, and has no parameter to fit. Short segments of the motion
show which mistakes agree better with the model than the given columns. Those few are fitted to whole recordings, with
only their first states unknown. A mistake is named if only noise remains without it, but not with the given columns.
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
from drake_diff.identification.recordings import Excerpt, guess_states, noise_by_differences
from drake_diff.identification.results import Explanation
from drake_diff.identification.tree import Tree
from drake_diff.identification.unknowns import Unknowns
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.tangent import tangent_space

SEGMENTS = 12  # of the recording, on which mistakes are compared
FITTED = 3  # number of best mistakes that are fitted to whole recordings
NEARER = 0.5  # fraction of the loss of the given columns: a mistake with a larger loss is not fitted
FAR = 3.0  # difference of losses (20 times the squared residuals) above which the given columns are not fitted
EVIDENCE = 20.0  # required decrease of -2 log likelihood: by chance in 0.5 % of recordings, for 100 mistakes
SAME = 6.0  # difference of -2 log likelihood (odds of 20 to 1) below which two mistakes are not distinguished
STEPS, FEW = 20, 8  # maximum numbers of Gauss-Newton steps: of a full fit, and of a first one


@dataclass(frozen=True, eq=False)
class Mistake:
    """A mistake in the columns of states and inputs, which this order and these factors correct."""

    words: str
    order: Indices  # (nx + nu,)
    factors: Array  # (nx + nu,)

    def mended(self, piece: Excerpt) -> Excerpt:
        """Return the piece without the mistake."""
        nx = piece.ys.shape[1]
        us = piece.us[:, self.order[nx:] - nx] * self.factors[nx:]
        return replace(piece, ys=piece.ys[:, self.order[:nx]] * self.factors[:nx], us=us)


Fitted = Callable[[Sequence[Excerpt]], tuple[float, bool]]  # (-2 log likelihood, whether the residuals are noise)


def mistakes(model: Model, pieces: Sequence[Excerpt]) -> list[Mistake]:
    """Return all mistakes to try; unmeasured columns and quaternions have none."""
    nq, nx, coordinates = model.nq, model.nx, coordinates_of(model)
    seen = np.any([np.isfinite(piece.ys).any(axis=0) for piece in pieces], axis=0)
    sliding = {model.places(joint)[0].start for joint in joints(model.plant) if joint.type_name() == "prismatic"}
    along = [(i, nq + j) for i, j in coordinates.single if i in sliding]
    along += [(i + 4 + k, nq + j + 3 + k) for i, j in coordinates.free for k in range(3)]
    turning = [(i, nq + j) for i, j in coordinates.single if i not in sliding]
    spins = [nq + j + k for _, j in coordinates.free for k in range(3)]
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
    """Return each set of columns of each group once, without empty sets."""
    return [columns for group in groups for columns in dict.fromkeys(map(tuple, group)) if columns]


def _listed(names: Sequence[str]) -> str:
    """Return the columns with their verb: "column a has", "columns a and b have"."""
    if len(names) == 1:
        return f"column {names[0]} has"
    if len(names) > 4:
        return f"{len(names)} columns of angles, {names[0]} to {names[-1]}, have"
    return f"columns {', '.join(names[:-1])} and {names[-1]} have"


def mistaken_columns(model: Model, pieces: Sequence[Excerpt], law: Law, fits: Sequence[Fitted]) -> Explanation | None:
    """Find the mistake that explains the recordings, or return None if none does or the given columns are explained.

    `law` simulates short segments. Each of `fits` measures how well the unchanged model follows whole recordings.
    """
    every = mistakes(model, pieces)
    none = Mistake("", np.arange(model.nx + model.nu), np.ones(model.nx + model.nu))
    left, *others = _left(model, law, pieces, [none, *every])
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


def mistaken_in_the_air(model: Model, tree: Tree, pieces: Sequence[Excerpt], stated: Array) -> Explanation | None:
    """Find such a mistake in motions without contact, in continuous time or with the model's own Euler steps.

    `stated` (2 nv,) is the given noise, NaN if unknown.
    """
    arguments = model, tree, Unknowns((), as_in_files=True)
    periods = np.concatenate([np.diff(piece.times) for piece in pieces]) / model.time_step
    whole = np.round(periods)
    steps = not tree.coordinates.free and np.all(whole > 0) and np.all(np.abs(periods - whole) < CLOCK_TOLERANCE)
    law = TreeMotion(*arguments)
    fits = [partial(_fitted, model, law, stated)]
    if steps:
        euler = EulerMotion(*arguments, model.time_step)
        fits.append(partial(_fitted, model, euler, stated))
    return mistaken_columns(model, pieces, law, fits)


def _left(model: Model, law: Law, pieces: Sequence[Excerpt], candidates: Sequence[Mistake]) -> list[float]:
    """Return the loss of short segments without each mistake, from guessed states: the mean of log(1 + r^2)."""
    s, nx, losses = cut_segments(law, pieces, model.nu), model.nx, list[float]()
    some = np.unique(np.linspace(0, len(s.first) - 1, SEGMENTS).round().astype(int))
    for candidate in candidates:
        mended = [candidate.mended(piece) for piece in pieces]
        starts = [guess_states(model, mended[s.of_piece[k]], s.first[k : k + 1]) for k in some]
        us = s.us[some][:, :, candidate.order[nx:] - nx] * candidate.factors[nx:]
        noise = noise_by_differences(model, mended)
        with np.errstate(all="ignore"):
            xs = law.run(np.zeros(0), np.concatenate(starts), s.hs[some], us)
            misses = [
                tangent_space(model).minus(mended[s.of_piece[k]].ys[s.samples[k]], x[s.at[k]]) / noise
                for k, x in zip(some, xs, strict=True)
            ]
        squares = np.concatenate(misses) ** 2
        known = np.log1p(squares[np.isfinite(squares)])
        losses.append(float(np.mean(known)) if len(known) else np.inf)
    return losses


def _fitted(model: Model, law: Law, stated: Array, pieces: Sequence[Excerpt]) -> tuple[float, bool]:
    """Return (-2 log likelihood with the noise of the residuals, whether the residuals are noise).

    The fit ends early if the first few steps leave residuals far above noise.
    """
    nothing = Unknowns((), as_in_files=True)
    problem = Problem(model, nothing, list(pieces), stated, noise_by_differences(model, pieces))
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            fit, starts = problem.prepared(law)
            size = noise_of(fit, fit.solve(problem.unknowns.z_first, starts, FEW))
            if np.any(size[np.isfinite(size)] > HOPELESS * problem.first_noise[np.isfinite(size)]):
                return np.inf, False
            fit, solved = problem.solve(law, STEPS)
    except (DrakeDiffError, np.linalg.LinAlgError):  # the motion overflows
        return np.inf, False
    score = likelihood_of(fit, solved, stated, problem.scatter)
    return score, not problem.doubt(fit, solved, "")
