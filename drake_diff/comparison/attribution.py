"""What each engine does, and which term makes two engines' steps differ: inertia, bias, actuation, damping, a law.

Jacobians are checked against differences of the engine's own steps: one that is not the derivative of its own step
must not be used for gradients, whatever it agrees with. To attribute a difference both steps are written as Euler steps
from the engines' own terms, one term of the other is put in at a time, and what that changes is the term's effect. A
recording has no terms: its steps are tried as the reference's by another scheme; `dd.explain` seeks what else differs.
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
from drake_diff.engines.interface import Engine, EngineContract, Precision
from drake_diff.exceptions import GradientError, InputError, NotOfferedError, SimulationError
from drake_diff.mechanics.coordinates import Coordinates, euler_acceleration, exponential_turn
from drake_diff.mechanics.description import coordinates_of
from drake_diff.model.tangent import TangentSpace

T = TypeVar("T")
BROKE_OFF = "broke off"


@dataclass(frozen=True)
class ComparisonOptions:
    """How engines are timed, differenced and attributed."""

    timed: int = 15  # calls whose median is told, after one that may compile
    longest: float = 1.0  # [s] less are timed where they take so long
    # An engine's derivative that is made of differences is good to 1e-8 of the row's largest entry, and the certificate
    # allows a hundred times what it is told was left unsolved.
    differences_leave: float = 1e-10
    single: float = 1e-2  # of the largest entry: as far as differences of single precision tell
    window: float = 2.0  # steps by which Drake's limits look ahead, at the joint's speed
    pushed: float = 1e-3  # of the largest generalized force: below it are what solvers leave, 1e-6, and rounding
    closes: float = 0.01  # of the gap may be left by a change that explains it


COMPARE = ComparisonOptions()

# Steps of differences for engines without derivatives: where rounding and truncation are both small.
DIFFERENCE_STEP: dict[Precision, float] = {"float64": 1e-5, "float32": 1e-2}
AGREES = "agree"
NO_DERIVATIVE = (NotOfferedError, GradientError, SimulationError)  # the last: shapes that AutoDiffXd refuses


@dataclass(frozen=True, eq=False, repr=False)
class EngineMotion:
    """What one engine, or a recording, did. `status` is "ok", or what its solver said first, and when."""

    times: Array  # (n,) [s]
    xs: Array  # (n, nx)
    us: Array  # (n - 1, nu)
    energy: Array | None  # (n,) [J] kinetic and potential; None where it does not compute it
    depth: Array | None  # (n,) [m] deepest overlap
    status: str

    def __repr__(self) -> str:
        return f"{len(self.xs)} states over {self.times[-1] - self.times[0]:.6g} s: {self.status}"

    @property
    def energy_change(self) -> float | None:
        """[J] from first to last state, inputs' work and damping included; None where there is no energy."""
        return None if self.energy is None else float(self.energy[-1] - self.energy[0])


def move(engine: Engine, x0: Array, us: Array) -> EngineMotion:
    """The motion from `x0` (nx,) under `us` (N, nu), up to the first step that the engine cannot take."""
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
    """The motion `xs` (n, nx) with the energies and overlaps that `engine` finds in it."""

    energy, depth = ([_offered_by(ask, x) for x in xs] for ask in (engine.energy, engine.contact_depth))
    energies, depths = (None if None in values else frozen(np.array(values)) for values in (energy, depth))
    return EngineMotion(frozen(times), frozen(xs), frozen(us), energies, depths, status)


def _offered_by(ask: Callable[..., T], *arguments: Any) -> T | None:
    try:
        return ask(*arguments)
    except NotOfferedError:
        return None


def seconds(call: Callable[[], Any]) -> float | None:
    """The median time of `call`, its first run, which may compile, left out; None where there is none."""
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
    """[A B] (2 nv, 2 nv + nu) of one engine's step at one state, on the tangent space.

    `own` says whether it is the derivative of the engine's own step: the certificate's verdict, in single precision
    "agree" or "undecided"; None where it is made of differences.
    """

    state: str  # "start", "free", "contact", "deepest"
    jacobian: Array
    method: str
    own: str | None
    certificate: Certificate | None


