"""The gate on what the processes say: keyframe and depth messages in, weights of keypoints and images out."""

from __future__ import annotations

import math

import numpy as np

from prism_edge.config import GateConfig
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.messages import Depth, Keyframe
from prism_edge.scale.gate import DepthGate, DepthView, Floats, Gated, GateParameters, image_pixels
from prism_edge.scale.samples import samples_of

LEAST_RATIOS = 15  # of triangulated points, whose median beats the filter: aligning place by place takes more
_MIN_PARALLAX_DEG = 1.0  # triangulated, as in tracking/point_table.py; the filter's own samples may need more


def gate_parameters(config: GateConfig, tau: float, temperature: float) -> GateParameters | None:
    """tau and T: the configuration's where set, else those given, a network's; None where there are none."""
    tau, temperature = config.tau or tau, config.temperature or temperature
    usable = math.isfinite(tau) and math.isfinite(temperature) and tau > 0.0 and temperature > 0.0
    return GateParameters(config.alpha, tau, temperature) if usable else None


class KeyframeGate:
    """Gates one keyframe after another of one map; an open gate (all weights 1) where it can't.

    It can't where it is switched off, where neither the network's card nor the configuration gives tau and
    T, and for the first keyframe of a map if the network gives no confidence.
    """

    def __init__(self, config: GateConfig, active: bool = True) -> None:
        self._config = config
        self._active = active
        self._gate = DepthGate(config.memory)
        self._newest: tuple[DepthView, DepthGate, GateParameters] | None = None

    def forget(self) -> None:
        """A new map has begun."""
        self._gate = DepthGate(self._config.memory)
        self._newest = None

    def parameters(self, depth: Depth) -> GateParameters | None:
        """tau and T: the configuration's where set, else the network's; None where there are none."""
        return gate_parameters(self._config, depth.dsug_tau, depth.dsug_temperature)

    def note(self, keyframe: Keyframe) -> Array:
        """A keyframe has come, with depth or without; where it lies by now.

        What the backend has corrected since the one before it moves the earlier views along.
        """
        placed = self._gate.placed(keyframe.id)
        if placed is not None:
            return placed
        self._gate.rebase(keyframe.anchor, keyframe.world_from_anchor)
        self._gate.place(keyframe.id, keyframe.world_from_camera)
        return keyframe.world_from_camera

    def assess(self, keyframe: Keyframe, depth: Depth, camera: Camera, log_scale: float) -> Gated | None:
        """Uncertainty and weight of each keypoint, against earlier keyframes; None: the gate is open.

        ``log_scale`` is the filter's, for a keyframe with too few triangulated points to place its depth.
        """
        self._newest = None
        parameters = self.parameters(depth) if self._active else None
        if parameters is None or not (depth.valid and usable(depth)):
            return None
        units = math.exp(-_own_log_scale(keyframe, depth, camera, log_scale))
        pose = self.note(keyframe)
        view = DepthView(
            keyframe.id, pose, camera, depth.depth, depth.image_to_depth, depth.confidence, units
        )
        raw = camera.distort_pixels(keyframe.pixels.astype(np.float64))
        gated = self._gate.assess(view, raw, parameters)
        before = self._gate.copy()
        self._gate.remember(view)
        self._newest = view, before, parameters
        return gated

    def images(self) -> tuple[Floats, Floats] | None:
        """u (nan: unknown) and w of every pixel of the newest depth map (h, w); None: the gate is open."""
        if self._newest is None:
            return None
        view, before, parameters = self._newest
        gated = before.assess(view, image_pixels(view), parameters)
        return gated.uncertainty.reshape(view.depth.shape), gated.weights.reshape(view.depth.shape)


def usable(depth: Depth) -> bool:
    """Whether a depth message can be read at all: a bus carries what it is given."""
    placed = bool(np.isfinite(depth.image_to_depth).all() and (depth.image_to_depth[[0, 2]] > 0).all())
    fits = depth.confidence.size == 0 or depth.confidence.shape == depth.depth.shape
    return placed and fits and min(depth.depth.shape) >= 3


def _own_log_scale(keyframe: Keyframe, depth: Depth, camera: Camera, log_scale: float) -> float:
    samples = samples_of(keyframe, depth, camera, _MIN_PARALLAX_DEG)
    ratios = samples.log_ratios[np.isfinite(samples.log_ratios)]
    own = float(np.median(ratios)) if len(ratios) >= LEAST_RATIOS else log_scale
    return float(np.clip(own, -20.0, 20.0))
