"""What a run was made of besides its configuration: whose camera, what kind of recording, which truth."""

from __future__ import annotations

import contextlib
import os
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from prism_edge.config import SourceConfig
from prism_edge.named_path import named_path
from prism_edge.sources import Source
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.known_cameras import ROS_DEFAULT
from prism_edge.sources.open import AUTO, find_listing
from prism_edge.sources.sim import is_simulated

_NUMBERS = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion")


@dataclass(frozen=True)
class Played:
    """For metrics.json; None where nothing is known."""

    camera: dict[str, Any] | None = None  # origin, model, width height fx fy cx cy (pixels), distortion
    layout: str | None = None
    truth_file: str | None = None  # or the folder of many
    guessed: bool = False  # the camera

    def after(self, log: Path) -> Played:
        """The same with what a daemon's ``log`` says of a camera that nobody calibrated."""
        if self.camera is None or self.camera["origin"] != AUTO:
            return self
        said: list[str] = []
        with contextlib.suppress(OSError):
            said = re.findall(r"; camera: (.*)$", log.read_text(errors="replace"), re.MULTILINE)
        return replace(self, camera=self.camera | {"origin": f"{AUTO}: {said[-1]}" if said else AUTO})


def played(config: SourceConfig, source: Source, truth: Path | None) -> Played:
    """Of the ``source`` that a configuration names; ``truth`` is the file that was given, if one was."""
    layout = layout_of(config)
    known = source.camera is not UNCALIBRATED
    numbers = asdict(source.camera) if known else {}
    camera = {"origin": source.camera_origin if known else AUTO}
    file = truth or truth_file(config, layout)
    return Played(
        camera | {name: numbers.get(name) for name in _NUMBERS},
        layout,
        str(file) if file else None,
        source.camera_origin == ROS_DEFAULT[0],
    )


def layout_of(config: SourceConfig) -> str:
    """What kind of recording a configuration names; raises SourceError where a folder is of none."""
    path = named_path(config.uri)
    if is_simulated(config.uri):
        return "simulator"
    return find_listing(path, config.rate_hz).layout if path.is_dir() else "video file"


def truth_file(config: SourceConfig, layout: str) -> Path | None:
    """Where `sources/truth.py` finds a recording's own; of 7-Scenes, the folder of its .pose.txt."""
    folder = Path(os.path.abspath(named_path(config.uri)))
    if layout == "7-Scenes":
        return find_listing(folder).files[0].parent
    benchmarks = folder.parent.parent / "poses" / f"{folder.name}.txt"
    found = {"TUM RGB-D": [folder / "groundtruth.txt"], "KITTI odometry": [folder / "poses.txt", benchmarks]}
    return next((file for file in found.get(layout, []) if file.is_file()), None)
