"""The command line as a user meets it: help, one-line errors, exit codes."""

from __future__ import annotations

import contextlib
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from prism_edge import errors
from prism_edge.cli import main as cli
from prism_edge.cli.main import COMMANDS, EXIT_CODES, main


def fails(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Exit code and the only line on stderr."""
    code = main(list(arguments))
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err.startswith("prism-edge: error: ")
    assert said.err.count("\n") == 1
    return code, said.err


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_each_command(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main([command, "--help"])
    assert ended.value.code == 0
    assert f"prism-edge {command}" in capsys.readouterr().out


def test_help_of_run_says_what_a_hangup_does_under_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["run", "--help"])
    assert "under a terminal it ends the run" in " ".join(capsys.readouterr().out.split())


def test_help_names_every_command_and_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    said = capsys.readouterr().out
    assert all(re.search(rf"^    {command}\s", said, re.MULTILINE) for command in COMMANDS)
    assert EXIT_CODES in said


def test_each_commands_line_of_help_is_the_same_whichever_is_named(
    capsys: pytest.CaptureFixture[str],
) -> None:
    shown = []
    for more in ([], *([command] for command in COMMANDS)):
        with pytest.raises(SystemExit):
            main(["--help", *more])
        shown.append(capsys.readouterr().out)
    assert set(shown) == {shown[0]}


def test_exit_codes_are_documented(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[2] / "docs" / "TROUBLESHOOTING.md").read_text(encoding="utf-8")
    kinds = [kind for kind in errors.PrismError.__subclasses__() if kind.__module__ == errors.__name__]
    codes = {kind.exit_code for kind in kinds}
    for code in {0, 1, 2, errors.UNEXPECTED, errors.FAILING_FILE, *codes}:
        assert f"\n| {code} | " in page
        assert f"\n  {code} " in "\n" + EXIT_CODES


def test_help_loads_no_heavy_library() -> None:
    script = (
        "import sys; from prism_edge.cli.main import build_parser; build_parser(None).format_help();"
        "print([m for m in ('numpy', 'cv2', 'zenoh', 'gtsam', 'onnxruntime', 'yaml') if m in sys.modules])"
    )
    assert subprocess.check_output([sys.executable, "-c", script], text=True).strip() == "[]"


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["run", "--fly"],
        ["run", "sim:room", "--mode", "lockstep"],
        ["ctl", "info", "--time", "1"],
        ["worker", "pilot", "--config", "x"],
        ["watch", "--count", "0"],
        ["watch", "--count", "-1"],
        ["watch", "--count", "many"],
        ["watch", "--tum", ""],
        ["ctl", "dance"],
        ["ctl", "info", "--timeout", "0"],
        ["ctl", "info", "--timeout", "nan"],
        ["ctl", "info", "--timeout", "soon"],
    ],
)
def test_wrong_command_line_is_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["run"], 4, "no source"),
        (["run", "missing"], 4, "missing"),
        (["run", ".", "--set", "depth.threads"], 3, "KEY=VALUE"),
        (["run", ".", "--set", "depth.thread=2"], 3, "did you mean depth.threads?"),
        (["run", ".", "--set", "depth.threads=many"], 3, "depth.threads"),
        (["run", ".", "--seed", "x"], 3, "seed"),
        (["run", ".", "--config", "missing.yaml"], 3, "missing.yaml"),
        (["run", ".", "--robot", "a/b"], 3, "a/b"),
        (["run", ".", "--robot", "*"], 3, "robot"),
        (["run", ".", "--robot", ""], 3, "robot"),
        (["run", ".", "--endpoint", "tcp/127.0.0.1"], 6, "tcp/127.0.0.1"),
        (["run", ".", "--endpoint", "nonsense"], 6, "nonsense"),
        (["run", ".", "--camera", "missing.yaml"], 3, "missing.yaml"),
        (["config", "--check", "missing.yaml"], 3, "missing.yaml"),
        (["config", "--set", "mode=fast"], 3, "realtime or lockstep"),
    ],
)
def test_users_error_is_one_line_before_anything_starts(
    arguments: list[str],
    code: int,
    words: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "0001.png").write_bytes(b"")  # a folder of images
    given, line = fails(capsys, *arguments)
    assert given == code
    assert words in line


def test_ctrl_c_is_130(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr("prism_edge.cli.config.run", interrupted)
    assert cli.main(["config"]) == 130


def test_ctrl_c_while_the_command_is_loaded_is_130_too(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(_: str) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli.importlib, "import_module", interrupted)
    assert cli.main(["watch"]) == 130
    assert capsys.readouterr().err == ""


def test_so_it_is_where_a_library_makes_an_import_error_of_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As those written in C do, gtsam's for one."""
    monkeypatch.setattr("prism_edge.cli.config.run", lambda _: exec_import(KeyboardInterrupt()))
    assert cli.main(["config"]) == 130
    assert capsys.readouterr().err == ""
    monkeypatch.setattr("prism_edge.cli.config.run", lambda _: exec_import(OSError("no such library")))
    assert cli.main(["config"]) == 70
    assert "ImportError: initialization failed" in capsys.readouterr().err


def exec_import(why: BaseException) -> None:
    raise ImportError("initialization failed") from why


@pytest.mark.parametrize(
    "words",
    [
        ("eval", "sim:room", "--out"),
        ("eval", "sim:room", "--out", "run", "--truth"),
        ("demo", "--out"),
        ("reconstruct", "map", "recording", "--out"),
        ("calibrate", "pictures", "--out"),
        ("calibrate", "pictures", "--picture"),
        ("mask", "pictures", "--out"),
        ("models", "pull", "prism_nano", "--into"),
        ("watch", "--tum"),
        ("map", "export", "lab", "--ply"),
    ],
)
def test_an_empty_name_is_not_the_folder_one_stands_in(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    """As of a script's variable that is not set."""
    with pytest.raises(SystemExit) as ended:
        main([*words, ""])
    assert ended.value.code == 2
    assert f"{words[-1]}: expected a file or folder, got an empty name" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "option"),
    [(c, o) for c in ("run", "eval") for o in ("--model", "--camera", "--mask")]
    + [("demo", "--model"), ("reconstruct", "--model")],
)
def test_an_empty_name_is_not_the_same_as_none(
    command: str, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """Else the robot would be looked at as if it were the world, and nobody be told."""
    with pytest.raises(SystemExit) as ended:
        main([command, "sim:room", option, ""])
    assert ended.value.code == 2
    assert f"{option}: expected a name, got an empty one" in capsys.readouterr().err


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize("option", ["--explain", "--robot=r2"])
def test_output_on_a_full_disk_is_one_line(option: str) -> None:
    with open("/dev/full", "w") as full:
        process = subprocess.run(
            [sys.executable, "-m", "prism_edge.cli", "config", option],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).resolve().parents[2],
        )
    assert process.stderr == "prism-edge: error: No space left on device\n"
    assert process.returncode == errors.FAILING_FILE


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
@pytest.mark.parametrize(("error", "code"), [(errors.ModelError("m"), 5), (ValueError("ours"), 70)])
def test_an_error_has_its_code_though_it_can_not_be_told(
    error: Exception, code: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prism_edge.cli.config.run", raising(error))
    with open("/dev/full", "w", buffering=1) as full:
        monkeypatch.setattr("sys.stderr", full)
        assert main(["config"]) == code
        monkeypatch.undo()
        with contextlib.suppress(OSError):
            full.close()


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (OSError(28, "No space left on device", "/run/x/lock"), "/run/x/lock: No space left on device"),
        (TimeoutError(), "TimeoutError"),
        (OSError("no number"), "no number"),
    ],
)
def test_a_file_that_fails_is_one_line(
    error: OSError, line: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prism_edge.cli.config.run", raising(error))
    assert fails(capsys, "config") == (errors.FAILING_FILE, f"prism-edge: error: {line}\n")


def test_an_error_of_our_own_shows_where(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("prism_edge.cli.config.run", raising(ValueError("ours")))
    assert cli.main(["config"]) == errors.UNEXPECTED
    said = capsys.readouterr().err.splitlines()
    assert said[0].startswith("Traceback")
    assert said[-2:] == [
        "ValueError: ours",
        "prism-edge: error: unexpected; please report it with the lines above",
    ]


def raising(error: Exception) -> Callable[..., int]:
    def run(*_: object) -> int:
        raise error

    return run


def test_reader_that_goes_away_is_no_error() -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "prism_edge.cli", "config", "--explain"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        cwd=Path(__file__).resolve().parents[2],
    )
    assert process.stdout is not None
    process.stdout.close()
    assert process.stderr is not None
    assert process.stderr.read() == b""
    assert process.wait() == 0


@pytest.mark.parametrize("module", ["prism_edge", "prism_edge.cli"])
def test_the_package_runs_as_the_command(module: str) -> None:
    root = Path(__file__).resolve().parents[2]
    line = [sys.executable, "-m", module, "config", "--explain", "--set", "robot=ada"]
    done = subprocess.run(line, capture_output=True, text=True, cwd=root)
    assert done.returncode == 0
    assert "robot: ada" in done.stdout
