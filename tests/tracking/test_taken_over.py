"""What a correction says of points themselves: where they are, and how far they are trusted."""

from __future__ import annotations

import numpy as np
import pytest

from prism_edge.geometry.poses import transform
from prism_edge.tracking.map_correction import apply_correction, take_over
from prism_edge.tracking.submaps import Parts
from tests.synthetic.messages import map_update
from tests.tracking.cloud import BY_POINTS, Cloud, pose_at

MOTION = pose_at(0.3, -0.2, 0.1, 0.02, 0.1, -0.05)
POSES = [pose_at(0.3 * i, 0.0, 0.0, 0.0, -0.04 * i) for i in range(6)]


def test_points_count_by_the_gate_s_weights_as_the_backend_has_them() -> None:
    """Those that are gone here are passed over; without weights all stay as they are."""
    world, _ = Cloud(300, seed=0).mapped(POSES[:3])
    known, table = world.points.ids[world.points.alive][:20].copy(), world.points
    told = np.append(known, 10**6)
    weights = np.linspace(0.1, 0.9, 21).astype(np.float32)
    rows, others = table.rows(known), ~np.isin(table.ids, known)
    positions = np.vstack([table.position[rows], np.zeros(3)])
    update = {"points": told, "positions": positions, "parallax_deg": np.zeros(21, np.float32)}
    for said in (weights, weights[:0]):
        take_over(world, Parts(), map_update(2, **update, weights=said), None, BY_POINTS)
        assert table.weight[rows] == pytest.approx(weights[:20])
        assert (table.weight[others] == 1.0).all()


def test_a_corrected_point_is_where_the_backend_put_it_though_it_goes_with_a_keyframe_that_is_newer() -> None:
    """Its maker was culled and handed it on: what the keyframe takes along is what nothing is said of."""
    world, _ = Cloud(600, seed=1).mapped(POSES)
    table, newer = world.points, world.keyframes[5]
    handed_on = table.rows(newer.points[newer.observed()][::3])
    table.reference[handed_on] = newer.id
    known = table.ids[table.alive].copy()
    positions = transform(MOTION, table.position[table.rows(known)])
    update = map_update(
        4, keyframes=np.arange(5), poses=np.array([MOTION @ pose for pose in POSES[:5]]), points=known,
        positions=positions, parallax_deg=np.zeros(len(known), np.float32),
    )  # fmt: skip
    apply_correction(world, update, BY_POINTS, Parts())
    assert newer.world_from_camera == pytest.approx(MOTION @ POSES[5], abs=1e-3)
    assert np.array_equal(table.position[table.rows(known)], positions)
