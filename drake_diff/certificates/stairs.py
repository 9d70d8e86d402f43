"""Is a loss, or a policy, a staircase?

Rounding, a table or a whole number make a function that is flat, or nearly so, between jumps. Its derivative is true
and worthless, and where the steps are wide no difference of a rollout meets one. The function alone can be asked far
from the motion at next to no cost. That is done here along one line, over lengths from 1e-4 to 10 times the scale.
"""

from collections.abc import Callable

import numpy as np

from drake_diff._base.arrays import Array
from drake_diff.certificates.feedback import fresh
from drake_diff.model.tangent import TangentSpace
from drake_diff.motion.gradient import RolloutGradient
from drake_diff.motion.loss import Loss, evaluate_loss

LENGTHS = tuple(10.0**k for k in range(-4, 2))  # of the line, to each side
CELLS = 16  # both sides together
STAIRS = 3  # jumps in as many cells: fewer are a switch, which the motion may never meet
QUARTERINGS = 10
SETTLED = 2  # after so many a smooth function's cells differ by 1/256, those of a corner by 1/16
KEPT = 0.125  # and those of a jump by as much as before
ROUNDED, PART = 1e-12, 1e-6  # of the largest value, and of what they differ by: a jump that is told
SINGLE = 5e-7  # of an input: single precision is no staircase
OUTSIDE = (ValueError, ArithmeticError, LookupError)  # what a function may raise where it is not defined

Jump = tuple[float, float]  # from where to where


def stairs_of_loss(loss: Loss, g: RolloutGradient, space: TangentSpace) -> str:
    """How the loss alone jumps around the motion of `g`; empty where it is no staircase."""
    by_x = _line(len(g.xs), space.size)
    states = np.array([space.derivative_of_plus(x) @ d for x, d in zip(g.xs, by_x, strict=True)])
    inputs = _line(*g.us.shape)

    def along(s: float) -> float:
        return evaluate_loss(loss, g.xs + s * states, g.us + s * inputs)

    if not (found := _stairs(along, 0.0)):
        return ""
    size = along(found[1]) - along(found[0])
    return (
        f"the loss is a staircase: of {CELLS} parts of a line through the motion {found[2]} jump, one by {size:.3g} "
        f"at {found[0]:.3g}"
    )


def stairs_of_policy(policy: Callable[..., Array], g: RolloutGradient, space: TangentSpace, time_step: float) -> str:
    """How the policy alone jumps around three states of the motion of `g`; empty where it is no staircase."""
    asked, nu = fresh(policy), g.us.shape[1]
    weight = _line(1, nu)[0]
    for k in sorted({0, len(g.us) // 2, len(g.us) - 1}):
        x, t, direction = g.xs[k], float(k * time_step), _line(1, space.size)[0]

        def u(s: float, x: Array = x, t: float = t, direction: Array = direction) -> Array:
            return np.asarray(asked(space.plus(x, s * direction), t), dtype=float)

        def along(s: float, u: Callable[[float], Array] = u) -> float:
            return float(weight @ u(s))

        if found := _stairs(along, SINGLE * float(np.abs(g.us[k]).sum())):
            change = u(found[1]) - u(found[0])
            i = int(np.argmax(np.abs(change)))
            return (
                f"the policy is a staircase: at t = {t:g} s, of {CELLS} parts of a line through x {found[2]} jump, "
                f"u[{i}] by {change[i]:.3g} at {found[0]:.3g}"
            )
    return ""


def _line(rows: int, columns: int) -> Array:
    """(rows, columns) a direction with no small entry."""
    random = np.random.default_rng(2)
    return np.asarray(random.uniform(0.5, 1.0, (rows, columns)) * random.choice([-1.0, 1.0], (rows, columns)))


def _stairs(f: Callable[[float], float], least: float) -> tuple[float, float, int] | None:
    """Where a function of one number jumps first, from and to, and in how many cells; None where it is no staircase."""
    with np.errstate(all="ignore"):
        for length in LENGTHS:
            ends = np.linspace(-length, length, CELLS + 1)
            try:
                values = np.array([f(float(s)) for s in ends])
                told = max(least, ROUNDED * float(np.max(np.abs(values))), PART * float(np.ptp(values)))
                if not np.max(np.abs(np.diff(values, 3))) > told:  # which is nothing where a function is smooth
                    continue
                jumps = [found for i in range(CELLS) if (found := _jump(f, ends[i : i + 2], values[i : i + 2], told))]
            except OUTSIDE:
                return None
            if len(jumps) >= STAIRS:
                return *jumps[0], len(jumps)
    return None


def _jump(f: Callable[[float], float], ends: Array, values: Array, least: float) -> Jump | None:
    """Where `f` jumps between two places (2,): the quarter that changes unlike the others is divided again."""
    sizes: list[float] = []
    for k in range(QUARTERINGS):
        places = np.linspace(float(ends[0]), float(ends[1]), 5)
        heights = np.array([values[0], *(f(float(s)) for s in places[1:-1]), values[1]])
        changes = np.diff(heights)
        apart = np.abs(changes - np.median(changes))
        i = int(np.argmax(apart))
        sizes.append(float(apart[i]))
        if not apart[i] > least or (k == SETTLED and apart[i] < KEPT * sizes[0]):
            return None
        ends, values = places[i : i + 2], heights[i : i + 2]
    return (float(ends[0]), float(ends[1])) if sizes[-1] > sizes[SETTLED] / 2 else None
