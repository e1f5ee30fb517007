"""The camera's pose on the robot, as it is configured."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.config import FramesConfig
from prism_edge.config_file import load
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.mount import base_from_camera, described, looking, quarter_turns
from prism_edge.geometry.poses import Array, inverse, transform

CAMERA = Camera(64, 48, 60.0, 55.0, 30.0, 25.0)
PAGE = Path(__file__).resolve().parents[2] / "docs" / "CONFIGURATION.md"
TILT = np.radians(25.0)
WAYS = {
    "forward": (1.0, 0.0, 0.0),
    "forward, 25° down": (np.cos(TILT), 0.0, -np.sin(TILT)),
    "to the rear": (-1.0, 0.0, 0.0),
    "to the left": (0.0, 1.0, 0.0),
}


def test_by_default_the_camera_looks_along_the_robots_x_axis() -> None:
    mount = base_from_camera(FramesConfig(base_from_camera_xyz=(0.1, 0.2, 0.3)))
    ahead, right, below = np.array([0, 0, 2.0, 1]), np.array([1.0, 0, 0, 1]), np.array([0, 1.0, 0, 1])
    np.testing.assert_allclose(mount @ ahead, [2.1, 0.2, 0.3, 1], atol=1e-12)
    np.testing.assert_allclose(mount @ right, [0.1, -0.8, 0.3, 1], atol=1e-12)
    np.testing.assert_allclose(mount @ below, [0.1, 0.2, -0.7, 1], atol=1e-12)


@pytest.mark.parametrize("way", WAYS)
def test_the_documented_numbers_look_where_they_say(way: str) -> None:
    (given,) = re.findall(rf"^\| {way} \| (\[.*\]) \|$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    mount = base_from_camera(load(None, {"frames.base_from_camera_xyzw": given}).frames)
    np.testing.assert_allclose(mount[:3, 2], WAYS[way], atol=2e-4)
    assert mount[2, 0] == pytest.approx(0.0, abs=2e-4)  # the image's rows are level
    assert mount[2, 1] < 0.0  # and it stands upright


def test_the_documented_recipe_runs(capsys: pytest.CaptureFixture[str]) -> None:
    (code,) = re.findall(r"```python\n(.*?looking.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    exec(code, {})
    assert capsys.readouterr().out == f"frames:\n  base_from_camera_xyzw: {looking(30, 10)}\n"


@pytest.mark.parametrize(
    ("turns", "forward", "right"),
    [
        ((0, 25, 0), WAYS["forward, 25° down"], (0, -1, 0)),
        ((90, 0, 0), (0, 1, 0), (1, 0, 0)),
        ((-90, 0, 0), (0, -1, 0), (-1, 0, 0)),
        ((0, 90, 0), (0, 0, -1), (0, -1, 0)),
        ((0, 0, 180), (1, 0, 0), (0, 1, 0)),
        ((0, 0, 90), (1, 0, 0), (0, 0, -1)),
        ((180, 25, 0), (-np.cos(TILT), 0.0, -np.sin(TILT)), (0, 1, 0)),
    ],
)
def test_turns_go_the_ways_that_they_are_named_by(
    turns: tuple[float, float, float], forward: tuple[float, ...], right: tuple[float, ...]
) -> None:
    mount = base_from_camera(FramesConfig(base_from_camera_xyzw=tuple(looking(*turns))))
    np.testing.assert_allclose(mount[:3, 2], forward, atol=2e-4)
    np.testing.assert_allclose(mount[:3, 0], right, atol=2e-4)


@pytest.mark.parametrize(
    ("xyz", "down_deg", "words"),
    [
        ((0.3, 0.0, 0.5), 25, "camera looks along base_link (0.91, 0.00, -0.42), 0.5 m above it"),
        ((0.3, 0.0, -0.05), 0, "camera looks along base_link (1.00, 0.00, 0.00), 0.05 m below it"),
        ((0.3, 0.0, 0.0), -10, "camera looks along base_link (0.98, 0.00, 0.17), level with it"),
    ],
)
def test_the_mount_in_words(xyz: tuple[float, float, float], down_deg: float, words: str) -> None:
    turn = tuple(looking(down_deg=down_deg))
    assert described(FramesConfig(base_from_camera_xyz=xyz, base_from_camera_xyzw=turn)) == words


def mounted(left: float = 0.0, down: float = 0.0, roll: float = 0.0) -> Array:
    return base_from_camera(FramesConfig(base_from_camera_xyzw=tuple(looking(left, down, roll))))


@given(st.integers(-180, 180), st.integers(-180, 180), st.integers(-55, 55))
def test_what_is_above_is_above_in_the_turned_picture(roll: int, left: int, down: int) -> None:
    """Within 45 degrees of straight up: a point a little above the one that the camera looks at."""
    if roll % 45 == 0 and roll % 90:
        return  # either of two neighbours
    mount = mounted(left, down, roll)
    ahead = 5.0 * mount[:3, 2]
    points = np.array([ahead, ahead + np.array([0.0, 0.0, 0.01])])
    pixels = CAMERA.project(transform(inverse(mount), points))
    across, below = pixels[1] - pixels[0]
    for _ in range(quarter_turns(mount)):
        across, below = below, -across
    assert -below > abs(across) * 0.85, "focal lengths differ"


@pytest.mark.parametrize(
    ("roll", "turns"), [(0, 0), (44, 0), (46, 3), (90, 3), (134, 3), (180, 2), (-180, 2), (-90, 1), (-46, 1)]
)
def test_a_camera_whose_right_side_is_down_has_its_pictures_turned_clockwise(roll: int, turns: int) -> None:
    assert quarter_turns(mounted(roll=roll)) == turns
    assert quarter_turns(mounted(20, 30, roll)) == turns


@pytest.mark.parametrize("roll", [0, 90, 180, 270])
def test_a_picture_of_the_ground_has_no_upright(roll: int) -> None:
    assert quarter_turns(mounted(down=90, roll=roll)) == 0
    assert quarter_turns(mounted(down=-75, roll=roll)) == 0
    assert quarter_turns(mounted(down=62, roll=roll)) == 0
    assert (quarter_turns(mounted(down=58, roll=roll)) == 0) == (roll == 0)
