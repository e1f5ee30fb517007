"""Native gtsam factors of the map: reprojection, Pluecker ray and metric depth, each with its robust kernel.

The ray's residual (paper, equation 6) is the distance of a point X from the ray (d, m) of a pixel,
|d x X + m| / |d| with m = t x d. For a point at range r and an angle a off the ray that is r sin a, so a
bearing factor whitened by sigma_ray / r has the same value to second order in a. r is the range when the
factor is made and has to be refreshed as the point moves. As it stays out of the derivatives, shrinking
the map gains nothing, which the exact residual, being a length, would reward.
"""

from __future__ import annotations

import math
from functools import lru_cache

import gtsam
import numpy as np

from prism_edge.backend.global_map import GlobalKeyframe
from prism_edge.config import BackendConfig
from prism_edge.geometry.poses import Array

LEAST_WEIGHT = 1e-3  # a gate that is shut leaves a factor finite
_RAY_STEP = 0.01
_LEAST_RANGE = 1e-3  # map units
_UNIT_CAMERA, _CENTRE = gtsam.Cal3_S2(1.0, 1.0, 0.0, 0.0, 0.0), np.zeros(2)
_SIGMA_STEP = 0.1  # of log sigma: noise models are shared between depths that are about as uncertain


class FactorFactory:
    """Makes the factors of one window. Python's share of a solve is spent here, so what can be shared is."""

    def __init__(self, config: BackendConfig, units_per_metre: float) -> None:
        """``units_per_metre`` turns thresholds in metres into the map's unit."""
        self._config = config
        self._huber_depth = config.huber_depth_m * units_per_metre
        self._ray_sigma = config.ray_sigma_m * units_per_metre
        self._calibrations: dict[int, gtsam.Cal3_S2] = {}
        self._standing: dict[int, gtsam.PinholePoseCal3_S2] = {}  # cameras whose poses are known
        self._taken: dict[int, Array] = {}  # pixels of each keyframe before undistortion, off the centre

    def reprojection(
        self, pose_key: int, point_key: int, keyframe: GlobalKeyframe, keypoint: int
    ) -> gtsam.NonlinearFactor:
        """Reprojection error of a point (paper, equation 1) under Huber's kernel."""
        noise = self._pixel_noise(keyframe, keypoint)
        calibration = self._calibrations.get(keyframe.id) or self._calibrate(keyframe)
        return gtsam.GenericProjectionFactorCal3_S2(
            keyframe.pixels[keypoint], noise, pose_key, point_key, calibration
        )

    def reprojection_from(
        self, point_key: int, keyframe: GlobalKeyframe, keypoint: int
    ) -> gtsam.NonlinearFactor:
        """The same from where the keyframe stands: its pose is no variable."""
        camera = self._standing.get(keyframe.id)
        if camera is None:
            calibration = self._calibrations.get(keyframe.id) or self._calibrate(keyframe)
            camera = gtsam.PinholePoseCal3_S2(gtsam.Pose3(keyframe.world_from_camera), calibration)
            self._standing[keyframe.id] = camera
        noise = self._pixel_noise(keyframe, keypoint)
        return gtsam.TriangulationFactorPoseCal3_S2(camera, keyframe.pixels[keypoint], noise, point_key)

    def reprojection_through(
        self, lens_key: int, pose_key: int, point_key: int, keyframe: GlobalKeyframe, keypoint: int
    ) -> gtsam.NonlinearFactor:
        """The same for the pixel as taken, through a lens that is unknown (lens.py); its centre is at 0."""
        camera = keyframe.camera
        taken = self._taken.get(keyframe.id)
        if taken is None:
            taken = self._taken[keyframe.id] = camera.distort_pixels(keyframe.pixels) - (camera.cx, camera.cy)
        x, y = taken[keypoint]
        return gtsam.GeneralSFMFactor2Cal3Bundler(
            np.array([x, y * camera.fx / camera.fy]),
            self._pixel_noise(keyframe, keypoint),
            pose_key,
            point_key,
            lens_key,
        )

    def metric_depth(
        self, pose_key: int, point_key: int, keyframe: GlobalKeyframe, keypoint: int
    ) -> gtsam.NonlinearFactor:
        """Network depth of a keypoint (along z, map units) as a range factor: range = z * |K^-1 p|.

        The Huber threshold is a length, gtsam's is in sigmas, so k = delta / sigma. The gate's weight
        divides the variance (Omega = w / sigma^2).
        """
        assert keyframe.depths is not None
        camera = keyframe.camera
        pixel = keyframe.pixels[keypoint]
        x, y = (float(pixel[0]) - camera.cx) / camera.fx, (float(pixel[1]) - camera.cy) / camera.fy
        distance = float(keyframe.depths[keypoint]) * math.sqrt(x * x + y * y + 1.0)
        weight = max(keyframe.gate_weight(keypoint), LEAST_WEIGHT)
        relative = keyframe.depth_sigma or self._config.depth_sigma
        sigma = relative * distance / math.sqrt(weight)
        noise = depth_noise(round(math.log(sigma) / _SIGMA_STEP), self._huber_depth)
        return gtsam.RangeFactor3D(pose_key, point_key, distance, noise)

    def ray(
        self, pose_key: int, point_key: int, keyframe: GlobalKeyframe, keypoint: int, current_range: float
    ) -> gtsam.NonlinearFactor:
        """Distance of a point from the ray of a keypoint; ``current_range`` is the point's, map units.

        It repeats what the reprojection of the same pixel says: use one of them. Huber's k = delta / sigma.
        A length far away is a small angle, but no ray is known better than its pixel: one point that had run
        off to a kilometre turned a whole window towards itself.
        """
        direction = gtsam.Unit3(_direction(keyframe, keypoint))
        noise = self._ray_noise(keyframe, keypoint, current_range)
        return gtsam.BearingFactor3D(pose_key, point_key, direction, noise)

    def ray_from(
        self, point_key: int, keyframe: GlobalKeyframe, keypoint: int, current_range: float
    ) -> gtsam.NonlinearFactor:
        """The same from where the keyframe stands: its pose is no variable.

        As seen by a camera that looks along the ray, with a focal length of 1: the tangent of the angle off
        the ray, which is as the angle itself to second order.
        """
        along = _axes_along(_direction(keyframe, keypoint))
        pose = keyframe.world_from_camera
        axes = gtsam.Pose3(gtsam.Rot3(pose[:3, :3] @ along), pose[:3, 3])
        camera = gtsam.PinholePoseCal3_S2(axes, _UNIT_CAMERA)
        noise = self._ray_noise(keyframe, keypoint, current_range)
        return gtsam.TriangulationFactorPoseCal3_S2(camera, _CENTRE, noise, point_key)

    def nearly_held(self, pose_key: int, keyframe: GlobalKeyframe, distance: float) -> gtsam.NonlinearFactor:
        """A pose as it is, give or take what moves the picture of things at a ``distance`` by a pixel."""
        angle = self._config.pixel_sigma / keyframe.camera.fx
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([angle, angle * max(distance, _LEAST_RANGE)], 3))
        return gtsam.PriorFactorPose3(pose_key, gtsam.Pose3(keyframe.world_from_camera), noise)

    def _pixel_noise(self, keyframe: GlobalKeyframe, keypoint: int) -> gtsam.noiseModel.Base:
        sigma = self._config.pixel_sigma * float(keyframe.sigmas[keypoint])
        return pixel_noise(sigma, self._config.huber_pixels)

    def _ray_noise(
        self, keyframe: GlobalKeyframe, keypoint: int, current_range: float
    ) -> gtsam.noiseModel.Base:
        weight = max(keyframe.gate_weight(keypoint), LEAST_WEIGHT)
        of_pixel = self._config.pixel_sigma * float(keyframe.sigmas[keypoint]) / keyframe.camera.fx
        of_length = self._ray_sigma / max(current_range, _LEAST_RANGE)
        angle = max(of_length, of_pixel) / math.sqrt(weight)
        threshold = self._config.huber_ray_m / self._config.ray_sigma_m * math.sqrt(weight)
        return ray_noise(round(math.log(angle) / _RAY_STEP), round(threshold, 2))

    def _calibrate(self, keyframe: GlobalKeyframe) -> gtsam.Cal3_S2:
        camera = keyframe.camera
        made = gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)
        self._calibrations[keyframe.id] = made
        return made


