"""Comparison of one model in several engines: a motion, its steps, their derivatives, and the causes of differences.

Drake with the model's settings is the reference. Every step of another engine is compared with the reference's step
from the same state, so that a gap shows where it arises and does not accumulate.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, frozen, number_of_steps
from drake_diff._base.values import Refusal
from drake_diff.comparison import attribution
from drake_diff.comparison.attribution import EngineMotion, JacobianAt, measured, move, rollout_jacobian, seconds
from drake_diff.comparison.recordings import Recording, check_recording, steps_between
from drake_diff.comparison.result import STEP_TOLERANCE, Compared, Comparison, StateProbe, first_above
from drake_diff.engines.contract import MUST_HAVE, Match, contact_lines, match_contracts
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.equations import ClosedForm
from drake_diff.engines.interface import Engine
from drake_diff.engines.load import ELSEWHERE, ENGINES, load_spec
from drake_diff.exceptions import InputError, MissingDependencyError, ModelError, SimulationError
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.model import Model
from drake_diff.model.tangent import sample_states, tangent_space
from drake_diff.motion.rollout import check_inputs
from drake_diff.runs.other_records import RefusedEvidence

DURATION, MOST_STEPS = 1.0, 500  # [s] and number of steps of a default motion


def compare(
    model: Model,
    engines: Sequence[str | Engine] | None = None,
    *,
    recordings: Sequence[Recording] = (),
    x0: ArrayLike | None = None,
    us: ArrayLike | None = None,
    num_steps: int | None = None,
    seed: int = 0,
) -> Comparison:
    """Run the same model in several engines and report where and why they differ from Drake.

    Every engine runs one motion. Each of its steps is compared with Drake's step from the same state. Its Jacobians are
    compared with Drake's and with finite differences of its own steps.

    Args:
        model: the model; Drake with its settings is the reference.
        engines: names for `load_engine`, "drake:similar" or "drake:lagged:implicit" for Drake with other settings,
            `Engine` objects, or your own equations as an `engines.ClosedForm`. Default: every engine that supports all
            of the model's contacts, and Drake's other contact approximations if contact is possible.
        recordings: motions from `read_recording`. Each recorded step is compared with the steps of Drake between its
            samples; a recording has no Jacobians.
        x0: start (nx,). Default: that of the first recording, or else a random state without contact.
        us: inputs (N, nu). Default: those of the first recording if it also gives the start, or else one second of
            constant random inputs.
        num_steps: the number of steps N of a motion without `us`.
        seed: seed of random states and inputs.

    Returns:
        A `Comparison`: per engine a verdict, the gaps of steps and Jacobians, and the term that causes them. Engines
        that are not installed or do not support the model are listed in `refused`.

    Raises:
        InputError: an argument does not fit the model.
        ModelError: no engine but Drake supports this model.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> found = dd.compare(model, ["numpy"], num_steps=5)
        >>> print(found.engines[1].verdict, found.holds)
        same True
    """
    for recording in recordings:
        check_recording(recording, model)
    if recordings and x0 is None:
        x0, recorded_us = _motion_of(recordings[0], model)
        us = recorded_us if us is None else us
    sample = sample_states(model, 1, seed)[0]
    if us is None:
        count = (num_steps and number_of_steps(num_steps)) or min(MOST_STEPS, max(1, round(DURATION / model.time_step)))
        us = np.tile(sample.u, (count, 1))
    start = sample.x if x0 is None else model.finite_state("x0", x0)
    inputs = check_inputs(model, us, num_steps)
    reference = DrakeEngine(model)
    loaded: list[Engine] = []
    refused: list[RefusedEvidence] = []
    for wanted in default_engines(model) if engines is None else engines:
        try:
            engine = load_spec(wanted, model) if isinstance(wanted, str) else _checked_engine(wanted, reference)
            if engines is None:
                _check_contact(reference, engine)
            loaded.append(engine)
        except (MissingDependencyError, ModelError) as error:
            installed = isinstance(error, ModelError)
            refused.append(RefusedEvidence(engine=str(wanted), reason=str(error), installed=installed))
    panel = _Panel(model, reference, start, inputs)
    panel.look(seed)
    results, stuck = panel.all([reference, *loaded, *recordings])
    compared = tuple(result for _, result in results)
    return Comparison(model, start, inputs, tuple(panel.probes), compared, (*refused, *stuck), tuple(recordings))


def compare_recordings(model: Model, recordings: Sequence[Recording]) -> Comparison:
    """Compare recordings alone, with the start of the first recording, as `compare` does.

    No Jacobians are computed, so `states` is empty. `engines` and `recordings` are the comparable ones, in order.
    """
    for recording in recordings:
        check_recording(recording, model)
    start, us = _motion_of(recordings[0], model)
    inputs = check_inputs(model, us, None)
    results, stuck = _Panel(model, DrakeEngine(model), start, inputs).all(recordings)
    compared, accepted = tuple(result for _, result in results), tuple(recording for recording, _ in results)
    return Comparison(model, start, inputs, (), compared, tuple(stuck), accepted)


def _motion_of(recording: Recording, model: Model) -> tuple[Array, Array]:
    """Return a recording's first state (nx,), and its inputs (N, nu) at each step of the model."""
    return recording.xs[0], np.repeat(recording.us, steps_between(recording, model.time_step), axis=0)


