"""How the tests are laid out: what several modules share is in `helpers` or, as fixtures, in conftest.py."""

import ast
from pathlib import Path

import pytest

pytestmark = pytest.mark.solve

TESTS = Path(__file__).parents[1]
BENCHMARKS = TESTS / "benchmarks"
PROGRAMS = {path.stem for path in BENCHMARKS.glob("*.py")} - {"__main__"}


def imported(text):
    """All that is imported, inside of functions too."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield "." * node.level + (node.module or "")
            yield from (f"{node.module or ''}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "importorskip")):
            yield from (word.value for word in node.args[:1] if isinstance(word, ast.Constant))


def imported_tests(text):
    return {name for name in imported(text) if any(p == "conftest" or p.startswith("test_") for p in name.split("."))}


def imported_benchmarks(text):
    """By `benchmarks.name`, or by `name` alone, which takes a changed search path."""
    parts = [name.lstrip(".").removeprefix("tests.").split(".") for name in imported(text)]
    return {names[0] for names in parts if names[0] in PROGRAMS or names[0] == "benchmarks"}


def test_no_module_imports_a_test_module_or_conftest():
    found = {path.name: imported_tests(path.read_text()) for path in TESTS.rglob("*.py")}
    assert len(found) > 80
    assert not {path: names for path, names in found.items() if names}


@pytest.mark.slow
def test_no_test_imports_a_benchmark():
    paths = [path for path in TESTS.rglob("*.py") if BENCHMARKS not in path.parents]
    found = {path.name: imported_benchmarks(path.read_text()) for path in paths}
    assert len(PROGRAMS) > 3
    assert not {path: names for path, names in found.items() if names}
