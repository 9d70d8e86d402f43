"""The smallest change of a model that explains what was recorded: one parameter, or two, or what no file has.

One pass of derivatives along the measured motion says what every change promises, and every pair. Those that promise
most go on by steps of Gauss and Newton of their own for as long as these help; what comes near the noise is fitted,
with the noise estimated anew. Beside the single changes that left least, a second one is sought in a pass of
derivatives with the first one made: a large change bends what others promise. A change is named where

    score(model) - score(changed) > limit,

scores being -2 log of the likelihood with the noise estimated anew. In a right model the difference is distributed as
chi^2 of as many numbers as the change has; the limit is its quantile at FALSE_NAME, divided by how many changes were
tried, and no less than the penalty of BIC. Of changes that are named, the one with the least BIC is the smallest.
"""

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff._base.refusal import Refusal
from drake_diff.comparison.recordings import Recording
from drake_diff.exceptions import ModelError, SimulationError, UnknownNameError
from drake_diff.identification.chart import Chart
from drake_diff.identification.columns import Mistaken, mistaken_in_the_air
from drake_diff.identification.dry import DryMotion
from drake_diff.identification.euler import EulerMotion
from drake_diff.identification.fit import Fit, Law, Point, Solved
from drake_diff.identification.flow import ROUGH, ContinuousMotion
from drake_diff.identification.frozen import FrozenMotion
from drake_diff.identification.identify import LONGEST, Problem, what_acts
from drake_diff.identification.judge import freedom_of, intervals_of, known_of, most_scatter, noise_of
from drake_diff.identification.measured import Piece, given_noise, noise_by_differences, read_pieces
from drake_diff.identification.screen import (
    DELAY,
    LEVELS,
    LIMIT,
    LONGEST_DELAY,
    Inputs,
    Promise,
    View,
    changes_of_inputs,
    view,
)
from drake_diff.identification.tree import Tree, tree_for_identification
from drake_diff.identification.unknowns import (
    BIAS,
    COULOMB,
    HELD_DAMPING,
    HELD_INERTIA,
    Unknown,
    Unknowns,
    choose_unknowns,
    possible_changes,
)
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.model import Model

FALSE_NAME = 0.003  # of right models in which some change is named
LOOKED_AT = 8  # changes that enter the race, of those that promise most: of those of one number, and of others
RACE = (5, 4, 3, 2, 2, 1)  # so many stay after each step of Gauss and Newton
FALLS = 0.7  # what does not fall to this part of what was left before is out of the race, after its first step
BESIDE, LOOKED_AT_BESIDE = 3, 4  # changes beside which a second one is sought, and how many of these go on
PARTS = (1, 2, 4, 5, 10, 20)  # of a sample: Euler steps that are tried
TIME_STEP = "time_step"
HELD_BY, CAUGHT = 10.0, 100.0  # times its own inertia; [1/s]: friction that gives way, where its search begins
MOST_OF_IT = 0.999  # of the squares that the model leaves: a change that takes them away is told though more is left
LONGEST_SEARCH = 45.0  # [s] of processor time, after which no further change is tried
STEPS, ROUNDS = 8, 4  # of Gauss and Newton, and of estimating the noise
SETTLING, SETTLES = 8, 0.8  # steps by which segments settle, and the part of what was left that each must leave at most
CALM = 3e-3  # of a small motion over a segment: by how much derivatives frozen halfway may miss it
SAME_NOISE = 0.03  # what is left of its error changes a score by less than 0.001 of how many numbers were measured
HOPELESS = 3.0  # times the noise: residuals that no better weights make good
PLAUSIBLE = 1.5  # times the squares that can be noise: what leaves more is not fitted to its end beside another
SAME = 6.0  # of a score: evidence of 20 to 1, below which two changes are not told apart
MOTIONS = ("auto", "continuous")
CLOSE = 1.0  # of the squares: what a step may still gain where two changes are told apart
TOLD_APART = 40.0  # of the squares: what leaves so much more than a change that explains is not fitted to its end
DELAYS_SEEN, NEAR = 4, 0.02  # passes of derivatives beside a delay, and of it how near two of them are at the end
BEHIND = 4.0  # times the least that is promised: of what is beyond, LOOKED_AT_BESIDE enter the race
SHORTEST_DELAY = 1e-4  # [s] beside which another change is looked for
DELAYS = (0.25, 0.75, 1.5, 3, 5.5, 8)  # of a sample, from which other changes are looked for beside a delay


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


