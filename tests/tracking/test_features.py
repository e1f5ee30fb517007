"""ORB features: spread, number, hopeless images; the index against brute force."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.config import TrackingConfig
from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.tracking.features import Features, OrbExtractor
from prism_edge.tracking.matching import candidate_pairs
from tests.geometry.by_opencv import undistorted
from tests.synthetic.scene import block_texture

CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)


def blocks(seed: int = 0) -> np.ndarray:
    """Random blocks of many sizes all over an image."""
    return block_texture(np.random.default_rng(seed), 640, 480)


def test_as_many_as_wanted_from_a_textured_image():
    features = OrbExtractor(TrackingConfig(features=1000, max_features=1000)).extract(blocks(), CAMERA)
    assert 900 <= len(features) <= 1000
    assert features.descriptors.shape == (len(features), 4)
    assert features.octaves.min() == 0
    assert features.octaves.max() > 3


def cells_with_features(pixels: np.ndarray, size: int) -> int:
    return len(np.unique((pixels // size).astype(int) @ (1, 1000)))


def test_every_textured_part_of_the_image_has_some():
    features = OrbExtractor(TrackingConfig(features=1000, max_features=1000)).extract(blocks(), CAMERA)
    inside = features.pixels[np.all((features.pixels > 40) & (features.pixels < (600, 440)), axis=1)]
    assert cells_with_features(inside - 40, 80) >= 7 * 5 - 2


def test_a_quarter_of_strong_corners_does_not_take_them_all():
    image = blocks()
    image[:, 160:] = 125 + (image[:, 160:].astype(float) - 125) * 0.6
    plain = cv2.ORB.create(nfeatures=1000, edgeThreshold=19, fastThreshold=10, scoreType=cv2.ORB_FAST_SCORE)
    clustered = cv2.KeyPoint.convert(plain.detect(image, None))
    features = OrbExtractor(TrackingConfig(features=1000, max_features=1000)).extract(image, CAMERA)
    weak, weak_clustered = ((p[:, 0] > 200).sum() for p in (features.pixels, clustered))
    assert weak > 1.5 * weak_clustered
    assert cells_with_features(features.pixels, 64) > cells_with_features(clustered, 64)


def test_descriptors_are_those_of_their_keypoints():
    config = TrackingConfig(features=400, max_features=400)
    image, extractor = blocks(2), OrbExtractor(config)
    plain = cv2.ORB.create(
        nfeatures=int(400 * extractor.surplus),
        scaleFactor=config.scale_factor,
        nlevels=config.levels,
        edgeThreshold=19,
        scoreType=cv2.ORB_FAST_SCORE,
        fastThreshold=config.fast_threshold,
    )
    keypoints, descriptors = plain.detectAndCompute(image, None)
    at_level_0 = {k.pt: d.tobytes() for k, d in zip(keypoints, descriptors, strict=True) if k.octave == 0}
    features = extractor.extract(image, CAMERA)
    mine = np.flatnonzero(features.octaves == 0)
    assert len(mine) > 50
    assert set(features.octaves.tolist()) > {0, 3}
    for i in mine:
        assert features.descriptors[i].tobytes() == at_level_0[tuple(np.rint(features.pixels[i]))]


def test_an_image_without_corners_gives_none():
    extractor = OrbExtractor(TrackingConfig())
    for image in (np.zeros((480, 640), np.uint8), np.full((480, 640), 255, np.uint8)):
        features = extractor.extract(image, CAMERA)
        assert len(features) == 0
        assert features.descriptors.shape == (0, 4)
        query, _ = candidate_pairs(features, np.array([[320.0, 240.0]]), np.array([50.0]))
        assert len(query) == 0


def test_an_image_smaller_than_a_patch_gives_none():
    image = np.random.default_rng(0).integers(0, 255, (24, 32), dtype=np.uint8)
    assert len(OrbExtractor(TrackingConfig()).extract(image, CAMERA)) == 0


def test_the_same_image_gives_the_same_features():
    first, second = (OrbExtractor(TrackingConfig()).extract(blocks(), CAMERA) for _ in range(2))
    assert np.array_equal(first.pixels, second.pixels)
    assert np.array_equal(first.descriptors, second.descriptors)


def test_pixels_of_a_distorted_camera_are_opencvs_ideal_ones():
    k = (-0.28, 0.07, 0.0002, 0.00002)
    camera = Camera(640, 480, 460.0, 455.0, 325.0, 245.0, "pinhole", k)
    raw, ideal = (OrbExtractor(TrackingConfig()).extract(blocks(), c) for c in (CAMERA, camera))
    expected = undistorted(raw.pixels, camera.matrix, np.array(k), camera.matrix)
    assert np.abs(ideal.pixels - expected).max() < 1e-3


def test_a_fisheyes_rim_is_left_out():
    """Rays at a right angle to the axis have no pixel in any pinhole image."""
    camera = Camera(640, 480, 150.0, 150.0, 319.5, 239.5, FISHEYE, (0.0, 0.0, 0.0, 0.0))
    raw, features = (OrbExtractor(TrackingConfig()).extract(blocks(), c) for c in (CAMERA, camera))
    assert np.isfinite(features.pixels).all()
    assert 100 < len(features) < len(raw)
    # equidistant: the angle from the axis is radius / f
    radius = np.linalg.norm(raw.pixels - (319.5, 239.5), axis=1)
    usable = radius < 1.2 * 150
    reach = 150.0 * np.tan(radius[usable] / 150.0)
    got = np.linalg.norm(features.pixels - (319.5, 239.5), axis=1)
    for r in reach:
        assert np.abs(got - r).min() < 1e-3


def test_where_a_lens_folds_over_there_are_none():
    """Those pixels belong to no ray: what undistortion makes of them lies anywhere."""
    camera = Camera(640, 480, 330.0, 330.0, 319.5, 239.5, "pinhole", (-0.33, 0.12, 5e-4, -3e-4, -0.02))
    raw, features = (OrbExtractor(TrackingConfig()).extract(blocks(), c) for c in (CAMERA, camera))
    assert 0.8 * len(raw) < len(features) < len(raw)
    back = camera.distort_pixels(features.pixels)
    assert max(np.linalg.norm(raw.pixels - pixel, axis=1).min() for pixel in back) < 1.5


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(0, 150),
    width=st.integers(5, 200),
    height=st.integers(5, 150),
)
def test_the_index_finds_what_brute_force_finds(seed, count, width, height):
    rng = np.random.default_rng(seed)
    # Undistortion puts some keypoints outside of the image.
    pixels = rng.uniform((-30.0, -30.0), (width + 30.0, height + 30.0), (count, 2))
    words = rng.integers(0, 2**64, (count, 4), dtype=np.uint64)
    features = Features.build(pixels, np.zeros(count, np.intp), words, width, height)
    centres = rng.uniform((-50.0, -50.0), (width + 50.0, height + 50.0), (20, 2))
    radii = rng.uniform(0.0, 60.0, 20)
    query, keypoint = candidate_pairs(features, centres, radii)
    expected = {
        (q, k) for q in range(20) for k in range(count) if np.abs(pixels[k] - centres[q]).max() <= radii[q]
    }
    assert set(zip(query.tolist(), keypoint.tolist(), strict=True)) == expected
    assert len(query) == len(expected)
    assert np.all(np.diff(query) >= 0)


def test_a_corner_lies_at_one_place_at_every_level():
    """OpenCV's own coordinates move down and right with the level, by up to two pixels at the sixth."""
    offsets: dict[int, list[np.ndarray]] = {o: [] for o in range(3, 6)}
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[0:480, 0:640]
    for _ in range(6):
        grid = np.array([(x, y) for y in range(60, 440, 60) for x in range(60, 600, 60)], float)
        centres = grid + rng.uniform(-8, 8, grid.shape)
        image = np.full((480, 640), 60.0)
        for x, y in centres:
            image += 190.0 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * 4.0**2))
        features = OrbExtractor(TrackingConfig(features=3000, max_features=3000)).extract(
            np.clip(image, 0, 255).astype(np.uint8), CAMERA
        )
        away = features.pixels[:, None] - centres
        nearest = away[np.arange(len(features)), np.linalg.norm(away, axis=2).argmin(axis=1)]
        for octave, found in offsets.items():
            found.append(nearest[features.octaves == octave])
    for found in offsets.values():
        mine = np.concatenate(found)
        assert len(mine) > 100
        # Corners found round a symmetric blob scatter evenly about it.
        assert np.all(np.abs(mine.mean(axis=0)) < 0.3), mine.mean(axis=0)


