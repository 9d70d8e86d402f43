"""An untrusted file as a robot for planning, with its start posture.

Missing parts are added, each with a sentence: motors, thrusters of floating bodies, a ground to stand on.
"""

import warnings
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.differences import central_differences
from drake_diff._base.values import Refusal
from drake_diff.derivatives.analytic import analytic_of
from drake_diff.exceptions import DrakeDiffError, ModelError, ModelWarning, SimulationError
from drake_diff.legs.feet import Legs
from drake_diff.legs.standing import Rest, ranges, stand_softly
from drake_diff.model.assembly import assembled, closed, loop_velocities
from drake_diff.model.contact import overlaps
from drake_diff.model.inputs import BodyForce
from drake_diff.model.model import Model, load_model
from drake_diff.model.plant import actuators, bodies, joints, key_of, labelled
from drake_diff.model.step import advance, set_state
from drake_diff.model.tangent import tangent_space

TIME_STEP = 0.02  # [s] of a plan
# Drake's springs are explicit: a step of 2 / (their angular frequency) is unstable, and a fourth of it is accurate.
OF_SPRING, NUDGE = 0.5, 1e-6  # the second in rad or m
# The least duration [s] of a motion, and the largest number of its steps and ratio to their time if springs are stiff.
SHORTEST, MOST_IF_STIFF, LONGER = 0.6, 1000, 1.25
FEW = 0.5  # of all joints: if fewer have a motor, the file does not describe motors or lacks some
TEXTBOOK = 6  # joints: in a larger file, which is not a textbook model, every joint should have a motor
SMALLEST_DRIVE = 1e-9  # of the largest singular value: a velocity with a smaller one is not driven
NAMED = 4  # names shown of a long list
# Start postures.
INSIDE = 0.05  # of a joint's range: minimum distance of a start from both limits
TOUCHING = 1e-4  # [m] tolerance of overlap
HOLD_SHARE = 0.63  # of the effort limits: maximum effort for holding a start
SEEN = 16  # postures in which a pair of shapes must overlap to count as always overlapping
ROOM, BESIDE = 0.1, 6  # [rad or m] simultaneous motion of all joints from a start, in this number of random directions
OUTSIDE = 1e-9  # largest change of a unit velocity by closing the loops if it is not in a loop
DRIVEN_FIRST = 1e3  # factor by which a velocity without a motor must move more to be independent in its place
ATTEMPTS, FINER = 60, 1000  # start candidates: sampled at growing distance from the file's, and near the best candidate
DEPTH = 0.01  # [m] overlap with the same weight as the full motor effort
# Thrusters of floating bodies without actuators.
STRENGTH = 1.5  # of the weight: the limit of one of the two thrusters along each axis
SMALLEST_ARM = 0.01  # [m]
GRAVITY = 9.81  # [m/s^2] for the weight, also for models without gravity
LIFTS = (0.1, 0.2, 0.5, 1.0, 2.0)  # [m] attempts to lift a body that starts in collision
Pair = tuple[str, str]


@dataclass(frozen=True, eq=False)
class StartPosture:
    """A posture q (nq,), the sum of its overlaps [m], and the share of the effort limits that it requires.

    `always` are the pairs of shapes that overlap in all sampled postures; they are ignored.
    """

    q: Array
    overlap: float
    load: float
    always: frozenset[Pair]


