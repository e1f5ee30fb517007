"""The rolling shutter's readout that was found of a map, in its file: its keypoints were moved for it."""

from __future__ import annotations

from prism_edge.backend.map_file import Info
from prism_edge.errors import MapError
from prism_edge.geometry.cameras import LONGEST_READOUT_MS

FIELD = "readout_ms"


def readout_info(readout_ms: float) -> Info:
    """What a stored map says of it; nothing where none was found."""
    return {FIELD: readout_ms} if readout_ms else {}


def readout_told(info: Info) -> float:
    """The readout that a stored map's keypoints were moved for, ms; 0 where it says nothing.

    Raises MapError where it says one that can't be.
    """
    told = info.get(FIELD, 0.0)
    if type(told) not in (int, float) or not abs(told) <= LONGEST_READOUT_MS:
        raise MapError(f"the map's {FIELD} is no camera's")
    return float(told)
