"""Frames in a finished map: at their keyframes, and between them."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.evaluation.carried import carried
from prism_edge.geometry.poses import Array, from_rt, inverse, se3_exp, so3_exp
from prism_edge.messages import OK, Tracked


def tracked(index: int, keyframe: int = -1, reference: int = 0, stamp_ns: int | None = None) -> Tracked:
    at = 10 * index if stamp_ns is None else stamp_ns
    return Tracked(index, at, 0, OK, True, keyframe, reference, np.eye(4))


def true_path(t: float) -> Array:
    """On a line, while it turns about the vertical."""
    return from_rt(so3_exp(np.array([0.0, 0.02 * t, 0.0])), np.array([0.1 * t, 0.03 * t, 0.0]))


@given(st.integers(0, 2**32 - 1))
def test_a_frame_that_became_a_keyframe_is_where_the_map_has_that(seed: int) -> None:
    rng = np.random.default_rng(seed)
    keyframes = {k: se3_exp(0.3 * rng.normal(size=6)) for k in range(4)}
    frames, offsets = [tracked(0, 0)], [np.eye(4)]
    for i in range(1, 20):
        frames.append(tracked(i, i // 5 if i % 5 == 0 else -1, (i - 1) // 5))
        offsets.append(se3_exp(0.1 * rng.normal(size=6)))
    placed = carried(frames, offsets, keyframes)
    for frame, pose in zip(frames, placed, strict=True):
        assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
        if frame.keyframe >= 0:
            assert np.array_equal(pose, keyframes[frame.keyframe])


def test_what_the_next_keyframe_had_drifted_by_is_shared_by_time() -> None:
    """Drift that grows with time is taken out of every frame before it, whatever gaps there are."""
    stamps = [0, 10, 20, 50, 60]
    keyframes = {0: true_path(0), 1: true_path(60)}
    drifted = [from_rt(np.eye(3), np.array([0.0, 0.0, 1e-3 * t])) @ true_path(t) for t in stamps]
    frames = [tracked(i, {0: 0, 4: 1}.get(i, -1), stamp_ns=t) for i, t in enumerate(stamps)]
    offsets = [inverse(keyframes[0]) @ pose for pose in drifted]
    for t, pose in zip(stamps, carried(frames, offsets, keyframes), strict=True):
        np.testing.assert_allclose(pose, true_path(t), atol=1e-12)


def test_frames_that_no_keyframe_follows_or_that_another_one_carries_stay_as_carried() -> None:
    keyframes = {0: true_path(0), 1: true_path(30), 5: true_path(3)}
    frames = [tracked(1), tracked(2, reference=5), tracked(3, 1, reference=5), tracked(4, reference=1)]
    offsets = [se3_exp(np.array([0.0, 0.1, 0.0, 0.0, 0.0, 0.1]))] * 4
    placed = carried(frames, offsets, keyframes)
    for i in (0, 3):
        np.testing.assert_allclose(placed[i], keyframes[frames[i].reference] @ offsets[i])
    assert not np.allclose(placed[1], keyframes[5] @ offsets[1], atol=1e-3)


def test_a_keyframe_that_the_map_no_longer_has_leads_nobody() -> None:
    keyframes, offset = {0: true_path(0)}, se3_exp(np.full(6, 0.1))
    placed = carried([tracked(0, 0), tracked(1), tracked(2, 9)], [np.eye(4), offset, offset], keyframes)
    for pose in placed[1:]:
        np.testing.assert_allclose(pose, keyframes[0] @ offset)


def test_a_copy_of_an_image_is_where_the_image_is() -> None:
    """Behind one that became a keyframe, and between two: a copy has its original's reference and place."""
    keyframes, offset = {0: true_path(0), 1: true_path(30)}, se3_exp(np.full(6, 0.1))
    frames = [tracked(0, 0), tracked(1), tracked(2), tracked(3, 1), tracked(4), tracked(5, reference=1)]
    offsets = [np.eye(4), offset, offset, se3_exp(np.full(6, 0.2)), se3_exp(np.full(6, 0.2)), offset]
    placed = carried(frames, offsets, keyframes)
    assert np.array_equal(placed[1], placed[2])
    assert np.array_equal(placed[3], placed[4])
    assert np.array_equal(placed[3], keyframes[1])
    assert not np.allclose(placed[5], placed[4], atol=1e-3)


def test_a_keyframe_whose_own_reference_is_gone_is_where_the_map_has_it() -> None:
    (pose,) = carried([tracked(3, 1, reference=7)], [se3_exp(np.full(6, 0.1))], {1: true_path(30)})
    assert np.array_equal(pose, true_path(30))
