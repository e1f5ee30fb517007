"""A plain folder of images, in natural order of their names; its camera has a file or a known name."""

from __future__ import annotations

from collections.abc import Set
from pathlib import Path

from prism_edge.sources.base import DEFAULT_RATE_HZ
from prism_edge.sources.image_file import SUFFIXES
from prism_edge.sources.known_cameras import by_full_name
from prism_edge.sources.listing import Listing, files_in
from prism_edge.sources.stamps import at_rate, from_names

COVERAGE = ".coverage.png"  # what calibrate calls its picture, behind the stem of its camera file


def find(folder: Path, rate_hz: float) -> Listing | None:
    """The images in a folder; None where there are none.

    Stamped by their names where those are nanoseconds, else at ``rate_hz`` (0: 30 Hz).
    """
    files = files_in(folder)
    others = {path.stem for path in files if path.suffix.lower() not in SUFFIXES}
    images = tuple(
        path for path in files if path.suffix.lower() in SUFFIXES and not _is_coverage(path.name, others)
    )
    if not images:
        return None
    named = from_names([path.stem for path in images])
    stamps = named or tuple(at_rate(i, rate_hz or DEFAULT_RATE_HZ) for i in range(len(images)))
    return Listing("folder of images", images, stamps, lambda: by_full_name(folder), bool(named))


def _is_coverage(name: str, stems: Set[str]) -> bool:
    """Whether an image is the picture beside a camera file, by the stems of what is no image."""
    return name.endswith(COVERAGE) and name.removesuffix(COVERAGE) in stems
