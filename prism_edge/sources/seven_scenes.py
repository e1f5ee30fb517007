"""7-Scenes layout: frame-NNNNNN.color.png (or .jpg), .depth.png, .pose.txt; 30 images a second."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path
from statistics import median

from prism_edge.errors import SourceError
from prism_edge.sources.image_file import SUFFIXES
from prism_edge.sources.known_cameras import seven_scenes
from prism_edge.sources.listing import Listing, files_in
from prism_edge.sources.stamps import at_rate

RATE_HZ = 30.0
_ARCHIVE = re.compile(r"seq-\d\d\.zip")
_COLOUR = re.compile(r"frame-(\d{6,})\.color\.(?:png|jpe?g)", re.IGNORECASE)


def find(folder: Path, rate_hz: float) -> Listing | None:
    """The sequence in a folder (or in the one seq-NN below it), None where its layout is another."""
    found = _colour_images(folder)
    if not found:
        below = _sequences(folder)
        if len(below) > 1:
            names = ", ".join(path.name for path in below)
            raise SourceError(f"{folder} holds several sequences; name one of them: {names}")
        if not below and (packed := _packed(folder)):
            raise SourceError(f"{folder} holds its sequences in archives: unpack {packed[0]} first")
        if not below:
            return None
        found = _colour_images(below[0])
    return Listing(
        "7-Scenes",
        tuple(path for _, path in found),
        tuple(at_rate(number, RATE_HZ) for number, _ in found),
        lambda: seven_scenes(folder),
        doubt=_gaps([number for number, _ in found]),
    )


def _gaps(numbers: list[int]) -> str:
    """What to know of numbers that are missing in between, where not every second, third, ... was kept."""
    steps = [after - before for before, after in pairwise(sorted(set(numbers)))]
    missing = sum(steps) - len(steps)
    if not missing or median(steps) > 1:
        return ""
    return f"{missing} images are missing in between, by their numbers; they are in no count"


def _packed(folder: Path) -> list[str]:
    """Names of a scene's archives, where nothing lies beside them but the scene's preview picture."""
    names = [path.name for path in files_in(folder)]
    others = [name for name in names if Path(name).suffix.lower() in SUFFIXES]
    there = [name for name in names if _ARCHIVE.fullmatch(name)]
    return there if len(others) < 2 and "calib.txt" not in names else []


def _sequences(folder: Path) -> list[Path]:
    """The folders of sequences below one of a scene, each as it is or, unpacked into its own, one deeper."""
    named = [path for path in sorted(folder.glob("seq-*")) if path.is_dir()]
    deeper = [path if _colour_images(path) else path / path.name for path in named]
    return [path for path in deeper if path.is_dir() and _colour_images(path)]


def _colour_images(folder: Path) -> list[tuple[int, Path]]:
    matches = ((_COLOUR.fullmatch(path.name), path) for path in files_in(folder))
    return [(int(match[1]), path) for match, path in matches if match]
