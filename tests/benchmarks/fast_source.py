"""Which source the Jacobians of robots come from: all URDFs of example-robot-data, motors added, at 5, 20 and 50 ms.

    pip install -e '.[test]'
    python tests/benchmarks/fast_source.py [--robots PATTERN] [--steps 0.005,0.02,0.05] [--seed 0] [--count 4]
                                           [--mimic reduce] [--out FILE.json] [--markdown FILE.md]

Arms are welded to the world and everything else flies, as `load_model(file, actuators="all")` reads it. What flies is
put on the ground as well, `load_model(..., meshes="spheres", contact="ground", ground=0.8)`, its lowest point 1 mm in.
From --count random states near the default one, speeds N(0, 0.2), each takes ten steps under random inputs: within
the limits, and such that none alone changes its joint's speed by more than 0.3. A robot counts where every step was
linearized by its own equation ("analytic") by "auto". One such step of each robot is compared with AutoDiffXd, or with
differences of the step solved to rounding where Drake refuses that, in parts of the largest entry. What is in --out
already is not run again.
"""

import argparse
import fnmatch
import json
import os
import sys
import time
import warnings
from collections import Counter
from importlib.metadata import files
from pathlib import Path

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

import numpy as np  # noqa: E402
from pydrake.geometry import Role  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff._base.statistics import success_rate  # noqa: E402
from drake_diff.derivatives.implicit import form_of  # noqa: E402
from drake_diff.derivatives.polish import polished_steps  # noqa: E402
from drake_diff.derivatives.sources import choose  # noqa: E402
from drake_diff.derivatives.steps import take_steps  # noqa: E402
from drake_diff.exceptions import DrakeDiffError, GradientError, SimulationError  # noqa: E402
from drake_diff.model.parameters import select  # noqa: E402
from drake_diff.model.step import set_state  # noqa: E402

ARMS = ("ur*", "panda*", "z1*", "kinova*", "xarm*", "so1*", "allegro*", "finger*", "double_pendulum*", "TwoDofs*")
ARMS += ("talos_left_arm*",)
STEPS, SPEED, KICK, DEPTH = 10, 0.2, 0.3, 1e-3
WIDTHS = (3e-7, 1e-5, 1e-4)  # SceneGraph's iterations leave noise: the width that comes nearest counts
EXACT, BY_DIFFERENCES = 1e-8, 1e-5  # what two derivatives of one step may differ by, in parts of the largest entry


def robots(pattern):
    """The files by name."""
    found = {str(f): Path(f.locate()) for f in files("example-robot-data") if str(f).endswith(".urdf")}
    return sorted({p.name: p for p in found.values() if fnmatch.fnmatch(p.name, pattern)}.items())


def is_arm(name):
    return any(fnmatch.fnmatch(name, arm) for arm in ARMS)


def load(file, time_step, feet, mimic):
    options = {"base": "weld"} if is_arm(file.name) else {}
    options |= {"ground": 0.8, "contact": "ground", "meshes": "spheres"} if feet else {}
    return dd.load_model(file, time_step=time_step, actuators="all", mimic=mimic, **options)


def lowest(model, x):
    """The height of the lowest point of a shape that has an end."""
    set_state(model.double, x)
    query = model.plant.get_geometry_query_input_port().Eval(model.double.context)
    shapes = query.inspector().GetAllGeometryIds(Role.kProximity)
    boxes = [query.ComputeAabbInWorld(shape) for shape in shapes]
    return min((box.lower()[2] for box in boxes if box is not None), default=0.0)


def state(model, feet, random):
    """(nx,) near the default state, within the limits; free bodies upright at 1 m, or on the ground."""
    x, (lower, upper) = model.default_state.copy(), model.position_limits
    x[: model.nq] = np.clip(x[: model.nq] + 0.1 * random.standard_normal(model.nq), lower, upper)
    x[model.nq :] = SPEED * random.standard_normal(model.nv)
    for index in model.plant.GetFloatingBaseBodies():
        start = model.plant.get_body(index).floating_positions_start()
        x[start : start + 4], x[start + 6] = [1, 0, 0, 0], 1.0
        if feet:
            x[start + 6] -= lowest(model, x) + DEPTH
    return x


def parity(model, x, u):
    """How far the analytic Jacobian is from another, in parts of its largest entry, and what the other is."""
    mine = dd.differentiate_step(model, x, u, method="analytic")
    mine = np.hstack([mine.A, mine.B])
    try:
        other = dd.differentiate_step(model, x, u, method="autodiff")
    except (SimulationError, GradientError):
        return min(apart(mine, differences(model, np.concatenate([x, u]), width)) for width in WIDTHS), "differences"
    return apart(mine, np.hstack([other.A, other.B])), "autodiff"


def apart(mine, other):
    return float(np.abs(mine - other).max() / np.abs(other).max())


def differences(model, point, width):
    """(nx, nx + nu) central differences of the step solved to rounding."""
    size = width * np.maximum(1.0, np.abs(point))
    points = np.concatenate([point + np.diag(size), point - np.diag(size)])
    ends = polished_steps(model, select(model, ()), points[:, : model.nx], points[:, model.nx :]).x_next
    return ((ends[: len(point)] - ends[len(point) :]) / (2 * size[:, None])).T


