"""A web server on loopback that serves files rightly, or misbehaves as it is told, request by request."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class WebServer:
    """``files`` by path. ``plan`` holds what to do with the next requests, one word each; then all is right.

    Words: right, truncate (half, then the connection is cut), corrupt (one byte is wrong), stall (half, then
    nothing until the server ends), trickle (a byte now and then), ignore-range, wrong-range, no-length,
    odd-length, changed (another version), packed, close (no answer), an HTTP status as digits, -> URL (a
    redirect).
    """

    def __init__(self) -> None:
        self.files: dict[str, bytes] = {}
        self.plan: list[str] = []
        self.asked: list[tuple[str, str]] = []  # path, Range
        self.ended = threading.Event()
        self.etags = True
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def log_message(self, *words: object) -> None:
                pass

            def do_GET(self) -> None:
                with suppress(BrokenPipeError, ConnectionResetError):
                    server._answer(self)

        self._http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._http.daemon_threads = True
        self._thread = threading.Thread(target=self._http.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()
        self.url = f"http://127.0.0.1:{self._http.server_address[1]}"

    def close(self) -> None:
        self.ended.set()
        self._http.shutdown()
        self._http.server_close()

    def _answer(self, request: BaseHTTPRequestHandler) -> None:
        path, span = request.path, request.headers.get("Range", "")
        self.asked.append((path, span))
        how = self.plan.pop(0) if self.plan else "right"
        request.close_connection = True
        if how.startswith("-> "):
            request.send_response(302)
            request.send_header("Location", how[3:])
            request.send_header("Content-Length", "0")
            request.end_headers()
            return
        if how == "close":
            return
        if how.isdigit() or path not in self.files:
            request.send_error(int(how) if how.isdigit() else 404)
            return
        self._send(request, self.files[path], span, how)

    def _send(self, request: BaseHTTPRequestHandler, whole: bytes, span: str, how: str) -> None:
        start = int(span.removeprefix("bytes=").rstrip("-")) if span and how != "ignore-range" else 0
        if start >= len(whole) > 0 and span:
            request.send_response(416)
            request.send_header("Content-Range", f"bytes */{len(whole)}")
            if self.etags:
                request.send_header("ETag", f'"{hashlib.md5(whole).hexdigest()}"')
            request.send_header("Content-Length", "0")
            request.end_headers()
            return
        body = whole[start:]
        request.send_response(206 if start else 200)
        if start:
            said = start + 1 if how == "wrong-range" else start
            request.send_header("Content-Range", f"bytes {said}-{len(whole) - 1}/{len(whole)}")
        if self.etags:
            version = hashlib.md5(whole).hexdigest() + ("x" if how == "changed" else "")
            request.send_header("ETag", f'"{version}"')
        if how == "packed":
            request.send_header("Content-Encoding", "gzip")
        if how != "no-length":
            length = str(len(body))
            request.send_header("Content-Length", f"{length}, {length}" if how == "odd-length" else length)
        request.end_headers()
        if how == "corrupt":
            body = body[:-1] + bytes([body[-1] ^ 1])
        half = len(body) // 2
        if how in ("truncate", "stall", "trickle"):
            request.wfile.write(body[:half])
            request.wfile.flush()
            while how != "truncate" and not self.ended.wait(0.05):
                if how == "trickle":
                    request.wfile.write(body[half : half + 1])
                    request.wfile.flush()
                    half += 1
            return
        request.wfile.write(body)


@contextmanager
def web_server() -> Iterator[WebServer]:
    """A server that ends with the block."""
    server = WebServer()
    try:
        yield server
    finally:
        server.close()
