"""Check the style of messages and pages, or list the messages of the package with --list.

    python .ci/prose.py [--list]

A message is a string of at least four words that is not a docstring. Pages are the Markdown files of the repository,
without their code and tables. The exit status is 1 if a text has a fault. `typos` and `proselint` check spelling and
usage, and the build of the site checks links.
"""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "drake_diff"
PAGES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/**/*.md")
LONGEST = 240  # characters of a message in the source, with its expressions
LONGEST_SENTENCE = 45  # words per sentence of a page; 1 in 100 sentences in the docs of Drake, JAX and diffrax has more
WORDS = 4
FAULTS = {
    "begins without a noun": re.compile(r"^(What|That|None|Of|Those) (?!.*\?$)"),
    "verbless 'none'": re.compile(r"\b(is|are|has|have) none\b"),
    "a chain of semicolons": re.compile(r";[^;]*;"),
    "an inverted sentence": re.compile(r"\b(is not to be|are not to be|is to be told|may not be asked)\b"),
    "a private word": re.compile(r"\b(told|tells of|apart from that|strangers?|elsewhere|untold|dry|marks)\b"),
}
IN_MESSAGES = {"begins without a noun": re.compile(r"^It ")}  # no sentence precedes the pronoun of a message
# Beginnings of texts, by file, that are not sentences (CSS, patterns, policies, README of an export) or that
# schemas and records store verbatim.
LEFT_OUT: dict[str, tuple[str, ...]] = {
    "_base/values.py": ("white-space:",),
    "export/export.py": ("# {name}", "- time step", "\n- Gazebo", "\n- `UrdfConverterCfg`", "positions uniform"),
    "pages/html.py": ("fetch",),
    "pages/live.py": ("default-src",),
    "runs/fields.py": ("This is version",),
    "runs/plan_record.py": ("cost per s and squared unit",),
}
VECTOR = re.compile(r"\[[^\]]*\]")  # such as [q; v], whose semicolon does not join clauses
CODE = re.compile(r"^(\s*)(```|~~~).*?^\s*\2|<!--.*?-->|<[a-zA-Z/][^>]*>|\$\$.*?\$\$", re.M | re.S)
BLOCK = re.compile(r"\n\s*\n|\n(?=\s*(?:[-*|#]|\d+\.) ?)")  # a paragraph, an item, a heading, or a row of a table
SENTENCE = re.compile(r"(?<=[.!?:])\s+(?=[A-Z`\"(*\[])")


def text_of(node: ast.expr) -> str:
    """Return the string of a node with {} in place of its expressions, or "" if it is not a string."""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
    return ""


def messages(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Yield the line and the text of each message in a module."""
    nodes = list(ast.walk(tree))
    statements = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    inside = {
        id(part) for node in nodes if isinstance(node, ast.JoinedStr) for part in ast.walk(node) if part is not node
    }
    for node in nodes:
        if isinstance(node, ast.expr) and id(node) not in statements | inside and len(text_of(node).split()) >= WORDS:
            yield node.lineno, text_of(node)


def sentences(page: str) -> Iterator[tuple[int, str]]:
    """Yield the line of the block and the text of each sentence in a page, except rows of tables."""
    page = CODE.sub(lambda code: "\n" * code[0].count("\n"), page)
    ends = [*(match.end() for match in BLOCK.finditer(page)), len(page)]
    for begin, end in zip([0, *ends], ends, strict=False):
        block = page[begin:end].strip(" \n-*#>")
        if block and not block.startswith("|"):
            line = page.count("\n", 0, begin) + 1
            yield from ((line, sentence) for sentence in SENTENCE.split(" ".join(block.split())))


def faults_in(text: str, extra: dict[str, re.Pattern[str]]) -> list[str]:
    """Return the names of the faults of a text."""
    text = re.sub(r"`[^`]*`", "`code`", VECTOR.sub("", text))
    return [fault for patterns in (FAULTS, extra) for fault, pattern in patterns.items() if pattern.search(text)]


def main() -> int:
    listed, count = "--list" in sys.argv, 0
    for path in sorted(PACKAGE.rglob("*.py")):
        skipped = LEFT_OUT.get(str(path.relative_to(PACKAGE)), ())
        for line, text in sorted(set(messages(ast.parse(path.read_text())))):
            faults = faults_in(text, IN_MESSAGES) + [f"{len(text)} characters"] * (len(text) > LONGEST)
            if listed or (faults and not text.startswith(skipped)):
                count += 1
                print(f"{path.relative_to(ROOT)}:{line}: {text}" + f"  [{'; '.join(faults)}]" * (not listed))
    for path in [] if listed else sorted(path for pattern in PAGES for path in ROOT.glob(pattern)):
        for line, text in sentences(path.read_text()):
            words = len(re.sub(r"`[^`]*`", "code", text).split())
            faults = faults_in(text, {}) + [f"{words} words"] * (words > LONGEST_SENTENCE)
            if faults:
                count += 1
                print(f"{path.relative_to(ROOT)}:{line}: {text}  [{'; '.join(faults)}]")
    print(f"{count} {'messages' if listed else 'faults'}", file=sys.stderr)
    return int(not listed and count > 0)


if __name__ == "__main__":
    sys.exit(main())
