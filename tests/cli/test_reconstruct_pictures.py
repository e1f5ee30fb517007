"""Which picture of a recording is which keyframe's, and how networks see it."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.stored_map import from_arrays, to_arrays
from prism_edge.config import SourceConfig
from prism_edge.depth.session import OnnxNetwork
from prism_edge.depth.several_views import SeveralViewsNetwork
from prism_edge.geometry.poses import inverse, transform
from prism_edge.sources.base import Image, Slot
from prism_edge.sources.image_sequence import ImageSequence
from prism_edge.sources.open import open_source
from tests.cli.mapped_room import APART, FRAMES, MOUNT, Call, cloud, from_the_walls, pictures, true_map
from tests.depth.test_several_views import write as write_several
from tests.synthetic.sequence import synthetic_camera


def test_keyframes_without_a_picture_are_counted(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    shorter = shutil.copytree(room / "seq", tmp_path / "seq")
    lines = (shorter / "rgb.txt").read_text().splitlines()
    (shorter / "rgb.txt").write_text("\n".join(lines[:60]) + "\n")
    assert call("--no-pictures", "--width", 160, source=shorter) == 0
    heard = capsys.readouterr()
    assert "5 of 8 keyframes" in heard.out
    assert "left out: 3 keyframes, of whose time the recording has no picture" in heard.err


def test_keyframes_of_later_rounds_of_a_looped_recording_have_their_pictures(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    info, arrays = map_file.unpack((room / "room.prismmap").read_bytes())
    world, index = from_arrays(info, arrays, 0)
    with open_source(SourceConfig(uri=str(room / "seq"), loop=True)) as source:
        stamps = [image.stamp_ns for _ in range(2 * FRAMES) if isinstance(image := source.read(), Image)]
    for keyframe in list(world.keyframes.values())[4:]:
        keyframe.taken_ns = stamps[keyframe.index + FRAMES]
    facts, arrays = to_arrays(world, index)
    (tmp_path / "looped.prismmap").write_bytes(map_file.pack({**info, **facts}, arrays))
    words = "--no-pictures", "--width", 160, "--voxel", 0.05
    assert call(*words, map=tmp_path / "looped.prismmap") == 0
    heard = capsys.readouterr()
    assert "4 of 8 keyframes" in heard.out
    assert "source.loop" in heard.err
    assert call(*words, "--overwrite", "--set", "source.loop=true", map=tmp_path / "looped.prismmap") == 0
    assert "8 of 8 keyframes" in capsys.readouterr().out
    assert np.median(from_the_walls(cloud(tmp_path / "out.ply")[0])) < 0.01


def test_of_a_map_of_two_recordings_each_gives_its_own_keyframes(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Stamps begin anew in the second, which went the way back: half of its pictures are of other places."""
    (tmp_path / "both.prismmap").write_bytes(true_map(twice=True))
    assert call("--no-pictures", "--width", 160, "--voxel", 0.05, map=tmp_path / "both.prismmap") == 0
    heard = capsys.readouterr()
    assert "8 of 16 keyframes" in heard.out
    assert "left out: 8 keyframes, of whose time the recording's picture is another" in heard.err
    assert np.median(from_the_walls(cloud(tmp_path / "out.ply")[0])) < 0.01


