"""`prism-edge models pull`, `verify` and `remove` as a user types them."""

from __future__ import annotations

import builtins
import hashlib
import re
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml

from prism_edge.cli import models_files
from prism_edge.cli.main import main
from prism_edge.depth import registry
from tests.depth.web_server import WebServer, web_server
from tests.synthetic.network import TinyNetwork, save, tiny_graph, write_sidecar, write_tiny_network


@pytest.fixture(autouse=True)
def plain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A wide terminal, and the folder that networks are pulled into."""
    monkeypatch.setenv("COLUMNS", "400")
    monkeypatch.setenv("PRISM_EDGE_MODELS", str(tmp_path / "models"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.delenv("CACHE_DIRECTORY", raising=False)
    return tmp_path / "models"


@pytest.fixture
def server(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[WebServer]:
    """Serves a network and a non-commercial checkpoint, and stands in the registry."""
    with web_server() as running:
        card = asdict(TinyNetwork().card())
        values = {k: list(v) if isinstance(v, tuple) else v for k, v in card.items() if v not in (None, "")}
        content = write_tiny_network(tmp_path / "made.onnx").read_bytes()
        values["sha256"] = hashlib.sha256(content).hexdigest()
        running.files = {"/tiny.onnx": content, "/model.safetensors": b"weights"}
        tiny = {"file": "tiny.onnx", "url": f"{running.url}/tiny.onnx", "card": {"contract": 1, **values}}
        later = {
            "kind": "checkpoint",
            "name": "later",
            "licence": "CC-BY-NC-4.0",
            "depth_kind": "relative",
            "export": "a checkpoint",
            "files": [{"file": "model.safetensors", "url": f"{running.url}/model.safetensors"}],
        }
        (tmp_path / "registry.yaml").write_text(yaml.safe_dump({"registry": 1, "models": [tiny, later]}))
        monkeypatch.setattr(registry, "data_folder", lambda: tmp_path)
        registry.entries.cache_clear()
        yield running
        monkeypatch.undo()
        registry.entries.cache_clear()


def said(capsys: pytest.CaptureFixture[str], *arguments: str, code: int = 0) -> str:
    """What the command prints; of an error, its one line."""
    assert main(["models", *arguments]) == code
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    if code == 5 and not captured.out.strip():
        assert captured.err.count("\n") == 1
    return captured.out + captured.err


def rows(out: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.split("│")[1:-1]] for line in out.splitlines() if line[:1] == "│"]


def test_a_network_is_pulled_verified_listed_and_removed(server: WebServer, plain: Path, capsys):
    assert "can be pulled" in said(capsys, "list")
    out = said(capsys, "pull", "tiny_tint")
    for text in (
        "licence: Apache-2.0",
        "tiny.onnx  ",
        "SHA-256",
        f"in {plain / 'tiny_tint'}",
        "--model tiny_tint",
    ):
        assert text in out
    assert "ready" in said(capsys, "list")
    assert f"pulled    {server.url}/tiny.onnx" in said(capsys, "info", "tiny_tint")
    assert sum("tiny_tint" in line for line in said(capsys, "list").splitlines()) == 1
    assert said(capsys, "verify").count("as registered") == 1
    out = said(capsys, "remove", "tiny_tint", code=5)  # there is no terminal to ask at
    assert f"delete 2 files (0 MB) in {plain / 'tiny_tint'}? --yes says so" in out
    assert "deleted 2 files" in said(capsys, "remove", "tiny_tint", "--yes")
    assert not (plain / "tiny_tint").exists()
    assert "No network is at hand" in said(capsys, "verify")


def test_a_non_commercial_licence_must_be_agreed_to(server: WebServer, plain: Path, capsys):
    assert "needs export (unverified)" in said(capsys, "list")
    out = said(capsys, "info", "later")
    assert "non-commercial" in out
    assert "prism-edge models pull later --unverified" in out
    assert "no digest is known" in out
    out = said(capsys, "info", "tiny_tint")  # whose digest is known
    assert "--unverified" not in out
    assert "no digest is known" not in out
    assert "--unverified takes what comes" in said(capsys, "pull", "later", code=5)
    assert "forbids commercial use: --accept-licence" in said(capsys, "pull", "later", "--unverified", code=5)
    assert not server.asked
    assert not plain.exists()
    out = said(capsys, "pull", "later", "--unverified", "--accept-licence")
    assert f"python tools/export_da3 {plain / 'later'} later.onnx" in out
    assert (plain / "later" / "model.safetensors").read_bytes() == b"weights"
    assert "pulled, needs export" in said(capsys, "list")
    out = said(capsys, "verify")
    assert "as pulled (unverified then)" in out
    assert "needs export" in out


@pytest.mark.parametrize(("answer", "code"), [("y", 0), ("n", 5), ("", 5)])
def test_at_a_terminal_the_licence_is_asked_about(server, plain: Path, capsys, monkeypatch, answer, code):
    monkeypatch.setattr(models_files.Console, "is_terminal", True)
    monkeypatch.setattr(models_files.sys.stdin, "isatty", lambda: True, raising=False)
    questions = []

    def typed(prompt: str = "") -> str:
        questions.append(prompt)
        return answer

    monkeypatch.setattr(builtins, "input", typed)
    out = said(capsys, "pull", "later", "--unverified", code=code)
    assert "forbids commercial use" in out
    assert len(questions) == 1
    assert (plain / "later").exists() is (code == 0)


def test_what_is_typed_is_an_answer_only_where_it_comes_from_a_terminal(server, capsys, monkeypatch):
    """`yes | prism-edge models pull` has read no licence."""
    monkeypatch.setattr(models_files.Console, "is_terminal", True)
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: False))
    monkeypatch.setattr(models_files.Confirm, "ask", lambda *asked, **how: True)
    assert "--accept-licence says" in said(capsys, "pull", "later", "--unverified", code=5)
    said(capsys, "pull", "tiny_tint")
    assert "--yes says so" in said(capsys, "remove", "tiny_tint", code=5)


@pytest.mark.parametrize("running", [True, False])
def test_a_question_is_asked_between_bars(running: bool):
    done: list[str] = []
    bars = SimpleNamespace(
        live=SimpleNamespace(is_started=running),
        stop=lambda: done.append("stop"),
        start=lambda: done.append("start"),
    )
    models_files._paused(bars, done.append)("asked")
    assert done == (["stop", "asked", "start"] if running else ["asked"])


def test_a_checkpoint_that_is_not_what_was_pulled_fails_verification(server, plain: Path, capsys):
    """It can't be run, so that nothing but its digest tells."""
    said(capsys, "pull", "later", "--unverified", "--accept-licence")
    weights = plain / "later" / "model.safetensors"
    weights.write_bytes(b"others")
    assert "model.safetensors is not the file it should be" in said(capsys, "verify", "later", code=5)
    weights.unlink()
    assert "model.safetensors is missing" in said(capsys, "verify", "later", code=5)
    said(capsys, "remove", "later", "--yes")
    weights.parent.mkdir()
    weights.write_bytes(b"put there by hand")
    assert ["later", "none is known", "needs export"] in rows(said(capsys, "verify"))


