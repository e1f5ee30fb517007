"""The columns of culled keyframes against a dict, through any sequence of operations."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.backend.carried import Carried
from prism_edge.geometry.poses import from_rt, se3_exp


def link(seed: int) -> np.ndarray:
    return se3_exp(np.random.default_rng(seed).normal(size=6))


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 40),
    st.lists(st.tuples(st.integers(0, 5), st.integers(0, 5), st.booleans()), max_size=300),
)
def test_it_does_what_a_dict_does(most: int, steps: list[tuple[int, int, bool]]) -> None:
    carried, model = Carried(most), {}
    for number, (one, other, culls) in enumerate(steps):
        if culls:
            for k, (anchor, own, frame) in model.items():
                if anchor == one:
                    model[k] = (other, link(number) @ own, frame)
            carried.rehang(one, other, link(number))
        elif other == 5:
            model = {k: hung for k, hung in model.items() if hung[0] != one}
            carried.drop(one)
        model[1000 + number] = (one, link(number + 1), 7 * number)
        carried.add(1000 + number, one, link(number + 1), 7 * number)
        while len(model) > most:
            del model[next(iter(model))]
    assert len(carried) == len(model)
    expected = np.array([m[1] for m in model.values()]).reshape(-1, 4, 4)
    np.testing.assert_allclose(carried.links, expected, atol=1e-9)
    assert carried.numbers.tolist() == [[k, m[0], m[2]] for k, m in model.items()]


def test_it_takes_no_more_memory_however_many_were_culled() -> None:
    carried, shift = Carried(1000), from_rt(np.eye(3), np.ones(3))
    for number in range(20_000):
        carried.add(number, 0, shift, number)
    assert carried.ids.tolist() == list(range(19_000, 20_000))
    assert len(carried._numbers) == len(carried._links) <= 2048


def test_what_hangs_on_a_keyframe_is_stretched_with_it_also_once_the_oldest_have_gone() -> None:
    carried = Carried(3)
    for culled in range(5):
        link = np.eye(4)
        link[:3, 3] = culled + 1.0, 0.0, -2.0
        carried.add(culled, 100 + culled % 2, link, 10 * culled)
    carried.stretch(100, 3.0)
    places = dict(zip(carried.ids.tolist(), carried.links[:, :3, 3].tolist(), strict=True))
    assert places == {2: [9.0, 0.0, -6.0], 3: [4.0, 0.0, -2.0], 4: [15.0, 0.0, -6.0]}
