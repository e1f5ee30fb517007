"""`camera: auto`: the intrinsics of a camera that nobody calibrated, as the depth network sees them."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from contextlib import closing
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from prism_edge.config import Config, SourceConfig
from prism_edge.depth import NESTED, open_onnx
from prism_edge.depth.session import OnnxNetwork
from prism_edge.depth.upright import turned_camera
from prism_edge.errors import ConfigError, SourceError
from prism_edge.geometry.cameras import Camera
from prism_edge.geometry.mount import base_from_camera, quarter_turns
from prism_edge.messages import U8
from prism_edge.sources import Image, open_source
from prism_edge.sources.address import shown_address
from prism_edge.sources.open import AUTO_NEEDS

log = logging.getLogger("prism_edge.source")

IMAGES = 5  # a network's answer differs from image to image by a few percent
_APART_NS = 200_000_000  # so that they are not all one image
_MOST_READ = 300  # items of a source that are looked at for them
_WORST_SPREAD = 0.1  # of the focal length, standard deviation over mean, beyond which we warn


def estimated_camera(config: Config, stopped: threading.Event) -> tuple[str, Camera]:
    """Where the intrinsics are from, in words, and the pinhole camera (no distortion) of the source.

    The median over IMAGES images from the source's beginning; the network is loaded for that alone. Raises
    ConfigError where the configured network predicts no intrinsics, SourceError where the source gives no
    image to judge by.
    """
    network = _network_with_intrinsics(config)
    estimates, size, why = [], (0, 0), ""
    turns = quarter_turns(base_from_camera(config.frames))
    for pixels in _first_images(config.source, stopped):
        rgb = pixels[:, :, ::-1] if pixels.ndim == 3 else np.repeat(pixels[:, :, None], 3, axis=2)
        upright = np.ascontiguousarray(np.rot90(rgb, turns))
        found = network.intrinsics(upright)
        if found is None:
            continue
        try:
            camera = turned_camera(Camera(upright.shape[1], upright.shape[0], *found), -turns % 4)
        except ConfigError as error:  # as little worth as none
            log.info("camera auto: an image says nothing of its camera: %s", error)
            why = f" (the last it said can't be: {error})"
            continue
        estimates.append((camera.fx, camera.fy, camera.cx, camera.cy))
        size = (camera.width, camera.height)
    if not estimates:
        raise SourceError(
            f"camera auto: {network.name} found no intrinsics in the first images of "
            f"{shown_address(config.source.uri)}{why}; give a camera file (--camera FILE)"
        )
    camera, spread = median_camera(np.array(estimates), *size)
    if spread > _WORST_SPREAD:
        log.warning(
            "camera auto: the focal length differs by %.0f %% from image to image; calibrate the camera",
            100 * spread,
        )
    return (
        f"as {network.name} sees it in {len(estimates)} images: f {camera.fx:.1f}, {camera.fy:.1f}, "
        f"c {camera.cx:.1f}, {camera.cy:.1f}, spread {100 * spread:.1f} %",
        camera,
    )


def median_camera(estimates: NDArray[np.float64], width: int, height: int) -> tuple[Camera, float]:
    """The camera of estimates (n, 4) fx, fy, cx, cy, and the relative spread of its focal length."""
    fx, fy, cx, cy = np.median(estimates, axis=0)
    focal = np.sqrt(estimates[:, 0] * estimates[:, 1])
    return Camera(width, height, fx, fy, cx, cy), float(np.std(focal) / np.mean(focal))


def _network_with_intrinsics(config: Config) -> OnnxNetwork:
    """The configured network, or the part of a pair, that predicts intrinsics."""
    spec = config.depth.network
    if not spec:
        raise ConfigError(AUTO_NEEDS)
    parts = spec.removeprefix(NESTED).split(",") if spec.startswith(NESTED) else [spec]
    for part in parts:
        network = open_onnx(part.strip(), config.depth)
        if network.card.intrinsics_output:
            return network
    raise ConfigError(f"camera auto: {spec} predicts no intrinsics; give a camera file (--camera FILE)")


def _first_images(config: SourceConfig, stopped: threading.Event) -> Iterator[U8]:
    """Up to IMAGES images from the beginning, some time apart; the source is opened for that and closed."""
    last_ns: int | None = None
    given = 0
    with closing(open_source(replace(config, loop=False))) as source:
        source.stop_on(stopped)
        source.open()
        for _ in range(_MOST_READ):
            item = None if stopped.is_set() else source.read()
            if item is None or given == IMAGES:
                return
            if isinstance(item, Image) and (last_ns is None or item.stamp_ns - last_ns >= _APART_NS):
                last_ns, given = item.stamp_ns, given + 1
                yield item.pixels
