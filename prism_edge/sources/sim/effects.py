"""What a lens and a sensor do to a clean picture: motion blur, changing exposure, noise. Each can be off.

All of it is a function of the seed and the frame's number or time, so any frame can be made by itself.
"""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, inverse
from prism_edge.messages import F32, U8
from prism_edge.sources.sim.paths import CameraPath, Wander
from prism_edge.sources.sim.rolling_shutter import rolled

EXPOSURE_S = 0.008  # of one picture, centred on its stamp, with blur=1
NOISE_SIGMA = 2.5  # grey levels with noise=1
_GAIN = 0.35  # largest change of log brightness with exposure=1
_MARGIN = 64  # pixels by which the noise that is kept exceeds a picture
# Shortest smear (pixels) that is made of so many positions of the camera.
_POSITIONS = ((7.0, 8), (2.0, 4), (0.7, 2))
_USUAL_DEPTH = 2.5  # m, for telling how far a picture smears before it is drawn
_WARP = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


class Exposure(NamedTuple):
    """When to draw the picture that is smeared, and of how many positions the smear is made."""

    seconds: float
    positions: int


class Sensor:
    """Turns clean pictures into a camera's. The three strengths are those of the options."""

    def __init__(
        self,
        camera: Camera,
        path: CameraPath,
        seed: int,
        noise: float,
        blur: float,
        exposure: float,
        readout_ms: float = 0.0,
    ):
        rng = np.random.default_rng([seed, 5])
        self._camera, self._path, self._seed = camera, path, seed
        self.readout_s = 1e-3 * readout_ms
        self._exposure_s, self._gain = blur * EXPOSURE_S, exposure * _GAIN
        self._brightness = Wander(rng, 0.05, 0.5)
        self._lighter = self._darker = None
        if noise:
            shape = (camera.height + _MARGIN, camera.width + _MARGIN, 3)
            grain = rng.standard_normal(shape, dtype=np.float32)
            # Demosaicing shares noise between neighbours.
            grain = cv2.GaussianBlur(grain, (3, 3), 0.5)
            grain *= noise * NOISE_SIGMA / float(grain.std())
            self._lighter = np.clip(np.rint(grain), 0, 255).astype(np.uint8)
            self._darker = np.clip(np.rint(-grain), 0, 255).astype(np.uint8)

    def exposure(self, seconds: float) -> Exposure:
        """How the picture whose exposure is centred at ``seconds`` is made."""
        if not self._exposure_s:
            return Exposure(seconds, 1)
        view = self._view(seconds, self._exposure_s, _USUAL_DEPTH)
        w, h = self._camera.width - 1.0, self._camera.height - 1.0
        marks = np.array([[0, 0, 1], [w, 0, 1], [0, h, 1], [w, h, 1], [w / 2, h / 2, 1]]).T
        moved = view @ marks
        smear = float(np.linalg.norm(moved[:2] / moved[2] - marks[:2], axis=0).max())
        count = next((number for shortest, number in _POSITIONS if smear >= shortest), 1)
        return Exposure(seconds, count)

    def take(
        self, clean: U8, index: int, exposure: Exposure, depth: float, depths: F32 | None = None
    ) -> U8:
        """The picture BGR (h, w, 3) of a clean one (h, w, 4) drawn at the middle of the exposure.

        ``depth`` (m) is that of most of the scene, ``depths`` (h, w) each pixel's, which a rolling shutter
        needs: it reads the clean picture's middle row in the middle of the exposure, others before and after.
        """
        out = cv2.cvtColor(self._blurred(clean, exposure, depth), cv2.COLOR_BGRA2BGR)
        if self.readout_s and depths is not None:
            out = rolled(out, depths, self._camera, self._path.pose, exposure.seconds, self.readout_s)
        if self._gain:
            out = cv2.convertScaleAbs(
                out, alpha=float(np.exp(self._gain * self._brightness(exposure.seconds)))
            )
        if self._lighter is not None and self._darker is not None:
            y, x = np.random.default_rng([self._seed, 6, index]).integers(0, _MARGIN, 2)
            part = np.s_[y : y + out.shape[0], x : x + out.shape[1]]
            cv2.add(out, self._lighter[part], out)
            cv2.subtract(out, self._darker[part], out)
        return out

    def _blurred(self, picture: U8, exposure: Exposure, depth: float) -> U8:
        """The mean of the picture as seen from equally spaced positions about the middle of the exposure.

        The mean of two copies moved by half a step either way, of that by one step, then by two, gives two,
        four, eight positions. The turning is exact; the shift is that of a wall at ``depth``, and walkers
        stand still. What is nearer or farther smears by too little or too much, but about its true place.
        """
        size = (self._camera.width, self._camera.height)
        away = 0.5 * self._exposure_s / exposure.positions
        for _ in range(exposure.positions.bit_length() - 1):
            later = self._view(exposure.seconds + 0.5 * away, away, depth)
            earlier = np.linalg.inv(self._view(exposure.seconds - 0.5 * away, away, depth))
            moved = [
                cv2.warpPerspective(picture, view, size, None, _WARP, cv2.BORDER_REPLICATE)
                for view in (earlier, later)
            ]
            picture = cv2.addWeighted(moved[0], 0.5, moved[1], 0.5, 0.0)
            away *= 2.0
        return picture

    def _view(self, seconds: float, span: float, depth: float) -> Array:
        """Homography (3, 3) from pixels at ``seconds + span / 2`` to those at ``seconds - span / 2``."""
        earlier, later = (self._path.pose(seconds + sign * 0.5 * span) for sign in (-1.0, 1.0))
        motion = inverse(earlier) @ later
        plane = motion[:3, :3].copy()
        plane[:, 2] += motion[:3, 3] / max(depth, 0.3)
        k = self._camera.matrix
        return k @ plane @ np.linalg.inv(k)
