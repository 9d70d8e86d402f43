"""The benchmark suite: one command that prints one table and can write a JSON file.

    pip install -e '.[bench]'
    python tests/benchmarks [--quick] [--only panda,step_jacobian] [--out FILE.json]
    python tests/benchmarks --compare OLD.json NEW.json

The models are cases.CASES, and the whole solves are solves.SOLVES. The quantities are peers.QUANTITIES, solve, and
start (the time of a new process that imports a package or prints --help).
--quick takes less than two minutes: five models, short horizons, no MJX. Peers that are not installed are listed.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)
import compare
from cases import CASES
from peers import QUANTITIES
from solves import SOLVES, solved
from starts import started
from suite import QUICK_MODELS, Missing, Row, measured
from table import document, machine, save, show

from drake_diff.exceptions import InputError, UnknownNameError

KINDS = (*QUANTITIES, "solve", "start")


def chosen(only: str, quick: bool) -> tuple[list[str], list[str], list[str]]:
    """Return the models, quantities and whole solves that `only` names, or the defaults if it names none."""
    names = [name for name in only.split(",") if name]
    for name in names:
        if name not in (*CASES, *KINDS, *SOLVES):
            raise UnknownNameError("benchmark", got=name, known=(*CASES, *KINDS, *SOLVES))
    places = [name for name in names if name not in KINDS]
    models = [n for n in CASES if (n in places if places else not quick or n in QUICK_MODELS)]
    solves = [n for n in SOLVES if n in places or not places]
    kinds = [n for n in KINDS if n in names] or [n for n in KINDS if n != "start" or not places]
    return models, kinds, solves if "solve" in kinds else []


def run(only: str, quick: bool, out: Path | None) -> dict:
    """Run the suite and return the JSON document. After each model, the results so far are saved to `out`."""
    models, kinds, solves = chosen(only, quick)
    before, quantities = machine(), [kind for kind in kinds if kind in QUANTITIES]
    found: list[Row | Missing] = []
    for part in _parts(models, quantities, solves, kinds, quick):
        found += part
        rows, missing = ([one for one in found if isinstance(one, kind)] for kind in (Row, Missing))
        whole = document(rows, missing, before, {"only": only, "quick": quick})
        if out:
            save(out, whole)
    return whole


def _parts(
    models: list[str], quantities: list[str], solves: list[str], kinds: list[str], quick: bool
) -> Iterator[list[Row | Missing]]:
    for name in models:
        yield [*measured(name, quantities, quick)] if quantities else []
    yield [*solved(solves, quick)]
    yield [*started(quick)] if "start" in kinds else []


def main() -> None:
    parser = argparse.ArgumentParser(prog="python tests/benchmarks", description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="less than two minutes")
    parser.add_argument("--only", default="", help="models, quantities and solves, separated by commas")
    parser.add_argument("--out", type=Path, help="where the JSON goes")
    parser.add_argument("--compare", nargs=2, type=Path, metavar=("OLD", "NEW"), help="two saved runs")
    given = parser.parse_args()
    try:
        if given.compare:
            compare.show(*compare.changes(*(compare.read(path) for path in given.compare)))
            return
        show(run(given.only, given.quick, given.out))
    except (InputError, UnknownNameError) as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
