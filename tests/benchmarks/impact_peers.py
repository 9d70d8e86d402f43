"""What other simulators make of the same impacts, each at its customary step, by the first column of a case.

`drake` is AutoDiffXd through Drake's own discrete steps of 1 ms, `mujoco` central differences over +-1e-6 (those of
mjd_transitionFD) of a rollout of mj_step at 2 ms, its default. Drake's steps have the case's own law, so that their
error is that from the truth. MuJoCo has another law of contact: its stiffness and friction are matched
(drake_diff.engines.mujoco), its damping is its own. Its error is that from what its own law gives in steps of 10 us,
where slopes over +-1e-2 and +-3e-3 agree to 5 %; elsewhere that is not known, and it is not counted. MJX has MuJoCo's
law and step, and runs in an environment of its own (impact_mjx.py), from what `for_mjx` writes.
"""

import numpy as np
from impact_cases import Case
from pydrake.autodiffutils import AutoDiffXd

import drake_diff as dd

DRAKES_STEP, MUJOCOS_STEP, FINE_STEP = 1e-3, 2e-3, 1e-5  # [s]
WIDTH = 1e-6
WIDTHS, AGREE = (1e-2, 3e-3), 0.05


def drake(one: Case, column: int, step: float = DRAKES_STEP) -> tuple[float, float]:
    """The loss, and its derivative by a number of the first state, through AutoDiffXd in Drake alone."""
    _, double = one.diagram(step)
    diagram = double.ToAutoDiffXd()
    plant = next(system for system in diagram.GetSystems() if hasattr(system, "SetPositionsAndVelocities"))
    root = diagram.CreateDefaultContext()
    context = plant.GetMyContextFromRoot(root)
    if plant.num_actuators():
        plant.get_actuation_input_port().FixValue(context, np.array([AutoDiffXd(one.input)]))
    x = [AutoDiffXd(float(value), [float(i == column)]) for i, value in enumerate(one.x0)]
    plant.SetPositionsAndVelocities(context, np.array(x))
    for _ in range(round(one.duration / step)):
        ahead = diagram.EvalUniquePeriodicDiscreteUpdate(root)
        root.SetDiscreteState(ahead)
    loss = one.loss(plant.GetPositionsAndVelocities(context))
    gradient = loss.derivatives()
    return float(loss.value()), float(gradient[0]) if len(gradient) else 0.0


class MujocosMotion:
    """Rollouts of mj_step from first states of Drake's."""

    def __init__(self, one: Case, step: float):
        from drake_diff.engines.load import load_engine

        self.case, self.count = one, round(one.duration / step)
        self.engine = load_engine("mujoco", dd.model_from_diagram(one.diagram(step)[1]))

    def loss(self, x0) -> float:
        import mujoco

        engine = self.engine
        engine._set(np.array(x0), np.full(engine.nu, self.case.input))
        for _ in range(self.count):
            mujoco.mj_step(engine.model, engine.data)
        return float(self.case.loss(engine.native.to_drake(engine.data.qpos, engine.data.qvel)))

    def slope(self, column: int, width: float) -> float:
        ends = [self.loss(self.case.changed(column, sign * width).x0) for sign in (1, -1)]
        return (ends[0] - ends[1]) / (2 * width)


def mujoco(one: Case, column: int) -> tuple[float, float | None]:
    """(its differences, the slope of its own law, None where it has none)."""
    found = MujocosMotion(one, MUJOCOS_STEP).slope(column, WIDTH)
    fine = MujocosMotion(one, FINE_STEP)
    slopes = [fine.slope(column, width) for width in WIDTHS]
    settles = np.ptp(slopes) <= AGREE * np.max(np.abs(slopes))
    return found, slopes[1] if settles else None


def for_mjx(one: Case, column: int, step: float = MUJOCOS_STEP) -> dict:
    """What impact_mjx.py needs of a case."""
    motion = MujocosMotion(one, step)
    native = motion.engine.native

    def there(width: float):
        return np.concatenate(native.to_native(np.array(one.changed(column, width).x0)))

    def back(z):
        return float(np.dot(one.weights, native.to_drake(z[: len(one.x0) - motion.engine.nv], z[-motion.engine.nv :])))

    at, h = there(0.0), 1e-4
    along = (there(h) - there(-h)) / (2 * h)
    eye = h * np.eye(len(at))
    by = [(back(at + e) - back(at - e)) / (2 * h) for e in eye]  # positions and linear velocities: straight lines
    nq = len(at) - motion.engine.nv
    return {
        "mjcf": motion.engine.mjcf,
        "qpos": at[:nq].tolist(),
        "qvel": at[nq:].tolist(),
        "qpos_direction": along[:nq].tolist(),
        "qvel_direction": along[nq:].tolist(),
        "ctrl": np.asarray(native.control(np.full(motion.engine.nu, one.input))).tolist(),
        "loss": by,
        "constant": back(at) - float(np.dot(by, at)),
        "target": one.target,
        "steps": motion.count,
    }


TRUTH = "truth"  # the case's own


def _drakes_slope(one: Case, column: int):
    return drake(one, column)[1], TRUTH


PEERS = {"drake": _drakes_slope, "mujoco": mujoco}  # (case, column) -> (slope, what it should be, None if not known)
