"""A process that a test forks ends by itself: what it raises is its status, and no second run of the tests."""

import os
import signal
import sys

from helpers.forks import FAILED, fork, status_of


def raises(error):
    raise error


def test_the_status_tells_how_a_forked_process_ended(capfd):
    def killed():
        os.kill(os.getpid(), signal.SIGKILL)

    ends = [status_of(fork(action)) for action in (list, killed, lambda: raises(KeyError("lost")), lambda: sys.exit(0))]
    assert ends == [0, -signal.SIGKILL, FAILED, FAILED]
    assert "KeyError: 'lost'" in capfd.readouterr().err
