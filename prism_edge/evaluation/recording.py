"""What a subscriber got during one run, and what follows from it without any ground truth; pure."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from prism_edge.evaluation.carried import carried
from prism_edge.evaluation.trajectory import NS, Trajectory
from prism_edge.geometry.poses import Array, scaled
from prism_edge.messages import DEGRADED, LOST, OK, EndOfStream, MapSnapshot, Solved, Tracked


@dataclass(frozen=True)
class Published:
    """One `pose` as it arrived."""

    stamp_ns: int
    arrival_ns: int  # host's monotonic clock
    map_from_camera: Array  # (4, 4) metres
    covariance: Array | None = None  # (6, 6) of base_link in the map's axes: metres, then rad


@dataclass(frozen=True)
class Recording:
    """Everything heard on the bus. ``arrivals_ns`` holds a monotonic time for each of ``frames``."""

    poses: list[Published] = field(default_factory=list)
    frames: list[Tracked] = field(default_factory=list)
    arrivals_ns: list[int] = field(default_factory=list)
    end: EndOfStream | None = None
    scale: Any | None = None  # the last prism_edge_msgs/Scale
    bias_sigma: float | None = None  # of the network's log scale, as the scale process had it last
    solved: list[Solved] = field(default_factory=list)  # what the backend has adjusted

    @cached_property
    def published(self) -> dict[int, Published]:
        """The first pose published for each stamp."""
        return {pose.stamp_ns: pose for pose in reversed(self.poses)}

    @cached_property
    def tracked(self) -> list[Tracked]:
        """The frames that count as tracked: state ok or degraded, and a pose arrived."""
        return [f for f in self.frames if f.odometry in (OK, DEGRADED) and f.stamp_ns in self.published]

    @cached_property
    def apart(self) -> list[Tracked]:
        """The frames that were tracked in a part of the map whose place in it was not known then."""
        followed = (f for f in self.frames if f.odometry in (OK, DEGRADED) and not f.published)
        return [f for f in followed if f.stamp_ns not in self.published]

    def live(self) -> Trajectory:
        """Every pose exactly as published, map_from_camera; poses that aren't finite are left out."""
        finite = (pose for pose in self.poses if np.isfinite(pose.map_from_camera).all())
        return Trajectory.of((pose.stamp_ns, pose.map_from_camera) for pose in finite)

    def final(self, snapshot: MapSnapshot, map_from_world: Array) -> tuple[Trajectory, int]:
        """Every tracked frame as the finished map has it (:mod:`~prism_edge.evaluation.carried`).

        So also those without a pose as they came, in parts of the map that a loop has joined since. In
        metres, map_from_camera: the snapshot's map units are multiplied by exp(log_scale), then brought
        from the map's world frame by ``map_from_world`` (4, 4). Also returns how many frames with a pose had
        to be left out because the map no longer holds their reference keyframe, or holds no numbers for it.
        """
        away, numbers = set(snapshot.away.tolist()), snapshot.keyframes.tolist()
        told = zip(numbers, snapshot.poses, strict=True)
        keyframes = {k: pose for k, pose in told if k not in away and np.isfinite(pose).all()}
        grown = dict(zip(numbers, snapshot.grown.tolist(), strict=False))  # none where nobody says it
        factor = float(np.exp(snapshot.log_scale))
        held = [f for f in (*self.tracked, *self.apart) if {f.reference, f.keyframe} & keyframes.keys()]
        held.sort(key=lambda f: f.stamp_ns)
        # One without a pose is told in the part's own unit of then.
        units = [1.0 if f.published else grown.get(f.reference, 1.0) for f in held]
        offsets = [scaled(f.reference_from_camera, unit) for f, unit in zip(held, units, strict=True)]
        placed = [map_from_world @ scaled(pose, factor) for pose in carried(held, offsets, keyframes)]
        rows = zip((f.stamp_ns for f in held), placed, strict=True)
        final = Trajectory.of((stamp_ns, pose) for stamp_ns, pose in rows if np.isfinite(pose).all())
        stamps = set(final.stamps.tolist())
        return final, sum(f.stamp_ns not in stamps for f in self.tracked)

    def latencies_ms(self) -> Array:
        """From scheduled capture to the subscriber, one for each published pose whose frame is known."""
        return self.arrivals_and_latencies()[1]

    def arrivals_and_latencies(self) -> tuple[NDArray[np.int64], Array]:
        """When those poses arrived (ns, the host's monotonic clock), and their latencies (ms)."""
        captured = {frame.stamp_ns: frame.captured_monotonic_ns for frame in self.frames}
        known = [pose for pose in self.poses if pose.stamp_ns in captured]
        arrivals = np.array([pose.arrival_ns for pose in known], np.int64)
        return arrivals, (arrivals - np.array([captured[pose.stamp_ns] for pose in known], np.int64)) / 1e6

    def violations(self) -> list[str]:
        """What no subscriber may ever see; each makes the run fail."""
        found = []
        lost = [frame for frame in self.frames if frame.odometry == LOST]
        told = [frame.index for frame in lost if frame.published or frame.stamp_ns in self.published]
        if told:
            found.append(f"{len(told)} poses were published while lost, the first for frame {told[0]}")
        strange = [pose for pose in self.poses if not np.isfinite(pose.map_from_camera).all()]
        if strange:
            at = strange[0].stamp_ns / NS
            found.append(f"{len(strange)} poses that are not finite were published, the first for {at:.3f} s")
        return found

    def last_scale(self) -> dict[str, Any] | None:
        """What the daemon said last about its scale; None where it never did."""
        if self.scale is None:
            return None
        names = ("log_scale", "sigma_log", "filter_sigma_log", "metric")
        values = {name: getattr(self.scale, name) for name in names}
        return {k: v if isinstance(v, bool) or np.isfinite(v) else None for k, v in values.items()}

    def flow(self, first_stamp_ns: int | None) -> dict[str, Any]:
        """Counts, coverage, rate and latency, under their names in metrics.json (docs/EVALUATION.md).

        ``first_stamp_ns`` is the recording's first stamp; None takes that of the first frame tracked.
        """
        processed = len({frame.index for frame in self.frames})
        end = self.end or EndOfStream(processed, processed, 0, 0, -1)
        if first_stamp_ns is None and self.frames:
            first_stamp_ns = self.frames[0].stamp_ns
        first_pose_s = None
        if self.poses and first_stamp_ns is not None:
            first_pose_s = (min(self.published) - first_stamp_ns) / NS
        states = [frame.odometry for frame in self.frames]
        return {
            "frames": end.frames,
            "tracked": len(self.tracked),
            "coverage": len(self.tracked) / end.frames if end.frames else None,
            "states": {state: states.count(state) for state in sorted(set(states))},
            "first_pose_s": first_pose_s,
            "fps": self._rate(),
            "dropped_frames": max(0, end.frames - end.unreadable - processed),
            "duplicate_frames": end.duplicates,
            "unreadable_frames": end.unreadable,
            "latency_ms": self._latency_percentiles(),
        }

    def _rate(self) -> float | None:
        span_ns = self.arrivals_ns[-1] - self.arrivals_ns[0] if self.arrivals_ns else 0
        return (len(self.arrivals_ns) - 1) * NS / span_ns if span_ns > 0 else None

    def _latency_percentiles(self) -> dict[str, float | None]:
        latencies = self.latencies_ms()
        return {
            f"p{percent}": float(np.percentile(latencies, percent)) if len(latencies) else None
            for percent in (50, 95, 99)
        }
