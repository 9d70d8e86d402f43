"""Which candidates fit best, and what evidence there is for them.

Those that promise most go on by steps of Gauss and Newton for as long as these help. What comes near the noise is
fitted, with the noise estimated anew, and ranked by BIC.
"""

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar

from drake_diff._base.arrays import Array, frozen
from drake_diff.exceptions import SimulationError
from drake_diff.identification.candidates import DELAY, LEVELS, LIMIT, Candidates, Promise, View
from drake_diff.identification.fit import Fit, Reduced, Solved
from drake_diff.identification.identify import Problem
from drake_diff.identification.judge import HOPELESS, freedom_of, intervals_of, known_of, likelihood_of, noise_of
from drake_diff.identification.motion import Law
from drake_diff.identification.recordings import Piece
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


def least_evidence(freedom: float, tried: int, count: int) -> float:
    """By how much -2 log of the likelihood must fall, where so many changes were tried and numbers measured."""
    by_chance = float(stats.chi2.isf(FALSE_NAME / max(tried, 1), freedom))
    return max(by_chance, freedom * float(np.log(count)))


@dataclass(eq=False)
class Ranking(Candidates):
    """Fits candidates, and says which of them have the evidence."""

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
        problem = self.problem(unknowns, pieces)
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
            noise = np.where(np.isfinite(self.stated), self.stated, np.fmax(size, 1e-3 * self.scatter))
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
            unknown.name: frozen(intervals[s][0] if len(unknown.start) == 1 else intervals[s])
            for unknown, s in zip(unknowns.each, unknowns.slices, strict=True)
        }
        values = unknowns.named(unknowns.values(solved.z))
        point = solved.z, solved.starts
        return Tried(
            names,
            likelihood_of(fit, solved, self.stated, self.scatter),
            pull,
            taken - alone,
            not doubt,
            doubt,
            values,
            shaped,
            *point,
        )

    def bic(self, candidate: Tried) -> float:
        return candidate.score + candidate.pull + candidate.freedom * float(np.log(self.count))

    def least(self, freedom: float, count: int) -> float:
        """By how much a score must fall, where so many changes were tried."""
        return max(float(stats.chi2.isf(FALSE_NAME / max(count, 1), freedom)), freedom * float(np.log(self.count)))

    def enough(self, base: Tried, tried: Sequence[Tried], count: int) -> list[Tried]:
        """The changes that explain and have the evidence, best first, and not told from the best."""
        candidates = []
        for candidate in tried:
            freedom = max(candidate.freedom, 1.0)
            if candidate.explains and base.score - candidate.score > self.least(freedom, count):
                candidates.append(candidate)
        candidates.sort(key=self.bic)
        return [candidate for candidate in candidates if self.bic(candidate) - self.bic(candidates[0]) < SAME]


LOOKED_AT = 8  # changes that enter the race, of those that promise most: of those of one number, and of others
RACE = (5, 4, 3, 2, 2, 1)  # so many stay after each step of Gauss and Newton
FALLS = 0.7  # what does not fall to this part of what was left before is out of the race, after its first step
LONGEST_SEARCH = 45.0  # [s] of processor time, after which no further change is tried
Chosen = dict[tuple[str, ...], Promise]  # changes by the names of what they change
HALVED = 3  # times: steps by which a change that makes motion stiff has none
CLOSE = 1.0  # of the squares: what a step may still gain where two changes are told apart
TOLD_APART = 20.0  # of the squares: what leaves so much more than a change that explains is not fitted to its end


@dataclass(eq=False)
class Runner:
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
        """Whether there is a motion to step from, if need be by steps that are shorter and stay so."""
        reduced = self._reduced()
        for _ in range(HALVED):
            shorter = self.fit.shorter
            if reduced is not None or shorter is None:
                break
            self.fit = self.fit.by(shorter)
            reduced = self._reduced()
        if reduced is None:
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


