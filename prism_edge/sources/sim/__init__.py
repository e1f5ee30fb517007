"""The simulator: textured indoor worlds, exact poses and depth, from a seed (docs/SIMULATOR.md)."""

from prism_edge.sources.sim.options import is_simulated
from prism_edge.sources.sim.source import SimSource

__all__ = ["SimSource", "is_simulated"]
