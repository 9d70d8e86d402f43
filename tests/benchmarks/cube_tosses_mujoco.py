"""The tosses of cube_tosses.py by MuJoCo's sysid toolbox, with as many simulated steps as Drake's fit took.

Eight corner spheres, whole tosses from the same first states as Drake has, positions of the centre and of two sites.
The toolbox's own optimizer with its tiny differences, and scipy's with differences of 1 % and a soft-L1 loss, which it
offers too: each gets all the steps, and the best values that it looked at count.
"""

import contextlib
from itertools import product
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array

RATE, WIDTH, MASS, INERTIA, INSET = 148.0, 0.1048, 0.37, 0.00081, 0.0024
AT = WIDTH / 2 - INSET
SPAN = 0.1  # [m] ground and centre are sought as 1 + place / SPAN: scipy's differences are relative


def model_text(steps: int, center: Array) -> str:
    """By so many steps between two samples. MuJoCo's defaults for solref, and the friction that was published."""
    corners = "".join(
        f'<geom name="corner{i}" type="sphere" size="{INSET}" pos="{a * AT} {b * AT} {c * AT}" priority="1"/>'
        for i, (a, b, c) in enumerate(product((-1, 1), repeat=3))
    )
    return (
        f'<mujoco><option timestep="{1 / RATE / steps}" cone="elliptic"/><default><geom friction="0.15 0 0"/></default>'
        '<worldbody><geom name="board" type="plane" size="0 0 1"/><body name="cube"><freejoint/>'
        f'<inertial pos="{center[0]} {center[1]} {center[2]}" mass="{MASS}" '
        f'diaginertia="{INERTIA} {INERTIA} {INERTIA}"/>{corners}'
        '<site name="center"/><site name="x" pos="0.05 0 0"/><site name="y" pos="0 0.05 0"/></body></worldbody><sensor>'
        '<framepos name="center" objtype="site" objname="center"/><framepos name="x" objtype="site" objname="x"/>'
        '<framepos name="y" objtype="site" objname="y"/></sensor></mujoco>'
    )


def _turned(quaternions: Array, vector: Array) -> Array:
    import mujoco

    found = np.empty((len(quaternions), 3))
    for k, q in enumerate(quaternions):
        mujoco.mju_rotVecQuat(found[k], vector, q)
    return found


def _state(x: Array) -> tuple[Array, Array]:
    """(qpos, qvel) of Drake's state: the angular velocity goes to the body's frame."""
    w = _turned((x[:4] * [1, -1, -1, -1])[None], x[7:10])[0]
    return np.concatenate([x[4:7], x[:4]]), np.concatenate([x[10:13], w])


def _parameters(sysid: Any, center: Array) -> Any:
    def corners(spec: Any, change: Any) -> None:
        for i in range(8):
            change(spec.geom(f"corner{i}"))

    def set_radius(s: Any, p: Any) -> None:
        corners(s, lambda g: setattr(g, "size", [p.value[0], 0, 0]))

    def set_friction(s: Any, p: Any) -> None:
        corners(s, lambda g: setattr(g, "friction", [p.value[0], 0, 0]))

    def set_law(s: Any, p: Any) -> None:
        corners(s, lambda g: setattr(g, "solref", [p.value[0], p.value[1]]))

    def set_ground(s: Any, p: Any) -> None:
        s.geom("board").pos = [0, 0, SPAN * (p.value[0] - 1)]

    def set_center(s: Any, p: Any) -> None:
        s.body("cube").ipos = SPAN * (p.value - 1)

    found = sysid.ParameterDict()
    found.add(sysid.Parameter("radius", INSET, 0.0005, 0.01, modifier=set_radius))
    found.add(sysid.Parameter("friction", 0.15, 0.01, 1.0, modifier=set_friction))
    found.add(sysid.Parameter("solref", [0.02, 1.0], [0.0075, 0.05], [0.1, 3.0], modifier=set_law))
    found.add(sysid.Parameter("ground", 1.0, 0.9, 1.1, modifier=set_ground))
    found.add(sysid.Parameter("center", (1 + center / SPAN).tolist(), [0.9] * 3, [1.1] * 3, modifier=set_center))
    return found


