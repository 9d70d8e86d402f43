"""The README's code prints what the README says, and what the documents name is there."""

import importlib
import json
import math
import re
import subprocess
import sys
from pathlib import Path

from helpers.models import ROOT
from helpers.table import each_row

DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
MOST_LINES = 200  # what an engineer reads in ten minutes


def test_the_readmes_code_prints_the_readmes_output(tmp_path):
    readme = (ROOT / "README.md").read_text()
    code, printed = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", readme, re.DOTALL).groups()
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout == printed
    assert (tmp_path / "artifacts" / "cart_pole" / "record.json").is_file()


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text().splitlines()) <= MOST_LINES


@each_row("path", DOCUMENTS, ids=lambda path: path.name)
def test_every_file_that_a_document_names_is_there(path):
    text = path.read_text()
    named = re.findall(r"(?:examples|models|tests|docs)(?:/\w+)*/\w+\.\w+", text)
    linked = [link for link in re.findall(r"\]\(([^)#]+)\)", text) if "://" not in link]
    if path.name != "zoo.md":  # which names files of other packages
        assert not [name for name in named if not (ROOT / name).is_file()]
    made = re.compile(r"reference/|changelog|contributing")  # pages of the site that are written when it is built
    assert not [link for link in linked if not ((path.parent / link).is_file() or made.match(link))]


def test_every_module_that_contributing_names_is_there():
    text = (ROOT / "CONTRIBUTING.md").read_text()
    package = ROOT / "drake_diff"
    modules = re.findall(r"`(\w+(?:/\w+)*\.py)`", text)
    rooms = {name for row in re.findall(r"^\| (`.*?) \|", text, re.MULTILINE) for name in re.findall(r"`(\w+)`", row)}
    assert modules
    assert not [name for name in modules if not ((package / name).is_file() or (ROOT / name).is_file())]
    assert rooms == {path.stem for path in package.iterdir() if path.is_dir() or path.stem == "exceptions"} - {
        "__pycache__",
        *("assets", "models", "schema"),
    }