def test_a_larger_image_has_as_many_more_as_it_shows_more_and_a_smaller_one_not_fewer():
    """Up to three times as much; the numbers of the configuration are for 640 x 480."""
    extractor = OrbExtractor(TrackingConfig(features=300, max_features=400))
    for width, height, wanted in ((900, 640, 750), (1280, 960, 1200), (640, 480, 400), (480, 360, 400)):
        image = block_texture(np.random.default_rng(0), width, height)
        camera = Camera(width, height, 500.0, 500.0, width / 2 - 0.5, height / 2 - 0.5)
        for _ in range(6):  # the detector's threshold follows
            found = len(extractor.extract(image, camera))
        assert 0.8 * wanted < found <= wanted, (width, height)


def test_few_matches_bring_more_features_and_many_bring_fewer():
    config = TrackingConfig(features=300, max_features=600)
    extractor = OrbExtractor(config)
    image = blocks()

    def found() -> int:
        for _ in range(5):  # the detector's threshold follows
            features = extractor.extract(image, CAMERA)
        return len(features)

    assert 500 < found() <= 600
    for _ in range(10):
        extractor.want(400)
    assert 250 < found() <= 300
    for _ in range(10):
        extractor.want(225)  # neither few nor many
    assert found() <= 300
    for _ in range(10):
        extractor.want(50)
    assert 500 < found() <= 600


