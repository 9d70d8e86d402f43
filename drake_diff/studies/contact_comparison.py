"""The textbook contact cases in every engine: values and gradients beside the rigid answer and the engine's own law."""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.jupyter import ShowsItsRepr
from drake_diff._base.refusal import Refusal
from drake_diff.comparison.result import Refused
from drake_diff.comparison.side_by_side import default_engines
from drake_diff.engines.closed_form import NumpyEngine, SphereOnGround
from drake_diff.engines.interface import Engine
from drake_diff.engines.load import load_spec
from drake_diff.engines.motion import EngineMotion, move, rollout_jacobian
from drake_diff.exceptions import MissingDependencyError, ModelError, UnknownNameError
from drake_diff.model.model import Model
from drake_diff.model.tangent import tangent_space
from drake_diff.studies.contact_cases import QUANTITIES, ContactCase, Kind, contact_cases
from drake_diff.studies.contact_laws import Answer, law_of

Verdict = Literal["rigid answer", "own law's", "off", "falls through", "broke off"]
GradientVerdict = Literal["right", "own law's", "zero", "wrong", "none", "not asked"]
Spec = str | Callable[[Model], Engine]


class Tolerance(NamedTuple):
    """Of a value and of a gradient, relative, and why."""

    value: float
    gradient: float
    reason: str


TOLERANCES: Mapping[Kind, Tolerance] = {
    "rest": Tolerance(1e-5, 1e-6, "solvers that stop at a relative 1e-6 settle to some 5e-7"),
    "stop": Tolerance(1e-5, 1e-3, "below 1e-3 m/s regularized friction adds 1e-6 m, and 2e-4 of the gradient"),
    "slide": Tolerance(1e-6, 1e-6, "solvers that stop at a relative 1e-6 leave some 1e-8"),
    "hold": Tolerance(2e-6, 1e-3, "a solver that stops at a relative 1e-6, where speed and slope are as small"),
    "roll": Tolerance(1e-5, 1e-5, "rolling slips by 5e-6 m/s where friction is regularized below 1e-4 m/s"),
    "bounce": Tolerance(5e-3, 0.1, "h sqrt(k / m) is 0.02: 12 times its square is left, 5 times it of a gradient"),
    "damped bounce": Tolerance(1e-2, 0.1, "when in a step it touches is chance: 0.2 h sqrt(k / m) of the speed"),
}
ZERO = 1e-9  # absolute tolerance where the answer is 0
NO_GRADIENT = 1e-6  # of the rigid gradient: less is none
SINGLE, SINGLE_ZERO = 1e-3, 1e-5  # instead, for engines in float32
FREE_FALL = 1e-3  # of the fall: nothing has held a ball that ends nearer to free fall
NOT_TO_TRUST = ("wrong", "zero")


def contact_table(engines: Sequence[Spec] | None = None, cases: Sequence[ContactCase] | None = None) -> "ContactTable":
    """Run textbook contact cases in several engines, and judge values and gradients.

    A ball rests, stops, slides, sticks, rolls and bounces. Each number is compared with the rigid answer and with what
    the engine's own contact law gives by formula, so that a gap is either explained or a fault.

    Args:
        engines: Names ("drake", "drake:lagged", "mujoco") or functions that make an engine of a Model. By default
            Drake's three contact approximations and every engine that is installed.
        cases: All of `contact_cases()` by default.

    Returns:
        A row for each case and engine, in SI units. Engines that are not installed, or cannot take the model of a
        case, are in `refused`, with the reason.

    Raises:
        UnknownNameError: For a name that no engine has.

    Example:
        >>> from drake_diff.studies.contact_cases import ContactCase
        >>> stop = ContactCase("stop", time_step=0.01, num_steps=40, speed=1.0)
        >>> row = dd.studies.contact_table(["drake"], [stop]).rows[0]
        >>> round(row.rigid, 4), round(row.value, 4), row.verdict  # [m]
        (0.097, 0.0967, "own law's")
    """
    rows, refused = [], {}
    for case in contact_cases() if cases is None else cases:
        model = case.model()
        for spec in ("drake", *default_engines(model)) if engines is None else engines:
            try:
                rows.append(_row(case, model, spec))
            except (MissingDependencyError, ModelError) as error:
                name = spec if isinstance(spec, str) else getattr(spec, "__name__", "engine")
                there = isinstance(error, ModelError)
                refused[name, str(error)] = Refused(name, f"{case.kind}: {error}" if there else str(error), there)
    return ContactTable(tuple(rows), tuple(refused.values()))


