"""Measure detection, false-alarm and false-success rates of the checks, each with its 95 % Wilson interval.

    pip install -e '.[test]'
    python tests/benchmarks/trust.py [--only certificate,verify] [--seed 0] [--count N] [--out FILE.json]

Each part plants errors or builds random cases from the seed, and counts the verdicts of the toolkit. --count is the
number of cases of a part. By default, each part uses as many as its figures in docs/measured.md.
"""

import argparse
import importlib
import json
import logging
import platform
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

from rates import success_rate

# Each is a module trust_NAME in this folder, with `measure(seed, count)` and a default COUNT.
PARTS = (
    "certificate",
    "checkers",
    "rollout",
    "refinement",
    "plans",
    "given",
    "avoid",
    "reach",
    "verify",
    "compare",
    "design",
    "kept",
    "undefined",
    "truth",
    "impact",
    "elsewhere",
)


@dataclass(frozen=True)
class Figure:
    """`found` of `of` cases, whose share must be at least or at most `bound`; None if nothing is asked."""

    name: str
    found: int
    of: int
    bound: float | None
    at_least: bool = True

    @property
    def holds(self) -> bool:
        if self.bound is None:
            return True
        share = self.found / self.of
        return share >= self.bound if self.at_least else share <= self.bound

    def __str__(self) -> str:
        rate = success_rate(self.found, self.of)
        asked = ""
        if self.bound is not None:
            asked = f", asked {'at least' if self.at_least else 'at most'} {100 * self.bound:g} %"
        return (
            f"{self.name}: {self.found} of {self.of}, {100 * rate.value:.2f} % "
            f"({100 * rate.lower:.2f} to {100 * rate.upper:.2f} %){asked}" + ("" if self.holds else ": MISSED")
        )


def run(parts: Sequence[str], seed: int, count: int | None) -> dict[str, list[Figure]]:
    """Run the parts, print the figures of each part, and return them."""
    found = {}
    for name in parts:
        module, begin = importlib.import_module(f"trust_{name}"), time.perf_counter()
        found[name] = module.measure(seed, count or module.COUNT)
        print(f"{name} (seed {seed}, {count or module.COUNT} cases, {time.perf_counter() - begin:.0f} s)")
        for figure in found[name]:
            print(f"  {figure}", flush=True)
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", default=",".join(PARTS), help="parts, with commas between them")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    parts = options.only.split(",")
    for name in parts:
        if name not in PARTS:
            parser.error(f"unknown part {name!r}, expected some of {', '.join(PARTS)}")
    logging.getLogger("drake").setLevel(logging.ERROR)  # hides warnings about unknown tags in robot files
    found = run(parts, options.seed, options.count)
    if options.out:
        figures = {name: [vars(figure) | {"holds": figure.holds} for figure in ones] for name, ones in found.items()}
        whole = {"seed": options.seed, "count": options.count, "python": platform.python_version(), "parts": figures}
        options.out.write_text(json.dumps(whole, indent=2) + "\n")
    return 0 if all(figure.holds for ones in found.values() for figure in ones) else 1


if __name__ == "__main__":
    sys.modules["trust"] = sys.modules["__main__"]  # the parts import Figure from `trust`
    sys.exit(main())
