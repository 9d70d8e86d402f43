"""Open thousands of untrusted directories: none may crash, hang or cause reads outside; each refusal is a named error.

    python tests/benchmarks/fuzz_directories.py [--seed 0] [--count 1000] [--log FILE]

A small run is changed at random: values of its record, the bytes of its files, its model, or the files themselves. Most
are sealed again with correct hashes, as an attacker can do. Then each is opened as users do: by `verify`, `list`,
`compare-runs`, `read_mcap`, and the functions with which `view` and `robustness` read. The script counts

- crashes: this process ends (the last case in the log is the cause), or a command reports a bug (exit status 4);
- hangs: a case takes longer than HANG seconds;
- reads outside: the names in the cases refer to canary files, which inotify watches for all processes, and to system
  files, which an audit hook watches for this process;
- errors without a name: the exception is not a DrakeDiffError.
"""

import argparse
import contextlib
import ctypes
import io
import json
import os
import select
import shutil
import struct
import sys
import tempfile
import time
import warnings
from collections import Counter
from hashlib import sha256
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np
from helpers.forgery import rewrite, seal
from helpers.models import MODELS
from helpers.strange import FILES, broken
from mcap.reader import NonSeekingReader
from mcap.writer import Writer
from trust_verify import leaves

import drake_diff as dd
from drake_diff.cli import main as cli
from drake_diff.exceptions import DrakeDiffError
from drake_diff.logs import read_mcap
from drake_diff.runs.verify import recalled
from drake_diff.runs.view import scene_of_run

HANG = 90.0  # [s]; the limit of the child process is 60 s, and this machine may be busy
OPENED, ACCESSED = 0x20, 0x1  # inotify events
FORBIDDEN = ("/etc/passwd", "/etc/shadow", "/root/.ssh", "/dev/zero", "/dev/random")
INERTIA = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
LINK = f'<link name="pole">{INERTIA}<visual><geometry>{{}}</geometry></visual></link>'
URDF = (
    '<robot name="pendulum">{}<joint name="hinge" type="continuous"><parent link="world"/><child link="pole"/>'
    '<axis xyz="0 1 0"/></joint><transmission><type>{}</type><joint name="hinge"/><actuator name="m"/></transmission>'
    "</robot>"
)


def values(canaries):
    """Return the values that can be written into a field of a record."""
    out = str(canaries / "secret.urdf")
    return (
        None, True, 0, -1, 2**63, 10**300, 1e308, -1e-308, 0.5, -(2**70), "", "nan", "inf", "9" * 400, "x" * 100_000,
        "<script>alert(1)</script>", "\x1b]0;x\x07\x1b[31m", "\u202egpj.exe", "a\nb", "\0", "/etc/passwd", "/dev/zero",
        out, "../" * 20 + out, f"file://{out}", [], {}, [[]], [None], [1e308] * 5, [0] * 1000, {"path": out},
        {"QuadraticCost": {"R": [[1e308]]}}, "pass", "converged", "collocation", "ilqr", "hydroelastic",
    )  # fmt: skip


def models(canaries):
    """Return (name, text) of robot files that crash a parser, never end, or refer to files outside."""
    out, kind = canaries / "secret", "transmission_interface/SimpleTransmission"
    mesh = '<mesh filename="{}"/>'
    deep = "<a>" * 20_000 + "</a>" * 20_000
    names = (
        f"{out}.obj",
        f"file://{out}.obj",
        "../" * 20 + f"{out}.obj",
        f"package://x/../../../{out}.obj",
        "x.obj",
        "\0",
    )
    found = [("empty.urdf", URDF.format(LINK.format(""), ""))]
    found += [("mesh.urdf", URDF.format(LINK.format(mesh.format(name)), kind)) for name in names]
    found += [
        ("entity.urdf", f'<!DOCTYPE r [<!ENTITY a SYSTEM "file://{out}.xml">]>' + URDF.format("&a;", kind)),
        ("deep.urdf", URDF.format(deep, kind)),
        ("self.xml", '<mujoco><include file="self.xml"/></mujoco>'),
        ("outside.xml", f'<mujoco><include file="{out}.xml"/><worldbody/></mujoco>'),
        ("asset.xml", f'<mujoco><asset><mesh name="m" file="{out}.obj"/></asset><worldbody/></mujoco>'),
        ("height.xml", f'<mujoco><asset><hfield name="m" file="{out}.png"/></asset><worldbody/></mujoco>'),
        ("dir.xml", f'<mujoco><compiler meshdir="{canaries}"/><asset><mesh file="secret.obj"/></asset></mujoco>'),
        ("uri.sdf", f'<sdf version="1.9"><model name="r"><include><uri>file://{out}.sdf</uri></include></model></sdf>'),
        ("merge.sdf", f'<sdf version="1.9"><include merge="true"><uri>{out}.sdf</uri></include></sdf>'),
        ("flow.dmd.yaml", f"{{directives: [{{add_model: {{name: a, file: 'file://{out}.urdf'}}}}]}}"),
        ("quoted.dmd.yaml", f'{{"directives": [{{"add_model": {{"name": "a", "\\x66ile": "file://{out}.urdf"}}}}]}}'),
        ("inner.dmd.yaml", f"directives:\n- add_directives: {{file: file://{out}.dmd.yaml}}\n"),
        ("merged.dmd.yaml", f"a: &a {{file: 'file://{out}.urdf'}}\ndirectives:\n- add_model: {{<<: *a, name: a}}\n"),
        ("bomb.dmd.yaml", "a0: &a0 [x, x]\n" + "".join(f"a{i}: &a{i} [{f'*a{i - 1}, ' * 9}]\n" for i in range(1, 9))),
        ("remote.dmd.yaml", "directives:\n- add_model: {name: a, file: 'package://drake_models/iiwa_description/x.urdf'}\n"),
        ("zeros.urdf", "\0" * 1000),
    ]  # fmt: skip
    return found


