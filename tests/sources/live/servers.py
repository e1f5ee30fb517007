"""Real servers of camera streams for the tests: RTSP in a process of its own, MJPEG in a thread."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest

SYSTEM_PYTHON = "/usr/bin/python3"  # the one for which Debian packages GStreamer's bindings
SCRIPT = Path(__file__).parent / "rtsp_server.py"
_PROBE = "import gi; gi.require_version('GstRtspServer', '1.0'); from gi.repository import GstRtspServer"


def need_rtsp_server() -> None:
    """Skips the test where there is no RTSP server to test against."""
    try:
        probe = subprocess.run([SYSTEM_PYTHON, "-c", _PROBE], capture_output=True, timeout=60)
    except OSError:
        pytest.skip(f"no {SYSTEM_PYTHON}, which would serve RTSP")
    if probe.returncode:
        pytest.skip("no RTSP server: apt install gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-{good,ugly}")


class RtspServer:
    """`rtsp://127.0.0.1:port/h264` and `/mjpeg`, until killed."""

    def __init__(self, port: int = 0, width: int = 160, height: int = 120, rate: int = 30) -> None:
        words = [SYSTEM_PYTHON, str(SCRIPT), *map(str, (port, width, height, rate))]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
        self._process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True, env=environment)
        assert self._process.stdout is not None
        line = self._process.stdout.readline().split()
        assert line[:1] == ["port"], "the RTSP server did not start"
        self.port = int(line[1])

    def address(self, name: str = "h264", options: str = "timeout=1") -> str:
        return f"rtsp://127.0.0.1:{self.port}/{name}#{options}"

    def stall(self) -> None:
        """The link stays up and carries nothing, as when a cable is cut."""
        self._process.send_signal(signal.SIGSTOP)

    def go_on(self) -> None:
        self._process.send_signal(signal.SIGCONT)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()


class NoisyLink:
    """Carries TCP connections to a port of this host and, while ``noise`` is set, flips bytes coming back."""

    def __init__(self, port: int) -> None:
        self.noise = 0.0  # share of the bytes that change
        self._target, self._random = port, random.Random(0)
        self._server = socket.create_server(("127.0.0.1", 0))
        self.port = self._server.getsockname()[1]
        self._sockets: list[socket.socket] = []
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                here, _ = self._server.accept()
                there = socket.create_connection(("127.0.0.1", self._target))
            except OSError:
                return
            self._sockets += [here, there]
            for source, sink, noisy in ((here, there, False), (there, here, True)):
                threading.Thread(target=self._carry, args=(source, sink, noisy), daemon=True).start()

    def _carry(self, source: socket.socket, sink: socket.socket, noisy: bool) -> None:
        try:
            while data := bytearray(source.recv(65536)):
                if noisy and self.noise:
                    for _ in range(max(1, round(self.noise * len(data)))):
                        data[self._random.randrange(len(data))] = self._random.randrange(256)
                sink.sendall(data)
            sink.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass

    def close(self) -> None:
        self._server.close()
        for end in self._sockets:
            end.close()


def jpeg(k: int, width: int = 160, height: int = 120) -> bytes:
    """The k-th image of a moving bar."""
    image = np.full((height, width, 3), 90, np.uint8)
    cv2.rectangle(image, (3 * k % width, 0), (3 * k % width + 12, height), (30, 200, 240), -1)
    return cv2.imencode(".jpg", image)[1].tobytes()


class MjpegServer(ThreadingHTTPServer):
    """``http://127.0.0.1:port/``: multipart JPEG; what it does to its clients is set while it runs."""

    daemon_threads = True

    def __init__(self, port: int = 0) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self.silent = threading.Event()  # connections stay open, nothing is sent
        self.ending = threading.Event()  # connections are closed
        self.status = 200
        self.picture: Callable[[int], bytes] = jpeg  # the k-th JPEG
        self.mangle: Callable[[bytes], bytes] = bytes  # what becomes of it
        self.period_s = 0.01
        self.type = "image/jpeg"  # of each part
        self.raw: bytes | None = None  # sent instead of all images, after the header
        self.sent = 0

    def address(self, options: str = "timeout=1") -> str:
        return f"http://127.0.0.1:{self.server_address[1]}/video#{options}"

    def handle_error(self, request: object, client_address: object) -> None:
        """A client that left is no error."""


class _Handler(BaseHTTPRequestHandler):
    server: MjpegServer

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        server = self.server
        self.send_response(server.status)
        self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
        self.end_headers()
        if server.status != 200:
            return
        if server.raw is not None:
            self.wfile.write(server.raw)
        while not server.ending.is_set():
            if server.silent.is_set() or server.raw is not None:
                server.ending.wait(0.01)
                continue
            data = server.mangle(server.picture(server.sent))
            head = f"--frame\r\nContent-Type: {server.type}\r\nContent-Length: {len(data)}\r\n\r\n"
            self.wfile.write(head.encode() + data + b"\r\n")
            server.sent += 1
            time.sleep(server.period_s)


@contextmanager
def mjpeg_server(port: int = 0) -> Iterator[MjpegServer]:
    with MjpegServer(port) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
        thread.start()
        try:
            yield server
        finally:
            server.ending.set()
            server.shutdown()
            thread.join()
