"""How it is told on a simulated walk whether the bundled network knows a place again."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import from_rt
from tools.train_nano import measure
from tools.train_nano.measure import Walk, recalls, revisits


def walk(metres: list[float], overlap: list[list[float]], descriptors: np.ndarray) -> Walk:
    """Frames 6 s apart at ``metres`` along a line, all looking one way."""
    n = len(metres)
    poses = np.array([from_rt(np.eye(3), np.array([x, 0.0, 0.0])) for x in metres])
    nothing = np.zeros(n)
    return Walk(6.0 * np.arange(n), poses, *([nothing] * 5), descriptors, np.array(overlap))


def test_a_place_is_known_by_sight_or_by_pose() -> None:
    """The fourth frame asks: the first is 0.9 m away and shares 0.4, the second 1.3 m away and shares 0.8."""
    overlap = [[1, 0.5, 0, 0.4], [0.5, 1, 0, 0.8], [0, 0, 1, 0], [0.4, 0.8, 0, 1]]
    to_second = np.array([[1, 0], [0, 1], [1, 0], [0.1, 0.9]], dtype=float)
    judged = revisits(walk([0.9, 1.3, 30.0, 0.0], overlap, to_second))
    assert judged.seen.tolist() == [True]
    assert judged.taken.tolist() == [False]
    assert judged.limit.tolist() == [False]  # nobody who goes by the picture finds the one that is nearer
    to_first = np.array([[1, 0], [0, 1], [1, 0], [0.9, 0.1]], dtype=float)
    judged = revisits(walk([0.9, 1.3, 30.0, 0.0], overlap, to_first))
    assert judged.seen.tolist() == [True]
    assert judged.taken.tolist() == [True]


def test_another_place_is_found_by_neither_rule_and_the_last_seconds_are_not_asked_for() -> None:
    """A frame 6 s ago is most alike, but no revisit; of the older ones the wrong one is taken."""
    overlap = np.eye(4)
    overlap[0, 3] = overlap[3, 0] = 0.6
    overlap[2, 3] = overlap[3, 2] = 1.0
    descriptors = np.array([[0, 0, 1], [0.6, 0.8, 0], [1, 0, 0], [1, 0, 0]], dtype=float)
    judged = revisits(walk([0.2, 9.0, 0.0, 0.0], overlap.tolist(), descriptors))
    assert judged.seen.tolist() == [False]
    assert judged.taken.tolist()[-1] is False
    assert judged.limit.tolist()[-1] is True


def test_without_descriptors_nothing_is_said_of_places() -> None:
    none = walk([0.0, 0.0, 0.0], np.ones((3, 3)).tolist(), np.zeros((3, 0)))
    assert recalls([none]) == ""


def test_each_noughth_frame_is_refused(monkeypatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["measure", "--every", "0"])
    with pytest.raises(SystemExit):
        measure.main()
    assert "--every" in capsys.readouterr().err
