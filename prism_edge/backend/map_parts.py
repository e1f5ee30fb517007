"""Which part of a stored map each keyframe was made in: plain values beside the arrays, as map_stamps.py's.

A part that nobody has joined lies nowhere yet, and what was made at home stays at home, also where culling
or a message that was lost has left no point that joins it to the rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from prism_edge.backend.map_file import Info
from prism_edge.errors import MapError
from prism_edge.messages import HOME, LARGEST_ID

FIELD, GROWTH = "parts", "part_growth"
MOST = 2_000  # keyframes away from home: beside map_stamps.MOST stamps, map_file.LARGEST_HEADER has no room


def parts_info(parts: Mapping[int, int | None]) -> Info:
    """The part of each keyframe, None where nobody has said it, for a stored map.

    Nothing where that is so of one, where too many are away from home, or where all are: whoever takes that
    map up has no other home than what is in it.
    """
    away = [[k, part] for k, part in sorted(parts.items()) if part != HOME]
    if len(away) > MOST or None in parts.values() or (away and len(away) == len(parts)):
        return {}
    return {FIELD: away}


def parts_told(info: Info) -> dict[int, int] | None:
    """The part of each keyframe away from home; None where the map doesn't say (earlier builds' maps).

    Raises MapError where it says what can't be.
    """
    told = info.get(FIELD)
    if told is None and FIELD not in info:
        return None
    if not isinstance(told, list) or len(told) > MOST or not all(map(_can_be, told)):
        raise MapError(f"the map's {FIELD} are none of its keyframes")
    return dict(told)


def growth_info(growth: Mapping[int, float]) -> Info:
    """For a journal: by how much loops have lengthened parts whose keyframes come in their old unit still."""
    return {GROWTH: [[part, by] for part, by in growth.items()]}


def growth_told(info: Info) -> dict[int, float]:
    """The growth of such parts; none where an earlier build wrote it. Raises MapError for what can't be."""
    told = info.get(GROWTH, [])
    if not isinstance(told, list) or not all(map(_can_grow, told)):
        raise MapError(f"the map's {GROWTH} is none of its parts")
    return dict(told)


def _can_grow(pair: object) -> bool:
    if not isinstance(pair, list) or len(pair) != 2:
        return False
    part, by = pair
    return type(part) is int and HOME <= part < LARGEST_ID and type(by) is float and 0.0 < by < math.inf


def _can_be(pair: object) -> bool:
    return (
        isinstance(pair, list)
        and len(pair) == 2
        and all(type(number) is int and 0 <= number < LARGEST_ID for number in pair)
    )
