"""What a network's answers follow from, as one digest: its file, its weights, what of its card shapes them.

A name alone doesn't tell networks apart: a file may be trained anew, or its card edited, under the one it
had, and then its descriptors can no more be compared with those from before than another network's.
"""

from __future__ import annotations

import hashlib
from dataclasses import MISSING, fields
from pathlib import Path

from prism_edge.depth.contract import ModelCard
from prism_edge.depth.vetting import Vetted
from prism_edge.errors import ModelError

_SAMPLES, _BLOCK = 256, 4096  # of each file of external data, whose gigabytes would take seconds
# Of a card: who it is, how far it is to be trusted, and what isn't asked for with a keyframe.
_SHAPES_NOTHING = {
    *("name", "revision", "licence", "source", "sha256", "scale_bias_sigma", "dsug_tau", "dsug_temperature"),
    *("confidence_output", "confidence_kind", "rays_output", "intrinsics_output"),
}


def fingerprint(card: ModelCard, vetted: Vetted) -> str:
    """Twelve hexadecimal digits. Raises ModelError where a file can't be read.

    Keys that have their default don't count, so that one to come changes no network's. Of external data the
    length and samples count: training moves all weights, if by little.
    """
    digest = hashlib.sha256(vetted.sha256.encode())
    for field in fields(card):
        value = getattr(card, field.name)
        default = None if field.default is MISSING else field.default
        if field.name not in _SHAPES_NOTHING and value != default:
            digest.update(f"\n{field.name}: {value!r}".encode())
    for path in vetted.data:
        digest.update(f"\n{path.name}: ".encode() + _samples(path))
    return digest.hexdigest()[:12]


def _samples(path: Path) -> bytes:
    digest = hashlib.sha256()
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            digest.update(str(size).encode())
            for i in range(_SAMPLES):
                file.seek(i * max(size - _BLOCK, 0) // (_SAMPLES - 1))
                digest.update(file.read(_BLOCK))
    except OSError as error:
        raise ModelError(f"{path}: can't be read ({error.strerror})") from None
    return digest.digest()
