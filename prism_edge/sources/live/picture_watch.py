"""Tells from its pictures that a camera which still delivers has stopped seeing (pure)."""

from __future__ import annotations

from collections import deque

import numpy as np

from prism_edge.messages import U8
from prism_edge.sources.live.damage import WAITING

_STEP = 8  # every eighth pixel of every eighth row says enough, and takes 20 us
_FLAT = 2.0  # standard deviation (grey levels): a lens cap's noise is 1 to 2, any scene has more than 5
_DARK = 32.0  # mean (grey levels), above the 16 that is black in video
_FLAT_NS = 1_000_000_000
_FROZEN_NS = 5_000_000_000  # an encoder repeats a still scene exactly, but not beyond its next key frame
_LAST, _USELESS_SHARE = 50, 0.1


class PictureWatch:
    """Looks at each picture; :attr:`problem` is a line on what is wrong with them, or empty."""

    def __init__(self) -> None:
        self._useless: deque[str] = deque(maxlen=_LAST)  # why; empty: whole
        self._flat_since_ns: int | None = None
        self._same_since_ns: int | None = None
        self._last: U8 | None = None
        self._pictures = ""  # what is wrong with the newest

    def look(self, pixels: U8, captured_ns: int) -> None:
        """A whole picture: grey (h, w) or BGR (h, w, 3), captured at this time of one clock."""
        self._useless.append("")
        sample = np.ascontiguousarray(pixels[::_STEP, ::_STEP])
        same = self._last is not None and np.array_equal(sample, self._last)
        self._last = sample
        self._same_since_ns = (self._same_since_ns or captured_ns) if same else None
        flat = float(sample.reshape(-1, *sample.shape[2:]).std(axis=0).max()) < _FLAT
        self._flat_since_ns = (self._flat_since_ns or captured_ns) if flat else None
        if flat and captured_ns - (self._flat_since_ns or 0) >= _FLAT_NS:
            dark = float(sample.mean()) < _DARK
            self._pictures = (
                "the camera gives black images: is the lens covered, or the light off?"
                if dark
                else "the camera gives images of a single colour: it sends no picture"
            )
        elif same and captured_ns - (self._same_since_ns or 0) >= _FROZEN_NS:
            self._pictures = "the camera repeats one image: it has frozen"
        else:
            self._pictures = ""

    def useless(self, why: str) -> None:
        """A picture came that can't be decoded, or only in part, or that builds on one that didn't come."""
        self._useless.append(why)

    @property
    def problem(self) -> str:
        """One line, empty where the pictures are as they should be."""
        bad = [why for why in self._useless if why]
        if len(bad) >= 3 and len(bad) > _USELESS_SHARE * len(self._useless):
            share = f"{len(bad)} of the last {len(self._useless)}"
            if set(bad) == {WAITING}:
                return f"the camera sends images that can't be used yet, {share}; each {WAITING}"
            return f"the camera sends damaged images, {share}: check cable or network"
        return self._pictures
