"""Every call that changes a disk below a folder: listed by a trace, made to fail, or made the last one of its process.

Each try is a process of its own, forked from one that has the solution to be saved.
"""

import json
import os
import signal

import drake_diff as dd
from helpers.forks import fork, status_of


def forked(action):
    """A running process of `action()`, which returns what JSON has, and the pipe from which `ended` takes its end."""
    reading, writing = os.pipe()

    def tell():
        try:
            told = {"ended": "done", "found": action()}
        except BaseException as error:
            told = {
                "ended": type(error).__name__,
                "message": str(error),
                "named": isinstance(error, dd.exceptions.DrakeDiffError),
            }
        with os.fdopen(writing, "wb") as pipe:
            pipe.write(json.dumps(told).encode())

    child = fork(tell)
    os.close(writing)
    return child, reading


def ended(child, reading):
    """What became of a process: what it returned, what it raised, or that it was killed."""
    with os.fdopen(reading, "rb") as pipe:
        told = pipe.read()
    status = status_of(child)
    assert status in (0, -signal.SIGKILL), f"a forked process ended with status {status}, and told {told!r}"
    return json.loads(told) if status == 0 else {"ended": "killed"}
