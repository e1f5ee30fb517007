"""One network file in onnxruntime, held to its model card."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from numpy.typing import NDArray

from prism_edge.depth.cards import card_of
from prism_edge.depth.contract import FOCAL_NORMALISED, ModelCard
from prism_edge.depth.inner_tensor import pool, with_output
from prism_edge.depth.placement import Placement, place, tensor
from prism_edge.depth.prediction import Prediction, checked, no_confidence, no_descriptor
from prism_edge.depth.registry import sha256_of
from prism_edge.errors import ModelError
from prism_edge.geometry.cameras import Camera

log = logging.getLogger("prism_edge.depth")

_LARGEST_DESCRIPTOR = 16_384
_QUIET = 3  # onnxruntime's severity "error": files in use carry hundreds of harmless warnings


class OnnxNetwork:
    """A loaded, verified and warmed-up network.

    ``card`` is its contract, ``provider`` the execution provider it really runs on, ``name`` and
    ``bias_sigma`` what messages carry. Raises ModelError where the file is no ONNX model, has no card,
    or is not what its card says.
    """

    def __init__(
        self,
        path: Path,
        providers: Sequence[str] = ("CPUExecutionProvider",),
        threads: int = 1,
        pinned: str = "",
    ) -> None:
        """``pinned`` is the SHA-256 that the file must have; empty: any."""
        self.path = path
        self.digest = sha256_of(path)
        if pinned and self.digest != pinned:
            raise ModelError(
                f"{path}: its SHA-256 is {self.digest[:12]}..., not the registered {pinned[:12]}..."
            )
        self._session = _load(path, providers, threads)
        self.provider: str = self._session.get_providers()[0]
        props = self._session.get_modelmeta().custom_metadata_map
        self.card: ModelCard = card_of(path, self.digest, props)
        if self.card.has_inner_descriptor:
            del self._session  # not both in memory
            self._session = _load_with_inner(path, providers, threads, self.card.descriptor_layer)
        self.name = self.card.name
        self.bias_sigma = self.card.scale_bias_sigma or 0.0
        self.dsug = self.card.dsug
        self.counters: dict[str, int] = {}
        self._input, self._outputs = _verify(self._session, self.card, path.name)
        self._warm_up()

    def infer(self, rgb: NDArray[np.uint8], camera: Camera) -> Prediction:
        """Metric depth of an image (height, width, 3) uint8 RGB that ``camera`` took.

        Metres are the output itself (metric) or output * f / f0 (focal_normalised), f being the
        geometric mean of fx and fy in pixels of the network's input. A lens's distortion is left in the
        image, and f is then its focal length at the centre. Raises ModelError where the network's kind
        has no metres, or where image and camera differ in size.
        """
        if not self.card.has_metres:
            raise ModelError(f"{self.name} is {self.card.depth_kind}: it has no metres of its own")
        if rgb.shape != (camera.height, camera.width, 3):
            raise ModelError(f"image {rgb.shape} is not of its camera ({camera.height}, {camera.width}, 3)")
        raw, placement = self.raw(rgb)
        if self.card.depth_kind == FOCAL_NORMALISED and self.card.canonical_focal_length:
            factor = placement.focal_length(camera) / self.card.canonical_focal_length
            raw = _with_depth(raw, raw.depth * np.float32(factor))
        return checked(raw)

    def intrinsics(self, rgb: NDArray[np.uint8]) -> NDArray[np.float64] | None:
        """(4,) fx, fy, cx, cy in pixels of the image, as the network sees them; None where it says nothing.

        Of an image (height, width, 3) uint8 RGB whose camera is not known.
        """
        output = self.card.intrinsics_output
        if not output:
            return None
        placement = place(self.card, rgb.shape[1], rgb.shape[0])
        (matrix,) = self._session.run([output], {self._input: tensor(rgb, self.card, placement)})
        if matrix.size != 9:
            shape = list(matrix.shape)
            raise ModelError(f"{self.name}: output {output!r} of shape {shape} is no camera matrix")
        fx, fy, cx, cy = np.asarray(matrix, np.float64).ravel()[[0, 4, 2, 5]]
        if not np.isfinite([fx, fy, cx, cy]).all() or fx <= 0 or fy <= 0:
            return None
        return placement.to_image(fx, fy, cx, cy)

    def raw(self, rgb: NDArray[np.uint8]) -> tuple[Prediction, Placement]:
        """The network's unchecked answer in its own unit, sky set to 0, and where the image lay in it."""
        started = time.perf_counter()
        placement = place(self.card, rgb.shape[1], rgb.shape[0])
        image = tensor(rgb, self.card, placement)
        values = self._session.run(list(self._outputs.values()), {self._input: image})
        answer = dict(zip(self._outputs, values, strict=True))
        depth = _plane(answer["depth"])
        if "sky" in answer:
            depth = np.where(_plane(answer["sky"]) < self.card.sky_limit, depth, np.float32(0))
        descriptor = no_descriptor()
        if self.card.has_inner_descriptor:
            descriptor = pool(answer["descriptor"], self.card.descriptor_pooling)
        elif "descriptor" in answer:
            descriptor = _descriptor(answer["descriptor"])
        prediction = Prediction(
            depth=depth,
            image_to_depth=placement.image_to_depth(depth.shape[1], depth.shape[0]),
            confidence=_plane(answer["confidence"]) if "confidence" in answer else no_confidence(),
            descriptor=descriptor,
            inference_ms=1e3 * (time.perf_counter() - started),
        )
        return prediction, placement

    def _warm_up(self) -> None:
        """One inference, so that the first keyframe does not pay for it and output shapes are known."""
        ramp = np.linspace(0, 255, self.card.input_width, dtype=np.uint8)
        image = np.broadcast_to(ramp[None, :, None], (self.card.input_height, self.card.input_width, 3))
        try:
            answer, _ = self.raw(np.ascontiguousarray(image))
        except ModelError as error:
            raise ModelError(f"{self.path.name}: {error}") from None
        except Exception as error:  # whatever a foreign graph makes onnxruntime raise
            raise ModelError(f"{self.path.name}: the first inference failed ({_first_line(error)})") from None
        if answer.confidence.size and answer.confidence.shape != answer.depth.shape:
            raise ModelError(
                f"{self.path.name}: confidence is {answer.confidence.shape}, depth {answer.depth.shape}; "
                "they must be of one size"
            )