def jacobian_at(
    engine: Engine, space: TangentSpace, names: tuple[str, ...], state: str, x: Array, u: Array
) -> JacobianAt:
    """The engine's Jacobian at `x` (nx,) and `u` (nu,), with the certificate; `names` (nu,) are the inputs'."""
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
        return JacobianAt(
            state, frozen(jacobian), derivatives.method, AGREES if gap <= COMPARE.single else "undecided", None
        )
    # What the engine's solver leaves unsolved of a step in contact, relative.
    unsolved = (engine.contract.solver_tolerance or 0.0) if engine.contact_depth(x) else 0.0
    by_differences = COMPARE.differences_leave if "differences" in derivatives.method else 0.0
    certificate = certify_displacement(
        one_by_one(step), jacobian, rows=space.names, columns=(*space.names, *names), scale=np.ones(size),
        minus=space.minus, unsolved=unsolved, stopped=max(unsolved, by_differences),
        method=derivatives.method, subject=f"the Jacobian of {engine.name} at the {state} state",
    )  # fmt: skip
    return JacobianAt(state, frozen(jacobian), derivatives.method, certificate.verdict, certificate)


def rollout_jacobian(engine: Engine, space: TangentSpace, motion: EngineMotion) -> Array | Refusal:
    """(size, size) d x_N / d x_0 along the engine's own motion; or why one of its steps has no derivative."""
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
# How well a scheme must give a step to be the engine's, relative to the state: rounding, and no force.
FITS: dict[Precision, float] = {"float64": 1e-9, "float32": 1e-4}


class EulerScheme(NamedTuple):
    """How a step is taken from its terms; the first of each is Drake's."""

    damping: str = "implicit"  # explicit: by v, not by v'
    position: str = "v'"  # v: positions move with the velocity before the step
    turn: str = "first term"  # exponential: of the rotation h w

    def __str__(self) -> str:
        return f"damping {self.damping}, positions by {self.position}, rotations by the {self.turn}"


SCHEMES = tuple(
    EulerScheme(*choice) for choice in product(("implicit", "explicit"), ("v'", "v"), ("first term", "exponential"))
)


class Terms(NamedTuple):
    """Of one engine at one state and input, in Drake's coordinates; the names are those of the effects."""

    inertia: Array  # (nv, nv) M(q)
    bias: Array  # (nv,)
    actuation: Array  # (nv,) B u, cut at the effort limits
    damping: Array  # (nv,)
    time_step: float