def default_engines(model: Model) -> tuple[str, ...]:
    """Return Drake's other contact approximations if contact is possible, all other engines, and names in ELSEWHERE."""
    contact = model.contract.contact
    others = [a for a in ("sap", "similar", "lagged") if contact.collision_pairs and a != contact.approximation]
    return (*(f"drake:{a}" for a in others), *(name for name in ENGINES if name != "drake"), *ELSEWHERE)


def _checked_engine(engine: Engine, reference: DrakeEngine) -> Engine:
    """Return the engine. Raises InputError for a closed form with other coordinates than the reference's."""
    if isinstance(engine, ClosedForm):
        ours, theirs = reference.contract, engine.contract
        for what in ("joints", "inputs"):
            a, b = ([getattr(x, "name", x) for x in getattr(contract, what)] for contract in (ours, theirs))
            if a != b:
                raise InputError(f"{engine.name}: {what}", got=", ".join(b), expected=f"this model's, {', '.join(a)}")
    return engine


def _check_contact(reference: Engine, engine: Engine) -> None:
    """Raise ModelError for an engine that was not named by the user and lacks contact, or contact of some pairs."""
    lines = contact_lines(Match(reference, engine))
    lacking = [line for line in lines if line.quantity in MUST_HAVE and line.verdict == "different" and line.reason]
    if lacking:
        raise ModelError(
            f"it does not have the model's contacts ({lacking[0].reason}); name the engine to compare it anyway"
        )


