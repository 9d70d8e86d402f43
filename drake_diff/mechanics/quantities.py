"""Functions of the state for costs and constraints: positions, rotations, velocities and contact forces.

Each function takes a model and names, checks them immediately, and returns a function of x (nx,), or of x and u (nu,),
for floats and AutoDiffXd, to use in costs and in a `dd.Constraint`. All of them except the contact forces also take the
symbols of a collocation, which computes exact second derivatives with them.

The functions use the model's own parameters and have no derivatives with respect to parameters. They raise InputError
while other parameters are applied that they depend on (joint offsets; masses and centres of mass; for contact forces
all), and so does a Problem that optimizes such parameters. The name of a frame is "frame", "instance::frame" if two
model instances have a frame of this name, or the name of its body.

Example:
    >>> model = dd.load_model("models/cart_pole.urdf", time_step=0.01)
    >>> cart = dd.quantities.frame_position(model, "cart")
    >>> problem = dd.Problem(model, x0=[0, 0, 0, 0], num_steps=10, final_cost=lambda x: (cart(x)[0] - 1) ** 2)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from pydrake.autodiffutils import AutoDiffXd
from pydrake.math import RotationMatrix_
from pydrake.multibody.tree import FrameIndex
from scipy.spatial.transform import Rotation

from drake_diff._base.arrays import finite_array
from drake_diff._base.autodiff import plain
from drake_diff._base.values import Refusal
from drake_diff.exceptions import InputError, ModelError, ShapeError, UnknownNameError
from drake_diff.mechanics.forward_kinematics import ForwardKinematics, forward_kinematics, product
from drake_diff.model.contact import body_of, contact_forces
from drake_diff.model.model import Model
from drake_diff.model.plant import bodies, frame_named, labelled
from drake_diff.model.step import advance, set_state
from drake_diff.model.twin import Twin

PLACE = frozenset({"offset"})  # the parameters that frames depend on
BALANCE = PLACE | {"mass", "center_of_mass"}  # the parameters that the centre of mass depends on
ORIGIN = (0.0, 0.0, 0.0)
UP = (0.0, 0.0, 1.0)
ROTATION_TOLERANCE = 1e-9  # of R' R = I: a goal given with fewer digits would be a different rotation

CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])  # a quaternion times this, entry by entry, is its conjugate
RECORDED = "recorded_as"  # the attribute that identifies a function of this module in a record

OfState = Callable[[Any], Any]
OfStateAndInput = Callable[[Any, Any], Any]


def frame_position(model: Model, frame: str, point: ArrayLike = ORIGIN, relative_to: str = "world") -> OfState:
    """Return the position of a point fixed in a frame, as a function of the state.

    Args:
        model: The model.
        frame: The name of the frame, or of a body.
        point: (3,) [m] in `frame`.
        relative_to: The frame in which the position is expressed.

    Returns:
        x (nx,) -> (3,) [m], or (K, nx) -> (K, 3) for floats.

    Raises:
        UnknownNameError: The frame does not exist. The message lists the existing frames.
        ShapeError: `point` is not (3,).

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> tip = dd.quantities.frame_position(model, "pole", point=[0, 0, -0.5])
        >>> tip([0.0, 0.0])
        array([ 0. ,  0. , -0.5])
    """
    here, base, p = frame_index(model, frame), frame_index(model, relative_to), finite_array("point", point, (3,))

    def position(x: Any) -> Any:
        R, origin = _pose(model, x, here, base)
        return origin + R @ p

    return of_rows(model, recorded(position, "frame_position", frame=frame, point=p.tolist(), relative_to=relative_to))


def frame_rotation_error(model: Model, frame: str, R_goal: ArrayLike, relative_to: str = "world") -> OfState:
    """Return the rotation of a frame relative to a goal, 2 sin(angle / 2) times the axis, as a function of the state.

    The result is twice the vector part of the quaternion of R R_goal' with nonnegative scalar part. It is 0 at the
    goal, approximates the rotation vector [rad] near the goal, and is smooth except at a rotation by 180 degrees, where
    the axis may have either sign. Its square is 2 (1 - cos angle).

    Args:
        model: The model.
        frame: The name of the frame, or of a body.
        R_goal: (3, 3) the goal rotation relative to `relative_to`.
        relative_to: The frame that both rotations are relative to.

    Returns:
        x (nx,) -> (3,) [rad, for small rotations], or (K, nx) -> (K, 3) for floats.

    Raises:
        UnknownNameError: The frame does not exist.
        ShapeError, InputError: R_goal is not (3, 3), or not a rotation.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> error = dd.quantities.frame_rotation_error(model, "pole", np.eye(3))
        >>> error([0.01, 0.0]).round(6)
        array([0.  , 0.01, 0.  ])
    """
    here, base = frame_index(model, frame), frame_index(model, relative_to)
    goal = finite_array("R_goal", R_goal, (3, 3))
    off, determinant = float(np.abs(goal.T @ goal - np.eye(3)).max()), np.linalg.det(goal)
    if off > ROTATION_TOLERANCE or determinant < 0:
        got = f"R' R with an error of {off:.2g}, determinant {determinant:.2g}"
        raise InputError("R_goal", got=got, expected="a rotation matrix")

    def error(x: Any) -> Any:
        if _is_symbolic(x):
            tree = _tree_of(model, PLACE)
            turned, origin = (tree.quaternion(x, model.plant.get_frame(i)) for i in (here, base))
            relative = product(product(CONJUGATE * origin, turned), CONJUGATE * _quaternion(goal, float))
            return 2 * relative[0].sign() * relative[1:]
        R, _ = _pose(model, x, here, base)
        if R.ndim == 3:
            turned = Rotation.from_matrix(R @ goal.T).as_quat()
            return np.where(turned[:, 3:] < 0, -2.0, 2.0) * turned[:, :3]
        return 2 * _quaternion(R @ goal.T, float if R.dtype == float else AutoDiffXd)[1:]

    return of_rows(
        model, recorded(error, "frame_rotation_error", frame=frame, R_goal=goal.tolist(), relative_to=relative_to)
    )


def frame_velocity(model: Model, frame: str, point: ArrayLike = ORIGIN) -> OfState:
    """Return the velocity in the world of a point fixed in a frame, as a function of the state.

    Args:
        model: The model.
        frame: The name of the frame, or of a body.
        point: (3,) [m] in `frame`.

    Returns:
        x (nx,) -> (3,) [m/s].

    Raises:
        UnknownNameError: The frame does not exist.
        ShapeError: `point` is not (3,).

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> tip = dd.quantities.frame_velocity(model, "pole", point=[0, 0, -0.5])
        >>> tip([0.0, 2.0]).round(6)
        array([-1.,  0.,  0.])
    """
    here, p = frame_index(model, frame), finite_array("point", point, (3,))

    return recorded(lambda x: _velocities(model, x, here, p)[1], "frame_velocity", frame=frame, point=p.tolist())


def frame_angular_velocity(model: Model, frame: str) -> OfState:
    """Return the angular velocity of a frame in the world, as a function of the state.

    Args:
        model: The model.
        frame: The name of the frame, or of a body.

    Returns:
        x (nx,) -> (3,) [rad/s].

    Raises:
        UnknownNameError: The frame does not exist.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> turning = dd.quantities.frame_angular_velocity(model, "pole")
        >>> turning([0.0, 2.0]).round(6)
        array([0., 2., 0.])
    """
    here = frame_index(model, frame)

    return recorded(lambda x: _velocities(model, x, here, np.zeros(3))[0], "frame_angular_velocity", frame=frame)


def frame_tilt(model: Model, frame: str, axis: ArrayLike = UP) -> OfState:
    """Return the tilt of a frame's axis from vertical, 2 sin(angle / 2) towards x and y, as a function of the state.

    The result is 0 if the axis points up along the world's z. Near this orientation it approximates the tilt angles
    [rad]. Its norm is 2 if the axis points down.

    Args:
        model: The model.
        frame: The name of the frame, or of a body.
        axis: (3,) the axis in `frame` that should point up, of any length.

    Returns:
        x (nx,) -> (2,) [rad, for small tilts].

    Raises:
        UnknownNameError: The frame does not exist.
        ShapeError, InputError: `axis` is not (3,), or 0.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> tilt = dd.quantities.frame_tilt(model, "pole")
        >>> tilt([0.01, 0.0]).round(6)
        array([0.01, 0.  ])
    """
    here, world, a = frame_index(model, frame), frame_index(model, "world"), finite_array("axis", axis, (3,))
    if not np.linalg.norm(a) > 0:
        raise InputError("axis", got=a.tolist(), expected="a direction")
    a = a / np.linalg.norm(a)

    def tilt(x: Any) -> Any:
        pointing = _pose(model, x, here, world)[0] @ a
        if not _is_symbolic(x) and not plain([1 + pointing[2]])[0] > 0:  # upside down: the direction is arbitrary
            return np.array([2.0, 0.0]) + 0 * pointing[:2]
        return pointing[:2] / np.sqrt((1 + pointing[2]) / 2)

    return recorded(tilt, "frame_tilt", frame=frame, axis=a.tolist())


def center_of_mass(model: Model) -> OfState:
    """Return the position in the world of the centre of mass of all bodies, as a function of the state.

    Args:
        model: The model.

    Returns:
        x (nx,) -> (3,) [m].

    Raises:
        ModelError: The bodies have no mass.

    Example:
        >>> model = dd.load_model("models/pendulum.urdf", time_step=0.01)
        >>> dd.quantities.center_of_mass(model)([0.0, 0.0])
        array([ 0. ,  0. , -0.5])
    """
    if not float(model.plant.CalcTotalMass(model.double.context)) > 0:
        raise ModelError("the bodies have no mass, and so no centre of mass")

    def center(x: Any) -> Any:
        if _is_symbolic(x):
            return _tree_of(model, BALANCE).center_of_mass(x)
        twin, _ = _twin_at(model, BALANCE, x)
        return np.array(twin.plant.CalcCenterOfMassPositionInWorld(twin.context))

    return recorded(center, "center_of_mass")


def contact_force(model: Model, body: str) -> OfStateAndInput:
    """Return the sum of all contact forces on a body, in the world, as a function of the state and the input.

    The force acts during the step from (x, u), so it must be used in a Constraint of (x, u) or in a cost of both. Its
    derivative is 0 without contact. An optimization must start from a trajectory with contact.

    Args:
        model: The model.
        body: The name of the body on which the forces act.

    Returns:
        (x (nx,), u (nu,)) -> (3,) [N]. The function raises the errors of `step`, such as SimulationError for pairs of
        shapes that Drake does not support.

    Raises:
        UnknownNameError: The body does not exist. The message lists the existing bodies.

    Example:
        >>> model = dd.load_model("models/sphere_on_ground.sdf", time_step=0.01)
        >>> force = dd.quantities.contact_force(model, "ball")
        >>> high = np.array([1, 0, 0, 0, 0, 0, 5, 0, 0, 0, 0, 0, 0])
        >>> force(high, [])
        array([0., 0., 0.])
    """
    known = labelled(bodies(model.plant))
    if body not in known:
        raise UnknownNameError("body", got=body, known=known)
    index = known[body].index()

    def force(x: Any, u: Any) -> Any:
        twin, (x, u) = _twin_at(model, model.other_quantities, x, u)
        advance(twin, x, u)
        total = np.array([twin.scalar(0.0)] * 3)
        for a, b, on_a, _ in contact_forces(twin):
            sign = float(body_of(model, a).index() == index) - float(body_of(model, b).index() == index)
            total = total + sign * on_a
        return total

    return recorded(force, "contact_force", body=body)


def recorded(function: Any, name: str, **arguments: Any) -> Any:
    """Attach the name and arguments to `function`, so that a record can make the function again. See `made_from`."""
    setattr(function, RECORDED, (function, {name: arguments}))
    return function


def of_rows(model: Model, function: Any) -> Any:
    """Mark a `function` of the state that also takes rows (K, nx) of floats, if the model has forward kinematics."""
    function.takes_rows = not isinstance(forward_kinematics(model), Refusal)
    return function


def description_of(function: Any) -> dict[str, Any] | None:
    """Return the name and arguments of this module's function that made `function`, or None for other functions."""
    made, description = getattr(function, RECORDED, (None, None))
    return description if made is function else None  # a wrapper copies the attributes but may return other values


