"""Identify an unknown torque of a pendulum by a small PyTorch network inside the simulation.

The real pendulum has a drag that the model does not have. Its motions are known at each step, with noise. The network
adds a torque, a function of the state, to the known inputs, and is trained on rollouts of the model: the gradient goes
through Drake's steps, so that no acceleration is measured.

    pip install 'drake-diff[torch]'
    python examples/torch_residual_force.py    trains, and compares the torque of the network with the real one
"""

from pathlib import Path

import numpy as np
import torch
from torch import Tensor, nn

import drake_diff as dd
from drake_diff.torch import rollout

MODEL = Path(__file__).parent.parent / "models" / "pendulum.urdf"
TIME_STEP, NUM_STEPS, MOTIONS, ITERATIONS = 0.02, 50, 8, 80
NOISE = np.array([1e-3, 1e-2])  # [rad], [rad/s]
FASTEST = 3.0  # [rad/s] in the comparison


def drag(speed: np.ndarray) -> np.ndarray:
    """Return the torque [N m] that the model does not have."""
    return -0.3 * speed * np.abs(speed)


def recordings(model: dd.Model) -> tuple[np.ndarray, np.ndarray]:
    """Return the measured states (M, N+1, 2) and the known inputs (M, N, 1) of the real pendulum."""
    random = np.random.default_rng(0)
    x0, us = random.uniform(-2, 2, (MOTIONS, 2)), 3 * random.standard_normal((MOTIONS, 1, 1))
    us = np.repeat(us, NUM_STEPS, axis=1)
    motions = []
    for start, inputs in zip(x0, us, strict=True):
        real = lambda x, t, u=inputs: u[round(t / TIME_STEP)] + drag(x[1:])  # noqa: E731  a policy of one line
        motions.append(dd.rollout(model, start, policy=real, num_steps=NUM_STEPS).xs)
    xs = np.array(motions)
    return xs + NOISE * random.standard_normal(xs.shape), us


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(1, 16), nn.Tanh(), nn.Linear(16, 1)).double()


def train(model: dd.Model, net: nn.Module, xs: Tensor, us: Tensor) -> list[float]:
    """Train by L-BFGS on the differences from the measured states, relative to the noise, and return the losses."""
    optimizer, losses = torch.optim.LBFGS(net.parameters(), max_iter=ITERATIONS, line_search_fn="strong_wolfe"), []

    def evaluate() -> Tensor:
        optimizer.zero_grad()
        simulated, _ = rollout(
            model, xs[:, 0], policy=lambda x, t: us[:, round(t / TIME_STEP)] + net(x[:, 1:]), num_steps=NUM_STEPS
        )
        loss = (((simulated - xs) / torch.from_numpy(NOISE)) ** 2).mean()
        loss.backward()
        losses.append(loss.item())
        return loss

    optimizer.step(evaluate)
    return losses


def errors(net: nn.Module) -> np.ndarray:
    """Return the errors [N m] of the network's torque at speeds up to FASTEST."""
    speeds = np.linspace(-FASTEST, FASTEST, 61)
    with torch.no_grad():
        return net(torch.from_numpy(speeds[:, None])).numpy()[:, 0] - drag(speeds)


if __name__ == "__main__":
    model, net = dd.load_model(MODEL, time_step=TIME_STEP), network()
    losses = train(model, net, *map(torch.from_numpy, recordings(model)))
    print(f"mean squared difference {losses[0]:.0f} of the noise before training, {losses[-1]:.2f} after it")
    print(f"largest error of the torque {np.abs(errors(net)).max():.2f} of {abs(drag(np.array(FASTEST))):.2f} N m")
