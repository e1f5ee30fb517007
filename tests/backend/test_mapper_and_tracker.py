"""The backend fed by a real tracker: both go on with one map."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.backend.mapper import Mapper
from prism_edge.bus import codec
from prism_edge.config import TrackingConfig
from prism_edge.geometry.poses import inverse
from prism_edge.messages import Keyframe, MapUpdate
from prism_edge.tracking.announcement import keyframe_message
from prism_edge.tracking.odometry import MetricOdometry
from prism_edge.tracking.tracker import Tracker
from tests.backend.test_mapper import CONFIG
from tests.backend.world import check, poses_of, step
from tests.tracking.cloud import check as check_local
from tests.tracking.footage import IDENTITY, footage


def film_frame(index: int, length: int = 75) -> int:
    """Which frame of the film is shown when it runs to and fro."""
    turn, at = divmod(index, length - 1)
    return length - 1 - at if turn % 2 else at


class Pair:
    """Tracker and mapper on the generated film; updates arrive ``lag`` frames after their keyframe."""

    def __init__(self, lag: int, **tracking: float) -> None:
        self.tracker, self.mapper = Tracker(TrackingConfig(features=500, **tracking)), Mapper(CONFIG)
        self.odometry, self.lag = MetricOdometry(), lag
        self.due: list[tuple[int, MapUpdate]] = []
        self.poses: dict[int, np.ndarray] = {}
        self.carriers: dict[int, tuple[int, np.ndarray]] = {}
        self.told: list[Keyframe] = []
        self.odoms: dict[int, np.ndarray] = {}
        self.steps: dict[int, float] = {}
        self.applied = 0

    def run(self, frames: int) -> None:
        """Play the film, forwards and backwards in turn."""
        film = footage()
        for i in range(frames):
            shown = film_frame(i)
            while self.due and self.due[0][0] <= i:
                self.apply(self.due.pop(0)[1])
            before = self.tracker.last_pose()
            result = self.tracker.process(i, film.stamp_ns(i), film.images[shown], film.camera)
            if result.world_from_camera is not None:
                self.poses[i] = result.world_from_camera
                self.carriers[i] = (result.reference, result.reference_from_camera)
                self.odometry.advance(before, result.world_from_camera, 0.0, film.stamp_ns(i))
                self.odoms[i] = self.odometry.odom_from_camera.copy()
            keyframe = self.tracker.maybe_keyframe()
            self.tracker.map_keyframe()
            if keyframe is not None:
                self.keyframe(keyframe, i)

    def keyframe(self, keyframe, frame: int) -> None:
        depth = footage().depths[film_frame(frame)]
        made = keyframe_message(self.tracker, keyframe)
        message = codec.unpack(codec.pack(made), Keyframe)
        self.told.append(message)
        self.tracker.add_depth(keyframe.id, depth, IDENTITY, 0.2)
        update = step(self.mapper, message, depth, IDENTITY)
        if update is not None:
            self.due.append((frame + self.lag, codec.unpack(codec.pack(update), MapUpdate)))

    def apply(self, update: MapUpdate) -> None:
        self.tracker.apply_update(update)
        self.applied += 1


@pytest.fixture(scope="module", params=[1, 6])
def pair(request) -> Pair:
    made = Pair(request.param)
    made.run(75)
    return made


def test_together_they_follow_the_truth(pair):
    truth = footage().poses
    assert pair.applied >= 2
    assert set(pair.poses) == set(range(1, 75))
    errors = [np.linalg.norm((pair.poses[i] - truth[i])[:3, 3]) for i in pair.poses]
    assert max(errors) < 0.05


def test_odometry_never_jumps_when_the_map_is_corrected(pair):
    """Between consecutive frames it moves as the camera did, whatever the updates did to the map."""
    truth = footage().poses
    for i in range(2, 75):
        step = inverse(pair.odoms[i - 1]) @ pair.odoms[i]
        true = inverse(truth[i - 1]) @ truth[i]
        assert np.linalg.norm((step - true)[:3, 3]) < 0.025, i


def test_both_have_the_same_observations(pair):
    """Of points both know. What is on its way between them may differ: new seeds, and dropped ones."""
    world, heard = pair.tracker.world, pair.mapper.world
    check(heard)
    check_local(world)
    assert set(heard.keyframes) == set(world.keyframes)
    mine = {
        (k.id, int(k.points[i]), int(i)) for k in world.keyframes.values() for i in k.observed()
    }
    theirs = {(k.id, p, i) for k in heard.keyframes.values() for p, i in k.observed.items()}
    in_flight = {(k, p, i) for p, k, i in world.changes.late}
    waiting = {
        (k, p)
        for _, update in pair.due
        for k, p in zip(update.dropped_keyframes.tolist(), update.dropped_points.tolist(), strict=True)
    }
    assert len(mine & theirs) > 500
    assert not theirs - mine
    missing = {(k, p) for k, p, _ in mine - theirs - in_flight} - waiting
    assert len(missing) < 0.02 * len(mine)


def test_what_is_corrected_is_where_the_backend_has_it(pair):
    """Keyframes, and all points that it knows: also those that no update named."""
    world, heard = pair.tracker.world, pair.mapper.world
    for _, update in pair.due:
        pair.apply(update)
    pair.due.clear()
    for k, keyframe in world.keyframes.items():
        error = inverse(heard.keyframes[k].world_from_camera) @ keyframe.world_from_camera
        assert error == pytest.approx(np.eye(4), abs=1e-9)
    known = np.array(sorted(heard.points))
    known = known[world.points.known(known)]
    assert len(known) > 500
    places = np.array([heard.points[p].position for p in known.tolist()])
    assert world.points.position[world.points.rows(known)] == pytest.approx(places, abs=1e-9)


BOUND = 15


@pytest.fixture(scope="module")
def bounded() -> Pair:
    """Many more keyframes than the tracker may keep."""
    made = Pair(6, max_keyframes=BOUND, keyframe_ratio=1.0, keyframe_min_s=0.05)
    made.run(148)
    return made


def test_a_bounded_map_stays_bounded_and_both_agree_on_it(bounded):
    world, heard = bounded.tracker.world, bounded.mapper.world
    ids = [message.id for message in bounded.told]
    culled = [k for message in bounded.told for k in message.culled_keyframes.tolist()]
    assert len(ids) > BOUND + 10
    assert ids == sorted(set(ids)), "ids are given once"
    assert len(culled) == len(set(culled))
    assert set(world.keyframes) == set(heard.keyframes) == set(ids) - set(culled)
    assert len(world.keyframes) == BOUND
    assert {0, *ids[-12:]} <= set(world.keyframes)
    assert set(heard.carried.ids.tolist()) == set(culled)
    check(heard)
    check_local(world)
    # What the backend knows, the tracker has too, but for what is on its way.
    waiting = {p for _, update in bounded.due for p in update.dropped_points.tolist()}
    alive = set(world.points.ids[world.points.alive].tolist())
    seen_by_two = {p for p, point in heard.points.items() if len(point.keyframes) >= 2}
    assert not seen_by_two - alive - waiting


def test_a_bounded_map_tracks_on(bounded):
    truth = footage().poses
    assert set(bounded.poses) == set(range(1, 148))
    errors = [np.linalg.norm((bounded.poses[i] - truth[film_frame(i)])[:3, 3]) for i in bounded.poses]
    assert max(errors) < 0.06


def test_frames_of_culled_keyframes_have_a_place_in_the_finished_map(bounded):
    """As final.tum is made: by the pose that the backend remembers of the frame's reference."""
    poses, truth = poses_of(bounded.mapper.world), footage().poses
    culled = set(bounded.mapper.world.carried.ids.tolist())
    on_culled = [i for i, (k, _) in bounded.carriers.items() if k in culled]
    assert len(on_culled) > 20
    for i, (reference, reference_from_camera) in bounded.carriers.items():
        placed = poses[reference] @ reference_from_camera
        assert np.linalg.norm((placed - truth[film_frame(i)])[:3, 3]) < 0.06