def _with_depth(prediction: Prediction, depth: NDArray[np.float32]) -> Prediction:
    return Prediction(
        depth,
        prediction.image_to_depth,
        prediction.confidence,
        prediction.descriptor,
        prediction.inference_ms,
    )


def _load_with_inner(path: Path, providers: Sequence[str], threads: int, tensor_name: str) -> Any:
    """A session on a file that is known to load, with an inner tensor as one more output."""
    try:
        return _load(path, providers, threads, with_output(path.read_bytes(), tensor_name))
    except (ModelError, OSError):
        raise ModelError(f"{path.name}: has no inner tensor {tensor_name!r} (descriptor_layer)") from None


def _load(path: Path, providers: Sequence[str], threads: int, content: bytes | None = None) -> Any:
    """A session on the first of ``providers`` that is there and takes the model.

    ``content`` stands for the file's own bytes; weights that it refers to stay in the file's folder.
    """
    offered = onnxruntime.get_available_providers()
    wanted = [provider for provider in providers if provider in offered]
    for provider in providers:
        if provider not in offered:
            log.warning("execution provider %s is not in this onnxruntime; trying the next", provider)
    if not wanted:
        raise ModelError(
            f"none of the execution providers {', '.join(providers) or '(none named)'} is there; "
            f"this onnxruntime offers {', '.join(offered)}"
        )
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _QUIET
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    # Idle threads would spin at full load between keyframes.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    if content is not None:
        options.add_session_config_entry(
            "session.model_external_initializers_file_folder_path", str(path.parent)
        )
    failure = ""
    for provider in wanted:
        try:
            session = onnxruntime.InferenceSession(content or str(path), options, providers=[provider])
        except Exception as error:  # onnxruntime's exceptions have no common root of their own
            failure = _first_line(error)
            continue
        if session.get_providers()[0] == provider or provider == wanted[-1]:
            return session
        log.warning("execution provider %s did not start; trying the next", provider)
    raise ModelError(f"{path}: no ONNX model that onnxruntime can load ({failure or 'no provider started'})")