def case(name, file, time_step, feet, mimic, seed, count):
    """What came of one robot at one time step."""
    begin, methods, whys, gap, whose = time.process_time(), Counter(), Counter(), None, ""
    model, random = load(file, time_step, feet, mimic), np.random.default_rng(seed)
    for _ in range(count):
        x = state(model, feet, random)
        set_state(model.double, x)
        inertia = np.diag(model.double.mass_matrix())[np.argmax(np.abs(model.actuation), axis=0) if model.nu else []]
        us = random.uniform(-1, 1, (STEPS, model.nu)) * np.minimum(form_of(model).limit, KICK * inertia / time_step)
        steps = take_steps(model, select(model, ()), x, us)
        found = choose(steps, "auto")
        methods.update(found.methods)
        whys.update(r for m, r in zip(found.methods, found.reasons, strict=True) if m != "analytic")
        known = [k for k, method in enumerate(found.methods) if method == "analytic"]
        if gap is None and known:
            k = known[-1]
            gap, whose = parity(model, steps.xs[k], us[k])
    why = whys.most_common(1)[0][0] if whys else ""
    return {
        "nv": model.nv,
        "methods": methods,
        "why": why,
        "gap": gap,
        "whose": whose,
        "cpu": time.process_time() - begin,
    }


def row(result):
    """One line of what came of it."""
    if "refused" in result:
        return f"refused: {result['refused']}"
    total, methods = sum(result["methods"].values()), result["methods"]
    text = ", ".join(f"{n} of {total} {method}" for method, n in sorted(methods.items()))
    gap = "" if result["gap"] is None else f", {result['gap']:.1e} from {result['whose']}"
    return f"{text}{gap}" + (f" ({result['why'][:300]})" if result["why"] else "")


def all_analytic(result):
    return "methods" in result and set(result["methods"]) == {"analytic"}


def agrees(result):
    return result["gap"] <= (EXACT if result["whose"] == "autodiff" else BY_DIFFERENCES)


def figures(results):
    """Lines of counts, each with its 95 % Wilson interval."""
    lines = []
    for feet in (False, True):
        for step in sorted({r["step"] for r in results}):
            own = [r for r in results if r["feet"] == feet and r["step"] == step]
            if own:
                where = "on the ground" if feet else "in flight"
                lines.append(f"{where}, {1e3 * step:g} ms: {told(sum(map(all_analytic, own)), len(own))}")
    compared = [r for r in results if r.get("gap") is not None]
    if compared:
        lines.append(f"equal to AutoDiffXd, or to differences: {told(sum(map(agrees, compared)), len(compared))}")
    return lines


def told(found, of):
    rate = success_rate(found, of)
    return f"{found} of {of} ({rate.lower:.3f} to {rate.upper:.3f})"


def markdown(results, text):
    """A table of robots by cases, and the counts."""
    steps = sorted({r["step"] for r in results})
    heads = [(feet, step) for feet in (False, True) for step in steps]
    names = [f"{'ground' if feet else 'flight'}, {1e3 * step:g} ms" for feet, step in heads]
    lines = [*text, "", "| robot | " + " | ".join(names) + " |", "|---" * (len(heads) + 1) + "|"]
    cells = {(r["robot"], r["feet"], r["step"]): r for r in results}
    for robot in sorted({r["robot"] for r in results}):
        found = [cells.get((robot, *head)) for head in heads]
        lines.append(f"| {robot} | " + " | ".join(map(cell, found)) + " |")
    return "\n".join(lines) + "\n"


def cell(result):
    if result is None:
        return ""
    if "refused" in result:
        return "refused"
    total = sum(result["methods"].values())
    known = result["methods"].get("analytic", 0)
    return "all" if known == total else f"{known} of {total}"


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robots", default="*.urdf")
    parser.add_argument("--steps", default="0.005,0.02,0.05")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--mimic")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--markdown", type=Path)
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    done = json.loads(given.out.read_text()) if given.out and given.out.exists() else []
    results, known = list(done), {(r["robot"], r["step"], r["feet"]) for r in done}
    for name, file in robots(given.robots):
        for step in map(float, given.steps.split(",")):
            for feet in (False,) if is_arm(name) else (False, True):
                if (name, step, feet) in known:
                    continue
                try:
                    found = case(name, file, step, feet, given.mimic, given.seed, given.count)
                except DrakeDiffError as error:
                    found = {"refused": " ".join(f"{type(error).__name__}: {error}".split())[:300]}
                results.append({"robot": name, "step": step, "feet": feet, **found})
                print(
                    f"{name} {'on the ground' if feet else 'in flight'} {1e3 * step:g} ms: {row(results[-1])}",
                    flush=True,
                )
                if given.out:
                    given.out.write_text(json.dumps(results))
    text = figures(results)
    print("\n".join(text))
    if given.markdown:
        given.markdown.write_text(markdown(results, text))
    return 0


if __name__ == "__main__":
    sys.exit(main())
