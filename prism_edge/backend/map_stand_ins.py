"""Which keyframes of a stored map stand in for older ones: plain values beside its arrays (map_stamps.py).

Those show what has been placed before, so they have no say in where it is.
"""

from __future__ import annotations

from collections.abc import Sequence

from prism_edge.backend.map_file import Info
from prism_edge.errors import MapError
from prism_edge.messages import LARGEST_ID

FIELD = "stand_ins"
MOST = 200  # a known place gives those up that are a dozen keyframes old


def stand_ins_info(keyframes: Sequence[int]) -> Info:
    """The numbers of keyframes that stand in, for a stored map; of too many, the newest."""
    return {FIELD: sorted(keyframes)[-MOST:]} if keyframes else {}


def stand_ins_told(info: Info) -> set[int]:
    """The numbers of keyframes that stand in; none where the map doesn't say (earlier builds' maps).

    Raises MapError where it says what can't be.
    """
    told = info.get(FIELD, [])
    if not isinstance(told, list) or len(told) > MOST or not all(map(_can_be, told)):
        raise MapError(f"the map's {FIELD} are none of its keyframes")
    return set(told)


def _can_be(number: object) -> bool:
    return type(number) is int and 0 <= number < LARGEST_ID
