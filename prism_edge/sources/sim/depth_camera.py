"""A simulated world's exact depth, as a depth camera in the colour camera's place would have it."""

from __future__ import annotations

from prism_edge.geometry.cameras import Camera
from prism_edge.messages import F32
from prism_edge.sources.sim.source import SimSource


class SimulatedDepth:
    """Depth of each picture of a ``sim:`` address; raises SourceError where the address is wrong."""

    def __init__(self, uri: str) -> None:
        self._source = SimSource(uri)
        self._source.open()

    def __len__(self) -> int:
        """How many pictures there are before it begins again."""
        return self._source.frame_count

    def in_colour(self, index: int, camera: Camera) -> F32 | None:
        """Depth (h, w) in metres along z of picture ``index``, pixel by pixel; ``camera`` took it."""
        return self._source.depth(index)
