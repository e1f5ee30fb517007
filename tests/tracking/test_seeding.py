"""Points from network depth: which pixel a keypoint gets, and where its point is."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.geometry.poses import inverse, transform
from prism_edge.tracking.features import Features
from prism_edge.tracking.local_map import LocalKeyframe, LocalMap
from prism_edge.tracking.seeding import ANYWHERE, sample_depth, seed_at_middle, seed_from_depth
from tests.tracking.cloud import pose_at

WIDE = (0.25, -0.375, 0.25, -0.375)  # a network at a quarter of the size, outer corners in line
CAMERAS = [
    Camera(640, 480, 500.0, 500.0, 319.5, 239.5),
    Camera(640, 480, 460.0, 455.0, 325.0, 245.0, "pinhole", (-0.28, 0.07, 0.0002, 0.00002)),
    Camera(640, 480, 300.0, 300.0, 319.5, 239.5, FISHEYE, (0.01, -0.003, 0.0, 0.0)),
]


def wall(rays: np.ndarray) -> np.ndarray:
    """Depth (n,) along z of the plane 0.2 x + 0.1 y + z = 3 on rays (n, 2)."""
    return 3.0 / (1.0 + 0.2 * rays[:, 0] + 0.1 * rays[:, 1])


def picture_of_wall(camera: Camera) -> np.ndarray:
    """Depth (120, 160) of the wall as the network gives it: for pixels of the raw, distorted image."""
    y, x = np.mgrid[0:120, 0:160].astype(float)
    pixels = np.column_stack([(x.ravel() - WIDE[1]) / WIDE[0], (y.ravel() - WIDE[3]) / WIDE[2]])
    return wall(camera.normalise(pixels)).reshape(120, 160).astype(np.float32)


def keyframe_of(camera: Camera, pose: np.ndarray, count: int = 150) -> tuple[LocalMap, LocalKeyframe]:
    rng = np.random.default_rng(0)
    raw = rng.uniform((40, 40), (600, 440), (count, 2))
    words = rng.integers(0, 2**64, (count, 4), dtype=np.uint64)
    features = Features.build(camera.undistort_pixels(raw), np.zeros(count, np.intp), words, 640, 480)
    keyframe = LocalKeyframe(0, 0, 0, pose, camera, features, np.full(count, -1, np.int64))
    world = LocalMap()
    world.add_keyframe(keyframe)
    return world, keyframe


@pytest.mark.parametrize("camera", CAMERAS)
def test_seeds_lie_on_the_wall(camera):
    pose = pose_at(0.3, -0.2, 0.5, 0.1, 0.2, -0.1)
    world, keyframe = keyframe_of(camera, pose)
    ids = seed_from_depth(world, keyframe, picture_of_wall(camera), np.array(WIDE), 0.5, 0.2, 1000)
    assert len(ids) > 140
    local = 2.0 * transform(inverse(pose), world.points.position)  # map units of 2 m
    off = local @ (0.2, 0.1, 1.0) - 3.0
    assert np.abs(off).max() < 0.03  # the nearest pixel's depth stands for the keypoint's
    pixels = camera.ideal().project(local)
    seen = keyframe.features.pixels[world.points.reference_keypoint]
    assert pixels == pytest.approx(seen, abs=1e-6)
    assert (world.points.log_depth_sigma == 0.2).all()
    assert not world.points.parallax_deg.any()
    assert np.array_equal(keyframe.points[world.points.reference_keypoint], ids)
    told = world.points.reference_keypoint
    assert keyframe.metres is not None
    assert keyframe.metres[told] == pytest.approx(local[:, 2])  # what the unit is has no part in it
    assert not np.delete(keyframe.metres, told).any()


@pytest.mark.parametrize("camera", CAMERAS)
def test_raw_pixels_undo_undistortion(camera):
    raw = np.random.default_rng(1).uniform((60, 60), (580, 420), (40, 2))
    assert camera.distort_pixels(camera.undistort_pixels(raw)) == pytest.approx(raw, abs=1e-4)


@pytest.mark.parametrize("behind", [0, 3])
def test_triangulated_points_set_the_unit(behind):
    """The network is 30 % off in this frame and the filter can't know; the map's own points do.

    Some of which may have come to lie behind the camera.
    """
    camera = CAMERAS[0]
    world, keyframe = keyframe_of(camera, np.eye(4))
    firm = np.arange(40)
    rays = camera.normalise(keyframe.features.pixels[firm])
    positions = np.column_stack([rays, np.ones(40)]) * wall(rays)[:, None]
    positions[:behind] *= -1.0
    world.add_points(keyframe, firm, positions, np.full(40, 0.01), 5.0)
    ids = seed_from_depth(world, keyframe, 1.3 * picture_of_wall(camera), np.array(WIDE), 1.0, 0.2, 1000)
    off = world.points.position[world.points.rows(ids)] @ (0.2, 0.1, 1.0) - 3.0
    assert np.abs(off).max() < 0.03


def test_a_keyframe_keeps_the_metres_that_are_of_use_and_no_others():
    camera, depth = CAMERAS[1], picture_of_wall(CAMERAS[1])
    depth[:, 80:] *= 2.0  # an edge, whose pixels have a depth and are of none of both sides
    world, keyframe = keyframe_of(camera, np.eye(4))
    seed_from_depth(world, keyframe, depth, np.array(WIDE), 1.0, 0.2, 1000)
    good, metres = sample_depth(depth, np.array(WIDE), camera.distort_pixels(keyframe.features.pixels))
    assert 0 < (~good & (metres > 0.0)).sum() < 20
    assert keyframe.metres.tolist() == np.where(good, metres, 0.0).tolist()


def test_what_is_seeded_beside_points_that_rays_place_follows_them_and_is_as_sure():
    """The network finds one half of the image a sixth larger: no one ratio is right for both."""
    camera, depth = CAMERAS[0], picture_of_wall(CAMERAS[0])
    depth[:, 80:] *= 1.18
    world, keyframe = keyframe_of(camera, np.eye(4), count=400)
    firm = np.arange(200)
    rays = camera.normalise(keyframe.features.pixels[firm])
    places = np.column_stack([rays, np.ones(len(firm))]) * wall(rays)[:, None]
    world.add_points(keyframe, firm, places, np.full(len(firm), 0.01), 5.0)
    rows = world.points.rows(seed_from_depth(world, keyframe, depth, np.array(WIDE), 1.0, 0.5, 1000))
    assert len(rows) > 150
    off = world.points.position[rows] @ (0.2, 0.1, 1.0) / 3.0 - 1.0
    aside = np.abs(keyframe.features.pixels[world.points.reference_keypoint[rows], 0] - 320.0) > 60.0
    assert np.abs(off[aside]).mean() < 0.03  # one ratio: 0.08
    assert np.median(world.points.log_depth_sigma[rows]) < 0.1


def test_points_where_the_network_has_no_depth_say_nothing_of_its_scale():
    camera, depth = CAMERAS[0], picture_of_wall(CAMERAS[0])
    world, keyframe = keyframe_of(camera, np.eye(4))
    firm = np.arange(40)
    rays = camera.normalise(keyframe.features.pixels[firm])
    places = np.column_stack([rays, np.ones(len(firm))]) * wall(rays)[:, None]
    world.add_points(keyframe, firm, places, np.full(len(firm), 0.01), 5.0)
    for x, y in keyframe.features.pixels[firm[:10]]:
        depth[round(y * WIDE[2] + WIDE[3]), round(x * WIDE[0] + WIDE[1])] = 0.0
    ids = seed_from_depth(world, keyframe, depth, np.array(WIDE), 1.0, 0.2, 1000)
    assert len(ids) > 90
    off = world.points.position[world.points.rows(ids)] @ (0.2, 0.1, 1.0) - 3.0
    assert np.abs(off).max() < 0.03


def test_few_or_seeded_points_do_not():
    camera = CAMERAS[0]
    for count, parallax in ((10, 5.0), (40, 0.0)):
        world, keyframe = keyframe_of(camera, np.eye(4))
        rays = camera.normalise(keyframe.features.pixels[:count])
        positions = 2.0 * np.column_stack([rays, np.ones(count)]) * wall(rays)[:, None]
        world.add_points(keyframe, np.arange(count), positions, np.full(count, 0.01), parallax)
        ids = seed_from_depth(world, keyframe, picture_of_wall(camera), np.array(WIDE), 1.0, 0.2, 1000)
        off = world.points.position[world.points.rows(ids)] @ (0.2, 0.1, 1.0) - 3.0
        assert np.abs(off).max() < 0.03


def test_only_free_keypoints_and_no_more_than_asked():
    world, keyframe = keyframe_of(CAMERAS[0], np.eye(4))
    depth = picture_of_wall(CAMERAS[0])
    first = seed_from_depth(world, keyframe, depth, np.array(WIDE), 1.0, 0.2, 30)
    assert len(first) == 30
    before = keyframe.points.copy()
    seed_from_depth(world, keyframe, depth, np.array(WIDE), 1.0, 0.2, 30)
    assert (world.points.ids == np.arange(60)).all()
    assert np.array_equal(keyframe.points[before >= 0], before[before >= 0])
    assert len(np.unique(world.points.reference_keypoint)) == 60


def test_sampling_takes_the_nearest_pixel():
    depth = np.arange(1000.0, 1600.0, dtype=np.float32).reshape(20, 30)
    pixels = np.array([[40.0, 20.0], [43.9, 20.0], [44.1, 24.1]])
    good, values = sample_depth(depth, np.array([0.25, 0.0, 0.25, 0.0]), pixels)
    assert good.all()
    assert values.tolist() == [depth[5, 10], depth[5, 11], depth[6, 11]]


def test_sampling_goes_by_where_the_network_s_picture_begins():
    """Pictures are padded and cropped: a keypoint's pixel is off by whole pixels, each way by others."""
    depth = np.arange(1000.0, 1600.0, dtype=np.float32).reshape(20, 30)
    good, values = sample_depth(depth, np.array([0.25, 3.0, 0.5, -2.0]), np.array([[40.0, 20.0]]))
    assert good.all()
    assert values.tolist() == [depth[8, 13]]


