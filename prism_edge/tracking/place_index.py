"""Which keyframes look like a view: cosine similarity of the depth network's own descriptors.

The network was trained for depth, not for places: its descriptors all lie close together, and what tells
views apart is how each differs from their mean. So the mean of the map's own descriptors is taken off
first, once there are enough of them (measured: docs/LOOPS.md). Geometry has the last word anyway.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from prism_edge.messages import F32, same_network

log = logging.getLogger("prism_edge.tracking")

ENOUGH_FOR_A_MEAN = 10
LEAST_NORM = 1e-4  # of what is left without the mean: descriptors that are all alike tell nothing apart


class PlaceIndex:
    """Descriptors of keyframes by number, all of one network: those of two can't be compared."""

    def __init__(self) -> None:
        self.network = ""  # whose they are, where that was said
        self._descriptors: dict[int, F32] = {}
        self._total = np.zeros(0)

    def __len__(self) -> int:
        return len(self._descriptors)

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._descriptors

    def add(self, keyframe: int, descriptor: F32, network: str = "") -> bool:
        """Take in a descriptor (D,); False where it is no direction.

        With the first of another network, or of another length, the rest is forgotten.
        """
        norm = float(np.linalg.norm(descriptor)) if descriptor.size else 0.0
        if not (np.isfinite(norm) and norm > 0):
            return False
        if self._descriptors and (self._is_foreign(network) or descriptor.shape != self._total.shape):
            log.info("another network names places now: what %d keyframes look like is forgotten", len(self))
            self.clear()
        self.network = network or self.network
        self.remove(keyframe)
        unit = (descriptor / norm).astype(np.float32)
        self._descriptors[keyframe] = unit
        self._total = unit.astype(np.float64) if len(self._descriptors) == 1 else self._total + unit
        return True

    def remove(self, keyframe: int) -> None:
        """Forget a keyframe; nothing where it is not here."""
        gone = self._descriptors.pop(keyframe, None)
        if gone is not None:
            self._total = self._total - gone

    def clear(self) -> None:
        """Forget all, and whose they were."""
        self._descriptors, self._total, self.network = {}, np.zeros(0), ""

    def get(self, keyframe: int) -> F32 | None:
        """The descriptor of a keyframe, of norm 1."""
        return self._descriptors.get(keyframe)

    def rank(self, descriptor: F32, among: Iterable[int], network: str = "") -> list[tuple[int, float]]:
        """(keyframe, similarity in [-1, 1]) of those of ``among`` that are here, most alike first.

        Equal ones come in the order of their numbers. Nothing where ``descriptor`` can't be compared.
        """
        ids = sorted(k for k in set(among) if k in self._descriptors)
        norm = float(np.linalg.norm(descriptor)) if descriptor.size else 0.0
        if self._is_foreign(network):
            return []
        if not ids or descriptor.shape != self._total.shape or not (np.isfinite(norm) and norm > 0):
            return []
        mean = np.zeros(len(self._total))
        if len(self._descriptors) >= ENOUGH_FOR_A_MEAN:
            mean = self._total / len(self._descriptors)
        query = _direction(np.asarray(descriptor / norm, np.float64)[None] - mean)[0]
        known = _direction(np.array([self._descriptors[k] for k in ids], np.float64) - mean)
        similarity = known @ query
        order = np.argsort(-similarity, kind="stable")
        return [(ids[i], float(similarity[i])) for i in order]

    def _is_foreign(self, network: str) -> bool:
        return bool(network and self.network) and not same_network(network, self.network)


def _direction(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rows (n, D) of norm 1, or of zeros where there was hardly anything."""
    norms = np.linalg.norm(rows, axis=1, keepdims=True)
    scaled: NDArray[np.float64] = np.where(norms > LEAST_NORM, rows / np.maximum(norms, LEAST_NORM), 0.0)
    return scaled
