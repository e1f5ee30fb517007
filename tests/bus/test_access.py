"""Who may do what over the robot's network, tried with certificates of a lab made for the test."""

from __future__ import annotations

import shutil
import subprocess
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh

from prism_edge.bus import access, links, ros
from prism_edge.bus.access import check_network
from prism_edge.bus.commands import Reply, send
from prism_edge.bus.keys import alive_key, check_loopback, key, ready_key, run_key
from prism_edge.bus.links import open_session
from prism_edge.bus.session import Bus
from prism_edge.bus.vacancy import free_endpoint
from prism_edge.config import BusConfig, Config, NetworkConfig
from prism_edge.errors import BusError, ConfigError
from prism_edge.topics import COMMANDS, TOPICS
from tests.waiting import until

MAKE = Path(__file__).resolve().parents[2] / "deploy" / "make_certificates.sh"
STATUS = ros.diagnostics(1, [("tracking", 0, "ok building", {})])
BUS = "tcp/127.0.0.1:7447"
HEARTBEATS = "prism/robot/internal/heartbeat"

needs_openssl = pytest.mark.skipif(not shutil.which("openssl"), reason="no openssl here")


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab")
    ours = ("robot1,127.0.0.1", "viewer", "operator", "depth")
    for where, names in (("ours", ours), ("theirs", ("operator",))):
        subprocess.run([str(MAKE), str(folder / where), *names], check=True, timeout=60, capture_output=True)
    return folder


