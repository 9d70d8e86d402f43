"""Measure what drake_diff can do and save it as JSON. Run this before and after a change, and compare the two files.

    pip install -e '.[test]'
    python tests/benchmarks/acceptance.py run --out after.json [--subset] [--only PATTERN] [--skip PATTERN] [--tree DIR]
    python tests/benchmarks/acceptance.py compare before.json after.json [--removed PATTERN]
    python tests/benchmarks/acceptance.py stable first.json second.json --out before.json
    python tests/benchmarks/acceptance.py status after.json

The full run takes about an hour on two idle cores, and --subset takes a quarter of that. An item is one case of one
benchmark in this folder. It runs in its own process, and its name is KIND/CASE. `run` appends each result to --out and
skips the items in that file, so an interrupted run can be continued. With --retry, items that ended in an error run
again. --tree measures the drake_diff of another checkout with the benchmarks of this one. Load on the machine does not
change the results: limits inside drake_diff count processor time (`processor_clock/`), and so do the LIMITS at which an
item is ended, as its result states. Processor seconds are recorded. Only the ratios of the speed suite are compared.

`compare` uses the items that are in both files. An item has outcomes (good, of): a task solved, a robot with a verified
plan, planted errors detected, causes named. The exit status is 1 if more than ALLOWED of the outcomes of a kind are
lost, if a claim has become false, or if the second run is incomplete. `stable` keeps the items on which two runs of one
tree agree, without the costs that differ when rounded to six digits, and lists the other items.
"""

import argparse
import fnmatch
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import _one_thread  # noqa: F401 (before NumPy)

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests"))  # helpers

LIMITS = {"tasks": 300, "zoo": 400, "trust": 1500, "identification": 600, "readme": 900, "wheel": 900, "speed": 900}
STUCK = 4 * 3600  # [s] of wall time after which an item is ended, whatever its processor time
SOLVE_LIMIT = 200.0  # [s] of processor time for the solve of a task
ZOO_LIMIT = 240  # [s] of processor time for one `drake-diff plan`
STARTS = 5  # random starts of each task
ALLOWED = 0.01  # share of the outcomes of a kind that may be lost
SLOWER = 1.25  # a ratio is lost if its median rose by this factor and is above the old third quartile
COST_RISE = 0.01  # relative; larger rises are listed, but are not counted as lost
CLAIM = "no false claim"  # name of the outcomes of which no loss is allowed

