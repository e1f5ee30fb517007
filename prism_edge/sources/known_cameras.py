"""Published intrinsics of datasets whose folders don't carry them (data)."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

from prism_edge.geometry.cameras import Camera

# Of a Kinect, as measured on another dataset's (docs/CAMERAS.md).
_KINECT_MS = 23.0
# Rendered at once; or compared with references that take all rows so, as structure from motion does.
_AT_ONCE_MS = 0.0


def _vga(
    matrix: tuple[float, float, float, float],
    distortion: tuple[float, ...] = (),
    readout_ms: float | None = None,
) -> Camera:
    """A 640x480 camera of fx fy cx cy."""
    return Camera(640, 480, *matrix, distortion=distortion, readout_ms=readout_ms)


# A part of the folder's name -> what it is, and its colour camera. The first that fits counts.
BY_NAME = {
    "freiburg1": (
        "TUM freiburg1 colour calibration",
        _vga(
            (517.306408, 516.469215, 318.643040, 255.313989),
            (0.262383, -0.953104, -0.005358, 0.002628, 1.163314),
            _KINECT_MS,
        ),
    ),
    "freiburg2": (
        "TUM freiburg2 colour calibration",
        _vga(
            (520.908620, 521.007327, 325.141442, 249.701764),
            (0.231222, -0.784899, -0.003257, -0.000105, 0.917205),
            _KINECT_MS,
        ),
    ),
    "freiburg3": ("TUM freiburg3 colour calibration", _vga((535.4, 539.2, 320.1, 247.6))),
    "rgbd_bonn": (
        "BONN colour calibration",
        _vga(
            (542.822841, 542.576870, 315.593520, 237.756098),
            (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
        ),
    ),
    "tartanair": ("TartanAir intrinsics", _vga((320.0, 320.0, 320.0, 240.0), (), _AT_ONCE_MS)),
    "new_tsukuba": ("New Tsukuba intrinsics", _vga((615.0, 615.0, 320.0, 240.0), (), _AT_ONCE_MS)),
}
SEVEN_SCENES = ("colour as of any Kinect (7-Scenes)", _vga((525.0, 525.0, 320.0, 240.0), (), _AT_ONCE_MS))
SEVEN_SCENES_GUESS = (
    f"{SEVEN_SCENES[0]} (a guess by its files' names: give a camera file)",
    replace(SEVEN_SCENES[1], readout_ms=None),
)
ROS_DEFAULT = ("ROS default for a Kinect (a guess: give a camera file)", _vga((525.0, 525.0, 319.5, 239.5)))

GUESSES = (SEVEN_SCENES_GUESS, ROS_DEFAULT)

# What else people call them: only as whole words, for so short a name may be part of any other.
SHORT = {
    "fr1": "freiburg1",
    "fr2": "freiburg2",
    "fr3": "freiburg3",
    "bonn": "rgbd_bonn",
    "tsukuba": "new_tsukuba",
}

# Names that nobody gives to images of his own: for folders in which nothing else speaks for a dataset.
_FULL = re.compile(
    r"(?<![a-z0-9])(?:rgbd_dataset_(freiburg[123])(?![0-9])|(rgbd_bonn)_|(tartanair)|(new_tsukuba)(?![a-z0-9]))"
)

_DATASET = re.compile(r"(?<![a-z0-9])7[-_ ]?scenes(?![a-z0-9])")
_SCENE = re.compile(r"(?<![a-z0-9])(?:chess|fire|heads|office|pumpkin|redkitchen|stairs)(?![a-z0-9])")

# A name further up says little about the folder; TartanAir's images lie four below its own. A scene's is any
# office's: it counts for the folder, its parent and, unpacked one too deep, that one's.
_LEVELS, _OF_SCENE = 5, 3


def by_name(folder: Path) -> tuple[str, Camera] | None:
    """What a folder's name, or else that of one of its nearest parents, is known for."""
    for part in _names(folder):
        for name, known in BY_NAME.items():
            if name in part:
                return known
        for word in re.split(r"[^a-z0-9]+", part):
            if word in SHORT:
                return BY_NAME[SHORT[word]]
    return None


def by_full_name(folder: Path) -> tuple[str, Camera] | None:
    """The same by a dataset's full name alone, as it unpacks."""
    found = next((match for part in _names(folder) if (match := _FULL.search(part))), None)
    return found and BY_NAME[next(filter(None, found.groups()))]


def seven_scenes(folder: Path) -> tuple[str, Camera]:
    """7-Scenes' camera; a guess where no name speaks for it, as other recorders name their files alike."""
    found = any(map(_DATASET.search, _names(folder))) or any(map(_SCENE.search, _names(folder, _OF_SCENE)))
    return SEVEN_SCENES if found else SEVEN_SCENES_GUESS


def _names(folder: Path, levels: int = _LEVELS) -> list[str]:
    """As it is called, nearest first, and then where links lead to."""
    called, led = Path(os.path.abspath(folder)), folder.resolve()
    paths = [called] if led == called else [called, led]
    return [part.lower() for path in paths for part in reversed(path.parts[-levels:])]
