"""What is said of each part's scale, and what it makes `odom` err by."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.config import CovarianceConfig
from prism_edge.messages import HOME, Scale
from prism_edge.tracking import scale_here
from prism_edge.tracking.drift import Drift
from prism_edge.tracking.odometry import MetricOdometry
from prism_edge.tracking.scale_here import UNKNOWN_SCALE_SIGMA, ScaleHere
from tests.tracking.cloud import pose_at


class Camera:
    """One that walks along x, and is told of its scale."""

    def __init__(self) -> None:
        parts = SimpleNamespace(current=HOME)
        self.tracker = SimpleNamespace(epoch=0, log_scale=0.0, map_log_scale=0.0, parts=parts)
        self.odometry, self.drift = MetricOdometry(), Drift(CovarianceConfig())
        self.scale = ScaleHere(self.tracker, self.odometry, self.drift)

    def walk(self, metres: float) -> None:
        step = pose_at(metres * np.exp(-self.tracker.log_scale))
        self.odometry.advance(np.eye(4), step, self.tracker.log_scale, 0)

    def hear(self, log_scale: float, sigma: float, part: int = HOME, local_sigma: float = 0.0) -> None:
        rest = {"observation": 0.0, "observation_sigma": 0.1, "points": 9, "accepted": True}
        for_map = log_scale + 0.05
        told = Scale(0, 0, 0, log_scale, for_map, sigma, sigma, local_sigma=local_sigma, part=part, **rest)
        self.scale.hear(told)

    def enter(self, part: int) -> None:
        self.tracker.parts.current = part
        self.scale.enter()

    @property
    def known(self) -> tuple[float, float, float]:
        return self.tracker.log_scale, self.scale.sigma, self.drift.local_sigma

    @property
    def error(self) -> float:
        return float(np.linalg.norm(self.scale.odom_error))


@pytest.fixture
def camera() -> Camera:
    return Camera()


def test_each_part_has_what_was_said_of_it_last(camera):
    assert camera.known == (0.0, UNKNOWN_SCALE_SIGMA, 0.0)
    camera.hear(0.1, 0.12, local_sigma=0.2)
    camera.enter(60)
    assert camera.known == (0.1, 0.12, 0.2), "nothing else is known of it yet"
    camera.hear(0.11, 0.11)  # a late word of home, by which the part is seeded
    assert camera.known == (0.11, 0.11, 0.0)
    camera.hear(0.3, 0.17, part=60)
    camera.hear(0.1, 0.12)  # later still: it is not the part's
    assert camera.known == (0.3, 0.17, 0.0)
    camera.enter(HOME)
    assert camera.known == (0.1, 0.12, 0.0)
    camera.hear(0.4, 0.16, part=60)
    assert camera.known == (0.1, 0.12, 0.0)
    camera.enter(60)
    assert camera.known == (0.4, 0.16, 0.0)


def test_a_map_is_built_by_a_scale_of_its_own_and_a_new_part_begins_with_what_is_published(camera):
    camera.hear(0.1, 0.12)
    assert camera.tracker.map_log_scale == pytest.approx(0.15)
    camera.enter(60)
    assert camera.tracker.map_log_scale == 0.1
    camera.hear(0.11, 0.11)  # of home; the part's own unit is not told yet
    assert camera.tracker.map_log_scale == 0.11
    camera.hear(0.3, 0.17, part=60)
    assert camera.tracker.map_log_scale == pytest.approx(0.35)
    camera.enter(HOME)
    assert camera.tracker.map_log_scale == pytest.approx(0.16)


def test_home_keeps_the_scale_that_a_map_was_taken_over_with(camera):
    camera.tracker.epoch, camera.tracker.log_scale = 1000, 0.2
    camera.scale.begin(0.05)
    camera.enter(60)
    assert camera.known == (0.2, 0.05, 0.0), "nothing else is known of it yet"
    camera.hear(0.45, 0.12, part=60)
    camera.enter(HOME)
    assert camera.known == (0.2, 0.05, 0.0)
    camera.scale.begin()  # a new map, of which nothing is known
    camera.hear(0.3, 0.1, part=70)
    assert camera.known == (0.3, 0.1, 0.0)


def test_of_parts_without_end_home_the_present_one_and_the_last_told_are_known(camera, monkeypatch):
    monkeypatch.setattr(scale_here, "MOST", 3)
    camera.hear(0.1, 0.12)
    camera.enter(60)
    for part in range(60, 70):
        camera.hear(0.01 * part, 0.17, part=part)
    assert set(camera.scale._told) == {HOME, 60, 67, 68, 69}
    camera.hear(0.67, 0.17, part=67)  # again
    camera.hear(0.7, 0.17, part=70)
    assert set(camera.scale._told) == {HOME, 60, 69, 67, 70}
    assert camera.known == (0.6, 0.17, 0.0)
    camera.enter(HOME)
    assert camera.known == (0.1, 0.12, 0.0)


def test_in_one_map_the_whole_way_has_the_present_sigma(camera):
    camera.walk(3.0)
    for sigma in (0.2, 0.1):
        camera.hear(0.05, sigma)
        assert camera.error == pytest.approx(3.0 * sigma)


def test_the_way_that_was_gone_in_another_map_keeps_the_sigma_that_it_had(camera):
    camera.hear(0.0, 0.1)
    camera.walk(50.0)
    camera.tracker.epoch, camera.tracker.log_scale = 1, 0.0
    camera.scale.enter()
    assert camera.known == (0.0, UNKNOWN_SCALE_SIGMA, 0.0), "nothing of the old map is taken for the new"
    assert camera.error == pytest.approx(5.0)
    camera.walk(0.5)
    assert camera.error == pytest.approx(5.5)
    camera.hear(0.0, 0.2)
    assert camera.error == pytest.approx(5.1)
    camera.scale.begin(0.3)  # a map is taken over
    camera.walk(1.0)
    assert camera.error == pytest.approx(5.4)


def test_the_way_in_a_part_has_the_part_s_sigma(camera):
    camera.hear(0.0, 0.1)
    camera.walk(10.0)
    camera.enter(60)
    camera.hear(0.0, 0.2, part=60)
    camera.walk(10.0)
    camera.enter(HOME)
    camera.walk(-20.0)  # back where it began: only what the part erred by more is left
    assert camera.error == pytest.approx(1.0 + 2.0 - 2.0)


def test_asked_at_each_frame_the_same_part_stays_one_way(camera):
    """A scale that is known better now was that of all the way in this part, however often it was asked."""
    camera.hear(0.0, 0.5)
    for _ in range(10):
        camera.walk(1.0)
        camera.enter(HOME)
    camera.hear(0.0, 0.1)
    assert camera.error == pytest.approx(1.0)
