"""`prism-edge config`: what it prints is what a run would take."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.cli.main import main
from prism_edge.config_file import leaves, load

CHECKOUT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize("explain", [[], ["--explain"]])
def test_prints_the_effective_configuration(
    explain: list[str], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "base.yaml"
    file.write_text("robot: a\nseed: 1\n")
    options = ["--config", str(file), "--robot", "b", "--model", "m.onnx", "--lockstep", "--loop"]
    assert main(["config", "some/folder", *options, "--set", "depth.threads=3", *explain]) == 0
    file.write_text(capsys.readouterr().out)
    config = load(file)
    assert (config.robot, config.seed, config.mode, config.depth.threads) == ("b", 1, "lockstep", 3)
    assert (config.source.uri, config.source.loop, config.depth.model) == ("some/folder", True, "m.onnx")


def test_check_says_ok_or_what_is_wrong(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    file = tmp_path / "base.yaml"
    file.write_text("robot: a\n")
    assert main(["config", "--check", str(file)]) == 0
    assert capsys.readouterr().out == f"{file}: ok\n"
    file.write_text("robot: a\nsource:\n  rate: 3\n")
    assert main(["config", "--check", str(file)]) == 3
    assert f"{file}:3: source.rate: unknown key" in capsys.readouterr().err
    file.write_text("robot: a/b\n")
    assert main(["config", "--check", str(file)]) == 3
    file.write_text("frames: {base_from_camera_xyzw: [0, 0, 0, 0]}\n")
    assert main(["config", "--check", str(file)]) == 3


@pytest.mark.parametrize("file", sorted((CHECKOUT / "configs").glob("*.yaml")), ids=lambda file: file.name)
def test_example_files_are_right(file: Path) -> None:
    assert main(["config", "--check", str(file)]) == 0


def test_page_describes_every_key_as_it_is() -> None:
    page = (CHECKOUT / "docs" / "CONFIGURATION.md").read_text(encoding="utf-8")
    for leaf in leaves():
        line = next((line for line in page.splitlines() if line.startswith(f"| `{leaf.key}` |")), "")
        assert leaf.expects in line, f"{leaf.key}: run `make docs`"
        assert leaf.help.replace("|", "\\|") in line, f"{leaf.key}: run `make docs`"
