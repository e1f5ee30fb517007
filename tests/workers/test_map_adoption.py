"""A tracker that goes on in the backend's map, against the true path of a short film."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig, NetworkConfig
from prism_edge.messages import IDS_A_LIFE, Keyframe, MapLoaded, WholeMap
from prism_edge.tracking.drift import Drift
from prism_edge.workers import backend, map_adoption
from prism_edge.workers.handover import PATIENCE_S
from tests.tracking.footage import footage
from tests.workers.list_bus import ListBus
from tests.workers.tracker_bench import CONFIG, World, depth_of, frame, positions, run, true_position

LONG_NS = 5_000_000_000
EPOCH, LOG_SCALE = 1000, 0.0
DRIFT = 0.05  # metres: what a map of forty frames without a backend is off by; a wrong place is off by more
BUILT, AFTER = range(40), range(45, 75)


@pytest.fixture(scope="module")
def whole() -> WholeMap:
    """The backend's map of the film's first half."""
    return map_of(built())


def built() -> list[Keyframe]:
    """The keyframes of the film's first half."""
    bus = ListBus("frame")
    World(bus)
    run(bus, [frame(i) for i in BUILT])
    return bus.of("keyframe")


def map_of(keyframes: list[Keyframe]) -> WholeMap:
    """What the backend makes of keyframes, for a tracker."""
    mapper = Mapper(BackendConfig())
    for keyframe in keyframes:
        mapper.absorb(keyframe)
    info, arrays = mapper.stored()
    data = map_file.pack({**info, **KnownScale(LOG_SCALE, 0.05).info}, arrays)
    return WholeMap(EPOCH, 7, LOG_SCALE, 0.05, np.frombuffer(data, np.uint8))


class Asked:
    """A bus on which the backend answers with a map, or not."""

    def __init__(self, answer: WholeMap | None, life: int) -> None:
        self.bus = ListBus("frame")
        self.bus.life, self.bus.first_id = life, life * IDS_A_LIFE
        self.asked: list[str] = []
        self.answers = [answer]  # the last one again and again
        World(self.bus)

        def ask(topic: str, timeout_s: float = 1.0) -> WholeMap | None:
            self.asked.append(topic)
            return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]

        self.bus.ask = ask  # type: ignore[method-assign]


def errors(bus: ListBus) -> list[float]:
    return [float(np.linalg.norm(p - true_position(i))) for i, p in positions(bus).items()]


def test_after_a_restart_poses_go_on_in_the_same_map(whole: WholeMap) -> None:
    life = Asked(whole, life=1)
    run(life.bus, [frame(i) for i in AFTER])
    assert life.asked == ["whole_map"]
    found = positions(life.bus)
    assert min(found) <= AFTER[0] + 5  # within a few frames of the first
    assert len(found) >= len(AFTER) - 5
    # In the coordinates of the first life, whose origin is the film's first frame.
    assert np.median(errors(life.bus)) < DRIFT
    keyframes = life.bus.of("keyframe")
    assert keyframes
    assert all(k.epoch == EPOCH and k.id >= IDS_A_LIFE for k in keyframes)


@pytest.mark.parametrize(
    ("supervised", "remote", "waited_s"),
    [(True, (), map_adoption.RECOVERED_S), (True, ("backend",), 3.0), (False, (), 3.0)],
)
def test_a_backend_that_is_started_again_too_is_waited_for(
    supervised: bool, remote: tuple[str, ...], waited_s: float, tmp_path: Path
) -> None:
    """It has the map, and reads its journal first; asked before that, it says that there is none."""
    bus, waits = ListBus(), []
    bus.run_directory = tmp_path if supervised else None
    bus.await_ready = lambda names, timeout_s: waits.append((list(names), timeout_s))  # type: ignore
    bus.ask = lambda topic, timeout_s: None  # type: ignore[method-assign,assignment]
    config = replace(CONFIG, network=NetworkConfig(endpoint="tcp/0.0.0.0:7448", remote=remote))
    assert map_adoption.MapAdoption(config, bus).of_the_last_life() is None  # type: ignore[arg-type]
    assert waits == [(["backend"], waited_s), (["backend"], 0.0)], "it says so itself, and is still there"
    assert bus.budgets_s["asking for the map"] > 2 * waited_s


