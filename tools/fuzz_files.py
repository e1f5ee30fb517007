"""Malformed files into each parser: fuzz.py starts `fuzz_files.py SEED COUNT SECONDS FOLDER`.

A process of its own, so that a crash ends only this. Prints a line of JSON for each thing found, the last one
the counts. A parser may accept an input or raise PrismError with one line; all else is found. An audit hook
sees every file that is opened for writing outside FOLDER.
"""

from __future__ import annotations

import contextlib
import faulthandler
import hashlib
import json
import os
import random
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from prism_edge.backend import map_file
from prism_edge.backend.stored_map import from_arrays, to_arrays
from prism_edge.bus import codec, ros
from prism_edge.bus.commands import parse_query, parse_reply
from prism_edge.config import Config
from prism_edge.config_file import dump, load
from prism_edge.depth.contract import card_from_sidecar
from prism_edge.depth.session import OnnxNetwork
from prism_edge.errors import PrismError
from prism_edge.messages import Tracked
from prism_edge.sources.camera_file import read_camera
from prism_edge.topics import COMMANDS
from tests.backend.test_stored_map import EXAMPLE
from tests.bus.examples import TYPES, tracked
from tests.synthetic.network import TinyNetwork, write_sidecar, write_tiny_network

CAMERA = """\
model: pinhole
width: 640
height: 480
fx: 525.0
fy: 526
cx: 320.5
cy: 240
distortion: [0, 0, 0, 0]
"""
WORDS = (
    *(b"\0", b"\n", b": ", b"- ", b"!!python/object:os.system", b"*a", b"&a ", b"{", b"[", b"'", b"\xff\xfe"),
    *(b".nan", b".inf", b"1e999", b"9" * 400, b"../../../x", b"[" * 2000, b"\xf0\x9f\x92\xa9", b"%s%n"),
)
_DIGEST = 32


def mutate(data: bytes, rng: random.Random) -> bytes:
    """A damaged copy: bits flipped, pieces cut, repeated or replaced, or noise altogether."""
    kind = rng.random()
    if kind < 0.05:
        return rng.randbytes(rng.randrange(400))
    if kind < 0.15:
        return data[: rng.randrange(len(data) + 1)]
    damaged = bytearray(data)
    for _ in range(rng.randint(1, 6)):
        at = rng.randrange(len(damaged) + 1)
        how = rng.randrange(4)
        if how == 0 and at < len(damaged):
            damaged[at] ^= 1 << rng.randrange(8)
        elif how == 1:
            damaged[at : at + rng.randrange(20)] = rng.choice(WORDS)
        elif how == 2:
            damaged[at:at] = damaged[at : at + rng.randrange(40)]
        else:
            del damaged[at : at + rng.randrange(20)]
    return bytes(damaged)


def sealed(data: bytes) -> bytes:
    """A map with a checksum and a length that are right again, so that what is inside is looked at."""
    if len(data) < 24 + _DIGEST:
        return data
    body = data[:16] + len(data).to_bytes(8, "little") + data[24:-_DIGEST]
    return body + hashlib.sha256(body).digest()


def cases(folder: Path) -> dict[str, tuple[bytes, Callable[[bytes, random.Random], None]]]:
    """By name: a sound example, and who reads the damaged ones."""
    network = write_tiny_network(folder / "sound.onnx").read_bytes()
    stored = map_file.pack(*to_arrays(*EXAMPLE))
    message = codec.pack(tracked(3))
    card = write_sidecar(folder / "sound.onnx", TinyNetwork().card()).read_bytes()

    def file(name: str, read: Callable[[Path], Any]) -> Callable[[bytes, random.Random], None]:
        def case(data: bytes, _: random.Random) -> None:
            path = folder / name
            path.write_bytes(data)
            read(path)

        return case

    def a_map(data: bytes, rng: random.Random) -> None:
        info, arrays = map_file.unpack(sealed(data) if rng.random() < 0.7 else data)
        from_arrays(info, arrays, max_carried=100)

    return {
        "configuration": (dump(Config()).encode(), file("robot.yaml", load)),
        "camera file": (CAMERA.encode(), file("camera.yaml", read_camera)),
        "map": (stored, a_map),
        "model metadata": (card, file("card.yaml", card_from_sidecar)),
        "network": (network, file("net.onnx", OnnxNetwork)),
        "message": (message, lambda data, rng: void(codec.unpack(data, _kind(rng)))),
        "public message": (
            ros.serialise(ros.POSE, ros.pose_with_covariance(1, "map", np.eye(4), np.eye(6))),
            lambda data, _: void(ros.deserialise(ros.POSE, data)),
        ),
        "query": (
            b'{"argument": "lab"}',
            lambda data, rng: void(parse_query(rng.choice(list(COMMANDS.values())), data)),
        ),
        "reply": (
            b'{"ok": true, "said": "x", "values": {"a": "b"}}',
            lambda data, _: void(parse_reply(data)),
        ),
    }


def _kind(rng: random.Random) -> type:
    return Tracked if rng.random() < 0.8 else rng.choice(TYPES)


def void(_: Any) -> None:
    """Take it."""


def main(seed: str, count: str, seconds: str, name: str) -> None:
    """Feed ``count`` inputs in at most ``seconds``."""
    faulthandler.enable()
    folder, rng = Path(name).resolve(), random.Random(int(seed))
    known = cases(folder)
    outside: list[str] = []

    def hook(event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open" and isinstance(arguments[0], str | bytes | os.PathLike):
            writes = isinstance(arguments[2], int) and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
            path = os.path.abspath(os.fsdecode(arguments[0]))
            if writes and not path.startswith(str(folder)) and not path.startswith("/dev/"):
                outside.append(path)

    sys.addaudithook(hook)
    sound = random.Random(1)
    for case, (example, read) in known.items():
        if case not in ("message", "query"):  # which take the right one of several kinds
            read(example, sound)  # else only noise would be refused
    counts = {case: {"inputs": 0, "refused": 0, "accepted": 0} for case in known}
    deadline = time.monotonic() + float(seconds)
    for number in range(int(count)):
        if time.monotonic() > deadline:
            break
        case = list(known)[number % len(known)]
        example, read = known[case]
        data = mutate(example, rng)
        counts[case]["inputs"] += 1
        (folder / "last").write_bytes(data)  # what a crash leaves to look at
        try:
            read(data, rng)
            counts[case]["accepted"] += 1
        except PrismError as error:
            counts[case]["refused"] += 1
            if "\n" in str(error):
                found(folder, case, number, data, f"says more than one line: {error}")
        except Exception as error:  # what is looked for
            found(folder, case, number, data, f"{type(error).__name__}: {error}")
    for path in sorted(set(outside)):
        print(json.dumps({"case": "files", "number": -1, "what": f"written outside: {path}"}))
    print(json.dumps({"counts": counts}), flush=True)


def found(folder: Path, case: str, number: int, data: bytes, what: str) -> None:
    """Tell, and keep the input."""
    with contextlib.suppress(OSError):
        (folder / f"found-{number}").write_bytes(data)
    print(json.dumps({"case": case, "number": number, "what": what[:300]}), flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
