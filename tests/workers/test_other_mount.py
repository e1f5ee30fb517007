"""A map is where its maker's base began, also for who takes it up with the camera elsewhere on the robot."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from prism_edge.backend import map_file
from prism_edge.backend.map_mount import FIELD
from prism_edge.bus import ros
from prism_edge.config import Config, FramesConfig, StateConfig, TrackingConfig
from prism_edge.errors import MapError
from prism_edge.geometry.mount import base_from_camera
from prism_edge.geometry.poses import inverse, se3_exp
from prism_edge.messages import OK, Keyframe, MapLoaded, WholeMap
from prism_edge.topics import TOPICS
from prism_edge.tracking.drift import Walk
from prism_edge.tracking.odometry import MetricOdometry
from prism_edge.tracking.tracker import FrameResult
from prism_edge.workers import backend
from prism_edge.workers.pose_publisher import PosePublisher
from prism_edge.workers.state_directory import map_path
from tests.tracking.footage import footage
from tests.workers.backend_bench import CONFIG as BENCH
from tests.workers.backend_bench import hear, keyframes, snapshot
from tests.workers.list_bus import ListBus
from tests.workers.test_map_adoption import AFTER, BUILT, DRIFT, Asked
from tests.workers.test_pose_publisher import COVARIANCE, STAMP
from tests.workers.test_recovered_run import Next, Runs
from tests.workers.tracker_bench import CONFIG, World, frame, run

# As the map's maker had the camera, tilted and aside, and as it is now.
THEIRS = FramesConfig(
    base_from_camera_xyz=(0.3, -0.1, 0.5),
    base_from_camera_xyzw=(-0.7303984, 0.4216957, -0.2686498, 0.4653151),
)
OURS = FramesConfig(base_from_camera_xyz=(-0.2, 0.4, 0.1), base_from_camera_xyzw=(-0.4, 0.5, -0.55, 0.53))
MADE_WITH, NOW = base_from_camera(THEIRS), base_from_camera(OURS)

twists = arrays(np.float64, 6, elements=st.floats(-3.0, 3.0))


def published(frames: FramesConfig, pose: np.ndarray, odom: np.ndarray, mount: np.ndarray | None) -> dict:
    """The messages of one frame in a map that was begun with a mount, as they arrive."""
    sent: dict = {}
    bus = SimpleNamespace(
        publish=lambda topic, message: sent.update({topic: message}),
        publish_if_heard=lambda topic, make: sent.update({topic: make()}),
    )
    result = FrameResult(OK, pose, COVARIANCE, 0, np.eye(4), 100)
    walked, drift = np.array([0.3, -0.2, 0.9]), Walk(0.01, 0.002)
    odometry = MetricOdometry()
    odometry.odom_from_camera, odometry.twist, odometry.interval_s = odom, np.arange(6.0), 0.1
    PosePublisher(bus, frames).publish(  # type: ignore[arg-type]
        STAMP, result, odometry, 0.4, 0.05, walked, drift, drift, mount
    )
    return {
        topic: ros.deserialise(TOPICS[topic].type, ros.serialise(TOPICS[topic].type, message))
        for topic, message in sent.items()
    }


@given(twists, twists, twists, twists)
def test_a_pose_is_the_maker_s_mount_the_camera_s_way_and_ours_taken_off(
    theirs: np.ndarray, ours: np.ndarray, way: np.ndarray, elsewhere: np.ndarray
) -> None:
    made_with, now = se3_exp(theirs), se3_exp(ours)
    x, y, z, w = ros_quaternion(now)
    frames = FramesConfig(base_from_camera_xyz=tuple(now[:3, 3]), base_from_camera_xyzw=(x, y, z, w))
    pose, odom = se3_exp(way), se3_exp(elsewhere)
    sent, plain = (published(frames, pose, odom, mount) for mount in (made_with, None))
    metric = pose.copy()
    metric[:3, 3] *= np.exp(0.4)
    in_map = ros.pose_matrix(sent["pose"].pose.pose)
    np.testing.assert_allclose(in_map, made_with @ metric @ np.linalg.inv(now), atol=1e-8)
    # `odom` knows nothing of it, and the tree joins both.
    assert raw(sent, "odom") == raw(plain, "odom")
    map_odom, odom_base, base_camera = (ros.pose_matrix(t.transform) for t in sent["tf"].transforms)
    np.testing.assert_allclose(map_odom @ odom_base, in_map, atol=1e-8)
    np.testing.assert_allclose(map_odom @ odom_base @ base_camera, made_with @ metric, atol=1e-8)
    # It is the same error of the same base, told along the axes of the other map.
    turned = np.kron(np.eye(2), (made_with @ np.linalg.inv(now))[:3, :3])
    expected = turned @ np.reshape(plain["pose"].pose.covariance, (6, 6)) @ turned.T
    np.testing.assert_allclose(np.reshape(sent["pose"].pose.covariance, (6, 6)), expected, atol=1e-9)


def raw(sent: dict, topic: str) -> bytes:
    return bytes(ros.serialise(TOPICS[topic].type, sent[topic]))


def ros_quaternion(pose: np.ndarray) -> tuple[float, float, float, float]:
    turn = ros.pose_with_covariance(STAMP, "map", pose, np.eye(6)).pose.pose.orientation
    return turn.x, turn.y, turn.z, turn.w


@given(twists, twists)
def test_the_same_mount_changes_no_digit(way: np.ndarray, elsewhere: np.ndarray) -> None:
    pose, odom = se3_exp(way), se3_exp(elsewhere)
    given_it, plain = (published(OURS, pose, odom, mount) for mount in (NOW.copy(), None))
    assert all(raw(given_it, topic) == raw(plain, topic) for topic in ("pose", "odom", "tf"))


# -- from the maker's run to ours, through a file ---------------------------------------------------


def config_of(folder: Path, frames: FramesConfig) -> Config:
    state = StateConfig(directory=str(folder), journal=False)
    return replace(CONFIG, frames=frames, state=state)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state directory with the map `lab` of the film's first half, made with the maker's mount."""
    folder = tmp_path_factory.mktemp("state")
    config, bus, beside = config_of(folder, THEIRS), ListBus("frame"), ListBus("keyframe")
    World(bus)
    run(bus, [frame(i) for i in BUILT], config)
    made = backend.BackendWorker(config, beside)
    for keyframe in bus.of("keyframe"):
        made._absorb(keyframe)
    assert made._save_map("lab").ok
    return folder


