"""Everything that can be set: one typed tree whose defaults need no file, overlaid by YAML."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


def limits(default: Any, low: float, high: float, help: str, least: float | None = None) -> Any:
    """A dataclass field with bounds (inclusive) that the loader enforces, and a line of help.

    ``least``: where 0 has a meaning of its own, the smallest number beside it.
    """
    return field(default=default, metadata={"low": low, "high": high, "help": help, "least": least})


def one_of(default: str, *choices: str, help: str = "") -> Any:
    """A dataclass field that takes one of a few words."""
    return field(default=default, metadata={"choices": choices, "help": help})


def text(default: str, help: str) -> Any:
    """A dataclass field of free text."""
    return field(default=default, metadata={"help": help})


def named(default: str, help: str) -> Any:
    """A dataclass field of a name: not empty, no slash in front, and no two of its section alike."""
    return field(default=default, metadata={"name": True, "help": help})


def section(tree: type, *reload: str) -> Any:
    """A section of the tree; ``reload``: who takes its keys up when the daemon is told to reload (SIGHUP).

    A process starts anew with them; the supervisor takes them up as it runs. None: only a restart will do.
    A key of its own ``reload`` goes by that.
    """
    return field(default_factory=tree, metadata={"reload": reload})


NO_NETWORK = "none"  # depth.model: no depth network, also where one would be taken by default
WITHOUT_NETWORK = (
    "has no network (--model, depth.model): no map begins, so no pose comes unless one is loaded"
)
SENSOR = "sensor"  # depth.model: the recording's own depth images in a network's place

# Parts that can be switched off to see what they are worth.
ABLATIONS = {
    "kalman": "the scale filter: the last observation is the estimate",
    "wls": "the weighted least squares: an observation is a plain mean",
    "depth_factor": "metric depth in bundle adjustments",
    "loop": "place recognition and loop closure",
    "init": "the first two views' structure: the second keyframe waits for nothing",
    "dsug": "the uncertainty gate: depth weighs alike at every pixel",
    "consistency": "the trust that points earn: all weigh alike, however long they have stood",
    "plucker": "the ray-distance factor: points that rest on depth keep their reprojections",
    "lens": "the search for radial distortion that the camera file lacks",
}


@dataclass(frozen=True)
class SourceConfig:
    """Where frames come from."""

    uri: str = text("", "folder of a dataset or of images, a video file, or a camera's address")
    camera: str = text("", "camera file (YAML); auto: as the network sees it; empty: what the recording says")
    mask: str = text("", "image, black where the camera sees its own robot or writing; empty: none")
    rate_hz: float = limits(
        0.0, 0.0, 1000.0, "play at this rate; 0: the recording's own stamps, else 30 Hz", least=0.01
    )
    shrink: int = limits(1, 1, 8, "images are made so many times smaller, each way; 1: as they come")
    frames: int = limits(0, 0, 10**9, "play no more than the first so many frames of a recording; 0: all")
    wait_s: float = limits(0.0, 0.0, 3600.0, "release the first frame no sooner than this after ready")
    absent_s: float = limits(10.0, 0.0, 45.0, "longest wait, at the start, for a camera's first image")
    peers_s: float = limits(30.0, 0.0, 3600.0, "longest wait for the run's other processes; 0: none")
    loop: bool = field(default=False, metadata={"help": "start again at the end, with continuing stamps"})


@dataclass(frozen=True)
class BusConfig:
    """The Zenoh session that joins the processes, and that subscribers join."""

    endpoint: str = text("tcp/127.0.0.1:7447", "the supervisor's listener, on loopback or a socket file")
    retry_ms: int = limits(200, 10, 5000, "pause between attempts to reach the listener")


@dataclass(frozen=True)
class NetworkConfig:
    """The robot's network: closed until ``endpoint`` opens it (docs/SECURITY.md)."""

    endpoint: str = text("", "second listener, such as tls/0.0.0.0:7448; empty: this host alone")
    ca: str = text("", "certificate of the lab's authority (PEM)")
    certificate: str = text("", "this end's certificate (PEM), which the other end asks for")
    key: str = text("", "its private key (PEM)")
    operators: tuple[str, ...] = field(
        default=(), metadata={"help": "names in the certificates of those who may command"}
    )
    remote: tuple[str, ...] = field(
        default=(), metadata={"help": "processes that run on another host, such as depth"}
    )


