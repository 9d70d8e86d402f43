"""Which term makes two engines' steps differ: inertia, bias, actuation, damping, time step, integrator, contact law.

Where nothing touches every engine here takes some Euler step with its own M, bias, B u and damping. So both steps are
written out from the terms that the engines give, one term of the other engine is put in at a time, and what that
changes of the step is this term's effect. What no Euler step explains is the contact law's, where something touches,
or the limit law's, where a joint is beyond a limit; else it is unexplained, and said to be.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.engines.interface import Engine, EngineContract, Precision
from drake_diff.exceptions import NotOfferedError
from drake_diff.mechanics.coordinates import Coordinates, euler_acceleration, exponential_turn

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
    not offer, and is taken to be the other's. `as_if` is the one change of the reference that takes the step of a
    recording, "" where none does.
    """

    gap: float
    effects: Mapping[str, float]
    responsible: str
    schemes: tuple[EulerScheme, EulerScheme]
    assumed: tuple[str, ...] = ()
    as_if: str = ""


def attribute(
    coordinates: Coordinates, one: Engine, two: Engine, x: Array, u: Array, steps: tuple[Array, Array]
) -> Attribution:
    """What makes the `steps` (nx,) that `one` and `two` took from `x` (nx,) under `u` (nu,) differ."""
    (a, b), assumed = _terms_of_both(coordinates, one, two, x, u)
    after_a, after_b = (of_norm_one(coordinates, after, x) for after in steps)
    scheme_a, scheme_b = (
        _scheme(coordinates, x, terms, after, FITS[engine.contract.precision])
        for engine, terms, after in ((one, a, after_a), (two, b, after_b))
    )
    base = euler(coordinates, x, a, scheme_a)
    effects = {
        name.replace("_", " "): _size(euler(coordinates, x, a._replace(**{name: getattr(b, name)}), scheme_a) - base)
        for name in Terms._fields
    }
    effects[INTEGRATOR] = _size(euler(coordinates, x, a, scheme_b) - base)
    left = _size((after_b - euler(coordinates, x, b, scheme_b)) - (after_a - base))
    what = what_is_left(coordinates, one, two, x, steps)
    effects[what] = max(left, effects.get(what, 0.0))
    ranked = dict(sorted(effects.items(), key=lambda item: -item[1]))
    gap = _size(after_b - after_a)
    return Attribution(gap, ranked, next(iter(ranked)) if gap else "", (scheme_a, scheme_b), assumed)


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


def _terms_of_both(
    coordinates: Coordinates, one: Engine, two: Engine, x: Array, u: Array
) -> tuple[tuple[Terms, Terms], tuple[str, ...]]:
    """The terms of both, and what was assumed of them: where one offers none it gets the other's."""
    q, v = x[: coordinates.nq], x[coordinates.nq :]
    masses, no_mass = _offered((one, two), "M(q)", lambda engine: engine.mass_matrix(q), np.eye(len(v)))
    biases, no_bias = _offered((one, two), "bias(q, v)", lambda engine: engine.bias(q, v), np.zeros(len(v)))
    a, b = (
        Terms(M, bias, *forces(engine.contract, u), engine.contract.time_step)
        for M, bias, engine in zip(masses, biases, (one, two), strict=True)
    )
    return (a, b), (*no_mass, *no_bias)


def _offered(
    engines: tuple[Engine, Engine], name: str, ask: Callable[[Engine], Array], otherwise: Array
) -> tuple[list[Array], list[str]]:
    found: list[Array | None] = []
    for engine in engines:
        try:
            found.append(ask(engine))
        except NotOfferedError:
            found.append(None)
    known = next((value for value in found if value is not None), otherwise)
    missing = [f"{name} of {e.name}" for e, value in zip(engines, found, strict=True) if value is None]
    return [known if value is None else value for value in found], missing


def forces(contract: EngineContract, u: Array) -> tuple[Array, Array]:
    """B u and the joints' damping, (nv,) each."""
    limits = np.array(contract.effort_limits)
    actuation = np.array(contract.actuation, dtype=float).reshape(len(contract.actuation), len(u))
    damping = [[0.0] * 6 if joint.kind == "quaternion_floating" else [joint.damping] for joint in contract.joints]
    return actuation @ np.clip(u, -limits, limits), np.array([number for joint in damping for number in joint])


def _scheme(coordinates: Coordinates, x: Array, terms: Terms, after: Array, fits: float) -> EulerScheme:
    """The scheme that gives the step; Drake's where none does, for then something else is at work."""
    misfits = {scheme: _size(after - euler(coordinates, x, terms, scheme)) for scheme in SCHEMES}
    best = min(misfits, key=lambda scheme: misfits[scheme])
    return best if misfits[best] <= fits * max(1.0, _size(after)) else SCHEMES[0]


def what_is_left(coordinates: Coordinates, one: Engine, two: Engine, x: Array, steps: tuple[Array, Array]) -> str:
    """What makes steps differ that no Euler step explains: a law that is at work at one of the states, if any."""
    states = (x, *steps)
    if any(_depth(engine, state) > 0 for engine in (one, two) for state in states):
        return CONTACT_LAW
    joints = ([j for j in e.contract.joints if j.kind != "quaternion_floating"] for e in (one, two))
    singles = [pair for own in joints for pair in zip(own, coordinates.single, strict=True)]
    if any(not j.lower <= state[i] <= j.upper for j, (i, _) in singles for state in states):
        return LIMIT_LAW
    return UNEXPLAINED if one.contract.integrator == two.contract.integrator else INTEGRATOR


def _depth(engine: Engine, x: Array) -> float:
    try:
        return engine.contact_depth(x)
    except NotOfferedError:
        return 0.0


def _size(difference: Array) -> float:
    return float(np.abs(difference).max(initial=0.0))
