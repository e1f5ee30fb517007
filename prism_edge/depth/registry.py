"""The networks that are known: models/registry.yaml, and where their files are looked for."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from prism_edge.depth import contract
from prism_edge.depth.contract import ModelCard
from prism_edge.depth.folders import data_folder, folders
from prism_edge.errors import ModelError

_ENTRY_KEYS = {"file", "obtain", "card", "name", "licence", "depth_kind", "export"}


@dataclass(frozen=True)
class Entry:
    """One known network. ``card`` is None for a checkpoint that must be exported first (``export``)."""

    name: str
    licence: str
    depth_kind: str
    file: str = ""
    obtain: str = ""
    export: str = ""
    card: ModelCard | None = None

    def located(self) -> Path | None:
        """Its file in the first of ``folders()`` that has it."""
        if not self.file:
            return None
        return next((folder / self.file for folder in folders() if (folder / self.file).is_file()), None)


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
    """The entry whose file has that digest."""
    return next((entry for entry in entries() if entry.card and entry.card.sha256 == sha256), None)


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal. Raises ModelError where it can't be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise ModelError(f"{path}: can't be read ({error.strerror})") from None


def _entry(item: Any, where: str) -> Entry:
    if not isinstance(item, Mapping):
        raise ModelError(f"{where}: a table of keys and values is needed")
    unknown = {str(key) for key in item} - _ENTRY_KEYS
    if unknown:
        raise ModelError(f"{where}: unknown key {sorted(unknown)[0]!r}")
    text = {str(key): value for key, value in item.items() if key != "card"}
    for key, value in text.items():
        if not isinstance(value, str) or not value.strip():
            raise ModelError(f"{where}: {key}: text is needed, not {value!r}")
    if "card" in item:
        return _runnable(text, contract.card_from_mapping(item["card"], where), where)
    for key in ("name", "licence", "depth_kind", "export"):
        if key not in text:
            raise ModelError(f"{where}: the key {key!r} is missing (or a card is)")
    kind = text["depth_kind"]
    if kind not in contract.KINDS:
        raise ModelError(f"{where}: depth_kind: {kind!r} is none of {', '.join(contract.KINDS)}")
    if "file" in text:
        raise ModelError(f"{where}: a checkpoint that needs export has no file")
    return Entry(**text)


def _runnable(text: dict[str, str], card: ModelCard, where: str) -> Entry:
    extra = set(text) - {"file", "obtain"}
    if extra:
        raise ModelError(f"{where}: {sorted(extra)[0]!r} does not stand beside a card")
    file = text.get("file", "")
    if not file or Path(file).name != file or file.startswith("."):
        raise ModelError(f"{where}: file: a plain file name is needed, not {file!r}")
    if not card.sha256:
        raise ModelError(f"{where}: a registered file needs its sha256")
    return Entry(card.name, card.licence, card.depth_kind, file, text.get("obtain", ""), card=card)
