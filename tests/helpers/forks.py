"""Processes that are forked from a test. They always end by themselves, and never continue with the tests."""

import os
import traceback
import warnings

FAILED = 70  # the status of a process whose action raised


def fork(action):
    """Return the id of a new process that calls `action()` and ends: status 0, or FAILED with a traceback on stderr.

    Any exception ends it, also one from a signal, because back in pytest it would run the tests a second time.
    """
    own, status = os.getpid(), FAILED
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # about threads that the new process does not have
            child = os.fork()
        if child == 0:
            action()
            status = 0
        return child
    except BaseException:
        if os.getpid() != own:
            traceback.print_exc()
        raise
    finally:
        if os.getpid() != own:
            os._exit(status)


def status_of(child):
    """Return the exit status of a forked process, or minus the number of the signal that ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