class Canaries:
    """A folder whose files no process may open. `opened` counts the accesses by any process since its last call."""

    def __init__(self, folder):
        self.folder = folder
        folder.mkdir()
        for ending in ("urdf", "sdf", "xml", "dmd.yaml", "obj", "png", "json", "npz", "mcap"):
            (folder / f"secret.{ending}").write_text(FILES.get(ending, "v 0 0 0\n"))
        libc = ctypes.CDLL(None, use_errno=True)
        self.watch = libc.inotify_init1(os.O_NONBLOCK)
        for path in folder.iterdir():
            libc.inotify_add_watch(self.watch, os.fsencode(path), OPENED | ACCESSED)
        (folder / "secret.obj").read_text()
        if not self.opened():
            raise RuntimeError("inotify does not report a file that is opened")

    def opened(self):
        count = 0
        while select.select([self.watch], [], [], 0)[0]:
            data = os.read(self.watch, 65536)
            while data:
                *_, length = struct.unpack_from("iIII", data)
                data, count = data[16 + length :], count + 1
        return count


def bytes_changed(data, rng):
    """Return bytes with random changes: flipped bits, a cut end, inserted bytes, extreme numbers, or a copied start."""
    data = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at, way = int(rng.integers(len(data) or 1)), rng.integers(6)
        if way == 0 and data:
            data[at] ^= 1 << int(rng.integers(8))
        elif way == 1:
            del data[at:]
        elif way == 2:
            data[at:at] = rng.bytes(int(rng.integers(1, 100)))
        elif way == 3:
            data[at : at + 8] = struct.pack("<Q", int(rng.choice([0, 2**31, 2**32 - 1, 2**63 - 1])))
        elif way == 4:
            data[at : at + 8] = struct.pack("<d", float(rng.choice([np.nan, np.inf, 1e308, -1e-308])))
        else:
            data[at : at + 40] = data[:40]
    return bytes(data)


def record_changed(folder, rng, canaries):
    fields = json.loads((folder / "record.json").read_text())
    told = []
    for _ in range(int(rng.integers(1, 4))):
        path, _ = (found := list(leaves(fields)))[rng.integers(len(found))]
        path = path[: int(rng.integers(1, len(path) + 1))]
        part = fields
        for key in path[:-1]:
            part = part[key]
        way = rng.integers(6)
        told.append(".".join(map(str, path)))
        if way == 0:
            del part[path[-1]]
        elif way == 1 and isinstance(part, dict):
            part["<b>more</b>"] = 1
        else:
            pool = values(canaries.folder)
            part[path[-1]] = pool[rng.integers(len(pool))]
            told[-1] += f" = {str(part[path[-1]])[:30]!r}"
    _sealed(folder, fields)
    return "record: " + "; ".join(told)


def _sealed(folder, fields):
    """Write the record, with correct hashes if the fields are still a record."""
    try:
        seal(folder, fields)
    except (AttributeError, KeyError, TypeError, ValueError):
        (folder / "record.json").write_text(json.dumps(fields, sort_keys=True, indent=2) + "\n")


def bytes_of_a_file_changed(folder, rng, _):
    name = str(
        rng.choice(["plan.npz", "trace.mcap", "replay.html", "report.html", "record.json", "record.schema.json"])
    )
    path = folder / name
    path.write_bytes(bytes_changed(path.read_bytes(), rng))
    if name != "record.json" and rng.random() < 0.8:
        with contextlib.suppress(Exception):
            seal(folder, json.loads((folder / "record.json").read_text()), attach=False)
    return f"bytes of {name}"


