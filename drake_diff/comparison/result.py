"""What a comparison found of each engine, what that amounts to, and the same in sentences."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.values import preformatted
from drake_diff.comparison.attribution import AGREES, BROKE_OFF, Attribution, EngineMotion, JacobianAt
from drake_diff.comparison.recordings import Recording
from drake_diff.engines.contract import UNKNOWN, ContractLine, is_another_model
from drake_diff.engines.equations import UserFunction
from drake_diff.engines.interface import Precision
from drake_diff.model.model import Model
from drake_diff.runs.other_records import EngineEvidence

Verdict = Literal["same", "other law", "other model", "unexplained"]
Gradient = Literal["its own step's", "not its own step's", "undecided", "none"]
# One step against the reference's, relative to the state where that is above 1: rounding in solves with M.
STEP_TOLERANCE: dict[Precision, float] = {"float64": 1e-10, "float32": 1e-4}
# Relative to the largest entry: what differences of a step, which some engines offer as its derivative, leave.
JACOBIAN_TOLERANCE: dict[Precision, float] = {"float64": 1e-8, "float32": 1e-2}
PHRASES: Mapping[Verdict, str] = {
    "same": "the same simulation as Drake",
    "other law": "the same model under another law",
    "other model": "another model: its contract is broken",
    "unexplained": "different, and nothing explains why",
}
TRUST: Mapping[Gradient, str] = {
    "its own step's": "to be trusted at the states looked at",
    "not its own step's": "not the derivatives of their own steps",
    "undecided": "undecided",
    "none": "none offered",
}
# What the contact law, whatever its form, is applied to.
OF_CONTACT = (
    "shapes", "poses", "contact pairs", "friction", "stiffness", "dissipation", "contact margin", "other contact terms",
)  # fmt: skip
# By term of a step: the lines of a contract that can explain it.
TELLS: Mapping[str, tuple[str, ...]] = {
    "inertia": ("mass", "center of mass", "inertia", "frames", "armature", "joint types", "joint order and names"),
    "bias": (
        "forces at rest", "velocity products", "gravity", "springs", "mass", "center of mass", "inertia", "frames",
        "joint order and names",
    ),
    "actuation": ("actuator mapping", "effort limits", "forces of the inputs"),
    "damping": ("damping", "damping forces", "integrator"),
    "time step": ("time step",),
    "integrator": ("integrator",),
    "contact law": ("contact law", *OF_CONTACT, "solver tolerance"),
    "limit law": ("limit law", "position limits"),
}  # fmt: skip


class StateProbe(NamedTuple):
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


@dataclass(frozen=True, eq=False, kw_only=True)
class Compared:
    """One engine, or a recording (which has no Jacobians and no times), beside the reference."""

    engine: str
    version: str
    precision: Precision
    lines: tuple[ContractLine, ...]  # of its contract against the reference's
    motion: EngineMotion
    step_gaps: Array  # (n - 1,) of each of its steps to the reference's from the same state
    first: Attribution  # of the first step that is apart, or of the first of all
    largest: Attribution  # of the largest gap
    final_gap: float  # of the last state that both have, on the tangent space
    jacobians: tuple[JacobianAt, ...] = ()
    jacobian_gaps: Array = field(default_factory=lambda: frozen([]))  # per state, of the reference's largest entry
    laws: tuple[str, ...] = ()  # per state, that which is at work there (contact, a limit, the integrator), else ""
    rollout_jacobian: Array | None = None
    rollout_gap: float | None = None  # relative to the reference's largest entry; None where one of the two broke off
    seconds_per_step: float | None = None
    seconds_per_jacobian: float | None = None
    function: UserFunction | None = None  # what is known of a user's own equations

    @property
    def is_recorded(self) -> bool:
        """Whether it is a recording, and no engine."""
        return not self.jacobians and self.seconds_per_step is None

    @property
    def different(self) -> tuple[ContractLine, ...]:
        """The lines of the contract that are different."""
        return tuple(line for line in self.lines if line.verdict == "different")

    @property
    def broken(self) -> tuple[ContractLine, ...]:
        """The lines that make it another model.

        They differ without being the engine's doing, or the engine lacks what contact acts on, and contact is at work.
        """
        at_work = {self.first.responsible, self.largest.responsible, *(self.laws[i] for i in self.other_states)}
        return tuple(line for line in self.different if _breaks(line, "contact law" in at_work))

    @cached_property
    def first_apart(self) -> int | None:
        """The first step whose gap is above the tolerance."""
        return first_above(self.step_gaps, self.precision)

    @property
    def told(self) -> tuple[ContractLine, ...]:
        """The lines that explain the terms responsible; none where one of the terms is explained by no line."""
        lines = [self.tells(term) for term in sorted({self.first.responsible, self.largest.responsible})]
        return tuple(dict.fromkeys(x for group in lines for x in group)) if all(lines) else ()

    def tells(self, term: str) -> tuple[ContractLine, ...]:
        """The lines that are different and explain a term."""
        known = [line for line in self.different if line.reason not in UNKNOWN]
        return tuple(line for line in known if line.quantity in TELLS.get(term, ()))

    @property
    def other_states(self) -> tuple[int, ...]:
        """The states at which its Jacobian is not the reference's."""
        return tuple(int(i) for i in np.flatnonzero(~(self.jacobian_gaps <= JACOBIAN_TOLERANCE[self.precision])))

    @property
    def verdict(self) -> Verdict:
        """How it relates to the reference.

        "same": every step and Jacobian is the reference's. "other model": the contract is broken. "other law": they
        differ, and the contract explains what is at work. "unexplained": nothing explains it. The steps of a recording
        are also explained, as a law or as the model, by a single change of the reference that reproduces them.
        """
        if self.broken:
            return "other model"
        if self.first_apart is not None and self.first.as_if and self.first.as_if == self.largest.as_if:
            return "other law"
        if self.first_apart is not None:
            return "other law" if self.told else "unexplained"
        if self.motion.status.startswith(BROKE_OFF) or not all(self.tells(self.laws[i]) for i in self.other_states):
            return "unexplained"
        return "other law" if self.other_states else "same"

    @property
    def gradient(self) -> Gradient:
        """Whether its Jacobians are the derivatives of its own steps, at all states that were looked at."""
        verdicts = {j.own for j in self.jacobians if j.own is not None}
        if not verdicts:
            return "none"
        if verdicts == {AGREES}:
            return "its own step's"
        return "not its own step's" if verdicts & {"disagree", "discontinuous"} else "undecided"

    @property
    def sentence(self) -> str:
        """What it is beside Drake, where they part, and why."""
        clauses, gap = [PHRASES[self.verdict]], _largest(self.step_gaps)
        if self.first_apart is None:
            clauses.append(f"each of {len(self.step_gaps)} steps within {gap} of Drake's")
        else:
            terms = _list(list(dict.fromkeys((self.first.responsible, self.largest.responsible))))
            start = f"different from t = {self.motion.times[self.first_apart]:.4g} s on"
            clauses.append(f"{start}, by up to {gap} of the state in one step, by its {terms}")
        if self.other_states:
            i = max(self.other_states, key=lambda state: self.jacobian_gaps[state])
            law = f", by the {self.laws[i]}" if self.laws[i] else ""
            off = f"off by {self.jacobian_gaps[i]:.1e} of its largest entry{law}"
            clauses.append(f"its Jacobian at the {self.jacobians[i].state} state is {off}")
        elif self.jacobians:
            clauses.append(f"Jacobians within {_largest(self.jacobian_gaps)} of their largest entry")
        if self.motion.status != "ok":
            clauses.append(self.motion.status)
        return "; ".join([*clauses, *self._reasons()])

    def _reasons(self) -> list[str]:
        if self.verdict == "other model":
            return [f"{line.quantity}: {line.detail}" for line in self.broken]
        if self.verdict == "unexplained":
            return ["no line of its contract explains it"]
        if self.verdict == "same":
            unused = [line.quantity for line in self.different if line.reason not in UNKNOWN]
            return [f"its contract also differs in {_list(unused)}, which played no part here"] if unused else []
        laws = [*self.told, *(line for i in self.other_states for line in self.tells(self.laws[i]))]
        reasons = dict.fromkeys(line.reason or line.detail for line in laws)
        return [*reasons, *([self.first.as_if] if self.first.as_if else [])]

    def __repr__(self) -> str:
        return f"{self.engine}: {self.sentence}"


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """One model in several engines, from `dd.compare`; the first of `engines` is Drake, the reference.

    Attributes:
        model: the model.
        x0: (nx,) where the motion starts.
        us: (N, nu) its inputs.
        states: the states at which Jacobians were compared, with a name each.
        engines: per engine a `verdict` ("same", "other law", "other model", "unexplained"), a `sentence`, `step_gaps`
            (N,), `jacobian_gaps`, and in `first` and `largest` the term that is responsible.
        refused: engines that were not compared, and why.
        recordings: those that were given.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> found = dd.compare(model, ["numpy"], num_steps=3)
        >>> print(found.reference.engine)
        drake (sap, autodiff)
        >>> print(found.engines[1].verdict)
        same
    """

    model: Model
    x0: Array
    us: Array
    states: tuple[StateProbe, ...]
    engines: tuple[Compared, ...]
    refused: tuple[Refused, ...]
    recordings: tuple[Recording, ...] = ()

    @property
    def reference(self) -> Compared:
        """Drake, as the model is set."""
        return self.engines[0]

    @property
    def holds(self) -> bool:
        """Whether there are engines beside Drake, each the same or apart by a law that its contract explains."""
        return len(self.engines) > 1 and all(e.verdict in ("same", "other law") for e in self.engines)

    def __repr__(self) -> str:
        lines = [f"{self.model.name} in {len(self.engines)} engines, {len(self.us)} steps"]
        lines += [f"  {e.engine}: {e.verdict if i else 'the reference'}" for i, e in enumerate(self.engines)]
        return "\n".join([*lines, *(f"  {r.engine}: not compared" for r in self.refused)])

    def _repr_html_(self) -> str:
        return preformatted(f"{self!r}\n{self}")

    def __str__(self) -> str:
        return sentence_of(self.engines)


