"""Take from this process what a stranger's file could misuse: memory, network, files. It cannot be given back.

All of it is Linux's: data segments by setrlimit, the network by a namespace of its own, files by Landlock (5.13 and
newer). What the system does not offer is told, not passed over.
"""

import ctypes
import fcntl
import os
import resource
import signal
import socket
import struct
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from glob import glob
from pathlib import Path

NEWUSER, NEWNET = 0x10000000, 0x40000000  # of unshare(2)
DIE_WITH_PARENT, NO_NEW_PRIVILEGES = 1, 38  # of prctl(2)
CREATE_RULESET, ADD_RULE, RESTRICT_SELF = 444, 445, 446  # Landlock's calls, the same on every machine
VERSION, BENEATH = 1, 1
SET_FLAGS, UP = 0x8914, 1  # of a network interface
EXECUTE, WRITE_FILE, READ_FILE, READ_DIR, REFER, TRUNCATE, IOCTL = 1, 1 << 1, 1 << 2, 1 << 3, 1 << 13, 1 << 14, 1 << 15
ALL_OF_1 = (1 << 13) - 1  # what the first version of Landlock knows, to run a file among it
CONNECT = 2  # by TCP, since version 4; a page is drawn by a server that binds a port
SIGNALS_AND_SOCKETS = 3  # to processes outside, since version 6
USED = "/proc/self/statm"  # in pages; the sixth number is that of data and stack
NEARLY = 0.9  # of the memory that a process may have
LARGEST_FILE = 2**30  # bytes that are written into one
LOADERS = "/lib*/ld-*", "/lib/*/ld-*"  # what starts a program
SYSTEM = (
    "/usr/lib",
    "/usr/lib64",
    "/lib",
    "/lib64",
    "/usr/local/lib",
    "/usr/share/zoneinfo",
    "/sys/devices/system/cpu",
)
SYSTEM_FILES = ("/dev/urandom", "/proc/cpuinfo", "/proc/meminfo", "/etc/localtime", "/etc/ld.so.cache")


def limit_memory(bytes_: int) -> None:
    """Let this process have at most so much of its own memory, no core file, and files of at most 1 GiB."""
    for kind, most in (
        (resource.RLIMIT_DATA, bytes_),
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_FSIZE, LARGEST_FILE),
    ):
        _, hard = resource.getrlimit(kind)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, most))


@contextmanager
def memory_at_most(bytes_: int) -> Iterator[None]:
    """Let this process have at most so much of its own memory while the block runs; MemoryError where it needs more."""
    soft, hard = resource.getrlimit(resource.RLIMIT_DATA)
    least = min(most for most in (bytes_, soft, hard) if most != resource.RLIM_INFINITY)
    resource.setrlimit(resource.RLIMIT_DATA, (least, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (soft, hard))


def check_memory() -> None:
    """MemoryError where this process has used nearly all that it may have: libraries in C end it where they get none.

    One that is confined cannot look; who started it tells of its end.
    """
    most, _ = resource.getrlimit(resource.RLIMIT_DATA)
    if most == resource.RLIM_INFINITY:
        return
    try:
        pages = int(Path(USED).read_text().split()[5])
    except OSError:
        return
    if pages * resource.getpagesize() > NEARLY * most:
        raise MemoryError


def confine(readable: Iterable[Path], own: Path) -> list[str]:
    """Leave this process no network and no file to open but Python, what is `readable`, and its `own` folder to write.

    What cannot be had here is told, a sentence each.
    """
    if sys.platform != "linux":
        return ["the network and files outside were not kept from it: only Linux can do so"]
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(DIE_WITH_PARENT, signal.SIGKILL, 0, 0, 0)
    told = []
    closed = libc.unshare(NEWNET) == 0 or libc.unshare(NEWUSER | NEWNET) == 0
    if closed:
        _loopback_up()
    version = libc.syscall(CREATE_RULESET, None, 0, VERSION)
    if not closed:
        only = "only connections by TCP were" if version >= 4 else "it was not"
        told.append(f"the network: {only} kept from it, as this system gives no namespace of its own")
    if version < 1:
        return [*told, "files outside were not kept from it: this system has no Landlock"]
    _only_files(libc, version, readable, own)
    return told


def _loopback_up() -> None:
    """In a namespace of one's own not even 127.0.0.1 is there at first."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_:
        fcntl.ioctl(any_, SET_FLAGS, struct.pack("16sh14x", b"lo", UP))


def _only_files(libc: ctypes.CDLL, version: int, readable: Iterable[Path], own: Path) -> None:
    rights = ALL_OF_1 | sum(right for right, since in ((REFER, 2), (TRUNCATE, 3), (IOCTL, 5)) if version >= since)
    words = (rights, CONNECT, SIGNALS_AND_SOCKETS)[: 3 if version >= 6 else 2 if version >= 4 else 1]
    rules = struct.pack(f"={len(words)}Q", *words)
    _done(libc.prctl(NO_NEW_PRIVILEGES, 1, 0, 0, 0))
    ruleset = _done(libc.syscall(CREATE_RULESET, rules, len(rules), 0))
    python = {Path(sys.executable), Path(sys.executable).resolve()}
    allowed = [(path, READ_FILE | READ_DIR) for path in (*readable, *pythons(), *map(Path, SYSTEM))]
    loaders = (Path(name) for pattern in LOADERS for name in glob(pattern))
    allowed += [(path, READ_FILE | EXECUTE) for path in (*python, *loaders)]  # some engines have a process of their own
    allowed += [(Path(name), READ_FILE) for name in SYSTEM_FILES]
    allowed += [(Path(os.devnull), READ_FILE | WRITE_FILE), (own, rights)]
    for path, right in allowed:
        try:
            place = os.open(path, os.O_PATH | os.O_CLOEXEC)
        except OSError:  # not on this machine: nothing to allow
            continue
        right = right if path.is_dir() else right & ~READ_DIR
        _done(libc.syscall(ADD_RULE, ruleset, BENEATH, struct.pack("=Qi", right, place), 0))
        os.close(place)
    _done(libc.syscall(RESTRICT_SELF, ruleset, 0))
    os.close(ruleset)


def _done(result: int) -> int:
    if result < 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))
    return result


def pythons() -> Sequence[Path]:
    """The folders that Python, its packages and what Numba compiled are in."""
    compiled = os.environ.get("NUMBA_CACHE_DIR") or os.path.expanduser("~/.cache/numba")
    places = (sys.prefix, sys.base_prefix, sys.exec_prefix, compiled, *sys.path)
    return [Path(place) for place in dict.fromkeys(places) if place and os.path.isabs(place)]
