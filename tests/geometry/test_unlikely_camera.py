"""Which intrinsics are doubted, and that the cameras of the known datasets are not."""

from __future__ import annotations

from dataclasses import replace

import pytest

from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.geometry.unlikely_camera import doubts
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.known_cameras import BY_NAME, ROS_DEFAULT, SEVEN_SCENES

VGA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
KNOWN = {**BY_NAME, "7-Scenes": SEVEN_SCENES, "ROS": ROS_DEFAULT}


@pytest.mark.parametrize(("_", "camera"), KNOWN.values(), ids=KNOWN)
def test_published_cameras_are_not_doubted(_: str, camera: Camera) -> None:
    assert doubts(camera) == []


def test_nor_is_one_that_nobody_knows_yet() -> None:
    assert doubts(UNCALIBRATED) == []


def test_intrinsics_of_an_image_twice_as_large() -> None:
    first, second = doubts(replace(VGA, fx=1050.0, fy=1050.0, cx=639.5, cy=479.5))
    assert first == "cx 639.5 of a 640-wide image: are these intrinsics of a larger image?"
    assert second == "cy 479.5 of a 480-high image: are these intrinsics of a larger image?"


def test_intrinsics_of_a_smaller_image() -> None:
    assert doubts(replace(VGA, cx=159.5))[0].endswith("of another image?")


def test_a_fifth_of_the_image_off_its_middle_is_the_bound() -> None:
    assert doubts(replace(VGA, cx=319.5 + 127.9, cy=239.5 - 95.9)) == []
    assert len(doubts(replace(VGA, cx=319.5 + 128.1, cy=239.5 - 96.1))) == 2


def test_focal_lengths_that_differ() -> None:
    assert doubts(replace(VGA, fx=525.0, fy=501.0)) == []
    (line,) = doubts(replace(VGA, fx=525.0, fy=700.0))
    assert line.startswith("fx 525 and fy 700 differ by 25 %")


def test_a_lens_that_folds_over_in_more_than_a_hundredth_of_the_image() -> None:
    wide = replace(VGA, fx=400.0, fy=400.0, distortion=(-0.3, 0.1, 1e-3, -2e-3, -0.02))
    (line,) = doubts(wide)
    assert line.startswith("its lens folds over in 2.3% of the image, where nothing is tracked")
    assert doubts(replace(wide, fx=420.0, fy=420.0)) == []  # 0.7 %
    assert doubts(replace(wide, model=FISHEYE, distortion=wide.distortion[:4])) == []


def test_a_fisheye_that_folds_over_is_doubted_and_one_of_half_a_sphere_is_not() -> None:
    folds = replace(VGA, fx=200.0, fy=200.0, model=FISHEYE, distortion=(-0.02, -0.01, 0.0, -0.02))
    (line,) = doubts(folds)
    assert line.startswith("its lens folds over in ")
    assert "model: fisheye" not in line
    assert doubts(replace(folds, fx=150.0, fy=150.0, distortion=(-0.01, 0.0, 0.0, 0.0))) == []
