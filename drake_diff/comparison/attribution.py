"""Motions and Jacobians of engines, and attribution of the difference of two steps: inertia, bias, actuation, ...

Jacobians are checked against differences of the engine's own steps: a Jacobian that is not the derivative of its own
step must not be used for gradients, even if it agrees with another engine. To attribute a difference, both steps are
written as Euler steps with the engines' own terms. The effect of a term is the change when it is replaced by the other
engine's. Recordings have no terms: other schemes of the reference are tried. `dd.explain` searches for other causes.
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from statistics import median
from time import perf_counter
from typing import Any, NamedTuple, TypeVar

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff._base.differences import central_differences, one_by_one
from drake_diff._base.values import Refusal
from drake_diff.certificates.certificate import Certificate, certify_displacement
from drake_diff.comparison.recordings import Recording
from drake_diff.engines.contract import NOT_TOLD, SAME_NUMBER, ContractLine, match_contracts
from drake_diff.engines.drake import DrakeEngine
from drake_diff.engines.equations import ClosedForm
from drake_diff.engines.interface import Engine, Precision
from drake_diff.exceptions import GradientError, InputError, NotOfferedError, SimulationError
from drake_diff.mechanics.coordinates import Coordinates, euler_acceleration, exponential_turn
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.tangent import TangentSpace

T = TypeVar("T")
BROKE_OFF = "broke off"


@dataclass(frozen=True)
class ComparisonOptions:
    """Options for timing, differences and attribution."""

    timed: int = 15  # timed calls whose median is reported, after a first call that may compile
    longest: float = 1.0  # [s] total time after which fewer calls are timed
    # Derivatives by finite differences are accurate to 1e-8 of the row's largest entry, and the certificate allows a
    # hundred times the given solver tolerance.
    differences_leave: float = 1e-10
    single: float = 1e-2  # relative to the largest entry: accuracy of differences in single precision
    window: float = 2.0  # number of steps that Drake's limits look ahead, at the joint's speed
    pushed: float = 1e-3  # relative to the largest generalized force: solver residuals (1e-6) and rounding are below
    closes: float = 0.01  # fraction of the gap that may remain after a change that explains it


COMPARE = ComparisonOptions()

# Difference steps for engines without derivatives, chosen so that rounding and truncation errors are both small.
DIFFERENCE_STEP: dict[Precision, float] = {"float64": 1e-5, "float32": 1e-2}
AGREES = "agree"
NO_DERIVATIVE = (NotOfferedError, GradientError, SimulationError)  # the last: shapes that AutoDiffXd does not support


@dataclass(frozen=True, eq=False, repr=False)
class EngineMotion:
    """The motion of an engine or recording. `status` is "ok", or the first message of its solver, with the time."""

    times: Array  # (n,) [s]
    xs: Array  # (n, nx)
    us: Array  # (n - 1, nu)
    energy: Array | None  # (n,) [J] kinetic and potential; None if the engine does not compute it
    depth: Array | None  # (n,) [m] deepest overlap
    status: str

    def __repr__(self) -> str:
        return f"{len(self.xs)} states over {self.times[-1] - self.times[0]:.6g} s: {self.status}"

    @property
    def energy_change(self) -> float | None:
        """The change [J] from first to last state, including inputs' work and damping; None without energies."""
        return None if self.energy is None else float(self.energy[-1] - self.energy[0])


def move(engine: Engine, x0: Array, us: Array) -> EngineMotion:
    """Simulate from `x0` (nx,) under `us` (N, nu), up to the first step that the engine cannot take."""
    h, xs, status = engine.contract.time_step, [x0], "ok"
    for k, u in enumerate(us):
        try:
            xs.append(engine.step(xs[-1], u))
        except SimulationError as error:
            status = f"{BROKE_OFF} at t = {k * h:.4g} s: {error}"
            break
        if engine.status != "ok" and status == "ok":
            status = f"at t = {k * h:.4g} s: {engine.status}"
    return measured(engine, np.array([k * h for k in range(len(xs))]), np.array(xs), us[: len(xs) - 1], status)


def measured(engine: Engine, times: Array, xs: Array, us: Array, status: str = "ok") -> EngineMotion:
    """Return the motion `xs` (n, nx) with the energies and penetration depths that `engine` computes."""
    energy, depth = ([_offered_by(ask, x) for x in xs] for ask in (engine.energy, engine.contact_depth))
    energies, depths = (None if None in values else frozen(np.array(values)) for values in (energy, depth))
    return EngineMotion(frozen(times), frozen(xs), frozen(us), energies, depths, status)


