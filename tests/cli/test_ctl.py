"""`prism-edge ctl` against a desk that answers: what it prints, and its exit codes."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from prism_edge.bus import links
from prism_edge.bus.commands import Reply
from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.cli.main import main
from prism_edge.config import BusConfig, Config
from prism_edge.errors import BusError


@contextmanager
def desk(answer: Callable[[str], Reply]) -> Iterator[str]:
    """A daemon that answers `info`; its endpoint."""
    config = replace(Config(), bus=BusConfig(endpoint=free_endpoint(), retry_ms=50))
    done = threading.Event()
    with Bus.open(config, "supervisor", listen=True) as bus:
        serving = bus.commands({"info": answer})

        def work() -> None:
            while not done.wait(0.01):
                serving.serve()

        thread = threading.Thread(target=work)
        thread.start()
        try:
            yield config.bus.endpoint
        finally:
            done.set()
            thread.join()


@pytest.mark.parametrize("option", [(), ("--quiet",), ("--json",), ("--json", "--quiet")])
@pytest.mark.parametrize(("ok", "code"), [(True, 0), (False, 1)])
def test_a_refusal_ends_with_1_however_it_is_told(
    option: tuple[str, ...], ok: bool, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    with desk(lambda argument: Reply(ok, "so it is", {"name": "value"})) as endpoint:
        assert main(["ctl", "info", "--endpoint", endpoint, *option]) == code
    said = capsys.readouterr()
    assert said.err == ""
    if option == ("--json",):
        assert json.loads(said.out) == {"ok": ok, "said": "so it is", "values": {"name": "value"}}
    else:
        assert said.out == ("" if option else "so it is\n  name  value\n")


def test_where_nobody_is_it_ends_with_6(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(links, "_REACH_MS", 300)
    assert main(["ctl", "info", "--endpoint", free_endpoint(), "--timeout", "1"]) == BusError.exit_code == 6
    assert capsys.readouterr().out == ""