@dataclass(frozen=True, eq=False)
class Robot:
    """A model for planning, its start posture, and the repairs of its file.

    `lower` and `upper` (nq,) are the limits of the coordinates, or a range around 0 for unlimited ones. `shapes` is the
    model with collision shapes for checking overlaps, or None if overlaps are not checked. `always` are the pairs of
    shapes that overlap in every posture, which are ignored. If `model` has contact, `apart` is the model without it
    in its steps, for motions without contact. `standing` describes how the robot stands on its feet, if it does.
    Otherwise, floating bases are welded. `steered` (nv,) are the velocities that a motion of a fully driven robot
    chooses; it is None for other robots. `stiff` is the joint whose spring limits the time step, or "".
    """

    model: Model
    shapes: Model | None
    q: Array
    lower: Array
    upper: Array
    repairs: tuple[str, ...]
    steered: NDArray[np.bool_] | None
    always: frozenset[Pair] = frozenset()
    standing: tuple[Legs, Rest] | None = None
    apart: Model | None = None
    stiff: str = ""

    def closed(self, q: Array) -> Array | None:
        """Return posture q (nq,) with closed loops and unchanged coordinates of the steered joints, or None."""
        if not self.model.file_facts.held_points:  # along paths, in every posture
            return q
        return closed(self.model, q, coordinates_of(self.model, self.steered))

    def overlap(self, q: Array) -> float:
        """Return the deepest overlap [m] of shapes in posture q (nq,), or 0 if overlaps are not checked."""
        return 0.0 if self.shapes is None else deepest(self.shapes, q, self.always)


class _Draft:
    """A robot's file, its load options, the model, and a sentence for each repair."""

    def __init__(self, path: Path, options: dict[str, Any], repairs: Sequence[str] = ()):
        self.path, self.options, self.repairs = path, dict(options), list(repairs)
        self.model = self.read()

    def read(self, **changes: Any) -> Model:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ModelWarning)  # the repairs are reported at the end
            return load_model(self.path, **self.options | changes)

    def mend(self, repair: str, model: Model | None = None, **changes: Any) -> None:
        self.model = self.read(**changes) if model is None else model
        self.options |= changes
        self.repairs.append(repair)

    def fix(self, names: Sequence[str], why: str) -> None:
        fixed = (*self.options.get("fix_joints", ()), *names)
        self.mend(f"{why}: fixed (fix_joints)", fix_joints=fixed)


def load_robot(path: Path, seed: int, packages: Mapping[str, str | Path] | None = None) -> Robot:
    """Load a robot file and repair it if necessary; raise ModelError if nothing in it can be driven.

    A floating robot that can stand on its feet does so. `packages` are the folders of packages by name.
    """
    draft = _Draft(path, {"time_step": TIME_STEP, "packages": packages})
    _reduce_followers(draft)
    _add_motors(draft)
    if draft.model.plant.GetFloatingBaseBodies() and joints(draft.model.plant):
        standing = _standing(draft, seed)
        if isinstance(standing, Robot):
            return standing
        _weld_base(draft, standing)
    _fix_stuck(draft)
    _fix_massless(draft)
    _add_thrusters(draft)
    stiff = _resolve_springs(draft)
    return replace(_placed(draft, np.random.default_rng(seed)), stiff=stiff)


def _resolve_springs(draft: _Draft) -> str:
    """Shorten the time step if a spring needs it, and return the name of its joint, or ""."""
    (resolved, name), usual = spring_step(draft.model), draft.model.time_step
    step = float(f"{resolved:.1g}")
    if step >= usual:
        return ""
    if step * MOST_IF_STIFF * LONGER >= SHORTEST:
        draft.mend(f"stiff springs need short time steps: {step:g} s for {name} (time_step={step:g})", time_step=step)
        return name
    needed = f"the spring of {name} needs time steps of {step:g} s"
    if not draft.options.get("ground"):
        expected = f"a plan of {SHORTEST:g} s has at most {MOST_IF_STIFF}: fix this joint in the file, or soften it"
        raise ModelError(f"{draft.path}: {needed}, and {expected}")
    draft.repairs.append(f"{needed}, which those of {usual:g} s on feet do not resolve")
    return ""