def _offered_by(ask: Callable[..., T], *arguments: Any) -> T | None:
    try:
        return ask(*arguments)
    except NotOfferedError:
        return None


def seconds(call: Callable[[], Any]) -> float | None:
    """Return the median time of `call` without its first run, which may compile; None if it is not supported."""
    try:
        call()
    except NO_DERIVATIVE:
        return None
    taken: list[float] = []
    while len(taken) < COMPARE.timed and sum(taken) < COMPARE.longest:
        start = perf_counter()
        call()
        taken.append(perf_counter() - start)
    return median(taken)


@dataclass(frozen=True, eq=False)
class JacobianAt:
    """The Jacobian [A B] (2 nv, 2 nv + nu) of one engine's step at one state, on the tangent space.

    `own` tells whether it is the derivative of the engine's own step. It is the certificate's verdict, or in single
    precision "agree" or "undecided". It is None if the Jacobian is by differences.
    """

    state: str  # "start", "free", "contact", "deepest"
    jacobian: Array
    method: str
    own: str | None
    certificate: Certificate | None


def jacobian_at(
    engine: Engine, space: TangentSpace, names: tuple[str, ...], state: str, x: Array, u: Array
) -> JacobianAt:
    """Return the engine's Jacobian at `x` (nx,) and `u` (nu,), with its certificate; `names` (nu,) are of inputs."""
    size, precision = space.size + len(u), engine.contract.precision

    def step(d: Array) -> Array:
        return engine.step(space.plus(x, d[: space.size]), u + d[space.size :])

    def quotients() -> Array:
        return central_differences(step, size, DIFFERENCE_STEP[precision], minus=space.minus)

    try:
        derivatives = engine.differentiate_step(x, u)
    except NO_DERIVATIVE as error:
        why = "" if isinstance(error, NotOfferedError) else f" ({error})"
        method = f"central differences of its steps, {DIFFERENCE_STEP[precision]:g} wide{why}"
        return JacobianAt(state, frozen(quotients()), method, None, None)
    jacobian = space.jacobian(x, engine.step(x, u), derivatives.A, derivatives.B)
    if precision == "float32":
        gap = np.abs(jacobian - quotients()).max() / np.abs(jacobian).max()
        verdict = AGREES if gap <= COMPARE.single else "undecided"
        return JacobianAt(state, frozen(jacobian), derivatives.method, verdict, None)
    # The relative residual that the engine's solver leaves for a step in contact.
    unsolved = (engine.contract.solver_tolerance or 0.0) if engine.contact_depth(x) else 0.0
    by_differences = COMPARE.differences_leave if "differences" in derivatives.method else 0.0
    certificate = certify_displacement(
        one_by_one(step), jacobian, rows=space.names, columns=(*space.names, *names), scale=np.ones(size),
        minus=space.minus, unsolved=unsolved, stopped=max(unsolved, by_differences),
        method=derivatives.method, subject=f"the Jacobian of {engine.name} at the {state} state",
    )  # fmt: skip
    return JacobianAt(state, frozen(jacobian), derivatives.method, certificate.verdict, certificate)


def rollout_jacobian(engine: Engine, space: TangentSpace, motion: EngineMotion) -> Array | Refusal:
    """Return d x_N / d x_0 (size, size) along the engine's motion, or a Refusal if a step has no derivative."""
    product = np.eye(space.size)
    for x, u, x_next in zip(motion.xs, motion.us, motion.xs[1:], strict=False):
        try:
            derivatives = engine.differentiate_step(x, u)
        except NotOfferedError:
            return Refusal("the engine has no derivative of a step in contact")
        except NO_DERIVATIVE as error:
            return Refusal(str(error))
        product = space.jacobian(x, x_next, derivatives.A) @ product
    return frozen(product)


INTEGRATOR, CONTACT_LAW, LIMIT_LAW, UNEXPLAINED = "integrator", "contact law", "limit law", "unexplained"
# Relative tolerance within which a scheme must reproduce an engine's step: for rounding, but not for a force.
FITS: dict[Precision, float] = {"float64": 1e-9, "float32": 1e-4}


