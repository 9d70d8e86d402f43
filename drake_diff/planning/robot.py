"""A stranger's file as a robot that can be planned for: what it leaves out is mended, each repair a sentence."""

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import DrakeDiffError, ModelError, ModelWarning, SimulationError
from drake_diff.model.contact import penetration
from drake_diff.model.model import Model, load_model
from drake_diff.model.plant import joints
from drake_diff.model.step import advance, set_state

TIME_STEP = 0.02  # [s] of a plan
ATTEMPTS = 60  # at a posture in which nothing overlaps
INSIDE = 0.05  # of a joint's range: a start is at least that far from both its limits
TURN, SHIFT = 1.0, 0.2  # [rad], [m] the range on each side of 0 of a joint without limits
WIDEST = 4 * np.pi  # a wider range is as good as none
TOUCHING = 1e-4  # [m] of overlap: less is none
FEW = 0.5  # of all joints: where fewer have a motor, the file says nothing of motors, or forgot some
TEXTBOOK = 6  # joints: a file of more is no cart-pole, and none of them is meant to be without a motor
SMALLEST_DRIVE = 1e-9  # of the largest singular value: a velocity with less is not driven
PROBE = 0.1  # of an effort limit, or of 1 N or N m: what the effect of an input is measured with


@dataclass(frozen=True, eq=False)
class Robot:
    """A model that can be planned for, the posture it starts in, and what was mended in its file.

    `lower` and `upper` (nq,) are where its coordinates may be: their limits, or a range around 0 where they have none.
    `shapes` is the model with its collision shapes, in which overlap is looked for; None where there is nothing to
    look for.
    """

    model: Model
    shapes: Model | None
    q: Array
    lower: Array
    upper: Array
    repairs: tuple[str, ...]
    is_fully_driven: bool

    def overlap(self, q: Array) -> float:
        """[m] how deep the deepest overlap of shapes is in posture q (nq,); 0 where nothing is looked for."""
        return 0.0 if self.shapes is None else overlap(self.shapes, q)


def load_robot(path: Path, seed: int) -> Robot:
    """The robot in a file, mended where it has to be; ModelError where nothing in it can be driven."""
    options: dict[str, Any] = {"time_step": TIME_STEP}
    told: list[str] = []
    model = _loaded(path, options)
    reduced = _loaded(path, options | {"mimic": "reduce"})
    if reduced.nv < model.nv:
        options["mimic"], gone = "reduce", model.nv - reduced.nv
        told.append(f"{gone} joint{'s' * (gone > 1)} that follow others left the state (mimic='reduce')")
        model = reduced
    count = sum(joint.num_velocities() == 1 for joint in joints(model.plant))
    if model.nu < (count if count > TEXTBOOK else FEW * count):
        had, model = model.nu, _loaded(path, options | {"actuators": "all"})
        if model.nu > had:
            options["actuators"] = "all"
            begin = f"only {had} joints had a motor" if had else "no joint had a motor"
            told.append(f"{begin}: all {model.nu} that can be driven have one (actuators='all')")
    if model.plant.GetFloatingBaseBodies() and joints(model.plant):
        held = _held(path, options)
        if held is not None and held.nv < model.nv:
            names = ", ".join(model.plant.get_body(b).name() for b in sorted(model.plant.GetFloatingBaseBodies()))
            options["base"], model = "weld", held
            told.append(f"{names} floated: it is fixed to the world (base='weld')")
    stuck = tuple(j.name() for j in joints(model.plant) if _is_stuck(j))
    if stuck and len(stuck) == count:
        raise ModelError(f"{path}: no joint of it can move: each has the same lower and upper limit, which Drake keeps")
    if stuck:
        options["fix_joints"] = stuck
        model = _loaded(path, options)
        told.append(f"{', '.join(stuck)} had the same lower and upper limit: fixed there (fix_joints)")
    if not model.nu:
        raise ModelError(f"{path}: nothing in it can be driven: it has no revolute or prismatic joint")
    return _placed(path, options, model, told, np.random.default_rng(seed))


def _placed(path: Path, options: dict[str, Any], model: Model, told: list[str], random: np.random.Generator) -> Robot:
    """The robot in the posture it starts in, and with the contact that its plan needs."""
    lower, upper = ranges(model)
    first = _inside(model, lower, upper)
    apart = model if not model.contract.contact.collision_pairs else _loaded(path, options | {"contact": False})
    driven = is_fully_driven(apart, first)
    shapes: Model | None = model if model.contract.contact.collision_pairs else None
    q = first
    if shapes is not None:
        found = _apart(shapes, first, lower, upper, random)
        if found is None:
            shapes = None
            told.append("its shapes overlap in every posture that was tried, so overlap is not looked for")
        else:
            q = found
        if driven:
            model = apart
            told.append("contact is left out of its steps (contact=False)" + ("" if shapes is None else SEEN))
    if np.any(np.abs(q - model.default_state[: model.nq]) > 1e-9):
        told.append("its start is moved to where joints are inside their limits and nothing overlaps")
    return Robot(model, shapes, q, lower, upper, tuple(told), driven)


