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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, combinations
from pathlib import Path

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.values import Refusal
from drake_diff.comparison.recordings import Recording
from drake_diff.exceptions import ModelError, SimulationError, UnknownNameError
from drake_diff.identification.candidates import (
    DELAY,
    FALLS,
    LIMIT,
    LONGEST_DELAY,
    LOOKED_AT,
    NO_PROMISE,
    STEPS,
    Promise,
    Race,
    Runner,
    View,
)
from drake_diff.identification.columns import mistaken_in_the_air
from drake_diff.identification.contact import Touching, may_touch
from drake_diff.identification.identify import TOUCH, what_acts
from drake_diff.identification.messages import also_touching
from drake_diff.identification.ranking import Tried
from drake_diff.identification.recordings import Chart, given_noise, read_pieces
from drake_diff.identification.results import Explanation
from drake_diff.identification.tree import Dynamics, tree_for_identification
from drake_diff.identification.unknowns import HELD_DAMPING, HELD_INERTIA, Unknown, Unknowns
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.model import Model

BESIDE, LOOKED_AT_BESIDE = 3, 4  # changes beside which a second one is sought, and how many of these go on
DELAYS_SEEN, NEAR = 4, 0.02  # passes of derivatives beside a delay, and of it how near two of them are at the end
BEHIND = 4.0  # times the least that is promised: of what is beyond, LOOKED_AT_BESIDE enter the race
SHORTEST_DELAY = 1e-4  # [s] beside which another change is looked for
MOST_OF_IT = 0.999  # of the squares that the model leaves: a change that takes them away is told though more is left
TIME_STEP = "time_step"
HELD_BY, CAUGHT = 10.0, 100.0  # times its own inertia; [1/s]: friction that gives way, where its search begins
MOTIONS = ("auto", "continuous")
Searching = Callable[[], list[Tried]]


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
            nothing. "auto" looks at motions in which bodies touch by the model's own steps, and refuses limits.

    Returns:
        `.names`, `.values` with `.intervals` (95 %), `.alternatives` that the recordings cannot tell from it, and a
        `.sentence`. No names with `.explained`: the model is right as far as the recordings can tell. No names without
        it: no change of one or two numbers explains them.

    Raises:
        InputError, UnknownNameError, ShapeError, NonFiniteError: A recording is not one of this model.
        ModelError: The model has no motion in continuous time there: a joint is beyond its limit, or controllers or
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
    chart, pieces = Chart(coordinates_of(model)), read_pieces(model, recordings, 0.0)
    tree = tree_for_identification(model)
    if not isinstance(tree, Refusal):
        columns = mistaken_in_the_air(model, tree, chart, pieces, given_noise(model, chart, noise))
        if columns is not None:
            return columns
    why = str(tree) if isinstance(tree, Refusal) else what_acts(model, chart, pieces) if motion == "auto" else ""
    if why == TOUCH:
        return Touching(model, chart, pieces, given_noise(model, chart, noise)).explanation()
    if why or isinstance(tree, Refusal):
        raise ModelError(f"{model.name}: causes are looked for in motions in continuous time only, and {why}")
    explanation = _Search(model, chart, pieces, given_noise(model, chart, noise), tree=tree).found()
    if explanation.explained or motion != "auto" or not may_touch(model, chart, pieces):
        return explanation
    touched = Touching(model, chart, pieces, given_noise(model, chart, noise)).explanation()
    return touched if touched.explained else also_touching(explanation, touched)


