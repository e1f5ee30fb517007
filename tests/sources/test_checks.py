"""What is released, what is refused, and what is counted."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sources.tiny_datasets import picture

from prism_edge.bus import ros
from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.base import Image, Unreadable
from prism_edge.sources.checks import Counts, FrameChecks, check_camera_size

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)


def image(index: int, stamp_ns: int, seed: int | None = None, width: int = 64, colour: bool = True) -> Image:
    return Image(index, stamp_ns, picture(index if seed is None else seed, width, 48, colour))


def test_plain_images_are_released() -> None:
    checks = FrameChecks(CAMERA)
    verdicts = [checks.check(image(i, i)) for i in range(5)]
    assert all(v.released and not v.duplicate for v in verdicts)
    assert checks.counts == Counts(frames=5, released=5)


def test_exact_copies_are_flagged_and_released() -> None:
    checks = FrameChecks(CAMERA)
    verdicts = [checks.check(image(i, i, seed)) for i, seed in enumerate([1, 1, 1, 2, 1])]
    assert [v.duplicate for v in verdicts] == [False, True, True, False, False]
    assert all(v.released for v in verdicts)
    assert checks.counts == Counts(frames=5, released=5, duplicates=2)


def test_one_pixel_makes_it_another_image() -> None:
    checks = FrameChecks(CAMERA)
    checks.check(image(0, 0))
    other = picture(0)
    other[47, 63, 2] ^= 1
    assert not checks.check(Image(1, 1, other)).duplicate


def test_stamps_that_repeat_or_go_back_are_refused() -> None:
    checks = FrameChecks(CAMERA)
    verdicts = [checks.check(image(i, stamp)) for i, stamp in enumerate([10, 20, 20, 15, 30, -5, 31])]
    assert [v.released for v in verdicts] == [True, True, False, False, True, False, True]
    assert checks.counts == Counts(frames=7, released=4, bad_stamps=3)
    assert "repeats" in verdicts[2].reason
    assert "goes back" in verdicts[3].reason


def test_a_stamp_that_no_ros_message_holds_is_refused() -> None:
    checks, last = FrameChecks(CAMERA), 2**31 * 10**9 - 1
    verdicts = [checks.check(image(i, s)) for i, s in enumerate([-(2**31) * 10**9 - 1, 5, last + 1, last])]
    assert [v.released for v in verdicts] == [False, True, False, True]
    assert checks.counts == Counts(frames=4, released=2, bad_stamps=2)
    assert "image 2: its stamp 2147483648.000000 s is beyond" in verdicts[2].reason
    for stamp in (-(2**31) * 10**9, last):
        message = ros.pose_stamped(stamp, "map", np.eye(4))
        assert ros.stamp_ns(ros.deserialise(ros.TRUTH, ros.serialise(ros.TRUTH, message))) == stamp


def test_a_refused_image_leaves_no_trace() -> None:
    checks = FrameChecks(CAMERA)
    checks.check(image(0, 10, seed=1))
    checks.check(image(1, 5, seed=2))
    checks.check(Unreadable(2, 15, "broken"))
    checks.check(image(3, 20, seed=3, width=32))
    verdict = checks.check(image(4, 16, seed=1))  # after the stamp 10 of the last one released
    assert verdict.released
    assert verdict.duplicate


def test_the_wrong_size_midway_is_refused() -> None:
    checks = FrameChecks(CAMERA)
    assert checks.check(image(0, 0)).released
    verdict = checks.check(image(1, 1, width=32))
    assert not verdict.released
    assert "32x48" in verdict.reason
    assert "64x48" in verdict.reason
    assert checks.check(image(2, 2)).released
    assert checks.counts == Counts(frames=3, released=2, wrong_size=1)


def test_colour_may_change() -> None:
    checks = FrameChecks(CAMERA)
    assert checks.check(image(0, 0, seed=1)).released
    verdict = checks.check(image(1, 1, seed=1, colour=False))
    assert verdict.released
    assert not verdict.duplicate


def test_unreadable_and_late_images_are_counted() -> None:
    checks = FrameChecks(CAMERA)
    verdict = checks.check(Unreadable(0, 0, "a.png is missing"))
    assert not verdict.released
    assert verdict.reason == "a.png is missing"
    checks.late()
    assert checks.counts == Counts(frames=2, unreadable=1, skipped=1)
    assert checks.counts.unusable == 1


def test_the_first_images_size_must_be_the_cameras() -> None:
    check_camera_size(CAMERA, "camera.yaml", picture(0), "a.png")
    with pytest.raises(ConfigError, match=r"camera\.yaml.*64x48.*a\.png is 32x24"):
        check_camera_size(CAMERA, "camera.yaml", picture(0, 32, 24), "a.png")


items = st.tuples(st.integers(-3, 12), st.integers(0, 2), st.sampled_from(["image", "small", "broken"]))


@settings(max_examples=60, deadline=None)
@given(st.lists(items, max_size=30))
def test_every_image_is_counted_once_and_time_goes_on(sequence: list[tuple[int, int, str]]) -> None:
    checks = FrameChecks(CAMERA)
    released = []
    for index, (stamp, seed, kind) in enumerate(sequence):
        size = (48, 64) if kind == "image" else (24, 32)
        item = Image(index, stamp, np.full(size, seed, np.uint8))
        verdict = checks.check(Unreadable(index, stamp, "broken") if kind == "broken" else item)
        if verdict.released:
            released.append((stamp, seed, verdict.duplicate))
        else:
            assert verdict.kind
            assert verdict.reason
    counts = checks.counts
    assert counts.frames == len(sequence) == counts.released + counts.unusable + counts.skipped
    assert [s for s, _, _ in released] == sorted({s for s, _, _ in released})
    for (_, before, _), (_, now, duplicate) in pairwise(released):
        assert duplicate == (before == now)
