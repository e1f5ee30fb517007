"""An echoed camera_info as a camera file."""

from __future__ import annotations

import re

import pytest

from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.camera_file import parse_camera
from tests.sources.test_camera_file import EIGHT, INFO

INFO_D = INFO[INFO.index("d:\n") : INFO.index("k:\n")]


def echoed(model: str = "plumb_bob", d: str = "[]") -> str:
    return INFO.replace(INFO_D, f"d: {d}\n").replace("plumb_bob", model)


def test_camera_info_as_ros_echoes_it() -> None:
    camera = Camera(640, 480, 525.0, 526.0, 320.5, 240.0, distortion=(-0.28, 0.07, 0.0002, 2e-5, 0.0))
    assert parse_camera(INFO) == camera
    assert parse_camera(INFO.removesuffix("---\n")) == camera
    assert parse_camera(re.sub(r"^[dkrp]:", lambda key: key[0].upper(), INFO, flags=re.MULTILINE)) == camera
    whole = INFO.replace("  height: 0\n  width: 0", "  height: 480\n  width: 640")
    assert parse_camera(whole.replace("binning_x: 0", "binning_x: 1")) == camera


@pytest.mark.parametrize(
    ("model", "d", "expected"),
    [
        ("plumb_bob", "[]", ("pinhole", ())),
        ("plumb_bob", "[0.0, 0.0, 0.0, 0.0, 0.0]", ("pinhole", ())),
        ("''", "[]", ("pinhole", ())),
        ("plumb_bob", "[0.1, 0, 0, 0]", ("pinhole", (0.1, 0, 0, 0))),
        ("rational_polynomial", f"[{EIGHT}]", ("pinhole", (0.5, 0.1, 0, 0, 0.01, 0.8, 0.2, 0.03))),
        ("rational_polynomial", f"[{EIGHT}, 0, 0, 0]", ("pinhole", (0.5, 0.1, 0, 0, 0.01, 0.8, 0.2, 0.03))),
        ("equidistant", "[0.1, 0.02, 0, 0]", ("fisheye", (0.1, 0.02, 0, 0))),
        ("equidistant", "[0, 0, 0, 0]", ("fisheye", ())),
    ],
)
def test_lenses_of_a_camera_info(model: str, d: str, expected: tuple[str, tuple[float, ...]]) -> None:
    camera = parse_camera(echoed(model, d))
    assert (camera.model, camera.distortion) == expected


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (INFO.replace("plumb_bob", "double_sphere"), ["distortion_model", "double_sphere"]),
        (echoed("''", "[0.1, 0, 0, 0, 0]"), ["distortion_model", "''"]),
        (echoed("plumb_bob", f"[{EIGHT}]"), ["d: plumb_bob takes 4 or 5, not 8"]),
        (echoed("rational_polynomial", f"[{EIGHT}, .001, 0, 0, 0]"), ["takes 8, not 9"]),
        (INFO.replace("binning_x: 0", "binning_x: 2"), ["binning_x: 2"]),
        (INFO.replace("binning_y: 0", "binning_y: 4"), ["binning_y: 4"]),
        (INFO.replace("x_offset: 0", "x_offset: 80"), ["roi", "80", "640x480"]),
        (INFO.replace("  height: 0\n  width: 0", "  height: 240\n  width: 640"), ["roi: 640x240"]),
        (INFO.replace("  do_rectify", "  rectify"), ["roi.rectify"]),
        (INFO.replace("- 525.0\n- 0.0", "- 525.0\n- 0.5"), ["k: ", "skew"]),
        (INFO.replace("- 525.0\n", ""), ["k: ", "9"]),
        (re.sub(r"\nk:(\n- .*){9}", f"\nk: {[0.0] * 9}", INFO), ["k: ", "not calibrated"]),
        (re.sub(r"\nk:(\n- .*){9}", f"\nk: {[0.0] * 8 + [1.0]}", INFO), ["k: ", "not calibrated"]),
        (INFO.replace("distortion_model: plumb_bob\n", ""), ["distortion_model", "missing"]),
        (INFO.replace("binning_y: 0", "bin_y: 0"), ["bin_y"]),
        (INFO + INFO, ["YAML"]),
        (INFO.replace("binning_x: 0", "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]"), ["'k' is given twice"]),
        (re.sub(r"roi:\n(  .*\n)+", "roi: 0\n", INFO), ["roi: expected x_offset"]),
    ],
)
def test_a_camera_info_that_no_camera_here_can_be(text: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        parse_camera(text)
    for word in words:
        assert word in str(caught.value)
