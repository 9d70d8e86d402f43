"""The smallest change that explains motions in which bodies touch: one parameter alone, by the model's own steps.

Motions are whole: from a first state, which is fitted with each change, to the end. That end is reached in stages. The
model as it is goes first, up to the stage at which it leaves more than noise. Only there does each change begin, from a
few values and by Gauss-Newton steps whose slopes are differences of motions; what cannot follow that far is given up,
and what can goes on to the end. Evidence and limit are those of `explain`.
"""

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import stats

from drake_diff._base.arrays import Array, frozen
from drake_diff.comparison.recordings import CLOCK_TOLERANCE
from drake_diff.exceptions import DrakeDiffError
from drake_diff.identification.chart import Chart
from drake_diff.identification.columns import mistaken_columns
from drake_diff.identification.measured import Piece, guess_states
from drake_diff.identification.race import LONGEST_SEARCH, LOOKED_AT, TOLD_APART
from drake_diff.identification.trial import FALSE_NAME, SAME
from drake_diff.identification.unknowns import BIAS, CENTER, MASS, Unknown, choose_unknowns
from drake_diff.identification.whole_motions import HEIGHT, HOPELESS, WIDTHS, Fitted, Point, WholeMotions
from drake_diff.identification.words import NO_CHANGE, Explanation, changed_to, explained_by
from drake_diff.model.model import Model
from drake_diff.model.parameters import applied, list_parameters, select
from drake_diff.model.plant import bodies, labelled
from drake_diff.model.step import set_state

OF_CONTACT = ("friction", "stiffness", "dissipation", "radius")
OF_MOTION = (MASS, CENTER, "damping", "gravity")
FOLLOWED, AGAIN_FOLLOWED = 2, 6  # of where a change may begin, at first and where none explains
SEGMENT = 0.1  # [s] by which mistakes of columns are compared
AGAIN = np.linspace(-1.5, 1.5, 25)  # where a change begins that is like one that explains, in its own scale
NEXT_TO_NOTHING = 2e-3  # of its scale: a change that explains and is no larger leaves the model as it is
LARGER = 1.2  # radii with which bodies are looked at that nearly touch


def explain_contact(model: Model, chart: Chart, pieces: Sequence[Piece], stated: Array) -> Explanation:
    """The one change that explains recordings in which bodies touch, with `stated` noise (2 nv,), NaN where unknown.

    InputError where samples are not a whole number of the model's steps apart.
    """
    return _Search(WholeMotions(model, chart, pieces, stated)).found()


def may_touch(model: Model, chart: Chart, pieces: Sequence[Piece]) -> bool:
    """Whether bodies would touch with a higher ground and larger spheres, where samples are whole steps apart."""
    periods = np.concatenate([np.diff(piece.times) for piece in pieces]) / model.time_step
    each = np.round(np.median(periods))
    if not model.contract.contact.collision_pairs or each < 1 or np.any(np.abs(periods - each) > CLOCK_TOLERANCE):
        return False
    lower = [model.position_names.index(name) for name in _heights(model, chart)]
    radii = {p.name: p.value for p in list_parameters(model) if p.name.endswith(".radius") and "/" not in p.name}
    with applied(select(model, {name: LARGER * value for name, value in radii.items()})) as larger:
        for piece in pieces:
            for x in guess_states(model, chart, piece, np.arange(len(piece.times))):
                x[lower] -= HEIGHT
                set_state(larger.double, x)
                if larger.double.overlaps():
                    return True
    return False


