"""What `load_map` takes up: a map of a later epoch than whatever the tracker is in, and nothing odd."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from prism_edge.backend import map_file
from prism_edge.backend.map_scale import KnownScale
from prism_edge.config import Config, StateConfig, TrackingConfig
from prism_edge.errors import MapError
from prism_edge.messages import IDS_A_LIFE, Epoch, MapLoaded
from prism_edge.workers import backend, loaded_map, map_adoption, tracker
from prism_edge.workers.map_adoption import MapAdoption
from prism_edge.workers.state_directory import map_path
from tests.tracking.cloud import CAMERA
from tests.workers.backend_bench import CONFIG, hear, keyframes
from tests.workers.list_bus import ListBus


def of_three_keyframes(folder: Path) -> tuple[Config, ListBus, backend.BackendWorker]:
    """A backend that has a map, and keeps maps in a folder."""
    state = StateConfig(directory=str(folder), journal=False)
    config = replace(CONFIG, tracking=TrackingConfig(scale_factor=1.2, levels=8), state=state)
    teller, told = keyframes(3)
    bus = ListBus("keyframe")
    made = backend.BackendWorker(config, bus)
    hear(made, bus, told, teller)
    return config, bus, made


@pytest.mark.parametrize("there", [0, 7, 1000, IDS_A_LIFE, None])
def test_the_tracker_takes_a_loaded_map_up_whatever_epoch_it_is_in(tmp_path: Path, there: int | None) -> None:
    """In its second life and without a keyframe yet, or beside a backend whose journal is gone; or away."""
    config, bus, made = of_three_keyframes(tmp_path)
    bus.desk.ask("save_map", "lab")
    made._desk.serve()
    bus = ListBus("keyframe")
    known = {} if there is None else {"epoch": Epoch(there)}
    bus.ask = lambda topic, timeout_s=1.0: known.get(topic)  # type: ignore[method-assign]
    made = backend.BackendWorker(config, bus)
    bus.desk.ask("load_map", "lab")
    made._desk.serve()
    (loaded,) = bus.of("map_loaded")
    beside, asked = ListBus("frame"), []
    whole = SimpleNamespace(epoch=loaded.epoch)
    beside.ask = lambda topic, timeout_s=1.0: asked.append(topic) or whole  # type: ignore[method-assign]
    adoption = MapAdoption(config, beside)
    beside.give("map_loaded", loaded)
    adoption.take_loaded(SimpleNamespace(epoch=there or 0), lambda whole: True, lambda word: None)
    assert asked == ["whole_map"]


@pytest.mark.parametrize("odd", [{"places_of": 5}, {"cameras": [["pinhole", [10**400, 480, 1, 1, 1, 1]]]}])
def test_odd_values_are_refused_in_a_line(tmp_path: Path, odd: dict[str, object]) -> None:
    config, _, made = of_three_keyframes(tmp_path)
    made._mapper.loops.index.network = "exact@0123456789ab"
    info, arrays = made._mapper.stored()
    path = map_path(config.state, "lab")
    path.parent.mkdir(parents=True)
    path.write_bytes(map_file.pack({**info, **KnownScale().info, **odd}, arrays))
    with pytest.raises(MapError):
        made._load_map("lab")
    assert len(made._mapper.world.keyframes) == 3


@pytest.mark.parametrize(
    ("focal", "k1", "said"), [(1.0, 0.0, False), (1.0, -0.05, False), (1.1, 0.0, True)], ids=str
)
def test_the_reply_says_where_another_camera_made_the_map(
    tmp_path: Path, focal: float, k1: float, said: bool
) -> None:
    """One whose lens was found anew is the same."""
    state = StateConfig(directory=str(tmp_path), journal=False)
    config = replace(CONFIG, tracking=TrackingConfig(scale_factor=1.2, levels=8), state=state)
    teller, told = keyframes(3)
    theirs = CAMERA.bent(k1) if k1 else replace(CAMERA, fx=focal * CAMERA.fx, fy=focal * CAMERA.fy)
    bus = ListBus("keyframe")
    made = backend.BackendWorker(config, bus)
    hear(made, bus, [replace(keyframe, camera=theirs.to_array()) for keyframe in told], teller)
    bus.desk.ask("save_map", "lab")
    made._desk.serve()
    bus = ListBus("keyframe")
    made = backend.BackendWorker(config, bus)
    hear(made, bus, told, teller)
    assert ("of another camera" in made._load_map("lab").said) == said


def test_the_tracker_says_which_epoch_it_is_in() -> None:
    bus = ListBus("frame")
    bus.life, bus.first_id = 1, IDS_A_LIFE
    made = tracker.TrackerWorker(CONFIG, bus)
    assert bus.answers["epoch"]() == Epoch(IDS_A_LIFE)
    made._reset("")
    assert bus.answers["epoch"]() == Epoch(IDS_A_LIFE + 1)


@pytest.mark.parametrize("answers_at", [0, 1, map_adoption.TRIES, None])
def test_a_backend_that_is_just_started_again_is_asked_once_more(
    answers_at: int | None, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A reload right behind `load_map`: its next life has the map in the journal."""
    monkeypatch.setattr(map_adoption, "AGAIN_S", 0.0)
    bus, whole, asked = ListBus("frame"), SimpleNamespace(epoch=7), []

    def ask(topic: str, timeout_s: float = 1.0) -> SimpleNamespace | None:
        asked.append(topic)
        return whole if len(asked) - 1 == answers_at else None

    bus.ask = ask  # type: ignore[method-assign,assignment]
    adoption, adopted, resets = MapAdoption(CONFIG, bus), [], []
    bus.give("map_loaded", MapLoaded(7, 0.0, 0.1))
    adoption.take_loaded(SimpleNamespace(epoch=0), lambda whole: adopted.append(whole) or True, resets.append)
    lost = answers_at is None
    assert (adopted, resets) == (([], [""]) if lost else ([whole], []))
    assert len(asked) == (map_adoption.TRIES if lost else answers_at) + 1
    assert ("has not come" in caplog.text) == lost


