"""What loops tell the tracker, once and completely, and which witnesses they may call."""

from __future__ import annotations

from prism_edge.backend import loop_closing as module
from prism_edge.backend.loop_closing import PATIENCE, LoopCloser
from prism_edge.backend.loops import Loop
from prism_edge.backend.mapper import Mapper
from tests.backend.closing import CONFIG, two_parts, walk
from tests.backend.ring import Ring
from tests.tracking.cloud import pose_at


def test_what_loops_have_changed_is_told_once():
    """Told again a dropped observation would undo what was seen since."""
    loops = two_parts()
    mine = {keypoint: point for point, keypoint in loops._world.keyframes[100].observed.items()}
    assert loops._join(loops._world.keyframes[100], [(102, 1)]) == 1
    assert loops.take_changes().fused == [(mine[102], 1)]
    assert not loops.take_changes().fused


def test_the_tracker_hears_which_observations_an_adjustment_found_wrong():
    mapper = walk(Ring(), 8, places=False, mapper=Mapper(CONFIG, use_depth=False))
    world = mapper.world
    point = max(world.points, key=lambda p: len(world.points[p].keyframes))
    wrong = min(world.points[point].keyframes)
    pixels = world.keyframes[wrong].pixels.copy()
    pixels[world.keyframes[wrong].observed[point]] += 40.0
    world.keyframes[wrong].pixels = pixels
    mapper.loops.finish()
    while mapper.loops.unfinished:
        mapper.loops.adjust(1.0)
    assert point not in world.keyframes[wrong].observed
    assert (wrong, point) in mapper.loops.take_changes().dropped


def test_the_tracker_hears_what_a_keyframe_sees_of_the_other_end_besides():
    """Of its keypoints that showed nothing so far."""
    loops = two_parts()
    view = loops._world.keyframes[100]
    free = view.observed.pop(next(iter(view.observed)))
    assert loops._join(view, [(free, 3)]) == 1
    assert loops.take_changes().added == [(100, 3, free)]
    assert loops._world.points[3].keyframes >= {100}


def witnessed(loops: LoopCloser, query: int, candidate: int = 0, aside: float = 0.1) -> bool:
    """Whether a loop is believed that one neighbour confirms, and who came before it."""
    there = pose_at(0.0, aside) @ loops._world.keyframes[query].world_from_camera
    return loops._confirmed(Loop(query, candidate, there, 1.0, 0.01, 50, 1, []))


def test_two_places_that_one_view_looks_like_do_not_vouch_for_each_other():
    loops = two_parts()
    assert not witnessed(loops, 100, 0)
    assert not witnessed(loops, 100, 1)
    assert witnessed(loops, 101, 0)


def test_all_that_came_shortly_before_may_vouch_and_not_the_last_alone():
    loops = two_parts()
    assert not witnessed(loops, 100)
    assert not witnessed(loops, 101, aside=3.0)
    assert witnessed(loops, 102)


def test_a_witness_that_was_culled_meanwhile_says_nothing():
    loops = two_parts()
    assert not witnessed(loops, 100)
    del loops._world.keyframes[100]
    assert not witnessed(loops, 101)


def test_a_loop_that_no_pose_graph_takes_changes_nothing(monkeypatch):
    loops = two_parts()
    monkeypatch.setattr(module.pose_graph, "spread", lambda *_: None)
    there = loops._world.keyframes[102].world_from_camera
    assert not loops._close(Loop(102, 0, there, 1.0, 0.01, 50, 2, [(102, 1)]))
    assert not loops.accepted
    assert not loops.take_changes().fused
    assert not loops.unfinished


def test_a_lens_that_gtsam_can_not_even_begin_to_look_for_is_not_looked_for_again_at_once(
    monkeypatch, caplog
):
    """With the same map: what waits for the end of all adjustments would wait for ever."""

    def indeterminate(*_: object) -> None:
        raise RuntimeError("Indeterminant linear system detected")

    loops = walk(Ring(), 12, places=False, mapper=Mapper(CONFIG, use_depth=False)).loops
    assert loops.adjusting, "a lens is due"
    monkeypatch.setattr(module, "GlobalAdjustment", indeterminate)
    for _ in range(3):
        if loops.adjusting:
            loops.adjust(1.0)
    assert not loops.adjusting
    assert caplog.text.count("no global adjustment") == 1


def test_a_loop_is_no_witness_for_one_much_later():
    """The same look-alike comes again on each round: what was not believed then says nothing now."""
    for later, believed in ((PATIENCE, True), (PATIENCE + 1, False)):
        loops = two_parts()
        world, back = loops._world, pose_at(0.0, 0.1)
        poses = {k: world.keyframes[k].world_from_camera for k in (100, 103)}
        world.keyframes[100 + later] = world.keyframes[103]
        one = Loop(100, 0, back @ poses[100], 1.0, 0.01, 50, 1, [])
        other = Loop(100 + later, 0, back @ poses[103], 1.0, 0.01, 50, 1, [])
        assert not loops._confirmed(one)
        assert loops._confirmed(other) == believed


def test_loops_are_tried_where_most_agrees_first(monkeypatch):
    """One is taken for each keyframe: the others of it are not looked at again."""
    loops = two_parts()
    there = loops._world.keyframes[103].world_from_camera
    monkeypatch.setattr(module, "candidates", lambda *_: [0, 1, 2])
    monkeypatch.setattr(module, "half_known", lambda *_: [])
    agree = {0: 31, 1: 200, 2: 90}
    monkeypatch.setattr(
        module, "verify", lambda _w, query, k, *_: Loop(query, k, there, 1.0, 0.01, agree[k], 2, [])
    )
    assert [loop.candidate for loop in loops._verified(103)] == [1, 2, 0]
