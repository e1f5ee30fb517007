"""Options that end up in the configuration, shared by the subcommands that take one."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from prism_edge.config import NO_NETWORK, SENSOR, BusConfig, Config
from prism_edge.config_file import load
from prism_edge.errors import ConfigError

_RECORDED = "folder of a dataset (TUM RGB-D, BONN, 7-Scenes, KITTI odometry) or of images, a video file"
RECORDING_HELP = f"{_RECORDED}, or a simulated world such as sim:room"
SOURCE_HELP = (
    f"{_RECORDED}, a camera (v4l2:/dev/video0, oak:, rtsp://HOST/PATH, http://HOST/PATH), "
    "or a simulated world such as sim:room"
)

FREE_PORT = "a free port of loopback, for runs side by side"  # where an evaluation's daemon listens
BUNDLED = "prism_nano"  # the network that comes with prism_edge (docs/PRISM_NANO.md)


def a_path(name: str) -> Path:
    """An option's file or folder. ArgumentTypeError for an empty name, which would be where one stands."""
    if not name:
        raise argparse.ArgumentTypeError("expected a file or folder, got an empty name")
    return Path(name)


def a_name(name: str) -> str:
    """An option's text. ArgumentTypeError for an empty one, as of a variable that isn't set."""
    if not name:
        raise argparse.ArgumentTypeError("expected a name, got an empty one")
    return name


def whole_above_zero(text: str) -> int:
    """An option's number of things. Raises ArgumentTypeError, which ends with exit code 2."""
    if not (text.isascii() and text.isdigit() and 0 < int(text) < 2**31):
        raise argparse.ArgumentTypeError(f"expected a whole number above 0, and below 2^31, got {text!r}")
    return int(text)


def whole_from_zero(text: str) -> int:
    """The same where none at all will do, too."""
    return 0 if text == "0" else whole_above_zero(text)


def whole_from_one_to(most: int) -> Callable[[str], int]:
    """What takes an option's whole number from 1 to ``most``, as :func:`whole_above_zero` does."""

    def taken(text: str) -> int:
        if whole_above_zero(text) > most:
            raise argparse.ArgumentTypeError(f"expected a whole number from 1 to {most}, got {text!r}")
        return int(text)

    return taken


def seconds_above_zero(text: str) -> float:
    """An option's time in seconds. Raises ArgumentTypeError, which ends with exit code 2."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = 0.0
    if not 0.0 < seconds <= 86_400.0:
        raise argparse.ArgumentTypeError(f"expected seconds above 0, a day at most, got {text!r}")
    return seconds


def add_common(parser: argparse.ArgumentParser, endpoint: str = BusConfig().endpoint) -> None:
    """--robot, --endpoint, and what :func:`add_configuration` adds; ``endpoint``: the default, in words."""
    parser.add_argument("--robot", metavar="NAME", help="name in the topics prism/NAME/... (default: robot)")
    parser.add_argument(
        "--endpoint", metavar="ENDPOINT", help=f"Zenoh endpoint of the daemon (default: {endpoint})"
    )
    add_configuration(parser)


def add_configuration(parser: argparse.ArgumentParser) -> None:
    """--config and --set."""
    parser.add_argument("--config", metavar="FILE", help="configuration file (YAML); options win over it")
    parser.add_argument(
        "--set",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help="set any key of the configuration, such as --set depth.threads=2; may be repeated",
    )


def add_input(parser: argparse.ArgumentParser) -> None:
    """What is played and how: an optional SOURCE, --loop, and what :func:`add_playing` adds."""
    parser.add_argument("source", metavar="SOURCE", nargs="?", help=SOURCE_HELP)
    add_playing(parser)
    parser.add_argument("--loop", action="store_true", help="start the recording again at its end")


def add_playing(parser: argparse.ArgumentParser) -> None:
    """--model, --camera, --mask, and what :func:`add_order` adds."""
    parser.add_argument(
        "--model",
        metavar="MODEL",
        type=a_name,
        help="depth network: ONNX file, known name, nested:RELATIVE,METRIC, "
        f"{SENSOR} (an RGB-D recording's or a simulated world's own depth: not monocular) or {NO_NETWORK} "
        f"(default: {BUNDLED} for simulated worlds, else {NO_NETWORK})",
    )
    parser.add_argument(
        "--camera",
        metavar="FILE",
        type=a_name,
        help="camera file (YAML or ROS camera_info); auto: as the network sees it",
    )
    parser.add_argument(
        "--mask",
        metavar="FILE",
        type=a_name,
        help="image, black where the camera sees its own robot (`prism-edge mask`)",
    )
    add_order(parser)


def add_order(parser: argparse.ArgumentParser) -> None:
    """--lockstep and --seed."""
    parser.add_argument(
        "--lockstep", action="store_true", help="drop no frame: the next waits until all have done the last"
    )
    parser.add_argument("--seed", metavar="N", help="seed of everything random (default: 0)")


def config_from(args: argparse.Namespace) -> Config:
    """Defaults, then --config, then --set, then the options of their own. Raises ConfigError."""
    overrides: dict[str, Any] = {}
    for setting in args.set:
        key, equals, value = setting.partition("=")
        if not equals:
            raise ConfigError(f"--set {setting}: expected KEY=VALUE, such as --set depth.threads=2")
        overrides[key.strip()] = value
    options = {
        "robot": getattr(args, "robot", None),
        "bus.endpoint": getattr(args, "endpoint", None),
        "source.uri": getattr(args, "source", None),
        "source.camera": getattr(args, "camera", None),
        "source.mask": getattr(args, "mask", None),
        "depth.model": getattr(args, "model", None),
        "seed": getattr(args, "seed", None),
    }
    overrides |= {key: value for key, value in options.items() if value is not None}
    if getattr(args, "lockstep", False):
        overrides["mode"] = "lockstep"
    if getattr(args, "loop", False):
        overrides["source.loop"] = True
    return with_network(load(args.config, overrides))


def endpoint_given(args: argparse.Namespace) -> bool:
    """Whether the command line names an endpoint, be it the default one."""
    return args.endpoint is not None or is_set(args, "bus.endpoint")


def source_given(args: argparse.Namespace) -> bool:
    """Whether the command line names what is to be played."""
    return args.source is not None or is_set(args, "source.uri")


def is_set(args: argparse.Namespace, key: str) -> bool:
    """Whether --set gives a value to the configuration's ``key``."""
    return any(setting.partition("=")[0].strip() == key for setting in args.set)


def find_networks(config: Config) -> None:
    """Raises ModelError where the networks that are to run on this host are not there to be run."""
    if config.depth.network in ("", SENSOR) or "depth" in config.network.remote:
        return
    from prism_edge.depth import locate, networks_of

    for network in networks_of(config.depth.network):
        locate(network)


def with_network(config: Config) -> Config:
    """The configuration with the bundled network where a simulated world is played and none is named.

    A real camera gets none by default: the bundled one has only ever seen simulated rooms.
    """
    if config.depth.model:
        return config
    from prism_edge.sources.sim import is_simulated

    model = BUNDLED if is_simulated(config.source.uri) else ""
    return replace(config, depth=replace(config.depth, model=model))
