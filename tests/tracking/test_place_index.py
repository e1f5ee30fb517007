"""Retrieval by descriptors."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.tracking.place_index import ENOUGH_FOR_A_MEAN, PlaceIndex


def filled(rows: np.ndarray) -> PlaceIndex:
    index = PlaceIndex()
    for k, row in enumerate(rows):
        assert index.add(k, row.astype(np.float32))
    return index


def test_few_are_ranked_by_plain_cosine():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(ENOUGH_FOR_A_MEAN - 1, 20))
    query = rng.normal(size=20).astype(np.float32)
    ranked = filled(rows).rank(query, range(100))
    cosine = rows @ query / np.linalg.norm(rows, axis=1) / np.linalg.norm(query)
    assert [k for k, _ in ranked] == np.argsort(-cosine).tolist()
    assert [s for _, s in ranked] == pytest.approx(sorted(cosine, reverse=True), abs=1e-5)


def test_many_are_ranked_by_what_tells_them_apart():
    """A common part a hundred times as large as the differences changes nothing."""
    rng = np.random.default_rng(1)
    own = rng.normal(size=(40, 16))
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    rows = own - own.mean(axis=0)
    common = np.full(16, 25.0)
    common -= 0.0
    index = filled(common + rows)
    for k in (3, 17):
        ranked = index.rank((common + rows[k] + 0.05 * rng.normal(size=16)).astype(np.float32), range(40))
        assert ranked[0][0] == k
        assert ranked[0][1] > 0.8 > ranked[1][1]


def test_only_those_asked_for_are_ranked():
    index = filled(np.eye(5))
    assert [k for k, _ in index.rank(np.ones(5, np.float32), [3, 1, 99])] == [1, 3]


def test_what_is_described_anew_counts_once():
    rows = np.random.default_rng(2).normal(size=(30, 8))
    once, twice = filled(rows), filled(rows)
    for k in range(0, 30, 3):
        twice.add(k, rows[-1 - k].astype(np.float32))
        twice.add(k, rows[k].astype(np.float32))
    query = rows[4].astype(np.float32)
    for (a, s), (b, t) in zip(once.rank(query, range(30)), twice.rank(query, range(30)), strict=True):
        assert (a, s) == (b, pytest.approx(t, abs=1e-5))


def test_what_is_removed_is_gone_from_the_mean_too():
    rng = np.random.default_rng(2)
    rows = rng.normal(size=(30, 8))
    index, fresh = filled(rows), PlaceIndex()
    for k in range(0, 30, 2):
        index.remove(k)
    index.remove(777)
    for k in range(1, 30, 2):
        fresh.add(k, rows[k].astype(np.float32))
    query = rng.normal(size=8).astype(np.float32)
    for (a, s), (b, t) in zip(index.rank(query, range(30)), fresh.rank(query, range(30)), strict=True):
        assert a == b
        assert s == pytest.approx(t, abs=1e-5)
    assert len(index) == 15
    assert 0 not in index
    assert 1 in index


def test_descriptors_all_equal_tell_nothing_apart():
    index = filled(np.ones((20, 8)))
    ranked = index.rank(np.ones(8, np.float32), range(20))
    assert [k for k, _ in ranked] == list(range(20))
    assert all(s == 0.0 for _, s in ranked)


@pytest.mark.parametrize(
    "bad", [np.zeros(8), np.full(8, np.nan), np.full(8, np.inf), np.zeros(0), np.full(7, np.nan)], ids=str
)
def test_what_is_no_descriptor_is_refused(bad):
    index = filled(np.eye(8))
    assert not index.add(99, bad.astype(np.float32))
    assert index.rank(bad.astype(np.float32), range(8)) == []
    assert len(index) == 8


@pytest.mark.parametrize("length", [8, 12])
def test_another_network_s_descriptors_take_the_place_of_the_rest(
    length: int, caplog: pytest.LogCaptureFixture
) -> None:
    """Where a network says who it is; another length tells as much."""
    caplog.set_level("INFO")
    one, other = ("one", "other") if length == 8 else ("", "")
    index = PlaceIndex()
    for k, row in enumerate(np.eye(8, dtype=np.float32)):
        assert index.add(k, row, one)
    query = np.eye(length, dtype=np.float32)[3]
    assert index.rank(query, range(99), other) == [], "what two networks say can't be compared"
    for k in range(50, 58):
        assert index.add(k, np.eye(length, dtype=np.float32)[k - 50], other)
    assert len(index) == 8
    assert index.network == other
    assert index.rank(query, range(99), other)[0] == (53, pytest.approx(1.0))
    assert caplog.text.count("another network names places now") == 1


def test_a_name_with_another_digest_is_another_network() -> None:
    index = PlaceIndex()
    assert index.add(0, np.ones(4, np.float32), "one")  # as maps of earlier builds have it
    assert index.add(1, np.ones(4, np.float32), "one@0123456789ab")
    assert len(index) == 2
    assert index.rank(np.ones(4, np.float32), range(9), "one@ba9876543210") == []
    assert index.add(2, np.ones(4, np.float32), "one@ba9876543210")
    assert len(index) == 1


def test_who_does_not_say_its_name_is_no_other_network() -> None:
    index = PlaceIndex()
    assert index.add(0, np.ones(4, np.float32), "one")
    assert index.add(1, np.ones(4, np.float32))
    assert len(index) == 2
    assert index.network == "one"
    assert len(index.rank(np.ones(4, np.float32), range(2))) == 2


def test_an_empty_index_ranks_nothing():
    assert PlaceIndex().rank(np.ones(4, np.float32), range(10)) == []
