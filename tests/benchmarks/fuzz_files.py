"""Read thousands of untrusted recordings and robot files: each refusal is a named error, within 60 s and 1 GiB.

    python tests/benchmarks/fuzz_files.py recordings|models [--seed 0] [--count 1000]

Recordings are CSV files, MCAP files and ROS 2 bags. Models are URDF, SDF, MJCF and .dmd.yaml files, with OBJ, STL, VTK
and glTF meshes. A valid file is changed at random, or drawn from a list. A forked process (60 s, 1 GiB more memory)
runs `read_recording`, `read_mcap` and the first checks of `identify` on a recording, and `load_model`, a step and
`audit` on a model, which `crash_of` loads first. Every 25th model is also loaded with isolated=True. The script counts

- crashes, and runs that reach a limit;
- errors without a name: the exception is not a DrakeDiffError;
- code execution: an audit hook reports a process, a connection or an unpickled class, or the payloads' file exists.
"""

import argparse
import gzip
import json
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import warnings
import zlib
from collections import Counter
from functools import partial
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np
import trimesh
import zstandard
from fuzz_directories import Canaries, bytes_changed
from fuzz_directories import models as listed_models
from helpers.forks import fork, status_of
from helpers.models import MODELS
from helpers.strange import FILES, URDF, VALUES, broken, put
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

import drake_diff as dd
from drake_diff._base import sandbox
from drake_diff.comparison import read_recording
from drake_diff.exceptions import DrakeDiffError
from drake_diff.identification.recordings import read_pieces
from drake_diff.logs import read_mcap
from drake_diff.logs.channels import input_channel, state_channel
from drake_diff.logs.mcap_file import write_mcap

SECONDS, MEMORY = 60, 2**30
OF_CACHES = ("numba", "copyreg", "builtins", "llvmlite")  # packages with classes in Numba's own cache files
STARTED = ("os.system", "os.exec", "os.posix_spawn", "subprocess.Popen", "socket.connect", "pickle.find_class")
JOINTS = "sensor_msgs/msg/JointState"
ROWS = 40
NUMBERS = (
    *VALUES, "1e200", "1e30", "-0", "1e-320", "0x10", "1_0", "\u0661", "9" * 400, "=1+1", "\0", '"', "'", ";",
    "\x1b[2J",
)  # fmt: skip
PAYLOADS = (
    "touch {0}", "$(touch {0})", "`touch {0}`", "${{__import__('os').system('touch {0}')}}", "=cmd|'touch {0}'!A1",
)  # fmt: skip
YAML = (
    "!!python/object/apply:os.system ['touch {0}']",
    "&a [*a, *a]",
    "[" * 3000,
    "{{a: &a [x, x], b: &b [*a, *a, *a, *a, *a, *a, *a, *a], c: &c [*b, *b, *b, *b, *b, *b, *b, *b]}}",
)
CUBE_VTK = (
    "# vtk DataFile Version 3.0\nx\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 5 double\n0 0 0 1 0 0 0 1 0 0 0 1 1 1 1\n"
)
CUBE_VTK += "CELLS 2 10\n4 0 1 2 3\n4 1 2 3 4\nCELL_TYPES 2\n10\n10\n"


# ---- recordings ----------------------------------------------------------------------------------------------------


def motion():
    times = 0.01 * np.arange(ROWS)
    return times, np.column_stack([np.sin(times), np.cos(times)]), np.zeros((ROWS - 1, 1))


def put_recordings(folder, model):
    """Write a valid recording of each kind into the folder."""
    times, xs, us = motion()
    header = ",".join(["time", *model.state_names, *model.input_names])
    rows = [",".join(map(repr, [t, *x, 0.0])) for t, x in zip(times.tolist(), xs.tolist(), strict=True)]
    (folder / "run.csv").write_text("\n".join([header, *rows]) + "\n")
    contract = model.contract
    channels = [
        state_channel("/state", times, xs, contract.positions, contract.velocities),
        input_channel("/input", times[:-1], us, contract.inputs),
    ]
    write_mcap(folder / "run.mcap", channels, {"a": "b"}, {"note": ("text/plain", b"c")})
    store = get_typestore(Stores.ROS2_HUMBLE)
    for name, plugin in (("bag", StoragePlugin.MCAP), ("old", StoragePlugin.SQLITE3)):
        with Writer(folder / name, version=8, storage_plugin=plugin) as bag:
            topic = bag.add_connection("/joint_states", JOINTS, typestore=store)
            for t, x in zip(times, xs, strict=True):
                stamp = store.types["builtin_interfaces/msg/Time"](*divmod(round(1e9 * t), 10**9))
                header = store.types["std_msgs/msg/Header"](stamp, "")
                numbers = [np.array([value]) for value in (x[0], x[1], 0.0)]
                bag.write(
                    topic, round(1e9 * t), store.serialize_cdr(store.types[JOINTS](header, ["hinge"], *numbers), JOINTS)
                )
    (ros,) = (folder / "bag").glob("*.mcap")
    shutil.copy(ros, folder / "ros.mcap")


