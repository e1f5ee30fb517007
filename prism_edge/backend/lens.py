"""The radial distortion that a camera file lacks, found from the map itself (self-calibration).

Most cameras bend their image by a per cent or so at the rim and most recordings say that they don't. Such a
lens bends the map: its path turns a little too far with every view, which no later view undoes. An adjustment
of all keyframes sees it where points are seen in the middle as well as at the rim. One coefficient is looked
for, r -> r (1 + k1 r^2). Focal length and principal point stay as they are: a short path says little of them,
and their errors do little.

An early map bends most and knows least. So what is found is weighed against what the file says: the most
probable k1 if lenses are PRIOR_SIGMA off, taken once it is likely that this one is off at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam.symbol_shorthand import C, X

from prism_edge.backend.elimination import covariance_of_last
from prism_edge.backend.global_map import GlobalMap
from prism_edge.geometry.cameras import PINHOLE, Camera
from prism_edge.geometry.poses import Array

LENS = C(0)  # the variable's key
PRIOR_SIGMA = 0.03  # of k1, about what the camera file says, where it is off
EXACT = 3.0  # times as many camera files as are off: rectified images, simulated ones
UNIT_SIGMA = 0.01  # relative; lengths don't bend with the lens
# A corner errs alike in keyframes that stand side by side: on recordings whose lens is exact, estimates
# scatter by two to three times the sigma that independent errors would have.
ALIKE = 3.0
LARGEST = 0.15  # of |k1|, all told: more is a wrong map
WELL_KNOWN = 0.004  # sigma: half a pixel at the corner of a common image
FIRST, GROWTH, LAST = 10, 1.2, 200  # keyframes at which it is looked for, each so many times the one before
ROUND_TRIP_PX = 0.1
NEWS = 0.2  # sigmas: a smaller change is not worth another map


@dataclass(frozen=True)
class Lens:
    """What to add to k1 of the camera that ``was``, and one sigma of it; the camera file ``said`` its k1."""

    was: Camera
    k1: float
    sigma: float
    said: float = 0.0

    @property
    def camera(self) -> Camera:
        """The camera as found."""
        return self.was.bent(self.k1)

    @property
    def is_off(self) -> bool:
        """Whether the camera file's k1 is more likely wrong than right, EXACT times as many being right.

        With a Gaussian prior, twice the logarithm of Bayes' factor is k1^2 / sigma^2 - 2 ln(prior / sigma).
        """
        if not self.sigma > 0.0:
            return False
        off = (radial(self.camera) - self.said) / self.sigma
        return off * off > 2.0 * math.log(EXACT * max(PRIOR_SIGMA / self.sigma, 1.0))

    @property
    def is_possible(self) -> bool:
        """Whether it is a lens that shows each ray once."""
        if abs(radial(self.camera)) > LARGEST:
            return False
        right, bottom = self.was.width - 1.0, self.was.height - 1.0
        corners = np.array([[0.0, 0.0], [right, 0.0], [0.0, bottom], [right, bottom]])
        there = self.camera.distort_pixels(self.camera.undistort_pixels(corners))
        return bool(np.abs(there - corners).max() < ROUND_TRIP_PX)

    @property
    def is_taken(self) -> bool:
        """Whether to go on with it: one that was off before is followed as it gets better known."""
        news = abs(self.k1) > NEWS * self.sigma
        return news and self.is_possible and (self.is_off or radial(self.was) != self.said)


class LensWatch:
    """When the lens is looked for: as a map grows, ever more seldom."""

    def __init__(self, enabled: bool, known: int = 0) -> None:
        """A map that had ``known`` keyframes when it was taken up has been looked at."""
        self._enabled, self._next, self._looked_at = enabled, FIRST, known
        self._bent: Camera | None = None  # the camera as this watch left it
        self._said = 0.0  # and what its file said
        if known:
            self._next = max(math.ceil(GROWTH * known), FIRST)

    def due(self, world: GlobalMap) -> bool:
        """Whether the map has grown enough since it was looked for."""
        return self._enabled and self._next <= len(world.keyframes) <= LAST and common(world) is not None

    def said(self, world: GlobalMap) -> float | None:
        """k1 as the camera file has it; None where no lens may be looked for."""
        camera = common(world)
        if camera is None:
            return None
        return self._said if camera == self._bent else radial(camera)

    def looked(self, world: GlobalMap, lens: Lens | None = None) -> bool:
        """It has been looked for, with this result; True where that is taken.

        What is known well need not be looked for so soon.
        """
        taken = lens is not None and lens.is_taken
        if lens is not None and taken:
            self._bent, self._said = lens.camera, lens.said
        self._looked_at = len(world.keyframes)
        well_known = lens is not None and lens.sigma < WELL_KNOWN
        self._next = math.ceil((2.0 if well_known else GROWTH) * self._looked_at)
        return taken

    def finish(self) -> None:
        """The map won't grow any more: its last keyframes count as well."""
        self._next = max(self._looked_at + 1, FIRST)


def common(world: GlobalMap) -> Camera | None:
    """The one camera that took all keyframes, if its lens may be looked for: a pinhole with k1 at most.

    A camera file that says more comes of a calibration, and is believed.
    """
    camera = world.camera
    if camera is None or camera.model != PINHOLE or any(camera.distortion[1:]):
        return None
    one = all(k.camera == camera for k in world.keyframes.values())
    return camera if one and abs(radial(camera)) <= LARGEST else None


def radial(camera: Camera) -> float:
    """The first radial coefficient."""
    return camera.distortion[0] if camera.distortion else 0.0


def add_variable(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, camera: Camera, said: float
) -> None:
    """The lens, starting as ``camera`` has it, with its prior about what was ``said``; all but k1 is held.

    The prior is as much too sure of itself as the measurements are.
    """
    sigmas = np.array([1e-6 * camera.fx, PRIOR_SIGMA / ALIKE, 1e-6])
    values.insert(LENS, gtsam.Cal3Bundler(camera.fx, radial(camera), 0.0, 0.0, 0.0))
    told = gtsam.Cal3Bundler(camera.fx, said, 0.0, 0.0, 0.0)
    graph.add(gtsam.PriorFactorCal3Bundler(LENS, told, gtsam.noiseModel.Diagonal.Sigmas(sigmas)))


def hold_unit(graph: gtsam.NonlinearFactorGraph, poses: dict[int, Array]) -> None:
    """Keep the first pose's distance from the farthest: where the unit is free there is no covariance."""
    first = min(poses)
    distance = {k: float(np.linalg.norm(pose[:3, 3] - poses[first][:3, 3])) for k, pose in poses.items()}
    far = max(distance, key=lambda k: distance[k])
    if distance[far] > 0.0:
        noise = gtsam.noiseModel.Isotropic.Sigma(1, UNIT_SIGMA * distance[far])
        graph.add(gtsam.RangeFactorPose3(X(first), X(far), distance[far], noise))


def found(
    graph: gtsam.NonlinearFactorGraph,
    values: gtsam.Values,
    ordering: gtsam.Ordering,
    was: Camera,
    said: float,
) -> Lens | None:
    """The lens of a solved graph, in whose ordering it comes last; None where it has no covariance."""
    try:
        variance = covariance_of_last(graph, values, ordering)[1, 1]
    except (RuntimeError, np.linalg.LinAlgError):
        return None
    k1 = float(values.atCal3Bundler(LENS).k1()) - radial(was)
    usable = math.isfinite(k1) and math.isfinite(variance) and variance > 0.0
    return Lens(was, k1, ALIKE * math.sqrt(variance), said) if usable else None
