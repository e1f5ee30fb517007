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
    depths = message.depths[message.depths > 0.0]
    depth = float(np.median(depths)) if len(depths) else 0.0
    camera = Camera.from_array(message.camera_model, message.camera)
    seen = seen_at_once(message.pixels.astype(np.float64), camera, message.twist, depth, more_ms)
    return replace(message, readout_ms=readout_ms, pixels=seen.astype(np.float32))
