"""A camera whose lens the backend has found: the tracker's map and its next frames are seen through it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.geometry.cameras import FISHEYE
from prism_edge.messages import OK
from prism_edge.tracking import tracker
from prism_edge.tracking.announcement import keyframe_message
from prism_edge.tracking.map_correction import flaw
from tests.synthetic.messages import map_update
from tests.tracking.film_run import BLACK, Run
from tests.tracking.footage import footage, other_room


@pytest.fixture
def run() -> Run:
    made = Run()
    made.play(range(30))
    return made


def test_keyframes_and_frames_are_seen_through_it(run):
    world, given = run.tracker.world, footage().camera
    lens = given.bent(-0.01)
    before = {k.id: k.features.pixels.copy() for k in world.keyframes.values()}
    run.tracker.apply_update(map_update(max(world.keyframes), camera=lens.to_array()))
    for keyframe in world.keyframes.values():
        assert keyframe.camera == lens
        np.testing.assert_allclose(
            given.undistort_pixels(lens.distort_pixels(keyframe.features.pixels)),
            before[keyframe.id],
            atol=1e-6,
        )
    run.play(range(30, 60))
    assert all(run.results[i].odometry == OK for i in range(30, 60))
    assert world.newest().index > 30
    assert world.newest().camera == lens
    assert keyframe_message(run.tracker, world.newest()).camera.tolist() == lens.to_array().tolist()


def test_one_of_another_camera_changes_nothing(run):
    world, given = run.tracker.world, footage().camera
    other = replace(given, fx=1.1 * given.fx).bent(-0.01)
    run.tracker.apply_update(map_update(max(world.keyframes), camera=other.to_array()))
    run.play(range(30, 60))
    assert {k.camera for k in world.keyframes.values()} == {given}


def test_a_map_whose_newest_keyframe_is_another_camera_s_still_knows_it(run, monkeypatch):
    """As one that was gone on with by another camera, or that another one is only localised in."""
    world, given = run.tracker.world, footage().camera
    lens, other = given.bent(-0.01), replace(given, fx=1.1 * given.fx)
    newest, ids = world.newest(), max(world.keyframes)
    run.tracker.apply_update(map_update(ids, camera=lens.to_array()))
    newest.camera = other
    run.tracker.apply_update(map_update(ids, sequence=2, camera=other.to_array()))
    seen, view = [], tracker.View
    monkeypatch.setattr(tracker, "View", lambda camera, *rest: (seen.append(camera), view(camera, *rest))[1])
    run.play(range(30, 31))
    run.tracker.adopt(world, run.tracker.places.index, run.tracker.parts, run.tracker.epoch, 0.0)
    run.play(range(31, 32))
    assert seen == [lens, lens]


@pytest.mark.parametrize("way", ["reset", "lost while it was young", "contradicted"])
def test_a_new_map_begins_with_what_the_camera_file_says(way, monkeypatch):
    given, run = footage().camera, Run()
    run.play(range(20))
    run.tracker.apply_update(
        map_update(max(run.tracker.world.keyframes), camera=given.bent(-0.01).to_array())
    )
    if way == "reset":
        run.tracker.reset()
        run.play(range(20, 30))
    elif way == "contradicted":
        monkeypatch.setattr(tracker, "is_contradicted", lambda *_: run.tracker.epoch == 0)
        run.play(range(20, 60))
    else:
        for i in range(20, 32):
            run.feed(0, BLACK, at=i)
        for i in range(32, 60):
            run.feed(0, other_room(1)[0][0], at=i)
    assert run.tracker.epoch == 1
    assert {k.camera for k in run.tracker.world.keyframes.values()} == {given}


def test_an_update_without_a_camera_leaves_it(run):
    lens = footage().camera.bent(-0.01)
    world = run.tracker.world
    run.tracker.apply_update(map_update(max(world.keyframes), camera=lens.to_array()))
    run.tracker.apply_update(map_update(max(world.keyframes), sequence=2))
    assert world.newest().camera == lens


@pytest.mark.parametrize("camera", [[640.0, 480.0], [640.0, 480.0, -1.0, 500.0, 320.0, 240.0], [np.nan] * 6])
def test_a_camera_that_is_none_makes_an_update_unusable(camera):
    assert flaw(map_update(0)) == ""
    assert "camera" in flaw(map_update(0, camera=np.array(camera)))


@pytest.mark.parametrize("readout_ms", [np.nan, np.inf, -100.1])
def test_an_update_with_a_readout_that_is_none_is_refused(readout_ms):
    assert "readout" in flaw(map_update(0, readout_ms=readout_ms))
    assert flaw(map_update(0, readout_ms=-100.0)) == ""


@pytest.mark.parametrize(
    ("units", "said"), [([0.1], "two numbers"), ([0.1, np.nan], "finite"), ([-800.0, 0.1], "sizes that")]
)
def test_an_update_whose_units_are_none_is_not_usable(units, said):
    assert said in flaw(map_update(0, loop_units=np.array(units)))
    assert flaw(map_update(0, loop_units=np.array([0.1, 0.01]))) == ""


def test_a_fisheye_is_no_other(run):
    given = footage().camera
    assert not given.bent(0.01).like(replace(given, model=FISHEYE))
