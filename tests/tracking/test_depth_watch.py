"""What makes a camera that tracks well say that it is degraded."""

from __future__ import annotations

from prism_edge.tracking.depth_watch import MOST_REFUSED, MUTE, REFUSED, SILENT_NS, DepthWatch

NAN = float("nan")


def test_depth_that_comes_is_no_trouble() -> None:
    watch = DepthWatch()
    for k in range(10):
        watch.keyframe(k, k * SILENT_NS)
        assert watch.trouble(k * SILENT_NS) == ""
        watch.depth(k, True, "")
        watch.scale(k, 0.1, True)
    assert watch.trouble(100 * SILENT_NS) == "", "a camera that makes no keyframe waits for none"


def test_silence_is_told_once_it_is_long_and_forgotten_with_the_next_depth() -> None:
    watch = DepthWatch()
    watch.keyframe(3, 1_000_000_000)
    watch.keyframe(4, 2_000_000_000)
    assert watch.trouble(1_000_000_000 + SILENT_NS) == ""
    assert watch.trouble(2_000_000_000 + SILENT_NS) == "no depth for 6 s"
    watch.depth(4, True, "")  # the newest picture won: 3 has no answer to come
    assert watch.trouble(9_000_000_000) == ""


def test_days_without_depth_cost_nothing_and_are_told_from_their_beginning() -> None:
    watch = DepthWatch()
    for number in range(5000):
        watch.keyframe(number, number * 1_000_000_000)
    assert len(watch._waiting) <= 64
    assert watch.is_waiting(4999)
    assert watch.trouble(5000 * 1_000_000_000) == "no depth for 5000 s"
    watch.depth(4999, True, "")
    assert watch.trouble(5000 * 1_000_000_000) == ""


def test_a_later_keyframe_is_not_answered_by_an_earlier_depth() -> None:
    watch = DepthWatch()
    watch.keyframe(3, 0)
    watch.keyframe(4, 0)
    watch.depth(3, True, "")
    assert watch.trouble(2 * SILENT_NS) == "no depth for 10 s"


def test_unusable_depth_is_told_with_its_reason_until_a_usable_one_comes() -> None:
    watch = DepthWatch()
    watch.depth(0, False, "the depth map is constant (2 m)")
    assert watch.trouble(0) == "no usable depth: the depth map is constant (2 m)"
    watch.depth(1, True, "")
    assert watch.trouble(0) == ""


def test_one_outlier_is_none_several_are_trouble_for_as_long_again() -> None:
    watch = DepthWatch()
    for number in range(REFUSED - 1):
        watch.scale(number, 2.3, False)
    assert watch.trouble(0) == ""
    watch.scale(REFUSED - 1, NAN, False)  # a keyframe without an observation says nothing
    assert watch.trouble(0) == ""
    watch.scale(REFUSED, 2.3, False)
    for number in range(REFUSED):
        assert watch.trouble(0) == "depth contradicts the scale"
        watch.scale(REFUSED + 1 + number, 2.3, True)
    assert watch.trouble(0) == ""


def test_however_long_it_was_contradicted_ten_that_agree_are_enough() -> None:
    watch = DepthWatch()
    for number in range(100):
        watch.scale(number, 2.3, False)
    for number in range(MOST_REFUSED):
        assert watch.trouble(0) == "depth contradicts the scale"
        watch.scale(100 + number, 2.3, True)
    assert watch.trouble(0) == ""


def test_depth_that_never_tells_the_scale_is_trouble_until_it_does() -> None:
    watch = DepthWatch()
    for number in range(MUTE):
        assert watch.trouble(number) == ""
        watch.depth(number, True, "")
        watch.scale(number, NAN, False)
    assert watch.trouble(MUTE) == "too few points have depth that tells the scale, in 10 keyframes"
    watch.scale(MUTE, 0.1, True)
    assert watch.trouble(MUTE) == ""


def test_keyframes_that_a_slow_network_leaves_without_depth_are_not_called_mute() -> None:
    watch = DepthWatch()
    for number in range(11 * MUTE):
        if number % 10 == 0:
            watch.depth(number, True, "")
        watch.scale(number, NAN, False)
        assert (watch.trouble(0) == "") == (number < 10 * (MUTE - 1))


def test_unusable_depth_is_not_held_against_the_usable_that_comes_after() -> None:
    """It could tell no scale: that says nothing of how many points have depth."""
    watch = DepthWatch()
    for number in range(2 * MUTE):
        watch.depth(number, False, "the depth map is constant (2 m)")
        watch.scale(number, NAN, False)
    watch.depth(2 * MUTE, True, "")
    assert watch.trouble(0) == ""


def test_a_map_that_stays_as_it_is_waits_for_no_depth() -> None:
    watch = DepthWatch()
    watch.keyframe(1, 0)
    for number in range(2, MUTE + 2):
        watch.depth(number, True, "")
        watch.scale(number, NAN, False)
    watch.depth(MUTE + 2, False, "dark")
    watch.keyframe(MUTE + 3, 0)
    assert watch.trouble(2 * SILENT_NS)
    watch.rest()
    assert watch.trouble(2 * SILENT_NS) == ""


def test_but_its_scale_may_be_wrong() -> None:
    watch = DepthWatch()
    for number in range(5):
        watch.scale(number, 0.8, False)
    watch.rest()
    assert watch.trouble(0) == "depth contradicts the scale"
