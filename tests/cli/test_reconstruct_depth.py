"""Which keyframes a network of several views is shown together, and how it sees them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from prism_edge.cli.reconstruct_depth import Taken, _of_one, _of_several
from prism_edge.depth.prediction import Prediction, no_confidence, no_descriptor
from prism_edge.depth.straight import bent_back, set_straight, straight_camera
from prism_edge.depth.upright import camera_from_turned, turned_camera
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import FISHEYE
from tests.synthetic.sequence import synthetic_camera

CAMERA = synthetic_camera(8, 6)
AS_IT_IS, NOTHING = np.array([1.0, 0.0, 1.0, 0.0]), (no_confidence(), no_descriptor(), 0.0)


class Network:
    """Answers with the green of what it is shown, as metres; remembers what that was."""

    name, provider, dsug, views = "several", "CPUExecutionProvider", (0.1, 0.2), 3

    def __init__(self) -> None:
        self.shown: list[tuple[list[np.ndarray], list[Any], np.ndarray]] = []

    def infer(self, pictures: list[np.ndarray], cameras: list[Any], poses: np.ndarray) -> list[Prediction]:
        self.shown.append((pictures, cameras, poses))
        return [Prediction(p[:, :, 1].astype(np.float32), AS_IT_IS, *NOTHING) for p in pictures]


def taken(count: int) -> list[Taken]:
    """Keyframes a metre from each other, whose pictures' red is their number."""
    found = []
    for k in range(count):
        pose, rgb = np.eye(4), np.full((6, 8, 3), k, np.uint8)
        pose[0, 3] = k
        rgb[:, :, 1] = np.arange(48).reshape(6, 8)
        found.append(Taken(SimpleNamespace(keyframe=k, camera=CAMERA, map_from_camera=pose), k, rgb))
    return found


def test_a_network_that_fails_at_a_picture_is_one_line() -> None:
    def fails(rgb: np.ndarray, camera: Any) -> Prediction:
        raise RuntimeError("indices out of bounds")

    network: Any = SimpleNamespace(name="one", provider="CPU", dsug=(0.1, 0.2), infer=fails)
    with pytest.raises(ModelError, match=r"^one: an inference failed \(indices out of bounds\)$"):
        list(_of_one(network, "").answers(taken(1)))


@pytest.mark.parametrize(
    ("count", "together"),
    [
        (3, [[0, 1, 2]]),
        (6, [[0, 1, 2], [3, 4, 5]]),
        (7, [[0, 1, 2], [3, 4, 5], [4, 5, 6]]),
        (8, [[0, 1, 2], [3, 4, 5], [5, 6, 7]]),
        (0, []),
    ],
)
def test_those_left_at_the_end_go_with_the_ones_before_and_each_is_answered_once(
    count: int, together: list[list[int]]
) -> None:
    network = Network()
    answered = [one.index for one, _ in _of_several(network, 0).answers(iter(taken(count)))]
    assert answered == list(range(count))
    assert [[int(p[0, 0, 0]) for p in pictures] for pictures, _, _ in network.shown] == together


@pytest.mark.parametrize("count", [1, 2])
def test_fewer_than_it_takes_are_refused(count: int) -> None:
    with pytest.raises(ModelError, match=f"takes 3 keyframes at once, and {count} have"):
        list(_of_several(Network(), 0).answers(taken(count)))


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_it_sees_pictures_upright_from_where_they_are_and_its_depth_is_turned_back(turns: int) -> None:
    network = Network()
    keyframes = taken(3)
    answers = list(_of_several(network, turns).answers(keyframes))
    [(pictures, cameras, poses)] = network.shown
    for k, one in enumerate(keyframes):
        np.testing.assert_array_equal(pictures[k], np.rot90(one.rgb, turns))
        assert cameras[k] == turned_camera(CAMERA, turns)
        np.testing.assert_allclose(poses[k], one.viewpoint.map_from_camera @ camera_from_turned(turns))
        assert answers[k][0] is one
        np.testing.assert_array_equal(answers[k][1].depth, one.rgb[:, :, 1])


def test_it_sees_pictures_of_a_strongly_bent_lens_straight_and_its_depth_is_carried_back() -> None:
    network, keyframes = Network(), taken(3)
    bent = replace(synthetic_camera(8, 6), model=FISHEYE, fx=3.0, fy=3.0)
    keyframes[1].viewpoint.camera = bent
    answers = list(_of_several(network, 0).answers(keyframes))
    [(pictures, cameras, _)] = network.shown
    straight = straight_camera(bent)
    assert cameras == [CAMERA, straight, CAMERA]
    np.testing.assert_array_equal(pictures[1], set_straight(keyframes[1].rgb, bent, straight))
    own = [answer for _, answer in answers]
    np.testing.assert_array_equal(own[0].depth, keyframes[0].rgb[:, :, 1])
    assert own[1].image_to_depth[0] == straight.width / bent.width
    said = Prediction(pictures[1][:, :, 1].astype(np.float32), AS_IT_IS, *NOTHING)
    carried = bent_back(said, bent, straight)
    np.testing.assert_array_equal(own[1].depth, carried.depth)


def test_one_picture_s_network_sees_it_as_it_was_taken() -> None:
    bent = replace(synthetic_camera(8, 6), model=FISHEYE, fx=3.0, fy=3.0)
    seen: list[Any] = []

    def infer(rgb: np.ndarray, camera: Any) -> Prediction:
        seen.append((rgb, camera))
        return Prediction(rgb[:, :, 1].astype(np.float32), AS_IT_IS, *NOTHING)

    network: Any = SimpleNamespace(name="one", provider="CPU", dsug=(0.1, 0.2), infer=infer)
    keyframes = taken(1)
    keyframes[0].viewpoint.camera = bent
    list(_of_one(network, "").answers(keyframes))
    assert seen == [(keyframes[0].rgb, bent)]
