"""When a network that fails at every image is given up, on a clock of numbers."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prism_edge.config import SupervisorConfig
from prism_edge.errors import ModelError
from prism_edge.workers.failing import LEAST, LONGEST_S, Failing

CUDA = "CUDAExecutionProvider"
FAULT = RuntimeError("CUDA failure 999: unknown error")


def gives_up(provider: str, *images: tuple[float, Exception | None]) -> bool:
    failing = Failing(provider)
    try:
        for now_s, error in images:
            failing.note(error, now_s)
    except ModelError:
        return True
    return False


def test_an_accelerator_that_fails_for_long_is_given_up_with_what_happened():
    failing = Failing(CUDA)
    for now_s in (100.0, 105.0, 119.9):
        failing.note(FAULT, now_s)
    with pytest.raises(ModelError, match=f"{CUDA} has failed at 4 images in 20 s: starting anew"):
        failing.note(FAULT, 120.0)


def test_one_image_that_is_answered_makes_it_sound():
    assert not gives_up(CUDA, (0.0, FAULT), (19.0, FAULT), (20.0, None), (21.0, FAULT), (40.0, FAULT))
    assert gives_up(CUDA, (0.0, FAULT), (20.0, None), (21.0, FAULT), (40.0, FAULT), (41.0, FAULT))


def test_two_failures_say_little_however_far_apart():
    assert not gives_up(CUDA, (0.0, FAULT), (3600.0, FAULT))


def test_nothing_else_is_made_anew_for_it():
    always = [(float(second), FAULT) for second in range(100)]
    assert not gives_up("CPUExecutionProvider", *always)
    wrong = ModelError("weights.bin: was overwritten while the network runs")
    assert not gives_up(CUDA, *((now_s, wrong) for now_s, _ in always))


def test_of_a_pair_the_one_on_an_accelerator_counts():
    always = [(float(second), FAULT) for second in range(100)]
    assert gives_up(f"{CUDA}, CPUExecutionProvider", *always)


@given(st.lists(st.tuples(st.floats(0.0, 5.0), st.booleans()), max_size=80))
def test_it_is_given_up_exactly_when_a_row_of_failures_is_long(steps: list[tuple[float, bool]]):
    now_s, row, images, expected = 0.0, [], [], False
    for step, failed in steps:
        now_s += step
        images.append((now_s, FAULT if failed else None))
        row = [*row, now_s] if failed else []
        expected |= len(row) >= LEAST and row[-1] - row[0] >= LONGEST_S
    assert gives_up(CUDA, *images) == expected


def test_one_that_fails_again_and_again_is_never_given_up_for_good():
    """The supervisor gives up a process that dies more than ``max_restarts`` times within its window."""
    usual = SupervisorConfig()
    assert usual.max_restarts * LONGEST_S > usual.window_s
