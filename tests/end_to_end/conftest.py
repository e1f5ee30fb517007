"""A generated recording and network for all, and daemons that are surely gone after each test."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.end_to_end.processes import Daemon
from tests.synthetic.network import write_tiny_network
from tests.synthetic.sequence import write_sequence

FRAMES, WIDTH, HEIGHT = 60, 320, 240
SLOW_HZ = 10


@pytest.fixture(scope="session")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A TUM RGB-D folder: two seconds through a room."""
    return write_sequence(tmp_path_factory.mktemp("room"), FRAMES, WIDTH, HEIGHT)


@pytest.fixture(scope="session")
def full_size_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same at 640 x 480, where metres don't hang on which frames happen to become keyframes.

    At half of that translation and rotation are told apart so badly that live scale goes from 0.99 to 1.06.
    Ten images a second, and all moves at a third of its speed: a busy machine's real time follows that.
    """
    folder = write_sequence(tmp_path_factory.mktemp("full_size_room"), FRAMES)
    for name in ("rgb.txt", "groundtruth.txt"):
        rows = [line.split(maxsplit=1) for line in (folder / name).read_text().splitlines()[1:]]
        slow = [f"{i / SLOW_HZ:.6f} {rest}\n" for i, (_, rest) in enumerate(rows)]
        (folder / name).write_text("".join(slow))
    return folder


@pytest.fixture(scope="session")
def long_room(room: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five minutes there and back through the same room: the same images again with other stamps.

    Longer than all tests of a module take on a machine that is busy with others.
    """
    folder = tmp_path_factory.mktemp("long_room")
    (folder / "rgb").symlink_to(room / "rgb")
    images = [line.split()[1] for line in (room / "rgb.txt").read_text().splitlines()[1:]]
    there_and_back = images + images[-2:0:-1]
    lines = [f"{i / 30:.6f} {there_and_back[i % len(there_and_back)]}\n" for i in range(9000)]
    (folder / "rgb.txt").write_text("".join(lines))
    return folder


@pytest.fixture(scope="session")
def camera(room: Path) -> Path:
    """The camera file of both."""
    return room / "camera.yaml"


@pytest.fixture(scope="session")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that reads the room's true depth from its tint."""
    return write_tiny_network(tmp_path_factory.mktemp("network") / "tiny.onnx")


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Callable[..., Daemon]]:
    """Starts ``prism-edge run`` with the arguments given; killed with all its processes after the test."""
    with ExitStack() as stack:
        yield lambda *arguments: stack.enter_context(Daemon(tmp_path / "daemon.log", *arguments))
