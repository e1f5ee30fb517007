"""A saved map read from its file, for `prism-edge map`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from prism_edge.backend import map_file
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.map_export import MetricMap, metric_map
from prism_edge.backend.map_file import SUFFIX, Info
from prism_edge.backend.map_mount import difference, mount_of
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.stored_map import from_arrays
from prism_edge.config import Config
from prism_edge.errors import MapError, say
from prism_edge.geometry.mount import base_from_camera
from prism_edge.named_path import named_path
from prism_edge.workers.state_directory import stored_map


@dataclass(frozen=True)
class Opened:
    """A map's file, and what is in it."""

    path: Path
    size: int  # bytes
    info: Info
    world: GlobalMap
    places: int  # keyframes with a place descriptor
    scale: KnownScale
    metric: MetricMap
    odd: str  # of its mount, in words; empty where it says one


def opened(name: str, config: Config) -> Opened:
    """Read a map, by its name or its file. Raises MapError with the file's name."""
    is_file = "/" in name or name.endswith(SUFFIX)
    path = named_path(name) if is_file else stored_map(config.state, name)
    data = map_file.read(path)
    try:
        info, arrays = map_file.unpack(data)
        world, index = from_arrays(info, arrays, config.backend.max_carried)
        scale, theirs = KnownScale.of(info), mount_of(info)
    except MapError as error:
        raise MapError(f"{path}: {error}") from None
    mount = base_from_camera(config.frames) if theirs is None else theirs
    odd = difference(theirs, mount)
    if odd:
        say(f"{path}: warning: the map is {odd}")
    metric = metric_map(world, scale.log_scale, mount)
    places = sum(k in index for k in world.keyframes)
    return Opened(path, len(data), info, world, places, scale, metric, odd)
