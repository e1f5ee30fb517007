"""Native gtsam factors of the map: reprojection and metric depth, each with its robust kernel."""

from __future__ import annotations

from functools import lru_cache

import gtsam
import numpy as np

from prism_edge.backend.global_map import SCALE_FACTOR
from prism_edge.config import BackendConfig
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array


@lru_cache(maxsize=64)
def pixel_noise(sigma: float, huber: float) -> gtsam.noiseModel.Base:
    """Isotropic pixel noise under Huber's kernel (threshold in sigmas)."""
    return gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(huber), gtsam.noiseModel.Isotropic.Sigma(2, sigma)
    )


@lru_cache(maxsize=256)
def calibration(camera: Camera) -> gtsam.Cal3_S2:
    """gtsam's calibration of the ideal camera."""
    return gtsam.Cal3_S2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy)


def reprojection(
    pose_key: int, point_key: int, pixel: Array, octave: int, camera: Camera, config: BackendConfig
) -> gtsam.NonlinearFactor:
    """Reprojection error of a point (paper, equation 1)."""
    noise = pixel_noise(config.pixel_sigma * SCALE_FACTOR**octave, config.huber_pixels)
    return gtsam.GenericProjectionFactorCal3_S2(pixel, noise, pose_key, point_key, calibration(camera))


def metric_depth(
    pose_key: int,
    point_key: int,
    pixel: Array,
    depth: float,
    camera: Camera,
    units_per_metre: float,
    weight: float,
    config: BackendConfig,
) -> gtsam.NonlinearFactor:
    """Network depth of a pixel as a range factor; ``depth`` along z, in map units.

    range = z * |K^-1 p|. The Huber threshold is given in metres, gtsam's in sigmas, so k = delta / sigma.
    ``weight`` (0, 1] divides the variance (the gate's Omega).
    """
    x, y = (pixel[0] - camera.cx) / camera.fx, (pixel[1] - camera.cy) / camera.fy
    distance = depth * float(np.sqrt(x * x + y * y + 1.0))
    sigma = config.depth_sigma * distance / float(np.sqrt(max(weight, 1e-3)))
    huber = max(config.huber_depth_m * units_per_metre / sigma, 1e-3)
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(huber), gtsam.noiseModel.Isotropic.Sigma(1, sigma)
    )
    return gtsam.RangeFactor3D(pose_key, point_key, distance, noise)


def held(pose_key: int, pose: gtsam.Pose3) -> gtsam.NonlinearFactor:
    """A pose that must not move (a prior far tighter than anything measured)."""
    return gtsam.PriorFactorPose3(pose_key, pose, gtsam.noiseModel.Isotropic.Sigma(6, 1e-6))
