"""Tests that public functions and classes document their arguments and results, and that their examples run."""

import doctest
import importlib
import inspect
import re
from pathlib import Path

import numpy as np
import pytest
from helpers.models import ROOT

import drake_diff as dd
from drake_diff import quantities

pytestmark = pytest.mark.solve

OPTIONS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
ROOMS = [path.parent.name for path in sorted(Path(dd.__file__).parent.glob("*/__init__.pyi"))]
OF_QUANTITIES = ["center_of_mass", "contact_force", "frame_position", "frame_rotation_error", "frame_velocity"]


def public():
    """Return each public function and class once, by its full name."""
    found = {f"dd.{name}": getattr(dd, name) for name in dd.__all__}
    found |= {f"dd.quantities.{name}": getattr(quantities, name) for name in OF_QUANTITIES}
    for room in ROOMS:
        package = importlib.import_module(f"drake_diff.{room}")
        found |= {f"drake_diff.{room}.{name}": getattr(package, name) for name in package.__all__}
    once = {}
    for name, value in found.items():
        if callable(value) and not any(value is other for other in once.values()):
            once[name] = value
    return once


PUBLIC = public()
FUNCTIONS = {name: value for name, value in PUBLIC.items() if inspect.isfunction(value)}
EXAMPLES = {*FUNCTIONS, *(name for name in PUBLIC if name.startswith("dd."))}  # these need an example


def described(text):
    """Return the argument names in a docstring's Args, where one entry may have several names."""
    section = re.split(r"^\w+:$", text.partition("\nArgs:\n")[2], flags=re.MULTILINE)[0]
    entries = re.findall(r"^ {4}([*\w]+(?:, [*\w]+)*):", section, flags=re.MULTILINE)
    return {name.lstrip("*") for entry in entries for name in entry.split(", ")}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_names_each_argument_and_what_it_returns(name):
    function = FUNCTIONS[name]
    text = inspect.getdoc(function)
    assert not [argument for argument in inspect.signature(function).parameters if argument not in described(text)]
    assert "Returns:" in text or inspect.signature(function).return_annotation is None


LONG = ("drake_diff.identification.identify_contact", "excite", "drake_diff.identification.write_model")


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in LONG else []) for name in PUBLIC]
)
def test_the_example_runs(name, monkeypatch, tmp_path):
    (tmp_path / "artifacts").mkdir()
    for folder in ("models", "examples", "artifacts/pendulum_swing_up"):
        (tmp_path / folder).symlink_to(ROOT / folder)
    monkeypatch.chdir(tmp_path)
    text = inspect.getdoc(PUBLIC[name])
    test = doctest.DocTestParser().get_doctest(text, {"dd": dd, "np": np}, name, None, 0)
    assert test.examples or name not in EXAMPLES
    said = []
    doctest.DocTestRunner(optionflags=OPTIONS).run(test, out=said.append)
    assert not said, "".join(said)
