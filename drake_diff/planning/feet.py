"""Which limbs of a floating robot can carry it: those that end in what is lowest, and can be drawn in."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydrake.geometry import Sphere
from pydrake.multibody.tree import BodyIndex, JacobianWrtVariable

from drake_diff._base.arrays import Array, Indices
from drake_diff._base.values import Refusal
from drake_diff.model.contact_geometry import collision_geometries
from drake_diff.model.model import Model
from drake_diff.model.plant import FLOATING, bodies, joints, proximity_property
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

FEWEST = 2  # feet: what stands on one is held by no posture of ours
LEVEL = (
    0.15  # of the height of the centre of mass over the ground: limbs whose ends are within that of the lowest are legs
)
FLAT = 5e-3  # [m] points of a foot that are within that of its lowest one are its sole
TRAVEL = 0.1  # of that height: how far an end has to move up and down for its limb to be a leg
DRAWN = 60  # postures in which that is looked at


@dataclass(frozen=True, eq=False)
class Foot:
    """What a leg ends in: spheres fixed to a body, and those of them that are its sole.

    Attributes:
        bodies: The names of the bodies that are fixed to each other there.
        frame: The frame of one of them.
        centres: (k, 3) [m] of the spheres in that frame.
        radii: (k,) [m].
        friction: The coefficient between it and the ground.
        joints: Where the joints between the base and it are in v, and so in the tangent space.
        sole: Which of the spheres it stands on; one or two of them cannot carry a torque about the foot.
    """

    bodies: tuple[str, ...]
    frame: Any
    centres: Array
    radii: Array
    friction: float
    joints: tuple[int, ...]
    sole: Indices

    @property
    def name(self) -> str:
        """That of the body which has the first of the spheres."""
        return str(self.frame.body().name())

    @property
    def is_flat(self) -> bool:
        """Whether the sole is a face, which turns the foot as it lies on the ground."""
        middle = self.centres[self.sole] - np.mean(self.centres[self.sole], axis=0)
        return len(middle) > 2 and bool(np.linalg.svd(middle, compute_uv=False)[1] > FLAT)


def find_feet(model: Model, q: Array) -> tuple[Foot, ...] | Refusal:
    """The feet of a robot whose base floats, as it stands upright in the file's posture q (nq,); or why it has none."""
    if len(model.plant.GetFloatingBaseBodies()) != 1:
        return Refusal(f"{len(model.plant.GetFloatingBaseBodies())} bodies float")
    candidates = limbs(model)
    if len(candidates) < FEWEST:
        return Refusal(
            f"{len(candidates) or 'none'} of its limbs {'ends' if len(candidates) == 1 else 'end'} in a shape"
        )
    upright(model, q)
    heights = np.array([_lowest(model, limb) for limb in candidates])
    ground = float(np.min(heights))
    if _lowest_of_all(model) < ground - FLAT:
        return Refusal("what is lowest of it is not the end of a limb")
    tall = float(center_of_mass(model)[0][2]) - ground
    lower = [body.name() for body in bodies(model.plant) if _pose(model, body).translation()[2] < ground - LEVEL * tall]
    if lower:
        return Refusal(f"{lower[0]} is below all that could touch the ground, and has no shape")
    low = [limb for limb, height in zip(candidates, heights, strict=True) if height - ground <= LEVEL * tall]
    legs = [_with_sole(model, limb) for limb in low]
    drawn = sum(_travel(model, q, limb) >= TRAVEL * tall for limb in low)
    if drawn < max(FEWEST, len(low)):
        return Refusal(f"{drawn or 'none'} of the {len(low)} limbs that end lowest can be drawn in")
    return tuple(legs)


def upright(model: Model, q: Array) -> None:
    """Put posture q (nq,) into the twin, at rest."""
    set_state(model.double, np.concatenate([q, np.zeros(model.nv)]))


def limbs(model: Model) -> list[Foot]:
    """The last bodies with spheres of the chains of joints, from the base out."""
    plant, inspector = model.plant, model.double.inspector
    spheres = dict[int, list[Any]]()
    for body, geometry in collision_geometries(plant, model.double.scene_graph) if inspector else ():
        if isinstance(inspector.GetShape(geometry), Sphere):
            spheres.setdefault(int(body.index()), []).append(geometry)
    group = {int(b.index()): {int(w.index()) for w in plant.GetBodiesWeldedTo(b)} for b in bodies(plant)}
    moving = [joint for joint in joints(plant) if joint.num_velocities() and joint.type_name() not in FLOATING]
    before = {i: joint for joint in moving for i in group[int(joint.child_body().index())]}
    parents = {i for joint in moving for i in group.get(int(joint.parent_body().index()), ())}
    feet, seen = [], set[frozenset[int]]()
    for last in moving:
        if group[int(last.child_body().index())] & parents:
            continue
        chain = [last]
        while int(chain[-1].parent_body().index()) in before:
            chain.append(before[int(chain[-1].parent_body().index())])
        ends = [group[int(j.child_body().index())] for j in chain]
        end = next((frozenset(e) for e in ends if any(i in spheres for i in e)), None)
        if end is None or end in seen:
            continue
        seen.add(end)
        velocities = tuple(i for j in chain for i in model.places(j)[1])
        feet.append(_end(model, end, spheres, velocities))
    return feet


