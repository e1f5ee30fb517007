"""`prism-edge config --check` beside `run`: what one refuses, the other does not pass unsaid."""

from __future__ import annotations

import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from prism_edge.cli.main import main
from prism_edge.cli.run import check
from prism_edge.config import Config, SourceConfig
from prism_edge.config_file import load
from prism_edge.errors import PrismError
from prism_edge.sources.open import open_source
from tests.sources.tiny_datasets import write_images

MAKE = Path(__file__).resolve().parents[2] / "deploy" / "make_certificates.sh"
CAMERA = "width: 640\nheight: 480\nfx: 525\nfy: 525\ncx: 319.5\ncy: 239.5\n"
LONG = "x" * 300  # what can't be looked for, as in a folder that is closed to us
USB = "source: {uri: 'v4l2:/dev/video7', camera: CAMERA}\ndepth: {model: prism_nano}\n"


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.delenv("PRISM_EDGE_MODELS", raising=False)
    monkeypatch.setenv("CACHE_DIRECTORY", str(tmp_path / "cache"))
    monkeypatch.setattr("prism_edge.cli.check.find_spec", lambda name: name)  # whatever is installed here
    (tmp_path / "camera.yaml").write_text(CAMERA)
    return tmp_path / "given.yaml"


def write(file: Path, text: str) -> None:
    if "LAB" in text:
        subprocess.run([str(MAKE), str(file.parent), "rover"], check=True, timeout=60, capture_output=True)
    text = text.replace("LAB", str(file.parent))
    file.write_text(text.replace("CAMERA", str(file.with_name("camera.yaml"))))


