"""The bar of an evaluation: on a terminal's stderr, and nowhere else."""

from __future__ import annotations

import errno
import io
import sys
import threading

import pytest

from prism_edge.evaluation.progress import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def shown(monkeypatch: pytest.MonkeyPatch, stderr: io.StringIO, quiet: bool = False) -> str:
    """What a run of 24 frames puts on ``stderr``."""
    monkeypatch.setattr(sys, "stderr", stderr)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "100")
    before = threading.active_count()
    with Progress(24, quiet) as progress:
        assert threading.active_count() == before  # a thread's time would count as the run's
        progress.at(7)
        assert ("7/24" in stderr.getvalue()) is (stderr.isatty() and not quiet)  # at once
        progress.say("settling")
        progress.say("reading", 300)
        progress.at(299)
    return stderr.getvalue()


def test_a_terminal_sees_how_far_a_run_is(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    said = shown(monkeypatch, Terminal())
    assert "playing" in said
    for words in ("7/24", "settling", "reading", "299/300"):
        assert words in said
    assert "7/24" in said[said.index("settling") :].partition("reading")[0]  # in the same number of frames
    assert "\x1b[?25h" in said[said.index("299/300") :]  # the cursor is shown again
    assert capsys.readouterr().out == ""  # which is for results


def test_a_terminal_that_goes_away_costs_the_bar_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gone(Terminal):
        is_gone = False

        def write(self, text: str) -> int:
            if self.is_gone:
                raise OSError(errno.EIO, "Input/output error")
            return super().write(text)

    stderr = Gone()
    monkeypatch.setattr(sys, "stderr", stderr)
    monkeypatch.setenv("TERM", "xterm")
    with Progress(24) as progress:
        progress.at(7)
        stderr.is_gone = True
        progress.at(8)
        progress.say("settling")
    assert "7/24" in stderr.getvalue()


def test_nothing_is_shown_where_nobody_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    assert shown(monkeypatch, Terminal(), quiet=True) == ""
    assert shown(monkeypatch, io.StringIO()).strip() == ""
