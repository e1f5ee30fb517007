"""The tools of the fault programme: they measure and do what their reports say."""

from __future__ import annotations

import contextlib
import dataclasses
import random
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from prism_edge.backend import map_file
from prism_edge.errors import MapError
from tools import faults
from tools.faults_kinds import EVERYBODY, draw, kinds, named
from tools.faults_relay import Relay
from tools.faults_service import Watcher, build_clock
from tools.fuzz_files import mutate, sealed


def test_faults_are_drawn_by_seed_and_evenly() -> None:
    possible, skipped = kinds(disk=False, clock=False)
    assert set(skipped) == {"full disk", "clock +1 h, clock -1 h"}
    assert len(kinds(disk=True, clock=True)[0]) == len(possible) + 3
    drawn = draw(possible, 2 * len(possible) + 1, random.Random(4))
    assert drawn == draw(possible, 2 * len(possible) + 1, random.Random(4))
    assert drawn != draw(possible, 2 * len(possible) + 1, random.Random(5))
    assert {sum(kind is other for other in drawn) for kind in possible} <= {2, 3}


def test_kinds_go_by_a_part_of_their_name_and_none_is_an_error() -> None:
    possible, skipped = kinds(disk=False, clock=False)
    assert {kind.name.split()[0] for kind in named(possible, "SIGKILL", skipped)} == {"SIGKILL"}
    assert named(possible, "", skipped) == possible
    with pytest.raises(SystemExit, match="no disk of its own"):
        named(possible, "full disk", skipped)
    with pytest.raises(SystemExit, match="'sigkil'"):
        named(possible, "sigkil", skipped)


def test_a_gap_reaches_from_the_last_pose_before_a_fault_to_the_end_of_looking() -> None:
    class Deaf(Watcher):
        def __init__(self) -> None:
            self.poses = [0.0, 1.0, 1.1, 4.1, 4.2]

    assert Deaf().longest_gap(1.05, 4.3) == pytest.approx(3.0)
    assert Deaf().longest_gap(1.05, 3.0) == pytest.approx(1.9)
    assert Deaf().longest_gap(4.15, 9.2) == pytest.approx(5.0)
    assert Deaf().longest_gap(1.0, 2.0, []) == pytest.approx(1.0)
    assert Deaf().longest_gap_and_when(0.5, 9.2) == pytest.approx((5.0, 4.2))
    assert Deaf().longest_gap_and_when(0.5, 4.3) == pytest.approx((3.0, 1.1))


def outcome(**changes: object) -> faults.Outcome:
    values = {
        "kind": "k", "at_s": 0.0, "length_s": 0.0, "gap_s": 1.0, "beyond_s": 1.0, "recovered_s": 2.0,
        "epochs": 0, "keyframes": (50, 48), "new_run": False, "exits": 0,
    }
    return faults.Outcome(**{**values, **changes})  # type: ignore[arg-type]


class Quiet:
    not_numbers = 0
    well, epoch = True, 0
    poses = far_poses = (0.0,)

    def keyframes(self) -> int:
        return 20

    def longest_gap(self, *_: object) -> float:
        return 4.95


def unmet(*outcomes: faults.Outcome, leftovers: tuple[str, ...] = (), files: int | None = 10) -> list[str]:
    """``files``: that the tracker has open at the end; None: it is not there."""
    counts = {} if files is None else {"tracker": files}
    numbers = {"descriptors": {"tracker": 10}}, {"descriptors": counts}
    found = faults.bars(list(outcomes), True, 0, Quiet(), list(leftovers), [], *numbers)  # type: ignore[arg-type]
    return [name for name, bar in found.items() if not bar["met"]]


