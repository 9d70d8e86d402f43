"""What is public, and what is loaded for it."""

import copy
import importlib
import pickle
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import drake_diff
import drake_diff.lazy

PACKAGE = Path(drake_diff.__file__).parent
PUBLIC = """
Actuator ArtifactError Barrier Bounds Certificate CertificateError CertificationRecord ClosedLoop Comparison
ComparisonRecord Constraint Contract ContractLine DrakeDiffError Dynamics Engine EvidenceRecord Fallback Finding
Gaussian GradientCase GradientError GradientPanel Hold InputError LQR Loop MPC MissingDependencyError Model ModelError
ModelWarning NonFiniteError NotOfferedError OpenLoop PD ParametricPolicy Predictor Problem Push QuadraticCost
Recording Robustness RobustnessRecord Rollout RolloutCertificate RolloutGradient Sensor ShapeError SimulationError
Smoothed SoftContact Solution Status StepDerivatives TVLQR Transcribed UnknownNameError Verification audit
center_of_mass certify certify_jacobian certify_model certify_rollout closed_loop compare contact_force contact_modes
contact_table differentiate_rollout differentiate_step export_model frame_position frame_rotation_error frame_velocity
gradient_panel linearize list_parameters load_engine load_model load_record match_contracts model_from_diagram
plant_dynamics read_mcap read_recording read_trace robustness rollout run_panel save save_comparison
save_gradient_panel save_robustness smooth smooth_step softened solve step transcribe_and_solve verify
violation_between_nodes
""".split()


def test_the_public_names_are_these():
    modules = {path.stem for path in PACKAGE.glob("*.py")} | {"engines", "loop", "panels"}
    names = {name for name in dir(drake_diff) if not name.startswith("_")}
    assert sorted(names - (modules - set(PUBLIC))) == sorted(drake_diff.__all__) == sorted(PUBLIC)
    for name in PUBLIC:
        assert callable(getattr(drake_diff, name)), name  # no module hides a function of its name


def test_every_public_name_is_documented():
    for name in PUBLIC:
        assert getattr(drake_diff, name).__doc__, name


HEAVY = (
    "numpy pydrake casadi pydantic matplotlib mcap google.protobuf foxglove_schemas_protobuf mujoco pinocchio jax ray "
    "typer rich"
).split()
LOADED = f"""
import sys

def loaded(*but):
    return [name for name in {HEAVY} if name in sys.modules and name not in but]
"""


