"""A lost camera is found anywhere in the map, and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import inverse, se3_log, transform
from prism_edge.tracking.features import Features
from prism_edge.tracking.frame_tracking import FrameTracker, TrackedFrame
from prism_edge.tracking.local_map import LocalMap
from prism_edge.tracking.relocalisation import RANKED, TRIES, Relocaliser, _near
from prism_edge.tracking.view import View
from tests.backend.ring import Ring, looking_out
from tests.tracking.cloud import CAMERA, FACTORS, Cloud, descriptors, pose_at

LAP = 24
HEADINGS = [2 * np.pi * i / LAP for i in range(LAP)]


@pytest.fixture
def place() -> tuple[Cloud, LocalMap]:
    """A map of the whole ring, the newest keyframe at the end of it."""
    ring, cloud = Ring(count=2500), Cloud(10, seed=4)
    cloud.positions, cloud.descriptors = ring.points, ring.words
    world, _ = cloud.mapped([looking_out(h) for h in HEADINGS])
    return cloud, world


def looks(heading: float) -> np.ndarray:
    bins = np.linspace(0.0, 2.0 * np.pi, 32, endpoint=False)
    return (3.0 + np.exp(4.0 * (np.cos(heading - bins) - 1.0))).astype(np.float32)


class Lost:
    """A lost camera in front of a relocaliser."""

    def __init__(self, world: LocalMap, known: bool = True) -> None:
        self.world, self.frames = world, FrameTracker(FACTORS, 5000)
        self.relocaliser = Relocaliser()
        for k in world.keyframes if known else ():
            self.relocaliser.add_place(k, looks(HEADINGS[k]))
        self.relocaliser.begin()
        self.now_ns = 0

    def see(self, features: Features, after_ms: int = 33) -> TrackedFrame | None:
        self.now_ns += after_ms * 1_000_000
        view = View(CAMERA, features, self.now_ns)
        return self.relocaliser.attempt(self.world, self.frames, view, None, 25)


def at(heading: float) -> np.ndarray:
    """A little beside the ring, and held askew."""
    return looking_out(heading) @ pose_at(0.15, -0.1, 0.2, 0.05, 0.05, 0.35)


def test_it_is_found_far_from_where_it_was_lost(place):
    cloud, world = place
    lost, true = Lost(world), at(HEADINGS[9] + 0.1)
    seen = (lost.see(cloud.view(true, noise_px=0.5, bits=15)[0]) for _ in range(LAP))
    tried, found = next((i, frame) for i, frame in enumerate(seen) if frame is not None)
    assert found.matched >= 50
    assert np.abs(se3_log(inverse(true) @ found.world_from_camera)).max() < 0.02
    assert tried >= 1, "one frame alone is not believed"


def test_the_network_s_word_goes_first(place):
    cloud, world = place
    lost, true = Lost(world), at(HEADINGS[9] + 0.1)
    lost.relocaliser.heard(world, looks(HEADINGS[9] + 0.1))
    assert lost.see(cloud.view(true, noise_px=0.5, bits=15)[0]) is None
    found = lost.see(cloud.view(true, noise_px=0.5, bits=15)[0])
    assert np.abs(se3_log(inverse(true) @ found.world_from_camera)).max() < 0.02


def test_a_wrong_word_only_costs_time(place):
    cloud, world = place
    lost, true = Lost(world), at(HEADINGS[9])
    lost.relocaliser.heard(world, looks(HEADINGS[9] + np.pi))
    found = [lost.see(cloud.view(true, bits=15)[0]) for _ in range(LAP)]
    assert any(frame is not None for frame in found)


def test_what_was_named_when_it_was_lost_before_is_forgotten(place):
    _, world = place
    lost = Lost(world)
    lost.relocaliser.heard(world, looks(HEADINGS[9]))
    lost.relocaliser.begin()
    assert 9 not in lost.relocaliser._next(world)


@pytest.mark.parametrize("rate_hz", [30, 10, 3])
def test_a_word_that_is_wrong_each_time_takes_no_keyframe_s_turn_from_it(place, rate_hz: int):
    """The network is asked three times a second, which is as often as a slow camera sees something."""
    cloud, world = place
    lost, true, found, asked_ms = Lost(world), at(HEADINGS[9]), None, -300.0
    for i in range(LAP):
        if i * 1000 / rate_hz - asked_ms >= 300:
            asked_ms = i * 1000 / rate_hz
            lost.relocaliser.heard(world, looks(HEADINGS[9] + np.pi))
        found = found or lost.see(cloud.view(true, bits=15)[0], 1000 // rate_hz)
    assert found is not None


@pytest.mark.parametrize(
    "descriptor", [np.ones(32), np.zeros(32), np.full(32, np.nan), np.zeros(0), np.ones(7)], ids=str
)
def test_descriptors_that_say_nothing_leave_the_round(place, descriptor):
    cloud, world = place
    lost = Lost(world, known=False)
    for k in world.keyframes:
        lost.relocaliser.add_place(k, descriptor.astype(np.float32))
    lost.relocaliser.heard(world, descriptor.astype(np.float32))
    found = [lost.see(cloud.view(at(HEADINGS[14]), bits=15)[0]) for _ in range(LAP)]
    assert any(frame is not None for frame in found)


def test_another_network_s_word_leaves_the_round(place):
    """The map was loaded: its descriptors are of the network of then."""
    _, world = place
    lost = Lost(world, known=False)
    for k in world.keyframes:
        lost.relocaliser.add_place(k, looks(HEADINGS[k]), "then")
    lost.relocaliser.heard(world, looks(HEADINGS[9]), "now")
    others = lost.relocaliser._next(world)
    lost.relocaliser.begin()
    assert others == lost.relocaliser._next(world)


def test_every_keyframe_has_its_turn(place):
    _, world = place
    lost = Lost(world)
    tried = [k for _ in range(LAP // TRIES) for k in lost.relocaliser._next(world)]
    assert sorted(tried) == sorted(world.keyframes)


def test_another_place_is_not_found(place):
    _, world = place
    elsewhere = Ring(count=2500, seed=77)
    cloud = Cloud(10, seed=5)
    cloud.positions, cloud.descriptors = elsewhere.points, elsewhere.words
    lost = Lost(world)
    for i in range(LAP):
        lost.relocaliser.heard(world, looks(HEADINGS[i]))
        assert lost.see(cloud.view(at(HEADINGS[i]))[0]) is None


def test_few_points_that_agree_are_no_first_witness(place):
    """Forty are enough to track by, but some forty agree by chance anywhere in a large map."""
    cloud, world = place
    lost, whole = Lost(world), cloud.view(at(HEADINGS[9]), bits=15)[0]
    seen = (whole.pixels[::5][:40], whole.octaves[::5][:40], whole.descriptors[::5][:40])
    lost.relocaliser.heard(world, looks(HEADINGS[9]))
    assert lost.see(Features.build(*seen, CAMERA.width, CAMERA.height)) is None
    lost.relocaliser.heard(world, looks(HEADINGS[9]))
    assert lost.see(whole) is None
    assert lost.see(whole) is not None


def test_two_frames_that_contradict_each_other_are_not_believed(place):
    """Each alone is convincing; together they would be a leap of the camera."""
    cloud, world = place
    lost = Lost(world)
    for i in range(LAP):
        heading = HEADINGS[4] if i % 2 else HEADINGS[16]
        lost.relocaliser.heard(world, looks(heading))
        assert lost.see(cloud.view(at(heading), bits=10)[0]) is None


def test_a_frame_without_features_and_a_map_without_points(place):
    cloud, world = place
    lost = Lost(world)
    none = Features.build(np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros((0, 4), np.uint64), 640, 480)
    assert lost.see(none) is None
    for keyframe in world.keyframes.values():
        keyframe.points[:] = -1
    assert lost.see(cloud.view(at(0.3))[0]) is None


def test_the_network_s_word_names_places_that_lie_apart(place):
    """Keyframes side by side show the same: where the first of them is not found the next is not either."""
    _, world = place
    for k, keyframe in world.keyframes.items():
        keyframe.neighbours = [(k - 1) % LAP, (k + 1) % LAP]
    lost = Lost(world)
    lost.relocaliser.heard(world, looks(HEADINGS[9]))
    named = [lost.relocaliser._next(world)[0] for _ in range(RANKED)]
    assert named[0] == 9
    assert len(set(named)) == RANKED
    assert all((a - b) % LAP not in (1, LAP - 1) for a in named for b in named)


def test_a_hand_before_the_lens_leaves_it_where_it_was(place):
    """By its last frame, whatever the keyframes look like by now."""
    cloud, world = place
    last = TrackedFrame.of_keyframe(world.keyframes[9], 100)
    for keyframe in world.keyframes.values():
        old, others = keyframe.features, descriptors(cloud.rng, len(keyframe.features))
        keyframe.features = Features.build(old.pixels, old.octaves, others, 640, 480)
    true = last.world_from_camera @ pose_at(0.01, 0.0, 0.0, 0.01)
    for known, found in ((None, False), (last, True)):
        relocaliser, frames = Relocaliser(), FrameTracker(FACTORS, 5000)
        seen = [cloud.view(true, noise_px=0.3, bits=10)[0] for _ in range(2)]
        made = [
            relocaliser.attempt(world, frames, View(CAMERA, features, 33_000_000 * i), known, 25)
            for i, features in enumerate(seen)
        ]
        assert made[0] is None
        assert (made[1] is not None) == found
    assert np.abs(se3_log(inverse(true) @ made[1].world_from_camera)).max() < 0.02


def test_keyframes_that_have_gone_are_passed_over(place):
    _, world = place
    lost = Lost(world)
    lost.relocaliser.heard(world, looks(HEADINGS[3]))
    del world.keyframes[3]
    lost.relocaliser.forget(3)
    tried = [k for _ in range(LAP) for k in lost.relocaliser._next(world)]
    assert 3 not in tried
    assert set(tried) == set(world.keyframes)


def test_a_turn_no_frame_makes_is_not_believed_though_both_see_the_same():
    """Through a wide lens two views 15 degrees apart share nearly all of their points."""
    wide, cloud = Camera(640, 480, 250.0, 250.0, 319.5, 239.5), Cloud(600, seed=6)
    turned = pose_at(0.0, 0.0, 0.0, 0.0, np.radians(15.0))
    world, _ = cloud.mapped([pose_at(), pose_at(0.1)])

    def seen(pose: np.ndarray) -> Features:
        features, shown = cloud.view(pose_at())
        pixels = wide.project(transform(inverse(pose), cloud.positions[shown]))
        return Features.build(pixels, features.octaves, features.descriptors, 640, 480)

    def attempt(lost: Lost, pose: np.ndarray, after_ms: int = 33) -> TrackedFrame | None:
        lost.now_ns += after_ms * 1_000_000
        view = View(wide, seen(pose), lost.now_ns)
        return lost.relocaliser.attempt(world, lost.frames, view, None, 25)

    lost = Lost(world, known=False)
    assert not [i for i in range(8) if attempt(lost, turned if i % 2 else pose_at()) is not None]
    lost.relocaliser.begin()
    assert attempt(lost, turned) is None
    assert attempt(lost, turned) is not None, "twice in one place it is"
    lost.relocaliser.begin()
    assert attempt(lost, pose_at()) is None
    assert attempt(lost, turned, 100) is not None, "ten images a second leave it the time"


@pytest.mark.parametrize(("turned_deg", "found"), [(39.0, True), (41.0, False)])
def test_the_frame_before_vouches_for_four_frames_motion_however_long_ago_it_was(turned_deg, found):
    """In a wait of seconds a camera gets anywhere: what it then seems to see has one witness, not two."""
    cloud = Cloud(600, seed=6)
    cloud.positions[:, :2] *= 0.2  # about the middle: rolled, it hardly moves
    world, _ = cloud.mapped([pose_at(), pose_at(0.1)])
    lost, rolled = Lost(world, known=False), pose_at(0.0, 0.0, 0.0, 0.0, 0.0, np.radians(turned_deg))
    assert lost.see(cloud.view(pose_at())[0]) is None
    assert (lost.see(cloud.view(rolled)[0], 10_000) is not None) == found


def test_a_place_that_only_looks_of_old_agree_on_is_passed_over(place):
    """The keyframe's corners are found, but its points have looked otherwise since."""
    cloud, world = place
    lost = Lost(world)
    world.points.descriptor[:] = descriptors(np.random.default_rng(7), len(world.points))
    for _ in range(3):
        lost.relocaliser.heard(world, looks(HEADINGS[9]))
        assert lost.see(cloud.view(at(HEADINGS[9]), bits=15)[0]) is None


@pytest.mark.parametrize(("step", "near"), [(0.5, True), (1.2, False)])
def test_how_far_a_frame_may_bring_it_goes_by_what_is_before_it_wherever_the_map_began(step, near):
    """A fifth of the median depth, which is some 4 m here, as seen from ten metres along."""
    cloud = Cloud(400, seed=6)
    cloud.positions[:, 2] += 10.0
    world, _ = cloud.mapped([pose_at(0.0, 0.0, 10.0), pose_at(step, 0.0, 10.0)])
    assert world.median_depth(world.keyframes[1]) == pytest.approx(4.0, abs=0.5)
    before, after = (TrackedFrame.of_keyframe(world.keyframes[k], 100) for k in (0, 1))
    assert _near(world, before, after, 1.0) == near