@dataclass(frozen=True)
class TrackingConfig:
    """The ORB tracker (the paper has N_f = 1000; an even spread needs fewer: docs/PERFORMANCE.md)."""

    features: int = limits(600, 100, 5000, "ORB features kept a frame of 640 x 480; larger ones more")
    max_features: int = limits(1400, 200, 10000, "and when few match: a fast motion, a low rate; never fewer")
    levels: int = limits(6, 1, 12, "pyramid levels")
    scale_factor: float = limits(1.3, 1.05, 2.0, "ratio between pyramid levels")
    fast_threshold: int = limits(
        10, 1, 25, "lowest FAST threshold; it rises with the texture, to 25 at most"
    )
    readout_ms: float = limits(
        0.0, -100.0, 100.0, "rolling shutter: first row to last; below 0: last first; 0: as said or found"
    )
    min_matches: int = limits(25, 6, 1000, "fewer inliers than this and tracking is lost")
    lost_after_s: float = limits(0.3, 0.0, 10.0, "failing for longer than this is `lost`")
    submap_after_s: float = limits(
        3.0, 0.0, 3600.0, "a camera lost for so long maps on its own; a younger map gives way; 0: never"
    )
    keyframe_ratio: float = limits(0.8, 0.1, 1.0, "new keyframe when matches fall below this share")
    keyframe_min_s: float = limits(0.15, 0.0, 10.0, "least time between keyframes; 0.05 where few match")
    keyframe_max_s: float = limits(
        1.5, 0.0, 60.0, "a moving camera makes a keyframe at least this often; not in a known place"
    )
    max_local_points: int = limits(5000, 100, 50_000, "map points projected into a frame at most")
    proven_after_s: float = limits(
        1.5, 0.0, 60.0, "age at which a point weighs fully; 0: all weigh alike", least=0.001
    )
    two_views: bool = field(
        default=True, metadata={"help": "a map's second keyframe waits for parallax, and checks the depth"}
    )
    adjust_unheard: int = limits(
        3, 0, 100, "with so many keyframes that no correction knows yet, they are adjusted here; 0: never"
    )
    max_keyframes: int = limits(
        600, 10, 100_000, "keyframes the local map keeps at most; fewer than 12 close no loop"
    )
    redundant_keyframes: int = limits(
        200, 10, 100_000, "beyond so many, a keyframe goes where older and newer ones see 90 % of its points"
    )


@dataclass(frozen=True)
class CovarianceConfig:
    """What published poses say of their errors (fitted on the simulator: docs/COVARIANCE.md)."""

    refinement: float = limits(1.0, 0.01, 100.0, "factor on the covariance that a frame's own points give")
    moment_ms: float = limits(
        20.0, 0.0, 1000.0, "and what the camera moves in so long: a pose may be that of a moment aside"
    )
    drift_of_motion: float = limits(
        0.07, 0.0, 1.0, "drift of position in a second, as a share of the way in it, at a degree of parallax"
    )
    drift_per_sqrt_m: float = limits(
        0.001, 0.0, 1.0, "and metres per square root of a metre travelled, however slowly"
    )
    drift_per_sqrt_rad: float = limits(
        0.01, 0.0, 1.0, "drift of orientation, radians per square root of a radian turned, at that, too"
    )
    turn_per_sqrt_m: float = limits(
        0.001, 0.0, 1.0, "and radians per square root of a metre travelled"
    )
    turn_of_motion: float = limits(
        1.0, 0.0, 10.0, "and of what a way across the view is off by, as an angle at the scene's depth"
    )


@dataclass(frozen=True)
class DepthConfig:
    """The ONNX worker."""

    model: str = field(
        default="",
        metadata={
            "help": "ONNX file, registry name, nested:RELATIVE,METRIC, sensor (an RGB-D recording's or "
            "simulated world's own depth: not monocular) or none; empty: the one that comes with prism_edge "
            "for simulated worlds, else none",
            "reload": ("depth", "scale"),  # another network, other metres
        },
    )
    providers: tuple[str, ...] = field(
        default=("cpu",),
        metadata={"help": "execution providers, tried in order: tensorrt, cuda, openvino, qnn, cpu"},
    )
    required: tuple[str, ...] = field(
        default=(), metadata={"help": "those of them whose absence is an error; the others are passed over"}
    )
    provider_options: tuple[str, ...] = field(
        default=(), metadata={"help": "their options, PROVIDER.KEY=VALUE, such as cuda.device_id=1"}
    )
    engine_cache: str = text("", "folder of compiled engines; empty: prism-edge/engines in the user's cache")
    threads: int = limits(1, 1, 64, "threads of one inference")
    spinning: bool = field(
        default=False, metadata={"help": "threads wait for work at full load: faster, and never idle"}
    )
    arena: bool = field(
        default=True, metadata={"help": "keep an inference's memory for the next: faster, takes more"}
    )

    @property
    def network(self) -> str:
        """What ``model`` names; empty where that is no network."""
        return "" if self.model == NO_NETWORK else self.model


