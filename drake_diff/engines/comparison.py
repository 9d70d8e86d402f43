"""The same model in every engine: one motion, its steps and their derivatives, side by side, and why they differ.

Drake, as the model is set, is the reference. Every step of another engine is compared with the reference's step from
the same state, so that a gap is where it arises and not what has become of it.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from drake_diff.arrays import Array, finite_array, frozen
from drake_diff.engines.attribution import Attribution, attribute
from drake_diff.engines.contract_match import ContractLine, match_contracts
from drake_diff.engines.description import describe
from drake_diff.engines.drake_engine import DrakeEngine
from drake_diff.engines.engine import Engine, Precision
from drake_diff.engines.jacobians import JacobianAt, jacobian_at, rollout_jacobian
from drake_diff.engines.load import ELSEWHERE, ENGINES, load_spec
from drake_diff.engines.motion import BROKE_OFF, EngineMotion, move, seconds
from drake_diff.exceptions import MissingDependencyError, ModelError, SimulationError
from drake_diff.model import Model
from drake_diff.rollout import check_inputs
from drake_diff.sampling import sample_states
from drake_diff.tangent import tangent_space

Verdict = Literal["same", "other law", "other model", "unexplained"]
DURATION, MOST_STEPS = 1.0, 1000  # [s]; of a motion that is not given
# One step against the reference's, relative to the state where that is above 1: rounding in solves with M.
STEP_TOLERANCE: dict[Precision, float] = {"float64": 1e-10, "float32": 1e-4}
# Relative to the largest entry: what differences of a step, which some engines offer as its derivative, leave.
JACOBIAN_TOLERANCE: dict[Precision, float] = {"float64": 1e-8, "float32": 1e-2}
# The lines of a contract that tell of a term.
TELLS: Mapping[str, tuple[str, ...]] = {
    "inertia": ("mass", "center of mass", "inertia", "frames", "armature", "joint types", "joint order and names"),
    "bias": ("gravity", "springs", "mass", "center of mass", "inertia", "frames", "joint order and names"),
    "actuation": ("actuator mapping", "effort limits"),
    "damping": ("damping", "integrator"),
    "time step": ("time step",),
    "integrator": ("integrator",),
    "contact law": ("contact law", "contact pairs", "solver tolerance"),
    "limit law": ("limit law", "position limits"),
}
# What is the engine's own whatever the model.
LAWS = ("integrator", "limit law", "contact law", "contact pairs", "solver tolerance", "reset")


class Probe(NamedTuple):
    """A state at which Jacobians are compared: "start", "free", "contact" or "deepest"."""

    name: str
    x: Array
    u: Array


@dataclass(frozen=True)
class Refused:
    """An engine that is not compared: not installed, or without something that the model has."""

    engine: str
    reason: str
    installed: bool


@dataclass(frozen=True, eq=False)
class Compared:
    """One engine beside the reference."""

    engine: str
    version: str
    precision: Precision
    lines: tuple[ContractLine, ...]  # of its contract against the reference's
    motion: EngineMotion
    step_gaps: Array  # (n - 1,) of each of its steps to the reference's from the same state
    first: Attribution  # of the first step that is apart, or of the first of all
    largest: Attribution  # of the largest gap
    final_gap: float  # of the last state that both have, on the tangent space
    jacobians: tuple[JacobianAt, ...]
    jacobian_gaps: Array  # one per state, relative to the reference's largest entry
    rollout_jacobian: Array | None
    rollout_gap: float | None  # relative to the reference's largest entry; None where one of the two broke off
    seconds_per_step: float | None
    seconds_per_jacobian: float | None

    @property
    def different(self) -> tuple[ContractLine, ...]:
        """The lines of the contract that are different."""
        return tuple(line for line in self.lines if line.verdict == "different")

    @cached_property
    def first_apart(self) -> int | None:
        """The first step whose gap is above the tolerance."""
        return _first_above(self.step_gaps, self.precision)

    @property
    def broken(self) -> tuple[ContractLine, ...]:
        """The lines that are different without being the engine's doing: it simulates another model."""
        return tuple(line for line in self.different if not line.reason and line.quantity not in LAWS)

    @property
    def told(self) -> tuple[ContractLine, ...]:
        """The lines that tell of the terms responsible; none where one of the terms is told of by no line."""
        terms = {self.first.responsible, self.largest.responsible}
        lines = {term: [x for x in self.different if x.quantity in TELLS.get(term, ())] for term in sorted(terms)}
        return tuple(dict.fromkeys(x for found in lines.values() for x in found)) if all(lines.values()) else ()

    @property
    def verdict(self) -> Verdict:
        """Same: every step and Jacobian is the reference's. Other law: not, and the contract tells of what is at work.

        Other model: the contract is broken. Unexplained: nothing tells why.
        """
        if self.broken:
            return "other model"
        if self.first_apart is not None:
            return "other law" if self.told else "unexplained"
        broke_off = self.motion.status.startswith(BROKE_OFF)
        same = np.all(self.jacobian_gaps <= JACOBIAN_TOLERANCE[self.precision])
        return "unexplained" if broke_off or not same else "same"

    @property
    def is_gradient_its_own(self) -> bool | None:
        """Whether each Jacobian is the derivative of the engine's own step; None where it offers none."""
        verdicts = [j.own.verdict for j in self.jacobians if j.own is not None]
        return all(verdict == "agree" for verdict in verdicts) if verdicts else None


