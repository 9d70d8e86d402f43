"""The evidence for a change of a model: -2 log of the likelihood with the noise estimated anew, and BIC.

In a right model the score falls by a change as chi^2 of as many numbers as the change has. The limit is its quantile at
FALSE_NAME, divided by how many changes were tried, and no less than the penalty of BIC. Of changes that have this
evidence, the one with the least BIC is the smallest.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
from scipy import stats

from drake_diff._base.arrays import Array
from drake_diff.identification.fit import Fit, Solved
from drake_diff.identification.identify import Problem
from drake_diff.identification.judge import freedom_of, intervals_of, known_of, likelihood_of
from drake_diff.identification.messages import changed_to
from drake_diff.identification.recordings import Chart, Piece, noise_by_differences
from drake_diff.identification.results import Explanation
from drake_diff.identification.unknowns import Unknowns
from drake_diff.model.model import Model

FALSE_NAME = 0.003  # of right models in which some change is named
SAME = 6.0  # of a score: evidence of 20 to 1, below which two changes are not told apart
LONGEST_SEARCH = 45.0  # [s] of processor time, after which no further change is tried


class Tried(NamedTuple):
    """A change that was fitted to its end."""

    names: tuple[str, ...]
    score: float
    pull: float  # how far it is from the file's values, as the fit weighs that
    freedom: float
    doubt: str  # why it does not explain the recordings; empty where it does
    values: dict[str, Any]
    intervals: dict[str, Array]
    z: Array
    starts: Array

    @property
    def explains(self) -> bool:
        return not self.doubt


@dataclass(eq=False)
class Ranking:
    """Judges fitted changes of a model, and says which of them have the evidence; it ends after LONGEST_SEARCH."""

    model: Model
    chart: Chart
    pieces: list[Piece]
    stated: Array  # (2 nv,) the noise, NaN where it is not known
    evidence: dict[str, float] = field(default_factory=dict)
    begun: float = field(default_factory=time.process_time)
    ended_early: bool = False
    jumps: ClassVar[bool] = False  # whether the motion jumps, as through impacts

    @property
    def is_late(self) -> bool:
        """Whether no further change is tried."""
        self.ended_early = self.ended_early or time.process_time() - self.begun > LONGEST_SEARCH
        return self.ended_early

    @cached_property
    def count(self) -> int:
        return int(sum(np.isfinite(p.ys).sum() for p in self.pieces))

    @property
    def price(self) -> float:
        """Of each number of a change, by BIC."""
        return float(np.log(self.count))

    @cached_property
    def scatter(self) -> Array:
        return noise_by_differences(self.chart, self.pieces, jumps=self.jumps)

    def problem(self, unknowns: Unknowns, pieces: Sequence[Piece]) -> Problem:
        return Problem(self.model, self.chart, unknowns, list(pieces), self.stated, self.scatter, jumps=self.jumps)

    def judge(self, names: tuple[str, ...], problem: Problem, fit: Fit, solved: Solved) -> Tried:
        unknowns, freedom = problem.unknowns, freedom_of(fit, solved)
        known = known_of(unknowns, solved.z, solved.reduced.R)
        return Tried(
            names,
            likelihood_of(fit, solved, self.stated, self.scatter),
            float(np.sum(((solved.z - unknowns.z_start) / unknowns.widths) ** 2)),
            freedom.of_unknowns,
            problem.doubt(fit, solved, ""),
            unknowns.named(unknowns.values(solved.z)),
            unknowns.named_intervals(intervals_of(unknowns, solved.z, known.covariance, freedom.left)),
            solved.z,
            solved.starts,
        )

    def bic(self, candidate: Tried) -> float:
        return candidate.score + candidate.pull + candidate.freedom * self.price

    def least(self, freedom: float, count: int) -> float:
        """By how much a score must fall, where so many changes were tried."""
        return max(float(stats.chi2.isf(FALSE_NAME / max(count, 1), freedom)), freedom * self.price)

    def enough(self, base: Tried, tried: Sequence[Tried], count: int) -> list[Tried]:
        """The changes that explain and have the evidence, best first, and not told from the best."""
        candidates = [
            candidate
            for candidate in tried
            if candidate.explains and base.score - candidate.score > self.least(max(candidate.freedom, 1.0), count)
        ]
        candidates.sort(key=self.bic)
        return [candidate for candidate in candidates if self.bic(candidate) - self.bic(candidates[0]) < SAME]

    def named(self, named: Sequence[Tried], how: str = "") -> Explanation:
        """The first of some changes with the others as alternatives; `how` says by which motion."""
        texts = [" and ".join(self.changed(candidate, name) for name in candidate.names) for candidate in named]
        explains = "this explains" if len(named[0].names) == 1 else "these two explain"
        tail = f"{explains} the recording" if len(named) == 1 else "the recording cannot tell"
        return Explanation(
            names=named[0].names,
            values={name: value for candidate in reversed(named) for name, value in candidate.values.items()},
            intervals={name: value for candidate in reversed(named) for name, value in candidate.intervals.items()},
            alternatives=tuple(candidate.names for candidate in named[1:]),
            explained=True,
            sentence=self.ended(f"{', or '.join(texts)}: {tail}{how}."),
            evidence=self.evidence,
        )

    def changed(self, candidate: Tried, name: str) -> str:
        value, interval = np.atleast_1d(candidate.values[name]), np.atleast_2d(candidate.intervals[name])
        return changed_to(name, value, interval, *self.of_model(name))

    def of_model(self, name: str) -> tuple[Array, str]:
        """What a quantity is in the model, and its unit."""
        raise NotImplementedError

    def ended(self, sentence: str) -> str:
        """The sentence, with that the search was ended where it was."""
        late = f" The search was ended after {LONGEST_SEARCH:.3g} s of processor time."
        return sentence + late if self.ended_early else sentence

    def nothing(self, how: str = "") -> Explanation:
        """Of a model that is right."""
        return Explanation((), {}, {}, (), True, f"Nothing: the model explains it{how}.", self.evidence)

    def unexplained(self, sentence: str) -> Explanation:
        return Explanation((), {}, {}, (), False, self.ended(sentence), self.evidence)
