"""Alter pages, scenes and sentences, with correct hashes and content policies: `verify` must accept none of them.

    python tests/benchmarks/fuzz_pages.py [--seed 0] [--count 300]

Directories of eight kinds are saved, two of each kind that shows a motion. Then one page is altered at random. Its
scene is replaced by that of another run, or gets another number or a truncated command. A script, a picture or words
are inserted, a number of a plot is changed, or the page is replaced by another run's. Some alterations change the
sentence in the record, the trace and all pages. The verdicts of `verify` are counted by kind and by alteration. What is
not reproduced (scenes and plots of comparisons and trials) may be "intact", which states that contents are not checked.
An alteration that "holds" is missed. Unaltered directories that are refused are false alarms.
"""

import argparse
import dataclasses
import json
import re
import shutil
import struct
import sys
import tempfile
import time
import warnings
from base64 import b64encode
from collections import Counter
from html import unescape
from pathlib import Path

import _one_thread  # noqa: F401 (before NumPy)

sys.path.insert(0, str(Path(__file__).parents[1]))  # tests/helpers

import numpy as np
from helpers.forgery import COMMAND, seal, with_commands, with_scene_of, with_scripts
from helpers.models import MODELS
from markupsafe import escape

import drake_diff as dd
from drake_diff.comparison import save_comparison
from drake_diff.panels import run_panel
from drake_diff.runs.verify import verify_own
from drake_diff.trials import save_robustness

NOT_RUN_AGAIN = ("comparison", "robustness", "panel")


def save_kinds(folder):
    model, block = (dd.load_model(MODELS / name, time_step=0.02) for name in ("pendulum.urdf", "sliding_block.sdf"))
    x0, end, free = np.zeros(13), np.full(13, np.nan), np.zeros(13, dtype=bool)
    x0[[0, 6, 10]], free[10] = (1, 0.1, 1), True
    for i, goal in enumerate((0.5, 1.0)):
        task = dd.Problem(model, x0=[0, 0], x_goal=[goal, 0], num_steps=10, running_cost=dd.QuadraticCost(R=[[1.0]]))
        plan, timed = dd.solve(task, method="shooting"), dataclasses.replace(task, horizon=(0.1, 0.4))
        dd.save(plan, folder / f"shooting{i}")
        dd.save(dd.solve(timed, method="collocation"), folder / f"collocation{i}")
        end[4] = 0.06 + 0.01 * i
        slide = dd.Problem(block, x0=x0, x_goal=end, num_steps=10, optimize=("initial_state",), initial_state_mask=free)
        dd.save(dd.solve(slide, method="shooting"), folder / f"contact{i}")
        parts = [dataclasses.replace(timed, x_goal=np.full(2, np.nan)), dataclasses.replace(timed, x0=[goal / 2, 0])]
        dd.save(dd.solve(dd.optimize.PhasedProblem(parts)), folder / f"phases{i}")
        save_comparison(dd.compare(model, ("numpy",), x0=[goal, 0], num_steps=5), folder / f"comparison{i}")
        tried = dd.robustness(plan, {"mass": [0.1]}, trials=2, controller="open_loop")
        save_robustness(tried, folder / f"robustness{i}")
    motion = dd.rollout(model, [1.0, 0.0], np.zeros((100, 1)), parameters={"hinge.damping": 0.2})
    noisy = motion.xs + 1e-3 * np.random.default_rng(0).standard_normal(motion.xs.shape)
    log = dd.Recording("swing", "1", 0.02 * np.arange(101), noisy, np.zeros((100, 1)))
    dd.save(dd.identify(model, log, ["hinge.damping"]), folder / "identification0")
    (folder.parent / "trials.py").write_text("def square(trial): return {'cost': trial['x'] ** 2}")
    (folder.parent / "panel.toml").write_text('evaluate = "trials.py:square"\n[axes]\nx = [1, 2, 3]')
    run_panel(folder.parent / "panel.toml", out=folder / "panel0", workers=1)


def number_in_scene(page, _, rng):
    """Change one number of a command by 0.001 to 1 times the largest number in the command."""
    wanted = int(rng.integers(len(COMMAND.findall(unescape(page)))))

    def change(i, data):
        places = [at for at in range(len(data) - 8) if data[at] == 0xCB]
        if i != wanted or not places:
            return data
        values = np.array([struct.unpack(">d", data[at + 1 : at + 9])[0] for at in places])
        k, largest = rng.integers(len(values)), float(np.max(np.abs(values), where=np.abs(values) < 1e9, initial=0.0))
        new = values[k] + rng.choice([-1, 1]) * max(largest, 1e-3) * 10 ** rng.uniform(-3, 0)
        return data[: places[k] + 1] + struct.pack(">d", new) + data[places[k] + 9 :]

    return with_commands(page, change)


def bytes_of_scene(page, _, rng):
    """Truncate a command, possibly to nothing."""
    wanted = int(rng.integers(len(COMMAND.findall(unescape(page)))))
    return with_commands(page, lambda i, data: data[: int(rng.integers(len(data)))] if i == wanted else data)


def script(page, _, rng):
    return with_scripts(page, lambda text: f"{text}//{b64encode(rng.bytes(60)).decode()}")


