"""What may be changed in a model, and what every change promises, alone or beside another.

One pass of derivatives along the measured motion takes first states and gaps out of the least squares, which leaves
|b - R dz|^2 in all changes together. What some of them leave is then a problem of a few numbers, in their own columns
of R alone.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from drake_diff._base.arrays import Array, frozen
from drake_diff.exceptions import SimulationError
from drake_diff.identification.fit import Fit, Point, Reduced
from drake_diff.identification.identify import Problem
from drake_diff.identification.judge import HOPELESS, most_scatter, noise_of
from drake_diff.identification.motion import LONGEST, ContinuousMotion, EulerMotion, Law
from drake_diff.identification.ranking import Ranking, Tried
from drake_diff.identification.recordings import Piece
from drake_diff.identification.tree import ORDER_4, Dynamics, Tree
from drake_diff.identification.unknowns import (
    BIAS,
    INERTIA,
    MASS,
    Unknown,
    Unknowns,
    choose_unknowns,
    possible_changes,
)

DELAY, LIMIT = "input_delay", "limit"  # changes of how inputs act; a limit is found by a search over its one number
LONGEST_DELAY = 0.1  # [s]
LEVELS = (0.85, 0.6, 0.35)  # of an input's largest value: limits that are tried


def changes_of_inputs(names: Sequence[str], pieces: Sequence[Piece]) -> list[Unknown]:
    """A column for each limit, and one for the delay of all; of inputs that move."""
    moving = [i for i in range(len(names)) if any(np.ptp(p.us[:, i]) > 0 for p in pieces)]
    unknowns = [
        Unknown(f"{names[i]}.{LIMIT}{round(100 * level)}", "", np.zeros(1), 0.0, 0.0)
        for i in moving
        for level in LEVELS
    ]
    return [*unknowns, Unknown(f"model.{DELAY}", "s", np.zeros(1), 0.0, 0.0, LONGEST_DELAY)] if moving else unknowns


@dataclass(frozen=True, eq=False)
class Inputs:
    """A law that also says how steps change with a delay of inputs, and with what a limit takes off them."""

    law: ContinuousMotion
    unknowns: Unknowns
    pieces: Sequence[Piece]

    def slopes(self, z: Array, xs: Array, hs: Array, us: Array) -> tuple[Array, Array]:
        """Of each step: by the state (K, M, nx, nx), and by z (K, M, nx, np)."""
        by_x, by_z = self.law.slopes(z, xs, hs, us)
        columns = self.unknowns.columns
        names, nq = self.law.model.input_names, self.law.model.nq
        places = {unknown.name: s for unknown, s in zip(self.unknowns.each, self.unknowns.slices, strict=True)}
        for unknown, s in zip(self.unknowns.each, self.unknowns.slices, strict=True):
            if unknown.quantity == MASS and f"{unknown.label}.{INERTIA}" in places:
                # Alone it takes the inertia along, of which half the logarithm of the second moment's root is z.
                inertia = places[f"{unknown.label}.{INERTIA}"]
                by_z[..., s.start] += by_z[..., inertia] @ (0.5 * np.concatenate([np.ones(3), z[inertia][3:]]))
            elif unknown.quantity == DELAY and not unknown.shifts:
                accelerate = Dynamics(self.law.tree, self.law.tree.numbers).accelerate
                before = np.concatenate([us[:, :1], us[:, :-1]], axis=1)
                before[1:, 0] = us[:-1, -1]
                before[np.all(hs == 0, axis=1)] = 0.0
                flat = xs[:, :-1].reshape(-1, xs.shape[2])
                nu = us.shape[2]
                change = accelerate(flat, before.reshape(-1, nu)) - accelerate(flat, us.reshape(-1, nu))
                pushed = (by_x[..., nq:] @ change.reshape(*hs.shape, -1, 1))[..., 0]
                by_z[..., s.start] = np.where((hs > 0)[..., None], pushed, 0.0)
            elif unknown.quantity.startswith(LIMIT):
                i = names.index(unknown.label)
                fraction = float(unknown.quantity.removeprefix(LIMIT)) / 100
                level = fraction * max(float(np.max(np.abs(p.us[:, i]))) for p in self.pieces)
                u = us[..., i]
                cut = np.where(np.abs(u) > level, 1 - level / np.maximum(np.abs(u), 1e-300), 0.0)
                by_z[..., s.start] = -cut[..., None] * by_z[..., columns.index(f"{unknown.label}.strength")]
        return by_x, by_z

    def __getattr__(self, name: str) -> Any:
        return getattr(self.law, name)


@dataclass(frozen=True, eq=False)
class Promise:
    """Some changes together, by the linearized motion."""

    members: tuple[int, ...]
    left: float  # of the squares, in units of the noise
    freedom: float  # how many numbers the data can tell of them
    step: Array  # of z of the members, one after the other


NO_PROMISE = Promise((), np.inf, 0.0, np.zeros(0))


@dataclass(frozen=True, eq=False)
class View:
    """The least squares in all changes, linearized at one motion."""

    unknowns: Unknowns
    z: Array  # (np,) there
    starts: Array  # of the segments
    fit: Fit
    reduced: Reduced
    matrix: Array  # (np, np) R' R, with the weak pull to the file's values
    right: Array  # (np,)
    most: float  # what is left where nothing changes
    freedoms: tuple[float, ...]

    @cached_property
    def _places(self) -> list[NDArray[np.intp]]:
        return [np.arange(s.start, s.stop) for s in self.unknowns.slices]

    @cached_property
    def _lower(self) -> Array:
        return self.unknowns.bounds[0] - self.z

    def promise(self, members: tuple[int, ...]) -> Promise | None:
        """The best step of some members; None where it leads out of bounds."""
        columns = np.concatenate([self._places[i] for i in members])
        H, g = self.matrix[np.ix_(columns, columns)], self.right[columns]
        scale = 1 / np.sqrt(np.maximum(np.diag(H), 1e-300))
        step = scale * np.linalg.lstsq(H * np.outer(scale, scale), g * scale, rcond=1e-12)[0]
        lower = self._lower[columns]
        if np.any(step < lower):
            if len(columns) > 1:
                return None
            step = np.maximum(step, lower)
        gain = float(2 * g @ step - step @ H @ step)
        return Promise(members, self.most - gain, sum(self.freedoms[i] for i in members), step)

    def promises(self, changes: Iterable[tuple[int, ...]], price: float) -> list[Promise]:
        """Those that lower what is left by more than the price of their numbers, best first."""
        promises = [self.promise(members) for members in changes]
        good = [
            promise
            for promise in promises
            if promise is not None and self.most - promise.left > price * promise.freedom
        ]
        return sorted(good, key=lambda promise: promise.left + price * promise.freedom)

    def ahead(self, promise: Promise) -> tuple[Array, Array]:
        """(z of all changes, starts of the segments) after the step."""
        dz = np.zeros_like(self.z)
        k = 0
        for i in promise.members:
            s = self.unknowns.slices[i]
            dz[s] = promise.step[k : k + s.stop - s.start]
            k += s.stop - s.start
        far = np.where(np.isfinite(self.unknowns.widths), self.unknowns.widths / 3, np.inf)
        dz = np.clip(dz, -far, far)
        return self.z + dz, self.fit.moved(self.starts, self.reduced, dz, 1.0)


def view(fit: Fit, unknowns: Unknowns, z: Array, starts: Array) -> View | None:
    """From there; None where there is no motion, or one that grows beyond what numbers hold."""
    point = fit.at(z, starts)
    if point is None:
        return None
    reduced = fit.reduce(point)
    if not reduced.finite:
        return None
    finite = np.isfinite(unknowns.widths)
    pull = np.where(finite, unknowns.widths, np.inf) ** -2.0
    offset = unknowns.z_start - z
    norms = np.linalg.norm(reduced.R, axis=0)
    scale = np.where(finite, unknowns.widths, 1e6 / np.where(norms > 0, norms, 1.0))
    freedoms = []
    for s in unknowns.slices:
        sizes = np.linalg.svd(reduced.R[:, s] * scale[s], compute_uv=False)
        freedoms.append(float(np.sum(sizes**2 / (1 + sizes**2))))
    matrix = reduced.R.T @ reduced.R + np.diag(pull)
    right = reduced.R.T @ reduced.b + pull * offset
    most = reduced.rest + float(reduced.b @ reduced.b + np.sum(pull * offset**2))
    return View(unknowns, z, starts, fit, reduced, matrix, right, most, tuple(freedoms))


CALM = 1e-2  # of a small motion over a segment: by how much derivatives frozen halfway may miss it, as of a deviation
PARTS = (1, 2, 4, 5, 10, 20)  # of a sample: Euler steps that are tried
SETTLING, SETTLES = 8, 0.8  # steps by which segments settle, and the part of what was left that each must leave at most
PLAUSIBLE = 1.5  # times the squares that can be noise: what leaves more is not fitted to its end beside another
DELAYS = (0.25, 0.75, 1.5, 3, 5.5, 8)  # of a sample, from which other changes are looked for beside a delay


@dataclass(eq=False, kw_only=True)
class Candidates(Ranking):
    """Everything that may be changed, and the motion of the model as it is; `prepare` comes first."""

    tree: Tree
    by_delay: dict[float, Array] = field(default_factory=dict)  # starts of segments that settled at a delay
    calm: bool = False  # whether steps frozen halfway have the derivatives of the motion
    step: float | None = None  # [s] of the Euler steps that stand for the motion; None for continuous time

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
        unknowns = choose_unknowns(self.model, self.tree, names).each
        return Unknowns((*unknowns, *changes_of_inputs(self.model.input_names, self.pieces)), as_in_files=True)

    @property
    def delays(self) -> Array:
        """[s] from which a delay is looked for."""
        period = float(np.median(np.diff(self.pieces[0].times)))
        delays = period * np.array(DELAYS)
        return delays[delays < LONGEST_DELAY]

    def starts_at(self, delay: float) -> Array:
        """The starts of segments that settle where inputs act so much later."""
        known = self.by_delay if self.step is None else {}
        if delay not in known:
            late = self.of([f"model.{DELAY}"])
            law = self.law(late, self.longest)
            if self.step is None:
                law = replace(law, method=ORDER_4, frozen=True)
            problem = self.problem(late, self.cut)
            near = min(known, key=lambda other: abs(other - delay), default=0.0)
            starts = known[near] if abs(near - delay) < delay else self.starts
            known[delay] = self.settled(problem.fit(law, self.cut, problem.first_noise), np.array([delay]), starts)
        return known[delay]

    @property
    def steps(self) -> list[float]:
        """[s] lengths of steps of which a whole number lies between samples."""
        period = np.concatenate([np.diff(piece.times) for piece in self.cut])
        if self.chart.coordinates.free or np.ptp(period) > 1e-6 * np.mean(period):
            return []
        return [float(np.mean(period)) / n for n in PARTS]

    def of(self, names: Sequence[str]) -> Unknowns:
        """Those called so; where inputs act later, the motion has its steps cut where they change."""
        chosen = (unknown for unknown in self.unknowns.each if unknown.name in names)
        return Unknowns(
            tuple(replace(unknown, shifts=unknown.quantity == DELAY) for unknown in chosen), as_in_files=True
        )

    def with_one(self, i: int, values: Array) -> Array:
        """z of everything where change i is `values`; a mass takes the inertia along, as it does alone."""
        z, unknowns, slices = self.unknowns.z_start.copy(), self.unknowns.each, self.unknowns.slices
        z[slices[i]] = values
        for unknown, s in self.each_of(self.unknowns):
            if unknowns[i].quantity == MASS and unknown.name == f"{unknowns[i].label}.{INERTIA}":
                along = 0.5 * float(values[0] - self.unknowns.z_start[slices[i]][0])
                z[s] = np.concatenate([z[s][:3] + along, z[s][3:] * np.exp(along)])
        return z

    def law(self, unknowns: Unknowns, longest: float, *, smooth: bool = True) -> ContinuousMotion:
        """By Euler steps where they stand for the motion; Coulomb friction that is not smooth holds."""
        if self.step is not None:
            return EulerMotion(self.model, self.tree, unknowns, self.step)
        return ContinuousMotion(self.model, self.tree, unknowns, longest, smooth=smooth, frozen=self.calm)

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
        segment_fit = Fit(self.model, fit.law, self.chart, fit.unknowns, parts, fit.noise, fixed=True)
        left = np.inf
        for _ in range(SETTLING):
            here = segment_fit.at(z, starts)
            if here is None or here.value > SETTLES * left:
                break
            reduced, left = segment_fit.reduce(here), here.value
            best = _each_left(here)
            for fraction in (1.0, 0.3):
                moved = segment_fit.moved(here.starts, reduced, np.zeros_like(z), fraction)
                there = segment_fit.at(z, moved)
                if there is not None:
                    better = _each_left(there) < best
                    starts, best = np.where(better[:, None], moved, starts), np.where(better, _each_left(there), best)
        return starts

    def is_calm(self, fit: Fit) -> bool:
        """Whether a small motion goes through segments alike by steps frozen halfway, and by the method's own."""
        s, z = fit.segments, fit.unknowns.z_start
        some = slice(None, None, 2)  # of the segments
        law = self.law(fit.unknowns, self.longest)
        xs = law.run(fit.unknowns.values(z), self.starts[some], s.hs[some], s.us[some])
        ends = []
        for halfway in (False, True):
            steps, _ = replace(law, frozen=halfway).slopes(z, xs, s.hs[some], s.us[some])
            through = self.chart.from_motion(xs[:, 0])
            for m in range(steps.shape[1]):
                through = steps[:, m] @ through
            ends.append(self.chart.to_motion(xs[:, -1]) @ through * fit.gap_scale / fit.gap_scale[:, None])
        off, size = (np.linalg.norm(end, axis=(1, 2)) for end in (ends[0] - ends[1], ends[0]))
        return bool(np.all(off <= CALM * size))

    def view(self, pieces: Sequence[Piece], z: Array, starts: Array) -> View | None:
        """What everything promises there; where z has a delay, inputs act so much later."""
        unknowns = self.unknowns
        if any(unknown.quantity == DELAY and z[s][0] > 0 for unknown, s in self.each_of(unknowns)):
            unknowns = self.of([unknown.name for unknown in unknowns.each])
        problem = self.problem(unknowns, pieces)
        law = cast(ContinuousMotion, Inputs(self.law(self.unknowns, self.longest), unknowns, pieces))
        return view(problem.fit(law, pieces, problem.first_noise), unknowns, z, starts)

    def is_hopeless(self, left: float) -> bool:
        return left > HOPELESS**2 * self.count

    @cached_property
    def plausible(self) -> float:
        """What a change may leave of the squares that explains, however they are weighted."""
        numbers = np.isfinite(np.concatenate([piece.ys for piece in self.pieces])).sum(axis=0)
        seen = numbers[numbers > 0]
        return PLAUSIBLE * most_scatter(int(np.min(seen)), len(seen)) ** 2 * self.count

    @staticmethod
    def plain(name: str) -> str:
        """The name without the level at which a limit was tried."""
        label, quantity = name.rsplit(".", 1)
        return f"{label}.{LIMIT}" if quantity.rstrip("0123456789") == LIMIT else name

    @staticmethod
    def is_of_inputs(name: str) -> bool:
        return name.endswith((f".{DELAY}", f".{LIMIT}"))


def _each_left(point: Point) -> Array:
    """(K,) of the squares, of each segment."""
    return np.array([float(np.nansum(r**2)) for r in point.residuals])


STEPS, ROUNDS = 8, 4  # of Gauss and Newton, and of estimating the noise
SAME_NOISE = 0.03  # what is left of its error changes a score by less than 0.001 of how many numbers were measured
LOOKED_AT = 8  # changes that enter the race, of those that promise most: of those of one number, and of others
RACE = (5, 4, 3, 2, 2, 1)  # so many stay after each step of Gauss and Newton
FALLS = 0.7  # what does not fall to this part of what was left before is out of the race, after its first step
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


@dataclass(eq=False, kw_only=True)
class Race(Candidates):
    """Fits changes of a model, those that promise most."""

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
        return self.judge(names, problem, fit, solved)

    def followed(self, problem: Problem, fit: Fit, z: Array, starts: Array) -> Fit:
        """By steps short enough for the motion there: a search by longer ones takes long, and leads nowhere."""
        for _ in range(ROUNDS):
            shorter = fit.shorter
            if shorter is None or problem.follows(fit, z, starts):
                break
            fit = fit.by(shorter)
        return fit

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
