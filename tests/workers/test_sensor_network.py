"""`--model sensor`: an RGB-D recording's own depth in a network's place."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from prism_edge.config import SENSOR, Config, DepthConfig, SourceConfig
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import KeyframeImage
from prism_edge.sources.open import open_source
from prism_edge.sources.sensor_depth import seen_by_colour
from prism_edge.sources.sim import SimSource
from prism_edge.tracking.seeding import sample_depth
from prism_edge.workers.depth import answer
from prism_edge.workers.sensor_network import SensorNetwork, open_depth
from tests.sources import tiny_datasets as tiny

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def write_depth(folder: Path, stamp: str, depth: np.ndarray) -> None:
    tiny.write_image(folder / "depth" / f"{stamp}.png", np.round(depth * 5000).astype(np.uint16))
    with (folder / "depth.txt").open("a") as lines:
        lines.write(f"{stamp} depth/{stamp}.png\n")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Four colour images; the first's depth is of half its size, the third's is flat, the last has none."""
    folder = tiny.write_tum(tmp_path / "tum", count=4)
    stamps = [line.split()[0] for line in (folder / "rgb.txt").read_text().splitlines()[2:]]
    x = np.mgrid[0:24, 0:32][1]
    write_depth(folder, stamps[0], 1.0 + 0.01 * (2 * x + 0.5))  # 1 + 0.01 x in the colour image's pixels
    write_depth(folder, stamps[1], 2.0 + 0.01 * np.mgrid[0:48, 0:64][0])
    write_depth(folder, stamps[2], np.full((48, 64), 2.0))
    return folder


def picture(index: int) -> KeyframeImage:
    image = np.zeros((48, 64), np.uint8)
    return KeyframeImage(7, index, 0, 0, False, CAMERA.model, CAMERA.to_array(), image)


def open_sensor(folder: Path | str, **source: Any) -> SensorNetwork:
    network = open_depth(
        Config(source=SourceConfig(uri=str(folder), **source), depth=DepthConfig(model=SENSOR))
    )
    assert isinstance(network, SensorNetwork)
    return network


def test_a_keyframe_gets_its_own_depth_image_and_the_name_says_what_it_is(folder: Path, caplog) -> None:
    network = open_sensor(folder)
    assert "not monocular" in caplog.text
    for index, depth_of in ((0, lambda x, y: 1.0 + 0.01 * x), (1, lambda x, y: 2.0 + 0.01 * y)):
        depth = answer(network, picture(index))
        assert depth.valid
        assert "not monocular" in depth.model
        assert depth.keyframe == 7
        assert 0 < depth.bias_sigma < 0.02
        assert 0 < depth.frame_sigma < 0.05
        pixels = np.array([[10.0, 7.0], [40.0, 30.0], [55.0, 12.0]])
        good, metres = sample_depth(depth.depth, depth.image_to_depth, pixels)
        assert good.all()
        np.testing.assert_allclose(metres, depth_of(pixels[:, 0], pixels[:, 1]), atol=0.011)


def test_an_image_without_depth_or_with_a_flat_one_is_answered_as_unusable(folder: Path) -> None:
    network = open_sensor(folder)
    for index in (2, 3):
        depth = answer(network, picture(index))
        assert not depth.valid
        assert depth.reason


def test_a_recording_played_again_counts_on(folder: Path) -> None:
    network = open_sensor(folder)
    np.testing.assert_array_equal(answer(network, picture(1)).depth, answer(network, picture(9)).depth)


def test_the_beginning_of_a_recording_played_again_counts_on(folder: Path) -> None:
    """The source begins again after its first two images, and so does depth."""
    played = open_source(SourceConfig(uri=str(folder), frames=2, loop=True))
    network = open_sensor(folder, frames=2, loop=True)
    with played:
        shown = [played.read() for _ in range(6)]
    assert [image.index for image in shown] == list(range(6))
    for image in shown:
        np.testing.assert_array_equal(image.pixels, shown[image.index % 2].pixels)
        of_it = answer(network, picture(image.index)).depth
        np.testing.assert_array_equal(of_it, answer(network, picture(image.index % 2)).depth)
    assert answer(network, picture(2)).depth.shape != answer(network, picture(3)).depth.shape


