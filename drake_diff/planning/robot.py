"""A stranger's file as a robot that can be planned for: what it leaves out is mended, each repair a sentence."""

import warnings
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff._base.values import Refusal
from drake_diff.derivatives.analytic import analytic_of
from drake_diff.exceptions import DrakeDiffError, ModelError, ModelWarning, SimulationError
from drake_diff.model.model import Model, load_model
from drake_diff.model.plant import actuators, joints
from drake_diff.model.step import advance, set_state
from drake_diff.planning.posture import (
    Pair,
    Start,
    deepest,
    inside,
    of_joints,
    pairs_always,
    ranges,
    shares_to_hold,
    start,
)
from drake_diff.planning.standing import Legged, Rest, stand
from drake_diff.planning.thrusters import lifted, thrusters

TIME_STEP = 0.02  # [s] of a plan
FEW = 0.5  # of all joints: where fewer have a motor, the file says nothing of motors, or forgot some
TEXTBOOK = 6  # joints: a file of more is no cart-pole, and none of them is meant to be without a motor
SMALLEST_DRIVE = 1e-9  # of the largest singular value: a velocity with less is not driven
NAMED = 4  # of a long list of names


@dataclass(frozen=True, eq=False)
class Robot:
    """A model that can be planned for, the posture it starts in, and what was mended in its file.

    `lower` and `upper` (nq,) are where its coordinates may be: their limits, or a range around 0 where they have none.
    `shapes` is the model with its collision shapes, in which overlap is looked for; None where there is nothing to
    look for. `always` are the pairs of shapes that overlap in every posture, which is not looked at. `apart` is the
    model without contact in its steps, for a way on which nothing touches, where `model` has contact. `standing`
    tells how it stands on its feet, where it does; else what floats is held.
    """

    model: Model
    shapes: Model | None
    q: Array
    lower: Array
    upper: Array
    repairs: tuple[str, ...]
    is_fully_driven: bool
    always: frozenset[Pair] = frozenset()
    standing: tuple[Legged, Rest] | None = None
    apart: Model | None = None

    def overlap(self, q: Array) -> float:
        """[m] how deep the deepest overlap of shapes is in posture q (nq,); 0 where nothing is looked for."""
        return 0.0 if self.shapes is None else deepest(self.shapes, q, self.always)


def load_robot(path: Path, seed: int, held: str = "") -> Robot:
    """The robot in a file, mended where it has to be; ModelError where nothing in it can be driven.

    What floats and can stand on feet does so, unless `held` says why it is to be held.
    """
    options: dict[str, Any] = {"time_step": TIME_STEP}
    repairs: list[str] = []
    model = _loaded(path, options)
    reduced = _reduced(path, options, model, repairs)
    if reduced.nv < model.nv:
        options["mimic"], gone = "reduce", model.nv - reduced.nv
        repairs.append(f"{gone} joint{'s' * (gone > 1)} that follow others left the state (mimic='reduce')")
        model = reduced
    count = sum(joint.num_velocities() == 1 for joint in joints(model.plant))
    if model.nu < (count if count > TEXTBOOK else FEW * count):
        had, model = model.nu, _loaded(path, options | {"actuators": "all"})
        if model.nu > had:
            options["actuators"] = "all"
            begin = f"only {had} joints had a motor" if had else "no joint had a motor"
            repairs.append(f"{begin}: all {model.nu} that can be driven have one (actuators='all')")
    if model.plant.GetFloatingBaseBodies() and joints(model.plant):
        standing = Refusal(held) if held else _standing(path, model, options, repairs, seed)
        if isinstance(standing, Robot):
            return standing
        welded = _held(path, options)
        if welded is not None and welded.nv < model.nv:
            names = _few(model.plant.get_body(b).name() for b in sorted(model.plant.GetFloatingBaseBodies()))
            options["base"], model = "weld", welded
            repairs.append(f"{names} floated: it is fixed to the world (base='weld'), as {standing}")
    stuck = _stuck(model)
    if stuck and len(stuck) == count:
        raise ModelError(f"{path}: no joint of it can move: each has the same lower and upper limit, which Drake keeps")
    if stuck:
        options["fix_joints"] = stuck
        model = _loaded(path, options)
        repairs.append(f"{_few(stuck)} had the same lower and upper limit: fixed there (fix_joints)")
    model = _with_mass(path, options, model, repairs)
    model = _with_thrusters(path, options, model, repairs)
    return _placed(path, options, model, repairs, np.random.default_rng(seed))


