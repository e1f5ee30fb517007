"""What makes one doubt a camera's intrinsics: possible, but seldom those of the images beside them (pure)."""

from __future__ import annotations

from prism_edge.geometry.cameras import FISHEYE, Camera
from prism_edge.geometry.field_of_view import folded

OFF_CENTRE = 0.2  # of the image's size, from its middle
STRETCHED = 0.05  # fx against fy
FOLDED = 0.01  # of the image


def doubts(camera: Camera) -> list[str]:
    """One line for each thing; empty where nothing is strange."""
    found = []
    for key, value, size in (("cx", camera.cx, camera.width), ("cy", camera.cy, camera.height)):
        if abs(value - (size - 1) / 2) > OFF_CENTRE * size:
            side, whose = "wide" if key == "cx" else "high", "a larger" if value > size / 2 else "another"
            found.append(f"{key} {value:g} of a {size}-{side} image: are these intrinsics of {whose} image?")
    if abs(camera.fx / camera.fy - 1.0) > STRETCHED:
        found.append(
            f"fx {camera.fx:g} and fy {camera.fy:g} differ by {100 * abs(camera.fx / camera.fy - 1):.0f} %: "
            "are these intrinsics of an image of another shape?"
        )
    if (share := folded(camera)) > FOLDED:
        fisheye = "" if camera.model == FISHEYE else "is it a fisheye (model: fisheye), or "
        found.append(
            f"its lens folds over in {share:.1%} of the image, where nothing is tracked: "
            f"{fisheye}is the distortion another lens's?"
        )
    return found
