"""What the tracker worker makes of how well the scale is known where it is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.bus import ros
from prism_edge.messages import HOME
from tests.synthetic import messages
from tests.tracking.footage import IDENTITY, footage, other_room
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import (
    CONFIG,
    World,
    depth_of,
    frame,
    positions,
    run,
    scale_of,
    true_position,
)


def walked(local_sigma: float) -> tuple[float, np.ndarray]:
    """Drift of `odom` (m) after 30 frames in a map whose scale here is in doubt by so much, and its pose."""
    bus = ListBus("frame")
    World(bus).scale = lambda keyframe: scale_of(keyframe, local_sigma=local_sigma)
    run(bus, [frame(i) for i in range(30)])
    message = bus.of("odom")[-1]
    covariance = np.asarray(message.pose.covariance).reshape(6, 6)
    walk = bus.of("tracked")[-1].walk_m
    assert covariance[0, 0] > walk**2
    return walk, message.pose.pose.position


def test_odom_drifts_more_where_the_map_s_scale_is_in_doubt_and_stays_where_it_is():
    surely, place = walked(0.0)
    doubted, same = walked(1.0)
    assert doubted > 4.0 * surely > 0.0
    assert (place.x, place.y, place.z) == (same.x, same.y, same.z)


def test_a_doubt_that_is_no_number_is_ignored():
    assert walked(float("nan"))[0] == pytest.approx(walked(0.0)[0], rel=0.2)


def test_a_new_map_s_unit_is_unknown_until_the_scale_process_says_something_of_it():
    room, film = other_room(), footage()
    bus = ListBus("frame")
    world = World(bus)
    world.scale = lambda keyframe: scale_of(keyframe, epoch=0, sigma=0.1)
    world.depth = lambda image: (
        depth_of(image)
        if image.epoch == 0
        else messages.depth_of(image, room[image.index - 32][1], IDENTITY)
    )
    dark = [frame(i, 0, image=np.zeros_like(film.images[0])) for i in range(20, 32)]
    elsewhere = [frame(32 + i, 0, image=image) for i, (image, _, _) in enumerate(room)]
    run(bus, [*[frame(i) for i in range(20)], *dark, *elsewhere])
    firsts = {keyframe.epoch: keyframe.index for keyframe in reversed(bus.of("keyframe"))}
    assert list(firsts) == [1, 0], "the map was given up, and a new one begun"
    sigma = {tracked.index: tracked.scale_sigma for tracked in bus.of("tracked")}
    # Given up with the image before the one that the new map begins with.
    assert sigma[firsts[1] - 2] == pytest.approx(0.1)
    assert sigma[firsts[1] - 1] == sigma[91] == 1.0
    # `odom` goes on where it was, and says that nobody saw the way from there to the new map.
    seen = [film.stamp_ns(i) for i in range(92)]
    moved = {seen.index(ros.stamp_ns(m)): m for m in bus.of("odom")}
    last, first = max(i for i in moved if i < firsts[1]), min(i for i in moved if i > firsts[1])
    place = {i: ros.pose_matrix(moved[i].pose.pose)[:3, 3] for i in (last, first)}
    assert np.linalg.norm(place[first] - place[last]) < 0.1
    walk = {tracked.index: tracked.walk_m for tracked in bus.of("tracked")}
    assert walk[first] > 0.5 * (firsts[1] - last) / 30.0 > 3.0 * walk[last]
    assert moved[first].twist.covariance[0] == 100.0**2 > moved[first + 1].twist.covariance[0]


def test_a_part_s_scale_is_left_behind_with_it():
    """Back in the old map no keyframe need come to say again what is known of its unit."""
    room, film = other_room(), footage()
    bus = ListBus("frame")
    world = World(bus)
    world.scale = lambda keyframe: (
        scale_of(keyframe, sigma=0.1) if keyframe.part == HOME else scale_of(keyframe, 0.4, sigma=0.2)
    )
    rooms = {42 + i: depth for i, (_, depth, _) in enumerate(room)}
    world.depth = lambda image: (
        messages.depth_of(image, rooms[image.index], IDENTITY)
        if image.index in rooms
        else depth_of(image, image.index % 102)
    )
    black = np.zeros_like(film.images[0])
    dark = [frame(i, 0, image=black) for i in (*range(30, 42), *range(102, 114))]
    elsewhere = [frame(42 + i, 0, image=image) for i, (image, _, _) in enumerate(room)]
    back = [frame(114 + i, 12 + i) for i in range(12)]
    tracking = replace(CONFIG.tracking, submap_after_s=0.4)
    config = replace(CONFIG, tracking=tracking)
    run(bus, [*(frame(i) for i in range(30)), *dark[:12], *elsewhere, *dark[12:], *back], config)
    placed, sigma = positions(bus), {tracked.index: tracked.scale_sigma for tracked in bus.of("tracked")}
    assert not any(30 <= i < 114 for i in placed)
    found = min(i for i in placed if i >= 114)
    assert (sigma[29], sigma[101], sigma[found]) == (0.1, 0.2, 0.1)
    assert np.linalg.norm(placed[found] - true_position(12 + found - 114)) < 0.03
