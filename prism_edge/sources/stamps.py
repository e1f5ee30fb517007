"""Times written as decimal seconds, kept exactly: near today's epoch a float64 steps by 0.24 us."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from itertools import pairwise

import numpy as np

_NS = Decimal(10**9)
_LIMIT = Decimal(2**63 - 1)
_LEAST_NS = 1_000_000  # between images that are named by their stamps
_NANOSECONDS = re.compile(r"[0-9]{17,19}")
_SECONDS = re.compile(r"[0-9]{10}(\.[0-9]{1,9})?")
_DECIMAL = re.compile(r"[0-9]+(\.[0-9]+)?")
_APART_NS = 3600 * 10**9  # no pause before the last image or after the first
_ROS_NS = 2**31 * 10**9  # builtin_interfaces/Time has 32 bits for seconds: until January 2038


def parse_seconds(text: str) -> int:
    """Nanoseconds of decimal seconds ('1305031102.175304', '1.0e-01'); ValueError for anything else.

    Its text asks about the unit where that may be another: today's date in milliseconds is past any second.
    """
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"{text!r} is no time in seconds") from None
    if not value.is_finite():
        raise ValueError(f"{text!r} is no time in seconds")
    if abs(value) > _LIMIT / _NS:  # before it is multiplied: decimals have a largest number
        raise ValueError(f"{text!r} is no time in seconds; nanoseconds or milliseconds? lists have seconds")
    return int((value * _NS).to_integral_value())


def fits_ros(stamp_ns: int) -> bool:
    """Whether a ROS message can carry the stamp."""
    return -_ROS_NS <= stamp_ns < _ROS_NS


def write_seconds(stamp_ns: int) -> str:
    """Decimal seconds, nine decimals, exact: what :func:`parse_seconds` reads back."""
    sign, stamp = ("-", -stamp_ns) if stamp_ns < 0 else ("", stamp_ns)
    return f"{sign}{stamp // 10**9}.{stamp % 10**9:09d}"


def from_names(names: Sequence[str]) -> tuple[int, ...] | None:
    """The stamps (ns) that images are named by, as EuRoC's and TUM's are; None where their names are no such.

    Whole nanoseconds of 17 to 19 digits, all alike, or seconds since 1970, at least one with a point in it
    (1305031102.175304, trailing zeros left out or not). No two are the same, and usually they are a
    millisecond apart and more: today's microseconds have 16 digits, and counters with zeros in front go up
    by less.
    """
    if len(names) < 2:
        return None
    if all(map(_SECONDS.fullmatch, names)) and any("." in name for name in names):
        stamps = tuple(map(parse_seconds, names))
    elif all(map(_NANOSECONDS.fullmatch, names)) and len({len(name) for name in names}) == 1:
        stamps = tuple(map(int, names))
    else:
        return None
    in_order = sorted(stamps)
    once = all(b > a for a, b in pairwise(in_order)) and fits_ros(in_order[-1])
    return stamps if once and usual_period_ns(in_order, 0) >= _LEAST_NS else None


def decimals(names: Sequence[str]) -> dict[str, Decimal]:
    """The names that are decimal numbers with fewer digits where zeros would end them (0.05, 0.1, 0.15, 1.0).

    Empty where there are none, or where they may be counters (1.9, 1.11): no counter has .05 beside .1.
    """
    found = {name: Decimal(name) for name in names if _DECIMAL.fullmatch(name)}
    fractions = [name.partition(".")[2] for name in found]
    lengths = {len(fraction) for fraction in fractions}
    counted = any(len(fraction) > 1 and fraction.endswith("0") for fraction in fractions)
    surely = any(len(fraction) > 1 and fraction.startswith("0") for fraction in fractions)
    return {} if counted or not surely or len(lengths) < 2 or len(set(found.values())) < len(found) else found


def at_rate(index: int, rate_hz: float) -> int:
    """Nanoseconds at which image ``index`` of a regular sequence was taken."""
    return round(index * 1e9 / rate_hz)


def usual_period_ns(stamps_ns: Sequence[int], default_ns: int) -> int:
    """Median time between successive images; stamps that repeat or go backwards don't count."""
    steps = [b - a for a, b in pairwise(stamps_ns) if b > a]
    return int(np.median(steps)) if steps else default_ns


def out_of_line(stamps_ns: Sequence[int]) -> frozenset[int]:
    """Which images have stamps that can't be right, as they would take the place of others'.

    An image goes out where its stamp lies behind all before it: so one that leaps ahead would cost all that
    follow. Where leaving out some lets more go out, those are out of line (what isn't in the longest row of
    rising stamps). So are the first ones or the last, a tenth of all at most, an hour and more from the rest,
    which nobody would wait for.
    """
    fitting = [index for index, stamp in enumerate(stamps_ns) if fits_ros(stamp)]
    row: list[int] = []
    for index in fitting:
        if not row or stamps_ns[index] > stamps_ns[row[-1]]:
            row.append(index)
    longest, found = _longest_rising(stamps_ns, fitting), set[int]()
    if len(longest) > len(row):
        row, found = longest, set(fitting) - set(longest)
    leaps = [n + 1 for n, (a, b) in enumerate(pairwise(row)) if stamps_ns[b] - stamps_ns[a] > _APART_NS]
    few = max(1, len(row) // 10)
    if leaps and leaps[0] <= few < len(row) - 1:
        row, leaps = row[leaps[0] :], [leap - leaps[0] for leap in leaps[1:]]
        found |= {index for index in fitting if stamps_ns[index] < stamps_ns[row[0]] - _APART_NS}
    if leaps and len(row) - leaps[-1] <= few < len(row) - 1:
        row = row[: leaps[-1]]
        found |= {index for index in fitting if stamps_ns[index] > stamps_ns[row[-1]] + _APART_NS}
    return frozenset(found)


def _longest_rising(values: Sequence[int], indices: Sequence[int]) -> list[int]:
    """Those of the indices (rising) whose values make the longest row that rises (patience sorting)."""
    ends: list[int] = []  # the least value that a row of each length ends with
    last: list[int] = []  # the index of that
    before: dict[int, int | None] = {}
    for index in indices:
        place = bisect_left(ends, values[index])
        before[index] = last[place - 1] if place else None
        if place == len(ends):
            ends.append(values[index])
            last.append(index)
        elif values[index] < ends[place]:
            ends[place], last[place] = values[index], index
    row: list[int] = []
    at = last[-1] if last else None
    while at is not None:
        row.append(at)
        at = before[at]
    return row[::-1]
