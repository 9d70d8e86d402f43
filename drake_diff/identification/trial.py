"""A change where it fits best, with the noise estimated anew, and what evidence there is for it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from drake_diff._base.arrays import Array, frozen
from drake_diff.identification.fit import Fit, Solved
from drake_diff.identification.identify import Problem
from drake_diff.identification.judge import HOPELESS, freedom_of, intervals_of, known_of, noise_of
from drake_diff.identification.measured import Piece
from drake_diff.identification.motion import Law
from drake_diff.identification.setting import Setting
from drake_diff.identification.unknowns import Unknowns

FALSE_NAME = 0.003  # of right models in which some change is named
STEPS, ROUNDS = 8, 4  # of Gauss and Newton, and of estimating the noise
SAME_NOISE = 0.03  # what is left of its error changes a score by less than 0.001 of how many numbers were measured
SAME = 6.0  # of a score: evidence of 20 to 1, below which two changes are not told apart


class Tried(NamedTuple):
    """A change that was fitted to its end."""

    names: tuple[str, ...]
    score: float
    pull: float  # how far it is from the file's values, as the fit weighs that
    freedom: float
    explains: bool
    doubt: str
    values: dict[str, Any]
    intervals: dict[str, Array]
    z: Array
    starts: Array


@dataclass(frozen=True, eq=False)
class Trial:
    """Fits changes of a model, and says which of them have the evidence."""

    setting: Setting

    def solved(
        self,
        names: tuple[str, ...],
        unknowns: Unknowns,
        law: Law,
        pieces: Sequence[Piece],
        starts: Array,
        z: Array,
        most: int = STEPS,
    ) -> Tried:
        problem = self.setting.problem(unknowns, pieces)
        fit = self.followed(problem, problem.fit(law, pieces, problem.first_noise), z, starts)
        law = fit.law
        for _ in range(ROUNDS):
            solved = fit.solve(z, starts, most)
            z, starts = solved.z, solved.starts
            shorter = fit.shorter
            if shorter is not None and not problem.follows(fit, z, starts):
                solved = replace(solved, converged=False, why="its steps are too long for the motion")
                fit = problem.fit(shorter, pieces, fit.noise)
                continue
            size = noise_of(fit, solved)
            seen = np.isfinite(size)
            if np.any(size[seen] > HOPELESS * problem.first_noise[seen]):
                solved = replace(solved, converged=True)
                break
            jumps = solved.stuck and unknowns.delay is not None and fit.law is law
            if shorter is not None and jumps:  # stiff motions do, between two counts of steps that a delay cuts
                fit = problem.fit(shorter, pieces, fit.noise)
                continue
            noise = np.where(
                np.isfinite(self.setting.stated), self.setting.stated, np.fmax(size, 1e-3 * self.setting.scatter)
            )
            if solved.converged and np.max(np.abs(noise[seen] / fit.noise[seen] - 1)) < SAME_NOISE:
                break
            fit = problem.fit(fit.law, pieces, noise)
        return self.told(names, problem, fit, solved)

    def followed(self, problem: Problem, fit: Fit, z: Array, starts: Array) -> Fit:
        """By steps short enough for the motion there: a search by longer ones takes long, and leads nowhere."""
        for _ in range(ROUNDS):
            shorter = fit.shorter
            if shorter is None or problem.follows(fit, z, starts):
                break
            fit = fit.by(shorter)
        return fit

    def score(self, fit: Fit, solved: Solved) -> float:
        """-2 log of the likelihood with the noise that the residuals show, where none was given."""
        every = np.concatenate(solved.reduced.residuals)
        numbers = np.isfinite(every).sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            size = fit.noise * np.sqrt(np.nansum(every**2, axis=0) / numbers)
            noise = np.where(
                np.isfinite(self.setting.stated), self.setting.stated, np.fmax(size, 1e-3 * self.setting.scatter)
            )
            each = numbers * ((size / noise) ** 2 + 2 * np.log(noise))
        return float(np.sum(each[numbers > 0]))

    def told(self, names: tuple[str, ...], problem: Problem, fit: Fit, solved: Solved) -> Tried:
        unknowns = problem.unknowns
        count, taken = freedom_of(fit, solved)
        _, alone = freedom_of(problem.fit(fit.law, fit.segments.pieces, fit.noise, fixed=True), solved)
        known = known_of(unknowns, solved.z, solved.reduced.R)
        intervals = intervals_of(unknowns, solved.z, known.covariance, count - taken)
        doubt = problem.doubt(fit, solved, "")
        with np.errstate(divide="ignore"):
            pull = float(np.sum(((solved.z - unknowns.z_start) / unknowns.widths) ** 2))
        shaped = {
            one.name: frozen(intervals[s][0] if len(one.start) == 1 else intervals[s])
            for one, s in zip(unknowns.each, unknowns.slices, strict=True)
        }
        values = unknowns.named(unknowns.values(solved.z))
        own = solved.z, solved.starts
        return Tried(names, self.score(fit, solved), pull, taken - alone, not doubt, doubt, values, shaped, *own)

    def bic(self, one: Tried) -> float:
        return one.score + one.pull + one.freedom * float(np.log(self.setting.count))

    def least(self, freedom: float, count: int) -> float:
        """By how much a score must fall, where so many changes were tried."""
        return max(
            float(stats.chi2.isf(FALSE_NAME / max(count, 1), freedom)), freedom * float(np.log(self.setting.count))
        )

    def enough(self, base: Tried, tried: Sequence[Tried], count: int) -> list[Tried]:
        """The changes that explain and have the evidence, best first, and not told from the best."""
        found = []
        for one in tried:
            freedom = max(one.freedom, 1.0)
            if one.explains and base.score - one.score > self.least(freedom, count):
                found.append(one)
        found.sort(key=self.bic)
        return [one for one in found if self.bic(one) - self.bic(found[0]) < SAME]