def csv_changed(text, rng, canary):
    """Return (name of the change, bytes) of a changed CSV file."""
    lines = text.splitlines()
    way, at = int(rng.integers(12)), int(rng.integers(1, len(lines)))
    cells = lines[at].split(",")
    if way < 4:
        value = str(rng.choice([*NUMBERS, PAYLOADS[rng.integers(len(PAYLOADS))].format(canary)]))
        cells[rng.integers(len(cells))] = value
        lines[at] = ",".join(cells)
    elif way == 4:
        return "encoding", text.encode(str(rng.choice(["utf-16", "utf-32", "utf-16-le", "cp037", "utf-8-sig"])))
    elif way == 5:
        return "packed", gzip.compress(text.encode()) if rng.random() < 0.5 else zstandard.compress(text.encode())
    elif way == 6:
        lines[at] = str(rng.choice(["0", ",", '"', "a", "0,"])) * int(rng.choice([200, 200_000, 2_000_000, 50_000_000]))
    elif way == 7:
        cells[0] = str(rng.choice(["1e9", "1e15", "1e308", "-1", "1e-300"]))
        lines[at:] = [",".join(cells)]
    elif way == 8:
        lines[0] = lines[0].replace(",", str(rng.choice([";", "\t", ",,", ",\u202e", ",time,"])))
    elif way == 9:
        lines[1:] = lines[1:] * int(rng.choice([2, 2000]))
    elif way == 10:
        lines[at:at] = [""] * int(rng.choice([3, 100_000]))
    else:
        return "bytes", bytes_changed(text.encode(), rng)
    return f"csv way {way}", "\n".join(lines).encode("utf-8", "surrogatepass")


def mcap_changed(data, rng):
    """Return (name, bytes): an MCAP file with changed bytes, or with a changed or huge chunk and its checksum."""
    if rng.random() < 0.6:
        return "bytes", bytes_changed(data, rng)
    place = data.find(b"\x06", 8)
    while place >= 0 and struct.unpack_from("<Q", data, place + 1)[0] > len(data):
        place = data.find(b"\x06", place + 1)
    length = struct.unpack_from("<Q", data, place + 1)[0]
    body = data[place + 9 : place + 9 + length]
    start, end, _, _, size = struct.unpack_from("<QQQII", body)
    name = body[32 : 32 + size]
    packed = body[32 + size + 8 :]
    inner = zstandard.decompress(packed) if name == b"zstd" else packed
    inner = bytes(int(rng.choice([10**6, 3 * 10**8]))) if rng.random() < 0.3 else bytes_changed(inner, rng)
    crc = zlib.crc32(inner)
    claimed = len(inner) if rng.random() < 0.7 else int(rng.choice([0, 2**31, 2**62]))
    packed = zstandard.compress(inner) if name == b"zstd" else inner
    chunk = struct.pack("<QQQII", start, end, claimed, crc, size) + name + struct.pack("<Q", len(packed)) + packed
    return "chunk", data[:place] + b"\x06" + struct.pack("<Q", len(chunk)) + chunk + data[place + 9 + length :]


def recording_changed(folder, rng, canary):
    """Change a recording and return (name of the change, path)."""
    name = str(rng.choice(["run.csv", "run.mcap", "ros.mcap", "bag", "old"], p=[0.4, 0.2, 0.15, 0.125, 0.125]))
    path = folder / name
    if name == "run.csv":
        how, data = csv_changed(path.read_text(), rng, canary)
        path.write_bytes(data)
    elif path.is_file():
        how, data = mcap_changed(path.read_bytes(), rng)
        path.write_bytes(data)
    else:
        inner = next(p for p in sorted(path.iterdir()) if p.suffix != ".yaml")
        metadata = path / "metadata.yaml"
        way, text = int(rng.integers(7)), metadata.read_text()
        how = f"{name} way {way}"
        if way < 2:
            inner.write_bytes(bytes_changed(inner.read_bytes(), rng))
        elif way == 2:
            metadata.write_bytes(bytes_changed(text.encode(), rng))
        elif way == 3:
            words, pool = text.split(" "), [*(v.format(canary) for v in YAML), "/etc/passwd", "-1", "9" * 30]
            words[rng.integers(len(words))] = str(rng.choice(pool))
            metadata.write_text(" ".join(words))
        elif way == 4:
            text = text.replace("compression_format: ''", "compression_format: zstd")
            mode = rng.choice(["file", "message", "x"])
            metadata.write_text(text.replace("compression_mode: ''", f"compression_mode: {mode}"))
            packed = zstandard.compress(bytes(int(rng.choice([10**3, 2 * 10**8]))))
            inner.with_name(inner.name + ".zstd").write_bytes(packed)
        elif way == 5:
            other = str(rng.choice(["../run.csv", "/dev/zero", "/etc/passwd", "."]))
            metadata.write_text(text.replace(inner.name, other))
        elif name == "bag":
            inner.write_bytes(mcap_changed(inner.read_bytes(), rng)[1])
        else:
            inner.write_bytes(b"SQLite format 3\0" + rng.bytes(5000))
    if rng.random() < 0.05:
        beside = str(rng.choice(["[" * 10**5, "{}", '{"time step": [1e999]}', '{"a": 1', '{"gravity": "x"}', "\xff"]))
        (folder / (path.stem + ".contract.json")).write_text(beside)
    return f"{name}: {how}", path


