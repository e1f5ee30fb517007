"""A daemon of fake workers as a service manager sees it: readiness, watchdog, reload, the end."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config, DepthConfig, SupervisorConfig
from prism_edge.config_file import dump
from prism_edge.supervisor.reload import put
from prism_edge.supervisor.run_directory import PREFIX
from tests.supervisor.fake_systemd import Manager

DAEMON = Path(__file__).with_name("fake_daemon.py")
CHECKOUT = Path(__file__).resolve().parents[2]
DEADLINE_S = 30.0


class Service:
    """The daemon's process, its manager, its configuration file and its log."""

    def __init__(self, folder: Path, manager: Manager, config: Config, behaviours: tuple[str, ...]) -> None:
        self.manager, self.config = manager, config
        self._file, self._log = folder / "given.yaml", folder / "log"
        self._file.write_text(dump(config))
        environment = os.environ | {
            "NOTIFY_SOCKET": manager.address,
            "WATCHDOG_USEC": "400000",
            "XDG_RUNTIME_DIR": str(folder),
            "PYTHONPATH": str(CHECKOUT),
        }
        command = [sys.executable, str(DAEMON), str(self._file), *behaviours]
        with self._log.open("w") as log:
            # a session of its own: no terminal, as under a service manager
            self.process = subprocess.Popen(
                command,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env=environment,
                start_new_session=True,
            )
        assert self.process.stdout is not None
        word, *pairs = self.process.stdout.readline().split()
        assert word == "ready", self.log
        self.pids = {name: int(pid) for name, _, pid in (pair.partition("=") for pair in pairs)}

    @property
    def log(self) -> str:
        return self._log.read_text()

    def reload(self, text: str) -> None:
        self._file.write_text(text)
        told = self.manager.hear().count("RELOADING=1")
        self.process.send_signal(signal.SIGHUP)
        self.manager.until(lambda heard: heard.count("RELOADING=1") > told)
        self.manager.until(lambda heard: "READY=1" in after(heard, "RELOADING=1"))


def after(heard: list[str], line: str) -> list[str]:
    """What came after the last time that a line was heard; nothing while it was not."""
    return heard[len(heard) - heard[::-1].index(line) :] if line in heard else []


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Service]]:
    limits = SupervisorConfig(stop_s=1.5, max_restarts=2, backoff_s=0.05)
    config = Config(
        robot="fake", bus=BusConfig(free_endpoint()), supervisor=limits, depth=DepthConfig(model="x.onnx")
    )
    services = []
    with Manager(str(tmp_path / "notify")) as manager:

        def start(*behaviours: str) -> Service:
            services.append(Service(tmp_path, manager, config, behaviours))
            return services[-1]

        yield start
        for service in services:
            service.process.kill()
            service.process.communicate()


def test_ready_then_fed_then_stopping(serve: Callable[..., Service]) -> None:
    service = serve("source:steady", "tracker:steady")
    manager = service.manager
    manager.until(lambda heard: heard.count("WATCHDOG=1") >= 3)
    assert manager.heard.index("EXTEND_TIMEOUT_USEC=120000000") < manager.heard.index("READY=1")
    manager.until(lambda heard: any(line.startswith("STATUS=ready") for line in heard))
    service.process.terminate()
    manager.until(lambda heard: "EXTEND_TIMEOUT_USEC=6500000" in after(heard, "STOPPING=1"))
    assert service.process.wait(DEADLINE_S) == 0


def test_watchdog_starves_while_a_required_process_stands_still(serve: Callable[..., Service]) -> None:
    service = serve("source:steady", "tracker:steady")
    manager = service.manager
    os.kill(service.pids["tracker"], signal.SIGSTOP)
    manager.until(lambda heard: any(line.startswith("STATUS=tracker silent") for line in heard))
    silent = next(line for line in manager.heard if line.startswith("STATUS=tracker silent"))
    # Found hung and killed, it is started again: only then is the watchdog fed.
    manager.until(lambda heard: any(line.startswith("STATUS=ready") for line in after(heard, silent)))
    between = after(manager.heard, silent)
    again = next(i for i, line in enumerate(between) if line.startswith("STATUS=tracker starting"))
    assert "WATCHDOG=1" not in between[:again]
    manager.until(lambda heard: "WATCHDOG=1" in after(heard, between[again]))


def test_watchdog_is_fed_while_a_process_that_was_ready_takes_its_time_to_start_again(
    serve: Callable[..., Service], tmp_path: Path
) -> None:
    """A source whose camera is away: it waits longer than the watchdog does."""
    service = serve(f"source:waits={tmp_path / 'away'}", "tracker:steady")
    manager = service.manager
    os.kill(service.pids["source"], signal.SIGKILL)
    manager.until(lambda heard: any(line.startswith("STATUS=source ended") for line in heard))
    killed = next(line for line in manager.heard if line.startswith("STATUS=source ended"))
    manager.until(lambda heard: after(heard, killed).count("WATCHDOG=1") >= 3)
    assert not any(line.startswith("STATUS=ready") for line in after(manager.heard, killed))
    (tmp_path / "away").unlink()
    manager.until(lambda heard: any(line.startswith("STATUS=ready") for line in after(heard, killed)))


def test_reload_starts_anew_only_whom_it_concerns(serve: Callable[..., Service]) -> None:
    service = serve("tracker:steady", "depth:steady")
    service.reload(dump(put(put(service.config, "depth.threads", 3), "robot", "other")))
    until_logged(service, "not reloaded, as only a restart changes it: robot")
    until_logged(service, "reloaded: depth.threads")
    until_logged(service, "depth started again")
    assert "tracker started again" not in service.log
    assert "ended with" not in service.log  # no death: nothing counts against the restarts allowed


def test_reload_of_a_broken_file_changes_nothing(serve: Callable[..., Service]) -> None:
    service = serve("tracker:steady", "depth:steady")
    service.reload("robot: [\n")
    until_logged(service, "not reloaded: ")
    assert "Traceback" not in service.log
    assert "started again" not in service.log


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_reload_that_a_full_disk_forbids_changes_nothing(
    serve: Callable[..., Service], tmp_path: Path
) -> None:
    service = serve("tracker:steady", "depth:steady")
    wanted = dump(put(service.config, "depth.threads", 3))
    [folder] = tmp_path.glob(PREFIX + "*")
    new = folder / ".new-config.yaml"
    new.symlink_to("/dev/full")
    service.reload(wanted)
    until_logged(service, f"not reloaded: {new}: No space left on device")
    assert "reloaded: depth.threads" not in service.log
    new.unlink()
    service.reload(wanted)
    until_logged(service, "reloaded: depth.threads")
    until_logged(service, "depth started again")


def test_what_a_process_refuses_is_taken_back(serve: Callable[..., Service]) -> None:
    service = serve("tracker:steady", "depth:picky")
    service.reload(dump(put(service.config, "depth.threads", 13)))
    until_logged(service, "depth refuses what was reloaded: going back to the configuration before it")

    def went_back(heard: list[str]) -> bool:
        """One was not ready since it was told to reload, and now all are, however much was said since."""
        said = [line for line in after(heard, "RELOADING=1") if line.startswith("STATUS=")]
        ready = [line.startswith("STATUS=ready") for line in said]
        return False in ready and ready[-1]

    service.manager.until(went_back)
    assert service.process.poll() is None


def until_logged(service: Service, text: str) -> None:
    service.manager.until(lambda heard: text in service.log)