@dataclass(eq=False, kw_only=True)
class _Search(Race):
    """What is tried, one after the other."""

    nearest: Tried | None = None
    alone: Tried | None = None  # the change that left least by itself
    share: float = 0.0  # of the squares, that it takes away

    def found(self) -> Explanation:
        self.prepare()
        explanation, base, alone, runners = self.by_one()
        if explanation is None and not base.explains:
            explanation = self.by_friction_that_gives(runners, base)
        if explanation is None and not base.explains and not self.is_late and self.may_be_steps(runners):
            explanation = self.by_steps(base)
        if explanation is None and not base.explains and not self.is_late:
            explanation = self.by_two(alone, runners, base)
        return explanation or (self.right() if base.explains else self.unexplained(base))

    def by_one(self) -> tuple[Explanation | None, Tried, View, list[Runner]]:
        nothing = self.of(())
        runner = self.running((), nothing, self.cut, self.starts, nothing.z_start, NO_PROMISE)
        before = np.inf
        while runner.step() and self.is_hopeless(runner.left) and runner.left < FALLS * before:
            before = runner.left
        most = 1 if self.is_hopeless(runner.left) else STEPS
        base = self.solved(
            (), nothing, runner.fit.law, self.cut, self.starts if most == 1 else runner.starts, runner.z, most
        )
        alone = self.view(self.cut, self.unknowns.z_start, base.starts if base.explains else self.starts)
        if alone is None:
            raise SimulationError(f"{self.model.name} has no motion near the states that were measured")
        count = len(alone.freedoms)
        chosen = self.chosen(alone, [(i,) for i in range(count)])
        singles, runners = self.tried(alone, chosen, base)
        named = self.enough(base, singles, count)
        self.nearest = min([self.nearest or base, base, *singles], key=self.bic)
        best = min(singles, key=self.bic, default=None)
        if self.step is None and best is not None:
            left = next(runner.left for runner in runners if runner.names == best.names)
            self.alone, self.share = best, 1 - left / alone.most
        return self.named(named) if named else None, base, alone, runners

    def by_friction_that_gives(self, runners: Sequence[Runner], base: Tried) -> Explanation | None:
        """Where dry friction of a joint left least, and not noise: the same, which gives way where it holds."""
        if not runners or self.is_late or self.tree.coupling is not None:
            return None
        runner = runners[0]
        law = self.law(runner.fit.unknowns, self.longest, smooth=False)
        dry = law.dry
        if len(runner.names) > 1 or not dry:
            return None
        (j,) = dry
        label = runner.names[0].rsplit(".", 1)[0]
        mass = Dynamics(self.tree, self.tree.numbers).mass(runner.starts[:1])
        inertia = HELD_BY / float(np.linalg.inv(mass)[0, j, j])
        held = [
            Unknown(f"{label}.{quantity}", unit, np.array([start]), 0.0, start)
            for quantity, unit, start in ((HELD_INERTIA, "", inertia), (HELD_DAMPING, "", CAUGHT * inertia))
        ]
        unknowns = Unknowns((*self.of(runner.names).each, *held), as_in_files=True)
        z = np.concatenate([runner.z, unknowns.z_start[1:]])
        gives = self.running(runner.names, unknowns, self.cut, runner.starts, z, NO_PROMISE)
        try:
            self.improve([gives])
            there = gives.fit.at(gives.z, gives.starts)
            if there is None or self.is_hopeless(there.value):
                return None
            if there.value + len(held) * float(np.log(self.count)) > runner.left:
                return None
            candidate = self.solved(runner.names, unknowns, gives.fit.law, self.cut, gives.starts, gives.z)
        except (SimulationError, np.linalg.LinAlgError):  # its motion grows beyond what numbers hold
            return None
        self.nearest = min([self.nearest or base, candidate], key=self.bic)
        named = self.enough(base, [candidate], len(self.unknowns.each))
        if not named:
            return None
        more, slower = (float(candidate.values[unknown.name]) for unknown in held)
        mappings = (
            {name: candidate.values[name] for name in runner.names},
            {name: candidate.intervals[name] for name in runner.names},
        )
        explanation = self.named([candidate._replace(values=mappings[0], intervals=mappings[1])])
        way = f"as if by {more:.3g} more of inertia and {slower:.3g} of damping"
        return self.ended_with(explanation, f"with friction that gives way where it holds, {way}")

    def by_two(self, alone: View, runners: Sequence[Runner], base: Tried) -> Explanation | None:
        count = len(alone.freedoms)
        pairs = self.paired(alone, runners, base)
        named = self.enough(base, pairs, count * (count - 1) // 2)
        if named:
            named = self.enough(base, [*self.halves(named), *named], count * (count - 1) // 2)
            named = [
                candidate for candidate in named if not any(set(other.names) < set(candidate.names) for other in named)
            ]
        self.nearest = min([self.nearest or base, *pairs], key=self.bic)
        return self.named(named) if named else None

    def halves(self, pairs: Sequence[Tried]) -> list[Tried]:
        """Each change of some pairs alone, from where the pair was: the other one may do nothing."""
        halves: dict[str, Tried] = {}
        for pair in pairs:
            unknowns = self.of([name for name in pair.names if not name.endswith(f".{LIMIT}")])
            for unknown, s in self.each_of(unknowns) if len(unknowns.each) == 2 else []:
                if unknown.name not in halves:
                    alone, z, cut = self.of([unknown.name]), pair.z[s], self.cut
                    runner = self.running((unknown.name,), alone, cut, pair.starts, z, NO_PROMISE)
                    if not runner.step() or self.is_hopeless(runner.left):
                        continue
                    law = runner.fit.law
                    halves[unknown.name] = self.solved((unknown.name,), alone, law, cut, pair.starts, z)
        return list(halves.values())

    def may_be_steps(self, runners: Sequence[Runner]) -> bool:
        """Whether Euler steps leave clearly less than continuous time, or less and little, with one change or none."""
        whole = [runner for runner in runners if not runner.special and runner.fit.unknowns.delay is None]
        whole = [runner for runner in whole if np.isfinite(runner.left)][:BESIDE]
        nothing = self.of(())
        cases: list[tuple[tuple[str, ...], Unknowns, Array, Array]] = [((), nothing, nothing.z_start, self.starts)]
        cases += [(runner.names, runner.fit.unknowns, runner.z, runner.starts) for runner in whole]
        for names, unknowns, z, starts in cases:
            before = self.left_by(None, names, unknowns, z, starts)
            after = min((self.left_by(step, names, unknowns, z, starts) for step in self.steps), default=np.inf)
            if after < FALLS * before or (after < before and not self.is_hopeless(after)):
                return True
        return False

    def left_by(self, step: float | None, names: tuple[str, ...], unknowns: Unknowns, z: Array, starts: Array) -> float:
        """What a step of Gauss and Newton leaves of the squares by Euler steps of this length."""
        self.step = step
        runner = self.running(names, unknowns, self.cut, starts, z, NO_PROMISE)
        left = runner.left if runner.step() else np.inf
        self.step = None
        return left

    def by_steps(self, base: Tried) -> Explanation | None:
        """By Euler steps of a length, with one other change or none."""
        nothing, left = self.of(()), dict[float, float]()
        promise = Promise((), 0.0, 0.0, np.zeros(0))
        for step in self.steps:
            self.step = step
            runner = self.running((), nothing, self.cut, self.starts, nothing.z_start, promise)
            seen = self.view(self.cut, self.unknowns.z_start, runner.starts) if runner.step() else None
            if seen is not None:
                promises = seen.promises([(i,) for i in range(len(seen.freedoms))], float(np.log(self.count)))
                left[step] = promises[0].left if promises else seen.most
        self.step = min(left, key=left.__getitem__, default=None)
        if self.step is None:
            return None
        name, is_model_step = f"model.{TIME_STEP}", abs(self.step / self.model.time_step - 1) < 1e-6
        try:
            explanation, stepped, _, _ = self.by_one()
        finally:
            step, self.step = self.step, None
        if explanation is None and not (
            stepped.explains and base.score - stepped.score > self.least(1.0, len(self.steps))
        ):
            return None
        steps = f"semi-implicit Euler steps of {1e3 * step:.4g} ms"
        if is_model_step:
            steps += ", as the model makes them"
        more = () if is_model_step else (name,)
        if explanation is None:
            sentence = f"{'Nothing: the model' if is_model_step else name} explains it, by {steps}."
            if not is_model_step:
                sentence = f"{name} is {step:.4g} s, not {self.model.time_step:.4g}: {steps} explain the recording."
            values = {} if is_model_step else {name: step}
            within = {} if is_model_step else {name: frozen([step, step])}
            return Explanation(more, values, within, (), True, sentence, self.evidence)
        return replace(
            self.ended_with(explanation, f"by {steps}"),
            names=(*explanation.names, *more),
            values={**explanation.values, **({} if is_model_step else {name: step})},
            intervals={**explanation.intervals, **({} if is_model_step else {name: frozen([step, step])})},
            alternatives=tuple((*names, *more) for names in explanation.alternatives),
        )

    def paired(self, alone: View, runners: Sequence[Runner], base: Tried) -> list[Tried]:
        """Pairs beside the change that left least, where that is little; those that promise most; and beside others."""
        later: list[Searching] = []  # searches for a limit or a delay, which take longest
        beside: list[Searching] = [partial(self.beside, runner, base, later) for runner in runners[:BESIDE]]
        first = 1 if runners and not self.is_hopeless(runners[0].left) else 0
        both: list[Searching] = [partial(self.at_the_model, alone, base), partial(self.beside_a_delay, base)]
        candidates: list[Tried] = []
        for search in chain(beside[:first], both, beside[first:], later):
            candidates += search()
            if any(candidate.explains for candidate in candidates) or self.is_late:
                break
        return candidates

    def at_the_model(self, alone: View, base: Tried) -> list[Tried]:
        names = [unknown.name for unknown in self.unknowns.each]
        moving = [i for i, name in enumerate(names) if not self.is_of_inputs(self.plain(name))]
        return self.tried(alone, self.chosen(alone, combinations(moving, 2)), base)[0]

    def beside(self, runner: Runner, base: Tried, later: list[Searching]) -> list[Tried]:
        """Beside one change; searches for a limit or a delay are put off till later."""
        if runner.fit.unknowns.delay is not None:
            return []
        if runner.special:
            later.append(partial(self.beside_inputs, runner, base))
            return []
        i = [unknown.name for unknown in self.unknowns.each].index(runner.names[0])
        seen = self.view(self.cut, self.with_one(i, runner.z), runner.starts)
        if seen is None:
            return []
        others = [(i, k) for k in range(len(seen.freedoms)) if k != i]
        chosen = self.chosen(seen, others, LOOKED_AT_BESIDE)
        plain = {names: promise for names, promise in chosen.items() if not any(map(self.is_of_inputs, names))}
        rest = {names: promise for names, promise in chosen.items() if names not in plain}
        later.append(lambda: self.tried(seen, rest, base)[0])
        return self.tried(seen, plain, base)[0]

    def beside_a_delay(self, base: Tried) -> list[Tried]:
        """A change beside a delay: what each promises together with some more delay, from several delays."""
        unknowns = self.unknowns.each
        last = next((i for i, unknown in enumerate(unknowns) if unknown.quantity == DELAY), None)
        if last is None:
            return []
        price = float(np.log(self.count))
        others = [(i, last) for i, unknown in enumerate(unknowns) if not self.is_of_inputs(self.plain(unknown.name))]
        best: dict[int, tuple[float, View, Promise]] = {}
        name, least = unknowns[last].name, np.inf
        delay = float(self.delayed((name,), self.of([name]), NO_PROMISE).z[0])
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
        groups = [[i for i in order if (len(unknowns[i].start) == 1) == small][:LOOKED_AT] for small in (True, False)]
        chosen = [
            i
            for group in groups
            for k, i in enumerate(group)
            if k < LOOKED_AT_BESIDE or best[i][0] < BEHIND * best[group[0]][0]
        ]
        names = {i: (unknowns[i].name, unknowns[last].name) for i in chosen}
        return self.raced([self.runner(*best[i][1:], names[i]) for i in chosen], base)[0]

    def beside_inputs(self, runner: Runner, base: Tried) -> list[Tried]:
        """A change beside a limit that is about what it is alone."""
        ((special, value),) = runner.special.items()
        pieces = runner.fit.segments.pieces
        seen = self.view(pieces, self.unknowns.z_start, runner.starts)
        if seen is None:
            return []
        names = [unknown.name for unknown in self.unknowns.each]
        others = [(i,) for i, name in enumerate(names) if not self.is_of_inputs(self.plain(name))]
        runners: list[Runner] = []
        for promise in seen.promises(others, float(np.log(self.count)))[:LOOKED_AT_BESIDE]:
            if runners and self.is_late:
                break
            name = names[promise.members[0]]
            runners.append(self.searched(special, (name, special), self.of([name]), promise, value))
        return self.raced(runners, base)[0]

    def of_model(self, name: str) -> tuple[Array, str]:
        label, quantity = name.rsplit(".", 1)
        if quantity == LIMIT:
            return self.tree.limits[[self.model.input_names.index(label)]], ""
        unknown = next(unknown for unknown in self.unknowns.each if unknown.name == name)
        return unknown.start, unknown.unit

    def unexplained(self, base: Tried) -> Explanation:
        nearest = self.nearest or base
        if self.alone is not None and self.share > MOST_OF_IT:
            candidate, share = self.alone, 100 * (1 - float(f"{1 - self.share:.1g}"))
            most = " and ".join(self.changed(candidate, name) for name in candidate.names)
            tail = f"{candidate.doubt}, and no second change that was tried explains that"
            sentence = f"Not explained, but {share:.10g} % of the squares: {most}; {tail}.{self.end}"
            return Explanation((), {}, {}, (), False, sentence, self.evidence)
        near = f"with {' and '.join(nearest.names)}" if nearest.names else "as the model is"
        tried = "no change that was tried" if self.ended_early else "no change of one or two quantities"
        sentence = f"Not explained: {tried} explains the recording;"
        sentence = f"{sentence} {near}, {nearest.doubt}.{self.end}"
        return Explanation((), {}, {}, (), False, sentence, self.evidence)

    def ended_with(self, explanation: Explanation, words: str) -> Explanation:
        """With these words at the end of its sentence."""
        before = explanation.sentence.removesuffix(self.end).removesuffix(".")
        return replace(explanation, sentence=f"{before}, {words}.{self.end}")