def test_the_panel_in_the_documents_runs(tmp_path):
    text = (ROOT / "docs" / "panels.md").read_text()
    panel, code = re.search(r"```toml\n(.*?)```.*?```python\n(.*?)```", text, re.DOTALL).groups()
    (tmp_path / "panel.toml").write_text(panel.replace("seeds = 50", "seeds = 1"))
    (tmp_path / "swing.py").write_text(code)
    (tmp_path / "pendulum.urdf").symlink_to(ROOT / "models" / "pendulum.urdf")
    command = [sys.executable, "-m", "drake_diff.cli.main", "panel", "panel.toml", "--out", "out"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(Path(tmp_path, "out", "table.csv").read_text().splitlines()) == 7  # a header and six cells


# What a number in the documents' prose is called by: names and versions, steps of h, codes of a licence.
NAMES = re.compile(r"Python 3\.1\d|\(3\.11, and 3\.12|ROS\s2|h/\d+|BSD-3|ICML 2022|Wild, 2011|\^2|_?invweight0")
SAP = "drake_diff.model.contract:SAP_RELATIVE_TOLERANCE"
TABLE = "tests/test_contact_table.py::test_the_table_in_the_documents_is_this_table"
TURN = "tests/test_engines.py::test_free_bodies_differ_by_the_quaternions_exponential_alone"
RESTING = "tests/test_contact_contract.py::test_the_stiffness_that_is_read_is_that_on_which_a_weight_rests_in_mujoco"
FORWARD = "tests/test_contact_table.py::test_what_the_documents_say_of_physx_and_newton"
BOUNCES = "tests/test_impact_cases.py::test_the_readmes_table_of_a_bounce_and_a_toss"
BLEND = "tests/test_smoothing.py::test_what_the_blend_keeps_of_the_bias_shrinks_with_more_samples"
CODES = {
    "0": "tests/test_cli.py::test_a_run_that_holds_prints_its_checks_and_exits_with_0",
    "1": "tests/test_cli.py::test_a_problem_that_cannot_be_solved_exits_with_1_and_a_complete_artifact",
    "2": "tests/test_cli.py::test_a_missing_script_exits_with_2",
    "3": "tests/test_readme.py::test_what_is_not_installed_exits_with_3",
    "4": "tests/test_cli.py::test_a_bug_in_the_script_exits_with_4_and_its_traceback",
}
# Of each number the constant that it is ("module:NAME", of 5 % as a part), or the test that fails without it.
UNDEFINED = "tests/test_undefined.py::test_what_the_entry_says_is_what_the_loss_does"
LIMIT = "tests/test_flow.py::test_hard_contact_is_the_limit_of_the_compliant_one"
SOURCES = {
    "README.md": {
        **CODES,
        **dict.fromkeys(("1", "0.2", "-1.867", "-13.18", "-1.437", "0.3739", "-0.9686", "0.2648"), BOUNCES),
        "97": "tests/test_readme.py::test_the_network_of_the_example_has_97_weights",
        "1e-6": SAP,
        "60": "drake_diff.runs.verify:WAITED",
    },
    "CONTRIBUTING.md": {},
    "docs/certificates.md": {
        **dict.fromkeys(("13", "1e-2", "1e-8"), "drake_diff.certificates.differences:STEPS"),
        "1e-9": "drake_diff.certificates.certificate:JITTER",
        "1": "drake_diff.certificates.certificate:POWER",
        "1e-4": "drake_diff.certificates.certificate:NEGLIGIBLE",
        "1e-6": SAP,
        "0.4": "drake_diff.certificates.certificate:STOPPED",
        "0.9": "drake_diff.certificates.certificate:DOUBTFUL",
        "0.3": "tests/test_certificate.py::",
        "1e-3": "drake_diff.certificates.truth:WIDTHS",
        "0.1": "drake_diff.certificates.truth:SETTLED",
    },
    "docs/mimic.md": {},
    "docs/mpc.md": {},
    "docs/plan.md": {
        "0": CODES["0"],
        "7": "drake_diff.planning.planner:SMALL",
        "0.7": "drake_diff.planning.standing:OF_FRICTION",
        "0.8": "drake_diff.planning.standing:OF_EFFORT",
        "1e-4": "drake_diff.planning.posture:TOUCHING",
    },
    "docs/contact.md": {
        "1000": "drake_diff.model.triangles:MOST_CORNERS",
        "30000": "drake_diff.pages.shapes:MOST_FACES",
        "1": "tests/test_contact_table.py::test_values_are_those_by_hand_and_by_drake_alone",
        "1e4": "tests/test_contact_table.py::test_values_are_those_by_hand_and_by_drake_alone",
        "1e-6": SAP,
        "1e-3": "drake_diff.motion.flow.plant:STICTION_SPEED",
        **dict.fromkeys(("0.42", "0.29", "-0.13"), TABLE),
        **dict.fromkeys(("0.5", "76", "0.02"), FORWARD),
        **dict.fromkeys(("-1e-2", "-1e-3", "-1e-4", "0.1", "1e-2"), UNDEFINED),  # "+-1e-2" reads as a sign
        "5": "tests/test_undefined.py::test_a_ball_that_passes_another_has_a_slope_only_far_from_touching",
        "24": "drake_diff.motion.undefined:MANY",
        "0": "tests/test_undefined.py::test_a_smoothed_step_has_the_slope_of_its_closed_form",
        **dict.fromkeys(("0.03", "1e6", "1e8", "-1", "2"), LIMIT),
        "30": BLEND,
        "0.01": "tests/test_gradient_panel.py::test_on_stiff_ground_the_jumps_of_the_step_turn_the_sign_of_first_order",
    },
    "docs/engines.md": {
        "1e-13": "tests/test_engines.py::test_the_step_and_its_jacobian_are_drakes",
        "1e-12": "tests/test_engines.py::test_the_step_and_its_jacobian_are_drakes",
        "1e-10": "tests/test_engines.py::test_the_step_and_its_jacobian_are_drakes",
        "1e-11": "tests/test_engines.py::test_the_step_and_its_jacobian_are_drakes",
        "8": TURN,
        "4e-6": "tests/test_engines.py::test_without_explicit_damping_the_step_is_drakes_and_else_the_formula",
        "1e-6": "tests/test_engines.py::test_without_explicit_damping_the_step_is_drakes_and_else_the_formula",
        "1": RESTING,
    },
    "docs/limitations.md": {
        **dict.fromkeys(("0", "0.1"), "tests/test_certificate.py::"),
        "0.01": "tests/test_bounce_oracles.py::test_a_resolved_collision_has_the_compliant_gradient",
        "1": "tests/test_rollout_certificate.py::",
        "1e-6": SAP,
        "-1e-2": UNDEFINED,
        "8": TURN,
        "3": "drake_diff.optimize.replay:FEEDBACK_TOLERANCE",
        "5": "drake_diff.optimize.replay:STATE_TOLERANCE",
    },
    "docs/index.md": {},
    "docs/contact_models.md": {},
    "docs/methods.md": {},
    "docs/report.md": {},
    "docs/loop.md": {},
    "docs/glossary.md": {"1": "drake_diff.certificates.certificate:POWER"},
    "docs/gradients.md": {},
    "docs/logs.md": {
        "1": "tests/test_verify.py::",
        "1e-6": "drake_diff.runs.differences:RELATIVE",
        "1e-9": "drake_diff.runs.differences:ABSOLUTE",
    },
    "docs/models.md": {
        "0.5": "drake_diff.model.repairs:GROUND_FRICTION",
        **dict.fromkeys(("0", "1"), "tests/test_audit_model.py::test_a_trap_is_named_and_its_remedy_mends_it"),
    },
    "docs/tasks.md": {
        **dict.fromkeys(
            ("5", "0.01", "0.05"), "tests/test_goals.py::test_the_default_tolerances_are_those_of_the_documents"
        ),
        "1": "drake_diff.optimize.transcription.between:JERK_TOLERANCE",
        "200": "tests/test_stays.py::test_a_pendulum_swings_up_to_where_a_regulator_takes_over",
        "1e-3": "drake_diff.optimize.problem.problem:SMALLEST_PART",
        "1e-12": "drake_diff.optimize.sensitivity:EXACT_TOLERANCE",
        "1e-4": "drake_diff.optimize.sensitivity:SAME",
        "1e-5": "drake_diff.optimize.transcription.kkt:NEAREST",
        **dict.fromkeys(
            ("57.94", "58.81"), "tests/test_restarts.py::test_both_swing_ups_of_kellys_cart_pole_are_listed"
        ),
    },
    "docs/panels.md": {
        "95": "tests/test_robustness.py::test_intervals_are_the_published_ones",
        "20": "tests/test_readme.py::test_the_reference_run_steps_by_20_ms",
        "0": "tests/test_panel.py::",
    },
}  # fmt: skip


def prose(path):
    """The text without code, links, and tables of figures, which have tests or a command of their own."""
    text = re.sub(r"<!--.*?-->|```.*?```|`[^`]*`|\]\([^)]*\)", " ", path.read_text(), flags=re.DOTALL)
    if path.name in ("contact.md", "tasks.md"):
        text = "\n".join(line for line in text.splitlines() if not line.startswith("|"))
    return NAMES.sub(" ", text)


FIGURES = (
    "trust.md",
    "zoo.md",
    "impacts.md",
    "continuous_plans.md",
    "benchmarks.md",
    "tasks_solved.md",
    "contact_plans.md",
    "mpc_realtime.md",
    "derivatives.md",
    "speed.md",
    "identification.md",
    "strangers.md",
    "artifacts.md",
)  # pages that a benchmark writes


@each_row("path", [path for path in DOCUMENTS if path.name not in FIGURES], ids=lambda path: path.name)
def test_every_number_of_the_documents_has_a_source(path):
    """Those in FIGURES have figures of their own, with the command and the seed that make them."""
    sources = SOURCES[str(path.relative_to(ROOT))]
    numbers = set(re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?(?:e[+-]?\d+)?(?!\w)", prose(path)))
    assert numbers <= sources.keys(), f"no source of {sorted(numbers - sources.keys())}"
    for number, source in sources.items():
        if "::" in source:
            file, test = source.split("::")
            assert f"def {test}" in (ROOT / file).read_text(), source
        else:
            module, name = source.split(":")
            value = getattr(importlib.import_module(module), name)
            values = (len(value), *value) if isinstance(value, tuple) else (value, 100 * value)
            assert any(math.isclose(float(number), each, rel_tol=1e-12) for each in values), source


def test_the_optimum_of_the_continuous_swing_up_is_no_claim_of_the_documents():
    """58.8077 is a local optimum; 57.9448 is less (see test_transcription)."""
    assert not [path.name for path in DOCUMENTS if "58.8077" in path.read_text()]


def test_the_network_of_the_example_has_97_weights():
    text = (ROOT / "examples" / "neural_network_policy.py").read_text()
    hidden = int(re.search(r"HIDDEN, STEP_SIZE = \S+ (\d+),", text)[1])
    assert "[4 * HIDDEN, HIDDEN, HIDDEN]" in text  # of 4 inputs; one more bias for the output
    assert 4 * hidden + hidden + hidden + 1 == 97


def test_the_reference_run_steps_by_20_ms():
    record = json.loads((ROOT / "artifacts" / "pendulum_swing_up" / "record.json").read_text())
    assert record["contract"]["time_step"] == 0.02


def test_what_is_not_installed_exits_with_3(tmp_path):
    script = "import sys; sys.modules['mujoco'] = None\nfrom drake_diff.cli.main import main\nmain()"
    command = [sys.executable, "-c", script, "export-model", str(ROOT / "models" / "hopper.sdf"), "--to", "mjcf"]
    done = subprocess.run([*command, "--out", str(tmp_path / "out")], capture_output=True, text=True, timeout=300)
    assert done.returncode == 3, done.stdout + done.stderr
