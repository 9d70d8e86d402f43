"""Seeded states of a model to try something on: in free motion, and with geometries just touching."""

from dataclasses import dataclass

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff.exceptions import SimulationError
from drake_diff.model.contact import penetration
from drake_diff.model.model import Model
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

FREE, CONTACT = "free", "contact"
ATTEMPTS = 200  # at a state of the kind that is wanted, before another kind is taken
DEPTH = (1e-4, 1e-3)  # [m] how deep geometries of a contact state overlap
BISECTIONS = 40
SPEED = 0.5  # [m/s or rad/s] standard deviation, within the velocity limits
REACH = 1.0  # [m] of a slide, or of a free body, without limits
ONE_WAY = 2.0  # [N or N m] how far from 0 on inputs are taken that have one sign only
EFFORT = 0.2  # part of the effort limit; of 1 N or N m where there is none


@dataclass(frozen=True, eq=False)
class SampledState:
    """A state x (nx,) and an input u (nu,), and whether geometries touch there."""

    kind: str
    x: Array
    u: Array


def sample_states(model: Model, count: int, seed: int = 0) -> list[SampledState]:
    """`count` states, every other one touching where contact can be found; the same seed gives the same states."""
    random = np.random.default_rng(seed)
    lower, upper = model.inputs.lower, model.inputs.upper
    limit = np.minimum(np.abs(lower), np.abs(upper))
    effort = EFFORT * np.where(limit < 1e6, limit, 1.0)
    middle = np.zeros(model.nu)
    for i in np.flatnonzero((lower >= 0) | (upper <= 0)).tolist():  # a force that cannot change its sign
        near = lower[i] if lower[i] >= 0 else upper[i]
        far = float(np.clip(near + ONE_WAY * (1 if lower[i] >= 0 else -1), lower[i], upper[i]))
        middle[i], effort[i] = (near + far) / 2, EFFORT * abs(far - near)
    touches = model.contract.contact.collision_pairs > 0
    samples: list[SampledState] = []
    for i in range(count):
        x = _touching(model, random) if touches and i % 2 else None
        kind = FREE if x is None else CONTACT
        x = _free(model, random) if x is None else x
        samples.append(SampledState(kind, frozen(x), frozen(middle + effort * random.uniform(-1, 1, model.nu))))
    return samples


def _free(model: Model, random: np.random.Generator) -> Array:
    """A state without overlap, where one is found; else the last one tried."""
    for _ in range(ATTEMPTS):
        x = any_state(model, random)
        if _depth(model, x) == 0:
            break
    return x


def _touching(model: Model, random: np.random.Generator) -> Array | None:
    """Between a free state and one with an overlap, the state where the overlap is small; None if none is found."""
    space = tangent_space(model)
    free = _free(model, random)
    for _ in range(ATTEMPTS // 10):
        inside = any_state(model, random)
        for start in space.quaternions:  # free bodies are pushed downwards, where the ground is
            inside[start + 6] -= REACH * random.uniform(0, 2)
        if _depth(model, inside) <= 0:
            continue
        way, low, high = space.minus(inside, free), 0.0, 1.0
        for _ in range(BISECTIONS):
            middle = (low + high) / 2
            x = space.plus(free, middle * way)
            depth = _depth(model, x)
            if DEPTH[0] <= depth <= DEPTH[1]:
                return x
            low, high = (middle, high) if depth < DEPTH[0] else (low, middle)
    return None


def any_state(model: Model, random: np.random.Generator) -> Array:
    """A state within the limits, 5 % of the range apart from them; around the default where there are none."""
    nq = model.nq
    x = np.array(model.default_state)
    lower, upper = model.position_limits
    limited = np.isfinite(lower) & np.isfinite(upper)
    lower, upper = np.where(limited, lower, 0), np.where(limited, upper, 0)
    reach = np.array([np.pi if coordinate.unit == "rad" else REACH for coordinate in model.contract.positions])
    middle, half = np.where(limited, (lower + upper) / 2, x[:nq]), np.where(limited, 0.45 * (upper - lower), reach)
    x[:nq] = middle + half * random.uniform(-1, 1, nq)
    for start in tangent_space(model).quaternions:  # the seven coordinates of a free body start here
        x[start : start + 4] = random.standard_normal(4)
        x[start : start + 4] /= np.linalg.norm(x[start : start + 4])
        x[start + 6] += REACH
    x[nq:] = np.clip(SPEED * random.standard_normal(model.nv), *model.velocity_limits)
    return x


def _depth(model: Model, x: Array) -> float:
    set_state(model.double, x)
    try:
        return penetration(model)
    except SimulationError:  # Drake cannot measure these shapes: the state is tried as it is
        return 0.0