def spring_step(model: Model) -> tuple[float, str]:
    """Return the time step [s] for the springs' fastest vibration in the default state, or inf, and its main joint."""
    if model.plant.num_force_elements() == 1:  # gravity
        return float("inf"), ""
    x, still, space = model.default_state, np.zeros(model.nv), tangent_space(model)
    x = np.append(x[: model.nq], still)

    def force(move: Array) -> Array:
        set_state(model.double, space.plus(x, np.append(move, still)))
        return np.asarray(model.double.inverse_dynamics(still))

    stiffness = central_differences(force, model.nv, NUDGE)
    set_state(model.double, x)
    ways = loop_velocities(model, x[: model.nq])
    mass = ways.T @ model.double.mass_matrix() @ ways
    squares, modes = np.linalg.eig(np.linalg.pinv(mass) @ ways.T @ stiffness @ ways)
    if np.max(squares.real, initial=0.0) <= np.finfo(float).tiny:
        return float("inf"), ""
    fastest = int(np.argmax(squares.real))
    motion = ways @ modes[:, fastest].real
    energy, names = motion * (stiffness @ motion), labelled(joints(model.plant))
    name = max(names, key=lambda n: float(np.sum(energy[list(model.places(names[n])[1])])))
    return OF_SPRING / float(np.sqrt(squares.real[fastest])), name


def _reduce_followers(draft: _Draft) -> None:
    try:
        reduced = draft.read(mimic="reduce")
    except ModelError as error:
        draft.repairs.append(f"mimic joints stay in the state, as {error}")
        return
    if gone := draft.model.nv - reduced.nv:
        draft.mend(f"{gone} mimic joints were removed from the state (mimic='reduce')", reduced, mimic="reduce")


def _add_motors(draft: _Draft) -> None:
    count, had = _movable(draft.model), draft.model.nu
    if had and draft.model.file_facts.held_points:
        return  # the loop moves its other joints
    if had < (count if count > TEXTBOOK else FEW * count):
        driven = draft.read(actuators="all")
        if driven.nu > had:
            begin = f"only {had} joints had a motor" if had else "no joint had a motor"
            repair = f"{begin}: motors were added, {driven.nu} in total (actuators='all')"
            draft.mend(repair, driven, actuators="all")
    driven_joints, labels = [actuator.joint() for actuator in actuators(draft.model.plant)], _labels(draft.model)
    stuck = [j for j in driven_joints if j.position_lower_limits()[0] == 0 == j.position_upper_limits()[0]]
    locked = [labels[key_of(joint)] for joint in stuck]
    if locked:
        draft.mend(f"the range from 0 to 0 of {_few(locked)} was removed (actuators=)", actuators=tuple(locked))


def _labels(model: Model) -> dict[tuple[str, str], str]:
    return {key_of(joint): name for name, joint in labelled(joints(model.plant)).items()}


def _movable(model: Model) -> int:
    return sum(joint.num_velocities() == 1 for joint in joints(model.plant))


def _weld_base(draft: _Draft, why: Refusal) -> None:
    try:
        welded = draft.read(base="weld")
    except ModelError:
        return  # no joint could move
    if welded.nv < draft.model.nv:
        plant = draft.model.plant
        names = _few(plant.get_body(b).name() for b in sorted(plant.GetFloatingBaseBodies()))
        draft.mend(f"the floating base {names} is fixed to the world (base='weld'), as {why}", welded, base="weld")


def _fix_stuck(draft: _Draft) -> None:
    """Weld joints with equal lower and upper limits, and their followers."""
    model, (lower, upper) = draft.model, draft.model.position_limits
    names: list[str] = []
    for name, joint in labelled(joints(model.plant)).items():
        positions, _ = model.places(joint)
        if joint.num_positions() == 1 and len(positions) and lower[positions[0]] >= upper[positions[0]]:
            names.append(name)
    stuck = _with_followers(model, names)
    if stuck and len(stuck) == _movable(model):
        got = "each joint has equal lower and upper limits, which Drake enforces"
        raise ModelError(f"{draft.path}: no joint can move: {got}")
    if stuck:
        draft.fix(stuck, f"{_few(stuck)} had the same lower and upper limit")


