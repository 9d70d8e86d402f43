"""Train a PyTorch network that pushes a ball to a target, by gradients through contact.

A pusher of 1 kg on a rail touches a ball of 0.5 kg, pushes it, and lets it roll on. One network serves all targets.
Before the first step of the optimizer, the derivative of each time step of the batch is compared with differences. A
GradientWarning, which names the steps without a certified derivative, ends the script.

    pip install 'drake-diff[torch]'
    python examples/torch_push_policy.py    trains, and pushes to targets that it was not trained on
"""

import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

import drake_diff as dd
from drake_diff.torch import rollout

MODEL = Path(__file__).parent.parent / "models" / "two_spheres.sdf"
TIME_STEP, NUM_STEPS, ITERATIONS = 0.02, 50, 60
TOUCHING = torch.tensor([0.0, 0.1999, 0.0, 0.0], dtype=torch.float64)  # [m]; 0.1 mm deep, as the radii are 0.1 m
TARGETS = torch.linspace(0.4, 0.8, 8, dtype=torch.float64)  # [m] of the ball after 1 s
UNSEEN = torch.tensor([0.45, 0.6, 0.75], dtype=torch.float64)
BALL = 1  # its position in the state


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(5, 16), nn.Tanh(), nn.Linear(16, 1)).double()


def push(model: dd.Model, net: nn.Module, targets: Tensor, *, certify: bool = False) -> tuple[Tensor, Tensor]:
    """Return the states (B, N+1, 4) and forces (B, N, 1) of rollouts to the targets (B,)."""

    def policy(x: Tensor, t: float) -> Tensor:
        return 1.0 + net(torch.cat([x, targets[:, None]], -1))  # 1 N, so that the first motion pushes too

    return rollout(model, TOUCHING.expand(len(targets), 4), policy=policy, num_steps=NUM_STEPS, certify=certify)


def loss(xs: Tensor, us: Tensor, targets: Tensor) -> Tensor:
    """Return the mean squared miss [m^2] of the targets, plus a small cost of the force."""
    return ((xs[:, -1, BALL] - targets) ** 2).mean() + 1e-4 * (us**2).mean()


def certify(model: dd.Model, net: nn.Module) -> None:
    """Compare the derivatives of all steps with differences. Raises GradientWarning for one that is not certified."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", dd.exceptions.GradientWarning)
        loss(*push(model, net, TARGETS, certify=True), TARGETS).backward()


def train(model: dd.Model, net: nn.Module) -> list[float]:
    """Train by Adam, and return the loss of each iteration."""
    optimizer, losses = torch.optim.Adam(net.parameters(), lr=0.03), []
    for _ in range(ITERATIONS):
        optimizer.zero_grad()
        value = loss(*push(model, net, TARGETS), TARGETS)
        value.backward()
        optimizer.step()
        losses.append(value.item())
    return losses


if __name__ == "__main__":
    model, net = dd.load_model(MODEL, time_step=TIME_STEP), network()
    certify(model, net)
    print(f"the derivatives of {len(TARGETS) * NUM_STEPS} steps agree with differences")
    losses = train(model, net)
    print(f"loss {losses[0]:.5f} before training, {losses[-1]:.5f} after it")
    with torch.no_grad():
        ends = push(model, net, UNSEEN)[0][:, -1, BALL]
    print("targets", *(f"{target:.2f}" for target in UNSEEN), "reached", *(f"{end:.3f}" for end in ends))
