"""Whether an endpoint is free: asked of real listeners, and of what a killed one leaves."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from prism_edge.bus.links import open_session
from prism_edge.bus.vacancy import can_listen, check_vacant, free_endpoint
from prism_edge.config import BusConfig
from prism_edge.errors import BusError

_LISTEN_AND_DIE = (
    "import os, signal, sys\n"
    "from prism_edge.bus.links import open_session\n"
    "from prism_edge.config import BusConfig\n"
    "session = open_session(BusConfig(endpoint=sys.argv[1]), listen=True)\n"
    "os.kill(os.getpid(), signal.SIGKILL)\n"
)


@pytest.mark.parametrize("protocol", ["tcp", "unixsock-stream"])
def test_an_endpoint_is_free_until_it_is_listened_on_and_after(tmp_path: Path, protocol: str) -> None:
    endpoint = free_endpoint() if protocol == "tcp" else f"unixsock-stream/{tmp_path}/bus"
    assert can_listen(endpoint)
    check_vacant(endpoint)
    with open_session(BusConfig(endpoint=endpoint), listen=True):
        assert not can_listen(endpoint)
        for settings in ("", "?prio=1-7", "#so_rcvbuf=65000"):
            with pytest.raises(BusError, match=r"bus\.endpoint: .* is in use already"):
                check_vacant(endpoint + settings)
    assert can_listen(endpoint)
    check_vacant(endpoint)


def test_a_port_is_free_while_the_last_link_to_it_times_out() -> None:
    """As after a run that was ended: for a minute the system keeps the ends of links that it closed first."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)) as client:
            server.accept()[0].close()
            assert client.recv(1) == b""
    assert can_listen(f"tcp/127.0.0.1:{port}")


def test_a_free_endpoint_is_one_of_loopback_that_can_be_listened_on() -> None:
    endpoint = free_endpoint()
    assert endpoint.startswith("tcp/127.0.0.1:")
    assert int(endpoint.rpartition(":")[2]) > 0
    assert can_listen(endpoint)


@pytest.mark.skipif(not socket.has_ipv6, reason="no IPv6 here")
def test_so_it_is_with_a_port_of_ipv6() -> None:
    with socket.socket(socket.AF_INET6) as listener:
        try:
            listener.bind(("::1", 0))
        except OSError:
            pytest.skip("no loopback of IPv6 here")
        listener.listen()
        endpoint = f"tcp/[::1]:{listener.getsockname()[1]}"
        assert not can_listen(endpoint)
    assert can_listen(endpoint)


def test_the_socket_of_a_killed_listener_is_free_and_taken_over(tmp_path: Path) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/bus"
    died = subprocess.run([sys.executable, "-c", _LISTEN_AND_DIE, endpoint], timeout=60)
    assert died.returncode == -signal.SIGKILL
    assert (tmp_path / "bus").is_socket()
    assert can_listen(endpoint)
    with open_session(BusConfig(endpoint=endpoint), listen=True):
        assert not can_listen(endpoint)


@pytest.mark.parametrize(
    "endpoint",
    [
        "unixsock-stream//nowhere/at/all",
        "unixsock-stream/" + "/x" * 200,  # longer than a socket's path may be
        "tcp/127.0.0.1:port",
        "tcp/192.0.2.1:7447",  # not of this host
        "tcp/127.0.0.1:99999999",
        "tcp/\u00fc..x:80",
        "tls/127.0.0.1:7447",
        "",
    ],
)
def test_where_it_can_not_be_told_it_is_not_free_and_not_taken_either(endpoint: str) -> None:
    check_vacant(endpoint)
    assert not can_listen(endpoint)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_folder_that_may_not_be_written_to_has_no_room(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert not can_listen(f"unixsock-stream/{tmp_path}/bus")
