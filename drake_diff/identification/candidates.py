"""Candidate changes of a model, and the search for the values at which each change fits best.

One differentiation along the measured motion eliminates the first states and the gaps from the least squares, which
leaves |b - R dz|^2 in all changes together. The decrease predicted for a few changes needs only their columns of R.
The candidates with the largest predicted decrease take Gauss-Newton steps; those near the noise level are fitted fully.
"""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from scipy import stats

from drake_diff._base.arrays import Array
from drake_diff.exceptions import SimulationError
from drake_diff.identification.fit import Fit, Reduced, Solved
from drake_diff.identification.identify import Problem
from drake_diff.identification.judge import (
    HOPELESS,
    freedom_of,
    freedoms_of,
    intervals_of,
    known_of,
    likelihood_of,
    most_scatter,
    noise_of,
)
from drake_diff.identification.messages import changed_to
from drake_diff.identification.motion import LONGEST, EulerMotion, Law, Slopes, TreeMotion
from drake_diff.identification.recordings import Excerpt, noise_by_differences
from drake_diff.identification.results import Explanation
from drake_diff.identification.tree import ORDER_4, Tree
from drake_diff.identification.unknowns import (
    BIAS,
    DELAY,
    LIMIT,
    STRENGTH,
    Unknown,
    Unknowns,
    choose_unknowns,
    possible_changes,
)
from drake_diff.model.model import Model

FALSE_NAME = 0.003  # fraction of correct models for which a change is named
SAME = 6.0  # difference of scores (odds of 20 to 1) below which two changes are not distinguished
LONGEST_SEARCH = 45.0  # [s] of processor time after which no further change is tried


class Tried(NamedTuple):
    """A change whose fit is complete."""

    names: tuple[str, ...]
    score: float
    pull: float  # squared distance from the file's values, as the fit weights it
    freedom: float
    doubt: str  # why the change does not explain the recordings; empty if it does
    values: dict[str, Any]
    intervals: dict[str, Array]
    z: Array
    starts: Array

    @property
    def explains(self) -> bool:
        return not self.doubt


@dataclass(eq=False)
class Ranking:
    """The judgement of fitted changes of a model and of their evidence; the search ends after LONGEST_SEARCH."""

    model: Model
    pieces: list[Excerpt]
    stated: Array  # (2 nv,) the given noise; NaN if unknown
    evidence: dict[str, float] = field(default_factory=dict)
    begun: float = field(default_factory=time.process_time)
    ended_early: bool = False
    jumps: ClassVar[bool] = False  # whether the motion has jumps, as at impacts

    @property
    def is_late(self) -> bool:
        """Whether the search has used up its time."""
        self.ended_early = self.ended_early or time.process_time() - self.begun > LONGEST_SEARCH
        return self.ended_early

    @cached_property
    def count(self) -> int:
        return int(sum(np.isfinite(p.ys).sum() for p in self.pieces))

    @property
    def price(self) -> float:
        """The penalty for each parameter of a change, according to BIC."""
        return float(np.log(self.count))

    @cached_property
    def scatter(self) -> Array:
        return noise_by_differences(self.model, self.pieces, jumps=self.jumps)

    def problem(self, unknowns: Unknowns, pieces: Sequence[Excerpt]) -> Problem:
        return Problem(self.model, unknowns, list(pieces), self.stated, self.scatter, jumps=self.jumps)

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
        """Return by how much a score must fall if `count` changes were tried."""
        return max(float(stats.chi2.isf(FALSE_NAME / max(count, 1), freedom)), freedom * self.price)

    def enough(self, base: Tried, tried: Sequence[Tried], count: int) -> list[Tried]:
        """Return the changes that explain the recordings with enough evidence and are close to the best, best first."""
        candidates = [
            candidate
            for candidate in tried
            if candidate.explains and base.score - candidate.score > self.least(max(candidate.freedom, 1.0), count)
        ]
        candidates.sort(key=self.bic)
        return [candidate for candidate in candidates if self.bic(candidate) - self.bic(candidates[0]) < SAME]

    def named(self, named: Sequence[Tried], how: str = "") -> Explanation:
        """Return an explanation by the first change, with the others as alternatives; `how` names the motion law."""
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
        """Return the model's value of a quantity, and its unit."""
        raise NotImplementedError

    def ended(self, sentence: str) -> str:
        """Return the sentence, with a note if the search ended early."""
        late = f" The search was ended after {LONGEST_SEARCH:.3g} s of processor time."
        return sentence + late if self.ended_early else sentence

    def nothing(self, how: str = "") -> Explanation:
        """Return the explanation for a correct model."""
        return Explanation((), {}, {}, (), True, f"Nothing: the model explains it{how}.", self.evidence)

    def unexplained(self, sentence: str) -> Explanation:
        return Explanation((), {}, {}, (), False, self.ended(sentence), self.evidence)


