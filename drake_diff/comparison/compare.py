"""The same model in every engine: one motion, its steps and their derivatives, side by side, and why they differ.

Drake, as the model is set, is the reference. Every step of another engine is compared with the reference's step from
the same state, so that a gap is where it arises and not what has become of it.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from drake_diff._base.arrays import Array, frozen
from drake_diff.comparison.attribution import CONTACT_LAW, LIMIT_LAW, Attribution, attribute, what_is_left
from drake_diff.comparison.recorded import advanced, attribute_recorded, precision_of, told_lines
from drake_diff.comparison.recordings import Recording, check_recording, steps_between
from drake_diff.comparison.result import (
    STEP_TOLERANCE,
    Compared,
    Comparison,
    Probe,
    Refused,
    first_above,
    probes_of,
    task_of,
)
from drake_diff.engines.contract_match import match_contracts
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.interface import Engine
from drake_diff.engines.jacobians import JacobianAt, jacobian_at, rollout_jacobian
from drake_diff.engines.load import ELSEWHERE, ENGINES, load_spec
from drake_diff.engines.motion import EngineMotion, measured, move, seconds
from drake_diff.exceptions import MissingDependencyError, ModelError, SimulationError
from drake_diff.mechanics.description import describe
from drake_diff.model.model import Model
from drake_diff.model.tangent import tangent_space


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
    """Compare `engines` with Drake on `model`: names, "drake:similar" or "drake:lagged:implicit", or engines.

    Without any, Drake's other contact approximations, where something can touch, and every engine there is.

    The motion starts at `x0` (nx,) under `us` (N, nu); a random free state, constant random inputs and one second
    where they are not given, the same for the same `seed`; those of the first of `recordings` (see `read_recording`)
    where there is one and no `x0`. The steps of a recording are compared with as many of the reference's as lie between
    its samples; it has no Jacobians. Engines that are missing or cannot have the model are
    listed in `refused`. Raises InputError for bad input, and ModelError where no engine but Drake can have the model.
    """
    for recording in recordings:
        check_recording(recording, model)
    x0, us = task_of(model, recordings, x0, us, num_steps, seed)
    reference = DrakeEngine(model)
    loaded, refused = _load(model, default_engines(model) if engines is None else tuple(engines))
    panel = _Panel(model, reference, x0, us, seed)
    compared = []
    each: tuple[Engine | Recording, ...] = (reference, *loaded, *recordings)
    for one in each:
        try:
            compared.append(panel.recorded(one) if isinstance(one, Recording) else panel.compared(one))
        except SimulationError as error:
            refused.append(Refused(one.name, f"it cannot take a step at one of the states: {error}", True))
    return Comparison(model, x0, us, panel.probes, tuple(compared), tuple(refused))


class _Panel:
    """What is asked of each engine, and the reference's answers."""

    def __init__(self, model: Model, reference: DrakeEngine, x0: Array, us: Array, seed: int):
        self.space, self.names, self.model = tangent_space(model), model.input_names, model
        self.reference, self.x0, self.us = reference, x0, us
        self.coordinates = describe(model).coordinates
        self.motion = move(reference, x0, us)
        self.probes = probes_of(model, self.motion, seed)
        self.jacobians = self._jacobians(reference)
        self.product = rollout_jacobian(reference, self.space, self.motion)

    def compared(self, engine: Engine) -> Compared:
        is_reference = engine is self.reference
        motion = self.motion if is_reference else move(engine, self.x0, self.us)
        jacobians = self.jacobians if is_reference else self._jacobians(engine)
        gaps = self._step_gaps(motion)
        product = self.product if is_reference else rollout_jacobian(engine, self.space, motion)
        return Compared(
            engine=engine.name,
            version=engine.version,
            precision=engine.contract.precision,
            lines=match_contracts(self.reference, engine),
            motion=motion,
            step_gaps=gaps,
            first=self._attribution(engine, motion, first_above(gaps, engine.contract.precision) or 0),
            largest=self._attribution(engine, motion, int(np.argmax(gaps)) if len(gaps) else 0),
            final_gap=self._gap_at_the_end(motion.xs),
            jacobians=jacobians,
            laws=tuple(self._law(engine, probe) for probe in self.probes),
            jacobian_gaps=frozen(
                [_gap(a.jacobian, b.jacobian) for a, b in zip(self.jacobians, jacobians, strict=True)]
            ),
            rollout_jacobian=product,
            rollout_gap=self._rollout_gap(motion, product),
            seconds_per_step=seconds(lambda: engine.step(self.x0, self.us[0])),
            seconds_per_jacobian=seconds(lambda: engine.differentiate_step(self.x0, self.us[0])),
        )

    def recorded(self, recording: Recording) -> Compared:
        motion = measured(self.reference, recording.times - recording.times[0], recording.xs, recording.us)
        count, precision = steps_between(recording, self.model.time_step), precision_of(recording)
        gaps = self._step_gaps(motion, count)
        first, largest = (
            attribute_recorded(
                self.reference, motion.xs[k], motion.us[k], count, motion.xs[k + 1], STEP_TOLERANCE[precision]
            )
            for k in (first_above(gaps, precision) or 0, int(np.argmax(gaps)))
        )
        return Compared(
            engine=recording.name,
            version=recording.version,
            precision=precision,
            lines=told_lines(recording, self.reference),
            motion=motion,
            step_gaps=gaps,
            first=first,
            largest=largest,
            final_gap=self._gap_at_the_end(motion.xs, count),
            jacobians=(),
            jacobian_gaps=frozen([]),
            laws=(),
            rollout_jacobian=None,
            rollout_gap=None,
            seconds_per_step=None,
            seconds_per_jacobian=None,
        )

    def _law(self, engine: Engine, probe: Probe) -> str:
        """The law that is at work in a step from there, of either engine."""
        steps = self.reference.step(probe.x, probe.u), engine.step(probe.x, probe.u)
        found = what_is_left(self.coordinates, self.reference, engine, probe.x, steps)
        return found if found in (CONTACT_LAW, LIMIT_LAW) else ""

    def _gap_at_the_end(self, xs: Array, count: int = 1) -> float:
        """On the tangent space, of the last of `xs`, `count` steps apart, that the reference's motion has too."""
        ours = self.motion.xs[::count]
        k = min(len(xs), len(ours)) - 1
        return float(np.abs(self.space.minus(xs[k], ours[k])).max())

    def _jacobians(self, engine: Engine) -> tuple[JacobianAt, ...]:
        return tuple(jacobian_at(engine, self.space, self.names, *probe) for probe in self.probes)

    def _rollout_gap(self, motion: EngineMotion, product: Array | None) -> float | None:
        """None where one of the two has no derivative, or broke off before the other."""
        if product is None or self.product is None or len(motion.us) != len(self.motion.us):
            return None
        return _gap(self.product, product)

    def _step_gaps(self, motion: EngineMotion, count: int = 1) -> Array:
        """Relative to the state after the step where that is above 1; states are `count` steps apart."""
        gaps = []
        for x, u, after in zip(motion.xs, motion.us, motion.xs[1:], strict=False):
            ours = advanced(self.reference, x, u, count)
            gaps.append(np.abs(self.space.minus(after, ours)).max() / max(1.0, np.abs(ours).max()))
        return frozen(gaps)

    def _attribution(self, engine: Engine, motion: EngineMotion, k: int) -> Attribution:
        x, u = motion.xs[k], self.us[k]
        return attribute(self.coordinates, self.reference, engine, x, u, (self.reference.step(x, u), engine.step(x, u)))


def _gap(reference: Array, other: Array) -> float:
    """The largest difference of entries, relative to the reference's largest."""
    return float(np.abs(other - reference).max() / np.abs(reference).max())


def default_engines(model: Model) -> tuple[str, ...]:
    """Drake's other contact approximations, where something can touch, every other engine, and what is none."""
    own = model.contract.contact
    others = [a for a in ("sap", "similar", "lagged") if own.collision_pairs and a != own.approximation]
    return (*(f"drake:{a}" for a in others), *(name for name in ENGINES if name != "drake"), *ELSEWHERE)


def _load(model: Model, wanted: tuple[str | Engine, ...]) -> tuple[list[Engine], list[Refused]]:
    loaded: list[Engine] = []
    refused: list[Refused] = []
    for engine in wanted:
        try:
            loaded.append(load_spec(engine, model) if isinstance(engine, str) else engine)
        except MissingDependencyError as error:
            refused.append(Refused(str(engine), str(error), False))
        except ModelError as error:
            refused.append(Refused(str(engine), str(error), True))
    return loaded, refused
