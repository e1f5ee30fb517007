"""What an operator is told of certificates where the daemon starts."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import pytest

from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import Config
from prism_edge.supervisor.supervisor import Supervisor
from tests.supervisor.fake_daemon import cast

MAKE = Path(__file__).resolve().parents[2] / "deploy" / "make_certificates.sh"


@pytest.mark.usefixtures("left_behind", "slow_is_not_silent")
@pytest.mark.parametrize("authority", ["ours", "theirs"])
def test_one_that_nobody_is_going_to_take_is_said(
    config: Config, tmp_path: Path, caplog: pytest.LogCaptureFixture, authority: str
) -> None:
    """As one that has expired: links fail, and only who asks for them would hear of it."""
    for whose in ("ours", "theirs"):
        command = [str(MAKE), str(tmp_path / whose), "robot"]
        subprocess.run(command, check=True, timeout=60, capture_output=True)
    network = replace(
        config.network,
        endpoint=free_endpoint().replace("tcp/", "tls/"),
        ca=str(tmp_path / authority / "ca.pem"),
        certificate=str(tmp_path / "ours" / "robot.pem"),
        key=str(tmp_path / "ours" / "robot.key"),
    )
    with Supervisor(replace(config, network=network), *cast(("source:steady",))) as run:
        run.reload(replace(config, network=network))
        assert "reads its file again" not in caplog.text
        with open(network.certificate, "a") as renewed:
            renewed.write("# renewed")
        run.reload(replace(config, network=network))
        assert "only a restart reads its file again: network.certificate\n" in caplog.text
    assert ("theirs/ca.pem does not vouch for" in caplog.text) == (authority == "theirs")
    assert ("link over the network" in caplog.text) == (authority == "theirs")
