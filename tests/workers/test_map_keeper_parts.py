"""The units of a map's parts, in its journal: a backend started again goes on with them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from prism_edge.backend import map_file
from prism_edge.backend.map_facts import growth_info, growth_told
from prism_edge.backend.map_file import Arrays, Info
from prism_edge.errors import MapError
from prism_edge.geometry.poses import inverse, transform
from prism_edge.messages import HOME
from prism_edge.workers import backend as worker
from tests.backend.ring import Ring
from tests.backend.test_loops_between_parts import carried_off
from tests.synthetic import messages
from tests.workers.backend_bench import QUARTER, gate_of, hear, keyframes
from tests.workers.list_bus import ListBus
from tests.workers.test_map_keeper_moved import life


def give(made: worker.BackendWorker, bus: ListBus, ring: Ring, log_scale: float) -> None:
    """One keyframe more, with its descriptor, its weights and the metres of its part."""
    keyframe = ring.keyframe()
    depth = np.ones((120, 160), np.float32)
    descriptor = ring.looks_like(keyframe.id)
    bus.give("depth", messages.depth_of(keyframe, depth, QUARTER, valid=False, descriptor=descriptor))
    bus.give("gate", gate_of(keyframe))
    bus.give("log_scale", messages.scale_of(keyframe, log_scale, 0.05, part=keyframe.part))
    bus.give("keyframe", keyframe)
    made._realtime()


def far_too_deep(made: worker.BackendWorker, ring: Ring) -> float:
    """How many times too far from it the points of a keyframe under way are taken to be."""
    message = ring.keyframe()
    here = inverse(made._mapper.world.absorb(message).world_from_camera)
    there = inverse(ring.true[message.id])
    found = [made._mapper.world.points[p].position for p in message.new_points.tolist()]
    true = [ring.points[ring.point_of[p]] for p in message.new_points.tolist()]
    return float(np.median(transform(here, np.array(found))[:, 2] / transform(there, np.array(true))[:, 2]))


def test_a_backend_started_again_has_the_units_of_all_parts(tmp_path: Path) -> None:
    ring = Ring(lap=32)
    bus, made = life(tmp_path)
    for _ in range(10):
        give(made, bus, ring, 0.0)
    carried_off(ring)
    ring.unit, part = 2.0, ring.part  # what is 1 m is told as 2
    for poses in (ring.true, ring.told):
        poses += 4 * [poses[-1]]
    give(made, bus, ring, -np.log(2.0))
    apart = made._units.between(part, HOME)
    assert apart == pytest.approx((-np.log(2.0), np.hypot(0.05, 0.05)))
    assert life(tmp_path, 1)[1]._units.between(part, HOME) == pytest.approx(apart), "by a record"
    made._keeper.overhauled()
    made._realtime()
    assert life(tmp_path, 1)[1]._units.between(part, HOME) == pytest.approx(apart), "by a base"
    while not made._mapper.loops.accepted:
        give(made, bus, ring, -np.log(2.0))
    made._realtime()  # writes the map that has moved
    _, again = life(tmp_path, 1)
    assert again._units.between(part, HOME) is made._units.between(part, HOME) is None, "they are one"
    assert again._units.log_scale == made._units.log_scale
    grown = {k: keyframe.grown for k, keyframe in made._mapper.world.keyframes.items()}
    assert min(grown.values()) == pytest.approx(0.5, rel=0.02)
    assert grown == {k: keyframe.grown for k, keyframe in again._mapper.world.keyframes.items()}
    assert far_too_deep(again, ring) == pytest.approx(1.0, rel=0.02)


Damage = Callable[[Info, Arrays], tuple[Info, Arrays]]


@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (lambda info, arrays: (info | {"scale_sigma": -1.0}, arrays), "the map's scale_sigma is none"),
        (lambda info, arrays: (info | {"unit_of": [1]}, arrays), "the map's units are not of"),
        (lambda info, arrays: (info, without(arrays, "keyframe")), "a keyframe's record has no 'keyframe'"),
        (lambda info, arrays: (info, without(arrays, "depths")), "a keyframe's record has no 'depths'"),
        (lambda info, arrays: (info, arrays | {"depths": np.array(3.0)}), "a keyframe's record is none"),
    ],
)
def test_a_record_that_can_not_be_read_costs_what_came_since_and_no_more(
    damage: Damage,
    why: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    teller, told = keyframes(6)
    bus, made = life(tmp_path)
    hear(made, bus, told[:5], teller)
    recorded = made._keeper._record
    monkeypatch.setattr(
        made._keeper, "_record", lambda *a: map_file.pack(*damage(*map_file.unpack(recorded(*a))))
    )
    hear(made, bus, told[5:], teller)
    assert len(made._mapper.world.keyframes) == 6
    _, again = life(tmp_path, 1)
    assert len(again._mapper.world.keyframes) == 5
    assert f"what came since then is left out, it can't be read: {why}" in caplog.text


def without(arrays: Arrays, name: str) -> Arrays:
    return {key: array for key, array in arrays.items() if key != name}


@pytest.mark.parametrize("growth", [3, [[7]], [[7, 0.0]], [[7, "2"]], [["7", 2.0]], [[7, float("1e400")]]])
def test_a_growth_that_can_not_be_is_refused(growth: object) -> None:
    assert growth_told(growth_info({7: 2.0, 9: 0.5})) == {7: 2.0, 9: 0.5}
    assert growth_told({}) == {}, "an earlier build's"
    with pytest.raises(MapError, match="part_growth"):
        growth_told({"part_growth": growth})
