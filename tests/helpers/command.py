"""The command `drake-diff` in a process of its own, which runs this checkout from any folder."""

import os
import subprocess
import sys

from helpers.models import ROOT


def drake_diff(*words, cwd=None, **options):
    """Return the finished process, with its output as text; `options` are those of subprocess.run."""
    command = [sys.executable, "-P", "-m", "drake_diff.cli.main", *map(str, words)]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "timeout": 300} | options
    return subprocess.run(command, cwd=cwd, env={**os.environ, "PYTHONPATH": str(ROOT)}, **streams)
