"""Measure models, quantities and peers, or report the reason why a measurement is missing."""

import sys
from collections.abc import Iterator
from dataclasses import asdict, dataclass

import numpy as np
from cases import BY_HORIZON, HORIZON, HORIZONS, Case, case
from native_peers import Mjx, peers_of
from peers import BASE, QUANTITIES, Peer
from timing import Sample, Spread, measure, ratios, spread, timed

from drake_diff.exceptions import GradientError, SimulationError

QUICK_MODELS = ("pendulum", "panda", "solo12", "sphere", "chain5")
BUDGET, QUICK_BUDGET = 3.0, 1.0  # [s] of rounds for one model and quantity
CHECKED = 10  # steps of a gradient in the comparison before the timing


@dataclass(frozen=True)
class Row:
    """One peer's time for one quantity: seconds per call, and ratios of processor time to the base's by round."""

    model: str
    joints: int  # nv, or 0 without a model
    quantity: str
    horizon: int | None
    peer: str
    how: str
    first: float  # wall time of the first call, with CHECKED steps if the quantity has a horizon
    calls: int  # per block
    blocks: int
    wall: Spread
    cpu: Spread
    base: str
    ratio: Spread
    gap: float | None  # difference from the base's result, over its largest entry or 1; None if coordinates differ

    def as_dict(self) -> dict:
        spreads = {name: getattr(self, name)._asdict() for name in ("wall", "cpu", "ratio")}
        return asdict(self) | spreads


@dataclass(frozen=True)
class Missing:
    model: str
    quantity: str  # "all" if the peer does not support the model
    peer: str
    reason: str


def measured(name: str, quantities: list[str], quick: bool) -> Iterator[Row | Missing]:
    """Yield the rows of one model for each quantity and horizon."""
    chosen = case(name)
    found, refused = peers_of(chosen, {Mjx.name} if quick else set())
    yield from (Missing(name, "all", peer, reason) for peer, reason in refused.items())
    try:
        for quantity in quantities:
            for horizon in _horizons(name, quantity, quick):
                print(f"{name}, {quantity}{f' over {horizon}' if horizon else ''}", file=sys.stderr, flush=True)
                yield from _group(chosen, quantity, horizon, found, QUICK_BUDGET if quick else BUDGET)
    finally:
        for peer in found:
            peer.close()


def _horizons(name: str, quantity: str, quick: bool) -> tuple[int, ...]:
    """Return the horizons of a quantity, or (0,) if it has no horizon."""
    if quantity in QUANTITIES[:2]:
        return (0,)
    if quick:
        return HORIZONS[:1]
    return HORIZONS if name in BY_HORIZON and quantity == "linearization" else (HORIZON,)


def _group(case: Case, quantity: str, horizon: int, peers: list[Peer], budget: float) -> Iterator[Row | Missing]:
    able, gaps, first, base = {}, {}, {}, None
    for peer in peers:
        reason = peer.missing.get(quantity)
        try:
            if reason is None:
                found, first[peer.name] = timed(lambda peer=peer: peer.answer(quantity, CHECKED))
                answer = peer.in_drake(quantity, found)
                base = answer if peer.name == BASE else base
                gaps[peer.name], able[peer.name] = _gap(answer, base), peer
        except (GradientError, SimulationError) as error:
            reason = str(error)
        if reason is not None:
            yield Missing(case.name, quantity, peer.name, reason)
    blocks = {name: peer.block(quantity, horizon) for name, peer in able.items()}
    samples = measure(blocks, budget)
    for name, sample in samples.items():
        how = able[name].how.get(quantity) or able[name].how.get("", "")
        about = {"model": case.name, "joints": case.model.nv, "quantity": quantity, "horizon": horizon or None}
        yield row(about, name, how, first[name], sample, (BASE, samples[BASE]), gaps[name])


def row(
    about: dict, peer: str, how: str, first: float, sample: Sample, base: tuple[str, Sample], gap: float | None
) -> Row:
    """Return a row. `about` contains model, joints, quantity and horizon."""
    return Row(
        **about,
        peer=peer,
        how=how,
        first=first,
        calls=sample.calls,
        blocks=len(sample.cpu),
        wall=spread(sample.wall),
        cpu=spread(sample.cpu),
        base=base[0],
        ratio=spread(ratios(sample, base[1])),
        gap=gap,
    )


def _gap(answer: np.ndarray | None, base: np.ndarray | None) -> float | None:
    if answer is None or base is None:
        return None
    return float(np.abs(answer - base).max() / max(1.0, np.abs(base).max()))