class EulerScheme(NamedTuple):
    """A scheme of an Euler step; the defaults are Drake's."""

    damping: str = "implicit"  # or "explicit": with v instead of v'
    position: str = "v'"  # or "v": positions use the velocity before the step
    turn: str = "first term"  # or "exponential": of the rotation h w

    def __str__(self) -> str:
        return f"damping {self.damping}, positions by {self.position}, rotations by the {self.turn}"


SCHEMES = tuple(
    EulerScheme(*choice) for choice in product(("implicit", "explicit"), ("v'", "v"), ("first term", "exponential"))
)


class Terms(NamedTuple):
    """The terms of one engine at one state and input, in Drake's coordinates; their names are those of the effects."""

    inertia: Array  # (nv, nv) M(q)
    bias: Array  # (nv,)
    actuation: Array  # (nv,) B u, with u clipped to the effort limits
    damping: Array  # (nv,)
    time_step: float


@dataclass(frozen=True)
class Attribution:
    """The cause of a difference: `gap` is the largest entry, with unit quaternions; `effects` are largest first.

    `responsible` is the name of the largest effect, or "" if the steps are equal. `assumed` lists the terms that an
    engine does not offer, which are taken from the other. `as_if` is the scheme with which the reference reproduces
    the step of a recording, or "".
    """

    gap: float
    effects: Mapping[str, float]
    responsible: str
    schemes: tuple[EulerScheme, EulerScheme]
    assumed: tuple[str, ...] = ()
    as_if: str = ""


def attribute(
    coordinates: Coordinates, first: Engine, second: Engine, x: Array, u: Array, steps: tuple[Array, Array]
) -> Attribution:
    """Attribute the difference of the `steps` (nx,) of `first` and `second` from `x` (nx,) under `u` (nu,)."""
    q, v, contracts = x[: coordinates.nq], x[coordinates.nq :], (first.contract, second.contract)
    masses, no_mass = _offered((first, second), "M(q)", lambda engine: engine.mass_matrix(q), np.eye(len(v)))
    biases, no_bias = _offered((first, second), "bias(q, v)", lambda engine: engine.bias(q, v), np.zeros(len(v)))
    a, b = (
        Terms(
            M,  # a closed form has no forces, so they are M times its accelerations
            *(engine.terms(M, x, u) if isinstance(engine, ClosedForm) else (bias, facts.effort(u), facts.damping)),
            facts.time_step,
        )
        for M, bias, engine, facts in zip(masses, biases, (first, second), contracts, strict=True)
    )
    after_a, after_b = (of_norm_one(coordinates, after, x) for after in steps)
    schemes = []
    for facts, terms, after in zip(contracts, (a, b), (after_a, after_b), strict=True):
        misfits = {scheme: _size(after - euler(coordinates, x, terms, scheme)) for scheme in SCHEMES}
        best = min(misfits, key=lambda scheme: misfits[scheme])
        fits = misfits[best] <= FITS[facts.precision] * max(1.0, _size(after))
        schemes.append(best if fits else SCHEMES[0])  # if none fits, the cause is something else
    scheme_a, scheme_b = schemes
    base = euler(coordinates, x, a, scheme_a)
    effects = {
        name.replace("_", " "): _size(euler(coordinates, x, a._replace(**{name: getattr(b, name)}), scheme_a) - base)
        for name in Terms._fields
    }
    effects[INTEGRATOR] = _size(euler(coordinates, x, a, scheme_b) - base)
    left = (after_b - euler(coordinates, x, b, scheme_b)) - (after_a - base)
    what = what_is_left(coordinates, first, second, x, steps, left)
    effects[what] = max(_size(left), effects.get(what, 0.0))
    ranked = dict(sorted(effects.items(), key=lambda item: -item[1]))
    gap = _size(after_b - after_a)
    return Attribution(gap, ranked, next(iter(ranked)) if gap else "", (scheme_a, scheme_b), (*no_mass, *no_bias))


def euler(coordinates: Coordinates, x: Array, terms: Terms, scheme: EulerScheme) -> Array:
    """Return the state (nx,) after a step from `x` with these terms, with unit quaternions."""
    q, v, h = x[: coordinates.nq], x[coordinates.nq :], terms.time_step
    implicit = terms.damping if scheme.damping == "implicit" else np.zeros(len(v))
    force = terms.actuation - terms.bias - (terms.damping - implicit) * v
    v_next = v + h * euler_acceleration(terms.inertia, implicit, h, v, force)
    moving = v_next if scheme.position == "v'" else v
    q_next = q + h * coordinates.rate(q) @ moving
    if scheme.turn == "exponential":
        for i, j in coordinates.free:
            q_next[i : i + 4] = exponential_turn(q[i : i + 4], h * moving[j : j + 3])
    return of_norm_one(coordinates, np.concatenate([q_next, v_next]), x)


