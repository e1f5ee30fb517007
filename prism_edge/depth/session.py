"""One network file in onnxruntime, held to its model card."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.config import DepthConfig
from prism_edge.depth.agreement import roles
from prism_edge.depth.cards import card_of
from prism_edge.depth.contract import FOCAL_NORMALISED, ModelCard
from prism_edge.depth.data_watch import DataWatch
from prism_edge.depth.fingerprint import fingerprint
from prism_edge.depth.inner_tensor import pool
from prism_edge.depth.placement import Placement, place, tensor
from prism_edge.depth.prediction import (
    OPEN,
    PROBABILITY,
    Prediction,
    checked,
    in_its_range,
    no_confidence,
    no_descriptor,
)
from prism_edge.depth.providers import Started, native_line, start, with_own_engines
from prism_edge.depth.registry import File
from prism_edge.depth.vetting import vet
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera

log = logging.getLogger("prism_edge.depth")

_LARGEST_DESCRIPTOR = 16_384
_SURELY_NO_PROBABILITY = 1.001  # rounding makes a little more than 1 of one
_SURELY_NOT_OPEN = 0.999
SAME_ASPECT = 0.03  # of the logarithm: maps have whole pixels
_DOUBTS = {
    PROBABILITY: "above 1, though its card says probability; is it percent, or open-ended (docs/MODELS.md)?",
    OPEN: "between 0 and 1, though its card says open; is it a probability (docs/MODELS.md)?",
}


class OnnxNetwork:
    """A loaded, verified and warmed-up network.

    ``card`` is its contract, ``provider`` the execution provider it really runs on, ``nodes`` how many
    nodes of it each provider runs, ``name`` what people read, ``identity``, ``bias_sigma`` and ``dsug`` what
    messages carry. Raises ModelError where the file is no ONNX model, has no card, or is not what its card
    says.
    """

    def __init__(self, path: Path, config: DepthConfig | None = None, pinned: tuple[File, ...] = ()) -> None:
        """``pinned`` is what the file and its external data must be; empty: anything."""
        self.path = path
        vetted = vet(path, pinned[0].sha256 if pinned else "")
        self._data = DataWatch(vetted.data)  # before they are hashed and loaded
        self.digest = vetted.sha256
        self.card: ModelCard = card_of(path, vetted, pinned)
        inner = self.card.descriptor_layer if self.card.has_inner_descriptor else ""
        self.fingerprint = fingerprint(self.card, vetted)
        self.name = self.card.name
        self.identity = f"{self.name}@{self.fingerprint}"
        self.bias_sigma = self.card.scale_bias_sigma or 0.0
        self.dsug = self.card.dsug
        self.counters: dict[str, int] = {}
        self._doubted = False
        self._sky_share = 0.0  # of the last image
        self._session: Any = None
        engines = with_own_engines(config or DepthConfig(), self.fingerprint)
        start(vetted, engines, self._first_image, inner)
        if len(self.nodes) > 1:
            self.counters["nodes_elsewhere"] = sum(self.nodes.values()) - self.nodes[self.provider]

    def _first_image(self, started: Started) -> str:
        """Takes the session for its own and warms it up; why that fails, empty where it does not."""
        self._session, self.provider, self.nodes = started.session, started.provider, started.nodes
        self._input, self._outputs = roles(self._session, self.card, self.path.name)
        why = self._warm_up()
        if why:
            self._session = None
        return why

    def infer(self, rgb: NDArray[np.uint8], camera: Camera) -> Prediction:
        """Metric depth of an image (height, width, 3) uint8 RGB that ``camera`` took.

        Metres are the output times the card's ``depth_scale``, and of a focal_normalised one times f / f0,
        f being the geometric mean of fx and fy in pixels of the network's input. A lens's distortion is left
        in the image, straight.py takes strong ones out before; f is its focal length at the centre. Raises
        ModelError where the network's kind has no metres, or where image and camera differ in size.
        """
        if not self.card.has_metres:
            raise ModelError(f"{self.name} is {self.card.depth_kind}: it has no metres of its own")
        if rgb.shape != (camera.height, camera.width, 3):
            raise ModelError(f"image {rgb.shape} is not of its camera ({camera.height}, {camera.width}, 3)")
        raw, placement = self.raw(rgb)
        factor = self.card.depth_scale
        if self.card.depth_kind == FOCAL_NORMALISED and self.card.canonical_focal_length:
            factor *= placement.focal_length(camera) / self.card.canonical_focal_length
        if factor != 1.0:
            with np.errstate(over="ignore"):  # infinite depth is none, and said to be
                raw = replace(raw, depth=raw.depth * np.float32(factor))
        answer = checked(raw)
        if not answer.valid and self._sky_share > 0.5:  # not the network, its mask did that
            by = f"{self.card.sky_output!r} at or above sky_limit {self.card.sky_limit:g}"
            answer = replace(answer, reason=f"{answer.reason}; {100 * self._sky_share:.0f} % is sky, {by}")
        return answer

    def intrinsics(self, rgb: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """(4,) fx, fy, cx, cy in pixels of the image, as the network sees them; None where it says nothing.

        Of an image (height, width, 3) uint8 RGB whose camera is not known. Raises ModelError where the
        network fails at it.
        """
        output = self.card.intrinsics_output
        if not output:
            return None
        placement = place(self.card, rgb.shape[1], rgb.shape[0])
        image = tensor(rgb, self.card, placement)
        (matrix,) = self._run_aside([output], image)
        if matrix.size != 9:
            shape = list(matrix.shape)
            raise ModelError(f"{self.name}: output {output!r} of shape {shape} is no camera matrix")
        fx, fy, cx, cy = np.asarray(matrix, np.float64).ravel()[[0, 4, 2, 5]]
        if not np.isfinite([fx, fy, cx, cy]).all() or fx <= 0 or fy <= 0:
            return None
        if why := _not_in_rows(matrix):
            raise ModelError(f"{self.name}: output {output!r} is no camera matrix: {why}")
        return placement.to_image(fx, fy, cx, cy)

    def check_offline_outputs(self, rgb: NDArray[np.uint8]) -> None:
        """Raises ModelError unless rays and intrinsics, which no keyframe asks for, are of their shapes."""
        wanted = {"rays": self.card.rays_output, "intrinsics": self.card.intrinsics_output}
        wanted = {role: output for role, output in wanted.items() if output}
        if not wanted:
            return
        image = tensor(rgb, self.card, place(self.card, rgb.shape[1], rgb.shape[0]))
        values = self._run_aside(list(wanted.values()), image)
        for (role, output), value in zip(wanted.items(), values, strict=True):
            shape = list(value.shape)
            is_right = value.size == 9 and shape[-2:] == [3, 3]
            if role == "rays":
                is_right = len(shape) == 4 and shape[0] == 1 and shape[3] == 6
            if not is_right:
                needed = "(1, h, w, 6)" if role == "rays" else "(1, 3, 3)"
                raise ModelError(
                    f"{self.path.name}: output {output!r} for {role} has shape {shape}, not {needed}"
                )
            if role == "intrinsics" and (why := _not_in_rows(value)):
                raise ModelError(f"{self.path.name}: output {output!r} is no camera matrix: {why}")

    def _run_aside(self, outputs: list[str], image: NDArray[np.float32]) -> list[NDArray[Any]]:
        """Outputs that no keyframe asks for. ModelError where onnxruntime fails, and as ``raw`` has it."""
        self._data.check()
        with failing_in_a_line(self.path.name):
            return list(self._session.run(outputs, {self._input: image}))

    def raw(self, rgb: NDArray[np.uint8]) -> tuple[Prediction, Placement]:
        """The network's unchecked answer in its own unit, without sky, and where the image lay in it.

        Raises ModelError where weights beside the file were overwritten since it was loaded.
        """
        self._data.check()
        started = time.perf_counter()
        placement = place(self.card, rgb.shape[1], rgb.shape[0])
        image = tensor(rgb, self.card, placement)
        values = self._session.run(list(self._outputs.values()), {self._input: image})
        answer = dict(zip(self._outputs, values, strict=True))
        depth = _plane(answer["depth"], self._outputs["depth"])
        if "sky" in answer:
            # Inverse depth 0 is as good as any: what isn't there must be told apart from it.
            nothing = np.float32(0 if self.card.has_metres else np.nan)
            sky = _plane(answer["sky"], self._outputs["sky"])
            if sky.shape != depth.shape:
                raise ModelError(f"sky is {sky.shape}, depth {depth.shape}; they must be of one size")
            below = sky < self.card.sky_limit
            depth, self._sky_share = np.where(below, depth, nothing), 1.0 - float(below.mean())
        descriptor = no_descriptor()
        if self.card.has_inner_descriptor:
            descriptor = pool(answer["descriptor"], self.card.descriptor_pooling)
            if descriptor.size > _LARGEST_DESCRIPTOR:
                layer = f"descriptor_layer {self.card.descriptor_layer!r}"
                raise ModelError(f"{layer} gives {descriptor.size} numbers, more than {_LARGEST_DESCRIPTOR}")
        elif "descriptor" in answer:
            descriptor = _descriptor(answer["descriptor"], self._outputs["descriptor"])
        confidence = no_confidence()
        if "confidence" in answer:
            confidence = _plane(answer["confidence"], self._outputs["confidence"])
            self._doubt(confidence)
            confidence = in_its_range(confidence, self.card.confidence_kind)
        prediction = Prediction(
            depth=depth,
            image_to_depth=placement.image_to_depth(depth.shape[1], depth.shape[0]),
            confidence=confidence,
            descriptor=descriptor,
            inference_ms=1e3 * (time.perf_counter() - started),
        )
        return prediction, placement

    def _doubt(self, confidence: NDArray[np.float32]) -> None:
        """Says once where confidence mostly is of another kind than the card says, and would be clipped."""
        kind = self.card.confidence_kind
        if self._doubted or kind not in _DOUBTS:
            return
        above = confidence > _SURELY_NO_PROBABILITY
        below = (confidence > 0) & (confidence < _SURELY_NOT_OPEN)
        share = float(np.mean(above if kind == PROBABILITY else below))
        if share > 0.5:
            self._doubted = True
            log.warning("%s: %.0f %% of its confidence is %s", self.name, 100 * share, _DOUBTS[kind])

    def _warm_up(self) -> str:
        """One inference, so that the first keyframe does not pay for it and output shapes are known.

        Why onnxruntime fails at it, empty where it does not.
        """
        ramp = np.linspace(0, 255, self.card.input_width, dtype=np.uint8)
        image = np.broadcast_to(ramp[None, :, None], (self.card.input_height, self.card.input_width, 3))
        try:
            answer, _ = self.raw(np.ascontiguousarray(image))
        except ModelError as error:
            raise ModelError(f"{self.path.name}: {error}") from None
        except Exception as error:  # whatever a foreign graph makes onnxruntime raise
            return f"the first inference failed ({native_line(error)})"
        if answer.confidence.size and answer.confidence.shape != answer.depth.shape:
            raise ModelError(
                f"{self.path.name}: confidence is {answer.confidence.shape}, depth {answer.depth.shape}; "
                "they must be of one size"
            )
        height, width = answer.depth.shape
        if are_swapped(width / height, self.card.input_width / self.card.input_height):
            raise ModelError(
                f"{self.path.name}: its depth is {width}x{height}, of an input of "
                f"{self.card.input_width}x{self.card.input_height}: its axes are swapped "
                "(docs/MODELS.md#exports-of-another-shape)"
            )
        return ""


def _not_in_rows(matrix: NDArray[Any]) -> str:
    """Why nine numbers with focal lengths are no camera matrix, row by row; empty where they may be one."""
    numbers = np.asarray(matrix, np.float64).ravel()
    last = numbers[6:]
    if not np.isfinite(numbers).all() or min(numbers[[0, 4]]) <= 0 or np.allclose(last, (0, 0, 1), atol=1e-3):
        return ""
    said = " ".join(f"{value:g}" for value in last)
    return f"its last row is {said}, not 0 0 1 (columns first? docs/MODELS.md#exports-of-another-shape)"


@contextmanager
def failing_in_a_line(name: str) -> Iterator[None]:
    """Makes a ModelError of whatever an inference raises, where nobody asks whose fault it is."""
    try:
        yield
    except ModelError:
        raise
    except Exception as error:  # whatever a foreign graph makes onnxruntime raise
        raise ModelError(f"{name}: an inference failed ({native_line(error)})") from None


def are_swapped(aspect: float, of_input: float) -> bool:
    """Whether a map's width by its height is the input's height by its width, and that not a square."""
    return abs(math.log(of_input)) > 2 * SAME_ASPECT and abs(math.log(aspect * of_input)) < SAME_ASPECT


def _plane(values: NDArray[Any], name: str) -> NDArray[np.float32]:
    """The one plane (h, w) in an output of shape (1, 1, h, w), (1, h, w) or (h, w)."""
    if values.ndim < 2 or any(extent != 1 for extent in values.shape[:-2]) or min(values.shape[-2:]) < 2:
        raise ModelError(f"output {name!r} of shape {list(values.shape)} is no map of one value a pixel")
    return np.asarray(values.reshape(values.shape[-2:]), dtype=np.float32)


def _descriptor(values: NDArray[Any], name: str) -> NDArray[np.float32]:
    """The one vector (n,) in an output of shape (1, n), (n,) or with more extents of 1."""
    if values.size > _LARGEST_DESCRIPTOR or values.size != max(values.shape, default=0):
        raise ModelError(f"output {name!r} of shape {list(values.shape)} is no descriptor of one vector")
    return np.asarray(values, dtype=np.float32).ravel()
