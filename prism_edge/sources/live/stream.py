"""Network cameras through PyAV: RTSP, and MJPEG over HTTP. PyAV is loaded when the first one connects."""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any
from urllib.parse import SplitResult, urlsplit

from prism_edge.config import limits, one_of
from prism_edge.errors import SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import U8
from prism_edge.sources.address import parse_options, shown_parts
from prism_edge.sources.base import DEFAULT_RATE_HZ
from prism_edge.sources.image_file import decode
from prism_edge.sources.live.arrival_clock import ArrivalClock
from prism_edge.sources.live.backlog import AT_ONCE_NS, Backlog
from prism_edge.sources.live.damage import WAITING, Damage
from prism_edge.sources.live.driver import CameraLostError, Grab

log = logging.getLogger("prism_edge.sources")

SCHEMES = ("rtsp", "rtsps", "http", "https")

# What a server may make FFmpeg open: nothing but connections to itself.
_PROTOCOLS = "rtsp,rtp,srtp,tcp,udp,tls,http,https,httpproxy,crypto"
_ESCAPES = "in a password write # as %23, @ as %40, / as %2F and ? as %3F"
_SHORT_NS = 1_000_000_000  # the clock's window where stamps run too slow: it lags by less than that
_MJPEG = "mpjpeg"  # FFmpeg's name of multipart JPEG
_READ = "; only multipart JPEG is read, its parts of the type image/jpeg"


@dataclass(frozen=True)
class Options:
    """What may stand behind # in a stream's address."""

    transport: str = one_of("tcp", "tcp", "udp", help="how RTSP carries the images; udp loses some")
    timeout: float = limits(5.0, 0.5, 60.0, "seconds without data after which the link is dead")
    delay_ms: float = limits(0.0, 0.0, 5000.0, "least time from exposure to arrival, taken off the stamps")


def is_stream(uri: str) -> bool:
    """Whether an address is one of ours."""
    return uri.split("://", 1)[0].lower() in SCHEMES and "://" in uri


class StreamDriver:
    """One RTSP or HTTP address; raises SourceError where the address is wrong."""

    def __init__(self, uri: str) -> None:
        parts = _split(uri)
        self.name = shown_parts(parts)
        self.options = Options(**parse_options(self.name, parts.fragment, Options))
        self.url = parts._replace(fragment="").geturl()
        self.is_mjpeg = parts.scheme.lower().startswith("http")
        self.period_ns = round(1e9 / DEFAULT_RATE_HZ)
        self.dead_s = self.options.timeout
        self.connect_s = 2 * self.options.timeout  # for an answer, and for what it says of its streams

    def connect(self) -> StreamConnection:
        """Raises CameraLostError where nobody answers, SourceError where it is the address that is wrong."""
        av = _pyav()
        if self.url[:6].lower() == "rtsps:":  # FFmpeg's TLS below RTSP takes no option, but heeds this
            os.environ["no_proxy"] = "*"
        options = {"protocol_whitelist": _PROTOCOLS, "fflags": "nobuffer"}
        if self.is_mjpeg:
            options["http_proxy"] = ""  # a camera is on our own network
            options["tls_verify"] = "0"  # ... and signs its own certificate, if any
        else:
            options |= {"rtsp_transport": self.options.transport, "allowed_media_types": "video"}
        began = time.monotonic()
        try:
            container = av.open(
                self.url,
                format=_MJPEG if self.is_mjpeg else "rtsp",
                options=options,
                timeout=(self.options.timeout, self.options.timeout),
            )
        except (av.error.HTTPUnauthorizedError, av.error.HTTPForbiddenError):
            raise SourceError(f"{self.name}: the camera refuses the user name or password") from None
        except (av.error.FFmpegError, ValueError) as error:
            is_late = time.monotonic() - began >= self.options.timeout
            reason = reason_of(error, is_late, self.options.timeout)
            if self.is_mjpeg and not is_late and isinstance(error, av.error.InvalidDataError):
                reason += _READ
            raise CameraLostError(reason) from None
        try:
            connection = StreamConnection(container, self.options, self.is_mjpeg)
        except BaseException:
            container.close()
            raise
        self.period_ns = connection.period_ns or self.period_ns
        return connection


