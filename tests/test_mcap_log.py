"""The MCAP file: what goes in comes out bit for bit, and damage is noticed."""

import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drake_diff.exceptions import ArtifactError
from drake_diff.mcap_log import Channel, read_mcap, write_mcap
from drake_diff.mcap_messages import MESSAGES, TYPES

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


def test_the_same_content_gives_the_same_bytes(tmp_path):
    paths = [tmp_path / name for name in ("a.mcap", "b.mcap")]
    for path in paths:
        write(path, states(), status="converged")
    assert paths[0].read_bytes() == paths[1].read_bytes()


def test_a_channel_without_messages_is_still_there(tmp_path):
    write(tmp_path / "a.mcap", [])
    assert read_mcap(tmp_path / "a.mcap").messages == {"/state": []}


def test_nothing_is_left_beside_the_file(tmp_path):
    write(tmp_path / "a.mcap", states())
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


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
    assert math.isclose(TYPES["GradientNorm"].cls(step=3, norm=0.1).norm, 0.1)
