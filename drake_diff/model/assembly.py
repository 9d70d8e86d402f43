"""Configurations with closed kinematic loops, in which the two points of each pair coincide."""

from collections.abc import Collection

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.tree import BodyIndex
from scipy.linalg import null_space

from drake_diff._base.arrays import Array, finite_array
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.model.loops import APART, relative_motion
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

CLOSED = 1e-9  # relative to the distance of the points from the origins of their bodies
OPEN = 1e-2  # relative to the same distance; a step from there closes the loop with a jerk
MOST = 50  # iterations of Newton's method, which needs fewer than ten if the loops can be closed
LONGEST = 0.5  # [rad or m] step length; longer steps miss the nearby configuration
DEPENDENT = 1e-6  # relative to the largest singular value; rows that differ by less constrain the same motion


def gap(model: Model, q: ArrayLike) -> tuple[float, float]:
    """Return the largest gap [m] of a loop in configuration q (nq,), and a length [m] to compare it with.

    The length is the largest distance between a loop's first point and the origin of its body, or the extent of the
    origins of the loops' bodies and their parents. The other points of a loop only define its axes. Their gap is the
    angle between them and the first point, times this length, so that the ratio does not depend on the unit.
    """
    held = model.file_facts.held_points
    set_state(model.double, np.concatenate([finite_array("q", q, (model.nq,)), np.zeros(model.nv)]))
    _, differences = relative_motion(model.plant, model.double.context, held)
    bodies = {int(index) for pair in held for index in pair.bodies}
    carried = [j for j in joints(model.plant) if int(j.child_body().index()) in bodies]
    bodies |= {int(j.parent_body().index()) for j in carried} - {int(model.plant.world_body().index())}
    poses = [model.plant.EvalBodyPoseInWorld(model.double.context, model.plant.get_body(BodyIndex(i))) for i in bodies]
    extent = float(np.linalg.norm(np.ptp([pose.translation() for pose in poses], axis=0))) if poses else 0.0
    first: dict[tuple[int, ...], int] = {}
    for i, pair in enumerate(held):
        first.setdefault(tuple(map(int, pair.bodies)), i)
    origins = [first[tuple(map(int, pair.bodies))] for pair in held]
    lengths = [float(np.linalg.norm(point)) for i in first.values() for point in held[i].points]
    size, gaps = max([extent, *lengths], default=0.0) or APART, [0.0]
    for i, origin in enumerate(origins):
        way = float(np.linalg.norm(np.subtract(held[i].points[0], held[origin].points[0])))
        off = float(np.linalg.norm(differences[i] - differences[origin]))
        gaps.append(size * off / way if way > 0 else float(np.linalg.norm(differences[i])))
    return max(gaps), size


def check_closed(model: Model, subject: str, x: Array) -> None:
    """Raise InputError if a loop of the model is open in the state x (nx,)."""
    distance, size = gap(model, x[: model.nq]) if model.file_facts.held_points else (0.0, 0.0)
    if distance > OPEN * size:
        expected = f"closed loops, as in dd.model.assembled(model, {subject})"
        raise InputError(subject, got=f"{distance:.3g} m between two points that a loop connects", expected=expected)


def assembled(model: Model, x: ArrayLike, *, keep: Collection[str] = ()) -> Array:
    """Close the loops of a model near the state `x`, as <connect> in MJCF does, without changing the velocities.

    Args:
        model: Any model; without loops, the result is `x`.
        x: (nx,) The initial guess.
        keep: The names of the positions, as in `Model.state_names`, that must not change, usually those of motors.

    Returns:
        (nx,) The state from Newton's method. Each step is the least change, and floating bases move only if necessary.

    Raises:
        UnknownNameError: A name in `keep` is not the name of a position.
        ModelError: The loops cannot be closed from this initial guess.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> dd.model.assembled(model, [0.3, 0.0])
        array([0.3, 0. ])
    """
    state = np.array(finite_array("x", x, (model.nx,)))
    for name in keep:
        if name not in model.position_names:
            raise UnknownNameError("position to keep", got=name, known=model.position_names)
    fixed = np.isin(model.position_names, list(keep))
    q = closed(model, state[: model.nq], fixed)
    if q is None:
        distance, _ = gap(model, state[: model.nq])
        raise ModelError(
            f"the loops cannot be closed from x, in which points are {distance:.3g} m apart; keep fewer positions"
        )
    return np.concatenate([q, state[model.nq :]])


def closed(model: Model, q: Array, fixed: NDArray[np.bool_]) -> Array | None:
    """Return a configuration near q (nq,) with closed loops and unchanged `fixed` (nq,) entries, or None."""
    if not model.file_facts.held_points:
        return q
    places, rates = single_coordinates(model)
    single = np.zeros(model.nv, dtype=bool)
    single[rates] = True
    free = np.ones(model.nv, dtype=bool)
    free[rates[fixed[places]]] = False
    without_bases = _closed(model, q, free & single)
    return _closed(model, q, free) if without_bases is None else without_bases


def _closed(model: Model, q: Array, free: NDArray[np.bool_]) -> Array | None:
    """Close the loops by Newton's method along the velocities that are `free` (nv,)."""
    for _ in range(MOST):
        distance, size = gap(model, q)
        if distance <= CLOSED * size:
            return q
        rows, difference = _relative_motion(model)
        change = np.zeros(model.nv)
        change[free] = -np.linalg.lstsq(rows[:, free], difference, rcond=None)[0]
        change /= max(1.0, float(np.abs(change).max()) / LONGEST)
        q = q + np.asarray(model.double.rates(change))
        for start in tangent_space(model).quaternions:
            q[start : start + 4] /= np.linalg.norm(q[start : start + 4])
    return None


def loop_velocities(model: Model, q: Array) -> Array:
    """Return an orthonormal basis (nv, k) of the velocities near configuration q (nq,) that keep the loops closed.

    Raises ModelError if the loops cannot be closed near q.
    """
    if not model.file_facts.held_points:
        return np.eye(model.nv)
    # A gap, which turns with the bodies, would depend on motions of joints outside of the loops.
    set_state(model.double, assembled(model, np.concatenate([q, np.zeros(model.nv)])))
    return np.asarray(null_space(_relative_motion(model)[0], rcond=DEPENDENT))


def _relative_motion(model: Model) -> tuple[Array, Array]:
    """Return the Jacobian (3L, nv) and the values (3L,) [m] of the gaps of the loops in the twin's state."""
    rows, difference = relative_motion(model.plant, model.double.context, model.file_facts.held_points)
    rows = rows.reshape(-1, rows.shape[-1])
    return rows if model.coupling is None else rows @ model.coupling.spread, difference.ravel()


def single_coordinates(model: Model) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the indices in q and in v of the joints with one position and one velocity."""
    places = [model.places(joint) for joint in joints(model.plant)]
    pairs = [(q[0], v[0]) for q, v in places if len(q) == len(v) == 1]
    in_q, in_v = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return in_q, in_v
