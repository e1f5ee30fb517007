"""The depth worker: a keyframe's picture in, its metric depth out."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from statistics import median

import numpy as np

from prism_edge.bus.inbox import Inbox
from prism_edge.bus.pack import rgb
from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.depth import DepthNetwork
from prism_edge.depth.plausible import range_of
from prism_edge.depth.prediction import no_confidence, no_descriptor
from prism_edge.depth.providers import native_line
from prism_edge.depth.straight import STRAIGHT, as_shown
from prism_edge.depth.upright import UprightNetwork
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import Acknowledged, Depth, KeyframeImage, Tracked, probe_of
from prism_edge.processes import LOADING_S, peers_of
from prism_edge.workers.failing import Failing
from prism_edge.workers.sensor_network import SensorNetwork, open_depth

log = logging.getLogger("prism_edge.depth")

_WAIT_S = 0.2
_ONE_LIFE = 100_000  # no tracker gives so many keyframes between two that are seen here
_INFERENCE_S = 20.0  # the slowest network in use takes a tenth of that on a small computer
_SLOWEST_S = 120.0  # where loading, which ends with an inference, said that this one is slower
# Lockstep: a picture that takes longer isn't coming (the tracker died with it), and all wait for us.
_PATIENCE_S = 20.0


class DepthWorker:
    """Joins a network to the bus. Without one, every keyframe is answered by a depth marked invalid."""

    def __init__(self, config: Config, bus: Bus, patience_s: float = _PATIENCE_S) -> None:
        """Loads and warms up the network. Raises ModelError where it can't be run."""
        self._bus = bus
        self._patience_s = patience_s
        self._peers = peers_of(config, "depth")
        shown = {"model": "none", "provider": "none", "inference_ms": "-", "inference_ms_median": "-"}
        bus.pulse.values.update(shown, **dict.fromkeys(("queue", "keyframes", "dropped", "invalid"), "0"))
        # Subscribed first: what comes while the network loads is waiting when it is ready.
        self._images = bus.queue("keyframe_image") if config.is_lockstep else bus.latest("keyframe_image")
        self._ticks = bus.queue("tracked", 1024) if config.is_lockstep else None
        self._ends = bus.queue("end")
        self._early: dict[int, KeyframeImage] = {}
        self._last = -1
        self._told: Depth | None = None  # the last answer
        self._recent: deque[float] = deque(maxlen=100)
        self._doubted: set[str] = set()  # of what the log has a word
        self._turned = self._straight = False  # whether the log has a word of it
        self._network: DepthNetwork | SensorNetwork | None = None
        self._inference_s = _INFERENCE_S
        self._failing: Failing | None = None
        if config.depth.network:
            bus.pulse.working("loading the network", LOADING_S)
            began_s = time.monotonic()
            self._network = open_depth(config)
            self._inference_s = min(max(2.0 * (time.monotonic() - began_s), _INFERENCE_S), _SLOWEST_S)
            bus.pulse.values.update(model=self._network.name, provider=self._network.provider)
            self._show_counters()
            if not config.is_lockstep and not isinstance(self._network, SensorNetwork):
                self._failing = Failing(self._network.provider)
            log.info("%s runs on %s", self._network.name, self._network.provider)
        else:
            log.warning("no depth network is configured: keyframes get no depth, and no map begins")

    def run(self) -> None:
        """Works until the bus is stopped; once the stream has ended it stays, for what still comes.

        Raises ModelError where an accelerator fails for good.
        """
        self._bus.pulse.ready()
        if self._ticks is not None:
            self._bus.await_ready(self._peers, self._patience_s)
        over = said_so = False
        while not self._bus.stopped.is_set():
            worked = self._newest() if self._ticks is None else self._next_tick(self._ticks)
            over = over or bool(self._ends.drain())
            if over and not worked and not said_so:
                self._bus.pulse.ended()
            said_so = over and not worked

    def _next_tick(self, ticks: Inbox) -> bool:
        """Lockstep: acknowledge the next frame; whether there was one."""
        tick = ticks.take(_WAIT_S)
        if tick is not None:
            self._acknowledge(tick)
        return tick is not None

    def _newest(self) -> bool:
        """Real time: answer the newest picture; whether there was one."""
        image = self._images.take(0.0)
        self._bus.pulse.values["queue"] = "0" if image is None else "1"
        if image is None:
            image = self._images.take(_WAIT_S)
        if image is None:
            return False
        told = self._told
        asked = image.keyframe, image.epoch, image.stamp_ns
        if told is not None and (told.keyframe, told.epoch, told.stamp_ns) == asked:
            self._bus.publish("depth", told)  # asked again while a slow network was at it, or it went astray
            return True
        passed_over = image.keyframe - self._last - 1
        # Ids are given in order; a restarted tracker's begin far above.
        if self._last >= 0 and 0 < passed_over < _ONE_LIFE:
            values = self._bus.pulse.values
            values["dropped"] = str(int(values["dropped"]) + passed_over)
        self._last = max(image.keyframe, self._last) if image.keyframe < 0 else image.keyframe
        self._answer(image)
        return True

    def _acknowledge(self, tick: Tracked) -> None:
        """Lockstep: frame ``tick.index`` is done here once its keyframe, if it became one, has its depth."""
        if tick.keyframe >= 0 or tick.probe:
            image = self._await(probe_of(tick.index) if tick.probe else tick.keyframe)
            if self._bus.stopped.is_set():
                return
            if image is not None:
                self._answer(image)
        self._bus.publish("acknowledged", Acknowledged("depth", tick.index))

    def _await(self, keyframe: int) -> KeyframeImage | None:
        """The picture of that keyframe; None when it doesn't come."""
        self._bus.pulse.working(f"waiting for keyframe {keyframe}", self._patience_s + 5.0)
        deadline = time.monotonic() + self._patience_s
        while keyframe not in self._early and time.monotonic() < deadline and not self._bus.stopped.is_set():
            image = self._images.take(_WAIT_S)
            if image is not None:
                self._early[image.keyframe] = image
        image = self._early.pop(keyframe, None)
        self._early = {early: kept for early, kept in self._early.items() if early > keyframe or keyframe < 0}
        if image is None and not self._bus.stopped.is_set():
            log.warning("the picture of keyframe %d has not come: going on without", keyframe)
            self._bus.pulse.count("dropped")
        self._bus.pulse.idle()
        return image

    def _answer(self, image: KeyframeImage) -> None:
        self._bus.pulse.working(f"keyframe {image.keyframe}", self._inference_s)
        if image.turns % 4 and not self._turned:
            self._turned = True
            degrees = 90 * (image.turns % 4)
            log.info("the network sees pictures turned by %d degrees: so the camera sits", degrees)
        self._told = depth = answer(self._network, image, self._failing)
        if depth.model.endswith(STRAIGHT) and not self._straight:
            self._straight = True
            log.info("pictures are set straight for the network: the lens bends them strongly")
        self._bus.publish("depth", depth)
        if image.keyframe >= 0:  # of a lost camera's probe the descriptor counts alone
            self._judge(image, depth)
        self._show_counters()
        self._bus.pulse.idle()

    def _judge(self, image: KeyframeImage, depth: Depth) -> None:
        """What is to be said of a keyframe's depth."""
        self._bus.pulse.count("keyframes")
        if not depth.valid:
            self._bus.pulse.count("invalid")
            self._bus.pulse.warn("depth", f"no usable depth: {depth.reason}")
            if self._network is not None:
                log.warning("keyframe %d has no depth: %s", image.keyframe, depth.reason)
        else:
            self._doubt(depth)
            self._recent.append(depth.inference_ms)
            self._bus.pulse.values.update(
                inference_ms=f"{depth.inference_ms:.1f}", inference_ms_median=f"{median(self._recent):.1f}"
            )

    def _doubt(self, depth: Depth) -> None:
        """Says where metres can't be metres, or a pair is none: on `health` while so, once on the log."""
        metres = None if isinstance(self._network, SensorNetwork) else range_of(depth.depth)
        doubt = (metres.doubt if metres else "") or getattr(self._network, "doubt", "")
        self._bus.pulse.warn("depth", doubt)
        if not doubt:
            return
        kind = "metres" if metres and metres.doubt else "pair"
        if kind not in self._doubted:
            log.warning("keyframe %d: %s", depth.keyframe, doubt)
        self._doubted.add(kind)

    def _show_counters(self) -> None:
        if self._network is not None:
            self._bus.pulse.values.update({name: str(n) for name, n in self._network.counters.items()})


