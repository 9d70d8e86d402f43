"""Which source the Jacobians of robots come from: all URDFs of example-robot-data, motors added, at 5, 20 and 50 ms.

    pip install -e '.[test]'
    python tests/benchmarks/fast_source.py [--robots PATTERN] [--steps 0.005,0.02,0.05] [--seed 0] [--count 4]
                                           [--mimic reduce] [--contact separable] [--tilt 0.01] [--out FILE.json]
                                           [--markdown FILE.md] [--planted]

Arms are welded to the world and everything else flies, as `load_model(file, actuators="all")` reads it. What flies is
put on the ground as well, `load_model(..., meshes="spheres", contact="ground", ground=0.8)`, its lowest point 1 mm in.
From --count random states near the default one, speeds N(0, 0.2), each takes ten steps under random inputs: within
the limits, and such that none alone changes its joint's speed by more than 0.3. A robot counts where every step was
linearized by its own equation ("analytic") by "auto". One such step of each robot is compared with AutoDiffXd, or with
differences of the step solved to rounding where Drake refuses that, in parts of the largest entry. What is in --out
already is not run again. With `--contact separable` shapes that overlap in every posture pass through each other.
Free bodies are exactly upright, in which boxes and wheels lie flat on the ground, where Drake's point of contact jumps;
with `--tilt` they are turned by so many rad, about a random axis.

With --planted, errors are planted instead in a contact of each robot on the ground, one after the other: its normal
tilted by 0.01 rad, its depth, how its point moves and how its depth changes 1 % off, how its normal turns off by
0.1 rad/m, and its two bodies swapped. What changes the Jacobian by more than 1e-6 of its largest entry is to
be refused by the certificate.
"""

import argparse
import fnmatch
import json
import os
import sys
import time
import warnings
from collections import Counter
from dataclasses import replace
from importlib.metadata import files
from pathlib import Path

for threads in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"):
    os.environ.setdefault(threads, "1")

import numpy as np  # noqa: E402
from rates import success_rate  # noqa: E402

import drake_diff as dd  # noqa: E402
from drake_diff._base import compiled  # noqa: E402
from drake_diff.derivatives.contact.pairs import Touches  # noqa: E402
from drake_diff.derivatives.contact.touching import AllPairs  # noqa: E402
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
MATTERS = 1e-6  # of the largest entry
WIDTHS = (3e-7, 1e-5, 1e-4)  # SceneGraph's iterations leave noise: the width that comes nearest counts
EXACT, BY_DIFFERENCES = 1e-8, 1e-5  # what two derivatives of one step may differ by, in parts of the largest entry


def robots(pattern):
    """The files by name."""
    found = [Path(f.locate()) for f in files("example-robot-data") if str(f).endswith(".urdf")]
    often = Counter(p.name for p in found)
    named = {p.name if often[p.name] == 1 else f"{p.parent.parent.name}/{p.name}": p for p in found}
    return sorted((name, p) for name, p in named.items() if fnmatch.fnmatch(p.name, pattern))


def is_arm(name):
    return any(fnmatch.fnmatch(name, arm) for arm in ARMS)


def load(file, time_step, feet, mimic, contact=True):
    options = {"contact": contact} | ({"base": "weld"} if is_arm(file.name) else {})
    options |= {"ground": 0.8, "contact": "ground", "meshes": "spheres"} if feet else {}
    return dd.load_model(file, time_step=time_step, actuators="all", mimic=mimic, **options)


def lowered(model, x, height):
    """`x` with its free body, whose height is in x[height], as low as leaves it DEPTH in the ground."""
    x = x.copy()

    def touches(z):
        x[height] = z
        set_state(model.double, x)
        return model.double.overlaps()

    free, inside = x[height] + 3.0, x[height] - 3.0
    assert touches(inside), f"{model.name} does not meet the ground"
    assert not touches(free), f"{model.name} touches in the air"
    while free - inside > 1e-7:
        middle = (free + inside) / 2
        free, inside = (free, middle) if touches(middle) else (middle, inside)
    x[height] = free - DEPTH
    return x


def state(model, feet, random, tilt=0.0):
    """(nx,) near the default state, within the limits; free bodies upright, or tilted, at 1 m, or on the ground."""
    x, (lower, upper) = model.default_state.copy(), model.position_limits
    x[: model.nq] = np.clip(x[: model.nq] + 0.1 * random.standard_normal(model.nq), lower, upper)
    x[model.nq :] = SPEED * random.standard_normal(model.nv)
    for index in model.plant.GetFloatingBaseBodies():
        start = model.plant.get_body(index).floating_positions_start()
        turn = np.append(1.0, tilt / 2 * random.standard_normal(3) if tilt else np.zeros(3))
        x[start : start + 4], x[start + 6] = turn / np.linalg.norm(turn), 1.0
        x = lowered(model, x, start + 6) if feet and model.contract.contact.collision_pairs else x
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


