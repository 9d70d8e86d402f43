"""Shapes of a robot that overlap wherever its joints are: the cover of a joint, a rotor inside the trunk.

Their contact pushes in every step, and says nothing of what the robot meets. As a rule files forget to filter them.
"""

from typing import Any

import numpy as np
from pydrake import geometry as pg
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.framework import Diagram

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError
from drake_diff.model.plant import joints

POSTURES = 100  # beside the default one
FIRST = 10  # of them, in which a pair has to overlap once
FLUSH = 1e-9  # [m]
REACH = 4.0  # [m or rad] of a joint without limits, and of a free body
TOLD = 6  # pairs of links named in a sentence
Pairs = tuple[tuple[Any, Any], ...]


def inseparable_pairs(plant: MultibodyPlant, diagram: Diagram) -> Pairs:
    """The pairs of geometries that overlap at the default positions and in 100 seeded postures within the limits.

    What is flush counts, as there rounding decides. Joints that follow others move freely here, and free bodies are
    anywhere. Raises ModelError where Drake cannot tell what overlaps.
    """
    root, random = diagram.CreateDefaultContext(), np.random.default_rng(0)
    context, port = plant.GetMyMutableContextFromRoot(root), plant.get_geometry_query_input_port()
    if not port.HasValue(context):
        return ()
    postures = [plant.GetPositions(context)] + [_posture(plant, random) for _ in range(POSTURES)]
    pairs: set[tuple[Any, Any]] = set()
    for k, q in enumerate([*postures[:FIRST], *postures]):
        plant.SetPositions(context, q)
        query = port.Eval(context)
        try:
            here = {tuple(sorted((contact.id_A, contact.id_B))) for contact in query.ComputePointPairPenetration()}
        except RuntimeError as error:
            raise ModelError(f"Drake cannot tell which shapes overlap: {error}") from error
        pairs = pairs | here if k < FIRST else {pair for pair in pairs if pair in here or _are_flush(query, *pair)}
        if not pairs and k >= FIRST:
            break
    return tuple(sorted(pairs))


def _are_flush(query: Any, a: Any, b: Any) -> bool:
    """Whether two geometries that do not overlap touch, to rounding; no where Drake does not measure such shapes."""
    try:
        return bool(query.ComputeSignedDistancePairClosestPoints(a, b).distance <= FLUSH)
    except RuntimeError:
        return False


def _posture(plant: MultibodyPlant, random: np.random.Generator) -> Array:
    """(nq,) positions within the limits; quaternions of unit norm."""
    lower, upper = plant.GetPositionLowerLimits(), plant.GetPositionUpperLimits()
    middle = np.clip(0.0, lower, upper)
    lower, upper = np.maximum(lower, middle - REACH), np.minimum(upper, middle + REACH)
    q = np.array(random.uniform(lower, upper))
    for joint in joints(plant):
        if joint.type_name() == "quaternion_floating":
            start = joint.position_start()
            q[start : start + 4] = random.standard_normal(4)
            q[start : start + 4] /= np.linalg.norm(q[start : start + 4])
    return q


def links_of(plant: MultibodyPlant, scene_graph: pg.SceneGraph, pairs: Pairs) -> str:
    """The links of the pairs, for a sentence: each two once, and how many more there are."""
    inspector = scene_graph.model_inspector()
    names = (
        " - ".join(sorted(str(plant.GetBodyFromFrameId(inspector.GetFrameId(g)).name()) for g in pair))
        for pair in pairs
    )
    links = list(dict.fromkeys(names))
    return ", ".join(links[:TOLD]) + (f" and {len(links) - TOLD} more" if len(links) > TOLD else "")


def touch_what_can_separate(plant: MultibodyPlant, scene_graph: pg.SceneGraph, diagram: Diagram) -> tuple[str, ...]:
    """Filter what overlaps in every posture; to be called when the diagram is built, before it has contexts in use."""
    pairs = inseparable_pairs(plant, diagram)
    for a, b in pairs:
        apart = pg.CollisionFilterDeclaration().ExcludeBetween(pg.GeometrySet([a]), pg.GeometrySet([b]))
        scene_graph.collision_filter_manager().Apply(apart)
    if not pairs:
        return ()
    number = f"{len(pairs)} pairs of shapes pass" if len(pairs) > 1 else "One pair of shapes passes"
    return (
        f"{number} through each other, as they overlap wherever the joints are: {links_of(plant, scene_graph, pairs)}.",
    )
