"""A public suite of 100 impacts and 100 smooth or contact steps with their exact slopes, for any engine.

`--write` writes gradients_suite.json: for each case the numbers of a mechanical system, its final state, the Jacobian
of this state with respect to the start state, the inputs and the constants, and a tolerance for each entry. The system
of a family is in `families`, in words. `--engine MODULE:FUNCTION` runs an engine: FUNCTION(case) returns the value (n,)
and the slopes (n, m), with NaN for slopes it cannot give, or raises NotImplementedError. It sees no value and no slope.

Slopes are derivatives by complex steps (Squire and Trapp, 1998) of closed forms, or of DOP853. At an event the complex
part of its time moves the state to the event and back, which is the saltation matrix. `doubt` is the largest change,
relative to the tolerance, when the tolerance of DOP853 increases by 30; a closed form has no doubt.
"""

import argparse
import importlib
import json
import sys
from pathlib import Path

import numpy as np

SUITE = Path(__file__).with_suffix(".json")
SEED = 44
TINY = 1e-30  # the complex step
EXACT, COARSER = 1e-13, 3e-12  # tolerances of DOP853
CLEAR = 0.03  # no event is nearer to the end, relative to the duration: the final state has no slope at an event
VALUE, SLOPE = 1e-6, 1e-5  # relative tolerances: 1/1000 of a 1 % error, and far above the doubt
DOUBT = 0.01  # relative to the tolerance; the suite has no case with more
SMALL = 1e-3  # of its row's largest effect: a smaller slope is compared with this part of it
LEAST = 1e-6  # the effect at least, in a row without effects
DIGITS = 12


def solve(family, numbers, duration, tolerance):
    """Return the final state (n,), its slopes (n, m) and the times of events."""
    first = np.array(list(numbers.values()))
    moved = first[:, None] + 1j * TINY * np.eye(len(first))
    end, times = family.end(dict(zip(numbers, moved, strict=True)), duration, tolerance)
    end = np.array(end)
    return end[:, 0].real, end.imag / TINY, [float(np.real(np.ravel(t)[0])) for t in times]


def tolerances(numbers, value, slopes, num_constants):
    """Return the tolerances of the value (n,) and of the slopes (n, m)."""
    sizes = np.abs(np.array(list(numbers.values())))
    varied = len(sizes) - num_constants
    sizes[:varied] = np.maximum(sizes[:varied], 0.1)
    largest = np.max(np.abs(slopes) * sizes, axis=1, keepdims=True)
    least = np.maximum(SMALL * largest, LEAST) / sizes
    return VALUE * np.maximum(np.abs(value), 0.1), SLOPE * np.maximum(np.abs(slopes), least)


def case(family, index, number):
    """Return case `number` of family `index`, from the first draw that is clear of events."""
    from gradients_suite_families import NearSwitchError

    random = np.random.default_rng([SEED, index, number])
    while True:
        numbers, duration = family.draw(random)
        numbers = {name: rounded(numbers[name], 4) for name in family.units}
        duration = rounded(duration, 4)
        try:
            value, slopes, times = solve(family, numbers, duration, EXACT)
        except NearSwitchError:
            continue
        is_clear = all(abs(t - duration) > CLEAR * duration for t in times)
        if is_clear and family.events[0] <= len([t for t in times if t < duration]) <= family.events[1]:
            break
    of_value, of_slopes = tolerances(numbers, value, slopes, len(family.constants))
    doubt = 0.0
    if family.is_integrated:
        other, others, _ = solve(family, numbers, duration, COARSER)
        doubt = max(np.max(np.abs(other - value) / of_value), np.max(np.abs(others - slopes) / of_slopes))
        if doubt > DOUBT:
            raise ValueError(f"{family.name} {number}: the slopes change by {doubt:.2g} of their tolerance")
    groups = {"state": family.state, "inputs": family.inputs, "constants": family.constants}
    return {
        "name": f"{family.name} {number}",
        "family": family.name,
        **{group: {name: numbers[name] for name in names} for group, names in groups.items()},
        "duration": duration,
        "events": [rounded(t, 6) for t in times if t < duration],
        "value": [rounded(v) for v in value],
        "slopes": [[rounded(v) for v in row] for row in slopes],
        "value_tolerance": [rounded(v, 2) for v in of_value],
        "slope_tolerance": [[rounded(v, 2) for v in row] for row in of_slopes],
        "doubt": rounded(doubt, 1),
    }


def rounded(value, digits=DIGITS):
    """Return a number rounded to significant digits. Without a difference from 0 it is 0, not -0."""
    return float(f"{value:.{digits}g}") + 0.0