@dataclass(frozen=True, repr=False)
class ContactRow:
    """One engine in one case; numbers in SI units, None where there is none."""

    case: Kind
    engine: str
    quantity: str
    unit: str
    value: float
    rigid: float
    law: float | None
    tolerance: float
    verdict: Verdict
    why: str
    derivative: str
    gradient: float | None
    rigid_gradient: float
    law_gradient: float | None
    gradient_tolerance: float
    gradient_verdict: GradientVerdict
    gradient_why: str

    @property
    def rigid_gap(self) -> float:
        """The gap to the rigid answer: relative, or absolute where that is 0."""
        return gap(self.value, self.rigid)

    @property
    def law_gap(self) -> float | None:
        """The gap to what the engine's own law gives."""
        return None if self.law is None else gap(self.value, self.law)

    def __repr__(self) -> str:
        gradient = "none" if self.gradient is None else f"{self.gradient:.4g}, {self.gradient_verdict}"
        value = f"{self.quantity} {self.value:.4g} {self.unit}, {self.verdict}"
        return f"ContactRow({self.case} in {self.engine}: {value}; {self.derivative} {gradient})"


@dataclass(frozen=True, repr=False)
class ContactTable(ShowsItsRepr):
    """All rows, case by case, and the engines that have none, with the reason."""

    rows: tuple[ContactRow, ...]
    refused: tuple[Refused, ...]

    @property
    def engines(self) -> tuple[str, ...]:
        """The engines that have rows."""
        return tuple(dict.fromkeys(row.engine for row in self.rows))

    def row(self, case: str, engine: str) -> ContactRow:
        """The row of that case and engine; UnknownNameError where there is none."""
        rows = {(str(row.case), row.engine): row for row in self.rows}
        if (case, engine) not in rows:
            known = [f"{a} of {b}" for a, b in rows]
            raise UnknownNameError("row of the contact table", got=f"{case} of {engine}", known=known)
        return rows[case, engine]

    @property
    def off(self) -> tuple[ContactRow, ...]:
        """Rows whose value is neither the rigid answer nor what the engine's own law is known to give."""
        return tuple(row for row in self.rows if row.verdict in ("off", "broke off"))

    def __repr__(self) -> str:
        lines = [f"  {engine}: {lines_of(self, engine)[0]}" for engine in self.engines]
        refused = ", ".join(dict.fromkeys(r.engine for r in self.refused))
        lines += [f"  refused at least one case: {refused}"] if refused else []
        return "\n".join([f"ContactTable({len(self.rows)} rows, {len(self.off)} off)", *lines])


def lines_of(table: ContactTable, engine: str) -> tuple[str, ...]:
    """Which values and gradients of `engine` are the rigid answer, which its own law's, which neither, and why."""
    rows = [row for row in table.rows if row.engine == engine]
    values = _grouped({row.case: row.verdict for row in rows})
    gradients = _grouped({row.case: row.gradient_verdict for row in rows})
    reasons = [f"{row.case}: {row.why}" for row in rows if row.verdict in ("own law's", "off")]
    reasons += [row.why for row in rows if row.verdict in ("falls through", "broke off")][:1]
    reasons += [f"gradient of {row.case}: {row.gradient_why}" for row in rows if row.gradient_verdict in NOT_TO_TRUST]
    reasons += [f"no gradient: {row.gradient_why}" for row in rows if row.gradient_verdict == "none"][:1]
    return (f"values: {values}; gradients: {gradients}", *reasons)


