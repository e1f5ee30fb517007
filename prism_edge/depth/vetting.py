"""What a network file must pass before onnxruntime, which is native code, is given it.

A file may come from anybody. ONNX lets its tensors name other files to be read, and onnxruntime has kinds of
nodes that load compiled code; the first are held to plain files beside the network, the others refused.
"""

from __future__ import annotations

import hashlib
import os
import stat
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from prism_edge.depth.onnx_file import Outline, read_outline
from prism_edge.errors import ModelError

LARGEST_FILE = 2**31 - 1  # bytes; protobuf has no larger messages
LARGEST_DATA = 2**35  # bytes of one file of external data; the largest known network has 6 GB
MOST_DATA_FILES = 4096  # some exporters write one for each tensor
# Nodes that carry or load code, which nobody can check.
_OPAQUE = {"EPContext", "PyOp", "PythonOp"}


@dataclass(frozen=True)
class Vetted:
    """A file that may be loaded."""

    path: Path  # without symbolic links
    sha256: str  # of the file itself
    metadata: dict[str, str]  # its metadata_props
    opset: int  # of ONNX's own operators
    data: tuple[Path, ...]  # files beside it that hold its external data, by name


def vet(path: Path, sha256: str = "") -> Vetted:
    """Checks that a file is whole, is ONNX and refers to nothing but plain files in its own folder.

    ``sha256`` is the digest that it must have (empty: any). Raises ModelError in one line otherwise.
    """
    digest, outline = inspect(path, sha256)
    data = _data_files(path, outline)
    # onnxruntime seeks the data beside the file that it is given, which is the one that was looked at.
    return Vetted(path.resolve(), digest, outline.metadata, outline.opsets.get("", 0), data)


def inspect(path: Path, sha256: str = "") -> tuple[str, Outline]:
    """SHA-256 and outline of a file, whose external data need not be there yet; else as :func:`vet`."""
    # Read once: what was hashed is what is checked, whatever happens to the file meanwhile.
    content = _read(path)
    digest = hashlib.sha256(content).hexdigest()
    if sha256 and digest != sha256:
        raise ModelError(f"{path}: its SHA-256 is {digest[:12]}..., not the registered {sha256[:12]}...")
    outline = read_outline(memoryview(content), str(path))
    opaque = sorted(outline.operators & _OPAQUE)
    if opaque:
        raise ModelError(f"{path}: contains {opaque[0]}, compiled code that can't be checked")
    return digest, outline


def _read(path: Path) -> bytes:
    try:
        if not path.is_file():
            what = "no plain file" if path.exists() else "no such file"
            raise ModelError(f"{path}: can't be read ({what})")
        if path.stat().st_size > LARGEST_FILE:
            raise ModelError(f"{path}: larger than 2 GB; weights of that size belong in external data")
        return path.read_bytes()
    except OSError as error:
        raise ModelError(f"{path}: can't be read ({error.strerror})") from None
    except ValueError:  # a NUL in the path
        raise ModelError(f"{str(path)!r}: can't be read (no such file)") from None


def _data_files(path: Path, outline: Outline) -> tuple[Path, ...]:
    """The files of external data, each checked; ModelError for one that is not to be read."""
    needed: dict[str, int] = {}
    for item in outline.external:
        needed[item.location] = max(needed.get(item.location, 0), item.offset + item.length)
    if len(needed) > MOST_DATA_FILES:
        raise ModelError(f"{path}: refers to {len(needed)} files of external data")
    return tuple(_data_file(path, location, least) for location, least in sorted(needed.items()))


def check_location(path: Path, location: str) -> None:
    """Raises ModelError for a name of external data that can't be that of a file in the network's folder."""
    shown = repr(location[:80])
    parts = PurePosixPath(location).parts
    # onnxruntime takes a location with '*' in it for an address in memory; '\' and ':' are other systems'.
    if not location.isprintable() or not parts or set(location) & set("*\\:"):
        raise ModelError(f"{path}: names external data {shown}, which is no plain file name")
    if location.startswith("/") or ".." in parts:
        raise ModelError(f"{path}: names external data {shown} outside its own folder")


def _data_file(path: Path, location: str, least: int) -> Path:
    check_location(path, location)
    shown = repr(location[:80])
    folder = path.resolve().parent
    file = folder / location
    try:
        if file.resolve() != folder / PurePosixPath(location):
            raise ModelError(f"{path}: its external data {shown} is a symbolic link, which is not followed")
        found = file.lstat()
    except (OSError, RuntimeError, ValueError) as error:
        if path.is_symlink() and os.path.exists(path.parent / location):  # as in Hugging Face's cache
            raise ModelError(
                f"{path}: is a link, and its external data {shown} lies beside the link alone; copy both "
                "files, not the links, into one folder"
            ) from None
        reason = getattr(error, "strerror", "") or "can't be read"
        raise ModelError(f"{path}: its external data {shown} is not beside it ({reason})") from None
    if not stat.S_ISREG(found.st_mode):
        raise ModelError(f"{path}: its external data {shown} is no plain file")
    if found.st_size > LARGEST_DATA:
        raise ModelError(f"{path}: its external data {shown} is larger than {LARGEST_DATA >> 30} GB")
    if found.st_size < least:
        raise ModelError(
            f"{path}: its external data {shown} has {found.st_size} bytes, but {least} are needed: cut off?"
        )
    return file
