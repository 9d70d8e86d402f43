"""Choose the gears of a swinging leg by the gradient of its optimal motion, in JAX.

A leg of two rods swings from one posture to another in 0.6 s. For each design, `solve` finds the motion with the least
squared torques of the joints. A motor's torque is that of its joint divided by the gear ratio, and its rotor adds
gear^2 times its inertia to the joint, so that a gear of medium ratio needs the least heat, the integral of the squared
torques of the motors. JAX differentiates the heat through the optimal motion.

    pip install 'drake-diff[jax]'
    python examples/jax_leg_design.py    prints the heat and its slopes at the first and the last design
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import drake_diff as dd
from drake_diff.jax import solve

jax.config.update("jax_enable_x64", True)

MODEL = Path(__file__).parent.parent / "models" / "double_pendulum.urdf"
MOTORS = ("shoulder_motor", "elbow_motor")  # of hip and knee
ROTOR = 5e-3  # [kg m^2]
TIME_STEP, NUM_STEPS, FIRST = 0.04, 15, (2.0, 2.0)
START, END = [-0.5, 0.6, 0.0, 0.0], [0.5, 0.2, 0.0, 0.0]  # hip and knee [rad], at rest


def problem() -> dd.Problem:
    model = dd.load_model(MODEL, time_step=TIME_STEP)
    effort = dd.QuadraticCost(R=np.eye(2))
    return dd.Problem(model, x0=START, x_goal=END, num_steps=NUM_STEPS, running_cost=effort)


def heat(swing: dd.Problem, logarithms: jax.Array) -> jax.Array:
    """Return the integral of the squared torques of the motors [N^2 m^2 s] for the logarithms of the gears (2,)."""
    gears = jnp.exp(logarithms)
    design = {f"{name}.gear_ratio": gear for name, gear in zip(MOTORS, gears, strict=True)}
    design |= {f"{name}.rotor_inertia": jnp.array(ROTOR) for name in MOTORS}
    plan = solve(swing, design, method="collocation")
    return TIME_STEP * ((plan.us / gears) ** 2).sum()


def improve(swing: dd.Problem, iterations: int = 12) -> np.ndarray:
    """Return the gears (2,) with the least heat, found by a quasi-Newton method from the first ones."""
    slopes = jax.value_and_grad(lambda logarithms: heat(swing, logarithms))

    def value_and_slopes(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        value, by_logarithms = slopes(jnp.array(logarithms))
        return float(value), np.asarray(by_logarithms)

    found = minimize(value_and_slopes, np.log(FIRST), jac=True, method="BFGS", options={"maxiter": iterations})
    return np.exp(found.x)


if __name__ == "__main__":
    swing = problem()
    for gears in (np.array(FIRST), improve(swing)):
        value, by_logarithms = jax.value_and_grad(lambda logarithms: heat(swing, logarithms))(jnp.log(gears))
        slopes = " ".join(f"{slope:.4f}" for slope in by_logarithms)
        print(
            f"gears {gears[0]:.2f} and {gears[1]:.2f}: heat {value:.4f} N^2 m^2 s, slopes by their logarithms {slopes}"
        )
