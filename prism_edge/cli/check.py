"""What `run` would refuse of a configuration: what is wrong in it, and what this machine lacks for it."""

from __future__ import annotations

import os
from importlib.util import find_spec

from prism_edge.bus.access import check_settings, unreadable
from prism_edge.bus.certificates import mismatch
from prism_edge.bus.keys import check_loopback, check_robot_name
from prism_edge.cli.settings import with_network
from prism_edge.config import SENSOR, Config, NetworkConfig, SourceConfig, SupervisorConfig
from prism_edge.depth import locate, networks_of
from prism_edge.depth.providers import absent, check_names, idle_options
from prism_edge.errors import ConfigError, ModelError, SourceError
from prism_edge.geometry.unlikely_camera import doubts
from prism_edge.named_path import hindrance, named_path
from prism_edge.sources.camera_file import read_camera
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.live.oak import is_oak
from prism_edge.sources.live.open import check_mode, is_live
from prism_edge.sources.live.stream import is_stream
from prism_edge.sources.mask import mask_for, read_mask
from prism_edge.sources.open import AUTO, AUTO_NEEDS, camera_files, open_source
from prism_edge.sources.shrunk import shrunk_camera
from prism_edge.sources.sim import is_simulated
from prism_edge.supervisor.metrics import check_port
from prism_edge.supervisor.restart import least_s
from prism_edge.workers.sensor_network import depth_of


def check_config(config: Config) -> list[str]:
    """What is missing on this machine, or left to the command line: a line for each thing.

    Raises PrismError for what is wrong in the configuration itself, whichever machine it is for.
    """
    check_robot_name(config.robot)
    check_settings(config.network, config.bus.endpoint)
    check_port(config)
    check_mode(config)
    missing = _endpoint(config) + _certificates(config.network)
    missing += extras(config) + _restarts(config.supervisor)
    return missing + _source(config.source) + _model(with_network(config))


def extras(config: Config) -> list[str]:
    """Optional dependencies that it takes, and that are not installed."""
    wanted = {
        "metrics": ("prometheus_client", bool(config.metrics.port)),
        "oak": ("depthai", is_oak(config.source.uri)),
        "streams": ("av", is_stream(config.source.uri)),
    }
    return [
        f"{module.replace('_', '-')} is not installed, which this needs: pip install 'prism-edge[{extra}]'"
        for extra, (module, needed) in wanted.items()
        if needed and find_spec(module) is None
    ]


def _certificates(network: NetworkConfig) -> list[str]:
    """The service's key is there only while it runs."""
    missing = unreadable(network)
    wrong = "" if missing else mismatch(network)
    return [*missing, wrong] if wrong else missing


def _restarts(config: SupervisorConfig) -> list[str]:
    """A line where so many restarts don't fit into their window."""
    seconds = least_s(config)
    if seconds <= config.window_s:
        return []
    pauses = f"{config.max_restarts} restarts pause for {seconds:.0f} s, longer than supervisor.window_s"
    return [f"supervisor.max_restarts: {pauses} ({config.window_s:g}): what keeps dying is never given up"]


def _endpoint(config: Config) -> list[str]:
    """A file that names a source is one for `run`; another may be a client's, or a worker's elsewhere."""
    try:
        check_loopback(config.bus.endpoint)
    except ConfigError as error:
        if config.source.uri:
            raise
        return [f"{error}; `run` refuses it, for `watch`, `ctl` and `worker` it is right"]
    return []


def _source(source: SourceConfig) -> list[str]:
    if not source.uri:
        return []
    missing: list[str] = []
    if is_live(source.uri) or is_simulated(source.uri):
        open_source(source, calibrated=False)  # nothing is connected yet: only the address is read
    camera = None
    if source.camera != AUTO:
        named = [named_path(source.camera)] if source.camera else camera_files(source.uri)
        known = next((read_camera(path) for path in named if os.path.isfile(path)), None)
        camera = shrunk_camera(known, source.shrink) if known else None
    mask = named_path(source.mask)
    has_mask = bool(source.mask) and os.path.exists(mask)
    if source.mask and not has_mask:
        hindered = hindrance(mask)
        what = f"can't be read ({hindered})" if hindered else "is not there"
        missing.append(f"mask {source.mask} {what}")
    try:
        opened = open_source(source)
        camera = None if opened.camera is UNCALIBRATED else opened.camera  # connected, or estimated
        if not (opened.live or opened.synthetic):
            with opened:  # its first image tells whether it is this camera's
                pass
    except (ConfigError, SourceError) as error:
        missing.append(str(error))
    if has_mask and camera:
        mask_for(mask, camera.width, camera.height, source.shrink)
    elif has_mask:
        read_mask(mask)
    return missing + [f"camera: {doubt}" for doubt in (doubts(camera) if camera else [])]


def _sensor(source: SourceConfig) -> list[str]:
    """A line where a recording that is here has no depth images."""
    if not source.uri or is_simulated(source.uri) or not os.path.exists(named_path(source.uri)):
        return []
    try:
        depth_of(source)
    except ModelError as error:
        return [f"depth.model: {error}"]
    return []


def _model(config: Config) -> list[str]:
    check_names(config.depth)
    model = config.depth.network
    if config.source.uri and config.source.camera == AUTO and not model:
        return [AUTO_NEEDS]  # wherever depth runs, the source asks it, too
    if "depth" in config.network.remote:
        return []
    if model == SENSOR:
        if is_live(config.source.uri):
            needs = "recordings with depth images and simulated worlds"
            raise ConfigError(f"depth.model: {SENSOR} is for {needs}")
        return _sensor(config.source)
    missing = idle_options(config.depth) + absent(config.depth) if model else []
    if config.source.uri and not model:
        missing.append("depth.model: no network is named, and without one there are no poses")
    for network in networks_of(model) if model else []:
        try:
            locate(network)
        except ModelError as error:
            missing.append(str(error))
    return missing
