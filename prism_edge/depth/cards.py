"""Which card is a file's: its sidecar's, its own metadata's, or the registry's, and whether they agree."""

from __future__ import annotations

import os
from pathlib import Path

from prism_edge.depth.contract import ModelCard, card_from_metadata, card_from_sidecar
from prism_edge.depth.folders import leading_to
from prism_edge.depth.registry import File, find, find_digest, sha256_of
from prism_edge.depth.vetting import Vetted
from prism_edge.errors import ModelError


def sidecar_of(path: Path) -> Path:
    """The YAML file that describes a foreign network: its name with ``.yaml`` added."""
    return path.with_name(path.name + ".yaml")


def sidecar_at(path: Path) -> Path | None:
    """The sidecar that is there: beside the file as it is named, else, of a link, beside where it leads.

    Raises ModelError for one that is there and no file: what it would say is not to be passed over.
    """
    for sidecar in map(sidecar_of, leading_to(path)):
        if os.path.isfile(sidecar):  # a name too long for a file is none
            return sidecar
        if os.path.lexists(sidecar):
            raise ModelError(f"{sidecar}: describes {path.name}, but is no file, or a link to none")
    return None


def card_of(path: Path, vetted: Vetted, pinned: tuple[File, ...] = ()) -> ModelCard:
    """The card of a vetted file; ``path`` is where the user has it, with its sidecar there or at its target.

    A sidecar goes before the file's metadata, and both before the registry, which knows files by
    digest. Raises ModelError where there is none, where the digest is not the one the card pins, where
    a file bears a registered name without being that file, where its licence contradicts the registry, or
    where its external data are not the registered ones or, of a file not registered, those in ``pinned``.
    """
    digest = vetted.sha256
    registered = find_digest(digest)
    sidecar = sidecar_at(path)
    if sidecar is not None:
        card = card_from_sidecar(sidecar)
    else:
        own = card_from_metadata(vetted.metadata, path.name)
        if own is None and (registered is None or registered.card is None):
            raise ModelError(
                f"{path.name}: does not say what it predicts; "
                f"describe it in {sidecar_of(path).name} (docs/MODELS.md)"
            )
        card = own or registered.card  # type: ignore[union-attr,assignment]
    if card.sha256 and card.sha256 != digest:
        raise ModelError(
            f"{path.name}: its SHA-256 is {digest[:12]}..., but its card says {card.sha256[:12]}..."
        )
    namesake = find(card.name)
    if namesake and namesake.card and namesake.card.sha256 != digest:
        raise ModelError(f"{path.name}: calls itself {card.name}, but is not the file registered as that")
    if registered and registered.licence != card.licence:
        raise ModelError(
            f"{path.name}: its card says licence {card.licence}, but it is registered under "
            f"{registered.licence}"
        )
    if registered:
        check_data(registered.files, vetted, "registered")
    elif pinned:
        check_data(pinned, vetted, "pulled")
    return card


def check_data(files: tuple[File, ...], vetted: Vetted, how: str) -> None:
    """Raises ModelError unless external data are ``files`` but the first, which are known as ``how`` says."""
    known = {file.name: file.sha256 for file in files[1:]}
    if {path.name for path in vetted.data} != set(known):
        raise ModelError(f"{vetted.path}: its external data are not those {how} for {files[0].name}")
    for path in vetted.data:
        digest = sha256_of(path)
        if digest != known[path.name]:
            raise ModelError(
                f"{path}: its SHA-256 is {digest[:12]}..., not the {how} {known[path.name][:12]}..."
            )