def words(page, _, rng):
    read = [m for m in re.finditer(r"(?<=>)[^<>]{2,200}(?=<)", page) if re.search(r"\w", m[0])]
    match = read[rng.integers(len(read))]
    return page[: match.start()] + match[0].rstrip() + " or better" + page[match.end() :]


def picture(page, _, rng):
    return page.replace("<body>", f'<body><img src="data:image/png;base64,{b64encode(rng.bytes(300)).decode()}">', 1)


def plot(page, _, rng):
    """Change the digit before the decimal point of a number that a page plots."""
    start = page.find('id="data">')
    digits = [m.start() for m in re.finditer(r"(?<=[\[,])\d(?=\.\d+[,\]])", page)] if start > 0 else []
    digits = [at for at in digits if start < at < page.index("</script>", start)]
    if not digits:
        return page
    at = digits[rng.integers(len(digits))]
    return page[:at] + str((int(page[at]) + int(rng.integers(1, 9))) % 10) + page[at + 1 :]


SCENES = {"scene of another run": lambda page, other, _: with_scene_of(page, other)}
SCENES |= {"number in a scene": number_in_scene, "command of a scene cut": bytes_of_scene}
PAGES = {"script": script, "words": words, "picture": picture, "number of a plot": plot}
PAGES |= {"page of another run": lambda page, other, _: other}


def sentence_changed(folder, rng):
    """Change the sentence in the record and in all files that show it."""
    fields = json.loads((folder / "record.json").read_text())
    old = fields["sentence"]
    fields["sentence"] = f"{old} It was checked on the robot."
    for path in folder.rglob("*.html"):
        page = path.read_text()
        for text, other in ((json.dumps(old)[1:-1], json.dumps(fields["sentence"])[1:-1]), (old, fields["sentence"])):
            page = page.replace(str(escape(text)), str(escape(other))).replace(text, other)
        path.write_text(page)
    seal(folder, fields, attach=(folder / "trace.mcap").is_file())


def altered(folder, other, rng):
    """Alter `folder` and return the name of the change, or None; `other` is a run of the same kind, if it exists."""
    if rng.random() < 0.1:
        sentence_changed(folder, rng)
        return "sentence"
    pages = sorted(folder.rglob("*.html"))
    path = pages[rng.integers(len(pages))]
    page = path.read_text()
    ways = {**PAGES, **(SCENES if COMMAND.search(unescape(page)) else {})}
    ways = {name: way for name, way in ways.items() if other.is_dir() or "another run" not in name}
    name = str(rng.choice(list(ways)))
    beside = other / path.relative_to(folder)
    new = ways[name](page, beside.read_text() if beside.is_file() else page, rng)
    if new == page:
        return None
    path.write_text(new)
    inside = [parent for parent in path.parents if parent.is_relative_to(folder)]
    for sealed in [parent for parent in inside if (parent / "record.json").is_file()]:
        seal(sealed, json.loads((sealed / "record.json").read_text()), attach=False)
    return name


def fuzz(count, seed):
    """Return verdict counts by kind and alteration, missed alterations, false alarms and the number of directories."""
    rng, verdicts, missed = np.random.default_rng(seed), Counter(), []
    with tempfile.TemporaryDirectory() as name, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        runs = Path(name) / "runs"
        save_kinds(runs)
        saved = sorted(path for path in runs.iterdir() if path.is_dir())
        unaltered = {path.name: verify_own(path) for path in saved}
        alarms = [
            f"{name}: {result}"
            for name, result in unaltered.items()
            if result.complaints or not (result.holds or (result.verdict == "intact" and name[:-1] in NOT_RUN_AGAIN))
        ]
        while sum(verdicts.values()) < count:
            chosen = saved[rng.integers(len(saved))]
            kind, i = chosen.name[:-1], int(chosen.name[-1])
            folder = Path(name) / "altered" / chosen.name
            shutil.copytree(chosen, folder)
            what = altered(folder, runs / f"{kind}{1 - i}", rng)
            if what is not None:
                result = verify_own(folder)
                verdicts[kind, what, result.verdict] += 1
                if result.holds or (result.verdict == "intact" and "contents not checked" not in str(result)):
                    missed.append(f"{chosen.name}: {what}: {result}")
            shutil.rmtree(folder)
    return verdicts, missed, alarms, len(saved)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=300)
    asked = parser.parse_args()
    start = time.monotonic()
    verdicts, missed, alarms, saved = fuzz(asked.count, asked.seed)
    for column in (0, 1, 2):  # by kind, by alteration, and in total
        counts = Counter()
        for key, number in verdicts.items():
            counts[key[column], key[2]] += number
        for (group, verdict), number in sorted(counts.items()):
            print(f"{number:6d} {group}: {verdict}" if column < 2 else f"{number:6d} {verdict}")
    for line in (*missed, *alarms):
        print(line)
    print(f"{asked.count} alterations, seed {asked.seed}: {len(missed)} missed")
    print(f"{saved} unaltered directories: {len(alarms)} false alarms; {time.monotonic() - start:.0f} s in all")
    sys.exit(1 if missed or alarms else 0)


if __name__ == "__main__":
    main()
