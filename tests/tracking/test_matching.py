"""Descriptor matching against a reference written with loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from prism_edge.tracking.features import Features
from prism_edge.tracking.matching import (
    all_distances,
    best_pairs,
    expand_ranges,
    hamming,
    match_corners,
    match_projected,
)
from tests.backend.ring import Ring, features_of


def reference_best(query, keypoint, distance, most, ratio):
    """Each query's nearest if it is near and distinct; each keypoint to the nearest query that wants it."""
    wanted = {}
    for q in sorted(set(query)):
        mine = [(d, i) for i, (p, d) in enumerate(zip(query, distance, strict=True)) if p == q]
        mine.sort()
        nearest, second = mine[0], mine[1] if len(mine) > 1 else None
        if nearest[0] <= most and (second is None or nearest[0] < ratio * second[0]):
            k = keypoint[nearest[1]]
            if k not in wanted or (nearest[0], q) < wanted[k]:
                wanted[k] = (nearest[0], q)
    return {(q, k) for k, (_, q) in wanted.items()}


@settings(max_examples=150, deadline=None)
@given(
    pairs=st.lists(
        st.tuples(st.integers(0, 8), st.integers(0, 8), st.integers(0, 9) | st.integers(0, 256)),
        max_size=40,
        unique_by=lambda p: p[:2],
    ),
    most=st.integers(0, 256),
    ratio=st.sampled_from([0.5, 0.75, 0.9, 1.0]),
)
def test_best_pairs_equals_the_reference(pairs, most, ratio):
    pairs.sort(key=lambda p: p[0])
    query, keypoint, distance = (np.array([p[i] for p in pairs], np.int64) for i in range(3))
    q, k = best_pairs(query, keypoint, distance, most, ratio)
    found = list(zip(q.tolist(), k.tolist(), strict=True))
    assert set(found) == reference_best(query.tolist(), keypoint.tolist(), distance.tolist(), most, ratio)
    assert len(set(q.tolist())) == len(set(k.tolist())) == len(found)


@settings(max_examples=60, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 60))
def test_match_projected_equals_the_reference(seed, count):
    rng = np.random.default_rng(seed)
    pixels = rng.uniform((0.0, 0.0), (160.0, 120.0), (count, 2))
    # Few distinct descriptors and few differing bits, so that ties, doubles and rejections all occur.
    words = rng.integers(0, 4, (count, 4)).astype(np.uint64)
    features = Features.build(pixels, rng.integers(0, 4, count), words, 160, 120)
    centres, radii = rng.uniform((0.0, 0.0), (160.0, 120.0), (25, 2)), rng.uniform(1.0, 40.0, 25)
    octaves, wanted = rng.integers(0, 4, 25), rng.integers(0, 4, (25, 4)).astype(np.uint64)
    free = rng.random(count) < 0.7
    query, keypoint = match_projected(features, centres, radii, octaves, wanted, 3, 0.9, free)
    pairs = [
        (q, k, sum((int(a) ^ int(b)).bit_count() for a, b in zip(wanted[q], words[k], strict=True)))
        for q in range(25)
        for k in features.order.tolist()  # the order of a search decides between equals
        if np.abs(pixels[k] - centres[q]).max() <= radii[q]
        and abs(features.octaves[k] - octaves[q]) <= 1
        and free[k]
    ]
    columns = ([p[i] for p in pairs] for i in range(3))
    assert set(zip(query.tolist(), keypoint.tolist(), strict=True)) == reference_best(*columns, 3, 0.9)


@given(st.lists(st.integers(0, 2**64 - 1), min_size=8, max_size=8))
def test_hamming_counts_bits(words):
    a, b = np.array([words[:4]], np.uint64), np.array([words[4:]], np.uint64)
    expected = sum((x ^ y).bit_count() for x, y in zip(words[:4], words[4:], strict=True))
    assert hamming(a, b).tolist() == [expected]


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(0, 9)), max_size=20))
def test_expand_ranges_lists_every_value(ranges):
    starts = np.array([s for s, _ in ranges], np.intp)
    stops = starts + np.array([n for _, n in ranges], np.intp)
    owners = 7 * np.arange(len(ranges))
    owner, value = expand_ranges(starts, stops, owners)
    expected = [(7 * i, v) for i, (s, n) in enumerate(ranges) for v in range(s, s + n)]
    assert list(zip(owner.tolist(), value.tolist(), strict=True)) == expected


def test_nothing_to_match():
    none = Features.build(np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros((0, 4), np.uint64), 160, 120)
    some = Features.build(np.ones((3, 2)), np.zeros(3, np.intp), np.zeros((3, 4), np.uint64), 160, 120)
    for features, count in ((none, 2), (some, 0), (none, 0)):
        query, keypoint = match_projected(
            features,
            np.ones((count, 2)),
            np.ones(count),
            np.zeros(count, np.intp),
            np.zeros((count, 4), np.uint64),
            64,
            0.9,
        )
        assert len(query) == len(keypoint) == 0


def test_matches_are_mutual_and_right():
    ring = Ring()
    first, second = ring.keyframes(2)
    a, b = match_corners(features_of(first), features_of(second))
    assert len(a) > 50
    assert len(set(a.tolist())) == len(set(b.tolist())) == len(a)
    assert (first.points[a] == second.points[b]).mean() > 0.99


def test_nothing_matches_nothing():
    ring = Ring()
    first = ring.keyframe()
    none = replace(
        first,
        pixels=np.zeros((0, 2), np.float32),
        octaves=np.zeros(0, np.uint8),
        descriptors=np.zeros((0, 32), np.uint8),
    )
    a, b = match_corners(features_of(first), features_of(none))
    assert len(a) == len(b) == 0


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 1000), rows=st.integers(0, 70), columns=st.integers(1, 9))
def test_all_distances_are_those_of_the_pairs(seed, rows, columns):
    rng = np.random.default_rng(seed)
    a, b = (rng.integers(0, 2**64, (n, 4), np.uint64) for n in (rows, columns))
    expected = [[int(hamming(one[None], other[None])[0]) for other in b] for one in a]
    assert all_distances(a, b).tolist() == expected
