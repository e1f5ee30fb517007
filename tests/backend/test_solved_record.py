"""What a window moved, written down and taken over by another map that had heard the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.frame import keep_frame
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.mapper import Mapper
from prism_edge.backend.solved_record import solution_of, solved_arrays
from prism_edge.config import BackendConfig
from prism_edge.errors import MapError
from tests.backend.world import Teller, check, depth_at_keypoints
from tests.tracking.cloud import pose_at

CONFIG = BackendConfig(observations=60)  # few: many points are none of a window's, and go along


def told_twice(count: int = 8, restored_at: int = -1) -> tuple[Mapper, Mapper]:
    """One solves each window; the other hears of the same keyframes and takes the records over.

    From ``restored_at`` on it is one that went on from what a journal's base says of the first.
    """
    first, second = Mapper(CONFIG), Mapper(CONFIG)
    teller = Teller(500, noise_px=0.5)
    rng = np.random.default_rng(0)
    for i in range(count):
        message = teller.keyframe(pose_at(0.15 * i, 0.0, 0.02 * i, 0.0, -0.03 * i))
        wrong = rng.permutation(len(message.pixels))[:3]
        message.pixels[wrong] += 60.0
        for mapper in (first, second):
            mapper.absorb(message)
            for point in mapper.world.points.values():  # most are made from the newer of two views
                point.made_by = sorted(point.keyframes)[:2][-1]
            depth_at_keypoints(mapper.world, teller.cloud, teller.poses)
        update = first.optimise(i, 0.0) if i else None
        if update is not None:
            _, arrays = map_file.unpack(map_file.pack({}, solved_arrays(update)))
            second.replay(solution_of(arrays))
        if i == restored_at:
            info, base = first.stored(in_use=True)
            second.restore(*map_file.unpack(map_file.pack({**info, **KnownScale().info}, base)))
    return first, second


@pytest.mark.parametrize("restored_at", [-1, 7])
def test_replayed_the_map_is_as_it_was_with_points_that_went_along_and_observations_that_went(
    restored_at: int,
) -> None:
    first, second = told_twice(restored_at=restored_at)
    if restored_at > 0:  # one window more: what it leaves out is of the base alone
        first.world.keyframes[7].world_from_camera = first.world.keyframes[7].world_from_camera @ pose_at(0.1)
        second.world.keyframes[7].world_from_camera = first.world.keyframes[7].world_from_camera
        update = first.optimise(7, 0.0)
        assert update is not None
        second.replay(solution_of(solved_arrays(update)))
    check(second.world)
    assert second.world.keyframes.keys() == first.world.keyframes.keys()
    assert second.world.points.keys() == first.world.points.keys()
    for k, keyframe in first.world.keyframes.items():
        taken = second.world.keyframes[k]
        assert taken.world_from_camera == pytest.approx(keyframe.world_from_camera, abs=1e-9)
        assert taken.observed == keyframe.observed
    for p, point in first.world.points.items():
        assert second.world.points[p].position == pytest.approx(point.position, abs=1e-5)
        assert second.world.points[p].parallax_deg == pytest.approx(point.parallax_deg, abs=1e-4)


def test_what_was_replayed_is_where_the_map_belongs() -> None:
    """Else the next window would move all of the map back to where it was before them."""
    _, second = told_twice()
    assert not keep_frame(second.world)


def test_what_is_not_here_is_passed_over_and_what_cannot_be_is_refused() -> None:
    first, second = told_twice()
    update = first.optimise(7, 0.0)
    assert update is not None
    arrays = solved_arrays(update)
    strange = replace(update, keyframes=update.keyframes + 100, points=update.points + 10**6)
    before = {p: point.position.copy() for p, point in second.world.points.items()}
    second.replay(solution_of(solved_arrays(strange)))
    for p, point in second.world.points.items():
        assert (point.position == before[p]).all()
    with pytest.raises(MapError, match="can't be"):
        solution_of(arrays | {"poses": np.full_like(arrays["poses"], np.nan)})
    for name in ("poses", "positions"):
        hurt = arrays[name].copy()
        hurt.flat[5] = np.inf  # one number of them all
        with pytest.raises(MapError, match="can't be"):
            solution_of(arrays | {name: hurt})
    with pytest.raises(MapError, match="zip"):
        solution_of(arrays | {"points": arrays["points"][1:]})
    with pytest.raises(MapError, match=r"poses|points"):
        solution_of({"solved": arrays["solved"]})


def test_a_point_that_ran_off_is_left_out_as_of_a_stored_map():
    first, second = told_twice()
    update = first.optimise(7, 0.0)
    assert update is not None
    update.positions[3] = (0.0, 0.0, 1e39)
    arrays = solved_arrays(update)
    assert set(update.points.tolist()) - set(arrays["points"].tolist()) == {int(update.points[3])}
    second.replay(solution_of(arrays))
    check(second.world)
