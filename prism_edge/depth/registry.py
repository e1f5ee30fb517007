"""The networks that are known: models/registry.yaml (schema: docs/MODELS.md)."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from prism_edge.depth import contract
from prism_edge.depth.contract import ModelCard
from prism_edge.depth.folders import data_folder, folders
from prism_edge.depth.web import check_url
from prism_edge.errors import ModelError

RUNNABLE, CHECKPOINT = "onnx", "checkpoint"
_KEYS = {
    RUNNABLE: {"kind", "file", "size", "url", "data", "obtain", "card"},
    CHECKPOINT: {"kind", "name", "licence", "depth_kind", "export", "source", "files"},
}
_FILE_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9._-]{0,127}")
_NON_COMMERCIAL = re.compile(r"(?i)(^|[^a-z])(nc|non[- ]?commercial|research[- ]only)([^a-z]|$)")


@dataclass(frozen=True)
class File:
    """One file of a network. ``sha256`` empty, ``size`` 0, ``url`` empty: not known."""

    name: str
    sha256: str = ""
    size: int = 0  # bytes
    url: str = ""


@dataclass(frozen=True)
class Entry:
    """One known network: a runnable ONNX file with its card, or a checkpoint that must be exported first."""

    name: str
    licence: str
    depth_kind: str
    files: tuple[File, ...] = ()  # of a runnable one: the network itself, then its external data
    obtain: str = ""  # how a file that can't be pulled is had, in words
    export: str = ""  # what a checkpoint is, in words
    source: str = ""  # the page that it comes from
    card: ModelCard | None = None

    @property
    def file(self) -> str:
        """Name of the runnable file; empty for a checkpoint."""
        return self.files[0].name if self.card else ""

    @property
    def can_be_pulled(self) -> bool:
        """Whether it is known where all of its files are."""
        return bool(self.files) and all(file.url for file in self.files)

    @property
    def is_pinned(self) -> bool:
        """Whether the digests of all of its files are known."""
        return bool(self.files) and all(file.sha256 for file in self.files)

    def located(self) -> Path | None:
        """Its file, or a checkpoint's folder, in the first of ``folders()`` that has it whole.

        It lies there plainly, or in a folder of the network's name, where ``models pull`` puts it.
        """
        for folder in folders():
            for place in (folder / self.name, folder) if self.card else (folder / self.name,):
                if self.files and all(os.path.isfile(place / file.name) for file in self.files):
                    return place / self.file
        return None


def is_non_commercial(licence: str) -> bool:
    """Whether a licence by its name forbids commercial use."""
    return bool(_NON_COMMERCIAL.search(licence))


@cache
def entries() -> tuple[Entry, ...]:
    """The entries of the project's own registry. Raises ModelError where it is broken."""
    return read_registry(data_folder() / "registry.yaml")


def read_registry(path: Path) -> tuple[Entry, ...]:
    """The entries of a registry file. Raises ModelError, naming the entry, where one breaks the schema."""
    content = contract.read_yaml(path)
    models = content.get("models") if isinstance(content, Mapping) and content.get("registry") == 1 else None
    if not isinstance(models, list):
        raise ModelError(f"{path}: no model registry (needs `registry: 1` and a list `models`)")
    read = tuple(_entry(item, f"{path.name} entry {i}") for i, item in enumerate(models, 1))
    for what in ("name", "file"):
        values = [getattr(entry, what) for entry in read if getattr(entry, what)]
        for value in values:
            if values.count(value) > 1:
                raise ModelError(f"{path}: {what} {value!r} is listed twice")
    return read


def find(name: str) -> Entry | None:
    """The entry of that name."""
    return next((entry for entry in entries() if entry.name == name), None)


def find_digest(sha256: str) -> Entry | None:
    """The entry whose network file has that digest."""
    return next((entry for entry in entries() if entry.card and entry.card.sha256 == sha256), None)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal. Raises ModelError where it can't be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ModelError(f"{path}: can't be read ({error.strerror})") from None