def _fix_massless(draft: _Draft) -> None:
    """Weld joints that move no mass, since Drake cannot take a step with them."""
    model, why = draft.model, _why_not(draft.model)
    if not why:
        return
    if draft.options.get("mimic"):
        fixed = draft.read(mimic="fix")
        if not _why_not(fixed):
            repair = "mimic joints and their leaders are fixed (mimic='fix')"
            draft.mend(f"{repair}, as Drake cannot take a step with them: {why}", fixed, mimic="fix")
            return
    mass = np.diag(model.double.mass_matrix())
    light = [
        name
        for name, joint in labelled(joints(model.plant)).items()
        if joint.num_velocities() == 1 and any(mass[v] <= 0 for v in model.places(joint)[1])
    ]
    if light:
        draft.fix(light, f"{_few(light)} move no mass and no inertia")


def _why_not(model: Model) -> str:
    """Return Drake's error for a step from the model's default state, or "" if it succeeds."""
    try:
        advance(model.double, model.default_state, model.neutral_input(model.default_state))
    except SimulationError as error:
        return str(error)
    return ""


def _add_thrusters(draft: _Draft) -> None:
    if not draft.model.nu and draft.model.plant.GetFloatingBaseBodies():
        forces = thrusters(draft.model)
        names = _few(dict.fromkeys(force.body for force in forces))
        repair = f"{names} has no actuator: six thrusters were added, two along each axis (body_forces)"
        draft.mend(repair, body_forces=forces)
    if not draft.model.nu:
        reason = "it has no revolute or prismatic joint and no floating body"
        raise ModelError(f"{draft.path}: no joint or body can be driven: {reason}")


# Options for standing: all shapes are spheres, whose ground contact has derivatives; no other contact.
ON_FEET: dict[str, Any] = {"base": "free", "meshes": "spheres", "contact_geometry": "corner_spheres"}
# With Drake's defaults, light legs sink by millimetres, depending on the time step, and recover only in 0.2 s.
GROUND: dict[str, Any] = {"ground": True, "contact": "ground", "near_rigid": 0.1, "relaxation_time": 0.02}
STEPS_ON_FEET, MANY = (0.005, 0.01), 24  # [s], the second for robots with more velocities, whose steps are slower
DRAWN = 16  # sampled postures, to find shapes that always overlap


def _standing(read: _Draft, seed: int) -> Robot | Refusal:
    """Return the robot standing on a ground, or the reason why it cannot stand."""
    step = STEPS_ON_FEET[read.model.nv > MANY]
    random = np.random.default_rng(seed)
    try:
        draft = _Draft(read.path, read.options | ON_FEET | GROUND | {"time_step": step}, read.repairs)
        _fix_stuck(draft)
        _fix_massless(draft)
        _resolve_springs(draft)
        derivatives = analytic_of(draft.model)
        if draft.model.nv > MANY and isinstance(derivatives, Refusal) and draft.options.get("mimic") == "reduce":
            what = "mimic joints and their leaders are fixed"
            draft.mend(f"{what} (mimic='fix'), for analytic derivatives", mimic="fix")
            derivatives = analytic_of(draft.model)
        model = draft.model
        if model.nv > MANY and isinstance(derivatives, Refusal):
            return Refusal(f"the derivatives of {model.nv} velocities in contact would take minutes: {derivatives}")
        stance = stand_softly(model)
        if isinstance(stance, Refusal):
            return Refusal(f"it cannot stand: {stance}")
        model = stance[0].model
        lower, upper = ranges(model)
        shapes = draft.read(ground=None, contact=True)
        q, is_joint = stance[1].x[: model.nq], of_joints(model)
        overlapping = pairs_always([np.where(is_joint, random.uniform(lower, upper), q) for _ in range(DRAWN)], shapes)
        besides = overlapping | pairs_always([q], shapes)
    except DrakeDiffError as error:
        return Refusal(f"a model for standing cannot be loaded: {error}")
    ground = "on an added ground (base='free', ground=True), with contact at spheres in its shapes"
    soft = f"of {model.options['stiffness']:.2g} N/m" if model.options and model.options["stiffness"] else ""
    draft.repairs.append(f"it stands on {_few(foot.name for foot in stance[0].feet)}, {ground} {soft}".rstrip())
    if besides:
        pairs = _few(map(" and ".join, sorted(besides)))
        draft.repairs.append(f"{pairs} overlap in the initial posture, which the search ignores")
    return Robot(model, shapes, q, lower, upper, tuple(draft.repairs), None, besides, stance)


