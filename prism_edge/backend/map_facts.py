"""What a stored map says beside its arrays, as plain values, which earlier builds pass over.

Arrays would be more fitting, but those builds refuse a map with one that they don't know. Each fact has two
functions: ``..._info`` is what a map's header says, ``..._told`` reads it back, and raises MapError where it
says what can't be.

When keyframes were taken; which of them stand in for older ones: those show what has been placed before, so
they have no say in where it is; which part of the map each was made in: a part that nobody has joined lies
nowhere yet, and what was made at home stays at home, also where culling or a message that was lost has left
no point that joins it to the rest; and a rolling shutter that was found: keypoints were moved for it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from prism_edge.backend.map_file import Info
from prism_edge.errors import MapError
from prism_edge.geometry.cameras import LONGEST_READOUT_MS
from prism_edge.messages import HOME, LARGEST_ID

STAMPS, STAND_INS, PARTS, GROWTH, READOUT = "stamps", "stand_ins", "parts", "part_growth", "readout_ms"
READOUT_SAID = "readout_said"
LATEST_NS = (1 << 63) - 1
# So that map_file.LARGEST_HEADER holds them all: stamps have 19 digits each.
MOST_STAMPS = 40_000
MOST_AWAY = 2_000  # keyframes away from home
MOST_STAND_INS = 200  # a known place gives those up that are a dozen keyframes old


def stamps_info(stamps: Sequence[int | None]) -> Info:
    """Stamps (ns) of keyframes in their order, None where one isn't known.

    Nothing where none is known, or where there are too many: a map is worth more than its stamps.
    """
    if len(stamps) > MOST_STAMPS or all(stamp is None for stamp in stamps):
        return {}
    return {STAMPS: list(stamps)}


def stamps_told(info: Info, count: int) -> list[int | None]:
    """The stamp (ns) of each of ``count`` keyframes, None where an earlier build wrote the map."""
    told = info.get(STAMPS, [None] * count)
    if not isinstance(told, list) or len(told) != count or not all(map(_is_stamp, told)):
        raise MapError(f"the map's {STAMPS} are not a time for each keyframe")
    return told.copy()


def stand_ins_info(keyframes: Sequence[int]) -> Info:
    """The numbers of keyframes that stand in; of too many, the newest."""
    return {STAND_INS: sorted(keyframes)[-MOST_STAND_INS:]} if keyframes else {}


def stand_ins_told(info: Info) -> set[int]:
    """The numbers of keyframes that stand in; none where the map doesn't say (earlier builds' maps)."""
    told = info.get(STAND_INS, [])
    if not isinstance(told, list) or len(told) > MOST_STAND_INS or not all(map(_is_number, told)):
        raise MapError(f"the map's {STAND_INS} are none of its keyframes")
    return set(told)


def parts_info(parts: Mapping[int, int | None]) -> Info:
    """The part of each keyframe, None where nobody has said it.

    Nothing where that is so of one, where too many are away from home, or where all are: whoever takes that
    map up has no other home than what is in it.
    """
    away = [[k, part] for k, part in sorted(parts.items()) if part != HOME]
    if len(away) > MOST_AWAY or None in parts.values() or (away and len(away) == len(parts)):
        return {}
    return {PARTS: away}


def parts_told(info: Info) -> dict[int, int] | None:
    """The part of each keyframe away from home; None where the map doesn't say (earlier builds' maps)."""
    if PARTS not in info:
        return None
    told = info[PARTS]
    pairs = isinstance(told, list) and len(told) <= MOST_AWAY and all(map(_is_pair, told))
    if not pairs or not all(map(_is_number, (number for pair in told for number in pair))):
        raise MapError(f"the map's {PARTS} are none of its keyframes")
    return dict(told)


def growth_info(growth: Mapping[int, float]) -> Info:
    """For a journal: by how much loops have lengthened parts whose keyframes come in their old unit still."""
    return {GROWTH: [[part, by] for part, by in growth.items()]}


def growth_told(info: Info) -> dict[int, float]:
    """The growth of such parts; none where an earlier build wrote it."""
    told = info.get(GROWTH, [])
    if not isinstance(told, list) or not all(_is_pair(pair) and _is_growth(*pair) for pair in told):
        raise MapError(f"the map's {GROWTH} is none of its parts")
    return dict(told)


def readout_info(readout_ms: float, is_said: bool = False) -> Info:
    """Nothing where none was found, nor ``is_said`` by a camera's file or the configuration."""
    return ({READOUT: readout_ms} if readout_ms else {}) | ({READOUT_SAID: True} if is_said else {})


def readout_told(info: Info) -> float:
    """The readout that a stored map's keypoints were moved for, ms; 0 where it says nothing."""
    told = info.get(READOUT, 0.0)
    if type(told) not in (int, float) or not abs(told) <= LONGEST_READOUT_MS:
        raise MapError(f"the map's {READOUT} is no camera's")
    return float(told)


def is_readout_said(info: Info) -> bool:
    """Whether the readout of a stored map's camera was said: what is found doesn't overrule that."""
    return info.get(READOUT_SAID) is True


def _is_stamp(stamp: object) -> bool:
    return stamp is None or (type(stamp) is int and abs(stamp) <= LATEST_NS)


def _is_number(number: object) -> bool:
    return type(number) is int and 0 <= number < LARGEST_ID


def _is_pair(pair: object) -> bool:
    return isinstance(pair, list) and len(pair) == 2


def _is_growth(part: object, by: object) -> bool:
    return type(part) is int and HOME <= part < LARGEST_ID and type(by) is float and 0.0 < by < math.inf
