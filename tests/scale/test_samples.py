import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.scale.samples import PATCHES_ACROSS, depth_at, sample
from tests.scale.scene import CAMERA, IMAGE_TO_DEPTH, depth_of_wall, keyframe_of_wall

DISTORTED = Camera(640, 480, 500.0, 500.0, 319.5, 239.5, distortion=(-0.25, 0.08, 0.001, -0.002))
FISH = Camera(640, 480, 300.0, 300.0, 319.5, 239.5, FISHEYE, (0.05, -0.01, 0.002, 0.0))


def at_wall(keyframe, camera, depth=None, min_parallax_deg=1.0):
    return sample(
        camera,
        keyframe.pixels,
        keyframe.depths,
        keyframe.parallax_deg,
        depth_of_wall(camera) if depth is None else depth,
        IMAGE_TO_DEPTH,
        min_parallax_deg,
    )


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED, FISH], ids=["ideal", "distorted", "fisheye"])
def test_a_perfect_network_shows_the_maps_unit_through_any_lens(camera):
    samples = at_wall(keyframe_of_wall(1, 0.0, metres_per_unit=0.8, camera=camera), camera)
    assert len(samples) == 200
    np.testing.assert_allclose(samples.log_ratios, np.log(0.8), atol=2e-4)


@pytest.mark.parametrize("camera", [DISTORTED, FISH], ids=["distorted", "fisheye"])
def test_distorting_undoes_undistorting(camera):
    raw = np.random.default_rng(0).uniform((20, 20), (620, 460), (50, 2))
    np.testing.assert_allclose(camera.distort_pixels(camera.undistort_pixels(raw)), raw, atol=1e-3)


def test_seeded_and_barely_triangulated_points_are_never_used():
    keyframe = keyframe_of_wall(1, 0.0)
    keyframe.parallax_deg[:50] = 0.0
    keyframe.parallax_deg[50:80] = 0.9
    keyframe.depths[80:90] = 0.0
    keyframe.depths[90:95] = np.nan
    np.testing.assert_array_equal(at_wall(keyframe, CAMERA).keypoints, np.arange(95, 200))
    assert at_wall(keyframe, CAMERA, min_parallax_deg=0.0).keypoints.min() == 50


def test_patches_number_the_squares_of_the_image():
    keyframe = keyframe_of_wall(1, 0.0)
    samples = at_wall(keyframe, CAMERA)
    squares = np.floor((keyframe.pixels[samples.keypoints] + 0.5) / (640 / PATCHES_ACROSS))
    same_square = (squares[:, None] == squares[None]).all(axis=2)
    np.testing.assert_array_equal(samples.patches[:, None] == samples.patches[None], same_square)


@given(
    st.floats(-0.01, 0.01),
    st.floats(-0.01, 0.01),
    st.lists(st.tuples(st.floats(0, 31), st.floats(0, 23)), min_size=1, max_size=20),
)
@settings(max_examples=40, deadline=None)
def test_interpolation_of_a_plane_is_exact(slope_x, slope_y, positions):
    y, x = np.mgrid[0:24, 0:32]
    positions = np.array(positions)
    values, counts = depth_at(3.0 + slope_x * x + slope_y * y, positions)
    assert counts.all()
    np.testing.assert_allclose(values, 3.0 + positions @ (slope_x, slope_y), atol=1e-12)


def test_edges_holes_and_the_outside_do_not_count():
    depth = np.full((24, 32), 2.0, np.float32)
    depth[:, 16:] = 2.5  # an edge between columns 15 and 16
    depth[4, 4] = 0.0
    depth[4, 10] = np.nan
    depth[20, 4] = -1.0
    depth[20, 10] = np.inf
    sound = np.array([[8, 12], [24, 12], [31.4, 23.4], [-0.4, -0.4]])
    values, counts = depth_at(depth, sound)
    assert counts.all()
    np.testing.assert_allclose(values, [2.0, 2.5, 2.5, 2.0])
    at_edge, by_hole = [[15.4, 12], [16, 12]], [[5, 5], [10, 4], [4, 20], [9.4, 20.2]]
    outside = [[-0.6, 5], [31.6, 5], [5, -0.6], [5, 23.6], [np.nan, 5]]
    _, counts = depth_at(depth, np.array([*at_edge, *by_hole, *outside]))
    assert not counts.any()


@pytest.mark.parametrize("shape", [(0, 0), (2, 5), (5, 2), (1, 1)])
def test_a_map_too_small_for_a_window_counts_nowhere(shape):
    _, counts = depth_at(np.ones(shape, np.float32), np.zeros((3, 2)))
    assert not counts.any()


def test_a_keyframe_without_keypoints_gives_no_samples():
    assert len(at_wall(keyframe_of_wall(1, 0.0, points=0), CAMERA)) == 0
    assert len(at_wall(keyframe_of_wall(1, 0.0), CAMERA, depth=np.zeros((120, 160), np.float32))) == 0