def _placed(draft: _Draft, random: np.random.Generator) -> Robot:
    """Return the robot in its start posture, with the contact that its plan needs."""
    model, repairs = draft.model, draft.repairs
    lower, upper = ranges(model)
    first = inside(model, lower, upper)
    touches, flies = bool(model.contract.contact.collision_pairs), bool(model.body_forces)
    apart = draft.read(contact=False) if touches else model
    assembly = closed(model, first, coordinates_of(model, np.any(model.actuation != 0, axis=1)))
    first = assembled(model, np.append(first, np.zeros(model.nv)))[: model.nq] if assembly is None else assembly
    chosen = steered(apart, first)
    driven = chosen is not None
    shapes, holds = model if touches else None, apart if driven else None
    joint_q = coordinates_of(apart, chosen)
    if flies and shapes is not None:
        first = lifted(shapes, first)
    try:
        posture = start(shapes, holds, first, lower, upper, random, joint_q)
    except SimulationError as error:
        repairs.append(f"its overlap cannot be checked: {error}")
        shapes, posture = None, start(None, holds, first, lower, upper, random, joint_q)
    weak = _too_weak(apart, posture) if driven and posture.load > 1 else ()
    if weak and len(weak) < model.nv:
        draft.fix(weak, f"the motors of {_few(weak)} cannot hold the weight in any posture tried")
        return _placed(draft, random)
    if posture.always:
        pairs = _few(map(" and ".join, sorted(posture.always)))
        repairs.append(f"{pairs} overlap in every posture and are not checked")
    if (driven or flies) and touches:
        model = apart
        seen = "" if shapes is None else ", and overlap is checked along the plan"
        repairs.append(f"contact is disabled in its time steps (contact=False){seen}")
    if np.any(np.abs(posture.q - model.default_state[: model.nq]) > 1e-9):
        repairs.append("the start is moved to a posture within joint limits, without overlap, that the motors can hold")
    other = apart if model is not apart else None
    return Robot(model, shapes, posture.q, lower, upper, tuple(repairs), chosen, posture.always, apart=other)


def _too_weak(model: Model, posture: StartPosture) -> tuple[str, ...]:
    """Return the joints whose motors are too weak for the posture, and their followers."""
    over = np.flatnonzero(shares_to_hold(model, posture.q) > 1)
    labels = _labels(model)
    moved = [labels[key_of(actuator.joint())] for actuator in actuators(model.plant)]
    return _with_followers(model, [moved[i] for i in model.inputs.actuator[over]])


def _with_followers(model: Model, names: list[str]) -> tuple[str, ...]:
    """Return the joints with their followers."""
    joint_names, mimics = list(names), () if model.coupling is None else model.coupling.mimics
    while more := [m.follower for m in mimics if m.leader in joint_names and m.follower not in joint_names]:
        joint_names += more
    return tuple(joint_names)


def _few(names: Iterable[str]) -> str:
    """Join the names by commas, and shorten a long list."""
    every = list(names)
    more = f" and {len(every) - NAMED} more" if len(every) > NAMED + 1 else ""
    return ", ".join(every[:NAMED] if more else every) + more


def drive(model: Model, q: Array) -> Array:
    """Return the velocity change (nv, nu) per effort in a step from posture q (nq,), from the step's equation."""
    ways = loop_velocities(model, q)
    set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))
    h = model.time_step
    mass = model.double.mass_matrix() + h * np.diag(model.double.damping())
    return np.asarray(h * ways @ np.linalg.solve(ways.T @ mass @ ways, ways.T @ model.actuation))


