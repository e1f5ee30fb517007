"""How far an estimated trajectory is from the true one; pure. Definitions: docs/EVALUATION.md.

All lengths are those of the truth's unit (metres). Both trajectories hold world_from_camera poses.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.evaluation.trajectory import Trajectory, paired, rows_apart
from prism_edge.geometry.alignment import Alignment, DegenerateAlignment, align
from prism_edge.geometry.poses import Array, inverse

KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
_KITTI_STEP = 10  # poses between segment starts, as in the benchmark's own tool
_FRACTIONS = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8)
_SHORTEST_PATH_M = 1.0
Segments = tuple[float, Array]  # length (m), errors (n, 4, 4)


@dataclass(frozen=True)
class Scores:
    """Errors of one trajectory; None where it can't be computed."""

    pairs: int  # poses that have a true counterpart
    ate_se3_m: float | None
    ate_sim3_m: float | None
    scale_ratio: float | None
    scale_ratio_halves: list[float | None]
    rpe_trans_m: float | None
    rpe_rot_deg: float | None
    t_rel_percent: float | None
    r_rel_deg_per_100m: float | None
    t_rel_lengths_m: list[float]

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json."""
        return asdict(self)


UNKNOWN = Scores(0, None, None, None, [None, None], None, None, None, None, [])


def score(estimate: Trajectory, truth: Trajectory, split_ns: int | None = None) -> Scores:
    """All errors of ``estimate`` against ``truth``, paired by stamp.

    ``split_ns`` parts the two halves of ``scale_ratio_halves``; by default it is midway in time
    between the first and the last pair.
    """
    estimate, truth = paired(estimate, truth)
    if not len(truth):
        return UNKNOWN
    if split_ns is None:
        split_ns = (int(truth.stamps[0]) + int(truth.stamps[-1])) // 2
    early = np.asarray(estimate.stamps < split_ns)
    trans, rot = rpe(estimate, truth)
    parts = segments(estimate, truth)
    percent, lengths = t_rel(parts)
    return Scores(
        pairs=len(truth),
        ate_se3_m=ate(estimate.positions, truth.positions, with_scale=False),
        ate_sim3_m=ate(estimate.positions, truth.positions, with_scale=True),
        scale_ratio=scale_ratio(estimate.positions, truth.positions),
        scale_ratio_halves=[
            scale_ratio(estimate.positions[half], truth.positions[half]) for half in (early, ~early)
        ],
        rpe_trans_m=trans,
        rpe_rot_deg=rot,
        t_rel_percent=percent,
        r_rel_deg_per_100m=r_rel(parts),
        t_rel_lengths_m=lengths,
    )


def _fit(estimate: Array, truth: Array, with_scale: bool) -> Alignment | None:
    try:
        return align(estimate, truth, with_scale)
    except DegenerateAlignment:
        return None


def ate(estimate: Array, truth: Array, with_scale: bool) -> float | None:
    """Root mean square distance (m) of positions (n, 3) after the best rigid or similarity fit.

    Absolute trajectory error of Sturm et al. (IROS 2012); None for fewer than 3 or coinciding positions.
    """
    fit = _fit(estimate, truth, with_scale)
    if fit is None:
        return None
    return _rms(np.linalg.norm(fit.apply(estimate) - truth, axis=1))


def scale_ratio(estimate: Array, truth: Array) -> float | None:
    """The factor that fits the estimate to the truth (truth ~ ratio * estimate), from the Sim(3) fit."""
    fit = _fit(estimate, truth, with_scale=True)
    return None if fit is None else fit.scale


def rpe(
    estimate: Trajectory, truth: Trajectory, delta_s: float = 1.0
) -> tuple[float | None, float | None]:
    """Relative pose error over ``delta_s``: RMS translation (m) and rotation (deg), nothing aligned.

    Over all pairs of poses whose stamps are ``delta_s`` apart (`rows_apart`):
    E = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), Q true and P estimated (Sturm et al., IROS 2012, equation 1).
    The arguments are associated already; None where no two poses are that far apart.
    """
    starts, ends = rows_apart(truth.stamps, delta_s)
    if not len(starts):
        return None, None
    errors = _relative_errors(estimate.poses, truth.poses, starts, ends)
    return _rms(np.linalg.norm(errors[:, :3, 3], axis=1)), float(np.degrees(_rms(_angles(errors[:, :3, :3]))))


def t_rel(parts: list[Segments]) -> tuple[float | None, list[float]]:
    """KITTI's mean translation error per length travelled (percent), and the lengths (m) it rests on.

    Over the `segments` of a path (Geiger et al., CVPR 2012); (None, []) where there are none.
    """
    if not parts:
        return None, []
    errors = [np.linalg.norm(relative[:, :3, 3], axis=1) / length for length, relative in parts]
    return 100.0 * float(np.concatenate(errors).mean()), [length for length, _ in parts]


def r_rel(parts: list[Segments]) -> float | None:
    """KITTI's mean rotation error per length travelled (deg / 100 m), over the segments of `t_rel`."""
    if not parts:
        return None
    errors = [_angles(relative[:, :3, :3]) / length for length, relative in parts]
    return 100.0 * float(np.degrees(np.concatenate(errors).mean()))


def of_own_length(lengths_m: list[float]) -> bool:
    """Whether `t_rel` and `r_rel` rest on shares of a path that holds no 100 m: not KITTI's figures."""
    return bool(lengths_m) and lengths_m[0] < KITTI_LENGTHS_M[0]


def segments(estimate: Trajectory, truth: Trajectory) -> list[Segments]:
    """Lengths (m), each with the errors (n, 4, 4) of the motion over all segments of that length.

    KITTI's: 100 to 800 m of true path, starting at every tenth pose. Paths that hold no 100 m use 10 to 80
    percent of their own length, starting at every pose; [] for paths under 1 m.
    """
    if len(truth) < 2:
        return []
    steps = np.linalg.norm(np.diff(truth.positions, axis=0), axis=1)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    path = float(travelled[-1])
    if path < _SHORTEST_PATH_M:
        return []
    standard = path > KITTI_LENGTHS_M[0]
    starts = np.arange(0, len(truth), _KITTI_STEP if standard else 1)
    found = []
    for length in KITTI_LENGTHS_M if standard else [fraction * path for fraction in _FRACTIONS]:
        ends = np.searchsorted(travelled, travelled[starts] + length, side="right")
        inside = ends < len(travelled)
        if inside.any():
            errors = _relative_errors(estimate.poses, truth.poses, starts[inside], ends[inside])
            found.append((length, errors))
    return found


def _relative_errors(
    estimate: Array, truth: Array, starts: NDArray[np.intp], ends: NDArray[np.intp]
) -> Array:
    true_motion = inverse(truth[starts]) @ truth[ends]
    return inverse(true_motion) @ inverse(estimate[starts]) @ estimate[ends]


def _angles(rotations: Array) -> Array:
    """Angles (n,) rad of rotations (n, 3, 3); by sine and cosine, exact for small ones too."""
    axis = np.stack(
        [
            rotations[:, 2, 1] - rotations[:, 1, 2],
            rotations[:, 0, 2] - rotations[:, 2, 0],
            rotations[:, 1, 0] - rotations[:, 0, 1],
        ],
        axis=1,
    )
    return np.arctan2(np.linalg.norm(axis, axis=1), np.trace(rotations, axis1=1, axis2=2) - 1.0)


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