def test_what_has_no_depth_images_is_refused_in_one_line(tmp_path: Path) -> None:
    plain = tiny.write_images(tmp_path / "plain")
    video = tiny.write_video(tmp_path / "video" / "v.avi")
    network = "rtsp://me:secret@camera/live"
    for uri in (plain, video, tmp_path / "none", "v4l2:/dev/video0", network, ""):
        with pytest.raises(ModelError, match="needs a recording with depth images") as error:
            open_sensor(uri)
        assert "\n" not in str(error.value)
        assert "secret" not in str(error.value)


def test_seven_scenes_depth_is_put_where_the_colour_camera_sees_it() -> None:
    """A slanted plane, 0.2 x + z = 2 in the depth camera, and a near square before it."""
    height, width = 240, 320
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    rays = np.stack([(2 * u + 0.5 - 320) / 585, (2 * v + 0.5 - 240) / 585], axis=-1)
    depth = 2.0 / (1.0 + 0.2 * rays[..., 0])
    square = (np.abs(rays) < 0.1).all(axis=-1)
    depth[square] = 1.0
    colour = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
    seen = seen_by_colour(depth.astype(np.float32), colour)
    assert seen.shape == depth.shape
    seen_rays = np.stack([(2 * u + 0.5 - 320) / 525, (2 * v + 0.5 - 240) / 525], axis=-1)
    # The same plane from 25 mm to the right: 0.2 (x + 0.025) + z = 2; the square moves left and up.
    plane = (2.0 - 0.2 * 0.025) / (1.0 + 0.2 * seen_rays[..., 0])
    middle = seen_rays + np.array([0.025, 0.005])
    inner, outer = (np.abs(middle) < 0.095).all(axis=-1), (np.abs(middle) > 0.13).any(axis=-1)
    np.testing.assert_allclose(seen[inner], 1.0)
    away = outer & (seen > 0) & (np.abs(seen_rays[..., 0]) < 0.45) & (np.abs(seen_rays[..., 1]) < 0.35)
    assert away.sum() > 0.5 * seen.size  # all that is left there, but for the square and its shadow
    np.testing.assert_allclose(seen[away], plane[away], rtol=2e-3)


@pytest.mark.parametrize("row", [300, 301])
def test_a_point_of_seven_scenes_lands_in_the_pixel_that_sees_it(row: int) -> None:
    """400, 300 at 2 m is at (0.2735, 0.2051) m; from (25, 5) mm aside that is at 385.23, 292.53.

    One row further down it is at 293.43: half a pixel too much or too little is seen in one of them.
    """
    depth = np.zeros((480, 640), np.float32)
    depth[row, 400] = 2.0
    seen = seen_by_colour(depth, Camera(640, 480, 525.0, 525.0, 320.0, 240.0))
    assert np.argwhere(seen).tolist() == [[293, 385]]
    assert seen[293, 385] == 2.0


def test_the_colour_views_first_row_and_column_are_seen_too() -> None:
    """At 1 m, a pixel of depth is one of colour: it moves by 585 times (25, 5) mm, 14.6 and 2.9 pixels."""
    colour = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
    seen = seen_by_colour(np.ones((480, 640), np.float32), colour)
    assert seen[:470, :620].all()
    assert not seen[:, 630:].any()  # beyond what the depth camera sees


def test_invalid_pixels_stay_without_depth() -> None:
    colour = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
    assert not seen_by_colour(np.zeros((24, 32), np.float32), colour).any()


def test_a_simulated_world_gives_its_exact_depth(caplog) -> None:
    uri = "sim:room?seed=2&frames=4&width=64&height=48"
    network = open_sensor(uri)
    assert "simulator" in caplog.text
    assert "not monocular" in caplog.text
    with SimSource(uri) as source:
        camera = source.camera
        for index in (3, 4, 9):  # looped: it begins again after four
            image = np.zeros((48, 64), np.uint8)
            shown = KeyframeImage(7, index, 0, 0, False, camera.model, camera.to_array(), image)
            depth = answer(network, shown)
            assert depth.valid
            pixels = np.array([[10.0, 7.0], [40.0, 30.0], [55.0, 12.0]])
            good, metres = sample_depth(depth.depth, depth.image_to_depth, pixels)
            exact = source.depth(index % 4)
            assert good.all()
            assert metres == pytest.approx([exact[int(y), int(x)] for x, y in pixels], rel=1e-5)


def test_an_address_that_is_no_world_is_one_line_that_says_so() -> None:
    with pytest.raises(ModelError, match="castle") as caught:
        open_sensor("sim:castle")
    assert "\n" not in str(caught.value)
