"""Compare gradients through random impacts with reference gradients.

    pip install -e '.[test]'
    python tests/benchmarks/impacts.py [--seed 0] [--count 100] [--only toss,rod] [--out FILE.json]

For each case (impact_cases.py), some columns of the gradient are tested: with respect to the first state, contact
parameters and an input. The reference is Drake's own continuous plant with error-controlled Runge-Kutta 3 and central
differences of three widths (impact_truth.py). If these agree to 0.1 %, our value must be within 1 %, and otherwise it
must be `undefined`. The cost is processor time relative to the rollout alone, as medians of three alternating runs.
"""

import argparse
import hashlib
import json
import logging
import statistics
import sys
import time
import warnings
from dataclasses import asdict
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)
import numpy as np
from impact_cases import FAMILIES, Case, case
from impact_truth import Slopes, truth
from rates import success_rate

from drake_diff import differentiate_rollout
from drake_diff.exceptions import DrakeDiffError, GradientWarning
from drake_diff.model.parameters import select
from drake_diff.motion.flow import FlowSteps

HERE = Path(__file__).parent
RIGHT = 0.01  # relative to the reference
DEARER = 10.0  # relative to the rollout
TIMES = 3


def known_truth(one: Case, file: Path | None) -> tuple[float, list[Slopes]]:
    """Return the reference of a case, read from `file` if it was computed before for the same case and referee."""
    if file is None:
        return truth(one)
    referee, cases = ((HERE / f"impact_{name}.py").read_text() for name in ("truth", "cases"))
    text = repr(one) + referee + cases.split("def case(")[0]
    key = hashlib.sha256(text.encode()).hexdigest()
    found = json.loads(file.read_text()) if file.exists() else {}
    if key not in found:
        value, slopes = truth(one)
        found[key] = [value, [asdict(each) for each in slopes]]
        file.write_text(json.dumps(found))
    value, slopes = found[key]
    return value, [Slopes(**each | {"slopes": tuple(each["slopes"])}) for each in slopes]


def ours(one: Case, model, us):
    """Return (loss, {column: derivative times its unit}, columns reported as undefined)."""
    names = tuple(name for column in one.columns for name in one.parameters(column))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", GradientWarning)  # `undefined` has the same content
        found = differentiate_rollout(model, one.x0, us, one.loss, method="continuous", parameters=names)
    by = {column: float(found.by_x0[column]) for column in one.columns if isinstance(column, int)}
    columns = dict(zip(names, found.by_parameters, strict=True))
    by |= {c: float(sum(columns[name] for name in one.parameters(c))) for c in one.columns if one.parameters(c)}
    if "input" in one.columns:
        by["input"] = float(np.sum(found.by_us))
    without = {each.column for each in found.undefined}
    called = {c: {f"{model.state_names[c]}[0]"} if isinstance(c, int) else set(one.parameters(c)) for c in one.columns}
    if "input" in called:
        called["input"] = {f"{name} at all times" for name in model.input_names}
    undefined = {column for column, names in called.items() if names & without}
    return found.loss, {column: one.unit(column) * slope for column, slope in by.items()}, undefined


def cost(one: Case, model, us) -> float:
    """Return the processor time of value, gradient and verdict relative to the rollout alone, without compilation."""
    steps = FlowSteps(model, select(model, ()))

    def roll():
        steps.roll(np.array(one.x0), lambda x, k: us[k], len(us))

    def timed(call):
        begin = time.process_time()
        call()
        return time.process_time() - begin

    calls = max(1, int(0.02 / max(timed(roll), 1e-6)))
    rolls, gradients = [], []
    for _ in range(TIMES):
        rolls.append(timed(lambda: [roll() for _ in range(calls)]) / calls)
        gradients.append(timed(lambda: ours(one, model, us)))
    return statistics.median(gradients) / statistics.median(rolls)