@pytest.fixture
def taken_up(folder: Path) -> tuple[backend.BackendWorker, WholeMap]:
    """Our backend, which has loaded it, and what it has for our tracker."""
    made = backend.BackendWorker(config_of(folder, OURS), ListBus("keyframe"))
    reply = made._load_map("lab")
    assert "camera elsewhere on the robot" in reply.said
    whole = made._keeper.whole(made._home_scale)
    assert whole is not None
    return made, whole


def off_by(bus: ListBus, made_with: np.ndarray) -> list[float]:
    """Metres from each published pose to the true one: of our base, in a map begun with a mount."""
    film, errors = footage(), []
    index = {film.stamp_ns(i): i for i in range(len(film.poses))}
    for message in bus.of("pose"):
        true = made_with @ film.poses[index[ros.stamp_ns(message)]] @ inverse(NOW)
        found = ros.pose_matrix(message.pose.pose)
        errors.append(float(np.linalg.norm((found - true)[:3, 3])))
        assert np.abs((found - true)[:3, :3]).max() < 0.05
    return errors


def tracked(life: Asked, frames: range = AFTER) -> list[Keyframe]:
    run(life.bus, [frame(i) for i in frames], replace(CONFIG, frames=OURS))
    return life.bus.of("keyframe")


def test_poses_in_a_loaded_map_are_those_of_our_base(
    taken_up: tuple[backend.BackendWorker, WholeMap], folder: Path
) -> None:
    made, whole = taken_up
    life = Asked(whole, life=0)
    life.bus.give("map_loaded", MapLoaded(whole.epoch, 0.0, 0.05))
    told = tracked(life)
    errors = off_by(life.bus, MADE_WITH)
    assert len(errors) >= len(AFTER) - 5
    assert np.median(errors) < DRIFT
    # `odom` begins where our base is.
    np.testing.assert_allclose(ros.pose_matrix(life.bus.of("odom")[0].pose.pose), np.eye(4), atol=0.02)
    # The map is still its maker's in all that is told of it, and kept.
    assert told
    assert all(np.array_equal(k.base_from_camera, MADE_WITH) for k in told)
    made._absorb(told[0])
    made._show()
    np.testing.assert_array_equal(made._snapshot.base_from_camera, MADE_WITH)
    assert made._save_map("again").ok
    info, _ = map_file.unpack(map_path(config_of(folder, OURS).state, "again").read_bytes())
    assert info[FIELD] == MADE_WITH.tolist()


def test_a_tracker_that_was_started_again_goes_on_in_it(
    taken_up: tuple[backend.BackendWorker, WholeMap]
) -> None:
    life = Asked(taken_up[1], life=1)
    tracked(life)
    assert np.median(off_by(life.bus, MADE_WITH)) < DRIFT


def test_a_run_that_goes_on_where_one_was_cut_off_does_too(
    taken_up: tuple[backend.BackendWorker, WholeMap], tmp_path: Path
) -> None:
    life = Next(replace(taken_up[1], epoch=0), tmp_path)
    tracked(life)
    assert np.median(off_by(life.bus, MADE_WITH)) < DRIFT


def test_a_backend_that_lost_the_map_hears_its_mount_again(
    taken_up: tuple[backend.BackendWorker, WholeMap], tmp_path: Path
) -> None:
    """Without a journal it goes on with what the tracker says from then on, in the tracker's coordinates."""
    life = Asked(taken_up[1], life=1)
    made = backend.BackendWorker(config_of(tmp_path, OURS), ListBus("keyframe"))
    for keyframe in tracked(life):
        made._absorb(keyframe)
    made._show()
    np.testing.assert_array_equal(made._snapshot.base_from_camera, MADE_WITH)


