#!/usr/bin/env python3
"""Composites moving, textured objects into an RGB-D recording: a dynamic scene with the static one's truth.

    python tools/make_distractors.py SEQUENCE OUT [--seed N] [--coverage 0.25] [--poses FILE.tum]

SEQUENCE is a TUM RGB-D or 7-Scenes folder with depth; OUT becomes one of the same layout and frames, whose
depth holds the objects too, with masks/NNNNNN.png (255: object) and distractors.json (seed, coverage of each
frame) beside. Objects are boxes and ellipsoids covered with corners, lit from above. Some walk straight past
the camera, others keep ahead of it for a while, as a person does whom one follows; each on a smooth path of
its own through the world. True surfaces that are nearer hide them. Sizes are chosen so that on average
--coverage of the image is covered, and never more than 40 %. Camera poses come from the sequence's truth, or
from --poses where that jitters (7-Scenes: the final.tum of a run on the static recording). The same seed
gives the same files. docs/GATE.md says what these recordings are used for.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parents[1]
if str(ROOT) not in sys.path:  # run from a checkout
    sys.path.insert(0, str(ROOT))

from prism_edge.errors import PrismError, SourceError  # noqa: E402
from prism_edge.evaluation.trajectory import write_tum  # noqa: E402
from prism_edge.sources.bonn import holds_markers  # noqa: E402
from prism_edge.sources.image_file import read_as_stored  # noqa: E402
from tools.distractors.plan import MOST_COVERED, plan  # noqa: E402
from tools.distractors.recording import Recording, empty  # noqa: E402
from tools.distractors.solids import Distractor, draw, texture  # noqa: E402
from tools.make_kidnapping import describe  # noqa: E402
from tools.true_poses import own_truth  # noqa: E402

Array = NDArray[np.float64]


def write(recording: Recording, things: list[Distractor], contrast: float, out: Path) -> list[float]:
    """Composite every frame into ``out``; the covered share of each."""
    textures = {thing.texture: texture(thing.texture, contrast) for thing in things}
    (out / "masks").mkdir(parents=True, exist_ok=True)
    shares: list[float] = []
    before: NDArray[np.uint8] | None = None
    place = {path: out / recording.inside(path) for path in recording.listing.files}
    for i, path in enumerate(recording.listing.files):
        target = place[path]
        target.parent.mkdir(parents=True, exist_ok=True)
        image = read_as_stored(path, cv2.IMREAD_COLOR)
        if image is None:
            raise SourceError(f"{path} can't be read")
        depth_file = recording.sensor_file(i)
        if before is not None and np.array_equal(image, before):  # a copy stays a copy
            shutil.copyfile(place[recording.listing.files[i - 1]], target)
            shutil.copyfile(out / f"masks/{i - 1:06d}.png", out / f"masks/{i:06d}.png")
            shares.append(shares[-1])
            earlier = recording.sensor_file(i - 1)
            if depth_file is not None and earlier is not None and depth_file != earlier:
                original = out / recording.inside(earlier)
                if original.is_file():
                    _copied(original, out / recording.inside(depth_file))
            continue
        before = image.copy()
        depth = recording.depth(i)
        pose, seconds = recording.poses[i], float(recording.stamps[i])
        shown, colours = draw(recording.camera, pose, seconds, things, depth, textures)
        mask = np.isfinite(shown)
        shares.append(float(mask.mean()))
        # No edge is sharper than a lens makes it.
        alpha = cv2.GaussianBlur(mask.astype(np.float32), (3, 3), 0.7)[..., None]
        spread = cv2.dilate(colours, np.ones((3, 3)))  # colour for the rim of the blurred mask
        colours = np.where(mask[..., None], colours, spread)
        mixed = image * (np.float32(1) - alpha) + colours * alpha
        drawn = np.clip(mixed + 0.5, 0, 255).astype(np.uint8)
        is_jpeg = target.suffix.lower() in (".jpg", ".jpeg")
        _write_image(target, drawn, *((cv2.IMWRITE_JPEG_QUALITY, 95) if is_jpeg else ()))
        _write_image(out / f"masks/{i:06d}.png", mask.astype(np.uint8) * 255)
        if depth_file is not None:
            _write_depth(recording, depth_file, shown, out)
    return shares


def _write_image(file: Path, image: NDArray[np.generic], *options: int) -> None:
    """Raises OSError where it can't be written, which OpenCV's own writing says by False alone."""
    file.write_bytes(cv2.imencode(file.suffix, image, options)[1].tobytes())


def _copied(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)


def _write_depth(recording: Recording, file: Path, shown: Array, out: Path) -> None:
    """The sensor's image with the objects in it, in its own pixels and unit; left out where it is none."""
    raw = read_as_stored(file, cv2.IMREAD_UNCHANGED)
    if raw is None or raw.dtype != np.uint16 or raw.ndim != 2:
        print(f"make_distractors: warning: {file} is no depth image: left out", file=sys.stderr)
        return
    unit = 1000.0 if recording.listing.layout == "7-Scenes" else 5000.0
    here = recording.in_sensor(shown, raw.shape)
    # A surface that the colour camera has behind an object may be before it where the sensor is.
    nearer = np.isfinite(here) & ((raw == 0) | (here * unit < raw))
    raw = np.where(nearer, np.clip(here * unit, 1, 65534), raw).astype(np.uint16)
    target = out / recording.inside(file)
    target.parent.mkdir(parents=True, exist_ok=True)
    _write_image(target, raw)