def test_edges_holes_and_the_outside_are_not_used():
    depth = np.full((20, 30), 2.0, np.float32)
    depth[:, 15:] = 4.0
    depth[3, 4] = 0.0
    depth[10, 4] = np.nan
    depth[15, 4] = np.inf
    x, y = [5, 14, 15, 4, 5, 5, 25, -1, 30, 5], [12, 12, 12, 4, 11, 14, 12, 5, 5, 20]
    good, values = sample_depth(depth, np.array([1.0, 0.0, 1.0, 0.0]), np.column_stack([x, y]) * 1.0)
    assert good.tolist() == [True, False, False, False, False, False, True, False, False, False]
    assert values[[0, 6]].tolist() == [2.0, 4.0]


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (2, 2), (0, 5)])
def test_a_depth_map_too_small_to_look_round_a_pixel_gives_nothing(shape):
    good, _ = sample_depth(np.ones(shape, np.float32), np.array([1.0, 0, 1.0, 0]), np.zeros((3, 2)))
    assert not good.any()


def test_a_mapping_that_is_not_a_number_gives_nothing():
    good, _ = sample_depth(np.ones((9, 9), np.float32), np.full(4, np.nan), np.ones((3, 2)))
    assert not good.any()


def test_nothing_usable_seeds_nothing():
    for depth in (np.zeros((120, 160), np.float32), np.full((120, 160), np.nan, np.float32)):
        world, keyframe = keyframe_of(CAMERAS[0], np.eye(4))
        assert len(seed_from_depth(world, keyframe, depth, np.array(WIDE), 1.0, 0.2, 100)) == 0
        assert len(world.points) == 0


