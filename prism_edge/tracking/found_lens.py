"""A camera's lens as a map has found it: of keyframes that the camera may have made.

The newest keyframe may be another camera's, that went on with the same map.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.messages import Keyframe


def found_lens(keyframes: Mapping[int, Any], camera: Camera, known: Camera | None = None) -> Camera:
    """The camera as its newest keyframe has it; as it is given where it has made none.

    ``keyframes``, by their numbers, have a ``camera`` each. ``known`` is what was found last: where that may
    be the camera's nothing is looked for.
    """
    if known is not None and known.like(camera):
        return known
    cameras = (keyframes[number].camera for number in sorted(keyframes, reverse=True))
    return next((one for one in cameras if one.like(camera)), camera)


def in_found_lens(message: Keyframe, keyframes: Mapping[int, Any]) -> Keyframe:
    """The message as if the tracker had known what ``keyframes`` say of its camera's lens."""
    given = Camera.from_array(message.camera_model, message.camera)
    known = found_lens(keyframes, given)
    if known == given:
        return message
    pixels = known.pixels_of(given, message.pixels.astype(np.float64)).astype(np.float32)
    return replace(message, camera=known.to_array(), pixels=pixels)
