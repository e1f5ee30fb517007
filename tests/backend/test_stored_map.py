"""A map becomes arrays and the same map again; arrays that no map would give are refused."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from prism_edge.backend import map_file, stored_map
from prism_edge.backend.global_map import GlobalMap
from prism_edge.backend.map_file import Arrays, Info
from prism_edge.backend.stored_map import from_arrays, to_arrays
from prism_edge.backend.window import choose_window, solve
from prism_edge.config import BackendConfig
from prism_edge.errors import MapError
from prism_edge.geometry.cameras import Camera
from prism_edge.tracking.place_index import PlaceIndex
from tests.backend.world import Teller, check, poses_of
from tests.tracking.cloud import pose_at


def example() -> tuple[GlobalMap, PlaceIndex]:
    """Eight keyframes, of which one was culled; depth on some, a place descriptor for each."""
    world, index, teller = GlobalMap(), PlaceIndex(), Teller(noise_px=0.5)
    rng = np.random.default_rng(3)
    for i, pose in enumerate(pose_at(0.1 * i) for i in range(8)):
        message = teller.keyframe(pose)
        added = world.absorb(message)
        if i % 2:
            added.depths = message.depths.astype(np.float64)
            added.weights = rng.random(len(added.pixels))
            added.weights[::5] = np.nan
            added.depth_sigma = 0.01 * i  # a sensor's
        else:
            added.depth_units = 1.0 + 0.1 * i  # of a network's
        index.add(added.id, rng.normal(size=16).astype(np.float32), "some network")
    world._forget_keyframe(3)
    index.remove(3)
    return world, index


EXAMPLE = example()
STORED = map_file.unpack(map_file.pack(*to_arrays(*EXAMPLE)))
IN_USE = map_file.unpack(map_file.pack(*to_arrays(*EXAMPLE, in_use=True)))
EXISTING = int(IN_USE[1]["points"][0])
OF_KEYFRAMES = ("poses", "scale_factors", "travelled", "depth_sigmas")


def test_every_part_of_the_map_comes_back() -> None:
    world, index = EXAMPLE
    again, places = from_arrays(*STORED, max_carried=100)
    assert places.network == "some network"
    assert list(again.keyframes) == list(world.keyframes)
    for number, keyframe in world.keyframes.items():
        found = again.keyframes[number]
        np.testing.assert_allclose(found.world_from_camera, keyframe.world_from_camera, atol=1e-12)
        np.testing.assert_array_equal(found.pixels, keyframe.pixels)
        np.testing.assert_array_equal(found.sigmas, keyframe.sigmas)
        np.testing.assert_array_equal(found.features.descriptors, keyframe.features.descriptors)
        np.testing.assert_array_equal(found.features.order, keyframe.features.order)
        assert found.observed == keyframe.observed
        assert found.index == keyframe.index
        assert found.camera == keyframe.camera
        assert found.travelled == keyframe.travelled
        assert found.depth_sigma == keyframe.depth_sigma
        if keyframe.depths is None:
            assert found.depths is None
            assert found.weights is None
        else:
            assert found.depths is not None
            np.testing.assert_allclose(found.depths, keyframe.depths, rtol=1e-6)
            assert found.weights is not None
            np.testing.assert_allclose(found.weights, keyframe.weights, rtol=1e-6)
    assert again.points.keys() == world.points.keys()
    for number, point in world.points.items():
        np.testing.assert_array_equal(again.points[number].position, point.position)
        assert again.points[number].keyframes == point.keyframes
    assert again.carried.ids.tolist() == world.carried.ids.tolist()
    for number, pose in poses_of(world).items():
        np.testing.assert_allclose(poses_of(again)[number], pose, atol=1e-12)
    for number in world.keyframes:
        np.testing.assert_allclose(places.get(number), index.get(number), atol=1e-6)
    assert 3 not in places


@pytest.mark.parametrize("culled", [0, 1])
def test_the_first_keyframe_of_all_may_be_carried_and_carry(culled: int) -> None:
    world, teller = GlobalMap(), Teller()
    for i in range(3):
        world.absorb(teller.keyframe(pose_at(0.1 * i)))
    world._forget_keyframe(culled)
    assert 0 in world.carried.numbers
    again, _ = from_arrays(*map_file.unpack(map_file.pack(*to_arrays(world, PlaceIndex()))), max_carried=100)
    np.testing.assert_array_equal(again.carried.numbers, world.carried.numbers)
    np.testing.assert_allclose(poses_of(again)[culled], poses_of(world)[culled], atol=1e-12)


def test_a_point_that_ran_off_stays_behind() -> None:
    world, index = example()
    far = next(iter(world.points))
    world.points[far].position = np.array([0.0, -3e9, 1.0])
    again, _ = from_arrays(*map_file.unpack(map_file.pack(*to_arrays(world, index))), max_carried=100)
    assert again.points.keys() == world.points.keys() - {far}
    assert not any(far in keyframe.observed for keyframe in again.keyframes.values())


def test_a_point_that_no_keyframe_sees_is_left_behind() -> None:
    world, _ = from_arrays(*changed("seen", lambda seen: np.where(seen == EXISTING, -1, seen)), max_carried=9)
    assert world.points.keys() == EXAMPLE[0].points.keys() - {EXISTING}
    check(world)


def test_a_sky_that_a_network_puts_too_far_away_is_left_out() -> None:
    world, index = example()
    keyframe = next(k for k in world.keyframes.values() if k.depths is not None)
    assert keyframe.depths is not None
    keyframe.depths[:3] = 1e10, 2.5, 1e9
    again, _ = from_arrays(*map_file.unpack(map_file.pack(*to_arrays(world, index))), max_carried=100)
    depths = again.keyframes[keyframe.id].depths
    assert depths is not None
    assert depths[:3].tolist() == [0.0, 2.5, 0.0]
    assert keyframe.depths[0] == 1e10, "here nothing has changed"


def test_what_comes_back_is_optimised_alike() -> None:
    config = BackendConfig()
    solved = []
    for world in (EXAMPLE[0], from_arrays(*STORED, max_carried=100)[0]):
        solution = solve(world, choose_window(world, 7, config), config, 1.0, False)
        assert solution is not None
        solved.append(solution)
    for number, pose in solved[0].poses.items():
        np.testing.assert_allclose(solved[1].poses[number], pose, atol=1e-6)


def test_what_comes_back_may_be_changed() -> None:
    again, _ = from_arrays(*STORED, max_carried=100)
    for keyframe in again.keyframes.values():
        keyframe.world_from_camera[0, 3] += 1.0
    for point in again.points.values():
        point.position[0] += 1.0
    assert to_arrays(again, PlaceIndex())[1]["positions"][0, 0] == STORED[1]["positions"][0, 0] + 1.0


def changed(name: str, change: Callable[[np.ndarray], Any]) -> tuple[Info, Arrays]:
    """The example with one array changed in place, or another in its stead."""
    info, arrays = IN_USE[0], {k: v.copy() for k, v in IN_USE[1].items()}
    result = change(arrays[name])
    if isinstance(result, np.ndarray):
        arrays[name] = result
    return info, arrays


def put(value: Any, at: Any = 0) -> Callable[[np.ndarray], None]:
    def change(array: np.ndarray) -> None:
        array[at] = value

    return change


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("keyframes", put(1, 0)),  # twice
        ("keyframes", put(-1)),
        ("keyframes", lambda a: a[:-1]),
        ("keyframes", lambda a: a.astype(np.float64)),
        ("poses", put(np.nan)),
        ("poses", put(2.0, (0, 0, 0))),  # no rotation
        ("poses", lambda a: a * (1, 1, 1, 1) * np.array([-1, -1, -1, 1])[:, None]),  # a mirror
        ("poses", put(1.0, (0, 3, 0))),
        ("poses", put(1e30, (0, 0, 3))),
        ("cameras", put(1)),
        ("cameras", put(-1)),
        ("scale_factors", put(0.0)),
        ("scale_factors", put(1e300)),
        ("travelled", put(np.inf)),
        ("starts", put(1)),
        ("starts", put(10**12, -1)),
        ("starts", put(10**6, 2)),
        ("pixels", put(np.nan)),
        ("octaves", put(200)),
        ("seen", put(10**9)),  # a point that is not there
        ("seen", put(-2)),
        ("depths", put(-1.0)),
        ("depth_sigmas", put(-0.01)),
        ("depth_sigmas", put(np.nan)),
        ("depth_sigmas", lambda a: a[:-1]),
        ("weights", put(1.5)),
        ("weights", put(np.nan)),
        ("points", lambda a: np.concatenate([a[1:2], a[1:]])),
        ("positions", put(np.inf)),
        ("parallax_deg", put(999.0)),
        ("made_by", put(-2)),
        ("made_by", lambda a: a[:-1]),
        ("depth_units", put(-1.0)),
        ("depth_units", put(np.nan)),
        ("grown", put(0.0)),
        ("grown", put(np.nan)),
        ("twists", put(np.nan)),
        ("twists", lambda a: a[:, :5]),
        ("renamed", lambda a: np.array([[9001, 9002], [9001, 9003]])),  # two names
        ("renamed", lambda a: np.array([[9001, 9002], [9002, 9001]])),  # round and round
        ("renamed", lambda a: np.array([[9001, -1]])),
        ("renamed", lambda a: np.array([[EXISTING, 9001]])),  # is there
        ("renamed", lambda a: np.array([9001, 9002])),
        ("carried", put(10**6, (0, 1))),  # hangs on nothing
        ("carried", put(1, (0, 0))),  # is there
        ("links", put(np.nan)),
        ("places", put(10**6)),
        ("places", lambda a: a[:-1]),
        ("place_descriptors", put(np.nan)),
        ("place_descriptors", put(0.0)),  # no direction
        ("place_descriptors", put(50.0)),
        ("descriptors", lambda a: a[:, :31]),
    ],
)
def test_values_that_can_not_be_are_refused(name: str, change: Callable[[np.ndarray], Any]) -> None:
    with pytest.raises(MapError) as caught:
        from_arrays(*changed(name, change), max_carried=100)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "cameras",
    [
        None,
        [],
        [5],
        [["pinhole", "x"]],
        [["nonsense", [640, 480, 500, 500, 320, 240]]],
        [["pinhole", [640, 480, -1, 500, 320, 240]]],
        [["pinhole", [1e9, 1e9, 500, 500, 320, 240]]],  # its grid would fill the memory
        [["pinhole", [[1], [2, 3]]]],
        [["pinhole", [10**400, 480, 500, 500, 320, 240]]],
    ],
    ids=lambda cameras: str(cameras)[:60],
)
def test_cameras_that_can_not_be_are_refused(cameras: Any) -> None:
    with pytest.raises(MapError):
        from_arrays({"cameras": cameras}, STORED[1], max_carried=100)


def test_places_that_no_network_has_described_are_refused() -> None:
    with pytest.raises(MapError):
        from_arrays({**STORED[0], "places_of": 5}, STORED[1], max_carried=100)


@pytest.mark.parametrize(
    ("keyframes", "side", "keypoints", "fits"),
    [(600, (3840, 2160), 0, True), (20_000, (3840, 2160), 1800, True), (200, (20_000, 20_000), 0, False)],
)
def test_a_map_takes_no_more_memory_than_what_is_in_it_can_be_worth(
    keyframes: int, side: tuple[int, int], keypoints: int, fits: bool
) -> None:
    arrays = {"cameras": np.zeros(keyframes, np.int64), "seen": np.zeros(keyframes * keypoints, np.uint8)}
    with nullcontext() if fits else pytest.raises(MapError, match="too much memory"):
        stored_map._check_room([Camera(*side, side[0], side[0], side[0] / 2, side[1] / 2)], arrays)


def test_a_small_file_of_huge_images_is_refused() -> None:
    info, arrays = STORED
    size, count = OF_KEYFRAMES, 200
    many = {name: np.repeat(arrays[name][:1], count, axis=0) for name in size}
    none = {name: array[:0] for name, array in arrays.items() if name not in (*size, "starts")}
    numbers = np.arange(count)
    held = {**none, **many, "keyframes": numbers, "indices": numbers, "starts": np.zeros(count + 1, np.int64)}
    cameras = [["pinhole", [20_000, 20_000, 20_000.0, 20_000.0, 10_000.0, 10_000.0]]]
    with pytest.raises(MapError, match="too much memory"):
        from_arrays({**info, "cameras": cameras}, {**held, "cameras": 0 * numbers}, max_carried=100)


def test_a_first_keyframe_without_points_is_a_map_and_nothing_at_all_is_none() -> None:
    world, told = GlobalMap(), Teller().keyframe(pose_at(0.0))
    none, nowhere = np.zeros(0, np.int64), np.zeros((0, 3))
    unseen = np.full(len(told.points), -1)
    world.absorb(replace(told, points=unseen, new_points=none, new_positions=nowhere, new_by=none))
    again, _ = from_arrays(*map_file.unpack(map_file.pack(*to_arrays(world, PlaceIndex()))), max_carried=1)
    assert list(again.keyframes) == [0]
    assert again.points == {}
    with pytest.raises(MapError, match="0 keyframes"):
        from_arrays(*to_arrays(GlobalMap(), PlaceIndex()), max_carried=1)


def test_a_missing_and_a_surplus_array_are_named() -> None:
    info, arrays = STORED
    with pytest.raises(MapError, match="the map has no octaves"):
        from_arrays(info, {k: v for k, v in arrays.items() if k != "octaves"}, max_carried=100)
    with pytest.raises(MapError, match="the map has more, which this version does not know"):
        from_arrays(info, {**arrays, "more": arrays["points"]}, max_carried=100)


def test_a_map_without_noise_of_its_depths_is_a_network_s_as_it_was_before_any_had_it() -> None:
    info, arrays = STORED
    old = {k: v for k, v in arrays.items() if k != "depth_sigmas"}
    world, index = from_arrays(info, old, max_carried=100)
    assert {k.depth_sigma for k in world.keyframes.values()} == {0.0}
    assert "depth_sigmas" not in to_arrays(world, index)[1], "which an earlier build can read"


def test_who_goes_on_with_a_map_knows_how_the_camera_moved() -> None:
    """A rolling shutter that is found later moves the keypoints of all keyframes, here and in the tracker."""
    world = GlobalMap()
    for i, twist in enumerate(([0.3, 0.0, -0.1, 0.0, 0.5, 0.2], [np.nan] * 6, [0.0] * 6)):
        world.absorb(replace(Teller(seed=i).keyframe(pose_at(0.2 * i)), id=i, twist=np.array(twist)))
    stored = map_file.unpack(map_file.pack(*to_arrays(world, PlaceIndex(), in_use=True)))
    again, _ = from_arrays(*stored, max_carried=100)
    assert [k.twist.tolist() for k in again.keyframes.values()] == [
        [0.3, 0.0, -0.1, 0.0, 0.5, 0.2], [0.0] * 6, [0.0] * 6,
    ]
    assert not again.readout_said
    world.readout_said = True  # or what is said of the readout would be overruled by what is found
    stored = map_file.unpack(map_file.pack(*to_arrays(world, PlaceIndex(), in_use=True)))
    assert from_arrays(*stored, max_carried=100)[0].readout_said


def test_who_goes_on_with_a_map_knows_points_by_the_names_that_they_had() -> None:
    """A loop has made them one, and the tracker, which has not heard of it, speaks of them as before."""
    teller, world = Teller(), GlobalMap()
    for i in range(5):
        world.absorb(teller.keyframe(pose_at(0.2 * i)))
    message = teller.keyframe(pose_at(0.9))
    first, second, third, fourth = [p for p in message.points.tolist() if p in world.points][:4]
    for gone, kept in ((first, second), (second, third)):
        world.fuse(gone, kept)
    stored = map_file.unpack(map_file.pack(*to_arrays(world, PlaceIndex(), in_use=True)))
    again, _ = from_arrays(*stored, max_carried=100)
    assert [again.present(p) for p in (first, second, third, fourth)] == [third, third, third, fourth]
    observed = again.absorb(message).observed
    assert observed == world.absorb(message).observed
    assert third in observed
    assert first not in observed
    check(again)
    saved = to_arrays(world, PlaceIndex())[1].keys()
    in_use = {"made_by", "depth_units", "renamed", "grown", "twists"}
    assert not in_use & saved, "which an earlier build can read"
    known, _ = from_arrays(*IN_USE, max_carried=100)
    assert [k.depth_units for k in known.keyframes.values()] == [1.0, 0.0, 1.2, 1.4, 0.0, 1.6, 0.0]
    again.keyframes[0].depth_units = 1e12  # before a lens cap, say: that is no reason to lose the map
    units = to_arrays(again, PlaceIndex(), in_use=True)[1]["depth_units"]
    assert units[0] == 0.0


@pytest.mark.parametrize("name", ["keyframes", "points"])
def test_a_number_that_no_factor_could_be_named_by_is_refused(name: str) -> None:
    info, arrays = STORED
    numbers = arrays[name].copy()
    last = numbers[-1]
    numbers[-1] = 2**56
    others = {k: np.where(arrays[k] == last, 2**56, arrays[k]) for k in ("seen", "places", "carried")}
    changed = {"seen"} if name == "points" else {"places", "carried"}
    with pytest.raises(MapError, match="can't be"):
        from_arrays(info, {**arrays, name: numbers, **{k: others[k] for k in changed}}, max_carried=100)


@given(st.data())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.too_slow])
def test_whatever_stands_in_the_arrays_it_is_a_map_or_an_error(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(sorted(STORED[1])))
    array = STORED[1][name].copy()
    flat = array.reshape(-1)
    at = data.draw(st.integers(0, len(flat) - 1))
    number = st.integers(0, 255) if array.dtype == np.uint8 else st.integers(-(2**40), 2**40)
    flat[at] = data.draw(number if array.dtype.kind in "iu" else st.floats(width=32))
    try:
        world, _ = from_arrays(STORED[0], {**STORED[1], name: array}, max_carried=100)
    except MapError:
        return
    assert np.isfinite(np.array(list(poses_of(world).values()))).all()
