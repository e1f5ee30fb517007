"""Camera models: pinhole with radial-tangential distortion, and the equidistant fisheye (Kannala-Brandt)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np

from prism_edge.errors import ConfigError
from prism_edge.geometry import fisheye
from prism_edge.geometry.poses import Array
from prism_edge.geometry.radial import undistort_radial

PINHOLE = "pinhole"
FISHEYE = "fisheye"
_COEFFICIENTS = {PINHOLE: (0, 4, 5, 8), FISHEYE: (0, 4)}
MOST_BENT = 0.3  # of k1: two cameras that differ by more are two
SHORTEST, LONGEST = 0.1, 20.0  # focal lengths, in image widths: what fisheyes and telescopes have
LONGEST_READOUT_MS = 100.0
MOST_STRETCHED = 2.0  # fx / fy, or the other way round: pixels of interlaced images
_ITERATIONS = 20
_SUBSTITUTIONS = 5


@dataclass(frozen=True)
class Camera:
    """Intrinsics of one camera, in pixels of its image; pixel centres are at whole numbers.

    ``distortion`` is k1 k2 p1 p2 [k3 [k4 k5 k6]] (pinhole, OpenCV's order) or k1..k4 (fisheye); empty
    means none. ``readout_ms`` is how long a rolling shutter takes from the first row to the last, below 0
    where the last is read first, None where nobody has said; two cameras that differ by nothing else are the
    same, and arrays don't have it. Raises ConfigError where a value can't be a camera's.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str = PINHOLE
    distortion: tuple[float, ...] = ()
    readout_ms: float | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if self.model not in _COEFFICIENTS:
            raise ConfigError(f"camera model {self.model!r} is not known (use pinhole or fisheye)")
        if len(self.distortion) not in _COEFFICIENTS[self.model]:
            raise ConfigError(
                f"a {self.model} camera takes {' or '.join(map(str, _COEFFICIENTS[self.model]))} "
                f"distortion coefficients, not {len(self.distortion)}"
            )
        values = (self.fx, self.fy, self.cx, self.cy, *self.distortion)
        if not all(map(math.isfinite, values)):
            raise ConfigError("camera intrinsics must be finite numbers")
        if self.readout_ms is not None and not abs(self.readout_ms) <= LONGEST_READOUT_MS:
            most = f"{-LONGEST_READOUT_MS:g} to {LONGEST_READOUT_MS:g}"
            raise ConfigError(f"readout_ms: expected {most}, found {self.readout_ms:g}")
        if self.fx <= 0 or self.fy <= 0:
            raise ConfigError(f"focal lengths must be above zero (fx {self.fx:g}, fy {self.fy:g})")
        if self.width <= 0 or self.height <= 0:
            raise ConfigError(f"image size must be above zero ({self.width}x{self.height})")
        self._check_possible()

    def _check_possible(self) -> None:
        """Raises ConfigError for numbers that no lens has: of another image, or in millimetres."""
        for key, value in (("fx", self.fx), ("fy", self.fy)):
            if not SHORTEST * self.width <= value <= LONGEST * self.width:
                raise ConfigError(
                    f"{key}: {value:g} pixels can't be the focal length of a {self.width}-wide image "
                    f"({SHORTEST:g} to {LONGEST:g} times its width)"
                )
        if not 1.0 / MOST_STRETCHED <= self.fx / self.fy <= MOST_STRETCHED:
            ratio = f"{1.0 / MOST_STRETCHED:g} to {MOST_STRETCHED:g}"
            raise ConfigError(f"fx: {self.fx:g} doesn't go with fy {self.fy:g} (fx / fy is {ratio})")
        for key, value, size in (("cx", self.cx, self.width), ("cy", self.cy, self.height)):
            if not -1.0 <= value <= size:  # half a pixel to spare for those who count from a corner
                side = "wide" if key == "cx" else "high"
                raise ConfigError(f"{key}: {value:g} lies outside the image, which is {size} pixels {side}")

    @property
    def matrix(self) -> Array:
        """The 3x3 calibration matrix K."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def is_ideal(self) -> bool:
        """True where pixels need no undistortion (a fisheye always does)."""
        return self.model == PINHOLE and not any(self.distortion)

    def to_array(self) -> Array:
        """Width, height, fx, fy, cx, cy, then the distortion: what messages carry beside the model's name."""
        return np.array(
            [self.width, self.height, self.fx, self.fy, self.cx, self.cy, *self.distortion], dtype=np.float64
        )

    @classmethod
    def from_array(cls, model: str, values: Array, readout_ms: float | None = None) -> Camera:
        """The camera that :meth:`to_array` described, and its readout.

        Raises ConfigError where no camera is like that.
        """
        numbers = [float(v) for v in values]
        if len(numbers) < 6 or not all(map(math.isfinite, numbers)):
            raise ConfigError("a camera takes at least six finite numbers: width height fx fy cx cy")
        width, height, fx, fy, cx, cy, *distortion = numbers
        if not (width.is_integer() and height.is_integer()):
            raise ConfigError(f"image size must be whole numbers ({width:g}x{height:g})")
        return cls(int(width), int(height), fx, fy, cx, cy, model, tuple(distortion), readout_ms)

    def ideal(self) -> Camera:
        """The distortion-free pinhole with the same matrix: what undistorted pixels are seen by."""
        return replace(self, model=PINHOLE, distortion=())

    def resized(self, width: int, height: int) -> Camera:
        """The camera of the same image after it was made as large as that."""
        across, down = width / self.width, height / self.height
        return replace(
            self,
            width=width,
            height=height,
            fx=self.fx * across,
            fy=self.fy * down,
            cx=(self.cx + 0.5) * across - 0.5,
            cy=(self.cy + 0.5) * down - 0.5,
        )

    def bent(self, k1: float) -> Camera:
        """The same camera with another lens: ``k1`` is added to the first radial coefficient."""
        first, *others = self.distortion or (0.0,) * 4
        return replace(self, distortion=(first + k1, *others))

    def like(self, other: Camera) -> bool:
        """Whether one may be the other with its lens found anew (:meth:`bent`): a pinhole, else the same."""
        if self == other or self.model != PINHOLE:
            return self == other
        same = other.model == PINHOLE and self.ideal() == other.ideal()
        mine, its = self._eight, other._eight
        return same and mine[1:] == its[1:] and abs(mine[0] - its[0]) <= MOST_BENT

    @property
    def _eight(self) -> tuple[float, ...]:
        """All coefficients that a pinhole camera may have."""
        return (*self.distortion, *(0.0,) * (8 - len(self.distortion)))

    def pixels_of(self, other: Camera, pixels: Array) -> Array:
        """Ideal pixels (n, 2) as this camera has them, of ``other``'s of the same image."""
        return self.undistort_pixels(other.distort_pixels(pixels))

    def project(self, points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3) in the camera frame; z must be above zero."""
        x, y = points[:, 0] / points[:, 2], points[:, 1] / points[:, 2]
        return self.to_pixels(self._distort(np.stack([x, y], axis=1)))

    def to_pixels(self, xy: Array) -> Array:
        """Pixels (n, 2) of what is on the plane z = 1 (n, 2): ideal ones, unless a lens has bent that."""
        return xy * (self.fx, self.fy) + (self.cx, self.cy)

    def on_plane(self, pixels: Array) -> Array:
        """Coordinates (n, 2) on the plane z = 1 of ideal pixels (n, 2): :meth:`to_pixels` undone."""
        return (np.asarray(pixels, dtype=np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)

    def normalise(self, pixels: Array) -> Array:
        """Undistorted image coordinates (n, 2) on the plane z = 1 of pixels (n, 2)."""
        return self._undistort(self.on_plane(pixels))

    def undistort_pixels(self, pixels: Array) -> Array:
        """Pixels (n, 2) where :meth:`ideal` would have seen the same rays."""
        if self.is_ideal:
            return np.asarray(pixels, dtype=np.float64)
        return self.to_pixels(self.normalise(pixels))

    def distort_pixels(self, pixels: Array) -> Array:
        """Pixels (n, 2) of the image as taken, of those :meth:`ideal` would have seen; undoes the above."""
        ideal = np.asarray(pixels, dtype=np.float64)
        if self.is_ideal:
            return ideal
        return self.to_pixels(self._distort(self.on_plane(ideal)))

    def _distort(self, xy: Array) -> Array:
        if self.is_ideal:
            return xy
        if self.model == FISHEYE:
            r = np.hypot(xy[:, 0], xy[:, 1])
            bent = fisheye.radius_of(np.arctan(r), self.distortion)
            scale = np.where(r > 1e-9, bent / np.maximum(r, 1e-9), 1.0)
            return xy * scale[:, None]
        k1, k2, p1, p2, k3, k4, k5, k6 = self._eight
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        return np.stack([x * radial + dx, y * radial + dy], axis=1)

    def _undistort(self, distorted: Array) -> Array:
        if self.is_ideal:
            return distorted
        if self.model == FISHEYE:
            radius = np.hypot(distorted[:, 0], distorted[:, 1])
            straight = np.tan(fisheye.theta_of(radius, self.distortion))
            scale = np.where(radius > 1e-9, straight / np.maximum(radius, 1e-9), 1.0)
            return distorted * scale[:, None]
        k1, k2, p1, p2, k3, *upper = self._eight
        if not (p1 or p2 or any(upper)):
            return undistort_radial(distorted, k1, k2, k3)
        xy = distorted.copy()
        for i in range(_ITERATIONS):
            error = distorted - self._distort(xy)
            if np.abs(error).max(initial=0.0) < 1e-12:
                break
            # Plain substitution brings strong distortion near enough for Newton's steps, which end it.
            xy += error if i < _SUBSTITUTIONS else self._newton_step(xy, error)
        return xy

    def _newton_step(self, xy: Array, error: Array) -> Array:
        """What to add to ``xy`` (n, 2) so that its distortion changes by ``error`` (n, 2)."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self._eight
        x, y = xy[:, 0], xy[:, 1]
        r2 = x * x + y * y
        upper, lower = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = upper / lower
        slope = (k1 + r2 * (2 * k2 + 3 * r2 * k3) - radial * (k4 + r2 * (2 * k5 + 3 * r2 * k6))) / lower
        xx = radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        yy = radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        xy_ = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        determinant = xx * yy - xy_ * xy_
        step = np.stack([yy * error[:, 0] - xy_ * error[:, 1], xx * error[:, 1] - xy_ * error[:, 0]], axis=1)
        # Where the model folds over there is no inverse; substitution at least stays put. A lens that doesn't
        # is as flat as 0.05 at 70 degrees off its axis.
        safe = (determinant > 0.002)[:, None]
        return np.where(safe, step / np.where(safe[:, 0], determinant, 1.0)[:, None], error)
