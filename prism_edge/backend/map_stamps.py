"""When a stored map's keyframes were taken: plain values beside the arrays, which earlier builds pass over.

An array would be more fitting, but those builds refuse a map with one that they don't know.
"""

from __future__ import annotations

from collections.abc import Sequence

from prism_edge.backend.map_file import Info
from prism_edge.errors import MapError

FIELD = "stamps"
MOST = 40_000  # of 19 digits each, so that map_file.LARGEST_HEADER holds them and all else
LATEST_NS = (1 << 63) - 1


def stamps_info(stamps: Sequence[int | None]) -> Info:
    """Stamps (ns) of keyframes in their order, None where one isn't known, for a stored map.

    Nothing where none is known, or where there are too many: a map is worth more than its stamps.
    """
    if len(stamps) > MOST or all(stamp is None for stamp in stamps):
        return {}
    return {FIELD: list(stamps)}


def stamps_of(info: Info, count: int) -> list[int | None]:
    """The stamp (ns) of each of ``count`` keyframes, None where the map doesn't say (earlier builds' maps).

    Raises MapError where it says what can't be.
    """
    told = info.get(FIELD)
    if told is None and FIELD not in info:
        return [None] * count
    if not isinstance(told, list) or len(told) != count or not all(map(_can_be, told)):
        raise MapError(f"the map's {FIELD} are not a time for each keyframe")
    return told.copy()


def _can_be(stamp: object) -> bool:
    return stamp is None or (type(stamp) is int and abs(stamp) <= LATEST_NS)
