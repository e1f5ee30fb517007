"""What subscribers get from a running daemon: late joiners, the tree of frames, and `watch`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
import zenoh

from prism_edge.bus import ros
from prism_edge.evaluation.trajectory import read_tum
from prism_edge.topics import TOPICS
from tests.end_to_end.processes import DEADLINE_S, Daemon, prism_edge, rows
from tests.waiting import until


@pytest.fixture(scope="module")
def running(
    long_room: Path, camera: Path, network: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Daemon]:
    """A daemon that has been publishing for a while."""
    with ExitStack() as stack:
        log = tmp_path_factory.mktemp("subscribers") / "daemon.log"
        daemon = stack.enter_context(Daemon(log, long_room, "--camera", camera, "--model", network))
        daemon.until_ready()
        with daemon.bus() as bus:
            poses = bus.queue("pose", 1024)
            # A frame's status is told after its pose: with the second pose that of the first is out.
            for which in ("a pose", "another pose"):
                until(lambda: poses.take(0.1), which)
        yield daemon


@pytest.fixture
def session(running: Daemon) -> Iterator[zenoh.Session]:
    """A plain Zenoh client that knows the endpoint and nothing else."""
    settings = {"mode": "client", "connect": {"endpoints": [running.config.bus.endpoint]}}
    with zenoh.open(zenoh.Config.from_json5(json.dumps(settings))) as session:
        yield session


@pytest.mark.parametrize("topic", ["status", "scale", "tf", "health"])
def test_a_late_joiner_is_told_the_last_value(topic: str, session: zenoh.Session) -> None:
    def answers() -> list[zenoh.Sample]:
        return [reply.ok for reply in session.get(f"prism/robot/{topic}", timeout=DEADLINE_S) if reply.ok]

    def state() -> str:
        return str(ros.deserialise(ros.DIAGNOSTICS, answers()[0].payload.to_bytes()).status[0].message)

    if topic == "status":  # where the machine stood still the camera has jumped, and is looked for
        until(lambda: state() in ("ok building", "degraded building"), "it tracks")
    replies = until(answers, "an answer")  # a scale that is known is said a moment later
    assert len(replies) == 1
    kind = TOPICS[topic].type
    assert isinstance(kind, str)
    assert str(replies[0].encoding) == f"application/cdr;{kind}"
    message = ros.deserialise(kind, replies[0].payload.to_bytes())
    if topic == "tf":
        names = [(link.header.frame_id, link.child_frame_id) for link in message.transforms]
        assert names == [("map", "odom"), ("odom", "base_link"), ("base_link", "camera_optical")]
    elif topic == "scale":
        assert message.metric
        assert message.scale == pytest.approx(1.0, rel=0.3)
    elif topic == "status":
        assert message.status[0].name == "tracking"
    else:
        assert rows(message).keys() == {"supervisor", "source", "tracker", "depth", "scale", "backend"}


def test_pose_odom_and_tf_of_a_frame_say_the_same(running: Daemon) -> None:
    with running.bus() as bus:
        inboxes = {name: bus.queue(name, 1024) for name in ("pose", "odom", "tf")}
        heard: dict[str, dict[int, object]] = {name: {} for name in inboxes}

        def together() -> list[int]:
            for name, inbox in inboxes.items():
                for message in inbox.drain():
                    stamped = message.transforms[0] if name == "tf" else message
                    heard[name][ros.stamp_ns(stamped)] = message
            return sorted(set.intersection(*(set(messages) for messages in heard.values())))

        stamps = until(lambda: found if len(found := together()) >= 10 else None, "ten frames")
    for stamp in stamps:
        pose = ros.pose_matrix(heard["pose"][stamp].pose.pose)
        odom = ros.pose_matrix(heard["odom"][stamp].pose.pose)
        links = heard["tf"][stamp].transforms
        map_odom, odom_base, mount = (ros.pose_matrix(link.transform) for link in links)
        np.testing.assert_allclose(odom_base, odom, atol=1e-9)
        np.testing.assert_allclose(map_odom @ odom_base, pose, atol=1e-9)
        np.testing.assert_allclose(mount[:3, :3] @ [0, 0, 1], [1, 0, 0], atol=1e-12)  # camera looks ahead
        covariance = np.array(heard["pose"][stamp].pose.covariance).reshape(6, 6)
        assert np.linalg.eigvalsh(covariance).min() >= -1e-12


def test_every_process_holds_its_liveliness_token(session: zenoh.Session) -> None:
    replies = session.liveliness().get("prism/robot/alive/*", timeout=DEADLINE_S)
    names = {str(reply.ok.key_expr).rsplit("/", 1)[1] for reply in replies if reply.ok}
    assert names >= {"supervisor", "source", "tracker", "depth", "scale", "backend"}


def test_watch_prints_poses_and_records_them(running: Daemon, tmp_path: Path) -> None:
    file = tmp_path / "watched.tum"
    endpoint = running.config.bus.endpoint
    # `scale` comes with keyframes, of which a moving camera makes one in 45 frames at least.
    done = prism_edge("watch", "--plain", "--count", "60", "--tum", file, "--endpoint", endpoint)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 60
    tracked = [line for line in lines if "state ok building" in line]  # not all, where it was lost a while
    assert any("scale 1." in line or "scale 0.9" in line for line in tracked)
    recorded = read_tum(file)
    assert len(recorded) == 60
    assert (np.diff(recorded.stamps) > 0).all()
