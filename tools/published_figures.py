"""The figures that the PRISM-SLAM paper prints for its own system, and which folder holds which sequence.

The paper says of how many frames a figure is for KITTI alone; other numbers are the datasets' own.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Published:
    """What the paper prints for one sequence: ATE (cm) after each alignment, t_rel (%); None: not printed."""

    sequence: str  # as the paper calls it
    sim3_cm: float | None
    se3_cm: float | None
    t_rel_percent: float | None = None
    frames: int | None = None  # that these are of: all of rgb.txt, a whole sequence; None: not known here

    def fits(self, frames: float, most: int | None = None) -> bool:
        """Whether a recording of so many frames may be that sequence: within a hundredth of its own.

        Where that isn't known, it may if it has fewer than the ``most`` that were asked for.
        """
        if self.frames is None:
            return most is None or frames < most
        return abs(frames - self.frames) <= 0.01 * self.frames


# Dataset, what a folder's path looks like, figures: tables "TUM RGB-D (fr1)", "(fr3)", "BONN Dynamic",
# "7-Scenes" and "KITTI Odometry" of the paper. TUM's frames are rgb.txt's lines: fr1/xyz's list itself is in
# the history of ORB-SLAM2's repository (Examples/RGB-D/TestSet), others' are as public reports of whole runs
# count them. 7-Scenes' page says 500 to 1000 a sequence; public loaders take 500 on the stairs, else 1000.
_TUM, _BONN, _SCENES, _KITTI = "TUM RGB-D", "BONN Dynamic", "7-Scenes", "KITTI odometry"
_PAPER = (
    (_TUM, r"(freiburg|fr)1_xyz", Published("fr1/xyz", 2.86, 3.04, frames=798)),
    (_TUM, r"(freiburg|fr)1_rpy", Published("fr1/rpy", 4.10, 4.94, frames=723)),
    (_TUM, r"(freiburg|fr)3_sitting_static", Published("fr3/sit-static", 1.6, 1.8)),
    (_TUM, r"(freiburg|fr)3_walking_static", Published("fr3/walk-static", 1.9, 2.7)),
    (_TUM, r"(freiburg|fr)3_sitting_xyz", Published("fr3/sit-xyz", 12.7, 20.0, frames=1261)),
    (_TUM, r"(freiburg|fr)3_walking_xyz", Published("fr3/walk-xyz", 23.2, 26.8, frames=859)),
    (_BONN, r"bonn_balloon", Published("balloon", 9.8, 18.1)),
    (_BONN, r"bonn_balloon2", Published("balloon2", 14.0, 17.7)),
    (_BONN, r"bonn_person_tracking", Published("pers_trk", 36.7, 39.5)),
    (_BONN, r"bonn_balloon_tracking", Published("balloon_trk", 7.8, 9.1)),
    (_SCENES, r"chess", Published("Chess", 7.1, 7.1, frames=1000)),
    (_SCENES, r"fire", Published("Fire", 10.8, 17.7, frames=1000)),
    (_SCENES, r"heads", Published("Heads", 8.8, 68.4, frames=1000)),
    (_SCENES, r"office", Published("Office", 11.7, 15.5, frames=1000)),
    (_SCENES, r"pumpkin", Published("Pumpkin", 7.9, 7.9, frames=1000)),
    (_SCENES, r"red_?kitchen", Published("Redkitchen", 3.6, 12.1, frames=1000)),
    (_SCENES, r"stairs", Published("Stairs", 11.5, 11.9, frames=500)),
    (_KITTI, r"03", Published("seq 03", None, 430.0, 2.29, 500)),
)
NOTES = {
    _SCENES: "The paper names no sequence of a scene.",
    _KITTI: "The paper's figures are of the first 500 frames (`--frames 500`).",
}


def dataset_of(layout: str, folder: Path) -> str:
    """The dataset of a folder whose files are laid out so; the layout itself where the paper has none."""
    return _BONN if layout == _TUM and "bonn" in folder.name.lower() else layout


def published(dataset: str, folder: Path) -> Published | None:
    """What the paper has for the sequence in a folder, known by its name; None where it has nothing.

    TUM, BONN and KITTI folders are known by their own name, 7-Scenes by that of the scene's folder, in
    which the sequences are (`redkitchen/seq-01`, `7scenes_redkitchen/seq-01`, `redkitchen/seq-01/seq-01`).
    """
    if dataset == _SCENES:
        folder = next(path for path in (folder, *folder.parents) if not path.name.startswith("seq"))
    name = folder.name.lower()
    prefix = r"(rgbd_dataset_|rgbd_|7-?scenes_)?"
    for known, pattern, figures in _PAPER:
        if known == dataset and re.fullmatch(prefix + pattern, name):
            return figures
    return None
