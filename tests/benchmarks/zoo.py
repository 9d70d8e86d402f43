"""Count robot files with a verified plan at the first attempt: `drake-diff plan FILE` with default arguments.

    pip install -e '.[test]'
    pip download --no-deps -d wheels dm_control underactuated     # optional: counts their models
    python tests/benchmarks/zoo.py [--only PATTERN] [--count N] [--seed 0] [--wheels wheels] [--out zoo.json]

The files are all URDFs of example-robot-data, the models that come with Drake, MuJoCo and drake_diff, and those in the
wheels (of dm_control, its suite). Each file runs in a separate process with 60 s of one core (including verification)
and 8 GiB of memory. A file counts if Drake's own parser accepts it and Drake reports that something can move, or if
drake_diff reads it and Drake does not. Single bodies without a joint (boxes, walls), except drones, are counted
separately. Results that are already in --out are not run again, so that an interrupted run can be continued. --markdown
writes a section of docs/measured.md from them.
"""

import argparse
import fnmatch
import importlib.metadata
import json
import os
import platform
import re
import resource
import subprocess
import sys
import tempfile
import zipfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from pages import marked, write_section

ROOT = Path(__file__).parents[2]
CPU_LIMIT, MEMORY = 60, 8 * 2**30  # [s], [bytes]
AIM = 0.95
FORMATS = (".urdf", ".sdf", ".xml", ".dmd.yaml")
LEFT_OUT = ("package.xml", "CMakeLists", "/meshes/", "/textures/", "/common/", "/conf/", "/launch/")
MODEL = re.compile(r"<(?:robot|sdf|mujoco)[\s>]|directives:")
SOURCES = {
    "example-robot-data": (("example-robot-data",), ".urdf"),
    "drake": (("drake",), FORMATS),
    "mujoco": (("mujoco", "mujoco_core"), (".xml", ".urdf")),
    "dm_control": (("dm_control",), (".xml",)),
    "underactuated": (("underactuated",), FORMATS),
}
DRONES = ("quadrotor", "iris")  # in the names of files: single bodies that a user may want to fly
# Check a file with Drake alone: whether its parser accepts it, and the numbers of velocities of joints and free bodies.
ALONE = """
import re
import sys
from pathlib import Path
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
plant = MultibodyPlant(0.01)
parser = Parser(plant)
path = Path(sys.argv[1]).resolve()
for name in set(re.findall("package://([^/]+)/", path.read_text(errors="replace"))):
    for folder in [folder for folder in path.parents if folder.name == name][:1]:
        parser.package_map().Add(name, str(folder))
parser.AddModels(sys.argv[1])
plant.Finalize()
free = 6 * len(plant.GetFloatingBaseBodies())
print("TAKES", plant.num_velocities() - free, free)
"""


def installed(package: str) -> list[Path]:
    try:
        return [Path(str(f.locate())).resolve() for f in importlib.metadata.files(package) or ()]
    except importlib.metadata.PackageNotFoundError:
        return []


def files(wheels: Path | None, unpacked: Path) -> Iterator[tuple[str, Path]]:
    """Yield (source, file) of each model."""
    for source, (packages, endings) in SOURCES.items():
        found = [path for package in packages for path in installed(package)]
        if not found and wheels:
            for wheel in sorted(wheels.glob(f"{packages[0]}-*.whl")):
                with zipfile.ZipFile(wheel) as archive:
                    archive.extractall(unpacked / source)
                found = [path for path in (unpacked / source).rglob("*") if path.is_file()]
        for path in sorted(set(found)):
            if not path.name.endswith(endings) or any(part in str(path) for part in LEFT_OUT):
                continue
            if source == "dm_control" and "/suite/" not in str(path):
                continue
            if MODEL.search(path.read_text(errors="replace")):
                yield source, path
    for path in sorted((ROOT / "models").iterdir()):
        yield "drake_diff", path


def limited() -> None:
    resource.setrlimit(resource.RLIMIT_CPU, (CPU_LIMIT, CPU_LIMIT + 2))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def alone(path: Path) -> tuple[bool, int, int]:
    """Return whether Drake's parser accepts the file, and the numbers of velocities of joints and free bodies."""
    done = subprocess.run([sys.executable, "-c", ALONE, str(path)], capture_output=True, text=True, errors="replace")
    words = next((line.split() for line in done.stdout.splitlines() if line.startswith("TAKES")), None)
    return (True, int(words[1]), int(words[2])) if words and done.returncode == 0 else (False, 0, 0)


def attempt(path: Path, seed: int) -> dict[str, object]:
    """Run the command on one file, and return its outcome, the repairs, and the processor time."""
    takes, of_joints, free = alone(path)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "drake_diff.cli.main", "plan", str(path), "--out", f"{folder}/run"]
        one = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [*command, "--seed", str(seed)],
            capture_output=True,
            text=True,
            errors="replace",
            preexec_fn=limited,
            env=os.environ | one,
            cwd=folder,
        )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    lines = done.stdout.splitlines()
    told = {word: next((line[10:] for line in lines if line.startswith(word)), "") for word in ("repaired", "guesses")}
    said = next((line for line in reversed(lines) if line.startswith("plan ")), "")
    wrong = [line for line in done.stderr.splitlines() if line.startswith("drake-diff: ")]
    why = said[10:] if said else (wrong[-1] if wrong else f"ended by {done.returncode}: {done.stderr[-200:]}")
    if done.returncode in (-9, -24, 137, 152):
        why = f"took more than {CPU_LIMIT} s"
    return {
        "drake": takes,
        "joints": of_joints,
        "free": free,
        "status": done.returncode,
        "verified": done.returncode == 0,
        "loaded": any(line.startswith(("robot", "audit")) for line in lines),
        "traceback": "Traceback" in done.stderr,
        "held": "(base='weld'" in told["repaired"],
        "flies": "thrusters" in told["repaired"],
        "stands": "(base='free', ground=True)" in told["repaired"],
        "repairs": told["repaired"],
        "guesses": told["guesses"],
        "why": "" if done.returncode == 0 else why,
        "seconds": round(seconds, 1),
    }


