"""The smallest change of a model that explains what was recorded: one parameter, or two, or what no file has.

Every possible change is tried by one step of Gauss and Newton from the model as it is, all in one pass of derivatives
along the measured motion. Those that promise most are fitted. A change is named where

    score(model) - score(changed) > limit,

scores being -2 log of the likelihood with the noise estimated anew. In a right model the difference is distributed as
chi^2 of as many numbers as the change has; the limit is its quantile at FALSE_NAME, divided by how many changes were
tried, and no less than the penalty of BIC. Of changes that are named, the one with the least BIC is the smallest.
"""

from collections.abc import Iterator, Mapping, Sequence
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
from drake_diff.identification.fit import Fit, Law, Solved
from drake_diff.identification.flow import ContinuousMotion
from drake_diff.identification.identify import LONGEST, Problem, what_acts
from drake_diff.identification.judge import freedom_of, intervals_of, known_of, noise_of
from drake_diff.identification.measured import Piece, given_noise, noise_by_differences, read_pieces
from drake_diff.identification.tree import Tree, tree_for_identification
from drake_diff.identification.unknowns import BIAS, Unknown, Unknowns, choose_unknowns, possible_changes
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.model import Model

FALSE_NAME = 0.003  # of right models in which some change is named
FITTED = 4  # changes that are fitted, of those that promise most
BEHIND, LEAST_BEHIND = 0.3, 40.0  # of the best promise: what promises less by so much is not fitted
STEPS, ROUNDS = 8, 4  # of Gauss and Newton, and of estimating the noise
SAME_NOISE = 0.03  # what is left of its error changes a score by less than 0.001 of how many numbers were measured
HOPELESS = 3.0  # times the noise: residuals that no better weights make good
SAME = 6.0  # of a score: evidence of 20 to 1, below which two changes are not told apart
DELAY, LIMIT = "input_delay", "limit"  # changes of how inputs act, found by a search over their one number
MOTIONS = ("auto", "continuous")
LONGEST_DELAY = 0.1  # [s]
LEVELS = (0.85, 0.6, 0.35)  # of an input's largest value: limits that are tried


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
    delay of all inputs, and biases of sensors. Pairs are tried where none of them explains the recordings alone.

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
    why = str(tree) if isinstance(tree, Refusal) else what_acts(model, chart, pieces) if motion == "auto" else ""
    if why or isinstance(tree, Refusal):
        raise ModelError(f"{model.name}: causes are looked for in motions in continuous time only, and {why}")
    return _Search(model, tree, chart, pieces, given_noise(model, chart, noise)).found()


class _Tried(NamedTuple):
    names: tuple[str, ...]
    score: float
    pull: float  # how far it is from the file's values, as the fit weighs that
    freedom: float
    explains: bool
    doubt: str
    values: dict[str, Any]
    intervals: dict[str, Array]


@dataclass(frozen=True, eq=False)
class _Promise:
    """What one step of Gauss and Newton from the model as it is promises of each change, and of two together."""

    names: tuple[str, ...]
    slices: tuple[slice, ...]
    matrix: Array  # (np, np) R' R, with the weak pull to the file's values
    right: Array  # (np,)
    lower: Array  # (np,) of a step
    freedoms: tuple[float, ...]

    def of(self, members: Sequence[int]) -> tuple[float, Array]:
        """(by how much -2 log of the likelihood falls, the step); nothing where it leads out of bounds."""
        at = np.concatenate([np.arange(self.slices[i].start, self.slices[i].stop) for i in members])
        H, g = self.matrix[np.ix_(at, at)], self.right[at]
        step = np.linalg.lstsq(H, g, rcond=1e-12)[0]
        if np.any(step < self.lower[at]):
            if len(at) > 1:
                return 0.0, np.zeros(len(at))
            step = np.maximum(step, self.lower[at])
        return float(2 * g @ step - step @ H @ step), step


