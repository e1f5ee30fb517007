"""Pictures that can't be used, at the start of a live camera and later."""

from __future__ import annotations

import threading
import time

import cv2
import numpy as np
import pytest
from sources.live.bench import CAMERA, DEADLINE_S, QUICK, Bench, picture, steady

from prism_edge.errors import SourceError
from prism_edge.messages import U8
from prism_edge.sources.base import Unreadable
from prism_edge.sources.live.camera import LiveCamera, Timing
from prism_edge.sources.live.driver import Grab
from tests.waiting import until

PATIENT = Timing(absent_s=DEADLINE_S, first_pause_s=0.01)


def useless(_: int = 0) -> Grab:
    time.sleep(0.002)
    return Grab(time.monotonic_ns(), lambda: "waits for a key frame")


def odd() -> U8:
    return cv2.cvtColor(np.zeros((4, 5, 2), np.uint8), cv2.COLOR_YUV2BGR_YUYV)


def test_a_stream_whose_key_frame_is_far_off_is_waited_for_where_it_is() -> None:
    began = time.monotonic()
    bench = Bench(lambda k: steady(k) if time.monotonic() > began + 0.1 else useless())
    bench.dead_s = 0.01
    with LiveCamera(bench, CAMERA, "a test", PATIENT):
        assert bench.connects == 1


def test_the_wait_for_a_key_frame_has_an_end() -> None:
    bench = Bench(useless)
    bench.dead_s = 0.01
    with pytest.raises(SourceError, match="waits for a key frame"):
        LiveCamera(bench, CAMERA, "a test", Timing(absent_s=0.05)).open()


def test_who_is_told_to_stop_waits_for_no_key_frame() -> None:
    camera = LiveCamera(bench := Bench(useless), CAMERA, "a test", PATIENT)
    stopping = threading.Thread(target=lambda: until(lambda: bench.grabs > 3) and camera.stopped.set())
    stopping.start()
    began = time.monotonic()
    with pytest.raises(SourceError):
        camera.open()
    stopping.join()
    assert time.monotonic() < began + DEADLINE_S / 2


def test_a_picture_at_which_the_decoder_fails_is_refused_like_a_damaged_one() -> None:
    def script(k: int) -> Grab:
        time.sleep(0.002)
        return Grab(time.monotonic_ns(), odd if k in (1, 2) or k > 4 else picture)

    bench = Bench(script)
    with LiveCamera(bench, CAMERA, "a test", QUICK) as camera:
        until(lambda: isinstance(item := camera.read(), Unreadable) and "can't be decoded" in item.reason)
        assert "\n" not in str(camera.read())
    assert bench.connects == 1
