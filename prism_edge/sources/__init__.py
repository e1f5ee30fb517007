"""Where images come from: one interface, one file a kind of source (docs/SOURCES.md)."""

from prism_edge.sources.base import Absent, Image, Slot, Source, Unreadable
from prism_edge.sources.open import open_source

__all__ = ["Absent", "Image", "Slot", "Source", "Unreadable", "open_source"]
