"""What the estimator thinks of a network's spread after another, a depth camera, or in another part."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from prism_edge.backend.map_scale import KnownScale
from prism_edge.config import ScaleConfig
from prism_edge.messages import HOME, Scale
from prism_edge.scale.estimator import ScaleEstimator
from prism_edge.scale.least_squares import Observation
from tests.scale.scene import depth_of, keyframe_of_wall

STEP_S = 0.5
UNKNOWN = float("nan")  # what a network says of how its images agree; a depth camera knows


class Player:
    """Keyframes of a wall, whose depths err in size by an AR(1) process of a spread."""

    def __init__(self, seed: int = 0) -> None:
        self.estimator = ScaleEstimator(ScaleConfig())
        self._rng, self._error, self._count = np.random.default_rng(seed), 0.0, 0

    def play(
        self,
        count: int,
        spread: float,
        model: str = "net@0123456789ab",
        bias: float = 0.1,
        said: float = UNKNOWN,
        part: int = HOME,
        metres_per_unit: float = 1.0,
        joined: tuple[int, int] | None = None,
    ) -> list[Scale]:
        """The scales that the estimator gives; with ``joined`` the first keyframe says so of two parts."""
        scales, phi = [], math.exp(-STEP_S / 2.0)
        for _ in range(count):
            k, self._count = self._count, self._count + 1
            self._error = phi * self._error + self._rng.normal() * spread * math.sqrt(1.0 - phi**2)
            keyframe = keyframe_of_wall(k, k * STEP_S, metres_per_unit, parallax_deg=3.0 if k else 0.0)
            keyframe = replace(keyframe, part=part, log_scale=0.0)
            if joined is not None:
                told = {"joined": np.array([joined], np.int64), "joined_units": np.array([[0.0, 0.02]])}
                keyframe, joined = replace(keyframe, **told), None
            depth = replace(depth_of(keyframe, float(np.exp(self._error))), bias_sigma=bias)
            self.estimator.hear(keyframe)
            answer = self.estimator.process(keyframe, replace(depth, frame_sigma=said, model=model))
            assert answer is not None
            scales.append(answer[0])
        return scales


@pytest.mark.parametrize("spread", [0.15, 0.5])
def test_a_network_after_a_depth_camera_is_judged_as_after_any_other(spread: float) -> None:
    """A reload of depth.model: what the camera said of itself is not true of a network."""
    runs = []
    for model, said in (("sensor", 0.02), ("other@0123456789ac", UNKNOWN)):
        player = Player()
        player.play(20, 0.02, model, 0.01, said)
        runs.append((player.play(120, spread), player.estimator.doubt))
    (scales, doubt), (reference, its_doubt) = runs
    accepted = [sum(scale.accepted for scale in told) for told in (scales, reference)]
    assert abs(accepted[0] - accepted[1]) <= 3
    assert scales[-1].sigma == pytest.approx(reference[-1].sigma, rel=0.1)
    assert bool(doubt) == bool(its_doubt) == (spread > 0.3)


def test_a_depth_camera_after_a_network_is_held_to_its_own_word() -> None:
    player = Player()
    player.play(40, 0.15)
    assert player.play(200, 0.02, "sensor", 0.01, said=0.02)[-1].accepted
    player._error = 0.3  # a network may err by as much, and is believed
    assert not player.play(1, 0.02, "sensor", 0.01, said=0.02)[-1].accepted


def test_a_part_that_was_joined_says_nothing_more_of_the_network() -> None:
    player = Player()
    player.play(120, 0.1)
    lost = player.play(120, 0.6, part=120)[-1]
    assert lost.sigma > 1.5
    assert player.estimator.doubt
    back = player.play(10, 0.1, part=HOME)
    assert back[0].sigma > 1.5, "it waits, and may be met again"
    assert player.estimator.doubt, "and health says why"
    assert player.play(50, 0.1, part=HOME)[-1].lost_sigma > 0.3
    joined = player.play(60, 0.1, joined=(120, HOME))
    assert joined[0].lost_sigma < 0.1, "at once, and not only as the more is seen"
    assert joined[-1].sigma < 0.3
    assert not player.estimator.doubt


def test_what_a_network_was_elsewhere_counts_the_less_the_more_it_has_seen_since() -> None:
    """A scale process that was started again meanwhile would know no more of it."""
    player = Player()
    player.play(120, 0.1)
    assert player.play(120, 0.6, part=120)[-1].lost_sigma > 1.5
    back = player.play(600, 0.1, part=HOME)
    assert np.all(np.diff([scale.lost_sigma for scale in back]) <= 0.0)
    assert back[-1].lost_sigma < 0.1
    assert back[-1].sigma < 0.2
    assert not player.estimator.doubt
    assert player.play(20, 0.6, part=120)[-1].lost_sigma > 1.0, "there it is as lost as ever"


def test_a_network_of_a_wide_spread_is_not_lost_where_the_unit_has_changed() -> None:
    """Its card says so: a belief that falls forgets what was seen, not what is known of the network."""
    player = Player(seed=2)
    player.play(40, 0.45, bias=0.3)
    scales = player.play(100, 0.45, bias=0.3, metres_per_unit=30.0)
    assert scales[-1].log_scale == pytest.approx(math.log(30.0), abs=0.5)
    assert scales[-1].sigma < 1.0
    assert not player.estimator.doubt


def test_of_two_parts_where_the_network_is_lost_the_one_here_is_spoken_of() -> None:
    """A figure that is another part's would say nothing of what the network sees now."""
    player, said = Player(), []
    for part, error in ((HOME, 0.3), (1, 0.42)):
        player.play(1, 0.0, part=part)
        known = player.estimator._filter
        for k in range(100):
            known.predict(known._time_s + 60.0, 0.0)
            known.update(Observation(error * (-1) ** k, 0.0226, 0.0001, 100))
        said.append(float(player.estimator.doubt.split("size by ")[1].split(" ")[0]))
    assert said[1] == pytest.approx(0.42, abs=0.02)
    assert said[0] == pytest.approx(0.3, abs=0.02)