def steered(model: Model, q: Array) -> NDArray[np.bool_] | None:
    """Return the velocities (nv,) that a motion chooses in posture q (nq,), or None if the inputs cannot produce them.

    These are all velocities or, with loops, those that determine the others, first those with a motor. Joints of loops
    without a motor, as in adaptive grippers, are not chosen.
    """
    ways, chosen = loop_velocities(model, q), independent(model, q)
    if model.file_facts.held_points:
        in_loops = np.linalg.norm(ways @ ways.T - np.eye(model.nv), axis=1) > OUTSIDE
        for _, v in map(model.places, joints(model.plant)):  # a rod between two balls also spins freely
            in_loops[v] = np.any(in_loops[v])
        chosen &= ~in_loops | np.any(model.actuation != 0, axis=1)
    if model.nq != model.nv or not chosen.any() or model.nu < np.sum(chosen):
        return None
    # The forces along velocities in which only one of the chosen is not 0, and the others are as small as possible.
    size = np.linalg.svd((ways @ np.linalg.pinv(ways[chosen])).T @ model.actuation, compute_uv=False)
    return chosen if size[-1] > SMALLEST_DRIVE * size[0] else None


def independent(model: Model, q: Array, preferred: Collection[int] = ()) -> NDArray[np.bool_]:
    """Return the velocities (nv,) that determine all others in posture q (nq,) by the loops; all without loops.

    The first choice are the velocities of the coordinates `preferred`, by index in q, and then those with a motor.
    """
    ways, mask = loop_velocities(model, q), np.zeros(model.nv, dtype=bool)
    if not ways.shape[1]:  # a truss; the lowest SciPy refuses an empty matrix
        return mask
    weights = np.where(np.any(model.actuation != 0, axis=1), DRIVEN_FIRST, 1.0)
    weights[np.isin(places_of_velocities(model), list(preferred))] = DRIVEN_FIRST**2
    _, order = qr((ways * weights[:, None]).T, mode="r", pivoting=True)
    mask[order[: ways.shape[1]]] = True
    return mask


def coordinates_of(model: Model, velocities: NDArray[np.bool_] | None) -> NDArray[np.bool_]:
    """Return whether each coordinate (nq,) belongs to one of the `velocities` (nv,)."""
    mask = np.zeros(model.nq, dtype=bool)
    mask[places_of_velocities(model)[np.zeros(model.nv, dtype=bool) if velocities is None else velocities]] = True
    return mask


def places_of_velocities(model: Model) -> Indices:
    """Return the index in q (nv,) of the coordinate of each joint velocity."""
    indices = np.arange(model.nv)
    for joint in joints(model.plant):
        q, v = model.places(joint)
        if len(q) == len(v) == 1:
            indices[v[0]] = q[0]
    return indices