def shown(lab: Path, name: str, **settings: object) -> NetworkConfig:
    """Settings of somebody with a certificate of our lab."""
    ours = lab / "ours"
    pem, key = str(ours / f"{name}.pem"), str(ours / f"{name}.key")
    return NetworkConfig(ca=str(ours / "ca.pem"), certificate=pem, key=key, **settings)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def robot(lab: Path) -> Iterator[Config]:
    """A robot that publishes, beats and takes commands, on loopback and by TLS."""
    endpoint = free_endpoint().replace("tcp/", "tls/")
    network = shown(lab, "robot1", endpoint=endpoint, operators=("operator",), remote=("depth",))
    config = Config(bus=BusConfig(free_endpoint(), retry_ms=50), network=network)
    with (
        Bus.open(config, "supervisor", listen=True) as supervisor,
        Bus.open(config, "source") as source,
        Bus.open(config, "tracker") as tracker,
    ):
        desks = [
            source.commands({"pause": lambda argument: Reply(True, "done")}),
            supervisor.commands({"info": lambda argument: Reply(True, "well")}),
        ]
        tracker.pulse.ready()
        source.pulse.ready()
        assert supervisor.await_ready(["tracker", "source"], 10.0) == set()
        done = threading.Event()

        def work() -> None:
            while not done.wait(0.02):
                tracker.publish("status", STATUS)
                for desk in desks:
                    desk.serve()

        thread = threading.Thread(target=work)
        thread.start()
        yield config
        done.set()
        thread.join()


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who is not let in finds out soon."""
    monkeypatch.setattr(links, "_REACH_MS", 600)


def client(robot: Config, network: NetworkConfig) -> zenoh.Session:
    return open_session(BusConfig(robot.network.endpoint), listen=False, client=True, network=network)


def hears(session: zenoh.Session, keys: tuple[str, ...] = (), messages: int = 1) -> list[str]:
    """Keys of what comes on ``keys`` before so many messages of `status` have."""
    asked = [session.declare_subscriber(key, zenoh.handlers.RingChannel(256)) for key in keys]
    with session.declare_subscriber("prism/robot/status", zenoh.handlers.FifoChannel(256)) as status:
        for _ in range(messages):
            status.recv()
    found = []
    for subscriber in asked:
        while (sample := subscriber.handler.try_recv()) is not None:
            found.append(str(sample.key_expr))
        subscriber.undeclare()
    return found


@needs_openssl
class TestByCertificate:
    @pytest.mark.parametrize("name", ["viewer", "operator"])
    def test_everybody_of_the_lab_reads_what_is_public(self, robot: Config, lab: Path, name: str) -> None:
        with client(robot, shown(lab, name)) as session:
            hears(session)
            (last,) = [r.ok for r in session.get("prism/robot/status", timeout=10) if r.ok]
            assert ros.deserialise(ros.DIAGNOSTICS, last.payload.to_bytes()).status[0].name == "tracking"
            tokens = {str(r.ok.key_expr) for r in session.liveliness().get("prism/robot/alive/*", timeout=10)}
            assert "prism/robot/alive/tracker" in tokens

    @pytest.mark.parametrize("several", ["prism/robot/*", "prism/*/*", "prism/*/status"])
    def test_several_topics_at_once_are_read_as_each_is(self, robot: Config, lab: Path, several: str) -> None:
        with client(robot, shown(lab, "viewer")) as session:
            with session.declare_subscriber(several, zenoh.handlers.RingChannel(256)) as subscriber:
                until(lambda: subscriber.handler.try_recv() is not None)
            last = {str(r.ok.key_expr) for r in session.get(several, timeout=10) if r.ok}
            assert "prism/robot/status" in last
            assert not [key for key in last if key.count("/") > 2]

    def test_what_spans_more_than_is_public_hears_nothing(self, robot: Config, lab: Path) -> None:
        spans = ("prism/robot/**", "prism/**", "prism/robot/*/*", "prism/*/command/*", "**")
        # Another hears what it may meanwhile: one link hands on to all who listen behind it.
        viewer = shown(lab, "viewer")
        with client(robot, viewer) as session, client(robot, viewer) as other:
            asking = [session.declare_subscriber(key, zenoh.handlers.RingChannel(256)) for key in spans]
            hears(other, messages=60)
            assert not [s for s in asking if s.handler.try_recv() is not None]
            for asked in spans:
                assert not [r for r in session.get(asked, timeout=1) if r.ok]

    def test_an_operator_commands(self, robot: Config, lab: Path) -> None:
        with client(robot, shown(lab, "operator")) as session:
            for name in ("pause", "info"):
                assert send(session, "robot", COMMANDS[name], None, 10.0).ok

    @pytest.mark.parametrize(
        ("name", "command"), [("viewer", "pause"), ("viewer", "info"), ("depth", "pause")]
    )
    def test_nobody_else_does(self, robot: Config, lab: Path, name: str, command: str) -> None:
        with client(robot, shown(lab, name)) as session:
            hears(session)  # it is linked, and heard
            with pytest.raises(BusError, match="may you command it"):
                send(session, "robot", COMMANDS[command], None, 0.5)

    @pytest.mark.parametrize("name", ["viewer", "operator", "depth"])
    def test_internal_topics_stay_on_the_host(self, robot: Config, lab: Path, name: str) -> None:
        with client(robot, shown(lab, name)) as session:
            keys = (f"{HEARTBEATS}/*", "prism/robot/internal/**", "**")
            # two heartbeats of each process at least, at fifty messages a second
            assert not [k for k in hears(session, keys, 60) if "/internal/" in k]

    @pytest.mark.parametrize(("name", "seen"), [("depth", True), ("viewer", False), ("operator", False)])
    def test_only_a_remote_process_sees_which_run_it_is(
        self, robot: Config, lab: Path, name: str, seen: bool
    ) -> None:
        with client(robot, shown(lab, name)) as session:
            hears(session)
            runs = list(session.liveliness().get(run_key("robot", "*"), timeout=3 if seen else 1))
            assert bool([reply for reply in runs if reply.ok]) == seen

    def test_only_a_remote_process_says_what_it_says(self, robot: Config, lab: Path) -> None:
        on_host = BusConfig(robot.bus.endpoint)
        with open_session(on_host, listen=False, client=True) as here:
            with here.declare_subscriber(f"{HEARTBEATS}/*", zenoh.handlers.RingChannel(1000)) as heard:
                for name in ("viewer", "operator", "depth"):
                    with client(robot, shown(lab, name)) as session:
                        hears(session)
                        for process in ("depth", "tracker"):
                            session.put(f"{HEARTBEATS}/{process}", f"{name} as {process}".encode())
                        session.put("prism/robot/status", name.encode())
                        hears(session, messages=20)
                payloads = []
                while (sample := heard.handler.try_recv()) is not None:
                    payloads.append(sample.payload.to_bytes())
            assert [said for said in payloads if b" as " in said[:20]] == [b"depth as depth"]

    @pytest.mark.usefixtures("impatient")
    def test_a_certificate_of_another_authority_opens_nothing(self, robot: Config, lab: Path) -> None:
        theirs = lab / "theirs"
        stranger = NetworkConfig(
            ca=str(lab / "ours" / "ca.pem"),
            certificate=str(theirs / "operator.pem"),
            key=str(theirs / "operator.key"),
        )
        with pytest.raises(BusError), client(robot, stranger) as session:
            send(session, "robot", COMMANDS["info"], None, 1.0)

    @pytest.mark.usefixtures("impatient")
    def test_no_certificate_opens_nothing(self, robot: Config, lab: Path) -> None:
        bare = NetworkConfig(ca=str(lab / "ours" / "ca.pem"))
        with pytest.raises(BusError), client(robot, bare) as session:
            send(session, "robot", COMMANDS["info"], None, 1.0)

    @pytest.mark.usefixtures("impatient")
    def test_a_client_refuses_a_robot_of_another_authority(self, robot: Config, lab: Path) -> None:
        fooled = replace(shown(lab, "viewer"), ca=str(lab / "theirs" / "ca.pem"))
        with pytest.raises(BusError), client(robot, fooled) as session:
            send(session, "robot", COMMANDS["info"], None, 1.0)

    @pytest.mark.usefixtures("impatient")
    def test_a_client_refuses_a_robot_that_shows_another_s_certificate(self, lab: Path) -> None:
        """A viewer of our own lab, who took the robot's place: its certificate is for no such address."""
        network = shown(lab, "viewer", endpoint=free_endpoint().replace("tcp/", "tls/"))
        config = Config(bus=BusConfig(free_endpoint(), retry_ms=50), network=network)
        with Bus.open(config, "supervisor", listen=True) as impostor:
            impostor.pulse.ready()
            with pytest.raises(BusError), client(config, shown(lab, "operator")):
                pytest.fail("it linked")