def _verify(session: Any, card: ModelCard, file: str) -> tuple[str, dict[str, str]]:
    """Names of the input and of the outputs by role; ModelError where file and card disagree."""
    inputs = {item.name: item for item in session.get_inputs()}
    if card.views != 1:
        raise ModelError(f"{file}: takes {card.views} images at once; the daemon runs networks of one")
    if len(inputs) != 1:
        raise ModelError(f"{file}: takes {len(inputs)} inputs; a depth network takes one image")
    name = card.input_name or next(iter(inputs))
    if name not in inputs:
        raise ModelError(f"{file}: has no input {name!r} (its input is {next(iter(inputs))!r})")
    if inputs[name].type != "tensor(float)":
        raise ModelError(f"{file}: input {name!r} is {inputs[name].type}, but float32 is needed")
    expected = (1, 3, card.input_height, card.input_width)
    shape = inputs[name].shape
    free_or_equal = [not isinstance(n, int) or n == e for n, e in zip(shape, expected, strict=False)]
    if len(shape) != 4 or not all(free_or_equal):
        raise ModelError(f"{file}: input {name!r} has shape {shape}, but its card says {list(expected)}")
    outputs = {item.name: item for item in session.get_outputs()}
    depth = card.depth_output or (next(iter(outputs)) if len(outputs) == 1 else "")
    if not depth:
        raise ModelError(f"{file}: its card must name depth_output, one of {', '.join(outputs)}")
    roles = {
        "depth": depth,
        "confidence": card.confidence_output,
        "descriptor": card.descriptor_output or card.descriptor_layer,
        "sky": card.sky_output,
        "rays": card.rays_output,
        "intrinsics": card.intrinsics_output,
    }
    roles = {role: output for role, output in roles.items() if output}
    for role, output in roles.items():
        if output not in outputs:
            raise ModelError(f"{file}: has no output {output!r} for {role}, only {', '.join(outputs)}")
        if outputs[output].type not in ("tensor(float)", "tensor(float16)"):
            raise ModelError(f"{file}: output {output!r} is {outputs[output].type}, but float is needed")
    # Rays and intrinsics are asked for by whoever wants them, not with every keyframe.
    return name, {role: output for role, output in roles.items() if role not in ("rays", "intrinsics")}


def _plane(values: NDArray[Any]) -> NDArray[np.float32]:
    """The one plane (h, w) in an output of shape (1, 1, h, w), (1, h, w) or (h, w)."""
    if values.ndim < 2 or any(extent != 1 for extent in values.shape[:-2]) or min(values.shape[-2:]) < 2:
        raise ModelError(f"an output of shape {list(values.shape)} is no map of one value a pixel")
    return np.asarray(values.reshape(values.shape[-2:]), dtype=np.float32)


def _descriptor(values: NDArray[Any]) -> NDArray[np.float32]:
    """The one vector (n,) in an output of shape (1, n), (n,) or with more extents of 1."""
    if values.size > _LARGEST_DESCRIPTOR or values.size != max(values.shape, default=0):
        raise ModelError(f"an output of shape {list(values.shape)} is no descriptor of one vector")
    return np.asarray(values, dtype=np.float32).ravel()


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
