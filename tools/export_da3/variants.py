"""Which checkpoints of Depth Anything 3 there are, what each gives, and which one a folder or file is."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path

from prism_edge.depth.contract import FOCAL_NORMALISED, RELATIVE
from prism_edge.errors import ModelError

METRIC, NESTED = "da3metric-large", "da3nested-giant-large"


@dataclass(frozen=True)
class Variant:
    """One kind of checkpoint. Those of several views give confidence, rays and cameras; the others sky."""

    name: str  # the package's
    title: str
    licence: str
    depth_kind: str
    several_views: bool


APACHE, NON_COMMERCIAL = "Apache-2.0", "CC-BY-NC-4.0"
VARIANTS = {
    variant.name: variant
    for variant in (
        Variant("da3-small", "SMALL", APACHE, RELATIVE, True),
        Variant("da3-base", "BASE", APACHE, RELATIVE, True),
        Variant("da3-large", "LARGE", NON_COMMERCIAL, RELATIVE, True),
        Variant("da3-giant", "GIANT", NON_COMMERCIAL, RELATIVE, True),
        Variant(METRIC, "METRIC-LARGE", APACHE, FOCAL_NORMALISED, False),
        Variant("da3mono-large", "MONO-LARGE", APACHE, RELATIVE, False),
    )
}
MODEL_NAMES = (*VARIANTS, NESTED)
_VERSION = re.compile(r"[-_. ]v?\d+(\.\d+)*$")  # DA3-LARGE-1.1 is da3-large, trained anew
_CACHED = re.compile(r"models--.+--(.+)")  # Hugging Face's cache: models--OWNER--NAME/snapshots/REVISION
_SHARD = re.compile(r"-\d{5}-of-(\d{5})$")


def parts_of(name: str) -> tuple[str, ...]:
    """The variants that a checkpoint holds: itself, or of a nested one a relative and a metric one."""
    return ("da3-giant", METRIC) if name == NESTED else (name,)


def variant_of(path: Path, named: str) -> str:
    """Which one a checkpoint is: what it says itself (config.json, folder's name), else ``named``.

    Raises ModelError where neither says so, and where any two of them contradict each other: architectures
    are alike, so that nothing else would tell one from another.
    """
    said = _said(path)
    if len(set(said.values())) > 1:
        words = ", ".join(f"{name} by its {source}" for source, name in said.items())
        raise ModelError(f"{path}: is {words}; name the folder by what is in it")
    for source, name in said.items():
        if named and name != named:
            raise ModelError(f"{path}: is {name} by its {source}, not {named}")
    if not (named or said):
        choices = ", ".join(MODEL_NAMES)
        raise ModelError(f"{path}: does not say which checkpoint it is; name it with --model ({choices})")
    return named or next(iter(said.values()))


def weights_file(path: Path) -> Path:
    """The one weights file of a folder, or the file itself. Raises ModelError, for shards of it too."""
    if path.is_file():
        found = [path]
    else:
        found = [file for kind in ("*.safetensors", "*.pth", "*.pt") for file in sorted(path.glob(kind))]
    for file in found:
        shard = _SHARD.search(file.stem)
        if shard:
            raise ModelError(
                f"{path}: its weights are in {int(shard[1])} shards, which must be joined: load them all "
                "into one table and save that as one model.safetensors (docs/EXPORT.md)"
            )
    if len(found) != 1:
        what = "several weight files: name one" if found else "no .safetensors or .pth file"
        raise ModelError(f"{path}: {what}" if path.is_dir() else f"{path}: there is no such checkpoint")
    return found[0]


def _said(path: Path) -> dict[str, str]:
    """Names of MODEL_NAMES, by where they stand."""
    folder = path if path.is_dir() else path.parent
    try:
        stated = json.loads((folder / "config.json").read_text(encoding="utf-8")).get("model_name")
    except (OSError, ValueError, AttributeError):
        stated = None
    own = folder.resolve()
    cached = _CACHED.fullmatch(own.parent.parent.name) if own.parent.name == "snapshots" else None
    told = {"config.json": _known(stated), "folder's name": _known(cached[1] if cached else own.name)}
    return {source: name for source, name in told.items() if name}


def _known(name: object) -> str:
    """The one of MODEL_NAMES that a name means, without its version; empty for none."""
    if not isinstance(name, str):
        return ""
    letters = {_letters(name), _letters(_VERSION.sub("", name))}
    return next((known for known in MODEL_NAMES if _letters(known) in letters), "")


def _letters(name: str) -> str:
    """A name without what it is written with: DA3METRIC-LARGE and da3_metric_large are one."""
    return "".join(letter for letter in name.lower() if letter.isalnum())