LONGEST_DELAY = 0.1  # [s]
DELAYS = (0.25, 0.75, 1.5, 3, 5.5, 8)  # in sample periods: initial guesses of a delay
LEVELS = (0.85, 0.6, 0.35)  # fractions of an input's largest value: initial guesses of its limit
CUT = 0.6  # fraction of an input's largest value at which its limit is linearized
PARTS = (1, 2, 4, 5, 10, 20)  # numbers of Euler steps per sample that are tried
SETTLING = 3  # maximum number of refinement steps of segment starts
PLAUSIBLE = 1.5  # times the largest loss of pure noise: a candidate above it is not fitted fully if another one is
STEPS, ROUNDS = 8, 4  # maximum numbers of Gauss-Newton steps, and of rounds of noise estimation
SAME_NOISE = 0.03  # relative tolerance; the error changes a score by less than 0.001 times the number of measurements
LOOKED_AT = 8  # maximum number of candidates that take steps: of one parameter, and also of several
RACE = 5  # number of candidates far above the noise that take more than one step
FALLS = 0.7  # a candidate is dropped if a step after its first does not reduce the loss by this factor
HALVED = 3  # maximum number of halvings of the integration step if a change makes the motion stiff
CLOSE = 1.0  # decrease of the loss below which no further step is taken before candidates are compared
TOLD_APART = 20.0  # loss in excess of the best candidate's, above which a candidate is not fitted fully


@dataclass(frozen=True, eq=False)
class WithLimits:
    """A motion law whose derivatives include the effect of an input's limit at the level CUT."""

    law: TreeMotion
    unknowns: Unknowns

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array, *, together: bool = False) -> list[Slopes]:
        """Return the derivatives of each step of each independent branch, or of the whole tree."""
        columns, branches = self.unknowns.columns, self.law.slopes(z, xs, hs, us, together=together)
        for unknown, s in self.unknowns.items():
            strength = f"{unknown.label}.{STRENGTH}"
            if unknown.quantity == LIMIT and z[s][0] == unknown.start[0] and strength in columns:
                u = np.abs(us[..., self.law.model.input_names.index(unknown.label)])
                share = np.clip(1 - CUT * unknown.start[0] / np.maximum(u, 1e-300), 0, None)
                for branch in branches:
                    limited = branch.columns == s.start
                    by_strength = branch.by_z[..., branch.columns == columns.index(strength)]
                    branch.by_z[..., limited] = -share[..., None, None] * by_strength
        return branches

    def __getattr__(self, name: str) -> Any:
        return getattr(self.law, name)


@dataclass(frozen=True, eq=False)
class Promise:
    """The prediction of the linearized motion for some changes made together."""

    members: tuple[int, ...]
    left: float  # remaining sum of squared residuals, in units of the noise
    freedom: float  # effective number of parameters that the data determine
    step: Array  # step in z of all members, concatenated


NO_PROMISE = Promise((), np.inf, 0.0, np.zeros(0))
Chosen = dict[tuple[str, ...], Promise]  # predictions by the names of the changed quantities


