"""Tests that the README's code prints the README's output, and that files and numbers in documents are right."""

import importlib
import math
import re
import subprocess
import sys
from itertools import product
from operator import attrgetter

import numpy as np
import pytest
from helpers.continuous import error_controlled_end
from helpers.models import ROOT, Plant, contact_properties
from helpers.table import each_row
from pydrake.geometry import Sphere
from pydrake.math import RigidTransform
from pydrake.multibody.tree import SpatialInertia

import drake_diff as dd

pytestmark = pytest.mark.solve

DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_the_readmes_code_prints_the_readmes_output(tmp_path):
    readme = (ROOT / "README.md").read_text()
    code, printed = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", readme, re.DOTALL).groups()
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout == printed
    assert (tmp_path / "artifacts" / "cart_pole" / "record.json").is_file()


@each_row("path", DOCUMENTS, ids=lambda path: path.name)
def test_every_file_that_a_document_names_is_there(path):
    text = path.read_text()
    named = re.findall(r"(?:examples|models|tests|docs)(?:/\w+)*/\w+\.\w+", text)
    linked = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    assert not [name for name in named if not (ROOT / name).is_file()]
    made = re.compile(r"reference/|changelog|contributing")  # pages that are written when the site is built
    assert not [link for link in linked if not ((path.parent / link).is_file() or made.match(link))]


def bouncing_ball(made):
    """Add a ball without loss or gravity; return contact properties, initial state and the derivative's index."""
    skin = contact_properties(2e4, 0.0, 0.5, 0.0)
    made.plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
    made.ball("ball", 1.0, 0.1, skin, "z")
    return skin, [1.0, -2.0], 0


def tossed_cube(made):
    """Add a cube with small balls at its corners; return the same as `bouncing_ball`."""
    skin = contact_properties(4e3, 0.5, 0.5, 0.0)
    made.plant.mutable_gravity_field().set_gravity_vector([0, 0, -2])
    cube = made.plant.AddRigidBody("cube", SpatialInertia.SolidBoxWithMass(0.1, 0.1, 0.1, 0.1))
    for i, corner in enumerate(product((-0.049, 0.049), repeat=3)):
        made.plant.RegisterCollisionGeometry(cube, RigidTransform(corner), Sphere(1e-3), f"corner {i}", skin)
    return skin, [math.cos(math.pi / 6), math.sin(math.pi / 6), 0, 0, 0, 0, 0.2, 0, 0, 0, 0, -0.1, -2.0], 5


def motion(build, time_step):
    made = Plant(time_step, "lagged")
    skin, x0, of = build(made)
    made.ground(skin)
    made.plant.set_stiction_tolerance(1e-3)
    return made, x0, of


def slope_by_differences(build):
    """Return the extrapolated slope of Drake's error-controlled integration of the continuous plant."""
    made, x0, of = motion(build, 0.0)
    made.plant.Finalize()
    end, last = error_controlled_end(made.plant, made.builder.Build(), 1.0), np.eye(len(x0))[-1]
    one, two = ((end(x0 + w * last)[of] - end(x0 - w * last)[of]) / (2 * w) for w in (1e-3, 2e-3))
    return (4 * one - two) / 3


def slope_through(build, time_step, method):
    made, x0, of = motion(build, time_step)
    count = round(1 / time_step)
    return dd.differentiate_rollout(made.model(), x0, None, lambda x: x[of], num_steps=count, method=method).by_x0[-1]


@pytest.mark.slow
def test_the_table_of_a_bounce_and_a_toss():
    text = (ROOT / "docs/gradients.md").read_text()
    table = text[text.index("| One second, d end") :].split("\n\n")[0]
    printed = [[cell.strip() for cell in row.split("|")[2:4]] for row in table.splitlines()[2:]]
    motions = bouncing_ball, tossed_cube
    found = [
        [slope_through(build, 1e-3, "autodiff") for build in motions],
        [slope_through(build, 2e-4, "autodiff") for build in motions],
        [slope_through(build, 1e-2, "continuous") for build in motions],
        [math.pi / math.sqrt(1e4) - 1, slope_by_differences(tossed_cube)],  # half a period of m = 1, k = 1e4
    ]
    for row, values in zip(printed, found, strict=True):
        assert row == [f"{value:.4g}" for value in values]