@dataclass(frozen=True)
class ScaleConfig:
    """The log-domain scale filter (paper, section 3.3; noise model measured, see docs)."""

    min_parallax_deg: float = limits(1.0, 0.1, 45.0, "triangulation angle a point needs to count")
    min_points: int = limits(15, 3, 1000, "points an observation needs")
    point_sigma: float = limits(0.25, 0.01, 2.0, "log-depth noise sigma_0 of one patch of a network's image")
    frame_sigma: float = limits(0.15, 0.0, 2.0, "log-scale noise that a keyframe's pixels share")
    correlation_s: float = limits(2.0, 0.0, 60.0, "time constant of that noise's autocorrelation")
    drift_per_sqrt_m: float = limits(0.003, 0.0, 1.0, "random walk of log scale with distance")
    drift_per_sqrt_s: float = limits(0.0005, 0.0, 1.0, "random walk of log scale with time")
    initial_sigma: float = limits(0.3, 0.01, 2.0, "log-scale sigma before any observation")
    hold_sigmas: float = limits(0.6, 0.0, 3.0, "the published scale holds while the estimate is this near")
    gate_sigmas: float = limits(4.0, 1.0, 100.0, "an innovation beyond this is an outlier")


@dataclass(frozen=True)
class GateConfig:
    """Dynamic scene uncertainty gating (paper, section 3.2; docs/GATE.md)."""

    alpha: float = limits(0.5, 0.0, 1.0, "share of u_spatial in u, where the network gives confidence")
    tau: float = limits(0.0, 0.0, 10.0, "uncertainty at which a weight is 1/2; 0: the network's own")
    temperature: float = limits(
        0.0, 0.0, 10.0, "softness of the gate; 0: the network's own", least=0.000001
    )
    memory: int = limits(4, 1, 20, "earlier keyframes that a new one is compared with")
    images: bool = field(default=False, metadata={"help": "publish u and w of each keyframe as images"})


@dataclass(frozen=True)
class BackendConfig:
    """Window bundle adjustment (paper, appendix A: W = 12, 15 iterations, Huber 0.05 / 0.1 m)."""

    window: int = limits(12, 2, 100, "keyframes optimised together")
    fixed: int = limits(8, 1, 100, "older covisible keyframes held fixed beside them")
    iterations: int = limits(15, 1, 100, "Levenberg-Marquardt iterations at most")
    observations: int = limits(200, 20, 2000, "observations a keyframe at most")
    pixel_sigma: float = limits(1.0, 0.1, 10.0, "keypoint noise at pyramid level 0 (pixels)")
    huber_pixels: float = limits(2.45, 0.1, 50.0, "Huber threshold of a reprojection, in sigmas")
    depth_sigma: float = limits(
        0.6, 0.01, 5.0, "relative noise of a depth, what a network's pixels share included"
    )
    huber_depth_m: float = limits(0.1, 0.001, 10.0, "Huber threshold of a depth residual (m)")
    loops: bool = field(default=True, metadata={"help": "recognise places seen before, and close loops"})
    lens: bool = field(
        default=True, metadata={"help": "find and take out radial distortion that the camera file lacks"}
    )
    shutter: bool = field(
        default=True, metadata={"help": "take out a rolling shutter that is found where nobody has said one"}
    )
    loop_inliers: int = limits(30, 10, 1000, "points that must agree on a loop")
    ray_sigma_m: float = limits(
        0.01, 1e-4, 1.0, "noise of a point's distance from a ray (m), no less than a pixel"
    )
    huber_ray_m: float = limits(
        0.05, 0.001, 10.0, "Huber threshold of that distance (m); as many sigmas where those are a pixel's"
    )
    max_carried: int = limits(10_000, 0, 1_000_000, "poses kept of culled keyframes, the last culled")


@dataclass(frozen=True)
class LockstepConfig:
    """Fixed lags, in frames, with which lockstep applies asynchronous results."""

    depth_lag: int = limits(3, 0, 100, "frames from a keyframe to its depth and scale")
    map_lag: int = limits(6, 0, 1000, "frames from a keyframe to the backend's map update")


