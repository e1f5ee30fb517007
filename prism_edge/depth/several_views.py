"""A network of several pictures and their poses at once, for work after the run (paper, section 3.6).

What `tools/export_da3 --views N` makes (docs/EXPORT.md): the poses are its condition, its attention goes
across the pictures, and so its depths agree with each other.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.config import DepthConfig
from prism_edge.depth.cards import card_of
from prism_edge.depth.contract import INVERSE_RELATIVE
from prism_edge.depth.data_watch import DataWatch
from prism_edge.depth.fingerprint import fingerprint
from prism_edge.depth.placement import Placement, place, tensor
from prism_edge.depth.prediction import Prediction, checked, in_its_range, no_confidence, no_descriptor
from prism_edge.depth.providers import Started, native_line, start, with_own_engines
from prism_edge.depth.registry import File
from prism_edge.depth.vetting import vet
from prism_edge.errors import ModelError
from prism_edge.geometry.alignment import DegenerateAlignment, align
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.poses import Array, inverse

LEAST_UNIT = 0.1  # m: views that are nearer together count as so far apart
POSES, MATRICES, PREDICTED = "extrinsics", "intrinsics", "predicted_extrinsics"  # of the exported file


def unit_of(centres: Array) -> float:
    """The distance that is 1 in what the network is given, of camera centres (n, 3) from the first view's.

    The median, of two in the middle the lower one, as PyTorch's is, by which the network has learned.
    """
    distances = np.sort(np.linalg.norm(centres, axis=1))
    return max(float(distances[(len(distances) - 1) // 2]), LEAST_UNIT)


class SeveralViewsNetwork:
    """A loaded and verified network of ``views`` pictures; other names as of OnnxNetwork."""

    def __init__(self, path: Path, config: DepthConfig, pinned: tuple[File, ...] = ()) -> None:
        """Raises ModelError where the file is no such network, or is not what its card says."""
        vetted = vet(path, pinned[0].sha256 if pinned else "")
        self._data = DataWatch(vetted.data)  # before they are hashed and loaded
        self.card = card_of(path, vetted, pinned)
        self.views, self.name, self.dsug = self.card.views, self.card.name, self.card.dsug
        self._path = path
        if self.card.depth_kind == INVERSE_RELATIVE or self.card.sky_output:
            raise ModelError(f"{path.name}: networks of several views are of depth, without sky")
        engines = with_own_engines(config, fingerprint(self.card, vetted))
        self._session: Any = None
        self._image = self.card.input_name or "image"
        self._outputs = [self.card.depth_output or "depth", PREDICTED]
        if self.card.confidence_output:
            self._outputs.append(self.card.confidence_output)
        start(vetted, engines, self._first_image)

    def _first_image(self, started: Started) -> str:
        """Takes the session for its own and asks it once; why that fails, empty where it does not.

        Raises ModelError where inputs and outputs are not those of such a network.
        """
        session, self.provider = started.session, started.provider
        inputs = {item.name: item.shape for item in session.get_inputs()}
        size = (self.card.input_height, self.card.input_width)
        wanted = {self._image: (3, *size), POSES: (4, 4), MATRICES: (3, 3)}
        if inputs != {name: [self.views, *shape] for name, shape in wanted.items()}:
            takes = ", ".join(f"{name} {shape}" for name, shape in inputs.items())
            needs = ", ".join(f"{name} {[self.views, *shape]}" for name, shape in wanted.items())
            needs = f"a network of {self.views} views takes {needs}"
            raise ModelError(f"{self._path.name}: takes {takes}; {needs}")
        lacking = set(self._outputs) - {item.name for item in session.get_outputs()}
        if lacking:
            raise ModelError(f"{self._path.name}: has no output {', '.join(sorted(lacking))}")
        any_feed = {name: np.zeros((self.views, *shape), np.float32) for name, shape in wanted.items()}
        for name in (POSES, MATRICES):
            any_feed[name][:] = np.eye(any_feed[name].shape[1])
        try:
            session.run(self._outputs, any_feed)
        except Exception as error:  # whatever a foreign graph makes onnxruntime raise
            return f"the first inference failed ({native_line(error)})"
        self._session = session
        return ""

    def infer(
        self, pictures: Sequence[NDArray[np.uint8]], cameras: Sequence[Camera], world_from_camera: Array
    ) -> list[Prediction]:
        """Depth in the poses' unit of ``views`` RGB pictures (height, width, 3), each with camera and pose.

        The poses (views, 4, 4) are given relative to the first, their median distance from it being 1 (the
        first's own 0 among them). What the network says is in the unit of the cameras that it predicts
        itself, which are laid over the given ones; where those are all in one place, in the unit of what it
        was given.
        Raises ModelError where pictures are not of their cameras, the network fails, or weights beside its
        file were overwritten since it was loaded.
        """
        self._data.check()
        for rgb, camera in zip(pictures, cameras, strict=True):
            if rgb.shape != (camera.height, camera.width, 3):
                raise ModelError(f"image {rgb.shape} is not of its {camera.width}x{camera.height} camera")
        if len(pictures) != self.views:
            raise ModelError(f"{self.name} takes {self.views} pictures, not {len(pictures)}")
        placements = [place(self.card, camera.width, camera.height) for camera in cameras]
        relative = inverse(world_from_camera) @ world_from_camera[0]
        centres = inverse(relative)[:, :3, 3]
        unit = unit_of(centres)
        relative[:, :3, 3] /= unit
        started = time.perf_counter()
        feed = {
            self._image: np.concatenate(
                [tensor(rgb, self.card, p) for rgb, p in zip(pictures, placements, strict=True)]
            ),
            POSES: relative.astype(np.float32),
            MATRICES: np.array([_matrix(c, p) for c, p in zip(cameras, placements, strict=True)]),
        }
        try:
            depths, predicted, *rest = self._session.run(self._outputs, feed)
        except Exception as error:  # whatever a foreign graph makes onnxruntime raise
            raise ModelError(f"{self._path.name}: an inference failed ({native_line(error)})") from None
        took_ms = 1e3 * (time.perf_counter() - started) / self.views
        planes = self._planes(depths, "depth")
        confidences = [no_confidence()] * self.views
        if rest:
            kind = self.card.confidence_kind
            confidences = [in_its_range(plane, kind) for plane in self._planes(rest[0], "confidence")]
            if confidences[0].shape != planes[0].shape:
                sizes = f"confidence is {confidences[0].shape}, depth {planes[0].shape}"
                raise ModelError(f"{self._path.name}: {sizes}; they must be of one size")
        metres = self._metres(predicted, centres, unit)
        return [
            checked(
                Prediction(
                    depth * np.float32(metres),
                    placement.image_to_depth(depth.shape[1], depth.shape[0]),
                    confidence,
                    no_descriptor(),
                    took_ms,
                )
            )
            for depth, confidence, placement in zip(planes, confidences, placements, strict=True)
        ]

    def _planes(self, values: NDArray[Any], role: str) -> list[NDArray[np.float32]]:
        shape = values.shape
        if values.ndim != 3 or shape[0] != self.views or min(shape) < 2:
            raise ModelError(f"{self._path.name}: {role} has shape {list(shape)}, not (views, h, w)")
        return list(np.asarray(values, np.float32))

    def _metres(self, predicted: NDArray[Any], centres: Array, unit: float) -> float:
        """By how much depths are to be multiplied; ``centres`` (views, 3) are the given ones."""
        if predicted.shape[:1] != (self.views,) or predicted.shape[1:] not in ((3, 4), (4, 4)):
            raise ModelError(f"{self._path.name}: output {PREDICTED!r} has shape {list(predicted.shape)}")
        poses = np.tile(np.eye(4), (self.views, 1, 1))
        poses[:, :3] = predicted[:, :3]
        try:
            scale = align(inverse(poses)[:, :3, 3], centres, with_scale=True).scale
        except DegenerateAlignment:
            scale = unit
        return scale if np.isfinite(scale) and scale > 0 else unit


def _matrix(camera: Camera, placement: Placement) -> NDArray[np.float32]:
    """Camera matrix (3, 3) in pixels of the network's input."""
    fx, fy, cx, cy = placement.to_input(camera)
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]], np.float32)
