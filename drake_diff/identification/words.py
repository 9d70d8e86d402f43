"""What is said of a recording: the change that explains it, or that none does."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff.identification.columns import Mistaken
from drake_diff.identification.race import LONGEST_SEARCH, Race
from drake_diff.identification.screen import LIMIT
from drake_diff.identification.setting import Setting
from drake_diff.identification.trial import Tried

MOST_OF_IT = 0.999  # of the squares that the model leaves: a change that takes them away is told though more is left

NO_CHANGE = "Not explained: no change that was tried explains the recording"


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


def also_touching(found: Explanation, touched: Explanation) -> Explanation:
    """Not explained by motion in which nothing touches, and not by motion in which bodies do."""
    rest = touched.sentence.removeprefix(NO_CHANGE)
    return replace(found, sentence=f"{found.sentence} Where bodies touch, none that was tried explains it either{rest}")


def explained_by(columns: Mistaken) -> Explanation:
    """By columns that are mistaken, and nothing else."""
    others = tuple((words,) for words in columns.alternatives)
    return Explanation((columns.words,), {}, {}, others, True, columns.sentence, columns.evidence)


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


@dataclass(eq=False)
class Words:
    """The sentence for what a search found."""

    setting: Setting
    race: Race
    nearest: Tried | None = None
    alone: Tried | None = None  # the change that left least by itself
    share: float = 0.0  # of the squares, that it takes away

    def said(self, named: Sequence[Tried]) -> Explanation:
        texts = [" and ".join(self.words(one, name) for name in one.names) for one in named]
        both = "this explains" if len(named[0].names) == 1 else "these two explain"
        tail = f": {both} the recording" if len(named) == 1 else ": the recording cannot tell"
        return Explanation(
            names=named[0].names,
            values={name: value for one in reversed(named) for name, value in one.values.items()},
            intervals={name: value for one in reversed(named) for name, value in one.intervals.items()},
            alternatives=tuple(one.names for one in named[1:]),
            explained=True,
            sentence=f"{', or '.join(texts)}{tail}.{self.end}",
            evidence=self.race.evidence,
        )

    def words(self, one: Tried, name: str) -> str:
        label, quantity = name.rsplit(".", 1)
        value, interval = np.atleast_1d(one.values[name]), np.atleast_2d(one.intervals[name])
        if quantity == LIMIT:
            start, unit = self.setting.tree.limits[[self.setting.model.input_names.index(label)]], ""
        else:
            own = next(each for each in self.setting.unknowns.each if each.name == name)
            start, unit = own.start, own.unit
        return changed_to(name, value, interval, start, unit)

    @property
    def end(self) -> str:
        return f" The search was ended after {LONGEST_SEARCH:.3g} s of processor time." if self.race.ended_early else ""

    def right(self) -> Explanation:
        return Explanation((), {}, {}, (), True, "Nothing: the model explains it.", self.race.evidence)

    def unexplained(self, base: Tried) -> Explanation:
        nearest = self.nearest or base
        if self.alone is not None and self.share > MOST_OF_IT:
            one, share = self.alone, 100 * (1 - float(f"{1 - self.share:.1g}"))
            most = " and ".join(self.words(one, name) for name in one.names)
            tail = f"{one.doubt}, and no second change that was tried explains that"
            sentence = f"Not explained, but {share:.10g} % of the squares: {most}; {tail}.{self.end}"
            return Explanation((), {}, {}, (), False, sentence, self.race.evidence)
        near = f"with {' and '.join(nearest.names)}" if nearest.names else "as the model is"
        tried = "no change that was tried" if self.race.ended_early else "no change of one or two quantities"
        sentence = f"Not explained: {tried} explains the recording;"
        sentence = f"{sentence} {near}, {nearest.doubt}.{self.end}"
        return Explanation((), {}, {}, (), False, sentence, self.race.evidence)

    def ended_with(self, said: Explanation, words: str) -> Explanation:
        """With these words at the end of its sentence."""
        before = said.sentence.removesuffix(self.end).removesuffix(".")
        return replace(said, sentence=f"{before}, {words}.{self.end}")