class View:
    """The least-squares problem in all changes, linearized at one motion."""

    def __init__(self, fit: Fit, unknowns: Unknowns, z: Array, starts: Array, reduced: Reduced):
        self.fit, self.unknowns, self.z, self.starts, self.reduced = fit, unknowns, z, starts, reduced
        pull = unknowns.widths**-2.0  # weak regularization towards the file's values
        offset = unknowns.z_start - z
        self.freedoms = freedoms_of(unknowns, reduced.R, unknowns.slices)
        self.matrix = reduced.R.T @ reduced.R + np.diag(pull)
        self.right = reduced.R.T @ reduced.b + pull * offset
        self.most = reduced.rest + float(reduced.b @ reduced.b + np.sum(pull * offset**2))  # loss without a change
        self.lower = unknowns.bounds[0] - z

    def promise(self, members: tuple[int, ...]) -> Promise | None:
        """Predict the best step of some changes; return None if it leaves the bounds."""
        columns = np.concatenate([np.arange(*self.unknowns.slices[i].indices(len(self.z))) for i in members])
        H, g = self.matrix[np.ix_(columns, columns)], self.right[columns]
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        step = scale * np.linalg.lstsq(H * np.outer(scale, scale), g * scale, rcond=1e-12)[0]
        lower = self.lower[columns]
        if np.any(step < lower):
            if len(columns) > 1:
                return None
            step = np.maximum(step, lower)
        gain = float(2 * g @ step - step @ H @ step)
        return Promise(members, self.most - gain, sum(self.freedoms[i] for i in members), step)

    def promises(self, changes: Iterable[tuple[int, ...]], price: float) -> list[Promise]:
        """Return the predictions whose decrease exceeds the price of their parameters, best first."""
        promises = (self.promise(members) for members in changes)
        good = [p for p in promises if p is not None and self.most - p.left > price * p.freedom]
        return sorted(good, key=lambda promise: promise.left + price * promise.freedom)

    def ahead(self, promise: Promise) -> tuple[Array, Array]:
        """Return (z of all changes, starts of the segments) after the predicted step."""
        dz = np.zeros_like(self.z)
        columns = [range(s.start, s.stop) for s in (self.unknowns.slices[i] for i in promise.members)]
        dz[[column for entries in columns for column in entries]] = promise.step
        far = self.unknowns.widths / 3
        dz = np.clip(dz, -far, far)
        return self.z + dz, self.fit.moved(self.starts, self.reduced, dz, 1.0)


@dataclass(eq=False)
class Runner:
    """A candidate change that is fitted by full Gauss-Newton steps."""

    names: tuple[str, ...]
    fit: Fit
    z: Array
    starts: Array
    left: float  # sum of squared residuals that the latest step predicts
    freedom: float

    def step(self) -> bool:
        """Take a Gauss-Newton step, shortening the integration steps if needed; return False if no motion exists."""
        reduced = self._reduced()
        for _ in range(HALVED):
            shorter = self.fit.shorter
            if reduced is not None or shorter is None:
                break
            self.fit = self.fit.by(shorter)
            reduced = self._reduced()
        if reduced is None:
            self.left = np.inf
            return False
        dz = self.fit.step_of(self.z, reduced)
        self.starts = self.fit.moved(self.starts, reduced, dz, 1.0)
        self.z = self.z + dz
        pull = float(np.sum(((self.z - self.fit.unknowns.z_start) / self.fit.unknowns.widths) ** 2))
        self.left = reduced.rest + float(np.sum((reduced.b - reduced.R @ dz) ** 2)) + pull
        return True

    def _reduced(self) -> Reduced | None:
        point = self.fit.at(self.z, self.starts)
        reduced = None if point is None else self.fit.reduce(point)
        return reduced if reduced is not None and reduced.finite else None