def test_a_network_that_has_been_tampered_with_fails_verification(server, plain: Path, capsys):
    said(capsys, "pull", "tiny_tint")
    write_tiny_network(plain / "tiny_tint" / "tiny.onnx", TinyNetwork(gain=3.0))
    assert "wrong digest" in said(capsys, "list")
    out = said(capsys, "verify", code=5)
    assert "tiny.onnx is not the file it should be" in out
    assert "not the registered" in out
    assert "models remove tiny_tint" in said(capsys, "pull", "tiny_tint", code=5)


def test_a_file_named_by_its_path_is_held_to_what_was_pulled(server, plain: Path, tmp_path: Path, capsys):
    """As the service names it: pulled --into a folder of its own."""
    url = f"{server.url}/tiny.onnx"
    said(capsys, "pull", url, "--name", "mine", "--unverified", "--into", str(tmp_path / "srv"))
    path = tmp_path / "srv" / "mine" / "mine.onnx"
    assert "as registered" in said(capsys, "verify", str(path))
    write_tiny_network(path, TinyNetwork(name="mine", gain=3.0))
    (link := tmp_path / "current.onnx").symlink_to(path)
    out = said(capsys, "verify", str(path), str(link), code=5)
    assert out.count("mine.onnx is not the file it should be") == 2
    assert "its SHA-256 is" in said(capsys, "info", str(path), code=5)
    path.rename(path.with_name("own.onnx"))  # no file of the pulled ones
    assert "none is known" in said(capsys, "verify", str(path.with_name("own.onnx")))


