"""The settings of a worker's parts, without what an ablation leaves out (docs/ABLATION.md)."""

from __future__ import annotations

from dataclasses import replace

from prism_edge.config import Config, TrackingConfig


def tracking_of(config: Config) -> TrackingConfig:
    """The tracker's settings."""
    trusting = 0.0 if "consistency" in config.ablate else config.tracking.proven_after_s
    two_views = config.tracking.two_views and "init" not in config.ablate
    adjusting = 0 if "depth_factor" in config.ablate else config.tracking.adjust_unheard
    return replace(config.tracking, proven_after_s=trusting, two_views=two_views, adjust_unheard=adjusting)
