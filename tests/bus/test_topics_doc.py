"""docs/TOPICS.md: its tables are the code's, its snippets run."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from prism_edge.bus import ros
from prism_edge.bus.session import Bus
from prism_edge.geometry.poses import from_rt
from prism_edge.topics import TOPICS

CHECKOUT = Path(__file__).resolve().parents[2]
TEXT = (CHECKOUT / "docs" / "TOPICS.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^### (\w+)\n(.*?)(?=^##)", TEXT, re.MULTILINE | re.DOTALL))
PUBLIC = [name for name, topic in TOPICS.items() if not topic.internal]
INTERNAL = [name for name, topic in TOPICS.items() if topic.internal]

POSE = from_rt(np.eye(3), np.array([1.5, 2.5, 3.5]))
SIX = np.eye(6)

# what is published, and what the snippet must then print
MESSAGES = {
    "odom": (ros.odometry(1, "odom", "base_link", POSE, SIX, np.zeros(6), SIX), "odom 1.5 2.5 3.5"),
    "pose": (ros.pose_with_covariance(1, "map", POSE, SIX), "map 1.5 2.5 3.5"),
    "tf": (ros.transforms([(1, "map", "odom", POSE)]), "map odom"),
    "scale": (ros.scale(1, "map", 0.0, 0.25, 0.1, metric=True), "1.0 0.25 True"),
    "status": (ros.diagnostics(1, [("tracking", 0, "ok building", {})]), "0 tracking ok building"),
    "health": (ros.diagnostics(1, [("depth", 1, "restarted", {})]), "1 depth restarted"),
    "uncertainty": (ros.image(1, "camera", np.full((2, 3), 0.25)), "camera 32FC1 (2, 3) 0.25"),
    "weight": (ros.image(1, "camera", np.full((3, 2), 0.5)), "camera 32FC1 (3, 2) 0.5"),
    "truth": (ros.pose_stamped(1, "map", POSE), "map 1.5 2.5 3.5"),
}


def snippet(name):
    (code,) = re.findall(r"```python\n(.*?)```", SECTIONS[name], re.DOTALL)
    return code


def rows(heading):
    """The cells of the first table below a heading."""
    table = TEXT.split(f"## {heading}\n", 1)[1].split("\n|---", 1)[1].split("\n\n", 1)[0]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()[1:]]


def test_the_public_table_is_the_codes_own():
    documented = {
        re.match(r"\[`(\w+)`\]", key)[1]: (kind, rate, priority, latched == "yes")
        for key, kind, rate, priority, latched in rows("Public topics")
    }
    assert documented == {
        name: (TOPICS[name].type, f"{TOPICS[name].rate_hz:g} Hz", TOPICS[name].priority, TOPICS[name].latched)
        for name in PUBLIC
    }


def test_the_internal_table_is_the_codes_own():
    documented = {name.strip("`"): kind for name, kind, *_ in rows("Internal topics")}
    assert documented == {name: TOPICS[name].type.__name__ for name in INTERNAL}


@pytest.mark.parametrize("name", PUBLIC)
def test_a_snippet_is_about_ten_lines(name):
    assert len([line for line in snippet(name).splitlines() if line.strip()]) <= 14


@pytest.mark.parametrize("name", PUBLIC)
def test_each_snippet_prints_a_message(config, name, tmp_path):
    message, expected = MESSAGES[name]
    config = replace(config, robot="testbot")
    environment = {**os.environ, "PRISM_ENDPOINT": config.bus.endpoint, "PRISM_ROBOT": "testbot"}
    producer = TOPICS[name].producer + "-test"
    with Bus.open(config, "supervisor", listen=True) as supervisor, Bus.open(config, producer) as bus:
        bus.publish(name, message)
        bus.pulse.ready()
        assert supervisor.await_ready([producer], 10.0) == set()
        done = threading.Event()

        def go_on():
            while not done.wait(0.02):
                bus.publish(name, message)

        publishing = threading.Thread(target=go_on)
        if not TOPICS[name].latched:  # a latched one must be got although it was published before
            publishing.start()
        try:
            run = subprocess.run(
                [sys.executable, "-c", snippet(name)],
                cwd=tmp_path,  # of the project nothing is needed
                env=environment,
                capture_output=True,
                text=True,
                timeout=60,
            )
        finally:
            done.set()
            if publishing.ident:
                publishing.join()
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith(expected)
