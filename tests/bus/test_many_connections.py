"""Connections to the robot's TLS port that never say who they are, more than descriptors were allowed."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from prism_edge.bus.vacancy import free_endpoint

MAKE = Path(__file__).resolve().parents[2] / "deploy" / "make_certificates.sh"
FEW, MANY = 200, 300  # descriptors that the process begins with; connections

ROBOT = """
import resource, sys
from prism_edge.bus.session import Bus
from prism_edge.config import BusConfig, Config, NetworkConfig
from prism_edge.supervisor.supervise import allow_descriptors

bus, network, folder, few = sys.argv[1:]
hard = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
resource.setrlimit(resource.RLIMIT_NOFILE, (int(few), hard))
allow_descriptors()
shown = NetworkConfig(network, f"{folder}/ca.pem", f"{folder}/robot.pem", f"{folder}/robot.key")
with Bus.open(Config(bus=BusConfig(bus), network=shown), "supervisor", listen=True):
    print("listening", flush=True)
    sys.stdin.readline()
    print(len(open("/proc/self/stat").read()) > 0, flush=True)
"""


@pytest.mark.skipif(not shutil.which("openssl"), reason="no openssl here")
@pytest.mark.skipif(sys.platform != "linux", reason="only Linux says what a process has open")
def test_they_do_not_take_the_last_descriptor(tmp_path: Path) -> None:
    subprocess.run(
        [str(MAKE), str(tmp_path), "robot,127.0.0.1"], check=True, timeout=60, capture_output=True
    )
    bus, network = free_endpoint(), free_endpoint().replace("tcp/", "tls/")
    command = [sys.executable, "-c", ROBOT, bus, network, str(tmp_path), str(FEW)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as robot:
        assert robot.stdin is not None
        assert robot.stdout is not None
        assert robot.stdout.readline() == "listening\n"
        host, port = network.removeprefix("tls/").rsplit(":", 1)
        with ExitStack() as connected:
            for _ in range(MANY):
                connected.enter_context(socket.create_connection((host, int(port)), timeout=5.0))
            robot.stdin.write("\n")
            robot.stdin.flush()
            assert robot.stdout.readline() == "True\n", "it can open a file beside them all"
