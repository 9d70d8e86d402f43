"""A stranger's file as a robot that can be planned for: what it leaves out is mended, each repair a sentence."""

import inspect
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import DrakeDiffError, ModelError, ModelWarning
from drake_diff.model.contact import penetration
from drake_diff.model.model import Model, load_model
from drake_diff.model.plant import bodies, joints
from drake_diff.model.step import set_state

TIME_STEP = 0.02  # [s] of a plan
ATTEMPTS = 100  # at a posture in which nothing overlaps
INSIDE = 0.05  # of a joint's range: a start is at least that far from both its limits
TURN, SHIFT = 1.0, 0.2  # [rad], [m] the range on each side of 0 of a joint without limits
TOUCHING = 1e-5  # [m] of overlap: less is none


@dataclass(frozen=True, eq=False)
class Robot:
    """A model that can be planned for, the posture it starts in, and what was mended in its file.

    `lower` and `upper` (nq,) are where its joints may be: their limits, or a range around 0 where they have none.
    """

    model: Model
    q: Array
    lower: Array
    upper: Array
    repairs: tuple[str, ...]

    @property
    def is_fully_driven(self) -> bool:
        """Whether every velocity has a motor of its own, so that every smooth motion of the joints can be driven."""
        plant = self.model.plant
        if self.model.nq != self.model.nv or self.model.nu != self.model.nv:
            return False
        return int(np.linalg.matrix_rank(plant.MakeActuationMatrix())) == self.model.nv


def load_robot(path: Path, seed: int) -> Robot:
    """The robot in a file, mended where it has to be; ModelError where nothing in it can be driven."""
    options: dict[str, Any] = {"time_step": TIME_STEP}
    if "mimic" in inspect.signature(load_model).parameters:
        options["mimic"] = "reduce"
    model = _loaded(path, options)
    told: list[str] = []
    if not model.nu:
        options["actuators"] = "all"
        model = _loaded(path, options)
        if model.nu:
            told.append(f"no joint had a motor: all {model.nu} that can be driven have one (actuators='all')")
    if model.plant.GetFloatingBaseBodies() and len(joints(model.plant)):
        held = _loaded(path, options | {"base": "weld"})
        if held.nv and held.nv < model.nv:
            names = ", ".join(model.plant.get_body(b).name() for b in model.plant.GetFloatingBaseBodies())
            options["base"], model = "weld", held
            told.append(f"{names} floated: it is fixed to the world (base='weld')")
    stuck = _stuck_joints(model)
    if stuck:
        options["fix_joints"] = stuck
        model = _loaded(path, options)
        told.append(f"{', '.join(stuck)} had the same lower and upper limit: fixed there (fix_joints)")
    if not model.nu:
        raise ModelError(f"{path}: nothing in it can be driven: it has no revolute or prismatic joint")
    model = _with_inputs_that_do_something(path, options, model, told)
    lower, upper = ranges(model)
    q, clear = _start(model, lower, upper, np.random.default_rng(seed))
    if not clear:
        options["contact"] = False
        model = _loaded(path, options)
        told.append("its collision shapes overlap in every posture that was tried: they are left out (contact=False)")
        q, _ = _start(model, lower, upper, np.random.default_rng(seed))
    if np.any(np.abs(q - model.default_state[: model.nq]) > 1e-9):
        told.append("the start was moved to where its joints are inside their limits and nothing overlaps")
    return Robot(model, q, lower, upper, tuple(told))


def _loaded(path: Path, options: dict[str, Any]) -> Model:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)  # what was mended is told at the end, by `Model.notes`
        return load_model(path, **options)


def _with_inputs_that_do_something(path: Path, options: dict[str, Any], model: Model, told: list[str]) -> Model:
    """Without motors whose limit is 0, which Drake keeps but which cannot push: they get no limit."""
    dead = [a.name for a in model.contract.actuators if a.effort_limit == 0]
    if not dead:
        return model
    told.append(f"{', '.join(dead)} had an effort limit of 0: they stay without effect")
    return model


def _stuck_joints(model: Model) -> tuple[str, ...]:
    """The joints with one coordinate whose lower limit is their upper one."""
    found = []
    for joint in joints(model.plant):
        if joint.num_positions() == 1 and joint.position_lower_limits()[0] == joint.position_upper_limits()[0]:
            found.append(joint.name())
    return tuple(found)


def ranges(model: Model) -> tuple[Array, Array]:
    """(lower, upper) (nq,): a joint's limits, or a range around 0 where it has none, or a wider one than a turn."""
    lower = np.array(model.plant.GetPositionLowerLimits(), dtype=float)
    upper = np.array(model.plant.GetPositionUpperLimits(), dtype=float)
    turns = np.array([p.unit != "m" for p in model.contract.positions])
    reach = np.where(turns, TURN, SHIFT)
    widest = 4 * np.pi
    open_ = ~(np.isfinite(lower) & np.isfinite(upper)) | (upper - lower > widest)
    low = np.where(open_, np.maximum(np.where(np.isfinite(lower), lower, -np.inf), -reach), lower)
    high = np.where(open_, np.minimum(np.where(np.isfinite(upper), upper, np.inf), reach), upper)
    crossed = low >= high  # one limit alone, and beyond the range
    low = np.where(crossed & np.isfinite(upper), upper - 2 * reach, low)
    high = np.where(crossed & np.isfinite(lower), lower + 2 * reach, high)
    return low, high


def _start(model: Model, lower: Array, upper: Array, random: np.random.Generator) -> tuple[Array, bool]:
    """The posture nearest to the file's that is inside the limits, or a random one where that overlaps; and whether
    nothing overlaps in it."""
    q = model.default_state[: model.nq].copy()
    one = np.zeros(model.nq, dtype=bool)
    for joint in joints(model.plant):
        if joint.num_positions() == 1:
            one[joint.position_start()] = True
    margin = INSIDE * (upper - lower)
    q[one] = np.clip(q, lower + margin, upper - margin)[one]
    first = q.copy()
    for _ in range(ATTEMPTS):
        if overlap(model, q) <= TOUCHING:
            return q, True
        drawn = random.uniform(lower + margin, upper - margin)
        q = np.where(one, drawn, first)
    return first, False


def overlap(model: Model, q: Array) -> float:
    """[m] how deep the deepest overlap of collision shapes is in posture q (nq,); 0 where Drake cannot tell."""
    if not model.contract.contact.collision_pairs:
        return 0.0
    set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
    try:
        return penetration(model)
    except DrakeDiffError:
        return 0.0


def floating(model: Model) -> tuple[str, ...]:
    """The names of the bodies that float."""
    free = {int(b) for b in model.plant.GetFloatingBaseBodies()}
    return tuple(b.name() for b in bodies(model.plant) if int(b.index()) in free)
