"""A camera that has its own robot in view: with a mask it is followed as without the robot."""

from __future__ import annotations

import numpy as np

from prism_edge.tracking.tracker import Tracker
from tests.synthetic.scene import block_texture
from tests.tracking.film_run import CONFIG, Run
from tests.tracking.footage import footage

HEIGHT, OWN = 240, 80  # rows, and those of them that the robot is seen in
BONNET = block_texture(np.random.default_rng(3), 320, OWN)


def followed(masked: bool) -> Run:
    """The film with a third of each image taken by what never moves."""
    run = Run(Tracker(CONFIG))
    if masked:
        shown = np.ones((HEIGHT, 320), bool)
        shown[-OWN:] = False
        run.tracker.look_only_at(shown)
    for i in range(60):
        image = footage().images[i].copy()
        image[-OWN:] = BONNET
        known = set(run.keyframes)
        run.feed(i, image)
        for k in set(run.keyframes) - known:
            run.depth(k)
    return run


def test_a_masked_bonnet_is_no_part_of_the_world() -> None:
    run = followed(masked=True)
    assert run.errors(range(1, 60)).max() < 0.1  # a third of the image is missing; without: 0.04
    for keyframe in run.tracker.world.keyframes.values():
        assert keyframe.features.pixels[:, 1].max() < HEIGHT - OWN


def test_without_the_mask_it_would_be() -> None:
    run = followed(masked=False)
    placed = [i for i in range(1, 60) if run.results[i].world_from_camera is not None]
    assert run.errors(placed).max() > 0.3