@dataclass(frozen=True, eq=False)
class _Inputs:
    """A law that also says how steps change with a delay of inputs, and with what a limit takes off them."""

    law: ContinuousMotion
    unknowns: Unknowns
    pieces: Sequence[Piece]

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array) -> tuple[Array, Array]:
        by_x, by_z = self.law.slopes(z, xs, hs, us)
        columns = self.unknowns.columns
        names, nq = self.law.model.input_names, self.law.model.nq
        for j, one in enumerate(self.unknowns.each):
            column = self.unknowns.slices[j].start
            if one.quantity == DELAY:
                accelerate = self.law.tree.acceleration(self.law.tree.numbers)
                before = np.concatenate([us[:, :1], us[:, :-1]], axis=1)
                before[1:, 0] = us[:-1, -1]
                before[np.all(hs == 0, axis=1)] = 0.0
                flat = xs[:, :-1].reshape(-1, xs.shape[2])
                q, v = flat[:, :nq], flat[:, nq:]
                nu = us.shape[2]
                change = accelerate(q, v, before.reshape(-1, nu)) - accelerate(q, v, us.reshape(-1, nu))
                pushed = (by_x[..., nq:] @ change.reshape(*hs.shape, -1, 1))[..., 0]
                by_z[..., column] = np.where((hs > 0)[..., None], pushed, 0.0)
            elif one.quantity.startswith(LIMIT):
                i = names.index(one.label)
                level = (
                    float(one.quantity.removeprefix(LIMIT))
                    / 100
                    * max(float(np.max(np.abs(p.us[:, i]))) for p in self.pieces)
                )
                u = us[..., i]
                cut = np.where(np.abs(u) > level, 1 - level / np.maximum(np.abs(u), 1e-300), 0.0)
                strength = columns.index(f"{one.label}.strength")
                by_z[..., column] = -cut[..., None] * by_z[..., strength]
        return by_x, by_z

    def __getattr__(self, name: str) -> Any:
        return getattr(self.law, name)