def fit_by_sysid(
    fitted: list[Array],
    held: list[Array],
    begins: list[Array],
    starts: list[Array],
    center: Array,
    most: int,
    steps: int,
) -> list[str]:
    """Lines with what it found by at most so many simulated steps, and its errors on tosses that were held out.

    Those that are fitted begin at `begins`, those held out at `starts`; there are `steps` between two samples. The
    search for the centre of mass begins at `center` [m].
    """
    import mujoco
    from mujoco import sysid

    spec = mujoco.MjSpec.from_string(model_text(steps, center))
    model = spec.compile()
    firsts, controls, sensors = [], [], []
    for xs, x0 in zip(fitted, begins, strict=True):
        firsts.append(sysid.create_initial_state(model, *_state(x0)))
        t, fine = np.arange(len(xs)) / RATE, np.arange((len(xs) - 1) * steps + 1) / RATE / steps
        sites = [xs[:, 4:7] + _turned(xs[:, :4], v) for v in (np.zeros(3), np.eye(3)[0] * 0.05, np.eye(3)[1] * 0.05)]
        every = np.concatenate(sites, axis=1)
        every = np.stack([np.interp(fine, t, column) for column in every.T], axis=1)
        controls.append(sysid.TimeSeries(fine, np.zeros((len(fine), 0))))
        sensors.append(sysid.TimeSeries.from_names(fine, every, model))
    names = [f"toss {i}" for i in range(len(fitted))]
    sequences = sysid.ModelSequences("cube", spec, names, firsts, controls, sensors)
    residual = sysid.build_residual_fn(models_sequences=[sequences], n_threads=1)
    each = sum(len(xs) - 1 for xs in fitted) * steps
    lines = [_told("MuJoCo, by hand", [_error(model, xs, x0, steps) for xs, x0 in zip(held, starts, strict=True)])]
    for name, options in OPTIMIZERS.items():
        parameters = _parameters(sysid, center)
        search = _Counted(residual, most, each)
        with contextlib.suppress(_SpentError):  # the best so far counts
            sysid.optimize(parameters, search, verbose=False, max_iters=most, x_scale="jac", **options)
        parameters.update_from_vector(search.best)
        by = sysid.apply_param_modifiers(parameters, spec)
        errors = [_error(by, xs, x0, steps) for xs, x0 in zip(held, starts, strict=True)]
        lines += [_told(f"MuJoCo, identified by its sysid with {name}, {search.taken} simulated steps", errors)]
        lines += [f"  {one}: {np.round(parameter.value, 6).tolist()}" for one, parameter in parameters.items()]
    return lines


OPTIMIZERS: dict[str, dict[str, Any]] = {
    "its own optimizer": {"optimizer": "mujoco"},
    "scipy's, differences of 1 %, soft L1": {"optimizer": "scipy", "diff_step": 0.01, "loss": "soft_l1"},
}


class _SpentError(Exception):
    pass


class _Counted:
    """A residual that ends the search once it has taken so many steps, and the best that it was asked for."""

    def __init__(self, residual: Any, most: int, each: int):
        self.residual, self.most, self.each, self.taken = residual, most, each, 0
        self.best, self.least = np.zeros(0), np.inf

    def __call__(self, x: Array, p: Any) -> Any:
        columns = x.reshape(len(x), -1)
        if self.taken + self.each * columns.shape[1] > self.most:
            raise _SpentError
        self.taken += self.each * columns.shape[1]
        found = self.residual(x, p)
        squares = np.concatenate(found[0]).reshape(-1, columns.shape[1]) ** 2
        costs = np.sum(2 * (np.sqrt(1 + squares) - 1), axis=0)
        if np.min(costs) < self.least:
            self.best, self.least = columns[:, np.argmin(costs)].copy(), float(np.min(costs))
        return found


def _told(name: str, errors: list[float]) -> str:
    e = np.array(errors)
    return f"{name}: mean {np.mean(e):.1f} %, median {np.median(e):.1f} %, below 10 %: {np.sum(e < 10)} of {len(e)}"


def _error(model: Any, xs: Array, x0: Array, steps: int) -> float:
    import mujoco

    data = mujoco.MjData(model)
    data.qpos, data.qvel = _state(x0)
    found = [data.qpos[:3].copy()]
    for _ in range(len(xs) - 1):
        mujoco.mj_step(model, data, steps)
        found.append(data.qpos[:3].copy())
    return float(np.mean(np.linalg.norm(np.array(found) - xs[:, 4:7], axis=1)) / WIDTH * 100)