# Drawn with seed 0 from the 111 files of zoo.py in which a joint moves.
ZOO = (
    "example-robot-data/urdf/ur3_joint_limited_robot.urdf",
    "example-robot-data/urdf/so101.urdf",
    "example-robot-data/urdf/romeo_small.urdf",
    "drake/cart_pole/cart_pole.sdf",
    "example-robot-data/robots/hyq_no_sensors.urdf",
    "example-robot-data/urdf/b1-z1.urdf",
    "drake_diff/models/acrobot.xml",
    "drake_diff/models/mass_spring_damper.sdf",
    "drake_diff/models/cart_pole.urdf",
    "example-robot-data/urdf/b1.urdf",
    "example-robot-data/urdf/alex_sake_hands.urdf",
    "example-robot-data/urdf/ur5_joint_limited_robot.urdf",
    "example-robot-data/robots/talos_full_v2_box.urdf",
    "drake/planar_gripper/planar_brick.sdf",
    "drake/acrobot/Acrobot_no_collision.urdf",
    "example-robot-data/urdf/z1.urdf",
    "example-robot-data/urdf/so100.urdf",
    "example-robot-data/urdf/pr2.urdf",
    "example-robot-data/urdf/borinot_flying_arm_2.urdf",
    "example-robot-data/robots/human.urdf",
    "example-robot-data/robots/tiago.urdf",
    "example-robot-data/robots/solo12.urdf",
    "example-robot-data/urdf/laikago.urdf",
    "drake_diff/models/box_push.sdf",
    "example-robot-data/robots/iris.urdf",
    "example-robot-data/urdf/centauro.urdf",
    "example-robot-data/robots/bolt.urdf",
    "example-robot-data/urdf/allegro_left_hand.urdf",
    "example-robot-data/urdf/panda.urdf",
    "drake_diff/models/pendulum.urdf",
)
# (number of seeds, number of cases for each seed) for each module trust_NAME.
TRUST = {
    "certificate": (3, 30),
    "rollout": (2, 30),
    "refinement": (2, 30),
    "plans": (3, 40),
    "avoid": (1, 30),
    "reach": (2, 30),
    "verify": (2, 30),
    "compare": (2, 30),
    "design": (2, 30),
    "kept": (2, 30),
    "undefined": (2, 32),
    "truth": (2, 32),
    "impact": (2, 30),
    "elsewhere": (2, 30),
}
IDENTIFIED = {"right": (0, 10), "single": (1, 20), "pair": (2, 20)}  # number of changes, number of cases
COLUMNS, FITS = 12, 12
# Sequences of the README's commands with their exit statuses. Each runs in an empty folder; {tree} is the checkout.
COMMANDS: dict[str, list[tuple[str, tuple[int, ...]]]] = {
    "run_and_its_directory": [
        ("run {tree}/examples/cart_pole_swing_up.py --out swing", (0,)),
        ("verify swing --time-limit 600", (0,)),
        ("list .", (0,)),
        ("compare-runs swing swing", (0,)),
        ("export --ros2 swing", (0,)),
        ("robustness swing --trials 3 --perturbations mass --out trials", (0, 1)),
    ],
    "verify_the_run_in_git": [("verify {tree}/artifacts/pendulum_swing_up --time-limit 600", (0,))],
    "plan_a_panda": [("plan --out panda", (0,)), ("verify panda --time-limit 600", (0,))],
    "audit": [("audit {tree}/models/cart_pole.urdf", (0,)), ("audit {tree}/models/sphere_on_ground.sdf", (0,))],
    "certify": [
        ("certify {tree}/models/cart_pole.urdf --out smooth", (0,)),
        ("certify {tree}/models/sphere_on_ground.sdf --out contact", (0, 1)),
    ],
    "compare": [("compare {tree}/models/double_pendulum.urdf --num-steps 50 --out compared", (0,))],
    "contact_table": [("contact-table", (0,))],
    "export_model": [
        ("export-model {tree}/models/double_pendulum.urdf --to gazebo --out gazebo", (0,)),
        ("export-model {tree}/models/double_pendulum.urdf --to isaaclab --out isaaclab", (0,)),
    ],
    "help": [(f"{name} --help", (0,)) for name in ("identify", "excite", "panel", "schema", "view", "export")],
}
SUBSET = {
    "tasks": "*/0",
    "zoo": "*/models/*,*/urdf/ur5*,*/urdf/so100*,*/robots/solo12*,*/urdf/panda*,*/Acrobot*",
    "trust": "*/0",
    "identification": "*/right/0,*/right/1,*/single/[0-7],*/pair/[0-3],*/columns/[0-5],*/fit/[0-1]",
    "readme": "*/snippet,*/run_and*,*/verify*,*/audit,*/certify,*/help",
    "wheel": "*",
    "speed": "*",
}
Result = dict[str, Any]


@dataclass(frozen=True)
class Item:
    kind: str
    case: tuple[Any, ...]

    @property
    def name(self) -> str:
        return "/".join(str(word) for word in (self.kind, *self.case))


def matches(name: str, patterns: str) -> bool:
    return any(fnmatch.fnmatch(name, pattern) for pattern in patterns.split(","))


