"""Camera files: what calibrators write is read as it is, every mistake is one line naming file and key."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from itertools import product
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.camera_file import parse_camera, read_camera

OWN = "model: pinhole\nwidth: 640\nheight: 480\nfx: 525.0\nfy: 526\ncx: 320.5\ncy: 240\n"
ROS = """\
image_width: 752
image_height: 480
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: [458.654, 0, 367.215, 0, 457.296, 248.375, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]
projection_matrix:
  rows: 3
  cols: 4
  data: [400, 0, 367, 0, 0, 400, 248, 0, 0, 0, 1, 0]
"""
# As `ros2 topic echo --once` prints it.
INFO = """\
header:
  stamp:
    sec: 1
    nanosec: 2
  frame_id: camera_optical
height: 480
width: 640
distortion_model: plumb_bob
d:
- -0.28
- 0.07
- 0.0002
- 2.0e-05
- 0.0
k:
- 525.0
- 0.0
- 320.5
- 0.0
- 526.0
- 240.0
- 0.0
- 0.0
- 1.0
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [500.0, 0.0, 319.5, 0.0, 0.0, 500.0, 239.5, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi:
  x_offset: 0
  y_offset: 0
  height: 0
  width: 0
  do_rectify: false
---
"""
EIGHT = ".5, .1, 0, 0, .01, .8, .2, .03"
CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "cameras"


def test_own_format() -> None:
    assert parse_camera(OWN) == Camera(640, 480, 525.0, 526.0, 320.5, 240.0)
    with_distortion = parse_camera(OWN + "distortion: [0.1, -0.2, 1e-8, -3E-4]\n")
    assert with_distortion.distortion == (0.1, -0.2, 1e-8, -3e-4)
    fisheye = parse_camera(OWN.replace("pinhole", "fisheye") + "distortion: [0.1, 0, 0, 0]\n")
    assert fisheye.model == "fisheye"


def test_beside_any_format_stands_how_long_its_rows_take() -> None:
    for text, ms in product((OWN, ROS, INFO), (26, -12.5, 100, 0)):
        camera = parse_camera(text)
        assert camera.readout_ms is None
        assert parse_camera(f"readout_ms: {ms}\n{text}") == replace(camera, readout_ms=ms)


def test_ros_camera_info() -> None:
    expected = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05, 0.0)
    assert parse_camera(ROS) == Camera(752, 480, 458.654, 457.296, 367.215, 248.375, "pinhole", expected)


def test_ros_models_take_their_coefficients() -> None:
    eight = ROS.replace("plumb_bob", "rational_polynomial").replace("1.76187114e-05, 0]", "0, 0, 1, 2, 3]")
    assert parse_camera(eight).distortion[5:] == (1.0, 2.0, 3.0)
    fisheye = ROS.replace("plumb_bob", "equidistant").replace("1.76187114e-05, 0]", "1e-8]")
    assert parse_camera(fisheye).model == "fisheye"
    assert parse_camera(fisheye).distortion == (-0.28340811, 0.07395907, 0.00019359, 1e-8)


def test_what_opencv_writes_is_read(tmp_path: Path) -> None:
    path = tmp_path / "camera.yml"
    matrix = np.array([[520.25, 0, 318.0], [0, 521.5, 241.0], [0, 0, 1]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", matrix)
    storage.write("distortion_coefficients", np.array([[0.1, -1e-8, 0.0, 0.0, 0.02]]))
    storage.release()
    assert read_camera(path) == Camera(
        640, 480, 520.25, 521.5, 318.0, 241.0, distortion=(0.1, -1e-8, 0, 0, 0.02)
    )


@pytest.mark.parametrize(
    ("written", "read"),
    [
        ((0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6), (0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6)),
        ((0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6, *[0.0] * 6), (0.1, 0.2, 0.0, 0.0, 0.3, 0.4, 0.5, 0.6)),
        ((0.1, 0.2, 0.0, 0.0, 0.3, *[0.0] * 9), (0.1, 0.2, 0.0, 0.0, 0.3)),
        ((0.1, 0.2, 0.0, 0.0), (0.1, 0.2, 0.0, 0.0)),
    ],
)
@pytest.mark.parametrize("tag", ["!!opencv-matrix", "!!opencv-nd-matrix"])
def test_opencvs_lens_is_by_how_many_coefficients_are_used(
    tag: str, written: tuple[float, ...], read: tuple[float, ...]
) -> None:
    size = f"rows: 1\n  cols: {len(written)}" if tag == "!!opencv-matrix" else f"sizes: [{len(written)}]"
    text = (
        "image_width: 640\nimage_height: 480\n"
        "camera_matrix: !!opencv-matrix\n  rows: 3\n  cols: 3\n  dt: d\n"
        "  data: [520, 0, 318, 0, 521, 241, 0, 0, 1]\n"
        f"distortion_coefficients: {tag}\n  {size}\n  dt: d\n  data: {list(written)}\n"
    )
    assert parse_camera(text).distortion == read


def test_an_opencv_lens_that_is_no_known_one_is_refused() -> None:
    text = ROS.replace("distortion_model: plumb_bob\n", "")
    assert text != ROS
    with pytest.raises(ConfigError, match="rational_polynomial takes 8, not 12"):
        parse_camera(text.replace("1.76187114e-05, 0]", "0, 0, 1, 2, 3, 4, 5, 6, 7]"))


@pytest.mark.parametrize("fisheye", [0, 1])
def test_what_opencvs_calibration_sample_writes_is_read(tmp_path: Path, fisheye: int) -> None:
    path = tmp_path / "out_camera_data.yml"
    distortion = (0.1, -0.02, 0.003, -0.0004) if fisheye else (0.1, -0.02, 0.003, -0.0004, 0.00005)
    views = np.ones((3, 6))
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "Tue 03 Jun 2025 10:11:12 AM CEST")
    for key in ("nframes", "nr_of_frames", "board_width", "board_height"):
        storage.write(key, 9)
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    for key in ("square_size", "marker_size", "aspectRatio", "fix_aspect_ratio", "avg_reprojection_error"):
        storage.write(key, 25.0)
    storage.writeComment("flags: +fix_principal_point")
    storage.write("flags", 4)
    storage.write("fisheye_model", fisheye)
    storage.write("camera_matrix", np.array([[520.25, 0, 318.0], [0, 521.5, 241.0], [0, 0, 1]]))
    storage.write("distortion_coefficients", np.array(distortion).reshape(-1, 1))
    storage.write("per_view_reprojection_errors", views[:, :1].astype(np.float32))
    storage.write("extrinsic_parameters", views)
    storage.write("image_points", np.ones((3, 54, 2), np.float32))
    storage.write("grid_points", np.ones((54, 3), np.float32))
    storage.release()
    model = "fisheye" if fisheye else "pinhole"
    assert read_camera(path) == Camera(640, 480, 520.25, 521.5, 318.0, 241.0, model, distortion)


def test_numbers_are_decimal() -> None:
    """YAML 1.1 would take 0525 for 341 and 8:45 for 525."""
    assert parse_camera(OWN.replace("525.0", "0525").replace("640", "0640")) == parse_camera(OWN)
    for number in ("8:45", "8:45.5", "0x20D", "0b101", "5_25", "08_5.0"):
        with pytest.raises(ConfigError, match=r"no valid YAML \(line 4\)|fx: expected a number"):
            parse_camera(OWN.replace("525.0", number))


@pytest.mark.parametrize("distortion", ["0", "false", "''", "0.0", "{}"])
def test_a_distortion_that_is_no_list_is_refused(distortion: str) -> None:
    with pytest.raises(ConfigError, match="distortion: expected a list of numbers"):
        parse_camera(f"{OWN}distortion: {distortion}\n")
    assert parse_camera(f"{OWN}distortion:\n") == parse_camera(f"{OWN}distortion: []\n") == parse_camera(OWN)


@pytest.mark.parametrize("path", sorted(CONFIGS.glob("*.yaml")), ids=lambda path: path.name)
def test_the_examples_are_valid(path: Path) -> None:
    assert read_camera(path).width > 0


def test_there_are_examples() -> None:
    assert list(CONFIGS.glob("*.yaml"))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (OWN.replace("fx: 525.0", "fx: 0"), ["fx"]),
        (OWN.replace("fx: 525.0", "fx: -525.0"), ["fx"]),
        (OWN.replace("pinhole", "omni"), ["model", "omni"]),
        (OWN.replace("pinhole", "3"), ["model"]),
        (OWN + "skew: 0\n", ["skew"]),
        (OWN + "1: 0\n", ["1"]),
        (OWN.replace("fx: 525.0\n", ""), ["fx", "missing"]),
        (OWN.replace("fx: 525.0", "fx: wide"), ["fx", "wide"]),
        (OWN.replace("fx: 525.0", "fx: '525.0'"), ["fx", "number"]),
        (OWN.replace("fx: 525.0", "fx: '1e2'"), ["fx", "number"]),
        (OWN.replace("fx: 525.0", "fx: true"), ["fx", "number"]),
        (OWN.replace("fx: 525.0", "fx: [525]"), ["fx", "number"]),
        (OWN.replace("fx: 525.0", "fx:"), ["fx", "number"]),
        (OWN.replace("cx: 320.5", "cx: .nan"), ["cx", "finite"]),
        (OWN.replace("cx: 320.5", "cx: -.inf"), ["cx", "finite"]),
        (OWN.replace("cx: 320.5", "cx: 1" + "0" * 400), ["cx", "finite"]),
        (OWN.replace("width: 640", "width: 640.5"), ["width", "whole"]),
        (OWN.replace("width: 640", "width: 0"), ["width"]),
        (OWN.replace("width: 640", "width: 1e12"), ["width"]),
        (OWN + "distortion: [0.1, 0.2]\n", ["distortion"]),
        (OWN + "distortion: 0.1\n", ["distortion", "list"]),
        (OWN + "distortion: [0.1, a, 0, 0]\n", ["distortion", "'a'"]),
        (OWN + "fx: 500\n", ["fx", "twice"]),
        (OWN + "readout_ms: 100.5\n", ["readout_ms", "-100 to 100"]),
        (OWN + "readout_ms: -101\n", ["readout_ms", "-100 to 100"]),
        (OWN + "readout_ms: .nan\n", ["readout_ms", "finite"]),
        (OWN + "readout_ms: 26 ms\n", ["readout_ms", "26 ms"]),
        (ROS + "readout_ms: 126\n", ["readout_ms", "-100 to 100"]),
        (ROS + "readout_ms: quick\n", ["readout_ms", "quick"]),
        (OWN.replace("fx: 525.0", "fx: [525.0"), ["YAML", "line"]),
        (OWN + "a: !!python/object/apply:os.getcwd []\n", ["YAML"]),
        (OWN + "? [a, b]\n: 1\n", ["YAML"]),
        *((OWN + f'a: !!{tag} ""\n', ["YAML"]) for tag in ("int", "float", "bool", "timestamp")),
        ("", ["no keys"]),
        ("- 1\n- 2\n", ["no keys"]),
        ("525\n", ["no keys"]),
        (ROS.replace("plumb_bob", "double_sphere"), ["distortion_model", "double_sphere"]),
        (ROS.replace("plumb_bob", "equidistant"), ["distortion_coefficients", "equidistant"]),
        (ROS.replace(", 0, 0, 1]\ndist", "]\ndist"), ["camera_matrix", "9"]),
        (ROS.replace("[458.654, 0,", "[458.654, 0.5,"), ["camera_matrix", "skew"]),
        (ROS.replace("[458.654,", "[-458.654,"), ["fx"]),
        (ROS.replace("[458.654,", "[wide,"), ["camera_matrix.data", "wide"]),
        (ROS.replace("image_width: 752\n", ""), ["image_width", "missing"]),
        (ROS.replace("image_width", "image_breadth"), ["image_breadth"]),
        # Told by image_width alone: of its own keys, camera_matrix is the one to write.
        (re.sub(r"camera_matrix:\n(  .*\n){3}", "", ROS), ["'camera_matrix' is missing"]),
        (ROS + "fx: 500\n", ["fx"]),
        (ROS + "fisheye_model: 2\n", ["fisheye_model", "0 or 1"]),
        (OWN + "flags: 0\n", ["flags", "not known"]),
        (ROS.split("camera_matrix")[0] + "camera_matrix: 3\ndistortion_coefficients: 4\n", ["camera_matrix"]),
    ],
)
def test_every_defect_is_one_line_with_its_place(tmp_path: Path, text: str, words: list[str]) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        read_camera(path)
    message = str(caught.value)
    assert "\n" not in message
    for word in ["bad.yaml", *words]:
        assert word in message


def test_files_that_are_none(tmp_path: Path) -> None:
    binary = tmp_path / "binary.yaml"
    binary.write_bytes(b"\xff\xfe\x00\x80")
    for path in (tmp_path / "missing.yaml", tmp_path, binary):
        with pytest.raises(ConfigError, match=path.name):
            read_camera(path)


@settings(max_examples=60, deadline=None)
@given(
    size=st.tuples(st.integers(1, 8000), st.integers(1, 8000)),
    shares=st.tuples(st.floats(0.3, 15.0), st.floats(0.75, 1.3), st.floats(0.0, 1.0), st.floats(0.0, 1.0)),
    distortion=st.sampled_from([0, 4, 5, 8]).flatmap(
        lambda n: st.lists(st.floats(-10, 10), min_size=n, max_size=n)
    ),
)
def test_what_is_written_is_read_back(
    size: tuple[int, int],
    shares: tuple[float, float, float, float],
    distortion: list[float],
) -> None:
    focal = shares[0] * size[0], shares[0] * shares[1] * size[0]
    centre = shares[2] * size[0], shares[3] * size[1]
    camera = Camera(*size, *focal, *centre, distortion=tuple(distortion))
    tree = {"width": size[0], "height": size[1], "fx": focal[0], "fy": focal[1]}
    tree |= {"cx": centre[0], "cy": centre[1], "distortion": distortion}
    assert parse_camera(yaml.safe_dump(tree)) == camera


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=8,
)
KNOWN = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion", "readout_ms")
KNOWN_TO_ROS = ("image_width", "image_height", "camera_matrix", "distortion_model", "distortion_coefficients")
KNOWN_OF_INFO = ("d", "k", "K", "binning_x", "roi")
keys = st.sampled_from([*KNOWN, *KNOWN_TO_ROS, *KNOWN_OF_INFO, "data"])


@settings(max_examples=150, deadline=None)
@given(
    changes=st.dictionaries(keys, anything, min_size=1, max_size=3),
    of=st.sampled_from([OWN, ROS, INFO.removesuffix("---\n")]),
)
def test_any_tree_is_a_camera_or_a_config_error(changes: dict[str, object], of: str) -> None:
    tree = yaml.safe_load(of) | changes
    try:
        camera = parse_camera(yaml.safe_dump(tree))
    except ConfigError:
        return
    assert camera.fx > 0
    assert camera.fy > 0


@settings(max_examples=150, deadline=None)
@given(st.text(max_size=60) | st.text(alphabet="%YAML:1.0-\n{}[]!&*'\"|>? #xf", max_size=40))
def test_any_text_is_a_camera_or_a_config_error(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_camera(text)


def test_a_pipe_is_refused_before_anybody_waits_for_it(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "camera.yaml")
    with pytest.raises(ConfigError, match=r"camera\.yaml can't be read \(a pipe, not a file\)"):
        read_camera(tmp_path / "camera.yaml")