def explain(
    model: Model,
    recordings: Recording | str | Path | Sequence[Recording | str | Path],
    *,
    noise: Mapping[str, float] | None = None,
    motion: str = "auto",
) -> Explanation:
    """Name the smallest change of a model that explains recordings of its motion.

    Each parameter is tried alone: masses, centres of mass, inertias, dampings, springs, rotor inertias, offsets of
    joints and gravity; and what is no parameter of a file: dry friction, the strength and the limit of each input, a
    delay of all inputs, and biases of sensors. Before these, mistaken columns are tried: two that are exchanged, one
    with the other sign, degrees where radians belong. Where none of them explains the recordings alone, semi-implicit
    Euler steps of several lengths are tried, with one change or none, and then pairs.

    Args:
        model: The model.
        recordings: As for `dd.identify`.
        noise: The standard deviation of the noise of states, by name. What is not given is estimated.
        motion: "continuous" looks at motions in which bodies touch or a joint is beyond its limit as if these did
            nothing; "auto" refuses them.

    Returns:
        `.names`, `.values` with `.intervals` (95 %), `.alternatives` that the recordings cannot tell from it, and a
        `.sentence`. No names with `.explained`: the model is right as far as the recordings can tell. No names without
        it: no change of one or two numbers explains them.

    Raises:
        InputError, UnknownNameError, ShapeError, NonFiniteError: A recording is not one of this model.
        ModelError: The model has no motion in continuous time there: bodies touch, a joint is beyond its limit, or
            controllers or constraints act.

    Source:
        BIC: Schwarz, "Estimating the dimension of a model" (1978).

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.0001)
        >>> motion = dd.rollout(model, [1.0, 0.0], np.zeros((15000, 1)), parameters={"hinge.damping": 0.2})
        >>> measured = motion.xs[::100] + 1e-3 * np.random.default_rng(0).standard_normal((151, 2))
        >>> log = dd.Recording("lab", "1", 0.01 * np.arange(151), measured, np.zeros((150, 1)))
        >>> w = dd.explain(model, log)
        >>> sorted([w.names, *w.alternatives])
        [('hinge.damping',), ('pole.mass',)]
    """
    if motion not in MOTIONS:
        raise UnknownNameError("motion", got=motion, known=MOTIONS)
    chart, pieces = Chart(coordinates_of(model)), read_pieces(model, recordings, 0.0)
    tree = tree_for_identification(model)
    if not isinstance(tree, Refusal):
        columns = mistaken_in_the_air(model, tree, chart, pieces, given_noise(model, chart, noise))
        if columns is not None:
            return explained_by(columns)
    why = str(tree) if isinstance(tree, Refusal) else what_acts(model, chart, pieces) if motion == "auto" else ""
    if why or isinstance(tree, Refusal):
        raise ModelError(f"{model.name}: causes are looked for in motions in continuous time only, and {why}")
    return _Search(model, tree, chart, pieces, given_noise(model, chart, noise)).found()


def explained_by(columns: Mistaken) -> Explanation:
    """By columns that are mistaken, and nothing else."""
    others = tuple((words,) for words in columns.alternatives)
    return Explanation((columns.words,), {}, {}, others, True, columns.sentence, columns.evidence)


class _Tried(NamedTuple):
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


@dataclass(eq=False)
class _Runner:
    """A change on its way to where it fits best, by whole steps of Gauss and Newton."""

    names: tuple[str, ...]
    fit: Fit
    z: Array
    starts: Array
    left: float  # of the squares, after the next step
    freedom: float
    special: dict[str, float] = field(default_factory=dict)  # the limit that its pieces have
    interval: dict[str, Array] = field(default_factory=dict)

    def step(self) -> bool:
        """Whether there is a motion to step from."""
        point = self.fit.at(self.z, self.starts)
        if point is None:
            return False
        found = self.fit.reduce(point)
        if not np.all(np.isfinite(found.R)) or not np.all(np.isfinite(found.b)):
            return False
        dz = self.fit.step_of(self.z, found)
        self.starts = self.fit.moved(self.starts, found, dz, 1.0)
        self.z = self.z + dz
        pull = float(np.sum(((self.z - self.fit.unknowns.z_start) / self.fit.unknowns.widths) ** 2))
        self.left = found.rest + float(np.sum((found.b - found.R @ dz) ** 2)) + pull
        return True


