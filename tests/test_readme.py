"""The README's code prints what the README says."""

import re
import subprocess
import sys

from helpers.models import ROOT


def test_the_readmes_code_prints_the_readmes_output(tmp_path):
    readme = (ROOT / "README.md").read_text()
    code, printed = re.search(r"```python\n(.*?)```\n\n```text\n(.*?)```", readme, re.DOTALL).groups()
    (tmp_path / "models").symlink_to(ROOT / "models")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout == printed
    assert (tmp_path / "artifacts" / "cart_pole" / "record.json").is_file()


def test_every_file_that_the_readme_names_is_there():
    readme = (ROOT / "README.md").read_text()
    for name in re.findall(r"(?:examples|models|tests)/\w+\.\w+", readme):
        assert (ROOT / name).is_file(), name
