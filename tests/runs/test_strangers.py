"""Check that an untrusted directory is refused with a named error, before anything is waited for or unpacked."""

import json
import os
import resource
import shutil
import socket
import struct
import tracemalloc
import zipfile
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from helpers.models import ROOT
from helpers.table import each_row

import drake_diff as dd
from drake_diff._base import files as untrusted
from drake_diff._base.files import arrays_of, files_in, read_plain
from drake_diff._base.sandbox import memory_at_most
from drake_diff.exceptions import ArtifactError
from drake_diff.logs.mcap_file import read_mcap
from drake_diff.runs import list_runs

pytestmark = pytest.mark.solve

RUN = ROOT / "artifacts" / "pendulum_swing_up"
MIB = 2**20
HEADER = "{'descr': '<f8', 'fortran_order': False, 'shape': %s, }"


def fifo(path):
    os.mkfifo(path)


def listening(path):
    here = os.getcwd()
    os.chdir(path.parent)  # the path of a socket has at most 107 bytes
    socket.socket(socket.AF_UNIX).bind(path.name)
    os.chdir(here)


def larger(path):
    path.touch()
    os.truncate(path, 2**40)  # a sparse file uses no disk space


ODD = {
    "a FIFO": fifo,
    "a socket": listening,
    "a link": lambda path: path.symlink_to("/dev/zero"),
    "a directory": Path.mkdir,
    "at most": larger,
}


@each_row("told", list(ODD))
def test_what_is_no_plain_file_is_not_opened(tmp_path, told):
    ODD[told](tmp_path / "x")
    with pytest.raises(ArtifactError, match=told):
        read_plain(tmp_path / "x")


@each_row("told", list(ODD))
@each_row("name", ["record.json", "plan.npz", "trace.mcap"])
def test_a_run_with_such_a_file_is_broken_and_listed(tmp_path, told, name):
    folder = Path(shutil.copytree(RUN, tmp_path / "run"))
    (folder / name).unlink()
    ODD[told](folder / name)
    assert dd.verify(folder).verdict == "broken"
    if name == "record.json":
        assert [line.verdict for line in list_runs(tmp_path)] == ["unreadable"]


def test_a_run_whose_files_are_too_much_to_read_is_broken(tmp_path, monkeypatch):
    """A thousand sparse files of 1 GiB use no disk space, but take an hour to read."""
    folder = Path(shutil.copytree(RUN, tmp_path / "run"))
    monkeypatch.setattr("drake_diff.runs.directory.MOST_READ", (folder / "plan.npz").stat().st_size)
    found = dd.verify(folder)
    assert found.verdict == "broken"
    assert "the files up to this one have more than" in found.sentence


def test_a_log_of_more_messages_than_there_is_memory_for_is_refused_before_it_is_used_up(tmp_path, monkeypatch):
    """Without memory, Protobuf's C code ends the process with SIGSEGV, for 4.9 million messages in 4 GiB."""
    monkeypatch.setattr("drake_diff._base.sandbox.NEARLY", 1e-9)
    with memory_at_most(2**40), pytest.raises(MemoryError):
        read_mcap(RUN / "trace.mcap")
    assert read_mcap(RUN / "trace.mcap").messages


def test_a_link_to_a_folder_is_not_followed_and_a_folder_has_a_most_of_files(tmp_path, monkeypatch):
    monkeypatch.setattr(untrusted, "MOST_FILES", 10)
    (tmp_path / "out").symlink_to("/")
    (tmp_path / "a").touch()
    assert sorted(files_in(tmp_path)) == ["a", "out"]
    for i in range(10):
        (tmp_path / f"f{i}").touch()
    with pytest.raises(ArtifactError, match="at most 10 files"):
        files_in(tmp_path)


