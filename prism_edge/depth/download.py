"""A file from the web: resumed where it broke off, held to its size and digest, never left half.

What has come so far lies in ``<file>.<tag>.part`` beside the file's place, the tag standing for the version
that the server named, so that two versions are never joined; where it names none (tag 0) only a SHA-256 lets
them be told apart, and without one a part is not gone on with. Nothing else is ever left behind.
"""

from __future__ import annotations

import errno
import hashlib
import http.client
import os
import re
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prism_edge.depth.web import (
    UNNAMED,
    CompleteError,
    StaleError,
    TransientError,
    check_url,
    content_range,
    next_chunk,
    request,
    version_tag,
)
from prism_edge.errors import ModelError

_LEAST_BYTES = 1024  # in ``stall_s``; slower than this is stalled

Progress = Callable[[int, int], None]  # bytes that are here, bytes in all (0: not known)


@dataclass(frozen=True)
class Wanted:
    """A file to be had. ``sha256`` empty and ``size`` 0: not known; ``largest`` bounds it then."""

    url: str
    file: Path
    sha256: str = ""
    size: int = 0
    largest: int = 2**35


@dataclass(frozen=True)
class Patience:
    """How long to wait, and how often to begin again without having got anything new."""

    stall_s: float = 30.0
    attempts: int = 4
    pause_s: float = 1.0  # before the second; doubles with each


def fetch(wanted: Wanted, patience: Patience = Patience(), progress: Progress | None = None) -> Path:
    """Fetches the file and returns its complete, checked ``.part``; :func:`settle` puts it in place.

    Goes on with what an earlier call got. Raises ModelError in one line where it can't be had; the part
    stays for the next time unless it is known to be wrong.
    """
    check_url(wanted.url)
    try:
        wanted.file.parent.mkdir(parents=True, exist_ok=True)
        part, fresh = _fetched(wanted, patience, progress or (lambda have, total: None))
        try:
            _check_digest(wanted, part)
        except ModelError:
            if fresh:
                raise
            # It was continued: the beginning may have been spoilt. Once more, all of it.
            part, _ = _fetched(wanted, patience, progress or (lambda have, total: None))
            _check_digest(wanted, part)
        return part
    except OSError as error:
        reason = "the disk is full" if error.errno == errno.ENOSPC else error.strerror or str(error)
        raise ModelError(f"{wanted.file}: can't be written ({reason})") from None


