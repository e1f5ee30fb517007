"""A recording played otherwise: backwards, mirrored, thinned, there and back (other sequences for free).

    python tools/make_variant.py FOLDER OUT [--backwards] [--mirrored] [--every N] [--ways N] [--bonnet]
        [--light SHARE] [--middle SHARE] [--first N] [--count N] [--poses TUM] [--camera FILE]

FOLDER is any folder of images that `prism-edge run` plays. OUT becomes a folder of the TUM RGB-D layout:
images, rgb.txt and, where FOLDER has true poses, groundtruth.txt with them as this camera would have moved;
camera.yaml describes it (`--camera`). Backwards the first stamp and the last change places, and so does all
between; images left out leave their time free. With several ways it turns back at each end, so that the
camera is in a known place from the second way on. A mirrored image is that of a mirrored world: M T M for a
pose T, M = diag(-1, 1, 1). With --bonnet the lowest fifth of each image is the robot itself, full of corners
and always the same; with --light there is so much of the light, and the noise that goes with it, Poisson's, a
grey level a photon. --middle keeps so much of the width and of the height, about the image's middle: a camera
of a narrow view. --first and --count take a piece: so many images from number N on. --poses is another
reference to be carried along: OUT/reference.tum.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.config import SourceConfig
from prism_edge.errors import PrismError, in_words
from prism_edge.evaluation.trajectory import Trajectory, read_tum, write_tum
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array
from prism_edge.sources import open_source
from prism_edge.sources.base import Image
from prism_edge.sources.stamps import write_seconds
from tools.distractors.recording import empty
from tools.little_light import dimmed
from tools.make_kidnapping import describe
from tools.true_poses import own_truth, pose_of_image

BONNET_SHARE, BLOTCH = 5, 8  # one part in so many of the rows; pixels
MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


@dataclass(frozen=True)
class Variant:
    """How a recording is played."""

    backwards: bool = False
    mirrored: bool = False
    every: int = 1
    ways: int = 1
    bonnet: bool = False
    light: float = 1.0
    middle: float = 1.0
    first: int = 0
    count: int = 0  # 0: all

    def takes(self, index: int) -> bool:
        """Whether it has image ``index`` of the recording."""
        into = index - self.first
        return into >= 0 and into % self.every == 0 and (self.count == 0 or into < self.count)

    def stamps(self, stamp_ns: int, first_ns: int, last_ns: int) -> list[int]:
        """When an image comes now: once on each way, and once where one way becomes the next."""
        there, back = stamp_ns - first_ns, last_ns - stamp_ns
        into = [back if (way % 2 == 1) != self.backwards else there for way in range(self.ways)]
        length = last_ns - first_ns
        return [first_ns + way * length + ns for way, ns in enumerate(into) if way == 0 or ns > 0]

    def pose(self, world_from_camera: Array) -> Array:
        """Where this camera is then, (4, 4)."""
        return MIRROR @ world_from_camera @ MIRROR if self.mirrored else world_from_camera

    def image(self, taken: NDArray[np.uint8], index: int) -> NDArray[np.uint8]:
        """What it takes, of image ``index`` (h, w) or (h, w, 3)."""
        left, top, width, height = self._kept(taken.shape[1], taken.shape[0])
        pixels = taken[top : top + height, left : left + width]
        pixels = (pixels[:, ::-1] if self.mirrored else pixels).copy()
        if self.bonnet:
            pixels[-(len(pixels) // BONNET_SHARE) :] = bonnet(pixels)
        return dimmed(pixels, self.light, index)

    def camera(self, taken: Camera) -> Camera:
        """The camera that takes these images; time that goes both ways leaves no order of its rows."""
        left, top, width, height = self._kept(taken.width, taken.height)
        cx, cy = taken.cx - left, taken.cy - top
        said_ms = 0.0 if self.ways > 1 else taken.readout_ms
        if said_ms is not None:
            said_ms *= (-1.0 if self.backwards else 1.0) * height / taken.height
        cx = width - 1.0 - cx if self.mirrored else cx
        return replace(taken, width=width, height=height, cx=cx, cy=cy, readout_ms=said_ms)

    def _kept(self, width: int, height: int) -> tuple[int, int, int, int]:
        """Left, top, width and height of what is kept of an image."""
        kept = [max(round(self.middle * side), 1) for side in (width, height)]
        return (width - kept[0]) // 2, (height - kept[1]) // 2, kept[0], kept[1]


def bonnet(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The robot's own part of an image like ``pixels``: soft blotches of all colours, always the same."""
    height, width = len(pixels) // BONNET_SHARE, pixels.shape[1]
    few = (max(height // BLOTCH, 2), max(width // BLOTCH, 2), *pixels.shape[2:])
    blotches = np.random.default_rng(0).integers(0, 256, few, dtype=np.uint8)
    return np.asarray(cv2.resize(blotches, (width, height), interpolation=cv2.INTER_CUBIC), np.uint8)


def write(folder: str, out: Path, variant: Variant, poses: Path | None = None, camera: str = "") -> int:
    """Writes the recording; returns how many images it has. Raises PrismError for unusable folders."""
    if not 0.0 < variant.light <= 1.0:
        raise SystemExit("--light: a share of the light, above 0, 1 at most")
    if not 0.0 < variant.middle <= 1.0:
        raise SystemExit("--middle: a share of the image's sides, above 0, 1 at most")
    if variant.every < 1 or variant.ways < 1:
        raise SystemExit("--every, --ways: a number, 1 or more")
    if variant.first < 0 or variant.count < 0:
        raise SystemExit("--first, --count: a number, 0 or more")
    empty(out)
    reference = None if poses is None else read_tum(poses)
    truth = own_truth(folder)
    taken: list[tuple[int, str]] = []  # stamp, file
    source = open_source(SourceConfig(uri=folder, camera=camera))
    with source:
        if not source.camera.is_ideal:
            raise SystemExit("the camera has distortion: its images would have to be undistorted first")
        (out / "rgb").mkdir(parents=True, exist_ok=True)
        describe(variant.camera(source.camera), out / "camera.yaml")
        while (image := source.read()) is not None:
            if not isinstance(image, Image) or not variant.takes(image.index):
                continue
            if taken and image.stamp_ns <= taken[-1][0]:  # the daemon would leave it out, too
                continue
            name, pixels = f"rgb/{image.index:06d}.png", variant.image(image.pixels, image.index)
            if not cv2.imwrite(str(out / name), pixels, [cv2.IMWRITE_PNG_COMPRESSION, 1]):
                raise SystemExit(f"{out}: can't write images there")
            taken.append((image.stamp_ns, name))
    if not taken:
        raise SystemExit(f"{folder}: no image could be read")
    first, last = taken[0][0], taken[-1][0]
    now = {old: variant.stamps(old, first, last) for old, _ in taken}
    lines = sorted((stamp, name) for old, name in taken for stamp in now[old])
    (out / "rgb.txt").write_text("".join(f"{write_seconds(ns)} {name}\n" for ns, name in lines))
    if len(truth):
        write_tum(out / "groundtruth.txt", carried(truth, now, variant))
    if reference is not None:
        write_tum(out / "reference.tum", carried(reference, now, variant))
    return len(lines)


def carried(truth: Trajectory, now: dict[int, list[int]], variant: Variant) -> Trajectory:
    """The poses of those images that are taken (``now`` by their old stamps), as they are played."""
    known = ((thens, pose_of_image(truth, old)) for old, thens in now.items())
    return Trajectory.of(
        (then, variant.pose(pose)) for thens, pose in known if pose is not None for then in thens
    )


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description="A recording played otherwise.")
    parser.add_argument("folder", help="recording to take")
    parser.add_argument("out", type=Path, help="folder to write")
    parser.add_argument("--backwards", action="store_true", help="last image first")
    parser.add_argument("--mirrored", action="store_true", help="left and right change places")
    parser.add_argument("--every", type=int, default=1, help="keep every so manieth image (default 1)")
    parser.add_argument("--ways", type=int, default=1, help="2: there and back; 3: there again")
    parser.add_argument("--bonnet", action="store_true", help="the robot itself below, never moving")
    parser.add_argument("--light", type=float, default=1.0, metavar="SHARE", help="so much of the light")
    parser.add_argument("--middle", type=float, default=1.0, metavar="SHARE", help="so much of its sides")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="begin with image N (default 0)")
    parser.add_argument("--count", type=int, default=0, metavar="N", help="of so many images (default: all)")
    parser.add_argument("--poses", type=Path, metavar="TUM", help="a reference to carry along")
    parser.add_argument("--camera", default="", metavar="FILE", help="camera file; default: the recording's")
    given = parser.parse_args()
    played = given.backwards, given.mirrored, given.every, given.ways, given.bonnet, given.light
    variant = Variant(*played, given.middle, given.first, given.count)
    try:
        count = write(given.folder, given.out, variant, given.poses, given.camera)
    except (PrismError, OSError) as error:
        sys.exit(in_words(error))
    print(f"{count} images in {given.out}")


if __name__ == "__main__":
    main()