def test_verify_says_whether_the_digest_was_given(server: WebServer, plain: Path, tmp_path: Path, capsys):
    made = write_tiny_network(tmp_path / "made.onnx", TinyNetwork(name="mine", gain=3.0))
    server.files["/mine.onnx"] = made.read_bytes()
    digest = hashlib.sha256(made.read_bytes()).hexdigest()
    said(capsys, "pull", f"{server.url}/mine.onnx", "--sha256", digest)
    manifest = plain / "mine" / "pulled.yaml"
    written = yaml.safe_load(manifest.read_text())
    assert written["given"] is True
    without = {key: value for key, value in written.items() if key != "given"}  # as earlier builds wrote it
    for content, shown in (
        (written, "as pulled (given digest)"),
        ({**written, "given": False}, "as pulled (unverified then)"),
        (without, "as pulled │"),
    ):
        manifest.write_text(yaml.safe_dump(content))
        for name in ("mine", str(manifest.with_name("mine.onnx"))):
            assert shown in " ".join(said(capsys, "verify", name).split())


def test_a_registered_file_is_known_wherever_it_lies(server: WebServer, tmp_path: Path, capsys):
    assert "as registered" in said(capsys, "verify", str(tmp_path / "made.onnx"))


def test_a_network_from_a_url(server: WebServer, plain: Path, capsys, monkeypatch):
    monkeypatch.setattr("prism_edge.depth.download.time.sleep", lambda seconds: None)
    url = f"{server.url}/tiny.onnx"
    assert "no SHA-256" in said(capsys, "pull", url, "--name", "mine", code=5)
    server.plan = ["truncate", "503"]
    # it bears a registered network's name and is that network
    out = said(capsys, "pull", url, "--name", "mine", "--unverified", "--stall", "1")
    assert "--model mine" in out
    assert "pulled from elsewhere" in said(capsys, "list")
    assert "tiny_tint" in said(capsys, "info", "mine")
    (plain / "mine" / "mine.onnx").write_bytes(b"others")
    assert "wrong digest" in said(capsys, "list")
    (plain / "mine" / "mine.onnx").unlink()
    assert "incomplete: pull again" in said(capsys, "list")


def test_a_network_that_says_nothing_of_itself_comes_but_can_t_be_run_yet(server, tmp_path: Path, capsys):
    path = write_tiny_network(tmp_path / "mute.onnx", TinyNetwork(describes_itself=False))
    server.files["/mute.onnx"] = path.read_bytes()
    out = said(capsys, "pull", f"{server.url}/mute.onnx", "--unverified")
    assert "licence: the file states none" in out
    assert "It can't be run yet: " in out
    assert "not stated" in next(line for line in said(capsys, "list").splitlines() if "mute" in line)


