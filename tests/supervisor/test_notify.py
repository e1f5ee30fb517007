"""sd_notify against a socket of our own."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from prism_edge.supervisor.notify import Notifier
from tests.supervisor.fake_systemd import Manager


@pytest.fixture(params=["path", "abstract"])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    abstract = f"@prism-test-{os.getpid()}-{id(request)}"
    with Manager(str(tmp_path / "notify") if request.param == "path" else abstract) as manager:
        yield manager


def test_what_is_said(manager: Manager) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": manager.address})
    notifier.starting(90.5)
    notifier.ready()
    notifier.status("two\nlines  become one")
    notifier.status("two lines become one")  # has not changed
    notifier.reloading()
    notifier.stopping(7.0)
    heard = manager.hear()
    assert heard[0] == "EXTEND_TIMEOUT_USEC=90500000"
    assert heard[1] == "READY=1"
    assert heard[2] == "STATUS=two lines become one"
    assert heard[3] == "RELOADING=1"
    assert heard[4].startswith("MONOTONIC_USEC=")
    assert heard[5:] == ["STOPPING=1", "EXTEND_TIMEOUT_USEC=7000000"]


def test_watchdog_is_fed_twice_a_period(manager: Manager) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "10000000"})
    assert notifier.watchdog_s == 10.0
    for now in (0.0, 1.0, 4.9, 5.0, 5.1, 9.9, 10.0):
        notifier.feed(now)
    assert manager.hear().count("WATCHDOG=1") == 3


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a socket has room for more")
def test_a_manager_that_is_slow_hears_all_that_counts_in_order(manager: Manager) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "2000000"})
    for now in range(1000):
        notifier.feed(now)  # more than it has room for
    notifier.status("starting")
    notifier.ready()
    for number in range(100):  # more than are kept
        notifier.status(f"line {number}")
    notifier.status("stopping")
    for _ in range(10):
        manager.hear()
        notifier.status("stopping")  # has not changed
    said = [line for line in manager.hear() if line != "WATCHDOG=1"]
    assert said == ["READY=1", "STATUS=stopping"]
    before = manager.heard.count("WATCHDOG=1")
    notifier.feed(2000.0)
    assert manager.hear().count("WATCHDOG=1") == before + 1


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere a socket has room for more")
def test_food_that_found_no_room_is_not_half_a_period_late(manager: Manager) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "2000000"})
    for number in range(100):
        notifier.status(f"line {number}")
    notifier.feed(10.0)
    while "STATUS=line 99" not in manager.hear():
        notifier.status("line 99")
    assert "WATCHDOG=1" not in manager.heard
    notifier.feed(10.1)
    assert manager.hear()[-1] == "WATCHDOG=1"


@pytest.mark.parametrize(
    "variables", [{}, {"WATCHDOG_USEC": "1000000", "WATCHDOG_PID": "1"}, {"WATCHDOG_USEC": "soon"}]
)
def test_no_watchdog_where_none_is_meant_for_us(variables: dict[str, str], manager: Manager) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": manager.address, **variables})
    notifier.feed(0.0)
    assert manager.hear() == []


def test_workers_do_not_inherit_the_socket(manager: Manager) -> None:
    environment = {"NOTIFY_SOCKET": manager.address, "WATCHDOG_USEC": "1", "WATCHDOG_PID": "2", "HOME": "/"}
    Notifier(environment)
    assert environment == {"HOME": "/"}


@pytest.mark.parametrize("address", ["", "vsock:2:1234", "/nowhere/at/all", "@nobody-listens-here"])
def test_nobody_who_listens_is_no_error(address: str) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": address, "WATCHDOG_USEC": "1000000"})
    notifier.ready()
    notifier.status("well")
    notifier.feed(0.0)
    notifier.stopping(1.0)