@dataclass(frozen=True)
class Attribution:
    """`gap`: the largest difference of the two steps, quaternions of norm 1; `effects`: of each term, largest first.

    `responsible` is the name of the largest effect, "" where the steps are the same. `assumed` is what an engine does
    not offer, and is taken to be the other's. `as_if` is the scheme by which the reference takes the step of a
    recording, "" where none does.
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
    """What makes the `steps` (nx,) that `first` and `second` took from `x` (nx,) under `u` (nu,) differ."""
    q, v = x[: coordinates.nq], x[coordinates.nq :]
    masses, no_mass = _offered((first, second), "M(q)", lambda engine: engine.mass_matrix(q), np.eye(len(v)))
    biases, no_bias = _offered((first, second), "bias(q, v)", lambda engine: engine.bias(q, v), np.zeros(len(v)))
    a, b = (
        Terms(
            M,  # of a closed form the forces are what M makes of its accelerations
            *(engine.terms(M, x, u) if isinstance(engine, ClosedForm) else (bias, *forces(engine.contract, u))),
            engine.contract.time_step,
        )
        for M, bias, engine in zip(masses, biases, (first, second), strict=True)
    )
    after_a, after_b = (of_norm_one(coordinates, after, x) for after in steps)
    schemes = []
    for engine, terms, after in ((first, a, after_a), (second, b, after_b)):
        misfits = {scheme: _size(after - euler(coordinates, x, terms, scheme)) for scheme in SCHEMES}
        best = min(misfits, key=lambda scheme: misfits[scheme])
        fits = misfits[best] <= FITS[engine.contract.precision] * max(1.0, _size(after))
        schemes.append(best if fits else SCHEMES[0])  # where none gives the step, something else is at work
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
    """(nx,) the step from `x` with these terms, quaternions of norm 1."""
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
    """`x` with quaternions of norm 1, of q and -q the one that is near that of the state `near`."""
    x = np.array(x, dtype=float)
    for i, _ in coordinates.free:
        quaternion = x[i : i + 4] / np.linalg.norm(x[i : i + 4])
        x[i : i + 4] = quaternion if quaternion @ near[i : i + 4] >= 0 else -quaternion
    return x


def _offered(
    engines: tuple[Engine, Engine], name: str, ask: Callable[[Engine], Array], otherwise: Array
) -> tuple[list[Array], list[str]]:
    """What both say, and who says nothing: an engine that does not offer it gets the other's."""
    answers = [_offered_by(ask, engine) for engine in engines]
    known = next((value for value in answers if value is not None), otherwise)
    missing = [f"{name} of {e.name}" for e, value in zip(engines, answers, strict=True) if value is None]
    return [known if value is None else value for value in answers], missing


def forces(contract: EngineContract, u: Array) -> tuple[Array, Array]:
    """B u and the joints' damping, (nv,) each."""
    limits = np.array(contract.effort_limits)
    actuation = np.array(contract.actuation, dtype=float).reshape(len(contract.actuation), len(u))
    damping = [[0.0] * 6 if joint.kind == "quaternion_floating" else [joint.damping] for joint in contract.joints]
    return actuation @ np.clip(u, -limits, limits), np.array([number for joint in damping for number in joint])


def what_is_left(
    coordinates: Coordinates,
    first: Engine,
    second: Engine,
    x: Array,
    steps: tuple[Array, Array],
    left: Array | None = None,
) -> str:
    """What makes `steps` differ that no Euler step explains: a law that is at work, if any.

    `left` (nx,) is that difference, that of the steps where it is not given. A joint's limit pushes this joint alone,
    and Drake's acts up to WINDOW steps ahead of it; what touches pushes all joints that it moves.
    """
    after_a, after_b = (of_norm_one(coordinates, after, x) for after in steps)
    push = _push(coordinates, first, x, after_b - after_a if left is None else left, after_a)
    joints = _joints_near_limits(coordinates, (first, second), x, (after_a, after_b))
    joints = joints if push <= joints else set()  # something pushes joints that are at no limit
    if _touching((first, second), (x, *steps)) and not (push and joints and len(push) < coordinates.nv):
        return CONTACT_LAW
    if joints and (push or left is None):
        return LIMIT_LAW
    return UNEXPLAINED if first.contract.integrator == second.contract.integrator else INTEGRATOR


def _push(coordinates: Coordinates, engine: Engine, x: Array, left: Array, after: Array) -> set[int]:
    """The velocities on which the force acts that changes the velocity by `left`; none where that is rounding."""
    change = left[coordinates.nq :]
    if _size(change) <= FITS[engine.contract.precision] * max(1.0, _size(after)):
        return set()
    _, damping = forces(engine.contract, np.zeros(len(engine.contract.inputs)))  # implicit in Drake's step
    force = np.abs((engine.mass_matrix(x[: coordinates.nq]) + engine.contract.time_step * np.diag(damping)) @ change)
    return {int(j) for j in np.flatnonzero(force > COMPARE.pushed * np.max(force))}


def _touching(engines: tuple[Engine, Engine], states: tuple[Array, ...]) -> bool:
    depths = (_offered_by(engine.contact_depth, x) for engine in engines for x in states)
    return any(depth is not None and depth > 0 for depth in depths)


