"""What makes a run's figures say less than they seem to, in words for metrics.json's `warnings`; pure."""

from __future__ import annotations

from prism_edge.evaluation.played import Played
from prism_edge.evaluation.trajectory import NS, Trajectory

_TRUTHS = {
    "TUM RGB-D": "groundtruth.txt",
    "7-Scenes": "frame-000000.pose.txt",
    "KITTI odometry": "../../poses/NN.txt (the benchmark's data_odometry_poses.zip) or poses.txt",
}


def apart_in_time(
    estimate: Trajectory, truth: Trajectory, pairs: int, until_ns: int | None = None
) -> list[str]:
    """What to say where not even half of the poses of either could be paired: they may be of other times.

    ``until_ns``: when a run ended that played no more of its recording; later true poses are in no count.
    """
    met = len(truth) if until_ns is None else max(int((truth.stamps <= until_ns).sum()), 1)
    if not len(estimate) or 2 * pairs >= min(len(estimate), met):
        return []
    (first, last), (begin, end) = ((t.stamps[0] / NS, t.stamps[-1] / NS) for t in (estimate, truth))
    return [
        f"{pairs} of {len(estimate)} poses have a true one at their time: the poses are of {first:.3f} to "
        f"{last:.3f} s, the {len(truth)} true ones of {begin:.3f} to {end:.3f} s"
    ]


def not_in_the_map(missing: int, tracked: int) -> list[str]:
    """What to say where the final errors are of other frames than the live ones."""
    if not missing:
        return []
    return [f"{missing} of {tracked} tracked frames are not in the finished map (final.tum)"]


def placed_later(later: int) -> list[str]:
    """What to say where the final errors are of frames that no subscriber had a pose of."""
    if not later:
        return []
    return [
        f"{later} frames without a pose as they came are in final.tum, as a loop has placed them since: "
        "final errors are over more frames than live ones"
    ]


def guessed_camera(played: Played) -> list[str]:
    """What to say where nothing names the camera."""
    if not played.guessed or played.camera is None:
        return []
    return [f"nothing says which camera took the recording: {played.camera['origin']}"]


def not_played(refused: int, frames: int) -> list[str]:
    """What to say where more than a hundredth of the frames never reached the tracker."""
    if 100 * refused <= frames:
        return []
    return [
        f"{refused} of {frames} frames were not played, and count as not tracked: unreadable, of another "
        "size, or their stamp repeats or goes back (daemon.log has the first of each kind)"
    ]


def unfinished(settled: bool) -> list[str]:
    """What to say where the map's last adjustment was not waited for."""
    if settled:
        return []
    return ["the map was still being adjusted when it was taken: final errors are of one that isn't finished"]


def no_truth(layout: str | None) -> list[str]:
    """What to say of a recording whose layout has a place for truth, and none there."""
    if layout not in _TRUTHS:
        return []
    return [f"no true poses lie with the recording, so nothing is scored; they would be in {_TRUTHS[layout]}"]


def no_pose(poses: int, frames: int, processed: int, begun: bool, no_depth: str = "") -> list[str]:
    """What to say of a run that published nothing; ``begun``: an image of those processed began a map.

    ``no_depth``: why the last keyframe without depth had none.
    """
    if poses:
        return []
    what = f"no pose came out of {frames} frames"
    if processed and not begun:
        what += ": in none were corners enough to begin a map with (too dark, too bright, blurred or blank)"
    elif no_depth:
        what += f": keyframes had no usable depth: {no_depth}"
    return [what]