def sentence_of(engines: Sequence[Compared | EngineEvidence]) -> str:
    """Which engines are the same as the first, which are not, and whose gradients are those of their own steps."""
    others = engines[1:]
    kinds = {phrase: [e.engine for e in others if e.verdict == v] for v, phrase in PHRASES.items()}
    parts = [f"{_list(names)}: {phrase}" for phrase, names in kinds.items() if names]
    trust = {kind: [e.engine for e in engines if e.gradient == kind] for kind in TRUST}
    parts += [f"gradients of {_list(names)}: {TRUST[kind]}" for kind, names in trust.items() if names]
    after_contact = any(
        "contact law" in (e.first.responsible, e.largest.responsible) for e in others if e.verdict != "same"
    )
    note = " After the first contact a state is only as accurate as the contact law: examples/studies/contact_table.py."
    return f"{'; '.join(parts)}.{note if after_contact else ''}"


def _breaks(line: ContractLine, touched: bool) -> bool:
    """Whether a line that is different makes another model, where contact is at work or not."""
    return line.reason not in UNKNOWN and is_another_model(line, touched)


def first_above(gaps: Array, precision: Precision) -> int | None:
    """The first step whose gap is above the tolerance."""
    above = np.flatnonzero(~(gaps <= STEP_TOLERANCE[precision]))
    return int(above[0]) if len(above) else None


def slugs(comparison: Comparison) -> list[str]:
    """Names of the engines that can be parts of a topic; the place keeps them apart."""
    return [slug(i, e.engine) for i, e in enumerate(comparison.engines)]


def slug(i: int, name: str) -> str:
    """Such a name, of engine i."""
    return f"{i}_" + re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")


def _largest(values: Iterable[float]) -> str:
    return f"{max(values, default=0.0):.1e}"


def _list(names: list[str]) -> str:
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)
