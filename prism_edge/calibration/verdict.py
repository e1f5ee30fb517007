"""Whether views and result are good enough, and in plain words what to do where they are not (pure)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from prism_edge.calibration.board import View
from prism_edge.calibration.solve import Calibration
from prism_edge.geometry.cameras import PINHOLE, Camera
from prism_edge.geometry.field_of_view import folded
from prism_edge.geometry.unlikely_camera import FOLDED
from prism_edge.messages import I64

LEAST_VIEWS = 10
COLUMNS, ROWS = 6, 4  # cells of the coverage
_LEAST_COVERED = 0.6
_REACH = 0.15  # of width or height, within which some corner must come to each edge
_TILTED_DEG, _LEAST_TILTED = 12.0, 2
_RMS, _RMS_WIDTH = 1.0, 1280  # pixels; larger images may have proportionally larger errors
_SIGMA = 0.005  # of the focal length
_STRETCHED = 0.01  # fx against fy


def covered(views: Sequence[View], width: int, height: int) -> I64:
    """Corners in each cell of the image (ROWS, COLUMNS)."""
    counts = np.zeros((ROWS, COLUMNS), dtype=np.int64)
    for view in views:
        column = np.clip(view.pixels[:, 0] * COLUMNS / width, 0, COLUMNS - 1).astype(int)
        row = np.clip(view.pixels[:, 1] * ROWS / height, 0, ROWS - 1).astype(int)
        np.add.at(counts, (row, column), 1)
    return counts


def of_views(views: Sequence[View], seen: int, width: int, height: int) -> list[str]:
    """What is wrong with views that differ from each other, of ``seen`` in which the board was found."""
    if len(views) < LEAST_VIEWS:
        if seen >= 2 * LEAST_VIEWS and len(views) < seen // 2:
            return [
                f"the board was seen in {seen} images, but in only {len(views)} different ways, and "
                f"{LEAST_VIEWS} are needed: move and tilt it more"
            ]
        return [f"the board was seen in only {len(views)} different ways, and {LEAST_VIEWS} are needed"]
    problems = []
    counts = covered(views, width, height)
    share = float((counts > 0).mean())
    if share < _LEAST_COVERED:
        problems.append(
            f"corners lie in only {share:.0%} of the image, and {_LEAST_COVERED:.0%} are needed: "
            "bring the board nearer and to the corners of the image"
        )
    pixels = np.concatenate([view.pixels for view in views])
    reach = {
        "left": pixels[:, 0].min() / width,
        "right": 1.0 - pixels[:, 0].max() / width,
        "upper": pixels[:, 1].min() / height,
        "lower": 1.0 - pixels[:, 1].max() / height,
    }
    far = [name for name, distance in reach.items() if distance > _REACH]
    if far:
        problems.append(f"no corner comes near the {' or '.join(far)} edge of the image")
    return problems


def of_calibration(views: Sequence[View], seen: int, result: Calibration) -> list[str]:
    """What is wrong with the views that a result rests on, or with the result."""
    used = [views[k] for k in result.used]
    problems = of_views(used, seen, result.camera.width, result.camera.height)
    if problems and len(used) < len(views):
        problems[0] += f" ({len(views) - len(used)} that miss by far are left out: hold the board still)"
    return problems + of_result(result)


def of_result(result: Calibration) -> list[str]:
    """What is wrong with the intrinsics."""
    camera, problems = result.camera, []
    tilted = (np.abs(result.tilts) > _TILTED_DEG).sum(axis=0)
    if tilted.min() < _LEAST_TILTED:
        how = "left and right" if tilted[0] <= tilted[1] else "up and down"
        problems.append(
            "the board nearly always faces the camera squarely: "
            f"tilt it {how} by 20 to 45 degrees in some views"
        )
    limit = _RMS * max(1.0, camera.width / _RMS_WIDTH)
    if result.rms > limit:
        hint = ", or the lens a fisheye (--model fisheye)" if camera.model == PINHOLE else ""
        problems.append(
            f"the corners miss by {result.rms:.2f} pixels, and {limit:.2g} are allowed: "
            f"the images are blurred, the board is not flat or not the one named{hint}"
        )
    share = folded(camera)
    if share > FOLDED:
        problems.append(
            f"the lens that was found folds over in {share:.1%} of the image, and {FOLDED:.0%} is allowed: "
            "bring the board further into its corners, or take the lens for a fisheye (--model fisheye)"
        )
    sigma = max(result.sigmas[0] / camera.fx, result.sigmas[1] / camera.fy)
    if sigma > _SIGMA:
        problems.append(
            f"the focal length is known to {sigma:.1%} only, and {_SIGMA:.1%} is needed: "
            "take more views, nearer and more tilted"
        )
    middle = np.array([camera.cx / camera.width, camera.cy / camera.height])
    if np.any(np.abs(middle - 0.5) > 0.2):
        problems.append(
            f"the optical centre comes out at ({camera.cx:.0f}, {camera.cy:.0f}), far from the middle: "
            "the image is cropped, or the views are too few"
        )
    return problems


def doubt(camera: Camera) -> str:
    """What is odd about intrinsics that may be right all the same; empty where nothing is."""
    ratio = camera.fx / camera.fy
    if abs(ratio - 1.0) <= _STRETCHED:
        return ""
    return (
        f"fx is {ratio:.3f} of fy, and nearly every camera has square pixels: measure whether the board's "
        "squares are square, as printers stretch them"
    )
