"""`prism-edge models verify` where one of several networks is broken: it hides no other."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.cli.main import main
from prism_edge.depth import find, pulled, registry
from prism_edge.depth.pulled import MANIFEST
from tests.synthetic.network import write_tiny_network

FASTDEPTH = "fastdepth_nyu"


@pytest.fixture(autouse=True)
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A wide terminal, and an empty folder for networks."""
    monkeypatch.setenv("COLUMNS", "400")
    monkeypatch.setenv("PRISM_EDGE_MODELS", str(tmp_path / "models"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    (tmp_path / "models").mkdir()
    return tmp_path / "models"


def rows(out: str) -> dict[str, list[str]]:
    lines = (line.split("│")[1:-1] for line in out.splitlines() if line.startswith("│"))
    return {name.strip(): [cell.strip() for cell in cells] for name, *cells in lines}


@pytest.mark.parametrize("named", [True, False])
def test_a_broken_manifest_is_a_row_beside_the_others(named: bool, models: Path, tmp_path: Path, capsys):
    good = write_tiny_network(tmp_path / "good.onnx")
    (models / "mine").mkdir()
    (models / "mine" / MANIFEST).write_text("broken: [")
    assert main(["models", "verify", *([str(good), "mine"] if named else [])]) == 5
    shown, heard = rows((said := capsys.readouterr()).out), said.err
    assert "on CPUExecutionProvider" in shown[str(good) if named else "prism_nano"][1]
    assert [MANIFEST in cell for cell in shown["mine"]] == [True, True]
    assert heard == ""


def test_a_file_that_can_not_be_read_is_a_row_beside_the_others(models: Path, capsys):
    (models / find(FASTDEPTH).file).symlink_to("/proc/self/mem")  # which nobody can, root included
    assert main(["models", "verify"]) == 5
    shown = rows(capsys.readouterr().out)
    assert "can't be read" in shown[FASTDEPTH][0]
    assert "on CPUExecutionProvider" in shown["prism_nano"][1]
    assert main(["models", "list"]) == 0
    shown = rows(capsys.readouterr().out)
    assert "can't be read" in shown[FASTDEPTH][3]
    assert shown["prism_nano"][3] == "ready"


def test_an_empty_name_is_of_no_network(capsys):
    """A script's variable that is not set must not pass for a sound network."""
    assert main(["models", "verify", ""]) == 5
    assert rows(capsys.readouterr().out)[""] == ["not at hand", "model '': the name is empty"]


def test_a_file_that_can_not_be_looked_for_is_a_row_beside_the_others(capsys):
    """As one in a folder that is closed to us; root may enter any."""
    name = "x" * 300 + ".onnx"
    assert main(["models", "verify", name, "prism_nano"]) == 5
    shown = capsys.readouterr().out
    assert "can't be read (File name too long)" in shown.replace("\n", " ")
    assert "on CPUExecutionProvider" in rows(shown)["prism_nano"][1]


def test_a_checkpoint_that_is_not_here_is_not_verified(capsys, monkeypatch, tmp_path):
    for module in (pulled, registry):  # whatever a checkout's models/ has
        monkeypatch.setattr(module, "folders", lambda: [tmp_path])
    assert main(["models", "verify", "da3_small"]) == 5
    assert rows(capsys.readouterr().out)["da3_small"] == ["not at hand", "needs export"]


def test_a_known_network_that_is_not_here_is_not_said_to_have_no_digest(capsys):
    assert main(["models", "verify", FASTDEPTH]) == 5
    cells = rows(capsys.readouterr().out)[FASTDEPTH]
    assert cells[0] == "not at hand", "nor that none is known: `pull` quotes it"
