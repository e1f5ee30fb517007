"""`prism-edge map show`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence

from prism_edge.backend.map_file import Info
from prism_edge.cli.map_opened import Opened
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import quaternion_from_rotation
from prism_edge.sources.stamps import write_seconds

LONGEST = 120  # characters of a word that the file says


def described(found: Opened) -> list[str]:
    """What a map holds, a line each."""
    info, metric, keyframes = found.info, found.metric, found.world.keyframes
    stamps = [k.taken_ns for k in keyframes.values() if k.taken_ns is not None]
    when = f"{write_seconds(min(stamps))} to {write_seconds(max(stamps))} s" if stamps else "not said"
    when += f" (not said of {len(keyframes) - len(stamps)})" if 0 < len(stamps) < len(keyframes) else ""
    seen_by = [k.camera for k in keyframes.values()]
    cameras = Counter(map(_named(seen_by), seen_by))
    shutter = f"; rows read over {found.world.readout_ms:.1f} ms, as found" if found.world.readout_ms else ""
    metres = math.exp(found.scale.log_scale)
    sigma = found.scale.whole_sigma
    x, y, z = metric.extent
    seat = ", ".join(f"{v:.4f}" for v in metric.mount[:3, 3])
    turn = ", ".join(f"{v:.4f}" for v in quaternion_from_rotation(metric.mount[:3, :3]))
    apart = f", {metric.elsewhere} of them apart, without a place in map" if metric.elsewhere else ""
    network = _word(info, "places_of") or "no network that is named"
    lines = {
        "file": f"{found.path}, {found.size / 1e6:.1f} MB",
        "saved": " ".join(filter(None, (_word(info, "saved"), _word(info, "program")))) or "not said",
        "robot": _word(info, "robot") or "not said",
        "keyframes": f"{len(keyframes)}{apart}",
        "points": f"{len(found.world.points)}",
        "cameras": ", ".join(f"{camera} ({count} keyframes)" for camera, count in cameras.items()) + shutter,
        "taken": when,
        "extent": f"{x:.2f} x {y:.2f} x {z:.2f} m along map's x, y, z",
        "scale": f"{metres:.4f} ± {metres * sigma:.4f} m per map unit",
        "learnt by": _word(info, "scale_by") or "no network that is named",
        "places": f"{found.places} keyframes described by {network}" if found.places else "none described",
        "mount": f"base_from_camera_xyz [{seat}], _xyzw [{turn}]" + (f" ({found.odd})" if found.odd else ""),
    }
    return [f"{name:<11}{value}" for name, value in lines.items()]


def _named(cameras: Sequence[Camera]) -> Callable[[Camera], str]:
    """By what cameras are told apart: their focal lengths, too, where there are several of one size."""
    sizes = Counter((camera.model, camera.width, camera.height) for camera in set(cameras))

    def name(camera: Camera) -> str:
        size = camera.model, camera.width, camera.height
        focal = f", focal length {camera.fx:.1f} and {camera.fy:.1f} pixels" if sizes[size] > 1 else ""
        return f"{camera.model} {camera.width}x{camera.height}{focal}"

    return name


def _word(info: Info, name: str) -> str:
    """What a file says in words, which may be anything, as a terminal can show it."""
    told = info.get(name)
    if not isinstance(told, str):
        return ""
    return "".join(c if c.isprintable() else "?" for c in told[:LONGEST])
