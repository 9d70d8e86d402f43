"""A process forked from a test: it ends by itself, whatever happens in it, and never goes on with the tests."""

import os
import traceback
import warnings

FAILED = 70  # the status of a process whose action raised


def fork(action):
    """The number of a new process that calls `action()` and ends: status 0, or FAILED with a traceback on stderr.

    Whatever is raised in it, by a signal too, ends it: back in pytest it would run the tests a second time.
    """
    own, status = os.getpid(), FAILED
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of other threads here, which the new process has not
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
    """The exit status of a forked process, minus the signal's number where one ended it."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