def judge(one: Case, truths: Path | None, *, costs: bool = True) -> dict:
    """Return, for one case, each column's kind of slope, our value, its error and whether it is called undefined."""
    value, slopes = known_truth(one, truths)
    found = {"name": one.name, "family": one.family, "law": one.law, "value": value, "columns": []}
    try:
        model = one.model()
        us = np.full((one.num_steps, model.nu), one.input)
        loss, by, undefined = ours(one, model, us)
        found["off"] = abs(loss - value)
        found["cost"] = cost(one, model, us) if costs else None
    except DrakeDiffError as error:
        return found | {"failed": f"{type(error).__name__}: {error}"}
    for each in slopes:
        off = abs(by[each.column] - each.best)
        found["columns"].append(
            {
                "column": each.column,
                "kind": each.kind,
                "slopes": each.slopes,
                "doubt": each.doubt,
                "ours": by[each.column],
                "undefined": each.column in undefined,
                "error": off / abs(each.best) if each.best else off,
                "right": off <= RIGHT * abs(each.best) + each.doubt,
            }
        )
    return found


def figures(cases: list[dict]) -> list[tuple[str, int, int]]:
    """Return (name, number of cases, total) of each figure."""
    columns = [column for one in cases for column in one["columns"]]
    exist, narrow, none = ([c for c in columns if c["kind"] == kind] for kind in ("exists", "narrow", "none"))
    costs = [one["cost"] for one in cases if one.get("cost") is not None]
    given = [c for c in exist if not c["undefined"]]
    return [
        ("a derivative that exists is given, within 1 %", sum(c["right"] for c in given), len(exist)),
        ("one that exists is called undefined", len(exist) - len(given), len(exist)),
        ("one that exists is given and is off by more", sum(not c["right"] for c in given), len(exist)),
        ("where slopes do not settle it is called undefined", sum(c["undefined"] for c in none), len(none)),
        (
            "where they settle below +-1e-2 alone it is within 1 %, or undefined",
            sum(c["undefined"] or c["right"] for c in narrow),
            len(narrow),
        ),
        ("the gradient with its verdict costs at most 10 rollouts", sum(c <= DEARER for c in costs), len(costs)),
        ("a case that fails", sum("failed" in one for one in cases), len(cases)),
    ]


def told(name: str, found: int, of: int) -> str:
    if not of:
        return f"{name}: none"
    rate = success_rate(found, of)
    return f"{name}: {found} of {of}, {100 * rate.value:.1f} % ({100 * rate.lower:.1f} to {100 * rate.upper:.1f} %)"


def line(one: dict) -> str:
    """Return the line that is printed for a case."""
    if "failed" in one:
        return f"{one['name']} ({one['law']}): {one['failed']}"
    columns = [
        f"{c['column']} {c['kind']}{'' if c['kind'] != 'none' else ' ' + ' '.join(f'{s:.3g}' for s in c['slopes'])}: "
        + (f"{100 * c['error']:.2g} % off" + ("" if c["right"] or c["kind"] == "none" else " WRONG"))
        + (", undefined" if c["undefined"] else "")
        for c in one["columns"]
    ]
    dear = f", {one['cost']:.1f} rollouts" if one["cost"] is not None else ""
    return f"{one['name']} ({one['law']}): value {one['off']:.0e} off{dear}; {'; '.join(columns)}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--begin", type=int, default=0, help="the number of the first case")
    parser.add_argument("--only", default=",".join(FAMILIES), help="families, with commas between them")
    parser.add_argument("--truths", type=Path, help="where truths are kept for another run")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    logging.getLogger("drake").setLevel(logging.ERROR)  # no message about each half space
    only, cases = options.only.split(","), []
    for family in only:
        if family not in FAMILIES:
            parser.error(f"unknown family {family!r}, expected some of {', '.join(FAMILIES)}")
    for number in range(options.begin, options.begin + options.count):
        one = case(options.seed, number)
        if one.family in only:
            cases.append(judge(one, options.truths))
            print(line(cases[-1]), flush=True)
            if options.out:
                whole = {"seed": options.seed, "count": options.begin + options.count, "cases": cases}
                options.out.write_text(json.dumps(whole, indent=1) + "\n")
    for each in figures(cases):
        print(told(*each))
    return 0


if __name__ == "__main__":
    sys.exit(main())