def fresh(code):
    """What the code prints in an interpreter of its own."""
    done = subprocess.run([sys.executable, "-c", LOADED + code], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_the_package_loads_nothing_heavy():
    assert fresh("import drake_diff; print(loaded())") == "[]\n"


@pytest.mark.parametrize("words", [["--help"], ["--version"]])
def test_the_commands_first_words_load_nothing_heavy(words):
    code = """
from drake_diff.cli import main
sys.argv = ["drake-diff", *WORDS]
try:
    main()
except SystemExit as end:
    print(f"exit {end.code}, loaded {loaded('typer', 'rich')}")
"""
    assert fresh(code.replace("WORDS", repr(words))).splitlines()[-1] == "exit 0, loaded []"


@pytest.mark.parametrize(("words", "status"), [(["run", "--help"], 0), (["run", "no_such_script.py"], 2)])
def test_a_command_that_does_not_begin_loads_no_drake(words, status):
    """Typer itself imports pydantic there, where it finds it."""
    code = """
from drake_diff.cli import main
sys.argv = ["drake-diff", *WORDS]
try:
    main()
except SystemExit as end:
    print(f"exit {end.code}, loaded {loaded('typer', 'rich', 'pydantic')}")
"""
    assert fresh(code.replace("WORDS", repr(words))).splitlines()[-1] == f"exit {status}, loaded []"


def test_a_model_is_loaded_without_records_logs_and_other_engines():
    path = PACKAGE.parent / "models" / "pendulum.urdf"
    found = fresh(f"import drake_diff; drake_diff.load_model({str(path)!r}, time_step=0.01); print(loaded())")
    assert found == "['numpy', 'pydrake']\n"


AGAIN = """
from importlib import import_module
from types import ModuleType

def again():
    for name in [name for name in sys.modules if name.split(".")[0] == "drake_diff"]:
        del sys.modules[name]
    return import_module("drake_diff")
"""


@pytest.mark.slow
def test_every_module_of_public_names_can_be_the_first():
    """Drake stays loaded in between: what counts are our modules."""
    code = """
places = dict(again().lazy.PLACES)
for place in dict.fromkeys(places.values()):
    names = [name for name in places if places[name] == place]
    package = again()
    for name in names:
        assert callable(getattr(package, name)), name
    print(*names)
"""
    assert sorted(fresh(AGAIN + code).split()) == sorted(PUBLIC)


def test_no_order_of_imports_puts_a_module_in_a_functions_place():
    code = """
places = dict(again().lazy.PLACES)
names = [name for name in places if places[name] == f"drake_diff.{name}"]
for name in names:
    for first in (places[name], "drake_diff.engines.load"):
        package = again()
        module = import_module(first)
        exec(f"from drake_diff import {name} as by_from")
        function = getattr(package, name)
        assert not isinstance(function, ModuleType), (name, first)
        assert function is by_from is getattr(sys.modules[places[name]], name), (name, first)
        assert function is pickle.loads(pickle.dumps(function)), (name, first)
print(*names)
"""
    found = fresh("import pickle\n" + AGAIN + code).split()
    assert found == ["audit", "certify", "gradient_panel", "rollout", "step", "verify"]


def test_threads_that_race_for_names_all_get_them():
    code = """
import threading
import drake_diff

names = [*drake_diff.__all__[::5], "step", "solve"] * 2
gate, found = threading.Barrier(len(names)), []

def reach(name):
    gate.wait()
    found.append((name, getattr(drake_diff, name)))

threads = [threading.Thread(target=reach, args=(name,)) for name in names]
for thread in threads:
    thread.start()
for thread in threads:
    thread.join(60)
print(len(found) == len(names) and all(value is getattr(drake_diff, name) for name, value in found))
"""
    assert fresh(code) == "True\n"


def test_public_classes_and_the_package_are_pickled_by_name():
    for name in PUBLIC:
        value = getattr(drake_diff, name)
        assert pickle.loads(pickle.dumps(value)) is value, name
    assert pickle.loads(pickle.dumps(drake_diff)) is copy.deepcopy(drake_diff) is drake_diff


def test_help_lists_the_public_names():
    text = fresh("import drake_diff; help(drake_diff)")
    assert "Trajectory optimization on Drake" in text
    assert re.search(r"^    class Problem\(", text, re.MULTILINE)
    assert re.search(r"^    step\(", text, re.MULTILINE)


def test_a_star_imports_the_public_names():
    assert fresh("from drake_diff import *; print(step.__name__, Problem.__name__)") == "step Problem\n"


def test_a_name_that_is_none_is_refused():
    with pytest.raises(AttributeError, match=r"module 'drake_diff' has no attribute 'stepp'"):
        drake_diff.stepp  # noqa: B018
    with pytest.raises(ImportError, match="cannot import name 'stepp'"):
        exec("from drake_diff import stepp")


@pytest.mark.parametrize(
    ("text", "said"),
    [("import no_such_library", "No module named 'no_such_library'"), ("import math; math.no_such", "no_such")],
)
def test_what_fails_in_a_module_is_told_and_not_called_a_missing_name(text, said, tmp_path, monkeypatch):
    (tmp_path / "broken_module.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(drake_diff.lazy.PLACES, "broken", "broken_module")
    for use in ("drake_diff.broken", "from drake_diff import broken", "hasattr(drake_diff, 'broken')"):
        with pytest.raises(ImportError, match=said):
            exec(use, {"drake_diff": drake_diff})


def test_a_public_name_can_be_replaced_and_comes_back(monkeypatch):
    real = drake_diff.step
    with monkeypatch.context() as patch:
        patch.setattr(drake_diff, "step", len)
        importlib.import_module("drake_diff.step")
        assert drake_diff.step is len
    assert drake_diff.step is real


def test_the_stub_goes_into_the_wheel():
    found = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())
    patterns = found["tool"]["setuptools"]["package-data"]["drake_diff"]
    for name in ("__init__.pyi", "py.typed"):
        assert any(Path(name).match(pattern) for pattern in patterns), name
        assert (PACKAGE / name).is_file()