# Of a robot that stands: every shape is spheres, which a ground meets with derivatives, and only the ground is met.
ON_FEET: dict[str, Any] = {"base": "free", "meshes": "spheres", "contact_geometry": "corner_spheres"}
# Drake's own values let light legs sink by millimetres, by how much depends on the step, and rise only in 0.2 s.
GROUND: dict[str, Any] = {"ground": True, "contact": "ground", "near_rigid": 0.1, "relaxation_time": 0.02}
STEPS_ON_FEET, MANY = (0.005, 0.01), 24  # [s], the second of robots of more velocities, each of whose steps costs more
DRAWN = 16  # postures, to see which shapes always overlap


def _standing(path: Path, read: Model, options: dict[str, Any], repairs: list[str], seed: int) -> Robot | Refusal:
    """The robot that was `read` on its feet on a ground; or why it does not stand."""
    on_feet = options | ON_FEET | GROUND | {"time_step": STEPS_ON_FEET[read.nv > MANY]}
    random = np.random.default_rng(seed)
    repairs = list(repairs)
    try:
        model = _loaded(path, on_feet)
        stuck = _stuck(model)
        if stuck:
            on_feet["fix_joints"] = stuck
            model = _loaded(path, on_feet)
            repairs.append(f"{_few(stuck)} had the same lower and upper limit: fixed there (fix_joints)")
        model = _with_mass(path, on_feet, model, repairs)
        if model.nv > MANY and isinstance(analytic_of(model), Refusal) and options.get("mimic") == "reduce":
            on_feet["mimic"] = "fix"
            model = _loaded(path, on_feet)
            repairs.append(
                "what follows and what leads is fixed where it stands (mimic='fix'), for analytic derivatives"
            )
        derivatives = analytic_of(model)
        if model.nv > MANY and isinstance(derivatives, Refusal):
            return Refusal(f"the derivatives of {model.nv} velocities in contact would take minutes: {derivatives}")
        lower, upper = ranges(model)
        stance = stand(model, lower, upper)
        if isinstance(stance, Refusal):
            return Refusal(f"it cannot stand: {stance}")
        shapes = _loaded(path, on_feet | {"ground": None, "contact": True})
        q, is_joint = stance[1].x[: model.nq], of_joints(model)
        overlapping = pairs_always([np.where(is_joint, random.uniform(lower, upper), q) for _ in range(DRAWN)], shapes)
        besides = overlapping | pairs_always([q], shapes)
    except DrakeDiffError as error:
        return Refusal(f"a model that could stand cannot be made: {error}")
    feet = _few(foot.name for foot in stance[0].feet)
    repairs.append(
        f"it stands on {feet}, on a ground that was added (base='free', ground=True), by spheres in its shapes"
    )
    if besides:
        repairs.append(f"{_few(map(' and '.join, sorted(besides)))} overlap where it stands, which is not looked at")
    return Robot(model, shapes, q, lower, upper, tuple(repairs), False, besides, stance)


def _with_thrusters(path: Path, options: dict[str, Any], model: Model, repairs: list[str]) -> Model:
    """The model, with thrusters where it floats and nothing drives it; ModelError where nothing can."""
    if not model.nu and model.plant.GetFloatingBaseBodies():
        options["body_forces"] = thrusters(model)
        model = _loaded(path, options)
        names = _few(dict.fromkeys(force.body for force in options["body_forces"]))
        repairs.append(f"nothing drives {names}: six thrusters push and turn it, two along each axis (body_forces)")
    if not model.nu:
        raise ModelError(f"{path}: nothing in it can be driven: it has no revolute or prismatic joint, and none floats")
    return model


def _reduced(path: Path, options: dict[str, Any], model: Model, repairs: list[str]) -> Model:
    """The model without the joints that follow others; as it is where that cannot be done, which is told."""
    try:
        return _loaded(path, options | {"mimic": "reduce"})
    except ModelError as error:
        repairs.append(f"joints that follow others stay in the state, as {error}")
        return model


