"""What a map knows of a camera's lens, whoever made its newest keyframe."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.tracking.found_lens import found_lens, in_found_lens
from tests.backend.world import Teller
from tests.tracking.cloud import CAMERA, pose_at

FOUND = CAMERA.bent(-0.08)
OTHER = replace(CAMERA, fx=1.2 * CAMERA.fx, fy=1.2 * CAMERA.fy)


@dataclass
class Made:
    camera: Camera


def made_by(*cameras: Camera) -> dict[int, Made]:
    return {10 * i: Made(camera) for i, camera in enumerate(cameras)}


def test_the_newest_keyframe_that_the_camera_may_have_made_tells_it() -> None:
    assert found_lens(made_by(CAMERA.bent(-0.05), FOUND), CAMERA) == FOUND
    assert found_lens(made_by(FOUND, OTHER), CAMERA) == FOUND
    assert found_lens(made_by(FOUND, OTHER), OTHER) == OTHER
    backwards = dict(reversed(made_by(CAMERA.bent(-0.05), FOUND).items()))
    assert found_lens(backwards, CAMERA) == FOUND


@pytest.mark.parametrize(
    "camera",
    [
        replace(CAMERA, width=CAMERA.width + 2),
        replace(CAMERA, model=FISHEYE, distortion=(0.01, 0.0, 0.0, 0.0)),
    ],
)
def test_a_camera_that_has_made_none_is_as_its_file_says(camera: Camera) -> None:
    assert found_lens(made_by(FOUND, OTHER), camera) == camera
    assert found_lens({}, camera) == camera


def test_what_was_found_last_is_looked_for_no_more_but_for_another_camera() -> None:
    assert found_lens({}, CAMERA, FOUND) == FOUND
    assert found_lens(made_by(CAMERA.bent(-0.05)), CAMERA, FOUND) == FOUND
    assert found_lens(made_by(FOUND, OTHER), CAMERA, OTHER) == FOUND


def test_a_message_s_keypoints_are_where_that_lens_has_them() -> None:
    message = Teller().keyframe(pose_at(0.0))
    seen = in_found_lens(message, made_by(FOUND, OTHER))
    assert seen.camera.tolist() == FOUND.to_array().tolist()
    raw = FOUND.distort_pixels(seen.pixels.astype(np.float64))
    np.testing.assert_allclose(CAMERA.undistort_pixels(raw), message.pixels, atol=1e-3)
    assert in_found_lens(message, made_by(OTHER)) is message
    assert in_found_lens(message, made_by(CAMERA)) is message