def of_norm_one(coordinates: Coordinates, x: Array, near: Array) -> Array:
    """Return `x` with unit quaternions, with the sign that is closer to the state `near`."""
    x = np.array(x, dtype=float)
    for i, _ in coordinates.free:
        quaternion = x[i : i + 4] / np.linalg.norm(x[i : i + 4])
        x[i : i + 4] = quaternion if quaternion @ near[i : i + 4] >= 0 else -quaternion
    return x


def _offered(
    engines: tuple[Engine, Engine], name: str, ask: Callable[[Engine], Array], otherwise: Array
) -> tuple[list[Array], list[str]]:
    """Return both engines' values and the missing ones; an engine that does not offer a value gets the other's."""
    answers = [_offered_by(ask, engine) for engine in engines]
    known = next((value for value in answers if value is not None), otherwise)
    missing = [f"{name} of {e.name}" for e, value in zip(engines, answers, strict=True) if value is None]
    return [known if value is None else value for value in answers], missing


def what_is_left(
    coordinates: Coordinates,
    first: Engine,
    second: Engine,
    x: Array,
    steps: tuple[Array, Array],
    left: Array | None = None,
) -> str:
    """Return the law (contact, limit, integrator) that explains a difference that no Euler step explains, if any.

    `left` (nx,) is the difference; by default, that of the steps. A joint limit acts on its joint alone, and Drake's
    limit acts up to COMPARE.window steps ahead. Contact acts on all joints that move the bodies in contact.
    """
    after_a, after_b = (of_norm_one(coordinates, after, x) for after in steps)
    push = _push(coordinates, first, x, after_b - after_a if left is None else left, after_a)
    joints = _joints_near_limits(coordinates, (first, second), x, (after_a, after_b))
    joints = joints if push <= joints else set()  # a force acts on joints that are not at a limit
    if _touching((first, second), (x, *steps)) and not (push and joints and len(push) < coordinates.nv):
        return CONTACT_LAW
    if joints and (push or left is None):
        return LIMIT_LAW
    return UNEXPLAINED if first.contract.integrator == second.contract.integrator else INTEGRATOR


def _push(coordinates: Coordinates, engine: Engine, x: Array, left: Array, after: Array) -> set[int]:
    """Return the velocities on which the force of the velocity change `left` acts; none if it is rounding."""
    change = left[coordinates.nq :]
    if _size(change) <= FITS[engine.contract.precision] * max(1.0, _size(after)):
        return set()
    damping = engine.contract.time_step * np.diag(engine.contract.damping)  # implicit in Drake's step
    force = np.abs((engine.mass_matrix(x[: coordinates.nq]) + damping) @ change)
    return {int(j) for j in np.flatnonzero(force > COMPARE.pushed * np.max(force))}


def _touching(engines: tuple[Engine, Engine], states: tuple[Array, ...]) -> bool:
    depths = (_offered_by(engine.contact_depth, x) for engine in engines for x in states)
    return any(depth is not None and depth > 0 for depth in depths)


def _joints_near_limits(
    coordinates: Coordinates, engines: tuple[Engine, Engine], x: Array, after: tuple[Array, Array]
) -> set[int]:
    """Return the velocities of joints that pass a limit, or would within COMPARE.window steps at their top speed."""
    velocities = set()
    for engine in engines:
        joints = [joint for joint in engine.contract.joints if joint.kind != "quaternion_floating"]
        for joint, (i, j) in zip(joints, coordinates.single, strict=True):
            speed = max(abs(float(state[coordinates.nq + j])) for state in (x, *after))
            reach = COMPARE.window * engine.contract.time_step * speed
            if not all(joint.lower <= state[i] - reach and state[i] + reach <= joint.upper for state in (x, *after)):
                velocities.add(j)
    return velocities


def _size(difference: Array) -> float:
    return float(np.abs(difference).max(initial=0.0))


PRECISIONS: dict[str, Precision] = {"float64": "float64", "float32": "float32"}
LAWS_OF_STEPS: Mapping[str, EulerScheme] = {
    "as if joint damping were explicit": EulerScheme(damping="explicit"),
    "as if positions moved with the velocity before the step": EulerScheme(position="v"),
    "as if rotations were by the exponential": EulerScheme(turn="exponential"),
}