class _Panel:
    """The test of each engine: at the motion's start, its deepest penetration, a sampled free and a contact state."""

    def __init__(self, model: Model, reference: DrakeEngine, x0: Array, us: Array):
        self.space, self.names, self.model = tangent_space(model), model.input_names, model
        self.reference, self.x0, self.us = reference, x0, us
        self.coordinates = coordinates_of(model)
        self.motion = move(reference, x0, us)

    def look(self, seed: int) -> None:
        """Choose the states at which Jacobians are compared, and compute the reference's Jacobians."""
        motion = self.motion
        self.probes = [StateProbe("start", motion.xs[0], motion.us[0])]
        self.probes += [StateProbe(s.kind, s.x, s.u) for s in sample_states(self.model, 2, seed + 1)]
        if motion.depth is not None and np.max(motion.depth[:-1], initial=0.0) > 0:
            k = int(np.argmax(motion.depth[:-1]))
            self.probes.append(StateProbe("deepest", motion.xs[k], motion.us[k]))
        self.jacobians = self._jacobians(self.reference)
        self.product = rollout_jacobian(self.reference, self.space, motion)

    def all(self, sources: Sequence[Engine | Recording]) -> tuple[list[tuple[Any, Compared]], list[RefusedEvidence]]:
        """Return each source with its comparison, and the refusals of those that cannot take a step."""
        results, stuck = list[tuple[Any, Compared]](), list[RefusedEvidence]()
        for source in sources:
            try:
                result = self.recorded(source) if isinstance(source, Recording) else self.compared(source)
                results.append((source, result))
            except SimulationError as error:
                reason = f"it cannot take a step from one of the states: {error}"
                stuck.append(RefusedEvidence(engine=source.name, reason=reason, installed=True))
        return results, stuck

    def compared(self, engine: Engine) -> Compared:
        is_reference = engine is self.reference
        motion = self.motion if is_reference else move(engine, self.x0, self.us)
        jacobians = self.jacobians if is_reference else self._jacobians(engine)
        product = self.product if is_reference else rollout_jacobian(engine, self.space, motion)
        gaps, precision = self._step_gaps(motion), engine.contract.precision
        has = None if isinstance(product, Refusal) else product
        rollout_gap = None  # if one of the two has no derivative, or ended before the other
        if has is not None and not isinstance(self.product, Refusal) and len(motion.us) == len(self.motion.us):
            rollout_gap = _gap(self.product, has)
        laws = []
        for x, u in ((probe.x, probe.u) for probe in self.probes):
            steps = self.reference.step(x, u), engine.step(x, u)
            law = attribution.what_is_left(self.coordinates, self.reference, engine, x, steps)
            laws.append("" if law == attribution.UNEXPLAINED else law)
        both = zip(self.jacobians, jacobians, strict=True)
        return Compared(
            engine=engine.name, version=engine.version, precision=precision,
            lines=match_contracts(self.reference, engine), motion=motion, step_gaps=gaps,
            first=self._attribution(engine, motion, first_above(gaps, precision) or 0),
            largest=self._attribution(engine, motion, int(np.argmax(gaps)) if len(gaps) else 0),
            final_gap=self._final_gap(motion.xs), jacobians=jacobians, laws=tuple(laws),
            jacobian_gaps=frozen([_gap(a.jacobian, b.jacobian) for a, b in both]), rollout_jacobian=has,
            rollout_gap=rollout_gap, seconds_per_step=seconds(lambda: engine.step(self.x0, self.us[0])),
            seconds_per_jacobian=seconds(lambda: engine.differentiate_step(self.x0, self.us[0])),
            function=engine.function if isinstance(engine, ClosedForm) else None,
        )  # fmt: skip

    def recorded(self, recording: Recording) -> Compared:
        motion = measured(self.reference, recording.times - recording.times[0], recording.xs, recording.us)
        count, precision = steps_between(recording, self.model.time_step), attribution.precision_of(recording)
        gaps = self._step_gaps(motion, count)
        xs, us, tolerance = motion.xs, motion.us, STEP_TOLERANCE[precision]
        first, largest = (
            attribution.attribute_recorded(self.reference, xs[k], us[k], count, xs[k + 1], tolerance)
            for k in (first_above(gaps, precision) or 0, int(np.argmax(gaps)))
        )
        return Compared(
            engine=recording.name, version=recording.version, precision=precision, motion=motion, step_gaps=gaps,
            lines=attribution.told_lines(recording, self.reference), first=first, largest=largest,
            final_gap=self._final_gap(motion.xs, count),
        )  # fmt: skip

    def _final_gap(self, xs: Array, count: int = 1) -> float:
        """Return the gap of the last state common with the reference, on the tangent space; `count` steps per state."""
        ours = self.motion.xs[::count]
        k = min(len(xs), len(ours)) - 1
        return float(np.abs(self.space.minus(xs[k], ours[k])).max())

    def _jacobians(self, engine: Engine) -> tuple[JacobianAt, ...]:
        return tuple(attribution.jacobian_at(engine, self.space, self.names, *probe) for probe in self.probes)

    def _step_gaps(self, motion: EngineMotion, count: int = 1) -> Array:
        """Return the gap of each step, relative to max(1, state after it); states are `count` steps apart."""
        gaps = []
        for x, u, after in zip(motion.xs, motion.us, motion.xs[1:], strict=False):
            ours = attribution.advanced(self.reference, x, u, count)
            gaps.append(np.abs(self.space.minus(after, ours)).max() / max(1.0, np.abs(ours).max()))
        return frozen(gaps)

    def _attribution(self, engine: Engine, motion: EngineMotion, k: int) -> attribution.Attribution:
        x, u, reference = motion.xs[k], self.us[k], self.reference
        return attribution.attribute(
            self.coordinates, reference, engine, x, u, (reference.step(x, u), engine.step(x, u))
        )


def _gap(reference: Array, other: Array) -> float:
    """Return the largest difference of entries, relative to the reference's largest entry."""
    return float(np.abs(other - reference).max() / np.abs(reference).max())
