"""What a run was made of besides its configuration: whose camera, what kind, which images and truth."""

from __future__ import annotations

import contextlib
import hashlib
import os
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from prism_edge.config import SourceConfig
from prism_edge.named_path import named_path
from prism_edge.sources import Source
from prism_edge.sources.checks import UNCALIBRATED
from prism_edge.sources.image_folder import FOLDER_OF_IMAGES
from prism_edge.sources.known_cameras import GUESSES
from prism_edge.sources.listing import Listing
from prism_edge.sources.open import AUTO, find_listing
from prism_edge.sources.sim import is_simulated
from prism_edge.sources.truth import truth_doubt, truth_file
from prism_edge.sources.video import CUT_SHORT
from prism_edge.workers.shutter_watch import SUBJECT

_NUMBERS = ("model", "width", "height", "fx", "fy", "cx", "cy", "distortion", "readout_ms")


@dataclass(frozen=True)
class Played:
    """For metrics.json; None where nothing is known."""

    camera: dict[str, Any] | None = None  # `origin` and _NUMBERS
    layout: str | None = None
    truth_file: str | None = None  # or the folder of many
    guessed: bool = False  # the camera
    images: str | None = None  # of a folder: images_of()
    files: dict[str, str] | None = None  # digests_of() what its figures hang on
    doubts: tuple[str, ...] = ()  # of folder, truth, camera and network; and of a video's end
    no_depth: str = ""  # why the last keyframe without depth had none

    def after(self, log: Path) -> Played:
        """The same with what a daemon's ``log`` says of its camera, its network and its video's end.

        A camera may be one that nobody calibrated, or have a shutter that is not as it is said to be.
        """
        text = ""
        with contextlib.suppress(OSError):
            text = log.read_text(errors="replace")
        subjects = rf"backend: (?={SUBJECT}: )|source: (?=.*{CUT_SHORT}$)"
        subjects += r"|(?:depth|scale): (?=keyframe -?\d+: )"
        doubts = re.findall(rf" WARNING +(?:{subjects})(.*)$", text, re.M)
        no_depth = re.findall(r" WARNING +depth: keyframe -?\d+ has no depth: (.*)$", text, re.M)
        told = replace(self, doubts=(*self.doubts, *doubts), no_depth=no_depth[-1] if no_depth else "")
        if self.camera is None or self.camera["origin"] != AUTO:
            return told
        said = re.findall(r"; camera: (.*)$", text, re.M)
        return replace(told, camera=self.camera | {"origin": f"{AUTO}: {said[-1]}" if said else AUTO})


def played(config: SourceConfig, source: Source, truth: Path | None) -> Played:
    """Of the ``source`` that a configuration names; ``truth`` is the file that was given, if one was."""
    listing = listing_of(config)
    layout = listing.layout if listing else "simulator" if is_simulated(config.uri) else "video file"
    own = truth_file(named_path(config.uri), listing) if listing else None
    file = truth or (Path(os.path.abspath(own)) if own else None)
    guessed = source.camera_origin in [origin for origin, _ in GUESSES]
    images = images_of(config, listing) if listing else None
    doubts = tuple(_doubts(config, listing, bool(truth))) if listing else ()
    return Played(camera_of(source), layout, str(file) if file else None, guessed, images, doubts=doubts)


def _doubts(config: SourceConfig, listing: Listing, truth_given: bool) -> Iterator[str]:
    """What to know of a folder's images, and of true poses that are or are not read with them."""
    folder = named_path(config.uri)
    if listing.doubt and not config.frames:  # else it may be of images that aren't played
        yield f"{folder}: {listing.doubt}"
    if truth_given:
        return
    if truth_file(folder, listing) and (doubt := truth_doubt(folder, listing)):
        yield f"{folder} {doubt}"
    beside = Path(os.path.abspath(folder)).parent / "groundtruth.txt"
    if listing.layout == FOLDER_OF_IMAGES and beside.is_file():
        yield f"{beside} is not read: name the folder that it lies in, or give it with --truth"


def camera_of(source: Source) -> dict[str, Any]:
    """Whose camera a source has, and its numbers; None for each that nobody knows yet."""
    known = source.camera is not UNCALIBRATED
    numbers = asdict(source.camera) if known else {}
    camera = {"origin": source.camera_origin if known else AUTO}
    return camera | {name: numbers.get(name) for name in _NUMBERS}


def images_of(config: SourceConfig, listing: Listing) -> str:
    """A digest of the played images' names and sizes, by which others in their place are noticed.

    Neither where the folder lies nor dates are in it, so a copy is the same; nor is what images hold.
    """
    folder, digest = named_path(config.uri), hashlib.sha256()
    for file in listing.files[: config.frames or None]:
        try:
            size = str(file.stat().st_size)
        except OSError:
            size = "missing"
        digest.update(os.fsencode(f"{os.path.relpath(file, folder)} {size}\n"))
    return digest.hexdigest()[:16]


def listing_of(config: SourceConfig) -> Listing | None:
    """What the folder that a configuration names holds; None: it names none. Raises SourceError."""
    path = named_path(config.uri)
    return find_listing(path, config.rate_hz) if path.is_dir() and not is_simulated(config.uri) else None