@dataclass(eq=False)
class _Search:
    motions: WholeMotions
    begun: float = field(default_factory=time.process_time)
    ended_early: bool = False

    def __post_init__(self) -> None:
        self.model, self.chart, self.pieces = self.motions.model, self.motions.chart, self.motions.pieces

    def found(self) -> Explanation:
        base, stage, point = self.motions.base()
        each = self.changes()
        if base.explains:
            falls = self.falls(each, 1.0, point)
            tried = [one for one in each if falls[one.name] > 0.5 * self.limit(len(one.start), len(each))]
        else:
            law = replace(self.motions.law, segment=SEGMENT)
            columns = mistaken_columns(self.model, self.chart, self.pieces, law, [self.unchanged])
            if columns is not None:
                return explained_by(columns)
            tried = each
        near = self.near(self.without_twins(tried), stage, point)
        fitted = self.all_fitted(near, stage, FOLLOWED)
        if not base.explains and not any(one.explains for one in fitted):
            fitted = self.all_fitted(near, stage, AGAIN_FOLLOWED) or fitted
        fitted = self.again(fitted, tried)
        return self.said(self.again_unchanged(base, fitted), fitted, each)

    def near(self, tried: Sequence[Unknown], stage: float, base: Point) -> list[tuple[Unknown, list[Point]]]:
        """Changes with where they begin, first those that come nearest in the stage that the model does not explain."""
        stages = self.motions.stages
        ahead = stages[min(stages.index(stage) + 1, len(stages) - 1)]
        start = self.motions.at(None, base.w, base.starts, ahead)
        J = self.motions.slopes(None, start, ahead)
        found = [(one, self.motions.near(one, ahead, base, J)) for one in tried]
        return sorted(found, key=lambda pair: pair[1][0].cost)

    def all_fitted(self, near: Sequence[tuple[Unknown, list[Point]]], stage: float, most: int) -> list[Fitted]:
        """Each change from a stage on, from the `most` values at which it is nearest there."""
        fitted: list[Fitted] = []
        bars, best = dict[float, float](), np.inf
        for i, (one, points) in enumerate(near):
            if self.is_late:
                break
            widths = None if i >= LOOKED_AT else WIDTHS[: int(most > FOLLOWED)]
            found = self.motions.fitted(one, stage, points[:most], bars, widths)
            if found is not None:
                fitted.append(found)
            if found is not None and found.explains and self.bic(found) < best:
                best, bars = self.bic(found), self.motions.costs(one, found.point, TOLD_APART)
        return fitted

    @staticmethod
    def without_twins(tried: Sequence[Unknown]) -> list[Unknown]:
        """Of friction one body's, where only two touch, as Drake makes one number of both: `again` adds the other's."""
        frictions = [one for one in tried if one.quantity == "friction"]
        return [one for one in tried if len(frictions) != 2 or one is not frictions[1]]

    def again(self, fitted: Sequence[Fitted], tried: Sequence[Unknown]) -> list[Fitted]:
        """With those that are like the best one, of the other body that touches, from its motion: it is theirs too."""
        best = min((one for one in fitted if one.explains), key=self.bic, default=None)
        if best is None:
            return list(fitted)
        found = {one.name: one for one in fitted}
        for one in tried:
            before = found.get(one.name)
            alike = one.quantity in OF_CONTACT and best.name.endswith(f".{one.quantity}")
            if self.is_late or not alike or (before is not None and before.explains):
                continue
            points = [self.motions.at(one, np.array([w]), best.point.starts, 1.0) for w in (best.point.w[0], *AGAIN)]
            point = self.motions.followed(one, min(points, key=lambda point: point.cost), 1.0)
            if self.motions.size(point) < HOPELESS:
                found[one.name] = self.motions.told(one, point)
        return list(found.values())

    def again_unchanged(self, base: Fitted, fitted: Sequence[Fitted]) -> Fitted:
        """The model as it is, from the motion of the change that explains best: its own search may have ended short."""
        best = min((one for one in fitted if one.explains), key=self.bic, default=None)
        if best is None:
            return base
        point = self.motions.followed(None, self.motions.at(None, np.zeros(0), best.point.starts, 1.0), 1.0)
        return min(base, self.motions.told(None, point), key=lambda one: one.score)

    def unchanged(self, pieces: Sequence[Piece]) -> tuple[float, bool]:
        """How well the model as it is goes through other pieces."""
        base, _, _ = WholeMotions(self.model, self.chart, pieces, self.motions.stated).base()
        return base.score, base.explains

    def falls(self, each: Sequence[Unknown], stage: float, base: Point) -> dict[str, float]:
        """By how much changes may lower the squares up to a stage, in units of what is left, by their slopes."""
        start = self.motions.at(None, base.w, base.starts, stage)
        Q = np.linalg.qr(self.motions.slopes(None, start, stage))[0]
        left = start.r - Q @ (Q.T @ start.r)
        noise, found = left @ left / len(left), {}
        for one in each:
            point = self.motions.at(one, np.zeros(len(one.start)), base.starts, stage)
            J = self.motions.by_change(one, point, stage)
            own = J - Q @ (Q.T @ J)
            found[one.name] = float(np.linalg.lstsq(own, left, rcond=1e-6)[0] @ (own.T @ left) / noise)
        return found

    def limit(self, freedom: int, tried: int) -> float:
        """By how much a score must fall, where so many changes are tried."""
        return max(float(stats.chi2.isf(FALSE_NAME / tried, freedom)), freedom * float(np.log(self.count)))

    @property
    def is_late(self) -> bool:
        self.ended_early = self.ended_early or time.process_time() - self.begun > LONGEST_SEARCH
        return self.ended_early

    def changes(self) -> list[Unknown]:
        """Everything that is tried: what touches first, then what moves."""
        known = {p.name: p.value for p in list_parameters(self.model)}
        names = [n for q in OF_CONTACT for n in known if n.endswith(f".{q}") and "/" not in n and np.all(known[n] > 0)]
        names += [f"{height}.{BIAS}" for height in _heights(self.model, self.chart)]
        names += [n for q in OF_MOTION for n in known if n.endswith(f".{q}")]
        found: list[Unknown] = []
        for name in names:
            try:
                found += choose_unknowns(self.model, None, [name]).each
            except DrakeDiffError:  # a body without mass
                continue
        moved = self.moved_by_weight()
        return [one for one in found if one.quantity not in (MASS, CENTER) or one.label in moved]

    def moved_by_weight(self) -> set[str]:
        """Bodies that are not fixed to the world."""
        plant = self.model.plant
        fixed = {body.index() for body in plant.GetBodiesWeldedTo(plant.world_body())}
        return {label for label, body in labelled(bodies(plant)).items() if body.index() not in fixed}

    @property
    def count(self) -> int:
        return int(sum(np.isfinite(piece.ys).sum() for piece in self.pieces))

    def bic(self, one: Fitted) -> float:
        return one.score + one.freedom * float(np.log(self.count))

    def said(self, base: Fitted, fitted: Sequence[Fitted], tried: Sequence[Unknown]) -> Explanation:
        own = {one.name: one for one in tried}
        # Through impacts the model's own search may end short of a motion that one with next to no change finds.
        none = {one.name: one for one in fitted if one.explains and is_nothing(own[one.name], one)}
        unchanged = min([base, *none.values()], key=lambda one: (not one.explains, one.score))
        evidence = {one.name: unchanged.score - one.score for one in fitted}
        end = f" The search was ended after {LONGEST_SEARCH:.3g} s of processor time." if self.ended_early else ""
        named = [
            one
            for one in sorted(fitted, key=self.bic)
            if one.explains and one.name not in none and evidence[one.name] > self.limit(one.freedom, len(tried))
        ]
        named = [one for one in named if self.bic(one) - self.bic(named[0]) < SAME]
        if not named and unchanged.explains:
            return Explanation((), {}, {}, (), True, f"Nothing: the model explains it.{end}", evidence)
        if not named:
            near = min(fitted, key=self.bic, default=base)
            what = f"with {near.name}, {near.doubt}" if near.name and near.doubt else "none comes near it"
            return Explanation((), {}, {}, (), False, f"{NO_CHANGE}; {what}.{end}", evidence)
        named = [self.motions.widened(own[one.name], one) for one in named]
        texts = [self.words(own[one.name], one) for one in named]
        tail = ": this explains the recording" if len(named) == 1 else ": the recording cannot tell"
        steps = f"by the model's own steps of {1e3 * self.model.time_step:.4g} ms"
        return Explanation(
            names=(named[0].name,),
            values={one.name: float(one.value[0]) if len(one.value) == 1 else frozen(one.value) for one in named},
            intervals={one.name: frozen(one.interval[0] if len(one.value) == 1 else one.interval) for one in named},
            alternatives=tuple((one.name,) for one in named[1:]),
            explained=True,
            sentence=f"{', or '.join(texts)}{tail}, {steps}.{end}",
            evidence=evidence,
        )

    @staticmethod
    def words(own: Unknown, one: Fitted) -> str:
        unit = "m" if own.quantity == BIAS else own.unit
        return changed_to(own.name, one.value, one.interval, own.start, unit)


def is_nothing(own: Unknown, one: Fitted) -> bool:
    """Whether a change is too small to tell from none: within its interval, or next to nothing of its own scale."""
    within = bool(np.all((one.interval[:, 0] <= own.start) & (own.start <= one.interval[:, 1])))
    known = bool(np.all(np.isfinite(one.half)))
    return (known and within) or (own.size > 0 and bool(np.all(np.abs(one.point.w) < NEXT_TO_NOTHING)))


def _heights(model: Model, chart: Chart) -> list[str]:
    """Positions along which nearly all weight acts: where the ground is moves their zero."""
    set_state(model.double, model.default_state)
    pulls = np.abs(model.plant.CalcGravityGeneralizedForces(model.double.context))
    each = [*chart.coordinates.single, *((i + 6, j + 5) for i, j in chart.coordinates.free)]
    most = float(np.max(pulls, initial=0.0))
    return [model.position_names[i] for i, j in each if most > 0 and pulls[j] > 0.9 * most]
