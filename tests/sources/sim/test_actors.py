"""People: they move, stay whole, walk on the floor, and meet neither furniture nor the camera."""

from __future__ import annotations

import numpy as np

from prism_edge.geometry.poses import Array
from prism_edge.sources.sim import SimSource
from prism_edge.sources.sim.actors import Walker, walkers_at
from prism_edge.sources.sim.floorplan import Lane


def walker(seed: int = 0) -> Walker:
    lane = Lane(0, np.array([1.0, 2.0]), np.array([3.0, 2.0]))
    return Walker.random(np.random.default_rng(seed), lane, [])


def gap(low: Array, high: Array, other_low: Array, other_high: Array) -> float:
    """Least distance between two sets of boxes."""
    apart = np.maximum(low[:, None] - other_high[None], other_low[None] - high[:, None])
    return float(np.linalg.norm(np.maximum(apart, 0.0), axis=2).min())


def test_walks_its_lane_there_and_back() -> None:
    who = walker()
    times = np.arange(0.0, 60.0, 0.05)
    places = np.array([who.where(t)[0] for t in times])
    assert np.abs(places[:, 1] - 2.0).max() < 1e-9
    assert places[:, 0].min() < 1.05
    assert places[:, 0].max() > 2.95
    speed = np.abs(np.diff(places[:, 0])) / 0.05
    assert 0.4 < speed.max() < 1.2
    # looks where it goes, except while it turns round
    ahead = np.cos([who.where(t)[1] for t in times[:-1]])
    moving = speed > 0.6 * speed.max()
    assert np.all(np.sign(np.diff(places[:, 0]))[moving] * ahead[moving] > 0.9)


def test_keeps_its_shape_and_its_bounds() -> None:
    who = walker(1)
    for seconds in (0.0, 0.4, 1.7, 2.9):
        now = who.at(seconds)
        assert np.allclose(np.linalg.norm(now.right, axis=1), np.linalg.norm(who.surfaces.right, axis=1))
        corners = np.stack([now.origin, now.origin + now.right, now.origin + now.down], axis=1)
        assert np.all(corners >= now.body_low[now.body][:, None] - 1e-9)
        assert np.all(corners <= now.body_high[now.body][:, None] + 1e-9)
        assert abs(now.body_low[:, 2].min()) < 1e-9
        assert 1.5 < now.body_high[:, 2].max() < 2.0
        assert np.allclose(now.normal, np.cross(now.down, now.right))


def test_people_meet_nothing(room: SimSource, loop: SimSource) -> None:
    for source in (room, loop):
        renderer, _ = source._opened()
        assert len(source._walkers) == 3
        for index in range(0, source.frame_count, 60):
            camera = source.pose(index)[None, :3, 3]
            everybody = walkers_at(source._walkers, source.stamp_ns(index) * 1e-9)
            for number, people in everybody.items():
                cell = renderer.world.cells[number]
                fixed = cell.surfaces
                assert gap(people.body_low, people.body_high, fixed.body_low, fixed.body_high) > 0.0
                assert gap(people.body_low, people.body_high, camera, camera) > 0.2
                assert np.all(people.body_low[:, :2] > cell.low[:2])
                assert np.all(people.body_high[:, :2] < cell.high[:2])
        single = [w.at(12.0) for w in source._walkers]
        for k, one in enumerate(single):
            for other in single[k + 1 :]:
                assert gap(one.body_low, one.body_high, other.body_low, other.body_high) > 0.0


def test_people_show_in_picture_and_depth(room: SimSource) -> None:
    with SimSource("sim:room?seed=5&width=160&height=120&noise=0&blur=0&exposure=0") as empty:
        shares = []
        for index in range(0, 900, 90):
            without, depth = empty.image(index).pixels, empty.depth(index)
            nearer = room.depth(index) < depth - 0.05
            changed = np.any(room.image(index).pixels != without, axis=2)
            shares.append(nearer.mean())
            assert np.mean(room.depth(index) > depth + 1e-3) < 1e-3  # a person only ever hides
            if nearer.mean() > 0.02:
                assert changed[nearer].mean() > 0.9
            assert changed.mean() < nearer.mean() + 0.05
        assert max(shares) > 0.05
