"""The scale worker: keyframes and their depth in, metres per map unit and gate weights out."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from typing import Any

from prism_edge.bus import ros
from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.messages import Acknowledged, Depth, Keyframe, MapLoaded, Scale, Tracked
from prism_edge.processes import peers_of
from prism_edge.scale.estimator import ScaleEstimator
from prism_edge.scale.rendezvous import Rendezvous
from prism_edge.workers.cut_off import goes_on

log = logging.getLogger("prism_edge.scale")

_WAIT_S = 0.05
# Lockstep: a depth that takes longer isn't coming (its worker died with the image), and all wait for us.
_PATIENCE_S = 30.0
_READY_S, _ASK_S = 20.0, 3.0  # a backend that starts beside us reads its journal first; metres wait for it
# Real time: with no depth for this long (its host is cut off) keyframes say how the uncertainty grows.
_SILENT_S = 3.0


class ScaleWorker:
    """Joins the estimator to the bus."""

    def __init__(self, config: Config, bus: Bus, patience_s: float = _PATIENCE_S) -> None:
        self._bus = bus
        self._patience_s = patience_s
        self._peers = peers_of(config, "scale")
        self._map_frame = config.frames.map
        self._keyframes = bus.queue("keyframe", 64)
        self._depths = bus.queue("depth", 64)
        self._loaded = bus.queue("map_loaded", 8)
        self._ends, self._begun = bus.queue("end"), bus.queue("new_map")
        self._ticks = bus.queue("tracked", 1024) if config.is_lockstep else None
        self._waiting = Rendezvous()
        self._served: deque[int] = deque(maxlen=256)  # keyframes; a later frame's may come with an earlier's
        self._estimator = ScaleEstimator(config.scale, config.ablate, config.gate)
        self._initial_sigma = config.scale.initial_sigma
        self._stamp_ns = 0  # of the newest keyframe
        self._doubted = False  # that the network knows what it sees
        self._unanswered_s: float | None = None  # since when no keyframe has met its depth, though some came
        self._shows_images, self._camera_frame = config.gate.images, config.frames.camera

    def run(self) -> None:
        """Works until the bus is stopped; once the stream has ended it stays, for what still comes."""
        if self._bus.first_id or goes_on(self._bus):
            self._go_on()
        self._bus.pulse.ready()
        if self._ticks is not None:
            self._bus.await_ready(self._peers, self._patience_s)
        while not self._bus.stopped.is_set():
            if self._ticks is None:
                self._take_depth(_WAIT_S)
            else:
                tick = self._ticks.take(_WAIT_S)
                if tick is not None:
                    self._acknowledge(tick)
                self._take_loaded()  # no keyframe may come any more
            if self._ends.drain():
                self._bus.pulse.ended()

    def _go_on(self) -> None:
        """What a life before this one, or a run that was cut off, has learned of the map's unit the backend
        knows. It tells so by itself too, but may be started again before it has.
        """
        self._bus.pulse.working("asking for the map's unit", _READY_S + 3 * _ASK_S)
        self._bus.await_ready(["backend"], _READY_S)
        known = self._bus.ask("map_loaded", _ASK_S)
        if known is not None:
            self._take_over(known)

    def _acknowledge(self, tick: Tracked) -> None:
        """Lockstep: frame ``tick.index`` is done here once its keyframe, if it became one, has its scale."""
        if tick.keyframe >= 0:
            self._bus.pulse.working(f"keyframe {tick.keyframe}", self._patience_s + 5.0)
            deadline = time.monotonic() + self._patience_s
            while tick.keyframe not in self._served:
                self._take_depth(_WAIT_S)
                if self._bus.stopped.is_set():
                    return
                if tick.keyframe not in self._served and time.monotonic() > deadline:
                    self._do_without_depth(tick.keyframe)
                    break
            self._bus.pulse.idle()
        self._bus.publish("acknowledged", Acknowledged("scale", tick.index))

    def _take_depth(self, timeout_s: float) -> None:
        """Handles all pairs that are complete once a depth has come or the time is over."""
        depth = self._depths.take(timeout_s)
        for come in ([] if depth is None else [depth]) + self._depths.drain():
            # A probe's is for the tracker; one that is told again has met its keyframe.
            if come.keyframe >= 0 and come.keyframe not in self._served:
                self._waiting.add_depth(come)
        self._take_loaded()
        keyframes = self._keyframes.drain()
        for keyframe in keyframes:
            self._stamp_ns = keyframe.stamp_ns
            self._estimator.hear(keyframe)
            if "depth" in self._peers:
                self._waiting.add_keyframe(keyframe)
            else:  # a loaded map's metres, less and less sure
                self._handle(keyframe, None)
        pairs = self._waiting.complete()
        for keyframe, depth in pairs:
            self._handle(keyframe, depth)
        now = time.monotonic()
        if pairs or "depth" not in self._peers:
            self._unanswered_s = None
        elif keyframes and self._unanswered_s is None:
            self._unanswered_s = now
        silent = self._unanswered_s is not None and now - self._unanswered_s > _SILENT_S
        if keyframes and silent and self._ticks is None and self._estimator.metric:
            self._grow(keyframes[-1])

    def _take_loaded(self) -> None:
        for loaded in self._loaded.drain():
            self._take_over(loaded)
        for told in self._begun.drain():  # it may be long until the new map's first keyframe
            if self._estimator.give_up(told.epoch):
                self._nothing_on_health()
                unknown = 0.0, self._initial_sigma, self._initial_sigma
                self._bus.publish("scale", ros.scale(self._stamp_ns, self._map_frame, *unknown, metric=False))

    def _take_over(self, loaded: MapLoaded) -> None:
        """Said at once: where the map is left as it is, no keyframe will."""
        if loaded.epoch < self._estimator.epoch:
            return  # given up before it was heard of
        log_scale, sigma = loaded.log_scale, loaded.scale_sigma
        apart = {"bias_sigma": loaded.bias_sigma, "lost_sigma": loaded.lost_sigma}
        known = log_scale, math.hypot(sigma, *apart.values()), sigma
        if loaded.metric:
            self._estimator.take_over(loaded.epoch, log_scale, sigma, network=loaded.network, **apart)
            self._on_health(*known[:2], "the map that was taken up")
        else:
            self._estimator.begin(loaded.epoch)
            self._nothing_on_health()
        self._bus.publish("scale", ros.scale(self._stamp_ns, self._map_frame, *known, metric=loaded.metric))

    def _do_without_depth(self, keyframe_id: int) -> None:
        log.warning("keyframe %d has no depth after %.0f s: going on without", keyframe_id, self._patience_s)
        keyframe = self._waiting.take_keyframe(keyframe_id)
        if keyframe is not None:
            self._handle(keyframe, None)

    def _grow(self, keyframe: Keyframe) -> None:
        """No depth comes: the estimate stays, less and less sure; the keyframe goes on waiting for it."""
        answer = self._estimator.process(keyframe, None)
        if answer is not None:
            self._publish(answer[0])

    def _publish(self, scale: Scale) -> None:
        self._on_health(scale.log_scale, scale.sigma, f"keyframe {scale.keyframe}")
        self._bus.publish("log_scale", scale)
        if "depth" in self._peers or self._estimator.metric:  # else nothing will ever say a metre
            self._bus.publish("scale", self._public(scale))

    def _on_health(self, log_scale: float, sigma: float, where: str) -> None:
        """The metres, and as long as a network seems to be out of its depth, that; logged once."""
        values, doubt = self._bus.pulse.values, self._estimator.doubt
        values.update(log_scale=f"{log_scale:.4f}", sigma=f"{sigma:.4f}")
        self._bus.pulse.warn("metres", doubt)
        if doubt and not self._doubted:
            self._doubted = True
            log.warning("%s: %s", where, doubt)

    def _nothing_on_health(self) -> None:
        """No metres are known of the map that there is now."""
        self._bus.pulse.warn("metres", "")
        for said in ("log_scale", "sigma"):
            self._bus.pulse.values.pop(said, None)

    def _handle(self, keyframe: Keyframe, depth: Depth | None) -> None:
        self._served.append(keyframe.id)
        answer = self._estimator.process(keyframe, depth)
        if answer is None:
            return
        scale, gate = answer
        self._bus.pulse.values.update(
            observations=str(self._estimator.accepted),
            rejected=str(self._estimator.rejected),
            unpaired=str(self._waiting.dropped),
        )
        if scale.points and not scale.accepted:
            log.info(
                "keyframe %d: log scale %.3f refused (estimate %.3f)",
                keyframe.id,
                scale.observation,
                scale.log_scale,
            )
        self._publish(scale)
        self._bus.publish("gate", gate)
        if self._shows_images:
            self._show(scale.stamp_ns)

    def _show(self, stamp_ns: int) -> None:
        """u and w of the newest keyframe's every pixel, for a look."""
        images = self._estimator.gate_images()
        if images is not None:
            for topic, values in zip(("uncertainty", "weight"), images, strict=True):
                self._bus.publish(topic, ros.image(stamp_ns, self._camera_frame, values))

    def _public(self, scale: Scale) -> Any:
        return ros.scale(
            scale.stamp_ns,
            self._map_frame,
            scale.log_scale,
            scale.sigma,
            scale.filter_sigma,
            metric=self._estimator.metric,
            keyframe=scale.keyframe,
            observation=scale.observation,
            observation_sigma=scale.observation_sigma,
            points=scale.points,
            accepted=scale.accepted,
        )


def main(config: Config, bus: Bus) -> None:
    """Runs until ``bus.stopped``."""
    ScaleWorker(config, bus).run()