def items(only: str, subset: bool) -> list[Item]:
    """Return the items in the order in which they run: the subset first, the speed suite last."""
    all_items = [
        *(Item("readme", (name,)) for name in ("snippet", *COMMANDS)),
        *(Item("tasks", (name, start)) for start in range(STARTS) for name in import_module("tasks").TASKS),
        *(Item("zoo", (name,)) for name in ZOO),
        *(Item("identification", (name, i)) for name, (_, count) in IDENTIFIED.items() for i in range(count)),
        *(Item("identification", ("columns", i)) for i in range(COLUMNS)),
        *(Item("identification", ("fit", i)) for i in range(FITS)),
        *(Item("trust", (name, seed)) for name, (seeds, _) in TRUST.items() for seed in range(seeds)),
        Item("wheel", ("plan",)),
        Item("speed", ("quick",)),
    ]
    chosen = [item for item in all_items if matches(item.name, only)]
    in_subset = [item for item in chosen if matches(item.name, SUBSET[item.kind])]
    rest = [] if subset else [item for item in chosen if item not in in_subset]
    return sorted([*in_subset, *rest], key=lambda item: item.kind == "speed")


# ------------------------------------------------------------------------------ measurements


def run_task(name: str, start: int) -> Result:
    """Solve a task with default options and return the referee's verdict."""
    row = import_module("tasks").attempt(name, 0, start, SOLVE_LIMIT)
    is_false = bool(row["false"])
    return {
        "outcomes": {"solved": [int(row["claimed"] and not is_false), 1], CLAIM: [int(not is_false), 1]},
        "status": row["status"],
        "why": (row["false"] or ("" if row["claimed"] else row["message"]))[:300],
        "cost": rounded(row.get("cost")),
        "method": row.get("method", ""),
        "solve_seconds": row["seconds"],
    }


def run_robot(name: str) -> Result:
    """Run `drake-diff plan FILE`."""
    zoo = import_module("zoo")
    zoo.CPU_LIMIT = ZOO_LIMIT
    paths = {f"{source}/{'/'.join(path.parts[-2:])}": path for source, path in zoo.files(None, Path())}
    if name not in paths:
        return {"outcomes": {}, "status": "not installed"}
    row = zoo.attempt(paths[name], 0)
    return {
        "outcomes": {"verified": [int(row["verified"]), 1]},
        "status": row["status"],
        "why": str(row["why"])[:300],
        "repairs": row["repairs"],
        "solve_seconds": row["seconds"],
    }


def run_trust(name: str, seed: int) -> Result:
    """Count planted errors that are detected and correct cases that pass. With a bound of 0, no loss is allowed."""
    outcomes = {}
    for figure in import_module(f"trust_{name}").measure(seed, TRUST[name][1]):
        good = figure.found if figure.at_least else figure.of - figure.found
        strict = not figure.at_least and figure.bound == 0.0
        outcomes[f"{CLAIM}: {figure.name}" if strict else figure.name] = [int(good), int(figure.of)]
    return {"outcomes": outcomes, "status": "measured"}


def run_identification(name: str, i: int) -> Result:
    """Run `dd.explain` on a recording, or `dd.identify` if `name` is "fit"."""
    if name == "fit":
        fits = import_module("identify_fits")
        kind = ("changed", "right", "changed", "friction")[i % 4]
        case = fits.measure(fits.ROBOTS[i % len(fits.ROBOTS)], kind, i)
        right = case.explained == (kind != "friction")
        outcomes = {"fit explained as it should be": [int(right), 1]}
        if case.covered:
            outcomes["intervals with the truth"] = [sum(case.covered), len(case.covered)]
        return {"outcomes": outcomes, "status": kind, "why": case.reason[:300]}
    if name == "columns":
        _, kind, _, verdict, _, sentence = import_module("identify_columns").measure(0, i)
        good = verdict in (("right",) if kind == "nothing" else ("named", "among"))
        return {"outcomes": {f"columns {verdict_of(kind)}": [int(good), 1]}, "status": verdict, "why": sentence[:300]}
    causes, changes = import_module("identify"), IDENTIFIED[name][0]
    case = causes.drawn(causes.ROBOTS[i % len(causes.ROBOTS)], changes, 0, i, False)
    good = case["verdict"] in (("right",) if not changes else ("named", "among"))
    outcomes = {f"{name} {verdict_of('nothing' if not changes else name)}": [int(good), 1]}
    if changes:
        outcomes[f"{name} named first"] = [int(case["verdict"] == "named"), 1]
    if case["covered"]:
        outcomes["intervals with the truth"] = [sum(case["covered"]), len(case["covered"])]
    return {"outcomes": outcomes, "status": case["verdict"], "why": f"{case['changed']} -> {case['said']}"[:500]}


