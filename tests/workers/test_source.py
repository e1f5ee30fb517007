"""The source worker on a bus of its own: what it releases, when, and what it waits for."""

from __future__ import annotations

import queue
import threading
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from sources import tiny_datasets as tiny

from prism_edge.bus.pack import grey, pack, rgb
from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, DepthConfig
from prism_edge.errors import ConfigError, SourceError
from prism_edge.messages import Acknowledged, EndOfStream
from prism_edge.sources import open_source
from prism_edge.sources.schedule import GAP
from prism_edge.workers.source import SourceWorker, main
from tests.synthetic.scene import block_texture
from tests.waiting import until
from tests.workers.source_bench import (
    DEADLINE_S,
    OTHERS,
    Recorder,
    acknowledging,
    playing,
    running,
    settings,
    undisturbed,
)


def test_realtime_plays_everything_and_ends(tmp_path: Path) -> None:
    config = settings(tiny.write_tum(tmp_path), rate_hz=50.0)
    frames, end, bus = undisturbed(lambda bus: main(config, bus))  # type: ignore[arg-type]
    assert bus.states.index("ready") < bus.states.index("ended")
    assert end.frames == 5
    assert end.released == len(frames)
    assert int(bus.pulse.values["released"]) + int(bus.pulse.values["skipped"]) == 5
    assert end.last_index == frames[-1].index
    for frame in frames:
        # captured is when the schedule says, whenever the image really went out
        due_ns = (frame.index - frames[0].index) * 20_000_000
        assert frame.captured_monotonic_ns - frames[0].captured_monotonic_ns == due_ns
        assert frame.stamp_ns == 1305031102175304000 + 100_000_000 * frame.index
        assert frame.colour
        assert not frame.duplicate
        assert frame.camera.tolist() == [64, 48, 60, 60, 31.5, 23.5]
        assert np.abs(rgb(frame)[:, :, ::-1].astype(int) - tiny.picture(frame.index)).mean() < 8


def test_a_readout_of_the_camera_file_goes_with_each_frame(tmp_path: Path) -> None:
    folder, file = tiny.write_tum(tmp_path), tmp_path / "rolling.yaml"
    numbers = "width: 64\nheight: 48\nfx: 60\nfy: 60\ncx: 31.5\ncy: 23.5\n"
    for said, expected in (("", "nan"), ("readout_ms: 0\n", "0.0"), ("readout_ms: -17.5\n", "-17.5")):
        file.write_text(numbers + said)
        config = settings(folder, rate_hz=50.0)
        config = replace(config, source=replace(config.source, camera=str(file)))
        frames, _, _ = undisturbed(lambda bus, config=config: main(config, bus))  # type: ignore[misc]
        assert {str(frame.readout_ms) for frame in frames} == {expected}


def test_the_recordings_own_stamps_set_the_pace(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path, count=3)
    frames, _, _ = undisturbed(lambda bus: main(settings(folder), bus))  # type: ignore[arg-type]
    steps = [f.captured_monotonic_ns - f.stamp_ns for f in frames]
    assert len(set(steps)) == 1


@pytest.mark.parametrize("bad", ["4900000000.0", "-4900000000.0"])
def test_a_first_stamp_that_is_refused_sets_no_pace(tmp_path: Path, bad: str) -> None:
    folder = tiny.write_tum(tmp_path, count=4)
    lines = (folder / "rgb.txt").read_text().splitlines()
    first = next(i for i, line in enumerate(lines) if not line.startswith("#"))
    lines[first] = " ".join([bad, *lines[first].split()[1:]])
    (folder / "rgb.txt").write_text("\n".join(lines) + "\n")
    frames, end, _ = undisturbed(lambda bus: main(settings(folder), bus))  # type: ignore[arg-type]
    assert [f.index for f in frames] == [1, 2, 3]
    assert end.unreadable == 1


def test_grey_recordings_stay_grey(tmp_path: Path) -> None:
    config = settings(tiny.write_kitti(tmp_path), rate_hz=50.0)
    frames, _, _ = undisturbed(lambda bus: main(config, bus))  # type: ignore[arg-type]
    assert not frames[0].colour
    np.testing.assert_array_equal(grey(frames[0]), tiny.picture(frames[0].index, 63, 47, colour=False))


