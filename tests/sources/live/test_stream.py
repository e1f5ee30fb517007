"""Network cameras against real servers that stall, die, come back, and send rubbish."""

from __future__ import annotations

import contextlib
import socket
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sources.live.servers import NoisyLink, RtspServer, jpeg, mjpeg_server, need_rtsp_server

from prism_edge.errors import SourceError
from prism_edge.sources.base import Image, Unreadable
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.live.camera import LiveCamera, Timing
from prism_edge.sources.live.driver import CameraLostError
from prism_edge.sources.live.stream import Options, StreamDriver, is_stream
from tests.waiting import until

pytest.importorskip("av", reason="network cameras need PyAV: pip install 'prism-edge[streams]'")

DEADLINE_S = 30.0
PATIENT = "timeout=20"  # where no silence is looked for: a busy machine's server is slow, not dead
QUICK = Timing(absent_s=0.0, first_pause_s=0.02, longest_pause_s=0.1)


def watching(address: str, absent_s: float = 0.0) -> LiveCamera:
    """``absent_s``: for a server that is there but may be slow to answer, as on a busy machine."""
    timing = Timing(absent_s=absent_s, first_pause_s=0.02, longest_pause_s=0.1)
    return LiveCamera(StreamDriver(address), UNCALIBRATED, "none", timing)


def images(camera: LiveCamera, count: int = 1) -> list[Image]:
    deadline, found = time.monotonic() + DEADLINE_S, []
    while len(found) < count:
        assert time.monotonic() < deadline
        item = camera.read()
        if isinstance(item, Image):
            found.append(item)
    return found


@pytest.fixture
def rtsp() -> Iterator[RtspServer]:
    need_rtsp_server()
    server = RtspServer()
    yield server
    server.kill()


@pytest.mark.parametrize(
    ("name", "options"),
    [("h264", PATIENT), ("mjpeg", PATIENT), ("reordered", PATIENT), ("h264", "transport=udp")],
)
def test_rtsp_plays(rtsp: RtspServer, name: str, options: str) -> None:
    with watching(rtsp.address(name, options), DEADLINE_S) as camera:
        assert camera.period_ns == pytest.approx(1e9 / 30, rel=0.01)
        seen = images(camera, 20)
        now = time.monotonic_ns()
    assert all(image.pixels.shape == (120, 160, 3) for image in seen)
    assert seen[0].pixels.max() > 200  # the ball on black
    captured = np.array([image.captured_monotonic_ns for image in seen])
    assert np.all(np.diff(captured) > 0)
    assert now - captured[-1] < DEADLINE_S * 1e9
    # The sender's stamps are a multiple of its period apart, whenever they arrived.
    steps = np.diff([image.captured_monotonic_ns - image.index * 1e9 / 30 for image in seen[5:]])
    assert np.median(np.abs(steps)) < 2e6


def test_rtsp_that_dies_is_said_and_comes_back(rtsp: RtspServer) -> None:
    with watching(rtsp.address(), DEADLINE_S) as camera:
        before = images(camera)[0]
        rtsp.kill()
        until(lambda: camera.health()["camera"].startswith("reconnecting"))
        again = RtspServer(rtsp.port)
        try:
            until(lambda: camera.health()["camera"] == "streaming")
            after = images(camera)[0]
        finally:
            again.kill()
    assert after.captured_monotonic_ns > before.captured_monotonic_ns
    assert after.index > before.index


def test_rtsp_that_stalls_is_dead_after_the_timeout(rtsp: RtspServer) -> None:
    with watching(rtsp.address(), DEADLINE_S) as camera:
        images(camera)
        rtsp.stall()
        until(lambda: camera.health()["camera"].startswith("reconnecting: silent"))
        rtsp.go_on()
        until(lambda: camera.health()["camera"] == "streaming")
        images(camera)


def test_rtsp_that_stalls_is_no_place_to_open(rtsp: RtspServer) -> None:
    rtsp.stall()
    with pytest.raises(SourceError, match="silent for 1 s"):
        watching(rtsp.address()).open()
    rtsp.go_on()


def test_rtsp_over_a_link_that_flips_bytes(rtsp: RtspServer) -> None:
    link = NoisyLink(rtsp.port)
    try:
        with watching(f"rtsp://127.0.0.1:{link.port}/h264#timeout=1", DEADLINE_S) as camera:
            images(camera)
            for noise in (1e-4, 1e-2):
                link.noise = noise
                until(lambda: camera.read() is not None and "warning" in camera.health())
            link.noise = 0.0
            until(lambda: isinstance(camera.read(), Image) and camera.health()["camera"] == "streaming")
    finally:
        link.close()


def test_rtsp_without_that_name(rtsp: RtspServer) -> None:
    with pytest.raises(SourceError, match="404"):
        watching(rtsp.address("nothing", PATIENT)).open()