def verdict_of(kind: str) -> str:
    return "not accused" if kind == "nothing" else "named, alone or among alternatives"


def run_readme(name: str) -> Result:
    """Run the README's snippet and compare its output with the README, or run one of COMMANDS."""
    tree = tree_under_test()
    outcomes, why = {}, []
    with tempfile.TemporaryDirectory() as folder:
        if name == "snippet":
            pattern = r"```python\n(.*?)```\n\n```text\n(.*?)```"
            code, printed = re.search(pattern, (tree / "README.md").read_text(), re.DOTALL).groups()
            done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)
            outcomes = {"runs": [int(done.returncode == 0), 1], "prints": [int(done.stdout == printed), 1]}
            why = [done.stderr[-300:]]
        else:
            for line, statuses in COMMANDS[name]:
                words = line.format(tree=tree).split()
                command = [sys.executable, "-m", "drake_diff.cli.main", *words]
                done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
                outcomes[line] = [int(done.returncode in statuses), 1]
                if done.returncode not in statuses:
                    why.append(f"{line}: exit {done.returncode}: {(done.stdout + done.stderr)[-300:]}")
    return {"outcomes": outcomes, "status": "run", "why": "; ".join(filter(None, why))}


def run_wheel(_: str) -> Result:
    """Build a wheel of the tree, install it in a new environment, and plan there."""
    pip = [sys.executable, "-m", "pip"]
    if subprocess.run([*pip, "--version"], capture_output=True).returncode != 0:
        return {"outcomes": {}, "status": "no pip"}
    with tempfile.TemporaryDirectory() as folder:
        source, wheels, venv = (Path(folder) / name for name in ("source", "wheels", "venv"))
        shutil.copytree(tree_under_test(), source, ignore=shutil.ignore_patterns(".git", "shared", "__pycache__"))
        quiet = {"check": True, "capture_output": True, "text": True}
        build = ["wheel", "--no-deps", "--no-index", "--no-build-isolation", "-w", str(wheels), str(source)]
        subprocess.run([*pip, *build], **quiet)
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(venv)], **quiet)
        python = venv / "bin" / "python"
        ours, its = (site_packages(Path(program)) for program in (sys.executable, python))
        (its / "outer.pth").write_text(f"{ours}\n")  # for the dependencies; .pth files in it are not read
        wheel = next(wheels.glob("*.whl"))
        subprocess.run([*pip, "--python", str(python), "install", "--no-deps", "--no-index", str(wheel)], **quiet)
        clean = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        asked = [str(python), "-c", "import drake_diff; print(drake_diff.__file__)"]
        where = subprocess.run(asked, cwd=folder, env=clean, **quiet).stdout.strip()
        model = ROOT / "models" / "pendulum.urdf"
        command = [str(venv / "bin" / "drake-diff"), "plan", str(model), "--out", f"{folder}/plan"]
        done = subprocess.run(command, cwd=folder, env=clean, capture_output=True, text=True)
        outcomes = {"is the wheel's": [int(where.startswith(str(venv))), 1], "plans": [int(done.returncode == 0), 1]}
        return {"outcomes": outcomes, "status": done.returncode, "why": "" if not done.returncode else done.stderr}


