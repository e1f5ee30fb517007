"""Messages for a running daemon to outlive: of each topic's own type, damaged, or sound with mad values.

Damaged ones are refused, and nothing else comes of them. Those that are sound but for what they say can only
come from one of the robot's own processes (docs/SECURITY.md), and are believed: a process may die of one.
"""

from __future__ import annotations

import random
import struct
from dataclasses import fields
from typing import Any, get_type_hints

import numpy as np

from prism_edge.bus import codec, ros
from prism_edge.errors import BusError
from prism_edge.topics import TOPICS, Topic
from tools.fuzz_files import mutate

ROWS = 3  # of arrays whose length is free
FLOATS = (float("nan"), float("inf"), -float("inf"), 1e300, -1e300, -1.0, 0.0, 5e-324)
WHOLES = (-1, -2, 0, 2**31, -(2**31), 2**55 + 1, 2**63 - 1, -(2**63))
CDR_HEAD = 4  # bytes of a CDR message that say how it is written
_POSE = np.eye(4)
_ROS = {
    ros.ODOMETRY: ros.odometry(1, "odom", "base_link", _POSE, np.eye(6), np.ones(6), np.eye(6)),
    ros.POSE: ros.pose_with_covariance(1, "map", _POSE, np.eye(6)),
    ros.TRUTH: ros.pose_stamped(1, "map", _POSE),
    ros.IMAGE: ros.image(1, "camera", np.ones((2, 3))),
    ros.TF: ros.transforms([(1, "map", "odom", _POSE)]),
    ros.SCALE: ros.scale(1, "map", 0.1, 0.2, 0.15, True, 7, 0.12, 0.3, 42, True),
    ros.DIAGNOSTICS: ros.diagnostics(1, [("tracking", ros.LEVEL_WARN, "lost", {"fps": 29.5})]),
}
# What a sound message of the first two says is done, and that is no finding: a process is taken for alive,
# the run ends. Of the others our own subscriber would take a forged one for the daemon's.
LEFT_OUT = ("heartbeat", "end", "pose", "health")


def topics(heard: bool = False) -> list[Topic]:
    """Those that messages are sent on; ``heard``: only what a process of the daemon listens to."""
    all_of_them = [topic for name, topic in TOPICS.items() if name not in LEFT_OUT]
    return [topic for topic in all_of_them if topic.consumers or not heard]


def example(kind: type | str, rng: random.Random | None = None) -> bytes:
    """A sound message of a topic's type, packed; with ``rng`` about a third of its values are mad."""
    if isinstance(kind, str):
        data = ros.serialise(kind, _ROS[kind])
        return data if rng is None else _mad_doubles(data, rng)
    hints, given = get_type_hints(kind), {}
    for f in fields(kind):
        if "dtype" in f.metadata:
            shape = [ROWS if n == -1 else n for n in f.metadata["shape"]]
            given[f.name] = _array(np.dtype(f.metadata["dtype"]), shape, rng)
        else:
            given[f.name] = _plain(hints[f.name], rng)
    return codec.pack(kind(**given))


def damaged(kind: type | str, rng: random.Random) -> bytes:
    """An example that is no message any more."""
    while True:
        data = mutate(example(kind), rng)
        try:
            read(kind, data)
        except BusError:
            return data


def read(kind: type | str, data: bytes) -> Any:
    """As a process of the daemon does. Raises BusError."""
    return ros.deserialise(kind, data) if isinstance(kind, str) else codec.unpack(data, kind)


def _plain(kind: Any, rng: random.Random | None) -> Any:
    mad = rng if rng is not None and rng.random() < 0.35 else None
    if kind is float:
        return 0.5 if mad is None else mad.choice(FLOATS)
    if kind is bool:
        return True if mad is None else mad.random() < 0.5
    if kind is int:
        return 1 if mad is None else mad.choice(WHOLES)
    if kind is str:
        return "ok" if mad is None else mad.choice(("", "pinhole", "../x", "\0", "x" * 300))
    return {"a": "b"}


def _array(dtype: np.dtype[Any], shape: list[int], rng: random.Random | None) -> np.ndarray[Any, Any]:
    values = np.ones(shape, dtype)
    if rng is None:
        return values
    mad = FLOATS if dtype.kind == "f" else WHOLES
    for i in range(values.size):
        if rng.random() < 0.35:
            # What is too large for its type wraps around, or becomes infinite.
            with np.errstate(over="ignore"):
                values.flat[i] = np.array(rng.choice(mad)).astype(dtype)
    return values


def _mad_doubles(data: bytes, rng: random.Random) -> bytes:
    """CDR with numbers written over: doubles lie at multiples of eight behind its head."""
    out = bytearray(data)
    for at in range(CDR_HEAD, len(data) - 7, 8):
        if rng.random() < 0.35:
            struct.pack_into("<d", out, at, rng.choice(FLOATS))
    return bytes(out)
