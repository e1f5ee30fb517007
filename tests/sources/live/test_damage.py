"""Pictures after a loss, by a real decoder."""

from __future__ import annotations

import contextlib
import io
from fractions import Fraction

import numpy as np
import pytest

from prism_edge.sources.live.damage import Damage
from prism_edge.sources.live.driver import CameraLostError
from prism_edge.sources.live.stream import Options, StreamConnection

av = pytest.importorskip("av", reason="network cameras need PyAV: pip install 'prism-edge[streams]'")

S = 1_000_000_000
KEY_EVERY, HIT, COUNT = 8, 11, 24


def packets() -> list[bytes]:
    """Noise that moves, a key frame every eighth picture."""
    encoder = av.CodecContext.create("libx264", "w")
    encoder.width, encoder.height, encoder.pix_fmt, encoder.framerate = 160, 120, "yuv420p", Fraction(30)
    encoder.time_base = Fraction(1, 30)
    keys = f"keyint={KEY_EVERY}:min-keyint={KEY_EVERY}:scenecut=0:repeat-headers=1"
    encoder.options = {"tune": "zerolatency", "preset": "ultrafast", "x264-params": keys}
    scene = np.random.default_rng(0).integers(0, 255, (180, 400), dtype=np.uint8)
    found = []
    for k in range(COUNT):
        frame = av.VideoFrame.from_ndarray(scene[:, 2 * k : 2 * k + 160], format="yuv420p")
        frame.pts = k
        found += [bytes(packet) for packet in encoder.encode(frame)]
    return found


def decoded(parts: list[bytes]) -> list[np.ndarray | str]:
    found: list[np.ndarray | str] = []
    with av.open(io.BytesIO(b"".join(parts)), format="h264") as container:
        connection = StreamConnection(container, Options(), False)
        with contextlib.suppress(CameraLostError):  # the stream's end
            while True:
                grab = connection.grab()
                if grab is not None:
                    found.append(grab.decode())
    return found


@pytest.mark.parametrize("left", [0.5, 0.004])  # half of the picture, or nothing but its header
def test_what_builds_on_a_damaged_picture_is_refused_until_the_next_key_frame(left: float) -> None:
    sent = packets()
    whole = decoded(sent)
    sent[HIT] = sent[HIT][: int(left * len(sent[HIT]))]
    found = decoded(sent)
    refused = [k for k, picture in enumerate(found) if isinstance(picture, str)]
    assert len(found) == len(whole)
    assert refused == list(range(HIT, 2 * KEY_EVERY))
    assert found[HIT] == "is damaged"
    assert found[HIT + 1] == "builds on a damaged one"
    for k in set(range(len(whole))) - set(refused):
        np.testing.assert_array_equal(found[k], whole[k])


def test_where_no_key_frame_comes_pictures_are_believed_after_ten_seconds() -> None:
    """However often it is damaged meanwhile: else a stream without key frames would never be heard again."""
    damage = Damage()
    assert not damage.spoils(False, 0)
    damage.hit(1 * S)
    assert damage.spoils(False, 2 * S)
    damage.hit(5 * S)
    assert damage.spoils(False, 11 * S)
    damage.hit(11 * S)
    assert not damage.spoils(False, 11 * S + 1)
    assert not damage.spoils(True, 12 * S)
    damage.hit(13 * S)
    assert damage.spoils(False, 14 * S), "it has key frames, after all"


def test_a_stream_of_key_frames_alone_loses_only_the_damaged_ones() -> None:
    damage = Damage()
    damage.hit(1 * S)
    assert not damage.spoils(True, 1 * S)


@pytest.mark.parametrize("knows", [False, True])  # what the server's description tells
def test_pictures_before_the_first_key_frame_say_what_they_wait_for(knows: bool) -> None:
    sent = packets()
    parameters = sent[0][: sent[0].index(b"\0\0\1\x65")]  # all before the key frame's first slice
    found = decoded([parameters * knows + sent[3], *sent[4:]])
    first = next(k for k, picture in enumerate(found) if not isinstance(picture, str))
    assert first == KEY_EVERY - 3
    assert all("waits for a key frame" in str(picture) for picture in found[:first])