def _grouped(verdicts: Mapping[Kind, str]) -> str:
    cases = {found: [case for case in verdicts if verdicts[case] == found] for found in verdicts.values()}
    return ", ".join(f"{verdict} ({', '.join(found)})" for verdict, found in cases.items())


def as_json(table: ContactTable) -> str:
    """Every field of every row, and the engines that have none."""
    return json.dumps(asdict(table), indent=1, allow_nan=False)


def gap(a: float, b: float) -> float:
    """The gap from `a` to `b`: relative, or absolute where `b` is 0."""
    return abs(a - b) / (abs(b) or 1.0)


def rebound_height(case: ContactCase, xs: Array) -> float:
    """[m] of a bounce `xs` (n, 2) in the case's steps; 0 where it does not leave the ground.

    Semi-implicit Euler keeps z + v^2 / (2 g) - h v / 2 in free flight: that is the apex, at any step of it.
    """
    up = np.flatnonzero((xs[:, 0] > case.radius) & (xs[:, 1] > 0))
    if not len(up):
        return 0.0
    z, v = xs[up[0]]
    return float(z - case.radius + v**2 / (2 * case.gravity) - case.time_step * v / 2)


class _Run:
    """One engine's run of one case; `row` is what `contact_laws.Ran` asks for."""

    def __init__(self, case: ContactCase, model: Model, engine: Engine):
        self.case, self.engine, self.space = case, engine, tangent_space(model)
        self.motion = move(engine, case.x0, np.zeros((case.num_steps, 0)))
        self.xs = self.motion.xs
        self.complete = len(self.motion.us) == case.num_steps
        self.no_gradient = ""  # why, where it has none
        self._products: dict[int, Array | None] = {}
        single = engine.contract.precision != "float64"
        found = TOLERANCES[case.kind]
        least = SINGLE if single else 0.0
        self.tolerance = found._replace(value=max(found.value, least), gradient=max(found.gradient, least))
        self.zero = SINGLE_ZERO if single else ZERO

    def row(self, name: str, n: int) -> Array | None:
        m = self.motion
        if n not in self._products:
            cut = EngineMotion(m.times[: n + 1], m.xs[: n + 1], m.us[:n], None, None, m.status)
            product = rollout_jacobian(self.engine, self.space, cut)
            if isinstance(product, Refusal):
                self.no_gradient = product.reason
            self._products[n] = None if isinstance(product, Refusal) else product
        found = self._products[n]
        return None if found is None else np.asarray(found[self._place(name)])

    @property
    def gradient(self) -> float | None:
        end = {"stop": "x", "hold": "x", "slide": "vx", "roll": "vx"}.get(self.case.kind, "z")
        row = self.row(end, len(self.motion.us))
        return None if row is None else float(row[self._place("z" if end == "z" else "vx")])

    def _place(self, name: str) -> int:
        """On the tangent space, where a turn has three coordinates and not four."""
        return self.case.place(name) - (0 if self.case.axes else 1)

    def end(self, name: str) -> float:
        return float(self.xs[-1][self.case.place(name)])

    @property
    def falls(self) -> bool:
        start = float(self.case.x0[self.case.place("z")])
        return abs(self.end("z") - self.case.free_fall) <= FREE_FALL * (start - self.case.free_fall)

    @property
    def value(self) -> float:
        kind = self.case.kind
        if kind == "rest":
            return self.case.radius - self.end("z")
        return rebound_height(self.case, self.xs) if "bounce" in kind else self.end("x" if kind == "stop" else "vx")

    def near(self, a: float, b: float, tolerance: float) -> bool:
        return gap(a, b) <= (tolerance if b else self.zero)


