"""Addresses of sources: how they may be shown, and their options, ``name=value&name=value``, checked."""

from __future__ import annotations

import math
import re
from dataclasses import fields
from difflib import get_close_matches
from typing import Any
from urllib.parse import SplitResult, urlsplit

from prism_edge.errors import SourceError

_SCHEME = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*):/+")
_OF_THIS_HOST = ("sim:", "v4l2:", "oak:")  # no password stands in these


def shown_address(uri: str) -> str:
    """A source's address as logs, errors and replies may show it: without user, password, query and options.

    A misspelt address is taken for a network camera's too; files and what is of this host stay as they are.
    """
    if uri.startswith(_OF_THIS_HOST):
        return uri
    scheme = _SCHEME.match(uri)
    if scheme is None:
        user, at, host = uri.rpartition("@")  # an address whose scheme was forgotten, or a file
        is_file = ":" not in user or user.startswith(("/", ".", "~"))
        return uri if not at or is_file else f"...@{host.partition('?')[0]}"
    try:
        return shown_parts(urlsplit(f"{scheme[1]}://{uri[scheme.end():]}"))
    except ValueError:
        return f"{scheme[1]}://..."


def shown_parts(parts: SplitResult) -> str:
    """The same of an address that is taken apart already."""
    _, at, host = parts.netloc.rpartition("@")
    rest = parts.path + parts.query + parts.fragment
    if not at and ":" in host and "@" in rest:  # a / ? or # in the password: this is no host
        return f"{parts.scheme}://..."
    path = "/..." if "@" in parts.path else parts.path
    return f"{parts.scheme}://{host}{path}" + ("?..." if parts.query else "")


def parse_options(shown: str, query: str, options: Any, without: tuple[str, ...] = ()) -> dict[str, Any]:
    """Values of the options that ``query`` gives, by name, checked against the fields of ``options``.

    ``options`` is a dataclass whose fields were made by the functions of ``config.py``; fields named in
    ``without`` can't be given. Raises SourceError in one line that begins with ``shown``, the address as
    it may be shown.
    """
    known = {field.name: field for field in fields(options) if field.name not in without}
    values: dict[str, Any] = {}
    for item in query.split("&") if query else []:
        name, equals, text = item.partition("=")
        if name not in known:
            near = get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]}?" if near else f"options are {', '.join(known)}"
            raise SourceError(f"{shown}: unknown option {name!r}; {hint}")
        if name in values:
            raise SourceError(f"{shown}: option {name} is given twice")
        if not equals or not text:
            raise SourceError(f"{shown}: option {name} has no value; write {name}=VALUE")
        values[name] = _value(shown, name, text, type(known[name].default), known[name].metadata)
    return values


def _value(shown: str, name: str, text: str, kind: type, metadata: Any) -> Any:
    choices = metadata.get("choices")
    if choices:
        if text not in choices:
            raise SourceError(f"{shown}: {name} must be one of {', '.join(choices)}, not {text!r}")
        return text
    if kind is str:
        return text
    try:
        value = kind(text)
    except ValueError:
        what = "a whole number" if kind is int else "a number"
        raise SourceError(f"{shown}: {name} must be {what}, not {text!r}") from None
    low, high = metadata["low"], metadata["high"]
    if not math.isfinite(value) or not low <= value <= high:
        raise SourceError(f"{shown}: {name} must be between {low:g} and {high:g}, not {text}")
    return value
