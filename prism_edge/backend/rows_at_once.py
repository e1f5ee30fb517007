"""A keyframe's rows, read one after the other, as the map has them: seen at once, by the readout it knows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.messages import Keyframe
from prism_edge.tracking.rolling_shutter import seen_at_once


def message_at_once(message: Keyframe, readout_ms: float) -> Keyframe:
    """The message as if the tracker had known the readout that was found, ms; as it is where that is said."""
    more_ms = readout_ms - message.readout_ms
    if message.readout_said or not more_ms:
        return message
    moved = replace(message, readout_ms=readout_ms)
    depths, twist = message.depths[message.depths > 0.0], message.twist
    if not (np.isfinite(twist).all() and twist.any() and len(depths)):
        return moved
    camera = Camera.from_array(message.camera_model, message.camera)
    depth, pixels = float(np.median(depths)), message.pixels.astype(np.float64)
    seen = seen_at_once(pixels, camera, twist, depth, more_ms)
    return replace(moved, pixels=seen.astype(np.float32))
