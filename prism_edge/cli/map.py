"""`prism-edge map`: what a saved map holds, and its path and points as files for others."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from prism_edge.all_or_nothing import put_whole
from prism_edge.cli.settings import a_path, add_configuration, config_from
from prism_edge.cli.whole_file import check_writable
from prism_edge.errors import ConfigError, MapError, say

if TYPE_CHECKING:
    from prism_edge.cli.map_opened import Opened

SUFFIX = ".prismmap"  # of map_file.py, which help does not wait for


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "map",
        help=help_line,
        description="Maps that `prism-edge ctl save_map` saved; no daemon need run. Exit code 10 where a "
        "file is no sound map.",
    )
    actions = parser.add_subparsers(dest="action", metavar="ACTION", required=True)

    def action(name: str, help: str, description: str) -> argparse.ArgumentParser:
        made: argparse.ArgumentParser = actions.add_parser(name, help=help, description=description)
        made.add_argument(
            "map",
            metavar="NAME_OR_FILE",
            help=f"a name as `ctl load_map` takes it, or a file: what has a slash or ends in {SUFFIX}",
        )
        return made

    what = "what a map holds, a line each"
    add_configuration(action("show", what, what))
    export = action(
        "export",
        "its keyframes' poses (TUM), its points (PLY), or both, in metres",
        "Write the keyframes' poses as the map has corrected them, or its points, or both: metres in the "
        "frame `map`, as `pose` is published. Parts of the map that nothing joins to its beginning have no "
        "place there and are left out.",
    )
    export.add_argument(
        "--tum",
        metavar="FILE",
        type=a_path,
        help="write the keyframes' poses, by their stamps (TUM format); refused (exit code 10) for a map "
        "that doesn't say when they were taken, as earlier builds' don't",
    )
    export.add_argument("--ply", metavar="FILE", type=a_path, help="write the points (binary PLY)")
    export.add_argument(
        "--of", choices=("camera", "base"), help="whose poses --tum has (default: camera); base: of the robot"
    )
    export.add_argument("--overwrite", action="store_true", help="replace files that are there")
    add_configuration(export)
    export.set_defaults(refuse=export.error)


def run(args: argparse.Namespace) -> int:
    """Describe or export; returns the exit code. Raises MapError for what is no sound map."""
    from prism_edge.cli.map_opened import opened

    if args.action == "show":
        from prism_edge.cli.map_show import described

        for line in described(opened(args.map, config_from(args))):
            print(line)
        return 0
    if args.tum is None and args.ply is None:
        args.refuse("nothing to write: give --tum FILE, --ply FILE, or both")
    if args.tum is None and args.of:
        args.refuse("--of says whose poses --tum FILE has: give that too")
    if args.tum is not None and args.ply is not None and args.tum.resolve() == args.ply.resolve():
        args.refuse("--tum and --ply name the same file")
    config = config_from(args)
    wanted = [path for path in (args.tum, args.ply) if path is not None]
    for path in wanted:
        if path.suffix == SUFFIX:
            raise ConfigError(f"{path}: files in {SUFFIX} are maps, which no export replaces: name another")
        check_writable(path, args.overwrite)
    _export(opened(args.map, config), args)
    return 0


def _export(found: Opened, args: argparse.Namespace) -> None:
    """Write what was asked for, each file whole or not at all. Raises MapError or OSError."""
    from prism_edge.evaluation.trajectory import Trajectory, tum_line
    from prism_edge.geometry.ply import ply

    metric, count = found.metric, len(found.metric.stamps)
    warning = f"{found.path}: warning: left out:"
    if metric.elsewhere:
        say(f"{warning} {metric.elsewhere} keyframes in parts whose place in map is not known")
    if args.tum is not None:
        rows = metric.trajectory(args.of == "base")
        if not rows:
            raise MapError(
                f"{found.path}: the map doesn't say when its keyframes were taken, as earlier builds' don't: "
                "it has no trajectory for --tum"
            )
        if len(rows) < count:
            say(f"{warning} {count - len(rows)} keyframes that an earlier build made, without a stamp")
        path = Trajectory.of(rows)
        lines = [tum_line(int(s), pose) for s, pose in zip(path.stamps, path.poses, strict=True)]
        put_whole(args.tum, "".join(lines).encode())
        print(f"{args.tum}: {len(rows)} keyframe poses of the {args.of or 'camera'}, metres in map")
    if args.ply is not None:
        whose = f"points of a prism_edge map of {count} keyframes, metres in its frame map"
        put_whole(args.ply, ply(whose, metric.points))
        print(f"{args.ply}: {len(metric.points)} points, metres in map")
