"""Camera files: our own few keys, what ROS, OpenCV and Kalibr write, or an echoed camera_info."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import yaml

from prism_edge.errors import YAML_MISFITS, ConfigError
from prism_edge.geometry.cameras import FISHEYE, PINHOLE, Camera
from prism_edge.named_path import refuse_pipe
from prism_edge.sources.camera_fields import (
    check_keys,
    counted,
    number_of,
    numbers_of,
    size_of,
    word_of,
)
from prism_edge.sources.kalibr import is_kalibr, kalibr_camera

_OWN_REQUIRED = ("width", "height", "fx", "fy", "cx", "cy")
_OWN_KEYS = {*_OWN_REQUIRED, "model", "distortion", "readout_ms"}
_ROS_REQUIRED = ("image_width", "image_height", "camera_matrix", "distortion_coefficients")
_ROS_KEYS = {*_ROS_REQUIRED, "camera_name", "distortion_model", "rectification_matrix", "projection_matrix"}
# What the calibration that comes with OpenCV as a sample writes besides: how it was done, not what was found.
_SAMPLE_KEYS = {"calibration_time", "nframes", "nr_of_frames", "board_width", "board_height", "square_size"}
_SAMPLE_KEYS |= {"marker_size", "aspectRatio", "fix_aspect_ratio", "flags", "fisheye_model"}
_SAMPLE_KEYS |= {"avg_reprojection_error", "per_view_reprojection_errors", "extrinsic_parameters"}
_SAMPLE_KEYS |= {"image_points", "grid_points"}
# A sensor_msgs/CameraInfo as `ros2 topic echo` prints it; in ROS 1's, d k r p are capitals.
_INFO_REQUIRED = ("width", "height", "distortion_model", "d", "k")
_INFO_KEYS = {*_INFO_REQUIRED, "header", "r", "p", "binning_x", "binning_y", "roi"}
_ROI_KEYS = {"x_offset", "y_offset", "height", "width", "do_rectify"}
_CAPITALS = ("D", "K", "R", "P")
_MATRIX_KEYS = {"rows", "cols", "sizes", "data", "dt"}
_DECIMAL = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
# ROS's name -> our model, and how many coefficients go with it
_ROS_MODELS = {
    "plumb_bob": (PINHOLE, (4, 5)),
    "rational_polynomial": (PINHOLE, (8,)),
    "equidistant": (FISHEYE, (4,)),
}


class _Loader(yaml.SafeLoader):
    """YAML whose numbers are decimal, 1e-8 too, and whose repeated keys are errors, in capitals or not.

    OpenCV's matrix tag is read over.
    """


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$"), list("-+.0123456789")
)


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    keys = [key.value.lower() if key.value in _CAPITALS else key.value for key, _ in node.value]
    repeated = sorted({str(key) for key in keys if keys.count(key) > 1})
    if repeated:
        problem = f"key {repeated[0]!r} is given twice"
        raise yaml.constructor.ConstructorError(None, None, problem, node.start_mark)
    return loader.construct_mapping(node, deep=True)


def _decimal(loader: _Loader, node: yaml.ScalarNode) -> float:
    """What YAML 1.1 takes for octal (0525) or sixtieths (8:45) nobody has meant so."""
    text = str(loader.construct_scalar(node))
    if not _DECIMAL.fullmatch(text):
        if text.lstrip("-+").lower() in (".inf", ".nan"):
            return float(text.replace(".", ""))
        raise yaml.constructor.ConstructorError(None, None, f"{text} is no decimal number", node.start_mark)
    return float(text) if set(text) & set(".eE") else int(text)


for _tag in ("map", "opencv-matrix", "opencv-nd-matrix"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _mapping)
for _tag in ("int", "float"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_tag}", _decimal)


def read_camera(path: Path) -> Camera:
    """The camera that a YAML file describes; raises ConfigError naming the file and the key."""
    try:
        refuse_pipe(path)
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
    text = re.sub(r"^---\s*\Z", "", text, flags=re.MULTILINE)  # an echoed message ends so
    try:
        tree = yaml.load(text, _Loader)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None) or getattr(error, "context_mark", None)
        line = f" (line {mark.line + 1})" if mark else ""
        problem = getattr(error, "problem", None) or "unreadable"
        raise ConfigError(f"is no valid YAML{line}: {problem}") from None
    except YAML_MISFITS:
        raise ConfigError("is no valid YAML") from None
    if not isinstance(tree, dict):
        raise ConfigError("holds no keys; expected width, height, fx, fy, cx, cy")
    says_readout = "readout_ms" in tree  # beside any of them: no other format has it
    readout_ms = number_of("readout_ms", tree.pop("readout_ms")) if says_readout else None
    if is_kalibr(tree):
        camera = kalibr_camera(tree)
    elif "camera_matrix" in tree or "image_width" in tree:
        camera = _ros(tree)
    else:
        camera = _echoed(tree) if tree.keys() & {"k", "K", "d", "D"} else _own(tree)
    return replace(camera, readout_ms=readout_ms)


def _own(tree: dict[Any, Any]) -> Camera:
    check_keys(tree, _OWN_KEYS, _OWN_REQUIRED)
    model = word_of(tree, "model", PINHOLE)
    if model not in (PINHOLE, FISHEYE):
        raise ConfigError(f"model: {model!r} is not known (use {PINHOLE} or {FISHEYE})")
    fx, fy, cx, cy = (number_of(key, tree[key]) for key in ("fx", "fy", "cx", "cy"))
    distortion = tree.get("distortion")
    distortion = numbers_of("distortion", [] if distortion is None else distortion)
    width, height = size_of("width", tree["width"]), size_of("height", tree["height"])
    return Camera(width, height, fx, fy, cx, cy, model, distortion)


def _ros(tree: dict[Any, Any]) -> Camera:
    check_keys(tree, _ROS_KEYS, _ROS_REQUIRED, _SAMPLE_KEYS)
    fisheye = tree.get("fisheye_model", 0)
    if fisheye not in (0, 1):
        raise ConfigError(f"fisheye_model: expected 0 or 1, found {fisheye!r}")
    fx, fy, cx, cy = _intrinsics("camera_matrix.data", _matrix(tree, "camera_matrix"))
    distortion, default = _matrix(tree, "distortion_coefficients"), "equidistant"
    if not fisheye:  # OpenCV's own files name no model: it is by how many of the coefficients are used
        if "distortion_model" not in tree:
            unused = (n for n in (5, 8) if len(distortion) > n and not any(distortion[n:]))
            distortion = distortion[: next(unused, None)]
        default = "plumb_bob" if len(distortion) <= 5 else "rational_polynomial"
    model, counts, name = _ros_model(tree, default)
    distortion = counted("distortion_coefficients.data", distortion, counts, name)
    width, height = (size_of(key, tree[key]) for key in ("image_width", "image_height"))
    return Camera(width, height, fx, fy, cx, cy, model, distortion)


def _echoed(tree: dict[Any, Any]) -> Camera:
    """A camera_info message: its k and d, which belong to the raw image; r and p belong to the rectified."""
    tree = {key.lower() if key in _CAPITALS else key: value for key, value in tree.items()}
    check_keys(tree, _INFO_KEYS, _INFO_REQUIRED)
    width, height = size_of("width", tree["width"]), size_of("height", tree["height"])
    for key in ("binning_x", "binning_y"):
        if number_of(key, tree.get(key, 0)) not in (0, 1):  # 0 is 1 there
            raise ConfigError(f"{key}: {tree[key]} pixels are taken together, and k is of the whole sensor")
    _check_whole({} if tree.get("roi") is None else tree["roi"], width, height)
    distortion = numbers_of("d", tree["d"])
    if tree["distortion_model"] == "" and not any(distortion):  # of a simulator, or rectified
        tree["distortion_model"] = "plumb_bob"
    model, counts, name = _ros_model(tree)
    if any(distortion):
        while len(distortion) > max(counts) and distortion[-1] == 0.0:  # of a longer model that isn't used
            distortion = distortion[:-1]
        distortion = counted("d", distortion, counts, name)
    else:
        distortion = ()
    k = numbers_of("k", tree["k"])
    if k and not any(k[:8]):
        raise ConfigError("k: is all zeros, by which ROS says that the camera is not calibrated")
    return Camera(width, height, *_intrinsics("k", k), model, distortion)


def _check_whole(roi: Any, width: int, height: int) -> None:
    """A region of interest must be the whole image; all zeros say that, too."""
    if not isinstance(roi, dict):
        raise ConfigError(f"roi: expected x_offset, y_offset, height and width, found {roi!r}")
    check_keys({f"roi.{key}": None for key in roi}, {f"roi.{key}" for key in _ROI_KEYS}, ())
    names = ("x_offset", "y_offset", "width", "height")
    part = tuple(number_of(f"roi.{name}", roi.get(name, 0)) for name in names)
    if part not in ((0, 0, 0, 0), (0, 0, width, height)):
        raise ConfigError(
            f"roi: {part[2]:g}x{part[3]:g} at ({part[0]:g}, {part[1]:g}) is not the whole {width}x{height} "
            "image that k belongs to"
        )


def _ros_model(tree: dict[Any, Any], default: str = "") -> tuple[str, tuple[int, ...], str]:
    """Our model, how many coefficients it takes, and ROS's name of it."""
    name = word_of(tree, "distortion_model", default)
    if name not in _ROS_MODELS:
        raise ConfigError(f"distortion_model: {name!r} is not known (use {', '.join(_ROS_MODELS)})")
    return *_ROS_MODELS[name], name


def _intrinsics(key: str, k: tuple[float, ...]) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a camera matrix, row by row."""
    if len(k) != 9:
        raise ConfigError(f"{key}: expected 9 numbers, found {len(k)}")
    if any((k[1], k[3], k[6], k[7])) or k[8] != 1.0:
        raise ConfigError(f"{key}: expected [fx, 0, cx, 0, fy, cy, 0, 0, 1], without skew")
    return k[0], k[4], k[2], k[5]


def _matrix(tree: dict[Any, Any], key: str) -> tuple[float, ...]:
    block = tree[key]
    if not isinstance(block, dict) or "data" not in block or not set(block) <= _MATRIX_KEYS:
        raise ConfigError(f"{key}: expected rows, cols and data, found {block!r}")
    return numbers_of(f"{key}.data", block["data"])
