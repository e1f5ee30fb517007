"""What was pulled from the web: each network in a folder of its own, with a manifest of its files."""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import yaml

from prism_edge.depth import contract, download
from prism_edge.depth.folders import folders, leading_to
from prism_edge.depth.registry import File, read_file_item
from prism_edge.errors import ModelError

log = logging.getLogger("prism_edge.depth")

MANIFEST = "pulled.yaml"
_LARGEST_MANIFEST = 4 << 20  # bytes, of as many files as a network may have (vetting.py)
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True)
class Pulled:
    """A network that was pulled, as its manifest has it. The first file is the network itself."""

    name: str
    licence: str
    runnable: bool
    files: tuple[File, ...]
    folder: Path
    given: bool | None = None  # whether all digests were known before it came; None: an earlier build's

    @property
    def path(self) -> Path:
        """The network's file, or a checkpoint's folder."""
        return self.folder / self.files[0].name if self.runnable else self.folder


def manifest_of(folder: Path) -> Pulled | None:
    """What was pulled into a folder, None where nothing was. Raises ModelError for a broken manifest."""
    path = folder / MANIFEST
    if not os.path.isfile(path):
        return None
    content = contract.read_yaml(path, _LARGEST_MANIFEST)
    listed = content.get("files") if isinstance(content, Mapping) and content.get("pulled") == 1 else None
    files = tuple(read_file_item(item, str(path)) for item in listed) if isinstance(listed, list) else ()
    if not files or not all(file.sha256 for file in files):
        raise ModelError(f"{path}: no list of pulled files; remove the folder and pull again")
    licence, runnable = str(content.get("licence", "")), bool(content.get("runnable"))
    given = content.get("given")
    return Pulled(folder.name, licence, runnable, files, folder, given if isinstance(given, bool) else None)


def find_pulled(name: str) -> Pulled | None:
    """What was pulled under that name, registered or not."""
    if not NAME.fullmatch(name):
        return None
    return next(filter(None, (manifest_of(folder / name) for folder in folders())), None)


def pulled_at(path: Path) -> Pulled | None:
    """The network at ``path``, or where that link leads, as pulled into its folder; None where it was not.

    Raises ModelError for a broken manifest.
    """
    for file in leading_to(path):
        pulled = manifest_of(file.parent)
        if pulled and pulled.runnable and pulled.files[0].name == file.name:
            return pulled
    return None


def pulled_files(path: Path) -> tuple[File, ...]:
    """The files of :func:`pulled_at`, the network first; none where it was not pulled. Raises ModelError."""
    pulled = pulled_at(path)
    return pulled.files if pulled else ()


def pulled_names() -> list[str]:
    """The names of everything that was pulled, be its manifest broken."""
    manifests = (path for folder in folders() for path in folder.glob(f"*/{MANIFEST}"))
    return sorted({path.parent.name for path in manifests if os.path.isfile(path)})


def all_pulled() -> list[Pulled]:
    """Everything that was pulled, by name; of several of one name the one that is found first."""
    found: dict[str, Pulled] = {}
    for folder in folders():
        for path in sorted(folder.glob(f"*/{MANIFEST}")):
            try:
                pulled = manifest_of(path.parent)
            except ModelError as error:  # one broken folder does not hide the others
                log.warning("%s", error)
                continue
            if pulled:
                found.setdefault(pulled.name, pulled)
    return [found[name] for name in sorted(found)]


def write_manifest(plan: Pulled) -> None:
    """Writes a network's manifest into its folder in one step. Raises ModelError, OSError."""
    files = [{"file": f.name, "sha256": f.sha256, "size": f.size, "url": f.url} for f in plan.files]
    content = {"pulled": 1, "licence": plan.licence, "runnable": plan.runnable, "given": plan.given}
    content |= {"files": files}
    part = plan.folder / f"{MANIFEST}.0.part"
    with part.open("w", encoding="utf-8") as file:
        yaml.safe_dump(content, file, sort_keys=False)
        file.flush()
        os.fsync(file.fileno())
    download.settle(part, plan.folder / MANIFEST)
