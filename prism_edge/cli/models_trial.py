"""What a network says of one picture, for `prism-edge models info` and `verify`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from prism_edge.depth.contract import INVERSE_RELATIVE, RELATIVE
from prism_edge.depth.plausible import range_of
from prism_edge.depth.prediction import Prediction, checked
from prism_edge.depth.session import OnnxNetwork, failing_in_a_line
from prism_edge.depth.several_views import SeveralViewsNetwork
from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import Camera

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)  # an ordinary one: what a focal-normalised one needs
IN_PIXELS = "are its intrinsics in pixels of its input (docs/MODELS.md)?"

STEP = 0.2  # m between cameras where several pictures are asked for


@dataclass(frozen=True)
class Trial:
    """Whether an answer is of use, what it was in words, and a warning where it is doubtful (or nothing)."""

    usable: bool
    words: str
    warning: str = ""


def tried(network: OnnxNetwork | SeveralViewsNetwork) -> Trial:
    """The answer to :func:`picture`.

    Raises ModelError where an output is not of the shape it should be, or onnxruntime fails.
    """
    rgb = picture()
    if isinstance(network, SeveralViewsNetwork):
        return _tried_together(network, rgb)
    network.check_offline_outputs(rgb)
    with failing_in_a_line(network.name):
        if network.card.has_metres:
            answer = network.infer(rgb, CAMERA)
        else:
            answer = checked(_above_zero(network.raw(rgb)[0], network.card.depth_kind))
    if not answer.valid:
        return Trial(False, f"its answer is of no use: {answer.reason}")
    metres = range_of(answer.depth) if network.card.has_metres else None
    doubt = (metres.doubt if metres else "") or _doubt_of_intrinsics(network, rgb)
    return Trial(True, str(metres or "no metres of its own"), doubt)


def _doubt_of_intrinsics(network: OnnxNetwork, rgb: NDArray[np.uint8]) -> str:
    """What is wrong with the camera that it sees, in words; empty for nothing, or where it sees none."""
    if not network.card.intrinsics_output:
        return ""
    said = network.intrinsics(rgb)
    if said is None:
        return "of a test picture it sees no camera"
    try:
        Camera(rgb.shape[1], rgb.shape[0], *said)
    except ConfigError as error:
        return f"of a test picture it sees a camera that can't be ({error}): {IN_PIXELS}"
    return ""


def _tried_together(network: SeveralViewsNetwork, rgb: NDArray[np.uint8]) -> Trial:
    """The answers to one picture as if several cameras beside each other had taken it."""
    poses = np.tile(np.eye(4), (network.views, 1, 1))
    poses[:, 0, 3] = STEP * np.arange(network.views)
    answers = network.infer([rgb] * network.views, [CAMERA] * network.views, poses)
    useless = next((answer for answer in answers if not answer.valid), None)
    if useless is not None:
        return Trial(False, f"its answer is of no use: {useless.reason}")
    return Trial(True, f"{network.views} pictures at once, for `prism-edge reconstruct` alone")


def picture() -> NDArray[np.uint8]:
    """A view (480, 640, 3) with some texture: boxes before a wall, on a floor that comes nearer."""
    rng = np.random.default_rng(0)
    view = np.full((480, 640, 3), 150, np.uint8)
    view[240:] = np.linspace(70, 130, 240, dtype=np.uint8)[:, None, None]
    for _ in range(24):
        x, y = rng.integers(0, 560), rng.integers(80, 380)
        width, height = rng.integers(30, 160, 2)
        view[y : y + height, x : x + width] = rng.integers(20, 235, 3)
    return np.clip(view + rng.normal(0.0, 8.0, view.shape), 0, 255).astype(np.uint8)


def _above_zero(raw: Prediction, kind: str) -> Prediction:
    """What is known up to a shift may be negative; 0 is no relative depth, but any inverse depth."""
    said = np.isfinite(raw.depth) & ((raw.depth != 0) | (kind == INVERSE_RELATIVE))
    if not said.any():
        return raw
    least = raw.depth[said].min()
    if kind == RELATIVE and least > 0:
        return raw
    return replace(raw, depth=np.where(said, raw.depth - least, raw.depth))
