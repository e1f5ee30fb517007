"""What the backend shows of its map: where keyframes are, which points there are, and the loops."""

from __future__ import annotations

import numpy as np

from prism_edge.backend.connectivity import parts_of
from prism_edge.backend.mapper import Mapper
from prism_edge.messages import MapSnapshot


def snapshot(mapper: Mapper, settled: bool, log_scale: float) -> MapSnapshot:
    """The map of this moment, for who asks; ``settled`` where nothing is left to be done."""
    world, loops = mapper.world, mapper.loops.accepted
    numbers, poses = world.table()
    apart = parts_of(world)
    # A culled keyframe is where that is which it hangs on.
    at = np.concatenate([numbers[: len(world.keyframes)], world.carried.numbers[:, 1]]).tolist()
    return MapSnapshot(
        epoch=mapper.epoch,
        sequence=mapper.sequence,
        settled=settled,
        log_scale=log_scale,
        keyframes=numbers,
        poses=poses,
        points=np.array(list(world.points), np.int64),
        carried=len(world.carried),
        away=numbers[[k in apart for k in at]],
        grown=np.array([world.keyframes[k].grown for k in at], np.float64),
        loop_queries=np.array([loop.query_index for loop in loops], np.int64),
        loop_candidates=np.array([loop.candidate_index for loop in loops], np.int64),
        loop_poses=np.array([loop.candidate_from_query for loop in loops]).reshape(-1, 4, 4),
        loop_inliers=np.array([loop.inliers for loop in loops], np.int64),
        base_from_camera=mapper.mount,
        camera=np.zeros(0) if world.camera is None else world.camera.to_array(),
        readout_ms=world.readout_ms,
    )