@dataclass(eq=False)
class _Search:
    model: Model
    tree: Tree
    chart: Chart
    pieces: list[Piece]
    stated: Array
    evidence: dict[str, float] = field(default_factory=dict)
    nearest: _Tried | None = None
    alone: _Tried | None = None  # the change that left least by itself
    share: float = 0.0  # of the squares, that it takes away
    begun: float = field(default_factory=time.process_time)
    ended_early: bool = False
    by_delay: dict[float, Array] = field(default_factory=dict)
    calm: bool = False  # whether steps frozen halfway have the derivatives of the motion
    step: float | None = None  # [s] of the Euler steps that stand for the motion; None for continuous time

    @cached_property
    def scatter(self) -> Array:
        return noise_by_differences(self.chart, self.pieces)

    @cached_property
    def unknowns(self) -> Unknowns:
        """Everything that is tried, and a column for each limit and the delay."""
        measured = np.any([np.isfinite(p.ys).any(axis=0) for p in self.pieces], axis=0)
        singles = {i for i, _ in self.chart.coordinates.single} | set(range(self.model.nq, self.model.nx))
        states = (*self.model.position_names, *self.model.velocity_names)
        names = []
        for name in possible_changes(self.model, self.tree):
            label, quantity = name.rsplit(".", 1)
            if quantity == BIAS:
                i = states.index(label)
                if not measured[i] or i not in singles:
                    continue
            names.append(name)
        each = choose_unknowns(self.model, self.tree, names).each
        return Unknowns((*each, *changes_of_inputs(self.model.input_names, self.pieces)), as_in_files=True)

    def of(self, names: Sequence[str]) -> Unknowns:
        """Those called so; where inputs act later, the motion has its steps cut where they change."""
        each = (one for one in self.unknowns.each if one.name in names)
        return Unknowns(tuple(replace(one, shifts=one.quantity == DELAY) for one in each), as_in_files=True)

    def problem(self, unknowns: Unknowns, pieces: Sequence[Piece]) -> Problem:
        return Problem(self.model, self.chart, unknowns, list(pieces), self.stated, self.scatter)

    def law(self, unknowns: Unknowns, longest: float) -> ContinuousMotion:
        own = self.model, self.tree, self.chart, unknowns
        if self.step is not None:
            return EulerMotion(*own, self.step)
        # Dry friction turns within less than a step, which halfway says nothing of.
        turns = unknowns is not self.unknowns and any(one.quantity == COULOMB for one in unknowns.each)
        return FrozenMotion(*own, longest) if self.calm and not turns else ContinuousMotion(*own, longest)

    def law_of(self, unknowns: Unknowns) -> ContinuousMotion:
        """With dry friction that holds."""
        law = self.law(unknowns, self.longest)
        dry = [one.label for one in unknowns.each if one.quantity == COULOMB]
        if not dry or self.step is not None or self.tree.dynamics.coupling is not None:
            return law
        at = {link.joint.joint: link.joint.v_start for link in self.tree.links}
        own = self.model, self.tree, self.chart, unknowns, self.longest
        gives = any(one.quantity == HELD_INERTIA for one in unknowns.each)
        return DryMotion(*own, joints=tuple(at[joint] for joint in dry), gives=gives, calm=self.calm)

    @staticmethod
    def each_of(unknowns: Unknowns) -> list[tuple[Unknown, slice]]:
        return list(zip(unknowns.each, unknowns.slices, strict=True))

    def prepare(self) -> None:
        """Steps, pieces and starts of segments with which the model as it is follows what was measured."""
        nothing = self.of(())
        fit, starts = self.problem(nothing, self.pieces).prepared(self.law(nothing, LONGEST))
        longest = fit.law.longest if isinstance(fit.law, ContinuousMotion) else LONGEST
        self.longest, self.segments, self.cut = longest, fit.segments, list(fit.segments.pieces)
        self.starts = self.settled(fit, nothing.z_start, starts)
        self.calm = self.is_calm(fit)

    def found(self) -> Explanation:
        self.prepare()
        found, base, alone, runners = self.by_one()
        if found is None and not base.explains:
            found = self.by_friction_that_gives(runners, base)
        if found is None and not base.explains and not self.is_late and self.may_be_steps(runners):
            found = self.by_steps(base)
        if found is None and not base.explains and not self.is_late:
            found = self.by_two(alone, runners, base)
        return found or (self.right() if base.explains else self.unexplained(base))

    def settled(self, fit: Fit, z: Array, starts: Array) -> Array:
        """Starts of the segments from which the motion is nearer to what each of them measured, by itself.

        A guess by cubics knows nothing of inputs, which may change a velocity within a few samples.
        """
        s = fit.segments
        last = [len(s.pieces[p].times) - 1 for p in s.of_piece]
        ends = [
            int(b) if p == q else n
            for b, p, q, n in zip(s.first[1:], s.of_piece[:-1], s.of_piece[1:], last[:-1], strict=True)
        ]
        parts = [s.pieces[p].part(int(a), b) for a, b, p in zip(s.first, [*ends, last[-1]], s.of_piece, strict=True)]
        own = Fit(self.model, fit.law, self.chart, fit.unknowns, parts, fit.noise, fixed=True)
        left = np.inf
        for _ in range(SETTLING):
            here = own.at(z, starts)
            if here is None or here.value > SETTLES * left:
                break
            found, left = own.reduce(here), here.value
            best = _each_left(here)
            for part in (1.0, 0.3):
                moved = own.moved(here.starts, found, np.zeros_like(z), part)
                there = own.at(z, moved)
                if there is not None:
                    better = _each_left(there) < best
                    starts, best = np.where(better[:, None], moved, starts), np.where(better, _each_left(there), best)
        return starts

    def starts_at(self, delay: float) -> Array:
        """The starts of segments that settle where inputs act so much later."""
        known = self.by_delay if self.step is None else {}
        if delay not in known:
            late = self.of([f"model.{DELAY}"])
            law = self.law(late, self.longest)
            if self.step is None:
                law = FrozenMotion(self.model, self.tree, self.chart, late, self.longest, method=ROUGH)
            problem = self.problem(late, self.cut)
            near = min(known, key=lambda other: abs(other - delay), default=0.0)
            starts = known[near] if abs(near - delay) < delay else self.starts
            known[delay] = self.settled(problem.fit(law, self.cut, problem.first_noise), np.array([delay]), starts)
        return known[delay]

    def is_calm(self, fit: Fit) -> bool:
        """Whether a small motion goes through segments alike by steps frozen halfway, and by the method's own."""
        s, z = fit.segments, fit.unknowns.z_start
        some = slice(None, None, 2)  # of the segments
        xs = fit.law.run(fit.unknowns.values(z), self.starts[some], s.hs[some], s.us[some])
        frozen = FrozenMotion(self.model, self.tree, self.chart, fit.unknowns, self.longest)
        whole = []
        for law in (fit.law, frozen):
            steps, _ = law.slopes(z, xs, s.hs[some], s.us[some])
            through = self.chart.from_motion(xs[:, 0])
            for m in range(steps.shape[1]):
                through = steps[:, m] @ through
            whole.append(self.chart.to_motion(xs[:, -1]) @ through * fit.gap_scale / fit.gap_scale[:, None])
        off, size = (np.linalg.norm(each, axis=(1, 2)) for each in (whole[0] - whole[1], whole[0]))
        return bool(np.all(off <= CALM * size))

    def by_one(self) -> tuple[Explanation | None, _Tried, View, list[_Runner]]:
        nothing = self.of(())
        one = self.running((), nothing, self.cut, self.starts, nothing.z_start, Promise((), np.inf, 0.0, np.zeros(0)))
        before = np.inf
        while one.step() and self.is_hopeless(one.left) and one.left < FALLS * before:
            before = one.left
        most = 1 if self.is_hopeless(one.left) else STEPS
        base = self.solved((), nothing, one.fit.law, self.cut, self.starts if most == 1 else one.starts, one.z, most)
        alone = self.view(self.cut, self.unknowns.z_start, base.starts if base.explains else self.starts)
        if alone is None:
            raise SimulationError(f"{self.model.name} has no motion near the states that were measured")
        count = len(alone.freedoms)
        singles, runners = self.tried(alone, [(i,) for i in range(count)], base)
        named = self.enough(base, singles, count)
        self.nearest = min([self.nearest or base, base, *singles], key=self.bic)
        best = min(singles, key=self.bic, default=None)
        if self.step is None and best is not None:
            left = next(one.left for one in runners if one.names == best.names)
            self.alone, self.share = best, 1 - left / alone.most
        return self.said(named) if named else None, base, alone, runners

    @property
    def is_late(self) -> bool:
        """Whether no further change is tried."""
        self.ended_early = self.ended_early or time.process_time() - self.begun > LONGEST_SEARCH
        return self.ended_early

    def by_friction_that_gives(self, runners: Sequence[_Runner], base: _Tried) -> Explanation | None:
        """Where dry friction of a joint left least, and not noise: the same, which gives way where it holds."""
        if not runners or self.is_late or self.tree.dynamics.coupling is not None:
            return None
        one = runners[0]
        if len(one.names) > 1 or not one.names[0].endswith(f".{COULOMB}"):
            return None
        label, nq = one.names[0].rsplit(".", 1)[0], self.model.nq
        x = one.starts[:1]
        mass, _ = self.tree.pushed(self.tree.numbers)(x[:, :nq], x[:, nq:], np.zeros((1, self.model.nu)), None)
        j = next(link.joint.v_start for link in self.tree.links if link.joint.joint == label)
        inertia = HELD_BY / float(np.linalg.inv(mass)[0, j, j])
        held = [
            Unknown(f"{label}.{quantity}", unit, np.array([start]), 0.0, start)
            for quantity, unit, start in ((HELD_INERTIA, "", inertia), (HELD_DAMPING, "", CAUGHT * inertia))
        ]
        unknowns = Unknowns((*self.of(one.names).each, *held), as_in_files=True)
        z = np.concatenate([one.z, unknowns.z_start[1:]])
        try:
            found = self.solved(one.names, unknowns, self.law_of(unknowns), self.cut, one.starts, z)
        except (SimulationError, np.linalg.LinAlgError):  # its motion grows beyond what numbers hold
            return None
        self.nearest = min([self.nearest or base, found], key=self.bic)
        named = self.enough(base, [found], len(self.unknowns.each))
        if not named:
            return None
        more, slower = (float(found.values[each.name]) for each in held)
        own = {name: found.values[name] for name in one.names}, {name: found.intervals[name] for name in one.names}
        said = self.said([found._replace(values=own[0], intervals=own[1])])
        way = f"as if by {more:.3g} more of inertia and {slower:.3g} of damping"
        return self.ended_with(said, f"with friction that gives way where it holds, {way}")

    def ended_with(self, said: Explanation, words: str) -> Explanation:
        """With these words at the end of its sentence."""
        before = said.sentence.removesuffix(self.end).removesuffix(".")
        return replace(said, sentence=f"{before}, {words}.{self.end}")

    def by_two(self, alone: View, runners: Sequence[_Runner], base: _Tried) -> Explanation | None:
        count = len(alone.freedoms)
        pairs = self.paired(alone, runners, base)
        named = self.enough(base, pairs, count * (count - 1) // 2)
        if named:
            named = self.enough(base, [*self.halves(named), *named], count * (count - 1) // 2)
        self.nearest = min([self.nearest or base, *pairs], key=self.bic)
        return self.said(named) if named else None

    def halves(self, pairs: Sequence[_Tried]) -> list[_Tried]:
        """Each change of some pairs alone, from where the pair was: the other one may do nothing."""
        found: dict[str, _Tried] = {}
        for pair in pairs:
            unknowns = self.of([name for name in pair.names if not name.endswith(f".{LIMIT}")])
            for one, s in self.each_of(unknowns) if len(unknowns.each) == 2 else []:
                if one.name not in found:
                    alone = self.of([one.name])
                    law = self.law_of(alone)
                    found[one.name] = self.solved((one.name,), alone, law, self.cut, pair.starts, pair.z[s])
        return list(found.values())

    @property
    def steps(self) -> list[float]:
        """[s] lengths of steps of which a whole number lies between samples."""
        period = np.concatenate([np.diff(piece.times) for piece in self.cut])
        if self.chart.coordinates.free or np.ptp(period) > 1e-6 * np.mean(period):
            return []
        return [float(np.mean(period)) / n for n in PARTS]

    def may_be_steps(self, runners: Sequence[_Runner]) -> bool:
        """Whether Euler steps leave clearly less than continuous time, of the model or of a change that left least."""
        whole = [one for one in runners if not one.special and one.fit.unknowns.delay is None]
        whole = [one for one in whole if np.isfinite(one.left)][:BESIDE]
        nothing = self.of(())
        each: list[tuple[tuple[str, ...], Unknowns, Array, Array]] = [((), nothing, nothing.z_start, self.starts)]
        each += [(one.names, one.fit.unknowns, one.z, one.starts) for one in whole]
        for names, unknowns, z, starts in each:
            before = self.left_by(None, names, unknowns, z, starts)
            after = min((self.left_by(step, names, unknowns, z, starts) for step in self.steps), default=np.inf)
            if after < FALLS * before or not self.is_hopeless(after):
                return True
        return False

    def left_by(self, step: float | None, names: tuple[str, ...], unknowns: Unknowns, z: Array, starts: Array) -> float:
        """What a step of Gauss and Newton leaves of the squares by Euler steps of this length."""
        self.step = step
        one = self.running(names, unknowns, self.cut, starts, z, Promise((), np.inf, 0.0, np.zeros(0)))
        left = one.left if one.step() else np.inf
        self.step = None
        return left

    def by_steps(self, base: _Tried) -> Explanation | None:
        """By Euler steps of a length, with one other change or none."""
        nothing, left = self.of(()), dict[float, float]()
        promise = Promise((), 0.0, 0.0, np.zeros(0))
        for step in self.steps:
            self.step = step
            one = self.running((), nothing, self.cut, self.starts, nothing.z_start, promise)
            seen = self.view(self.cut, self.unknowns.z_start, one.starts) if one.step() else None
            if seen is not None:
                each = seen.promises([(i,) for i in range(len(seen.freedoms))], float(np.log(self.count)))
                left[step] = each[0].left if each else seen.most
        self.step = min(left, key=left.__getitem__, default=None)
        if self.step is None:
            return None
        name, own = f"model.{TIME_STEP}", abs(self.step / self.model.time_step - 1) < 1e-6
        try:
            found, stepped, _, _ = self.by_one()
        finally:
            step, self.step = self.step, None
        if found is None and not (stepped.explains and base.score - stepped.score > self.least(1.0, len(self.steps))):
            return None
        steps = f"semi-implicit Euler steps of {1e3 * step:.4g} ms"
        if own:
            steps += ", as the model makes them"
        more = () if own else (name,)
        if found is None:
            sentence = f"{'Nothing: the model' if own else name} explains it, by {steps}."
            if not own:
                sentence = f"{name} is {step:.4g} s, not {self.model.time_step:.4g}: {steps} explain the recording."
            values = {} if own else {name: step}
            within = {} if own else {name: frozen([step, step])}
            return Explanation(more, values, within, (), True, sentence, self.evidence)
        return replace(
            self.ended_with(found, f"by {steps}"),
            names=(*found.names, *more),
            values={**found.values, **({} if own else {name: step})},
            intervals={**found.intervals, **({} if own else {name: frozen([step, step])})},
            alternatives=tuple((*names, *more) for names in found.alternatives),
        )

    def paired(self, alone: View, runners: Sequence[_Runner], base: _Tried) -> list[_Tried]:
        """Pairs that promise most at the model, or beside a change that left least."""
        count = len(alone.freedoms)
        names = [one.name for one in self.unknowns.each]
        own = [i for i, name in enumerate(names) if not self.is_of_inputs(self.plain(name))]
        found, _ = self.tried(alone, combinations(own, 2), base)
        if not any(one.explains for one in found) and not self.is_late:
            found += self.beside_a_delay(base)
        for runner in runners[:BESIDE]:
            if any(one.explains for one in found) or self.is_late:
                break
            if runner.fit.unknowns.delay is not None:
                continue
            if runner.special:
                found += self.beside_inputs(runner, base)
                continue
            i = names.index(runner.names[0])
            z = self.unknowns.z_start.copy()
            z[self.unknowns.slices[i]] = runner.z
            seen = self.view(self.cut, z, runner.starts)
            if seen is not None:
                others = [(i, k) for k in range(count) if k != i]
                more, _ = self.tried(seen, others, base, LOOKED_AT_BESIDE)
                found += more
        return found

    def beside_a_delay(self, base: _Tried) -> list[_Tried]:
        """A change beside a delay: what each promises together with some more delay, from several delays."""
        each = self.unknowns.each
        last = next((i for i, one in enumerate(each) if one.quantity == DELAY), None)
        if last is None:
            return []
        price = float(np.log(self.count))
        others = [(i, last) for i, one in enumerate(each) if not self.is_of_inputs(self.plain(one.name))]
        best: dict[int, tuple[float, View, Promise]] = {}
        name, least = each[last].name, np.inf
        delay = float(self.delayed((name,), self.of([name]), np.zeros(1), Promise((), np.inf, 0.0, np.zeros(0))).z[0])
        for _ in range(DELAYS_SEEN):
            if best and self.is_late:
                break
            z = self.unknowns.z_start.copy()
            delay = max(delay, SHORTEST_DELAY)
            z[self.unknowns.slices[last]] = delay
            seen = self.view(self.cut, z, self.starts_at(delay))
            promises = [] if seen is None else seen.promises(others, price)
            for promise in promises:
                i, cost = promise.members[0], promise.left + price * promise.freedom
                if seen is not None and (i not in best or cost < best[i][0]):
                    best[i] = cost, seen, promise
            if not promises or promises[0].left > least:
                break
            least, before = promises[0].left, delay
            delay = min(delay + float(promises[0].step[-1]), LONGEST_DELAY)
            if abs(delay - before) < NEAR * delay:
                break
        order = sorted(best, key=lambda i: best[i][0])
        groups = [[i for i in order if (len(each[i].start) == 1) == small][:LOOKED_AT] for small in (True, False)]
        chosen = [
            i
            for group in groups
            for k, i in enumerate(group)
            if k < LOOKED_AT_BESIDE or best[i][0] < BEHIND * best[group[0]][0]
        ]
        names = {i: (each[i].name, each[last].name) for i in chosen}
        return self.raced([self.runner(*best[i][1:], names[i]) for i in chosen], base)[0]

    @property
    def delays(self) -> Array:
        """[s] from which a delay is looked for."""
        period = float(np.median(np.diff(self.pieces[0].times)))
        delays = period * np.array(DELAYS)
        return delays[delays < LONGEST_DELAY]

    def beside_inputs(self, runner: _Runner, base: _Tried) -> list[_Tried]:
        """A change beside a limit that is about what it is alone."""
        ((special, value),) = runner.special.items()
        pieces = runner.fit.segments.pieces
        seen = self.view(pieces, self.unknowns.z_start, runner.starts)
        if seen is None:
            return []
        each = [one.name for one in self.unknowns.each]
        others = [(i,) for i, name in enumerate(each) if not self.is_of_inputs(self.plain(name))]
        runners: list[_Runner] = []
        for promise in seen.promises(others, float(np.log(self.count)))[:LOOKED_AT_BESIDE]:
            if runners and self.is_late:
                break
            name = each[promise.members[0]]
            runners.append(self.searched(special, (name, special), self.of([name]), promise, value))
        return self.raced(runners, base)[0]

    def view(self, pieces: Sequence[Piece], z: Array, starts: Array) -> View | None:
        """What everything promises there; where z has a delay, inputs act so much later."""
        unknowns = self.unknowns
        if any(one.quantity == DELAY and z[s][0] > 0 for one, s in self.each_of(unknowns)):
            unknowns = self.of([one.name for one in unknowns.each])
        problem = self.problem(unknowns, pieces)
        law: Law = Inputs(self.law(self.unknowns, self.longest), unknowns, pieces)
        return view(problem.fit(law, pieces, problem.first_noise), unknowns, z, starts)

    def tried(
        self, seen: View, changes: Iterable[tuple[int, ...]], base: _Tried, most: int = LOOKED_AT
    ) -> tuple[list[_Tried], list[_Runner]]:
        """(those that are fitted, all that stayed in the race, best first) of those that promise most."""
        each = self.unknowns.each
        chosen: dict[tuple[str, ...], Promise] = {}
        places = {True: most, False: most}  # what has more numbers bends to more, and promises more than it keeps
        for promise in seen.promises(changes, float(np.log(self.count))):
            small = all(len(each[i].start) == 1 for i in promise.members)
            own = tuple(self.plain(each[i].name) for i in promise.members)
            if (
                places[small]
                and own not in chosen
                and len(set(own)) == len(own)
                and sum(map(self.is_of_inputs, own)) <= 1
            ):
                chosen[own] = promise
                places[small] -= 1
        plain = {own: promise for own, promise in chosen.items() if not any(map(self.is_of_inputs, own))}
        found, every = self.raced([self.runner(seen, promise, own) for own, promise in plain.items()], base)
        if any(one.explains for one in found):  # a search for a delay or a limit takes longer than the others together
            first = min(promise.left for promise in chosen.values())
            chosen = {own: promise for own, promise in chosen.items() if not self.is_behind(promise.left, first)}
        others: list[_Runner] = []
        for own, promise in chosen.items():
            if own in plain or (others and self.is_late):
                continue
            others.append(self.runner(seen, promise, own))
        more, rest = self.raced(others, base)
        return [*found, *more], sorted([*every, *rest], key=lambda one: one.left)

    def runner(self, seen: View, promise: Promise, names: tuple[str, ...]) -> _Runner:
        special = next((name for name in names if name.endswith(f".{LIMIT}")), None)
        unknowns = self.of([name for name in names if name != special])
        if special is not None:
            return self.searched(special, names, unknowns, promise)
        z, starts = seen.ahead(promise)
        own = [one.name for one in unknowns.each]
        at = [i for one, s in self.each_of(seen.unknowns) if one.name in own for i in range(s.start, s.stop)]
        z = np.clip(z[at], *unknowns.bounds)
        if unknowns.delay is None or seen.unknowns.delay is not None:
            return self.running(names, unknowns, self.cut, starts, z, promise)
        return self.delayed(names, unknowns, z, promise)

    def delayed(self, names: tuple[str, ...], unknowns: Unknowns, z: Array, promise: Promise) -> _Runner:
        """From the delay from which a step leaves least; a step sees only as far as inputs stay the same."""
        best = self.running(names, unknowns, self.cut, self.starts, z, promise)
        best.left, worse = np.inf, 0
        for delay in self.delays:
            if worse > 1:
                break
            at = z.copy()
            at[unknowns.delay] = delay
            one = self.running(names, unknowns, self.cut, self.starts_at(float(delay)), at, promise)
            worse += 1
            if one.step() and one.left < best.left:
                best, worse = one, 0
        return best

    def running(
        self,
        names: tuple[str, ...],
        unknowns: Unknowns,
        pieces: list[Piece],
        starts: Array,
        z: Array,
        promise: Promise,
    ) -> _Runner:
        problem = self.problem(unknowns, pieces)
        fit = problem.fit(self.law(unknowns, self.longest), pieces, problem.first_noise)
        return _Runner(names, fit, z, starts, promise.left, promise.freedom)

    def firm(self, one: _Runner) -> Fit:
        """With dry friction that holds, of the size that it has by now."""
        unknowns, pieces = one.fit.unknowns, one.fit.segments.pieces
        if all(each.quantity != COULOMB for each in unknowns.each):
            return one.fit
        return self.problem(unknowns, pieces).fit(self.law_of(unknowns), pieces, one.fit.noise)

    def raced(self, runners: list[_Runner], base: _Tried) -> tuple[list[_Tried], list[_Runner]]:
        alive, there = list(runners), []
        for most in RACE:
            if most < RACE[0] and self.is_late:
                most = 1
            before = {one.names: one.left for one in alive}
            alive = sorted((one for one in alive if one.step()), key=lambda one: one.left)
            there += [one for one in alive if not self.is_hopeless(one.left)]
            for one in alive:
                one.fit = self.firm(one)
            alive = [
                one
                for one in alive[:most]
                if self.is_hopeless(one.left) and (most == RACE[0] or one.left < FALLS * before[one.names])
            ]
        self.improve(there)
        every = sorted(runners, key=lambda one: one.left)
        alive = there + alive
        price = float(np.log(self.count))
        alive.sort(key=lambda one: one.left + price * one.freedom)
        found: list[_Tried] = []
        for one in alive:
            first = alive[0].left + price * alive[0].freedom
            enough = any(each.explains for each in found) and self.is_behind(one.left + price * one.freedom, first)
            enough = enough or (bool(found) and (self.is_late or one.left > self.plausible))
            if enough or self.is_hopeless(one.left) or one.fit.at(one.z, one.starts) is None:
                continue
            try:
                found.append(self.ended(one))
            except (SimulationError, np.linalg.LinAlgError):  # its motion grows beyond what numbers hold
                continue
            self.evidence[" and ".join(one.names)] = base.score - found[-1].score
        return found, every

    def improve(self, there: Sequence[_Runner]) -> None:
        """Steps of those that came near the noise, for as long as these help."""
        best = np.inf
        for one in sorted(there, key=lambda one: one.left):
            for _ in range(STEPS):
                last = one.left
                if self.is_late or not one.step() or last - one.left < CLOSE:
                    break
                if one.left > FALLS * last and self.is_behind(one.left, best):
                    break
            best = min(best, one.left)

    def is_behind(self, left: float, best: float) -> bool:
        """Whether a change that leaves so much is told from the one that leaves least."""
        return left - best > TOLD_APART * max(1.0, best / self.count)

    @cached_property
    def plausible(self) -> float:
        """What a change may leave of the squares that explains, however they are weighted."""
        numbers = sum(np.isfinite(p.ys).sum(axis=0) for p in self.pieces)
        seen = numbers[numbers > 0]
        return PLAUSIBLE * most_scatter(int(np.min(seen)), len(seen)) ** 2 * self.count

    def is_hopeless(self, left: float) -> bool:
        return left > HOPELESS**2 * self.count

    @staticmethod
    def plain(name: str) -> str:
        """The name without the level at which a limit was tried."""
        label, quantity = name.rsplit(".", 1)
        return f"{label}.{LIMIT}" if quantity.rstrip("0123456789") == LIMIT else name

    @staticmethod
    def is_of_inputs(name: str) -> bool:
        return name.endswith((f".{DELAY}", f".{LIMIT}"))

    @property
    def count(self) -> int:
        return int(sum(np.isfinite(p.ys).sum() for p in self.pieces))

    def ended(self, one: _Runner) -> _Tried:
        """The change where it fits best, with the noise estimated anew."""
        pieces = one.fit.segments.pieces
        found = self.solved(one.names, one.fit.unknowns, one.fit.law, pieces, one.starts, one.z)
        if not one.special:
            return found
        return found._replace(
            freedom=found.freedom + 1.0,
            values={**found.values, **one.special},
            intervals={**found.intervals, **one.interval},
        )

    def solved(
        self,
        names: tuple[str, ...],
        unknowns: Unknowns,
        law: Law,
        pieces: Sequence[Piece],
        starts: Array,
        z: Array,
        most: int = STEPS,
    ) -> _Tried:
        problem = self.problem(unknowns, pieces)
        fit = problem.fit(law, pieces, problem.first_noise)
        for _ in range(ROUNDS):
            solved = fit.solve(z, starts, most)
            z, starts = solved.z, solved.starts
            size = noise_of(fit, solved)
            seen = np.isfinite(size)
            if np.any(size[seen] > HOPELESS * problem.first_noise[seen]):
                solved = replace(solved, converged=True)
                break
            if any(one.quantity == COULOMB for one in unknowns.each) and not problem.follows(fit, z, starts):
                fit = problem.shortened(fit, pieces, fit.noise)
                continue
            noise = np.where(np.isfinite(self.stated), self.stated, np.fmax(size, 1e-3 * self.scatter))
            if solved.converged and np.max(np.abs(noise[seen] / fit.noise[seen] - 1)) < SAME_NOISE:
                break
            fit = problem.fit(fit.law, pieces, noise)
        return self.told(names, problem, fit, solved)

    def score(self, fit: Fit, solved: Solved) -> float:
        """-2 log of the likelihood with the noise that the residuals show, where none was given."""
        every = np.concatenate(solved.reduced.residuals)
        numbers = np.isfinite(every).sum(axis=0)
        with np.errstate(divide="ignore", invalid="ignore"):
            size = fit.noise * np.sqrt(np.nansum(every**2, axis=0) / numbers)
            noise = np.where(np.isfinite(self.stated), self.stated, np.fmax(size, 1e-3 * self.scatter))
            each = numbers * ((size / noise) ** 2 + 2 * np.log(noise))
        return float(np.sum(each[numbers > 0]))

    def told(self, names: tuple[str, ...], problem: Problem, fit: Fit, solved: Solved) -> _Tried:
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
        return _Tried(names, self.score(fit, solved), pull, taken - alone, not doubt, doubt, values, shaped, *own)

    def searched(
        self, special: str, names: tuple[str, ...], unknowns: Unknowns, promise: Promise, near: float | None = None
    ) -> _Runner:
        """At the limit by which the rest fits best, with its interval by how what is left bends there."""
        found: dict[float, _Runner] = {}

        def left(value: float) -> float:
            if value not in found:
                pieces = [self.acted(piece, special, value) for piece in self.cut]
                one = self.running(names, unknowns, pieces, self.starts, unknowns.z_start, promise)
                if not all(one.step() for _ in range(2)):
                    one.left = np.inf
                found[value] = one
            return found[value].left

        i = self.model.input_names.index(special.rsplit(".", 1)[0])
        largest = max(float(np.max(np.abs(p.us[:, i]))) for p in self.pieces)
        grid, low, high = np.array(LEVELS) * largest, 0.0, largest
        if near is not None:
            grid = near * np.array([0.8, 1.0, 1.25])
            low, high = max(low, 0.5 * near), min(high, 2 * near)
        best = min((float(v) for v in grid), key=left)
        nearby = sorted([low, *map(float, grid), high])
        k = nearby.index(best)
        least = minimize_scalar(left, bounds=(nearby[k - 1], nearby[k + 1]), method="bounded",
                                options={"xatol": 0.01 * best, "maxiter": 8})  # fmt: skip
        value = float(least.x)
        width = max(0.02 * value, 1e-12)
        bend = (left(value + width) + left(value - width) - 2 * left(value)) / width**2
        noise = left(value) / self.count
        half = 1.96 * float(np.sqrt(2 * noise / bend)) if bend > 0 else np.inf
        one = found[value]
        one.special, one.interval = {special: value}, {special: frozen([max(value - half, 0.0), value + half])}
        return one

    def acted(self, piece: Piece, special: str, value: float) -> Piece:
        """The piece with an input that is cut."""
        i = self.model.input_names.index(special.rsplit(".", 1)[0])
        us = piece.us.copy()
        us[:, i] = np.clip(us[:, i], -value, value)
        return replace(piece, us=us)

    def bic(self, one: _Tried) -> float:
        return one.score + one.pull + one.freedom * float(np.log(self.count))

    def least(self, freedom: float, count: int) -> float:
        """By how much a score must fall, where so many changes were tried."""
        return max(float(stats.chi2.isf(FALSE_NAME / max(count, 1), freedom)), freedom * float(np.log(self.count)))

    def enough(self, base: _Tried, tried: Sequence[_Tried], count: int) -> list[_Tried]:
        """The changes that explain and have the evidence, best first, and not told from the best."""
        found = []
        for one in tried:
            freedom = max(one.freedom, 1.0)
            if one.explains and base.score - one.score > self.least(freedom, count):
                found.append(one)
        found.sort(key=self.bic)
        return [one for one in found if self.bic(one) - self.bic(found[0]) < SAME]

    def said(self, named: Sequence[_Tried]) -> Explanation:
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
            evidence=self.evidence,
        )

    def words(self, one: _Tried, name: str) -> str:
        label, quantity = name.rsplit(".", 1)
        value, interval = np.atleast_1d(one.values[name]), np.atleast_2d(one.intervals[name])
        if quantity == LIMIT:
            start, unit = self.tree.limits[[self.model.input_names.index(label)]], ""
        else:
            own = next(each for each in self.unknowns.each if each.name == name)
            start, unit = own.start, own.unit
        columns = [name] if len(start) == 1 else [f"{name}[{k}]" for k in range(len(start))]
        unit = f" {unit}" if unit not in ("", "1") else ""
        return ", ".join(
            f"{column} is {v:.4g}{unit} ({low:.4g} to {high:.4g}), not {was:.4g}"
            if np.isfinite(low) and np.isfinite(high)
            else f"{column} cannot be known"
            for column, v, (low, high), was in zip(columns, value, interval, start, strict=True)
        )

    @property
    def end(self) -> str:
        return f" The search was ended after {LONGEST_SEARCH:.3g} s of processor time." if self.ended_early else ""

    def right(self) -> Explanation:
        return Explanation((), {}, {}, (), True, "Nothing: the model explains it.", self.evidence)

    def unexplained(self, base: _Tried) -> Explanation:
        nearest = self.nearest or base
        if self.alone is not None and self.share > MOST_OF_IT:
            one, share = self.alone, 100 * (1 - float(f"{1 - self.share:.1g}"))
            most = " and ".join(self.words(one, name) for name in one.names)
            tail = f"{one.doubt}, and no second change that was tried explains that"
            sentence = f"Not explained, but {share:.10g} % of the squares: {most}; {tail}.{self.end}"
            return Explanation((), {}, {}, (), False, sentence, self.evidence)
        near = f"with {' and '.join(nearest.names)}" if nearest.names else "as the model is"
        tried = "no change that was tried" if self.ended_early else "no change of one or two quantities"
        sentence = f"Not explained: {tried} explains the recording;"
        sentence = f"{sentence} {near}, {nearest.doubt}.{self.end}"
        return Explanation((), {}, {}, (), False, sentence, self.evidence)


def _each_left(point: Point) -> Array:
    """(K,) of the squares, of each segment."""
    return np.array([float(np.nansum(r**2)) for r in point.residuals])