@dataclass(frozen=True, eq=False)
class Comparison:
    """Engines on one model; the first of `engines` is Drake, the reference."""

    model: Model
    x0: Array
    us: Array
    states: tuple[Probe, ...]  # where Jacobians were compared
    engines: tuple[Compared, ...]
    refused: tuple[Refused, ...]

    @property
    def reference(self) -> Compared:
        return self.engines[0]

    @property
    def holds(self) -> bool:
        """Whether every engine is the same, or differs by a law that its contract tells of."""
        return all(e.verdict in ("same", "other law") for e in self.engines)


def slugs(comparison: Comparison) -> list[str]:
    """Names of the engines that can be parts of a topic; the place keeps them apart."""
    return [f"{i}_" + re.sub(r"[^A-Za-z0-9]+", "_", e.engine).strip("_") for i, e in enumerate(comparison.engines)]


def compare(
    model: Model,
    engines: Sequence[str | Engine] | None = None,
    *,
    x0: ArrayLike | None = None,
    us: ArrayLike | None = None,
    num_steps: int | None = None,
    seed: int = 0,
) -> Comparison:
    """Compare `engines` with Drake on `model`: names, "drake:similar" or "drake:lagged:implicit", or engines.

    Without any, Drake's other contact approximations, where something can touch, and every engine there is.

    The motion starts at `x0` (nx,) under `us` (N, nu); a random free state, constant random inputs and one second
    where they are not given, the same for the same `seed`. Engines that are missing or cannot have the model are
    listed in `refused`. Raises InputError for bad input, and ModelError where no engine but Drake can have the model.
    """
    x0, us = _task(model, x0, us, num_steps, seed)
    reference: Engine = DrakeEngine(model)
    loaded, refused = _load(model, default_engines(model) if engines is None else tuple(engines))
    panel = _Panel(model, reference, x0, us, seed)
    compared = []
    for engine in (reference, *loaded):
        try:
            compared.append(panel.compared(engine))
        except SimulationError as error:
            refused.append(Refused(engine.name, f"it cannot take a step at one of the states: {error}", True))
    return Comparison(model, x0, us, panel.probes, tuple(compared), tuple(refused))


class _Panel:
    """What is asked of each engine, and the reference's answers."""

    def __init__(self, model: Model, reference: Engine, x0: Array, us: Array, seed: int):
        self.space, self.names, self.model = tangent_space(model), model.input_names, model
        self.reference, self.x0, self.us = reference, x0, us
        self.coordinates = describe(model).coordinates
        self.motion = move(reference, x0, us)
        self.probes = _probes(model, self.motion, seed)
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
            first=self._attribution(engine, motion, _first_above(gaps, engine.contract.precision) or 0),
            largest=self._attribution(engine, motion, int(np.argmax(gaps)) if len(gaps) else 0),
            final_gap=float(np.abs(self.space.minus(motion.xs[-1], self.motion.xs[len(motion.xs) - 1])).max()),
            jacobians=jacobians,
            jacobian_gaps=frozen(
                [_gap(a.jacobian, b.jacobian) for a, b in zip(self.jacobians, jacobians, strict=True)]
            ),
            rollout_jacobian=product,
            rollout_gap=self._rollout_gap(motion, product),
            seconds_per_step=seconds(lambda: engine.step(self.x0, self.us[0])),
            seconds_per_jacobian=seconds(lambda: engine.differentiate_step(self.x0, self.us[0])),
        )

    def _jacobians(self, engine: Engine) -> tuple[JacobianAt, ...]:
        return tuple(jacobian_at(engine, self.space, self.names, *probe) for probe in self.probes)

    def _rollout_gap(self, motion: EngineMotion, product: Array | None) -> float | None:
        """None where one of the two has no derivative, or broke off before the other."""
        if product is None or self.product is None or len(motion.us) != len(self.motion.us):
            return None
        return _gap(self.product, product)

    def _step_gaps(self, motion: EngineMotion) -> Array:
        """Relative to the state after the step where that is above 1."""
        gaps = []
        for x, u, after in zip(motion.xs, motion.us, motion.xs[1:], strict=False):
            ours = self.reference.step(x, u)
            gaps.append(np.abs(self.space.minus(after, ours)).max() / max(1.0, np.abs(ours).max()))
        return frozen(gaps)

    def _attribution(self, engine: Engine, motion: EngineMotion, k: int) -> Attribution:
        x, u = motion.xs[k], self.us[k]
        return attribute(self.coordinates, self.reference, engine, x, u, (self.reference.step(x, u), engine.step(x, u)))


def _first_above(gaps: Array, precision: Precision) -> int | None:
    above = np.flatnonzero(~(gaps <= STEP_TOLERANCE[precision]))
    return int(above[0]) if len(above) else None


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


def _task(
    model: Model, x0: ArrayLike | None, us: ArrayLike | None, num_steps: int | None, seed: int
) -> tuple[Array, Array]:
    sample = sample_states(model, 1, seed)[0]
    if us is None:
        count = num_steps or min(MOST_STEPS, max(1, round(DURATION / model.time_step)))
        us = np.tile(sample.u, (count, 1))
    return (sample.x if x0 is None else finite_array("x0", x0, (model.nx,))), check_inputs(model, us, num_steps)


def _probes(model: Model, motion: EngineMotion, seed: int) -> tuple[Probe, ...]:
    """The motion's start, a state sampled free and one touching, and the motion's deepest overlap."""
    probes = [Probe("start", motion.xs[0], motion.us[0])]
    probes += [Probe(sample.kind, sample.x, sample.u) for sample in sample_states(model, 2, seed + 1)]
    if motion.depth is not None and np.max(motion.depth[:-1], initial=0.0) > 0:
        k = int(np.argmax(motion.depth[:-1]))
        probes.append(Probe("deepest", motion.xs[k], motion.us[k]))
    return tuple(probes)
