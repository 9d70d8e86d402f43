"""Measure gradients of a batch of rollouts through PyTorch and JAX, next to a loop of `differentiate_rollout`.

    python tests/benchmarks/batch_gradients.py [--library torch jax mjx] [--rollouts 64] [--steps 100]

A Go2 stands on four spherical feet, with random torques. The loss is the squared norm of the last state. All times are
of the processor, and those of compilations are left out. The overhead is that of a gradient of one step of a pendulum
over `differentiate_step`. MJX simulates the same robot with MuJoCo's contact. As reverse mode does not support its
solver, it has the Jacobians of steps in forward mode, and a reverse pass over them.
"""

import argparse
import importlib.util
import resource
import sys
import time
import timeit
from collections.abc import Callable
from pathlib import Path
from typing import Any

import _one_thread  # noqa: F401  before NumPy
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from helpers.robots import example_robot

import drake_diff as dd


def seconds(call: Callable[[], Any], calls: int = 1, repeats: int = 3) -> float:
    """Return the least processor time [s] per call."""
    call()
    return min(timeit.repeat(call, timer=time.process_time, number=calls, repeat=repeats)) / calls


def through_torch() -> tuple[Any, Callable[..., Any]]:
    import torch

    from drake_diff.torch import rollout, step

    torch.set_num_threads(1)

    def gradients(function: Any, model: dd.Model, x: np.ndarray, u: np.ndarray) -> list[np.ndarray]:
        tensors = [torch.tensor(x, requires_grad=True), torch.tensor(u, requires_grad=True)]
        states = function(model, *tensors)
        last = states if torch.is_tensor(states) else states[0][..., -1, :]
        return [g.numpy() for g in torch.autograd.grad((last**2).sum(), tensors)]

    return (step, rollout), gradients


def through_jax() -> tuple[Any, Callable[..., Any]]:
    import jax

    from drake_diff.jax import rollout, step

    jax.config.update("jax_enable_x64", True)
    compiled: dict[Any, Any] = {}

    def gradients(function: Any, model: dd.Model, x: np.ndarray, u: np.ndarray) -> list[np.ndarray]:
        def loss(x: Any, u: Any) -> Any:
            states = function(model, x, u)
            return ((states[0][..., -1, :] if isinstance(states, tuple) else states) ** 2).sum()

        if function not in compiled:
            compiled[function] = jax.jit(jax.grad(loss, argnums=(0, 1)))
        return [np.asarray(g) for g in compiled[function](x, u)]

    return (step, rollout), gradients


def through_mjx(model: dd.Model, x0: np.ndarray, us: np.ndarray) -> Callable[[], Any]:
    """Return the gradients of all rollouts by MJX, compiled."""
    import jax
    from mujoco import mjx

    from drake_diff.engines.mjx import MjxEngine

    jax.config.update("jax_enable_x64", True)
    engine, jnp = MjxEngine(model), jax.numpy
    states = np.array([np.concatenate(engine.native.to_native(x)) for x in x0])
    controls = np.array([[engine.native.control(u) for u in inputs] for inputs in us])
    nq, nx = engine.mjx.nq, states.shape[1]

    def step(point: Any) -> Any:
        data = engine.data.replace(qpos=point[:nq], qvel=point[nq:nx], ctrl=point[nx:])
        after = mjx.step(engine.mjx, data)
        return jnp.concatenate([after.qpos, after.qvel])

    def forward(x: Any, u: Any) -> Any:
        point = jnp.concatenate([x, u])
        return step(point), jax.jacfwd(step)(point)

    def backward(by_x: Any, jacobian: Any) -> Any:
        row = by_x @ jacobian
        return row[:nx], row[nx:]

    @jax.jit
    @jax.vmap
    def gradient(x: Any, inputs: Any) -> Any:
        last, jacobians = jax.lax.scan(forward, x, inputs)
        return jax.lax.scan(backward, 2 * last, jacobians, reverse=True)

    return lambda: jax.block_until_ready(gradient(states, controls))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--library", nargs="+", default=["torch", "jax"], choices=["torch", "jax", "mjx"])
    parser.add_argument("--rollouts", type=int, default=64)
    parser.add_argument("--steps", type=int, default=100)
    args = parser.parse_args()
    go2 = example_robot("go2.urdf", 0.005, feet=True, approximation="sap", leg=(0.0, 0.8, -1.6))
    us = np.random.default_rng(0).standard_normal((args.rollouts, args.steps, go2.nu))
    x0 = np.tile(go2.default_state, (args.rollouts, 1))
    loop = seconds(lambda: dd.differentiate_rollout(go2, x0, us, lambda x: (x**2).sum()), repeats=1)
    print(f"loop: {args.rollouts / loop:.1f} gradients of {args.steps} steps per second")
    expected = dd.differentiate_rollout(go2, x0, us, lambda x: (x**2).sum())
    pendulum = dd.example_model("pendulum", time_step=0.01)
    x, u = np.array([0.1, 0.2]), np.array([0.3])
    single = seconds(lambda: dd.differentiate_step(pendulum, x, u), 1000)
    for name in args.library:
        if importlib.util.find_spec({"mjx": "mujoco.mjx"}.get(name, name)) is None:
            print(f"{name}: not installed")
            continue
        if name == "mjx":
            batch = seconds(through_mjx(go2, x0, us), repeats=1)
            print(f"mjx: {args.rollouts / batch:.1f} gradients per second")
            continue
        (step, rollout), gradients = {"torch": through_torch, "jax": through_jax}[name]()
        batch = seconds(lambda g=gradients, f=rollout: g(f, go2, x0, us), repeats=1)
        pairs = zip(gradients(rollout, go2, x0, us), (expected.by_x0, expected.by_us), strict=True)
        gap = max(np.abs(a - b).max() / np.abs(b).max() for a, b in pairs)
        over = seconds(lambda g=gradients, f=step: g(f, pendulum, x, u), 1000) - single
        print(f"{name}: {args.rollouts / batch:.1f} gradients per second, {gap:.0e} from the loop's", end=", ")
        print(f"{1e6 * over:.0f} us over differentiate_step ({1e6 * single:.0f} us)")
    print(f"largest resident memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
