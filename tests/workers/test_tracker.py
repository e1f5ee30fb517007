"""The tracker worker on the generated film: messages in, messages out."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.bus import ros
from prism_edge.config import Config, CovarianceConfig
from prism_edge.geometry.poses import inverse
from prism_edge.messages import (
    Frame,
    probe_of,
)
from prism_edge.workers import tracker
from prism_edge.workers.ablated import tracking_of
from tests.synthetic.drawing import SLACK
from tests.tracking.footage import footage, other_room
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import (
    BASE_FROM_CAMERA,
    CONFIG,
    LOCKSTEP,
    World,
    depth_of,
    frame,
    positions,
    run,
    scale_of,
    true_position,
    update_of,
)


def test_poses_go_out_in_metres_and_the_robot_s_axes(bus, world):
    run(bus, [frame(i) for i in range(40)])
    placed = positions(bus)
    assert set(placed) == set(range(1, 40))
    for i, position in placed.items():
        assert np.linalg.norm(position - true_position(i)) < 0.04
    assert len(bus.of("odom")) == len(bus.of("tf")) == 39
    odom = [ros.pose_matrix(m.pose.pose)[:3, 3] for m in bus.of("odom")]
    assert np.linalg.norm(odom[-1] - true_position(39)) < 0.05


def test_every_frame_is_answered(bus, world):
    run(bus, [frame(i) for i in range(30)])
    ticks = bus.of("tracked")
    assert [t.index for t in ticks] == list(range(30))
    assert [t.published for t in ticks] == [False] + [True] * 29
    assert [t.captured_monotonic_ns for t in ticks] == [1000 + i for i in range(30)]
    assert ticks[0].odometry == "initialising"
    assert {t.odometry for t in ticks[1:]} == {"ok"}
    assert all(t.dropped == 0 for t in ticks)
    assert bus.states[0] == "ready"
    assert not bus.of("acknowledged")


def test_keyframes_go_out_with_their_picture_and_are_named_in_the_tick(bus, world):
    run(bus, [frame(i) for i in range(40)])
    keyframes, images = bus.of("keyframe"), bus.of("keyframe_image")
    assert len(keyframes) >= 2
    assert [k.id for k in keyframes] == [i.keyframe for i in images] == list(range(len(keyframes)))
    ticks = {t.index: t for t in bus.of("tracked")}
    for keyframe, image in zip(keyframes, images, strict=True):
        assert ticks[keyframe.index].keyframe == keyframe.id
        assert image.index == keyframe.index
        assert np.array_equal(image.image, footage().images[keyframe.index])
        assert keyframe.stamp_ns == image.stamp_ns == footage().stamp_ns(keyframe.index)
    others = set(ticks) - {k.index for k in keyframes}
    assert all(ticks[i].keyframe == -1 for i in others)
    travelled = [k.travelled for k in keyframes]
    assert travelled[0] == 0.0
    path = np.array([true_position(i) for i in range(keyframes[-1].index + 1)])
    length = np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
    assert travelled[-1] == pytest.approx(length, rel=0.1)


def test_the_scale_turns_units_into_metres_and_its_error_into_covariance(bus, world):
    world.scale = lambda keyframe: scale_of(keyframe, np.log(1.5), 0.2)
    no_drift = {"drift_of_motion": 0.0, "drift_per_sqrt_m": 0.0, "drift_per_sqrt_rad": 0.0}
    scale_alone = CovarianceConfig(refinement=0.01, moment_ms=0.0, turn_per_sqrt_m=0.0, **no_drift)
    run(bus, [frame(i) for i in range(30)], replace(CONFIG, covariance=scale_alone))
    message = bus.of("pose")[-1]
    # The first depth came before the first scale did: a unit is a metre of the network.
    position = ros.pose_matrix(message.pose.pose)[:3, 3]
    assert np.linalg.norm(position) == pytest.approx(1.5 * np.linalg.norm(true_position(29)), rel=0.06)
    covariance = np.asarray(message.pose.covariance).reshape(6, 6)[:3, :3]
    assert position @ covariance @ position == pytest.approx((0.2 * position @ position) ** 2, rel=0.1)


def test_without_a_scale_the_covariance_says_so(bus, world):
    world.scale = None
    run(bus, [frame(i) for i in range(30)])
    position = positions(bus)[29]
    covariance = np.asarray(bus.of("pose")[-1].pose.covariance).reshape(6, 6)[:3, :3]
    assert np.sqrt(np.linalg.eigvalsh(covariance)[-1]) > 0.9 * np.linalg.norm(position)


def test_it_goes_on_when_nobody_answers_after_the_start(bus, world):
    world.scale = world.update = None
    world.depth = lambda image: depth_of(image) if image.keyframe == 0 else depth_of(image, valid=False)
    run(bus, [frame(i) for i in range(60)])
    placed = positions(bus)
    assert set(placed) == set(range(1, 60))
    assert np.linalg.norm(placed[59] - true_position(59)) < 0.05 * SLACK


NAN = float("nan")
ONE = np.ones(1, np.float32)


@pytest.mark.parametrize(
    "changes",
    [
        {"depth": np.full((240, 320), np.nan, np.float32)},
        {"depth": np.full((240, 320), np.inf, np.float32)},
        {"depth": np.zeros((240, 320), np.float32)},
        {"depth": np.full((240, 320), -2.0, np.float32)},
        {"depth": np.zeros((0, 0), np.float32)},
        {"depth": np.ones((1, 1), np.float32)},
        {"image_to_depth": np.full(4, np.nan)},
        {"image_to_depth": np.array([1e30, 0, 1e30, 0])},
        {"valid": False},
        {"epoch": 7},
        {"keyframe": 99},
    ],
)
def test_depth_that_can_t_be_used_is_ignored(bus, world, changes):
    """It begins nothing, and later harms nothing."""
    world.depth = lambda image: depth_of(image, **changes)
    run(bus, [frame(i) for i in range(5)])
    assert not bus.of("pose")
    assert len(bus.of("tracked")) == 5
    later = ListBus("frame")
    answers = World(later)
    answers.depth = lambda image: depth_of(image, **(changes if image.keyframe else {}))
    run(later, [frame(i) for i in range(26)])
    assert len(later.of("keyframe")) >= 2
    assert np.linalg.norm(positions(later)[25] - true_position(25)) < 0.05


@pytest.mark.parametrize(
    "changes",
    [
        {"log_scale": NAN},
        {"log_scale": float("inf")},
        {"map_log_scale": NAN},
        {"sigma": NAN},
        {"sigma": float("inf")},
        {"epoch": 3},
        {"metric": False},
    ],
)
def test_a_scale_that_says_nothing_is_ignored(bus, world, changes):
    world.scale = lambda keyframe: scale_of(keyframe, **({"log_scale": 0.4} | changes))
    run(bus, [frame(i) for i in range(20)])
    assert np.linalg.norm(positions(bus)[19] - true_position(19)) < 0.03
    for message in bus.of("pose"):
        assert np.isfinite(message.pose.covariance).all()


def test_an_update_moves_the_pose_and_not_the_odometry(bus, world):
    shift = np.eye(4)
    shift[:3, 3] = (0.5, 0.0, 0.0)
    world.update = lambda keyframe, sequence: update_of(
        keyframe, sequence, (shift @ keyframe.world_from_camera)[None] if keyframe.id == 0 else None
    )
    run(bus, [frame(i) for i in range(20)])
    # The points of keyframe 0 that it names nothing of go with it, and so does the camera.
    moved = (BASE_FROM_CAMERA @ shift @ inverse(BASE_FROM_CAMERA))[:3, 3]
    odom = {ros.stamp_ns(m): ros.pose_matrix(m.pose.pose)[:3, 3] for m in bus.of("odom")}
    assert len(odom) == 19
    assert np.linalg.norm(odom[footage().stamp_ns(19)] - true_position(19)) < 0.03
    assert np.linalg.norm(positions(bus)[19] - true_position(19) - moved) < 0.03


@pytest.mark.parametrize("changes", [{"epoch": 5}, {"sequence": 0}, {"sequence": 1}])
def test_updates_of_another_map_or_overtaken_ones_are_ignored(bus, world, changes):
    shift = np.eye(4)
    shift[:3, 3] = (5.0, 0.0, 0.0)

    def answer(keyframe, sequence):
        if keyframe.id == 0:
            bus.give("map_update", update_of(keyframe, 1))
            return update_of(keyframe, poses=(shift @ keyframe.world_from_camera)[None], **changes)
        return update_of(keyframe, sequence)

    world.update = answer
    run(bus, [frame(i) for i in range(20)])
    assert np.linalg.norm(positions(bus)[19] - true_position(19)) < 0.03


@pytest.mark.parametrize(
    "changes",
    [
        {"poses": np.full((1, 4, 4), NAN)},
        {"poses": np.zeros((0, 4, 4))},
        {"poses": np.zeros((2, 4, 4))},
        {"points": np.array([3]), "positions": np.full((1, 3), np.inf), "parallax_deg": ONE},
        {"points": np.array([3]), "positions": np.zeros((1, 3)), "parallax_deg": ONE * np.float32(NAN)},
        {"points": np.array([3, 4]), "positions": np.zeros((1, 3)), "parallax_deg": ONE},
        {"points": np.array([3]), "positions": np.zeros((1, 3))},
        {"dropped_keyframes": np.array([0, 0]), "dropped_points": np.array([3])},
    ],
)
def test_an_update_that_makes_no_sense_is_passed_over(bus, world, changes, caplog):
    world.update = lambda keyframe, sequence: update_of(
        keyframe, sequence, **({"poses": keyframe.world_from_camera[None]} | changes if sequence == 1 else {})
    )
    run(bus, [frame(i) for i in range(20)])
    assert bus.pulse.values["malformed"] == "1"
    assert "map update 1" in caplog.text
    assert set(positions(bus)) == set(range(1, 20))
    assert np.linalg.norm(positions(bus)[19] - true_position(19)) < 0.03


def test_what_never_arrived_is_counted(bus, world):
    run(bus, [frame(i) for i in (0, 1, 2, 5, 6, 9)])
    assert [t.dropped for t in bus.of("tracked")] == [0, 0, 0, 2, 2, 4]


def test_real_time_takes_the_newest(bus, world):
    bus.one_by_one = False
    run(bus, [frame(i) for i in range(10)])
    assert [t.index for t in bus.of("tracked")] == [9]


def test_status_says_how_it_goes(bus, world):
    black = np.zeros((240, 320), np.uint8)
    frames = [frame(i) for i in range(15)] + [frame(i, of=0, image=black) for i in range(15, 35)]
    run(bus, frames)
    words = [s.status[0].message.split()[0] for s in bus.of("status")]
    distinct = [w for i, w in enumerate(words) if i == 0 or words[i - 1] != w]
    assert distinct == ["initialising", "ok", "degraded", "lost"]
    levels = {s.status[0].message.split()[0]: s.status[0].level for s in bus.of("status")}
    assert levels["ok"] == ros.LEVEL_OK
    assert levels["lost"] == ros.LEVEL_ERROR
    assert bus.pulse.values["odometry"] == "lost"
    assert len(bus.of("pose")) == 14, "a lost tracker publishes no pose"
    assert len(bus.of("tracked")) == 35


@pytest.mark.parametrize(
    "changes",
    [
        {"camera": np.array([320.0, 240.0, 250.0])},
        {"camera": np.array([320.0, 240.0, NAN, 250.0, 160.0, 120.0])},
        {"camera": np.array([320.0, 240.0, -1.0, 250.0, 160.0, 120.0])},
        {"camera_model": "spherical"},
        {"image": np.zeros((0, 0), np.uint8)},
        {"image": np.zeros((100, 320), np.uint8)},
    ],
)
@pytest.mark.parametrize("config", [CONFIG, LOCKSTEP])
def test_a_frame_that_makes_no_sense_is_passed_over(bus, world, changes, config, caplog):
    frames = [frame(i) for i in range(12)]
    frames[6] = replace(frames[6], **changes)
    run(bus, frames, config)
    ticks = bus.of("tracked")
    assert [t.index for t in ticks] == list(range(12)), "the others wait for each"
    assert not ticks[6].published
    assert 6 not in positions(bus)
    assert bus.pulse.values["malformed"] == "1"
    assert positions(bus)[11] == pytest.approx(true_position(11), abs=0.03)
    assert "frame 6" in caplog.text
    if config is LOCKSTEP:
        assert [a.index for a in bus.of("acknowledged")] == list(range(12))


def dark(index: int) -> Frame:
    """The same darkness as in the frame before."""
    made = frame(index, of=0)
    return replace(made, image=np.zeros_like(made.image), duplicate=True)


def test_a_camera_carried_off_in_the_dark_is_lost_and_found_again(bus, world):
    frames = [frame(i) for i in range(30)]
    frames += [replace(dark(30), duplicate=False), *(dark(i) for i in range(31, 60))]
    # It comes back where it was before, which is not where it was lost.
    frames += [frame(i, of=i - 50) for i in range(60, 75)]
    few = replace(CONFIG, tracking=replace(CONFIG.tracking, max_features=500))
    run(bus, frames, config=few)
    states = {t.index: t.odometry for t in bus.of("tracked")}
    assert states[29] == "ok"
    assert states[41] == "lost", "0.4 s later"
    assert not {t.index for t in bus.of("tracked") if t.published} & set(range(30, 61))
    placed = positions(bus)
    assert max(placed) == 74
    assert min(i for i in placed if i >= 30) < 66, "found within 0.2 s"
    for i in placed:
        if i >= 60:
            assert np.linalg.norm(placed[i] - true_position(i - 50)) < 0.03
    words = [s.status[0].message for s in bus.of("status")]
    assert "lost relocalising" in words
    assert words[-1].startswith("ok")
    # The map has the way from there to here, so `odom` goes it, and not how fast the camera is now.
    film, found = footage(), min(i for i in placed if i >= 30)
    moved = next(m for m in bus.of("odom") if ros.stamp_ns(m) == film.stamp_ns(found))
    assert np.linalg.norm(ros.pose_matrix(moved.pose.pose)[:3, 3] - true_position(found - 50)) < 0.05
    assert moved.twist.covariance[0] == 100.0**2
    walk = {t.index: t.walk_m for t in bus.of("tracked")}
    assert walk[found] < walk[29] + 0.05


def test_the_network_is_shown_what_a_lost_camera_sees(bus, world):
    """A picture that nothing in the map fits goes to the depth worker now and then, and to nobody's map."""
    other = np.random.default_rng(0).integers(0, 256, (240, 320), dtype=np.uint8)
    frames = [frame(i) for i in range(20)]
    frames += [replace(frame(i, of=0), image=np.roll(other, i, axis=1)) for i in range(20, 60)]
    run(bus, frames, LOCKSTEP)
    probes = [m for m in bus.of("keyframe_image") if m.keyframe < 0]
    asked = [t.index for t in bus.of("tracked") if t.probe]
    assert [m.index for m in probes] == asked
    assert [m.keyframe for m in probes] == [probe_of(i) for i in asked]
    assert len(asked) >= 2
    assert min(np.diff(asked)) >= 9
    assert {t.odometry for t in bus.of("tracked") if t.probe} == {"lost"}
    assert all(k.id >= 0 for k in bus.of("keyframe"))