# The numbers in each document that are constants of the package, as "module:name". 5 % may be 5 or 0.05.
SAP = "drake_diff.model.contract:SAP_RELATIVE_TOLERANCE"
CONSTANTS = {
    "docs/index.md": {"60": "drake_diff.runs.verify:WAITED"},
    "docs/certificates.md": {
        **dict.fromkeys(("13", "1e-2", "1e-8"), "drake_diff.certificates.differences:DIFFERENCES.steps"),
        "1e-9": "drake_diff.certificates.certificate:VerdictOptions.jitter",
        "1": "drake_diff.certificates.certificate:VerdictOptions.power",
        "1e-4": "drake_diff.certificates.certificate:VerdictOptions.negligible",
        "1e-6": SAP,
        "0.4": "drake_diff.certificates.certificate:VerdictOptions.stopped",
        "0.9": "drake_diff.certificates.certificate:VerdictOptions.doubtful",
        "1e-3": "drake_diff.certificates.truth:TRUTH.widths",
        "0.1": "drake_diff.certificates.truth:TRUTH.settled",
    },
    "docs/plan.md": {
        "7": "drake_diff.planning.planner:SMALL",
        "0.7": "drake_diff.legs.standing:OF_FRICTION",
        "0.8": "drake_diff.legs.standing:OF_EFFORT",
        "1e-4": "drake_diff.planning.robot:TOUCHING",
    },
    "docs/contact.md": {
        "1000": "drake_diff.model.triangles:MOST_CORNERS",
        "30000": "drake_diff.pages.shapes:MOST_FACES",
        "1e-6": SAP,
        "1e-3": "drake_diff.motion.compliance:STICTION_SPEED",
        "24": "drake_diff.motion.undefined:MANY",
    },
    "docs/limitations.md": {
        "1e-6": SAP,
    },
    "docs/verification.md": {
        "3": "drake_diff.optimize.replay:FEEDBACK_TOLERANCE",
        "5": "drake_diff.optimize.replay:STATE_TOLERANCE",
        "1e-6": "drake_diff.runs.differences:RELATIVE",
        "1e-9": "drake_diff.runs.differences:ABSOLUTE",
    },
    "docs/models.md": {"0.5": "drake_diff.model.repairs:GROUND_FRICTION"},
    "docs/tasks.md": {
        "1": "drake_diff.optimize.transcription.between:JERK_TOLERANCE",
        "1e-3": "drake_diff.optimize.problem.problem:SMALLEST_PART",
        "1e-12": "drake_diff.optimize.sensitivity:EXACT_TOLERANCE",
        "1e-4": "drake_diff.optimize.sensitivity:SAME",
        "1e-5": "drake_diff.optimize.transcription.kkt:NEAREST",
    },
}


@each_row("document", CONSTANTS)
def test_a_number_of_a_document_is_the_constant_of_the_package(document):
    text = re.sub(r"<!--.*?-->|```.*?```|`[^`]*`|\]\([^)]*\)", " ", (ROOT / document).read_text(), flags=re.DOTALL)
    numbers = set(re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?!\w)", text))
    for number, constant in CONSTANTS[document].items():
        module, name = constant.split(":")
        value = attrgetter(name)(importlib.import_module(module))
        values = (len(value), *value) if isinstance(value, tuple) else (value, 100 * value)
        assert number in numbers, constant
        assert any(math.isclose(float(number), each, rel_tol=1e-12) for each in values), constant


@pytest.mark.slow
def test_what_is_not_installed_exits_with_3(tmp_path):
    script = "import sys; sys.modules['mujoco'] = None\nfrom drake_diff.cli.main import main\nmain()"
    command = [sys.executable, "-c", script, "export-model", str(ROOT / "models" / "hopper.sdf"), "--to", "mjcf"]
    done = subprocess.run([*command, "--out", str(tmp_path / "out")], capture_output=True, text=True, timeout=300)
    assert done.returncode == 3, done.stdout + done.stderr


def test_the_idioms_of_the_page_for_users_of_drake_are_arguments_of_a_problem():
    page = (ROOT / "docs/drake.md").read_text()
    wanted = ("running_cost", "constraints", "bounds", "x_goal")
    idioms = [re.search(rf"`({name}=[^`]*)`", page).group(1) for name in wanted]
    made = f"dd.Problem(dd.example_model('pendulum', time_step=0.05), x0=[0, 0], num_steps=40, {', '.join(idioms)})"
    assert dd.solve(eval(made, {"dd": dd}), restarts=0).success