class StreamConnection:
    """One open stream."""

    intrinsics: Camera | None = None

    def __init__(self, container: Any, options: Options, is_mjpeg: bool) -> None:
        if not container.streams.video:
            raise CameraLostError("the stream carries no video")
        self._container, self._options, self._is_mjpeg = container, options, is_mjpeg
        self._stream = container.streams.video[0]
        if self._stream.codec_context is None:
            raise CameraLostError("the stream's codec is not known")
        # One thread: the cores belong to the tracker, and frame threads hold images back.
        self._stream.thread_type = "SLICE"
        self._stream.codec_context.thread_count = 1
        rate = self._stream.average_rate or self._stream.guessed_rate
        # A multipart stream carries no rate; FFmpeg takes 25.
        self.period_ns = round(1e9 / rate) if rate and not is_mjpeg and 0.1 <= rate <= 1000 else 0
        self._packets: Iterator[Any] = container.demux(self._stream)
        self._clock = ArrivalClock()
        self._backlog, self._left_out, self._misled = Backlog(), 0, False
        self._damage, self._begun = Damage(), False
        self._decoded: deque[Grab] = deque()

    def grab(self) -> Grab | None:
        """The next image; raises CameraLostError where the link ends, or is silent for the timeout."""
        if self._decoded:
            return self._decoded.popleft()
        errors = _pyav().error
        asked_ns = time.monotonic_ns()
        try:
            packet = next(self._packets, None)
            arrival_ns = time.monotonic_ns()
            if packet is None or packet.size == 0:
                raise CameraLostError("the server has ended the stream")
            if self._is_mjpeg:
                return self._undecoded(bytes(packet), arrival_ns)
            if packet.pts is not None:
                stamp_ns = _ns(packet.pts, packet.time_base)
                waited_ns = arrival_ns - asked_ns
                self._clock.observe(stamp_ns, arrival_ns, waited_ns >= AT_ONCE_NS)
                late_ns = arrival_ns - self._clock.host_ns(stamp_ns)
                leaves_out = self._backlog.leaves_out(late_ns, waited_ns, packet.is_keyframe)
                if (self._backlog.misled or self._clock.is_slow) and not self._misled:
                    self._distrust(stamp_ns, arrival_ns)
                if leaves_out:
                    self._left_out += 1
                    return None
            self._begun |= packet.is_keyframe
            try:
                frames = packet.decode()
            except errors.InvalidDataError:
                self._damage.hit(arrival_ns)
                return self._grab(arrival_ns, self._damaged)
        except (errors.FFmpegError, ValueError) as error:
            reason = reason_of(error, False, self._options.timeout)
            if self._is_mjpeg and isinstance(error, errors.InvalidDataError):
                reason += _READ
            raise CameraLostError(reason) from None
        if not frames and not self._begun:
            return self._grab(arrival_ns, self._damaged)  # the decoder passes over it without a word
        for frame in frames:
            picture = self._unsound(frame, arrival_ns) or frame
            self._decoded.append(self._grab(self._captured_ns(frame, arrival_ns), picture))
        return self._decoded.popleft() if self._decoded else None

    def _distrust(self, stamp_ns: int, arrival_ns: int) -> None:
        """The sender's stamps run slower than time: they say no more than whether decoding falls behind."""
        self._misled = True
        self._clock = ArrivalClock(_SHORT_NS)
        self._clock.observe(stamp_ns, arrival_ns)
        log.warning("the stream's stamps run slower than time: images are stamped by their arrivals now")

    def close(self) -> None:
        with contextlib.suppress(Exception):  # it may be broken already
            self._container.close()

    def _captured_ns(self, frame: Any, arrival_ns: int) -> int:
        if self._misled or frame.pts is None or frame.time_base is None:
            return arrival_ns
        try:
            return min(self._clock.host_ns(_ns(frame.pts, frame.time_base)), arrival_ns)
        except ValueError:  # no packet had a stamp
            return arrival_ns

    def _unsound(self, frame: Any, arrival_ns: int) -> str:
        """Why a picture is not to be looked at, empty where it is whole."""
        if frame.is_corrupt:
            self._damage.hit(arrival_ns)
            return self._damaged
        spoilt = self._damage.spoils(bool(frame.key_frame), arrival_ns)
        return "builds on a damaged one" if spoilt else ""

    @property
    def _damaged(self) -> str:
        if self._begun:
            return "is damaged"
        return WAITING

    def _undecoded(self, data: bytes, arrival_ns: int) -> Grab:
        return Grab(arrival_ns - self._delay_ns, lambda: decode(data))

    def _grab(self, captured_ns: int, frame: Any) -> Grab:
        missed, self._left_out = self._left_out, 0
        return Grab(captured_ns - self._delay_ns, lambda: _pixels(frame), missed)

    @property
    def _delay_ns(self) -> int:
        return round(self._options.delay_ms * 1e6)


def reason_of(error: Exception, is_late: bool, timeout_s: float) -> str:
    """FFmpeg's error in a few words, without the address, which may hold a password.

    Where the time was up (``is_late``), what FFmpeg makes of its interruption says nothing.
    """
    if is_late or type(error).__name__ in ("ExitError", "TimeoutError"):
        return f"silent for {timeout_s:g} s"
    words = getattr(error, "strerror", None) or type(error).__name__
    return str(words)[:1].lower() + str(words)[1:]


def _split(uri: str) -> SplitResult:
    try:
        parts = urlsplit(uri)
        host, _ = parts.hostname, parts.port
    except ValueError:  # its words may quote a password
        raise SourceError(f"the source's address is wrong; {_ESCAPES}") from None
    if any(c in parts.fragment for c in "@/?"):
        raise SourceError(f"the source's address goes on behind its options (#); {_ESCAPES}")
    if not host:
        raise SourceError(f"{shown_parts(parts)}: the address names no host")
    if any(ord(c) <= 32 or ord(c) == 127 for c in uri):
        raise SourceError(f"{shown_parts(parts)!r}: an address has no spaces; write %20")
    return parts


def _ns(stamp: int, time_base: Any) -> int:
    return stamp * time_base.numerator * 1_000_000_000 // time_base.denominator


def _pixels(frame: Any) -> U8 | str:
    if isinstance(frame, str):
        return frame
    grey = frame.format.name == "gray"
    return frame.to_ndarray(format="gray" if grey else "bgr24")


def _pyav() -> Any:
    try:
        return importlib.import_module("av")
    except ImportError:
        raise SourceError(
            "network cameras need PyAV, which is not installed: pip install 'prism-edge[streams]'"
        ) from None
