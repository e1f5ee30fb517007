"""Pictures that libjpeg complains about, and lines of the log that come meanwhile."""

from __future__ import annotations

import logging
import os
import threading

import cv2
import numpy as np
import pytest

from prism_edge import vital
from prism_edge.sources.live.camera import _decoded
from prism_edge.sources.live.driver import Grab
from prism_edge.sources.live.v4l2_pixels import to_image
from prism_edge.sources.native_stderr import native_stderr_unheard
from tests.waiting import until


def of_a_cheap_camera() -> bytes:
    """A whole JPEG with bytes too many before its end marker."""
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    smooth = cv2.GaussianBlur(noise, (0, 0), 5)
    data = cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_RST_INTERVAL, 4])[1].tobytes()
    return data[:-2] + bytes(30) + data[-2:]


def test_what_libjpeg_says_of_a_whole_picture_is_not_heard(capfd: pytest.CaptureFixture[str]) -> None:
    data = of_a_cheap_camera()
    plain = to_image(data, "MJPG", 640, 480, 0)
    assert "Corrupt JPEG data" in capfd.readouterr().err, "else nothing is shown here"
    picture = _decoded(Grab(0, lambda: to_image(data, "MJPG", 640, 480, 0)))
    np.testing.assert_array_equal(picture, plain)
    os.write(2, b"heard again\n")
    assert capfd.readouterr().err == "heard again\n"


def test_a_line_of_another_thread_waits_and_is_not_lost(capfd: pytest.CaptureFixture[str]) -> None:
    root, free = logging.getLogger(), []
    handler = logging.StreamHandler(os.fdopen(2, "w", closefd=False))  # sys.stderr is pytest's own
    asking = threading.Thread(target=lambda: free.append(handler.lock.acquire(blocking=False)))
    speaking = threading.Thread(target=root.warning, args=("meanwhile",))
    root.addHandler(handler)
    try:
        with native_stderr_unheard():
            asking.start()
            asking.join()
            assert free == [False]
            speaking.start()
            os.write(2, b"not heard\n")
        until(lambda: not speaking.is_alive())
    finally:
        root.removeHandler(handler)
    assert capfd.readouterr().err == "meanwhile\n"


def test_no_descriptor_is_left_open_and_none_is_needed() -> None:
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(5):
        with pytest.raises(ValueError), native_stderr_unheard():  # noqa: PT011
            raise ValueError
    assert len(os.listdir("/proc/self/fd")) == before
    kept = os.dup(2)
    os.close(2)
    try:
        with native_stderr_unheard():
            pass
        with pytest.raises(OSError, match="Bad file descriptor"):
            os.fstat(2)
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def test_what_a_process_says_as_it_ends_is_heard_meanwhile(capfd: pytest.CaptureFixture[str]) -> None:
    """A thread that finds no memory ends its process with a line that waits for nobody."""
    child = os.fork()
    if child == 0:
        with native_stderr_unheard():
            vital.end_starved(b"starved\n")
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 70
    assert capfd.readouterr().err == "starved\n"
    assert vital.stderr == 2


def test_without_a_descriptor_left_an_image_is_decoded_all_the_same(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def none_left(*_: object) -> int:
        raise OSError(24, "Too many open files")

    with monkeypatch.context() as patched:
        patched.setattr(os, "open", none_left)
        with native_stderr_unheard():
            os.write(2, b"heard\n")
    assert capfd.readouterr().err == "heard\n"
