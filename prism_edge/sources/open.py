"""From a configuration to the source that it names, recognised by what is there."""

from __future__ import annotations

import logging
import os
from collections.abc import Iterable
from itertools import chain
from pathlib import Path

from prism_edge.config import SourceConfig
from prism_edge.errors import ConfigError, SourceError
from prism_edge.named_path import hindrance, named_path
from prism_edge.sources import image_folder, kitti, seven_scenes, tum
from prism_edge.sources.address import shown_address
from prism_edge.sources.base import DEFAULT_RATE_HZ, Source
from prism_edge.sources.beginning import Beginning
from prism_edge.sources.camera_file import read_camera
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.image_sequence import ImageSequence
from prism_edge.sources.known_cameras import GUESSES
from prism_edge.sources.listing import Intrinsics, Listing
from prism_edge.sources.live.open import is_live, open_live
from prism_edge.sources.loop import Looped
from prism_edge.sources.shrunk import Shrunk
from prism_edge.sources.sim import SimSource, is_simulated
from prism_edge.sources.unrecognised import guess, no_video
from prism_edge.sources.video import Video

log = logging.getLogger("prism_edge.sources")

# Asked in this order: each dataset's marks are looked for before a folder is just one of images.
LAYOUTS = (tum.find, seven_scenes.find, kitti.find, image_folder.find)
CAMERA_FILES = ("camera.yaml", "camera_info.yaml")
RECOGNISED = (
    "TUM RGB-D or BONN (rgb.txt), 7-Scenes (frame-000000.color.png), KITTI odometry (image_0 or image_2, "
    "calib.txt, times.txt), a folder of images, a video file, "
    "the simulator (sim:room, sim:loop, sim:street, sim:town and more), "
    "a camera (v4l2:/dev/video0, oak:, rtsp://HOST/PATH, http://HOST/PATH)"
)

AUTO = "auto"  # in place of a camera file: the depth network is asked (workers/uncalibrated.py)
AUTO_NEEDS = "camera auto needs a depth network that predicts intrinsics (--model)"
_UNKNOWN: Intrinsics = ("not calibrated", UNCALIBRATED)


def open_source(config: SourceConfig, calibrated: bool = True) -> Source:
    """The source that a configuration names, still closed.

    Where it needn't be ``calibrated``, or its camera is AUTO, missing intrinsics are no error: its camera is
    then UNCALIBRATED, until whoever opened it gives it another. With ``shrink`` images and camera are
    smaller than those of the recording.
    Raises SourceError where it is not there, not recognised, or empty, and ConfigError where its camera
    file is wrong or missing.
    """
    source = _whole(config, calibrated and config.camera != AUTO)
    return Shrunk(source, config.shrink) if config.shrink > 1 else source


def _whole(config: SourceConfig, calibrated: bool) -> Source:
    """:func:`open_source` before its images are made smaller."""
    if not config.uri:
        raise SourceError(f"no source given; name one of: {RECOGNISED}")
    path = named_path(config.uri)
    source: Source
    if is_simulated(config.uri):
        if config.camera:
            raise ConfigError("a simulated camera is set in its address (width, height, focal), not a file")
        source = SimSource(config.uri)
    elif is_live(config.uri):
        return open_live(config, calibrated)
    elif os.path.isdir(path):
        source = _folder(path, config, calibrated)
    elif os.path.isfile(path) and (words := no_video(path)):
        raise SourceError(f"{path} {words}")
    elif os.path.isfile(path):
        known = _camera_file([path.parent], config) if calibrated else _UNKNOWN
        origin, camera = known or _no_camera(path)
        source = Video(path, camera, origin, config.rate_hz)
    elif os.path.exists(path):
        raise SourceError(f"{path} is neither a folder nor a file; recognised are: {RECOGNISED}")
    elif hindered := hindrance(path):
        raise SourceError(f"{shown_address(str(path))} can't be read ({hindered})")
    else:
        raise SourceError(f"{shown_address(str(path))} does not exist; give one of: {RECOGNISED}")
    source = Beginning(source, config.frames) if config.frames else source
    return Looped(source) if config.loop else source


def find_listing(folder: Path, rate_hz: float = 0.0) -> Listing:
    """What a folder holds; raises SourceError where nothing is recognised or it lists no image."""
    for find in LAYOUTS:
        try:
            listing = find(folder, rate_hz)
        except OSError as error:  # it may be listed, but not entered
            raise SourceError(f"{folder} can't be read ({error.strerror})") from None
        if listing is not None:
            if not listing.files:
                raise SourceError(f"{folder} looks like {listing.layout} but holds no image")
            return listing
    if words := guess(folder):
        raise SourceError(f"{folder} {words}")
    raise SourceError(
        f"{folder} is empty or of no known kind; recognised are: {RECOGNISED}; "
        "docs/SOURCES.md, Another dataset, says how any recording is laid out"
    )


def _folder(folder: Path, config: SourceConfig, calibrated: bool) -> Source:
    listing = find_listing(folder, config.rate_hz)
    folders = dict.fromkeys((folder, listing.files[0].parent))
    known = (_camera_file(folders, config) or listing.intrinsics()) if calibrated else _UNKNOWN
    origin, camera = known or _no_camera(folder)
    if known in GUESSES:
        log.warning("%s names no known camera: taking the %s", folder, origin)
    if listing.doubt:
        log.warning("%s: %s", folder, listing.doubt)
    if not listing.stamped and not config.rate_hz and (calibrated or config.camera == AUTO):
        words = "%s: nothing says when its images were taken: assuming %g Hz (else set source.rate_hz)"
        log.warning(words, folder, DEFAULT_RATE_HZ)
    return ImageSequence(folder, listing, camera, origin)


def _camera_file(folders: Iterable[Path], config: SourceConfig) -> Intrinsics | None:
    """The configured camera file, else one that lies with the images."""
    if config.camera:
        return config.camera, read_camera(named_path(config.camera))
    for path in chain.from_iterable(camera_files(str(folder)) for folder in folders):
        if os.path.isfile(path):
            return str(path), read_camera(path)
    return None


def camera_files(uri: str) -> list[Path]:
    """Where a camera file may lie with a recording that is there, best first; others have none."""
    path = named_path(uri)
    folder = path if os.path.isdir(path) else path.parent
    of_euroc = [folder.parent / "sensor.yaml"] if folder.name == "data" else []
    return [*(folder / name for name in CAMERA_FILES), *of_euroc] if os.path.exists(path) else []


def _no_camera(path: Path) -> Intrinsics:
    raise ConfigError(f"nothing says which camera took {path}; give a camera file (--camera FILE)")
