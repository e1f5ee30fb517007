"""Tiny datasets written to a folder, in every layout."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

U8 = NDArray[np.uint8]
CAMERA = "width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\n"
CAMERA_VGA = "width: 640\nheight: 480\nfx: 600\nfy: 600\ncx: 319.5\ncy: 239.5\n"


def picture(seed: int, width: int = 64, height: int = 48, colour: bool = True) -> U8:
    """A smooth coloured image that differs from that of any other seed."""
    rng = np.random.default_rng(seed)
    coarse = rng.integers(0, 256, (6, 8, 3), dtype=np.uint8)
    image = cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
    return image if colour else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def write_image(path: Path, image: U8) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)
    return path


def write_tum(folder: Path, count: int = 5, suffix: str = "png", width: int = 64, height: int = 48) -> Path:
    """rgb.txt, groundtruth.txt and a camera file; stamps of a real date, 0.1 s apart."""
    lines, truth = ["# colour images", "# timestamp filename"], ["# timestamp tx ty tz qx qy qz qw"]
    for i in range(count):
        stamp = f"1305031102.{175304 + 100_000 * i:06d}" if i < 8 else f"{1305031103 + i}.175304"
        write_image(folder / "rgb" / f"{stamp}.{suffix}", picture(i, width, height))
        lines.append(f"{stamp} rgb/{stamp}.{suffix}")
        truth.append(f"{stamp} {0.1 * i:.3f} 0 0 0 0 0 1")
    (folder / "rgb.txt").write_text("\n".join(lines) + "\n")
    (folder / "groundtruth.txt").write_text("\n".join(truth) + "\n")
    (folder / "camera.yaml").write_text(CAMERA)
    return folder


def write_seven_scenes(
    folder: Path, count: int = 4, suffix: str = "png", size: tuple[int, int] = (640, 480)
) -> Path:
    for i in range(count):
        write_image(folder / f"frame-{i:06d}.color.{suffix}", picture(i, *size))
        rows = np.eye(4)
        rows[0, 3] = 0.1 * i
        (folder / f"frame-{i:06d}.pose.txt").write_text(
            "\n".join("\t".join(f"{value:.7e}" for value in row) for row in rows)
        )
    return folder


def write_kitti(folder: Path, count: int = 3, cameras: tuple[str, ...] = ("image_0",)) -> Path:
    for name in cameras:
        for i in range(count):
            colour = name == "image_2"
            write_image(folder / name / f"{i:06d}.png", picture(i, 63, 47, colour))
    rows = ["P0: 70 0 31 0 0 71 23 0 0 0 1 0", "P1: 70 0 31 -9 0 71 23 0 0 0 1 0"]
    rows += ["P2: 72 0 30 4 0 73 22 0 0 0 1 0", "P3: 72 0 30 -9 0 73 22 0 0 0 1 0"]
    (folder / "calib.txt").write_text("\n".join(rows) + "\n")
    (folder / "times.txt").write_text("\n".join(f"{0.1 * i:.6e}" for i in range(count)) + "\n")
    (folder / "poses.txt").write_text("\n".join(f"1 0 0 0 0 1 0 0 0 0 1 {i}" for i in range(count)) + "\n")
    return folder


def write_images(folder: Path, count: int = 12) -> Path:
    """1.png, 2.png, ... 12.png: names whose alphabetical order is wrong."""
    for i in range(1, count + 1):
        write_image(folder / f"{i}.png", picture(i))
    (folder / "camera.yaml").write_text(CAMERA)
    return folder


def write_video(path: Path, count: int = 10, rate_hz: float = 20.0, kind: str = "MJPG") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*kind), rate_hz, (64, 48))
    assert writer.isOpened()
    for i in range(count):
        writer.write(picture(i))
    writer.release()
    (path.parent / "camera.yaml").write_text(CAMERA)
    return path


def truncate(path: Path, keep: float = 0.6) -> None:
    """Cuts a file short, as a full disk or a crash does."""
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * keep)])
