"""Results of a comparison: the findings for each engine, verdicts, and sentences."""

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
from drake_diff.runs.other_records import EngineEvidence, RefusedEvidence

Verdict = Literal["same", "other law", "other model", "unexplained"]
Gradient = Literal["its own step's", "not its own step's", "undecided", "none"]
# Difference of one step from the reference's, relative to max(1, state): rounding in solves with M.
STEP_TOLERANCE: dict[Precision, float] = {"float64": 1e-10, "float32": 1e-4}
# Relative to the largest entry: accuracy of finite differences, which some engines offer as derivatives.
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
# The contract lines that any contact law depends on.
OF_CONTACT = (
    "shapes", "poses", "contact pairs", "friction", "stiffness", "dissipation", "contact margin", "other contact terms",
)  # fmt: skip
# For each term of a step, the contract lines that can explain a difference in it.
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


@dataclass(frozen=True, eq=False, kw_only=True)
class Compared:
    """The comparison of one engine, or of a recording (without Jacobians and times), with the reference."""

    engine: str
    version: str
    precision: Precision
    lines: tuple[ContractLine, ...]  # of its contract compared with the reference's
    motion: EngineMotion
    step_gaps: Array  # (n - 1,) of each of its steps from the reference's step from the same state
    first: Attribution  # of the first step above the tolerance, or of the first step of all
    largest: Attribution  # of the step with the largest gap
    final_gap: float  # of the last common state, on the tangent space
    jacobians: tuple[JacobianAt, ...] = ()
    jacobian_gaps: Array = field(default_factory=lambda: frozen([]))  # per state, relative to the reference's largest
    laws: tuple[str, ...] = ()  # per state, the law that acts (contact, limit, integrator), or ""
    rollout_jacobian: Array | None = None
    rollout_gap: float | None = None  # relative to the reference's largest entry; None if one of the two ended early
    seconds_per_step: float | None = None
    seconds_per_jacobian: float | None = None
    function: UserFunction | None = None  # the facts of a user's own equations

    @property
    def is_recorded(self) -> bool:
        """Whether it is a recording and not an engine."""
        return not self.jacobians and self.seconds_per_step is None

    @property
    def different(self) -> tuple[ContractLine, ...]:
        """The contract lines that differ."""
        return tuple(line for line in self.lines if line.verdict == "different")

    @property
    def broken(self) -> tuple[ContractLine, ...]:
        """The contract lines that make it another model.

        They differ for no reason of the engine, or the engine lacks a contact quantity and contact occurs.
        """
        at_work = {self.first.responsible, self.largest.responsible, *(self.laws[i] for i in self.other_states)}
        return tuple(line for line in self.different if is_another_model(line, "contact law" in at_work))

    @cached_property
    def first_apart(self) -> int | None:
        """The first step with a gap above the tolerance."""
        return first_above(self.step_gaps, self.precision)

    @property
    def told(self) -> tuple[ContractLine, ...]:
        """The lines that explain the responsible terms; empty if a term has no explanation."""
        lines = [self.tells(term) for term in sorted({self.first.responsible, self.largest.responsible})]
        return tuple(dict.fromkeys(x for group in lines for x in group)) if all(lines) else ()

    def tells(self, term: str) -> tuple[ContractLine, ...]:
        """Return the differing lines that explain a term."""
        known = [line for line in self.different if line.reason not in UNKNOWN]
        return tuple(line for line in known if line.quantity in TELLS.get(term, ()))

    @property
    def other_states(self) -> tuple[int, ...]:
        """The indices of the states at which its Jacobian differs from the reference's."""
        return tuple(int(i) for i in np.flatnonzero(~(self.jacobian_gaps <= JACOBIAN_TOLERANCE[self.precision])))

    @property
    def verdict(self) -> Verdict:
        """The relation to the reference.

        "same": every step and Jacobian agrees with the reference. "other model": the contract is broken. "other law":
        they differ, and the contract explains the difference. "unexplained": nothing explains it. The steps of a
        recording are also explained, as "other law", if another scheme of the reference reproduces them.
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
        """Whether its Jacobians are the derivatives of its own steps, at all tested states."""
        verdicts = {j.own for j in self.jacobians if j.own is not None}
        if not verdicts:
            return "none"
        if verdicts == {AGREES}:
            return "its own step's"
        return "not its own step's" if verdicts & {"disagree", "discontinuous"} else "undecided"

    @property
    def sentence(self) -> str:
        """A sentence on its relation to Drake, and on the place and the cause of the first difference."""
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
    """The comparison of one model in several engines, from `dd.compare`; the first engine is Drake, the reference.

    Attributes:
        model: the model.
        x0: (nx,) the first state of the motion.
        us: (N, nu) the inputs of the motion.
        states: the named states at which Jacobians were compared.
        engines: per engine a `verdict` ("same", "other law", "other model", "unexplained"), a `sentence`, `step_gaps`
            (N,), `jacobian_gaps`, and the responsible terms in `first` and `largest`.
        refused: engines that were not compared, with the reasons.
        recordings: the given recordings.

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
    refused: tuple[RefusedEvidence, ...]
    recordings: tuple[Recording, ...] = ()

    @property
    def reference(self) -> Compared:
        """Drake with the model's settings."""
        return self.engines[0]

    @property
    def holds(self) -> bool:
        """Whether there are engines besides Drake, and all are the same or differ by a law that a contract explains."""
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
    """Return a sentence on which engines agree with the first, and whose gradients are those of their own steps."""
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


def first_above(gaps: Array, precision: Precision) -> int | None:
    """Return the first step with a gap above the tolerance, or None."""
    above = np.flatnonzero(~(gaps <= STEP_TOLERANCE[precision]))
    return int(above[0]) if len(above) else None


def slugs(comparison: Comparison) -> list[str]:
    """Return names of the engines for use in topics; the index makes them unique."""
    return [slug(i, e.engine) for i, e in enumerate(comparison.engines)]


def slug(i: int, name: str) -> str:
    """Return the name of engine i for use in topics."""
    return f"{i}_" + re.sub(r"[^A-Za-z0-9]+", "_", name).strip("_")


def _largest(values: Iterable[float]) -> str:
    return f"{max(values, default=0.0):.1e}"


def _list(names: list[str]) -> str:
    return ", ".join(names[:-1]) + " and " + names[-1] if len(names) > 1 else "".join(names)