def made_from(model: Model, description: Any) -> OfState | OfStateAndInput:
    """Make the function on `model` from the result of `description_of`; raise InputError for another description."""
    makers: tuple[Any, ...] = (
        *(frame_position, frame_rotation_error, frame_velocity, frame_angular_velocity, frame_tilt),
        *(center_of_mass, contact_force),
    )
    kinds = {make.__name__: make for make in makers}
    if isinstance(description, dict) and len(description) == 1:
        ((name, arguments),) = description.items()
        if name in kinds and isinstance(arguments, dict):
            return kinds[name](model, **arguments)
    raise InputError("quantity", got=repr(description), expected=f"one of {', '.join(kinds)} with its arguments")


def _pose(model: Model, x: Any, here: FrameIndex, base: FrameIndex) -> tuple[Any, Any]:
    """Return the rotation (3, 3) and origin (3,) of the frame `here` in the frame `base`."""
    if np.ndim(x) == 2 and np.shape(x)[1] != model.nx:
        raise ShapeError("x", got=np.shape(x), expected=(len(x), model.nx))
    if np.ndim(x) == 2 or _is_symbolic(x):
        tree = _tree_of(model, PLACE)
        moving, origin = (tree.frame(x, model.plant.get_frame(i)) for i in (here, base))
        back = np.swapaxes(origin.R, -1, -2)
        return back @ moving.R, (back @ (moving.p - origin.p)[..., None])[..., 0]
    twin, _ = _twin_at(model, PLACE, x)
    pose = twin.plant.get_frame(here).CalcPose(twin.context, twin.plant.get_frame(base))
    return pose.rotation().matrix(), pose.translation()