def site_packages(python: Path) -> str | Path:
    asked = [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"]
    return Path(subprocess.run(asked, check=True, capture_output=True, text=True).stdout.strip())


def run_speed(_: str) -> Result:
    """Run the quick speed suite and return the ratios of drake_diff's times to Drake's, with quartiles."""
    with tempfile.TemporaryDirectory() as folder:
        saved = Path(folder) / "speed.json"
        quantities = "step,step_jacobian,linearization,rollout_gradient,solve"
        command = [sys.executable, str(Path(__file__).parent), "--quick", "--only", quantities, "--out", str(saved)]
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            raise RuntimeError(done.stderr[-500:])
        rows = [row for row in json.loads(saved.read_text())["rows"] if row["peer"].startswith("drake_diff")]
    ratios = {
        f"{row['model']}, {row['quantity']}, {row['peer']}": [rounded(row["ratio"][q]) for q in ("median", "q1", "q3")]
        for row in rows
    }
    return {"outcomes": {"runs": [1, 1]}, "status": "measured", "ratios": ratios}


RUN: dict[str, Callable[..., Result]] = {
    "tasks": run_task,
    "zoo": run_robot,
    "trust": run_trust,
    "identification": run_identification,
    "readme": run_readme,
    "wheel": run_wheel,
    "speed": run_speed,
}
# Modules that are imported once, before processes are forked from this one.
MODULES = {"tasks": ["tasks"], "identification": ["identify", "identify_columns", "identify_fits"], "zoo": ["zoo"]}


def rounded(value: float | None) -> float | None:
    return None if value is None else float(f"{value:.6g}")


def tree_under_test() -> Path:
    import drake_diff

    return Path(drake_diff.__file__).resolve().parents[1]


# ------------------------------------------------------------------------------ processes


@dataclass
class Child:
    item: Item
    answer: Path
    log: Path
    start: float


def start(item: Item, folder: Path) -> tuple[int, Child]:
    """Fork a process that runs the item. It uses the modules that this process has imported."""
    stem = re.sub(r"\W", "_", item.name)
    child = Child(item, folder / f"{stem}.json", folder / f"{stem}.log", time.perf_counter())
    sys.stdout.flush()
    pid = os.fork()
    if pid:
        return pid, child
    try:
        os.setsid()
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        limit = LIMITS[item.kind]
        resource.setrlimit(resource.RLIMIT_CPU, (limit, limit + 10))
        log = os.open(child.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(log, 1)
        os.dup2(log, 2)
        try:
            result = RUN[item.kind](*item.case)
        except Exception as error:  # the failure is the item's result
            result = {"outcomes": {}, "status": "error", "why": f"{type(error).__name__}: {error}"[:500]}
        save(child.answer, result)
    finally:
        sys.stdout.flush()
        os._exit(0)


def end(child: Child, status: int, usage: resource.struct_rusage) -> Result:
    """Return the result that the process saved, or one that describes how the process ended."""
    if child.answer.is_file():
        result = json.loads(child.answer.read_text())
    else:
        limited = os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGKILL)
        tail = child.log.read_text(errors="replace")[-300:] if child.log.is_file() else ""
        why = f"ended by status {status}: {tail}"
        result = {"outcomes": {}, "status": "limit" if limited else "error", "why": why}
    seconds = round(usage.ru_utime + usage.ru_stime, 2)
    wall = round(time.perf_counter() - child.start, 1)
    return result | {"seconds": seconds, "wall": wall, "date": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())}


def run_all(queue: list[Item], workers: int) -> Iterator[tuple[Item, Result]]:
    """Yield each item with its result when it ends. The speed suite runs alone."""
    children: dict[int, Child] = {}
    signal.signal(signal.SIGTERM, lambda *_: sys.exit("terminated"))
    with tempfile.TemporaryDirectory() as name:
        try:
            while queue or children:
                while queue and len(children) < (1 if queue[0].kind == "speed" else workers):
                    item = queue.pop(0)
                    for module in MODULES.get(item.kind, []):
                        import_module(module)
                    pid, child = start(item, Path(name))
                    children[pid] = child
                pid, status, usage = os.wait4(-1, os.WNOHANG)
                if pid in children:
                    child = children.pop(pid)
                    yield child.item, end(child, status, usage)
                    continue
                for pid, child in children.items():
                    if time.perf_counter() - child.start > STUCK:
                        os.killpg(pid, signal.SIGKILL)
                time.sleep(0.02)
        finally:
            for pid in children:
                os.killpg(pid, signal.SIGKILL)


