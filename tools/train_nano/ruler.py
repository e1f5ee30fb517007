"""What a picture is to prism-nano: its size, its depth's focal length, its values; what one place is."""

from __future__ import annotations

WIDTH, HEIGHT = 128, 96  # of the input
CANONICAL_FOCAL = 104.57  # pixels of the input: what 640x480 with 525 pixels of focal length shrinks to
MEAN, STD = (0.45, 0.45, 0.45), (0.25, 0.25, 0.25)
SEEN_TOGETHER, SEEN_APART = 0.35, 0.05  # overlap of views of one place, and of different ones
FOUND = 0.5 * SEEN_TOGETHER  # overlap with the right answer, at least
