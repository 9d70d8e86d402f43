"""Test the verdicts of `check_plan` on verified plans of random tasks, unchanged and with one error in each.

The tasks are those of trust_plans.py. The trajectories of a plan are passed to `check_plan` as they are, and with an
error by seed: a state or an input at a knot, the inputs of a third of the motion, two exchanged columns, a weaker motor
or a slower clock. The referee of trust_plans.py, which shares no code with drake_diff, decides whether a motion holds
under a regulator. A changed plan may hold although its states do not follow from its inputs, so that rejections of
changed plans are no false alarms.
"""

from collections import Counter
from dataclasses import replace

import numpy as np
from trust import Figure
from trust_plans import PART, WIDE, Referee, drawn

import drake_diff as dd

COUNT = 300
ERRORS = ("state", "input", "inputs", "columns", "motor", "clock")
SIZES = (-1.5, -0.5)  # exponents of 10: errors of 3 to 30 % of a range


def changed(plan, kind, random):
    """Return the two trajectories of a plan with an error, or None if that error does not apply."""
    xs, us, size = np.array(plan.xs), np.array(plan.us), 10 ** random.uniform(*SIZES)
    k, i, j = random.integers(1, len(us)), random.integers(xs.shape[1]), random.integers(us.shape[1])
    middle = None if plan.us_mid is None else np.array(plan.us_mid)
    if kind == "state":
        xs[k, i] += size * np.ptp(xs[:, i])
    elif kind == "input":
        us[k, j] += size * np.ptp(us[:, j])
    elif kind == "columns":
        xs[:, [0, -1]] = xs[:, [-1, 0]]
    elif kind in ("inputs", "motor"):
        chosen = slice(len(us) // 3, 2 * len(us) // 3) if kind == "inputs" else slice(None)
        for signal in (us, middle):
            if signal is not None:
                signal[chosen, j] += size * np.ptp(us[:, j]) if kind == "inputs" else -size * signal[chosen, j]
    signals = replace(plan, xs=xs, us=us, us_mid=middle).trajectory()
    if kind == "clock":
        if plan.free_horizon is None:
            return None
        for signal in signals:
            signal.ScaleTime(1 + size)
    return signals


def refuted(task, verdict, steps):
    """Return whether the referee rejects the motion of a verdict, and whether it rejects it in finer steps."""
    referee, plant = Referee(task, verdict), "steps" if steps else "continuous"
    if referee.always():
        return True, True
    if referee.judge_open(plant) and referee.judge_feedback(plant, 1 if steps else 4, PART):
        return True, True
    return False, bool(steps and referee.judge_feedback("steps", 8, WIDE, 5 * WIDE))


def measure(seed, count):
    table, random = Counter(), np.random.default_rng([71, seed])
    for number in range(count * seed, count * (seed + 1)):
        task, kind = drawn(number), str(random.choice(ERRORS))
        problem = task.problem()
        try:
            plan = dd.solve(problem, method=task.method, max_iterations=300)
        except dd.exceptions.DrakeDiffError:
            continue
        for name in ("unchanged", kind) if plan.success else ():
            signals = changed(plan, name, random)
            if signals is None:
                continue
            steps = plan.u_final is None and not problem.is_map and problem.has_model
            verdict = dd.check_plan(problem, *signals, plant="steps" if steps else "continuous")
            wrong, finer = refuted(task, verdict, steps)
            table[name] += 1
            table["wrong"] += wrong
            table["false"] += wrong and verdict.success
            table["changed"] += name == kind
            table["detected"] += name == kind and not verdict.success
            table["rejected"] += name != kind and not (wrong or finer or verdict.success)
            if (wrong and verdict.success) or (name != kind and not (wrong or finer or verdict.success)):
                print(f"  seed {number}, {task.row}, {task.kind}, {name}, wrong {wrong}: {verdict.message[:200]}")
    print(f"  {', '.join(f'{name} {number}' for name, number in sorted(table.items()))}")
    return [
        Figure("wrong plans that check_plan verifies", table["false"], max(table["wrong"], 1), 0.0, False),
        Figure("verified plans, rejected when given", table["rejected"], max(table["unchanged"], 1), 0.03, False),
    ]
