"""What the fuzzer feeds gets past the first bytes, and what the command line says is judged."""

from __future__ import annotations

import random
import subprocess

import numpy as np
import pytest

from prism_edge.bus import codec
from prism_edge.errors import BusError
from tools import fuzz
from tools.fuzz_messages import damaged, example, read, topics


@pytest.mark.parametrize("topic", topics(), ids=lambda topic: topic.key)
def test_examples_are_sound_and_mad_values_are_where_the_daemon_reads_them(topic) -> None:
    sound = example(topic.type)
    read(topic.type, sound)
    mad = [example(topic.type, random.Random(seed)) for seed in range(30)]
    assert any(data != sound for data in mad)
    if not isinstance(topic.type, str):
        for data in mad:  # the header is kept: every one of them is a message
            read(topic.type, data)


def test_damaged_messages_are_none_any_more_and_most_get_past_magic_and_version() -> None:
    rng, head = random.Random(0), codec.MAGIC + codec.VERSION.to_bytes(2, "little")
    sent = [(topic.type, damaged(topic.type, rng)) for topic in topics() for _ in range(40)]
    for kind, data in sent:
        with pytest.raises(BusError):
            read(kind, data)
    ours = [data for kind, data in sent if not isinstance(kind, str)]
    assert sum(data.startswith(head) for data in ours) / len(ours) > 0.5


def test_mad_values_are_among_them() -> None:
    (topic,) = [topic for topic in topics(heard=True) if topic.key == "internal/depth"]
    read_back = [codec.unpack(example(topic.type, random.Random(seed)), topic.type) for seed in range(60)]
    assert any(np.isnan(depth.depth).any() for depth in read_back)
    assert any(depth.keyframe < 0 for depth in read_back)
    assert any(np.isinf(depth.bias_sigma) for depth in read_back)


@pytest.mark.parametrize(
    ("code", "said", "words"),
    [
        (3, "prism-edge: error: x\n", ""),
        (0, "prism-edge: warning: x\nprism-edge: warning: y\n", ""),
        (1, "Traceback (most recent call last):\n", "Traceback"),
        (-11, "", "-11"),
        (1, "prism-edge: error: x\n", "exit code 1"),
        (3, "prism-edge: error: x\nand more\n", "2 lines"),
        (3, "", "0 lines"),
    ],
)
def test_the_command_line_refuses_with_a_documented_code_and_in_one_line(
    code: int, said: str, words: str
) -> None:
    done = subprocess.CompletedProcess([], code, "", said)
    assert words in (fuzz.misbehaved(done, (0, 3)) or "")
    assert (fuzz.misbehaved(done, (0, 3)) is None) is (not words)


def test_what_was_found_before_an_input_hangs_is_reported(tmp_path, monkeypatch) -> None:
    finding = b'{"case": "video", "number": 3, "what": "a crash"}\n'

    def hangs(*_, **given):
        kept = given["cwd"] / "found-3"
        kept.write_bytes(b"the input")
        raise subprocess.TimeoutExpired("fuzz_files", 1.0, output=finding)  # what Python on Linux passes on

    monkeypatch.setattr(fuzz.subprocess, "run", hangs)
    report = fuzz.files(tmp_path, 10, 0, 1.0, tmp_path)
    first, second = report["found"]
    assert first["what"] == "a crash"
    assert "not done with" in second["what"]
    assert (tmp_path / "found-3").read_bytes() == b"the input"
