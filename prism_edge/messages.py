"""What the processes tell each other: plain dataclasses of numbers and arrays, checked when unpacked.

Lengths and poses inside the system are in *map units*: the unit that the first keyframes gave the map.
``Scale.log_scale`` turns them into metres, once, where poses are published (docs/ARCHITECTURE.md).
Poses are ``world_from_camera`` in the map's own world frame, camera frames optical.
Arrays carry their dtype and shape in the field's metadata; -1 stands for a free dimension.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

# Tracking state in two words: odometry, map.
INITIALISING, OK, DEGRADED, LOST = "initialising", "ok", "degraded", "lost"
BUILDING, LOOP_CLOSED, RELOCALISING, LOCALISED = "building", "loop_closed", "relocalising", "localised"
RECOVERED = "recovered"

MOST_BIAS = 2.0  # of a network's log scale: a card says no more (docs/MODELS.md)

# Epochs, keyframes, points and map updates have numbers that never come again.
IDS_A_LIFE = 10**10  # a process's lives begin to number things so far apart: months of mapping in each
LARGEST_ID = 2**55  # of what comes from outside: gtsam has 56 bits for a number, and others follow it

# The part of a map that it began with. Any other bears the number of its first keyframe; where that one had
# been culled when the tracker was started again, of the first that was still there.
HOME = -1

_DIGEST = re.compile(r"@[0-9a-f]{12}")  # in a network's identity


def beyond(largest: int) -> int:
    """Where a map's numbers go on for who takes it over: past all that its last owner may have given out."""
    return (largest // IDS_A_LIFE + 1) * IDS_A_LIFE


def array(dtype: str, *shape: int) -> Any:
    """A required array field; the codec refuses any other dtype or shape."""
    return field(metadata={"dtype": dtype, "shape": shape})


def optional(dtype: str, *shape: int) -> Any:
    """An array field that is empty, or zeros where its shape is fixed, where it isn't given."""
    empty = tuple(max(n, 0) for n in shape)
    return field(
        default_factory=lambda: np.zeros(empty, dtype), metadata={"dtype": dtype, "shape": shape}
    )


def identity() -> Any:
    """A pose (4, 4) that is the identity where it isn't given."""
    return field(default_factory=lambda: np.eye(4), metadata={"dtype": "float64", "shape": (4, 4)})


@dataclass(frozen=True)
class Frame:
    """One camera image.

    ``image`` is the luma plane followed by the two half-size chroma planes (I420, (3 height / 2, width),
    width and height even) when ``colour``, else the grey image (height, width). ``camera`` describes
    the *valid* area; where an image of odd size was padded, the camera's own size is the smaller one.
    """

    index: int  # in the recording, from 0; gaps are frames that were dropped or unreadable
    stamp_ns: int  # capture, in the recording's or camera's own clock
    captured_monotonic_ns: int  # capture on this host's monotonic clock; a recording's scheduled release
    colour: bool
    duplicate: bool  # an exact copy of its predecessor
    camera_model: str
    camera: F64 = array("float64", -1)  # width height fx fy cx cy, then distortion
    image: U8 = array("uint8", -1, -1)
    readout_ms: float = math.nan  # of a rolling shutter, as the camera's file says; NaN: it doesn't


@dataclass(frozen=True)
class EndOfStream:
    """The source has nothing more to give; totals of what it saw."""

    frames: int  # in the recording
    released: int
    duplicates: int
    unreadable: int
    last_index: int  # of the last frame released, -1 for none


@dataclass(frozen=True)
class Tracked:
    """What became of one frame: the tick of lockstep, and what ties a frame to its keyframe."""

    index: int
    stamp_ns: int
    captured_monotonic_ns: int
    odometry: str  # initialising | ok | degraded | lost
    published: bool  # whether a pose went out
    keyframe: int  # created from this frame, -1 for none
    reference: int  # keyframe that carries this frame, -1 for none
    reference_from_camera: F64 = array("float64", 4, 4)  # map units
    dropped: int = 0  # frames so far that the tracker never got
    probe: bool = False  # lost: this frame's picture goes to the depth worker, to be recognised
    # What a published covariance has in common with that of a pose nearby: standard deviations
    scale_sigma: float = 0.0  # ... of the log scale, times the way from the start,
    drift_m: float = 0.0  # ... of the map's drift since its beginning, in metres
    drift_rad: float = 0.0  # ... and radians;
    walk_m: float = 0.0  # the same of `odom`, which nothing undoes: what it grows by between two frames
    walk_rad: float = 0.0  # ... is the drift of the motion between them


@dataclass(frozen=True)
class Keyframe:
    """A keyframe as the tracker made it, with what it observed; images travel apart.

    Observations are the keypoints that have a map point. New points are those since the keyframe
    before; points fused go from ``fused_from`` into ``fused_into``.
    """

    id: int
    index: int  # frame index
    stamp_ns: int
    epoch: int  # grows when tracking starts a new map
    camera_model: str
    camera: F64 = array("float64", -1)
    world_from_camera: F64 = array("float64", 4, 4)
    pixels: F32 = array("float32", -1, 2)  # of all keypoints, undistorted
    octaves: U8 = array("uint8", -1)
    descriptors: U8 = array("uint8", -1, 32)
    points: I64 = array("int64", -1)  # map point of each keypoint, -1 for none
    depths: F32 = array("float32", -1)  # of that point along z, map units; 0 for none
    parallax_deg: F32 = array("float32", -1)  # largest angle it was triangulated at; 0: seeded from depth
    new_points: I64 = array("int64", -1)
    new_positions: F64 = array("float64", -1, 3)
    new_by: I64 = array("int64", -1)  # keyframe that each was made from, and goes with
    late_points: I64 = array("int64", -1)  # observations added to earlier keyframes: point,
    late_keyframes: I64 = array("int64", -1)  # ... keyframe,
    late_keypoints: I64 = array("int64", -1)  # ... keypoint of it
    culled_points: I64 = array("int64", -1)
    culled_keyframes: I64 = array("int64", -1)
    fused_from: I64 = array("int64", -1)
    fused_into: I64 = array("int64", -1)
    anchor: int = -1  # the keyframe before, and where the tracker has it: what the poses here are relative to
    world_from_anchor: F64 = identity()
    trust: F32 = optional("float32", -1)  # weight in (0, 1] of each keypoint's point, 0 for none
    travelled: float = 0.0  # path length since start, map units
    log_scale: float = math.nan  # of the map's unit there, as the tracker had it (NaN: earlier builds)
    scale_factor: float = 1.2  # between pyramid levels: a keypoint is as much less precise a level up
    stands_in: bool = False  # for an older one that shows the same: what is there has been placed before
    part: int = HOME  # of the map: each has a unit of its own until it is joined to an older one
    kept: I64 = optional("int64", -1)  # all that the map has: others went, also where nobody heard of it
    joined: I64 = optional("int64", -1, 2)  # parts that were since the keyframe before: the newer, the older,
    joined_units: F64 = optional("float64", -1, 2)  # ... and of each what MapUpdate.loop_units says
    # How the camera moved, a second, in its own frame and map units, translation first; 0: nothing is known.
    twist: F64 = optional("float64", 6)
    readout_ms: float = 0.0  # of the rolling shutter that its keypoints were moved for,
    readout_said: bool = False  # ... and whether the camera's file, or the configuration, says so
    # Where the camera sat on the robot that began the map, metres: `map` is that times the map's world.
    base_from_camera: F64 = identity()


def probe_of(index: int) -> int:
    """The number under which the picture of a lost camera's frame travels; no keyframe has such a one."""
    return -2 - index


@dataclass(frozen=True)
class KeyframeImage:
    """The picture of a keyframe, for the depth worker alone."""

    keyframe: int  # below -1: a probe (:func:`probe_of`), of which only the descriptor is wanted
    index: int
    stamp_ns: int
    epoch: int
    colour: bool
    camera_model: str
    camera: F64 = array("float64", -1)
    image: U8 = array("uint8", -1, -1)  # as in Frame
    turns: int = 0  # counter-clockwise quarter turns that bring it nearest to upright (geometry/mount.py)


def same_network(one: str, other: str) -> bool:
    """Whether two identities may be one network's; maps of earlier builds have the bare name."""
    if _DIGEST.search(one) and _DIGEST.search(other):
        return one == other
    return _DIGEST.sub("", one) == _DIGEST.sub("", other)


@dataclass(frozen=True)
class Depth:
    """Metric depth of one keyframe at the network's resolution.

    Pixel (x, y) of the camera image is at (x * image_to_depth[0] + image_to_depth[1],
    y * image_to_depth[2] + image_to_depth[3]) of the map. Invalid pixels are 0.
    """

    keyframe: int
    stamp_ns: int
    epoch: int
    model: str  # identity of the network, NAME@DIGEST (depth/fingerprint.py)
    bias_sigma: float  # log-scale error of this network that never averages out
    inference_ms: float
    valid: bool  # False: the network's answer was unusable (all NaN, constant, ...)
    reason: str  # why not
    image_to_depth: F64 = array("float64", 4)
    depth: F32 = array("float32", -1, -1)  # metres
    confidence: F32 = array("float32", -1, -1)  # NaN: unknown; (0, 0) where the network gives none
    descriptor: F32 = array("float32", -1)  # of norm 1; empty where the network gives none
    dsug_tau: float = math.nan  # uncertainty gate as fitted for this network, nan where it is not
    dsug_temperature: float = math.nan
    frame_sigma: float = math.nan  # log-scale error that its pixels share; nan: scale.frame_sigma

    @property
    def says_bias(self) -> bool:
        """Whether ``bias_sigma`` is one that a card may have: a host that lends its depth may err."""
        return 0.0 <= self.bias_sigma <= MOST_BIAS


@dataclass(frozen=True)
class Scale:
    """Metres per map unit, in the log domain."""

    keyframe: int
    stamp_ns: int
    epoch: int
    log_scale: float  # as published: held near the estimate
    map_log_scale: float  # that the map is built by: held nearer to it
    sigma: float  # of log_scale, the network's bias included
    filter_sigma: float  # without that bias
    observation: float  # this keyframe's own log scale, nan for none
    observation_sigma: float
    points: int  # that it rests on
    accepted: bool
    bias_sigma: float = 0.0  # the network's, which is in sigma
    lost_sigma: float = 0.0  # of a network that doesn't know what it sees, which is in sigma too
    local_sigma: float = 0.0  # how far the map's log scale here may be from log_scale, beyond sigma
    network: str = ""  # whose depth it was learned from
    metric: bool = True  # whether depth has fixed or met the map's unit; else log_scale is a guess
    part: int = HOME  # of the map, whose unit it is

    @property
    def known_to(self) -> float:
        """Sigma of log_scale for who begins with it: without the bias, with what is held and contested."""
        apart = self.sigma**2 - self.bias_sigma**2 - self.lost_sigma**2
        return math.sqrt(max(apart, self.filter_sigma**2 + (self.log_scale - self.map_log_scale) ** 2))


@dataclass(frozen=True)
class Gate:
    """DSUG's weight w of each keypoint of a keyframe, and the uncertainty u that it follows from.

    Where nothing is known of a pixel, u is nan and w 1; so it is everywhere where the gate is off.
    """

    keyframe: int
    epoch: int
    weights: F32 = array("float32", -1)
    uncertainty: F32 = array("float32", -1)


@dataclass(frozen=True)
class MapUpdate:
    """What the backend changed: a delta, idempotent, ordered by (epoch, sequence)."""

    epoch: int
    sequence: int
    based_on: int  # newest keyframe the solve knew
    solve_ms: float
    keyframes: I64 = array("int64", -1)
    poses: F64 = array("float64", -1, 4, 4)
    points: I64 = array("int64", -1)
    positions: F64 = array("float64", -1, 3)
    parallax_deg: F32 = array("float32", -1)  # widest angle between the rays of each point
    dropped_keyframes: I64 = array("int64", -1)  # observations found to be wrong: keyframe,
    dropped_points: I64 = array("int64", -1)  # ... point
    loop_query: int = -1  # the loop that was closed: its newer keyframe, -1 for none,
    loop_candidate: int = -1  # ... and the older
    # Where that joined two parts: log of the newer one's unit in the older one's, which it now has; its sigma
    loop_units: F64 = optional("float64", -1)
    # It shows that points are one, and that keyframes see points of the other end: keyframe,
    fused_from: I64 = optional("int64", -1)
    fused_into: I64 = optional("int64", -1)
    added_keyframes: I64 = optional("int64", -1)
    added_points: I64 = optional("int64", -1)  # ... point,
    added_keypoints: I64 = optional("int64", -1)  # ... keypoint
    weights: F32 = optional("float32", -1)  # of each point, 0..1: how far it stands still; empty: as before
    camera: F64 = optional("float64", -1)  # as the backend has found it: all pixels through its lens
    readout_ms: float = 0.0  # of a rolling shutter that nobody has said, as the backend has found it
    everything: bool = False  # whether it names every keyframe that the backend has


@dataclass(frozen=True)
class Solved:
    """An adjustment that the backend has finished, and when (the host's monotonic clock): for reports."""

    everything: bool  # all keyframes, beside other work; else a window, at a stretch
    keyframes: int
    began_ns: int
    ended_ns: int
    cpu_s: float  # of this work alone


@dataclass(frozen=True)
class MapSnapshot:
    """The backend's map as reports need it (answer to a query)."""

    epoch: int
    sequence: int
    settled: bool  # the stream has ended and the last optimisation is in
    log_scale: float
    keyframes: I64 = array("int64", -1)
    poses: F64 = array("float64", -1, 4, 4)
    points: I64 = array("int64", -1)
    carried: int = 0  # how many of ``keyframes``, the last of them, have been culled and still carry frames
    away: I64 = optional("int64", -1)  # those that lie nowhere in it: of parts that no loop has joined
    grown: F64 = optional("float64", -1)  # by how much loops have lengthened each one's part since
    # Every loop that was accepted: the later keyframe's frame, the earlier one's, and what was measured then.
    loop_queries: I64 = optional("int64", -1)  # frame indices
    loop_candidates: I64 = optional("int64", -1)
    loop_poses: F64 = optional("float64", -1, 4, 4)  # candidate_from_query, map units
    loop_inliers: I64 = optional("int64", -1)
    base_from_camera: F64 = identity()  # as in Keyframe, of this map
    camera: F64 = optional("float64", -1)  # the newest keyframe's, with the lens that was found
    readout_ms: float = 0.0  # as in MapUpdate


@dataclass(frozen=True)
class WholeMap:
    """Everything the backend knows of the map (answer to a query): what a tracker goes on from."""

    epoch: int
    sequence: int  # of the newest update that is in it
    log_scale: float
    scale_sigma: float  # of log_scale, the network's bias included
    data: U8 = array("uint8", -1)  # as in a file: backend/map_file.py, backend/stored_map.py


@dataclass(frozen=True)
class MapLoaded:
    """The backend has taken up a stored map: the tracker asks for all of it, scale knows its unit.

    A scale process that was started again asks for that of the present one.
    """

    epoch: int
    log_scale: float
    scale_sigma: float  # the network's bias, and how lost it was, left out
    bias_sigma: float = 0.0
    network: str = ""  # whose depth log_scale was learned from
    metric: bool = True  # whether anything is known of the unit; else log_scale is a guess
    lost_sigma: float = 0.0


@dataclass(frozen=True)
class Epoch:
    """The epoch that the tracker is in (answer to a query): what comes after it must have a later one."""

    epoch: int


@dataclass(frozen=True)
class Acknowledged:
    """Lockstep: a process has done frame ``index`` and all the work that it caused."""

    process: str
    index: int


@dataclass(frozen=True)
class Heartbeat:
    """A process is alive: what it is doing, since when, and how long that may take."""

    process: str
    pid: int
    monotonic_ns: int
    state: str  # starting | ready | working | idle | ended
    activity: str
    activity_since_ns: int
    budget_s: float
    values: dict[str, str]  # shown on `health`: queue length, inference time, provider, ...