def _placed(
    path: Path, options: dict[str, Any], model: Model, repairs: list[str], random: np.random.Generator
) -> Robot:
    """The robot in the posture it starts in, and with the contact that its plan needs."""
    lower, upper = ranges(model)
    first = inside(model, lower, upper)
    touches = bool(model.contract.contact.collision_pairs)
    apart = _loaded(path, options | {"contact": False}) if touches else model
    driven = is_fully_driven(apart)
    flies = bool(options.get("body_forces"))
    shapes = model if touches else None
    if flies and shapes is not None:
        first = lifted(shapes, first)
    try:
        posture = start(shapes, apart if driven else None, first, lower, upper, random)
    except SimulationError as error:
        repairs.append(f"its overlap is not looked for: {error}")
        shapes, posture = None, start(None, apart if driven else None, first, lower, upper, random)
    weak = _too_weak(apart, posture) if driven and posture.load > 1 else ()
    if weak and len(weak) < model.nv:
        repairs.append(f"the motors of {_few(weak)} cannot hold the weight in any posture tried: fixed (fix_joints)")
        fixed = options | {"fix_joints": (*options.get("fix_joints", ()), *weak)}
        return _placed(path, fixed, _loaded(path, fixed), repairs, random)
    if posture.always:
        repairs.append(
            f"{_few(map(' and '.join, sorted(posture.always)))} overlap in every posture, which is not looked at"
        )
    if (driven or flies) and touches:
        model = apart
        seen = "" if shapes is None else ": overlap is looked for along the plan"
        repairs.append(f"contact is left out of its steps (contact=False){seen}")
    if np.any(np.abs(posture.q - model.default_state[: model.nq]) > 1e-9):
        repairs.append(
            "its start is moved to where joints are inside their limits, nothing overlaps and its motors hold it"
        )
    other = apart if model is not apart else None
    return Robot(model, shapes, posture.q, lower, upper, tuple(repairs), driven, posture.always, apart=other)


def _too_weak(model: Model, posture: Start) -> tuple[str, ...]:
    """The joints whose motors are too weak for the posture, and those that follow them."""
    over = np.flatnonzero(shares_to_hold(model, posture.q) > 1)
    moved = [actuator.joint().name() for actuator in actuators(model.plant)]
    return _with_followers(model, [moved[i] for i in model.inputs.actuator[over]])


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


def _stuck(model: Model) -> tuple[str, ...]:
    """The joints that have no way to go between their limits, and those that follow them."""
    lower, upper = model.position_limits
    names: list[str] = []
    for joint in joints(model.plant):
        (positions, _) = model.places(joint)
        if joint.num_positions() == 1 and len(positions) and lower[positions[0]] >= upper[positions[0]]:
            names.append(joint.name())
    return _with_followers(model, names)


def _with_followers(model: Model, names: list[str]) -> tuple[str, ...]:
    """The joints, and those that follow them."""
    joint_names, mimics = list(names), () if model.coupling is None else model.coupling.mimics
    while more := [m.follower for m in mimics if m.leader in joint_names and m.follower not in joint_names]:
        joint_names += more
    return tuple(joint_names)


def _with_mass(path: Path, options: dict[str, Any], model: Model, repairs: list[str]) -> Model:
    """The model, less joints that nothing hangs on which has a mass: Drake could take no step of them."""
    if _can_step(model):
        return model
    if options.get("mimic"):
        held = _loaded(path, options | {"mimic": "fix"})
        if _can_step(held):
            options["mimic"] = "fix"
            repairs.append(
                "joints that follow others, and those that they follow, are fixed (mimic='fix'), as Drake cannot "
                f"take a step with them: {_why_not(model)}"
            )
            return held
    moved = model.double.mass_matrix()
    light = tuple(
        joint.name()
        for joint in joints(model.plant)
        if joint.num_velocities() == 1
        and len(velocities := model.places(joint)[1])
        and moved[velocities[0], velocities[0]] <= 0
    )
    if not light:
        return model
    options["fix_joints"] = (*options.get("fix_joints", ()), *light)
    repairs.append(f"{_few(light)} move nothing that has a mass or inertia: fixed (fix_joints)")
    return _loaded(path, options)


def _why_not(model: Model) -> str:
    """What Drake says of a step from the model's own state; empty where it takes it."""
    try:
        advance(model.double, model.default_state, np.zeros(model.nu))
    except SimulationError as error:
        return str(error)
    return ""


def _can_step(model: Model) -> bool:
    return not _why_not(model)


def _few(names: "Collection[str] | Any") -> str:
    """The names with commas between, the first ones of many."""
    every = list(names)
    more = f" and {len(every) - NAMED} more" if len(every) > NAMED + 1 else ""
    return ", ".join(every[:NAMED] if more else every) + more


def drive(model: Model, q: Array) -> Array:
    """(nv, nu) what each input adds to the velocities in a step from posture q (nq,), as the step's equation says."""
    set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
    h = model.time_step
    mass = model.double.mass_matrix() + h * np.diag(model.double.damping())
    return np.asarray(h * np.linalg.solve(mass, model.actuation))


def is_fully_driven(model: Model) -> bool:
    """Whether the inputs can give any velocity, so that every smooth motion of the joints can be made."""
    if model.nq != model.nv or model.nu < model.nv:
        return False
    size = np.linalg.svd(model.actuation, compute_uv=False)
    return bool(size[-1] > SMALLEST_DRIVE * size[0])
