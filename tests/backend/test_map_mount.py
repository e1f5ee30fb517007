"""The mount that a map was made with, in its file: exact, absent or refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from prism_edge.backend import map_file
from prism_edge.backend.map_mount import FIELD, difference, mount_info, mount_of
from prism_edge.backend.map_scale import KnownScale
from prism_edge.backend.mapper import Mapper
from prism_edge.config import BackendConfig
from prism_edge.errors import MapError
from prism_edge.geometry.poses import se3_exp
from prism_edge.messages import Keyframe
from tests.backend.world import Teller
from tests.tracking.cloud import pose_at

OURS, THEIRS = pose_at(0.1, 0.2, 0.3, 0.4), pose_at(0.3, -0.1, 0.5, 0.2, -0.7, 0.1)


def mapper_of(*mounts: np.ndarray) -> Mapper:
    """A map of as many keyframes, each of which says a mount."""
    made, teller = Mapper(BackendConfig()), Teller()
    for mount in mounts:
        made.absorb(told(teller, mount))
    return made


def told(teller: Teller, mount: np.ndarray) -> Keyframe:
    """Its next keyframe, of a map that was begun with a mount."""
    return replace(teller.keyframe(pose_at(0.2 * len(teller.poses))), base_from_camera=mount)


@given(arrays(np.float64, 6, elements=st.floats(-3.0, 3.0)))
def test_what_is_written_is_read_to_the_last_digit(twist: np.ndarray) -> None:
    mount = se3_exp(twist)
    info, _ = map_file.unpack(map_file.pack(mount_info(mount), {}))
    read = mount_of(info)
    assert read is not None
    assert read.tobytes() == mount.tobytes()
    assert difference(read, mount) == ""


def test_maps_of_earlier_builds_do_not_say() -> None:
    assert mount_of({}) is None
    assert "the present one is taken" in difference(None, OURS)
    assert "elsewhere" in difference(THEIRS, OURS)


def with_element(value: object, row: int = 0, column: int = 3) -> object:
    rows: list[list[object]] = [list(r) for r in np.eye(4).tolist()]
    rows[row][column] = value
    return rows


@pytest.mark.parametrize(
    "said",
    [
        None,
        5,
        "eye",
        [],
        {},
        [1.0] * 16,
        np.eye(3).tolist(),
        [[1.0, 0.0, 0.0]] * 4,
        np.eye(4, 3).tolist(),
        np.eye(4, 5).tolist(),
        [*np.eye(4).tolist()[:3], [0.0, 0.0, 0.0]],  # of rows that are not alike
        [5] * 4,
        ["1000"] * 4,
        with_element("0.3"),
        with_element(None),
        with_element(True),
        with_element([0.0]),
        with_element(10**400),
        with_element(1e308),
        with_element(float("nan")),  # which a file can't say, but another process might
        with_element(float("inf")),
        with_element(0.5, 3, 0),
        with_element(0.5, 0, 1),
        with_element(-1.0, 0, 0),  # a mirror
        (0.9 * np.eye(4)).tolist(),
        np.zeros((4, 4)).tolist(),
    ],
    ids=lambda said: str(said)[:30],
)
def test_what_is_no_mount_is_refused(said: object) -> None:
    with pytest.raises(MapError, match=FIELD):
        mount_of({FIELD: said})
    made = mapper_of(OURS, OURS)
    info, stored = made.stored()
    with pytest.raises(MapError, match=FIELD):
        made.restore({**info, **KnownScale().info, FIELD: said}, stored)
    assert len(made.world.keyframes) == 2, "the map that there was is kept"
    np.testing.assert_array_equal(made.mount, OURS)


def test_a_map_s_first_keyframe_says_it_and_no_other_does() -> None:
    np.testing.assert_array_equal(mapper_of(THEIRS, OURS).mount, THEIRS)
    again = mapper_of(THEIRS)
    again.absorb(told(Teller(epoch=1), OURS))
    np.testing.assert_array_equal(again.mount, OURS)


@pytest.mark.parametrize("says", [True, False])
def test_a_map_that_is_taken_up_keeps_its_own(says: bool) -> None:
    info, stored = mapper_of(THEIRS, THEIRS).stored()
    if not says:
        del info[FIELD]
    made = mapper_of(OURS)
    made.restore({**info, **KnownScale().info}, stored, 7, OURS)
    expected = THEIRS if says else OURS
    np.testing.assert_array_equal(made.mount, expected)
    made.absorb(told(Teller(epoch=7, first=10), OURS))
    assert made.stored()[0][FIELD] == expected.tolist()