def start(
    shapes: Model | None,
    driven: Model | None,
    first: Array,
    lower: Array,
    upper: Array,
    random: np.random.Generator,
    fixed: NDArray[np.bool_],
) -> StartPosture:
    """Return the posture `first` (nq,) or a better one: without overlap, and within the motors' effort of `driven`.

    If possible, it has free space in all directions, in which the searches continue.
    `lower` and `upper` (nq,) are the ranges of all coordinates; poses of floating bodies do not change. If there are
    loops, they are closed by all coordinates except the `fixed` (nq,).
    """
    model = shapes or driven
    if model is None:
        return StartPosture(first, 0.0, 0.0, frozenset())
    is_joint, margin = of_joints(model), INSIDE * (upper - lower)

    def drawn(middle: Array, width: Array, moved: NDArray[np.bool_]) -> Array | None:
        q = np.clip(middle + width * random.uniform(-1, 1, len(first)), lower + margin, upper - margin)
        return _closed_within(model, np.where(is_joint & moved, q, middle), fixed, lower, upper)

    every, whole = np.ones(len(first), dtype=bool), upper - lower
    seen = [first, *(drawn(first, whole, every) for _ in range(SEEN - 1))]
    always = pairs_always([q for q in seen if q is not None], shapes)

    def measured(q: Array) -> StartPosture:
        load = 0.0 if driven is None else share_to_hold(driven, q)
        depths = {} if shapes is None else _overlaps(shapes, q)
        overlap = sum(depth for pair, depth in depths.items() if pair not in always and depth > TOUCHING)
        return StartPosture(q, overlap, load, always)

    def has_room(q: Array) -> bool:
        ways = [np.where(is_joint, random.choice([-ROOM, ROOM], len(q)), 0.0) for _ in range(BESIDE)]
        beside = [closed(model, q + way, fixed) for way in ways]
        return shapes is None or all(q is not None and deepest(shapes, q, always) <= TOUCHING for q in beside)

    best, tight = measured(first), None
    for i in range(ATTEMPTS + FINER):
        if i == ATTEMPTS and tight is not None:
            return tight
        if _badness(best) == 0:
            if has_room(best.q):
                break
            tight, best = tight or best, replace(best, overlap=np.inf)  # use it only if all others are worse
        if i < ATTEMPTS:
            fraction = (i + 1) / ATTEMPTS
            q = np.where(is_joint, first + fraction * (random.uniform(lower + margin, upper - margin) - first), first)
            near = _closed_within(model, q, fixed, lower, upper)
        else:
            few = random.random(len(first)) < max(0.1, 3 / len(first))
            near = drawn(best.q, whole * 0.5 ** random.uniform(0, 6), few)
        candidate = best if near is None else measured(near)
        best = candidate if _badness(candidate) < _badness(best) else best
    return best


def _closed_within(model: Model, q: Array, fixed: NDArray[np.bool_], lower: Array, upper: Array) -> Array | None:
    """Return posture q (nq,) with closed loops and unchanged `fixed` (nq,) coordinates, or None beyond joint limits."""
    near, is_joint = closed(model, q, fixed), of_joints(model)
    return near if near is not None and np.all(((lower <= near) & (near <= upper))[is_joint]) else None


def _badness(candidate: StartPosture) -> float:
    return candidate.overlap / DEPTH + max(0.0, candidate.load - HOLD_SHARE)


def pairs_always(tried: list[Array], shapes: Model | None) -> frozenset[Pair]:
    """Return the pairs of shapes that overlap in all of the postures (nq,)."""
    if shapes is None:
        return frozenset()
    overlaps = [{pair for pair, depth in _overlaps(shapes, q).items() if depth > TOUCHING} for q in tried]
    return frozenset(set.intersection(*overlaps))


def deepest(shapes: Model, q: Array, besides: frozenset[Pair]) -> float:
    """Return the deepest overlap [m] in posture q (nq,), ignoring the pairs `besides`."""
    return max((depth for pair, depth in _overlaps(shapes, q).items() if pair not in besides), default=0.0)


def _overlaps(shapes: Model, q: Array) -> dict[Pair, float]:
    set_state(shapes.double, np.concatenate([q, np.zeros(shapes.nv)]))
    return overlaps(shapes)


def share_to_hold(model: Model, q: Array) -> float:
    """Return the largest share of an effort limit that a fully driven robot needs to hold posture q (nq,)."""
    return float(np.max(shares_to_hold(model, q), initial=0.0))


def shares_to_hold(model: Model, q: Array) -> Array:
    """Return the share of each effort limit (nu,) that is needed to hold posture q (nq,)."""
    return shares(model, efforts_for(model, np.concatenate([q, np.zeros(model.nv)]), np.zeros(model.nv)))