@pytest.mark.parametrize("cut_off", [False, True])
def test_a_backend_that_dies_over_the_question_is_asked_again(
    whole: WholeMap, cut_off: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where making the map took the last of the memory: its next life has it, from its journal."""
    monkeypatch.setattr(map_adoption, "AGAIN_S", 0.0)
    life = Asked(None, life=1)
    life.answers.append(whole)
    there = [set(), {"backend"}, set()]  # when it is asked, after that, and once it is started again
    life.bus.await_ready = lambda names, timeout_s: there.pop(0)  # type: ignore[method-assign]
    adoption = map_adoption.MapAdoption(CONFIG, life.bus)  # type: ignore[arg-type]
    assert (adoption.of_a_run_cut_off if cut_off else adoption.of_the_last_life)() is whole
    assert not there


def test_a_backend_that_is_not_there_is_asked_once() -> None:
    life = Asked(None, life=1)
    life.bus.await_ready = lambda names, timeout_s: {"backend"}  # type: ignore[method-assign]
    adoption = map_adoption.MapAdoption(CONFIG, life.bus)  # type: ignore[arg-type]
    assert adoption.of_the_last_life() is None
    assert life.asked == ["whole_map"]


def test_status_tells_of_a_map_that_was_gone_on_in_without_an_image(whole: WholeMap) -> None:
    """The source is paused, or the camera away."""
    life = Asked(whole, life=1)
    run(life.bus, [])
    assert life.bus.of("status")[0].status[0].message == "lost relocalising"


def test_the_same_map_loaded_in_the_first_life(whole: WholeMap) -> None:
    run_of = Asked(whole, life=0)
    run_of.bus.give("map_loaded", MapLoaded(EPOCH, LOG_SCALE, 0.05))
    run(run_of.bus, [frame(i) for i in AFTER])
    assert len(positions(run_of.bus)) >= len(AFTER) - 5
    assert np.median(errors(run_of.bus)) < DRIFT
    # The map's last owner may have given out numbers that are not in the file.
    assert all(k.id >= IDS_A_LIFE for k in run_of.bus.of("keyframe"))
    assert len({k.id for k in run_of.bus.of("keyframe")}) == len(run_of.bus.of("keyframe"))


def test_status_tells_of_a_loaded_map_without_another_image(whole: WholeMap) -> None:
    """The source is paused: the camera has still to be found in it."""
    bus = Asked(whole, life=0).bus
    depths = World(bus)

    def heard(topic: str, message: object) -> None:
        depths.heard(topic, message)
        if topic == "tracked" and message.index == 20:  # type: ignore[attr-defined]
            bus.give("map_loaded", MapLoaded(EPOCH, LOG_SCALE, 0.05))

    bus.hear = heard
    run(bus, [frame(i) for i in range(21)])
    last = bus.of("status")[-1].status[0]
    assert last.message == "lost relocalising"
    assert bus.forgotten == ["tf"], "it led into the map before"
    told = {pair.key: pair.value for pair in last.values}
    assert int(told["keyframes"]) > 2


@pytest.mark.parametrize("asked_for", ["before it is loaded", "as soon as it is"])
def test_a_loaded_map_stays_as_it_is_where_that_was_asked_for(whole: WholeMap, asked_for: str) -> None:
    bus = Asked(whole, life=0).bus
    depths, told = World(bus), []

    def heard(topic: str, message: object) -> None:
        depths.heard(topic, message)
        if topic == "tracked" and message.index == 20:  # type: ignore[attr-defined]
            bus.give("map_loaded", MapLoaded(EPOCH, LOG_SCALE, 0.05))
            told.append(message)

    served = bus.desk.before_serving

    def look() -> None:
        served()
        early = asked_for.startswith("before")
        due = bool(bus.of("pose")) if early else bool(told) and not bus.inboxes["map_loaded"].waiting
        if due and not bus.desk.replies:
            bus.desk.ask("localise_only", "on")

    bus.hear, bus.desk.before_serving = heard, look
    run(bus, [frame(i) for i in range(21)] + [frame(i) for i in AFTER])
    assert [reply.ok for reply in bus.desk.replies] == [True]
    assert [k for k in bus.of("keyframe") if k.epoch == EPOCH] == []
    assert len(positions(bus)) > len(AFTER), "poses come in both maps"


def test_a_reset_after_a_load_is_not_undone_by_it(whole: WholeMap) -> None:
    """Both wait while a frame is tracked."""
    bus = Asked(whole, life=0).bus
    bus.give("map_loaded", MapLoaded(EPOCH, LOG_SCALE, 0.05))
    bus.desk.ask("reset")
    run(bus, [frame(i) for i in AFTER])
    assert {k.epoch for k in bus.of("keyframe")} == {EPOCH + 1}


def test_the_drift_of_the_map_before_is_forgotten(
    whole: WholeMap, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus, forgotten = Asked(whole, life=0).bus, []
    forget = Drift.forget

    def forget_and_say(drift: Drift) -> None:
        forgotten.append(sorted(drift._keyframes))
        forget(drift)

    monkeypatch.setattr(Drift, "forget", forget_and_say)
    depths = World(bus)

    def heard(topic: str, message: object) -> None:
        depths.heard(topic, message)
        if topic == "tracked" and message.index == 20:  # type: ignore[attr-defined]
            bus.give("map_loaded", MapLoaded(EPOCH, LOG_SCALE, 0.05))

    bus.hear = heard
    run(bus, [frame(i) for i in range(21)] + [frame(i) for i in AFTER])
    before = [k.id for k in bus.of("keyframe") if k.epoch != EPOCH]
    assert forgotten == [before], "which the loaded map numbers alike"


def test_numbers_under_way_when_the_last_life_died_are_not_given_out_again() -> None:
    told = built()
    under_way = told[-1]  # in the backend's inbox when it was asked for the map
    given = map_of(told[:-1])
    _, arrays = map_file.unpack(given.data.tobytes())
    late = set(under_way.points.tolist()) - {-1, *arrays["points"].tolist()}
    assert late
    life = Asked(given, life=1)
    run(life.bus, [frame(i) for i in AFTER])
    keyframes = life.bus.of("keyframe")
    assert any(len(k.new_points) for k in keyframes)
    assert late.isdisjoint(np.concatenate([k.points for k in keyframes]).tolist())


@pytest.mark.parametrize("same", [True, False])
def test_one_started_by_hand_goes_on_in_the_map_of_its_own_camera(whole: WholeMap, same: bool) -> None:
    """A tracker on another computer has lives that nobody counts, and the map is as much its own."""
    life = Asked(whole, life=0)
    life.bus.first_id = 10**15
    camera = frame(AFTER[0]).camera.copy()
    camera[2] *= 1.0 if same else 1.01  # focal length
    run(life.bus, [frame(i, camera=camera) for i in AFTER])
    assert life.asked == ["whole_map"]
    made = life.bus.of("keyframe")
    assert {k.epoch for k in made} == {EPOCH if same else EPOCH + 1}
    assert all(k.id >= 10**15 for k in made)
    assert life.bus.of("tracked")[-1].dropped == 0, "what came before its start was another's"
    assert not any("recovered" in message.status[0].message for message in life.bus.of("status"))


def test_without_an_answer_a_new_map_begins() -> None:
    life = Asked(None, life=2)
    run(life.bus, [frame(i) for i in AFTER])
    assert positions(life.bus)
    assert {k.epoch for k in life.bus.of("keyframe")} == {2 * IDS_A_LIFE}


def test_a_backend_in_the_midst_of_a_solve_is_waited_for(whole: WholeMap) -> None:
    life = Asked(whole, life=1)
    patience: list[float] = []
    life.bus.ask = lambda topic, timeout_s=1.0: (  # type: ignore[method-assign]
        patience.append(timeout_s) or (whole if timeout_s > PATIENCE_S else None)
    )
    run(life.bus, [frame(i) for i in AFTER])
    assert {k.epoch for k in life.bus.of("keyframe")} == {EPOCH}
    assert life.bus.budgets_s["asking for the map"] > sum(patience), "it is not taken for a hang meanwhile"


def test_whoever_asks_waits_longer_than_the_backend_and_that_longer_than_a_solve_may_take() -> None:
    assert PATIENCE_S > backend._SOLVE_S
    assert min(map_adoption.BUSY_S, map_adoption.LOADED_S, map_adoption.RECOVERED_S) > PATIENCE_S


def test_the_first_life_asks_nobody(whole: WholeMap) -> None:
    life = Asked(whole, life=0)
    run(life.bus, [frame(0)])
    assert life.asked == []


@pytest.mark.parametrize("data", [b"", b"noise" * 100])
def test_a_map_that_is_none_is_not_gone_on_in(data: bytes) -> None:
    broken = WholeMap(EPOCH, 1, 0.0, 0.1, np.frombuffer(data, np.uint8))
    life = Asked(broken, life=1)
    run(life.bus, [frame(i) for i in AFTER])
    assert {k.epoch for k in life.bus.of("keyframe")} == {IDS_A_LIFE}
    assert positions(life.bus)


def only_one(whole: WholeMap) -> WholeMap:
    """The map with its first keyframe alone."""
    return replace(map_of(built()[:1]), epoch=whole.epoch)


def without_points(whole: WholeMap) -> WholeMap:
    """The map with keyframes that see nothing."""
    info, arrays = map_file.unpack(whole.data.tobytes())
    data = map_file.pack(info, {**arrays, "seen": np.full_like(arrays["seen"], -1)})
    return replace(whole, data=np.frombuffer(data, np.uint8))


FLAWS: dict[str, Callable[[WholeMap], WholeMap | None]] = {
    "none comes": lambda whole: None,
    "older than announced": lambda whole: replace(whole, epoch=EPOCH - 1),
    "noise": lambda whole: replace(whole, data=np.frombuffer(b"noise" * 100, np.uint8)),
    "one keyframe": only_one,
    "no points": without_points,
}


@pytest.mark.parametrize("flaw", FLAWS)
def test_a_loaded_map_that_can_not_be_gone_on_in_gives_way_to_a_new_one(
    whole: WholeMap, flaw: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Backend and scale are in its epoch: what is of an older one they would not hear any more."""
    life = Asked(FLAWS[flaw](whole), life=0)
    life.bus.give("map_loaded", MapLoaded(EPOCH, LOG_SCALE, 0.05))
    run(life.bus, [frame(i) for i in AFTER])
    assert {k.epoch for k in life.bus.of("keyframe")} == {EPOCH + 1}
    assert positions(life.bus)
    assert "a new one begins" in caplog.text
    assert life.bus.states[-1] != "asking for the loaded map", "a camera that is paused is no hang"


@pytest.mark.parametrize(("levels", "epoch"), [(6, EPOCH), (3, IDS_A_LIFE)])
def test_a_map_of_a_larger_pyramid_is_not_gone_on_in(whole: WholeMap, levels: int, epoch: int) -> None:
    smaller = replace(CONFIG, tracking=replace(CONFIG.tracking, levels=levels))
    life = Asked(whole, life=1)
    run(life.bus, [frame(i) for i in AFTER], smaller)
    assert {k.epoch for k in life.bus.of("keyframe")} == {epoch}
    assert positions(life.bus)


def test_a_camera_that_is_elsewhere_maps_a_part_of_its_own(whole: WholeMap) -> None:
    """`odom` goes on; there is no `pose` until the part is joined to the map."""
    life = Asked(whole, life=1)
    bus = life.bus
    depths = World(bus)
    grey = [255 - frame(i).image for i in range(75)]  # nothing of it looks like the map
    film = footage()
    depths.depth = lambda image: depth_of(image, depth=film.depths[image.index])
    step = 100_000_000
    run(bus, [frame(i, image=grey[i], stamp_ns=i * step) for i in range(75)])
    assert {k.epoch for k in bus.of("keyframe")} <= {EPOCH}
    assert not bus.of("pose")
    assert bus.of("odom")


def test_a_loaded_map_is_kept_however_long_the_camera_is_elsewhere(whole: WholeMap) -> None:
    life = Asked(whole, life=0)
    life.bus.give("map_loaded", MapLoaded(EPOCH, LOG_SCALE, 0.05))
    grey = np.full((240, 320), 128, np.uint8)
    frames = [frame(i, image=grey, stamp_ns=i * LONG_NS) for i in range(5)]
    frames += [frame(i, stamp_ns=10 * LONG_NS + i * 33_000_000) for i in range(45, 60)]
    run(life.bus, frames)
    assert life.bus.of("pose")
    assert {k.epoch for k in life.bus.of("keyframe")} <= {EPOCH}
