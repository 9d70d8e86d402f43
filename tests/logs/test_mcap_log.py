"""Tests of MCAP files: data is read back bit for bit, and damage raises an error."""

import math
import mmap
import os
import random
import signal
import struct
import time
import tracemalloc
from contextlib import suppress

import numpy as np
import pytest
from helpers.forks import fork, status_of
from helpers.table import each_row
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import McapError
from mcap.records import Message
from mcap.stream_reader import StreamReader

from drake_diff.exceptions import ArtifactError, InputError, UnknownNameError
from drake_diff.logs import mcap_file
from drake_diff.logs.channels import MESSAGES, TYPES
from drake_diff.logs.mcap_file import CHUNK_SIZE, Channel, read_mcap, write_mcap

pytestmark = pytest.mark.solve

STATE = TYPES["State"].cls


def states(count=200):
    random_numbers = np.random.default_rng(0)
    return [
        (k * 1000, STATE(time=k * 1e-6, q=random_numbers.normal(size=3), v=random_numbers.normal(size=3)))
        for k in range(count)
    ]


def write(path, messages, **metadata):
    channel = Channel("/state", STATE, messages, {"units": {"q": "m"}})
    write_mcap(path, [channel], metadata, {"model.urdf": ("application/xml", b"<robot/>")})


def test_messages_metadata_and_attachments_come_back(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, states(), status="converged")
    log = read_mcap(path)
    assert [(t, list(m.q), list(m.v)) for t, m in log.messages["/state"]] == [
        (t, list(m.q), list(m.v)) for t, m in states()
    ]
    assert log.metadata == {"run": {"status": "converged"}}
    assert log.attachments == {"model.urdf": b"<robot/>"}
    assert log.channel_metadata["/state"] == {"units": {"q": "m"}}


@settings(max_examples=50, deadline=None)
@given(values=st.lists(st.floats(allow_nan=True, allow_infinity=True), max_size=20))
def test_every_double_comes_back_bit_for_bit(tmp_path_factory, values):
    path = tmp_path_factory.mktemp("mcap") / "a.mcap"
    write(path, [(0, STATE(time=0.0, q=values))])
    found = np.array(read_mcap(path).messages["/state"][0][1].q)
    assert found.tobytes() == np.array(values).tobytes()