@dataclass(eq=False)
class _Search:
    model: Model
    tree: Tree
    chart: Chart
    pieces: list[Piece]
    stated: Array
    evidence: dict[str, float] = field(default_factory=dict)

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
        each = list(choose_unknowns(self.model, self.tree, names).each)
        moving = [i for i in range(self.model.nu) if any(np.ptp(p.us[:, i]) > 0 for p in self.pieces)]
        for i in moving:
            label = self.model.input_names[i]
            each += [Unknown(f"{label}.{LIMIT}{round(100 * part)}", "", np.zeros(1), 0.0, 0.0) for part in LEVELS]
        if moving:
            each.append(Unknown(f"model.{DELAY}", "s", np.zeros(1), 0.0, 0.0))
        return Unknowns(tuple(each))

    def problem(self, unknowns: Unknowns, pieces: Sequence[Piece]) -> Problem:
        return Problem(self.model, self.chart, unknowns, list(pieces), self.stated, self.scatter)

    def law(self, unknowns: Unknowns, longest: float) -> ContinuousMotion:
        return ContinuousMotion(self.model, self.tree, self.chart, unknowns, longest)

    def found(self) -> Explanation:
        nothing = Unknowns(())
        fit, starts = self.problem(nothing, self.pieces).prepared(self.law(nothing, LONGEST))
        longest = fit.law.longest if isinstance(fit.law, ContinuousMotion) else LONGEST
        self.longest, self.cut, self.starts = longest, list(fit.segments.pieces), starts
        base = self.solved((), nothing, self.cut, starts)
        if base is None:
            raise SimulationError(f"{self.model.name} has no motion near the states that were measured")
        promise = self.promise(starts)
        singles = self.tried([(i,) for i in range(len(promise.names))], promise, base)
        named = self.enough(base, singles, len(promise.names))
        if named:
            return self.said(named)
        if base.explains:
            return self.right()
        count = len(promise.names)
        pairs = self.tried(list(combinations(range(count), 2)), promise, base)
        best = min([base, *singles], key=lambda one: one.score)
        named = self.enough(base, [one for one in pairs if one.score < best.score], count * (count - 1) // 2)
        if named:
            return self.said(named)
        return self.unexplained(min([base, *singles, *pairs], key=self.bic))

    def promise(self, starts: Array) -> _Promise:
        unknowns = self.unknowns
        problem = self.problem(unknowns, self.cut)
        law: Law = _Inputs(self.law(unknowns, self.longest), unknowns, self.cut)
        fit = problem.fit(law, self.cut, problem.first_noise)
        point = fit.at(unknowns.z_start, starts)
        if point is None:
            raise SimulationError(f"{self.model.name} has no motion near the states that were measured")
        reduced = fit.reduce(point)
        pull = np.where(np.isfinite(unknowns.widths), unknowns.widths, np.inf) ** -2.0
        matrix = reduced.R.T @ reduced.R
        scale = np.where(np.isfinite(unknowns.widths), unknowns.widths, 1e6)
        freedoms = []
        for s in unknowns.slices:
            sizes = np.linalg.svd(reduced.R[:, s] * scale[s], compute_uv=False)
            freedoms.append(float(np.sum(sizes**2 / (1 + sizes**2))))
        lower = unknowns.bounds[0] - unknowns.z_start
        names = tuple(one.name for one in unknowns.each)
        right = reduced.R.T @ reduced.b
        return _Promise(names, unknowns.slices, matrix + np.diag(pull), right, lower, tuple(freedoms))

    def tried(self, changes: Sequence[tuple[int, ...]], promise: _Promise, base: _Tried) -> list[_Tried]:
        """Those that promise most, fitted."""
        log_count = np.log(self.count)
        ranked = []
        for members in changes:
            gain, step = promise.of(members)
            ranked.append((gain - log_count * sum(promise.freedoms[i] for i in members), members, step))
        ranked.sort(key=lambda one: -one[0])
        found: list[_Tried] = []
        done: set[tuple[str, ...]] = set()
        for gain, members, step in ranked:
            if gain <= 0 or len(done) == FITTED or gain < ranked[0][0] - max(LEAST_BEHIND, BEHIND * ranked[0][0]):
                break
            names = tuple(self.plain(promise.names[i]) for i in members)
            if names in done or len(set(names)) < len(names) or sum(map(self.is_of_inputs, names)) > 1:
                continue
            done.add(names)
            one = self.fitted(names, dict(self.starting(members, promise, step)))
            if one is not None:
                found.append(one)
                self.evidence[" and ".join(names)] = base.score - one.score
        return found

    def starting(self, members: Sequence[int], promise: _Promise, step: Array) -> Iterator[tuple[str, Array]]:
        k = 0
        for i in members:
            size = promise.slices[i].stop - promise.slices[i].start
            yield promise.names[i], step[k : k + size]
            k += size

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

    def fitted(self, names: tuple[str, ...], steps: Mapping[str, Array]) -> _Tried | None:
        own = [one for one in self.unknowns.each if one.name in names and not self.is_of_inputs(one.name)]
        unknowns = Unknowns(tuple(own))
        special = [name for name in names if self.is_of_inputs(name)]
        try:
            if special:
                return self.searched(special[0], names, unknowns)
            dz = np.concatenate([steps[one.name] for one in own])
            far = np.where(np.isfinite(unknowns.widths), unknowns.widths / 3, np.inf)
            z = np.clip(unknowns.z_start + np.clip(dz, -far, far), *unknowns.bounds)
            return self.solved(names, unknowns, self.cut, self.starts, z)
        except SimulationError:
            return None

    def solved(
        self, names: tuple[str, ...], unknowns: Unknowns, pieces: Sequence[Piece], starts: Array, z: Array | None = None
    ) -> _Tried | None:
        problem = self.problem(unknowns, pieces)
        fit = problem.fit(self.law(unknowns, self.longest), pieces, problem.first_noise)
        z = unknowns.z_start if z is None or fit.at(z, starts) is None else z
        for _ in range(ROUNDS):
            solved = fit.solve(z, starts, STEPS)
            z, starts = solved.z, solved.starts
            size = noise_of(fit, solved)
            seen = np.isfinite(size)
            if solved.converged and np.any(
                size[seen] > HOPELESS * np.where(np.isfinite(self.stated), self.stated, self.scatter)[seen]
            ):
                break
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
        return _Tried(names, self.score(fit, solved), pull, taken - alone, not doubt, doubt, values, shaped)

    def searched(self, special: str, names: tuple[str, ...], unknowns: Unknowns) -> _Tried | None:
        """The delay or limit by which the rest fits best, and its interval by how the score bends there."""
        found: dict[float, _Tried | None] = {}

        def score(value: float) -> float:
            if value not in found:
                pieces = [self.acted(piece, special, value) for piece in self.cut]
                problem = self.problem(unknowns, pieces)
                fit = problem.fit(self.law(unknowns, self.longest), pieces, problem.first_noise)
                try:
                    found[value] = self.solved(names, unknowns, pieces, problem.guess(fit))
                except SimulationError:
                    found[value] = None
            one = found[value]
            return np.inf if one is None else one.score

        period = float(np.median(np.diff(self.pieces[0].times)))
        if special.endswith(DELAY):
            grid = np.array([0.5, 1, 2, 4, 7]) * period
            grid = grid[grid <= LONGEST_DELAY]
            low, high = 0.0, LONGEST_DELAY
        else:
            i = self.model.input_names.index(special.rsplit(".", 1)[0])
            largest = max(float(np.max(np.abs(p.us[:, i]))) for p in self.pieces)
            grid, (low, high) = np.array(LEVELS) * largest, (0.0, largest)
        best = min((float(v) for v in grid), key=score)
        nearby = sorted([low, *map(float, grid), high])
        k = nearby.index(best)
        least = minimize_scalar(score, bounds=(nearby[k - 1], nearby[k + 1]), method="bounded",
                                options={"xatol": 0.01 * best, "maxiter": 8})  # fmt: skip
        value = float(least.x)
        one = found[value]
        if one is None:
            return None
        width = max(0.02 * value, 1e-12)
        bend = (score(value + width) + score(value - width) - 2 * one.score) / width**2
        half = 1.96 * np.sqrt(2 / bend) if bend > 0 else np.inf
        return one._replace(
            freedom=one.freedom + 1.0,
            values={**one.values, special: value},
            intervals={**one.intervals, special: frozen([max(value - half, 0.0), value + half])},
        )

    def acted(self, piece: Piece, special: str, value: float) -> Piece:
        """The piece with its inputs later, or cut; an input that changes between samples makes a sample of nothing."""
        if not special.endswith(DELAY):
            i = self.model.input_names.index(special.rsplit(".", 1)[0])
            us = piece.us.copy()
            us[:, i] = np.clip(us[:, i], -value, value)
            return replace(piece, us=us)
        switches = piece.times[:-1] + value
        near = np.min(np.abs(switches[:, None] - piece.times), axis=1) < 1e-6
        times = np.union1d(piece.times, switches[(switches < piece.times[-1]) & ~near])
        ys = np.full((len(times), piece.ys.shape[1]), np.nan)
        ys[np.searchsorted(times, piece.times)] = piece.ys
        held = np.clip(np.searchsorted(piece.times[:-1], times[:-1] - value + 1e-6, side="right") - 1, 0, None)
        return Piece(piece.name, times, ys, piece.us[held], piece.held_out)

    def bic(self, one: _Tried) -> float:
        return one.score + one.pull + one.freedom * float(np.log(self.count))

    def enough(self, base: _Tried, tried: Sequence[_Tried], count: int) -> list[_Tried]:
        """The changes that explain and have the evidence, best first, and not told from the best."""
        found = []
        for one in tried:
            freedom = max(one.freedom, 1.0)
            limit = max(stats.chi2.isf(FALSE_NAME / max(count, 1), freedom), freedom * np.log(self.count))
            if one.explains and base.score - one.score > limit:
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
            sentence=f"{', or '.join(texts)}{tail}.",
            evidence=self.evidence,
        )

    def words(self, one: _Tried, name: str) -> str:
        label, quantity = name.rsplit(".", 1)
        value, interval = np.atleast_1d(one.values[name]), np.atleast_2d(one.intervals[name])
        if quantity == DELAY:
            start, unit = np.zeros(1), "s"
        elif quantity == LIMIT:
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

    def right(self) -> Explanation:
        return Explanation((), {}, {}, (), True, "Nothing: the model explains it.", self.evidence)

    def unexplained(self, nearest: _Tried) -> Explanation:
        near = f"with {' and '.join(nearest.names)}" if nearest.names else "as the model is"
        sentence = f"Not explained: no change of one or two quantities explains the recording; {near}, {nearest.doubt}."
        return Explanation((), {}, {}, (), False, sentence, self.evidence)
