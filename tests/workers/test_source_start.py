"""How the source worker begins, and begins again: for whom its first frame waits, and where it goes on."""

from __future__ import annotations

import queue
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from sources import tiny_datasets as tiny
from sources.live.bench import CAMERA, QUICK, Bench, steady

from prism_edge.config import Config, DepthConfig, NetworkConfig
from prism_edge.messages import Tracked
from prism_edge.sources.live.camera import LiveCamera
from prism_edge.workers.position import Position
from prism_edge.workers.source import SourceWorker, awaited_peers, main
from tests.waiting import until
from tests.workers.source_bench import (
    OTHERS,
    Recorder,
    acknowledging,
    playing,
    running,
    settings,
    undisturbed,
)


@pytest.mark.parametrize("peers_s", [600.0, 0.1])
def test_in_lockstep_the_first_frame_waits_for_all_as_long_as_a_start_takes(
    peers_s: float, tmp_path: Path
) -> None:
    """Such as a network that loads for a minute: without it the run would not be that of another time."""
    with playing(settings(tiny.write_tum(tmp_path), "lockstep", peers_s=peers_s)) as bus:
        until(lambda: "ready" in bus.states)
        bus.say("ready", "backend")
        bus.say("ready", "scale")
        with pytest.raises(queue.Empty):
            bus.published.get(timeout=0.5)
        bus.say("ready", "tracker")
        frames, _ = acknowledging(bus, *OTHERS)
    assert frames[0].index == 0


def test_the_wait_for_the_others_has_an_end(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    config = settings(tiny.write_tum(tmp_path), rate_hz=50.0, peers_s=0.1)

    def work(bus: Recorder) -> None:
        bus.say("ready", "tracker")
        main(config, bus)  # type: ignore[arg-type]

    with running(work) as bus:
        bus.until_end()
    assert "backend" in caplog.text
    assert "tracker" not in caplog.text


def test_who_is_ready_only_after_the_end_is_told_of_it(tmp_path: Path) -> None:
    """A short recording that waits for nobody is over before the others are linked: nor would the run end."""
    with playing(settings(tiny.write_tum(tmp_path), rate_hz=50.0, peers_s=0.0)) as bus:
        bus.say("ready", "tracker")
        bus.say("ready", "scale")
        _, end = bus.until_end()
        bus.say("ready", "backend")
        assert bus.next() == ("end", end)


def test_whom_the_first_frames_wait_for() -> None:
    """Poses don't wait for who is not needed for them: a network that is loading, a computer that is off."""
    config = Config(depth=DepthConfig(model="net.onnx"))
    everybody = {"tracker", "depth", "scale", "backend"}
    away = replace(config, network=NetworkConfig(endpoint="tcp/0.0.0.0:7448", remote=("depth",)))
    lockstep = replace(away, mode="lockstep")
    assert awaited_peers(config, begun=False) == everybody
    assert awaited_peers(config, begun=True) == {"tracker"}
    assert awaited_peers(away, begun=False) == everybody - {"depth"}
    assert awaited_peers(lockstep, begun=True) == everybody
    elsewhere = replace(away, network=replace(away.network, remote=("tracker",)))
    assert awaited_peers(elsewhere, begun=False) == everybody


def test_in_lockstep_another_computer_that_is_off_is_not_waited_for_so_long(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    config = settings(tiny.write_tum(tmp_path, count=2), "lockstep", peers_s=0.1)
    away = NetworkConfig(endpoint="tcp/0.0.0.0:7448", remote=("tracker",))
    with playing(replace(config, network=away)) as bus:
        bus.say("ready", "backend")
        bus.say("ready", "scale")
        acknowledging(bus, *OTHERS)
    assert "not ready in time: tracker; playing all the same" in caplog.text


def test_started_again_it_goes_on_though_the_tracker_takes_seconds_to_say_where(tmp_path: Path) -> None:
    config = settings(tiny.write_tum(tmp_path), rate_hz=5.0)
    last = Tracked(2, 0, 0, "ok", True, -1, 0, np.eye(4))

    def work(bus: Recorder) -> None:
        bus.life = 1
        bus.ask = lambda topic, timeout_s=1.0: last if timeout_s > 3.0 else None  # type: ignore[attr-defined]
        main(config, bus)  # type: ignore[arg-type]

    frames, _, _ = undisturbed(work)
    assert frames[0].index == 3


def test_started_again_in_a_loop_it_does_not_play_all_rounds_again(tmp_path: Path) -> None:
    config = settings(tiny.write_video(tmp_path / "clip.avi", 5), rate_hz=5.0, loop=True)
    last = Tracked(5_000_002, 0, 0, "ok", True, -1, 0, np.eye(4))

    def work(bus: Recorder) -> None:
        bus.life = 1
        bus.ask = lambda topic, timeout_s=1.0: last  # type: ignore[attr-defined]
        main(config, bus)  # type: ignore[arg-type]

    with running(work) as bus:
        _, frame = bus.next()
        until(lambda: int(bus.pulse.values["frames"]) > 5_000_003)
    assert frame.index == 5_000_003


@pytest.mark.parametrize("live", [False, True])
def test_started_again_beside_a_tracker_that_was_too_it_goes_on_where_it_was(
    live: bool, tmp_path: Path
) -> None:
    """Nobody is left who has tracked anything: what went out counts. Stamps don't go back."""
    config = settings(tiny.write_tum(tmp_path / "seq"), rate_hz=5.0)

    def work(life: int) -> Callable[[Recorder], None]:
        def life_of(bus: Recorder) -> None:
            bus.life, bus.run_directory = life, tmp_path
            bus.ask = lambda topic, timeout_s=1.0: None  # type: ignore[attr-defined]
            if live:
                with LiveCamera(Bench(steady), CAMERA, "a test", QUICK) as camera:
                    SourceWorker(config, bus, camera).run()  # type: ignore[arg-type]
            else:
                main(config, bus)  # type: ignore[arg-type]

        return life_of

    with running(work(0)) as bus:
        bus.next()
        bus.next()
    went_out = Position(tmp_path).read()
    assert went_out is not None
    index, stamp_ns = went_out.index, went_out.stamp_ns
    with running(work(1)) as bus:
        first = bus.next()[1]
    assert first.index > index if live else first.index == index + 1
    assert first.stamp_ns > stamp_ns


def test_started_again_it_does_not_wait_once_more(tmp_path: Path) -> None:
    config = settings(tiny.write_tum(tmp_path), rate_hz=5.0, wait_s=600.0)

    def work(bus: Recorder) -> None:
        bus.life = 1
        bus.ask = lambda topic, timeout_s=1.0: None  # type: ignore[attr-defined]
        main(config, bus)  # type: ignore[arg-type]

    with running(work) as bus:
        assert bus.next()[1].index == 0
