"""`prism-edge mask`: finds what of a camera's images is its own robot, and writes a mask of it."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from prism_edge.all_or_nothing import put_whole
from prism_edge.cli.settings import a_path
from prism_edge.cli.whole_file import check_writable
from prism_edge.config import SourceConfig
from prism_edge.errors import CalibrationError, ConfigError, SourceError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from prism_edge.sources import Source

LEAST, ENOUGH = 20, 120  # images of a moving camera
PATIENCE_S = 120.0  # with a live camera


def add_parser(subparsers: Any, help_line: str) -> None:
    """Add the subcommand, with its line of `prism-edge --help`."""
    parser: argparse.ArgumentParser = subparsers.add_parser(
        "mask",
        help=help_line,
        description="Watch the images of SOURCE while the robot drives and turns, and find what stays as it "
        "is in all of them: its own bonnet, legs or gripper, or writing laid over the images. What is found "
        "is black in the mask, for `--mask` and source.mask; look at it, and paint over it what is missing "
        "or too much. Exit code 9 where the camera hardly moved.",
    )
    parser.add_argument("source", metavar="SOURCE", help="recording, or camera such as v4l2:/dev/video0")
    parser.add_argument("--out", metavar="FILE", type=a_path, help="PNG to write (default: mask.png)")
    parser.add_argument("--overwrite", action="store_true", help="replace a file that is there")


def run(args: argparse.Namespace) -> int:
    """Watch, find, write. Raises ConfigError, SourceError or CalibrationError."""
    import cv2
    import numpy as np

    from prism_edge.sources.image_folder import MASK
    from prism_edge.sources.open import open_source
    from prism_edge.sources.own_parts import OwnParts

    out = args.out or Path(MASK)
    check_writable(out, args.overwrite)
    if out.suffix.lower() != ".png":
        raise ConfigError(f"{out}: a mask is a PNG file, which keeps its black black")
    config = SourceConfig(uri=args.source, rate_hz=rate_hz(args.source))
    source, parts = open_source(config, calibrated=False), OwnParts()
    with source:
        print(f"looking for what never moves in {source.name}", flush=True)
        width, height = _watch(source, parts)
    if parts.taken < LEAST:
        raise CalibrationError(
            f"only {parts.taken} images differ enough from the one before ({LEAST} are needed): "
            "let the robot drive and turn while it looks"
        )
    found = parts.found()
    if parts.undecided:
        raise CalibrationError(
            "more than 60 % of the image stay as they are: did the camera stand before something that moves? "
            "If not, draw the mask by hand"
        )
    own = cv2.resize(found.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    print(f"{parts.taken} images of a moving camera looked at")
    put_whole(out, cv2.imencode(".png", np.where(own, 0, 255).astype(np.uint8))[1].tobytes())
    if own.any():
        print(f"{100.0 * own.mean():.1f} % of the image never moves ({_where(own)})")
        print(f"mask: {out}")
    else:  # written all the same: an earlier robot's may lie there, or a script go on to use it
        print("nothing stays as it is: this camera needs no mask")
        print(f"mask: {out} (hides nothing)")
    return 0


def rate_hz(uri: str) -> float:
    """For images that nothing says the time of, the rate at which few are all looked at; 0 for others."""
    from prism_edge.named_path import named_path
    from prism_edge.sources.base import DEFAULT_RATE_HZ
    from prism_edge.sources.open import find_listing
    from prism_edge.sources.own_parts import APART_NS

    path = named_path(uri)
    if not path.is_dir():
        return 0.0
    listing = find_listing(path)
    usual = round(APART_NS * 1e-9 * DEFAULT_RATE_HZ)  # images from one that is looked at to the next
    apart = min(max(len(listing.files) // ENOUGH, 1), usual)
    return 0.0 if listing.stamped else apart / (APART_NS * 1e-9)


def _watch(source: Source, parts: Any) -> tuple[int, int]:
    """Show ``parts`` an open source's images until they suffice; their width and height."""
    from prism_edge.sources import Absent, Image, Unreadable

    size, until, problem = (0, 0), time.monotonic() + PATIENCE_S, ""
    while parts.taken < ENOUGH and (not source.live or time.monotonic() < until):
        item = source.read()
        if item is None:
            break
        warning = item.reason if isinstance(item, Unreadable) else source.health().get("warning", "")
        if warning != problem:
            problem = warning
            print(f"  {warning}" if warning else "  there are images again", flush=True)
        if isinstance(item, Absent):
            time.sleep(0.01)
        if not isinstance(item, Image):
            continue
        here = item.pixels.shape[1], item.pixels.shape[0]
        if size not in ((0, 0), here):
            raise SourceError(f"the images differ in size ({size[0]}x{size[1]}, then {here[0]}x{here[1]})")
        size = here
        if parts.look(item.pixels, item.stamp_ns) and parts.taken % 20 == 0:
            print(f"  {parts.taken} of {ENOUGH} images", flush=True)
    return size


def _where(own: NDArray[np.bool_]) -> str:
    """In which part of the image it is: words for a person."""
    rows, columns = own.nonzero()
    down, right = float(rows.mean()) / own.shape[0], float(columns.mean()) / own.shape[1]
    vertical = "top" if down < 1 / 3 else "bottom" if down > 2 / 3 else "middle"
    horizontal = "left" if right < 1 / 3 else "right" if right > 2 / 3 else "centre"
    return f"its middle lies at the {vertical}, {horizontal}"
