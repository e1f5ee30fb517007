"""Downloads from a real server on loopback that truncates, corrupts, stalls, redirects and changes."""

from __future__ import annotations

import errno
import hashlib
import http.client
import os
import shutil
import ssl
import urllib.error
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from prism_edge.depth import download, web
from prism_edge.depth.download import Patience, Wanted, fetch, parts_of, settle
from prism_edge.errors import ModelError
from tests.depth.web_server import WebServer, web_server

CONTENT = np.random.default_rng(0).bytes(300_000)
DIGEST = hashlib.sha256(CONTENT).hexdigest()
HASTY = Patience(stall_s=30.0, attempts=3, pause_s=0.0)  # only who stalls on purpose is held to less
STALL_S = 1.0


def held_to(plan: list[str], attempts: int = 3) -> Patience:
    stalls = {"stall", "trickle"} & set(plan)
    return Patience(STALL_S if stalls else HASTY.stall_s, attempts, pause_s=0.0)


@pytest.fixture
def server() -> Iterator[WebServer]:
    with web_server() as running:
        running.files["/net.onnx"] = CONTENT
        yield running


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "models" / "net.onnx"


def wanted(server: WebServer, file: Path, **more: object) -> Wanted:
    return Wanted(f"{server.url}/net.onnx", file, **{"sha256": DIGEST, "size": len(CONTENT), **more})


def digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def refused(want: Wanted, says: str, patience: Patience = HASTY) -> None:
    """In one line, and without anything but parts in the folder."""
    with pytest.raises(ModelError, match=says) as error:
        fetch(want, patience)
    assert "\n" not in str(error.value)
    if want.file.parent.exists():
        assert set(os.listdir(want.file.parent)) == {part.name for part in parts_of(want.file)}


def test_a_file_comes_whole_and_is_put_in_place_in_one_step(server: WebServer, file: Path):
    seen: list[tuple[int, int]] = []
    part = fetch(wanted(server, file), HASTY, lambda have, total: seen.append((have, total)))
    assert not file.exists()
    settle(part, file)
    assert file.read_bytes() == CONTENT
    assert os.listdir(file.parent) == ["net.onnx"]
    assert seen[0] == (0, len(CONTENT))
    assert seen[-1] == (len(CONTENT), len(CONTENT))
    assert seen == sorted(seen)


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("plan", [["truncate"], ["truncate", "truncate", "truncate", "truncate"], ["stall"]])
def test_what_breaks_off_is_gone_on_with(server: WebServer, file: Path, plan: list[str], known: bool):
    server.plan = list(plan)
    want = wanted(server, file) if known else wanted(server, file, sha256="", size=0)
    assert fetch(want, held_to(plan)).read_bytes() == CONTENT
    starts = [int(span.removeprefix("bytes=").rstrip("-") or 0) for _, span in server.asked]
    assert starts[0] == 0
    assert starts == sorted(set(starts))  # each goes on where the last one ended
    assert len(starts) == len(plan) + 1


@pytest.mark.parametrize("how", ["503", "429", "500", "close"])
def test_a_fault_that_passes_is_waited_for(server: WebServer, file: Path, how: str):
    server.plan = [how, how]
    assert fetch(wanted(server, file), HASTY).read_bytes() == CONTENT


@pytest.mark.parametrize(
    ("how", "says"),
    [
        ("truncate", "broke off at 150000 of 300000 bytes; what has come is kept"),
        ("stall", "nothing has come for too long; what has come is kept"),
        ("trickle", f"less than 1024 bytes have come in {STALL_S:g} s; what has come is kept"),
        ("503", "the server answers 503"),
        ("close", "no sensible answer|no connection"),
    ],
)
def test_one_attempt_ends_in_one_line_and_the_next_call_goes_on(server, file, how: str, says: str):
    server.plan = [how]
    refused(wanted(server, file), says, held_to([how], attempts=1))
    had = sum(part.stat().st_size for part in parts_of(file))
    assert fetch(wanted(server, file), HASTY).read_bytes() == CONTENT
    assert server.asked[-1][1] == (f"bytes={had}-" if had else "")


def test_a_server_that_never_gets_further_is_given_up(server: WebServer, file: Path):
    server.plan = ["503"] * 9
    refused(wanted(server, file), "the server answers 503")
    assert len(server.asked) == HASTY.attempts


@pytest.mark.parametrize("code", [400, 401, 403, 404, 410])
def test_a_refusal_is_taken_at_once(server: WebServer, file: Path, code: int):
    server.plan = [str(code)]
    refused(wanted(server, file), f"the server answers {code}")
    assert len(server.asked) == 1


def test_a_corrupted_file_is_not_kept(server: WebServer, file: Path):
    server.plan = ["corrupt"]
    refused(wanted(server, file), f"its SHA-256 is .* not the registered {DIGEST[:12]}.* nothing is kept")
    assert not parts_of(file)
    assert fetch(wanted(server, file), HASTY).read_bytes() == CONTENT