def commit_of(tree: Path) -> str:
    command = ["git", "-C", str(tree), "describe", "--always", "--dirty"]
    return subprocess.run(command, capture_output=True, text=True).stdout.strip()


def run(given: argparse.Namespace) -> int:
    tree = given.tree.resolve()
    if not (tree / "drake_diff" / "__init__.py").is_file():
        raise SystemExit(f"expected a checkout with a package drake_diff, got {tree}")
    path = f"{Path(__file__).parent / 'processor_clock'}:{tree}"
    if os.environ.get("PYTHONPATH") != path:
        os.execve(sys.executable, [sys.executable, *sys.argv], os.environ | {"PYTHONPATH": path})
    if time.monotonic is not time.process_time:
        raise SystemExit("expected the clock of processor_clock/sitecustomize.py, got another sitecustomize")
    if tree_under_test() != tree:
        raise SystemExit(f"expected the drake_diff of {tree}, got that of {tree_under_test()}")
    quieten()
    saved = read(given.out) if given.out.is_file() else {"results": {}}
    results = saved["results"]
    if given.retry:
        results = {name: row for name, row in results.items() if row["status"] not in ("error", "limit")}
    asked = [item for item in items(given.only, given.subset) if not matches(item.name, given.skip)]
    queue = [item for item in asked if item.name not in results]
    if given.list:
        print("\n".join(item.name for item in queue))
        return 0
    about = {"tree": commit_of(tree), "benchmarks": commit_of(ROOT), "python": sys.version.split()[0]}
    save(given.out, about | {"complete": not queue, "results": results})
    total, began = len(queue), time.perf_counter()
    for count, (item, row) in enumerate(run_all(queue, given.workers), 1):
        results[item.name] = row
        save(given.out, about | {"complete": count == total, "results": results})
        marks = ", ".join(f"{good}/{of_all}" for good, of_all in row["outcomes"].values())
        clock = f"{count}/{total} {time.perf_counter() - began:6.0f} s  {row['seconds']:7.1f} s"
        print(f"{clock}  {item.name}: {row['status']} {marks} {row.get('why', '')[:160]}", flush=True)
    return 0


def quieten() -> None:
    import logging
    import warnings

    from drake_diff.exceptions import ModelWarning

    warnings.simplefilter("ignore", ModelWarning)
    logging.getLogger("drake").setLevel(logging.ERROR)


def save(path: Path, document: dict[str, Any]) -> None:
    draft = path.with_suffix(".part")
    draft.write_text(json.dumps(document, indent=1) + "\n")
    draft.replace(path)


def read(path: Path) -> dict[str, Any]:
    document = json.loads(path.read_text())
    if not isinstance(document.get("results"), dict):
        raise SystemExit(f"{path}: expected the JSON that `acceptance.py run` writes, got no results")
    return document


# ------------------------------------------------------------------------------ comparison of two files


@dataclass(frozen=True)
class Change:
    """The change of one outcome of one item: how many of `of_all` cases are lost (negative if gained)."""

    item: str
    outcome: str
    lost: float
    of_all: int
    why: str

    @property
    def kind(self) -> str:
        strict = self.outcome.startswith(CLAIM)
        return f"{self.item.split('/')[0]}: {CLAIM}" if strict else self.item.split("/")[0]


