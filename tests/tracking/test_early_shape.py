"""A young map of the wrong one of the two motions that a plane allows: what lies off the plane tells."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest

from prism_edge.geometry.poses import from_rt, inverse, scaled
from prism_edge.messages import INITIALISING, OK
from prism_edge.tracking import tracker
from prism_edge.tracking.early_shape import MIN_PARALLAX_DEG, MIN_SHARED, YOUNG, is_contradicted
from prism_edge.tracking.frame_tracking import TrackedFrame
from prism_edge.tracking.local_map import NO_POINT, LocalMap
from prism_edge.tracking.submaps import Parts
from tests.tracking.cloud import CAMERA, Cloud, pose_at
from tests.tracking.film_run import CONFIG, Run
from tests.tracking.footage import footage

STEP = pose_at(0.3, 0.02, 0.01, 0.0, 0.02, 0.01)
NOISE_PX = 0.4


@dataclass
class Young:
    """Three keyframes close together, and a frame a step aside of them."""

    world: LocalMap
    frame: TrackedFrame

    def is_contradicted(self, parts: Parts | None = None) -> bool:
        return is_contradicted(self.world, parts or Parts(), self.frame, 0)


def a_map(moved: np.ndarray, relief: float = 0.05, seed: int = 1, parallax_deg: float = 4.0) -> Young:
    """Of a tilted plane that what is on it rises from by ``relief`` of its depth; said to have ``moved``."""
    cloud = Cloud(400, seed)
    rays = cloud.rng.uniform(-0.5, 0.5, (400, 2))
    depth = 4.0 / (1.0 + 0.9 * rays[:, 1]) * (1.0 + relief * cloud.rng.normal(size=400))
    cloud.positions = np.column_stack([rays * depth[:, None], depth])
    near = [pose_at(0.005 * k) for k in range(3)]
    world, shown = cloud.mapped(near, NOISE_PX, parallax_deg=parallax_deg)
    of_cloud = np.full(400, NO_POINT, np.int64)
    for keyframe, seen in zip(world.keyframes.values(), shown, strict=True):
        of_cloud[seen] = keyframe.points
    features, seen = cloud.view(STEP, NOISE_PX)
    points = of_cloud[seen]
    return Young(world, TrackedFrame(CAMERA, features, moved, points, np.eye(6), len(points)))


def motions(young: Young) -> tuple[np.ndarray, np.ndarray]:
    """The two motions (4, 4) that a plane allows, the one nearer to the truth first."""
    first, frame = young.world.keyframes[0], young.frame
    _, before, now = np.intersect1d(first.points, frame.points, return_indices=True)
    pixels = first.features.pixels[before], frame.features.pixels[now]
    homography, _ = cv2.findHomography(*pixels, cv2.RANSAC, 3.0)
    _, turns, ways, normals = cv2.decomposeHomographyMat(homography, CAMERA.matrix)
    allowed = [
        inverse(from_rt(turn, 4.0 * way.ravel()))
        for turn, way, normal in zip(turns, ways, normals, strict=True)
        if normal[2] > 0
    ]
    assert len(allowed) == 2
    true, wrong = sorted(allowed, key=lambda pose: float(np.linalg.norm(pose[:3, 3] - STEP[:3, 3])))
    return true, wrong


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("relief", [0.04, 0.08])
def test_a_map_of_the_other_motion_is_contradicted_and_the_true_one_is_not(relief: float, seed: int) -> None:
    young = a_map(STEP, relief, seed)
    true, wrong = motions(young)
    assert not young.is_contradicted()
    young.frame.world_from_camera = true
    assert not young.is_contradicted()
    young.frame.world_from_camera = wrong
    assert young.is_contradicted()


def test_of_a_plane_alone_both_fit_and_nothing_is_said() -> None:
    young = a_map(STEP, relief=0.0)
    for moved in motions(young):
        young.frame.world_from_camera = moved
        assert not young.is_contradicted()


def wrong_map(parallax_deg: float = 4.0) -> Young:
    young = a_map(STEP, parallax_deg=parallax_deg)
    young.frame.world_from_camera = motions(young)[1]
    return young


def test_from_too_near_nothing_is_said() -> None:
    assert wrong_map(MIN_PARALLAX_DEG + 0.1).is_contradicted()
    assert not wrong_map(MIN_PARALLAX_DEG - 0.1).is_contradicted()


def test_few_points_say_nothing() -> None:
    young = wrong_map()
    young.frame.points[MIN_SHARED + 5 :] = NO_POINT
    assert young.is_contradicted()
    young.frame.points[MIN_SHARED - 5 :] = NO_POINT
    assert not young.is_contradicted()


def test_one_keyframe_is_no_witness() -> None:
    young = wrong_map()
    for k in (1, 2):
        young.world.keyframes[k].points[:] = NO_POINT
    assert not young.is_contradicted()


def test_an_old_map_and_a_part_of_one_are_left_alone() -> None:
    young = wrong_map()
    parts = Parts()
    parts.current = 7
    assert not young.is_contradicted(parts)
    newest = young.world.keyframes[2]
    young.world.keyframes[YOUNG - 1] = newest
    assert young.is_contradicted()
    young.world.keyframes[YOUNG] = newest
    assert not young.is_contradicted()


def test_pixels_that_fit_nothing_say_nothing() -> None:
    rng = np.random.default_rng(0)
    for pixels in (np.full((400, 2), 100.0), rng.uniform(0.0, 480.0, (400, 2))):
        young = wrong_map()
        for keyframe in young.world.keyframes.values():
            keyframe.features.pixels[:] = pixels[: len(keyframe.features)]
        assert not young.is_contradicted()


def test_a_map_that_is_contradicted_gives_way_to_one_that_begins_where_the_camera_is(monkeypatch) -> None:
    """In metres, whatever the old one's unit was."""
    run = Run()
    run.play(range(20))
    old, at = run.tracker.world, max(run.keyframes.values())
    assert len(old.keyframes) >= 2
    run.tracker.log_scale = 0.5
    asked: list[int] = []
    monkeypatch.setattr(tracker, "is_contradicted", lambda world, *_: not asked.append(len(world.keyframes)))
    index = 20
    while not asked:
        said = run.feed(index)
        index += 1
    assert said.odometry == OK, "the frame itself has been tracked"
    assert (run.tracker.epoch, len(run.tracker.world.keyframes)) == (1, 0)
    assert run.tracker.last_result is None, "an exact copy of it repeats nothing"
    assert max(run.keyframes.values()) == at, "it became no keyframe"
    monkeypatch.undo()
    assert run.feed(index).odometry == INITIALISING
    first = run.tracker.world.keyframes[max(run.keyframes)]
    begins = scaled(said.world_from_camera, np.exp(0.5))
    assert first.world_from_camera == pytest.approx(begins)
    assert run.depth(first.id) > 100
    run.play(range(index + 1, index + 10))
    film = footage()
    moved = inverse(run.results[index + 9].world_from_camera) @ first.world_from_camera
    true = inverse(film.poses[index + 9]) @ film.poses[index]
    assert moved[:3, 3] == pytest.approx(true[:3, 3], abs=0.02)
    assert run.tracker.log_scale == 0.0


def test_a_map_that_was_there_is_not_thrown_away_however_small(monkeypatch) -> None:
    run = Run()
    run.play(range(20))
    index, parts, world = run.tracker.places.index, run.tracker.parts, run.tracker.world
    run.tracker.adopt(world, index, parts, 7, 0.0)
    assert run.tracker._began_at is None
    run.tracker.last = TrackedFrame.of_keyframe(world.newest(), 100)
    run.tracker._search.lost = False
    monkeypatch.setattr(tracker, "is_contradicted", lambda *_: True)
    before = len(run.keyframes)
    run.play(range(20, 50))
    assert len(run.keyframes) > before
    assert (run.tracker.epoch, run.tracker.world) == (7, world)


def test_nobody_asks_where_two_views_are_not_to_be_asked(monkeypatch) -> None:
    def ask(*_: object) -> bool:
        raise AssertionError

    monkeypatch.setattr(tracker, "is_contradicted", ask)
    run = Run(tracker.Tracker(replace(CONFIG, two_views=False)))
    run.play(range(40))
    assert len(run.keyframes) > 3
    asks = Run()
    with pytest.raises(AssertionError):
        asks.play(range(40))