def read_as_users_do(path, model, rng):
    recording = read_recording(path, model, gaps=bool(rng.random() < 0.5))
    read_pieces(model, [recording], 0.2)


# ---- models --------------------------------------------------------------------------------------------------------


def mesh_bytes(ending):
    data = CUBE_VTK if ending == "vtk" else trimesh.creation.box().export(file_type=ending)
    return data.encode() if isinstance(data, str) else data


def mesh_changed(ending, rng):
    data = mesh_bytes(ending)
    if rng.random() < 0.5 and ending in ("obj", "vtk"):
        words = data.decode().split(" ")
        for _ in range(int(rng.integers(1, 4))):
            words[rng.integers(len(words))] = str(rng.choice([*VALUES, "-1", "99999999", "2147483648"]))
        return " ".join(words).encode()
    return bytes_changed(data, rng)


def gltf_changed(rng):
    document = {
        "asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "buffers": [{"uri": "x.bin", "byteLength": 60}],
        "bufferViews": [{"buffer": 0, "byteLength": 48}, {"buffer": 0, "byteOffset": 48, "byteLength": 12}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": 12, "type": "SCALAR"},
        ],
    }  # fmt: skip
    part = document
    while isinstance(part, (dict, list)) and part:
        keys = list(part) if isinstance(part, dict) else list(range(len(part)))
        key, last = keys[rng.integers(len(keys))], part
        part = part[key]
        if rng.random() < 0.3:
            break
    pool = [
        None, -1, 2**31, 1e308, "../x", "/dev/zero", "data:;base64,AAAA", "http://localhost/x", [], {}, "VEC9", 5130,
    ]  # fmt: skip
    last[key] = pool[rng.integers(len(pool))]
    return json.dumps(document).encode()


def chain(count):
    inertia = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    joint = '<joint name="j{0}" type="revolute"><parent link="l{0}"/><child link="l{1}"/><axis xyz="0 1 0"/>'
    joint += '<limit effort="1" velocity="1" lower="-1" upper="1"/></joint>'
    links = "".join(f'<link name="l{i}">{inertia}</link>' for i in range(count + 1))
    return f'<robot name="c">{links}{"".join(joint.format(i, i + 1) for i in range(count))}</robot>'


def model_changed(folder, rng, canaries):
    """Write a changed model and return (name of the change, path, options to load it)."""
    put(folder)
    options = {
        "time_step": 0.01,
        "packages": {"here": str(folder)},
        "meshes": str(rng.choice(["skip", "convex", "spheres"])),
    }
    way = rng.random()
    if way < 0.45:
        ending = str(rng.choice(list(FILES)))
        ((how, data),) = broken(ending, int(rng.integers(2**31)), 1)
        path = folder / f"robot.{ending}"
    elif way < 0.85:
        ending, path = str(rng.choice(["obj", "stl", "vtk", "gltf", "glb"])), folder / "robot.urdf"
        mesh = gltf_changed(rng) if ending == "gltf" else mesh_changed(ending, rng)
        (folder / f"mesh.{ending}").write_bytes(mesh)
        (folder / "x.bin").write_bytes(bytes(60))
        where = '<sphere radius="0.1"/>'
        data = URDF.replace(where, f'<mesh filename="mesh.{ending}"/>', int(rng.integers(1, 3))).encode()
        how = f"mesh {ending}"
        if rng.random() < 0.2:
            path = folder / "robot.xml"
            body = '<worldbody><body><freejoint/><geom type="mesh" mesh="m"/></body></worldbody>'
            data = f'<mujoco><asset><mesh name="m" file="mesh.{ending}"/></asset>{body}</mujoco>'.encode()
        if rng.random() < 0.3:
            options["contact_model"] = "hydroelastic_with_fallback"
    elif way < 0.97:
        pool = listed_models(canaries.folder)
        name, text = pool[rng.integers(len(pool))]
        path, data, how = folder / name, text.encode(), name
    elif way < 0.99:
        payload = str(rng.choice(PAYLOADS)).format(canaries.folder / "made")
        ending = str(rng.choice(list(FILES)))
        path, how = folder / f"robot.{ending}", "payload"
        data = FILES[ending].replace("1", payload, int(rng.integers(1, 5))).encode()
        if ending == "dmd.yaml":
            data = ("directives: " + YAML[0].format(canaries.folder / "made")).encode()
    else:
        path, how = folder / "robot.urdf", "chain"
        data = chain(int(rng.choice([300, 2000]))).encode()
    path.write_bytes(data)
    return f"{path.name}: {how}", path, options