def test_a_cut_file_is_refused(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, states())
    whole = path.read_bytes()
    for length in (0, 7, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(ArtifactError, match=r"a\.mcap"):
            read_mcap(path)


def test_any_flipped_bit_is_refused(tmp_path):
    path = tmp_path / "a.mcap"
    write(path, states(), status="converged")
    whole, seeded = path.read_bytes(), random.Random(0)
    for _ in range(300):
        damaged = bytearray(whole)
        damaged[seeded.randrange(len(damaged))] ^= 1 << seeded.randrange(8)
        path.write_bytes(damaged)
        with pytest.raises(ArtifactError, match=r"a\.mcap"):
            read_mcap(path)


def test_a_file_that_is_no_mcap_or_missing_is_refused(tmp_path):
    (tmp_path / "a.mcap").write_text("not an mcap file" * 20)
    for name in ("a.mcap", "missing.mcap"):
        with pytest.raises(ArtifactError, match=name):
            read_mcap(tmp_path / name)


def test_every_message_has_a_unit_for_every_number():
    for name, fields in MESSAGES.items():
        for field, ((kind, _), unit) in fields.items():
            assert (kind == "string") == (unit == ""), f"{name}.{field}"
    assert math.isclose(TYPES["GradientNorm"].cls(step=3, lagrangian=0.1).lagrangian, 0.1)


DOUBLES = st.floats(allow_nan=True, allow_infinity=True)
NAMES = st.text(st.characters(codec="utf-8"), max_size=20)


@settings(max_examples=30, deadline=None)
@given(data=st.data())
def test_any_log_comes_back_names_numbers_and_bytes(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("mcap") / "a.mcap"
    topics = data.draw(st.lists(NAMES, max_size=4, unique=True))
    metadata = data.draw(st.dictionaries(NAMES, NAMES, max_size=3))
    attachments = data.draw(st.dictionaries(NAMES, st.tuples(NAMES, st.binary(max_size=50)), max_size=3))
    names = data.draw(st.lists(NAMES, max_size=3))
    rows, channels = {}, []
    for topic in topics:
        count, nq = data.draw(st.integers(0, 5)), data.draw(st.integers(1, 4))
        number = st.lists(DOUBLES, min_size=nq, max_size=nq)
        rows[topic] = data.draw(st.lists(st.tuples(DOUBLES, number, number), min_size=count, max_size=count))
        messages = [(k, STATE(time=t, q=q, v=v)) for k, (t, q, v) in enumerate(rows[topic])]
        channels.append(Channel(topic, STATE, messages, {"names": {"q": names}}))
    write_mcap(path, channels, metadata, attachments)
    log = read_mcap(path)
    assert log.metadata == {"run": metadata}
    assert log.attachments == {name: content for name, (_, content) in attachments.items()}
    assert list(log.messages) == topics
    for topic in topics:
        found = log.arrays(topic)
        assert log.channel_metadata[topic] == {"names": {"q": names}}
        for i, field in enumerate(("time", "q", "v")):
            assert found[field].tobytes() == np.array([row[i] for row in rows[topic]], dtype=float).tobytes()


def test_arrays_of_lists_of_different_lengths_texts_and_flags(tmp_path):
    contacts, replay = TYPES["Contacts"].cls, TYPES["Replay"].cls
    channels = [
        Channel("/contacts", contacts, [(0, contacts(body_a=["a"], depth=[1.0])), (1, contacts(depth=[2.0, 3.0]))]),
        Channel("/replays", replay, [(0, replay(variant="x", holds=True, failures=["y", "z"]))]),
    ]
    write_mcap(tmp_path / "a.mcap", channels, {}, {})
    log = read_mcap(tmp_path / "a.mcap")
    found = log.arrays("/contacts")
    assert [depth.tolist() for depth in found["depth"]] == [[1.0], [2.0, 3.0]]
    assert found["body_a"] == [["a"], []]
    found = log.arrays("/replays")
    assert (found["variant"], found["failures"], found["holds"].tolist()) == (["x"], [["y", "z"]], [True])
    with pytest.raises(UnknownNameError, match="one of /contacts, /replays"):
        log.arrays("/contact")


def test_channels_are_merged_in_time_and_a_time_that_decreases_is_refused(tmp_path):
    from mcap.reader import make_reader

    channels = [Channel(f"/{i}", STATE, [(t, STATE()) for t in range(i, 30, 3)]) for i in range(3)]
    write_mcap(tmp_path / "a.mcap", channels, {}, {})
    with (tmp_path / "a.mcap").open("rb") as file:
        times = [m.log_time for _, _, m in make_reader(file).iter_messages(log_time_order=False)]
    assert times == list(range(30))
    with pytest.raises(InputError, match="time of message 1 of /state: expected at least 5, got 4"):
        write_mcap(tmp_path / "b.mcap", [Channel("/state", STATE, [(5, STATE()), (4, STATE())])], {}, {})
    assert not list(tmp_path.glob("b.*"))


def test_a_schema_that_does_not_decode_is_refused(tmp_path):
    from mcap.writer import Writer

    for encoding, schema in (("protobuf", b"no schema"), ("ros2msg", b"float64 x")):
        with (tmp_path / "a.mcap").open("wb") as file:
            writer = Writer(file, enable_data_crcs=True)
            writer.start()
            writer.register_channel("/a", encoding, writer.register_schema("a", encoding, schema))
            writer.finish()
        with pytest.raises(ArtifactError, match=r"a\.mcap is not an MCAP file of drake_diff"):
            read_mcap(tmp_path / "a.mcap")


def test_an_attachment_whose_checksum_is_wrong_is_refused_though_every_other_holds(tmp_path):
    import zlib

    path = tmp_path / "a.mcap"
    write(path, states(3))
    data = bytearray(path.read_bytes())
    data[data.index(b"<robot/>")] ^= 1
    (start,) = struct.unpack_from("<Q", data, len(data) - 8 - 20)  # of the summary, after the data's checksum
    struct.pack_into("<I", data, start - 4, zlib.crc32(data[: start - 13]))
    path.write_bytes(data)
    with pytest.raises(ArtifactError, match="the checksum of an attachment"):
        read_mcap(path)


@pytest.mark.slow
def test_a_long_log_is_streamed_not_gathered(tmp_path):
    """40,000 messages are over 10 MB as Python objects, while a few chunks and their indexes are far smaller."""
    messages = ((k, STATE(time=k, q=[k] * 10)) for k in range(40_000))
    tracemalloc.start()
    write(tmp_path / "a.mcap", messages)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4e6


def test_a_process_killed_while_it_writes_loses_no_more_than_the_chunk_in_progress(tmp_path):
    size = 9 + 22 + len(STATE(time=1.0, q=[1.0] * 30, v=[1.0] * 30).SerializeToString())  # size of a message's record
    seeded, lost = random.Random(2), []
    for trial in range(10):
        path, partial = tmp_path / f"{trial}.mcap", tmp_path / f"{trial}.mcap.partial"
        written = _write_until_killed(path, after=seeded.randrange(1, 3000))
        assert not path.exists()
        times = np.array(readable(partial))
        assert times.tolist() == list(range(len(times)))
        lost.append((written - len(times)) * size)
    assert max(lost) <= CHUNK_SIZE + 1000  # schemas are in the first chunk, and the last message overflows it
    assert len(set(lost)) > 5  # the writes did not all end at the same place


def readable(path):
    """Return the log times of the messages before the damage in a file, read with the mcap package only."""
    times = []
    with path.open("rb") as file, suppress(McapError, struct.error):
        for record in StreamReader(file, validate_crcs=True).records:
            times += [record.log_time] if isinstance(record, Message) else []
    return times


def _write_until_killed(path, *, after):
    """Return the number of messages that the writer took before SIGKILL, which follows the `after`-th message."""
    count = mmap.mmap(-1, 8)

    def forever():
        k = 0
        while True:
            yield k, STATE(time=k, q=[k] * 30, v=[k] * 30)
            k += 1
            count[:8] = struct.pack("<q", k)

    child = fork(lambda: write(path, forever()))
    deadline = time.monotonic() + 60
    while struct.unpack("<q", count[:8])[0] < after and time.monotonic() < deadline:
        time.sleep(1e-4)
    os.kill(child, signal.SIGKILL)
    assert status_of(child) == -signal.SIGKILL
    return struct.unpack("<q", count[:8])[0]


def test_a_file_that_says_that_it_holds_too_much_is_refused_before_it_is_decoded(tmp_path, monkeypatch):
    path, state = tmp_path / "log.mcap", TYPES["State"].cls
    write_mcap(path, [Channel(f"/{i}", state, [(0, state(time=1.0))]) for i in range(3)], {}, {})
    assert len(read_mcap(path).messages) == 3
    for name, told in (("MOST_CHANNELS", "3 channels, but at most 2"), ("MOST_MESSAGES", "3 messages, but at most 2")):
        with monkeypatch.context() as patch:
            patch.setattr(mcap_file, name, 2)
            patch.setattr(mcap_file, "_unpacked", None)  # must not be called
            with pytest.raises(ArtifactError, match=told):
                read_mcap(path)


@each_row("what", ["messages", "channels"])
def test_a_file_that_holds_more_than_it_says_is_refused(tmp_path, monkeypatch, what):
    path, state = tmp_path / "log.mcap", TYPES["State"].cls
    write_mcap(path, [Channel(f"/{i}", state, [(0, state(time=1.0))]) for i in range(3)], {}, {})
    if what == "messages":
        monkeypatch.setattr(mcap_file, "_declared", lambda *_: 2)
    else:
        monkeypatch.setattr(mcap_file, "_declared", lambda *_: 3)
        monkeypatch.setattr(mcap_file, "MOST_CHANNELS", 2)
    with pytest.raises(ArtifactError, match=f"more (messages than its statistics declare, 2|than 2 {what})"):
        read_mcap(path)
