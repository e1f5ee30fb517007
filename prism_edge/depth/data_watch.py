"""Whether weights beside a network are still what they were when it was loaded.

onnxruntime maps such files into memory: one that is overwritten in place changes the network while it runs,
and one that is cut short ends the process. A file that another replaces (mv) leaves what is mapped alone.
"""

from __future__ import annotations

import os
from pathlib import Path

from prism_edge.errors import ModelError


class DataWatch:
    """Remembers how external data were found, and looks again. Raises ModelError where one can't be read."""

    def __init__(self, files: tuple[Path, ...]) -> None:
        try:
            self._found = {file: _state(file.stat()) for file in files}
        except OSError as error:
            raise ModelError(f"{error.filename}: can't be read ({error.strerror})") from None

    def check(self) -> None:
        """Raises ModelError for a file that was written to since."""
        for file, found in self._found.items():
            try:
                now = _state(file.stat())
            except OSError:  # removed or replaced: what is mapped stays
                continue
            if now[:2] == found[:2] and now != found:
                raise ModelError(
                    f"{file}: was overwritten while the network runs; start it again, replace files by mv"
                )


def _state(of: os.stat_result) -> tuple[int, int, int, int]:
    return of.st_dev, of.st_ino, of.st_size, of.st_mtime_ns
