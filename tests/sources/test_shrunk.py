"""Images made smaller as they come, and the camera that would have taken them."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from sources import tiny_datasets as tiny
from sources.live.bench import CAMERA, QUICK, Bench, picture, steady

from prism_edge.config import SourceConfig
from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources import Image, Source, Unreadable, open_source
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.live.camera import LiveCamera
from prism_edge.sources.live.driver import Grab
from prism_edge.sources.mask import mask_for, read_mask
from prism_edge.sources.shrunk import Shrunk, shrunk, shrunk_camera
from tests.waiting import until

LARGE = Camera(96, 72, 90.0, 91.0, 40.5, 37.25, distortion=(-0.2, 0.05, 0.001, -0.002), readout_ms=20.0)


def smaller(path: Path | str, **more: object) -> Source:
    return open_source(SourceConfig(uri=str(path), shrink=2, **more))  # type: ignore[arg-type]


def test_of_a_recording_each_image_is_the_mean_of_its_pixels(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path)
    with open_source(SourceConfig(uri=str(folder))) as whole, smaller(folder) as source:
        assert source.camera == shrunk_camera(whole.camera, 2)
        assert (source.camera.width, source.camera.height, source.camera.fx) == (32, 24, 30.0)
        assert (source.frame_count, source.period_ns) == (whole.frame_count, whole.period_ns)
        for _ in range(5):
            assert source.peek() == whole.peek()
            item, same = source.read(), whole.read()
            assert isinstance(item, Image)
            assert isinstance(same, Image)
            assert (item.index, item.stamp_ns) == (same.index, same.stamp_ns)
            means = same.pixels.reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
            np.testing.assert_allclose(item.pixels, means, atol=0.5)
        assert source.read() is None


def test_a_video_s_too(tmp_path: Path) -> None:
    video = tiny.write_video(tmp_path / "clip.avi", 5, 10.0)
    (tmp_path / "camera.yaml").write_text(tiny.CAMERA)
    with smaller(video, loop=True) as source:
        assert source.decodes_skipped
        assert source.period_ns == 100_000_000, "known once it is open"
        assert source.skip()
        for _ in range(5):
            item = source.read()
            assert isinstance(item, Image)
            assert item.pixels.shape == (24, 32, 3)
        assert item.index == 5
        assert source.leap(16) == 10, "whole rounds cost nothing"


def test_a_damaged_image_is_said_to_be_damaged(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path)
    tiny.truncate(sorted((folder / "rgb").iterdir())[1])
    with smaller(folder) as source:
        kinds = [type(source.read()) for _ in range(3)]
    assert kinds == [Image, Unreadable, Image]


def test_the_camera_file_is_for_the_images_as_they_come(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path)
    (folder / "camera.yaml").write_text("width: 32\nheight: 24\nfx: 30\nfy: 30\ncx: 15.5\ncy: 11.5\n")
    source = smaller(folder)
    with pytest.raises(ConfigError, match=r"is for 32x24 images, but .* is 64x48"):
        source.open()


def test_what_nobody_calibrated_stays_so(tmp_path: Path) -> None:
    """Whoever opens it gives it a camera, of the smaller images."""
    source = smaller(tiny.write_tum(tmp_path), camera="auto")
    assert source.camera is UNCALIBRATED
    source.camera = estimated = Camera(32, 24, 31.0, 31.0, 15.0, 12.0)
    with source:
        assert source.camera is estimated


def test_a_simulated_walk_keeps_its_poses() -> None:
    uri = "sim:room?frames=3&width=64&height=48"
    with smaller(uri) as source, open_source(SourceConfig(uri=uri)) as whole:
        assert source.synthetic
        np.testing.assert_array_equal(source.true_pose(2), whole.true_pose(2))
        assert source.name.endswith("1/2 of its size")


@given(
    factor=st.integers(2, 8),
    width=st.integers(90, 200),
    height=st.integers(70, 150),
    x=st.floats(-0.3, 0.3),
    y=st.floats(-0.3, 0.3),
)
def test_a_point_is_where_the_smaller_camera_sees_it(
    factor: int, width: int, height: int, x: float, y: float
) -> None:
    """Sizes that the factor doesn't divide, too: the corners of an image are still its corners."""
    camera = replace(LARGE, width=width, height=height, fx=1.1 * width, fy=1.1 * width)
    small = shrunk_camera(camera, factor)
    point = np.array([[x, y, 1.0]])
    # Counted from the image's corner all lengths go by one ratio.
    share = (camera.project(point) + 0.5) / (camera.width, camera.height)
    np.testing.assert_allclose((small.project(point) + 0.5) / (small.width, small.height), share, atol=1e-9)
    assert shrunk(np.zeros((height, width), np.uint8), factor).shape == (small.height, small.width)
    assert small.distortion == camera.distortion
    assert small.readout_ms == camera.readout_ms