def npz(path, files, lie=None):
    """Write an archive of these members. With `lie`, the index has this size instead of the actual one."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    if lie is not None:
        told = bytearray(path.read_bytes())
        at = told.rindex(b"PK\x01\x02")
        told[at + 24 : at + 28] = struct.pack("<I", lie)
        path.write_bytes(told)


def npy(shape, numbers=b"", version=1, length=None):
    text = (HEADER % shape).encode()
    return (
        b"\x93NUMPY"
        + bytes([version, 0])
        + struct.pack("<H" if version == 1 else "<I", length or len(text))
        + text
        + numbers
    )


BOMBS = {
    "after decompression, got": lambda path: npz(path, {"xs.npy": bytes(99)}, lie=2**31),
    "Bad CRC-32": lambda path: npz(path, {"xs.npy": bytes(64 * MIB)}, lie=1000),
    "of shape": lambda path: npz(path, {"xs.npy": npy("(800000000,)")}),
    "of shape ": lambda path: npz(path, {"xs.npy": npy("(-1, -8)", bytes(64))}),
    "at most 100 arrays": lambda path: npz(path, {f"{i}.npy": npy("()", bytes(8)) for i in range(200)}),
    "got object": lambda path: np.savez(path, xs=np.array([None])),
    "EOF": lambda path: npz(path, {"xs.npy": npy("()", version=2, length=2**32 - 1)}),
    "or deflated": lambda path: zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA).writestr("xs.npy", npy("()", bytes(8))),
}


@each_row("told", list(BOMBS))
def test_arrays_are_not_unpacked_before_their_sizes_are_known(tmp_path, told):
    path = tmp_path / "plan.npz"
    BOMBS[told](path)
    tracemalloc.start()
    try:
        with pytest.raises(ArtifactError, match=told):
            arrays_of(path)
        assert tracemalloc.get_traced_memory()[1] < 16 * MIB
    finally:
        tracemalloc.stop()


def test_arrays_come_back_to_the_last_bit(tmp_path):
    given = {"a": np.array([[1.0, np.nan], [np.inf, 0.1]]), "b": np.array(3.0), "c": np.asfortranarray(np.eye(3)[:2])}
    np.savez(tmp_path / "x.npz", **given)
    found = arrays_of(tmp_path / "x.npz")
    assert all(np.array_equal(found[name], given[name], equal_nan=True) for name in given)


TEXTS = {
    "nested": "[" * 100_000 + "]" * 100_000,
    "deep": '{"a":' * 100 + "1" + "}" * 100,
    "many": "[" + "0," * 1_100_000 + "0]",
    "infinite": '{"a": 1e999}',
    "digits": '{"a": ' + "9" * 5000 + "}",
    "surrogate": '{"a": "\\ud800"}',
    "nan": '{"a": NaN}',
    "bytes": b"\xff\xfe",
    "none": "",
}


@each_row("text", list(TEXTS.values()), ids=list(TEXTS))
def test_a_record_that_no_program_of_ours_writes_is_refused(tmp_path, text):
    (tmp_path / "record.json").write_bytes(text if isinstance(text, bytes) else text.encode())
    found = dd.verify(tmp_path)
    assert found.verdict == "broken"
    assert "is not JSON" in found.sentence
    assert len(found.sentence) < 1000


def test_a_number_that_a_record_writes_in_full_can_be_put_into_one_that_is_sealed(tmp_path):
    """The hash covers the values that Python reads. 1e999 has no hash, and verification reports it in its sentence."""
    folder = Path(shutil.copytree(RUN, tmp_path / "run"))
    fields = json.loads((folder / "record.json").read_text())
    (folder / "record.json").write_text(json.dumps(fields).replace('"duration_s": ', '"duration_s": 1e999, "x": '))
    assert "1e999" in dd.verify(folder).sentence


def chunk(data, size, compression=b"zstd"):
    """Return a file of one chunk that declares an unpacked size of `size` bytes."""
    body = struct.pack("<QQQII", 0, 0, size, 0, len(compression)) + compression + struct.pack("<Q", len(data)) + data
    return b"\x89MCAP0\r\n" + b"\x06" + struct.pack("<Q", len(body)) + body


ZEROS = 64 * MIB
LOGS = {
    "declared": lambda: chunk(zstandard.compress(bytes(ZEROS)), ZEROS),
    "lied": lambda: chunk(zstandard.compress(bytes(ZEROS)), 1000),
    "unsaid": lambda: chunk(zstandard.ZstdCompressor(write_content_size=False).compress(bytes(ZEROS)), 1000),
    "lz4": lambda: chunk(lz4.frame.compress(bytes(ZEROS)), ZEROS, b"lz4"),
    "lz4 lied": lambda: chunk(lz4.frame.compress(bytes(ZEROS)), 1000, b"lz4"),
    "plain": lambda: chunk(b"x", 1000, b""),
}


@each_row("made", list(LOGS.values()), ids=list(LOGS))
def test_a_log_is_not_unpacked_before_its_size_is_known(tmp_path, made):
    data = made()
    footer = struct.pack("<BQQQ", 2, 20, len(data) + 13, 0)
    end = struct.pack("<BQI", 15, 4, zlib.crc32(data)) + footer + struct.pack("<I", zlib.crc32(footer))
    path = tmp_path / "trace.mcap"
    path.write_bytes(data + end + b"\x89MCAP0\r\n")
    del data
    tracemalloc.start()
    try:
        with pytest.raises(ArtifactError, match=r"unpacks to|has|left|decompress"):
            read_mcap(path)
        assert tracemalloc.get_traced_memory()[1] < 32 * MIB
    finally:
        tracemalloc.stop()


def test_what_a_log_makes_of_itself_in_memory_is_limited():
    """A command that reads a log may use some GiB. The test allows only the memory that is already in use.

    64 GiB exceed the freed memory that the allocator may have kept from earlier tests.
    """
    before = resource.getrlimit(resource.RLIMIT_DATA)
    with memory_at_most(2**20), pytest.raises(MemoryError):
        bytearray(2**36)
    assert resource.getrlimit(resource.RLIMIT_DATA) == before
