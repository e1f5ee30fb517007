"""`prism-edge calibrate`: a camera file from views of a calibration board."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prism_edge.all_or_nothing import put_whole
from prism_edge.cli.settings import a_path
from prism_edge.cli.whole_file import check_writable
from prism_edge.config import SourceConfig
from prism_edge.errors import CalibrationError, ConfigError
from prism_edge.geometry.cameras import FISHEYE, PINHOLE

if TYPE_CHECKING:
    from prism_edge.calibration.board import Board
    from prism_edge.cli.board_views import Gathered


OUT = Path("camera.yaml")


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "calibrate",
        help=help_line,
        description="Find a printed board in the images of SOURCE and work out the camera's intrinsics from "
        "them. SOURCE is a folder of images, a video, or a live camera, at the very size (and focus) that "
        "the daemon is to run with. Hold the flat board in 20 or more places: near enough to fill a third "
        "of the image, in all its corners, and tilted by 20 to 45 degrees. Views that don't suffice are "
        "refused with the reason (exit code 9).",
    )
    parser.add_argument("source", metavar="SOURCE", help="recording, or camera such as v4l2:/dev/video0")
    parser.add_argument(
        "--board",
        metavar="BOARD",
        default="chessboard:9x6",
        help="chessboard:9x6 (inner corners; the default), or charuco:7x5,4X4_50,0.75 (squares, "
        "dictionary, marker/square); the size of the squares doesn't matter",
    )
    parser.add_argument(
        "--model", choices=(PINHOLE, FISHEYE), default=PINHOLE, help="lens model (default: pinhole)"
    )
    parser.add_argument(
        "--out", metavar="FILE", type=a_path, default=OUT, help=f"camera file to write (default: {OUT})"
    )
    parser.add_argument(
        "--picture",
        metavar="FILE",
        type=a_path,
        help="picture of the coverage (default: beside the file, .coverage.png)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files that are there")


def run(args: argparse.Namespace) -> int:
    """Gather, solve, judge, write. Raises ConfigError, SourceError or CalibrationError."""
    from prism_edge.calibration.board import Board
    from prism_edge.cli.board_views import gather
    from prism_edge.sources.image_folder import coverage_of, refused_coverage_of
    from prism_edge.sources.listing import files_in
    from prism_edge.sources.open import open_source

    board = Board.parse(args.board)
    out = args.out
    check_writable(out, args.overwrite)
    picture = args.picture or coverage_of(out)
    # A picture without a camera file is that of a run that was refused: the next one takes its place.
    left_over = not args.picture and picture not in map(coverage_of, files_in(out.parent))
    check_writable(picture, args.overwrite or left_over)
    if out.resolve() == picture.resolve():
        raise ConfigError(f"{out} can't be both the camera file and the picture")
    source = open_source(SourceConfig(uri=args.source), calibrated=False)
    if source.synthetic:
        raise ConfigError("a simulated camera knows its intrinsics; there is no board in its world")
    with source:
        print(f"looking for {args.board} in {source.name}", flush=True)
        gathered = gather(source, board, lambda line: print(line, flush=True), args.model)
    # What a refused try shows is not to take the place of what belongs to the camera file that stays.
    refused = refused_coverage_of(out) if out.exists() else picture
    return _finish(args, board, gathered, source.name, out, picture, refused)


def _finish(
    args: argparse.Namespace, board: Board, gathered: Gathered, name: str, out: Path, picture: Path,
    refused: Path,
) -> int:
    import cv2

    from prism_edge.calibration import coverage, verdict
    from prism_edge.calibration.camera_text import camera_text
    from prism_edge.calibration.solve import calibrate

    seen = gathered.found
    if not seen:
        raise CalibrationError(
            f"{args.board} was found in none of {gathered.looked} images: is it the board named, flat, sharp "
            "and wholly in the image? (a chessboard is named by its inner corners)"
        )
    chosen = gathered.different()
    views = [gathered.views[k] for k in chosen]
    width, height = gathered.width, gathered.height
    outlines = [gathered.outlines[k] for k in chosen]
    encoded = cv2.imencode(".png", coverage.draw(views, outlines, width, height))[1]
    put_whole(refused, encoded.tobytes())  # it shows why
    _refuse(verdict.of_views(views, seen, width, height), refused)
    result = calibrate(board, views, width, height, args.model)
    drawn = cv2.imencode(".png", coverage.draw(views, outlines, width, height, result))[1].tobytes()
    put_whole(refused, drawn)
    camera, used = result.camera, [views[k] for k in result.used]
    print(f"board found in {seen} of {gathered.looked} images, {len(used)} different views used")
    print(f"reprojection error {result.rms:.3f} pixels (rms)")
    for label, value, sigma in zip(
        ("fx", "fy", "cx", "cy"), (camera.fx, camera.fy, camera.cx, camera.cy), result.sigmas, strict=True
    ):
        print(f"{label:<3}{value:10.3f}  +- {sigma:.3f}")
    print(f"distortion {', '.join(f'{value:.5f}' for value in camera.distortion)}")
    share = (verdict.covered(used, width, height) > 0).mean()
    print(f"corners in {share:.0%} of the image")
    if doubt := verdict.doubt(camera):
        print(f"note: {doubt}")
    _refuse(verdict.of_calibration(views, seen, result), refused)
    readout_ms = _readout_of(out)
    put_whole(out, camera_text(result, len(used), name, args.board, readout_ms).encode())
    if refused != picture:
        put_whole(picture, drawn)
        refused.unlink(missing_ok=True)
    print(f"picture: {picture}")
    kept = "" if readout_ms is None else f" (with the readout_ms of {readout_ms:g} that it had)"
    print(f"camera file: {out}{kept}")
    return 0


def _readout_of(out: Path) -> float | None:
    """The rolling shutter's readout that the camera file to be replaced has: no board shows it."""
    from prism_edge.sources.camera_file import read_camera

    try:
        return read_camera(out).readout_ms
    except ConfigError:  # none, or not a camera file
        return None


def _refuse(problems: list[str], picture: Path) -> None:
    if problems:
        raise CalibrationError(f"{'; '.join(problems)} (picture: {picture})")