def read_file_item(item: Any, where: str) -> File:
    """One file of a network from a mapping of ``file``, ``sha256``, ``size``, ``url``. Raises ModelError."""
    if not isinstance(item, Mapping) or set(item) - {"file", "sha256", "size", "url"}:
        raise ModelError(f"{where}: a file has the keys file, sha256, size, url")
    name, size, url = item.get("file", ""), item.get("size", 0), item.get("url", "")
    if not isinstance(name, str) or not _FILE_NAME.fullmatch(name):
        raise ModelError(f"{where}: file: a plain file name is needed, not {name!r}")
    if isinstance(size, bool) or not isinstance(size, int) or not 0 <= size < 2**40:
        raise ModelError(f"{where}: size: a number of bytes is needed, not {size!r}")
    if not isinstance(url, str):
        raise ModelError(f"{where}: url: text is needed, not {url!r}")
    if url:
        try:
            check_url(url)
        except ModelError as error:
            raise ModelError(f"{where}: {error}") from None
    try:
        return File(name, contract.sha256_text(item.get("sha256", "")), size, url)
    except ValueError as error:
        raise ModelError(f"{where}: sha256: {error}") from None


def _entry(item: Any, where: str) -> Entry:
    if not isinstance(item, Mapping):
        raise ModelError(f"{where}: a table of keys and values is needed")
    kind = item.get("kind", RUNNABLE)
    if not isinstance(kind, str) or kind not in _KEYS:
        raise ModelError(f"{where}: kind: {kind!r} is none of {', '.join(_KEYS)}")
    unknown = {str(key) for key in item} - _KEYS[kind]
    if unknown:
        raise ModelError(f"{where}: unknown key {sorted(unknown)[0]!r} of kind {kind}")
    words = {"obtain", "name", "licence", "depth_kind", "export", "source"} & set(item)
    for key in sorted(words):
        if not isinstance(item[key], str) or not item[key].strip():
            raise ModelError(f"{where}: {key}: text is needed, not {item[key]!r}")
    return _runnable(item, where) if kind == RUNNABLE else _checkpoint(item, where)


def _runnable(item: Mapping[str, Any], where: str) -> Entry:
    if "card" not in item:
        raise ModelError(f"{where}: the key 'card' is missing")
    card = contract.card_from_mapping(item["card"], where)
    if not card.sha256:
        raise ModelError(f"{where}: a registered file needs its sha256")
    own = {key: item[key] for key in ("file", "size", "url") if key in item}
    files = [read_file_item({**own, "sha256": card.sha256}, where)]
    for extra in _listed(item.get("data", []), f"{where}: data"):
        files.append(read_file_item(extra, f"{where}: data"))
        if not files[-1].sha256:
            raise ModelError(f"{where}: data: a registered file needs its sha256")
    words = {"obtain": item.get("obtain", ""), "source": card.source}
    return Entry(card.name, card.licence, card.depth_kind, tuple(files), card=card, **words)


def _checkpoint(item: Mapping[str, Any], where: str) -> Entry:
    for key in ("name", "licence", "depth_kind", "export"):
        if key not in item:
            raise ModelError(f"{where}: the key {key!r} is missing")
    if item["depth_kind"] not in contract.KINDS:
        kinds = ", ".join(contract.KINDS)
        raise ModelError(f"{where}: depth_kind: {item['depth_kind']!r} is none of {kinds}")
    if not _FILE_NAME.fullmatch(item["name"]):
        raise ModelError(f"{where}: name: {item['name']!r} is no name")
    files = tuple(read_file_item(extra, where) for extra in _listed(item.get("files", []), f"{where}: files"))
    words = {key: item[key] for key in ("name", "licence", "depth_kind", "export", "source") if key in item}
    return Entry(files=files, **words)


def _listed(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list):
        raise ModelError(f"{where}: a list of files is needed")
    return value
