"""A motion as an engine took it, and how fast: states, energy, overlap, and where it broke off."""

from collections.abc import Callable
from dataclasses import dataclass
from statistics import median
from time import perf_counter
from typing import Any

import numpy as np

from drake_diff._base.arrays import Array, frozen
from drake_diff.engines.interface import Engine
from drake_diff.exceptions import NotOfferedError, SimulationError

BROKE_OFF = "broke off"
TIMED = 15  # calls whose median is told, after one that may compile
LONGEST = 1.0  # [s] less are timed where they take so long


@dataclass(frozen=True, eq=False, repr=False)
class EngineMotion:
    """What one engine, or a recording, did. `status` is "ok", or what its solver said first, and when."""

    times: Array  # (n,) [s]
    xs: Array  # (n, nx)
    us: Array  # (n - 1, nu)
    energy: Array | None  # (n,) [J] kinetic and potential; None where it does not compute it
    depth: Array | None  # (n,) [m] deepest overlap
    status: str

    def __repr__(self) -> str:
        return f"{len(self.xs)} states over {self.times[-1] - self.times[0]:.6g} s: {self.status}"

    @property
    def energy_change(self) -> float | None:
        """[J] from first to last state, inputs' work and damping included; None where there is no energy."""
        return None if self.energy is None else float(self.energy[-1] - self.energy[0])


def move(engine: Engine, x0: Array, us: Array) -> EngineMotion:
    """The motion from `x0` (nx,) under `us` (N, nu), up to the first step that the engine cannot take."""
    h, xs, status = engine.contract.time_step, [x0], "ok"
    for k, u in enumerate(us):
        try:
            xs.append(engine.step(xs[-1], u))
        except SimulationError as error:
            status = f"{BROKE_OFF} at t = {k * h:.4g} s: {error}"
            break
        if engine.status != "ok" and status == "ok":
            status = f"at t = {k * h:.4g} s: {engine.status}"
    states = np.array(xs)
    return measured(engine, np.array([k * h for k in range(len(xs))]), states, us[: len(xs) - 1], status)


def measured(engine: Engine, times: Array, xs: Array, us: Array, status: str = "ok") -> EngineMotion:
    """The motion `xs` (n, nx) with the energies and overlaps that `engine` finds in it."""

    def where_offered(ask: Callable[[Array], float]) -> Array | None:
        try:
            return frozen([ask(x) for x in xs])
        except NotOfferedError:
            return None

    energy, depth = where_offered(engine.energy), where_offered(engine.contact_depth)
    return EngineMotion(frozen(times), frozen(xs), frozen(us), energy, depth, status)


def seconds(call: Callable[[], Any]) -> float | None:
    """The median time of `call`, its first run, which may compile, left out; None where it is not offered."""
    try:
        call()
    except NotOfferedError:
        return None
    taken: list[float] = []
    while len(taken) < TIMED and sum(taken) < LONGEST:
        start = perf_counter()
        call()
        taken.append(perf_counter() - start)
    return median(taken)
