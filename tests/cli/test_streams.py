"""Commands whose stdin, stdout or stderr is closed, or whose reader goes away."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

CHECKOUT = Path(__file__).resolve().parents[2]


def ended(command: str, closed: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of a command that was started without some of the three."""
    line = ["sh", "-c", f'exec "$0" -m prism_edge.cli {command} {closed}', sys.executable]
    done = subprocess.run(line, cwd=CHECKOUT, capture_output=True, text=True, timeout=60)
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("closed", [">&-", "2>&-", "<&-", "<&- >&-", ">&- 2>&-", "<&- >&- 2>&-"])
@pytest.mark.parametrize(
    ("command", "code"),
    [("config", 0), ("models list", 0), ("--version", 0), ("config --set x", 3), ("fly", 2)],
)
def test_what_is_closed_is_written_to_nobody(command: str, code: int, closed: str) -> None:
    given, out, err = ended(command, closed)
    assert given == code
    assert "Traceback" not in err
    assert (out != "") == (code == 0 and ">&-" not in closed.replace("2>&-", "")), "an error is no output"


@pytest.mark.parametrize("command", ["doctor", "models list", "models verify", "config --explain"])
def test_a_reader_that_goes_away_is_no_error(command: str) -> None:
    line = [sys.executable, "-m", "prism_edge.cli", *command.split()]
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=CHECKOUT)
    assert process.stdout is not None
    assert process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == 0


@pytest.mark.parametrize("encoding", ["utf-8:strict", "utf-8:surrogateescape", "ascii:strict"])
def test_a_folder_whose_name_is_no_text_can_be_spoken_of(encoding: str, tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"st\xe9r\xe9o")
    folder.mkdir()
    (folder / "0.png").write_bytes(cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes())
    line = [sys.executable, "-m", "prism_edge.cli", "calibrate", folder, "--out", tmp_path / "camera.yaml"]
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run(line, cwd=CHECKOUT, env=environment, capture_output=True, timeout=60)
    assert done.returncode == 9
    assert b"looking for chessboard:9x6 in folder of images" in done.stdout
    assert (b"st\\udce9r" in done.stdout) == (encoding != "utf-8:surrogateescape")
    assert done.stderr.count(b"\n") == 1
