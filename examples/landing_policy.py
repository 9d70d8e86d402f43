"""Train a policy of 36 weights by gradients through a landing; after a fall the body comes to rest at 0.75 m.

drake-diff run examples/landing_policy.py    trains the policy, and writes its motion as a plan that `verify` reproduces
python examples/landing_policy.py            compares with Powell's derivative-free method at as many simulated steps
"""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

import drake_diff as dd
from drake_diff.motion import ParametricPolicy

HEIGHT, HIDDEN, DROPS, UNSEEN = 0.75, 6, (0.6, 0.75, 0.9), (0.65, 0.85)  # heights [m]: final, and initial
FIRST = np.random.default_rng(0).normal(0, np.repeat([0.5, 0.1], [5 * HIDDEN, HIDDEN]))  # the initial weights
warnings.simplefilter("ignore", dd.exceptions.GradientWarning)  # mostly about the initial state, which is fixed
model = dd.load_model(Path(__file__).parent.parent / "models/hopper.sdf", time_step=0.02, fix_joints=("x", "swing"))
miss = dd.QuadraticCost(Q=np.diag([1, 0, 0.05, 0]), x_ref=[HEIGHT, 0, 0, 0])  # at rest at HEIGHT after 0.8 s


def network(x: np.ndarray, t: float, weights: np.ndarray) -> np.ndarray:
    """Return the force of the leg [N] (1,): a spring, a damper and a network."""
    inner, bias, outer = np.split(weights, [4 * HIDDEN, 5 * HIDDEN])
    hidden = np.tanh(inner.reshape(HIDDEN, 4) @ ((x - [0.6, 0.5, 0, 0]) * [3, 3, 0.5, 0.5]) + bias)
    return np.array([12 - 100 * (x[1] - 0.45) - 3 * x[3] + 30 * (outer @ hidden)])


def fall(function: Any, weights: np.ndarray, height: float, *loss: Any) -> Any:
    asked = {"policy": ParametricPolicy(network, weights), "num_steps": 40, "method": "continuous"}
    return function(model, [height, 0.45, 0, 0], None, *loss, **asked)


def train(evaluations: int, *, gradients: bool = True) -> np.ndarray:
    def mean(weights: np.ndarray) -> Any:
        if not gradients:
            return np.mean([miss(fall(dd.rollout, weights, z).xs[-1]) for z in DROPS])
        found = [fall(dd.differentiate_rollout, weights, z, lambda x: miss(x)) for z in DROPS]
        return np.mean([g.loss for g in found]), np.mean([g.by_policy for g in found], axis=0)

    how = ("L-BFGS-B", {"maxfun": evaluations}) if gradients else ("Powell", {"maxfev": evaluations})
    return minimize(mean, FIRST, jac=gradients, method=how[0], options=how[1]).x


def problem(weights: np.ndarray | None = None) -> dd.Problem:
    """Pose the tracking of the policy's motion from the first height; the policy's own inputs have zero cost."""
    motion = fall(dd.rollout, train(16) if weights is None else weights, DROPS[0])
    table = motion.times, motion.xs, np.vstack([motion.us, motion.us[-1:]])
    follow = dd.optimize.TrackingCost(table, Q=np.eye(4), R=[[1.0]])
    return dd.Problem(model, x0=motion.xs[0], num_steps=40, motion="continuous", us=motion.us, running_cost=follow)


if __name__ == "__main__":
    with dd.model.count_steps() as count:
        found = {"gradients": train(16)}
    found["Powell"] = train(count.steps // (40 * len(DROPS)), gradients=False)
    print(f"{count.steps} simulated steps each; 0.8 s after drops from {DROPS}, and {UNSEEN} m not trained on, at")
    for name, weights in found.items():
        heights = [fall(dd.rollout, weights, z).xs[-1][0] for z in DROPS + UNSEEN]
        print(f"{name} {np.round(heights, 3)} m; its plan: {dd.solve(problem(weights)).message}")
