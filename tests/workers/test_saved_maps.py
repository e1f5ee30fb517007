"""Maps that are saved by name, and taken up again."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig, TrackingConfig
from prism_edge.workers import backend as worker
from prism_edge.workers import state_directory
from prism_edge.workers.state_directory import map_names, map_path
from tests.backend.world import poses_of
from tests.workers.backend_bench import CONFIG, depth_of, gate_of, keyframes, live, snapshot
from tests.workers.list_bus import ListBus


def described(told: list, looks: np.ndarray, network: str) -> tuple[map_file.Info, map_file.Arrays]:
    """A map as stored, its places in a network's words."""
    mapper = Mapper(BackendConfig())
    for keyframe in told:
        mapper.absorb(keyframe)
        mapper.loops.add_place(keyframe.id, looks[keyframe.id], network)
    return mapper.stored()


class TestSaving:
    @pytest.fixture(autouse=True)
    def _state(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))

    def test_a_saved_map_is_the_map(self, tmp_path: Path) -> None:
        teller, told = keyframes(5)
        bus = live(tmp_path, told, teller, ask=("lab", "lab"))
        assert [r.ok for r in bus.desk.replies] == [True, True]
        assert bus.desk.replies[0].said.startswith("saved lab: 5 keyframes, ")
        assert ["in place of" in reply.said for reply in bus.desk.replies] == [False, True]
        assert map_names(CONFIG.state) == ["lab"]
        info, arrays = map_file.unpack(map_file.read(map_path(CONFIG.state, "lab")))
        mapper = Mapper(BackendConfig())
        assert mapper.restore(info, arrays) == KnownScale(0.25, 0.1, 0.07)
        np.testing.assert_allclose(list(poses_of(mapper.world).values()), snapshot(bus).poses, atol=1e-12)
        assert info["robot"] == CONFIG.robot
        assert info["model"] == CONFIG.depth.model

    def test_a_saved_map_is_loaded_in_another_run(self, tmp_path: Path) -> None:
        teller, told = keyframes(6)
        saved = live(tmp_path / "a", told[:5], teller, ask=("lab",))
        bus = ListBus("keyframe")
        bus.run_directory = tmp_path / "b"
        made = worker.BackendWorker(replace(CONFIG, tracking=TrackingConfig(levels=8, scale_factor=1.2)), bus)
        bus.desk.ask("load_map", "lab")
        made._desk.serve()
        (reply,) = bus.desk.replies
        assert reply.ok
        assert reply.said.startswith("loaded lab: 5 keyframes, ")
        (loaded,) = bus.of("map_loaded")
        assert loaded.epoch > 0
        assert loaded.log_scale == pytest.approx(0.25)
        np.testing.assert_allclose(snapshot(bus).poses, snapshot(saved).poses, atol=1e-12)
        whole = made._keeper.whole(made._home_scale)
        assert whole is not None
        assert (whole.epoch, whole.log_scale) == (loaded.epoch, loaded.log_scale)
        assert (loaded.scale_sigma, loaded.bias_sigma) == (0.1, 0.07)
        assert whole.scale_sigma == pytest.approx(math.hypot(0.1, 0.07)), "what is published with it"
        # the tracker goes on in it, and what it still says of the map before is not heard
        bus.give("keyframe", told[5])
        bus.give("keyframe", replace(told[5], epoch=loaded.epoch))
        for _ in range(3):
            waiting = made._arrivals._waiting
            made._arrivals._waiting = type(waiting)((0.0, k) for _, k in waiting)  # waited long enough
            made._realtime()
        assert snapshot(bus).keyframes.tolist() == [0, 1, 2, 3, 4, 5]

    @pytest.mark.parametrize("content", [None, b"", b"PRISMMAP", b"noise" * 50])
    def test_what_can_not_be_loaded_leaves_the_map_as_it_is(
        self, tmp_path: Path, content: bytes | None
    ) -> None:
        folder = state_directory.maps_folder(CONFIG.state)
        folder.mkdir(parents=True)
        if content is not None:
            (folder / "lab.prismmap").write_bytes(content)
        teller, told = keyframes(3)
        bus = live(tmp_path, told, teller, ask=("other",))
        made = bus.desk.handlers["load_map"].__self__  # type: ignore[attr-defined]
        bus.desk.replies.clear()
        bus.desk.ask("load_map", "lab")
        made._desk.serve()
        (reply,) = bus.desk.replies
        assert not reply.ok
        assert ("there are: other" if content is None else "not a sound map") in reply.said
        assert bus.of("map_loaded") == []
        assert len(made._mapper.world.keyframes) == 3

    def test_a_map_of_other_pyramids_is_refused(self, tmp_path: Path) -> None:
        teller, told = keyframes(3)
        live(tmp_path, [replace(k, scale_factor=1.5) for k in told], teller, ask=("lab",))
        bus = live(tmp_path, [], teller)
        made = bus.desk.handlers["load_map"].__self__  # type: ignore[attr-defined]
        bus.desk.ask("load_map", "lab")
        made._desk.serve()
        assert "another tracking.scale_factor" in bus.desk.replies[-1].said

    @pytest.mark.parametrize(
        ("count", "seen", "said"),
        [
            (1, True, "too few keyframes, 1"),
            (3, False, "no points"),
            (3, True, "more tracking.levels than 6"),
        ],
    )
    def test_a_map_that_the_tracker_could_not_go_on_in_is_refused(
        self, tmp_path: Path, count: int, seen: bool, said: str
    ) -> None:
        """Loading it would leave backend and scale in an epoch that the tracker never comes to."""
        teller, told = keyframes(3)
        mapper = Mapper(BackendConfig())
        for keyframe in told[:count]:
            mapper.absorb(keyframe)
        info, arrays = mapper.stored()
        if not seen:
            arrays["seen"] = np.full_like(arrays["seen"], -1)
        path = map_path(CONFIG.state, "lab")
        path.parent.mkdir(parents=True)
        path.write_bytes(map_file.pack({**info, **KnownScale().info}, arrays))
        config = replace(CONFIG, tracking=TrackingConfig(levels=6, scale_factor=told[0].scale_factor))
        bus = live(tmp_path, told, teller, config=config)
        made = bus.desk.handlers["load_map"].__self__  # type: ignore[attr-defined]
        bus.desk.ask("load_map", "lab")
        made._desk.serve()
        assert said in bus.desk.replies[-1].said
        assert not bus.desk.replies[-1].ok
        assert made._mapper.epoch == 0
        assert len(made._mapper.world.keyframes) == 3
        assert bus.of("map_loaded") == []

    @pytest.mark.parametrize("was_said", [True, False])
    def test_places_that_another_network_described_are_left_out(self, tmp_path: Path, was_said: bool) -> None:
        """They mean nothing to this one. Whose they are, older files say in `model` alone."""
        teller, told = keyframes(5)
        looks = np.eye(8, dtype=np.float32)
        config = replace(CONFIG, tracking=TrackingConfig(levels=8, scale_factor=told[0].scale_factor))
        info, arrays = described(told, looks, "other")
        if not was_said:
            del info["places_of"]
        path = map_path(CONFIG.state, "lab")
        path.parent.mkdir(parents=True)
        path.write_bytes(map_file.pack({**info, **KnownScale().info, "model": "other"}, arrays))
        bus = ListBus("keyframe")
        made = worker.BackendWorker(config, bus)
        for k in told[:2]:
            bus.give("depth", depth_of(k, teller, descriptor=looks[k.id]))
            bus.give("gate", gate_of(k))
            bus.give("keyframe", k)
            made._realtime()
        assert len(made._mapper.loops.index) == 2
        assert made._load_map("lab").said.count("without another depth network's words") == 1
        assert len(made._mapper.loops.index) == 0
        assert len(made._mapper.world.keyframes) == 5

    def test_places_of_the_same_network_are_kept_whatever_the_file_was_called(self, tmp_path: Path) -> None:
        _, told = keyframes(3)
        info, arrays = described(told, np.eye(8, dtype=np.float32), "exact")
        path = map_path(CONFIG.state, "lab")
        path.parent.mkdir(parents=True)
        path.write_bytes(map_file.pack({**info, **KnownScale().info, "model": "a/path/to.onnx"}, arrays))
        config = replace(CONFIG, tracking=TrackingConfig(levels=8, scale_factor=told[0].scale_factor))
        made = worker.BackendWorker(config, ListBus("keyframe"))
        assert "without" not in made._load_map("lab").said
        assert len(made._mapper.loops.index) == 3

    @pytest.mark.parametrize("has_spoken", [False, True])
    def test_our_network_s_map_keeps_its_places_behind_another_network_s(
        self, tmp_path: Path, has_spoken: bool
    ) -> None:
        """Ours is whose depths come in this run, not who described the map that there is."""
        teller, told = keyframes(5)
        looks, ours, theirs = np.eye(8, dtype=np.float32), "exact@0123456789ab", "other@0123456789ab"
        for name, network in (("ours", ours), ("theirs", theirs)):
            info, arrays = described(told, looks, network)
            path = map_path(CONFIG.state, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            known = {**info, **KnownScale().info, "model": network.partition("@")[0]}
            path.write_bytes(map_file.pack(known, arrays))
        config = replace(CONFIG, tracking=TrackingConfig(levels=8, scale_factor=told[0].scale_factor))
        bus = ListBus("keyframe")
        made = worker.BackendWorker(config, bus)
        if has_spoken:
            bus.give("depth", depth_of(told[0], teller, descriptor=looks[0], model=ours))
            bus.give("keyframe", told[0])
            made._realtime()
        said = []
        for name in ("theirs", "theirs", "ours"):
            left_out = "without another depth network's words" in made._load_map(name).said
            said.append((left_out, len(made._mapper.loops.index)))
        assert said[-1] == (False, 5)
        assert said[:2] == ([(True, 0)] * 2 if has_spoken else [(False, 5)] * 2)

    def test_what_has_no_place_in_the_map_is_said(self, tmp_path: Path) -> None:
        teller, told = keyframes(5)
        bus = live(tmp_path, told, teller)
        made = bus.desk.handlers["save_map"].__self__  # type: ignore[attr-defined]
        assert made._save_map("lab").said.startswith("saved lab: 5 keyframes, ")
        for number in (3, 4):
            made._mapper.world.keyframes[number].part = 3
            for point in list(made._mapper.world.keyframes[number].observed):
                made._mapper.world.drop_observation(number, point)
        said = made._save_map("lab").said
        assert said.startswith("saved lab: 5 keyframes (2 of them apart, without a place in map), ")

    def test_no_map_no_file(self, tmp_path: Path) -> None:
        bus = live(tmp_path, [], keyframes(1)[0], ask=("lab",))
        assert [(r.ok, r.said) for r in bus.desk.replies] == [(False, "there is no map to save yet")]

    def test_what_would_not_be_loaded_is_not_saved(self, tmp_path: Path) -> None:
        teller, told = keyframes(1)
        [reply] = live(tmp_path, told, teller, ask=("lab",)).desk.replies
        assert not reply.ok
        assert "too few keyframes, 1" in reply.said
        assert map_names(CONFIG.state) == []
        assert map_names(CONFIG.state) == []

    @pytest.mark.parametrize(
        "name", ["", ".", "..", "../x", "/etc/x", "a/b", ".hidden", "a" * 65, "a b", "ä", "a\n"]
    )
    def test_a_name_leads_nowhere_else(self, tmp_path: Path, name: str) -> None:
        teller, told = keyframes(2)
        bus = live(tmp_path, told, teller, ask=(name,))
        assert not bus.desk.replies[0].ok
        assert "is no name for a map" in bus.desk.replies[0].said
        assert not (tmp_path / "state" / "maps").exists()
