"""From keyframes and their depth to metres per map unit: samples, least squares and filter in a row."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from prism_edge.config import GateConfig, ScaleConfig
from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import Camera
from prism_edge.messages import F32, Depth, Gate, Keyframe, Scale, same_network
from prism_edge.scale.filter import SAID_FROM, ScaleFilter, is_late
from prism_edge.scale.gate import Floats
from prism_edge.scale.gate_keyframes import KeyframeGate
from prism_edge.scale.least_squares import Observation, plain_mean, weighted_least_squares
from prism_edge.scale.parts import PartScale, PartScales
from prism_edge.scale.sample_trust import ShutGate, sample_trust
from prism_edge.scale.samples import samples_of
from prism_edge.scale.spread import PRIOR_WEIGHT, USUAL_BIAS


class ScaleEstimator:
    """Scale of the newest map; a new epoch starts afresh, since its unit is another, and so does a new part.

    ``ablate`` may name 'kalman' (the last observation is the estimate), 'wls' (a plain mean of points) and
    'dsug' (the gate stays open).
    """

    def __init__(
        self, config: ScaleConfig, ablate: tuple[str, ...] = (), gate: GateConfig | None = None
    ) -> None:
        self._config, self._usual = config, config.frame_sigma
        self._kalman = "kalman" not in ablate
        self._least_squares = "wls" not in ablate
        self._epoch: int | None = None
        self._bias_sigma = 0.0  # of the network, as last heard
        self._network = ""  # whose depth the map's unit was learned from
        self._says_spread = False  # whether the source of depth has told its own frame_sigma
        self._gate = KeyframeGate(gate or GateConfig(), "dsug" not in ablate)
        self._shut = ShutGate()
        self._parts = PartScales(config, self._kalman)
        self._seen = 0.0  # independent observations since this epoch began
        self.accepted = self.rejected = 0  # observations since this epoch began; refused are outliers

    @property
    def epoch(self) -> int:
        """Of the map that it is about; -1 before any."""
        return -1 if self._epoch is None else self._epoch

    @property
    def metric(self) -> bool:
        """Whether network depth has fixed this part's unit or met it; else scale is a guess."""
        return not self._filter.is_open

    @property
    def doubt(self) -> str:
        """Why metres may be worth little, here before elsewhere in the map, in words; empty for nothing."""
        elsewhere = self._most_lost.filter.doubt if self._lost_sigma() > SAID_FROM else ""
        return self._filter.doubt or elsewhere or self._shut.doubt

    def hear(self, keyframe: Keyframe) -> None:
        """A keyframe has come, whose depth may come later or never: where the map has it counts even so.

        So does which parts of the map have become one; to be called once for each keyframe.
        """
        if keyframe.epoch == self._epoch:
            self._join(keyframe)
            if self._parts.is_here(keyframe):
                self._gate.note(keyframe)

    def process(self, keyframe: Keyframe, depth: Depth | None) -> tuple[Scale, Gate] | None:
        """The scale after a keyframe, and the weights of its keypoints; None where its epoch is over.

        ``depth`` is the same keyframe's, or None where none will come. The first valid depth of an epoch
        fixes the map's unit unless points triangulated without it have already given it another.
        """
        if self._epoch is not None and keyframe.epoch < self._epoch:
            return None
        if self._epoch != keyframe.epoch:
            self.begin(keyframe.epoch)
        if self._parts.enter(keyframe, self._config):
            self._gate.forget()
        self._gate.note(keyframe)
        weights = np.ones(len(keyframe.pixels), dtype=np.float32)
        uncertainty = np.full(len(keyframe.pixels), np.nan, dtype=np.float32)
        self._heed(depth)
        here, scale = self._parts.here, self._filter
        scale.predict(keyframe.stamp_ns * 1e-9, keyframe.travelled)
        if depth is not None and depth.says_bias:
            self._meet(depth)
            if self._bias_sigma > 0.0:
                scale.expect(self._network_sigma())
        observation, accepted = None, False
        camera = _camera_of(keyframe)
        if depth is not None and depth.valid and camera is not None:
            gated = self._gate.assess(keyframe, depth, camera, scale.log_scale)
            if gated is not None:
                self._shut.see(gated.weights)
                weights, uncertainty = gated.weights.astype(np.float32), gated.uncertainty.astype(np.float32)
            observation = self._observe(keyframe, depth, camera, sample_trust(keyframe, weights))
            if observation is not None:
                accepted = scale.update(observation)
                self.accepted += accepted
                self.rejected += not accepted
            elif scale.is_open and not (keyframe.parallax_deg > 0.0).any():
                scale.fix_unit()
        # A network that is steadier than the filter's model leaves less room to hold, a wilder one more.
        sigma = math.hypot(scale.learned_sigma, self._bias_sigma)
        here.steady.follow(scale.log_scale, sigma, scale.excess)
        # Of the map that would be too much: it would bend where a network wavers.
        modest = math.hypot(min(scale.sigma, scale.learned_sigma), self._bias_sigma)
        here.of_map.follow(scale.log_scale, modest)
        held = here.steady.log_scale - scale.log_scale
        if observation is not None and accepted:
            elapsed_s = max(keyframe.stamp_ns - here.local_ns, 0) * 1e-9
            self._seen += 1.0 - scale.correlation(elapsed_s)
            here.local.take(observation.log_scale - here.steady.log_scale, scale.correlation(elapsed_s))
            if not is_late((here.local_ns - keyframe.stamp_ns) * 1e-9):
                here.local_ns = keyframe.stamp_ns
        here.seen = self._seen
        lost_sigma = self._lost_sigma()
        message = Scale(
            keyframe=keyframe.id,
            stamp_ns=keyframe.stamp_ns,
            epoch=keyframe.epoch,
            log_scale=here.steady.log_scale,
            map_log_scale=here.of_map.log_scale,
            sigma=math.hypot(scale.learned_sigma, self._bias_sigma, held, lost_sigma, scale.contested_sigma),
            lost_sigma=lost_sigma,
            filter_sigma=scale.learned_sigma,
            bias_sigma=self._bias_sigma,
            local_sigma=here.local.sigma(self._network_sigma()),
            network=self._network,
            observation=observation.log_scale if observation else math.nan,
            observation_sigma=math.sqrt(observation.variance) if observation else math.nan,
            points=observation.points if observation else 0,
            accepted=accepted,
            metric=self.metric,
            part=keyframe.part,
        )
        return message, Gate(keyframe.id, keyframe.epoch, weights, uncertainty)

    def take_over(
        self,
        epoch: int,
        log_scale: float,
        sigma: float,
        bias_sigma: float = 0.0,
        network: str = "",
        lost_sigma: float = 0.0,
    ) -> None:
        """A map that was there is gone on with, as ``epoch``: its unit is known, to its network's errors."""
        self.begin(epoch)
        self._network = network
        self._bias_sigma = bias_sigma or self._bias_sigma
        self._parts.take_over(log_scale, sigma, lost_sigma)

    def give_up(self, epoch: int) -> bool:
        """The map gives way to a new one, of which nothing is known; False where that is known already."""
        gives_way = self._epoch is not None and epoch > self._epoch
        if gives_way:
            self.begin(epoch)
        return gives_way

    def begin(self, epoch: int) -> None:
        """A map of whose unit nothing is known."""
        self._epoch = epoch
        self._parts, self._seen = PartScales(self._config, self._kalman), 0.0
        self._shut = ShutGate()
        self.accepted = self.rejected = 0
        self._network = ""
        self._gate.forget()

    def _join(self, keyframe: Keyframe) -> None:
        """Parts whose way to one another was found since the keyframe before."""
        if len(keyframe.joined) == len(keyframe.joined_units):
            for (newer, older), units in zip(keyframe.joined.tolist(), keyframe.joined_units, strict=True):
                log_unit, sigma = units.tolist()
                if math.isfinite(log_unit) and math.isfinite(sigma):
                    self._parts.join(newer, older, log_unit, sigma, self._config)

    def _meet(self, depth: Depth) -> None:
        """Another network has other metres: they are off by its bias and by that of the one before."""
        both, self._bias_sigma = math.hypot(self._bias_sigma, depth.bias_sigma), depth.bias_sigma
        if self._network and depth.model and not same_network(depth.model, self._network):
            if not math.isfinite(depth.frame_sigma):  # the one before may have told its own
                self._config, self._says_spread = replace(self._config, frame_sigma=self._usual), False
            for part in self._parts:
                part.filter.meet_another(both, self._network_sigma() or self._usual, self._config)
        self._network = depth.model or self._network

    def _heed(self, depth: Depth | None) -> None:
        """A source of depth that knows how well its images agree in scale says so, before it is believed."""
        said = math.nan if depth is None else depth.frame_sigma
        if math.isfinite(said) and 0.0 <= said <= 2.0 and said != self._config.frame_sigma:
            self._config = replace(self._config, frame_sigma=said)
            self._says_spread = True
            for part in self._parts:
                part.filter.assume(self._config)

    def gate_images(self) -> tuple[Floats, Floats] | None:
        """u and w of every pixel of the newest keyframe's depth map (h, w); None where the gate was open."""
        return self._gate.images()

    def _network_sigma(self) -> float:
        """What the pixels of an image are thought to share with this network."""
        return self._config.frame_sigma * (1.0 if self._says_spread else self._bias_sigma / USUAL_BIAS)

    def _lost_sigma(self) -> float:
        """What metres may be off by beyond the bias: the network is lost, in whichever part that showed."""
        if self._says_spread:  # measured, not guessed: where a map wavers, that is the map
            return 0.0
        return self._lost_in(self._most_lost)

    @property
    def _most_lost(self) -> PartScale:
        return max(self._parts.apart, key=self._lost_in)

    def _lost_in(self, part: PartScale) -> float:
        """As the network was in a part; of one that was left it counts the less, the more was seen since."""
        return part.filter.lost_sigma * PRIOR_WEIGHT / (PRIOR_WEIGHT + self._seen - part.seen)

    @property
    def _filter(self) -> ScaleFilter:
        return self._parts.here.filter

    def _observe(self, keyframe: Keyframe, depth: Depth, camera: Camera, weights: F32) -> Observation | None:
        c = self._config
        if not np.isfinite(depth.image_to_depth).all():
            return None
        samples = samples_of(keyframe, depth, camera, c.min_parallax_deg)
        if not self._least_squares:
            return plain_mean(samples.log_ratios, c.point_sigma, c.frame_sigma, c.min_points)
        return weighted_least_squares(
            samples.log_ratios,
            samples.patches,
            weights[samples.keypoints],
            c.point_sigma,
            c.frame_sigma,
            c.min_points,
        )


def _camera_of(keyframe: Keyframe) -> Camera | None:
    """None for a message no camera can have sent: worth as much as no message."""
    try:
        return Camera.from_array(keyframe.camera_model, keyframe.camera)
    except ConfigError:
        return None
