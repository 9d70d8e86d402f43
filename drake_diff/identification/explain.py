"""The search for the smallest change of a model that explains recordings: of one or two parameters, or of the setup.

Each change is tried alone. If none explains the recordings, Euler steps of several lengths are tried, and then pairs.
Pairs are the best by the linearization at the model, and the best single changes with a second change. The second
change is predicted with derivatives at the first one, as a large change alters the prediction of others.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.values import Refusal
from drake_diff.comparison.recordings import Recording
from drake_diff.exceptions import ModelError, SimulationError, UnknownNameError
from drake_diff.identification.candidates import (
    FALLS,
    NO_PROMISE,
    STEPS,
    Candidates,
    Promise,
    Runner,
    Tried,
    View,
)
from drake_diff.identification.columns import mistaken_in_the_air
from drake_diff.identification.contact import ContactExplanation, may_touch
from drake_diff.identification.identify import TOUCH, what_acts
from drake_diff.identification.messages import NO_CHANGE
from drake_diff.identification.recordings import given_noise, read_pieces
from drake_diff.identification.results import Explanation
from drake_diff.identification.tree import tree_for_identification
from drake_diff.identification.unknowns import DELAY, LIMIT, POINT_MASS
from drake_diff.model.model import Model

BESIDE, LOOKED_AT_BESIDE = 3, 4  # number of first changes of pairs, and number of second changes for each
TIME_STEP = "model.time_step"
MOTIONS = ("auto", "continuous")
Search = Callable[[], list[Tried]]


def explain(
    model: Model,
    recordings: Recording | str | Path | Sequence[Recording | str | Path],
    *,
    noise: Mapping[str, float] | None = None,
    motion: str = "auto",
) -> Explanation:
    """Find the smallest change of a model that explains recordings of its motion.

    Mistaken columns are tried first: two exchanged columns, wrong signs, and degrees instead of radians. Then each
    parameter is tried alone: masses, first with and then without their inertias, centres of mass, inertias, dampings,
    springs, rotor inertias, offsets of joints and gravity. Quantities that model files lack are also tried: Coulomb
    friction, the strength and the limit of each input, a delay of all inputs, and biases of sensors. If none explains
    the recordings alone, semi-implicit Euler steps of several lengths are tried, with one change or none, and then
    pairs of changes.

    Args:
        model: The model.
        recordings: As for `dd.identify`.
        noise: The standard deviation of the noise of states, by name. Missing values are estimated.
        motion: "continuous" ignores contact and joint limits in the recordings. "auto" simulates recordings with
            contact by the model's own steps, and refuses recordings in which a joint is beyond its limit.

    Returns:
        `.names`, `.values` with `.intervals` (95 %), `.alternatives` that the recordings cannot distinguish from it,
        and a `.sentence`. If `.names` is empty and `.explained` is true, the model agrees with the recordings. If
        `.explained` is false, no change of one or two quantities explains them.

    Raises:
        InputError, UnknownNameError, ShapeError, NonFiniteError: A recording does not fit the model.
        ModelError: The recorded motion is not one in continuous time: a joint is beyond its limit, or controllers or
            constraints act.

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
    pieces, tree = read_pieces(model, recordings, 0.0), tree_for_identification(model)
    stated = given_noise(model, noise)
    if not isinstance(tree, Refusal):
        columns = mistaken_in_the_air(model, tree, pieces, stated)
        if columns is not None:
            return columns
    why = str(tree) if isinstance(tree, Refusal) else what_acts(model, pieces) if motion == "auto" else ""
    if why == TOUCH:
        return ContactExplanation(model, pieces, stated).explanation()
    if why or isinstance(tree, Refusal):
        raise ModelError(f"{model.name}: causes can be found in motion in continuous time only, and {why}")
    explanation = _Search(model, pieces, stated, tree=tree).explanation()
    if explanation.explained or motion != "auto" or not may_touch(model, pieces):
        return explanation
    touched = ContactExplanation(model, pieces, stated).explanation()
    if touched.explained:
        return touched
    more = f"With contact, no change that was tried explains it either{touched.sentence.removeprefix(NO_CHANGE)}"
    return replace(explanation, sentence=f"{explanation.sentence} {more}")


