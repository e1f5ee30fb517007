"""Keys that are each in their bounds, and together make one of them void."""

from __future__ import annotations

from collections.abc import Iterator
from operator import attrgetter

from prism_edge.config import Config

# The first may be no more than the second, and why.
NOT_ABOVE = (
    ("tracking.min_matches", "tracking.features", "no map could begin, which does with no more points"),
)


def contradictions(config: Config) -> Iterator[str]:
    """A line for each pair of keys that can't go together."""
    for low, high, why in NOT_ABOVE:
        value, most = attrgetter(low, high)(config)
        if value > most:
            yield f"{low}: {value:g} is more than {high} ({most:g}): {why}"
    if config.is_lockstep and config.source.peers_s == 0.0:
        yield "source.peers_s: 0 in lockstep: images would go out before the others listen, and be lost"
    has_network = bool(config.depth.network) or config.source.uri.startswith("sim:")  # one that comes along
    if "depth" in config.network.remote and not has_network:
        yield "network.remote: depth runs elsewhere, but depth.model is empty: name its network here too"