@pytest.mark.filterwarnings("error")
def test_levels_that_are_smaller_than_a_pixel_have_nothing():
    config = TrackingConfig(levels=12, scale_factor=2.0)
    assert len(OrbExtractor(config).extract(blocks(), CAMERA)) > 100


def test_through_another_lens_keypoints_are_filed_where_they_then_are():
    was, lens = CAMERA, CAMERA.bent(-0.1)
    features = OrbExtractor(TrackingConfig()).extract(blocks(), was)
    moved = features.through(lens, was)
    anew = OrbExtractor(TrackingConfig()).extract(blocks(), lens)
    np.testing.assert_allclose(moved.pixels, anew.pixels, atol=1e-6)
    assert np.array_equal(moved.descriptors, anew.descriptors)
    assert np.array_equal(moved.order, anew.order)
    assert np.array_equal(moved.cell_start, anew.cell_start)
    assert np.abs(moved.pixels - features.pixels).max() > 5.0


def test_points_of_an_edge_are_no_corners():
    """They slide along it: where a tiled wall's joints run, only their crossings are places."""
    rng = np.random.default_rng(3)
    wall = np.full((480, 640), 205.0)
    across = [((-20, 90), (660, 190)), ((-20, 290), (660, 390))]
    ends = [*across, ((150, -20), (90, 500)), ((470, -20), (410, 500))]
    for start, end in ends:
        cv2.line(wall, start, end, 60.0, 3, cv2.LINE_AA)
    image = np.clip(cv2.GaussianBlur(wall, (0, 0), 0.7) + rng.normal(0, 2.0, wall.shape), 0, 255)
    found = OrbExtractor(TrackingConfig()).extract(image.astype(np.uint8), CAMERA)
    lines = [np.cross((*start, 1.0), (*end, 1.0)) for start, end in ends]
    crossings = np.array([np.cross(a, b) for a in lines[:2] for b in lines[2:]])
    crossings = crossings[:, :2] / crossings[:, 2:]
    nearest = np.linalg.norm(found.pixels[:, None] - crossings, axis=2).min(axis=1)
    reach = 16.0 * 1.2**found.octaves  # of a corner's window
    assert (nearest < reach).sum() >= 4
    assert (nearest > reach).mean() < 0.1
