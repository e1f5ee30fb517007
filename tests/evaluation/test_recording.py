"""What follows from a run that was written down by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from prism_edge.evaluation.recording import Published, Recording
from prism_edge.evaluation.trajectory import NS
from prism_edge.geometry.poses import se3_exp
from prism_edge.messages import DEGRADED, INITIALISING, LOST, OK, EndOfStream, MapSnapshot, Tracked

PERIOD = NS // 30


def frame(index: int, state: str = OK, reference: int = 0, published: bool = True) -> Tracked:
    return Tracked(
        index, index * PERIOD, 10 * NS + index * PERIOD, state, published, -1, reference, np.eye(4), 0
    )


def pose(index: int, late_ms: float = 8.0) -> Published:
    at = np.eye(4)
    at[0, 3] = index
    return Published(index * PERIOD, 10 * NS + index * PERIOD + round(late_ms * 1e6), at)


def snapshot(poses: dict[int, np.ndarray], log_scale: float) -> MapSnapshot:
    ids = np.array(list(poses), dtype=np.int64)
    stacked = np.array(list(poses.values())).reshape(-1, 4, 4)
    return MapSnapshot(0, 1, True, log_scale, ids, stacked, np.zeros(0, dtype=np.int64))


def test_counts_of_a_run() -> None:
    states = [INITIALISING, OK, DEGRADED, LOST, OK, OK]
    # frame 0 was dropped
    frames = [frame(i, state, published=state in (OK, DEGRADED)) for i, state in enumerate(states, 1)]
    recording = Recording(
        [pose(i) for i in (2, 3, 5)],
        frames,
        [20 * NS + i * NS // 25 for i in range(6)],
        EndOfStream(frames=9, released=7, duplicates=2, unreadable=1, last_index=6),
    )
    flow = recording.flow(first_stamp_ns=0)
    assert (flow["frames"], flow["tracked"], flow["coverage"]) == (9, 3, pytest.approx(3 / 9))
    assert flow["first_pose_s"] == pytest.approx(2 / 30)
    assert flow["fps"] == pytest.approx(25.0)
    assert (flow["dropped_frames"], flow["duplicate_frames"], flow["unreadable_frames"]) == (2, 2, 1)
    assert flow["states"] == {"degraded": 1, "initialising": 1, "lost": 1, "ok": 3}
    assert recording.violations() == []
    assert recording.flow(first_stamp_ns=None)["first_pose_s"] == pytest.approx(1 / 30)


def test_latency_is_from_scheduled_capture_to_arrival() -> None:
    recording = Recording([pose(i, late_ms=i) for i in range(101)], [frame(i) for i in range(101)])
    percentiles = recording.flow(0)["latency_ms"]
    assert percentiles == {"p50": pytest.approx(50), "p95": pytest.approx(95), "p99": pytest.approx(99)}


def test_a_pose_without_its_frame_has_no_latency_but_is_live() -> None:
    recording = Recording([pose(0), pose(9)], [frame(0)])
    assert len(recording.latencies_ms()) == 1
    assert len(recording.live()) == 2


def test_an_empty_run_has_no_numbers() -> None:
    flow = Recording(end=EndOfStream(0, 0, 0, 0, -1)).flow(None)
    assert flow["coverage"] is flow["fps"] is flow["first_pose_s"] is None
    assert flow["latency_ms"] == {"p50": None, "p95": None, "p99": None}


@pytest.mark.parametrize("published", [True, False])
def test_a_pose_while_lost_is_a_violation_whoever_admits_it(published: bool) -> None:
    heard = [] if published else [pose(4)]
    (violation,) = Recording(heard, [frame(3), frame(4, LOST, published=published)]).violations()
    assert "while lost" in violation
    assert "frame 4" in violation


def test_a_pose_that_is_no_number_is_a_violation_and_not_in_the_file() -> None:
    broken = Published(5 * PERIOD, 0, np.full((4, 4), np.nan))
    recording = Recording([pose(4), broken], [frame(4), frame(5)])
    assert "not finite" in recording.violations()[0]
    assert len(recording.live()) == 1


def test_final_poses_are_carried_by_their_keyframes_in_metres() -> None:
    rng = np.random.default_rng(2)
    world_from_keyframe, keyframe_from_camera = se3_exp(rng.normal(size=6)), se3_exp(rng.normal(size=6))
    map_from_world = se3_exp(rng.normal(size=6))
    carried = Tracked(1, PERIOD, 0, OK, True, -1, 7, keyframe_from_camera, 0)
    recording = Recording(
        [pose(0), pose(1), pose(2), pose(3)],
        [frame(0, reference=3), carried, frame(2, LOST, 3), frame(3, reference=5), frame(4, reference=3)],
    )
    final, missing = recording.final(
        snapshot({3: np.eye(4), 7: world_from_keyframe}, np.log(2.0)), map_from_world
    )
    # frame 2 was lost, the keyframe of 3 is gone, and 4 has never arrived
    assert final.stamps.tolist() == [0, PERIOD]
    assert missing == 1
    centre = (world_from_keyframe @ keyframe_from_camera @ [0, 0, 0, 1])[:3]
    expected = map_from_world[:3, :3] @ (2.0 * centre) + map_from_world[:3, 3]
    np.testing.assert_allclose(final.positions[1], expected, atol=1e-12)
    turned = map_from_world[:3, :3] @ world_from_keyframe[:3, :3] @ keyframe_from_camera[:3, :3]
    assert Rotation.from_matrix(final.poses[1, :3, :3] @ turned.T).magnitude() < 1e-9


def test_frames_of_a_part_that_a_loop_has_joined_since_are_in_the_finished_map() -> None:
    """They had no pose as they came; what they lie from their keyframe is in the part's unit of then."""
    there, offset = se3_exp(np.array([1.0, 2.0, 3.0, 0.1, -0.2, 0.3])), np.eye(4)
    offset[0, 3] = 0.4
    then = [Tracked(i, i * PERIOD, 0, OK, i > 2, -1, k, offset) for i, k in ((1, 7), (2, 8), (3, 7), (4, 9))]
    taken = replace(
        snapshot({3: np.eye(4), 7: there, 8: there, 9: there}, np.log(2.0)),
        away=np.array([8, 9]),
        grown=np.array([1.0, 1.5, 1.0, 1.0]),
    )
    recording = Recording([pose(0), pose(3), pose(4)], [frame(0, reference=3), *then])
    final, missing = recording.final(taken, np.eye(4))
    # 2 is of a part that nothing has joined; so would 4 be, whose pose was published all the same
    assert final.stamps.tolist() == [0, PERIOD, 3 * PERIOD]
    assert missing == 1
    for at, unit in ((1, 1.5), (2, 1.0)):
        centre = there[:3, :3] @ [0.4 * unit, 0, 0] + there[:3, 3]
        np.testing.assert_allclose(final.positions[at], 2.0 * centre, atol=1e-12)


def test_of_two_poses_of_one_stamp_the_first_counts() -> None:
    """It is what a subscriber acted on."""
    recording = Recording([pose(1, late_ms=8.0), pose(2), pose(1, late_ms=90.0)], [frame(1), frame(2)])
    assert recording.published[PERIOD].arrival_ns == pose(1, late_ms=8.0).arrival_ns