def test_of_a_map_of_two_sizes_of_image_a_recording_gives_those_of_its_own(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The other camera's keyframes have the same stamps; the mask is as large as the recording's images."""
    both, mask = tmp_path / "both.prismmap", tmp_path / "mask.png"
    both.write_bytes(true_map(twice=True, other=synthetic_camera(640, 480)))
    cv2.imwrite(str(mask), np.full((240, 320), 255, np.uint8))
    assert call("--no-pictures", "--width", 160, "--mask", mask, map=both) == 0
    heard = capsys.readouterr()
    assert "8 of 16 keyframes" in heard.out
    assert "left out: 8 keyframes, of whose time the recording's picture is another" in heard.err
    cv2.imwrite(str(mask), np.full((480, 640), 255, np.uint8))
    assert call("--overwrite", "--mask", mask, map=both) == 3
    said = capsys.readouterr().err
    assert "mask.png is 640x480, but the camera's images are 320x240: if the run made its images" in said
    mask.write_text("no image")
    assert call("--overwrite", "--mask", mask, map=both) == 3
    assert "smaller" not in capsys.readouterr().err


def test_a_run_that_made_its_images_smaller_is_reconstructed_from_those(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    larger = shutil.copytree(room / "seq", tmp_path / "seq")
    for path in (larger / "rgb").iterdir():  # each pixel twice, each way: the mean of four is what it was
        cv2.imwrite(str(path), cv2.imread(str(path)).repeat(2, axis=0).repeat(2, axis=1))
    assert call("--no-pictures", "--width", 160, source=larger) == 4
    assert "pictures of 640x480, but the map is of 320x240: if the run made its images smaller" in (
        capsys.readouterr().err
    )
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((480, 640), 255, np.uint8))
    hidden = "--mask", tmp_path / "mask.png", "--set", "source.shrink=2"
    assert call("--no-pictures", "--width", 160, "--voxel", 0.05, *hidden, source=larger) == 0
    assert "8 of 8 keyframes" in capsys.readouterr().out
    assert np.median(from_the_walls(cloud(tmp_path / "out.ply")[0])) < 0.01


def test_a_recording_that_is_looped_in_the_configuration_ends(
    call: Call, room: Path, tmp_path: Path
) -> None:
    shorter = shutil.copytree(room / "seq", tmp_path / "seq")
    lines = (shorter / "rgb.txt").read_text().splitlines()
    (shorter / "rgb.txt").write_text("\n".join(lines[:60]) + "\n")
    assert call("--no-pictures", "--width", 160, "--set", "source.loop=true", source=shorter) == 0


@pytest.mark.parametrize(("picture", "missing"), [(APART, 1), (APART - 1, 0)])
def test_a_picture_that_can_not_be_read_is_counted_where_it_is_a_keyframe_s(
    picture: int, missing: int, call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = shutil.copytree(room / "seq", tmp_path / "seq")
    sorted((damaged / "rgb").iterdir())[picture].write_bytes(b"no picture")
    assert call("--no-pictures", "--width", 160, source=damaged) == 0
    heard = capsys.readouterr()
    assert f"{8 - missing} of 8 keyframes" in heard.out
    assert ("left out: 1 keyframes, whose picture can't be read" in heard.err) == bool(missing)
    assert ("left out" in heard.err) == bool(missing)


@pytest.mark.parametrize("model", ["metric.onnx", "several.onnx"])
def test_networks_see_pictures_upright(
    call: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str
) -> None:
    """A map that says that its camera hung upside down, whatever the configuration says of today's."""
    over = MOUNT @ np.diag([-1.0, -1.0, 1.0, 1.0])
    (tmp_path / "over.prismmap").write_bytes(true_map(mount=over))
    shown: list[np.ndarray] = []
    for kind, name in ((OnnxNetwork, "raw"), (SeveralViewsNetwork, "infer")):
        method = getattr(kind, name)

        def spied(self: object, pictures: Any, *more: Any, method: Any = method) -> Any:
            shown.extend([pictures] if isinstance(pictures, np.ndarray) else pictures)
            return method(self, pictures, *more)

        monkeypatch.setattr(kind, name, spied)
    write_several(tmp_path / "several.onnx", size=(320, 240), tinted=True)
    path = tmp_path / model if model == "several.onnx" else model
    assert call("--no-pictures", "--width", 160, map=tmp_path / "over.prismmap", model=path) == 0
    truth = pictures()[0][0]
    greys = [cv2.cvtColor(p, cv2.COLOR_RGB2GRAY).ravel() for p in shown]
    likeness = [np.corrcoef([t.ravel(), *greys])[0, 1:].max() for t in (truth, truth[::-1, ::-1])]
    assert likeness[1] > 0.95 > likeness[0]
    world = cloud(tmp_path / "out.ply")[0]
    assert np.median(from_the_walls(transform(MOUNT @ inverse(over), world))) < 0.01


def test_what_the_mask_hides_is_not_in_the_cloud(call: Call, tmp_path: Path) -> None:
    mask = np.full((240, 320), 255, np.uint8)
    mask[:, :160] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    assert call("--no-pictures", "--width", 160, "--agree", 1) == 0
    whole = len(cloud(tmp_path / "out.ply")[0])
    masked = ("--overwrite", "--mask", tmp_path / "mask.png")
    assert call("--no-pictures", "--width", 160, "--agree", 1, *masked) == 0
    assert len(cloud(tmp_path / "out.ply")[0]) < 0.75 * whole
    cv2.imwrite(str(tmp_path / "small.png"), mask[:100])
    assert call("--overwrite", "--mask", tmp_path / "small.png") == 3


def test_a_map_that_was_made_with_a_mask_knows_its_pictures(
    call: Call, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All that is seen of corners beside the mask is of no keyframe."""
    mask = np.full((240, 320), 255, np.uint8)
    mask[60:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), mask)
    (tmp_path / "part.prismmap").write_bytes(true_map(shown=mask > 0))
    masked = ("--agree", 1, "--mask", tmp_path / "mask.png")
    assert call("--no-pictures", "--width", 160, *masked, map=tmp_path / "part.prismmap") == 0
    heard = capsys.readouterr()
    assert "8 of 8 keyframes" in heard.out
    assert "left out" not in heard.err


def test_a_video_s_stamps_are_those_of_the_pictures_that_were_read(
    call: Call, capsys: pytest.CaptureFixture[str]
) -> None:
    """What is expected before they are read is a little off, and by a gap's length right after it."""
    peek = ImageSequence.peek

    def expected(self: ImageSequence) -> Slot | None:
        slot = peek(self)
        if slot is None:
            return None
        off_ns = 2_000_000_000 if slot.index // APART % 2 else 7_000_000
        return Slot(slot.index, slot.stamp_ns - off_ns)

    def truly(self: ImageSequence) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(ImageSequence, "peek", peek)
            return read(self)

    read = ImageSequence.read
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ImageSequence, "decodes_skipped", True)
        patch.setattr(ImageSequence, "peek", expected)
        patch.setattr(ImageSequence, "read", truly)
        assert call("--no-pictures", "--width", 160) == 0
    assert "8 of 8 keyframes" in capsys.readouterr().out


def test_another_recording_is_refused(
    call: Call, room: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = shutil.copytree(room / "seq", tmp_path / "seq")
    lines = [line for line in (other / "rgb.txt").read_text().splitlines() if not line.startswith("#")]
    (other / "rgb.txt").write_text("\n".join(f"9{line}" for line in lines) + "\n")  # nine seconds later
    assert call(source=other) == 4
    assert "has no picture of any keyframe: is it the recording of this map?" in capsys.readouterr().err
