"""Lists the messages of the package, or with --style those that a reader has to read twice.

    python .ci/messages.py [--style]

A message is a string of four words or more that is no docstring. Exits with 1 where --style finds a fault.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "drake_diff"
LONGEST = 240  # characters of a text in the source, with its expressions
WORDS = 4
FAULTS = {
    "begins without a noun": re.compile(r"^(What|That|None|It|Of|Those) "),
    "verbless 'none'": re.compile(r"\b(is|are|has|have) none\b"),
    "a chain of semicolons": re.compile(r";[^;]*;"),
    "an inverted sentence": re.compile(r"\b(is not to be|are not to be|is to be told|may not be asked)\b"),
    "a private word": re.compile(r"\b(told|tells of|apart from that|strangers?|elsewhere|untold|dry|marks)\b"),
}
# How the texts of each file begin that are no sentences (CSS, patterns, policies, README of an export), or that schemas
# and records store word for word.
LEFT_OUT: dict[str, tuple[str, ...]] = {
    "_base/values.py": ("white-space:",),
    "export/export.py": ("# {name}", "- time step", "\n- Gazebo", "\n- `UrdfConverterCfg`", "positions uniform"),
    "pages/html.py": ("fetch",),
    "pages/live.py": ("default-src",),
    "runs/fields.py": ("This is version",),
    "runs/plan_record.py": ("cost per s and squared unit",),
}
VECTOR = re.compile(r"\[[^\]]*\]")  # [q; v], whose semicolons join no clauses


def text_of(node: ast.expr) -> str:
    """A string of the source, with its expressions in braces."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return ""


def messages(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """The line and the text of each message in a module."""
    nodes = list(ast.walk(tree))
    statements = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    inside = {
        id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in ast.walk(node) if part is not node
    }
    for node in nodes:
        if isinstance(node, ast.expr) and id(node) not in statements | inside and len(text_of(node).split()) >= WORDS:
            yield node.lineno, text_of(node)


def main() -> int:
    style, count = "--style" in sys.argv, 0
    for path in sorted(PACKAGE.rglob("*.py")):
        for line, text in sorted(set(messages(ast.parse(path.read_text())))):
            if style and text.startswith(LEFT_OUT.get(str(path.relative_to(PACKAGE)), ())):
                continue
            faults = [fault for fault, pattern in FAULTS.items() if pattern.search(VECTOR.sub("", text))]
            faults += [f"{len(text)} characters"] * (len(text) > LONGEST)
            if faults or not style:
                count += 1
                print(f"{path.relative_to(PACKAGE.parent)}:{line}: {text}" + f"  [{'; '.join(faults)}]" * style)
    print(f"{count} messages", file=sys.stderr)
    return int(style and count > 0)


if __name__ == "__main__":
    sys.exit(main())