def counts(name: str, row: dict[str, object]) -> str:
    """Return "robot", "thing" (a single body without a joint), or why a file does not count: "refused", "still"."""
    if not row["drake"] and not row["loaded"]:
        return "refused"
    if row["drake"] and not row["joints"] and not row["free"]:
        return "still"
    single = not row["joints"] if row["drake"] else row["flies"]  # by the output if Drake does not read it
    return "thing" if single and not any(word in name for word in DRONES) else "robot"


def told(rows: dict[str, dict[str, object]]) -> list[str]:
    """Return the figures, one per line."""
    kinds = {name: counts(name, row) for name, row in rows.items()}
    taken = {name: row for name, row in rows.items() if kinds[name] == "robot"}
    things = [row for name, row in rows.items() if kinds[name] == "thing"]
    good = [row for row in taken.values() if row["verified"]]
    share = len(good) / len(taken) if taken else 0.0
    number = Counter(kinds.values())
    lines = [
        f"{len(rows)} files: {number['robot']} robots, {number['thing']} single bodies without a joint, "
        f"{number['still']} in which nothing can move, {number['refused']} that neither Drake nor drake_diff reads",
        f"robots with a verified plan: {len(good)} of {len(taken)}, {100 * share:.1f} %, target {100 * AIM:g} %"
        + ("" if share >= AIM else ": MISSED"),
        f"of these robots {sum(bool(r['stands']) for r in good)} stand on their feet, "
        f"{sum(bool(r['flies']) for r in good)} fly, and {sum(bool(r['held']) for r in good)} have a floating base "
        "that was fixed to the world",
        f"single bodies with a verified plan: {sum(bool(r['verified']) for r in things)} of {len(things)}",
        f"above {CPU_LIMIT} s of one core: {sum('took more than' in str(r['why']) for r in rows.values())}; "
        f"tracebacks: {sum(bool(r['traceback']) for r in rows.values())}",
    ]
    for source in sorted({str(r["source"]) for r in taken.values()}):
        of = [row for row in taken.values() if row["source"] == source]
        lines.append(f"{source}: {sum(bool(r['verified']) for r in of)} of {len(of)}")
    causes = Counter(str(r["why"])[:110] for r in taken.values() if not r["verified"])
    lines += [f"{n} x {cause}" for cause, n in causes.most_common()]
    return lines


def markdown(rows: dict[str, dict[str, object]], seed: int) -> str:
    """Return the section of docs/measured.md."""
    begin = told(rows)
    python = f"{platform.python_implementation()} {platform.python_version()}"
    mark = "at commit {commit}, {date}".format(**marked())
    text = [
        "Every robot file of the sources below, planned with default arguments and 60 s of one core, with verification."
    ]
    text += [f"`python tests/benchmarks/zoo.py --markdown docs/measured.md`, seed {seed}, {python}, {mark}."]
    text += ["", *(f"- {line}" for line in begin), ""]
    text += ["| File | Verified | Base | CPU [s] | Repairs, or why not |", "|---|---|---|---|---|"]
    for name, row in rows.items():
        said = (row["repairs"] if row["verified"] else row["why"]) or "-"
        said = re.sub(r"[|<>\n`*_]", " ", re.sub(r"/\S*/", "", str(said)))[:160]
        base = "on its feet" if row.get("stands") else "held" if row.get("held") else "as in the file"
        text.append(f"| {name} | {'yes' if row['verified'] else 'no'} | {base} | {row['seconds']} | {said} |")
    return "\n".join(text) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", default="*", help="a pattern of names, such as '*panda*'")
    parser.add_argument("--count", type=int, help="at most so many files, evenly spread")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--wheels", type=Path, help="a folder with wheels of dm_control and underactuated")
    parser.add_argument("--out", type=Path, help="a JSON file; what is in it already is not run again")
    parser.add_argument("--markdown", type=Path, help="write the section of that page")
    given = parser.parse_args()
    rows: dict[str, dict[str, object]] = {}
    if given.out and given.out.is_file():
        rows = json.loads(given.out.read_text())
    with tempfile.TemporaryDirectory() as unpacked:
        named = {
            f"{source}/{'/'.join(path.parts[-2:])}": (source, path)
            for source, path in files(given.wheels, Path(unpacked))
        }
        chosen = [name for name in named if fnmatch.fnmatch(name, given.only)]
        if given.count and given.count < len(chosen):
            chosen = [chosen[i * len(chosen) // given.count] for i in range(given.count)]
        for name in chosen:
            if name in rows:
                continue
            source, path = named[name]
            rows[name] = {"source": source, **attempt(path, given.seed)}
            row = rows[name]
            print(
                f"{'yes' if row['verified'] else 'NO ':3} {row['seconds']:6} s  {name}  {str(row['why'])[:140]}",
                flush=True,
            )
            if given.out:
                given.out.write_text(json.dumps(rows, indent=1))
    shown = {name: row for name, row in rows.items() if fnmatch.fnmatch(name, given.only)}
    print("\n".join(told(shown)))
    if given.markdown:
        write_section(given.markdown, "zoo", markdown(shown, given.seed))


if __name__ == "__main__":
    main()
