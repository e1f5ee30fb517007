"""The table of points against a dict, through any sequence of operations."""

from __future__ import annotations

import numpy as np
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule

from prism_edge.messages import IDS_A_LIFE
from prism_edge.tracking.point_table import PointTable


class TableModel(RuleBasedStateMachine):
    """Adds, kills and squeezes a table and a dict alike."""

    def __init__(self) -> None:
        super().__init__()
        self.table = PointTable()
        self.model: dict[int, tuple[float, bool]] = {}
        self.issued = 0

    @rule(count=st.sampled_from([0, 1, 7, 900, 3000]))
    def add(self, count: int) -> None:
        values = np.arange(count) + 1000.0 * self.issued
        positions = np.column_stack([values, values, values])
        ids = self.table.add(count, position=positions, parallax_deg=values, reference=5)
        assert ids.tolist() == list(range(self.issued, self.issued + count)), "ids are permanent"
        self.issued += count
        self.model |= {int(i): (float(v), True) for i, v in zip(ids, values, strict=True)}

    @rule(share=st.floats(0.0, 1.0), seed=st.integers(0, 100))
    def kill(self, share: float, seed: int) -> None:
        ids = np.array([p for p, (_, alive) in self.model.items() if alive], np.int64)
        chosen = ids[np.random.default_rng(seed).random(len(ids)) < share]
        self.table.alive[self.table.rows(chosen)] = False
        for p in chosen.tolist():
            self.model[p] = (self.model[p][0], False)

    @rule()
    def squeeze(self) -> None:
        self.table.squeeze()

    @invariant()
    def same_as_the_dict(self) -> None:
        alive = {p: v for p, (v, lives) in self.model.items() if lives}
        table = self.table
        assert table.ids[table.alive].tolist() == sorted(alive)
        assert table.position[table.alive, 1].tolist() == [alive[p] for p in sorted(alive)]
        ids = np.arange(-2, self.issued + 2)
        assert table.known(ids).tolist() == [p in alive for p in ids.tolist()]
        assert table.ids[table.live_rows(ids)].tolist() == sorted(alive)
        some = np.array(sorted(alive)[::7], np.int64)
        assert table.ids[table.rows(some)].tolist() == some.tolist()
        assert len(table) >= len(alive)


TestPointTable = TableModel.TestCase
TestPointTable.settings = settings(max_examples=15, stateful_step_count=20, deadline=None)


def test_dead_rows_are_squeezed_out_once_they_are_the_majority():
    table = PointTable()
    table.add(6000, parallax_deg=np.arange(6000.0))
    table.alive[:2500] = False
    table.squeeze()
    assert len(table) == 6000
    table.alive[:4000] = False
    table.squeeze()
    assert len(table) == 2000
    assert table.ids.tolist() == list(range(4000, 6000))
    assert table.parallax_deg.tolist() == list(range(4000, 6000))


def test_new_rows_don_t_inherit_from_dead_ones():
    table = PointTable()
    table.add(6000, parallax_deg=9.0, octave=3, weight=0.5)
    table.alive[:] = False
    table.squeeze()
    ids = table.add(10)
    rows = table.rows(ids)
    assert ids.tolist() == list(range(6000, 6010))
    assert table.add(1).tolist() == [6010]
    assert not table.parallax_deg[rows].any()
    assert not table.octave[rows].any()
    assert (table.weight[rows] == 1.0).all()
    assert table.alive[rows].all()


def test_a_table_taken_over_numbers_on_past_what_its_last_owner_may_have_given_out():
    table = PointTable()
    table.restore(np.array([3, 40]))
    table.leave_room(7)
    assert table.add(2).tolist() == [IDS_A_LIFE, IDS_A_LIFE + 1]
    table.leave_room(5 * IDS_A_LIFE + 3)
    assert table.add(1).tolist() == [5 * IDS_A_LIFE + 3]
    empty = PointTable()
    empty.leave_room(2 * IDS_A_LIFE)
    assert empty.add(1).tolist() == [2 * IDS_A_LIFE]


def test_views_follow_growth():
    table = PointTable()
    first = table.add(10, octave=1)
    table.add(100_000, octave=2)
    table.octave[table.rows(first)] = 7
    assert table.octave[:10].tolist() == [7] * 10
    assert (table.octave[10:] == 2).all()


def test_the_index_stays_as_large_as_the_table_asks_for():
    """Days of mapping: millions of ids given out, a few thousand rows left, old and new among them."""
    table = PointTable()
    old = table.add(1500, parallax_deg=1.0)
    rng = np.random.default_rng(0)
    for _ in range(60):
        ids = table.add(70_000)
        kept = rng.choice(ids, 60, replace=False)
        table.alive[table.rows(ids)] = np.isin(ids, kept)
        table.squeeze()
    assert len(table) < 80_000
    assert len(table._slots) <= 8 * 80_000
    alive = table.ids[table.alive]
    assert set(old.tolist()) <= set(alive.tolist())
    rng.shuffle(alive)
    assert (table.ids[table.rows(alive)] == alive).all()
    assert table._shared, "else this tries nothing: ids far apart with a slot in common"
    anything = np.concatenate([alive, rng.integers(0, 60 * 70_000, 5000)])
    assert (table.known(anything) == np.isin(anything, alive)).all()
    assert table.ids[table.live_rows(anything)].tolist() == anything[np.isin(anything, alive)].tolist()