@dataclass(eq=False)
class Race(Ranking):
    """Of changes of a model; it ends after LONGEST_SEARCH."""

    evidence: dict[str, float] = field(default_factory=dict)
    begun: float = field(default_factory=time.process_time)
    ended_early: bool = False

    @property
    def is_late(self) -> bool:
        """Whether no further change is tried."""
        self.ended_early = self.ended_early or time.process_time() - self.begun > LONGEST_SEARCH
        return self.ended_early

    def chosen(self, seen: View, changes: Iterable[tuple[int, ...]], most: int = LOOKED_AT) -> Chosen:
        """Those that promise most, and a delay."""
        unknowns, changes = self.unknowns.each, list(changes)
        chosen: Chosen = {}
        places = {True: most, False: most}  # what has more numbers bends to more, and promises more than it keeps
        for promise in seen.promises(changes, float(np.log(self.count))):
            small = all(len(unknowns[i].start) == 1 for i in promise.members)
            names = tuple(self.plain(unknowns[i].name) for i in promise.members)
            if (
                places[small]
                and names not in chosen
                and len(set(names)) == len(names)
                and sum(map(self.is_of_inputs, names)) <= 1
            ):
                chosen[names] = promise
                places[small] -= 1
        for i, unknown in enumerate(unknowns):  # none at all promises little of one of several samples
            if unknown.quantity == DELAY and (i,) in changes:
                chosen.setdefault((unknown.name,), Promise((i,), seen.most, 1.0, np.zeros(1)))
        return chosen

    def tried(self, seen: View, chosen: Chosen, base: Tried) -> tuple[list[Tried], list[Runner]]:
        """(those that are fitted, all that stayed in the race, best first)."""
        plain = {names: promise for names, promise in chosen.items() if not any(map(self.is_of_inputs, names))}
        candidates, every = self.raced([self.runner(seen, promise, names) for names, promise in plain.items()], base)
        if any(
            candidate.explains for candidate in candidates
        ):  # a search for a delay or a limit takes longer than the others together
            first = min(promise.left for promise in chosen.values())
            chosen = {names: promise for names, promise in chosen.items() if not self.is_behind(promise.left, first)}
        others: list[Runner] = []
        for names, promise in chosen.items():
            if names in plain or (others and self.is_late):
                continue
            others.append(self.runner(seen, promise, names))
        more, rest = self.raced(others, base)
        return [*candidates, *more], sorted([*every, *rest], key=lambda runner: runner.left)

    def runner(self, seen: View, promise: Promise, names: tuple[str, ...]) -> Runner:
        special = next((name for name in names if name.endswith(f".{LIMIT}")), None)
        unknowns = self.of([name for name in names if name != special])
        if special is not None:
            return self.searched(special, names, unknowns, promise)
        if unknowns.delay is not None and seen.unknowns.delay is None:
            return self.delayed(names, unknowns, promise)
        z, starts = seen.ahead(promise)
        unknown_names = [unknown.name for unknown in unknowns.each]
        columns = [
            i
            for unknown, s in self.each_of(seen.unknowns)
            if unknown.name in unknown_names
            for i in range(s.start, s.stop)
        ]
        z = np.clip(z[columns], *unknowns.bounds)
        return self.running(names, unknowns, self.cut, starts, z, promise)

    def delayed(self, names: tuple[str, ...], unknowns: Unknowns, promise: Promise) -> Runner:
        """From the delay from which steps leave least; a step sees only as far as inputs stay the same."""
        best = self.running(names, unknowns, self.cut, self.starts, unknowns.z_start, promise)
        best.left, worse = np.inf, 0
        for delay in self.delays:
            if worse > 1:
                break
            z = unknowns.z_start.copy()
            z[unknowns.delay] = delay
            worse += 1
            runner = self.running(names, unknowns, self.cut, self.starts_at(float(delay)), z, promise)
            if all(runner.step() for _ in names) and runner.left < best.left:  # two where another change bends as well
                best, worse = runner, 0
        return best

    def running(
        self,
        names: tuple[str, ...],
        unknowns: Unknowns,
        pieces: list[Piece],
        starts: Array,
        z: Array,
        promise: Promise,
    ) -> Runner:
        problem = self.problem(unknowns, pieces)
        fit = problem.fit(self.law(unknowns, self.longest, smooth=False), pieces, problem.first_noise)
        return Runner(names, fit, z, starts, promise.left, promise.freedom)

    def raced(self, runners: list[Runner], base: Tried) -> tuple[list[Tried], list[Runner]]:
        alive, there = list(runners), []
        for most in RACE:
            if most < RACE[0] and self.is_late:
                most = 1
            before = {runner.names: runner.left for runner in alive}
            alive = sorted((runner for runner in alive if runner.step()), key=lambda runner: runner.left)
            there += [runner for runner in alive if not self.is_hopeless(runner.left)]
            alive = [
                runner
                for runner in alive[:most]
                if self.is_hopeless(runner.left) and (most == RACE[0] or runner.left < FALLS * before[runner.names])
            ]
        self.improve(there)
        every = sorted(runners, key=lambda runner: runner.left)
        alive = there + alive
        price = float(np.log(self.count))
        alive.sort(key=lambda runner: runner.left + price * runner.freedom)
        candidates: list[Tried] = []
        for runner in alive:
            first = alive[0].left + price * alive[0].freedom
            enough = any(candidate.explains for candidate in candidates) and self.is_behind(
                runner.left + price * runner.freedom, first
            )
            enough = enough or (bool(candidates) and (self.is_late or runner.left > self.plausible))
            if enough or self.is_hopeless(runner.left) or runner.fit.at(runner.z, runner.starts) is None:
                continue
            try:
                candidates.append(self.ended(runner))
            except (SimulationError, np.linalg.LinAlgError):  # its motion grows beyond what numbers hold
                continue
            self.evidence[" and ".join(runner.names)] = base.score - candidates[-1].score
        return candidates, every

    def improve(self, there: Sequence[Runner]) -> None:
        """Steps of those that came near the noise, for as long as these help."""
        best = np.inf
        for runner in sorted(there, key=lambda runner: runner.left):
            for _ in range(STEPS):
                last = runner.left
                if self.is_late or not runner.step() or last - runner.left < CLOSE:
                    break
                if runner.left > FALLS * last and (self.is_behind(runner.left, best) or self.is_hopeless(runner.left)):
                    break
            best = min(best, runner.left)

    def is_behind(self, left: float, best: float) -> bool:
        """Whether a change that leaves so much is told from the one that leaves least."""
        return left - best > TOLD_APART * max(1.0, best / self.count)

    def ended(self, runner: Runner) -> Tried:
        """The change where it fits best, with the noise estimated anew."""
        pieces = runner.fit.segments.pieces
        candidate = self.solved(runner.names, runner.fit.unknowns, runner.fit.law, pieces, runner.starts, runner.z)
        if not runner.special:
            return candidate
        return candidate._replace(
            freedom=candidate.freedom + 1.0,
            values={**candidate.values, **runner.special},
            intervals={**candidate.intervals, **runner.interval},
        )

    def searched(
        self, special: str, names: tuple[str, ...], unknowns: Unknowns, promise: Promise, near: float | None = None
    ) -> Runner:
        """At the limit by which the rest fits best, with its interval by how what is left bends there."""
        runners: dict[float, Runner] = {}

        def left(value: float) -> float:
            if value not in runners:
                pieces = [self.acted(piece, special, value) for piece in self.cut]
                runner = self.running(names, unknowns, pieces, self.starts, unknowns.z_start, promise)
                if not all(runner.step() for _ in range(2)):
                    runner.left = np.inf
                runners[value] = runner
            return runners[value].left

        i = self.model.input_names.index(special.rsplit(".", 1)[0])
        largest = max(float(np.max(np.abs(p.us[:, i]))) for p in self.pieces)
        grid, low, high = np.array(LEVELS) * largest, 0.0, largest
        if near is not None:
            grid = np.minimum(near * np.array([0.8, 1.0, 1.25]), largest)
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
        runner = runners[value]
        runner.special, runner.interval = {special: value}, {special: frozen([max(value - half, 0.0), value + half])}
        return runner

    def acted(self, piece: Piece, special: str, value: float) -> Piece:
        """The piece with an input that is cut."""
        i = self.model.input_names.index(special.rsplit(".", 1)[0])
        us = piece.us.copy()
        us[:, i] = np.clip(us[:, i], -value, value)
        return replace(piece, us=us)