def test_a_spoilt_beginning_costs_a_second_download_but_not_the_file(server: WebServer, file: Path):
    server.plan = ["truncate"]
    refused(wanted(server, file), "broke off", held_to([], attempts=1))
    (part,) = parts_of(file)
    part.write_bytes(bytes(len(part.read_bytes())))
    assert fetch(wanted(server, file), HASTY).read_bytes() == CONTENT


@pytest.mark.parametrize("known", [True, False])
@pytest.mark.parametrize("how", ["ignore-range", "wrong-range", "changed", "416"])
def test_a_server_that_can_not_go_on_sends_it_again(server: WebServer, file: Path, how: str, known: bool):
    server.plan = ["truncate", how]
    want = wanted(server, file) if known else wanted(server, file, sha256="", size=0)
    assert fetch(want, HASTY).read_bytes() == CONTENT
    assert len(parts_of(file)) == 1


def test_two_versions_are_never_joined(server: WebServer, file: Path):
    server.plan = ["truncate"]
    want = wanted(server, file, sha256="", size=0)
    refused(want, "broke off", held_to([], attempts=1))
    newer = bytes(reversed(CONTENT))
    server.files["/net.onnx"] = newer
    assert fetch(want, HASTY).read_bytes() == newer


def test_a_part_of_no_named_version_is_gone_on_with_only_where_a_digest_can_tell(server, file: Path):
    server.etags = False
    unknown = wanted(server, file, sha256="", size=0)
    for want in (unknown, wanted(server, file)):
        server.plan = ["truncate"]
        refused(want, "broke off", held_to([], attempts=1))
        newer = bytes(reversed(CONTENT))
        server.files["/net.onnx"] = newer
        assert fetch(replace(want, sha256=want.sha256 and digest(newer)), HASTY).read_bytes() == newer
        assert server.asked[-1][1] == ""
        server.files["/net.onnx"] = CONTENT
        for part in parts_of(file):
            part.unlink()


def test_a_digest_makes_up_for_a_version_that_is_not_named(server: WebServer, file: Path):
    server.etags = False
    server.plan = ["truncate"]
    assert fetch(wanted(server, file), HASTY).read_bytes() == CONTENT
    assert [span for _, span in server.asked] == ["", f"bytes={len(CONTENT) // 2}-"]


def test_a_complete_part_of_another_version_of_the_same_length_is_fetched_again(server, file: Path):
    want = wanted(server, file, sha256="", size=0)
    fetch(want, HASTY)
    server.files["/net.onnx"] = bytes(reversed(CONTENT))
    assert fetch(want, HASTY).read_bytes() == bytes(reversed(CONTENT))


def test_a_part_that_was_complete_is_not_fetched_again(server: WebServer, file: Path):
    for want in (wanted(server, file), wanted(server, file, sha256="", size=0)):
        part = fetch(want, HASTY)
        before = part.stat().st_ino
        assert fetch(want, HASTY).stat().st_ino == before
    assert len([span for _, span in server.asked if not span]) == 1


def test_a_server_without_versions_or_lengths_will_do(server: WebServer, file: Path):
    server.etags = False
    server.plan = ["truncate", "no-length"]
    assert fetch(wanted(server, file), HASTY).read_bytes() == CONTENT


def test_parts_of_another_file_are_left_alone(server: WebServer, file: Path):
    file.parent.mkdir()
    other = file.parent / "net.onnx.data.0123456789ab.part"
    other.write_bytes(b"of another file")
    fetch(wanted(server, file), HASTY)
    assert other.read_bytes() == b"of another file"


@pytest.mark.parametrize("hops", [1, 5])
def test_redirects_are_followed_and_gone_on_behind(server: WebServer, file: Path, hops: int):
    chain = [f"-> /hop{n}" for n in range(1, hops)] + [f"-> {server.url}/net.onnx"]
    server.plan = [*chain, "truncate", *chain]
    assert fetch(wanted(server, file), HASTY).read_bytes() == CONTENT
    assert server.asked[-1] == ("/net.onnx", "bytes=150000-")


@pytest.mark.parametrize(
    ("target", "says"),
    [
        ("file:///etc/passwd", "answers 302|not followed"),
        ("ftp://127.0.0.1/net.onnx", "redirects from http to ftp"),
        ("http://user:word@127.0.0.1/net.onnx", "password"),
        ("/net.onnx", "answers 302"),
    ],
)
def test_redirects_to_elsewhere_or_without_end_are_refused(server, file, target: str, says: str):
    server.plan = [f"-> {target}"] * 20
    refused(wanted(server, file), says)


def test_a_redirect_from_https_to_http_is_refused():
    from email.message import Message
    from io import BytesIO
    from urllib.request import Request

    from prism_edge.depth.web import _Redirects

    asked, handler = Request("https://example.org/net.onnx"), _Redirects()
    for target in ("http://example.org/net.onnx", "ftp://example.org/net.onnx"):
        with pytest.raises(ModelError, match="redirects from https to"):
            handler.redirect_request(asked, BytesIO(), 302, "Found", Message(), target)
    followed = handler.redirect_request(
        Request("http://example.org/net.onnx"), BytesIO(), 302, "Found", Message(), "https://example.org/net"
    )
    assert followed is not None
    assert followed.full_url == "https://example.org/net"