def _row(case: ContactCase, model: Model, spec: Spec) -> ContactRow:
    run = _Run(case, model, _load(case, model, spec))
    value, at_step = run.value, ""
    law = None
    if run.complete and not run.falls:
        law = law_of(run.engine.contract.contact_law, case)
        if "bounce" in case.kind:  # the height as h -> 0, from h and h / 2: its error is of the first order
            half = replace(case, time_step=case.time_step / 2, num_steps=2 * case.num_steps)
            finer = _load(half, model.at_time_step(half.time_step), spec)
            at_step = f"at h = {case.time_step:g} s it is {value:.4g} m"
            value = 2 * rebound_height(half, move(finer, half.x0, np.zeros((half.num_steps, 0))).xs) - value
    answer = law.answer(run) if law else None
    verdict, why = _judge(run, value, answer)
    asked = verdict not in ("falls through", "broke off")
    gradient = run.gradient if asked else None
    gradient_verdict, gradient_why = _judge_gradient(run, gradient, answer) if asked else ("not asked", why)
    quantity, unit, derivative = QUANTITIES[case.kind]
    return ContactRow(
        case=case.kind,
        engine=run.engine.name,
        quantity=quantity,
        unit=unit,
        value=value,
        rigid=case.rigid,
        law=answer.value if answer else None,
        tolerance=run.tolerance.value,
        verdict=verdict,
        why="; ".join(said for said in (why, at_step) if said),
        derivative=derivative,
        gradient=gradient,
        rigid_gradient=case.rigid_gradient,
        law_gradient=answer.gradient if answer else None,
        gradient_tolerance=run.tolerance.gradient,
        gradient_verdict=gradient_verdict,
        gradient_why=gradient_why,
    )


def _load(case: ContactCase, model: Model, spec: Spec) -> Engine:
    if callable(spec):
        return spec(model)
    if spec != "numpy":
        return load_spec(spec, model)
    if case.axes != ("z",):
        raise ModelError("the hand calculation knows a ball on a vertical rail only")
    same = {name: getattr(case, name) for name in ("mass", "radius", "stiffness", "relaxation_time", "gravity")}
    return NumpyEngine(SphereOnGround(**same), time_step=model.time_step)


def _judge(run: _Run, value: float, answer: Answer | None) -> tuple[Verdict, str]:
    case, allowed = run.case, run.tolerance.value
    if not run.complete:
        return "broke off", run.motion.status
    if run.falls:
        return "falls through", f"no contact: it falls freely to z = {run.end('z'):.3g} m"
    if run.near(value, case.rigid, allowed):
        return "rigid answer", answer.why if answer else ""
    unit = QUANTITIES[case.kind][1]
    apart = f"{_apart(value, case.rigid, unit)} from the rigid answer"
    if answer is None:
        return "off", f"{apart}; its own law: {run.engine.contract.contact_law}"
    if run.near(value, answer.value, allowed):
        return "own law's", f"{apart}: {answer.why}"
    return "off", f"{apart}, and {_apart(value, answer.value, unit)} from what its own law gives"


def _apart(value: float, reference: float, unit: str) -> str:
    return f"{value:+.2g} {unit}" if reference == 0 else f"{100 * (value / reference - 1):+.3g} %"


def _judge_gradient(run: _Run, gradient: float | None, answer: Answer | None) -> tuple[GradientVerdict, str]:
    case, allowed, told = run.case, run.tolerance.gradient, ""
    if gradient is None:
        return "none", run.no_gradient
    if run.near(gradient, case.rigid_gradient, allowed):
        return "right", ""
    if answer is not None and answer.gradient is not None:
        if run.near(gradient, answer.gradient, allowed):
            return "own law's", answer.why_gradient
        told = f"; its own law gives {answer.gradient:.4g} ({answer.why_gradient})"
    if abs(gradient) <= NO_GRADIENT * abs(case.rigid_gradient):
        return "zero", f"the rigid one is {case.rigid_gradient:.4g}{told}"
    return "wrong", f"the rigid one is {case.rigid_gradient:.4g}{told}"
