"""The journal's native protocol, read back by its rules."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import struct
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from prism_edge.config import Config, LogConfig
from prism_edge.workers import journald_log, launch
from prism_edge.workers.journald_log import JournalHandler, stderr_is_the_journal

CHECKOUT = Path(__file__).resolve().parents[2]


def fields(datagram: bytes) -> dict[str, str]:
    """A datagram's fields, by the published rules: a line with `=`, or a name, a length and as many bytes."""
    found = {}
    while datagram:
        line, _, rest = datagram.partition(b"\n")
        if b"=" in line:
            name, _, value = line.partition(b"=")
            datagram = rest
        else:
            name, (size,) = line, struct.unpack("<Q", rest[:8])
            value, end, datagram = rest[8 : 8 + size], rest[8 + size : 9 + size], rest[9 + size :]
            assert end == b"\n"
        found[name.decode()] = value.decode()
    return found


@pytest.fixture
def server(tmp_path: Path) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "journal"))
        listening.settimeout(10)
        yield listening


@pytest.fixture
def log(server: socket.socket) -> Iterator[logging.Logger]:
    logger = logging.getLogger("prism_edge.test_journal")
    logger.propagate = False
    handler = JournalHandler({"PRISM_PROCESS": "depth"}, server.getsockname())
    logger.addHandler(handler)
    logger.setLevel(logging.DEBUG)
    yield logger
    logger.removeHandler(handler)
    handler.close()


@pytest.mark.parametrize(
    ("level", "number"), [("debug", "7"), ("info", "6"), ("warning", "4"), ("error", "3"), ("critical", "2")]
)
def test_a_line_and_its_fields(
    log: logging.Logger, server: socket.socket, level: str, number: str
) -> None:
    getattr(log, level)("%d images = ü", 5)
    found = fields(server.recv(65536))
    assert found["MESSAGE"] == "5 images = ü"
    assert found["PRIORITY"] == number
    assert found["SYSLOG_IDENTIFIER"] == "prism-edge"
    assert found["PRISM_PROCESS"] == "depth"
    assert found["LOGGER"] == "prism_edge.test_journal"
    assert found["CODE_FILE"] == __file__


def test_a_traceback_and_forged_fields_stay_in_the_message(
    log: logging.Logger, server: socket.socket
) -> None:
    try:
        raise ValueError("x\nPRIORITY=0\nMESSAGE=forged")
    except ValueError:
        log.exception("failed")
    found = fields(server.recv(65536))
    assert found["MESSAGE"].startswith("failed\nTraceback")
    assert "MESSAGE=forged" in found["MESSAGE"]
    assert found["PRIORITY"] == "3"


def test_a_huge_message_is_cut(log: logging.Logger, server: socket.socket) -> None:
    log.info("x" * 10_000_000)
    assert len(fields(server.recv(1 << 20))["MESSAGE"]) == journald_log.LONGEST


def test_a_journal_that_has_gone_is_no_error(
    log: logging.Logger, server: socket.socket, capsys: pytest.CaptureFixture[str]
) -> None:
    server.close()
    log.warning("on its own")
    assert "<4>on its own" in capsys.readouterr().err


def test_a_journal_whose_socket_is_made_anew_has_its_lines_again(
    log: logging.Logger, server: socket.socket, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(server.getsockname())
    server.close()
    log.warning("meanwhile")
    path.unlink()
    log.warning("meanwhile too")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as anew:
        anew.bind(str(path))
        anew.settimeout(10)
        log.warning("heard")
        found = fields(anew.recv(65536))
    assert (found["MESSAGE"], found["PRISM_PROCESS"]) == ("heard", "depth")
    assert capsys.readouterr().err == "<4>meanwhile\n<4>meanwhile too\n"


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_line_that_nothing_takes_is_no_error(
    log: logging.Logger, server: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    server.close()
    with open("/dev/full", "w", buffering=1) as full:
        monkeypatch.setattr(sys, "stderr", full)
        log.warning("nobody hears it")
        monkeypatch.undo()
        with contextlib.suppress(OSError):
            full.close()


@pytest.mark.timeout(30)
def test_a_journal_that_hangs_holds_nobody_up_on_stderr(
    log: logging.Logger, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its stream is full as well: a line that waited there would be caught by the test's own time limit."""
    ours, theirs = socket.socketpair()
    with ours, theirs, ours.makefile("w", buffering=1) as stderr:
        ours.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                ours.send(b"x" * 1000)
        ours.setblocking(True)
        monkeypatch.setattr(sys, "stderr", stderr)
        for _ in range(2000):  # the journal's own queue fills up on the way
            log.warning("x" * 1000)
        monkeypatch.undo()


def test_stderr_is_the_journal_where_systemd_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    with (tmp_path / "err").open("w") as stream:
        monkeypatch.setattr(sys, "stderr", stream)
        status = os.fstat(stream.fileno())
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino}")
        assert stderr_is_the_journal()
        monkeypatch.setenv("JOURNAL_STREAM", f"{status.st_dev}:{status.st_ino + 1}")
        assert not stderr_is_the_journal()
        for unset in ("", "nonsense"):
            monkeypatch.setenv("JOURNAL_STREAM", unset)
            assert not stderr_is_the_journal()


@pytest.mark.parametrize(("form", "logged"), [("journal", True), ("text", False), ("auto", False)])
def test_the_configuration_decides(form: str, logged: bool, server: socket.socket) -> None:
    script = (
        "import logging, sys; from prism_edge.config import Config, LogConfig\n"
        "from prism_edge.workers import journald_log, launch\n"
        "init = journald_log.JournalHandler.__init__; path = sys.argv[2]\n"
        "journald_log.JournalHandler.__init__ = lambda self, fields: init(self, fields, path)\n"
        "launch.log_as_configured('depth', Config(log=LogConfig(form=sys.argv[1], level='warning')))\n"
        "logging.info('quiet'); logging.warning('heard')\n"
    )
    command = [sys.executable, "-c", script, form, server.getsockname()]
    done = subprocess.run(command, cwd=CHECKOUT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    if logged:
        assert fields(server.recv(65536))["MESSAGE"] == "depth: heard"
        assert done.stderr == ""
    else:
        assert "WARNING depth: heard" in done.stderr
        assert "quiet" not in done.stderr


def test_no_journal_is_said_and_logged_in_text(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(journald_log.JournalHandler.__init__, "__defaults__", ("/nowhere/at/all",))
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    try:
        launch.log_as_configured("depth", Config(log=LogConfig(form="journal")))
        logging.getLogger("prism_edge").info("still heard")
    finally:
        root.handlers[:] = handlers
        root.setLevel(level)
    said = capsys.readouterr().err
    assert "no journal to log to" in said
    assert "still heard" in said