@pytest.mark.parametrize(
    "url",
    [
        "file:///etc/passwd",
        "ftp://example.org/x",
        "https://",
        "https://user:word@example.org/x",
        "https://token@example.org/x",
        "https://example.org:port/x",
        "https://[::1/x",
        "no url",
        "",
        "https://example.org/a b",
        "https://example.org/a\nb",
    ],
)
def test_what_is_no_url_of_the_web_is_refused(tmp_path: Path, url: str):
    refused(Wanted(url, tmp_path / "x" / "net.onnx"), "URL")


def test_a_server_that_is_not_there_is_one_line(file: Path):
    with web_server() as gone:
        want = wanted(gone, file)
    refused(want, "no connection")


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"size": 299_999}, "has 300000 bytes there, but 299999 are registered"),
        ({"size": 0, "largest": 1000}, "has 300000 bytes, more than the 1000"),
    ],
)
def test_a_wrong_size_is_refused_before_anything_comes(server, file, more, says):
    refused(wanted(server, file, **more), says)
    assert not parts_of(file)


def test_a_server_that_hides_the_size_is_stopped_at_the_limit(server: WebServer, file: Path):
    server.plan = ["no-length"]
    refused(wanted(server, file, sha256="", size=0, largest=100_000), "sends more than 100000 bytes")
    assert not parts_of(file)


def test_a_short_file_without_a_length_is_refused(server: WebServer, file: Path):
    server.files["/net.onnx"] = CONTENT[:1000]
    server.plan = ["no-length"] * 9
    refused(wanted(server, file), "gave 1000 of 300000")


def test_a_packed_answer_is_refused(server: WebServer, file: Path):
    server.plan = ["packed"]
    refused(wanted(server, file), "packs the file")


def test_a_full_disk_is_told_before_and_during(server: WebServer, file: Path, monkeypatch):
    usage = shutil.disk_usage("/")._replace(free=1000)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: usage)
        refused(wanted(server, file), "300000 bytes are to come, but the disk has 1000 left")

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(download.os, "fsync", full)
        refused(wanted(server, file), "the disk is full")
    assert fetch(wanted(server, file), HASTY).read_bytes() == CONTENT


def test_a_part_that_is_a_link_is_not_written_through(server: WebServer, file: Path, tmp_path: Path):
    fetch(wanted(server, file), HASTY)
    (part,) = parts_of(file)
    part.unlink()
    victim = tmp_path / "victim"
    part.symlink_to(victim)
    with pytest.raises(ModelError, match="can't be written"):
        fetch(wanted(server, file), HASTY)
    assert not victim.exists()


def test_a_folder_that_can_not_be_made_is_one_line(server: WebServer, tmp_path: Path):
    (tmp_path / "taken").write_text("")
    with pytest.raises(ModelError, match="can't be written") as error:
        fetch(wanted(server, tmp_path / "taken" / "net.onnx"), HASTY)
    assert "\n" not in str(error.value)


def test_a_length_that_is_none_counts_as_not_told(server: WebServer, file: Path):
    server.plan = ["odd-length"]
    assert fetch(wanted(server, file), HASTY).read_bytes() == CONTENT
    assert len(server.asked) == 1


def test_a_server_whose_certificate_is_not_valid_is_not_asked_again(server, file: Path, monkeypatch):
    asked, invalid = [], ssl.SSLCertVerificationError()
    invalid.verify_message = "certificate has expired"

    def open_(request: object, timeout: float) -> None:
        asked.append(request)
        raise urllib.error.URLError(invalid)

    monkeypatch.setattr(web, "_opener", lambda: SimpleNamespace(open=open_))
    refused(wanted(server, file), r"certificate is not valid \(certificate has expired\)")
    assert len(asked) == 1


@pytest.mark.parametrize("error", [ConnectionResetError(104, "reset"), http.client.IncompleteRead(b"")])
def test_a_connection_that_breaks_half_way_may_be_tried_again(error: Exception):
    def read1(most: int) -> bytes:
        raise error

    with pytest.raises(web.TransientError, match="the connection broke"):
        web.next_chunk(SimpleNamespace(read1=read1))


@pytest.mark.parametrize("name", ["net", "net.v2.onnx", "a.b.c.d"])
def test_a_part_s_version_is_told_whatever_its_file_is_called(server: WebServer, tmp_path: Path, name: str):
    server.etags = False
    want = wanted(server, tmp_path / "models" / name, sha256="", size=0)
    server.plan = ["truncate"]
    refused(want, "broke off", held_to([], attempts=1))
    assert fetch(want, HASTY).read_bytes() == CONTENT
    assert server.asked[-1][1] == "", "what may be of another version is not gone on with"
