"""Exact copies of images: a slow camera's, a repeating encoder's, a recorder's that lost some."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.bus import ros
from prism_edge.geometry.poses import from_rt
from tests.synthetic.drawing import SLACK
from tests.workers.tracker_bench import depth_of, frame, positions, run, true_position, update_of


def matrix(message):
    return np.asarray(message.pose.covariance).reshape(6, 6)


def test_an_exact_copy_repeats_the_pose(bus, world):
    frames = [frame(i) for i in range(10)]
    frames.append(frame(10, of=9, duplicate=True))
    frames += [frame(i) for i in range(11, 15)]
    run(bus, frames)
    assert len(bus.of("pose")) == 14
    placed = positions(bus)
    assert placed[10].tolist() == placed[9].tolist()
    odom = [ros.pose_matrix(m.pose.pose)[:3, 3].tolist() for m in bus.of("odom")]
    assert odom[9] == odom[8]
    assert [t.index for t in bus.of("tracked")] == list(range(15))
    assert np.linalg.norm(placed[14] - true_position(14)) < 0.03


def test_the_velocity_after_a_copy_is_of_both_periods(bus, world):
    frames = [frame(i) for i in range(20)]
    frames.append(frame(20, of=19, duplicate=True))
    run(bus, [*frames, *(frame(i) for i in range(21, 30))])
    speed = [np.linalg.norm([getattr(m.twist.twist.linear, axis) for axis in "xyz"]) for m in bus.of("odom")]
    true = np.linalg.norm(true_position(21) - true_position(19)) * 30.0 / 2.0
    assert speed[20] == pytest.approx(true, rel=0.3)


def test_a_camera_that_hangs_is_not_said_to_move_on(bus, world):
    copies = [frame(i, of=19, duplicate=True) for i in range(20, 50)]
    run(bus, [*(frame(i) for i in range(20)), *copies, frame(50, of=20), frame(51, of=21)])
    velocity = {ros.stamp_ns(m): m.twist for m in bus.of("odom")}
    linear = {i: velocity[frame(i).stamp_ns].twist.linear for i in (19, 20, 49, 50, 51)}
    sigma = {i: velocity[frame(i).stamp_ns].covariance[0] ** 0.5 for i in linear}
    assert linear[20] == linear[19]
    assert (linear[49].x, linear[49].y, linear[49].z) == (0.0, 0.0, 0.0)
    assert sigma[49] == sigma[50] == 100.0
    assert sigma[20] < 10.0 > sigma[51]


def test_a_copy_may_have_been_taken_where_the_camera_went_on_to(bus, world):
    """Its sigma is the way that nobody saw, a second of it at most, and not after them."""
    copies = [frame(i, of=19, duplicate=True) for i in range(20, 58)]
    run(bus, [*(frame(i) for i in range(20)), *copies, frame(58, of=20)])
    for topic in ("pose", "odom"):
        sigma = {ros.stamp_ns(m): np.sqrt(np.trace(matrix(m)[:3, :3])) for m in bus.of(topic)}
        at = {i: sigma[frame(i).stamp_ns] for i in (19, 20, 49, 57, 58)}
        speed = np.linalg.norm(true_position(19) - true_position(18)) * 30.0
        # Along its way, and on each axis by a change as large as itself, within this second.
        assert at[49] == pytest.approx(np.hypot(at[19], 2.0 * speed * 30 / 30.0), rel=0.3)
        assert at[57] == pytest.approx(at[49], rel=0.05)
        assert at[19] < at[20] < 0.2 * at[49] > at[58]


def test_a_camera_that_stood_before_copies_came_stays_as_sure(bus, world):
    world.depth = lambda image: depth_of(image, min(image.index, 19))
    standing = [frame(i, of=min(i, 19)) for i in range(40)]
    run(bus, [*standing, *(frame(i, of=19, duplicate=True) for i in range(40, 70))])
    sigma = {ros.stamp_ns(m): np.sqrt(np.trace(matrix(m)[:3, :3])) for m in bus.of("pose")}
    assert sigma[frame(69).stamp_ns] < 1.5 * sigma[frame(39).stamp_ns]


def test_a_copy_whose_original_was_dropped_is_looked_at(bus, world):
    # Of the later images, each of which comes twice, only the copies get through.
    of = {i: i for i in range(20)} | {2 * i - 19: i for i in range(20, 50)}
    world.depth = lambda image: depth_of(image, of[image.index])
    run(bus, [frame(n, of=i, duplicate=i >= 20) for n, i in of.items()])
    placed = positions(bus)
    for n in range(21, 80, 2):
        assert np.linalg.norm(placed[n] - true_position(of[n])) < 0.03 * SLACK


def test_a_copy_is_where_the_corrected_map_has_it(bus, world):
    world.update = None
    moved = {}

    def heard(topic, message):
        world.heard(topic, message)
        if topic == "tracked" and message.index == 12:
            keyframes = bus.of("keyframe")
            shift = from_rt(np.eye(3), np.array([1.0, 0.0, 0.0]))
            moved["keyframes"] = np.array([k.id for k in keyframes])
            moved["poses"] = np.array([shift @ k.world_from_camera for k in keyframes])
            bus.give("map_update", update_of(keyframes[-1], 1000, **moved))

    bus.hear = heard
    run(bus, [*(frame(i) for i in range(13)), frame(13, of=12, duplicate=True), frame(14)])
    placed = positions(bus)
    assert np.linalg.norm(placed[13] - placed[12]) == pytest.approx(1.0, abs=0.02)
    assert np.linalg.norm(placed[14] - placed[13]) < 0.05
    odom = [ros.pose_matrix(m.pose.pose)[:3, 3].tolist() for m in bus.of("odom")]
    assert odom[12] == odom[11]


def test_a_copy_before_anything_was_tracked_is_harmless(bus, world):
    run(bus, [frame(0, duplicate=True), frame(1, of=0, duplicate=True), frame(2), frame(3)])
    assert len(bus.of("tracked")) == 4
    assert len(bus.of("pose")) >= 2


def test_copies_of_the_first_image_are_placed_once_its_depth_has_come(bus, world):
    run(bus, [frame(0), *(frame(i, of=0, duplicate=True) for i in range(1, 12)), frame(12, of=1)])
    assert len(bus.of("pose")) >= 10
    placed = positions(bus)
    assert np.linalg.norm(placed[11] - true_position(0)) < 0.03
    assert len(bus.of("keyframe")) == 1


@pytest.mark.parametrize("copies", [True, False])
def test_images_that_fail_to_come_for_long_lose_the_camera_and_copies_of_one_do_not(bus, world, copies):
    """Copies may be what a camera at rest shows."""
    between = [frame(i, of=19, duplicate=True) for i in range(20, 60)] if copies else []
    after = [replace(frame(60 + i, of=20 + i), index=len(between) + 20 + i) for i in range(5)]
    run(bus, [*(frame(i) for i in range(20)), *between, *after])
    words = [told.odometry for told in bus.of("tracked")][-5:]
    assert words == ["ok" if copies else "lost", *["ok"] * 4]
