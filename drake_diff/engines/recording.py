"""A motion that was recorded elsewhere, by an engine that cannot be loaded here."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from drake_diff.arrays import Array


@dataclass(frozen=True, eq=False)
class Recording:
    """States in Drake's coordinates. `facts` is what is known of the engine's contract, by quantity."""

    name: str
    version: str
    times: Array  # (n,) [s], increasing
    xs: Array  # (n, nx)
    us: Array  # (n - 1, nu), held from one time to the next
    facts: Mapping[str, str] = field(default_factory=dict)