def _velocities(model: Model, x: Any, here: FrameIndex, point: Any) -> tuple[Any, Any]:
    """Return the angular velocity (3,) of a frame and the velocity (3,) of a point fixed in the frame, in world."""
    if _is_symbolic(x):
        moving = _tree_of(model, PLACE).frame(x, model.plant.get_frame(here), speeds=True).shifted(np.eye(3), point)
        return moving.w, moving.v
    twin, _ = _twin_at(model, PLACE, x)
    frame = twin.plant.get_frame(here)
    arm = frame.CalcPose(twin.context, twin.plant.world_frame()).rotation().matrix() @ point
    velocity = frame.CalcSpatialVelocityInWorld(twin.context).Shift(arm)
    return velocity.rotational(), velocity.translational()


def _twin_at(model: Model, depends_on: frozenset[str], x: Any, *inputs: Any) -> tuple[Twin, list[Any]]:
    """Return the twin for the scalar type of the arguments, with its state set to `x`, and x and the inputs as scalars.

    Raises InputError if parameters are applied that the result depends on.
    """
    _check_parameters(model, depends_on)
    given = [np.asarray(array) for array in (x, *inputs)]
    for name, array, size in zip(("x", "u"), given, (model.nx, model.nu), strict=False):
        if array.shape != (size,):
            raise ShapeError(name, got=array.shape, expected=(size,))
    if all(array.dtype != object for array in given):
        twin, numbers = model.double, [array.astype(float) for array in given]
    else:
        twin = model.autodiff
        numbers = [np.array([v if isinstance(v, AutoDiffXd) else AutoDiffXd(v) for v in array]) for array in given]
    set_state(twin, numbers[0])
    return twin, numbers


