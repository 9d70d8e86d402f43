"""The command `drake-diff` in a process of its own, of this checkout wherever it runs."""

import os
import subprocess
import sys

from helpers.models import ROOT


def drake_diff(*words, cwd=None, **options):
    """The process that has ended, with its output as text; `options` of subprocess.run."""
    command = [sys.executable, "-P", "-m", "drake_diff.cli.main", *map(str, words)]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "timeout": 300} | options
    return subprocess.run(command, cwd=cwd, env={**os.environ, "PYTHONPATH": str(ROOT)}, **streams)
