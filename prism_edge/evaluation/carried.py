"""Where the finished map has each frame: carried by its keyframe, and led to where the next one came to lie.

A frame was tracked beside a keyframe of then. By the time the next one was made it had drifted from where the
finished map has that; frames between the two have their share of it, by time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from prism_edge.geometry.poses import Array, from_rt, so3_exp, so3_log
from prism_edge.messages import Tracked


def carried(
    frames: Sequence[Tracked], offsets: Sequence[Array], keyframes: Mapping[int, Array]
) -> list[Array]:
    """world_from_camera (4, 4) of frames in the order of their stamps.

    ``offsets`` are reference_from_camera (4, 4) in the units of ``keyframes``, which holds the finished
    world_from_camera of each one's reference, or of the keyframe that it became.
    """
    # Of a keyframe's own frame the reference may be gone.
    placed = [
        keyframes[f.reference] @ offset if f.reference in keyframes else keyframes[f.keyframe]
        for f, offset in zip(frames, offsets, strict=True)
    ]
    first = 0  # frame since the last keyframe was made, or another became the reference
    for i, frame in enumerate(frames):
        if i and frame.reference != frames[i - 1].reference:
            first = i
        own = keyframes.get(frame.keyframe)
        if own is None:
            continue
        began_ns = frames[max(first - 1, 0)].stamp_ns
        turned = so3_log(placed[i][:3, :3].T @ own[:3, :3])
        moved = own[:3, 3] - placed[i][:3, 3]
        for j in range(first, i):
            share = (frames[j].stamp_ns - began_ns) / max(frame.stamp_ns - began_ns, 1)
            led = placed[j][:3, :3] @ so3_exp(share * turned)
            placed[j] = from_rt(led, placed[j][:3, 3] + share * moved)
        placed[i] = own
        first = i + 1
    for i in range(1, len(frames)):  # a copy of an image is where the image is
        if frames[i].reference == frames[i - 1].reference and np.array_equal(offsets[i], offsets[i - 1]):
            placed[i] = placed[i - 1]
    return placed
