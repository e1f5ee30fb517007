"""A plain folder of images, in order of names or stamps in them; its camera has a file or a known name."""

from __future__ import annotations

import math
import re
from collections.abc import Set
from pathlib import Path

from prism_edge.sources.base import DEFAULT_RATE_HZ
from prism_edge.sources.image_file import SUFFIXES
from prism_edge.sources.known_cameras import by_full_name
from prism_edge.sources.listing import Listing, files_in
from prism_edge.sources.stamps import at_rate, decimals, from_names

FOLDER_OF_IMAGES = "folder of images"  # the layout's name
COVERAGE = ".coverage.png"  # what calibrate calls its picture, in the place of its camera file's .yaml
MASK = "mask.png"  # what `prism-edge mask` writes where nobody says otherwise
_OWN = (MASK, f"camera{COVERAGE}")  # that is left of a calibration that was refused, too
_DEPTH = re.compile(r"(?<![a-z])depth(?![a-z])")


def find(folder: Path, rate_hz: float) -> Listing | None:
    """The images in a folder; None where there are none.

    Stamped by their names where those are nanoseconds or seconds since 1970, else at ``rate_hz`` (0: 30 Hz).
    """
    files = files_in(folder)
    found = tuple(path for path in files if path.suffix.lower() in SUFFIXES)
    others = [path for path in files if path.suffix.lower() not in SUFFIXES]
    pictures = {of(path) for path in others for of in (coverage_of, refused_coverage_of)}
    images = tuple(path for path in found if not _is_no_frame(path, pictures)) or found
    if not images:
        return None
    named = from_names([path.stem for path in images])
    if named:  # 0.9 s is later than 0.88 s, though 9 comes before 88
        named, images = zip(*sorted(zip(named, images, strict=True)), strict=True)
    elif numbers := decimals([path.stem for path in images]):  # with what is called otherwise behind them
        images = tuple(sorted(images, key=lambda path: numbers.get(path.stem, math.inf)))
    stamps = named or tuple(at_rate(i, rate_hz or DEFAULT_RATE_HZ) for i in range(len(images)))
    return Listing(FOLDER_OF_IMAGES, images, stamps, lambda: by_full_name(folder), bool(named))


def coverage_of(camera_file: Path) -> Path:
    """The picture of the coverage that calibrate puts beside a camera file."""
    if camera_file.suffix.lower() in (".yaml", ".yml"):
        return camera_file.with_suffix(COVERAGE)
    return camera_file.with_name(camera_file.name + COVERAGE)  # cam.left and cam.right are two cameras


def refused_coverage_of(camera_file: Path) -> Path:
    """That of a try that was refused, beside a camera file that is there: its own stays as it is."""
    picture = coverage_of(camera_file)
    return picture.with_name(picture.name.removesuffix(COVERAGE) + ".refused" + COVERAGE)


def _is_no_frame(image: Path, pictures: Set[Path]) -> bool:
    """Whether an image beside others is one that our own tools wrote, or the depth of another.

    ``pictures`` of coverage are those that files which are no image would have, a camera file among them.
    """
    return image.name in _OWN or image in pictures or _DEPTH.search(image.name.lower()) is not None