def test_a_folder_in_one_s_home_and_one_s_patience_are_heeded(server, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    asked = []
    pull = models_files.pulling.pull
    monkeypatch.setattr(models_files.pulling, "pull", lambda *how: asked.append(how[-1]) or pull(*how))
    said(capsys, "pull", "tiny_tint", "--into", "~/nets", "--stall", "7")
    assert (tmp_path / "home" / "nets" / "tiny_tint" / "tiny.onnx").is_file()
    assert [patience.stall_s for patience in asked] == [7.0]


def test_parts_of_a_pull_that_was_given_up_can_be_removed(server, plain: Path, capsys, monkeypatch):
    monkeypatch.setattr("prism_edge.depth.download.time.sleep", lambda seconds: None)
    server.plan = ["truncate"] + ["503"] * 9
    assert "pull again to go on" in said(capsys, "pull", "tiny_tint", code=5)
    assert [path.suffix for path in (plain / "tiny_tint").iterdir()] == [".part"]
    assert "deleted 1 files" in said(capsys, "remove", "tiny_tint", "--yes")
    assert not (plain / "tiny_tint").exists()


def test_what_was_not_pulled_is_not_deleted(server: WebServer, plain: Path, capsys):
    plain.mkdir()
    path = write_tiny_network(plain / "tiny.onnx")
    assert "put there by hand" in said(capsys, "remove", "tiny_tint", "--yes", code=5)
    assert path.exists()
    said(capsys, "pull", "tiny_tint")
    (plain / "tiny_tint" / "notes.txt").write_text("mine")
    said(capsys, "remove", "tiny_tint", "--yes")
    assert (plain / "tiny_tint" / "notes.txt").read_text() == "mine"


def test_what_lies_outside_the_folders_is_not_deleted(server, plain: Path, tmp_path: Path, capsys):
    plain.mkdir()
    said(capsys, "pull", "tiny_tint", "--into", str(tmp_path / "srv"))
    assert "was not pulled" in said(capsys, "remove", "../srv/tiny_tint", "--yes", code=5)
    assert (tmp_path / "srv" / "tiny_tint" / "tiny.onnx").is_file()


def test_what_can_t_be_deleted_is_one_line(server, capsys, monkeypatch):
    def refused(self: Path, missing_ok: bool = False) -> None:
        raise PermissionError(13, "Permission denied")

    said(capsys, "pull", "tiny_tint")
    monkeypatch.setattr(Path, "unlink", refused)
    assert "can't be deleted (Permission denied)" in said(capsys, "remove", "tiny_tint", "--yes", code=5)


@pytest.mark.parametrize(
    "arguments",
    [
        ["pull", "nothing"],
        ["pull", "tiny_tint", "--sha256", "abc"],
        ["pull", "tiny_tint", "--name", "mine"],
        ["pull", "ftp://example.org/x.onnx"],
        ["remove", "../models", "--yes"],
        ["remove", "nothing", "--yes"],
        ["bench", "nothing"],
        ["bench", "tiny_tint", "--providers", "abacus"],
    ],
)
def test_what_can_not_be_done_is_one_line(server: WebServer, capsys, arguments: list[str]):
    assert main(["models", *arguments]) == 5
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("prism-edge: error: ")


@pytest.mark.parametrize(
    "arguments",
    [
        ["pull", "tiny_tint", "--stall", "0"],
        ["pull", "tiny_tint", "--stall", "0.09"],
        ["pull", "tiny_tint", "--stall", "3601"],
        ["bench", "tiny_tint", "--runs", "0"],
        ["bench", "tiny_tint", "--runs", "10001"],
        ["bench", "tiny_tint", "--threads", "0"],
        ["bench", "tiny_tint", "--threads", "1", "65"],
    ],
)
def test_a_number_that_can_not_be_is_a_wrong_command_line(server: WebServer, capsys, arguments: list[str]):
    with pytest.raises(SystemExit) as ended:
        main(["models", *arguments])
    assert ended.value.code == 2
    assert f"argument {arguments[2]}: expected" in capsys.readouterr().err


def test_what_comes_along_need_not_be_pulled(capsys):
    out = said(capsys, "pull", "prism_nano")
    assert "prism_nano is here already" in out
    assert "--model prism_nano" in out


@pytest.mark.parametrize(("misbehaviour", "says"), [("nan", "NaN"), ("constant", "constant")])
def test_verify_judges_the_answer(tmp_path: Path, capsys, misbehaviour: str, says: str):
    what = TinyNetwork(misbehaviour=misbehaviour)
    out = said(capsys, "verify", str(write_tiny_network(tmp_path / "useless.onnx", what)), code=5)
    assert "of no use" in out
    assert says in out


@pytest.mark.parametrize("kind", ["relative", "inverse_relative"])
def test_verify_knows_that_depth_up_to_a_shift_may_be_negative(tmp_path: Path, capsys, kind: str):
    for misbehaviour, code, says in (("negative", 0, "on CPUExecution"), ("constant", 5, "of no use")):
        what = TinyNetwork(depth_kind=kind, misbehaviour=misbehaviour)
        path = write_tiny_network(tmp_path / f"{misbehaviour}.onnx", what)
        assert says in said(capsys, "verify", str(path), code=code)


def test_verify_says_how_far_a_test_picture_is_and_doubts_millimetres(tmp_path: Path, capsys):
    metres = said(capsys, "verify", str(write_tiny_network(tmp_path / "m.onnx")))
    assert re.search(r"on CPUExecutionProvider: [\d.]+ to [\d.]+ m, median [\d.]+ m", metres)
    assert "warning" not in metres
    path = write_tiny_network(tmp_path / "mm.onnx", TinyNetwork(gain=1000.0, describes_itself=False))
    write_sidecar(path, TinyNetwork().card())
    doubted = " ".join(said(capsys, "verify", str(path)).replace("│", " ").split())
    assert re.search(r"warning: a median depth of \d{3,5} m is not within 0.05 and 300 m", doubted)
    write_sidecar(path, replace(TinyNetwork().card(), depth_scale=0.001))
    assert "warning" not in said(capsys, "verify", str(path))


def test_verify_holds_outputs_that_no_keyframe_asks_for_to_their_shapes(tmp_path: Path, capsys):
    what = TinyNetwork(descriptor=True)
    path = tmp_path / "bad.onnx"
    save(path, tiny_graph(what), replace(what.card(), descriptor_output="", intrinsics_output="descriptor"))
    assert "for intrinsics has shape [1, 75], not (1, 3, 3)" in said(capsys, "verify", str(path), code=5)


def test_verify_has_a_row_for_each_part_of_a_pair(tmp_path: Path, capsys):
    relative = write_tiny_network(tmp_path / "r.onnx", TinyNetwork(name="r", depth_kind="relative"))
    metric = write_tiny_network(tmp_path / "m.onnx", TinyNetwork(name="m"))
    out = said(capsys, "verify", f"nested:{relative},{metric}")
    assert out.count("on CPUExecutionProvider") == 2
    assert "no metres of its own" in out
    out = said(capsys, "verify", f"nested:{metric},{relative}", code=5)
    assert "the first network must be a relative one" in out
    assert "nested takes two networks" in said(capsys, "verify", "nested:alone", str(metric), code=5)
    out = said(capsys, "verify", f"nested:nowhere,{metric}", code=5)
    assert out.count("neither a file nor a registered name") == 1  # not again of the pair
    assert "not at hand" in out


def test_verify_says_what_is_wrong_with_a_file(tmp_path: Path, capsys):
    good, bad = write_tiny_network(tmp_path / "good.onnx"), tmp_path / "bad.onnx"
    bad.write_bytes(good.read_bytes()[:200])
    assert "on CPUExecutionProvider" in said(capsys, "verify", str(good))
    assert "no ONNX model, or damaged" in said(capsys, "verify", str(good), str(bad), code=5)


@pytest.mark.parametrize("answer", [False, True])
def test_who_is_asked_whether_to_delete_and_says_no_keeps_all(tmp_path: Path, monkeypatch, answer: bool):
    file = tmp_path / "own" / "net.onnx"
    file.parent.mkdir()
    file.write_bytes(b"x")
    monkeypatch.setattr(models_files, "_removable", lambda name: (file.parent, [file]))
    monkeypatch.setattr("sys.stdin", SimpleNamespace(isatty=lambda: True))
    monkeypatch.setattr(models_files.Confirm, "ask", lambda *asked, **how: answer)
    console = SimpleNamespace(is_terminal=True, print=lambda *said, **how: None)
    assert models_files._remove(console, "own", yes=False) == 0
    assert file.exists() != answer