@pytest.fixture
def mishaps(tmp_path: Path) -> Path:
    """Ten images: 2 copies 1, 3 is cut short, 4 is small, 5 missing, 7 repeats a stamp, 8 goes back."""
    folder = tiny.write_tum(tmp_path, count=10, suffix="jpg")
    rows = [line.split() for line in (folder / "rgb.txt").read_text().splitlines()[2:]]
    files = [folder / name for _, name in rows]
    files[2].write_bytes(files[1].read_bytes())
    tiny.truncate(files[3])
    tiny.write_image(files[4], tiny.picture(4, 32, 24))
    files[5].unlink()
    rows[7][0], rows[8][0] = rows[6][0], rows[0][0]
    (folder / "rgb.txt").write_text("\n".join(" ".join(row) for row in rows) + "\n")
    return folder


def test_mishaps_in_a_recording_are_refused_and_counted(
    mishaps: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with playing(settings(mishaps, "lockstep")) as bus:
        frames, end = acknowledging(bus, *OTHERS)
        values = dict(bus.pulse.values)
    assert [frame.index for frame in frames] == [0, 1, 2, 6, 9]
    assert [frame.duplicate for frame in frames] == [False, False, True, False, False]
    assert end == EndOfStream(frames=10, released=5, duplicates=1, unreadable=5, last_index=9)
    shown = {"frames": 10, "released": 5, "duplicates": 1, "unreadable": 2, "wrong_size": 1, "bad_stamps": 2}
    assert {name: int(values[name]) for name in shown} == shown
    warnings = [record.message for record in caplog.records if record.levelname == "WARNING"]
    assert len([line for line in warnings if "not released" in line]) == 3  # one of each kind
    assert any("truncated" in line for line in warnings)


def test_mishaps_do_not_disturb_the_schedule(mishaps: Path) -> None:
    with playing(settings(mishaps, rate_hz=25.0)) as bus:
        frames, end = bus.until_end()
        skipped = int(bus.pulse.values["skipped"])
    assert end.frames == 10
    assert end.released + end.unreadable + skipped == 10
    assert {frame.index for frame in frames} <= {0, 1, 2, 6, 7, 8, 9}


def test_an_image_of_the_next_century_is_not_waited_for(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path, count=4)
    rows = [line.split() for line in (folder / "rgb.txt").read_text().splitlines() if line[0] != "#"]
    rows[1][0] = "4000000000.0"
    (folder / "rgb.txt").write_text("\n".join(" ".join(row) for row in rows) + "\n")
    frames, end, bus = undisturbed(lambda bus: main(settings(folder), bus))  # type: ignore[arg-type]
    assert (frames[0].index, bus.pulse.values["bad_stamps"], end.unreadable) == (0, "1", 1)
    assert end.frames == 4


def test_lockstep_waits_for_everyone_of_the_run(tmp_path: Path) -> None:
    config = replace(settings(tiny.write_tum(tmp_path), "lockstep"), depth=DepthConfig(model="some.onnx"))
    with playing(config) as bus:
        assert bus.next()[1].index == 0
        for name in ("tracker", "depth", "scale"):
            bus.say("acknowledged", Acknowledged(name, 0))
        bus.say("acknowledged", Acknowledged("stranger", 0))
        with pytest.raises(queue.Empty):
            bus.published.get(timeout=0.3)
        bus.say("acknowledged", Acknowledged("backend", 0))
        assert bus.next()[1].index == 1
        for name in ("tracker", "depth", "scale", "backend"):
            bus.say("acknowledged", Acknowledged(name, 4))  # of later frames: as good
        rest, end = bus.until_end()
    assert [frame.index for frame in rest] == [2, 3, 4]
    assert end.released == 5


def test_without_a_network_nobody_waits_for_depth(tmp_path: Path) -> None:
    with playing(settings(tiny.write_tum(tmp_path), "lockstep")) as bus:
        frames, _ = acknowledging(bus, *OTHERS)
    assert len(frames) == 5


def test_lockstep_goes_on_without_who_has_died(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    config = settings(tiny.write_tum(tmp_path, count=2), "lockstep")

    def work(bus: Recorder) -> None:
        with open_source(config.source) as source:
            SourceWorker(config, bus, source, patience_s=0.1).run()  # type: ignore[arg-type]

    with running(work) as bus:
        frames, _ = acknowledging(bus, "tracker")
    assert len(frames) == 2
    assert "not acknowledged by backend, scale" in caplog.text


def test_stopping_ends_every_wait(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path)
    waiting_for_peers = settings(folder, peers_s=600.0)
    waiting_by_wish = settings(folder, wait_s=600.0)
    waiting_for_acknowledgement = settings(folder, "lockstep")
    waiting_for_a_late_image = settings(folder, rate_hz=0.001)
    for config in (
        waiting_for_peers,
        waiting_by_wish,
        waiting_for_acknowledgement,
        waiting_for_a_late_image,
    ):
        with playing(config) as bus:
            until(lambda bus=bus: "ready" in bus.states)
            if config is waiting_for_a_late_image:  # as `eval`, which gives up what is silent, must know
                until(lambda bus=bus: GAP in bus.pulse.values)
                assert 900 < float(bus.pulse.values[GAP]) <= 1000
        assert "ended" not in bus.states


def test_loop_plays_on(tmp_path: Path) -> None:
    with playing(settings(tiny.write_tum(tmp_path, count=3), "lockstep", loop=True)) as bus:
        frames = []
        for _ in range(8):
            frames.append(bus.next()[1])
            for name in OTHERS:
                bus.say("acknowledged", Acknowledged(name, frames[-1].index))
    assert [frame.index for frame in frames] == list(range(8))
    assert len({frame.stamp_ns for frame in frames}) == 8


@pytest.mark.parametrize("kind", ["folder", "video"])
def test_lockstep_ends_after_the_first_frames(tmp_path: Path, kind: str) -> None:
    path = tiny.write_tum(tmp_path) if kind == "folder" else tiny.write_video(tmp_path / "clip.avi", 5)
    with playing(settings(path, "lockstep", frames=3)) as bus:
        frames, end = acknowledging(bus, *OTHERS)
    assert [frame.index for frame in frames] == [0, 1, 2]
    assert end == EndOfStream(frames=3, released=3, duplicates=0, unreadable=0, last_index=2)


def test_what_cannot_be_played_is_an_error_before_ready(tmp_path: Path) -> None:
    bus = Recorder()
    folder = tiny.write_tum(tmp_path)
    broken = tmp_path / "camera2.yaml"
    broken.write_text(tiny.CAMERA.replace("fx: 60", "fx: -60"))
    with pytest.raises(SourceError):
        main(settings(tmp_path / "missing"), bus)  # type: ignore[arg-type]
    with pytest.raises(ConfigError):
        main(settings(folder, camera=str(broken)), bus)  # type: ignore[arg-type]
    assert "ready" not in bus.states
    assert bus.published.empty()


def test_a_mask_of_another_size_is_an_error_before_ready(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = tiny.write_tum(tmp_path)
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((20, 30), 255, np.uint8))
    bus = Recorder()
    with pytest.raises(ConfigError, match="is 30x20, but the camera's images are"):
        main(settings(folder, mask="~/mask.png"), bus)  # type: ignore[arg-type]
    assert "ready" not in bus.states


def test_images_made_smaller_come_with_the_camera_that_would_have_taken_them(tmp_path: Path) -> None:
    folder = tiny.write_tum(tmp_path / "robot")
    cv2.imwrite(str(tmp_path / "mask.png"), np.full((48, 64), 255, np.uint8))  # of the images as they come
    config = settings(folder, "lockstep", shrink=2, mask=str(tmp_path / "mask.png"))
    with playing(config) as bus:
        frames, end = acknowledging(bus, *OTHERS)
    assert end.released == 5
    for frame in frames:
        np.testing.assert_allclose(frame.camera, [32, 24, 30, 30, 15.5, 11.5])
        means = tiny.picture(frame.index).reshape(24, 2, 32, 2, 3).mean(axis=(1, 3))
        of_means = pack(np.rint(means).astype(np.uint8))[0].astype(int)
        np.testing.assert_allclose(frame.image, of_means, atol=2)  # which way halves are rounded is OpenCV's


def bonnet(folder: Path) -> Path:
    """A TUM folder of 50 images, 0.3 s apart, of a camera that sways; the lower third never changes."""
    texture = block_texture(np.random.default_rng(0), 1200, 900)
    own = block_texture(np.random.default_rng(1), 320, 80)
    (folder / "rgb").mkdir(parents=True)
    lines = []
    for i in range(50):
        x, y = round(400 + 300 * np.sin(0.9 * i)), round(300 + 200 * np.sin(0.7 * i))
        image = texture[y : y + 240, x : x + 320].copy()
        image[-80:] = own
        cv2.imwrite(str(folder / f"rgb/{i}.png"), image)
        lines.append(f"{0.3 * i:.6f} rgb/{i}.png\n")
    (folder / "rgb.txt").write_text("".join(lines))
    (folder / "camera.yaml").write_text("width: 320\nheight: 240\nfx: 260\nfy: 260\ncx: 160\ncy: 120\n")
    return folder


def test_health_says_that_the_camera_sees_its_own_robot(tmp_path: Path) -> None:
    folder = bonnet(tmp_path / "robot")
    with playing(settings(folder, "lockstep")) as bus:
        acknowledging(bus, *OTHERS)
        assert "if that is the robot itself, mask it" in bus.pulse.values["warning"]
    shown = np.full((240, 320), 255, np.uint8)
    shown[-90:] = 0
    cv2.imwrite(str(tmp_path / "mask.png"), shown)
    with playing(settings(folder, "lockstep", mask=str(tmp_path / "mask.png"))) as bus:
        acknowledging(bus, *OTHERS)
        assert "warning" not in bus.pulse.values


def test_log_and_health_say_that_the_intrinsics_look_like_another_images(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = tiny.write_tum(tmp_path / "robot")
    with playing(settings(folder)) as bus:
        bus.until_end()
        assert "intrinsics" not in bus.pulse.values.get("warning", "")
    assert "intrinsics of" not in caplog.text
    (folder / "camera.yaml").write_text(tiny.CAMERA.replace("cx: 31.5", "cx: 62.5"))
    doubt = "camera: cx 62.5 of a 64-wide image: are these intrinsics of a larger image?"
    with playing(settings(folder)) as bus:
        until(lambda: "warning" in bus.pulse.values)
        assert bus.pulse.values["warning"] == doubt
    assert caplog.text.count(doubt) == 1


def test_over_the_real_bus(tmp_path: Path) -> None:
    config = settings(tiny.write_tum(tmp_path, count=8), "lockstep", peers_s=DEADLINE_S)
    config = replace(config, bus=BusConfig(free_endpoint()))

    def work(stop: Recorder) -> None:
        with Bus.open(config, "source") as bus:
            threading.Thread(target=lambda: (stop.stopped.wait(), bus.stopped.set()), daemon=True).start()
            main(config, bus)

    with (
        Bus.open(config, "supervisor", listen=True),
        Bus.open(config, "tracker") as tracker,
        Bus.open(config, "scale") as scale,
        Bus.open(config, "backend") as backend,
    ):
        frames, ends = tracker.queue("frame"), tracker.queue("end")
        with running(work):
            for peer in (backend, scale, tracker):
                peer.pulse.ready()
            seen = []
            for _ in range(8):
                frame = frames.take(DEADLINE_S)
                assert frame is not None
                seen.append(frame.index)
                np.testing.assert_array_equal(frame.image, pack(tiny.picture(frame.index))[0])
                for peer in (tracker, scale, backend):
                    peer.publish("acknowledged", Acknowledged(peer.process, frame.index))
            end = ends.take(DEADLINE_S)
            late_comer = tracker.ask("end", DEADLINE_S)
    assert seen == list(range(8))
    assert end == late_comer
    assert end is not None
    assert end.released == 8