def test_a_backend_that_is_silent_is_not_waited_for_again_and_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """It would be taken for a hang, and poses would wait for minutes."""
    bus, now, asked, resets = ListBus("frame"), [100.0], [], []
    monkeypatch.setattr(map_adoption.time, "monotonic", lambda: now[0])

    def ask(topic: str, timeout_s: float = 1.0) -> None:
        asked.append(topic)
        now[0] += timeout_s

    bus.ask = ask  # type: ignore[method-assign]
    adoption = MapAdoption(CONFIG, bus)
    bus.give("map_loaded", MapLoaded(7, 0.0, 0.1))
    adoption.take_loaded(SimpleNamespace(epoch=0), lambda whole: True, resets.append)
    assert (len(asked), resets) == (1, [""])
    assert now[0] - 100.0 < bus.budgets_s["asking for the loaded map"]


def test_a_map_that_is_passed_over_is_an_error(caplog: pytest.LogCaptureFixture) -> None:
    bus = ListBus("frame")
    adoption = MapAdoption(CONFIG, bus)
    for epoch in (5, 6):  # the one that it has, and an older one
        bus.give("map_loaded", MapLoaded(5, 0.0, 0.1))
        adoption.take_loaded(SimpleNamespace(epoch=epoch), lambda whole: True, lambda word: None)
    (record,) = caplog.records
    assert record.levelname == "ERROR"
    assert "passed over" in record.message


def test_a_tracker_that_has_not_heard_is_told_again_and_not_with_each_keyframe(monkeypatch, tmp_path) -> None:
    """Else it would go on in a map that nobody else has, and all that it says would be passed over."""
    now = [100.0]
    monkeypatch.setattr(loaded_map.time, "monotonic", lambda: now[0])
    bus = ListBus()
    mapper = SimpleNamespace(epoch=7)
    loaded = loaded_map.LoadedMap(bus, mapper)
    known = KnownScale(0.3, 0.02, 0.07, "")
    loaded.remind(known)
    assert bus.of("map_loaded") == [], "none was loaded"
    loaded.tell(known)
    for now[0] in (100.1, 100.9, 101.2, 101.3, 101.9, 102.4):
        loaded.remind(known)
    assert [m.epoch for m in bus.of("map_loaded")] == [7, 7, 7]
    mapper.epoch = 8  # begun since
    now[0] = 200.0
    loaded.remind(known)
    assert len(bus.of("map_loaded")) == 3


@pytest.mark.parametrize("known", [KnownScale(0.3, 0.02, 0.07, "a"), KnownScale()], ids=["known", "unknown"])
def test_others_are_told_what_is_known_of_the_unit_and_whether_it_is(known: KnownScale) -> None:
    news = loaded_map.LoadedMap(ListBus(), SimpleNamespace(epoch=7)).news(known)  # type: ignore[arg-type]
    assert (news.log_scale, news.scale_sigma) == (known.log_scale, known.sigma)
    assert (news.bias_sigma, news.network) == (known.bias_sigma, known.network)
    assert news.metric == (known != KnownScale())