def suite():
    """Return the whole suite. Only this needs SciPy."""
    from gradients_suite_families import FAMILIES

    importlib.import_module("gradients_suite_steps")  # registers the families without impacts
    families = {
        family.name: {
            "group": family.group,
            "source": "DOP853" if family.is_integrated else "closed form",
            "statement": family.statement,
            "state": family.state,
            "inputs": family.inputs,
            "constants": family.constants,
        }
        for family in FAMILIES.values()
    }
    cases = [case(f, index, number) for index, f in enumerate(FAMILIES.values()) for number in range(f.count)]
    about = (
        "value is the state after `duration` [s]; slopes[i][j] is the derivative of its entry i with respect to entry "
        "j of state, inputs and constants, in their order. An entry is right if it differs by at most its tolerance. "
        "Inputs are constant in time. Units of slopes follow from the units of the families' variables."
    )
    return {"version": 1, "seed": SEED, "about": about, "families": families, "cases": cases}


def text(whole):
    """Return the suite as JSON with a line for each case."""
    head = json.dumps({name: part for name, part in whole.items() if name != "cases"}, indent=1)
    lines = ",\n".join(json.dumps(each, separators=(",", ":")) for each in whole["cases"])
    return f'{head[:-2]},\n "cases": [\n{lines}\n ]\n}}\n'


COLUMNS = ("cases", "not supported", "failed", "values right", "slopes right", "wrong signs", "entries", "not given")


def compare(one, value, slopes, times):
    """Return the counts of `COLUMNS` of one case, and its slopes' largest error relative to the tolerance."""
    true, of_value = np.array(one["value"]), times * np.array(one["value_tolerance"])
    exact, of_slopes = np.array(one["slopes"]), times * np.array(one["slope_tolerance"])
    value, slopes = np.asarray(value, dtype=float), np.asarray(slopes, dtype=float)
    if value.shape != true.shape or slopes.shape != exact.shape:
        raise ValueError(f"shapes {value.shape} and {slopes.shape}, expected {true.shape} and {exact.shape}")
    given = ~np.isnan(slopes)
    off = np.abs(slopes - exact)[given]
    return {
        "values right": int(np.all(np.abs(value - true) <= of_value)),
        "slopes right": int(given.any() and np.all(off <= of_slopes[given])),
        "wrong signs": int(np.sum((off > of_slopes[given]) & ((slopes * exact)[given] < 0))),
        "entries": int(given.sum()),
        "not given": int((~given).sum()),
    }, float(np.max(off / of_slopes[given], initial=0.0))


def run(engine, whole, families, times, limit):
    """Run an engine on the cases and print its table. Return whether all that it gives is right."""
    counts = {name: dict.fromkeys(COLUMNS, 0) for name in whole["families"] if not families or name in families}
    worst = dict.fromkeys(counts, 0.0)
    hidden = ("value", "slopes", "value_tolerance", "slope_tolerance", "doubt", "events")
    for one in whole["cases"]:
        if one["family"] not in counts or counts[one["family"]]["cases"] == limit:
            continue
        row = counts[one["family"]]
        row["cases"] += 1
        try:
            found, off = compare(one, *engine({k: v for k, v in one.items() if k not in hidden}), times)
        except NotImplementedError:
            row["not supported"] += 1
        except Exception as error:  # of any engine, which the table counts
            row["failed"] += 1
            print(f"{one['name']}: {type(error).__name__}: {error}", file=sys.stderr)
        else:
            worst[one["family"]] = max(worst[one["family"]], off)
            for column, count in found.items():
                row[column] += count
    totals = {column: sum(row[column] for row in counts.values()) for column in COLUMNS}
    print("| family | " + " | ".join(COLUMNS) + " | worst slope / tolerance |")
    print("|---" * (len(COLUMNS) + 2) + "|")
    for name, row in [*counts.items(), ("all", totals)]:
        most = max(worst.values()) if name == "all" else worst[name]
        print(f"| {name} | " + " | ".join(str(row[column]) for column in COLUMNS) + f" | {most:.2g} |")
    tried = totals["cases"] - totals["not supported"]
    return tried == totals["values right"] == totals["slopes right"]


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--write", action="store_true", help="compute the truth and write the suite")
    parser.add_argument("--out", type=Path, default=SUITE, help="the file that --write writes")
    parser.add_argument("--engine", metavar="MODULE:FUNCTION", help="the engine that is compared with the suite")
    parser.add_argument("--suite", type=Path, default=SUITE, help="the suite of --engine")
    parser.add_argument("--families", default="", help="families, with commas between them; all by default")
    parser.add_argument("--limit", type=int, help="the number of cases of each family; all by default")
    parser.add_argument("--times", type=float, default=1.0, help="a factor of all tolerances; 1000 accepts 1 %%")
    options = parser.parse_args()
    if options.write == bool(options.engine):
        parser.error("expected either --write or --engine")
    if options.write:
        options.out.write_text(text(suite()))
        return 0
    module, _, function = options.engine.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    engine = getattr(importlib.import_module(module), function)
    whole = json.loads(options.suite.read_text())
    families = [name for name in options.families.split(",") if name]
    if unknown := set(families) - set(whole["families"]):
        parser.error(f"unknown families {', '.join(sorted(unknown))}, expected some of {', '.join(whole['families'])}")
    return 0 if run(engine, whole, families, options.times, options.limit) else 1


if __name__ == "__main__":
    sys.exit(main())