def _direction(keyframe: GlobalKeyframe, keypoint: int) -> Array:
    """Of a keypoint's ray (3,), in its camera's frame."""
    camera, pixel = keyframe.camera, keyframe.pixels[keypoint]
    return np.array([(pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy, 1.0])


def _axes_along(direction: Array) -> Array:
    """A rotation (3, 3) whose z axis lies along ``direction`` (x, y, 1)."""
    x, y, _ = direction.tolist()
    across, length = math.hypot(x, 1.0), math.sqrt(x * x + y * y + 1.0)
    right = (1.0 / across, 0.0, -x / across)
    ahead = (x / length, y / length, 1.0 / length)
    down = (
        ahead[1] * right[2] - ahead[2] * right[1],
        ahead[2] * right[0] - ahead[0] * right[2],
        ahead[0] * right[1] - ahead[1] * right[0],
    )
    return np.array([right, down, ahead]).T


@lru_cache(maxsize=256)
def pixel_noise(sigma: float, huber: float) -> gtsam.noiseModel.Base:
    """Isotropic pixel noise; Huber's threshold is in sigmas."""
    return _robust(huber, gtsam.noiseModel.Isotropic.Sigma(2, sigma))


@lru_cache(maxsize=1024)
def depth_noise(step: int, huber: float) -> gtsam.noiseModel.Base:
    """Range noise of sigma exp(step * 0.1); ``huber`` is a length in the same unit."""
    sigma = math.exp(step * _SIGMA_STEP)
    return _robust(max(huber / sigma, 1e-3), gtsam.noiseModel.Isotropic.Sigma(1, sigma))


@lru_cache(maxsize=4096)
def ray_noise(step: int, huber: float) -> gtsam.noiseModel.Base:
    """Bearing noise of sigma exp(step * 0.01) radians; ``huber`` is in sigmas."""
    return _robust(max(huber, 1e-3), gtsam.noiseModel.Isotropic.Sigma(2, math.exp(step * _RAY_STEP)))


def _robust(huber: float, noise: gtsam.noiseModel.Base) -> gtsam.noiseModel.Base:
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(huber), noise)


def held(pose_key: int, pose: Array) -> gtsam.NonlinearFactor:
    """A pose that must not move (a prior far tighter than anything measured)."""
    tight = gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)
    return gtsam.PriorFactorPose3(pose_key, gtsam.Pose3(np.asarray(pose)), tight)
