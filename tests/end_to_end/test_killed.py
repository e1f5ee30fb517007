"""Each process is killed in the middle of a run: it is started again, `health` says so, and poses go on."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from prism_edge.bus import ros
from prism_edge.bus.session import Bus
from prism_edge.messages import IDS_A_LIFE
from tests.end_to_end.processes import Daemon, rows
from tests.waiting import until

WORKERS = ("depth", "scale", "backend", "tracker", "source")
SECOND = 1_000_000_000


@pytest.fixture(scope="module")
def running(
    long_room: Path, camera: Path, network: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Daemon, Bus]]:
    """A daemon, and an ordinary subscriber's session."""
    with ExitStack() as stack:
        log = tmp_path_factory.mktemp("killed") / "daemon.log"
        daemon = stack.enter_context(Daemon(log, long_room, "--camera", camera, "--model", network))
        yield daemon.until_ready(), stack.enter_context(daemon.bus())


class Health:
    """What `health` said last."""

    def __init__(self, bus: Bus) -> None:
        self._inbox = bus.queue("health")
        self.seen: list[dict[str, dict[str, str]]] = []

    def now(self) -> dict[str, dict[str, str]]:
        self.seen += [rows(message) for message in self._inbox.drain()]
        return self.seen[-1] if self.seen else {}


def is_well(row: dict[str, str]) -> bool:
    """But for having too slow a computer for ten seconds, which is the computer's fault."""
    return row["level"] == "0" or (row["level"] == "1" and "of the images were dropped" in row["message"])


@pytest.mark.parametrize("name", WORKERS)
def test_a_killed_process_is_started_again_and_poses_go_on(name: str, running: tuple[Daemon, Bus]) -> None:
    daemon, bus = running
    poses, tracked, health = bus.queue("pose", 1024), bus.queue("tracked", 1024), Health(bus)
    before = until(lambda: poses.take(0.1), "a pose")
    until(lambda: health.now().get(name, {}).get("state") in ("idle", "working", "ready"), "its health")
    pid = int(health.now()[name]["pid"])
    os.kill(pid, signal.SIGKILL)

    until(lambda: health.now()[name]["restarts"] == "1", f"{name} is started again")
    told = [row[name] for row in health.seen if row[name]["state"] == "restarting"]
    assert told, "its loss was not reported"
    assert told[0]["level"] == "2"
    assert "SIGKILL" in told[0]["message"]
    until(lambda: health.now()[name]["level"] == "0", f"{name} is well again")
    assert int(health.now()[name]["pid"]) != pid
    until(lambda: all(map(is_well, health.now().values())), "all are well again")

    poses.drain()
    first = ros.stamp_ns(until(lambda: poses.take(0.1), "poses go on"))
    assert first > ros.stamp_ns(before), "the recording began anew"
    later = []

    def went_on() -> bool:
        later.extend(poses.drain())
        return bool(later) and ros.stamp_ns(later[-1]) > first + 1.5 * SECOND

    until(went_on, "poses a second and a half later")
    assert np.isfinite([ros.pose_matrix(message.pose.pose) for message in later]).all()
    # Where the machine stood still the camera has jumped, and is looked for.
    until(lambda: (ticks := tracked.drain()) and ticks[-1].odometry == "ok", "it tracks")
    assert "Traceback" not in daemon.log


def test_after_all_that_depth_and_corrections_still_reach_the_tracker(running: tuple[Daemon, Bus]) -> None:
    """Each life numbers keyframes and updates anew; none may be mistaken for an older one's."""
    _, bus = running
    keyframes, updates, scales = bus.queue("keyframe"), bus.queue("map_update"), bus.queue("log_scale")
    keyframe = until(lambda: keyframes.take(0.1), "a keyframe of the second tracker")
    assert keyframe.id >= IDS_A_LIFE
    assert keyframe.epoch == 0, "the map is not the one that the first tracker began"
    update = until(lambda: updates.take(0.1), "an update of the second backend")
    assert update.sequence > IDS_A_LIFE
    assert update.epoch == keyframe.epoch
    scale = until(lambda: scales.take(0.1), "a scale of the second scale filter")
    assert scale.epoch == keyframe.epoch
    assert scale.accepted
    assert abs(scale.log_scale) < 0.3  # a map that was seeded in metres
