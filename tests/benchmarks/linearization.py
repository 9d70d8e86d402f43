"""The Panda arm's step Jacobian from each source, alone and per knot of 100, and what the libraries alone take.

    OPENBLAS_NUM_THREADS=1 python tests/benchmarks/linearization.py

Sources take turns in blocks; [us] a Jacobian: median of the blocks' fastest calls, and the quartiles of all calls.
"""

import platform
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
from step_derivatives import panda_arm, state

import drake_diff as dd
from drake_diff._base.refusal import Refusal
from drake_diff.derivatives.analytic import analytic_of
from drake_diff.engines.mujoco.engine import MujocoEngine
from drake_diff.engines.pinocchio import PinocchioEngine
from drake_diff.exceptions import ModelWarning
from drake_diff.model.step import advance

KNOTS, BLOCKS, CALLS = 100, 40, 8
REFERENCE = "autodiff, one step"
# (name, by, of, the ratio by/of that is wanted at least): speedups; or at most: what is left to lose.
AT_LEAST = (
    ("analytic, one step", REFERENCE, 25.0),
    ("analytic, knot of 100", REFERENCE, 25.0),
    ("implicit, one step", REFERENCE, 2.5),
    ("implicit, knot of 100", REFERENCE, 2.5),
    ("analytic, one step", "MuJoCo mjd_transitionFD centred", 2.0),
    ("analytic, knot of 100, ends known", "MuJoCo mjd_transitionFD centred", 2.0),
)
AT_MOST = (
    ("analytic, one step", "Pinocchio + NumPy Euler chain", 1.3),
    ("analytic, knot of 100, ends known", "Pinocchio + NumPy Euler chain", 1.3),
    ("analytic, knot of 100, ends known", "Pinocchio ABA derivatives, knot of 100", 1.3),
)


def sources(model: dd.Model) -> dict[str, tuple[Callable[[], object], int]]:
    """What to call, and how many Jacobians that gives."""
    random = np.random.default_rng(0)
    points = [state(model, random) for _ in range(KNOTS)]
    xs, us = (np.array(part) for part in zip(*points, strict=True))
    x, u, n, h = xs[0], us[0], model.nv, model.time_step
    ends = np.array([advance(model.double, *point) for point in points])
    peer, bodies = PinocchioEngine(model), MujocoEngine(model)
    data, damping = peer.data, peer.damping
    A, B = np.zeros((2 * n, 2 * n)), np.zeros((2 * n, model.nu))
    bodies._set(x, u)

    def chain() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q, v = x[:n], x[n:]
        by_q, by_v, inverse = pin.computeABADerivatives(peer.pin, data, q, v, u - damping * v)
        lower = np.hstack([h * by_q, np.eye(n) + h * (by_v - inverse * damping)])
        upper = h * lower
        upper[:, :n] += np.eye(n)
        v_next = v + h * data.ddq
        return np.vstack([upper, lower]), np.vstack([h * h * inverse, h * inverse]), np.r_[q + h * v_next, v_next]

    def each_knot() -> None:
        for q, v, force in zip(xs[:, :n], xs[:, n:], us, strict=True):
            pin.computeABADerivatives(peer.pin, data, q, v, force)

    def rnea() -> None:
        pin.computeRNEADerivatives(peer.pin, data, x[:n], x[n:], u)
        pin.crba(peer.pin, data, x[:n])

    def one(method: str) -> tuple[Callable[[], object], int]:
        return lambda: dd.differentiate_step(model, x, u, method=method), 1

    return {
        REFERENCE: one("autodiff"),
        "implicit, one step": one("implicit"),
        "analytic, one step": one("analytic"),
        "implicit, knot of 100": (lambda: dd.linearize(model, xs, us, "implicit"), KNOTS),
        "analytic, knot of 100": (lambda: dd.linearize(model, xs, us, "analytic"), KNOTS),
        "analytic, knot of 100, ends known": (lambda: dd.linearize(model, xs, us, "analytic", ends), KNOTS),
        "Pinocchio ABA derivatives": (lambda: pin.computeABADerivatives(peer.pin, data, x[:n], x[n:], u), 1),
        "Pinocchio ABA derivatives, knot of 100": (each_knot, KNOTS),
        "Pinocchio RNEA derivatives + CRBA": (rnea, 1),
        "Pinocchio + NumPy Euler chain": (chain, 1),
        "MuJoCo mjd_transitionFD centred": (
            lambda: mujoco.mjd_transitionFD(bodies.model, bodies.data, 1e-6, True, A, B, None, None),
            1,
        ),
        "Drake's double step": (lambda: advance(model.double, x, u), 1),
    }


def measure(calls: dict[str, tuple[Callable[[], object], int]]) -> dict[str, tuple[float, float, float]]:
    """[us] a Jacobian: the median of the blocks' fastest, and the quartiles of all."""
    best: dict[str, list[float]] = {name: [] for name in calls}
    every: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(BLOCKS):
        for name, (call, count) in calls.items():
            call()  # the first after another allocates anew
            times = []
            for _ in range(CALLS):
                start = time.perf_counter()
                call()
                times.append(1e6 * (time.perf_counter() - start) / count)
            best[name].append(min(times))
            every[name] += times
    quartiles = {name: statistics.quantiles(times, n=4) for name, times in every.items()}
    return {name: (statistics.median(times), quartiles[name][0], quartiles[name][2]) for name, times in best.items()}


def main() -> None:
    warnings.simplefilter("ignore", ModelWarning)
    with tempfile.TemporaryDirectory() as folder:
        model = dd.load_model(panda_arm(Path(folder)), time_step=0.005, weld_base="panda_link0")
    if isinstance(why := analytic_of(model), Refusal):
        raise SystemExit(f"no analytic steps: {why}")
    found = measure(sources(model))
    print(f"Python {platform.python_version()}, Pinocchio {pin.__version__}, MuJoCo {mujoco.__version__}")
    print(f"{'[us] a Jacobian':42}{'median':>9}{'quartiles':>18}{'autodiff /':>12}")
    for name, (median, low, high) in found.items():
        print(f"{name:42}{median:9.1f}{low:9.1f}{high:9.1f}{found[REFERENCE][0] / median:12.1f}")
    for limit, wanted, rows in (("at least", 1, AT_LEAST), ("at most", -1, AT_MOST)):
        for name, other, target in rows:
            ratio = (found[other][0] / found[name][0]) ** wanted
            verdict = "yes" if wanted * (ratio - target) >= 0 else "MISSED"
            print(f"{verdict:7} {ratio:6.2f} ({limit} {target}): {name} against {other}")


if __name__ == "__main__":
    main()