@pytest.mark.parametrize("factor", [2, 3, 5])
def test_what_an_image_shows_is_where_the_camera_says(factor: int) -> None:
    """By a soft spot, whose middle can be told to a small part of a pixel; 5 divides no side."""
    camera = Camera(96, 72, 90.0, 90.0, 47.5, 35.5)
    x, y = np.meshgrid(np.arange(96.0), np.arange(72.0))
    at = camera.project(np.array([[0.12, -0.08, 1.0]]))[0]
    spot = 200.0 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * 5.0**2))
    small = shrunk(np.rint(spot).astype(np.uint8), factor).astype(float)
    rows, columns = np.indices(small.shape)
    middle = np.array([(small * columns).sum(), (small * rows).sum()]) / small.sum()
    seen = shrunk_camera(camera, factor).project(np.array([[0.12, -0.08, 1.0]]))[0]
    np.testing.assert_allclose(middle, seen, atol=0.03)


def test_a_live_camera_keeps_its_health_its_clock_and_its_stop() -> None:
    inner = LiveCamera(Bench(steady), CAMERA, "a test", QUICK)
    source = Shrunk(inner, 2)
    assert source.live
    assert source.connecting_s == inner.connecting_s > 0
    with source:
        item = until(lambda: found if isinstance(found := source.read(), Image) else None)
        assert item.pixels.shape == (24, 32, 3)
        assert item.captured_monotonic_ns > 0
        assert source.health()["camera"] == "streaming"
    waits = LiveCamera(Bench(lambda _: None), CAMERA, "a test", replace(QUICK, absent_s=60.0))
    stopped = threading.Event()
    stopped.set()
    source = Shrunk(waits, 2)
    source.stop_on(stopped)
    with pytest.raises(SourceError):
        source.open()


def test_a_camera_that_knows_its_lens_is_made_smaller_once_it_is_there() -> None:
    bench = Bench(steady)
    bench.intrinsics = CAMERA
    source = Shrunk(LiveCamera(bench, None, "its own", QUICK), 2)
    assert source.camera is UNCALIBRATED
    with source:
        assert source.camera == shrunk_camera(CAMERA, 2)


def test_an_estimated_camera_that_comes_back_in_another_size_is_said_to() -> None:
    def script(number: int) -> Grab:
        now, size = time.monotonic_ns(), ((64, 48) if number < 5 else (32, 24))
        time.sleep(0.002)
        return Grab(now, lambda: picture(number, *size))

    source = Shrunk(LiveCamera(Bench(script), UNCALIBRATED, "not calibrated", QUICK), 2)
    source.camera = shrunk_camera(CAMERA, 2)
    with source:
        said = until(lambda: source.read() and source.health().get("warning"))
    assert said == "the camera sends 32x24 instead of 64x48"


def test_an_image_of_nearly_the_same_size_is_refused(tmp_path: Path) -> None:
    """A third as large all of these are 21 x 16."""
    folder = tiny.write_tum(tmp_path)
    odd = sorted((folder / "rgb").iterdir())[2]
    tiny.write_image(odd, tiny.picture(2, 65, 50))
    with open_source(SourceConfig(uri=str(folder), shrink=3)) as source:
        items = [source.read() for _ in range(5)]
    assert [type(item) for item in items] == [Image, Image, Unreadable, Image, Image]
    assert isinstance(items[2], Unreadable)
    assert items[2].reason == "image 2 is 65x50 instead of 64x48"


def test_a_mask_is_drawn_over_the_images_as_they_come(tmp_path: Path) -> None:
    """And hides every smaller pixel that has some of what it hides."""
    pixels = np.full((48, 64), 255, np.uint8)
    pixels[31:, 11:40] = 0
    path = tmp_path / "mask.png"
    assert cv2.imwrite(str(path), pixels)
    shown = mask_for(path, 32, 24, shrink=2)
    hidden = np.zeros((24, 32), bool)
    hidden[15:, 5:20] = True
    np.testing.assert_array_equal(shown, ~hidden)
    np.testing.assert_array_equal(read_mask(path, 1), pixels > 0)
    with pytest.raises(ConfigError, match=r"is 16x12 after source\.shrink 4, but .* 32x24"):
        mask_for(path, 32, 24, shrink=4)
