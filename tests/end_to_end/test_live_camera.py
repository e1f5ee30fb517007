"""The whole daemon on a network camera that goes away and comes back."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path

import cv2
import pytest
from sources.live.servers import MjpegServer, mjpeg_server

from prism_edge.bus.session import Bus
from prism_edge.messages import Tracked
from tests.end_to_end.processes import DEADLINE_S, Daemon, prism_edge, rows
from tests.waiting import until

pytest.importorskip("av", reason="network cameras need PyAV: pip install 'prism-edge[streams]'")


@pytest.fixture
def server(long_room: Path) -> Iterator[MjpegServer]:
    """The long room as MJPEG, at 20 Hz."""
    names = [line.split()[1] for line in (long_room / "rgb.txt").read_text().splitlines()]
    known: dict[str, bytes] = {}

    def picture(k: int) -> bytes:
        name = names[k % len(names)]
        if name not in known:
            image = cv2.imread(str(long_room / name))
            known[name] = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
        return known[name]

    with mjpeg_server() as server:
        server.picture, server.period_s = picture, 0.05
        yield server


PATIENT = "timeout=20"  # a server that is there is given up by no test, however busy the machine


def source_row(bus_health) -> dict[str, str]:  # type: ignore[no-untyped-def]
    return process_row(bus_health, "source")


def process_row(bus_health, name: str) -> dict[str, str]:  # type: ignore[no-untyped-def]
    found = [rows(message) for message in bus_health.drain()]
    return found[-1].get(name, {}) if found else {}


def next_ok(tracked) -> Tracked:  # type: ignore[no-untyped-def]
    """A frame from now on whose pose went out."""
    tracked.drain()
    found: list[Tracked] = []

    def seen() -> bool:
        item = tracked.take(0.1)
        if item is not None and item.published:
            found.append(item)
        return bool(found)

    until(seen, "a pose", deadline_s=60.0)
    return found[0]


def test_a_camera_that_goes_away_and_a_source_that_dies(
    server: MjpegServer, camera: Path, network: Path, tmp_path: Path
) -> None:
    arguments = (server.address(PATIENT), "--camera", camera, "--model", network)
    with Daemon(tmp_path / "daemon.log", *arguments) as daemon:
        bus: Bus
        with daemon.until_ready().bus() as bus:
            tracked, health = bus.queue("tracked", 1024), bus.queue("health", 64)
            before = next_ok(tracked)

            server.ending.set()
            until(lambda: source_row(health).get("camera", "").startswith("reconnecting"), "its loss")
            until(lambda: "camera: reconnecting" in source_row(health).get("message", ""), "a warning")
            server.ending.clear()
            until(lambda: source_row(health).get("camera") == "streaming", "its return")
            after = next_ok(tracked)
            assert after.index > before.index
            assert after.stamp_ns > before.stamp_ns
            assert after.captured_monotonic_ns > before.captured_monotonic_ns

            row = until(lambda: source_row(health), "health")
            assert row["restarts"] == "0"
            os.kill(int(row["pid"]), signal.SIGKILL)
            until(lambda: source_row(health).get("restarts") == "1", "the source is started again")
            until(lambda: source_row(health).get("camera") == "streaming", "the camera is back")
            last = next_ok(tracked)
            assert last.index > after.index
            assert last.stamp_ns > after.stamp_ns
            assert "Traceback" not in daemon.log


def test_a_camera_that_never_was_is_an_error(camera: Path, tmp_path: Path) -> None:

    done = prism_edge("run", "http://127.0.0.1:9/video", "--camera", camera, "--set", "source.absent_s=0")
    assert done.returncode == 4
    assert "connection refused" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_live_camera_is_nothing_to_evaluate(server: MjpegServer, camera: Path, tmp_path: Path) -> None:

    done = prism_edge("eval", server.address(), "--camera", camera, "--out", tmp_path / "run")
    assert done.returncode == 8
    assert "evaluate a recording" in done.stderr
    assert done.stderr.count("\n") == 1


def test_the_map_of_a_run_that_was_cut_off_is_the_next_ones(
    server: MjpegServer, camera: Path, network: Path, tmp_path: Path
) -> None:
    mark = tmp_path / "state" / "journal" / "unfinished"
    state = f"state.directory={tmp_path / 'state'}"
    arguments = (server.address(PATIENT), "--camera", camera, "--model", network, "--set", state)
    with Daemon(tmp_path / "first.log", *arguments) as first:
        with first.until_ready().bus() as bus:
            next_ok(bus.queue("tracked", 1024))
            before = until(lambda: known(bus, 4), "four keyframes")
        first.send(signal.SIGKILL)
        first.wait()
        assert not first.leftovers(DEADLINE_S)
    assert mark.is_file()

    with Daemon(tmp_path / "second.log", *arguments) as second:
        with second.until_ready().bus() as bus:
            status, tracked = bus.queue("status", 256), bus.queue("tracked", 1024)
            said: list[str] = []

            def recovered() -> bool:
                said.extend(message.status[0].message for message in status.drain())
                return any(word.endswith(" recovered") for word in said)

            until(recovered, "the camera is found in the map")
            assert before <= until(lambda: known(bus, 4), "its map")
            assert next_ok(tracked).odometry == "ok"
            health = bus.queue("health", 64)
            row = until(lambda: process_row(health, "backend"), "health")
            assert row["recovered"].endswith("keyframes of an earlier run")
        assert "going on in its map" in second.log
        assert "Traceback" not in second.log
        second.send(signal.SIGTERM)
        assert second.wait() == 0
    assert not mark.exists()

    with Daemon(tmp_path / "third.log", *arguments) as third, third.until_ready().bus() as bus:
        health = bus.queue("health", 64)
        row = until(lambda: process_row(health, "backend"), "health")
        assert "recovered" not in row, "it goes on in the map of a run that had ended"
        assert "going on in its map" not in third.log


def known(bus: Bus, least: int) -> set[int]:
    """Numbers of the keyframes in the backend's map, once they are so many."""
    snapshot = bus.ask("map_snapshot", 2.0)
    ids = set() if snapshot is None else set(snapshot.keyframes.tolist())
    return ids if len(ids) >= least else set()
