"""The radial distortion that a camera file lacks, found from the map itself (self-calibration).

Most cameras bend their image by a per cent or so at the rim and most recordings say that they don't. Such a
lens bends the map: its path turns a little too far with every view, which no later view undoes. An adjustment
of all keyframes sees it where points are seen in the middle as well as at the rim. One coefficient is looked
for, r -> r (1 + k1 r^2), on top of what the camera file says. Focal length and principal point stay as they
are: a short path says little of them, and their errors do little.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from prism_edge.backend.global_map import GlobalMap
from prism_edge.geometry.cameras import PINHOLE, Camera
from prism_edge.geometry.poses import Array

LENS = C(0)  # the variable's key
PRIOR_SIGMA = 0.05  # of k1
UNIT_SIGMA = 0.01  # relative; lengths don't bend with the lens
# A corner errs alike in keyframes that stand side by side: on recordings whose lens is exact, estimates
# scatter by two to three times the sigma that independent errors would have.
ALIKE = 3.0
CERTAIN = 3.0  # sigmas: less is not taken for a lens
LEAST_PARALLAX_DEG = 1.0  # of the points that it is looked for in
LARGEST = 0.15  # of |k1|: more is a wrong map
WELL_KNOWN = 0.004  # sigma: half a pixel at the corner of a common image
FIRST, GROWTH, LAST = 20, 1.25, 200  # keyframes at which it is looked for, each so many times the one before


@dataclass(frozen=True)
class Lens:
    """What to add to k1, and one sigma of it."""

    k1: float
    sigma: float

    @property
    def is_certain(self) -> bool:
        """Whether it is taken for real."""
        return CERTAIN * self.sigma < abs(self.k1) < LARGEST


class LensWatch:
    """When the lens is looked for: as a map grows, until it is known."""

    def __init__(self, enabled: bool) -> None:
        self._enabled, self._next, self._looked_at = enabled, FIRST, 0

    def due(self, world: GlobalMap) -> bool:
        """Whether the map has grown enough since it was looked for."""
        return self._enabled and self._next <= len(world.keyframes) <= LAST and common(world) is not None

    def looked(self, world: GlobalMap) -> None:
        """It is being looked for in the map as it is."""
        self._looked_at = len(world.keyframes)
        self._next = math.ceil(GROWTH * self._looked_at)

    def learn(self, lens: Lens) -> None:
        """What came of it: what is known well need not be looked for so soon."""
        if lens.is_certain or lens.sigma < WELL_KNOWN:
            self._next = 2 * self._looked_at

    def finish(self) -> None:
        """The map won't grow any more: its last keyframes count as well."""
        self._next = max(self._looked_at + 1, FIRST)


def common(world: GlobalMap) -> Camera | None:
    """The one pinhole camera that took all keyframes; None where there were several."""
    camera = world.camera
    one = camera is not None and camera.model == PINHOLE
    return camera if one and all(k.camera == camera for k in world.keyframes.values()) else None


def add_variable(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, camera: Camera) -> None:
    """The lens with its prior; all but k1 is held."""
    ideal = gtsam.Cal3Bundler(camera.fx, 0.0, 0.0, 0.0, 0.0)
    sigmas = np.array([1e-6 * camera.fx, PRIOR_SIGMA, 1e-6])
    values.insert(LENS, ideal)
    graph.add(gtsam.PriorFactorCal3Bundler(LENS, ideal, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))


def hold_unit(graph: gtsam.NonlinearFactorGraph, poses: dict[int, Array]) -> None:
    """Keep the first pose's distance from the farthest: where the unit is free there is no covariance."""
    first = min(poses)
    distance = {k: float(np.linalg.norm(pose[:3, 3] - poses[first][:3, 3])) for k, pose in poses.items()}
    far = max(distance, key=lambda k: distance[k])
    if distance[far] > 0.0:
        noise = gtsam.noiseModel.Isotropic.Sigma(1, UNIT_SIGMA * distance[far])
        graph.add(gtsam.RangeFactorPose3(X(first), X(far), distance[far], noise))


def found(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> Lens | None:
    """The lens of a solved graph; None where it has no covariance."""
    try:
        variance = gtsam.Marginals(graph, values).marginalCovariance(LENS)[1, 1]
    except RuntimeError:
        return None
    k1 = float(values.atCal3Bundler(LENS).k1())
    usable = math.isfinite(k1) and math.isfinite(variance) and variance > 0.0
    return Lens(k1, ALIKE * math.sqrt(variance)) if usable else None
