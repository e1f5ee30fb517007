"""From an address to the live camera it names; a kind's library is loaded only once it connects."""

from __future__ import annotations

from dataclasses import replace

from prism_edge.config import Config, SourceConfig
from prism_edge.errors import ConfigError
from prism_edge.geometry.cameras import Camera
from prism_edge.named_path import named_path
from prism_edge.sources.camera_file import read_camera
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.live.camera import LiveCamera, Timing
from prism_edge.sources.live.driver import Driver
from prism_edge.sources.live.oak import OakDriver, is_oak
from prism_edge.sources.live.stream import StreamDriver, is_stream
from prism_edge.sources.live.v4l2 import V4l2Driver, is_v4l2


def is_live(uri: str) -> bool:
    """Whether an address names a live camera."""
    return is_stream(uri) or is_v4l2(uri) or is_oak(uri)


def check_mode(config: Config) -> None:
    """Raises ConfigError where a live camera is to be played in lockstep."""
    if config.is_lockstep and is_live(config.source.uri):
        raise ConfigError("a live camera can't wait for lockstep: use mode realtime, or a recording")


def open_live(config: SourceConfig, calibrated: bool = True) -> LiveCamera:
    """The camera that a configuration names, not connected yet.

    Raises SourceError where the address is wrong, and ConfigError where a setting is that of recordings
    or the intrinsics are missing.
    """
    unfit = {"source.loop": config.loop, "source.rate_hz": config.rate_hz, "source.frames": config.frames}
    for key, given in unfit.items():
        if given:
            raise ConfigError(f"{key} is for recordings; a live camera runs at its own rate, without end")
    camera = read_camera(named_path(config.camera)) if config.camera and calibrated else None
    driver = _driver(config.uri, camera)
    timing = replace(Timing(), absent_s=config.absent_s)
    if not calibrated:
        return LiveCamera(driver, UNCALIBRATED, "not calibrated", timing)
    if camera is not None:
        return LiveCamera(driver, camera, config.camera, timing)
    if is_oak(config.uri):
        return LiveCamera(driver, None, "the device's factory calibration", timing)
    raise ConfigError(
        f"{driver.name} needs a camera file (--camera FILE); prism-edge calibrate makes one"
    )


def _driver(uri: str, camera: Camera | None) -> Driver:
    if is_oak(uri):
        return OakDriver(uri, camera)
    if is_v4l2(uri):
        return V4l2Driver(uri, camera)
    return StreamDriver(uri)