def plan_changed(folder, rng, _):
    with np.load(folder / "plan.npz") as file:
        arrays = {name: file[name] for name in file.files}
    name = str(rng.choice(list(arrays)))
    array = arrays[name].copy()
    way = rng.integers(6)
    if way == 0:
        array = array[: len(array) // 2]
    elif way == 1:
        array = array.astype("O")
    elif way == 2 and array.size:
        array.flat[rng.integers(array.size)] = rng.choice([np.nan, np.inf, 1e308, 1e-308])
    elif way == 3:
        array = np.zeros((0, 3))
    elif way == 4:
        array = np.zeros((2, 10**6))
    else:
        array = array.astype("f4")
    arrays[name] = array
    np.savez(folder / "plan.npz", **arrays)
    seal(folder, json.loads((folder / "record.json").read_text()), attach=False)
    return f"plan: {name}, way {way}"


def messages_changed(folder, rng, _):
    share = float(rng.choice([0.01, 0.3, 1.0]))
    rewrite(
        folder / "trace.mcap",
        message=lambda i, c, m: bytes_changed(m.data, rng) if rng.random() < share else m.data,
        metadata={"verdict_rests_on": "x" * int(rng.integers(100_000))},
        drop=int(rng.integers(100)),
    )
    seal(folder, json.loads((folder / "record.json").read_text()), attach=False)
    return f"messages, {share}"


def model_changed(folder, rng, canaries):
    """Replace the robot file, consistently in the record and the trace."""
    fields = json.loads((folder / "record.json").read_text())
    if rng.random() < 0.5:
        pool = models(canaries.folder)
        name, text = pool[rng.integers(len(pool))]
        data, how = text.encode(), name
    else:
        ending = str(rng.choice(["urdf", "sdf", "xml", "dmd.yaml"]))
        ((how, data),) = broken(ending, int(rng.integers(2**31)), 1)
        name = f"robot.{ending}"
    _with_model(folder, fields, name, data)
    if rng.random() < 0.3:  # a model that must be read from its original path
        fields["provenance"]["model_file"] = str(
            rng.choice([str(canaries.folder / f"secret.{e}") for e in ("urdf", "xml")])
        )
        fields["model"]["named"] = [{"path": "x.obj", "bytes": 1, "sha256": "0" * 64, "reason": None}]
    _sealed(folder, fields)
    return f"model: {name}, {how}"


def replace_model(folder, name, data):
    """Replace the robot file, with correct hashes."""
    fields = json.loads((folder / "record.json").read_text())
    _with_model(folder, fields, name, data)
    seal(folder, fields)
    return f"model: {name}"


def _with_model(folder, fields, name, data):
    with_attachment(folder / "trace.mcap", "pendulum.urdf", name, data)
    fields["model"]["file"] = {"path": name, "bytes": len(data), "sha256": sha256(data).hexdigest(), "reason": None}


def with_attachment(path, old, new, data):
    """Rewrite the trace with another file in place of the model's file."""
    real = Writer.add_attachment

    def add(self, create_time, log_time, name, media_type, content):
        real(self, create_time, log_time, new if name == old else name, media_type, data if name == old else content)

    Writer.add_attachment = add
    try:
        rewrite(path)
    finally:
        Writer.add_attachment = real
    assert any(a.name == new for a in NonSeekingReader(io.BytesIO(path.read_bytes())).iter_attachments())


def files_changed(folder, rng, canaries):
    name = str(rng.choice(["plan.npz", "trace.mcap", "record.json", "new", "a/b", "report.html", "<b>&\x1b[31m"]))
    path, way = folder / name, int(rng.integers(8))
    path.parent.mkdir(exist_ok=True)
    if path.exists():
        path.unlink()
    if way == 0:
        os.mkfifo(path)
    elif way == 1:
        path.symlink_to(canaries.folder / ("secret.json" if name == "record.json" else "secret.npz"))
    elif way == 2:
        path.symlink_to(canaries.folder)
    elif way == 3:
        path.mkdir()
    elif way == 4:
        path.touch()
        os.truncate(path, 2**42)
    elif way == 5:
        path.symlink_to(path.name)
    elif way == 6:
        os.mknod(path, 0o666 | 0o020000, os.makedev(1, 5)) if os.geteuid() == 0 else path.touch()
    else:
        deep = folder
        for _ in range(200):
            deep = deep / "d"
        deep.mkdir(parents=True)
    return f"files: {name}, way {way}"


WAYS = {
    record_changed: 0.35,
    bytes_of_a_file_changed: 0.2,
    plan_changed: 0.1,
    messages_changed: 0.05,
    model_changed: 0.2,
    files_changed: 0.1,
}


def command(*words):
    """Run a command in this process and return its exit status and its output."""
    out, argv = io.StringIO(), sys.argv
    sys.argv = ["drake-diff", *map(str, words)]
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            cli.main()
    except SystemExit as end:
        return int(end.code or 0), out.getvalue()
    finally:
        sys.argv = argv
    return 0, out.getvalue()


def opened_as_users_do(folder, base, wanted):
    """Open a directory in each way in `wanted`, and yield (way, outcome)."""
    commands = {
        "verify": ("verify", folder),
        "list": ("list", folder.parent),
        "compare-runs": ("compare-runs", folder, base),
    }
    for what, words in commands.items():
        if what in wanted:
            status, said = command(*words)
            named = status in (0, 1, 2) and "Traceback" not in said and "report a bug" not in said
            yield what, f"exit status {status}" if named else f"BUG: exit status {status}: {said[-2000:]}"
    functions = {
        "view": lambda: scene_of_run(folder),
        "robustness": lambda: recalled(folder).__enter__(),
        "load_record": lambda: dd.load_record(folder),
        "read_mcap": lambda: read_mcap(folder / "trace.mcap", links=False),
    }
    for what, function in functions.items():
        if what in wanted:
            try:
                function()
                yield what, "opened"
            except DrakeDiffError as error:
                yield what, type(error).__name__
            except Exception as error:
                yield what, f"BUG: {type(error).__name__}: {error!s:.500}"


def fuzz(count, seed, *, log=None, every_model=False):
    """Return the failures, the number of each outcome of opening a directory, and the longest time [s] of a case.

    With `every_model`, at most `count` files of `models` are tried, once each. Accepting one is a failure.
    """
    rng, ended, wrong, slowest = np.random.default_rng(seed), Counter(), [], 0.0
    read = []
    sys.addaudithook(lambda event, given: read.append(given[0]) if event == "open" and given[0] in FORBIDDEN else None)
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        place = Path(name)
        canaries, base = Canaries(place / "canaries"), place / "base"
        model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
        task = dd.Problem(model, x0=[0, 0], x_goal=[0.1, 0], num_steps=4, running_cost=dd.QuadraticCost(R=[[1.0]]))
        dd.save(dd.solve(task, method="shooting"), base)
        pool = models(canaries.folder)
        chosen = rng.permutation(len(pool))[:count]
        for i in range(len(chosen) if every_model else count):
            folder = place / "runs" / "run"
            shutil.copytree(base, folder)
            way = list(WAYS)[rng.choice(len(WAYS), p=list(WAYS.values()))]
            wanted = ["list", "read_mcap", "load_record", *(["compare-runs"] if rng.random() < 0.5 else [])]
            if every_model:
                file_name, text = pool[chosen[i]]
                told = replace_model(folder, file_name, text.encode())
                wanted += ["verify", *(("view", "robustness") if i % 5 == 0 else ())]
            else:
                told = way(folder, rng, canaries)
                wanted.append("verify" if rng.random() < 0.7 else str(rng.choice(["view", "robustness"])))
            if log is not None:
                log.write_text(f"{seed} {i} {told}\n")
            canaries.opened()
            start = time.monotonic()
            for what, how in opened_as_users_do(folder, base, wanted):
                ended[f"{what}: {how.split(':')[0]}"] += 1
                if how.startswith("BUG"):
                    wrong.append(("error without a name", i, told, what, how))
                if every_model and (what, how) == ("verify", "exit status 0"):
                    wrong.append(("accepted", i, told, what, how))
            taken = time.monotonic() - start
            slowest = max(slowest, taken)
            if taken > HANG:
                wrong.append(("hang", i, told, wanted[-1], f"{taken:.0f} s"))
            if canaries.opened() or read:
                wrong.append(("read outside", i, told, wanted[-1], str(read)))
                read.clear()
            shutil.rmtree(place / "runs")
    return wrong, ended, slowest


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--every-model", action="store_true", help="robot files, each once, instead")
    parser.add_argument("--log", type=Path)
    asked = parser.parse_args()
    start = time.monotonic()
    wrong, ended, slowest = fuzz(asked.count, asked.seed, log=asked.log, every_model=asked.every_model)
    for line in wrong:
        print(*line, sep=" | ")
    for what, count in sorted(ended.items()):
        print(f"{count:6d} {what}")
    kinds = Counter(kind for kind, *_ in wrong)
    names = ("error without a name", "hang", "read outside", "accepted")
    told = ", ".join(f"{kinds[name]} {name}" for name in names)
    print(f"{asked.count} directories, seed {asked.seed}: 0 crashes, {told}; the slowest took {slowest:.1f} s")
    print(f"{time.monotonic() - start:.0f} s in all")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
