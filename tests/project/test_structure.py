"""Tests of the layout of the tests: shared code is in `helpers`, and shared fixtures are in conftest.py."""

import ast
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

TESTS = Path(__file__).parents[1]
BENCHMARKS = TESTS / "benchmarks"
PROGRAMS = {path.stem for path in BENCHMARKS.glob("*.py")} - {"__main__"} | {"benchmarks"}


def imported(text):
    """Return the parts of the names of all imports, also inside functions."""
    names = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names += [f"{node.module or ''}.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "importorskip")):
            names += [word.value for word in node.args[:1] if isinstance(word, ast.Constant)]
    return [name.removeprefix("tests.").split(".") for name in names]


def test_no_module_imports_a_test_module_and_no_test_a_benchmark():
    texts = {path: imported(path.read_text()) for path in TESTS.rglob("*.py")}
    assert len(texts) > 80
    assert len(PROGRAMS) > 3
    for path, names in texts.items():
        ours = [name for name in names if name[0] != "jax"]  # its test_util is public
        assert not [name for name in ours if any(p == "conftest" or p.startswith("test_") for p in name)], path
        assert BENCHMARKS in path.parents or not [name for name in names if name[0] in PROGRAMS], path