@dataclass(eq=False, kw_only=True)
class _Search(Candidates):
    """The sequence of searches."""

    nearest: Tried | None = None

    def explanation(self) -> Explanation:
        self.prepare()
        explanation, base, alone, runners = self.by_one()
        if explanation is None and not base.explains and not self.is_late:
            explanation = self.by_steps(base, runners)
        if explanation is None and not base.explains and not self.is_late:
            explanation = self.by_two(alone, runners, base)
        return explanation or (self.nothing() if base.explains else self.without(base))

    def by_one(self, how: str = "") -> tuple[Explanation | None, Tried, View, list[Runner]]:
        """Return (explanation by one change, fit of the unchanged model, its linearization, all candidates)."""
        nothing = self.of(())
        runner = self.running((), nothing, self.starts, nothing.z_start, NO_PROMISE)
        if runner.step():
            self.approach(runner)
        most = 1 if self.is_hopeless(runner.left) else STEPS
        starts = self.starts if most == 1 else runner.starts
        base = self.solved((), nothing, runner.fit.law, starts, runner.z, most)
        alone = self.view(self.cut, self.unknowns.z_start, base.starts if base.explains else self.starts)
        if alone is None:
            raise SimulationError(f"{self.model.name} has no motion near the states that were measured")
        points = {i for i, unknown in enumerate(self.unknowns.each) if unknown.quantity == POINT_MASS}
        count = len(alone.freedoms) - len(points)
        chosen = self.chosen(alone, [(i,) for i in range(len(alone.freedoms)) if i not in points])
        if self.delay is not None:  # at zero delay, the prediction is poor for a delay of several samples
            chosen.setdefault((f"model.{DELAY}",), Promise((self.delay,), alone.most, 1.0, np.zeros(1)))
        singles, runners = self.tried(alone, chosen, base)
        named = self.enough(base, singles, count)
        if not (named or base.explains or self.is_late):  # a mass without its inertia changes the motion as others do
            singles += self.tried(alone, self.chosen(alone, [(i,) for i in points]), base)[0]
            named = self.enough(base, singles, count + len(points))
        self.nearest = min([self.nearest or base, base, *singles], key=self.bic)
        return self.named(named, how) if named else None, base, alone, runners

    @property
    def delay(self) -> int | None:
        """The index of the delay among the changes."""
        return next((i for i in self.of_inputs if self.unknowns.each[i].quantity == DELAY), None)

    def by_steps(self, base: Tried, runners: Sequence[Runner]) -> Explanation | None:
        """Try Euler steps that reduce the residuals clearly or to the noise level, with one other change or none."""
        fitted = [runner for runner in runners if runner.fit.unknowns.delay is None and np.isfinite(runner.left)]
        nothing = self.of(())
        none = self.running((), nothing, self.starts, nothing.z_start, NO_PROMISE)
        left: dict[float, float] = {}
        for case in (none, *fitted[:BESIDE]):
            before = self.left_by(None, case)
            for step in self.euler_steps:
                after = self.left_by(step, case)
                if after < FALLS * before or (after < before and not self.is_hopeless(after)):
                    left[step] = min(after, left.get(step, np.inf))
        if not left:
            return None
        self.step = step = min(left, key=left.__getitem__)
        is_own = abs(step / self.model.time_step - 1) < 1e-6
        how = f"semi-implicit Euler steps of {1e3 * step:.4g} ms{', as the model makes them' if is_own else ''}"
        try:
            explanation, stepped, _, _ = self.by_one(f", by {how}")
        finally:
            self.step = None
        if explanation is None:
            if not (stepped.explains and base.score - stepped.score > self.least(1.0, len(self.euler_steps))):
                return None
            explanation = self.nothing(f", by {how}")
        if is_own:
            return explanation
        if not explanation.names:
            words = f"{TIME_STEP} is {step:.4g} s, not {self.model.time_step:.4g}: {how} explain the recording."
            explanation = replace(explanation, sentence=words)
        return replace(
            explanation,
            names=(*explanation.names, TIME_STEP),
            values={**explanation.values, TIME_STEP: step},
            intervals={**explanation.intervals, TIME_STEP: frozen([step, step])},
            alternatives=tuple((*names, TIME_STEP) for names in explanation.alternatives),
        )

    def left_by(self, step: float | None, case: Runner) -> float:
        """Return the loss after a Gauss-Newton step with Euler steps of this length (None: continuous time)."""
        self.step = step
        runner = self.running(case.names, case.fit.unknowns, case.starts, case.z, NO_PROMISE)
        left = runner.left if runner.step() else np.inf
        self.step = None
        return left

    def by_two(self, alone: View, runners: Sequence[Runner], base: Tried) -> Explanation | None:
        several = sum(unknown.quantity != POINT_MASS for unknown in self.unknowns.each)
        count = several * (several - 1) // 2
        pairs = self.paired(alone, runners, base)
        named = self.enough(base, pairs, count)
        if named:
            named = self.enough(base, [*self.halves(named), *named], count)
            names = [set(candidate.names) for candidate in named]
            named = [candidate for candidate in named if not any(other < set(candidate.names) for other in names)]
        self.nearest = min([self.nearest or base, *pairs], key=self.bic)
        return self.named(named) if named else None

    def halves(self, pairs: Sequence[Tried]) -> list[Tried]:
        """Fit each change of some pairs alone, from the values of the pair, as the other one may be unnecessary."""
        halves: dict[str, Tried] = {}
        for pair in pairs:
            for unknown, s in self.of(pair.names).items():
                if unknown.name in halves:
                    continue
                names = (unknown.name,)
                runner = self.running(names, self.of(names), pair.starts, pair.z[s], NO_PROMISE)
                if runner.step() and not self.is_hopeless(runner.left):
                    law = runner.fit.law
                    halves[unknown.name] = self.solved(names, runner.fit.unknowns, law, pair.starts, pair.z[s])
        return list(halves.values())

    def paired(self, alone: View, runners: Sequence[Runner], base: Tried) -> list[Tried]:
        """Try pairs with the best single change if it fits well, then the best predicted pairs, then all others."""
        delays = [runner for runner in runners if runner.fit.unknowns.delay is not None]
        singles = [runner for runner in runners if runner.fit.unknowns.delay is None][:BESIDE]
        first = 1 if singles and not self.is_hopeless(singles[0].left) else 0
        beside = [partial(self.beside, runner, base) for runner in (*singles[:first], *delays, *singles[first:])]
        candidates: list[Tried] = []
        for search in (*beside[:first], partial(self.at_the_model, alone, base), *beside[first:]):
            candidates += search()
            if any(candidate.explains for candidate in candidates) or self.is_late:
                break
        return candidates

    def at_the_model(self, alone: View, base: Tried) -> list[Tried]:
        kinds = [unknown.quantity for unknown in self.unknowns.each]
        moving = [i for i, kind in enumerate(kinds) if i not in self.of_inputs and kind != POINT_MASS]
        return self.tried(alone, self.chosen(alone, combinations(moving, 2)), base)[0]

    def beside(self, runner: Runner, base: Tried) -> list[Tried]:
        """Try pairs of a given change with every other; a delay is the second one of its pairs."""
        i = [unknown.name for unknown in self.unknowns.each].index(runner.names[0])
        z = self.unknowns.z_start.copy()
        z[self.unknowns.slices[i]] = runner.z
        seen = self.view(self.cut, z, runner.starts)
        if seen is None:
            return []
        without = {i, *self.of_inputs} if i in self.of_inputs else {i}
        others = [k for k, u in enumerate(self.unknowns.each) if k not in without and u.quantity != POINT_MASS]
        pairs = [(k, i) if i == self.delay else (i, k) for k in others]
        return self.tried(seen, self.chosen(seen, pairs, LOOKED_AT_BESIDE), base)[0]

    def of_model(self, name: str) -> tuple[Array, str]:
        label, quantity = name.rsplit(".", 1)
        if quantity == LIMIT:
            return self.tree.numbers.limit[[self.model.input_names.index(label)]], ""
        unknown = next(unknown for unknown in self.unknowns.each if unknown.name == name)
        return unknown.start, unknown.unit

    def without(self, base: Tried) -> Explanation:
        """Return the explanation for recordings that no change explains."""
        nearest = self.nearest or base
        near = f"with {' and '.join(nearest.names)}" if nearest.names else "as the model is"
        tried = "no change that was tried" if self.ended_early else "no change of one or two quantities"
        return self.unexplained(f"Not explained: {tried} explains the recording; {near}, {nearest.doubt}.")
