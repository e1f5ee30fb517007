"""What the tracker says of a frame that has a place, and of one that has none."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.messages import DEGRADED, LOST, OK
from prism_edge.tracking.baseline import shift_as_turn
from prism_edge.tracking.frame_result import DEGRADED_MATCHES, beside, nothing
from prism_edge.tracking.frame_tracking import TrackedFrame
from tests.tracking.cloud import CAMERA, Cloud, pose_at


@pytest.mark.parametrize(("matched", "word"), [(DEGRADED_MATCHES, OK), (DEGRADED_MATCHES - 1, DEGRADED)])
def test_a_frame_is_told_beside_its_keyframe_with_all_that_is_doubtful_of_it(matched, word):
    reference, pose = Cloud(40).keyframe(7, pose_at(1.0, 0.2, 0.0, 0.1))[0], pose_at(1.3, 0.0, 0.4, 0.0, 0.2)
    features, covariance = reference.features, np.diag(np.arange(1.0, 7.0))
    points = np.where(features.pixels[:, 0] < 0.5 * CAMERA.width, np.arange(len(features)), -1)
    frame = TrackedFrame(CAMERA, features, pose, points, covariance, matched, 0.3, 4.0)
    said = beside(reference, frame, in_map=False)
    assert (said.odometry, said.matched, said.reference, said.in_map) == (word, matched, 7, False)
    assert (said.unobserved, said.parallax_deg) == (0.3, 4.0)
    # By what bears the pose, not by all that was found: a view of which half is masked is a narrow one.
    assert said.shift_as_turn == shift_as_turn(CAMERA, features.pixels[points >= 0])
    assert 1.0 > said.shift_as_turn > 1.1 * shift_as_turn(CAMERA, features.pixels)
    assert np.array_equal(said.covariance, covariance)
    assert reference.world_from_camera @ said.reference_from_camera == pytest.approx(pose, abs=1e-12)


def test_without_a_place_there_is_no_pose_and_no_keyframe():
    said = nothing(LOST)
    assert (said.odometry, said.world_from_camera, said.reference, said.matched) == (LOST, None, -1, 0)
