"""Count the size of the project and fail above a limit of `[tool.drake_diff.budget]` in pyproject.toml.

    python .ci/budget.py [--root DIRECTORY]

Prints a table with each count, its limit and its target, and exits with status 1 if a count is above its limit. A limit
is the count that the tree has reached, a target is required by the architecture. Lower a limit when its count falls.
"""

import argparse
import ast
import re
import sys
import tomllib
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path

# Names that do not describe a value or an action. They are counted where they name a local, an argument or a function.
VAGUE_NAMES = frozenset(["found", "told", "one", "each", "own", "said", "at", "of", "part", "place", "kept"])


def modules(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*.py") if "__pycache__" not in path.parts)


def count_lines(paths: list[Path]) -> int:
    return sum(len(path.read_text().splitlines()) for path in paths)


def count_words(paths: list[Path]) -> int:
    return sum(len(path.read_text().split()) for path in paths)


def count_vague_names(tree: ast.AST) -> int:
    """Count the bindings of names in `VAGUE_NAMES`: assigned locals, arguments and functions."""
    names: list[str] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            names.append(node.id)
        elif isinstance(node, ast.arg):
            names.append(node.arg)
        elif isinstance(node, ast.FunctionDef):
            names.append(node.name.strip("_"))
    return sum(name in VAGUE_NAMES for name in names)


def count_constants(tree: ast.Module) -> int:
    """Count the assignments of a number, or of a tuple with a number, at module level."""
    values = [node.value for node in tree.body if isinstance(node, ast.Assign | ast.AnnAssign) and node.value]
    return sum(any(_is_number(item) for item in _items(value)) for value in values)


def _items(value: ast.expr) -> list[ast.expr]:
    return value.elts if isinstance(value, ast.Tuple) else [value]


def _is_number(value: ast.expr) -> bool:
    if isinstance(value, ast.UnaryOp | ast.BinOp):
        return True
    return isinstance(value, ast.Constant) and type(value.value) in (int, float)


def count_repeated_classes(trees: list[ast.Module]) -> int:
    """Count the public class names that more than one module defines."""
    counts = Counter(name for tree in trees for name in _public_classes(tree))
    return sum(count > 1 for count in counts.values())


def _public_classes(tree: ast.Module) -> set[str]:
    return {node.name for node in tree.body if isinstance(node, ast.ClassDef) and not node.name.startswith("_")}


def count_root_names(root: Path) -> int:
    text = (root / "drake_diff/__init__.pyi").read_text()
    return len(re.findall(r"^from \.\S* import \w+ as \w+$", text, flags=re.MULTILINE))


def measure(root: Path, packages: Iterable[str]) -> dict[str, tuple[int, ...]]:
    """Return the counts by name. A package has two counts, its modules and its lines."""
    source = root / "drake_diff"
    paths = modules(source)
    trees = [ast.parse(path.read_text()) for path in paths]
    benchmarks = modules(root / "tests/benchmarks")
    tests = [path for path in modules(root / "tests") if path not in benchmarks]
    pages = sorted((root / "docs").rglob("*.md"))
    counts: dict[str, tuple[int, ...]] = {"total": (len(paths), count_lines(paths))}
    for name in packages:
        inside = [path for path in paths if path.relative_to(source).parts[0] in name.split("+")]
        counts[name] = (len(inside), count_lines(inside))
    counts["root names"] = (count_root_names(root),)
    counts["record schemas"] = (len(list((source / "schema").glob("*.json"))),)
    counts["constants of modules"] = (sum(count_constants(tree) for tree in trees),)
    counts["vague names"] = (sum(count_vague_names(tree) for tree in trees),)
    counts["repeated class names"] = (count_repeated_classes(trees),)
    counts["lines of tests"] = (count_lines(tests),)
    counts["lines of benchmarks"] = (count_lines(benchmarks),)
    counts["words of documentation"] = (count_words(pages),)
    counts["words of README"] = (count_words([root / "README.md"]),)
    return counts


def unlisted_packages(root: Path, packages: Iterable[str]) -> list[str]:
    """Return the packages of drake_diff that no row of the budget lists."""
    listed = {name for row in packages for name in row.split("+")}
    folders = {path.relative_to(root / "drake_diff").parts[0] for path in modules(root / "drake_diff")}
    return sorted(name for name in folders - listed if not name.endswith(".py"))


def rows(root: Path) -> Iterator[tuple[str, int, int, int]]:
    """Yield the name, count, limit and target of each row of the budget."""
    budget = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["drake_diff"]["budget"]
    counts = measure(root, budget["packages"])
    for name in unlisted_packages(root, budget["packages"]):
        yield f"{name}, which the budget does not list", 1, 0, 0
    for name, row in (budget["packages"] | budget["totals"]).items():
        kinds = (" modules", " lines") if len(counts[name]) == 2 else ("",)
        for kind, count, limit, target in zip(kinds, counts[name], row["limit"], row["target"], strict=True):
            yield name + kind, count, limit, target


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[1])
    above = 0
    print(f"{'':42}{'count':>8}{'limit':>8}{'target':>8}")
    for name, count, limit, target in rows(parser.parse_args().root):
        above += count > limit
        print(f"{name:42}{count:8}{limit:8}{target:8}" + ("  ABOVE THE LIMIT" if count > limit else ""))
    return 1 if above else 0


if __name__ == "__main__":
    sys.exit(main())
