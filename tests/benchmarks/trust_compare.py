"""Count how often `compare` detects an engine with another model and the reason, and its false alarms.

A mismatch is one changed number in the model of an engine: in the MJCF that MuJoCo reads, or in the plant from which
another engine is built. Every second mismatch concerns contact. Models without a change are also built and must hold.
"""

import warnings
from importlib.util import find_spec
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from helpers.robots import example_robot, state_in_contact, state_in_range
from trust import Figure

import drake_diff as dd
from drake_diff.engines.mujoco import generated
from drake_diff.exceptions import ModelWarning
from drake_diff.mechanics.description import describe

COUNT = 40
STEPS = 8
MODELS = Path(__file__).parents[2] / "models"
FREE = ("pendulum.urdf", "double_pendulum.urdf", "cart_pole.urdf", "acrobot.xml", "ur5_robot.urdf", "z1.urdf")
TOUCHING = ("sphere_on_ground.sdf", "sliding_block.sdf", "hopper.sdf", "solo12.urdf", "bolt.urdf")
# Terms that follow from another mass or position of a link. MuJoCo computes contact stiffness from masses.
TERMS = {"M(q)", "bias(q, v)"}
SOFTNESS = {"stiffness", "dissipation", "other contact terms"}
FOLLOWS = {
    "mass": {"center of mass", "inertia", *TERMS, *SOFTNESS},
    "inertia": {*TERMS, *SOFTNESS},
    "center of mass": {"inertia", *TERMS, *SOFTNESS},
    "frames": {"center of mass", "inertia", "poses", *TERMS, *SOFTNESS},
    "armature": {*TERMS, *SOFTNESS},
    "gravity": TERMS,
    "springs": TERMS,
    "shapes": {"poses"},
    "stiffness": {"dissipation", "other contact terms"},
    "contact pairs": {"shapes", "poses"},
}


class Edit(NamedTuple):
    """A change of an attribute in the elements of an MJCF, and the line of the contract that must fail."""

    path: str
    attribute: str
    change: str
    quantity: str


OF_LINKS = (
    Edit(".//body/inertial", "mass", "scale", "mass"),
    Edit(".//body/inertial", "diaginertia", "scale", "inertia"),
    Edit(".//body/inertial", "pos", "shift", "center of mass"),
    Edit(".//body/joint", "axis", "turn", "frames"),
    Edit(".//body/joint", "damping", "add", "damping"),
    Edit(".//body/joint", "armature", "add", "armature"),
    Edit(".//body/joint", "range", "scale", "position limits"),
    Edit(".//body/joint", "stiffness", "add", "springs"),
    Edit(".//actuator/motor", "gear", "scale", "actuator mapping"),
    Edit(".//actuator/motor", "forcerange", "scale", "effort limits"),
    Edit("./option", "gravity", "scale", "gravity"),
    Edit("./option", "timestep", "scale", "time step"),
)
OF_CONTACT = (
    Edit(".//contact/pair", "friction", "scale", "friction"),
    Edit(".//contact/pair", "friction", "small", "friction"),
    Edit(".//contact/pair", "condim", "1", "friction"),
    Edit(".//contact/pair", "solref", "scale", "stiffness"),
    Edit(".//contact/pair", "solref", "second", "dissipation"),
    Edit(".//contact/pair", "solref", "0.02 1", "stiffness"),
    Edit(".//contact/pair", "solimp", "0.9 0.95 0.001", "stiffness"),
    Edit(".//contact/pair", "margin", "add", "contact margin"),
    Edit(".//contact/pair", "", "remove", "contact pairs"),
    Edit(".//geom", "size", "scale", "shapes"),
    Edit(".//geom", "pos", "shift", "poses"),
    Edit(".//geom[@type='plane']", "pos", "up", "poses"),
    Edit(".//geom[@type='plane']", "", "remove", "contact pairs"),
)


class Case(NamedTuple):
    model: dd.Model
    engine: object
    quantity: str  # the changed quantity, or ""
    said: str


