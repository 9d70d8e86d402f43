"""The search for one changed parameter in recordings with contact, by the model's own steps.

A small error of the first state grows through an impact, so the fitted part of a recording is extended in stages. The
unchanged model is fitted up to the stage with residuals above noise. Each change starts there, from several values.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.certificates.truth import overlaps_along
from drake_diff.comparison.recordings import CLOCK_TOLERANCE
from drake_diff.exceptions import DrakeDiffError, SimulationError
from drake_diff.identification.candidates import Ranking, Tried
from drake_diff.identification.columns import mistaken_columns
from drake_diff.identification.fit import Fit, FittedMotion, Solved
from drake_diff.identification.judge import HOPELESS
from drake_diff.identification.messages import NO_CHANGE
from drake_diff.identification.motion import DiscreteMotion, discrete_motion
from drake_diff.identification.recordings import Excerpt, guess_states, heights
from drake_diff.identification.results import Explanation
from drake_diff.identification.unknowns import BIAS, CENTER, MASS, Unknown, Unknowns, choose_unknowns
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, list_parameters, select
from drake_diff.model.plant import bodies, labelled
from drake_diff.model.tangent import tangent_space

FIRST, LONGER = 3, 1.5  # samples of the first stage; ratio of the lengths of successive stages
BEGIN = (0.1, -0.1, 0.3, -0.3, 0.8, -0.8)  # initial changes of one number, in its logarithm or in units of HEIGHT
HEIGHT = 0.02  # [m] unit of initial changes of the ground's height
BEST = 2  # number of initial values of a change from which a fit is started
STEPS, FEW = 8, 3  # maximum numbers of Gauss-Newton steps, in the last stage and in those before
TOLD_APART = 20.0  # excess of the sum of squares over that of a change that explains, above which a change is given up
MORE = 1.3  # times the mean square of the previous stage, above which other first states are tried
DRAWS, LEAST_SEEN = 24, 1e-3  # number of such states; relative singular value below which a combination is not varied
NOISY = 1.5  # times the scatter: residuals of the model in a stage at which changes begin
OF_CONTACT = ("friction", "stiffness", "dissipation", "radius")
OF_MOTION = (MASS, CENTER, "damping", "gravity")
SEGMENT = 0.1  # [s] length of the segments on which mistaken columns are compared
LARGER = 1.2  # factor of the radii with which bodies that nearly touch are found
NOTHING = Unknowns(())


def may_touch(model: Model, pieces: Sequence[Excerpt]) -> bool:
    """Return whether bodies would touch with a higher ground and larger spheres; needs whole steps between samples."""
    periods = np.concatenate([np.diff(piece.times) for piece in pieces]) / model.time_step
    stride = np.round(np.median(periods))
    if not model.contract.contact.collision_pairs or stride < 1 or np.any(np.abs(periods - stride) > CLOCK_TOLERANCE):
        return False
    lower = [i for i, _ in heights(model)]
    radii = {p.name: p.value for p in list_parameters(model) if p.name.endswith(".radius") and "/" not in p.name}
    with applied(select(model, {name: LARGER * value for name, value in radii.items()})) as larger:
        states = np.concatenate([guess_states(model, piece, np.arange(len(piece.times))) for piece in pieces])
        states[:, lower] -= HEIGHT
        return any(overlaps_along(larger, states))


class FitStage(NamedTuple):
    """The fit of a change to the recordings up to a stage."""

    stage: int
    fit: Fit
    solved: Solved
    left: float  # mean squared residual, in units of the scatter


@dataclass(eq=False)
class ContactExplanation(Ranking):
    """The search for one change that explains recordings with contact."""

    least_left: dict[int, float] = field(default_factory=dict)  # least `left` by stage, of the changes that explain
    jumps = True

    def __post_init__(self) -> None:
        self.model = discrete_motion(self.model, NOTHING, self.pieces).model

    def explanation(self) -> Explanation:
        stages = list(self.stages_of(NOTHING, 0, np.zeros(0), None))
        begin = stages[0]
        for stage in stages:
            begin = stage if stage.left < NOISY**2 * min(1.0, begin.left) else begin
        base = self.judged((), NOTHING, stages[-1])
        if not base.explains:
            law = replace(self.law(NOTHING), segment=SEGMENT)
            columns = mistaken_columns(self.model, self.pieces, law, [self.unchanged])
            if columns is not None:
                return columns
        tried: list[Tried] = []
        for unknown, points in sorted(self.first_points(begin), key=lambda pair: pair[1][0].value):
            candidate = None if self.is_late else self.tried(unknown, begin, points)
            tried += [] if candidate is None else [candidate]
        explaining = [candidate for candidate in tried if candidate.explains]
        end = None  # unchanged model from the first states of the best change, which may give smaller residuals
        if explaining:
            starts = min(explaining, key=self.bic).starts
            end = self.to_end(len(self.stages) - 1, starts)
        again = [] if end is None else [self.judged((), NOTHING, end)]
        none = [candidate for candidate in explaining if self.is_nothing(candidate)]
        base = min([base, *again], key=lambda fitted: fitted.score)
        base = min([base, *none], key=lambda fitted: (not fitted.explains, fitted.score))
        self.evidence.update({candidate.names[0]: base.score - candidate.score for candidate in tried})
        changed = [candidate for candidate in tried if not any(candidate is other for other in none)]
        named = self.enough(base, changed, len(self.changes))
        if named:
            return self.named(named, f", by the model's own steps of {1e3 * self.model.time_step:.4g} ms")
        if base.explains:
            return self.nothing()
        near = min(tried, key=self.bic, default=None)
        what = f"with {near.names[0]}, {near.doubt}" if near and near.doubt else "no change comes close"
        return self.unexplained(f"{NO_CHANGE}; {what}.")

    def is_nothing(self, candidate: Tried) -> bool:
        """Return whether the interval contains the model's value: only the first states improved the fit."""
        (name,) = candidate.names
        start, _ = self.of_model(name)
        low, high = np.atleast_2d(candidate.intervals[name]).T
        return bool(np.all(np.isfinite(high - low) & (low <= start) & (start <= high)))

    @cached_property
    def stages(self) -> list[float]:
        """The fractions of the recordings that are fitted, the last being 1."""
        longest = max(len(piece.times) for piece in self.pieces)
        count = max(0, int(np.ceil(np.log(longest / FIRST) / np.log(LONGER))))
        return [min(1.0, FIRST * LONGER**k / longest) for k in range(count)] + [1.0]

    def law(self, unknowns: Unknowns) -> DiscreteMotion:
        return discrete_motion(self.model, unknowns, self.pieces)

    def fit(self, law: DiscreteMotion, unknowns: Unknowns, stage: int) -> Fit:
        last = [round(self.stages[stage] * len(piece.times)) - 1 for piece in self.pieces]
        parts = [p.part(0, min(max(k, FIRST - 1), len(p.times) - 1)) for p, k in zip(self.pieces, last, strict=True)]
        problem = self.problem(unknowns, parts)
        return problem.fit(law, parts, problem.first_noise)

    def stages_of(
        self, unknowns: Unknowns, first: int, z: Array, starts: Array | None, before: FitStage | None = None
    ) -> Iterator[FitStage]:
        """Yield the fits of a change stage by stage, while the residuals are at most HOPELESS."""
        law = self.law(unknowns)
        for stage in range(first, len(self.stages)):
            fit = self.fit(law, unknowns, stage)
            starts = self.problem(unknowns, fit.segments.pieces).guess(fit) if starts is None else starts
            steps = STEPS if stage == len(self.stages) - 1 else FEW
            now = self.solved(fit, stage, z, starts, steps)
            if before is not None and (now is None or now.left > MORE * max(before.left, 1.0)):
                others = (self.solved(fit, stage, z, x, steps) for x in self.other_starts(fit, z, before))
                now = min((end for end in (now, *others) if end), key=lambda end: end.left, default=None)
            if now is None:
                return
            if self.is_behind(now):
                now = self.solved(fit, stage, now.solved.z, now.solved.starts, STEPS) or now
            z, starts, before = now.solved.z, now.solved.starts, now
            yield now
            if now.left > HOPELESS**2 or self.is_behind(now):
                return

    def is_behind(self, now: FitStage) -> bool:
        """Return whether the residuals of a stage are clearly larger than those of a change that explains."""
        best = self.least_left.get(now.stage, np.inf)
        return (now.left - best) * now.fit.count > TOLD_APART * max(best, 1.0)

    @staticmethod
    def solved(fit: Fit, stage: int, z: Array, starts: Array, most: int) -> FitStage | None:
        """Solve the least squares of a stage; return None if no motion exists."""
        try:
            solved = fit.solve(z, starts, most)
        except SimulationError:
            return None
        residuals = np.concatenate([rows[np.isfinite(rows)] for rows in solved.reduced.residuals])
        return FitStage(stage, fit, solved, float(np.mean(residuals**2)))

    def other_starts(self, fit: Fit, z: Array, before: FitStage) -> list[Array]:
        """Return the best other first states that the stage before allows, as steps may stop early through impacts."""
        random, size = np.random.default_rng(0), np.sqrt(max(before.left, 1.0))
        spreads = [np.linalg.pinv(R, rcond=LEAST_SEEN) for R, _, _ in before.solved.reduced.own]
        moves = (
            np.array([size * spread @ random.standard_normal(len(spread)) for spread in spreads]) for _ in range(DRAWS)
        )
        points = [fit.at(z, tangent_space(self.model).plus(before.solved.starts, move)) for move in moves]
        best = sorted((point for point in points if point is not None), key=lambda point: point.value)
        return [point.starts for point in best[:BEST]]

    def to_end(self, first: int, starts: Array | None) -> FitStage | None:
        """Return the last stage of the unchanged model, or None if it does not reach the end of the recordings."""
        stages = list(self.stages_of(NOTHING, first, np.zeros(0), starts))
        return stages[-1] if stages and stages[-1].stage == len(self.stages) - 1 else None

    def first_points(self, begin: FitStage) -> Iterator[tuple[Unknown, list[FittedMotion]]]:
        """Yield each change with the motions at its initial values, best first."""
        for unknown in self.changes:
            unknowns = Unknowns((unknown,))
            fit = self.fit(self.law(unknowns), unknowns, min(begin.stage + 1, len(self.stages) - 1))
            points = [fit.at(unknowns.z_start + change, begin.solved.starts) for change in self.beginnings(unknown)]
            there = sorted((point for point in points if point is not None), key=lambda point: point.value)
            if there:
                yield unknown, there

    def tried(self, unknown: Unknown, begin: FitStage, points: Sequence[FittedMotion]) -> Tried | None:
        """Fit a change from the best initial value that reaches the end; return None if none does."""
        unknowns, stage = Unknowns((unknown,)), min(begin.stage + 1, len(self.stages) - 1)
        for point in points[:BEST]:
            stages = list(self.stages_of(unknowns, stage, point.z, point.starts, begin))
            if stages and stages[-1].stage == len(self.stages) - 1:
                candidate = self.judged((unknown.name,), unknowns, stages[-1])
                for now in stages if candidate.explains else ():
                    self.least_left[now.stage] = min(self.least_left.get(now.stage, np.inf), now.left)
                return candidate
        return None

    @staticmethod
    def beginnings(unknown: Unknown) -> list[Array]:
        """Return the changes (k,) of z with which the search begins."""
        none, scales = np.zeros(len(unknown.start)), np.array(BEGIN)[:, None]
        if unknown.quantity == BIAS:
            return [none, *(HEIGHT * scales)]
        if len(none) > 1 or unknown.size == 0:
            return [none]
        return [none, *(scales if unknown.quantity == MASS else unknown.start * np.expm1(scales))]

    def judged(self, names: tuple[str, ...], unknowns: Unknowns, stage: FitStage) -> Tried:
        """Judge a fit by the noise of its residuals; a fit that does not reach the end does not explain."""
        solved = replace(stage.solved, converged=True)  # the loss is rough: only the last residuals count
        candidate = self.judge(names, self.problem(unknowns, stage.fit.segments.pieces), stage.fit, solved)
        if stage.stage == len(self.stages) - 1:
            return candidate
        return candidate._replace(score=np.inf, doubt="its motion departs from the recordings")

    def unchanged(self, pieces: Sequence[Excerpt]) -> tuple[float, bool]:
        """Return (score, whether it explains) of the unchanged model on other pieces."""
        other = ContactExplanation(self.model, list(pieces), self.stated)
        end = other.to_end(0, None)
        base = None if end is None else other.judged((), NOTHING, end)
        return (np.inf, False) if base is None else (base.score, base.explains)

    @cached_property
    def changes(self) -> list[Unknown]:
        """All quantities that are tried: first those of contact, then those of motion."""
        known, plant = {p.name: p.value for p in list_parameters(self.model)}, self.model.plant
        names = [n for q in OF_CONTACT for n in known if n.endswith(f".{q}") and "/" not in n and np.all(known[n] > 0)]
        names += [f"{self.model.position_names[i]}.{BIAS}" for i, _ in heights(self.model)]
        names += [n for q in OF_MOTION for n in known if n.endswith(f".{q}")]
        fixed = {body.index() for body in plant.GetBodiesWeldedTo(plant.world_body())}
        moving = {label for label, body in labelled(bodies(plant)).items() if body.index() not in fixed}
        unknowns: list[Unknown] = []
        for name in names:
            label, quantity = name.rsplit(".", 1)
            if quantity in (MASS, CENTER) and label not in moving:
                continue
            try:
                unknowns += choose_unknowns(self.model, None, [name]).each
            except DrakeDiffError:  # a body without mass
                continue
        return unknowns

    def of_model(self, name: str) -> tuple[Array, str]:
        unknown = next(unknown for unknown in self.changes if unknown.name == name)
        return unknown.start, "m" if unknown.quantity == BIAS else unknown.unit
