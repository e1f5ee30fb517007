"""The comparison with real pictures: what is none is said before any simulated world is played."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from tools import benchmark_sim


@pytest.mark.parametrize("held", [None, 0, 1])
def test_a_folder_without_pictures_is_one_line(held: int | None, tmp_path: Path, monkeypatch) -> None:
    folder = tmp_path / "pictures"
    if held is not None:
        folder.mkdir()
        for i in range(held):
            cv2.imwrite(str(folder / f"{i}.png"), np.zeros((48, 64), np.uint8))
    monkeypatch.setattr(benchmark_sim, "simulated", lambda *_: pytest.fail("it was to be said at once"))
    monkeypatch.setattr("sys.argv", ["benchmark_sim.py", "--video", str(folder)])
    with pytest.raises(SystemExit, match="holds no pictures"):
        benchmark_sim.main()


@pytest.mark.parametrize("option", ["--frames", "--pairs"])
def test_none_at_all_is_refused(option: str, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["benchmark_sim.py", option, "0"])
    with pytest.raises(SystemExit) as ended:
        benchmark_sim.main()
    assert ended.value.code == 2
    assert option in capsys.readouterr().err


def test_pictures_are_compared(tmp_path: Path, monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (240, 330), dtype=np.uint8)
    for i in range(3):
        picture = cv2.GaussianBlur(noise[:, 3 * i : 320 + 3 * i], (5, 5), 1.0)
        cv2.imwrite(str(tmp_path / f"{i}.png"), picture)
    monkeypatch.setattr(benchmark_sim, "simulated", lambda *_: None)
    monkeypatch.setattr("sys.argv", ["benchmark_sim.py", "--video", str(tmp_path), "--pairs", "2"])
    benchmark_sim.main()
    assert str(tmp_path) in capsys.readouterr().out


def test_one_frame_alone_makes_no_pair(monkeypatch) -> None:
    monkeypatch.setattr("sys.argv", ["benchmark_sim.py", "sim:room?frames=1"])
    with pytest.raises(SystemExit, match="has one frame"):
        benchmark_sim.main()
