"""Test `verify` against a forger who may edit everything in a run directory and update its hashes.

The runs are small and of several kinds, some of them failures. A forger chooses a run, makes a random change, and seals
the directory like a genuine one: the trace contains the changed record, and all hashes are updated. A forgery is
accepted if `verify` reports that the run holds, without the change among the unchecked values or as rounding.
"""

import copy
import json
import shutil
import tempfile
from collections import Counter
from io import BytesIO
from pathlib import Path

import numpy as np
from helpers.forgery import rewrite, seal
from helpers.models import MODELS
from mcap.reader import NonSeekingReader
from solving import solve_with
from trust import Figure

import drake_diff as dd

COUNT = 1000
# Terms of `Verification.unchecked` for values that cannot be reproduced, and for the problem itself.
UNCHECKED = ("wall_clock", "provenance", "name")
ASKED = ("problem.", "model.", "inputs.search.")
EFFORT = dd.QuadraticCost(R=[[1.0]])


def pendulum(**changes):
    model = dd.load_model(MODELS / "pendulum.urdf", time_step=0.02)
    return dd.Problem(model, **{"x0": [0, 0], "x_goal": [1, 0], "num_steps": 20, "running_cost": EFFORT, **changes})


def sliding(place):
    """Return a problem of a block that is thrown onto a floor with a variable speed and slides to `place`."""
    model = dd.load_model(MODELS / "sliding_block.sdf", time_step=0.01)
    x0, goal, free = np.zeros(13), np.full(13, np.nan), np.zeros(13, dtype=bool)
    x0[[0, 6, 10]], goal[4], free[10] = (1, 0.1, 1), place, True
    given = {"x0": x0, "x_goal": goal, "initial_state_mask": free}
    return dd.Problem(model, num_steps=10, optimize=("initial_state",), **given)


def save_runs(folder, rng):
    """Save successes and failures, smooth and in contact, of all three methods, with random goals."""
    goal = float(rng.uniform(0.3, 1.5))
    weak = dd.Bounds(u_lower=[-2], u_upper=[2])
    tasks = {
        "shooting": (pendulum(x_goal=[goal, 0]), {"method": "shooting"}),
        "ilqr": (pendulum(x_goal=[goal, 0]), {"method": "ilqr"}),
        "collocation": (pendulum(x_goal=[goal, 0], horizon=(0.3, 0.6)), {"method": "collocation"}),
        "far": (pendulum(x_goal=[goal + 1.2, 0], bounds=weak), {"method": "ilqr", "max_iterations": 5}),
        "stopped": (pendulum(x_goal=[3, 0]), {"method": "shooting", "max_iterations": 1}),
        "sliding": (sliding(float(rng.uniform(0.05, 0.08))), {"method": "shooting"}),
    }
    for name, (problem, options) in tasks.items():
        dd.save(solve_with(problem, **options), folder / name)
    return list(tasks)


def leaves(value, path=()):
    """Yield (path, value) for each value of a record that is not a dictionary or a list."""
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    if not isinstance(value, (dict, list)):
        yield path, value
    for key, part in parts:
        yield from leaves(part, (*path, key))