def _joints_near_limits(
    coordinates: Coordinates, engines: tuple[Engine, Engine], x: Array, after: tuple[Array, Array]
) -> set[int]:
    """The velocities of the joints that pass a limit, or would within WINDOW steps at the largest of their speeds."""
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
    """As the facts tell, else float64."""
    precision = recording.facts.get("precision", "float64")
    if precision not in PRECISIONS:
        raise InputError(f"recording {recording.name}: precision", got=precision, expected="float64 or float32")
    return PRECISIONS[precision]


def told_lines(recording: Recording, reference: DrakeEngine) -> tuple[ContractLine, ...]:
    """A line per quantity of a match: what no fact tells of is different, for that reason."""
    ours, lines = reference.contract, []
    texts = {"integrator": ours.integrator, "contact law": ours.contact_law, "limit law": ours.limit_law}
    numbers = {"time step": (ours.time_step,), "gravity": ours.gravity}
    quantities = [line.quantity for line in match_contracts(reference, reference)]
    for quantity in (*quantities, "seeds", "reset distribution"):
        fact = recording.facts.get(quantity)
        if fact is None:
            lines.append(ContractLine(quantity, "different", NOT_TOLD, NOT_TOLD))
            continue
        if quantity in texts:
            value: object = texts[quantity]
            same = fact == value
        elif quantity in numbers:
            value = numbers[quantity]
            theirs = _numbers(recording, quantity, fact, len(numbers[quantity]))
            same = np.allclose(theirs, np.array(value), rtol=SAME_NUMBER[precision_of(recording)], atol=0.0)
        else:
            lines.append(ContractLine(quantity, "mapped", f"{fact}; here each step starts from the recorded state"))
            continue
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
    """(nx,) `count` of the reference's steps after `x`."""
    for _ in range(count):
        x = reference.step(x, u)
    return x


def attribute_recorded(
    reference: DrakeEngine, x: Array, u: Array, count: int, after: Array, tolerance: float
) -> Attribution:
    """What makes the recorded state `after` (nx,) differ from that which `count` steps of the reference lead to."""
    coordinates = coordinates_of(reference.model)
    theirs, ours = (of_norm_one(coordinates, state, x) for state in (after, advanced(reference, x, u, count)))
    gap, schemes = float(np.abs(theirs - ours).max()), (SCHEMES[0], SCHEMES[0])
    if gap <= tolerance:
        return Attribution(gap, {}, "", schemes)
    law = what_is_left(coordinates, reference, reference, x, (ours, theirs))
    if law != UNEXPLAINED:
        return Attribution(gap, {law: gap}, law, schemes)
    misfits = {
        name: float(np.abs(theirs - _stepped(reference, x, u, count, scheme)).max())
        for name, scheme in LAWS_OF_STEPS.items()
    }
    best = min(misfits, key=lambda name: misfits[name])
    if not misfits[best] <= COMPARE.closes * gap:
        return Attribution(gap, {UNEXPLAINED: gap}, UNEXPLAINED, schemes)
    effects = {INTEGRATOR: gap, UNEXPLAINED: misfits[best]}
    return Attribution(gap, effects, INTEGRATOR, (SCHEMES[0], LAWS_OF_STEPS[best]), as_if=best)


def _stepped(reference: DrakeEngine, x: Array, u: Array, count: int, scheme: EulerScheme) -> Array:
    """(nx,) where `count` Euler steps of the reference's terms lead by another scheme."""
    nq, contract = reference.model.nq, reference.contract
    actuation, damping = forces(contract, u)
    for _ in range(count):
        q, v = x[:nq], x[nq:]
        terms = Terms(reference.mass_matrix(q), reference.bias(q, v), actuation, damping, contract.time_step)
        x = euler(reference.description.coordinates, x, terms, scheme)
    return x
