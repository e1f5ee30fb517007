"""The daemon's own command line: how it ends is said in a line that whoever started it passes on."""

from __future__ import annotations

from pathlib import Path

import pytest

from prism_edge.config import Config
from prism_edge.config_file import dump
from prism_edge.errors import FAILING_FILE, UNEXPECTED, SupervisionError
from prism_edge.supervisor import __main__ as daemon


@pytest.mark.parametrize(
    ("error", "code", "last"),
    [
        (SupervisionError("gone"), SupervisionError.exit_code, "gone"),
        (OSError(28, "No space left on device", "/run/x"), FAILING_FILE, "/run/x: No space left on device"),
        (ValueError("ours"), UNEXPECTED, "unexpected; please report it with the lines above"),
    ],
)
def test_the_last_line_says_why(
    error: Exception,
    code: int,
    last: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def supervise(*_: object, **__: object) -> int:
        raise error

    (tmp_path / "c.yaml").write_text(dump(Config()))
    monkeypatch.setattr(daemon, "supervise", supervise)
    monkeypatch.setattr(daemon, "log_as_configured", lambda *_: None)
    monkeypatch.setattr(daemon, "log_to_stderr", lambda *_: None)
    assert daemon.main(["--config", str(tmp_path / "c.yaml")]) == code
    said = capsys.readouterr().err.splitlines()
    assert said[-1] == f"prism-edge: error: {last}"
    assert (len(said) > 1) == (code == UNEXPECTED)