def changes(before: dict[str, Result], after: dict[str, Result]) -> list[Change]:
    """Return the change of every outcome of the items in both files. An outcome missing from `after` is lost."""
    rows = []
    for item in sorted(before.keys() & after.keys()):
        old, new = before[item], after[item]
        for outcome, (good, of_all) in old["outcomes"].items():
            if not of_all:
                continue
            good_now, all_now = new["outcomes"].get(outcome, (0, 0))
            share = good_now / all_now if all_now else 0.0
            why = f"{good} of {of_all} -> {good_now} of {all_now}; {new['status']}: {new.get('why', '')[:200]}"
            rows.append(Change(item, outcome, round(good - share * of_all, 6), of_all, why))
        for name, (median, _, upper) in old.get("ratios", {}).items():
            now = new.get("ratios", {}).get(name)
            slower = now is None or (now[0] > SLOWER * median and now[1] > upper)
            faster = now is not None and median > SLOWER * now[0]
            why = "no longer measured" if now is None else f"ratio {median:g} -> {now[0]:g}"
            rows.append(Change(item, name, float(slower) - float(faster), 1, why))
    return rows


def compare(given: argparse.Namespace) -> int:
    """Print the lost and gained outcomes, and return the exit status."""
    first, second = read(given.before), read(given.after)
    before = {name: row for name, row in first["results"].items() if not matches(name, given.removed)}
    after = second["results"]
    removed = len(first["results"]) - len(before)
    rows = changes(before, after)
    failed = not second.get("complete", False)
    print(f"before: {first.get('tree')}, {len(before)} items; after: {second.get('tree')}, {len(after)} items")
    if removed:
        print(f"left out, as removed on purpose ({given.removed}): {removed} items")
    if failed:
        print("the second run is INCOMPLETE")
    absent = sorted(before.keys() - after.keys())
    if absent:
        print(f"not run in the second: {len(absent)} items, such as {', '.join(absent[:5])}")
    for kind in sorted({row.kind for row in rows}):
        group = [row for row in rows if row.kind == kind]
        total = sum(row.of_all for row in group)
        lost = sum(max(row.lost, 0.0) for row in group)
        gained = sum(max(-row.lost, 0.0) for row in group)
        allowed = 0.0 if CLAIM in kind else ALLOWED
        over = lost > allowed * total + 1e-9
        failed = failed or over
        verdict = f"LOST MORE THAN {100 * allowed:g} %" if over else "ok"
        print(f"{kind}: {total} outcomes, lost {lost:g}, gained {gained:g}: {verdict}")
        for row in sorted(group, key=lambda row: -row.lost):
            if row.lost:
                print(
                    f"  {'lost' if row.lost > 0 else 'gained'} {abs(row.lost):g}  {row.item}, {row.outcome}: {row.why}"
                )
    for line in costs(before, after):
        print(line)
    return int(failed)


def costs(before: dict[str, Result], after: dict[str, Result]) -> Iterator[str]:
    """Yield lines that list the costs that rose and the processor time. They are for information only."""
    rises = []
    for item in sorted(before.keys() & after.keys()):
        old, new = before[item].get("cost"), after[item].get("cost")
        if old is not None and new is not None and new - old > COST_RISE * max(abs(old), 1e-6):
            rises.append((item, old, new))
    yield f"costs that rose by more than {100 * COST_RISE:g} %: {len(rises)}"
    for item, old, new in rises:
        yield f"  {item}: {old:g} -> {new:g}"
    for kind in RUN:
        both = [name for name in before.keys() & after.keys() if name.startswith(f"{kind}/")]
        if both:
            old, new = (sum(rows[name]["seconds"] for name in both) for rows in (before, after))
            yield f"processor seconds, {kind}: {old:.0f} -> {new:.0f}"


