"""A daemon that only pretends: it says what the real one would, by a script, so that listening is tested.

``python fake_daemon.py SCENARIO --config FILE``; its estimate is the truth of the `tiny_sequence` at half
its size, from the first frame on, published by the public topics' own types.
"""

from __future__ import annotations

import argparse
import signal
import subprocess
import sys
import threading
import time

import numpy as np

from prism_edge.bus import ros
from prism_edge.bus.session import Bus
from prism_edge.config import Config
from prism_edge.config_file import load
from prism_edge.geometry.mount import base_from_camera
from prism_edge.geometry.poses import inverse
from prism_edge.messages import EndOfStream, Heartbeat, MapSnapshot, Tracked
from prism_edge.sources.schedule import GAP

FRAMES = 24
PERIOD_NS = 10_000_000

def camera_at(i: int) -> np.ndarray:
    """map_from_camera of frame i: half of the truth's path."""
    pose = np.eye(4)
    pose[:2, 3] = i / 30, (i / 15) ** 2 / 8
    return pose


def play(scenario: str, config: Config, bus: Bus, worker: int, stopped: threading.Event) -> int:
    assert not bus.await_ready({"eval"}, 30.0)
    now = time.monotonic_ns()
    for name in ("source", "tracker", "depth", "scale", "backend"):
        bus.publish("heartbeat", Heartbeat(name, worker, now, "ready", "", now, 5.0, {}))
    mount, no_ids = base_from_camera(config.frames), np.zeros(0, dtype=np.int64)
    begun_with = np.diag([1.0, -1, -1, 1]) @ mount if scenario == "loaded" else mount  # another robot's map
    ended = False

    def snapshot() -> MapSnapshot:
        print("asked for its map", flush=True)
        settled = ended and scenario != "unsettled"
        ids = np.array([0, 4], dtype=np.int64)
        # The map's world is the first camera's; half its unit is a metre.
        world = np.array([inverse(begun_with) @ camera_at(0), inverse(begun_with) @ camera_at(4)])
        world[:, :3, 3] *= 2.0
        known = settled, float(np.log(0.5)), ids, world, no_ids
        return MapSnapshot(0, 1, *known, base_from_camera=begun_with)

    bus.answer("map_snapshot", snapshot)
    begin = time.monotonic_ns()
    for i in range(FRAMES):
        stamp, due = 100 * 10**9 + round(i * 1e6 / 30) * 1000, begin + i * PERIOD_NS
        stopped.wait(max(0.0, (due - time.monotonic_ns()) / 1e9))
        if scenario in ("stalls", "pauses") and i == 6:
            until_s = time.monotonic() + 3.0
            while scenario == "stalls" or time.monotonic() < until_s:
                now = time.monotonic_ns()
                gap = {GAP: "3.0"} if scenario == "pauses" else {}
                bus.publish("heartbeat", Heartbeat("source", worker, now, "idle", "", now, 5.0, gap))
                if stopped.wait(0.1):
                    return 0
        if scenario == "dies" and i == 6:
            print("prism-edge tracker: error: out of luck", file=sys.stderr, flush=True)
            return 7
        lost = 10 <= i < 12
        if i > 0 and (not lost or scenario == "lost") and scenario != "silent":
            robot = camera_at(i) @ inverse(mount)
            bus.publish("pose", ros.pose_with_covariance(stamp, config.frames.map, robot, np.eye(6)))
        reference = 4 * (i >= 4)
        relative = inverse(camera_at(reference)) @ camera_at(i)
        relative[:3, 3] *= 2.0
        state = "initialising" if i == 0 else "lost" if lost else "ok"
        bus.publish(
            "tracked",
            Tracked(i, stamp, due, state, i > 0 and not lost, -1, 9 if i == 5 else reference, relative, 0),
        )
    bus.publish("scale", ros.scale(stamp, config.frames.map, float(np.log(0.5)), 0.11, 0.05, metric=True))
    bus.publish("end", EndOfStream(FRAMES, FRAMES, 3, 0, FRAMES - 1))
    ended = True
    stopped.wait(120.0)
    return 0


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("scenario")
    parser.add_argument("--config", required=True)
    args = parser.parse_args()
    if args.scenario == "refuses":
        print("prism-edge depth: error: model.onnx: no such file", file=sys.stderr, flush=True)
        return 5
    stopped = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: stopped.set())
    config = load(args.config)
    worker = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    with Bus.open(config, "supervisor", listen=True) as bus:
        code = play(args.scenario, config, bus, worker.pid, stopped)
    worker.kill()
    worker.wait()
    return code


if __name__ == "__main__":
    sys.exit(main())