def test_mjpeg_plays_and_the_newest_wins() -> None:
    with mjpeg_server() as server, watching(server.address(PATIENT), DEADLINE_S) as camera:
        before = images(camera)[0].index
        until(lambda: camera._taken > before + 20)
        first, later = images(camera, 2)
        assert first.pixels.shape == (120, 160, 3)
        assert first.index >= before + 10
        # Index and image are in step: the bar moves by 3 pixels an image.
        start, end = (np.nonzero(image.pixels[60, :, 2] > 170)[0].min() for image in (first, later))
        assert (end - start) % 160 == pytest.approx(3 * (later.index - first.index), abs=2)


def test_mjpeg_that_ends_or_stalls_comes_back() -> None:
    with mjpeg_server() as server, watching(server.address(), DEADLINE_S) as camera:
        images(camera)
        server.ending.set()
        until(lambda: camera.health()["camera"].startswith("reconnecting"))
        server.ending.clear()
        until(lambda: camera.health()["camera"] == "streaming")
        server.silent.set()
        until(lambda: "silent for 1 s" in camera.health()["camera"])
        server.silent.clear()
        until(lambda: camera.health()["camera"] == "streaming")
        assert int(camera.health()["reconnects"]) >= 2


def test_mjpeg_cut_short_is_unreadable() -> None:
    with mjpeg_server() as server, watching(server.address(), DEADLINE_S) as camera:
        images(camera)
        server.mangle = lambda data: data[: len(data) // 2]
        until(lambda: isinstance(item := camera.read(), Unreadable) and "truncated" in item.reason)
        until(lambda: "damaged images" in (camera.read() and camera.health().get("warning", "")))
        server.mangle = bytes
        images(camera)


@pytest.mark.parametrize(("status", "words"), [(401, "refuses the user name"), (404, "404"), (500, "5XX")])
def test_http_errors_are_one_line_without_the_password(status: int, words: str) -> None:
    with mjpeg_server() as server:
        server.status = status
        address = server.address(PATIENT).replace("http://", "http://me:secret@")
        with pytest.raises(SourceError) as error:
            watching(address).open()
    assert words in str(error.value)
    assert "secret" not in str(error.value)
    assert "\n" not in str(error.value)


def test_parts_of_another_type_are_refused_with_the_one_that_is_read() -> None:
    with mjpeg_server() as server:
        server.type = "image/jpg"  # FFmpeg insists on the right one
        with pytest.raises(SourceError, match="parts of the type image/jpeg"):
            watching(server.address(PATIENT)).open()


def test_nobody_there() -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    for address in (f"rtsp://127.0.0.1:{port}/x", f"http://127.0.0.1:{port}/x"):
        with pytest.raises(SourceError, match="connection refused"):
            watching(address).open()


def test_who_accepts_and_says_nothing_is_not_waited_for() -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        port = mute.getsockname()[1]
        for scheme in ("rtsp", "http"):
            with pytest.raises(SourceError, match="silent"):
                watching(f"{scheme}://127.0.0.1:{port}/x#timeout=0.5").open()


def test_a_constant_delay_is_taken_off_the_stamps() -> None:
    with mjpeg_server() as server:
        before = time.monotonic_ns()
        connection = StreamDriver(server.address("delay_ms=2000")).connect()
        try:
            grabs = [connection.grab() for _ in range(3)]
            after = time.monotonic_ns()
        finally:
            connection.close()
    assert grabs[-1] is not None
    assert grabs[-1].captured_ns <= after - 2 * 10**9  # by the clock that all share
    assert grabs[-1].captured_ns >= before - 3 * 10**9  # and no more than that: a second is plenty


@pytest.mark.parametrize(
    ("address", "words"),
    [
        ("rtsp:///stream", "no host"),
        ("rtsp://camera:99999/", "address is wrong"),
        ("rtsp://[::1/", "address is wrong"),
        ("rtsp://camera/a b", "%20"),
        ("rtsp://camera/s#transport=pigeon", "tcp, udp"),
        ("rtsp://camera/s#timeout=0", "between 0.5 and 60"),
        ("http://camera/s#tineout=3", "did you mean timeout"),
        ("http://me:secret@camera/s?password=secret#delay_ms=-1", "delay_ms"),
    ],
)
def test_wrong_addresses_are_one_line(address: str, words: str) -> None:
    with pytest.raises(SourceError) as error:
        StreamDriver(address)
    assert words in str(error.value)
    assert "secret" not in str(error.value)


def test_addresses_are_shown_without_secrets() -> None:
    driver = StreamDriver("rtsp://me:secret@camera:8554/live?token=secret#transport=udp&timeout=2")
    assert driver.name == "rtsp://camera:8554/live?..."
    assert driver.url == "rtsp://me:secret@camera:8554/live?token=secret"
    assert driver.options == Options("udp", 2.0)
    assert is_stream("RTSP://camera/x")
    assert not is_stream("recordings/http")


class Babbler:
    """Sends given bytes to whoever connects, and hangs up."""

    def __init__(self) -> None:
        self.answer = b""
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                client, _ = self._server.accept()
            except OSError:
                return
            with client:
                client.settimeout(2.0)
                try:
                    client.recv(4096)
                    client.sendall(self.answer)
                    client.shutdown(socket.SHUT_WR)
                    while client.recv(4096):
                        client.sendall(self.answer)
                except OSError:
                    pass

    def close(self) -> None:
        self._server.close()


@pytest.fixture(scope="module")
def babbler() -> Iterator[Babbler]:
    server = Babbler()
    yield server
    server.close()


def handshake(codec: str) -> bytes:
    """A whole conversation of RTSP's, said at once."""
    sdp = f"v=0\r\ns=x\r\nt=0 0\r\nm=video 0 RTP/AVP 96\r\na=rtpmap:96 {codec}/90000\r\na=control:track\r\n"
    parts = (
        "Public: OPTIONS, DESCRIBE, SETUP, PLAY\r\n\r\n",
        f"Content-Type: application/sdp\r\nContent-Length: {len(sdp)}\r\n\r\n{sdp}",
        "Session: 1\r\nTransport: RTP/AVP/TCP;unicast;interleaved=0-1\r\n\r\n",
        "Session: 1\r\n\r\n",
    )
    return "".join(f"RTSP/1.0 200 OK\r\nCSeq: {k}\r\n{part}" for k, part in enumerate(parts, 1)).encode()


HEADS = [
    handshake("H264"),
    b"",
    b"RTSP/1.0 200 OK\r\nCSeq: 1\r\n",
    b"RTSP/1.0 200 OK\r\nCSeq: 2\r\nContent-Type: application/sdp\r\nContent-Length: 120\r\n\r\nv=0\r\n",
    b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=frame\r\n\r\n--frame\r\n",
    b"HTTP/1.0 200 OK\r\n\r\n--b\r\nContent-Type: image/jpeg\r\nContent-Length: 9999999999\r\n\r\n" + jpeg(0),
]


def survive(babbler: Babbler, answer: bytes, scheme: str) -> None:
    babbler.answer = answer
    driver = StreamDriver(f"{scheme}://127.0.0.1:{babbler.port}/x#timeout=0.5")
    with contextlib.suppress(CameraLostError, SourceError):
        connection = driver.connect()
        try:
            for _ in range(5):
                grab = connection.grab()
                if grab is not None:
                    assert isinstance(grab.decode(), str | np.ndarray)
        finally:
            connection.close()


def test_a_stream_that_nobody_can_decode(babbler: Babbler) -> None:
    packet = bytes([0x80, 96, 0, 1, 0, 0, 0, 0, 0, 0, 0, 1]) + b"?" * 20
    babbler.answer = handshake("NONSENSE") + (b"$\0" + len(packet).to_bytes(2, "big") + packet) * 5
    with pytest.raises(CameraLostError, match="codec"):
        StreamDriver(f"rtsp://127.0.0.1:{babbler.port}/x#timeout=0.5").connect()


@settings(max_examples=60, deadline=None)
@given(
    head=st.sampled_from(HEADS),
    tail=st.binary(max_size=400),
    repeats=st.integers(1, 3),
    scheme=st.sampled_from(["rtsp", "http"]),
)
def test_rubbish_is_refused(babbler: Babbler, head: bytes, tail: bytes, repeats: int, scheme: str) -> None:
    survive(babbler, head + tail * repeats, scheme)


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_bits_flipped_in_an_mjpeg_stream_crash_nothing(babbler: Babbler, data: st.DataObject) -> None:
    parts = b"".join(
        b"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%s\r\n" % (len(image), image)
        for image in map(jpeg, range(3))
    )
    stream = bytearray(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace\r\n\r\n" + parts)
    for _ in range(data.draw(st.integers(1, 20))):
        stream[data.draw(st.integers(0, len(stream) - 1))] = data.draw(st.integers(0, 255))
    survive(babbler, bytes(stream), "http")


def test_without_pyav_a_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(SourceError, match=r"prism-edge\[streams\]"):
        StreamDriver("rtsp://127.0.0.1/x").connect()


def test_a_camera_may_sign_its_own_certificate_whatever_ffmpeg_comes_to_ask(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: dict[str, str] = {}

    def opened(_: str, **given: Any) -> None:
        asked.update(given["options"])
        raise CameraLostError("seen enough")

    monkeypatch.setattr(av, "open", opened)
    with pytest.raises(CameraLostError, match="seen enough"):
        StreamDriver("https://camera/video").connect()
    assert asked["tls_verify"] == "0"


def test_a_proxy_of_the_environment_is_passed_by(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("no_proxy", "")  # put back afterwards, whatever the driver made of it
    with socket.create_server(("127.0.0.1", 0)) as camera, socket.create_server(("127.0.0.1", 0)) as proxy:
        monkeypatch.setenv("http_proxy", f"http://127.0.0.1:{proxy.getsockname()[1]}")
        with pytest.raises(CameraLostError):
            StreamDriver(f"rtsps://127.0.0.1:{camera.getsockname()[1]}/x#timeout=0.5").connect()
        proxy.settimeout(0.1)
        with pytest.raises(TimeoutError):
            proxy.accept()
        camera.settimeout(0.1)
        camera.accept()[0].close()
