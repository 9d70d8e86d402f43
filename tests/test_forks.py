"""A process that a test forks ends by itself: what it raises is its status, and no second run of the tests."""

import os
import signal
import sys

import pytest
from helpers.faults import ended, forked
from helpers.forks import FAILED, fork, status_of


def raises(error):
    raise error


def test_the_status_tells_how_a_forked_process_ended(capfd):
    def killed():
        os.kill(os.getpid(), signal.SIGKILL)

    ends = [status_of(fork(action)) for action in (list, killed, lambda: raises(KeyError("lost")), lambda: sys.exit(0))]
    assert ends == [0, -signal.SIGKILL, FAILED, FAILED]
    assert "KeyError: 'lost'" in capfd.readouterr().err


def test_what_cannot_be_told_is_no_kill():
    assert ended(*forked(lambda: [1])) == {"ended": "done", "found": [1]}
    assert ended(*forked(lambda: raises(KeyError("lost")))) == {
        "ended": "KeyError",
        "message": "'lost'",
        "named": False,
    }
    with pytest.raises(AssertionError, match="status 70"):
        ended(*forked(object))
    assert ended(*forked(lambda: signal.raise_signal(signal.SIGKILL))) == {"ended": "killed"}