def precision_of(recording: Recording) -> Precision:
    """Return the precision in the recording's facts, else float64."""
    precision = recording.facts.get("precision", "float64")
    if precision not in PRECISIONS:
        raise InputError(f"recording {recording.name}: precision", got=precision, expected="float64 or float32")
    return PRECISIONS[precision]


def told_lines(recording: Recording, reference: DrakeEngine) -> tuple[ContractLine, ...]:
    """Return one line per quantity of a contract; a quantity without a fact is "different" because it is unknown."""
    ours, lines = reference.contract, []
    values: dict[str, str | tuple[float, ...]] = {
        "integrator": ours.integrator, "contact law": ours.contact_law, "limit law": ours.limit_law,
        "time step": (ours.time_step,), "gravity": ours.gravity,
    }  # fmt: skip
    quantities = [line.quantity for line in match_contracts(reference, reference)]
    for quantity in (*quantities, "seeds", "reset distribution"):
        fact, value = recording.facts.get(quantity), values.get(quantity)
        if fact is None:
            lines.append(ContractLine(quantity, "different", NOT_TOLD, NOT_TOLD))
        elif value is None:
            lines.append(ContractLine(quantity, "mapped", f"{fact}; here each step starts from the recorded state"))
        else:
            same = fact == value
            if not isinstance(value, str):
                theirs = _numbers(recording, quantity, fact, len(value))
                same = np.allclose(theirs, value, rtol=SAME_NUMBER[precision_of(recording)], atol=0.0)
            detail = fact if same else f"{ours.engine}: {value}; {recording.name}: {fact}"
            lines.append(ContractLine(quantity, "equal" if same else "different", detail))
    return tuple(lines)


def _numbers(recording: Recording, quantity: str, text: str, count: int) -> Array:
    try:
        values = np.atleast_1d(np.array(json.loads(text), dtype=float))
    except (ValueError, TypeError):
        values = np.zeros(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        expected = "a number" if count == 1 else f"a list of {count} numbers"
        raise InputError(f"recording {recording.name}: {quantity}", got=text, expected=expected)
    return values


def advanced(reference: DrakeEngine, x: Array, u: Array, count: int) -> Array:
    """Return the state (nx,) after `count` steps of the reference from `x`."""
    for _ in range(count):
        x = reference.step(x, u)
    return x


def attribute_recorded(
    reference: DrakeEngine, x: Array, u: Array, count: int, after: Array, tolerance: float
) -> Attribution:
    """Attribute the difference of the recorded state `after` (nx,) from that after `count` reference steps."""
    coordinates = coordinates_of(reference.model)
    theirs, ours = (of_norm_one(coordinates, state, x) for state in (after, advanced(reference, x, u, count)))
    gap, schemes = _size(theirs - ours), (SCHEMES[0], SCHEMES[0])
    if gap <= tolerance:
        return Attribution(gap, {}, "", schemes)
    law = what_is_left(coordinates, reference, reference, x, (ours, theirs))
    if law != UNEXPLAINED:
        return Attribution(gap, {law: gap}, law, schemes)
    misfits = {name: _size(theirs - _stepped(reference, x, u, count, scheme)) for name, scheme in LAWS_OF_STEPS.items()}
    best = min(misfits, key=lambda name: misfits[name])
    if not misfits[best] <= COMPARE.closes * gap:
        return Attribution(gap, {UNEXPLAINED: gap}, UNEXPLAINED, schemes)
    effects = {INTEGRATOR: gap, UNEXPLAINED: misfits[best]}
    return Attribution(gap, effects, INTEGRATOR, (SCHEMES[0], LAWS_OF_STEPS[best]), as_if=best)


def _stepped(reference: DrakeEngine, x: Array, u: Array, count: int, scheme: EulerScheme) -> Array:
    """Return the state (nx,) after `count` Euler steps with the reference's terms and another scheme."""
    nq, contract = reference.model.nq, reference.contract
    given = contract.effort(u), contract.damping, contract.time_step
    for _ in range(count):
        q, v = x[:nq], x[nq:]
        terms = Terms(reference.mass_matrix(q), reference.bias(q, v), *given)
        x = euler(coordinates_of(reference.model), x, terms, scheme)
    return x