@dataclass(frozen=True)
class SupervisorConfig:
    """Starting, watching, restarting."""

    stop_s: float = limits(2.0, 0.1, 60.0, "time processes get to end before they are killed")
    start_s: float = limits(
        60.0, 5.0, 600.0, "time processes get to become ready; what is above 60 s each of its parts gets, too"
    )
    max_restarts: int = limits(5, 0, 1000, "restarts of one process within the window before giving up")
    window_s: float = limits(60.0, 1.0, 86_400.0, "that window")
    backoff_s: float = limits(
        0.2, 0.0, 10.0, "pause before the first restart; doubles with each, to 10 s at most"
    )


@dataclass(frozen=True)
class StateConfig:
    """What is kept from run to run (docs/OPERATIONS.md)."""

    directory: str = text(
        "", "folder of maps and journal; empty: systemd's, or ~/.local/state/prism-edge (maps alone)"
    )
    journal: bool = field(
        default=True, metadata={"help": "a backend that was started again recovers its map from a journal"}
    )
    recover_s: float = limits(
        600.0, 0.0, 1e6, "go on in the map of a live camera's run that was cut off no longer ago; 0: never"
    )


@dataclass(frozen=True)
class LogConfig:
    """One line for each event that matters (docs/OPERATIONS.md)."""

    form: str = one_of("auto", "auto", "text", "journal", help="auto: journal where stderr goes there")
    level: str = one_of("info", "debug", "info", "warning", "error", help="the least that is logged")


@dataclass(frozen=True)
class MetricsConfig:
    """Prometheus metrics, on this host alone (docs/OPERATIONS.md)."""

    port: int = limits(0, 0, 65535, "http://127.0.0.1:PORT/metrics; 0: none")


@dataclass(frozen=True)
class FramesConfig:
    """Names and placement of published frames (REP 103 and 105)."""

    map: str = named("map", "global frame")
    odom: str = named("odom", "continuous frame")
    base_link: str = named("base_link", "the robot (x forward, y left, z up)")
    camera: str = named("camera_optical", "the camera (x right, y down, z forward)")
    base_from_camera_xyz: tuple[float, ...] = field(
        default=(0.0, 0.0, 0.0),
        metadata={
            "length": 3,
            "low": -20.0,
            "high": 20.0,
            "measure": "metres",
            "help": "camera position on the robot (m)",
        },
    )
    base_from_camera_xyzw: tuple[float, ...] = field(
        default=(-0.5, 0.5, -0.5, 0.5),
        metadata={
            "length": 4,
            "unit": True,
            "help": "camera orientation on the robot (quaternion x y z w); the network sees pictures upright",
        },
    )


@dataclass(frozen=True)
class Config:
    """The whole tree; what `prism-edge config` prints and every worker is given."""

    robot: str = text("robot", "name in the topics: prism/<robot>/...")
    mode: str = one_of("realtime", "realtime", "lockstep", help="newest frame wins, or nothing is dropped")
    seed: int = limits(0, 0, 2**31 - 1, "seed of everything random")
    ablate: tuple[str, ...] = field(
        default=(),
        metadata={"choices": tuple(ABLATIONS), "help": f"parts switched off: {', '.join(ABLATIONS)}"},
    )
    source: SourceConfig = field(default_factory=SourceConfig)
    bus: BusConfig = field(default_factory=BusConfig)
    network: NetworkConfig = field(default_factory=NetworkConfig)
    frames: FramesConfig = field(default_factory=FramesConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    covariance: CovarianceConfig = field(default_factory=CovarianceConfig)
    depth: DepthConfig = section(DepthConfig, "depth")
    scale: ScaleConfig = section(ScaleConfig, "scale")
    gate: GateConfig = section(GateConfig, "scale")
    backend: BackendConfig = section(BackendConfig, "backend")
    lockstep: LockstepConfig = field(default_factory=LockstepConfig)
    supervisor: SupervisorConfig = section(SupervisorConfig, "supervisor")
    state: StateConfig = field(default_factory=StateConfig)
    log: LogConfig = field(default_factory=LogConfig)
    metrics: MetricsConfig = field(default_factory=MetricsConfig)

    @property
    def is_lockstep(self) -> bool:
        """Whether frames wait for everybody."""
        return self.mode == "lockstep"
