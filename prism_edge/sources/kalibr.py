"""Cameras as Kalibr's chain of cameras and EuRoC's sensor.yaml describe them, which are alike."""

from __future__ import annotations

from typing import Any

from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import FISHEYE, PINHOLE, Camera
from prism_edge.sources.camera_fields import check_keys, counted, numbers_of, size_of, word_of

_REQUIRED = ("resolution", "camera_model", "intrinsics", "distortion_model")
_COEFFICIENTS = ("distortion_coeffs", "distortion_coefficients")  # Kalibr's name, and EuRoC's
_KEYS = {*_REQUIRED, *_COEFFICIENTS}
# Where the camera sits beside others, and how it is read: not what its lens is.
_BESIDE = {"T_cn_cnm1", "T_cam_imu", "timeshift_cam_imu", "cam_overlaps", "rostopic"}
_BESIDE |= {"sensor_type", "comment", "T_BS", "rate_hz"}
# Their name of a lens -> our model, and how many coefficients go with it.
_LENSES = {
    "radtan": (PINHOLE, 4),
    "radial-tangential": (PINHOLE, 4),
    "equidistant": (FISHEYE, 4),
    "none": (PINHOLE, 0),
}


def is_kalibr(tree: dict[Any, Any]) -> bool:
    """Whether a camera file is one of theirs: a camera by its own name, or ``cam0``, ``cam1`` ..."""
    return "resolution" in tree or bool(_cameras(tree))


def kalibr_camera(tree: dict[Any, Any]) -> Camera:
    """The one camera that it describes. Raises ConfigError for several, or one that can't be."""
    cameras = _cameras(tree)
    if not cameras:
        return _camera(tree)
    if len(tree) > 1:
        raise ConfigError(f"describes {', '.join(map(str, tree))}: keep the one camera that is meant")
    (name,) = cameras
    try:
        return _camera(tree[name])
    except ConfigError as error:
        raise ConfigError(f"{name}: {error}") from None


def _cameras(tree: dict[Any, Any]) -> list[Any]:
    return [name for name, camera in tree.items() if isinstance(camera, dict) and "resolution" in camera]


def _camera(tree: dict[Any, Any]) -> Camera:
    check_keys(tree, _KEYS, _REQUIRED, _BESIDE)
    if (kind := word_of(tree, "camera_model", "")) != "pinhole":
        raise ConfigError(f"camera_model: {kind!r} is not known (use pinhole, with its distortion_model)")
    lens = word_of(tree, "distortion_model", "")
    if lens not in _LENSES:
        raise ConfigError(f"distortion_model: {lens!r} is not known (use {', '.join(_LENSES)})")
    model, count = _LENSES[lens]
    key = next((name for name in _COEFFICIENTS if name in tree), _COEFFICIENTS[0])
    distortion = counted(key, numbers_of(key, tree.get(key, [])), (count,), lens)
    fx, fy, cx, cy = counted("intrinsics", numbers_of("intrinsics", tree["intrinsics"]), (4,), "pinhole")
    sides = counted("resolution", numbers_of("resolution", tree["resolution"]), (2,), "an image")
    width, height = (size_of("resolution", side) for side in sides)
    return Camera(width, height, fx, fy, cx, cy, model, distortion)