def copy_rest(recording: Recording, out: Path) -> None:
    """Lists, truth and camera, as they are; of BONN's truth, which is the markers', what is the camera's."""
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        if (recording.folder / name).is_file():
            shutil.copyfile(recording.folder / name, out / name)
    if holds_markers(recording.folder) and len(truth := own_truth(str(recording.folder))):
        write_tum(out / "groundtruth.txt", truth)
    for folder in sorted({path.parent for path in recording.listing.files}):
        for path in sorted(folder.glob("*.pose.txt")):
            _copied(path, out / recording.inside(path))
    describe(recording.camera, out / "camera.yaml")


def main(arguments: list[str] | None = None) -> int:
    """Returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", metavar="SEQUENCE", type=Path)
    parser.add_argument("out", metavar="OUT", type=Path)
    parser.add_argument("--seed", metavar="N", type=int, default=0)
    parser.add_argument("--coverage", metavar="SHARE", type=float, default=0.25, help="on average")
    parser.add_argument("--contrast", metavar="SHARE", type=float, default=0.5, help="of the texture")
    parser.add_argument("--poses", metavar="FILE.tum", type=Path, help="camera path; default: the truth")
    args = parser.parse_args(arguments)
    try:
        if not 0.05 <= args.coverage <= 0.35:
            raise SourceError(f"--coverage {args.coverage:g} is not within 0.05 and 0.35")
        if not 0.0 <= args.contrast <= 1.0:
            raise SourceError(f"--contrast {args.contrast:g} is not within 0 and 1")
        empty(args.out)
        recording = Recording(args.sequence, args.poses)
        things = plan(recording, args.seed, args.coverage)
        args.out.mkdir(parents=True, exist_ok=True)
        shares = write(recording, things, args.contrast, args.out)
        copy_rest(recording, args.out)
        summary = {
            "seed": args.seed,
            "objects": len(things),
            "covered": [round(share, 4) for share in shares],
        }
        (args.out / "distractors.json").write_text(json.dumps(summary) + "\n")  # last: all of it is there
    except (PrismError, OSError) as error:
        print(f"make_distractors: error: {error}", file=sys.stderr)
        return 2
    low, middle, high = np.quantile(shares, (0.05, 0.5, 0.95))
    inside = float(np.mean((np.array(shares) >= 0.1) & (np.array(shares) <= MOST_COVERED)))
    print(
        f"{len(things)} objects cover {100 * float(np.mean(shares)):.0f} % of the image on average "
        f"(5 %, 50 %, 95 % of frames: {100 * low:.0f}, {100 * middle:.0f}, {100 * high:.0f}); "
        f"{100 * inside:.0f} % of frames lie between 10 and 40 %"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
