"""Postures in which loops are closed: the points of each pair are where the other's are."""

from collections.abc import Collection

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydrake.multibody.tree import BodyIndex

from drake_diff._base.arrays import Array, finite_array
from drake_diff.exceptions import InputError, ModelError, UnknownNameError
from drake_diff.model.loops import APART, relative_motion
from drake_diff.model.model import Model
from drake_diff.model.plant import joints
from drake_diff.model.step import set_state
from drake_diff.model.tangent import tangent_space

CLOSED = 1e-9  # of the distance of points from their bodies' origins
OPEN = 1e-2  # of that distance: a step from there pulls the loop shut with a jerk
MOST = 50  # steps of Newton's method; from what can be assembled it takes below ten
LONGEST = 0.5  # [rad or m] of a step: farther ones miss the posture nearby


def gap(model: Model, q: ArrayLike) -> tuple[float, float]:
    """[m] how far the points of a loop are apart in posture q (nq,) at most, and a length to compare that with.

    The length is the largest distance of a loop's first point from the origin of its body, or the extent of the origins
    of the bodies that are held and of those that carry them. The other points of a loop only give its axes. They count
    by the angle between them and the first point, times this length, so that the ratio has no unit.
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
    """InputError where x (nx,) leaves a loop of the model open."""
    distance, size = gap(model, x[: model.nq]) if model.file_facts.held_points else (0.0, 0.0)
    if distance > OPEN * size:
        expected = f"a closed loop, as dd.model.assembled(model, {subject}) makes it"
        raise InputError(subject, got=f"points {distance:.3g} m apart that the file holds together", expected=expected)


def assembled(model: Model, x: ArrayLike, *, keep: Collection[str] = ()) -> Array:
    """The state near `x` in which the loops of a model are closed, as <connect> of MJCF does, at the same velocities.

    Args:
        model: Any; one without loops has its state already.
        x: (nx,) where to begin.
        keep: The names of positions, as in `Model.state_names`, that stay as they are: those of motors, as a rule.

    Returns:
        (nx,) by Newton's method; each step is the least change of positions, of bases that float only where it must be.

    Raises:
        UnknownNameError: One of `keep` is no position.
        ModelError: The loops cannot be closed from there.

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
            f"the loops cannot be closed from this posture: points stay {distance:.3g} m apart; keep fewer coordinates"
        )
    return np.concatenate([q, state[model.nq :]])


def closed(model: Model, q: Array, fixed: NDArray[np.bool_]) -> Array | None:
    """The posture near q (nq,) in which loops are closed; what is `fixed` (nq,) stays. None where none was found."""
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
    """By velocities that are `free` (nv,)."""
    for _ in range(MOST):
        distance, size = gap(model, q)
        if distance <= CLOSED * size:
            return q
        rows, difference = relative_motion(model.plant, model.double.context, model.file_facts.held_points)
        rows = rows.reshape(-1, rows.shape[-1])
        if model.coupling is not None:
            rows = rows @ model.coupling.spread
        change = np.zeros(model.nv)
        change[free] = -np.linalg.lstsq(rows[:, free], difference.ravel(), rcond=None)[0]
        change /= max(1.0, float(np.abs(change).max()) / LONGEST)
        q = q + np.asarray(model.double.rates(change))
        for start in tangent_space(model).quaternions:
            q[start : start + 4] /= np.linalg.norm(q[start : start + 4])
    return None


def single_coordinates(model: Model) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Where the positions and velocities of joints with one of each are in q and in v."""
    places = [model.places(joint) for joint in joints(model.plant)]
    pairs = [(q[0], v[0]) for q, v in places if len(q) == len(v) == 1]
    in_q, in_v = np.array(pairs, dtype=np.intp).reshape(-1, 2).T
    return in_q, in_v
