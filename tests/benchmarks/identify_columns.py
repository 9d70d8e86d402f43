"""Test whether `dd.explain` names columns of a recording that are exchanged, have the wrong sign, or are in degrees.

    pip install -e '.[test]'
    python tests/benchmarks/identify_columns.py [--seed 0] [--count 40]

The recordings are those of `identify.py` without a change: robots simulated by MuJoCo for 2 s, with encoder noise and
without velocities. In turn, a recording has no mistake (any named column is a false alarm), two positions or two inputs
are exchanged, a position or an input has the wrong sign, or angles are in degrees.
"""

import argparse
import time
from dataclasses import replace

import identify as causes
import numpy as np
from rates import success_rate

import drake_diff as dd

ROBOTS = ("ur5_robot", "double_pendulum", "panda", "z1", "so100", "kinova", "models/quadruped", "TwoDofs")
KINDS = ("nothing", "positions exchanged", "inputs exchanged", "position mirrored", "input mirrored", "degrees")


def mistaken(model, log, kind, random):
    """Return (the recording with the mistake, the names of the mistaken columns)."""
    xs, us = log.xs.copy(), log.us.copy()
    values, names = (us, model.input_names) if kind.startswith("input") else (xs[:, : model.nq], model.position_names)
    some = [int(i) for i in sorted(random.choice(values.shape[1], 2, replace=False))]
    if kind.endswith("exchanged"):
        values[:, some] = values[:, some[::-1]]
    elif kind.endswith("mirrored"):
        some = some[:1]
        values[:, some] *= -1
    elif kind == "degrees":
        angles = [i for i, name in enumerate(names) if name.endswith("_q")]
        values[:, angles] = np.degrees(values[:, angles])
        some = angles if len(angles) <= 4 else [angles[0], angles[-1]]
    return replace(log, xs=xs, us=us), [names[i] for i in some] if kind != "nothing" else []


def verdict(model, log, kind, columns):
    try:
        w = dd.explain(model, log, motion="continuous")
    except dd.exceptions.DrakeDiffError as error:
        return "refused", str(error)
    ends = {"exchanged": "exchanged", "mirrored": "the other sign", "degrees": "degrees, not radians"}
    end = ends.get(kind.split()[-1], "")
    each = [[words.endswith(end) and all(name in words for name in columns) for words in names]
            for names in (w.names, *w.alternatives)]  # fmt: skip
    if kind == "nothing":
        return ("right" if w.explained and not w.names else "alarm"), w.sentence
    if each[0] == [True]:
        return "named", w.sentence
    if [True] in each:
        return "among", w.sentence
    return ("another" if w.names else "right as it is" if w.explained else "unexplained"), w.sentence


def measure(seed, i):
    """Return (robot, kind, processor seconds, verdict, columns, sentence) of the i-th case."""
    robot, kind = ROBOTS[i // len(KINDS) % len(ROBOTS)], KINDS[i % len(KINDS)]
    random = np.random.default_rng([seed, i])
    model, log, _ = causes.recorded(robot, (), 10000 * seed + i)
    log, columns = mistaken(model, log, kind, random)
    begin = time.process_time()
    said, sentence = verdict(model, log, kind, columns)
    return robot, kind, time.process_time() - begin, said, columns, sentence


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=40)
    given = parser.parse_args()
    found = {}
    for i in range(given.count):
        robot, kind, seconds, said, columns, sentence = measure(given.seed, i)
        found.setdefault(kind != "nothing", []).append(said)
        print(f"{i:3} {robot:18} {seconds:5.1f} s {said:14} {kind}: {columns} -> {sentence}", flush=True)
    for is_mistaken, each in sorted(found.items()):
        for said in sorted(set(each)):
            rate = success_rate(each.count(said), len(each))
            what = "mistaken" if is_mistaken else "right"
            within = f"{100 * rate.lower:.3g} to {100 * rate.upper:.3g} %"
            print(f"{what} columns, {said}: {each.count(said)} of {len(each)} ({within})")


if __name__ == "__main__":
    main()