def test_a_new_map_is_ours(taken_up: tuple[backend.BackendWorker, WholeMap]) -> None:
    life = Asked(taken_up[1], life=1)
    life.bus.desk.ask("reset")
    told = tracked(life, range(40))
    assert told
    assert all(np.array_equal(k.base_from_camera, NOW) for k in told)
    assert np.median(off_by(life.bus, NOW)) < DRIFT


# -- files of earlier builds, and damaged ones ------------------------------------------------------


def rewrite(path: Path, change: dict[str, object]) -> None:
    """A map with other plain values, or without one that is None, and a checksum that is right."""
    known, stored = map_file.unpack(path.read_bytes())
    known = {name: value for name, value in {**known, **change}.items() if value is not None}
    path.write_bytes(map_file.pack(known, stored))


def saved(folder: Path) -> tuple[backend.BackendWorker, Path]:
    """A backend of ours with four keyframes, and the file of a map with three by the same mount."""
    state = StateConfig(directory=str(folder), journal=False)
    tracking = TrackingConfig(levels=8, scale_factor=1.2)
    bus = ListBus("keyframe")
    made = backend.BackendWorker(replace(BENCH, state=state, tracking=tracking, frames=OURS), bus)
    teller, told = keyframes(4)
    told = [replace(k, base_from_camera=NOW) for k in told]
    hear(made, bus, told[:3], teller)
    assert made._save_map("lab").ok
    hear(made, bus, told[3:], teller)
    return made, map_path(state, "lab")


@pytest.mark.parametrize(
    ("change", "said"),
    [({}, ""), ({FIELD: None}, "the present one is taken"), ({FIELD: MADE_WITH.tolist()}, "elsewhere")],
)
def test_the_reply_says_what_became_of_it(tmp_path: Path, change: dict[str, object], said: str) -> None:
    made, path = saved(tmp_path)
    rewrite(path, change)
    reply = made._load_map("lab")
    assert said in reply.said
    assert ("robot" in reply.said) == bool(said)
    np.testing.assert_array_equal(made._snapshot.base_from_camera, MADE_WITH if said == "elsewhere" else NOW)


def test_a_mount_that_can_not_be_leaves_the_present_map(tmp_path: Path) -> None:
    made, path = saved(tmp_path)
    rewrite(path, {FIELD: np.zeros((4, 4)).tolist()})
    with pytest.raises(MapError, match=FIELD):
        made._load_map("lab")
    assert len(made._mapper.world.keyframes) == 4
    np.testing.assert_array_equal(made._mapper.mount, NOW)


def test_the_tracker_takes_no_such_map_up(
    taken_up: tuple[backend.BackendWorker, WholeMap], caplog: pytest.LogCaptureFixture
) -> None:
    info, stored = map_file.unpack(taken_up[1].data.tobytes())
    data = map_file.pack({**info, FIELD: [1.0]}, stored)
    life = Asked(replace(taken_up[1], data=np.frombuffer(data, np.uint8)), life=1)
    told = tracked(life, range(20))
    assert "can't be gone on in" in caplog.text
    assert all(np.array_equal(k.base_from_camera, NOW) for k in told)


@pytest.mark.parametrize("known", [True, False])
def test_a_run_that_was_cut_off_leaves_its_mount_in_the_journal(
    tmp_path: Path, known: bool, caplog: pytest.LogCaptureFixture
) -> None:
    runs = Runs(tmp_path, replace(BENCH, frames=THEIRS))
    teller, told = keyframes(6)
    told = [replace(k, base_from_camera=MADE_WITH) for k in told]
    runs.backend(told[:5], teller)
    if not known:
        rewrite(tmp_path / "state" / "journal" / "base", {FIELD: None})
    expected = MADE_WITH if known else NOW
    for _ in range(2):  # and what our own run leaves, when it is cut off too
        after = snapshot(runs.backend([], teller, goes_on=True, frames=OURS))
        assert len(after.keyframes) == 5
        np.testing.assert_array_equal(after.base_from_camera, expected)
        assert ("elsewhere" if known else "the present one is taken") in caplog.text
    again = runs.backend([replace(told[5], epoch=0)], teller, goes_on=True, again=True, frames=OURS)
    np.testing.assert_array_equal(snapshot(again).base_from_camera, expected)
    caplog.clear()
    life = runs.backend([], teller, life=1, again=True, frames=OURS)
    np.testing.assert_array_equal(snapshot(life).base_from_camera, expected)
    assert "that was left" not in caplog.text, "it is this run's own by now"


def test_a_journal_with_a_mount_that_can_not_be_is_none(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    runs = Runs(tmp_path, BENCH)
    teller, told = keyframes(4)
    runs.backend(told, teller)
    runs.rewrite(**{FIELD: "askew"})
    assert len(snapshot(runs.backend([], teller, goes_on=True)).keyframes) == 0
    assert FIELD in caplog.text
