"""Recover hidden parameters from a motion: masses, a link length, and friction in contact.

A motion is simulated with parameters that the search does not know. From wrong initial values, `solve` changes all of
them together until the simulator's own steps reproduce the motion. Gradients are from AutoDiffXd where Drake supports
it, and otherwise (friction) from finite differences of the step. The source of each column is printed.

    python examples/hidden_parameters.py
"""

from pathlib import Path
from typing import Any

import numpy as np

import drake_diff as dd

PRECISION = 1e-2  # of the measured motion [m, rad, and per s]: a deviation of this size counts as 1
MODELS = Path(__file__).parent.parent / "models"


def swinging() -> tuple[dd.Model, np.ndarray, np.ndarray]:
    """Return a double pendulum, its initial state, and one second of inputs of its two motors."""
    model = dd.load_model(MODELS / "double_pendulum.urdf", time_step=0.01)
    t = model.time_step * np.arange(100)
    return model, np.array([0.4, -0.3, 0.0, 0.0]), np.column_stack([2 * np.sin(9 * t), 0.5 * np.cos(7 * t)])


def sliding() -> tuple[dd.Model, np.ndarray, None]:
    """Return a ball that slides along the ground. (The cost would jump at the step in which it starts to roll.)"""
    model = dd.load_model(MODELS / "sphere_on_ground.sdf", time_step=0.005)
    x0 = model.default_state
    x0[6], x0[10] = 0.1 - 9.81 / 1e4, 2.0  # resting height [m], speed [m/s]
    return model, x0, None


def problem(
    model: dd.Model, x0: np.ndarray, us: np.ndarray | None, hidden: dict[str, object], start: dict[str, object]
) -> dd.Problem:
    """Search from `start` for the parameters that reproduce the motion with the `hidden` parameters."""
    steps = 20 if us is None else len(us)
    measured = dd.rollout(model, x0, us, num_steps=steps, parameters=hidden).xs
    return dd.Problem(
        model,
        x0=x0,
        us=us,
        num_steps=steps,
        optimize="parameters",
        parameters=start,
        trajectory_cost=lambda xs, us: (((xs - measured) / PRECISION) ** 2).mean(),
    )


def main() -> None:
    cases: tuple[tuple[Any, dict[str, Any], dict[str, Any]], ...] = (
        (
            swinging(),
            {"upper.mass": 1.3, "lower.mass": 0.55, "elbow.offset": [0, 0, -0.72]},
            {"upper.mass": 0.8, "lower.mass": 0.9, "elbow.offset": [0, 0, -0.9]},
        ),
        (sliding(), {"ball.friction": 0.31}, {"ball.friction": 0.6}),
    )
    for (model, x0, us), hidden, start in cases:
        solution = dd.solve(problem(model, x0, us, hidden, start), method="shooting")
        print(f"{model.name}: {solution.status.value} after {len(solution.iterations)} iterations")
        vector, found = solution.vector, solution.vector.values
        truth = np.concatenate([np.atleast_1d(hidden[name]) for name in hidden])
        for name, source, value, true in zip(vector.names, vector.sources, found, truth, strict=True):
            print(f"  {name:20} {value:12.7f}  hidden {true:8.4f}  derivative from {source}")


if __name__ == "__main__":
    main()
