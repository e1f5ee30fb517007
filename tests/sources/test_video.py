"""Video files."""

from __future__ import annotations

import logging
import struct
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.config import SourceConfig
from prism_edge.errors import SourceError
from prism_edge.sources import Image, Source, Unreadable, open_source


def opened(path: Path) -> Source:
    return open_source(SourceConfig(uri=str(path)))


def test_frames_and_stamps_are_the_containers(tmp_path: Path) -> None:
    with opened(tiny.write_video(tmp_path / "clip.avi", count=10, rate_hz=20.0)) as source:
        assert source.frame_count == 10
        assert source.period_ns == 50_000_000
        items = []
        while (item := source.read()) is not None:
            items.append(item)
        assert source.peek() is None
        assert source.read() is None
    assert [item.index for item in items] == list(range(10))
    assert [item.stamp_ns for item in items] == [50_000_000 * i for i in range(10)]
    for i, item in enumerate(items):
        assert isinstance(item, Image)
        assert item.pixels.shape == (48, 64, 3)
        errors = [np.abs(item.pixels.astype(int) - tiny.picture(j)).mean() for j in range(10)]
        assert int(np.argmin(errors)) == i


def test_a_colon_in_a_name_is_no_protocol(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tiny.write_video(tmp_path / "clip.avi", count=3).rename(tmp_path / "2026-11-27T12:30:05.avi")
    monkeypatch.chdir(tmp_path)
    with opened(Path("2026-11-27T12:30:05.avi")) as source:
        assert source.frame_count == 3


def test_skipping_and_what_comes_next(tmp_path: Path) -> None:
    with opened(tiny.write_video(tmp_path / "clip.avi")) as source:
        source.skip()
        source.skip()
        slot, item = source.peek(), source.read()
        assert slot is not None
        assert item is not None
        assert (slot.index, slot.stamp_ns) == (item.index, item.stamp_ns) == (2, 100_000_000)


def turned(path: Path, rows: tuple[int, ...]) -> Path:
    """A video whose track has another matrix (ISO 14496-12, tkhd): its upper two rows, as whole numbers."""
    tiny.write_video(path, kind="mp4v")
    data = bytearray(path.read_bytes())
    at = data.index(b"tkhd") + 4 + 40  # version 0
    a, b, c, d = (value << 16 for value in rows)
    data[at : at + 36] = struct.pack(">9i", a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(("rows", "degrees"), [((0, 1, -1, 0), 90), ((-1, 0, 0, -1), 180), ((1, 0, 0, 1), 0)])
def test_a_video_that_asks_to_be_turned_is_not_but_it_is_said(
    rows: tuple[int, ...], degrees: int, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with opened(turned(tmp_path / "clip.mp4", rows)) as source:
        item = source.read()
        source.open()  # as a loop does
    assert isinstance(item, Image)
    assert np.abs(item.pixels.astype(int) - tiny.picture(0)).mean() < 10.0
    assert caplog.text.count("asks to be turned by") == (degrees > 0)
    assert degrees == 0 or f"by {degrees} degrees; its frames are taken as they are stored" in caplog.text


def write_h264(path: Path, kind: str, count: int = 8, stored: bool = False, **options: str) -> Path:
    """At 20 Hz and with B-frames; kind "h264" is a bare stream, which has no stamps.

    ``stored``: stamps are of the order in which frames are stored, as some recorders write them.
    """
    av = pytest.importorskip("av", reason="OpenCV can't write H.264 here, and PyAV is not installed")
    (path.parent / "camera.yaml").write_text(tiny.CAMERA)
    with av.open(str(path), "w", format=kind) as container:
        stream = container.add_stream("libx264", rate=20, options={"bf": "2"} | options)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        frames = [av.VideoFrame.from_ndarray(tiny.picture(i), format="bgr24") for i in range(count)]
        for i, packet in enumerate(chain.from_iterable(map(stream.encode, [*frames, None]))):
            if stored:
                packet.time_base, packet.pts, packet.dts = Fraction(1, 20), i, i
            container.mux(packet)
    return path


@pytest.mark.parametrize(("rate_hz", "period_ns"), [(0.0, 40_000_000), (50.0, 20_000_000)])
def test_a_bare_stream_runs_at_its_rate(
    tmp_path: Path, rate_hz: float, period_ns: int, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_h264(tmp_path / "clip.h264", "h264")
    source = open_source(SourceConfig(uri=str(path), rate_hz=rate_hz))
    with caplog.at_level(logging.INFO):
        for _ in range(2):
            with source:
                assert source.period_ns == period_ns
                items = list(iter(source.read, None))
            assert [item.stamp_ns for item in items if item] == [period_ns * i for i in range(8)]
    assert caplog.text.count("has no stamps") == 1


def test_the_last_frames_of_an_avi_with_b_frames_have_their_time(tmp_path: Path) -> None:
    with opened(write_h264(tmp_path / "clip.avi", "avi")) as source:
        stamps = [item.stamp_ns for item in iter(source.read, None) if item]
    assert len(stamps) == 8
    assert np.diff(stamps).tolist() == [50_000_000] * 7


@pytest.mark.parametrize("b_frames", [1, 2, 3])
def test_stamps_in_the_order_of_storage_are_not_those_of_the_frames(
    tmp_path: Path, b_frames: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Some recorders write B-frames without saying when each is shown: half of the stamps go back."""
    path = write_h264(
        tmp_path / "clip.mp4", "mp4", count=40, stored=True, bf=str(b_frames), preset="veryfast"
    )
    with opened(path) as source:
        stamps = [item.stamp_ns for item in iter(source.read, None) if item]
    assert stamps == [50_000_000 * i for i in range(40)]
    assert caplog.text.count("taken to run at 20 Hz") == 1


def test_a_rate_leaves_the_stamps_of_a_container(tmp_path: Path) -> None:
    path = tiny.write_video(tmp_path / "clip.avi", count=3)
    with open_source(SourceConfig(uri=str(path), rate_hz=5.0)) as source:
        assert [item.stamp_ns for item in iter(source.read, None) if item] == [0, 50_000_000, 100_000_000]


def test_the_usual_time_between_frames_is_that_of_their_stamps(tmp_path: Path) -> None:
    """A browser's recording says no rate, and FFmpeg takes it to run at 1000 Hz."""
    av = pytest.importorskip("av", reason="OpenCV can't write a stream without a rate")
    path = tmp_path / "clip.webm"
    path.with_name("camera.yaml").write_text(tiny.CAMERA)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libvpx", rate=1000)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(20):
            frame = av.VideoFrame.from_ndarray(tiny.picture(i), format="bgr24")
            frame.pts, frame.time_base = 33 * i + i % 2, Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with opened(path) as source:
        assert 32_000_000 <= source.period_ns <= 34_000_000
        assert source.frame_count is None  # FFmpeg's is that of milliseconds
        assert [source.skip() for _ in range(22)] == [True] * 20 + [False] * 2


@pytest.mark.parametrize(("begins_s", "counted"), [(0, 60), (5, None), (600, None)])
def test_a_recording_whose_stamps_begin_late_is_not_said_to_be_cut_short(
    tmp_path: Path, begins_s: int, counted: int | None, caplog: pytest.LogCaptureFixture
) -> None:
    """Matroska says when it ends, and not how long it is: FFmpeg counts frames from 0 s on."""
    av = pytest.importorskip("av", reason="OpenCV can't write stamps of one's own")
    path = tmp_path / "clip.mkv"
    path.with_name("camera.yaml").write_text(tiny.CAMERA)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"bf": "0"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for i in range(60):
            frame = av.VideoFrame.from_ndarray(tiny.picture(i % 8), format="bgr24")
            frame.pts, frame.time_base = 1000 * begins_s + round(i * 1000 / 30), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with opened(path) as source:
        assert source.frame_count == counted
        stamps = [item.stamp_ns for item in iter(source.read, None) if item]
    assert (stamps[0], len(stamps)) == (0, 60)
    assert stamps[-1] == pytest.approx(59e9 / 30, abs=2e6)
    assert "cut short" not in caplog.text


def test_a_trimmed_film_is_as_long_as_it_is_shown(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Trimming without loss keeps what comes since the last key frame, and an edit list hides it."""
    av = pytest.importorskip("av", reason="OpenCV can't write an edit list")
    whole, path = tmp_path / "whole.mp4", tmp_path / "clip.mp4"
    path.with_name("camera.yaml").write_text(tiny.CAMERA)
    with av.open(str(whole), "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"g": "60"})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(60):
            frame = av.VideoFrame.from_ndarray(tiny.picture(i % 8), format="bgr24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    film = bytearray(whole.read_bytes())
    edit, movie = film.index(b"elst") + 8, film.index(b"mvhd") + 8  # ISO/IEC 14496-12, 8.6.6 and 8.2.2
    entries, _, begins = struct.unpack_from(">Iii", film, edit)
    assert entries == 1
    (scale,) = struct.unpack_from(">I", film, movie + 8)
    (ticks,) = struct.unpack_from(">I", film, film.index(b"mdhd") + 16)  # a second, of the track
    struct.pack_into(">ii", film, edit + 4, scale * 20 // 30, begins + ticks * 40 // 30)
    struct.pack_into(">I", film, movie + 12, scale * 20 // 30)
    path.write_bytes(film)
    with opened(whole) as source:
        assert source.frame_count == 60
    with opened(path) as source:
        assert source.frame_count == 20
        assert len([item for item in iter(source.read, None) if item]) == 20
    assert "cut short" not in caplog.text


def test_a_stamp_that_goes_back_is_left_to_the_checks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stamps_ns = [0, 50_000_000, 20_000_000, 150_000_000]
    source = opened(tiny.write_video(tmp_path / "clip.avi", count=4))
    with source:
        monkeypatch.setattr(source, "_position_ns", iter(stamps_ns).__next__)
        assert [item.stamp_ns for item in iter(source.read, None) if item] == stamps_ns


def test_a_frame_is_looked_for_no_later_than_after_the_step_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A film that begins in the dark, at 10 Hz, and goes on at 30; and one whose rate sinks."""
    with opened(tiny.write_video(tmp_path / "clip.avi", count=8, rate_hz=10.0)) as source:
        stamps_ms = [0, 100, 200, 233, 266, 300, 400, 900]
        monkeypatch.setattr(source, "_position_ns", iter(1_000_000 * ms for ms in stamps_ms).__next__)
        expected_ms = []
        for _ in stamps_ms:
            slot = source.peek()
            assert slot is not None
            expected_ms.append(slot.stamp_ns / 1e6)
            source.read()
    assert expected_ms == [0, 100, 200, 300, 266, 299, 334, 500]


def test_it_plays_again_once_reopened(tmp_path: Path) -> None:
    source = opened(tiny.write_video(tmp_path / "clip.avi"))
    for _ in range(2):
        with source:
            first = source.read()
            assert first is not None
            assert (first.index, first.stamp_ns) == (0, 0)
        assert source.read() is None


def test_a_truncated_video_ends_early(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tiny.write_video(tmp_path / "clip.avi", count=20)
    list(played(path))
    assert "should last" not in caplog.text
    tiny.truncate(path, 0.5)
    assert 1 <= len(played(path)) < 20
    assert "should last 1.0 s" in caplog.text


def played(path: Path) -> list[Image | Unreadable]:
    with opened(path) as source:
        return [item for item in iter(source.read, None) if isinstance(item, Image | Unreadable)]


@pytest.mark.parametrize("damaged", [[4], [0, 1, 8], [5, 6, 7]])
def test_what_comes_behind_damaged_packets_is_played(tmp_path: Path, damaged: list[int]) -> None:
    path = write_h264(tmp_path / "clip.mp4", "mp4", count=10, g="1", bf="0")
    whole = played(path)
    spoil(path, damaged)
    items = played(path)
    assert [item.index for item in items] == list(range(10))
    assert [item.index for item in items if isinstance(item, Unreadable)] == damaged
    for item in items:
        if isinstance(item, Image):
            assert item.stamp_ns == whole[item.index].stamp_ns


def test_nothing_but_damage_is_no_video(tmp_path: Path) -> None:
    path = write_h264(tmp_path / "clip.mp4", "mp4", count=10, g="1", bf="0")
    spoil(path, list(range(10)))
    with pytest.raises(SourceError, match=r"no readable frame: .* does not decode 'h264' here"):
        played(path)


def spoil(path: Path, packets: list[int]) -> None:
    """Overwrites what these packets hold."""
    import av

    with av.open(str(path)) as container:
        sizes = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    data = bytearray(path.read_bytes())
    for begin, size in (sizes[k] for k in packets):
        data[begin : begin + size] = b"\xff" * size
    path.write_bytes(data)


@pytest.mark.parametrize("content", [b"", b"no video", b"RIFF\x10\0\0\0AVI LIST", b"\0" * 500])
def test_what_is_no_video(tmp_path: Path, content: bytes, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "clip.avi"
    path.write_bytes(content)
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    with pytest.raises(SourceError, match=r"clip\.avi"), opened(path):
        pass
    assert capfd.readouterr().err == "", "FFmpeg's own words are nothing to a user"


def interlaced(path: Path, flags: str) -> Path:
    av = pytest.importorskip("av", reason="OpenCV can't write interlaced films")
    tiny.write_video(path.with_name("beside.avi"))  # and the camera file
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg2video", rate=25, options={"flags": flags} if flags else {})
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for i in range(20):
            frame = av.VideoFrame.from_ndarray(tiny.picture(i % 8), format="bgr24").reformat(format="yuv420p")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("flags", ["+ildct+ilme", ""])
def test_an_interlaced_film_of_which_opencv_shows_nothing_is_said(
    flags: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with opened(interlaced(tmp_path / "clip.mkv", flags)) as source:
        item, later = source.read(), source.read()
    assert isinstance(item, Image)
    assert isinstance(later, Image)
    # Some releases of OpenCV convert them.
    assert ("interlaced" in caplog.text) == np.array_equal(item.pixels, later.pixels)
    assert flags or "interlaced" not in caplog.text
