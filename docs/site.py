"""Generate pages of the site during its build: reference, notebooks and files of the top folder."""

import json
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "drake_diff"
NAME = re.compile(r"^from \.([\w.]+) import (\w+) as \w+$", re.MULTILINE)
# The packages in the order of use.
USE = [
    "model",
    "planning",
    "derivatives",
    "motion",
    "certificates",
    "optimize",
    "runs",
    "logs",
    "trials",
    "loop",
    "engines",
    "comparison",
    "export",
]
NOTEBOOKS, GALLERY = ROOT / "docs/notebooks", ROOT / "docs/gallery"
TOP = {"changelog.md": "CHANGELOG.md", "contributing.md": "CONTRIBUTING.md"}


def by_use(path: str) -> int:
    """Return the rank of a name "drake_diff.PACKAGE..." in the order of use."""
    return next((i for i, package in enumerate(USE) if f"drake_diff.{package}." in f"{path}."), len(USE))


def names_of(package: str) -> dict[str, str]:
    """Return the full path of each public name of a package ("" for the root)."""
    folder = PACKAGE / package
    found = NAME.findall((folder / "__init__.pyi").read_text())
    prefix = ".".join(["drake_diff", *([package] if package else [])])
    return {name: f"{prefix}.{module}.{name}" for module, name in found}


def reference() -> dict[str, str]:
    """Return the text of each reference page: one for the names of `dd`, one for each package with further names."""
    root = dict(sorted(names_of("").items(), key=lambda item: by_use(item[1])))
    pages = {}
    for stub in sorted(PACKAGE.glob("*/__init__.pyi"), key=lambda stub: by_use(f"drake_diff.{stub.parent.name}")):
        package = stub.parent.name
        names = {name: where for name, where in names_of(package).items() if root.get(name) != where}
        if names:
            first = (stub.parent / "__init__.py").read_text().split('"""')[1].split("\n")[0]
            pages[f"reference/{package}.md"] = _page(f"dd.{package}", first, f"dd.{package}", names)
    errors = "# dd.exceptions\n\n::: drake_diff.exceptions\n    options: {show_root_heading: false}\n"
    pages["reference/exceptions.md"] = errors
    functions = "::: drake_diff.bridges.functions.Functions\n    options: {heading: step, rollout and solve}\n"
    first = "`step`, `rollout` and `solve` for PyTorch, in `drake_diff.torch`, and for JAX, in `drake_diff.jax`."
    pages["reference/bridges.md"] = f"# drake_diff.torch and drake_diff.jax\n\n{first}\n\n{functions}"
    packages = ", ".join(f"[`dd.{Path(page).stem}`]({Path(page).name})" for page in pages)
    intro = f"The names of `import drake_diff as dd`. Packages with further names: {packages}."
    return {"reference/index.md": _page("drake_diff", intro, "dd", root), **pages}


def _page(title: str, intro: str, prefix: str, names: dict[str, str]) -> str:
    listed = "\n".join(f"[`{name}`](#{where}) " for name, where in names.items())
    sections = [f"::: {where}\n    options: {{heading: {prefix}.{name}}}\n" for name, where in names.items()]
    return "\n".join([f"# {title}\n", intro + "\n", listed + "\n", *sections])


def on_files(files: Files, config: Any) -> Files:
    """Add the generated pages to the files of docs/."""
    for path, text in reference().items():
        files.append(File.generated(config, path, content=text))
    for path, name in TOP.items():
        text = re.sub(r"\]\(docs/", "](", (ROOT / name).read_text())
        files.append(File.generated(config, path, content=text))
    for path in NOTEBOOKS.glob("*.ipynb"):
        files.append(File.generated(config, f"notebooks/{path.stem}.md", content=page_of(path)))
    return files


def page_of(notebook: Path) -> str:
    """Return a notebook as a page with its text, its code, and a link to the file for Jupyter."""
    parts = []
    for cell in json.loads(notebook.read_text())["cells"]:
        text = "".join(cell["source"])
        parts.append(f"```python\n{text}\n```" if cell["cell_type"] == "code" else text)
    text = _to_pages("\n\n".join(parts))
    title, _, rest = text.partition("\n")
    return f"{title}\n\n[Open this notebook]({notebook.name}) in Jupyter to run it and to see its plots.\n{rest}\n"


def _to_pages(text: str) -> str:
    """Replace links to notebooks by links to their pages."""
    return re.sub(r"\]\((\w+)\.ipynb\)", r"](\1.md)", text)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Link notebooks to their pages, and pictures of the gallery to their reports."""
    if page.file.src_uri == "notebooks/index.md":
        return _to_pages(markdown)
    if page.file.src_uri == "gallery/index.md":
        return with_reports(markdown, GALLERY)
    return markdown


def with_reports(text: str, gallery: Path) -> str:
    """Link each picture of the gallery to its report, if docs/gallery.py has written the report."""

    def linked(found: re.Match[str]) -> str:
        picture, report = found.groups()
        return f"[{picture}]({report})" if (gallery / report).is_file() else picture

    return re.sub(r"(!\[[^]]*\]\([^)]*\))<!-- (\S+) -->", linked, text)
