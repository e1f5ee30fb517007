"""What a folder that can't be played seems to be: datasets unpacked in part, and folders of sequences."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

from prism_edge.sources import kitti
from prism_edge.sources.image_file import SUFFIXES
from prism_edge.sources.listing import natural_order

_NAMED = 4  # sequences; more than a few are no line any more
AN_ARCHIVE = "is an archive: unpack it first, and name the folder"
BAGS = {".bag", ".db3", ".mcap", ".klg"}
A_BAG = "is a bag: write its images to files first (docs/SOURCES.md, Another dataset)"

# What datasets come in; none of them can be played as it is.
PACKED = {".zip", ".tgz", ".tar", ".gz", ".bz2", ".xz", ".7z", ".rar"}
_VIDEOS = {".mp4", ".m4v", ".mov", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".h264", ".gif"}
_YAML = {".yaml", ".yml"}
_TEXT = {".txt", ".csv", ".json", ".xml", ".toml", ".md", ".tum", *_YAML}


def no_video(file: Path) -> str:
    """Why a file can't be played, in words that follow its name; empty: it may be a video."""
    try:
        with file.open("rb") as opened:
            if not opened.read(1):
                return "is empty"
    except OSError as error:
        return f"can't be read ({error.strerror})"
    kind = file.suffix.lower()
    if kind in BAGS:
        return A_BAG
    if kind in PACKED:
        return AN_ARCHIVE
    hint = " (--config FILE for a configuration, --camera FILE for a camera)" if kind in _YAML else ""
    return f"is text, no video that can be read{hint}" if kind in _TEXT else ""


def guess(folder: Path) -> str:
    """What to do with a folder that no layout knows, in a few words that follow its name; empty: no idea."""
    with suppress(OSError):
        if images := kitti.image_folders(folder):
            return f"has KITTI's {images[0]} but no calib.txt: {kitti.TABLES}"
        if any(path.suffix.lower() in BAGS for path in folder.iterdir()):
            return A_BAG
        if data := _euroc(folder):
            return f"has EuRoC's images: name {data}, or with truth see docs/SOURCES.md, Another dataset"
        # One further down, too: KITTI's are in dataset/sequences.
        if below := _sequences(folder.iterdir()) or _sequences(folder.glob("*/*")):
            return f"is no sequence but holds {len(below)}; {_name(below, folder)}"
        if videos := sorted(filter(_is_video, folder.iterdir()), key=natural_order):
            return f"is no video but holds {len(videos)}; {_name(videos, folder)}"
        if pictures := sorted(filter(_has_pictures, folder.iterdir()), key=natural_order):
            lack = "has no rgb.txt, TUM's list of its images" if _of_tum(folder) else "is no sequence"
            return f"{lack}, but images further down; {_name(pictures, folder)}"
    return ""


def _name(found: list[Path], folder: Path) -> str:
    which = "it" if len(found) == 1 else "one of them"
    names = [str(path.relative_to(folder)) for path in found[:_NAMED]]
    return f"name {which}: {', '.join(names + ['...'] * (len(found) > _NAMED))}"


def _is_video(file: Path) -> bool:
    return file.suffix.lower() in _VIDEOS and not file.name.startswith(".")


def _has_pictures(folder: Path) -> bool:
    """Whether images lie in a folder, other than of depth."""
    with suppress(OSError):
        names = (path.name.lower() for path in folder.iterdir()) if folder.is_dir() else ()
        return "depth" not in folder.name.lower() and any(name.endswith(SUFFIXES) for name in names)
    return False


def _of_tum(folder: Path) -> bool:
    return any((folder / name).is_file() for name in ("groundtruth.txt", "depth.txt"))


def _sequences(folders: Iterable[Path]) -> list[Path]:
    return sorted((path for path in folders if _is_sequence(path)), key=natural_order)


def _euroc(folder: Path) -> str:
    """Where from here EuRoC's first camera has its images; empty where this is none of its folders."""
    for camera in ("mav0/cam0", "cam0", "."):
        if (folder / camera / "sensor.yaml").is_file() and (folder / camera / "data").is_dir():
            return f"{camera}/data".removeprefix("./")
    return ""


def _is_sequence(folder: Path) -> bool:
    """Whether a dataset's marks are there, of one sequence or of a scene of 7-Scenes; nothing is read."""
    with suppress(OSError):
        if not folder.is_dir():
            return False
        scenes = ("frame-*.color.*", "seq-*/frame-*.color.*", "seq-*/seq-*/frame-*.color.*")
        frames = (next(folder.glob(pattern), None) for pattern in scenes)
        return (folder / "rgb.txt").is_file() or bool(kitti.image_folders(folder)) or any(frames)
    return False
