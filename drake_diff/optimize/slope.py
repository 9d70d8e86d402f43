"""Whether the derivative of a plan in continuous time is a slope of the motion, measured by another integration of it.

After many impacts, or one that barely touches, a derivative exists and yet says nothing of the motion beside it: a
search that follows it is at no optimum for that.
"""

from functools import partial

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.exceptions import GradientError, SimulationError
from drake_diff.model.parameters import applied
from drake_diff.motion.continuous import ContinuousMotion
from drake_diff.optimize.shooting import ShootingVariables, final_sensitivity
from drake_diff.optimize.solution import Solution, Status

WIDTHS = (1e-4, 1e-5, 1e-6)  # of a variable's unit, over the derivative's own size where that is more
SAME, SETTLED = 0.01, 0.1  # of the derivative: how far a slope may be from it, and slopes from each other
HOLDS = f"the derivative of its end is the slope of that integration, to {SAME:.0%}"


def doubt_of_the_slope(solution: Solution) -> tuple[Status, str] | None:
    """Why the derivative of the plan's end is no slope, and how the solve ends then; None where it is one.

    Along the change of the variables that moves the end most, and along a random one; parameters stay as they are.
    """
    variables = ShootingVariables(solution.problem)
    z = variables.pack(solution.xs[0], solution.us, solution.step_vector.values)
    lower, upper = variables.limits()
    free = (z > lower + WIDTHS[0]) & (z < upper - WIDTHS[0])
    free[variables.inputs.stop :] = False
    try:
        last = final_sensitivity(variables, z) * free
        strongest = np.linalg.svd(last, full_matrices=False)[2][0]
        for direction in (strongest, free * np.random.default_rng(0).standard_normal(len(z))):
            wanted = last @ direction
            size = float(np.linalg.norm(wanted))
            if size == 0.0:
                continue
            widths = [width / max(float(np.max(np.abs(direction))), size) for width in WIDTHS]
            slopes: list[Array] = []
            off: list[float] = []
            for width in widths:
                slopes.append(_slope(solution, variables, z, direction, width))
                off.append(float(np.linalg.norm(slopes[-1] - wanted)) / size)
                if off[-1] <= SAME:
                    break
            if off[-1] <= SAME:
                continue
            apart = float(np.linalg.norm(slopes[-2] - slopes[-1])) / size
            if apart > SETTLED:
                told = (
                    f"slopes over +-{widths[-2]:.1g} and +-{widths[-1]:.1g} along its own direction differ by "
                    f"{apart:.0%}"
                )
                return Status.NO_GRADIENT, f"the derivative of the plan's end is that of a point alone: {told}"
            told = f"the derivative of the plan's end is {off[-1]:.1%} off the slope that another integration has"
            return Status.CONVERGED_NOT_VERIFIED, told
    except (GradientError, SimulationError) as error:
        return Status.NO_GRADIENT, f"beside the plan there is no motion: {error}"
    return None


def _slope(solution: Solution, variables: ShootingVariables, z: Array, direction: Array, width: float) -> Array:
    """(nx,) that of the end over +-`width` along `direction` (size,)."""
    ahead, behind = (variables.unpack(z + sign * width * direction) for sign in (1, -1))
    with applied(solution.step_vector) as model:
        motion = ContinuousMotion(model)
        ends = [motion.roll(x0, partial(_input, us), len(us))[0][-1] for x0, us in (ahead, behind)]
    return np.asarray((ends[0] - ends[1]) / (2 * width))


def _input(us: Array, _: Array, k: int) -> Array:
    return np.asarray(us[k])
