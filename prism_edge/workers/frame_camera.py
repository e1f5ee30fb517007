"""The camera that a frame says it is from, and whether the frame can be that camera's."""

from __future__ import annotations

import logging
import math

import numpy as np
from numpy.typing import NDArray

from prism_edge.bus.pack import grey
from prism_edge.bus.pulse import Pulse
from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import Frame
from prism_edge.named_path import named_path

log = logging.getLogger("prism_edge.tracker")


class FrameCamera:
    """Looks at each frame before it is tracked; one that makes no sense is counted on `health`, said once."""

    def __init__(self, pulse: Pulse, mask: str, shrink: int = 1) -> None:
        """``mask`` and ``shrink`` are source's; raises ConfigError where the first is no mask."""
        self._pulse = pulse
        self.shown: NDArray[np.bool_] | None = None  # (height, width): where the world is; None: everywhere
        if mask:
            from prism_edge.sources.mask import read_mask  # the tracker needs nothing else of the sources

            self.shown = read_mask(named_path(mask), shrink)

    def of(self, frame: Frame) -> Camera | None:
        """The frame's camera; None where no camera takes such a frame."""
        try:
            said = None if math.isnan(frame.readout_ms) else frame.readout_ms
            camera = Camera.from_array(frame.camera_model, frame.camera, said)
            size = camera.height, camera.width
            if grey(frame).shape != size:
                problem = "its image is smaller than its camera says"
            elif self.shown is not None and self.shown.shape != size:
                is_for = "{1}x{0}".format(*self.shown.shape)
                problem = f"the mask is for images of another size, {is_for} (source.mask, source.shrink)"
            else:
                return camera
        except ConfigError as error:
            problem = str(error)
        if self._pulse.count("malformed") == 1:
            log.warning("frame %d is passed over: %s", frame.index, problem)
        return None
