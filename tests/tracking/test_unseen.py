"""What of the camera's way nobody saw, as poses come and don't."""

from __future__ import annotations

from prism_edge.messages import DEGRADED, INITIALISING, LOST
from prism_edge.tracking.submaps import HOME
from prism_edge.tracking.unseen import Sight, Unseen

SECOND = 1_000_000_000


def begun() -> Sight:
    """Seen until second 10, in map 0."""
    sight = Sight()
    sight.miss(INITIALISING)
    assert sight.see(0, HOME, 9 * SECOND, 10 * SECOND) == Unseen(), "a first map leaves nothing out"
    return sight


def test_frame_after_frame_all_is_seen():
    assert begun().see(0, HOME, 9 * SECOND, 11 * SECOND) == Unseen()


def test_a_blurred_frame_between_hides_nothing():
    sight = begun()
    sight.miss(DEGRADED)
    assert sight.see(0, HOME, 9 * SECOND, 11 * SECOND) == Unseen()


def test_found_in_the_same_map_the_way_is_known_and_the_speed_is_not():
    sight = begun()
    sight.miss(LOST)
    assert sight.see(0, HOME, 9 * SECOND, 30 * SECOND) == Unseen(lost=True)
    assert sight.see(0, HOME, 9 * SECOND, 31 * SECOND) == Unseen()


def test_however_the_frames_after_it_are_called_the_speed_is_not_known():
    sight = begun()
    for word in (LOST, DEGRADED):
        sight.miss(word)
    assert sight.see(0, HOME, 9 * SECOND, 30 * SECOND) == Unseen(lost=True)


def test_a_part_of_its_own_or_a_new_map_is_seen_from_its_first_keyframe_on():
    for epoch, part in ((0, 7), (1, HOME)):
        sight = begun()
        sight.miss(LOST)
        sight.miss(INITIALISING)
        assert sight.see(epoch, part, 14 * SECOND, 15 * SECOND) == Unseen(lost=True, unseen_s=4.0)
        assert sight.see(epoch, part, 14 * SECOND, 16 * SECOND) == Unseen()


def test_in_a_stored_map_the_way_is_seen_from_the_frame_that_was_found():
    sight = begun()
    sight.miss(LOST)
    assert sight.see(1, HOME, 2 * SECOND, 15 * SECOND) == Unseen(lost=True, unseen_s=5.0)


def test_a_part_that_gets_its_place_while_it_is_tracked_hides_nothing():
    sight = begun()
    sight.miss(LOST)
    sight.see(0, 7, 14 * SECOND, 15 * SECOND)
    assert sight.see(0, HOME, 14 * SECOND, 16 * SECOND) == Unseen()


def test_a_stored_map_s_keyframes_are_of_another_time():
    """Of a later one than this recording's, even: what was not seen is no longer than it was."""
    sight = begun()
    sight.miss(LOST)
    assert sight.see(5, HOME, 1_700_000_000 * SECOND, 12 * SECOND) == Unseen(lost=True, unseen_s=2.0)
