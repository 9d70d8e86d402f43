"""How the tests are laid out: what several modules share is in `helpers` or, as fixtures, in conftest.py."""

import ast
from pathlib import Path

from helpers.table import each_row

TESTS = Path(__file__).parent


def imported(path):
    for node in ast.walk(ast.parse(path.read_text())):  # those inside of functions too
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield "." * node.level + (node.module or "")
            yield from (f"{node.module or ''}.{alias.name}" for alias in node.names)


def of_tests(names):
    return [name for name in names if any(p == "conftest" or p.startswith("test_") for p in name.split("."))]


def test_no_module_imports_a_test_module_or_conftest():
    found = {str(path.relative_to(TESTS)): of_tests(imported(path)) for path in TESTS.rglob("*.py")}
    assert len(found) > 80
    assert not {path: names for path, names in found.items() if names}


@each_row(
    "line", ["import conftest", "from test_a import b", "from . import test_a", "def f():\n    import test_a as c"]
)
def test_such_an_import_is_found(tmp_path, line):
    (tmp_path / "module.py").write_text(line)
    assert of_tests(imported(tmp_path / "module.py"))