def stable(given: argparse.Namespace) -> int:
    """Keep the items on which two runs of the same tree agree."""
    first, second = read(given.first), read(given.second)
    if first.get("tree") != second.get("tree"):
        raise SystemExit(f"expected two runs of one tree, got {first.get('tree')} and {second.get('tree')}")
    results, excluded = {}, {}
    for name, row in first["results"].items():
        other = second["results"].get(name)
        if other is None:
            excluded[name] = "only in the first run"
        elif row["status"] in ("error", "limit") or other["status"] in ("error", "limit"):
            excluded[name] = f"{row['status']}, {other['status']}: {row.get('why', '')[:200]}"
        elif row["outcomes"] != other["outcomes"]:
            excluded[name] = f"{row['outcomes']} against {other['outcomes']}"
        else:
            results[name] = row if row.get("cost") == other.get("cost") else row | {"cost": None}
            if "ratios" in row:
                both = {key: (row["ratios"][key], other["ratios"][key]) for key in row["ratios"]}
                results[name] = row | {"ratios": {key: widest(*pair) for key, pair in both.items()}}
    excluded |= {name: "only in the second run" for name in second["results"] if name not in first["results"]}
    complete = first.get("complete", False) and second.get("complete", False)
    save(given.out, first | {"complete": complete, "results": results, "excluded": excluded})
    print(f"{len(results)} items agree, {len(excluded)} are excluded")
    for name, why in sorted(excluded.items()):
        print(f"  {name}: {why}")
    return 0


def widest(first: list[float], second: list[float]) -> list[float]:
    """Return the larger median, the smaller first quartile and the larger third quartile."""
    return [max(first[0], second[0]), min(first[1], second[1]), max(first[2], second[2])]


def status(given: argparse.Namespace) -> int:
    """Print the number of items of each kind, and the items with an outcome that is not good."""
    document = read(given.file)
    kinds: dict[str, Counter[str]] = defaultdict(Counter)
    for name, row in document["results"].items():
        good = all(good == of_all for good, of_all in row["outcomes"].values()) and row["outcomes"]
        kinds[name.split("/")[0]]["all good" if good else "not all good"] += 1
        if not good:
            print(f"{name}: {row['status']} {row['outcomes']} {row.get('why', '')[:200]}")
    for kind, count in kinds.items():
        seconds = sum(r["seconds"] for n, r in document["results"].items() if n.startswith(f"{kind}/"))
        print(f"{kind}: {dict(count)}, {seconds:.0f} s")
    print("complete" if document.get("complete") else "incomplete")
    return 0


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    sub = commands.add_parser("run", help="measure a tree")
    sub.add_argument("--out", type=Path, required=True, help="a JSON file; what is in it already is not run again")
    sub.add_argument("--tree", type=Path, default=ROOT, help="the checkout whose drake_diff is measured")
    sub.add_argument(
        "--only", default="*", help="patterns of KIND/CASE with commas between them, such as 'tasks/*pole*'"
    )
    sub.add_argument(
        "--skip", default="", help="patterns of items to leave out, such as 'wheel/*' where there is no pip"
    )
    sub.add_argument("--subset", action="store_true", help="fixed items that take a quarter of the time")
    sub.add_argument("--workers", type=int, default=2)
    sub.add_argument("--retry", action="store_true", help="run items again that ended in an error or at a limit")
    sub.add_argument("--list", action="store_true", help="print the items that would run")
    sub.set_defaults(call=run)
    sub = commands.add_parser("compare", help="what was lost and gained; exit status 1 for more than 1 in 100")
    sub.add_argument("before", type=Path)
    sub.add_argument("after", type=Path)
    sub.add_argument("--removed", default="", help="patterns of items whose capability was removed on purpose")
    sub.set_defaults(call=compare)
    sub = commands.add_parser("stable", help="keep the items on which two runs of one tree agree")
    sub.add_argument("first", type=Path)
    sub.add_argument("second", type=Path)
    sub.add_argument("--out", type=Path, required=True)
    sub.set_defaults(call=stable)
    sub = commands.add_parser("status", help="progress of a file")
    sub.add_argument("file", type=Path)
    sub.set_defaults(call=status)
    given = parser.parse_args()
    return int(given.call(given))


if __name__ == "__main__":
    sys.exit(main())
