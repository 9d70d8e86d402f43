"""Train a small neural network to balance the cart-pole, by gradient descent through Drake's simulator.

u = W2 tanh(W1 e + b1) + b2 with e = x - upright: 4 inputs, 16 hidden units, 1 force, 97 parameters, in plain NumPy.
Reverse differentiation through each rollout gives the gradient with respect to all 97 parameters, for Adam.

    python examples/neural_network_policy.py   trains, then tests with unseen initial states
"""

from pathlib import Path

import numpy as np

import drake_diff as dd
from drake_diff.motion import ParametricPolicy

MODEL = Path(__file__).parent.parent / "models" / "cart_pole.urdf"
TIME_STEP, HIDDEN, STEP_SIZE = 0.02, 16, 0.03
STAGES = ((30, 30), (60, 20), (120, 20))  # (steps of a rollout, iterations): short at first, because poles fall
UPRIGHT = np.array([0.0, np.pi, 0.0, 0.0])  # cart [m], angle [rad], and their rates
SPREAD = np.array([0.2, 0.2, 0.2, 0.4])  # largest deviation of an initial state from upright
LIMITS = np.array([2.0, 0.5])  # of cart [m] and angle [rad]; a larger deviation counts as fallen


def network(x: np.ndarray, t: float, parameters: np.ndarray) -> np.ndarray:
    """Return the force [N] (1,) at state x (4,), for floats or AutoDiffXd."""
    w1, b1, w2, b2 = np.split(parameters, np.cumsum([4 * HIDDEN, HIDDEN, HIDDEN]))
    hidden = np.tanh(w1.reshape(HIDDEN, 4) @ (x - UPRIGHT) + b1)
    return 10 * w2.reshape(1, HIDDEN) @ hidden + b2


def loss(xs: np.ndarray, us: np.ndarray) -> float:
    """Return the mean weighted squared distance from upright over the motion, plus a small cost of the force."""
    e = xs - UPRIGHT
    return ((e**2) @ [1.0, 10.0, 0.1, 0.1]).mean() + 1e-3 * (us**2).mean()


def first_parameters(random: np.random.Generator) -> np.ndarray:
    parameters = 0.5 * random.standard_normal(6 * HIDDEN + 1)
    parameters[5 * HIDDEN :] *= 0.1  # small initial forces
    return parameters


def initial_states(random: np.random.Generator, count: int) -> np.ndarray:
    return UPRIGHT + SPREAD * random.uniform(-1, 1, (count, 4))


def loss_and_gradient(
    model: dd.Model, parameters: np.ndarray, starts: np.ndarray, num_steps: int
) -> tuple[float, np.ndarray]:
    """Return the mean loss of rollouts from `starts` (m, 4), and its gradient (97,) with respect to the parameters."""
    policy = ParametricPolicy(network, parameters)
    found = [dd.differentiate_rollout(model, x0, None, loss, policy=policy, num_steps=num_steps) for x0 in starts]
    return float(np.mean([g.loss for g in found])), np.mean([g.by_policy for g in found], axis=0)


def train(model: dd.Model, parameters: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Train by Adam, with longer rollouts in each stage, and return the parameters."""
    mean, square, i = np.zeros_like(parameters), np.zeros_like(parameters), 0
    for num_steps, iterations in STAGES:
        for _ in range(iterations):
            value, gradient = loss_and_gradient(model, parameters, starts, num_steps)
            i += 1
            mean = 0.9 * mean + 0.1 * gradient
            square = 0.99 * square + 0.01 * gradient**2
            direction = mean / (1 - 0.9**i) / (np.sqrt(square / (1 - 0.99**i)) + 1e-8)
            parameters = parameters - STEP_SIZE * direction
        print(f"  {num_steps:3d} steps, iteration {i:3d}: loss {value:.5f}, |gradient| {np.linalg.norm(gradient):.5f}")
    return parameters


def survivors(model: dd.Model, parameters: np.ndarray, starts: np.ndarray, seconds: float = 5.0) -> int:
    """Count the `starts` (m, 4) from which the pole stays up and the cart on its rail for `seconds`."""
    policy, steps = ParametricPolicy(network, parameters), round(seconds / TIME_STEP)
    motions = [dd.rollout(model, x0, policy=policy, num_steps=steps).xs for x0 in starts]
    return sum(bool(np.all(np.abs(xs - UPRIGHT)[:, :2] < LIMITS)) for xs in motions)


def main() -> None:
    random = np.random.default_rng(0)
    model = dd.load_model(MODEL, time_step=TIME_STEP)
    untrained, starts, unseen = first_parameters(random), initial_states(random, 4), initial_states(random, 20)
    print(f"training {len(untrained)} parameters on {len(starts)} rollouts")
    trained = train(model, untrained, starts)
    losses = [loss_and_gradient(model, p, starts, STAGES[-1][0])[0] for p in (untrained, trained)]
    print(f"loss over {STAGES[-1][0] * TIME_STEP:.1f} s: {losses[0]:.5f} before, {losses[1]:.5f} after")
    before, now = survivors(model, untrained, unseen), survivors(model, trained, unseen)
    print(f"balanced for 5 s from {len(unseen)} unseen initial states: {before} before, {now} after")


if __name__ == "__main__":
    main()