def case(file, time_step, feet, given):
    """What came of one robot at one time step."""
    begin, methods, whys, gap, whose = time.process_time(), Counter(), Counter(), None, ""
    touching = 0
    model = load(file, time_step, feet, given.mimic, given.contact or True)
    random = np.random.default_rng(given.seed)
    for _ in range(given.count):
        x = state(model, feet, random, given.tilt)
        set_state(model.double, x)
        inertia = np.diag(model.double.mass_matrix())[np.argmax(np.abs(model.actuation), axis=0) if model.nu else []]
        us = random.uniform(-1, 1, (STEPS, model.nu)) * np.minimum(form_of(model).limit, KICK * inertia / time_step)
        steps = take_steps(model, select(model, ()), x, us)
        found = choose(steps, "auto")
        touching += int(np.count_nonzero(steps.touching))
        methods.update(found.methods)
        whys.update(r for m, r in zip(found.methods, found.reasons, strict=True) if m != "analytic")
        known = [k for k, method in enumerate(found.methods) if method == "analytic"]
        known = [k for k in known if steps.touching[k]] or known
        if gap is None and known:
            k = known[-1]
            gap, whose = parity(model, steps.xs[k], us[k])
    why = whys.most_common(1)[0][0] if whys else ""
    return {
        "nv": model.nv,
        "touching": touching,
        "methods": methods,
        "why": why,
        "gap": gap,
        "whose": whose,
        "cpu": time.process_time() - begin,
    }


def tilted(touch):
    """Its normals by 0.01 rad, about a direction across them."""
    across = np.cross(touch.normal, np.eye(3)[np.argmin(np.abs(touch.normal), axis=1)])
    across /= np.linalg.norm(across, axis=1)[:, None]
    return replace(touch, normal=np.cos(0.01) * touch.normal + np.sin(0.01) * across)


def off(rows, factor):
    def change(touch):
        found = touch.change.copy()
        found[:, rows] *= factor
        return replace(touch, change=found)

    return change


def turned(touch):
    found, n = touch.change.copy(), touch.normal
    found[:, 3:6, :3] += 0.1 * (np.eye(3) - n[:, :, None] * n[:, None, :])
    return replace(touch, change=found)


ERRORS = {
    "normal": tilted,
    "depth": lambda touch: replace(touch, phi=1.01 * touch.phi),
    "motion of the point": off(slice(3), 1.01),
    "turn of the normal": turned,
    "change of the depth": off(slice(6, 7), 1.01),
    "bodies swapped": off(slice(7), -1.0),
}


OF_STATE = ("normal", "depth")  # which Drake's equation notices


def planted(file, time_step, mimic, seed):
    """Whether each error was refused; None where it changes nothing, and an empty answer where nothing touches."""
    compiled.has_numba = lambda: False  # the errors are planted in the form in NumPy, which the same trial judges
    model, random, right = load(file, time_step, True, mimic), np.random.default_rng(seed), Touches.at
    x, u, found = state(model, True, random)[None], np.zeros((1, model.nu)), {}
    touches = take_steps(model, select(model, ()), x[0], u).touching[0]
    A, B, methods = dd.linearize(model, x, u)
    if not touches or methods != ("analytic",):
        return {}
    trials = (model.whole if model.coupling is not None else model).cache("impulse trials", dict, of_structure=True)
    for name, error in ERRORS.items():
        trials.clear()
        touching = AllPairs.touching
        Touches.at = lambda touch, part, error=error: right(error(touch), part)
        if name in OF_STATE:
            Touches.at, AllPairs.touching = right, lambda *a, error=error, touching=touching: error(touching(*a))
        try:
            wrong = np.concatenate(dd.linearize(model, x, u, "analytic")[:2], axis=2)
            gap = np.abs(wrong - np.concatenate([A, B], axis=2)).max() / np.abs(A).max()
            found[name] = False if gap > MATTERS else None
        except GradientError:
            found[name] = True
        finally:
            Touches.at, AllPairs.touching = right, touching
    return found


def row(result):
    """One line of what came of it."""
    if "refused" in result:
        return f"refused: {result['refused']}"
    total, methods = sum(result["methods"].values()), result["methods"]
    text = ", ".join(f"{n} of {total} {method}" for method, n in sorted(methods.items()))
    text += f", {result['touching']} in contact"
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
    parser.add_argument("--contact", choices=("separable",))
    parser.add_argument("--tilt", type=float, default=0.0)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--markdown", type=Path)
    parser.add_argument("--planted", action="store_true")
    given = parser.parse_args()
    warnings.simplefilter("ignore")
    return plant(given) if given.planted else survey(given)


def plant(given):
    """Count what was refused, over robots."""
    refused, of = Counter(), Counter()
    for name, file in robots(given.robots):
        for step in [] if is_arm(file.name) else map(float, given.steps.split(",")):
            try:
                found = planted(file, step, given.mimic, given.seed)
            except DrakeDiffError as error:
                print(f"{name}: {type(error).__name__}", flush=True)
                continue
            print(f"{name} {1e3 * step:g} ms: {found}", flush=True)
            of.update(error for error, was in found.items() if was is not None)
            refused.update(error for error, was in found.items() if was)
    for error in ERRORS:
        print(f"{error}: refused {told(refused[error], of[error])}" if of[error] else f"{error}: never mattered")
    return 0 if refused == of else 1


def survey(given):
    """Count the robots on the fast source."""
    done = json.loads(given.out.read_text()) if given.out and given.out.exists() else []
    results, known = list(done), {(r["robot"], r["step"], r["feet"]) for r in done}
    for name, file in robots(given.robots):
        for step in map(float, given.steps.split(",")):
            for feet in (False,) if is_arm(file.name) else (False, True):
                if (name, step, feet) in known:
                    continue
                try:
                    found = case(file, step, feet, given)
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