def test_who_goes_on_from_a_lost_network_s_metres_knows_it_until_the_network_shows_otherwise() -> None:
    before = Player()
    last = before.play(120, 0.6)[-1]
    assert last.lost_sigma > 1.5
    known = KnownScale(last.log_scale, last.known_to, last.bias_sigma, last.network, last.lost_sigma)
    told = KnownScale.of(known.info)
    after = Player(seed=1)
    after.play(1, 0.1)
    after.estimator.take_over(
        0, told.log_scale, told.sigma, told.bias_sigma, told.network, told.lost_sigma
    )
    scales, doubts = [], []
    for _ in range(400):
        scales += after.play(1, 0.1)
        doubts.append(after.estimator.doubt)
    assert scales[0].sigma == pytest.approx(last.sigma, rel=0.1)
    assert "did not know what it saw" in doubts[0]
    assert doubts[-1] == ""
    assert all(math.isfinite(scale.sigma) for scale in scales)
    assert scales[-1].lost_sigma < 0.2, "the images agree with one another again"
    another = Player(seed=1)
    another.estimator.take_over(0, told.log_scale, 0.05, 0.1, told.network, told.lost_sigma)
    seen = another.play(2, 0.0, "another@0123456789ab", metres_per_unit=7.0)
    assert seen[1].accepted, "whose metres are free to be others"
    assert seen[1].lost_sigma == 0.0


def test_a_part_that_joins_a_map_of_a_lost_network_s_metres_doesn_t_make_them_sure() -> None:
    player = Player()
    player.estimator.take_over(0, 0.0, 0.05, 0.1, "net@0123456789ab", lost_sigma=2.0)
    player.play(2, 0.1)
    player.play(10, 0.1, part=60)
    assert player.play(1, 0.1, joined=(60, HOME))[-1].lost_sigma > 0.5


def test_a_map_that_does_not_say_its_network_s_bias_leaves_the_one_last_heard() -> None:
    """Earlier builds' maps: metres that are off by 10 % are not sure to 5 %, with depth or before any."""
    player = Player()
    player.play(5, 0.1, bias=0.1)
    player.estimator.take_over(1, 0.3, 0.05)
    answer = player.estimator.process(keyframe_of_wall(9, 9.0, epoch=1), None)
    assert answer is not None
    assert answer[0].bias_sigma == 0.1
    assert answer[0].sigma > 0.1


def test_who_begins_with_metres_that_are_contested_knows_no_more_than_was_published() -> None:
    """Held 0.05 from the estimate, and maybe off by a fifth: what a map keeps of it says so."""
    of = Player().play(3, 0.0)[-1]
    said = replace(of, sigma=np.sqrt(0.04**2 + 0.1**2 + 0.05**2 + 0.2**2), filter_sigma=0.04, bias_sigma=0.1)
    assert said.known_to == pytest.approx(np.sqrt(0.04**2 + 0.05**2 + 0.2**2))
    assert replace(said, lost_sigma=2.0, sigma=float(np.hypot(said.sigma, 2.0))).known_to == pytest.approx(
        said.known_to
    )
    sure = replace(said, sigma=np.hypot(0.04, 0.1), map_log_scale=said.log_scale - 0.03)
    assert sure.known_to == pytest.approx(0.05), "the map is built by another value"
