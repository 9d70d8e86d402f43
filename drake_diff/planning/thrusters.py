"""Bodies that float and that nothing in their file drives, such as a drone's base: thrusters, and a place to begin."""

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import ModelError
from drake_diff.model.inputs import BodyForce
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, labelled
from drake_diff.model.step import set_state
from drake_diff.planning.posture import TOUCHING, deepest

STRENGTH = 1.5  # of the weight: what one thruster has, of the two along each axis
SMALLEST_ARM = 0.01  # [m]
GRAVITY = 9.81  # [m/s^2] that the weight is reckoned with, also where a model has none
LIFTS = (0.1, 0.2, 0.5, 1.0, 2.0)  # [m] of a body that begins inside something


def thrusters(model: Model) -> tuple[BodyForce, ...]:
    """Six for each body that floats: two along each of its axes, on both sides of its centre of mass.

    Together they can push and turn it in any direction. Each is beside the centre of mass by the body's radius of
    gyration.
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
    """Posture q (nq,) with what floats as much higher as it takes to overlap with nothing; as it is if none helps."""
    for up in (0.0, *LIFTS):
        higher = q.copy()
        for i, (_, q_start, _) in enumerate(floating(shapes)):
            higher[q_start + 6] += up * (1 + i)
        if deepest(shapes, higher, frozenset()) <= TOUCHING:
            return higher
    return q


def floating(model: Model) -> list[tuple[str, int, int]]:
    """(name, where its quaternion and position begin in q, where its velocities begin in v) of what floats."""
    free = [model.plant.get_body(index) for index in sorted(model.plant.GetFloatingBaseBodies())]
    return [(b.name(), int(b.floating_positions_start()), int(b.floating_velocities_start_in_v())) for b in free]