def _check_parameters(model: Model, depends_on: frozenset[str]) -> None:
    for quantity in sorted(model.other_quantities & depends_on):
        expected = "parameters that do not change the functions of dd.quantities"
        raise InputError("parameters", got=quantity, expected=expected)


def _is_symbolic(x: Any) -> bool:
    """Check if `x` has entries that are neither numbers nor AutoDiffXd, so that Drake cannot evaluate them."""
    array = np.asarray(x)
    known = (AutoDiffXd, int, float, np.number)
    return array.dtype == object and not all(isinstance(entry, known) for entry in array.ravel())


def _tree_of(model: Model, depends_on: frozenset[str]) -> ForwardKinematics:
    """Return the forward kinematics for scalar types that Drake does not support; raise ModelError if not available."""
    _check_parameters(model, depends_on)
    kinematics = forward_kinematics(model)
    if isinstance(kinematics, Refusal):
        raise ModelError(str(kinematics))
    return kinematics


def frame_index(model: Model, name: str) -> FrameIndex:
    return frame_named(model.plant, "frame", name, of_world=True).index()


def _quaternion(R: Any, scalar: Any) -> Any:
    """Return the quaternion w x y z (4,), with w >= 0, of a rotation matrix."""
    quaternion = RotationMatrix_[scalar](R).ToQuaternion().wxyz()
    return -quaternion if quaternion[0] < 0 else quaternion
