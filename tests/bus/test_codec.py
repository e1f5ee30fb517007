"""Internal messages as bytes."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, fields, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge import messages as m
from prism_edge.bus.codec import MAX_HEADER, pack, unpack
from prism_edge.errors import BusError
from tests.bus.examples import TYPES, frame, messages_of, same, tracked

NaN = float("nan")


@pytest.mark.parametrize("cls", TYPES, ids=lambda cls: cls.__name__)
@settings(max_examples=15, deadline=None)
@given(data=st.data())
def test_every_message_survives_the_round_trip(cls, data):
    message = data.draw(messages_of(cls))
    assert same(unpack(pack(message), cls), message)


def test_arrays_are_views_of_the_bytes_aligned_and_read_only():
    data = pack(tracked(3))
    pose = unpack(data, m.Tracked).reference_from_camera
    assert np.shares_memory(pose, np.frombuffer(data, np.uint8))
    assert pose.flags.aligned
    assert not pose.flags.writeable


def test_not_finite_numbers_stay_as_they_are():
    scale = m.Scale(1, 3, 0, NaN, NaN, float("inf"), -float("inf"), NaN, 0.0, 5, True)
    assert same(unpack(pack(scale), m.Scale), scale)


def test_arrays_that_are_not_contiguous_are_sent_in_order():
    image = np.arange(720 * 1280, dtype=np.uint32).astype(np.uint8).reshape(720, 1280)[:, ::2]
    assert np.array_equal(unpack(pack(replace(frame(), image=image)), m.Frame).image, image)


HALF = "half a character: \ud83d"


def test_text_that_nobody_can_write_goes_with_a_question_mark_in_its_place():
    """Names of files that are no UTF-8 hold such halves, and find their way into warnings."""
    beat = m.Heartbeat("depth", 1, 2, "ready", HALF, 3, 4.0, {HALF: HALF})
    come = unpack(pack(beat), m.Heartbeat)
    assert come.activity == "half a character: ?"
    assert come.values == {come.activity: come.activity}


def test_text_that_nobody_can_write_is_refused_from_others():
    """JSON can say it, and whoever passes it on (to ROS, to a file) would fail."""
    good = pack(m.Heartbeat("depth", 1, 2, "ready", "??????", 3, 4.0, {"??????": "??????"}))
    spots = [i for i in range(len(good)) if good.startswith(b"??????", i)]
    assert len(spots) == 3
    for spot in spots:
        bad = good[:spot] + b"\\ud83d" + good[spot + 6 :]
        with pytest.raises(BusError, match="malformed Heartbeat"):
            unpack(bad, m.Heartbeat)


def test_numpy_scalars_are_sent_as_numbers():
    message = replace(tracked(), index=np.int64(4), published=np.bool_(True))
    back = unpack(pack(message), m.Tracked)
    assert (type(back.index), back.index, back.published) == (int, 4, True)


@pytest.mark.parametrize(
    ("message", "field"),
    [
        (replace(tracked(), reference_from_camera=np.eye(4, dtype=np.float32)), "reference_from_camera"),
        (replace(tracked(), reference_from_camera=np.eye(3)), "reference_from_camera"),
        (replace(tracked(), reference_from_camera=[[1.0]]), "reference_from_camera"),
        (replace(tracked(), index=1.5), "index"),
        (replace(tracked(), index=2**63), "index"),
        (replace(tracked(), odometry=None), "odometry"),
        (replace(tracked(), published=1), "published"),
        (m.Heartbeat("depth", 1, 2, "idle", "", 3, "soon", {}), "budget_s"),
        (m.Heartbeat("depth", 1, 2, "idle", "", 3, 10**400, {}), "budget_s"),
        (m.Heartbeat("depth", 1, 2, "idle", "", 3, 0.0, {"queue": 3}), "values"),
        (m.Heartbeat("depth", 1, 2, "idle", "x" * MAX_HEADER, 3, 0.0, {}), "Heartbeat"),
    ],
)
def test_a_value_that_its_field_does_not_allow_is_refused_by_name(message, field):
    with pytest.raises(BusError, match=field):
        pack(message)


GOOD = pack(tracked(3))
(HEADER_SIZE,) = struct.unpack_from("<I", GOOD, 8)
FLOATS = GOOD[16 : 16 + 8 * sum(f.type == "float" for f in fields(m.Tracked))]


def with_header(text: str) -> bytes:
    """GOOD with another header."""
    header = text.encode()
    arrays = GOOD[16 + len(FLOATS) + HEADER_SIZE + -HEADER_SIZE % 8 :]
    prefix = GOOD[:8] + struct.pack("<II", len(header), 0) + FLOATS
    return prefix + header + b"\0" * (-len(header) % 8) + arrays


VALUES = '[3,99,7,"ok",true,-1,0,0,false]'
SHAPES = '[["<f8",4,4]]'


def test_the_headers_that_follow_differ_from_a_good_one_in_one_thing_each():
    assert same(unpack(with_header(f'["Tracked",{VALUES},{SHAPES}]'), m.Tracked), tracked(3))


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "requires a buffer"),
        (GOOD[:10], "requires a buffer"),
        (GOOD[:-1], "truncated"),
        (GOOD[:-8], "truncated"),
        (GOOD[:30], "header of"),
        (GOOD + b"\0", "too many"),
        (GOOD + b"\0" * 8, "too many"),
        (b"JSON" + GOOD[4:], "not a message"),
        (GOOD[:12] + b"\1\0\0\0" + GOOD[16:], "not a message"),
        (GOOD[:4] + b"\2\0" + GOOD[6:], "version 2"),
        (GOOD[:6] + b"\1\0" + GOOD[8:], "float fields"),
        (GOOD[:8] + b"\xff\xff\xff\xff" + GOOD[12:], "header of 4294967295"),
        (pack(frame()), "float fields instead of"),
        (with_header(f'["Frame",{VALUES},{SHAPES}]'), "'Frame'"),
        (with_header(f'["Tracked",{VALUES.replace("99", "NaN")},{SHAPES}]'), "NaN in the header"),
        (with_header(f'["Tracked",{VALUES.replace("99", "1e3")},{SHAPES}]'), "stamp_ns is 1000.0"),
        (with_header(f'["Tracked",{VALUES.replace("99", str(2**63))},{SHAPES}]'), "stamp_ns"),
        (with_header(f'["Tracked",{VALUES.replace("99", "9" * 5000)},{SHAPES}]'), "digits"),
        (with_header(f'["Tracked",{VALUES.replace("true", "1")},{SHAPES}]'), "published"),
        (with_header(f'["Tracked",[3],{SHAPES}]'), "another build"),
        (with_header(f'["Tracked",{VALUES},[]]'), "another build"),
        (with_header(f'["Tracked",{VALUES},[["<f4",4,4]]]'), "reference_from_camera is '<f4'"),
        (with_header(f'["Tracked",{VALUES},[["<f8",2,8]]]'), "reference_from_camera"),
        (with_header(f'["Tracked",{VALUES},[["<f8",4]]]'), "reference_from_camera"),
        (with_header(f'["Tracked",{VALUES},[["<f8",4,4.0]]]'), "reference_from_camera"),
        (with_header(f'["Tracked",{VALUES},[7]]'), "unpack"),
        (with_header("7"), "unpack"),
        (with_header("{}"), "unpack"),
        (with_header("[" * 60_000), "recursion"),
        (with_header("\udcff".encode("utf-8", "surrogateescape").decode("latin-1")), "Expecting value"),
    ],
)
def test_defects_are_told_in_one_line(data, says):
    with pytest.raises(BusError, match=says) as caught:
        unpack(data, m.Tracked)
    assert "\n" not in str(caught.value)


def test_what_is_between_the_parts_must_be_nothing():
    data = pack(m.Gate(1, 3, np.zeros(0, np.float32), np.ones(1, np.float32)))
    assert data[-4:] == b"\0" * 4
    with pytest.raises(BusError, match="padding"):
        unpack(data[:-1] + b"\1", m.Gate)


@dataclass(frozen=True)
class Flags:
    """No message has such an array yet."""

    flags: np.ndarray = field(metadata={"dtype": "?", "shape": (-1,)})


def test_a_flag_is_true_or_false_and_nothing_else():
    data = pack(Flags(np.array([True, False] * 4)))
    assert unpack(data, Flags).flags.tolist() == [True, False] * 4
    with pytest.raises(BusError, match="flags holds more than true and false"):
        unpack(data[:-1] + b"\2", Flags)


def test_a_huge_size_is_refused_before_memory_is_touched():
    data = pack(m.Gate(1, 3, np.zeros(0, np.float32), np.ones(2, np.float32)))
    huge = data.replace(b'["<f4",0]', b'["<f4",9]').replace(b'"<f4",9', b'"<f4",4')
    assert huge != data
    with pytest.raises(BusError, match="truncated in weights"):
        unpack(huge, m.Gate)


@settings(max_examples=100, deadline=None)
@given(data=st.binary(max_size=200), cls=st.sampled_from(TYPES))
def test_random_bytes_raise_nothing_else_than_a_bus_error(data, cls):
    for start in (b"", GOOD[:16]):
        with pytest.raises(BusError):
            unpack(start + data, cls)


@settings(max_examples=200, deadline=None)
@given(position=st.integers(0, len(GOOD) - 1), bit=st.integers(0, 7))
def test_a_flipped_bit_raises_nothing_else_than_a_bus_error(position, bit):
    damaged = bytearray(GOOD)
    damaged[position] ^= 1 << bit
    try:
        message = unpack(bytes(damaged), m.Tracked)
    except BusError:
        return
    # what still unpacks is a message of the right types
    assert same(unpack(pack(message), m.Tracked), message)