@dataclass(eq=False, kw_only=True)
class Candidates(Ranking):
    """All candidate changes, and the motion of the unchanged model; `prepare` must be called first."""

    tree: Tree
    by_delay: dict[float, Array] = field(default_factory=dict)  # refined segment starts, by delay [s]
    step: float | None = None  # [s] length of the Euler steps; None for continuous time

    @cached_property
    def unknowns(self) -> Unknowns:
        """All quantities that are tried."""
        measured = np.any([np.isfinite(p.ys).any(axis=0) for p in self.pieces], axis=0)
        singles = {i for i, _ in self.tree.coordinates.single} | set(range(self.model.nq, self.model.nx))
        biases = {f"{name}.{BIAS}" for i, name in enumerate(self.model.state_names) if measured[i] and i in singles}
        names = [n for n in possible_changes(self.model, self.tree) if not n.endswith(f".{BIAS}") or n in biases]
        unknowns = choose_unknowns(self.model, self.tree, names).each
        largest = np.max([np.max(np.abs(p.us), axis=0) for p in self.pieces], axis=0)
        moving = np.any([np.ptp(p.us, axis=0) > 0 for p in self.pieces], axis=0)
        limits = [
            Unknown(f"{self.model.input_names[i]}.{LIMIT}", "", largest[[i]], 0.0, float(largest[i]), largest[i])
            for i in np.flatnonzero(moving)
        ]
        delay = [Unknown(f"model.{DELAY}", "s", np.zeros(1), 0.0, 0.0, LONGEST_DELAY)] if limits else []
        return Unknowns((*unknowns, *limits, *delay), as_in_files=True)

    @cached_property
    def of_inputs(self) -> list[int]:
        """The indices of the changes of input delays and input limits."""
        return [i for i, unknown in enumerate(self.unknowns.each) if unknown.quantity in (DELAY, LIMIT)]

    def of(self, names: Sequence[str]) -> Unknowns:
        """Return the unknowns with these names; with a delay, integration steps end where the inputs change."""
        chosen = (unknown for unknown in self.unknowns.each if unknown.name in names)
        shifting = (replace(unknown, shifts=unknown.quantity == DELAY) for unknown in chosen)
        return Unknowns(tuple(shifting), as_in_files=True)

    def law(self, unknowns: Unknowns, longest: float, *, smooth: bool = True) -> TreeMotion:
        """Return Euler steps if `step` is set, else continuous time; Coulomb friction sticks if not `smooth`."""
        if self.step is not None:
            return EulerMotion(self.model, self.tree, unknowns, self.step)
        return TreeMotion(self.model, self.tree, unknowns, longest, smooth=smooth, frozen=True)

    @property
    def period(self) -> float:
        """The median sample period [s] of the first piece."""
        return float(np.median(np.diff(self.pieces[0].times)))

    @property
    def euler_steps(self) -> list[float]:
        """The lengths [s] of the Euler steps that are tried; a whole number of steps fits between samples."""
        periods = np.concatenate([np.diff(piece.times) for piece in self.cut])
        if self.tree.coordinates.free or np.ptp(periods) > 1e-6 * np.mean(periods):
            return []
        return [float(np.mean(periods)) / n for n in PARTS]

    def prepare(self) -> None:
        """Choose steps, pieces and segment starts with which the unchanged model follows the measurements."""
        nothing = self.of(())
        fit, starts = self.problem(nothing, self.pieces).prepared(self.law(nothing, LONGEST))
        self.longest = fit.law.longest if isinstance(fit.law, TreeMotion) else LONGEST
        self.cut = list(fit.segments.pieces)
        self.starts = self.settled(fit, nothing.z_start, starts)

    def settled(self, fit: Fit, z: Array, starts: Array) -> Array:
        """Refine the starts of the segments by a fit of each segment to its own samples.

        The initial guess by cubics ignores inputs, which may change a velocity within a few samples.
        """
        s = fit.segments
        parts = [
            s.pieces[p].part(int(samples[0]), min(int(samples[-1]) + 1, len(s.pieces[p].times) - 1))
            for samples, p in zip(s.samples, s.of_piece, strict=True)
        ]
        segment_fit = Fit(self.model, fit.law, fit.unknowns, parts, fit.noise, fixed=True)
        try:
            return segment_fit.solve(z, starts, SETTLING).starts
        except SimulationError:
            return starts

    def starts_at(self, delay: float) -> Array:
        """Return the refined segment starts for inputs that act later by `delay`."""
        known = self.by_delay if self.step is None else {}
        if delay not in known:
            late = self.of([f"model.{DELAY}"])
            law = self.law(late, self.longest)
            law = replace(law, method=ORDER_4) if self.step is None else law
            problem = self.problem(late, self.cut)
            near = min(known, key=lambda other: abs(other - delay), default=0.0)
            starts = known[near] if abs(near - delay) < delay else self.starts
            known[delay] = self.settled(problem.fit(law, self.cut, problem.first_noise), np.array([delay]), starts)
        return known[delay]

    def view(self, pieces: Sequence[Excerpt], z: Array, starts: Array) -> View | None:
        """Linearize in all changes at z, which may include a delay; return None if no motion exists."""
        unknowns = self.unknowns
        if any(unknown.quantity == DELAY and z[s][0] > 0 for unknown, s in unknowns.items()):
            unknowns = self.of([unknown.name for unknown in unknowns.each])
        problem = self.problem(unknowns, pieces)
        law = cast(TreeMotion, WithLimits(self.law(self.unknowns, self.longest), unknowns))
        fit = problem.fit(law, pieces, problem.first_noise)
        point = fit.at(z, starts)
        reduced = None if point is None else fit.reduce(point)
        return None if reduced is None or not reduced.finite else View(fit, unknowns, z, starts, reduced)

    def is_hopeless(self, left: float) -> bool:
        return left > HOPELESS**2 * self.count

    def is_behind(self, left: float, best: float) -> bool:
        """Return whether the sum of squares `left` is clearly larger than the smallest one, `best`."""
        return left - best > TOLD_APART * max(1.0, best / self.count)

    @cached_property
    def plausible(self) -> float:
        """The largest sum of squares, for any weights, that a change that explains the recordings can leave."""
        numbers = np.isfinite(np.concatenate([piece.ys for piece in self.pieces])).sum(axis=0)
        seen = numbers[numbers > 0]
        return PLAUSIBLE * most_scatter(int(np.min(seen)), len(seen)) ** 2 * self.count

    def chosen(self, seen: View, changes: Iterable[tuple[int, ...]], most: int = LOOKED_AT) -> Chosen:
        """Return the best predictions; several parameters have a quota of their own, as they are overestimated."""
        unknowns, chosen = self.unknowns.each, Chosen()
        places = {True: most, False: most}
        for promise in seen.promises(changes, self.price):
            small = all(len(unknowns[i].start) == 1 for i in promise.members)
            if places[small]:
                chosen[tuple(unknowns[i].name for i in promise.members)] = promise
                places[small] -= 1
        return chosen

    def tried(self, seen: View, chosen: Chosen, base: Tried) -> tuple[list[Tried], list[Runner]]:
        """Return (fitted changes, all candidates, best first); delays and limits of inputs are tried last."""
        plain = {names: promise for names, promise in chosen.items() if not set(promise.members) & set(self.of_inputs)}
        candidates, runners = self.raced([self.runner(seen, p, names) for names, p in plain.items()], base)
        rest = {names: promise for names, promise in chosen.items() if names not in plain}
        if any(candidate.explains for candidate in candidates):  # delays and limits take the longest to search
            first = min(promise.left for promise in chosen.values())
            rest = {names: promise for names, promise in rest.items() if not self.is_behind(promise.left, first)}
        others: list[Runner] = []
        for names, promise in rest.items():
            if not (others and self.is_late):
                others.append(self.runner(seen, promise, names))
        more, late = self.raced(others, base)
        return [*candidates, *more], sorted([*runners, *late], key=lambda runner: runner.left)

    def runner(self, seen: View, promise: Promise, names: tuple[str, ...]) -> Runner:
        unknowns = self.of(names)
        z, starts = seen.ahead(promise)
        columns = [i for unknown, s in seen.unknowns.items() if unknown.name in names for i in range(s.start, s.stop)]
        z = np.clip(z[columns], *unknowns.bounds)
        for unknown, s in unknowns.items():
            before = next(seen.z[t] for other, t in seen.unknowns.items() if other.name == unknown.name)
            if unknown.quantity in (DELAY, LIMIT) and before == unknown.start:
                return self.from_several(names, unknowns, z, s.start, promise)
        return self.running(names, unknowns, starts, z, promise)

    def from_several(
        self, names: tuple[str, ...], unknowns: Unknowns, z: Array, column: int, promise: Promise
    ) -> Runner:
        """Start from the best of several delays or limits: a linear step is valid only while inputs are constant."""
        is_delay = column == unknowns.delay
        values = self.period * np.array(DELAYS) if is_delay else unknowns.start[column] * np.array(LEVELS)
        best, worse = self.running(names, unknowns, self.starts, z, promise), 0
        best.left = np.inf
        for value in values[values < unknowns.bounds[1][column]]:
            begin = unknowns.z_start.copy()
            begin[column] = value
            starts = self.starts_at(float(value)) if is_delay else self.starts
            runner = self.running(names, unknowns, starts, begin, promise)
            worse += 1
            if all(runner.step() for _ in names) and runner.left < best.left:  # two steps for a pair
                best, worse = runner, 0
            if worse > 1:
                break
        return best

    def running(self, names: tuple[str, ...], unknowns: Unknowns, starts: Array, z: Array, promise: Promise) -> Runner:
        problem = self.problem(unknowns, self.cut)
        fit = problem.fit(self.law(unknowns, self.longest, smooth=False), self.cut, problem.first_noise)
        return Runner(names, fit, z, starts, promise.left, promise.freedom)

    def raced(self, runners: list[Runner], base: Tried) -> tuple[list[Tried], list[Runner]]:
        """Take steps, most with the best candidates; return (fitted changes, all candidates, best first)."""
        first = sorted((runner for runner in runners if runner.step()), key=lambda runner: runner.left)
        best, candidates = np.inf, list[Tried]()
        for k, runner in enumerate(first):
            if k < RACE or not self.is_hopeless(runner.left):
                self.approach(runner, best)
                best = min(best, runner.left)

        def cost(runner: Runner) -> float:
            return runner.left + self.price * runner.freedom

        finalists = sorted((runner for runner in first if not self.is_hopeless(runner.left)), key=cost)
        for runner in finalists:
            explained = any(candidate.explains for candidate in candidates)
            if explained and self.is_behind(cost(runner), cost(finalists[0])):
                continue
            if candidates and (self.is_late or runner.left > self.plausible):
                continue
            if runner.fit.at(runner.z, runner.starts) is None:
                continue
            try:
                candidates.append(
                    self.solved(runner.names, runner.fit.unknowns, runner.fit.law, runner.starts, runner.z)
                )
            except (SimulationError, np.linalg.LinAlgError):  # the motion overflows
                continue
            self.evidence[" and ".join(runner.names)] = base.score - candidates[-1].score
        return candidates, sorted(runners, key=lambda runner: runner.left)

    def approach(self, runner: Runner, best: float = np.inf) -> None:
        """Take further steps while they help; far above the noise or the `best` loss, each step must help clearly."""
        for _ in range(STEPS):
            last = runner.left
            if self.is_late or not runner.step() or last - runner.left < CLOSE:
                break
            if runner.left > FALLS * last and (self.is_behind(runner.left, best) or self.is_hopeless(runner.left)):
                break

    def solved(
        self, names: tuple[str, ...], unknowns: Unknowns, law: Law, starts: Array, z: Array, most: int = STEPS
    ) -> Tried:
        """Fit a change fully, with repeated estimation of the noise."""
        problem, pieces = self.problem(unknowns, self.cut), self.cut
        fit = self.followed(problem, problem.fit(law, pieces, problem.first_noise), z, starts)
        law = fit.law
        for _ in range(ROUNDS):
            judged, solved = fit, fit.solve(z, starts, most)
            z, starts = solved.z, solved.starts
            shorter = fit.shorter
            if shorter is not None and not problem.follows(fit, z, starts):
                solved = replace(solved, converged=False, why="the integration steps are too long for the motion")
                fit = problem.fit(shorter, pieces, fit.noise)
                continue
            size = noise_of(fit, solved)
            seen = np.isfinite(size)
            if np.any(size[seen] > HOPELESS * problem.first_noise[seen]):
                solved = replace(solved, converged=True)
                break
            jumps = solved.stuck and unknowns.delay is not None and fit.law is law
            if shorter is not None and jumps:  # a stiff motion jumps where a delay changes the number of steps
                fit = problem.fit(shorter, pieces, fit.noise)
                continue
            noise = np.where(np.isfinite(self.stated), self.stated, np.fmax(size, 1e-3 * self.scatter))
            if solved.converged and np.max(np.abs(noise[seen] / fit.noise[seen] - 1)) < SAME_NOISE:
                break
            fit = problem.fit(fit.law, pieces, noise)
        return self.judge(names, problem, judged, solved)

    @staticmethod
    def followed(problem: Problem, fit: Fit, z: Array, starts: Array) -> Fit:
        """Return a fit with steps short enough for the motion; a search with longer steps is slow and fails."""
        for _ in range(ROUNDS):
            shorter = fit.shorter
            if shorter is None or problem.follows(fit, z, starts):
                break
            fit = fit.by(shorter)
        return fit
