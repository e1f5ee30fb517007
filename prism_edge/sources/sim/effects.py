"""What a lens and a sensor do to a clean picture: motion blur, changing exposure, noise. Each can be off.

All of it is a function of the seed and the frame's number or time, so any frame can be made by itself.
"""

from __future__ import annotations

import cv2
import numpy as np

from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, inverse
from prism_edge.messages import U8
from prism_edge.sources.sim.paths import CameraPath, Wander

EXPOSURE_S = 0.008  # of one picture, centred on its stamp, with blur=1
NOISE_SIGMA = 2.5  # grey levels with noise=1
_GAIN = 0.35  # largest change of log brightness with exposure=1
_MARGIN = 64  # pixels by which the noise that is kept exceeds a picture
# Shortest smear (pixels) for which so many positions of the camera are averaged.
_POSITIONS = ((5.0, 8), (1.8, 4), (0.6, 2))
_WARP = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP


class Sensor:
    """Turns clean pictures into a camera's. The three strengths are those of the options."""

    def __init__(self, camera: Camera, path: CameraPath, seed: int, noise: float, blur: float, exposure: float):
        rng = np.random.default_rng([seed, 5])
        self._camera, self._path, self._seed = camera, path, seed
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

    def take(self, clean: U8, index: int, seconds: float, depth: float) -> U8:
        """The picture BGR (h, w, 3) of a clean one (h, w, 4); ``depth`` (m) is that of most of the scene."""
        picture = self._blurred(clean, seconds, depth) if self._exposure_s else clean
        out = cv2.cvtColor(picture, cv2.COLOR_BGRA2BGR)
        if self._gain:
            out = cv2.convertScaleAbs(out, alpha=float(np.exp(self._gain * self._brightness(seconds))))
        if self._lighter is not None and self._darker is not None:
            y, x = np.random.default_rng([self._seed, 6, index]).integers(0, _MARGIN, 2)
            part = np.s_[y : y + out.shape[0], x : x + out.shape[1]]
            cv2.add(out, self._lighter[part], out)
            cv2.subtract(out, self._darker[part], out)
        return out

    def _blurred(self, clean: U8, seconds: float, depth: float) -> U8:
        """The mean of the picture as seen from positions during the exposure.

        The turning is exact; the shift is that of a wall at ``depth``, and walkers stand still.
        """
        ends = self._views(seconds, depth)
        w, h = self._camera.width - 1.0, self._camera.height - 1.0
        marks = np.array([[0, 0, 1], [w, 0, 1], [0, h, 1], [w, h, 1], [w / 2, h / 2, 1]]).T
        first, last = ((view @ marks)[:2] / (view @ marks)[2] for view in ends)
        smear = float(np.linalg.norm(last - first, axis=0).max())
        count = next((number for shortest, number in _POSITIONS if smear >= shortest), 1)
        if count == 1:
            return clean
        size = (self._camera.width, self._camera.height)
        views = []
        for k in range(count):
            share = (k + 0.5) / count  # over so short a time the way from end to end is straight
            view = (1.0 - share) * ends[0] + share * ends[1]
            views.append(cv2.warpPerspective(clean, view, size, None, _WARP, cv2.BORDER_REPLICATE))
        while len(views) > 1:
            pairs = zip(views[::2], views[1::2], strict=True)
            views = [cv2.addWeighted(a, 0.5, b, 0.5, 0.0, a) for a, b in pairs]
        return views[0]

    def _views(self, seconds: float, depth: float) -> list[Array]:
        """Homographies (3, 3) from pixels at the beginning and end of exposure to those at its middle."""
        middle_from_world = inverse(self._path.pose(seconds))
        k = self._camera.matrix
        views = []
        for later in (-0.5 * self._exposure_s, 0.5 * self._exposure_s):
            motion = middle_from_world @ self._path.pose(seconds + later)
            plane = motion[:3, :3].copy()
            plane[:, 2] += motion[:3, 3] / max(depth, 0.3)
            view = k @ plane @ np.linalg.inv(k)
            views.append(view / view[2, 2])
        return views
