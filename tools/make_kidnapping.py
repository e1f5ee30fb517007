"""A recording in which the camera is carried off blind and set down again turned (a test of relocalisation).

    python tools/make_kidnapping.py FOLDER OUT [--dark 300 600] [--roll 20] [--frames N]

FOLDER is any folder of images that `prism-edge run` plays. OUT becomes a folder of the 7-Scenes layout
(frame-NNNNNN.color.png), played at 30 images a second: the images from the first --dark number up to (not
with) the second are black, and those from there on are turned about the optical axis by --roll degrees, as
if the camera came back held askew. Where FOLDER has true poses they are written too, turned alike; positions
stay as they are, so any other reference for positions still holds. camera.yaml describes the camera.
--poses FILE.tum is a reference to be turned too: OUT/reference.tum, without the poses in the dark.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.config import SourceConfig
from prism_edge.errors import PrismError, in_words
from prism_edge.evaluation.trajectory import Trajectory, read_tum, write_tum
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, from_rt, so3_exp
from prism_edge.sources import open_source
from prism_edge.sources.base import Image
from prism_edge.sources.seven_scenes import RATE_HZ
from prism_edge.sources.stamps import at_rate
from tools.distractors.recording import empty
from tools.true_poses import own_truth, pose_of_image


def roll_of(degrees: float) -> Array:
    """upright_from_turned (4, 4): a camera turned clockwise about its axis, as seen from behind it."""
    return from_rt(so3_exp(np.array([0.0, 0.0, np.radians(degrees)])), np.zeros(3))


def turned(pixels: NDArray[np.uint8], camera: Camera, degrees: float) -> NDArray[np.uint8]:
    """What the camera would have seen turned by ``degrees``: black where it saw nothing.

    The rotation homography K R^T K^-1; exact for an ideal pinhole, whose image this must be.
    """
    rotation = roll_of(degrees)[:3, :3]
    homography = camera.matrix @ rotation.T @ np.linalg.inv(camera.matrix)
    size = (camera.width, camera.height)
    return np.asarray(cv2.warpPerspective(pixels, homography, size, flags=cv2.INTER_LINEAR), np.uint8)


def write(
    folder: str, out: Path, dark: tuple[int, int], degrees: float, most: int, poses: Path | None = None
) -> int:
    """Writes the recording; returns how many images it has.

    Raises PrismError where FOLDER, OUT, or the reference ``poses``, is unusable.
    """
    empty(out)
    reference = None if poses is None else read_tum(poses)
    numbers: dict[int, int] = {}  # of images, by stamp
    source = open_source(SourceConfig(uri=folder))
    truth = own_truth(folder)
    with source:
        if not source.camera.is_ideal:
            raise SystemExit("the camera has distortion: its images would have to be undistorted first")
        out.mkdir(parents=True, exist_ok=True)
        describe(source.camera, out / "camera.yaml")
        count = 0
        while (image := source.read()) is not None:
            if not isinstance(image, Image):
                continue
            if image.index >= most:
                break
            pixels, pose = image.pixels, pose_of_image(truth, image.stamp_ns)
            if dark[0] <= image.index < dark[1]:
                pixels = np.zeros_like(pixels)
            elif image.index >= dark[1]:
                pixels = turned(pixels, source.camera, degrees)
                pose = None if pose is None else pose @ roll_of(degrees)
            numbers[image.stamp_ns] = image.index
            name = f"frame-{image.index:06d}"
            if not cv2.imwrite(str(out / f"{name}.color.png"), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
                raise SystemExit(f"{out}: can't write images there")
            if pose is not None:
                np.savetxt(out / f"{name}.pose.txt", pose, fmt="%.9e")
            count += 1
    if reference is not None:
        write_tum(out / "reference.tum", kidnapped(reference, numbers, dark, degrees))
    return count


def kidnapped(
    reference: Trajectory, numbers: dict[int, int], dark: tuple[int, int], degrees: float
) -> Trajectory:
    """The reference's poses of those images (``numbers`` by stamp) that show something, turned alike."""
    rows = []
    for stamp, number in numbers.items():
        pose = pose_of_image(reference, stamp)
        if pose is not None and not dark[0] <= number < dark[1]:
            rows.append((at_rate(number, RATE_HZ), pose @ roll_of(degrees) if number >= dark[1] else pose))
    return Trajectory.of(rows)


def describe(camera: Camera, path: Path) -> None:
    """The camera file for `--camera`."""
    path.write_text(
        f"model: {camera.model}\nwidth: {camera.width}\nheight: {camera.height}\n"
        f"fx: {camera.fx}\nfy: {camera.fy}\ncx: {camera.cx}\ncy: {camera.cy}\n"
        + ("" if camera.readout_ms is None else f"readout_ms: {camera.readout_ms}\n")
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="A recording with a blind stretch and a turned re-entry.")
    parser.add_argument("folder", help="recording to take")
    parser.add_argument("out", type=Path, help="folder to write")
    parser.add_argument("--dark", nargs=2, type=int, default=(300, 600), metavar=("FROM", "TO"))
    parser.add_argument("--roll", type=float, default=20.0, help="degrees (default 20)")
    parser.add_argument("--frames", type=int, default=10**9, help="stop after so many")
    parser.add_argument("--poses", type=Path, metavar="FILE.tum", help="a reference to turn too")
    given = parser.parse_args()
    try:
        count = write(given.folder, given.out, tuple(given.dark), given.roll, given.frames, given.poses)
    except (PrismError, OSError) as error:
        sys.exit(in_words(error))
    print(f"{count} images in {given.out}")


if __name__ == "__main__":
    main()