def test_what_the_network_reads_is_what_is_public() -> None:
    read = zenoh.KeyExpr(access._PUBLIC)
    for topic in TOPICS.values():
        assert read.intersects(zenoh.KeyExpr(key("robot", topic))) != topic.internal
    others = [key("robot", command) for command in COMMANDS.values()]
    others += [alive_key("robot", "tracker"), ready_key("robot", "tracker")]
    assert not [other for other in others if read.intersects(zenoh.KeyExpr(other))]


@pytest.mark.parametrize(("process", "commands"), [("backend", {"save_map", "load_map"}), ("depth", set())])
def test_who_runs_elsewhere_answers_its_commands_and_no_others(process: str, commands: set[str]) -> None:
    network = NetworkConfig(endpoint="tcp/0.0.0.0:7448", remote=(process,))
    rules = access.access_control(network, listener=True)["access_control"]["rules"]
    of_process = [rule for rule in rules if rule["id"].startswith(f"{process} says")]
    for message, flow in (("declare_queryable", "ingress"), ("reply", "ingress"), ("query", "egress")):
        keys = [
            k for r in of_process if message in r["messages"] and flow in r["flows"] for k in r["key_exprs"]
        ]
        assert {name for name, command in COMMANDS.items() if f"prism/*/{command.key}" in keys} == commands


@needs_openssl
def test_certificates_are_kept_and_added_to(lab: Path, tmp_path: Path) -> None:
    def make(*names: str) -> str:
        command = [str(MAKE), str(tmp_path), *names]
        return subprocess.run(command, check=True, timeout=60, capture_output=True, text=True).stdout

    make("robot1,10.0.0.1,robot1.local")
    first = {path.name: path.read_bytes() for path in tmp_path.glob("*.pem")}
    assert "kept robot1.pem" in make("robot1,10.0.0.1", "robot2")
    assert all((tmp_path / name).read_bytes() == data for name, data in first.items())
    for name in ("robot1", "robot2"):
        verify = ["openssl", "verify", "-CAfile", str(tmp_path / "ca.pem"), str(tmp_path / f"{name}.pem")]
        assert subprocess.run(verify, capture_output=True, timeout=60).returncode == 0
    text = subprocess.run(
        ["openssl", "x509", "-in", str(tmp_path / "robot1.pem"), "-noout", "-ext", "subjectAltName"],
        capture_output=True,
        text=True,
        timeout=60,
    ).stdout
    assert all(name in text for name in ("DNS:robot1", "IP Address:10.0.0.1", "DNS:robot1.local"))
    assert all(path.stat().st_mode & 0o077 == 0 for path in tmp_path.glob("*.key"))


