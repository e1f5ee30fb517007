"""The whole of it, on a room whose faces are known."""

from __future__ import annotations

import numpy as np

from prism_edge.reconstruction.dense import Options, reconstruct
from prism_edge.scale.gate import GateParameters
from tests.reconstruction.room import COUNT, all_others, from_the_walls, looks, wavering


def wavering_room() -> dict:
    return {k: wavering(look) for k, look in looks().items()}


def test_pictures_and_agreement_bring_a_network_s_depth_to_the_walls() -> None:
    plain = reconstruct(wavering_room(), all_others(), Options(agreeing=1, by_pictures=False))
    agreed = reconstruct(wavering_room(), all_others(), Options(by_pictures=False))
    by_pictures = reconstruct(wavering_room(), all_others(), Options())
    errors = [np.median(from_the_walls(made.cloud.points)) for made in (plain, agreed, by_pictures)]
    assert errors[1] < 0.9 * errors[0]
    assert errors[2] < 0.25 * errors[0]
    assert errors[2] < 0.01
    assert by_pictures.kept > agreed.kept, "and more of it agrees"
    assert by_pictures.sure > 0.2
    assert np.isnan(agreed.sure)


def test_what_passed_by_is_not_in_the_cloud() -> None:
    with_box, gate = looks(with_box_in=3), GateParameters(0.5, 0.1, 0.02)
    alone = reconstruct(with_box, all_others(), Options(agreeing=1, by_pictures=False))
    made = reconstruct(with_box, all_others(), Options(by_pictures=False, gate=gate))
    assert (from_the_walls(alone.cloud.points) > 0.1).mean() < 0.001, "even alone it is outvoted"
    one = reconstruct({3: with_box[3]}, {}, Options(agreeing=1, by_pictures=False))
    assert (from_the_walls(one.cloud.points) > 0.1).sum() > 50, "but where nobody else has looked"
    assert (from_the_walls(made.cloud.points) > 0.05).mean() < 0.001


def test_what_is_farther_than_asked_is_left_out() -> None:
    made = reconstruct(looks(), all_others(), Options(by_pictures=False, farthest=2.0))
    centres = np.array([look.view.world_from_camera[:3, 3] for look in looks().values()])
    nearest = np.linalg.norm(made.cloud.points[:, None] - centres, axis=2).min(axis=1)
    assert len(made.cloud.points) > 1000
    assert 1.9 < nearest.max() < 2.03  # along a ray to the corner of the picture, too, but for a voxel


def test_nothing_gives_nothing() -> None:
    made = reconstruct({}, {}, Options())
    assert len(made.cloud.points) == 0
    assert made.kept == 0.0


def test_progress_counts_both_rounds_and_names_of_others_are_passed_over() -> None:
    said: list[tuple[str, int, int]] = []
    beside = {k: [*others, 999] for k, others in all_others().items()}
    made = reconstruct(looks(), beside, Options(), lambda *words: said.append(words))
    assert [done for what, done, _ in said if what == "agreeing"] == list(range(COUNT + 1))
    assert [done for what, done, _ in said if what == "comparing pictures"] == list(range(COUNT))
    assert {of for *_, of in said} == {COUNT}
    again = reconstruct(looks(), beside, Options())
    np.testing.assert_array_equal(made.cloud.points, again.cloud.points)
