"""Every engine's motion in one trace.mcap."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from drake_diff.engines.compared import Comparison, slugs
from drake_diff.engines.motion import EngineMotion
from drake_diff.mcap_log import Channel, write_mcap
from drake_diff.mcap_messages import TYPES
from drake_diff.trace_motion import Shown, input_channel, nanoseconds, state_channel, transform_channel


def write_comparison_trace(path: Path, comparison: Comparison) -> None:
    """Write every engine's states, energy and overlap under a topic of its name, and all bodies' frames."""
    metadata = {"model": comparison.model.name, "time_axis": "simulated", "engines": ", ".join(slugs(comparison))}
    write_mcap(path, list(_channels(comparison)), metadata, {})


def _channels(comparison: Comparison) -> Iterator[Channel]:
    model, motions = comparison.model, [e.motion for e in comparison.engines]
    names = slugs(comparison)
    for slug, motion in zip(names, motions, strict=True):
        shown = Shown(
            model, float(motion.times[1] - motion.times[0]) if len(motion.times) > 1 else 0.0, motion.xs, None
        )
        yield state_channel(shown, f"/{slug}/state", motion.xs)
        yield input_channel(shown, f"/{slug}/input", motion.times[:-1], motion.us)
        kind = TYPES["Diagnostics"]
        yield Channel(f"/{slug}/diagnostics", kind.cls, _measures(motion, kind.cls), {"units": kind.units})
    times = motions[0].times
    alike = {s: m for s, m in zip(names, motions, strict=True) if np.allclose(m.times, times[: len(m.times)])}
    yield transform_channel(model, times, {f"{s}/": m.xs for s, m in alike.items()})  # not what was sampled otherwise


def _measures(motion: EngineMotion, message: Any) -> Iterable[tuple[int, Any]]:
    """Energy and overlap; NaN where the engine does not compute them."""
    missing = np.full(len(motion.times), np.nan)
    energy = missing if motion.energy is None else motion.energy
    depth = missing if motion.depth is None else motion.depth
    for t, e, d in zip(motion.times.tolist(), energy.tolist(), depth.tolist(), strict=True):
        yield nanoseconds(t), message(energy_total=e, max_penetration=d)