def efforts_for(model: Model, x: Array, change: Array) -> Array:
    """Return the efforts (nu,) of a step from x (nx,) that changes the velocities by `change` (nv,), with closed loops.

    They follow from the equation of the step with implicit damping.
    """
    ways = loop_velocities(model, x[: model.nq])
    set_state(model.double, x)
    needed = model.double.inverse_dynamics(change / model.time_step) + model.double.damping() * change
    return np.asarray(np.linalg.lstsq(ways.T @ model.actuation, ways.T @ needed, rcond=None)[0])


def shares(model: Model, efforts: Array) -> Array:
    """Return efforts (..., nu) as shares of the effort limits, and 0 for inputs without a limit."""
    limits = model.effort_limits
    return np.asarray(np.abs(efforts) / np.where((limits > 0) & np.isfinite(limits), limits, np.inf))


def of_joints(model: Model) -> NDArray[np.bool_]:
    """Return whether each coordinate (nq,) belongs to a joint and not to the pose of a floating body."""
    if model.nq == model.nv:
        return np.ones(model.nq, dtype=bool)
    mask = np.zeros(model.nq, dtype=bool)
    for joint in joints(model.plant):
        if joint.num_positions() == 1:
            mask[list(model.places(joint)[0])] = True
    return mask


def inside(model: Model, lower: Array, upper: Array) -> Array:
    """Return the file's posture, with joints outside their limits at the middle, and joints at a limit moved inside."""
    q = model.default_state[: model.nq].copy()
    margin = INSIDE * (upper - lower)
    outside = (q < lower) | (q > upper)
    moved = np.where(outside, (lower + upper) / 2, np.clip(q, lower + margin, upper - margin))
    return np.where(of_joints(model), moved, q)


def thrusters(model: Model) -> tuple[BodyForce, ...]:
    """Return six thrusters for each floating body: two along each axis, on both sides of its centre of mass.

    Together they can produce any force and moment. The distance of each from the centre of mass is the body's radius
    of gyration.
    """
    plant, forces = model.plant, list[BodyForce]()
    set_state(model.double, model.default_state)
    for label, body in labelled(bodies(plant)).items():
        if body.index() not in plant.GetFloatingBaseBodies():
            continue
        whole = [welded.index() for welded in plant.GetBodiesWeldedTo(body)]
        inertia = plant.CalcSpatialInertia(model.double.context, body.body_frame(), whole)
        mass, centre = float(inertia.get_mass()), np.asarray(inertia.get_com())
        if not mass > 0:
            raise ModelError(f"{label} floats, nothing drives it, and it has no mass: give it an inertial element")
        about = inertia.Shift(centre).CalcRotationalInertia().CopyToFullMatrix3()
        arm = max(SMALLEST_ARM, float(np.sqrt(np.max(np.linalg.eigvalsh(about)) / mass)))
        limit = float(f"{STRENGTH * mass * GRAVITY:.3g}")
        for axis, beside in ((0, 1), (1, 2), (2, 0)):
            for side in (1.0, -1.0):
                point = centre + side * float(f"{arm:.3g}") * np.eye(3)[beside]
                name = f"{label}_{'xyz'[axis]}{'+' if side > 0 else '-'}"
                forces.append(BodyForce(name, label, point, np.eye(3)[axis], lower=-limit, upper=limit))
    return tuple(forces)


def lifted(shapes: Model, q: Array) -> Array:
    """Return posture q (nq,) with floating bodies lifted until nothing overlaps, or q itself if no lift helps."""
    for up in (0.0, *LIFTS):
        higher = q.copy()
        for i, (_, q_start, _) in enumerate(floating(shapes)):
            higher[q_start + 6] += up * (1 + i)
        if deepest(shapes, higher, frozenset()) <= TOUCHING:
            return higher
    return q


def floating(model: Model) -> list[tuple[str, int, int]]:
    """Return (name, start of the pose in q, start of the velocities in v) of each floating body."""
    free = [model.plant.get_body(index) for index in sorted(model.plant.GetFloatingBaseBodies())]
    return [(b.name(), int(b.floating_positions_start()), int(b.floating_velocities_start_in_v())) for b in free]
