"""Tasks of a humanoid on two flat feet: it shifts its weight and takes a step with each foot, or stands up.

The robot is Talos with fixed torso and arms. The starts are drawn and the ends are measured as in `legged_tasks.py`.
The height of a swinging foot is measured at each corner of its sole, and its landing position is measured too.
"""

from functools import cache, partial

import numpy as np
from contact_task import Task, Tasks
from helpers.legged import LEGGED, legged_model, rest
from legged_tasks import IN_AIR, OPTIONS, TIME_STEP, build, scheduled_problem

ROBOT, LEFT, RIGHT, BOTH = "talos", 0, 1, (0, 1)
STRIDE, SWING = 0.1, 0.05  # [m]
LANDED, STANDS = 0.03, 0.005  # [m] distance of a foot from its final position; height of a standing foot


def step(random, h=TIME_STEP):
    phases = [(0.6, BOTH), (0.6, (RIGHT,)), (0.6, BOTH), (0.6, (LEFT,)), (0.6, BOTH)]
    return _task(random, h, "step", "high", phases, f"takes a step of {STRIDE:.2f} m with each foot", way=STRIDE)


def stand_up(random, h=TIME_STEP):
    return _task(random, h, "stand", "low", [(0.8, BOTH)], "stands up from a crouch")


KINDS = {"step": step, "stand": stand_up}
TASKS: Tasks = {f"{ROBOT}_{kind}": make for kind, make in KINDS.items() if LEGGED[ROBOT].is_installed}


def _task(random, h, kind, first, phases, text, *, way=0.0):
    model, facts = legged_model(ROBOT, h), LEGGED[ROBOT]
    x0 = rest(ROBOT, model, np.array(getattr(facts, first)), random)
    end = np.array(_posture(h))
    begun = _soles(x0[: model.nq])
    shift = np.mean(begun, axis=(0, 1))[:2] - np.mean(_soles(end), axis=(0, 1))[:2]
    end[4:6] += shift + np.array([way, 0.0])
    steps = [(round(seconds / h), [facts.feet[i] for i in feet]) for seconds, feet in phases]
    problem, guess, asks = scheduled_problem(model, facts, x0, end, steps, SWING)
    if way:
        ends = np.mean(_soles(end), axis=1)
        asks += [(f"{facts.feet[i]} from where it lands [m]", partial(_off_foot, i, ends[i]), LANDED) for i in BOTH]
    knot = 0
    for count, standing in steps:
        middle, knot = knot + count // 2, knot + count
        for i, foot in enumerate(facts.feet):
            if foot in standing:
                asks.append((f"{foot} over the ground [m]", partial(_over, i, middle), STANDS))
            else:
                asks.append((f"{foot} short of its clearance [m]", partial(_low, i, middle), 0.0))
    return Task(
        name=f"{ROBOT}_{kind}",
        problem=problem,
        goal_text=text,
        options={**OPTIONS, "initial_guess": guess},
        asks=tuple(asks),
        build=partial(build, ROBOT, h),
        falls=True,
    )


@cache
def _posture(h):
    """Return the posture (nq,) of the standing robot."""
    model = legged_model(ROBOT, h)
    return tuple(rest(ROBOT, model, np.array(LEGGED[ROBOT].high))[: model.nq])


# The measurements of the referee, with Drake alone.


@cache
def _kinematics():
    plant, _ = build(ROBOT, TIME_STEP, TIME_STEP)
    return plant, plant.CreateDefaultContext()


def _soles(q):
    """Return the lowest points (feet, corners, 3) [m] of the spheres under each foot in posture q (nq,)."""
    plant, context = _kinematics()
    facts = LEGGED[ROBOT]
    plant.SetPositions(context, q)
    poses = [plant.EvalBodyPoseInWorld(context, plant.GetBodyByName(foot)) for foot in facts.feet]
    centres = np.array([[pose.multiply(np.array(centre)) for centre in facts.soles] for pose in poses])
    return centres - [0.0, 0.0, facts.radius]


def _off_foot(i, place, xs, us):
    return float(np.linalg.norm(np.mean(_soles(_q(xs[-1]))[i], axis=0) - place))


def _low(i, knot, xs, us):
    return float(max(IN_AIR - np.min(_soles(_q(xs[knot]))[i, :, 2]), 0.0))


def _over(i, knot, xs, us):
    """Return the height of the middle of a sole above the ground."""
    return float(max(np.mean(_soles(_q(xs[knot]))[i, :, 2]), 0.0))


def _q(x):
    return x[: _kinematics()[0].num_positions()]