@pytest.mark.parametrize(
    "text",
    [
        USB,
        "source: {uri: 'sim:room'}\n",
        "source: {uri: 'oak:'}\ndepth: {model: prism_nano}\n",
        "source: {uri: 'v4l2:/dev/video7', camera: auto}\ndepth: {model: prism_nano}\n",
        "network: {endpoint: tls/0.0.0.0:7448, ca: LAB/ca.pem, certificate: LAB/rover.pem, "
        "key: LAB/rover.key, remote: [depth]}\n"
        "source: {uri: 'oak:'}\ndepth: {model: /elsewhere/net.onnx}\n",
    ],
)
def test_what_runs_is_passed_without_a_word(
    text: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(file, text)
    assert main(["config", "--check", str(file)]) == 0
    said = capsys.readouterr()
    assert said.out == f"{file}: ok\n"
    assert said.err == ""


@pytest.mark.parametrize(
    ("text", "code", "why"),
    [
        ("bus: {endpoint: tcp/0.0.0.0:7447}\n" + USB, 3, "is not of this host alone"),
        ("bus: {endpoint: nonsense}\n", 6, "must start with one of"),
        ("source: {uri: 'v4l2:/dev/video7?nonsense=1', camera: CAMERA}\n", 4, "nonsense"),
        ("source: {uri: 'v4l2:/dev/video7', loop: true, camera: CAMERA}\n", 3, "is for recordings"),
        ("mode: lockstep\n" + USB, 3, "a live camera can't wait for lockstep"),
        ("source: {uri: 'sim:nowhere'}\n", 4, "nowhere"),
        ("source: {uri: 'sim:room', mask: CAMERA}\n", 3, "is no image"),
        ("source: {uri: 'sim:room', camera: CAMERA}\n", 3, "a simulated camera"),
        ("source: {uri: 'oak:'}\ndepth: {model: sensor}\n", 3, "is for recordings with depth"),
        ("network: {operators: [anna]}\n", 3, "network.operators"),
        ("depth: {model: 'nested:one'}\n", 5, "nested takes two networks"),
        ("depth: {model: a, providers: [gpu]}\n", 5, "no execution provider 'gpu'"),
        ("depth: {model: a, required: [cuda]}\n", 5, "depth.required: cuda is not among depth.providers"),
        ("depth: {model: a, provider_options: [device_id=1]}\n", 5, "not of the form PROVIDER.KEY=VALUE"),
        ("depth: {providers: [abacus]}\n", 5, "there is no execution provider 'abacus'"),
        ("depth: {provider_options: [abacus]}\n", 5, "not of the form PROVIDER.KEY=VALUE"),
        ("metrics: {port: 7447}\n", 3, "bus.endpoint has this port"),
    ],
)
def test_what_is_wrong_in_the_file_is_an_error(
    text: str, code: int, why: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(file, text)
    assert main(["config", "--check", str(file)]) == code
    said = capsys.readouterr()
    assert why in said.err
    assert "ok" not in said.out


@pytest.mark.parametrize(
    ("options", "code", "why"),
    [
        (["--set", "depth.thread=2"], 3, "did you mean depth.threads?"),
        (["--set", "depth.threads"], 3, "KEY=VALUE"),
        (["--endpoint", "nonsense"], 6, "must start with one of"),
        (["--robot", "a/b"], 3, "a/b"),
        (["--config", "other.yaml"], 3, "--config"),
        (["--model", "/nowhere/net.onnx"], 0, "there is no such file"),
        (["/nowhere/recording"], 0, "/nowhere/recording does not exist"),
        ([LONG], 0, "can't be read (File name too long)"),
        (["--model", f"{LONG}.onnx"], 0, "can't be read (File name too long)"),
        (["--set", f"source.mask={LONG}"], 0, "can't be read (File name too long)"),
    ],
)
def test_options_beside_the_file_are_checked_with_it(
    options: list[str], code: int, why: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(file, USB)
    assert main(["config", *options, "--check", str(file)]) == code
    said = capsys.readouterr()
    assert why in said.err
    assert ("ok" in said.out) == (code == 0)


def test_a_camera_file_that_is_wrong_is_an_error(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(file, USB)
    file.with_name("camera.yaml").write_text("width: wide\n")
    assert main(["config", "--check", str(file)]) == 3
    assert "camera.yaml" in capsys.readouterr().err


def test_a_camera_that_can_not_be_is_an_error(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(file, USB)
    file.with_name("camera.yaml").write_text(CAMERA.replace("319.5", "1319.5"))
    assert main(["config", "--check", str(file)]) == 3
    assert "camera.yaml: cx: 1319.5 lies outside the image" in capsys.readouterr().err


def test_so_is_one_that_lies_with_the_images(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = write_images(tmp_path / "images")
    (images / "camera.yaml").write_text(CAMERA.replace("525", "'525'"))
    write(file, f"source: {{uri: {images}}}\n")
    assert main(["config", "--check", str(file)]) == 3
    assert "camera.yaml: fx: expected a number" in capsys.readouterr().err


def test_a_recording_without_depth_images_has_none_to_be_measured_by(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    images = write_images(tmp_path / "images")
    (images / "camera.yaml").write_text(CAMERA)
    write(file, f"source: {{uri: {images}}}\ndepth: {{model: sensor}}\n")
    assert main(["config", "--check", str(file)]) == 0
    assert "holds no depth images" in capsys.readouterr().err


@pytest.mark.parametrize("source", ["'v4l2:/dev/video7', camera: CAMERA", "'sim:room'"])
def test_a_mask_of_another_size_is_an_error(
    source: str, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((240, 320), 255, np.uint8))
    write(file, f"source: {{uri: {source}, mask: {tmp_path / 'mask.png'}}}\n")
    assert main(["config", "--check", str(file)]) == 3
    assert "mask.png is 320x240, but the camera's images are 640x480" in capsys.readouterr().err
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((480, 640), 255, np.uint8))
    assert main(["config", "--check", str(file), "--set", "source.shrink=2"]) == 0
    elsewhere = "--set", f"source.uri={tmp_path / 'drive.mkv'}"  # a recording that this machine lacks
    capsys.readouterr()
    assert main(["config", "--check", str(file), "--set", "source.shrink=2", *elsewhere]) == 0
    assert "does not exist" in capsys.readouterr().err


@pytest.mark.parametrize("source", ["'oak:'", "'oak:', camera: auto", "'v4l2:/dev/video7', camera: auto"])
def test_a_mask_for_a_camera_that_is_not_known_yet_is_passed(
    source: str, file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    mask = tmp_path / "mask.png"
    cv2.imwrite(str(mask), np.full((480, 640), 255, np.uint8))
    write(file, f"source: {{uri: {source}, mask: {mask}}}\ndepth: {{model: prism_nano}}\n")
    assert main(["config", "--check", str(file)]) == 0
    mask.write_text("no image")
    assert main(["config", "--check", str(file)]) == 3
    assert "mask.png" in capsys.readouterr().err


def test_a_folder_is_no_mask(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(file, f"source: {{uri: 'sim:room', mask: {tmp_path}}}\n")
    assert main(["config", "--check", str(file)]) == 3
    assert "can't be read" in capsys.readouterr().err


@pytest.mark.parametrize("source", ["'v4l2:/dev/video7'", "/nowhere/recording"])
def test_a_camera_that_is_doubted_is_a_warning(
    source: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(file, USB.replace("'v4l2:/dev/video7'", source))
    file.with_name("camera.yaml").write_text(CAMERA.replace("319.5", "639.5"))
    assert main(["config", "--check", str(file)]) == 0
    line = capsys.readouterr().err.splitlines()[-1]
    doubt = "cx 639.5 of a 640-wide image: are these intrinsics of a larger image?"
    assert line == f"{file}: warning: camera: {doubt}"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("source: {uri: 'v4l2:/dev/video7'}\ndepth: {model: prism_nano}\n", "needs a camera file"),
        (USB.replace("CAMERA", "/nowhere/camera.yaml"), "/nowhere/camera.yaml"),
        ("source: {uri: /nowhere/recording}\ndepth: {model: prism_nano}\n", "does not exist"),
        (USB.replace("prism_nano", "fastdepth_nyu"), "model fastdepth_nyu: its file"),
        (USB.replace("prism_nano", "/nowhere/net.onnx"), "there is no such file"),
        (USB.replace("prism_nano", "'nested:/nowhere/net.onnx,prism_nano'"), "there is no such file"),
        (USB.replace("camera: CAMERA", "camera: CAMERA, mask: /nowhere/m.png"), "mask /nowhere/m.png is not"),
        ("source: {uri: 'v4l2:/dev/video7', camera: CAMERA}\n", "depth.model: no network is named"),
        ("source: {uri: 'v4l2:/dev/video7', camera: auto}\n", "camera auto needs a depth network"),
        ("bus: {endpoint: tls/rover1.local:7448}\n", "`run` refuses it"),
        (
            "source: {uri: 'sim:room'}\ndepth: {providers: [qnn, cpu], required: [qnn]}\n",
            "no qnn provider",
        ),
        ("supervisor: {max_restarts: 12}\n", "what keeps dying is never given up"),
        ("network: {ca: CAMERA, certificate: CAMERA, key: /run/no/a.key}\n", "network.key: can't read"),
    ],
)
def test_what_may_only_be_missing_here_is_one_warning(
    text: str, why: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(file, text)
    assert main(["config", "--check", str(file)]) == 0
    said = capsys.readouterr()
    assert said.out == f"{file}: ok\n"
    (line,) = said.err.splitlines()
    assert line.startswith(f"{file}: warning: ")
    assert why in line


@pytest.mark.parametrize(
    ("text", "module", "extra"),
    [
        ("source: {uri: 'oak:'}\ndepth: {model: prism_nano}\n", "depthai", "oak"),
        ("source: {uri: 'rtsp://h/c', camera: CAMERA}\ndepth: {model: prism_nano}\n", "av", "streams"),
        ("metrics: {port: 9400}\n", "prometheus_client", "metrics"),
    ],
)
def test_an_optional_dependency_that_is_missing_is_one_warning(
    text: str,
    module: str,
    extra: str,
    file: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write(file, text)
    assert main(["config", "--check", str(file)]) == 0
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(
        "prism_edge.cli.check.find_spec", lambda name: None if name == module else name
    )
    assert main(["config", "--check", str(file)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert f"pip install 'prism-edge[{extra}]'" in line


@pytest.mark.parametrize(
    "text",
    [
        "source: {uri: 'v4l2:/dev/video7'}\n",
        "source: {uri: 'v4l2:/dev/video7', camera: auto}\n",
        "bus: {endpoint: tcp/10.0.0.1:7447}\n",
        "robot: a/b\n",
        "source: {uri: 'rtsp://'}\n",
        "mode: lockstep\n" + USB,
    ],
)
def test_what_run_refuses_is_never_passed_in_silence(
    text: str, file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(file, text)
    with pytest.raises(PrismError):
        check(load(file))
    main(["config", "--check", str(file)])
    assert capsys.readouterr().err


def test_what_the_source_will_warn_of_is_left_to_it(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """`run` looks at the source before anything is logged in order, and said it twice."""
    source = SourceConfig(uri=str(write_images(tmp_path)))
    for look, count in ((open_source, 1), (lambda source: check(Config(source=source)), 0), (open_source, 1)):
        caplog.clear()
        look(source)
        assert caplog.text.count("nothing says when its images were taken") == count


def test_a_recording_of_another_size_than_the_camera_s_is_one_warning(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """`run` refuses its first image."""
    folder = write_images(tmp_path / "film")
    write(file, f"source: {{uri: {folder}}}\ndepth: {{model: prism_nano}}\n")
    assert main(["config", "--check", str(file)]) == 0
    assert "camera" not in capsys.readouterr().err
    write(file, f"source: {{uri: {folder}, camera: CAMERA}}\ndepth: {{model: prism_nano}}\n")
    assert main(["config", "--check", str(file)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "is for 640x480 images, but" in line
