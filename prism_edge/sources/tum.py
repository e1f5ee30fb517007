"""TUM RGB-D layout (BONN's too): rgb.txt lists stamps and colour images."""

from __future__ import annotations

from pathlib import Path

from prism_edge.errors import SourceError
from prism_edge.sources.known_cameras import ROS_DEFAULT, by_name
from prism_edge.sources.listing import Listing, lines_of
from prism_edge.sources.stamps import parse_seconds


def find(folder: Path, rate_hz: float) -> Listing | None:
    """The sequence in a folder, None where its layout is another; SourceError where its list is damaged."""
    if not (folder / "rgb.txt").is_file():
        return None
    stamps, files = read_list(folder, "rgb.txt")
    return Listing("TUM RGB-D", files, stamps, lambda: by_name(folder) or ROS_DEFAULT)


def read_list(folder: Path, name: str) -> tuple[tuple[int, ...], tuple[Path, ...]]:
    """Stamps (ns) and files of rgb.txt or depth.txt; raises SourceError naming file and line."""
    stamps, files = [], []
    for number, words in lines_of(folder / name):
        if len(words) != 2:
            raise SourceError(f"{folder / name} line {number}: expected a stamp and the name of a file")
        try:
            stamps.append(parse_seconds(words[0]))
        except ValueError as error:
            raise SourceError(f"{folder / name} line {number}: {error}") from None
        files.append(folder / words[1])
    return tuple(stamps), tuple(files)
