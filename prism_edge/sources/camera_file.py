"""Camera files: our own few keys, or what ROS's and OpenCV's calibrators write, read as it is."""

from __future__ import annotations

import math
import re
from collections.abc import Set
from pathlib import Path
from typing import Any

import yaml

from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import FISHEYE, PINHOLE, Camera

_OWN_REQUIRED = ("width", "height", "fx", "fy", "cx", "cy")
_OWN_KEYS = {*_OWN_REQUIRED, "model", "distortion"}
_ROS_REQUIRED = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")
_ROS_KEYS = {*_ROS_REQUIRED, "camera_name", "distortion_model", "rectification_matrix", "projection_matrix"}
# What the calibration that comes with OpenCV as a sample writes besides: how it was done, not what was found.
_SAMPLE_KEYS = {"calibration_time", "nframes", "nr_of_frames", "board_width", "board_height", "square_size"}
_SAMPLE_KEYS |= {"marker_size", "aspectRatio", "fix_aspect_ratio", "flags", "fisheye_model"}
_SAMPLE_KEYS |= {"avg_reprojection_error", "per_view_reprojection_errors", "extrinsic_parameters"}
_SAMPLE_KEYS |= {"image_points", "grid_points"}
_MATRIX_KEYS = {"rows", "cols", "data", "dt"}
# ROS's name -> our model, and how many coefficients go with it
_ROS_MODELS = {
    "plumb_bob": (PINHOLE, (4, 5)),
    "rational_polynomial": (PINHOLE, (8,)),
    "equidistant": (FISHEYE, (4,)),
}


class _Loader(yaml.SafeLoader):
    """YAML whose 1e-8 is a number and whose repeated keys are errors; OpenCV's matrix tag is read over."""


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    keys = [key.value for key, _ in node.value]
    repeated = sorted({str(key) for key in keys if keys.count(key) > 1})
    if repeated:
        problem = f"key {repeated[0]!r} is given twice"
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
    return loader.construct_mapping(node, deep=True)


for _tag in ("tag:yaml.org,2002:map", "tag:yaml.org,2002:opencv-matrix"):
    _Loader.add_constructor(_tag, _mapping)


def read_camera(path: Path) -> Camera:
    """The camera that a YAML file describes; raises ConfigError naming the file and the key."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"camera file {path} can't be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ConfigError(f"camera file {path} is no text file") from None
    try:
        return parse_camera(text)
    except ConfigError as error:
        raise ConfigError(f"camera file {path}: {error}") from None


def parse_camera(text: str) -> Camera:
    """The camera described by a YAML text; raises ConfigError naming the key."""
    # OpenCV's FileStorage begins with a directive that isn't YAML's.
    text = re.sub(r"\A\ufeff?%YAML:1\.0", "%YAML 1.1", text)
    if text.startswith("%YAML 1.1") and not re.search(r"^---", text, re.MULTILINE):
        text = text.replace("\n", "\n---\n", 1)
    try:
        tree = yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        line = f" (line {mark.line + 1})" if mark else ""
        problem = getattr(error, "problem", None) or "unreadable"
        raise ConfigError(f"is no valid YAML{line}: {problem}") from None
    except (ValueError, RecursionError):  # a date that is none, brackets without end
        raise ConfigError("is no valid YAML") from None
    if not isinstance(tree, dict):
        raise ConfigError("holds no keys; expected width, height, fx, fy, cx, cy")
    return _ros(tree) if "camera_matrix" in tree or "image_width" in tree else _own(tree)


def _own(tree: dict[Any, Any]) -> Camera:
    _check_keys(tree, _OWN_KEYS, _OWN_REQUIRED)
    model = _word(tree, "model", PINHOLE)
    if model not in (PINHOLE, FISHEYE):
        raise ConfigError(f"model: {model!r} is not known (use {PINHOLE} or {FISHEYE})")
    fx, fy, cx, cy = (_number(key, tree[key]) for key in ("fx", "fy", "cx", "cy"))
    distortion = _numbers("distortion", tree.get("distortion") or [])
    return Camera(_size(tree, "width"), _size(tree, "height"), fx, fy, cx, cy, model, distortion)


def _ros(tree: dict[Any, Any]) -> Camera:
    _check_keys(tree, _ROS_KEYS, _ROS_REQUIRED, _SAMPLE_KEYS)
    fisheye = tree.get("fisheye_model", 0)
    if fisheye not in (0, 1):
        raise ConfigError(f"fisheye_model: expected 0 or 1, found {fisheye!r}")
    name = _word(tree, "distortion_model", "equidistant" if fisheye else "plumb_bob")
    if name not in _ROS_MODELS:
        raise ConfigError(f"distortion_model: {name!r} is not known (use {', '.join(_ROS_MODELS)})")
    model, counts = _ROS_MODELS[name]
    k = _matrix(tree, "camera_matrix")
    if len(k) != 9:
        raise ConfigError(f"camera_matrix.data: expected 9 numbers, found {len(k)}")
    if any((k[1], k[3], k[6], k[7])) or k[8] != 1.0:
        raise ConfigError("camera_matrix.data: expected [fx, 0, cx, 0, fy, cy, 0, 0, 1], without skew")
    distortion = _matrix(tree, "distortion_coefficients")
    if len(distortion) not in counts:
        wanted = " or ".join(map(str, counts))
        raise ConfigError(f"distortion_coefficients.data: {name} takes {wanted}, not {len(distortion)}")
    size = _size(tree, "image_width"), _size(tree, "image_height")
    return Camera(*size, k[0], k[4], k[2], k[5], model, distortion)


def _check_keys(
    tree: dict[Any, Any], known: set[str], required: tuple[str, ...], ignored: Set[str] = frozenset()
) -> None:
    for key in tree:
        if key not in known and key not in ignored:
            raise ConfigError(f"key {key!r} is not known (known: {', '.join(sorted(known))})")
    for key in required:
        if key not in tree:
            raise ConfigError(f"key {key!r} is missing")


def _word(tree: dict[Any, Any], key: str, default: str) -> str:
    value = tree.get(key, default)
    if not isinstance(value, str):
        raise ConfigError(f"{key}: expected a word, found {value!r}")
    return value


def _number(key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{key}: expected a number, found {value!r}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ConfigError(f"{key}: expected a finite number, found {value!r}")
    return number


def _numbers(key: str, value: Any) -> tuple[float, ...]:
    if not isinstance(value, list):
        raise ConfigError(f"{key}: expected a list of numbers, found {value!r}")
    return tuple(_number(key, item) for item in value)


def _size(tree: dict[Any, Any], key: str) -> int:
    number = _number(key, tree[key])
    if not number.is_integer() or not 1 <= number <= 65_535:
        raise ConfigError(f"{key}: expected a whole number of pixels from 1 to 65535, found {number:g}")
    return int(number)


def _matrix(tree: dict[Any, Any], key: str) -> tuple[float, ...]:
    block = tree[key]
    if not isinstance(block, dict) or "data" not in block or not set(block) <= _MATRIX_KEYS:
        raise ConfigError(f"{key}: expected rows, cols and data, found {block!r}")
    return _numbers(f"{key}.data", block["data"])
