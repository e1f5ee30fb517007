"""What a dataset's folder holds, found without reading an image; each layout's reader makes one."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from prism_edge.errors import SourceError
from prism_edge.geometry.cameras import Camera

Intrinsics = tuple[str, Camera]  # where they are from, and they


@dataclass(frozen=True)
class Listing:
    """Images of one sequence in order, with their stamps."""

    layout: str  # "TUM RGB-D"
    files: tuple[Path, ...]
    stamps_ns: tuple[int, ...]
    # Asked only where no camera file speaks; None: the layout knows none.
    intrinsics: Callable[[], Intrinsics | None]
    stamped: bool = True  # False: nothing says when images were taken, so they come at a rate
    doubt: str = ""  # what to know before it is played, in words that follow the folder's name and a colon

    def __post_init__(self) -> None:
        if len(self.files) != len(self.stamps_ns):
            raise ValueError("a listing takes a stamp for each file")


def natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Sort key under which image 2 comes before image 10."""
    parts = [part for part in re.split(r"([0-9]+)", path.name) if part]
    return [(0, int(part), "") if "0" <= part[0] <= "9" else (1, 0, part) for part in parts]


def files_in(folder: Path) -> list[Path]:
    """The files of a folder in natural order; raises SourceError where it can't be read."""
    try:
        # ._x.png is what macOS notes about x.png where a disk has no other place for it. A link that leads
        # nowhere is a file that is missing.
        entries = (path for path in folder.iterdir() if not path.name.startswith("._"))
        files = (path for path in entries if path.is_file() or (path.is_symlink() and not path.exists()))
        return sorted(files, key=natural_order)
    except OSError as error:
        raise SourceError(f"{folder} can't be read ({error.strerror})") from None


def lines_of(path: Path, comments: bool = True) -> list[tuple[int, list[str]]]:
    """(line number, words) of a text table without its blank lines and, where it may have them, # comments.

    Raises SourceError where the file can't be read or is no text.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")  # Windows' editors put a mark in front
    except OSError as error:
        raise SourceError(f"{path} can't be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise SourceError(f"{path} is no text file") from None
    lines = (line.split("#", 1)[0] if comments else line for line in text.splitlines())
    rows = ((number, line.split()) for number, line in enumerate(lines, 1))
    return [(number, words) for number, words in rows if words]
