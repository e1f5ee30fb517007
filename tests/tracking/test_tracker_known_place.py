"""In a known place the tracker goes by the keyframes that there are."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.tracking.frame_tracking import FrameTracker
from prism_edge.tracking.keyframe_culling import drop_keyframe
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.point_table import Ids
from prism_edge.tracking.tracker import REFRESH_FRAMES, Tracker
from tests.tracking.cloud import check
from tests.tracking.film_run import CONFIG, Run
from tests.tracking.footage import footage

QUICK = replace(CONFIG, keyframe_min_s=0.05, keyframe_max_s=0.2)
FRAMES = 75
THERE, BACK = list(range(FRAMES)), list(range(FRAMES - 2, -1, -1))


def played(*ways: list[int]) -> Iterator[Run]:
    """The film one way after the other; the run as it is after each."""
    run, at = Run(Tracker(QUICK)), 0
    for way in ways:
        for i in way:
            known = set(run.keyframes)
            run.feed(i, at=at)
            at += 1
            for k in set(run.keyframes) - known:
                run.depth(k, of=i)
        yield run


def there_and_back() -> tuple[Run, list[int]]:
    """The film there and back twice; how many keyframes there were after each way."""
    counts = []
    for run in played(THERE, BACK, THERE[1:], BACK):
        counts.append(len(run.keyframes))
    return run, counts


@pytest.fixture(scope="module")
def known() -> tuple[Run, list[int]]:
    return there_and_back()


def test_a_known_place_makes_few_new_keyframes(known, monkeypatch):
    run, counts = known
    check(run.tracker.world)
    monkeypatch.setattr("prism_edge.tracking.tracker.shown_before", lambda *_: None)
    _, otherwise = there_and_back()
    assert counts[0] == otherwise[0]  # all of it was new
    assert counts[3] - counts[1] <= 0.7 * (otherwise[3] - otherwise[1])


def test_a_camera_that_stays_makes_its_map_no_larger(monkeypatch):
    """Known places get keyframes even so, here every half second; each goes once it is no longer recent."""
    monkeypatch.setattr("prism_edge.tracking.keyframe_decision.KNOWN_S", 0.5)
    made, kept, standing = [], [], set()
    for run in played(*(THERE, BACK) * 3):
        made.append(len(run.keyframes))
        standing |= {k for k, keyframe in run.tracker.world.keyframes.items() if keyframe.stands_in}
        kept.append(len(run.tracker.world.keyframes))
    assert made[5] - made[2] >= 8
    assert kept[5] <= kept[2] + 1
    assert min(standing) >= made[0], "on the first way all was new"
    assert len([k for k in standing if k >= made[2]]) >= 0.8 * (made[5] - made[2])
    check(run.tracker.world)
    last = max(run.results)
    last_way = [(run.results[last - i].world_from_camera, footage().poses[i]) for i in THERE]
    assert max(np.linalg.norm((pose - true)[:3, 3]) for pose, true in last_way) < 0.04


def test_poses_are_as_good_and_hang_on_older_keyframes(known):
    run, _ = known
    world, last = run.tracker.world, max(run.results)
    assert run.results[last].reference < world.newest().id - 5
    for at, of in ((last, BACK[-1]), (last - 30, BACK[-31])):
        result = run.results[at]
        assert np.linalg.norm((result.world_from_camera - footage().poses[of])[:3, 3]) < 0.04
    result = run.results[last]
    carried = world.keyframes[result.reference].world_from_camera @ result.reference_from_camera
    assert carried == pytest.approx(result.world_from_camera, abs=1e-9)


def test_the_keyframe_that_frames_hang_on_may_go() -> None:
    run, _ = there_and_back()
    last = max(run.results)
    gone = run.results[last].reference
    drop_keyframe(run.tracker.world, run.tracker.world.keyframes[gone])
    newest = run.tracker.world.newest().id
    result = run.feed(BACK[-1], at=last + 1)
    assert result.reference == newest
    assert result.world_from_camera == pytest.approx(run.results[last].world_from_camera, abs=0.01)


def test_where_the_map_is_only_localised_in_the_camera_still_comes_to_its_older_keyframes() -> None:
    run = Run(Tracker(QUICK))
    for i in THERE:
        known = set(run.keyframes)
        run.feed(i)
        for k in set(run.keyframes) - known:
            run.depth(k, of=i)
    tracker, made = run.tracker, dict(run.keyframes)
    tracker.may_map = False
    for at, i in enumerate(BACK, start=FRAMES):
        result = run.feed(i, at=at)
    assert run.keyframes == made
    here = tracker.world.keyframes[result.reference]
    assert here.id < tracker.world.newest().id - 5
    assert tracker.depth == pytest.approx(tracker.world.median_depth(here))
    away = np.linalg.norm((here.world_from_camera - result.world_from_camera)[:3, 3])
    newest = tracker.world.newest().world_from_camera
    assert away < 0.5 * np.linalg.norm((newest - result.world_from_camera)[:3, 3])


def test_what_is_looked_for_is_chosen_anew_where_no_keyframe_is_made_either(monkeypatch) -> None:
    """With a new keyframe it is, so a map that is only localised in would keep what was seen at first."""
    run, chosen = Run(Tracker(QUICK)), []
    run.play(range(20))
    run.tracker.may_map = False
    choose = FrameTracker.refresh_local_map

    def chosen_anew(self: FrameTracker, world: LocalMap, points: Ids) -> None:
        chosen.append(at)
        assert np.isin(points, run.tracker.last.points).all(), "by what is seen now"
        choose(self, world, points)

    monkeypatch.setattr(FrameTracker, "refresh_local_map", chosen_anew)
    for at in range(20, 60):
        run.feed(at)
    assert np.diff([19, *chosen, 60]).max() <= REFRESH_FRAMES + 1