def measure(seed: int, count: int) -> list[Figure]:
    found = named = alarms = 0
    for i in range(count):
        case = mismatch(np.random.default_rng([seed, i]), touching=i % 2 == 1)
        passed, broken, sentence = judged(case, np.random.default_rng([seed, i, 1]))
        right = case.quantity in broken and broken <= {case.quantity, *FOLLOWS.get(case.quantity, ())}
        found, named = found + (not passed), named + right
        if passed or not right:
            print(f"  missed: {case.said}, {case.quantity}: {sorted(broken)}: {sentence[:300]}", flush=True)
    for i in range(count // 2):
        case = same_model(np.random.default_rng([seed, i, 2]), touching=i % 2 == 1)
        passed, broken, sentence = judged(case, np.random.default_rng([seed, i, 3]))
        alarms += not passed
        if not passed:
            print(f"  false alarm: {case.said}: {sorted(broken)}: {sentence[:300]}", flush=True)
    return [
        Figure("mismatches found", found, count, 1.0, True),
        Figure("mismatches with the right reason", named, count, 0.95, True),
        Figure("false alarms on right models", alarms, count // 2, 0.0, False),
    ]


def judged(case: Case, random: np.random.Generator) -> tuple[bool, set[str], str]:
    """Return whether the case passes `compare`, the broken lines of the contract, and the message."""
    x = state_of(case.model, random)
    us = np.tile(0.5 * random.standard_normal(case.model.nu), (STEPS, 1))
    result = dd.compare(case.model, [case.engine], x0=x, us=us, seed=int(random.integers(1000)))
    if result.refused:
        return False, set(), result.refused[0].reason
    other = result.engines[1]
    return result.holds, {line.quantity for line in other.broken}, other.sentence


def state_of(model: dd.Model, random: np.random.Generator) -> np.ndarray:
    """Return a random state, in contact with the ground if the model supports it, or with a joint near its limit."""
    if model.plant.GetFloatingBaseBodies() and model.contract.contact.collision_pairs:
        if model.nu:
            return state_in_contact(model, random)
        x = np.array(model.default_state)
        x[6] -= float(random.uniform(0, 1e-3))
        x[7:] = 0.2 * random.standard_normal(6)
        return x
    x = state_in_range(model, random)
    lower, upper = model.plant.GetPositionLowerLimits(), model.plant.GetPositionUpperLimits()
    limited = np.flatnonzero(np.isfinite(lower) & np.isfinite(upper))
    if len(limited) and random.random() < 0.5:
        i = int(random.choice(limited))
        x[i], x[model.nq + i] = upper[i] - 1e-4, abs(random.standard_normal())
    return x


def load(name: str, time_step: float, approximation: str = "lagged", **changes: float) -> dd.Model:
    """Load a file of models/, or a robot of example-robot-data with `changes` of its feet."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ModelWarning)
        if (MODELS / name).exists():
            return dd.load_model(MODELS / name, time_step=time_step, contact_approximation=approximation)
        return example_robot(name, time_step, approximation=approximation, feet=name in TOUCHING, **changes)


def built(engine: str, model: dd.Model) -> object:
    """Return the engine of this name. The approximation in the name of Drake's engine is that of `model`."""
    return dd.engines.load_engine(engine.split(":")[0], model)


def mismatch(random: np.random.Generator, *, touching: bool) -> Case:
    name = str(random.choice(TOUCHING if touching else FREE))
    model = load(name, float(random.choice([0.001, 0.002, 0.005])))
    engines = ["mujoco", "mujoco", *others(model)]
    engine = str(random.choice(engines))
    if engine == "mujoco":
        return edited(random, name, model, OF_CONTACT if touching else OF_LINKS)
    return rebuilt(random, name, model, engine, touching=touching)


def others(model: dd.Model) -> list[str]:
    """Return the engines other than MuJoCo that support the model."""
    touches = model.contract.contact.collision_pairs > 0
    modules = {"newton": "newton", "pybullet": "pybullet", "sapien": "sapien"}
    installed = [engine for engine, module in modules.items() if find_spec(module)]
    rotors = any(link.armature for link in describe(model).links)
    if rotors:  # Bullet does not support armature
        installed = [engine for engine in installed if engine != "pybullet"]
    return ["drake:sap", "drake:similar", *installed] if touches else ["drake", "pinocchio", "casadi", *installed]


def edited(random: np.random.Generator, name: str, model: dd.Model, edits: tuple[Edit, ...]) -> Case:
    """Return a case of MuJoCo with the model's own MJCF, in which one attribute is changed."""
    text = generated(describe(model), model.time_step)
    for i in random.permutation(len(edits)):
        edit = edits[int(i)]
        root = ElementTree.fromstring(text)
        if said := make(random, root, edit):
            engine = on_mjcf(model, ElementTree.tostring(root, encoding="unicode"))
            return Case(model, engine, edit.quantity, f"{name} in MuJoCo, {said}")
    raise AssertionError(f"{name}: nothing to change")


def make(random: np.random.Generator, root: ElementTree.Element, edit: Edit) -> str:
    """Make the change and return its description, or "" if there is nothing to change or no effect."""
    pairs = root.findall(".//contact/pair")
    elements = changeable(root, edit)
    if not elements:
        return ""
    element = elements[int(random.integers(len(elements)))]
    where = element.get("name") or element.get("geom1") or element.tag
    if edit.change == "remove":
        parent = next(e for e in root.iter() if element in list(e))
        parent.remove(element)
        for pair in pairs if element.tag == "geom" else []:
            if where in (pair.get("geom1"), pair.get("geom2")):
                root.find("contact").remove(pair)
        return f"{where} removed"
    old = element.get(edit.attribute) or "0"
    new = changed(random, np.array(old.split(), dtype=float), edit.change)
    if new == old:
        return ""
    element.set(edit.attribute, new)
    return f"{edit.attribute} of {where} from {old} to {new}"


def changeable(root: ElementTree.Element, edit: Edit) -> list[ElementTree.Element]:
    """Return the elements whose change affects the model: of moving bodies, and of shapes in contact pairs."""
    elements = [e for e in root.findall(edit.path) if not edit.attribute or e.get(edit.attribute)]
    if edit.change == "add":
        elements = root.findall(edit.path)
    pairs = root.findall(".//contact/pair")
    if edit.path.startswith(".//geom"):
        touching = {e.get(side) for e in pairs for side in ("geom1", "geom2")}
        elements = [e for e in elements if e.get("name") in touching]
        if edit.attribute == "size" or edit.change == "shift":
            elements = [e for e in elements if e.get("type") != "plane"]
    if edit.quantity in ("mass", "inertia", "center of mass"):  # moving bodies, if their mass has an effect
        fixed = {e for body in root.findall("./worldbody/body") for e in still(body)}
        elements = [e for e in elements if e not in fixed and float(e.get("mass")) > 1e-3]
    if edit.attribute == "diaginertia":
        elements = [e for e in elements if min(map(float, e.get("diaginertia").split())) > 1e-9]
    return elements


def still(body: ElementTree.Element) -> list[ElementTree.Element]:
    """Return the inertias of a body that is fixed to the world, and of the bodies that are fixed to it."""
    if body.findall("joint") or body.findall("freejoint"):
        return []
    return [*body.findall("inertial"), *(e for child in body.findall("body") for e in still(child))]


def changed(random: np.random.Generator, old: np.ndarray, change: str) -> str:
    factor = float(np.exp(random.choice([-1, 1]) * random.uniform(0.01, 0.5)))
    if change == "scale":
        new = old * factor
    elif change == "second":
        new = old * [1.0, factor]
    elif change == "small":
        new = np.where(old > 0, 0.01, 0.0)
    elif change == "add":
        new = old + random.uniform(0.01, 0.1)
    elif change == "up":
        new = old + np.array([0.0, 0.0, 0.01])
    elif change == "shift":
        new = old + 0.01 * random.standard_normal(3)
    elif change == "turn":
        new = old + 0.05 * random.standard_normal(3)
    else:
        return change
    return " ".join(repr(float(value)) for value in new)


def on_mjcf(model: dd.Model, text: str) -> object:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "model.xml"
        path.write_text(text)
        return dd.engines.load_engine("mujoco", model, path=path)


def rebuilt(random: np.random.Generator, name: str, model: dd.Model, engine: str, *, touching: bool) -> Case:
    """Return a case of another engine, built from the same plant with one number changed."""
    factor = float(np.exp(random.choice([-1, 1]) * random.uniform(0.01, 0.5)))
    time_step, other = model.time_step, None
    approximation = engine.split(":")[1] if ":" in engine else "lagged"
    if touching and not (MODELS / name).exists():
        numbers = {"friction": 0.6, "stiffness": 2e4, "dissipation": 0.5}
        numbers = {k: v for k, v in numbers.items() if engine.startswith("drake") or k != "dissipation"}
        numbers = {k: v for k, v in numbers.items() if engine != "sapien" or k == "friction"}
        quantity = str(random.choice(sorted(numbers)))
        other = load(name, time_step, approximation, **{quantity: numbers[quantity] * factor})
    elif touching:
        factor = min(factor, 1 / factor)  # dynamic friction is not above static friction
        tags = {"radius": "shapes", "drake:mu_dynamic": "friction", "drake:point_contact_stiffness": "stiffness"}
        if engine == "sapien":
            del tags["drake:point_contact_stiffness"]
        tag = str(random.choice(sorted(tags)))
        quantity = tags[tag]
        other = with_number(name, time_step, approximation, tag, factor)
    else:
        quantity = str(random.choice(["gravity", "time step"]))
        if quantity == "gravity":
            gravity = tuple(factor * g for g in model.plant.gravity_field().gravity_vector())
            other = model.changed(gravity=gravity) if model.can_rebuild else None
        if quantity == "time step" or other is None:
            quantity, other = "time step", load(name, time_step * factor)
    return Case(model, built(engine, other), quantity, f"{name} in {engine}, {quantity} by {factor:.3g}")


def with_number(name: str, time_step: float, approximation: str, tag: str, factor: float) -> dd.Model:
    """Load a file of models/ with the last number of this tag multiplied by `factor`."""
    text = (MODELS / name).read_text()
    before, rest = text.rsplit(f"<{tag}>", 1)
    number, after = rest.split("<", 1)
    with TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_text(f"{before}<{tag}>{float(number) * factor!r}<{after}")
        return dd.load_model(path, time_step=time_step, contact_approximation=approximation)


def same_model(random: np.random.Generator, *, touching: bool) -> Case:
    """Return a case of an engine with the same model, which for MuJoCo may be an MJCF in another order and naming."""
    name = str(random.choice(TOUCHING if touching else FREE))
    model = load(name, float(random.choice([0.001, 0.002, 0.005])))
    engine = str(random.choice(["mujoco", "own MJCF", *others(model)]))
    if engine != "own MJCF":
        other = load(name, model.time_step, engine.split(":")[1]) if ":" in engine else model
        return Case(model, built(engine, other), "", f"{name} in {engine}")
    root = ElementTree.fromstring(generated(describe(model), model.time_step))
    new = {e.get("name"): f"shape_{i}" for i, e in enumerate(root.findall(".//geom"))}
    for geom in root.findall(".//geom"):
        geom.set("name", new[geom.get("name")])
    for pair in root.findall(".//contact/pair"):
        pair.set("geom1", new[pair.get("geom1")])
        pair.set("geom2", new[pair.get("geom2")])
    root.find("worldbody")[:] = reversed(list(root.find("worldbody")))
    engine = on_mjcf(model, ElementTree.tostring(root, encoding="unicode"))
    return Case(model, engine, "", f"{name} in MuJoCo, bodies in another order, geometries by other names")
