"""`prism-edge reconstruct`: a dense coloured cloud in metres from a finished map and its recording."""

from __future__ import annotations

import argparse
import math
from typing import TYPE_CHECKING, Any

from prism_edge.all_or_nothing import put_whole
from prism_edge.cli.settings import (
    BUNDLED,
    RECORDING_HELP,
    a_name,
    a_path,
    add_configuration,
    config_from,
    whole_from_one_to,
)
from prism_edge.cli.whole_file import check_writable
from prism_edge.errors import ConfigError, MapError, say

if TYPE_CHECKING:
    from prism_edge.cli.reconstruct_looks import Gathered
    from prism_edge.config import Config
    from prism_edge.reconstruction.dense import Options

VOXEL, AGREEING, WIDTH = 0.02, 3, 320
MOST_AGREEING = 9  # a keyframe, and the eight beside it that it is held to
LEAST_WIDTH, MOST_WIDTH = 64, 1920


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "reconstruct",
        help=help_line,
        description="Give every keyframe of a finished map a depth map, hold those to the map's points, to "
        "the pictures and to each other, and write what they agree on as one cloud of points with normals "
        "and colours: metres in the frame `map` (docs/RECONSTRUCTION.md). The camera is as the map knows it. "
        "No daemon need run.",
    )
    parser.add_argument("source", metavar="RECORDING", help=f"what the map was made of: {RECORDING_HELP}")
    parser.add_argument(
        "--map",
        metavar="NAME_OR_FILE",
        required=True,
        help="the map: as `ctl save_map` saved it, or an evaluation's map.prismmap",
    )
    parser.add_argument(
        "--model",
        metavar="MODEL",
        type=a_name,
        help="depth network, as `run` takes it; one without metres, or of several views, too "
        f"(default: depth.model, {BUNDLED} for simulated worlds)",
    )
    parser.add_argument("--out", metavar="FILE", type=a_path, required=True, help="PLY file to write")
    parser.add_argument(
        "--mask",
        metavar="FILE",
        type=a_name,
        help="image, black where the camera sees its own robot (as for `run`)",
    )
    parser.add_argument(
        "--voxel", metavar="METRES", type=_length, default=VOXEL, help=f"a point for each (default: {VOXEL})"
    )
    parser.add_argument(
        "--agree",
        metavar="N",
        type=whole_from_one_to(MOST_AGREEING),
        default=AGREEING,
        help=f"keyframes that must see a surface alike (default: {AGREEING}, at most {MOST_AGREEING})",
    )
    parser.add_argument(
        "--far", metavar="METRES", type=_length, default=math.inf, help="leave out what is farther away"
    )
    parser.add_argument(
        "--width",
        metavar="PIXELS",
        type=_width,
        default=WIDTH,
        help=f"width of the depth maps (default: {WIDTH}); more shows more, and takes longer",
    )
    parser.add_argument(
        "--no-pictures",
        action="store_true",
        help="don't compare pictures: the network's depth, held to the map's points alone",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a file that is there")
    add_configuration(parser)


def _length(text: str) -> float:
    try:
        metres = float(text)
    except ValueError:
        metres = 0.0
    if not 1e-4 <= metres <= 1e4:
        raise argparse.ArgumentTypeError(f"expected metres from 0.0001 to 10000, got {text!r}")
    return metres


def _width(text: str) -> int:
    width = whole_from_one_to(MOST_WIDTH)(text)
    if width < LEAST_WIDTH:
        raise argparse.ArgumentTypeError(f"expected {LEAST_WIDTH} to {MOST_WIDTH} pixels, got {text!r}")
    return width


def run(args: argparse.Namespace) -> int:
    """Read, reconstruct, write; the exit code. Raises MapError, SourceError, ModelError or ConfigError."""
    from prism_edge.cli.map_opened import opened
    from prism_edge.cli.reconstruct_looks import gather
    from prism_edge.evaluation.progress import Progress
    from prism_edge.geometry.ply import ply
    from prism_edge.reconstruction.dense import reconstruct
    from prism_edge.reconstruction.viewpoints import viewpoints

    if args.out.suffix.lower() != ".ply":
        raise ConfigError(f"{args.out}: what is written is a PLY file: give it that ending")
    check_writable(args.out, args.overwrite)
    config = config_from(args)
    found = opened(args.map, config)
    seen = viewpoints(found.world, found.metric)
    if not found.scale.is_known:
        say(f"{found.path}: warning: no depth has said how long its unit is: metres are a guess")
    if found.metric.elsewhere:
        count = found.metric.elsewhere
        say(f"warning: left out: {count} keyframes, in parts whose place in map is not known")
    if unstamped := found.metric.stamps.count(None):
        say(f"warning: left out: {unstamped} keyframes, whose stamps the map doesn't have")
    if not seen:
        raise MapError(f"{found.path}: none of its keyframes says when it was taken, or has a place in map")
    with Progress(None) as bar:

        def progress(what: str, done: int, of: int) -> None:
            bar.say(what, of)
            bar.at(done)

        gathered = gather(config, found.metric.mount, seen, args.width, progress)
        options = _options(args, config, gathered)
        beside = {view.keyframe: view.beside for view in seen}
        made = reconstruct(gathered.looks, beside, options, progress)
    for reason, count in gathered.without.items():
        say(f"warning: left out: {count} keyframes, {reason}")
    if made.beyond:
        say(f"warning: {made.beyond} pixels lie too far out for voxels of {args.voxel:g} m: take larger ones")
    points = made.cloud.points
    if not len(points):
        near = "" if math.isinf(args.far) else f" within {args.far:g} m"
        what = f"no surface{near} that {args.agree} keyframes agree on and the gate trusts"
        raise MapError(f"{found.path}: {what}: try a smaller --agree, or another network")
    size = points.max(axis=0) - points.min(axis=0)
    words = f"dense cloud of {len(gathered.looks)} keyframes by prism_edge, metres in its frame map"
    put_whole(args.out, ply(words, points, made.cloud.normals, made.cloud.colours))
    print(f"depth by {gathered.network}: {len(gathered.looks)} of {len(seen)} keyframes of {found.path}")
    if options.by_pictures:
        print(f"pictures say the depth of {made.sure:.0%} of their pixels")
    print(f"{made.kept:.0%} of the pixels agree")
    extent = " x ".join(f"{length:.2f}" for length in size)
    print(f"{args.out}: {len(points)} points, {extent} m along map's axes")
    return 0


def _options(args: argparse.Namespace, config: Config, gathered: Gathered) -> Options:
    from prism_edge.reconstruction.dense import Options
    from prism_edge.scale.gate_keyframes import gate_parameters

    return Options(
        voxel=args.voxel,
        agreeing=args.agree,
        farthest=args.far,
        by_pictures=not (args.no_pictures or gathered.is_measured),
        gate=None if "dsug" in config.ablate else gate_parameters(config.gate, *gathered.dsug),
    )