def changed(value, rng):
    """Return another value of the same type: a number changed by 0.1 % to 100 % or a small step, a text by a word."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + int(rng.integers(1, 4))
    if isinstance(value, float):
        sign = rng.choice([-1, 1])
        return float(value * (1 + sign * 10 ** rng.uniform(-3, 0)) if value else sign * 10 ** rng.uniform(-3, 0))
    return "changed" if value is None else value + rng.choice([" ", " not", "x"])


def edit_leaf(folder, fields, rng):
    """Change one value of the record, except in its list of files, which is written again."""
    found = [(p, v) for p, v in leaves(fields) if p[0] not in ("files", "record_sha256")]
    path, value = found[rng.integers(len(found))]
    part = fields
    for key in path[:-1]:
        part = part[key]
    part[path[-1]] = changed(value, rng)
    return ".".join(str(key) for key in path)


def delete_part(folder, fields, rng):
    """Delete an entry of a list of results, or the whole list."""
    lists = ("metrics", "invariants", "events", "replays", "failures", "parameters")
    places = [(fields, name) for name in lists if fields[name]]
    places += [(fields["gradient"], name) for name in ("certificates", "columns") if fields["gradient"][name]]
    part, name = places[rng.integers(len(places))]
    if rng.random() < 0.3:
        part[name] = []
    else:
        part[name].pop(int(rng.integers(len(part[name]))))
    return f"{name}, deleted"


def claim_success(folder, fields, rng):
    """Report a failure as a success, or a success as a better success."""
    how = rng.choice(["delete", "zero", "tolerance"])
    tolerated = [m for m in fields["metrics"] if m["tolerance"] is not None]
    failing = [m for m in tolerated if m["verdict"] != "pass"] or tolerated[:1]
    for metric in failing:
        if how == "delete":
            fields["metrics"].remove(metric)
        elif how == "zero":
            metric.update(value=0.0, verdict="pass", reason=None)
        else:
            metric.update(tolerance=1e3, verdict="pass", value=metric["value"] or 0.0, reason=None)
    for replay in fields["replays"]:
        replay.update(holds=True, failures=[], goal_error=0.0)
    for certificate in fields["gradient"]["certificates"]:
        certificate["verdict"] = "agree"
    fields["solver"].update(status="converged", message="the solver converged", iterations=9)
    fields.update(verdict="pass", sentence="the solver converged, and every measure that was taken again holds")
    fields["events"] = [e for e in fields["events"] if e["kind"] != "failure"]
    fields["failures"] = []
    if rng.random() < 0.3:  # also a goal error of 0, which no failure has
        fields["metrics"][0]["value"] = 0.0
    return f"success, {how}"


def edit_channel(folder, fields, rng):
    """Change one byte in the decoded data of one message of the trace, so that it remains a message."""
    path = folder / "trace.mcap"
    count = sum(1 for _ in NonSeekingReader(BytesIO(path.read_bytes())).iter_messages())
    chosen, told = int(rng.integers(count)), []

    def message(i, channel, m):
        if i != chosen or len(m.data) < 9:
            return m.data
        data = bytearray(m.data)
        data[int(rng.integers(1, len(data)))] ^= 1 << int(rng.integers(8))
        told.append(channel.topic)
        return bytes(data)

    rewrite(path, message=message)
    return f"trace.mcap: {told[0]}" if told else None


def edit_trace(folder, fields, rng):
    """Drop a message of the trace, or change its metadata or its configuration."""
    how = rng.choice(["drop", "status", "configuration"])
    changes = {
        "drop": {"drop": int(rng.integers(40))},
        "status": {"metadata": {"status": "converged, and better"}},
        "configuration": {"attachments": {"configuration.json": b"{}\n"}},
    }
    rewrite(folder / "trace.mcap", **changes[how])
    return f"trace.mcap, {how}"


def change_page(folder, fields, rng):
    """Replace a page by that of another run, or change a letter in it."""
    name = rng.choice(["report.html", "replay.html"])
    page = folder / name
    if rng.random() < 0.5:
        others = [p for p in folder.parent.parent.glob(f"runs/*/{name}") if p.read_bytes() != page.read_bytes()]
        shutil.copy(others[rng.integers(len(others))], page)
        return f"{name}, exchanged"
    text = page.read_text()
    at = int(rng.integers(len(text) // 2, len(text) - 10))
    page.write_text(text[:at] + rng.choice(["1", "a", " "]) + text[at + 1 :])
    return f"{name}, a letter" if page.read_text() != text else None


def edit_plan(folder, fields, rng):
    """Change a number of the plan, and leave the trace as it was."""
    with np.load(folder / "plan.npz") as file:
        arrays = {name: np.array(file[name]) for name in file.files}
    name = rng.choice([name for name, values in arrays.items() if values.size])
    arrays[name].flat[int(rng.integers(arrays[name].size))] += 10 ** rng.uniform(-4, 0)
    np.savez(folder / "plan.npz", **arrays)
    return f"plan.npz, {name}"


def add_file(folder, fields, rng):
    (folder / rng.choice(["certificate.pdf", "notes.txt", "trace2.mcap"])).write_text("all is well")
    return "a file more"


# Relative frequency of each forgery.
FORGERIES = {edit_leaf: 9, delete_part: 2, claim_success: 3, edit_channel: 3, edit_trace: 1, change_page: 2}
FORGERIES |= {edit_plan: 1, add_file: 1}


EDITS = ("edit_leaf", "edit_channel")  # some concern values that cannot be reproduced, or are within rounding


def is_told(what, found):
    """Return whether the only change, which was accepted, is reported as unchecked, as the problem, or as rounding."""
    listed = " ".join(found.unchecked)
    named = what.startswith((*UNCHECKED, *ASKED)) and what.split(".")[0] in listed
    return named or (what == "a file more" and "drake_diff does not write such a file" in listed) or bool(found.rounded)


def measure(seed, count):
    rng = np.random.default_rng(seed)
    tried, refused, told, missed = Counter(), Counter(), Counter(), []
    with tempfile.TemporaryDirectory() as place:
        runs = Path(place) / "runs"
        names = save_runs(runs, rng)
        untouched = [dd.verify(runs / name) for name in names]
        weights = np.array(list(FORGERIES.values())) / sum(FORGERIES.values())
        while sum(tried.values()) < count:
            forge = list(FORGERIES)[rng.choice(len(weights), p=weights)]
            folder = Path(place) / "forged" / str(rng.choice(names))
            shutil.copytree(runs / folder.name, folder)
            before = json.loads((folder / "record.json").read_text())
            fields = copy.deepcopy(before)
            what = forge(folder, fields, rng)
            if what is not None:
                seal(folder, fields)
                found = dd.verify(folder)
                tried[forge.__name__] += 1
                if not found.holds:
                    refused[forge.__name__] += 1
                elif is_told(what, found):
                    told[forge.__name__] += 1
                else:
                    missed.append(f"{folder.name}: {what}")
            shutil.rmtree(folder)
    for line in missed:
        print(f"  accepted: {line}")
    alarms = sum(not found.holds or bool(found.rounded) for found in untouched)
    names = [forge.__name__ for forge in FORGERIES if tried[forge.__name__]]
    accepted = {name: tried[name] - refused[name] - told[name] for name in names}
    words = {name: name.replace("_", " ") for name in names}
    return [
        *(
            Figure(
                f"{words[name]}: refused, or named as unchecked or rounding",
                tried[name] - accepted[name],
                tried[name],
                1.0,
                True,
            )
            for name in names
        ),
        Figure(
            "edits of values and channels that were refused",
            sum(refused[n] for n in EDITS),
            sum(tried[n] for n in EDITS),
            0.9,
            True,
        ),
        Figure("forged claims accepted", sum(accepted.values()), sum(tried.values()), 0.0, False),
        Figure("untouched runs that do not hold to the last bit", alarms, len(untouched), 0.0, False),
    ]
