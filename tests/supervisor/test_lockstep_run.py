"""A lockstep run that is none any more: a process was started again on the way."""

from __future__ import annotations

import os
import signal
from dataclasses import replace

import pytest

from prism_edge.config import Config
from prism_edge.supervisor.supervisor import Supervisor
from tests.supervisor.fake_daemon import cast
from tests.supervisor.whole_runs import in_time


@pytest.mark.usefixtures("left_behind", "slow_is_not_silent")
@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_it_says_so_at_its_end(config: Config, mode: str, caplog: pytest.LogCaptureFixture) -> None:
    processes = cast(["source:steady", "tracker:steady"])
    with Supervisor(replace(config, mode=mode), *processes) as run:
        run.run(in_time(lambda: run.ready))
        first = run.processes["source"]
        os.kill(first, signal.SIGKILL)
        run.run(in_time(lambda: run.ready and run.processes.get("source") not in (None, first)))
        run.ended_well()
    said = "not the run that lockstep repeats: source died" in caplog.text
    assert said == (mode == "lockstep")
