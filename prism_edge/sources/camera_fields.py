"""Fields of a camera file, checked: what is wrong is said with its key."""

from __future__ import annotations

import math
from collections.abc import Set
from typing import Any

from prism_edge.errors import ConfigError


def check_keys(
    tree: dict[Any, Any], known: Set[str], required: tuple[str, ...], ignored: Set[str] = frozenset()
) -> None:
    """Raises ConfigError for a key that is not ``known``, or a required one that is missing."""
    for key in tree:
        if key not in known and key not in ignored:
            raise ConfigError(f"key {key!r} is not known (known: {', '.join(sorted(known))})")
    for key in required:
        if key not in tree:
            raise ConfigError(f"key {key!r} is missing")


def word_of(tree: dict[Any, Any], key: str, default: str) -> str:
    """A text, ``default`` where the key is missing. Raises ConfigError for anything else, as all below do."""
    value = tree.get(key, default)
    if not isinstance(value, str):
        raise ConfigError(f"{key}: expected a word, found {value!r}")
    return value


def number_of(key: str, value: Any) -> float:
    """A finite number."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{key}: expected a number, found {value!r}")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ConfigError(f"{key}: expected a finite number, found {value!r}")
    return number


def numbers_of(key: str, value: Any) -> tuple[float, ...]:
    """A list of them."""
    if not isinstance(value, list):
        raise ConfigError(f"{key}: expected a list of numbers, found {value!r}")
    return tuple(number_of(key, item) for item in value)


def size_of(key: str, value: Any) -> int:
    """A side of an image, pixels."""
    number = number_of(key, value)
    if not number.is_integer() or not 1 <= number <= 65_535:
        raise ConfigError(f"{key}: expected a whole number of pixels from 1 to 65535, found {number:g}")
    return int(number)


def counted(key: str, values: tuple[float, ...], counts: tuple[int, ...], name: str) -> tuple[float, ...]:
    """The values, if they are as many as what is called ``name`` takes."""
    if len(values) not in counts:
        raise ConfigError(f"{key}: {name} takes {' or '.join(map(str, counts))}, not {len(values)}")
    return values
