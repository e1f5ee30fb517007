"""Certificates as they are copied to a robot."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

MAKE = Path(__file__).resolve().parents[2] / "deploy" / "make_certificates.sh"


@pytest.mark.skipif(not shutil.which("openssl"), reason="no openssl here")
@pytest.mark.parametrize("umask", [0o022, 0o077])
def test_the_service_can_read_what_is_public_and_nobody_a_key(umask: int, tmp_path: Path) -> None:
    subprocess.run([str(MAKE), str(tmp_path), "rover1"], check=True, timeout=60, umask=umask)
    modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir()}
    assert modes["ca.pem"] == modes["rover1.pem"] == 0o644
    assert modes["ca.key"] == modes["rover1.key"] == 0o600