def _end(model: Model, rigid: frozenset[int], spheres: dict[int, list[Any]], velocities: tuple[int, ...]) -> Foot:
    """The spheres on bodies that are welded together, all in the frame of the first with some."""
    plant, inspector = model.plant, model.double.inspector
    those = [plant.get_body(BodyIndex(i)) for i in sorted(rigid) if i in spheres]
    first, context = those[0], model.double.context
    centres, radii, frictions = [], [], []
    for body in those:
        pose = plant.CalcRelativeTransform(context, first.body_frame(), body.body_frame())
        for geometry in spheres[int(body.index())]:
            centres.append(pose.multiply(inspector.GetPoseInFrame(geometry).translation()))
            radii.append(inspector.GetShape(geometry).radius())
            frictions.append(proximity_property(inspector, geometry, "friction") or 0.0)
    everything = np.arange(len(radii))
    names = tuple(str(plant.get_body(BodyIndex(i)).name()) for i in sorted(rigid))
    return Foot(names, first.body_frame(), np.array(centres), np.array(radii), min(frictions), velocities, everything)


def _with_sole(model: Model, end: Foot) -> Foot:
    """The foot whose sole is what is lowest of it now."""
    height = bottoms(model, end)[0][:, 2]
    return replace(end, sole=np.flatnonzero(height - np.min(height) <= FLAT))


def _lowest(model: Model, foot: Foot) -> float:
    return float(np.min(bottoms(model, foot)[0][:, 2]))


def _lowest_of_all(model: Model) -> float:
    """[m] the lowest point of all spheres that move."""
    fixed = {int(body.index()) for body in model.plant.GetBodiesWeldedTo(model.plant.world_body())}
    inspector, heights = model.double.inspector, [np.inf]
    for body, geometry in collision_geometries(model.plant, model.double.scene_graph):
        if int(body.index()) not in fixed and isinstance(inspector.GetShape(geometry), Sphere):
            centre = _pose(model, body).multiply(inspector.GetPoseInFrame(geometry).translation())
            heights.append(float(centre[2]) - inspector.GetShape(geometry).radius())
    return min(heights)


def _pose(model: Model, body: Any) -> Any:
    return model.plant.EvalBodyPoseInWorld(model.double.context, body)


def _travel(model: Model, q: Array, limb: Foot) -> float:
    """[m] how far the end of a limb moves up and down where its joints move alone, in postures at random."""
    random, space = np.random.default_rng(0), tangent_space(model)
    x, heights = np.concatenate([q, np.zeros(model.nv)]), []
    for _ in range(DRAWN):
        turned = np.zeros(space.size)
        turned[list(limb.joints)] = random.uniform(-1.5, 1.5, len(limb.joints))
        upright(model, space.plus(x, turned)[: model.nq])
        heights.append(_lowest(model, limb))
    upright(model, q)
    return float(np.ptp(heights))


def center_of_mass(model: Model) -> tuple[Array, Array]:
    """(3,) [m] the centre of mass in the twin's state, and (3, nv) how it moves."""
    twin = model.double
    plant, context, world = twin.plant, twin.context, twin.plant.world_frame()
    centre = plant.CalcCenterOfMassPositionInWorld(context)
    jacobian = plant.CalcJacobianCenterOfMassTranslationalVelocity(context, JacobianWrtVariable.kV, world, world)
    return np.asarray(centre), own_velocities(model, jacobian)


def own_velocities(model: Model, jacobian: Array) -> Array:
    """A Jacobian by the velocities of the model, of which the plant may have more."""
    coupling = model.double.coupling
    return np.asarray(jacobian if coupling is None else jacobian @ coupling.spread)


def bottoms(model: Model, foot: Foot, which: Indices | None = None) -> tuple[Array, Array]:
    """(k, 3) [m] the lowest points of spheres of a foot in the twin's state, and (3 k, nv) how they move."""
    twin = model.double
    chosen = np.arange(len(foot.radii)) if which is None else which
    plant, context, world = twin.plant, twin.context, twin.plant.world_frame()
    frame = plant.get_frame(foot.frame.index())
    centres = foot.centres[chosen].T
    places = plant.CalcPointsPositions(context, frame, centres, world).T.copy()
    places[:, 2] -= foot.radii[chosen]
    jacobian = plant.CalcJacobianTranslationalVelocity(context, JacobianWrtVariable.kV, frame, centres, world, world)
    return places, own_velocities(model, jacobian)