def test_a_lost_frame_that_begins_a_part_is_shown_once(bus, world):
    """In lockstep the depth worker waits for one picture a frame: of a keyframe, its own."""
    room, config = other_room(30), replace(LOCKSTEP.tracking, submap_after_s=0.3)
    frames = [*(frame(i) for i in range(30)), *(dark(i) for i in range(30, 34))]
    frames += [replace(frame(34 + i, of=0), image=image) for i, (image, _, _) in enumerate(room)]
    run(bus, frames, replace(LOCKSTEP, tracking=config))
    ticks = bus.of("tracked")
    assert any(t.keyframe >= 0 for t in ticks if t.index >= 34), "a part has begun"
    assert any(t.probe for t in ticks)
    shown = [m.index for m in bus.of("keyframe_image")]
    assert len(shown) == len(set(shown))
    assert shown == [t.index for t in ticks if t.probe != (t.keyframe >= 0)]


def test_where_its_place_in_the_map_is_unknown_odom_goes_out_and_pose_does_not(bus, world):
    """Carried off to another room, the camera maps there; a loop of the backend's brings it into the map."""
    room, looped_at = other_room(60), 80
    config = replace(CONFIG, tracking=replace(CONFIG.tracking, submap_after_s=0.3))
    world.depth = lambda image: replace(depth_of(image, of=0), depth=depths[image.index])
    depths = dict(enumerate(footage().depths)) | {42 + i: depth for i, (_, depth, _) in enumerate(room)}
    world.update = lambda keyframe, sequence: update_of(
        keyframe, 2 * sequence, poses=keyframe.world_from_camera[None]
    )

    def heard(topic, message) -> None:
        """The loop is told after a frame, whichever frames became keyframes."""
        world.heard(topic, message)
        if topic == "tracked" and message.index == looped_at:
            newest = bus.of("keyframe")[-1]
            closed = {"loop_query": newest.id, "loop_candidate": 0}
            pose = newest.world_from_camera[None]
            bus.give("map_update", update_of(newest, 2 * newest.id + 3, poses=pose, **closed))

    bus.hear = heard
    frames = [frame(i) for i in range(30)]
    frames += [replace(dark(i), duplicate=i > 30) for i in range(30, 42)]
    frames += [replace(frame(42 + i, of=0), image=image) for i, (image, _, _) in enumerate(room)]
    run(bus, frames, config)
    tracked = {t.index: t for t in bus.of("tracked")}
    placed, film = set(positions(bus)), footage()
    index = {film.stamp_ns(i): i for i in range(200)}
    moving = {index[ros.stamp_ns(m)] for m in bus.of("odom")}
    astray = sorted(moving - placed)
    assert astray
    assert 42 < astray[0] < 70
    assert astray == list(range(astray[0], astray[-1] + 1))
    assert all(tracked[i].odometry in ("ok", "degraded") and not tracked[i].published for i in astray)
    frames_of = [{t.header.frame_id for t in m.transforms} for m in bus.of("tf")]
    assert sum("map" in names for names in frames_of) == len(placed)
    assert "ok relocalising" in [s.status[0].message for s in bus.of("status")]
    # Once a loop has told where that is, poses go out again; odom knows nothing of it.
    assert astray[-1] == looped_at
    assert max(placed) == 101
    odom = {index[ros.stamp_ns(m)]: ros.pose_matrix(m.pose.pose)[:3, 3] for m in bus.of("odom")}
    steps = [np.linalg.norm(odom[i + 1] - odom[i]) for i in sorted(odom) if i + 1 in odom]
    assert max(steps) < 0.1


@pytest.mark.parametrize("part", ["consistency", "init"])
def test_an_ablated_part_is_off_and_no_other(part):
    tracking = tracking_of(replace(CONFIG, ablate=(part,)))
    assert (tracking.proven_after_s > 0.0) == (part != "consistency")
    assert tracking.two_views == (part != "init")


def test_the_log_says_where_the_camera_looks(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(tracker, "TrackerWorker", lambda config, bus: SimpleNamespace(run=lambda: None))
    monkeypatch.setattr(tracker, "gc", SimpleNamespace(freeze=lambda: None, set_threshold=lambda *_: None))
    caplog.set_level("INFO")
    tracker.main(Config(), ListBus())
    assert "camera looks along base_link (1.00, 0.00, 0.00), level with it" in caplog.text