def answer(
    network: DepthNetwork | SensorNetwork | None, image: KeyframeImage, failing: Failing | None = None
) -> Depth:
    """The depth of one keyframe; an inference that fails is an answer too, marked invalid with the reason.

    A network sees the picture upright, its message says which way that is, and through a strongly bent lens
    straight. Raises ModelError where ``failing``, which is told of each, has had enough.
    """
    if network is None:
        return _without(image, "none", 0.0, "no depth network is configured")
    if image.turns % 4 and not isinstance(network, SensorNetwork):
        network = UprightNetwork(network, image.turns % 4)
    try:
        camera = Camera.from_array(image.camera_model, image.camera)
        if isinstance(network, SensorNetwork):
            prediction = network.measure(image.index, camera)
        else:
            network = as_shown(network, camera)
            prediction = network.infer(rgb(image), camera)
    except Exception as error:  # native code and foreign graphs raise anything; tracking goes on
        if failing is not None:
            failing.note(error, time.monotonic())
        failed = f"inference failed: {native_line(error)}"
        return _without(image, network.identity, network.bias_sigma, failed)
    if failing is not None:
        failing.note(prediction.fault, time.monotonic())
    return Depth(
        keyframe=image.keyframe,
        stamp_ns=image.stamp_ns,
        epoch=image.epoch,
        model=network.identity,
        bias_sigma=network.bias_sigma,
        inference_ms=prediction.inference_ms,
        valid=prediction.valid,
        reason=prediction.reason,
        image_to_depth=prediction.image_to_depth,
        depth=prediction.depth,
        confidence=prediction.confidence,
        descriptor=prediction.descriptor,
        dsug_tau=network.dsug[0],
        dsug_temperature=network.dsug[1],
        frame_sigma=getattr(network, "frame_sigma", math.nan),
    )


def _without(image: KeyframeImage, model: str, bias_sigma: float, reason: str) -> Depth:
    return Depth(
        keyframe=image.keyframe,
        stamp_ns=image.stamp_ns,
        epoch=image.epoch,
        model=model,
        bias_sigma=bias_sigma,
        inference_ms=0.0,
        valid=False,
        reason=reason,
        image_to_depth=np.zeros(4),
        depth=np.zeros((0, 0), np.float32),
        confidence=no_confidence(),
        descriptor=no_descriptor(),
    )


def main(config: Config, bus: Bus) -> None:
    """Runs until ``bus.stopped``. Raises ModelError where the network can't be run."""
    DepthWorker(config, bus).run()
