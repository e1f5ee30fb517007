"""Cameras as Kalibr and EuRoC describe them: read as they are, refused by key where they can't be taken."""

from __future__ import annotations

import logging
from pathlib import Path

import pytest

from prism_edge.config import SourceConfig
from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import Camera
from prism_edge.sources.camera_file import parse_camera
from prism_edge.sources.open import open_source
from tests.sources import tiny_datasets as tiny

SENSOR = """\
# General sensor definitions.
sensor_type: camera
comment: VI-Sensor cam0 (MT9M034)

# Sensor extrinsics wrt. the body-frame.
T_BS:
  cols: 4
  rows: 4
  data: [0.0148, -0.9998, 0.0041, -0.0216, 0.9995, 0.0149, 0.0257, -0.0646, -0.0257, 0.0037, 0.9996, 0.0098,
         0.0, 0.0, 0.0, 1.0]

# Camera specific definitions.
rate_hz: 20
resolution: [752, 480]
camera_model: pinhole
intrinsics: [458.654, 457.296, 367.215, 248.375] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
"""
CHAIN = """\
cam0:
  T_cam_imu:
  - [-0.9995, 0.0075, -0.0298, 0.0455]
  - [0.0296, -0.0343, -0.9989, -0.0716]
  - [-0.0085, -0.9993, 0.0341, -0.0446]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [0.0034, 0.0007, -0.0020, 0.0002]
  distortion_model: equidistant
  intrinsics: [190.97, 190.97, 254.93, 256.89]
  resolution: [512, 512]
  rostopic: /cam0/image_raw
  timeshift_cam_imu: 0.0
"""


def test_a_sensor_of_euroc() -> None:
    expected = (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05)
    assert parse_camera(SENSOR) == Camera(752, 480, 458.654, 457.296, 367.215, 248.375, "pinhole", expected)
    assert parse_camera(SENSOR).readout_ms is None
    assert parse_camera(SENSOR + "readout_ms: 26\n").readout_ms == 26.0


def test_a_chain_of_one_camera() -> None:
    expected = (0.0034, 0.0007, -0.0020, 0.0002)
    assert parse_camera(CHAIN) == Camera(512, 512, 190.97, 190.97, 254.93, 256.89, "fisheye", expected)
    radtan = parse_camera(CHAIN.replace("equidistant", "radtan"))
    assert (radtan.model, radtan.distortion) == ("pinhole", expected)


@pytest.mark.parametrize("line", ["  distortion_coeffs: []\n", ""])
def test_a_lens_that_bends_nothing(line: str) -> None:
    text = CHAIN.replace("equidistant", "none").replace(
        "  distortion_coeffs: [0.0034, 0.0007, -0.0020, 0.0002]\n", line
    )
    assert parse_camera(text).is_ideal


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (CHAIN + CHAIN.replace("cam0:", "cam1:"), ["cam0, cam1", "one camera"]),
        (CHAIN + "width: 640\n", ["cam0, width", "one camera"]),
        (CHAIN.replace("model: pinhole", "model: omni"), ["cam0: camera_model", "'omni'"]),
        (CHAIN.replace("equidistant", "fov"), ["cam0: distortion_model", "'fov'", "radtan"]),
        (CHAIN.replace("0.0007, ", ""), ["distortion_coeffs", "equidistant takes 4, not 3"]),
        (SENSOR.replace("0.07395907, ", ""), ["distortion_coefficients", "radial-tangential takes 4, not 3"]),
        (SENSOR.replace("458.654, ", ""), ["intrinsics", "takes 4, not 3"]),
        (SENSOR.replace("[752, 480]", "[752]"), ["resolution", "takes 2, not 1"]),
        (SENSOR.replace("752", "752.5"), ["resolution", "whole number"]),
        (SENSOR.replace("[752, 480]", "752x480"), ["resolution", "list of numbers"]),
        (SENSOR.replace("458.654", "wide"), ["intrinsics", "'wide'"]),
        (SENSOR.replace("458.654", "4.58"), ["fx", "752-wide"]),
        (SENSOR.replace("camera_model: pinhole\n", ""), ["'camera_model' is missing"]),
        (SENSOR + "gain: 3\n", ["'gain' is not known"]),
        (CHAIN.replace("  rostopic", "  topic"), ["cam0: key 'topic' is not known"]),
    ],
)
def test_what_is_no_camera_is_one_line_that_names_the_key(text: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_camera(text)
    said = str(refused.value)
    assert "\n" not in said
    for word in words:
        assert word in said


@pytest.mark.parametrize("name", ["data", "pictures"])
def test_images_of_euroc_bring_their_sensor_along(
    tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tmp_path / "mav0" / "cam0" / name
    folder.mkdir(parents=True)
    for i in range(3):
        tiny.write_image(folder / f"{1403636579763555584 + 50_000_000 * i}.png", tiny.picture(i, 752, 480))
    (folder.parent / "sensor.yaml").write_text(SENSOR)
    if name != "data":  # anybody's folder
        with pytest.raises(ConfigError, match="camera file"):
            open_source(SourceConfig(uri=str(folder)))
        return
    with caplog.at_level(logging.WARNING), open_source(SourceConfig(uri=str(folder))) as source:
        assert source.camera == parse_camera(SENSOR)
        assert source.camera_origin.endswith("cam0/sensor.yaml")
    assert caplog.text == ""