@needs_openssl
def test_an_authority_whose_key_was_put_away_is_kept(tmp_path: Path) -> None:
    folder = tmp_path / "lab"
    subprocess.run([str(MAKE), str(folder), "robot1"], check=True, timeout=60, capture_output=True)
    (folder / "ca.key").rename(tmp_path / "ca.key")
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    done = subprocess.run([str(MAKE), str(folder), "robot2"], capture_output=True, timeout=60, text=True)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "ca.key" in done.stderr
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


@needs_openssl
def test_an_interrupted_run_is_gone_on_with(tmp_path: Path) -> None:
    """The key is there and the authority is not: what it may have signed holds."""
    make = [str(MAKE), str(tmp_path), "robot1"]
    subprocess.run(make, check=True, timeout=60, capture_output=True)
    key = (tmp_path / "ca.key").read_bytes()
    (tmp_path / "ca.pem").rename(tmp_path / ".ca.pem")
    (tmp_path / ".ca.pem").write_text("half")
    subprocess.run(make, check=True, timeout=60, capture_output=True)
    assert (tmp_path / "ca.key").read_bytes() == key
    verify = ["openssl", "verify", "-CAfile", str(tmp_path / "ca.pem"), str(tmp_path / "robot1.pem")]
    assert subprocess.run(verify, capture_output=True, timeout=60).returncode == 0


@pytest.mark.parametrize("name", ["", "a b", "../x", "ca", "-x y", "a,b c", "a/b"])
def test_names_that_can_not_be_are_refused(name: str, tmp_path: Path) -> None:
    done = subprocess.run([str(MAKE), str(tmp_path / "new"), name], capture_output=True, timeout=60)
    assert done.returncode == 2
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("network", "words"),
    [
        (NetworkConfig(endpoint="tcp/0.0.0.0:7448", operators=("me",)), "network.operators"),
        (NetworkConfig(remote=("depth",)), "needs network.endpoint"),
        (NetworkConfig(endpoint="tcp/0.0.0.0:7448", remote=("source",)), "can't run elsewhere"),
        (NetworkConfig(endpoint="tcp/0.0.0.0:7448", remote=("nonsense",)), "can't run elsewhere"),
        (NetworkConfig(endpoint="tls/0.0.0.0:7448"), "TLS needs"),
        (NetworkConfig(endpoint="tcp/0.0.0.0:7447"), f"network.endpoint: the bus has its port.*{BUS}"),
        (NetworkConfig(certificate="x.pem"), "belong together"),
        (NetworkConfig(ca="/nowhere/ca.pem"), "can't read /nowhere/ca.pem"),
    ],
)
def test_settings_that_can_not_be_are_named(network: NetworkConfig, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        check_network(network, BUS)


@pytest.mark.parametrize("protocol", ["ws", "tls", "quic"])
def test_beside_a_network_the_bus_is_by_what_the_rules_know(protocol: str) -> None:
    """Else its own processes' heartbeats would be refused in silence."""
    bus = f"{protocol}/127.0.0.1:7449"
    with pytest.raises(ConfigError, match=f"bus.endpoint: {bus}: .*tcp/ or unixsock-stream/"):
        check_network(NetworkConfig(endpoint="tcp/0.0.0.0:7448"), bus)
    check_network(NetworkConfig(), bus)


def test_a_malformed_endpoint_of_the_network_is_named() -> None:
    with pytest.raises(BusError, match=r"network\.endpoint"):
        check_network(NetworkConfig(endpoint="nonsense"), BUS)


@pytest.mark.parametrize(
    "endpoint",
    ["tcp/127.0.0.1:1", "tcp/127.9.9.9:1", "tcp/localhost:1", "tcp/[::1]:1", "unixsock-stream//x/y"],
)
def test_this_host_alone(endpoint: str) -> None:
    assert check_loopback(endpoint) == endpoint


@pytest.mark.parametrize(
    "endpoint", ["tcp/0.0.0.0:1", "tcp/[::]:1", "tcp/192.0.2.1:1", "tls/robot:1", "tcp/127.0.0.1.evil.org:1"]
)
def test_an_endpoint_others_reach_is_refused_with_the_setting_that_is_meant(endpoint: str) -> None:
    with pytest.raises(ConfigError, match=r"network\.endpoint opens"):
        check_loopback(endpoint)