def load_as_users_do(path, options):
    model = dd.load_model(path, **options)
    dd.step(model, model.default_state, np.zeros(model.nu))
    dd.audit(model)


# ---- recordings and models -----------------------------------------------------------------------------------------


def outcome_of(action, log):
    """Call `action` in a forked process with limits; return "read", the name of an error, or "WRONG" with a reason."""
    log.write_text("")

    def act():
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_REAL, SECONDS)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_DATA, (sandbox._used() + MEMORY,) * 2)
        started = []

        def look(event, given):
            if event in STARTED and not (event == "pickle.find_class" and given[0].split(".")[0] in OF_CACHES):
                started.append(f"{event} {given!r:.100}")

        sys.addaudithook(look)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                action()
                end = "read"
            except DrakeDiffError as error:
                end = type(error).__name__
            except BaseException as error:
                end = f"WRONG error without a name: {type(error).__name__}: {error!s:.300}"
        log.write_text(f"WRONG code execution: {started}" if started else end)

    status = status_of(fork(act))
    if status == -signal.SIGALRM:
        return f"WRONG more than {SECONDS} s"
    if status < 0:
        return f"WRONG crash: {signal.Signals(-status).name}"
    return log.read_text() or f"WRONG status {status}"


def fuzz(kind, count, seed):
    rng, ends, wrong, slowest = np.random.default_rng(seed), Counter(), [], (0.0, "")
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        good, log = place / "good", place / "log"
        good.mkdir()
        canaries = Canaries(place / "canaries")
        made = canaries.folder / "made"
        warnings.simplefilter("ignore")
        model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.01)
        put_recordings(good, model)
        for i in range(count):
            folder, begin = place / "case", time.monotonic()
            if kind == "recordings":
                shutil.copytree(good, folder)
                how, path = recording_changed(folder, rng, made)
                end = outcome_of(partial(read_as_users_do, path, model, rng), log)
                if path.suffix == ".mcap" and not end.startswith("WRONG"):
                    other = outcome_of(partial(read_mcap, path), log)
                    end = other if other.startswith("WRONG") else end
            else:
                folder.mkdir()
                how, path, options = model_changed(folder, rng, canaries)
                crash = sandbox.crash_of(partial(load_as_users_do, path, options))
                load = partial(load_as_users_do, path, options)
                end = f"ended by {crash}" if crash else outcome_of(load, log)
                if i % 25 == 0:
                    end += isolated(path, options, crash)
            taken = time.monotonic() - begin
            slowest = max(slowest, (taken, how))
            if made.exists():
                made.unlink()
                end = "WRONG code execution: the payload's file is there"
            ends[f"{how.split(':')[0]}: {end.split(':')[0]}"] += 1
            if "WRONG" in end:
                wrong.append(f"{i} | {how} | {end}")
                shutil.copytree(
                    folder,
                    Path(tempfile.gettempdir()) / f"fuzz_files_{kind}_{seed}_{i}",
                    dirs_exist_ok=True,
                    symlinks=True,
                )
                print(wrong[-1], flush=True)
            shutil.rmtree(folder)
    return wrong, ends, slowest


def isolated(path, options, crash):
    """Return "" if an isolated load raises a named error or loads a file that did not crash, or else the failure."""
    try:
        dd.load_model(path, isolated=True, **options)
    except DrakeDiffError:
        return ""
    except Exception as error:
        return f" WRONG isolated: {type(error).__name__}: {error!s:.200}"
    return " WRONG isolated: it loaded" if crash and "limit" not in crash else ""


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("kind", choices=["recordings", "models"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=1000)
    asked = parser.parse_args()
    begin = time.monotonic()
    wrong, ends, slowest = fuzz(asked.kind, asked.count, asked.seed)
    for what, number in sorted(ends.items()):
        print(f"{number:6d} {what}")
    print(f"{asked.count} {asked.kind}, seed {asked.seed}: {len(wrong)} wrong")
    print(f"the slowest took {slowest[0]:.1f} s ({slowest[1]})")
    print(f"{time.monotonic() - begin:.0f} s in all")
    sys.exit(1 if wrong else 0)


if __name__ == "__main__":
    main()