@pytest.mark.parametrize(
    ("name", "stops"),
    [
        *((f"SIGSTOP {name}", name in ("source", "tracker")) for name in EVERYBODY),
        *((f"SIGKILL {name}", False) for name in EVERYBODY),
        *((f"memory limit {name}", False) for name in ("tracker", "depth")),
        *((name, False) for name in ("full disk", "truncated frames", "200 ms delay", "router restarted")),
        ("camera gone", True),
    ],
)
def test_only_a_fault_that_stops_poses_by_itself_excuses_its_length(
    name: str, stops: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nearly five seconds without poses are none too many while the camera is away; else they are."""
    now = [0.0]
    monkeypatch.setattr(faults.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(faults.time, "sleep", lambda seconds: now.__setitem__(0, now[0] + seconds))
    monkeypatch.setattr(faults, "_until_well", lambda *_: now[0])
    (kind,) = [kind for kind in kinds(disk=True, clock=True)[0] if kind.name == name]
    harmless = dataclasses.replace(kind, fault=lambda _: contextlib.nullcontext())
    bench = SimpleNamespace(service=SimpleNamespace(exits=[]), rng=random.Random(0))
    seen = faults.one(harmless, bench, Quiet(), 0.0)  # type: ignore[arg-type]
    assert seen.gap_s == 4.95
    assert seen.beyond_s == (0.0 if stops else 4.95)


def test_every_bar_can_be_missed() -> None:
    assert unmet(outcome(), outcome()) == []
    assert len(unmet(outcome(beyond_s=3.1), outcome())) == 2  # the longest, and the median of both
    assert len(unmet(outcome(beyond_s=3.1), outcome(), outcome())) == 1
    assert unmet(outcome(epochs=1)) == ["no map lost"]
    assert unmet(outcome(keyframes=(50, 20))) == ["no map lost"]
    assert unmet(outcome(keyframes=(50, 2), epochs=1, exits=1, new_run=True)) == ["no map lost"]
    assert unmet(outcome(exits=1, new_run=True)) == []
    assert unmet(outcome(exits=1)) == ["the service never ended of itself"]
    assert unmet(outcome(), leftovers=("python",)) == ["no process, folder or shared memory left"]
    assert unmet(outcome(), files=50) == ["no descriptors leaked"]
    assert unmet(outcome(), files=None) == ["no descriptors leaked"]
    assert unmet(outcome(recovered_s=None)) == ["well again within 60 s of each fault"]


def test_a_map_is_lost_where_it_shrinks_or_nobody_has_it() -> None:
    assert unmet(outcome(keyframes=(20, 14))) == unmet(outcome(keyframes=(20, -1))) == ["no map lost"]
    assert unmet(outcome(keyframes=(20, 16))) == unmet(outcome(keyframes=(-1, 20))) == []


@pytest.fixture
def echo() -> socket.socket:
    server = socket.create_server(("127.0.0.1", 0))

    def serve() -> None:
        while True:
            try:
                end, _ = server.accept()
            except OSError:
                return
            while data := end.recv(100):
                end.sendall(data)

    threading.Thread(target=serve, daemon=True).start()
    yield server
    server.close()


def test_the_relay_delays_both_ways_and_hangs_up(echo: socket.socket) -> None:
    with Relay(("127.0.0.1", 0), echo.getsockname(), delay_s=0.1) as relay:
        end = socket.create_connection(("127.0.0.1", relay.port), timeout=10.0)
        began = time.monotonic()
        end.sendall(b"x")
        assert end.recv(10) == b"x"
        assert time.monotonic() - began >= 0.2
        relay.gone = True
        assert end.recv(10) == b""
        with socket.create_connection(("127.0.0.1", relay.port), timeout=10.0) as refused:
            assert refused.recv(10) == b""
        relay.gone = False
        with socket.create_connection(("127.0.0.1", relay.port), timeout=10.0) as again:
            again.sendall(b"y")
            assert again.recv(10) == b"y"
        end.close()


def test_the_faked_clock_moves_wall_time_alone(tmp_path: Path) -> None:
    library = build_clock(tmp_path)
    if library is None:
        pytest.skip("no C compiler")
    file = tmp_path / "clock"
    file.write_bytes(struct.pack("=q", -3600))
    code = "import time, datetime; print(time.time(), time.monotonic(), datetime.datetime.now().timestamp())"
    environment = {"LD_PRELOAD": str(library), "PRISM_EDGE_TRIAL_CLOCK": str(file)}
    said = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    wall, monotonic, other = map(float, said.stdout.split())
    assert wall == pytest.approx(time.time() - 3600, abs=60)
    assert other == pytest.approx(wall, abs=60)
    assert monotonic == pytest.approx(time.monotonic(), abs=60)


def test_mutations_are_by_seed_and_a_sealed_map_is_looked_into() -> None:
    sound = map_file.pack({"a": 1}, {})
    assert [mutate(sound, random.Random(3)) for _ in range(2)] == [mutate(sound, random.Random(3))] * 2
    assert len({mutate(sound, random.Random(seed)) for seed in range(50)}) > 40
    damaged = sound[:26] + b"!" + sound[27:]
    with pytest.raises(MapError, match="checksum"):
        map_file.unpack(damaged)
    with pytest.raises(MapError) as inside:
        map_file.unpack(sealed(damaged))
    assert "checksum" not in str(inside.value)
    assert map_file.unpack(sealed(sound)) == ({"a": 1}, {})