def settle(part: Path, file: Path) -> None:
    """Puts a complete part in place in one step; it is on the disk when this returns. Raises ModelError."""
    try:
        os.replace(part, file)
        folder = os.open(file.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    except OSError as error:
        raise ModelError(f"{file}: can't be put in place ({error.strerror})") from None


def parts_of(file: Path) -> list[Path]:
    """The parts of a file that are there, the longest first."""
    own = re.compile(re.escape(file.name) + r"\.([0-9a-f]{12}|0)\.part")
    parts = [path for path in file.parent.glob("*.part") if own.fullmatch(path.name) and path.is_file()]
    return sorted(parts, key=lambda path: -path.stat().st_size)


def _fetched(wanted: Wanted, patience: Patience, progress: Progress) -> tuple[Path, bool]:
    """The complete part, not yet checked, and whether all of it came in this call."""
    failures = 0
    fresh = not parts_of(wanted.file)
    while True:
        before = _have(wanted.file)
        try:
            return _attempt(wanted, patience, progress), fresh
        except (CompleteError, StaleError) as error:
            part = next(iter(_resumable(wanted)), None)
            if part and isinstance(error, CompleteError) and str(error) in (UNNAMED, _tag(part)):
                return part, fresh
            for part in parts_of(wanted.file):
                part.unlink()
            fresh = True
            failures += 1
            reason = "the file on the server keeps changing"
        except TransientError as error:
            failures = 1 if _have(wanted.file) > before else failures + 1
            reason = str(error)
        if failures >= patience.attempts:
            kept = "; what has come is kept, pull again to go on" if _resumable(wanted) else ""
            raise ModelError(f"{wanted.url}: {reason}{kept}")
        time.sleep(patience.pause_s * 2 ** (failures - 1))


def _tag(part: Path) -> str:
    """The version that a part is of."""
    return part.name.split(".")[-2]


def _resumable(wanted: Wanted) -> list[Path]:
    """Parts to go on with: of a version that can be told, now or by the digest in the end."""
    return [part for part in parts_of(wanted.file) if wanted.sha256 or _tag(part) != UNNAMED]


def _have(file: Path) -> int:
    return max((part.stat().st_size for part in parts_of(file)), default=0)


def _attempt(wanted: Wanted, patience: Patience, progress: Progress) -> Path:
    """One request, from where the last one ended."""
    parts, old = parts_of(wanted.file), next(iter(_resumable(wanted)), None)
    have = old.stat().st_size if old else 0
    if wanted.size and have == wanted.size and old:
        return old
    with request(wanted.url, have, patience.stall_s) as response:
        part = wanted.file.with_name(f"{wanted.file.name}.{version_tag(response.headers)}.part")
        if response.status == http.client.PARTIAL_CONTENT:
            start, total = content_range(response.headers)
            if start != have or part != old:
                raise StaleError
        else:  # the server sends all of it, whether or not it was asked to go on
            said = response.headers.get("Content-Length") or ""
            have, total = 0, int(said) if said.isascii() and said.isdigit() else 0  # else not told
        _check_size(wanted, total, have)
        for other in parts:
            if other != part:
                other.unlink()
        return _receive(response, part, have, total or wanted.size, wanted, patience.stall_s, progress)


def _receive(
    response: Any, part: Path, have: int, total: int, wanted: Wanted, stall_s: float, progress: Progress
) -> Path:
    flags = os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | (os.O_APPEND if have else os.O_TRUNC)
    mark, since = have, time.monotonic()
    with open(os.open(part, flags, 0o644), "wb", buffering=0) as file:
        progress(have, total)
        while chunk := next_chunk(response):
            have += len(chunk)
            if have > (total or wanted.largest):
                part.unlink()
                raise ModelError(f"{wanted.url}: sends more than {total or wanted.largest} bytes")
            file.write(chunk)
            progress(have, total)
            now = time.monotonic()
            if have - mark >= _LEAST_BYTES:
                mark, since = have, now
            elif now - since > stall_s:
                raise TransientError(f"less than {_LEAST_BYTES} bytes have come in {stall_s:g} s")
        os.fsync(file.fileno())
    if total and have < total:
        raise TransientError(f"broke off at {have} of {total} bytes")
    return part


def _check_size(wanted: Wanted, total: int, have: int) -> None:
    if wanted.size and total and total != wanted.size:
        raise ModelError(f"{wanted.url}: has {total} bytes there, but {wanted.size} are registered")
    if total > wanted.largest:
        raise ModelError(f"{wanted.url}: has {total} bytes, more than the {wanted.largest} that are allowed")
    free = shutil.disk_usage(wanted.file.parent).free
    if total - have > free:
        raise ModelError(f"{wanted.file}: {total - have} bytes are to come, but the disk has {free} left")


def _check_digest(wanted: Wanted, part: Path) -> None:
    """Raises ModelError, and removes the part, where it is not what is wanted."""
    size = part.stat().st_size
    if wanted.size and size != wanted.size:
        part.unlink()
        raise ModelError(f"{wanted.url}: gave {size} of {wanted.size} registered bytes; nothing is kept")
    if wanted.sha256:
        with part.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        if digest != wanted.sha256:
            part.unlink()
            raise ModelError(
                f"{wanted.url}: its SHA-256 is {digest[:12]}..., not the registered "
                f"{wanted.sha256[:12]}...; nothing is kept"
            )