SEEN = ": overlap is looked for along the plan"


def _loaded(path: Path, options: dict[str, Any]) -> Model:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # what was mended is told at the end
        return load_model(path, **options)


def _held(path: Path, options: dict[str, Any]) -> Model | None:
    """With its base held; None where nothing can move then."""
    try:
        return _loaded(path, options | {"base": "weld"})
    except ModelError:
        return None


def _is_stuck(joint: Any) -> bool:
    return bool(joint.num_positions() == 1 and joint.position_lower_limits()[0] == joint.position_upper_limits()[0])


def ranges(model: Model) -> tuple[Array, Array]:
    """(lower, upper) (nq,): the limits of each coordinate, or a range around 0 where it has none, or a wide one."""
    lower = np.array([p.lower for p in model.contract.positions], dtype=float)
    upper = np.array([p.upper for p in model.contract.positions], dtype=float)
    reach = np.array([SHIFT if p.unit == "m" else TURN for p in model.contract.positions])
    wide = upper - lower > WIDEST  # so is what has no limits
    low = np.where(wide, np.maximum(lower, -reach), lower)
    high = np.where(wide, np.minimum(upper, reach), upper)
    beyond = low >= high  # one limit alone, on the other side of 0
    low = np.where(beyond & np.isfinite(upper), upper - 2 * reach, low)
    high = np.where(beyond & np.isfinite(lower), lower + 2 * reach, high)
    return low, high


def _of_joints(model: Model) -> Array:
    """(nq,) whether a coordinate is that of a joint, and no part of a free body's pose."""
    if model.nq == model.nv:
        return np.ones(model.nq, dtype=bool)
    found = np.zeros(model.nq, dtype=bool)
    for joint in joints(model.plant):
        if joint.num_positions() == 1:
            found[joint.position_start()] = True
    return found


def _inside(model: Model, lower: Array, upper: Array) -> Array:
    """The file's posture; in the middle of a joint's limits where that is outside, and inside where it is at one."""
    q = model.default_state[: model.nq].copy()
    margin = INSIDE * (upper - lower)
    outside = (q < lower) | (q > upper)
    inside = np.where(outside, (lower + upper) / 2, np.clip(q, lower + margin, upper - margin))
    return np.where(_of_joints(model), inside, q)


def _apart(shapes: Model, first: Array, lower: Array, upper: Array, random: np.random.Generator) -> Array | None:
    """The posture `first`, or one drawn at random, in which nothing overlaps; None where none is found."""
    margin, one, q = INSIDE * (upper - lower), _of_joints(shapes), first
    for i in range(ATTEMPTS):
        if overlap(shapes, q) <= TOUCHING:
            return q
        part = (i + 1) / ATTEMPTS  # ever farther away
        drawn = first + part * (random.uniform(lower + margin, upper - margin) - first)
        q = np.where(one, drawn, first)
    return None


def overlap(model: Model, q: Array) -> float:
    """[m] how deep the deepest overlap of collision shapes is in posture q (nq,); 0 where Drake cannot tell."""
    set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
    try:
        return penetration(model)
    except DrakeDiffError:
        return 0.0


def effort_limits(model: Model) -> Array:
    """(nu,) the smaller of the two limits of each input, infinite where there is none."""
    return np.array([min(abs(u.lower), abs(u.upper)) for u in model.contract.inputs])


def drive(model: Model, x: Array) -> tuple[Array, Array]:
    """(v, J): the velocities after a step from x without input (nv,), and what each input adds to them (nv, nu).

    Raises SimulationError where Drake cannot take the step.
    """
    limits = effort_limits(model)
    probe = np.where(np.isfinite(limits) & (limits > 0), PROBE * limits, PROBE)
    at_rest = np.array(advance(model.double, x, np.zeros(model.nu)))[model.nq :]
    columns = [np.array(advance(model.double, x, u))[model.nq :] - at_rest for u in np.diag(probe)]
    return at_rest, np.array(columns).T / probe


def is_fully_driven(model: Model, q: Array) -> bool:
    """Whether the inputs can give any velocity, so that every smooth motion of the joints can be made."""
    if model.nq != model.nv or model.nu < model.nv:
        return False
    try:
        _, effect = drive(model, np.concatenate([q, np.zeros(model.nv)]))
    except SimulationError:
        return False
    size = np.linalg.svd(effect, compute_uv=False)
    return bool(size[-1] > SMALLEST_DRIVE * size[0])
