"""Certificates as they are copied to a robot, and what is said where none can be made."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

MAKE = Path(__file__).resolve().parents[2] / "deploy" / "make_certificates.sh"
OPENSSL = shutil.which("openssl")
needs_openssl = pytest.mark.skipif(not OPENSSL, reason="no openssl here")


def make(folder: Path, *names: str, path: str = "", days: str = "") -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PATH": path or os.environ["PATH"], **({"DAYS": days} if days else {})}
    return subprocess.run(
        ["/bin/bash", MAKE, folder, *names], env=environment, capture_output=True, text=True, timeout=60
    )


@needs_openssl
@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_the_service_can_read_what_is_public_and_nobody_a_key(umask: int, tmp_path: Path) -> None:
    subprocess.run([str(MAKE), str(tmp_path), "rover1"], check=True, timeout=60, umask=umask)
    modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert modes["ca.pem"] == modes["rover1.pem"] == 0o644
    assert modes["ca.key"] == modes["rover1.key"] == 0o600


@needs_openssl
def test_names_and_addresses_are_told_apart(tmp_path: Path) -> None:
    done = make(tmp_path, "rover1,rover1.local,192.168.1.20,0.0.0.0,255.255.255.255,fe80::1")
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    addresses = "IP:192.168.1.20,IP:0.0.0.0,IP:255.255.255.255,IP:fe80::1"
    assert f"made rover1.pem and rover1.key (DNS:rover1,DNS:rover1.local,{addresses})\n" in done.stdout
    made = {"ca.key", "ca.pem", "rover1.key", "rover1.pem"}
    assert {path.name for path in tmp_path.iterdir()} - {"ca.srl"} == made


@pytest.mark.parametrize("host", ["10.0.0", "10.0.0.0.1", "10.0.0.256", "10.0.0.007", "10..0.1", "7", "."])
def test_an_address_that_is_none_is_refused_before_anything_is_made(host: str, tmp_path: Path) -> None:
    done = make(tmp_path / "lab", "anna", f"rover1,rover1.local,{host}")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert f"'{host}' is no IPv4 address" in done.stderr
    assert not (tmp_path / "lab").exists()


@pytest.mark.parametrize("name", ["-rover1", "--help", ".rover1", "ca", "ro/ver", ""])
def test_a_name_that_is_none_is_refused_before_anything_is_made(name: str, tmp_path: Path) -> None:
    done = make(tmp_path / "lab", "anna", name)
    assert done.returncode == 2
    assert done.stderr == f"make_certificates.sh: error: '{name}' is no NAME[,HOST...]\n"
    assert not (tmp_path / "lab").exists()


@pytest.mark.parametrize(
    ("name", "days", "words"),
    [
        ("rover1", "x", "DAYS=x is no number of days"),
        ("rover1", "0", "DAYS=0 is no number of days"),
        ("x" * 65, "", f"'{'x' * 65}' is longer than"),
        ("rover1,rover1.local,1:2", "", "'1:2' is no IPv6 address"),
        ("rover1,rover1.local:7448", "", "'rover1.local:7448' is no IPv6 address"),
    ],
)
def test_what_openssl_would_refuse_is_said_before_anything_is_made(
    name: str, days: str, words: str, tmp_path: Path
) -> None:
    done = make(tmp_path / "lab", "anna", name, days=days)
    assert done.returncode == 2
    assert done.stderr.startswith(f"make_certificates.sh: error: {words}")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "lab").exists()


@needs_openssl
def test_a_name_may_have_64_letters(tmp_path: Path) -> None:
    assert make(tmp_path, "x" * 64, days="1").returncode == 0


def test_without_openssl_it_says_so(tmp_path: Path) -> None:
    done = make(tmp_path / "lab", "rover1", path="/nowhere")
    assert done.returncode == 1
    assert done.stderr == "make_certificates.sh: error: no openssl found: install it\n"
    assert not (tmp_path / "lab").exists()


@needs_openssl
def test_a_key_that_an_interrupted_run_has_left_is_kept(tmp_path: Path) -> None:
    assert make(tmp_path, "anna").returncode == 0
    key = (tmp_path / "ca.key").read_bytes()
    (tmp_path / "ca.pem").unlink()
    assert make(tmp_path, "rover1").returncode == 0
    assert (tmp_path / "ca.key").read_bytes() == key
    assert (tmp_path / "ca.pem").is_file()


@needs_openssl
@pytest.mark.parametrize("authority", [False, True], ids=["at first", "with an authority"])
@pytest.mark.parametrize("fail", ["genpkey", "req", "x509"])
def test_what_openssl_says_is_told_and_nothing_half_made_stays(
    fail: str, authority: bool, tmp_path: Path
) -> None:
    tools, lab = tmp_path / "bin", tmp_path / "lab"
    tools.mkdir()
    refusal = f'case $1 in {fail}) echo "no room left"; echo "no luck" >&2; exit 1 ;; esac'
    (tools / "openssl").write_text(f'#!/bin/sh\n{refusal}\nexec "{OPENSSL}" "$@"\n')
    (tools / "openssl").chmod(0o755)
    if authority:
        assert make(lab, "anna").returncode == 0
    before = {path.name for path in lab.iterdir()} if authority else set()
    done = make(lab, "rover1", path=f"{tools}:{os.environ['PATH']}")
    assert done.returncode == 1
    assert done.stderr == f"make_certificates.sh: error: openssl {fail} failed: no room left\nno luck\n"
    # An authority is of use by itself.
    whole = {"ca.key", "ca.pem"} if fail == "x509" else set()
    assert {path.name for path in lab.iterdir()} == before | whole