def test_of_a_network_that_does_not_tell_near_from_far_nothing_is_kept():
    """What few points leave free is somewhere in the middle of what they see."""
    pose = pose_at(0.3, -0.2, 0.5, 0.1, 0.2, -0.1)
    world, keyframe = keyframe_of(CAMERAS[0], pose)
    firm = np.arange(60)
    rays = CAMERAS[0].normalise(keyframe.features.pixels[firm])
    depths = np.random.default_rng(3).uniform(2.0, 20.0, 60)
    places = np.column_stack([rays, np.ones(60)]) * depths[:, None]
    world.add_points(keyframe, firm, transform(pose, places), np.full(60, 0.01), 5.0)
    flat = np.full((120, 160), 5.0, np.float32)
    for most in (50, 60):
        assert len(seed_from_depth(world, keyframe, flat, np.array(WIDE), 1.0, 0.2, most)) == 0
    ids = seed_from_depth(world, keyframe, flat, np.array(WIDE), 1.0, 0.2, 100)
    assert keyframe.metres is None
    assert len(ids) == 40
    rows = world.points.rows(ids)
    local = transform(inverse(pose), world.points.position[rows])
    assert local[:, 2] == pytest.approx(np.median(depths))
    seen = keyframe.features.pixels[world.points.reference_keypoint[rows]]
    assert CAMERAS[0].project(local) == pytest.approx(seen, abs=1e-6)
    assert (world.points.log_depth_sigma[rows] == ANYWHERE).all()


def test_a_keyframe_that_sees_nothing_has_no_middle():
    world, keyframe = keyframe_of(CAMERAS[0], np.eye(4))
    assert len(seed_at_middle(world, keyframe, 100)) == 0
