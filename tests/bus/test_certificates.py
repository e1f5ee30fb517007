"""Certificates held to their authority, as OpenSSL made them; openssl verify has the last word."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from prism_edge.bus.certificates import mismatch
from prism_edge.config import NetworkConfig

MAKE = Path(__file__).resolve().parents[2] / "deploy" / "make_certificates.sh"
LISTENS = "tls/0.0.0.0:7448"


def openssl(folder: Path, *words: str) -> None:
    subprocess.run(["openssl", *words], cwd=folder, check=True, timeout=60, capture_output=True)


def ended(folder: Path) -> None:
    """A certificate whose time was January 2020, of the request that lies there."""
    (folder / "index").touch()
    config = "[ca] default_ca=lab [lab] database=index policy=any rand_serial=yes [any] commonName=supplied"
    (folder / "ca.conf").write_text(config.replace(" ", "\n"))
    by = ("-config", "ca.conf", "-cert", "ca.pem", "-keyfile", "ca.key", "-md", "sha256")
    held = ("-startdate", "20200101000000Z", "-enddate", "20200201000000Z")
    openssl(folder, "ca", "-batch", *by, *held, "-outdir", ".", "-in", "csr", "-notext", "-out", "ended.pem")


def between(folder: Path) -> None:
    """An authority that ours vouches for, and a robot's certificate by it."""
    (folder / "is_ca").write_text("basicConstraints=critical,CA:TRUE\n")
    for name, by, extension in (("inter", "ca", ("-extfile", "is_ca")), ("leaf", "inter", ())):
        made = ("-newkey", "rsa:2048", "-nodes", "-keyout", f"{name}.key", "-subj", f"/CN={name}")
        openssl(folder, "req", "-new", *made, "-out", "csr")
        signed = ("-CA", f"{by}.pem", "-CAkey", f"{by}.key", "-CAcreateserial", *extension)
        openssl(folder, "x509", "-req", "-in", "csr", *signed, "-out", f"{name}.pem")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    for where, names in (("ours", ("robot", "anna")), ("theirs", ("anna",))):
        subprocess.run([str(MAKE), str(folder / where), *names], check=True, timeout=60, capture_output=True)
    ours = folder / "ours"
    (ours / "ext").write_text("extendedKeyUsage=clientAuth\n")
    openssl(ours, "req", "-new", "-key", "anna.key", "-subj", "/CN=reader", "-out", "csr")
    signed = ("x509", "-req", "-in", "csr", "-CA", "ca.pem", "-CAkey", "ca.key", "-extfile", "ext")
    openssl(ours, *signed, "-CAcreateserial", "-out", "reader.pem")
    ended(ours)
    openssl(ours, "pkey", "-in", "anna.key", "-aes256", "-passout", "pass:secret", "-out", "locked.key")
    (folder / "text.pem").write_text("no certificate\n")
    between(ours)
    return folder


def said_of(lab: Path, ca: str, certificate: str, key: str, endpoint: str = "") -> str:
    files = {"ca": str(lab / ca), "certificate": str(lab / certificate), "key": str(lab / key)}
    return mismatch(NetworkConfig(endpoint=endpoint, **files))


@pytest.mark.parametrize(
    ("name", "endpoint", "taken"),
    [("robot", LISTENS, True), ("anna", "", True), ("reader", "", True), ("reader", LISTENS, False)],
)
def test_a_certificate_is_taken_for_what_it_is_for(lab: Path, name: str, endpoint: str, taken: bool) -> None:
    key = "anna" if name == "reader" else name
    said = said_of(lab, "ours/ca.pem", f"ours/{name}.pem", f"ours/{key}.key", endpoint)
    purpose = "sslserver" if endpoint else "sslclient"
    judged = subprocess.run(
        ["openssl", "verify", "-purpose", purpose, "-CAfile", "ca.pem", f"{name}.pem"],
        cwd=lab / "ours",
        check=False,
        timeout=60,
        capture_output=True,
    )
    assert (judged.returncode == 0) == taken == (said == "")
    assert taken or "reader.pem (unsuitable certificate purpose)" in said


@pytest.mark.parametrize("endpoint", ["", LISTENS])
@pytest.mark.parametrize(
    ("ca", "certificate", "key", "why"),
    [
        ("theirs/ca.pem", "ours/anna.pem", "ours/anna.key", "theirs/ca.pem does not vouch for"),
        ("ours/ca.pem", "theirs/anna.pem", "theirs/anna.key", "ours/ca.pem does not vouch for"),
        ("ours/ca.pem", "ours/ended.pem", "ours/anna.key", "ended.pem (certificate has expired)"),
        ("ours/ca.pem", "ours/anna.pem", "theirs/anna.key", "theirs/anna.key is not the key of"),
        ("text.pem", "ours/anna.pem", "ours/anna.key", "text.pem holds no PEM certificate"),
        ("ours/ca.pem", "text.pem", "ours/anna.key", "no PEM pair without password"),
        ("ours/ca.pem", "ours/anna.pem", "text.pem", "no PEM pair without password"),
        ("ours/ca.pem", "ours/anna.pem", "ours/locked.key", "no PEM pair without password"),
        ("ours", "ours/anna.pem", "ours/anna.key", "ours holds no PEM certificate"),
        ("ours/ca.pem", "ours", "ours/anna.key", "no PEM pair without password"),
    ],
)
def test_what_does_not_belong_together_is_one_line(
    lab: Path, ca: str, certificate: str, key: str, why: str, endpoint: str
) -> None:
    said = said_of(lab, ca, certificate, key, endpoint)
    assert why in said
    assert said.startswith("network.")
    assert "\n" not in said


def test_where_no_certificate_is_shown_there_is_nothing_to_say(lab: Path) -> None:
    assert mismatch(NetworkConfig()) == ""
    assert mismatch(NetworkConfig(ca=str(lab / "ours" / "ca.pem"))) == ""


@pytest.mark.parametrize("endpoint", [LISTENS, ""])
def test_an_authority_need_not_be_a_root(lab: Path, endpoint: str) -> None:
    """As Zenoh has it, which links them: OpenSSL asks for the root, unless it is told."""
    assert said_of(lab, "ours/inter.pem", "ours/leaf.pem", "ours/leaf.key", endpoint) == ""
